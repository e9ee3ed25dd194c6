//! A rollout server under attack: requests and policies made to harm it, clients that stop, die at any moment, flood it, or belong to
//! another user. Each is refused or survived by name while another client gets every bit right, and nothing is left.

mod clients;
mod requests;
mod snapshots;

use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use nearl_runtime::Snapshot;
use nearl_runtime::link::RobotName;
use nearl_runtime::snapshot::digest;
use nearl_trainer::rollout::{Worker, make_env, stream};
use nearl_trainer::rollout_protocol::*;
use serde_json::{Map, Value};

use crate::common::*;
use crate::serve_clients::Server;

const PATIENCE: Duration = Duration::from_secs(60);
const ROLE: &str = "NEARL_TEST_ATTACK_ROLE";
const NAME: &str = "NEARL_TEST_ATTACK_SERVER";
/// More than one chunk.
const STEPS: u64 = 90;
const ENDLESS: u64 = 1_000_000;
const GOOD: Training = Training { n_envs: 2, begins: true, stream: 0, gamma: 0.9, moved_penalty: 0.0 };

fn snapshot() -> Snapshot {
    Snapshot::load(&panda()).expect("bundled snapshot")
}

fn bits(numbers: &[f64]) -> Vec<u64> {
    numbers.iter().map(|x| x.to_bits()).collect()
}

/// The bits of a request, computed without a server.
fn expected(snapshot: &Snapshot, seed: u64) -> Vec<u64> {
    let env = make_env(snapshot).expect("environment");
    let mut worker = Worker::new(env, snapshot, 1.0, stream(seed, 0)).expect("worker");
    let mut row = Vec::new();
    (0..STEPS).for_each(|_| worker.transition(true, &mut row).expect("a transition"));
    bits(&row)
}

fn numbers(client: &mut RolloutClient, seed: u64) -> Result<Vec<f64>, RequestError> {
    let mut rollouts = client.request(&Request::new(seed, STEPS))?;
    let mut numbers = Vec::new();
    while let Some(chunk) = rollouts.next(PATIENCE)? {
        numbers.extend(chunk.numbers);
    }
    Ok(numbers)
}

/// Runs `attack` while another client asks again and again; it ends only after three whole rollouts, every bit of which is right.
fn beside(server: &Server, attack: impl FnOnce(&(dyn Fn() -> bool + Sync))) {
    let (over, rounds) = (AtomicBool::new(false), AtomicU64::new(0));
    let right = expected(&snapshot(), 5);
    std::thread::scope(|scope| {
        let witness = scope.spawn(|| {
            let mut client = server.client();
            while !over.load(Ordering::Relaxed) {
                match numbers(&mut client, 5) {
                    Ok(numbers) => assert!(bits(&numbers) == right, "other bits under attack"),
                    // Every place may be taken by the attackers, which is said.
                    Err(RequestError::Refused { answer: Answer::Busy, .. }) => continue,
                    Err(e) => panic!("{e}"),
                }
                rounds.fetch_add(1, Ordering::Relaxed);
            }
        });
        let begin = rounds.load(Ordering::Relaxed);
        let is_served = || rounds.load(Ordering::Relaxed) >= begin + 3 || witness.is_finished();
        let attack = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| attack(&is_served)));
        until("three rollouts under attack", || is_served().then_some(()));
        over.store(true, Ordering::Relaxed);
        witness.join().expect("the other client was served");
        attack.unwrap_or_else(|panic| std::panic::resume_unwind(panic));
    });
}

/// The file with another manifest, and the digest of what it now holds.
fn resigned(good: &[u8], change: impl FnOnce(&mut String)) -> Vec<u8> {
    let length = u64::from_le_bytes(good[..8].try_into().expect("eight bytes")) as usize;
    let mut header: Map<String, Value> = serde_json::from_slice(&good[8..8 + length]).expect("header");
    let data = &good[8 + length..];
    let old = header["__metadata__"]["nearl"].as_str().expect("manifest").to_owned();
    let mut manifest = old.split_once('\n').expect("digest and manifest").1.to_owned();
    change(&mut manifest);
    let list = |entry: &Value, key: &str| -> Vec<usize> {
        entry[key].as_array().into_iter().flatten().filter_map(Value::as_u64).map(|n| n as usize).collect()
    };
    let tensors: Vec<(String, Vec<usize>, &[u8])> = header
        .iter()
        .filter(|(name, _)| *name != "__metadata__")
        .map(|(name, entry)| {
            let place = list(entry, "data_offsets");
            (name.clone(), list(entry, "shape"), &data[place[0]..place[1]])
        })
        .collect();
    let sum = digest(&manifest, tensors.iter().map(|(n, s, d)| (n.as_str(), s.as_slice(), *d)));
    header.insert("__metadata__".into(), serde_json::json!({ "nearl": format!("{sum}\n{manifest}") }));
    let mut header = serde_json::to_vec(&header).expect("header");
    header.resize(header.len().next_multiple_of(8), b' ');
    [&(header.len() as u64).to_le_bytes()[..], &header, data].concat()
}

