//! A rollout server under clients that leave, are killed, cancel, read slowly, and send what is no request.
//!
//! Five minutes of it: `NEARL_STRESS_SECONDS=300 cargo test --release -p nearl-tests --test serve_stress -- --nocapture --ignored`.

mod common;

use std::collections::BTreeMap;
use std::process::Command;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use common::*;
use nearl_runtime::Snapshot;
use nearl_runtime::link::{RobotName, remove_files};
use nearl_runtime::rollout_protocol::*;
use nearl_trainer::rollout::{Worker, make_env, stream};
use rand::{RngExt, SeedableRng, rngs::StdRng};
use serde_json::Value;

const PATIENCE: Duration = Duration::from_secs(60);
const ROLE: &str = "NEARL_TEST_STRESS_CLIENT";
const CLIENTS: u64 = 16;
const SEEDS: u64 = 6;
/// Steps of the requests whose every bit is compared: more than one chunk.
const STEPS: u64 = 90;
/// Far more than anyone waits for.
const ENDLESS: u64 = 1_000_000;

struct Name(RobotName);

impl Name {
    fn client(&self) -> RolloutClient {
        RolloutClient::open(&self.0, PATIENCE).expect("a server")
    }
}

impl Drop for Name {
    fn drop(&mut self) {
        remove_files(&self.0);
    }
}

/// Not a test of its own: a client process that is killed while it reads.
#[test]
#[ignore = "started by another test as a process of its own"]
fn client() {
    let Ok(name) = std::env::var(ROLE) else { return };
    let mut client = Name(RobotName::new(&name).expect("name")).client();
    loop {
        let mut rollouts = client.request(&Request::new(1, ENDLESS)).expect("request");
        while let Ok(Some(_)) = rollouts.next(PATIENCE) {}
    }
}

/// The bits of a request, computed without a server.
fn expected(snapshot: &Snapshot, seed: u64) -> Vec<u64> {
    let env = make_env(snapshot).expect("environment");
    let mut worker = Worker::new(env, snapshot, 1.0, stream(seed, 0)).expect("worker");
    let mut row = Vec::new();
    (0..STEPS).for_each(|_| worker.transition(true, &mut row));
    row.iter().map(|x| x.to_bits()).collect()
}

/// Resident memory of a process \[kB\].
fn resident(id: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{id}/status")).expect("status of the server");
    let line = status.lines().find(|l| l.starts_with("VmRSS:")).expect("VmRSS");
    line.split_whitespace().nth(1).and_then(|n| n.parse().ok()).expect("a number of kB")
}

/// What one client did, by name.
type Counts = BTreeMap<&'static str, u64>;

/// One deed of a client; `None` ends the connection.
fn deed(client: &mut RolloutClient, rng: &mut StdRng, right: &[Vec<u64>]) -> (&'static str, bool) {
    let busy = |error: &RequestError| matches!(error, RequestError::Refused { answer: Answer::Busy, .. });
    match rng.random_range(0..10) {
        0..4 => {
            let seed = rng.random_range(0..SEEDS);
            let mut rollouts = client.request(&Request::new(seed, STEPS)).expect("request");
            let mut bits = Vec::new();
            loop {
                match rollouts.next(PATIENCE) {
                    Ok(Some(chunk)) => bits.extend(chunk.numbers.iter().map(|x| x.to_bits())),
                    Ok(None) => break,
                    Err(e) if busy(&e) => return ("busy", true),
                    Err(e) => panic!("{e}"),
                }
            }
            assert!(bits == right[seed as usize], "seed {seed} has other bits");
            ("bit-equal", true)
        }
        4 | 5 => {
            let length =
                if rng.random() { size_of::<RequestMessage>() } else { rng.random_range(1..MAX_REQUEST) };
            let bytes: Vec<u8> = (0..length).map(|_| rng.random()).collect();
            let answer = client.request_bytes(&bytes).expect("sent").next(PATIENCE);
            assert!(
                matches!(answer, Err(RequestError::Refused { answer: Answer::BadRequest, .. })),
                "{answer:?}"
            );
            ("malformed", true)
        }
        6 => {
            let answer = client.request(&Request::new(0, ENDLESS + 1)).expect("sent").next(PATIENCE);
            assert!(
                matches!(answer, Err(RequestError::Refused { answer: Answer::LimitExceeded, .. })),
                "{answer:?}"
            );
            ("over the limit", true)
        }
        7 => {
            let mut rollouts = client.request(&Request::new(rng.random(), ENDLESS)).expect("request");
            let first = rollouts.next(PATIENCE);
            if first.as_ref().is_err_and(busy) {
                return ("busy", true);
            }
            first.expect("chunk");
            rollouts.cancel();
            while rollouts.next(PATIENCE).expect("the end").is_some() {}
            ("cancelled", true)
        }
        8 => {
            // Reads nothing for a while, then leaves its request, but stays.
            let rollouts = client.request(&Request::new(rng.random(), ENDLESS)).expect("request");
            std::thread::sleep(Duration::from_millis(rng.random_range(0..50)));
            drop(rollouts);
            ("dropped", true)
        }
        _ => {
            let mut rollouts = client.request(&Request::new(rng.random(), ENDLESS)).expect("request");
            let _ = rollouts.next(Duration::from_millis(rng.random_range(0..20)));
            ("left", false)
        }
    }
}

