//! Round trip of a state and its action through shared memory, without a loop in between.

use std::sync::atomic::{AtomicBool, Ordering};

use serde::Serialize;

use super::service::Bus;
use super::*;
use crate::rt::{Percentiles, clock, percentiles};

/// Round trips in [ns].
#[derive(Clone, Debug, Serialize)]
pub struct RoundTrip {
    /// Size of the state message [bytes].
    pub state_bytes: usize,
    /// Size of the action message [bytes].
    pub action_bytes: usize,
    /// One after the other.
    pub busy: Percentiles,
    /// One each millisecond, on an absolute grid.
    pub paced: Percentiles,
    /// One after the other with messages of [`RoundTrip::ping_bytes`]: what the transport itself costs.
    pub ping: Percentiles,
    /// Size of these messages [bytes].
    pub ping_bytes: usize,
}

/// A message and its answer.
trait Pair {
    type Out: Message + iceoryx2::prelude::ZeroCopySend;
    type Back: Message + iceoryx2::prelude::ZeroCopySend;
    /// Number of the message that `back` answers.
    fn answered(back: &Self::Back) -> u64;
    /// Makes `back` the answer to message `seq`.
    fn answer(back: &mut Self::Back, seq: u64);
}

struct Control;
struct Transport;

impl Pair for Control {
    type Out = StateMessage;
    type Back = ActionMessage;
    fn answered(back: &ActionMessage) -> u64 {
        back.state_seq
    }
    fn answer(back: &mut ActionMessage, seq: u64) {
        back.state_seq = seq;
    }
}

impl Pair for Transport {
    type Out = PingMessage;
    type Back = PongMessage;
    fn answered(back: &PongMessage) -> u64 {
        back.ping_seq
    }
    fn answer(back: &mut PongMessage, seq: u64) {
        back.ping_seq = seq;
    }
}

/// Measures `n` round trips busy, `n` paced at 1 kHz and `n` pings between two threads, both polling; segments are the same as
/// between processes. Removes the files of `name` afterwards: use a name of its own.
pub fn bench_round_trip(name: &RobotName, n: u64) -> Result<RoundTrip, LinkError> {
    let control = with_echo::<Control>(name, n, true);
    let transport = control.and_then(|control| Ok((control, with_echo::<Transport>(name, n, false)?)));
    remove_files(name);
    let ([busy, paced], [ping, _]) = transport?;
    let (state_bytes, action_bytes) = (size_of::<StateMessage>(), size_of::<ActionMessage>());
    Ok(RoundTrip { state_bytes, action_bytes, busy, paced, ping, ping_bytes: size_of::<PingMessage>() })
}

fn with_echo<P: Pair>(name: &RobotName, n: u64, pace: bool) -> Result<[Percentiles; 2], LinkError> {
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let echo = scope.spawn(|| echo::<P>(name, &over));
        let result = measure::<P>(name, n, pace);
        over.store(true, Ordering::Release);
        match echo.join() {
            Ok(echoed) => echoed.and(result),
            Err(_) => Err(name.transport("measure", "the echo thread panicked")),
        }
    })
}

fn echo<P: Pair>(name: &RobotName, over: &AtomicBool) -> Result<(), LinkError> {
    let bus = Bus::join(name)?;
    let mut inbox = bus.inbox::<P::Out>()?;
    let mut outbox = bus.outbox::<P::Back>()?;
    let (mut back, mut poll) = (P::Back::zeroed(), Poll::default());
    while !over.load(Ordering::Acquire) {
        match inbox.newest() {
            Some(out) => {
                P::answer(&mut back, out.header().seq);
                outbox.send(&mut back);
                poll = Poll::default();
            }
            None => poll.again(),
        }
    }
    Ok(())
}

/// Polling that leaves the core to others after a while: without a second core nothing would ever answer.
#[derive(Default)]
struct Poll(u32);

impl Poll {
    fn again(&mut self) {
        self.0 += 1;
        if self.0 < 10_000 {
            std::hint::spin_loop();
        } else {
            std::thread::yield_now();
        }
    }
}

fn measure<P: Pair>(name: &RobotName, n: u64, pace: bool) -> Result<[Percentiles; 2], LinkError> {
    let fail = |e: hdrhistogram::CreationError| name.transport("measure", e.to_string());
    let bus = Bus::join(name)?;
    let mut outbox = bus.outbox::<P::Out>()?;
    let mut inbox = bus.inbox::<P::Back>()?;
    let mut out = P::Out::zeroed();
    let mut exchange = |patience: u64| {
        outbox.send(&mut out);
        let (end, mut poll) = (clock::now() + patience, Poll::default());
        while clock::now() < end {
            match inbox.newest() {
                Some(back) if P::answered(&back) == out.header().seq => {
                    return Some(clock::now() - out.header().stamp);
                }
                _ => poll.again(),
            }
        }
        None
    };
    // The first exchange waits for the echo thread to open its ends.
    let attached = (0..50).any(|_| exchange(100_000_000).is_some());
    if !attached {
        return Err(name.transport("measure", "the echo thread does not answer"));
    }
    let mut busy = hdrhistogram::Histogram::<u64>::new_with_bounds(1, 10_000_000_000, 3).map_err(fail)?;
    let mut paced = busy.clone();
    for _ in 0..n {
        exchange(1_000_000_000).into_iter().for_each(|t| busy.saturating_record(t));
    }
    let start = clock::now();
    for i in 0..if pace { n } else { 0 } {
        clock::sleep_until(start + i * 1_000_000);
        exchange(1_000_000_000).into_iter().for_each(|t| paced.saturating_record(t));
    }
    Ok([percentiles(&busy), percentiles(&paced)])
}
