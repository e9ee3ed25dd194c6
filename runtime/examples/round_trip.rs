//! Measures what a busily polled round trip of a tick's 536 bytes costs by itself: over one word of shared memory, by publish-subscribe, and over
//! the blackboard.
//!
//!     cargo run --release -p nearl-runtime --example round_trip

use iceoryx2::prelude::*;
use std::error::Error;
use std::hint::spin_loop;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

const ROUNDS: u64 = 200_000;
/// Time for the other thread to open its ports.
const OPENING: Duration = Duration::from_millis(300);

#[repr(C)]
#[derive(Clone, Copy, Debug, ZeroCopySend)]
struct Packet {
    seq: u64,
    data: [u64; 66],
}

/// Words of two threads, far enough apart for a cache line each. 0: nothing yet.
#[derive(Default)]
#[repr(align(128))]
struct Word(AtomicU64);

fn report(name: &str, mut round: impl FnMut(u64)) {
    let mut times: Vec<u128> = (1..=ROUNDS)
        .map(|seq| {
            let start = Instant::now();
            round(seq);
            start.elapsed().as_nanos()
        })
        .collect();
    times.sort_unstable();
    let at = |share: f64| times[(share * (times.len() - 1) as f64) as usize];
    println!("{name:20} p50 {:5} ns   p99 {:5} ns", at(0.5), at(0.99));
}

fn one_word() {
    let (there, back) = (Word::default(), Word::default());
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for seq in 1..=ROUNDS {
                while there.0.load(Ordering::Acquire) != seq {
                    spin_loop();
                }
                back.0.store(seq, Ordering::Release);
            }
        });
        report("one word", |seq| {
            there.0.store(seq, Ordering::Release);
            while back.0.load(Ordering::Acquire) != seq {
                spin_loop();
            }
        });
    });
}

/// Runs `answer` on a thread of its own, which returns after [`ROUNDS`] answers, and `ask` here.
fn both(
    answer: impl FnOnce() -> Result<(), Box<dyn Error>> + Send,
    ask: impl FnOnce() -> Result<(), Box<dyn Error>>,
) -> Result<(), Box<dyn Error>> {
    std::thread::scope(|scope| {
        scope.spawn(|| answer().unwrap_or_else(|e| panic!("{e}")));
        std::thread::sleep(OPENING);
        ask()
    })
}

fn publish_subscribe() -> Result<(), Box<dyn Error>> {
    let name = format!("round-trip-{}", std::process::id());
    let open = |way: &str| -> Result<_, Box<dyn Error>> {
        let node = NodeBuilder::new().create::<ipc::Service>()?;
        let service = node.service_builder(&format!("{name}/{way}").as_str().try_into()?);
        Ok((service.publish_subscribe::<Packet>().open_or_create()?, node))
    };
    let answer = || {
        let ((there, _a), (back, _b)) = (open("there")?, open("back")?);
        let (from, to) = (there.subscriber_builder().create()?, back.publisher_builder().create()?);
        let mut seq = 0;
        while seq < ROUNDS {
            match from.receive()? {
                None => spin_loop(),
                Some(tick) => {
                    seq = tick.seq;
                    to.loan_uninit()?.write_payload(Packet { seq, data: [1; 66] }).send()?;
                }
            }
        }
        Ok(())
    };
    both(answer, || {
        let ((there, _a), (back, _b)) = (open("there")?, open("back")?);
        let (to, from) = (there.publisher_builder().create()?, back.subscriber_builder().create()?);
        std::thread::sleep(OPENING);
        let round = |seq| -> Result<(), Box<dyn Error>> {
            to.loan_uninit()?.write_payload(Packet { seq, data: [2; 66] }).send()?;
            while from.receive()?.is_none_or(|tick| tick.seq != seq) {
                spin_loop();
            }
            Ok(())
        };
        report("publish-subscribe", |seq| round(seq).unwrap_or_else(|e| panic!("{e}")));
        Ok(())
    })
}

fn blackboard() -> Result<(), Box<dyn Error>> {
    let name = format!("round-trip-{}", std::process::id());
    let node = NodeBuilder::new().create::<ipc::Service>()?;
    let create = |way: &str| -> Result<_, Box<dyn Error>> {
        let service = node.service_builder(&format!("{name}/board/{way}").as_str().try_into()?);
        Ok(service.blackboard_creator::<u64>().add::<Packet>(0, Packet { seq: 0, data: [0; 66] }).create()?)
    };
    let (there, back) = (create("there")?, create("back")?);
    let name = &name;
    let answer = move || {
        let node = NodeBuilder::new().create::<ipc::Service>()?;
        let open = |way: &str| -> Result<_, Box<dyn Error>> {
            let service = node.service_builder(&format!("{name}/board/{way}").as_str().try_into()?);
            Ok(service.blackboard_opener::<u64>().open()?)
        };
        let (reader, writer) =
            (open("there")?.reader_builder().create()?, open("back")?.writer_builder().create()?);
        let (from, to) = (reader.entry::<Packet>(&0)?, writer.entry::<Packet>(&0)?);
        let mut last = from.get();
        while last.seq < ROUNDS {
            if from.is_up_to_date(&last) {
                spin_loop();
                continue;
            }
            last = from.get();
            to.update_with_copy(Packet { seq: last.seq, data: [1; 66] });
        }
        Ok(())
    };
    both(answer, || {
        let (writer, reader) = (there.writer_builder().create()?, back.reader_builder().create()?);
        let (to, from) = (writer.entry::<Packet>(&0)?, reader.entry::<Packet>(&0)?);
        let mut last = from.get();
        report("blackboard", |seq| {
            to.update_with_copy(Packet { seq, data: [2; 66] });
            while last.seq != seq {
                if from.is_up_to_date(&last) {
                    spin_loop();
                } else {
                    last = from.get();
                }
            }
        });
        Ok(())
    })
}

fn main() -> Result<(), Box<dyn Error>> {
    set_log_level(LogLevel::Error);
    one_word();
    publish_subscribe()?;
    blackboard()
}
