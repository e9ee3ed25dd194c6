//! A rollout server under clients that leave, are killed, cancel, read slowly, and send what is no request.
//!
//! Five minutes of it: `NEARL_STRESS_SECONDS=300 cargo test --release -p nearl-tests --test programs serve_stress -- --nocapture`.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use crate::common::*;
use nearl_runtime::Snapshot;
use nearl_runtime::link::{RobotName, remains, remove_files};
use nearl_trainer::rollout::{Worker, make_env, stream};
use nearl_trainer::rollout_protocol::*;
use rand::{RngExt, SeedableRng, rngs::StdRng};
use serde_json::Value;

const PATIENCE: Duration = Duration::from_secs(60);
const ROLE: &str = "NEARL_TEST_STRESS_CLIENT";
const CLIENTS: u64 = 16;
/// Requests the server takes at once, and clients it lets in at once.
const REQUESTS: usize = 16;
const PLACES: usize = 24;
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
    // No `Name`: dropping one removes the files of the living server.
    let mut client = RolloutClient::open(&RobotName::new(&name).expect("name"), PATIENCE).expect("a server");
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
    (0..STEPS).for_each(|_| worker.transition(true, &mut row).expect("a transition"));
    row.iter().map(|x| x.to_bits()).collect()
}

/// What a server without clients holds: data of replies and receipts, three services, the counter of nodes; the files of services and
/// node, its role, the lock of the living and the token; itself.
const ALONE: (usize, usize, usize) = (6, 16, 1);

/// Segments in shared memory, files, and processes that hold them.
fn held(name: &Name) -> (usize, usize, usize) {
    fn files(folder: &Path) -> usize {
        let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
        entries.map(|e| if e.path().is_dir() { files(&e.path()) } else { 1 }).sum()
    }
    let prefix = format!("nearl.{}.", name.0);
    let memory = std::fs::read_dir("/dev/shm").expect("/dev/shm").flatten();
    let segments = memory.filter(|f| f.file_name().to_string_lossy().starts_with(&prefix)).count();
    // SAFETY: plain call without arguments.
    let folder = Path::new("/dev/shm").join(format!("nearl-{}", unsafe { libc::geteuid() }));
    let holders = remains().into_iter().find(|r| r.name == name.0.as_str());
    (segments, files(&folder.join(name.0.as_str())), holders.map_or(0, |r| r.alive + r.dead))
}

/// Waits until nothing of any client is left.
fn alone(name: &Name) {
    until("the server alone", || (held(name) == ALONE).then_some(()));
}

/// Takes every place for requests at once, so that the server has all the simulators it will ever have: one that ended early would hand its own on.
fn fill(name: &Name) {
    let mut clients: Vec<_> = (0..REQUESTS / 2).map(|_| name.client()).collect();
    let ask = |client: &mut RolloutClient| {
        [1, 2].map(|seed| client.request(&Request::new(seed, ENDLESS)).expect("request"))
    };
    let mut running: Vec<_> = clients.iter_mut().flat_map(ask).collect();
    for rollouts in &mut running {
        rollouts.next(PATIENCE).expect("chunk").expect("chunk");
    }
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
        let client = Process::start(
            command.args(["--exact", "serve_stress::client", "--ignored"]).env(ROLE, name.0.as_str()),
        );
        std::thread::sleep(Duration::from_millis(rng.random_range(0..1000)));
        client.kill();
        killed += 1;
    }
    killed
}

#[test]
fn sixteen_clients_hammer_a_server_which_neither_crashes_nor_leaks_nor_errs() {
    let seconds = std::env::var("NEARL_STRESS_SECONDS")
        .map_or(6.0, |s| s.parse::<f64>().expect("NEARL_STRESS_SECONDS"));
    let name = Name(RobotName::new(&format!("stress-{}", std::process::id())).expect("name"));
    let snapshot = Snapshot::load(&panda()).expect("bundled snapshot");
    let right: Vec<_> = (0..SEEDS).map(|seed| expected(&snapshot, seed)).collect();
    let (panda, places) = (panda(), REQUESTS.to_string());
    let panda = panda.to_str().expect("UTF-8");
    let server =
        Process::nearl(&["serve", panda, "--name", name.0.as_str(), "--requests", &places, "--json"]);
    fill(&name);
    alone(&name);
    let early = resident(server.id());

    let (start, sum) = (Instant::now(), Mutex::new(Counts::new()));
    let end = start + Duration::from_secs_f64(seconds);
    let killed = std::thread::scope(|scope| {
        let (name, right, sum) = (&name, &right, &sum);
        for number in 0..CLIENTS {
            scope.spawn(move || {
                let counts = hammer(name, number, end, right);
                let mut sum = sum.lock().expect("no client failed");
                counts.into_iter().for_each(|(what, n)| *sum.entry(what).or_default() += n);
            });
        }
        killer(name, end)
    });

    // Every place is free again, and the answers are still right.
    let mut clients: Vec<_> = (0..PLACES).map(|_| name.client()).collect();
    let seconds = start.elapsed().as_secs_f64();
    let bits = until("a place at the server", || {
        let mut rollouts = clients[0].request(&Request::new(0, STEPS)).expect("request");
        let mut bits = Vec::new();
        while let Some(chunk) = rollouts.next(PATIENCE).ok()? {
            bits.extend(chunk.numbers.iter().map(|x| x.to_bits()));
        }
        Some(bits)
    });
    assert!(bits == right[0]);
    drop(clients);
    alone(&name);
    let late = resident(server.id());
    let report: Value = server.end();
    let counts = sum.into_inner().expect("no client failed");
    println!("{seconds:.0} s, {CLIENTS} clients: {counts:?}, {killed} processes killed");
    println!("server: {report}");
    println!("segments, files and holders: {ALONE:?} before and after; {PLACES} of {PLACES} places free");
    println!("memory of its own: {:.1} MB before, {:.1} MB after", early as f64 / 1e3, late as f64 / 1e3);

    let count = |what: &str| counts.get(what).copied().unwrap_or(0);
    let said = |what: &str| report[what].as_u64().expect("a number in the report");
    assert!(count("bit-equal") > 0 && killed > 0, "{counts:?}, {killed} killed");
    let ends = ["done", "cancelled", "busy", "limit", "malformed", "gone", "failed", "closed"];
    assert_eq!(said("requests"), ends.iter().map(|end| said(end)).sum::<u64>(), "{report}");
    let same = [("done", "bit-equal", 1), ("malformed", "malformed", 0), ("limit", "over the limit", 0)];
    for (end, what, more) in same {
        assert_eq!(said(end), count(what) + more, "{end}: {report}, {counts:?}");
    }
    assert_eq!((said("failed"), said("closed")), (0, 0), "{report}");
    // A simulator of the Panda takes 0.7 MB; the server has all of them from the start.
    assert!(late < early + 8_000, "the server grew from {early} kB to {late} kB");
}
