//! The rollout server: the same bits whatever the load, explicit refusals, and clients or servers that die.

use std::sync::mpsc::channel;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::common::*;
use nearl_runtime::Snapshot;
use nearl_runtime::link::{RobotName, remove_files};
use nearl_runtime::rt::Stop;
use nearl_trainer::rollout::{Worker, make_env, stream};
use nearl_trainer::rollout_protocol::*;
use nearl_trainer::serve::{Report, Settings, serve};
use rand::{RngExt, SeedableRng, rngs::StdRng};

const PATIENCE: Duration = Duration::from_secs(60);
const ROLE: &str = "NEARL_TEST_ROLLOUT_CLIENT";
/// Far more than any test waits for.
const ENDLESS: u64 = 1_000_000;

fn snapshot() -> Snapshot {
    Snapshot::load(&panda()).expect("bundled snapshot")
}

/// A name of its own, and nothing left of it at the end.
struct Name(RobotName);

impl Name {
    fn new(what: &str) -> Name {
        Name(RobotName::new(&format!("{what}-{}", std::process::id())).expect("name"))
    }

    fn client(&self) -> RolloutClient {
        RolloutClient::open(&self.0, PATIENCE).expect("a server")
    }

    fn process(&self) -> Process {
        let panda = panda();
        Process::nearl(&["serve", panda.to_str().expect("UTF-8"), "--name", self.0.as_str(), "--json"])
    }
}

impl Drop for Name {
    fn drop(&mut self) {
        remove_files(&self.0);
    }
}

/// A server in a thread of this process.
struct Serving {
    stop: Stop,
    thread: JoinHandle<Report>,
}

impl Serving {
    fn start(name: &Name, threads: usize, requests: usize) -> Serving {
        let (name, stop) = (name.0.clone(), Stop::new());
        let settings = Settings { threads, requests, max_steps: ENDLESS, max_envs: 16, patience: PATIENCE };
        let (ready, wait) = channel();
        let thread = std::thread::spawn({
            let stop = stop.clone();
            move || {
                let begin = || ready.send(()).expect("a test that waits");
                serve(&snapshot(), &name, &settings, &stop, begin).expect("a server")
            }
        });
        wait.recv().expect("the server begins");
        Serving { stop, thread }
    }

    fn end(self) -> Report {
        self.stop.request();
        self.thread.join().expect("the server ends")
    }
}

fn bits(numbers: &[f64]) -> Vec<u64> {
    numbers.iter().map(|x| x.to_bits()).collect()
}

/// All numbers of a request, whatever the chunks.
fn rollout(client: &mut RolloutClient, request: &Request) -> Vec<f64> {
    let mut rollouts = client.request(request).expect("request");
    let mut numbers = Vec::new();
    while let Some(chunk) = rollouts.next(PATIENCE).expect("chunk") {
        numbers.extend(chunk.numbers);
    }
    assert_eq!(rollouts.steps(), request.n_steps);
    numbers
}

fn refusal(client: &mut RolloutClient, request: &Request) -> (Answer, String) {
    match client.request(request).expect("request").next(PATIENCE) {
        Err(RequestError::Refused { answer, text }) => (answer, text),
        other => panic!("not refused: {other:?}"),
    }
}

/// The first chunk of a request that is then under way.
fn begin(client: &mut RolloutClient) -> Rollouts {
    let mut rollouts = client.request(&Request::new(1, ENDLESS)).expect("request");
    rollouts.next(PATIENCE).expect("chunk").expect("chunk");
    rollouts
}

/// Waits until the server has a place.
fn accepted(client: &mut RolloutClient) -> Rollouts {
    until("a place at the server", || {
        let mut rollouts = client.request(&Request::new(1, ENDLESS)).expect("request");
        match rollouts.next(PATIENCE) {
            Ok(chunk) => chunk.map(|_| rollouts),
            Err(RequestError::Refused { answer: Answer::Busy, .. }) => None,
            Err(e) => panic!("{e}"),
        }
    })
}

/// Not a test of its own: a client process to be killed. It reads one chunk, then no more.
#[test]
#[ignore = "started by another test as a process of its own"]
fn client() {
    let Ok(name) = std::env::var(ROLE) else { return };
    let mut client = RolloutClient::open(&RobotName::new(&name).expect("name"), PATIENCE).expect("server");
    // The test that looks for a busy server takes the place for moments.
    let _rollouts = accepted(&mut client);
    std::thread::sleep(PATIENCE);
}