fn hammer(name: &Name, number: u64, end: Instant, right: &[Vec<u64>]) -> Counts {
    let (mut rng, mut counts) = (StdRng::seed_from_u64(number), Counts::new());
    while Instant::now() < end {
        let mut client = name.client();
        let mut stays = true;
        while stays && Instant::now() < end {
            let (what, goes_on) = deed(&mut client, &mut rng, right);
            *counts.entry(what).or_default() += 1;
            stays = goes_on;
        }
    }
    counts
}

/// Starts client processes and kills them while they read.
fn killer(name: &Name, end: Instant) -> u64 {
    let (mut rng, mut killed) = (StdRng::seed_from_u64(99), 0);
    while Instant::now() < end {
        let mut command = Command::new(std::env::current_exe().expect("path of the test program"));
        let client =
            Process::start(command.args(["--exact", "client", "--ignored"]).env(ROLE, name.0.as_str()));
        std::thread::sleep(Duration::from_millis(rng.random_range(0..1000)));
        client.kill();
        killed += 1;
    }
    killed
}

#[test]
#[ignore = "fails: under churn refusals and requests are lost, and after kills clients no longer find the living server"]
fn sixteen_clients_hammer_a_server_which_neither_crashes_nor_leaks_nor_errs() {
    let seconds = std::env::var("NEARL_STRESS_SECONDS")
        .map_or(5.0, |s| s.parse::<f64>().expect("NEARL_STRESS_SECONDS"));
    let name = Name(RobotName::new(&format!("stress-{}", std::process::id())).expect("name"));
    let snapshot = Snapshot::load(&panda()).expect("bundled snapshot");
    let right: Vec<_> = (0..SEEDS).map(|seed| expected(&snapshot, seed)).collect();
    let panda = panda();
    let server =
        Process::nearl(&["serve", panda.to_str().expect("UTF-8"), "--name", name.0.as_str(), "--json"]);
    drop(name.client());

    let (start, sum) = (Instant::now(), Mutex::new(Counts::new()));
    let end = start + Duration::from_secs_f64(seconds);
    let mut memory = Vec::new();
    let killed = std::thread::scope(|scope| {
        let (name, right, sum) = (&name, &right, &sum);
        for number in 0..CLIENTS {
            scope.spawn(move || {
                let counts = hammer(name, number, end, right);
                let mut sum = sum.lock().expect("no client failed");
                counts.into_iter().for_each(|(what, n)| *sum.entry(what).or_default() += n);
            });
        }
        let killer = scope.spawn(|| killer(name, end));
        while Instant::now() < end {
            std::thread::sleep(Duration::from_secs_f64(seconds / 20.0));
            memory.push(resident(server.id()));
        }
        killer.join().expect("killer")
    });

    // Still right when all are gone.
    let mut client = name.client();
    let bits = until("a place at the server", || {
        let mut rollouts = client.request(&Request::new(0, STEPS)).expect("request");
        let mut bits = Vec::new();
        while let Some(chunk) = rollouts.next(PATIENCE).ok()? {
            bits.extend(chunk.numbers.iter().map(|x| x.to_bits()));
        }
        Some(bits)
    });
    assert!(bits == right[0]);
    drop(client);
    let report: Value = server.end();
    let counts = sum.into_inner().expect("no client failed");
    let quarter = memory.len() / 4;
    let most = |part: &[u64]| part.iter().copied().max().unwrap_or(0);
    let (early, late) = (most(&memory[..=quarter]), most(&memory[memory.len() - 1 - quarter..]));
    println!("{seconds} s, {CLIENTS} clients: {counts:?}, {killed} processes killed");
    println!("server: {report}");
    println!(
        "resident memory: {:.1} MB in the first quarter, {:.1} MB in the last",
        early as f64 / 1e3,
        late as f64 / 1e3
    );
    for what in ["bit-equal", "malformed", "over the limit"] {
        assert!(counts.get(what).is_some_and(|n| *n > 0), "no client ever was '{what}': {counts:?}");
    }
    assert_eq!(
        (report["failed"].as_u64(), report["malformed"].as_u64()),
        (Some(0), counts.get("malformed").copied()),
        "{report}"
    );
    assert!(killed > 0, "no client was killed");
    // Workers of requests are kept for the next ones; beyond the places there is nothing to grow by.
    assert!(late < early + early / 2 + 64_000, "the server grew from {early} kB to {late} kB");
}