/// Not a test of its own: the clients that the tests below start as processes.
#[test]
#[ignore = "started by other tests as a process of its own"]
fn client() {
    let (Ok(role), Ok(name)) = (std::env::var(ROLE), std::env::var(NAME)) else { return };
    let name = RobotName::new(&name).expect("name");
    let stop_at = |stage: &str| {
        if role == stage {
            // SAFETY: plain call; the test continues this process.
            unsafe { libc::raise(libc::SIGSTOP) };
        }
    };
    if role == "stranger" {
        return stranger(&name);
    }
    let mut client = RolloutClient::open(&name, PATIENCE).expect("a server");
    stop_at("opened");
    if role == "learning" {
        let asked = Request { training: Some(GOOD), ..Request::new(1, 500) };
        let mut parts = client.request(&asked).expect("request");
        stop_at("learning");
        let mut end = parts.next_part(PATIENCE);
        while let Ok(Some(_)) = end {
            end = parts.next_part(PATIENCE);
        }
        return println!("said {}", end.expect_err("given up"));
    }
    let steps = if role == "whole" { STEPS } else { ENDLESS };
    let mut rollouts = client.request(&Request::new(1, steps)).expect("request");
    stop_at("asked");
    rollouts.next(PATIENCE).expect("chunk").expect("chunk");
    stop_at("reading");
    if role == "cancelled" {
        rollouts.cancel();
        stop_at("cancelled");
    }
    loop {
        match rollouts.next(PATIENCE) {
            Ok(Some(_)) => {}
            Ok(None) => return println!("said the end"),
            Err(e) => return println!("said {e}"),
        }
    }
}

/// As another user: nothing of the server's can be opened, and its name leads to this user's own, empty folder.
fn stranger(name: &RobotName) {
    const USER: libc::uid_t = 65_534;
    let theirs = Path::new("/dev/shm/nearl-0").join(name.as_str());
    let server: i32 = std::env::var("NEARL_TEST_ATTACK_PID").expect("pid").parse().expect("a number");
    // SAFETY: plain calls; this process is a stranger from here on.
    unsafe {
        assert_eq!(libc::setgroups(0, std::ptr::null()), 0);
        assert_eq!(libc::setresgid(USER, USER, USER), 0);
        assert_eq!(libc::setresuid(USER, USER, USER), 0);
        assert_eq!(libc::kill(server, libc::SIGSTOP), -1, "a stranger stopped the server");
    }
    for file in ["token", "alive", "owner-runtime"] {
        let error = std::fs::File::open(theirs.join(file)).expect_err(file);
        assert_eq!(error.kind(), std::io::ErrorKind::PermissionDenied, "{file}: {error}");
    }
    let prefix = format!("nearl.{name}.");
    let segments: Vec<_> = std::fs::read_dir("/dev/shm")
        .expect("/dev/shm")
        .flatten()
        .filter(|e| e.file_name().to_string_lossy().starts_with(&prefix))
        .collect();
    assert!(segments.len() > 2, "{segments:?}");
    for segment in segments {
        for write in [false, true] {
            let opened = std::fs::OpenOptions::new().read(!write).write(write).open(segment.path());
            assert_eq!(opened.unwrap_err().kind(), std::io::ErrorKind::PermissionDenied, "{segment:?}");
        }
        assert!(std::fs::remove_file(segment.path()).is_err(), "{segment:?}");
    }
    // Files where a server of that name might put its own next: they are in nobody's way, as their names cannot be guessed.
    let decoy = Path::new("/dev/shm").join(format!("{prefix}0000000000000000.decoy"));
    std::fs::write(&decoy, "decoy").expect("/dev/shm is open to all");
    let error = RolloutClient::open(name, Duration::from_millis(300)).map(|_| ()).unwrap_err();
    println!("said {error}");
}