#[test]
fn a_request_gives_the_same_bits_alone_and_among_eight_clients() {
    let request = Request::new(7, 500);
    let name = Name::new("alone");
    let server = Serving::start(&name, 1, 16);
    let alone = bits(&rollout(&mut name.client(), &request));
    server.end();

    let name = Name::new("crowd");
    let server = Serving::start(&name, 3, 16);
    std::thread::scope(|scope| {
        for i in 0..7 {
            let name = &name;
            scope.spawn(move || {
                let mut client = name.client();
                for seed in 0..3 {
                    rollout(&mut client, &Request::new(100 * i + seed, 200 + 37 * i));
                }
            });
        }
        let mut client = name.client();
        for _ in 0..3 {
            assert_eq!(bits(&rollout(&mut client, &request)), alone);
        }
    });
    let report = server.end();
    assert_eq!((report.done, report.gone, report.failed, report.malformed), (24, 0, 0, 0), "{report:?}");
}

#[test]
fn what_is_served_is_what_training_collects() {
    let steps = 1500; // over the end of an episode
    let (name, snapshot) = (Name::new("parity"), snapshot());
    let server = Serving::start(&name, 2, 4);
    let mut rollouts = name.client().request(&Request::new(3, steps)).expect("request");
    let (mut reward, mut action, mut ended, mut log_prob) = (vec![], vec![], vec![], vec![]);
    let mut expected_next: Option<Vec<f64>> = None;
    while let Some(chunk) = rollouts.next(PATIENCE).expect("chunk") {
        assert_eq!(
            (chunk.version, chunk.constraints),
            (snapshot.manifest.version, constraint_set(&snapshot.manifest))
        );
        reward.extend(chunk.column("reward").map(|r| r[0]));
        action.extend(chunk.column("action").flatten().map(|a| *a as f32));
        ended.extend(chunk.column("ended").map(|e| (e[0] != 0.0, e[1] != 0.0)));
        let both = chunk.column("log_prob_proposal").zip(chunk.column("log_prob_action"));
        log_prob.extend(both.map(|(p, a)| (p[0] + a[0]) as f32));
        for ((obs, next), end) in chunk.column("obs").zip(chunk.column("next_obs")).zip(chunk.column("ended"))
        {
            assert!(expected_next.is_none_or(|e| e == obs), "an observation does not follow the one before");
            expected_next = (end == [0.0, 0.0]).then(|| next.to_vec());
        }
    }
    let mut worker =
        Worker::new(make_env(&snapshot).expect("env"), &snapshot, 0.99, stream(3, 0)).expect("worker");
    worker.collect(steps as usize).expect("rollout");
    let collected = &worker.rows.collected.segment;
    assert_eq!(bits(&reward), bits(&collected.reward));
    assert_eq!((action, log_prob), (collected.action.clone(), collected.log_prob.clone()));
    // The learner also cuts at the end of its segment; a served stream says what the task says.
    let mut cut: Vec<_> =
        collected.terminated.iter().copied().zip(collected.truncated.iter().copied()).collect();
    assert!(ended.iter().any(|e| e.0 || e.1), "no episode ended");
    let last = ended.len() - 1;
    cut[last] = ended[last];
    assert_eq!(ended, cut);
    server.end();
}

#[test]
fn noise_and_projection_are_what_the_request_says() {
    let name = Name::new("modes");
    let server = Serving::start(&name, 2, 4);
    let mut client = name.client();
    let counts = |client: &mut RolloutClient, request: &Request| {
        let mut rollouts = client.request(request).expect("request");
        let mut sums = [0.0; LEDGER.len()];
        while let Some(chunk) = rollouts.next(PATIENCE).expect("chunk") {
            chunk.column("ledger").for_each(|row| sums.iter_mut().zip(row).for_each(|(s, x)| *s += x));
        }
        LEDGER.iter().zip(sums).map(|(name, sum)| (*name, sum)).collect::<std::collections::BTreeMap<_, _>>()
    };
    let own = Request::new(5, 400);
    let projected = counts(&mut client, &own);
    let raw = counts(&mut client, &Request { constraints: Constraints::Off, ..own });
    assert_eq!(projected["target_violations"], 0.0);
    assert!(projected["raw_violations"] > 0.0 && raw["target_violations"] > 0.0, "{projected:?} {raw:?}");
    let id = constraint_set(&snapshot().manifest);
    let by_id =
        Request { constraints: Constraints::Id(id), version: Some(snapshot().manifest.version), ..own };
    let same = bits(&rollout(&mut client, &own));
    assert_eq!(bits(&rollout(&mut client, &by_id)), same);
    assert_ne!(bits(&rollout(&mut client, &Request { noise: false, ..own })), same);
    server.end();
}

#[test]
fn a_full_server_says_busy_and_a_cancelled_place_is_free_again() {
    let name = Name::new("busy");
    let server = Serving::start(&name, 1, 1);
    let (mut first, mut second) = (name.client(), name.client());
    let mut rollouts = begin(&mut first);
    let (answer, text) = refusal(&mut second, &Request::new(1, 1));
    assert!(answer == Answer::Busy && text.contains("all 1 places"), "{answer}: {text}");
    rollouts.cancel();
    while rollouts.next(PATIENCE).expect("chunks under way, then the end").is_some() {}
    assert!(rollouts.steps() < ENDLESS);
    // Dropping the stream is enough, too.
    drop(accepted(&mut second));
    drop(accepted(&mut first));
    drop((first, second));
    let report = server.end();
    assert_eq!((report.cancelled, report.done), (1, 0), "{report:?}");
    assert!(report.busy >= 1 && report.gone + report.closed == 2, "{report:?}");
}

