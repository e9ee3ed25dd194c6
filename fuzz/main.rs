//! Everything that comes from outside, damaged: snapshots, task files, fault plans, messages, flight logs, to replay and to verify.
//!
//! A program of its own: a case that hangs ends the process, and the allocator counts the bytes that each thread holds.
//!
//! Each target takes a file of its folder in `corpus/`, damages it as the seed says, and reads it. A refusal must be one
//! sentence; a panic, a hang, or memory beyond a bound fails and leaves the input in the temporary folder.
//!
//! | variable | |
//! |---|---|
//! | `NEARL_FUZZ_CASES` | cases of each target (a few thousand by default) |
//! | `NEARL_FUZZ_SECONDS` | instead: seconds of each target |
//! | `NEARL_FUZZ_SEED` | first seed (0) |
//! | `NEARL_WRITE=1` | writes `corpus/` anew |

#![allow(unreachable_pub)] // modules of a test program

#[path = "../runtime/tests/arm/mod.rs"]
mod arm;
#[path = "../runtime/tests/attack/mod.rs"]
mod attack;
mod budget;
mod corpus;
mod log;
mod messages;
mod mutate;
mod snapshot;
#[path = "../runtime/tests/toy/mod.rs"]
mod toy;
mod verified;

use std::panic::{AssertUnwindSafe, catch_unwind};

use budget::{Watch, peak_of};
use mutate::{Rng, mutate};
use nearl_runtime::rt::FaultPlan;
use nearl_runtime::{Manifest, Task};

#[global_allocator]
static ALLOCATOR: budget::Counting = budget::Counting;

/// What a case may hold beside a few copies of its input [bytes].
const ROOM: u64 = 64 << 20;
/// The same for flight logs: before it reads a text, the mcap crate reserves as much address space as its length field of 32 bits says.
const ROOM_OF_LOGS: u64 = 5 << 30;

fn number(variable: &str) -> Option<u64> {
    std::env::var(variable).ok().map(|text| text.parse().expect("a whole number"))
}

/// Runs `read` on damaged files of `corpus/<target>`; `damage` is what a plain mutation does not reach.
pub fn fuzz(
    target: &'static str,
    cases: u64,
    damage: impl Fn(&mut Rng, &[u8], &[u8]) -> Vec<u8>,
    read: impl Fn(&[u8]),
) {
    let files = corpus::files(target);
    let (first, seconds) = (number("NEARL_FUZZ_SEED").unwrap_or(0), number("NEARL_FUZZ_SECONDS"));
    let cases = number("NEARL_FUZZ_CASES").unwrap_or(cases);
    let watch = Watch::new(target);
    let mut done = 0;
    for file in &files {
        run(target, u64::MAX, file, &read); // as they are
    }
    for seed in first.. {
        let spent = watch.begin();
        if seconds.map_or(done >= cases, |s| spent.as_secs() >= s) {
            break;
        }
        let mut rng = Rng(seed);
        let (base, other) = (rng.pick(&files).clone(), rng.pick(&files).clone());
        run(target, seed, &damage(&mut rng, &base, &other), &read);
        done += 1;
    }
    println!("{target}: {done} cases from seed {first}, {} files", files.len());
}

fn run(target: &str, seed: u64, input: &[u8], read: &impl Fn(&[u8])) {
    let mut panicked = false;
    let peak = peak_of(|| panicked = catch_unwind(AssertUnwindSafe(|| read(input))).is_err());
    let room = if matches!(target, "log" | "verified") { ROOM_OF_LOGS } else { ROOM };
    let most = room + 100 * input.len() as u64;
    if panicked || peak > most {
        let file = std::env::temp_dir().join(format!("nearl-fuzz-{target}-{seed}"));
        std::fs::write(&file, input).expect("input");
        let file = file.display();
        panic!(
            "{target}, NEARL_FUZZ_SEED={seed}: panicked {panicked}, {peak} B held ({most} B allowed); input in {file}"
        );
    }
}

/// A refusal is one sentence that names one of `words`.
pub fn assert_sentence(text: &str, words: &[&str]) {
    assert!(words.iter().any(|word| text.contains(word)), "none of {words:?} is in: {text}");
    assert!(text.lines().count() == 1 && text.len() < 4000, "not one sentence: {text}");
}

#[test]
fn snapshots() {
    fuzz("snapshot", 400, snapshot::damage, snapshot::read);
}

#[test]
fn task_files() {
    fuzz("task", 3000, mutate, |bytes| {
        let Ok(text) = std::str::from_utf8(bytes) else { return };
        match Task::parse("t.toml", text, &[]) {
            Err(error) => assert_sentence(&error.to_string(), &["t.toml"]),
            Ok(task) => {
                let manifest = Manifest { task, ..arm::snapshot(1, |_| {}).manifest };
                if let Err(error) = nearl_runtime::controller::Parts::new(&manifest) {
                    assert_sentence(&error.to_string(), &["task cannot be used"]);
                }
            }
        }
    });
}

#[test]
fn fault_plans() {
    let folder = arm::Scratch::new("fuzz-plan");
    let file = folder.0.join("plan.json");
    fuzz("plan", 2000, mutate, |bytes| {
        std::fs::write(&file, bytes).expect("plan");
        match FaultPlan::load(&file) {
            Err(error) => assert_sentence(&error.to_string(), &["plan.json"]),
            Ok(plan) => {
                let mut state = nearl_runtime::link::Message::zeroed();
                (0..600)
                    .for_each(|tick| plan.spoil(tick, &mut state, &nearl_runtime::link::Message::zeroed()));
            }
        }
    });
}

#[test]
fn link_messages() {
    fuzz("message", 20_000, mutate, messages::read_link);
}

#[test]
fn states_in_the_loop() {
    messages::with_core(|read| fuzz("state", 3000, mutate, read));
}

#[test]
fn robots() {
    fuzz("robot", 300, mutate, messages::read_robot);
}

#[test]
fn rollout_messages() {
    fuzz("rollout", 20_000, mutate, messages::read_rollout);
}

#[test]
fn flight_logs() {
    let folder = arm::Scratch::new("fuzz-log");
    let file = folder.0.join("flight.mcap");
    fuzz("log", 120, log::damage, |bytes| log::read(&file, bytes));
}

#[test]
fn verified_logs() {
    let folder = arm::Scratch::new("fuzz-verified");
    let file = folder.0.join("flight.mcap");
    let (limits, broken) = (verified::Limits::new(), std::sync::atomic::AtomicU64::new(0));
    let damage = |rng: &mut Rng, base: &[u8], other: &[u8]| limits.damage(rng, base, other);
    fuzz("verified", 300, damage, |bytes| {
        broken.fetch_add(verified::read(&file, bytes, &limits), std::sync::atomic::Ordering::Relaxed);
    });
    println!("{} ticks were beyond a limit, and none of them was called verified", broken.into_inner());
}
