//! One training on several ranks: the bits of one rank, and what is left when a rank is lost.

use nearl_tests::request;
use nearl_trainer::ranks::{Gather, Ranks};
use nearl_trainer::train::{Experience, Request, Training, resume, resume_on, train, train_on};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Barrier, Mutex};

/// Five batches of 1024 rows, in minibatches of two shards.
const SET: [&str; 4] =
    ["train.n_envs=8", "train.n_steps=128", "train.ppo.batch_size=512", "train.ppo.n_epochs=2"];
const STEPS: u64 = 5 * 1024;

/// Ranks that are threads of this process.
struct Round {
    places: Vec<Mutex<Vec<u8>>>,
    barrier: Barrier,
}

/// One rank's place. After `last` calls it reaches nobody.
struct Seat {
    round: Arc<Round>,
    rank: usize,
    calls: AtomicUsize,
    last: usize,
}

impl Gather for Seat {
    fn gather(&self, mine: &[u8]) -> Result<Vec<u8>, String> {
        if self.calls.fetch_add(1, Ordering::Relaxed) >= self.last {
            return Err("the cable is out".into());
        }
        *self.round.places[self.rank].lock().expect("place") = mine.to_vec();
        self.round.barrier.wait();
        let all = self.round.places.iter().flat_map(|place| place.lock().expect("place").clone()).collect();
        self.round.barrier.wait();
        Ok(all)
    }
}

fn ranks(size: usize, last: usize) -> Vec<Experience> {
    let places = (0..size).map(|_| Mutex::default()).collect();
    let round = Arc::new(Round { places, barrier: Barrier::new(size) });
    let seat = |rank| Seat { round: Arc::clone(&round), rank, calls: AtomicUsize::new(0), last };
    let rank = |rank| Ranks::new(rank, size, Box::new(seat(rank))).expect("a rank");
    (0..size).map(|r| Experience::Ranks(Arc::new(rank(r)))).collect()
}

/// What `work` returns on each rank, all of them at once.
fn on_each<T: Send>(ranks: &[Experience], work: impl Fn(usize, &Experience) -> T + Sync) -> Vec<T> {
    std::thread::scope(|scope| {
        let work = &work;
        let threads: Vec<_> =
            ranks.iter().enumerate().map(|(r, rank)| scope.spawn(move || work(r, rank))).collect();
        threads.into_iter().map(|thread| thread.join().expect("a rank panicked")).collect()
    })
}

fn asked(algo: &str, threads: usize) -> Request {
    asked_of("HalfCheetah-v5", algo, threads, &[])
}

fn asked_of(task: &str, algo: &str, threads: usize, more: &[&str]) -> Request {
    Request { steps: STEPS, ..request(task, algo, 3, threads, &[&SET, more].concat()) }
}

fn last(run: &Path) -> Vec<u8> {
    std::fs::read(run.join("checkpoints/final.safetensors")).expect("final")
}

/// All of the metrics but the columns of time.
fn metrics(run: &Path) -> Vec<Vec<String>> {
    let text = std::fs::read_to_string(run.join("metrics.csv")).expect("metrics");
    let rows: Vec<Vec<String>> =
        text.lines().map(|line| line.split(',').map(str::to_owned).collect()).collect();
    let keep: Vec<bool> = rows[0].iter().map(|name| !name.starts_with("time/")).collect();
    let kept = |row: Vec<String>| row.into_iter().zip(&keep).filter(|(_, k)| **k).map(|(x, _)| x).collect();
    rows.into_iter().map(kept).collect()
}

#[test]
fn any_number_of_ranks_gives_the_same_bits() {
    let folder = tempfile::tempdir().expect("folder");
    let costed = ["train.cost.limit=5.0", "train.cost.multiplier=0.5"];
    for (task, algo, more) in [
        ("HalfCheetah-v5", "pid2-ib", [].as_slice()),
        ("HalfCheetah-v5", "ppo", &[]),
        ("Hopper-velocity", "ppo", &costed),
    ] {
        let asked = |threads| asked_of(task, algo, threads, more);
        let one = folder.path().join(format!("{task}_{algo}_1"));
        train(&asked(1), &one, |_, _| true).expect("one rank");
        for (size, threads) in [(2, 1), (2, 2), (3, 1), (4, 1)] {
            let run = |rank| folder.path().join(format!("{task}_{algo}_{size}_{threads}_{rank}"));
            on_each(&ranks(size, usize::MAX), |rank, experience| {
                train_on(&asked(threads), experience, &run(rank), |_, _| true).expect("a rank");
            });
            for rank in 0..size {
                assert!(last(&run(rank)) == last(&one), "{algo}: rank {rank} of {size} has other weights");
                assert_eq!(metrics(&run(rank)), metrics(&one), "{algo}: rank {rank} of {size}");
            }
        }
    }
}

/// Whichever call is the last: one in the middle of an update, or the one that hands a batch round. What is left goes on to the same bits,
/// alone or with others again.
#[test]
fn a_rank_that_is_left_alone_stops_with_a_checkpoint_that_goes_on() {
    let folder = tempfile::tempdir().expect("folder");
    let one = folder.path().join("one");
    train(&asked("pid2-ib", 1), &one, |_, _| true).expect("one rank");
    // two calls hand a batch round; the first batch is not learned from, the second asks for sixteen calls or more
    for (calls, learned) in [(3, 1024), (9, 2048), (20, 2048), (31, 3072)] {
        let run = |rank| folder.path().join(format!("{calls}_{rank}"));
        let ends = on_each(&ranks(2, calls), |rank, experience| {
            train_on(&asked("pid2-ib", 2), experience, &run(rank), |_, _| true).map_err(|e| e.to_string())
        });
        for (rank, end) in ends.into_iter().enumerate() {
            let said = end.expect_err("it is alone");
            let begin = format!("rank {rank} of 2 was left alone after {learned} steps");
            let parts = [&begin, "the cable is out", "checkpoint"];
            parts.iter().for_each(|part| assert!(said.contains(*part), "'{part}' is not in: {said}"));
        }
        resume(&run(0), None, 1, |_, _| true).expect("alone");
        assert!(last(&run(0)) == last(&one), "alone after {calls} calls: other weights");
        on_each(&ranks(1, usize::MAX), |_, experience| {
            resume_on(&run(1), experience, None, 1, |_, _| true).expect("with others");
        });
        assert!(last(&run(1)) == last(&one), "with others after {calls} calls: other weights");
    }
}

#[test]
fn ranks_that_do_not_do_the_same_are_refused() {
    let said = on_each(&ranks(2, usize::MAX), |rank, experience| {
        let mut asked = asked("ppo", 1);
        asked.seed = rank as u64;
        let mut training = Training::on(&asked, experience).expect("a training");
        training.try_iterate().expect_err("they differ").to_string()
    });
    for words in said {
        assert!(words.contains("do not train the same") && words.contains("seed"), "{words}");
    }
    let few = on_each(&ranks(9, usize::MAX), |_, experience| {
        Training::on(&asked("ppo", 1), experience).err().expect("too few").to_string()
    });
    assert!(few[0].starts_with("[train.n_envs]: 8 environments for 9 ranks"), "{}", few[0]);
    let seat = Seat {
        round: Arc::new(Round { places: Vec::new(), barrier: Barrier::new(1) }),
        rank: 2,
        calls: AtomicUsize::new(0),
        last: 0,
    };
    assert!(Ranks::new(2, 2, Box::new(seat)).is_err());
}