#[test]
fn limits_and_foreign_wishes_are_refused_with_the_reason() {
    let name = Name::new("limits");
    let server = Serving::start(&name, 1, 4);
    let mut client = name.client();
    let good = Request::new(1, 10);
    let refused = [
        (Request { n_steps: ENDLESS + 1, ..good }, Answer::LimitExceeded, "1000001 steps"),
        (Request { n_steps: 0, ..good }, Answer::BadRequest, "n_steps is 0"),
        (Request { version: Some(123_456), ..good }, Answer::BadRequest, "not 123456"),
        (Request { constraints: Constraints::Id(0xabc), ..good }, Answer::BadRequest, "not 0000000000000abc"),
    ];
    for (request, answer, words) in refused {
        let (given, text) = refusal(&mut client, &request);
        assert!(given == answer && text.contains(words), "{given}: {text}");
    }
    rollout(&mut client, &good);
    let report = server.end();
    assert_eq!((report.limit, report.malformed, report.done), (1, 3, 1), "{report:?}");
}

#[test]
fn malformed_requests_are_answered_and_counted_while_others_go_on() {
    let request = Request::new(11, 600);
    let name = Name::new("fuzz");
    let server = Serving::start(&name, 2, 8);
    let alone = bits(&rollout(&mut name.client(), &request));
    let rounds = 300;
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let (mut client, mut rng) = (name.client(), StdRng::seed_from_u64(4));
            for round in 0..rounds {
                let length = if round % 3 == 0 {
                    size_of::<RequestMessage>()
                } else {
                    rng.random_range(1..MAX_REQUEST)
                };
                let bytes: Vec<u8> = (0..length).map(|_| rng.random()).collect();
                let answer = client.request_bytes(&bytes).expect("sent").next(PATIENCE);
                assert!(
                    matches!(answer, Err(RequestError::Refused { answer: Answer::BadRequest, .. })),
                    "{answer:?}"
                );
            }
        });
        let mut client = name.client();
        for _ in 0..3 {
            assert_eq!(bits(&rollout(&mut client, &request)), alone);
        }
    });
    let report = server.end();
    assert_eq!((report.malformed, report.done), (rounds, 4), "{report:?}");
}

#[test]
fn the_place_of_a_killed_client_becomes_free() {
    let name = Name::new("killed");
    let server = Serving::start(&name, 1, 1);
    let mut command = std::process::Command::new(std::env::current_exe().expect("path of the test program"));
    let other =
        Process::start(command.args(["--exact", "serve::client", "--ignored"]).env(ROLE, name.0.as_str()));
    let mut client = name.client();
    until("the other client has the place", || {
        let first = client.request(&Request::new(1, 1)).expect("request").next(PATIENCE);
        matches!(first, Err(RequestError::Refused { answer: Answer::Busy, .. })).then_some(())
    });
    let killed = Instant::now();
    other.kill();
    drop(accepted(&mut client));
    println!("place free after {:?}", killed.elapsed());
    assert_eq!(server.end().failed, 0);
}

#[test]
fn a_client_outlives_its_server_and_asks_the_next_one() {
    let (name, request) = (Name::new("restart"), Request::new(2, 100));
    let server = name.process();
    let mut client = name.client();
    let before = bits(&rollout(&mut client, &request));
    let mut rollouts = begin(&mut client);
    server.kill();
    let error = loop {
        if let Err(error) = rollouts.next(PATIENCE) {
            break error;
        }
    };
    assert_eq!(error, RequestError::ServerGone(name.0.clone()));
    drop(rollouts);
    let server = name.process();
    let mut client = name.client();
    assert_eq!(bits(&rollout(&mut client, &request)), before);
    let _under_way = begin(&mut client);
    let report = server.end();
    assert_eq!((&report["done"], &report["closed"]), (&1.into(), &1.into()), "{report}");
}

/// The rates themselves are for the reader; here only that they are measured.
#[test]
fn the_benchmark_prints_served_beside_collected() {
    let panda = panda();
    let arguments = [
        "bench",
        "serve",
        panda.to_str().expect("UTF-8"),
        "--steps",
        "200",
        "--repeat",
        "1",
        "--clients",
        "2",
        "--json",
    ];
    let rates = Process::nearl(&arguments).json();
    for key in ["served_steps_per_s", "collected_steps_per_s", "ratio", "processor_ratio"] {
        assert!(rates[key].as_f64().is_some_and(|r| r.is_finite() && r > 0.0), "{key}: {rates}");
    }
}
