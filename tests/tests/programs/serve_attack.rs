//! A rollout server under attack: requests and policies made to harm it, clients that stop, die at any moment, flood it, or belong to
//! another user. Each is refused or survived by name while another client gets every bit right, and nothing is left.

use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use crate::common::*;
use crate::serve_clients::Server;
use iceoryx2::prelude::*;
use nearl_runtime::link::{Header, Message, ReceiptMessage, RobotName, TrainerLink, Verdict};
use nearl_runtime::net::DenseLayer;
use nearl_runtime::snapshot::digest;
use nearl_runtime::{PolicyKind, Snapshot};
use nearl_trainer::rollout::{Worker, make_env, stream};
use nearl_trainer::rollout_protocol::*;
use serde_json::{Map, Value};

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

/// The bytes of a request as they travel.
fn bytes_of(message: &RequestMessage) -> Vec<u8> {
    // SAFETY: plain numbers without padding, for their whole size.
    unsafe { std::slice::from_raw_parts(std::ptr::from_ref(message).cast(), size_of::<RequestMessage>()) }
        .to_vec()
}

fn message(request: &Request) -> RequestMessage {
    let mut message = request.message(1);
    message.header = Header { schema: RequestMessage::SCHEMA, epoch: 1, seq: 1, stamp: 0 };
    message
}

type Spoil = fn(&mut RequestMessage);

/// What is done to a good request, the answer, and words of it.
const SPOILT: &[(Spoil, Answer, &str)] = &[
    (|m| m.header.schema ^= 1, Answer::BadRequest, "schema"),
    (|m| m.n_steps = 0, Answer::BadRequest, "n_steps is 0"),
    (|m| m.n_steps = u64::MAX, Answer::LimitExceeded, "18446744073709551615 steps"),
    (|m| m.n_steps = ENDLESS + 1, Answer::LimitExceeded, "1000001 steps"),
    (|m| m.noise = 2, Answer::BadRequest, "noise is 2"),
    (|m| m.begins = u32::MAX, Answer::BadRequest, "begins 4294967295"),
    (|m| m.version = 123_456, Answer::BadRequest, "not 123456"),
    (|m| m.constraints = 77, Answer::BadRequest, "not 000000000000004d"),
    (|m| m.gamma = f64::NAN, Answer::BadRequest, "n_envs is 0"),
    (|m| m.stream = 1, Answer::BadRequest, "n_envs is 0"),
    (|m| m.moved_penalty = f64::INFINITY, Answer::BadRequest, "n_envs is 0"),
    (|m| (m.n_envs, m.gamma) = (1, f64::NAN), Answer::BadRequest, "gamma is NaN"),
    (|m| (m.n_envs, m.gamma) = (1, 1.0 + f64::EPSILON), Answer::BadRequest, "lies in [0, 1]"),
    (|m| (m.n_envs, m.gamma) = (1, -0.5), Answer::BadRequest, "lies in [0, 1]"),
    (|m| (m.n_envs, m.moved_penalty) = (1, f64::NAN), Answer::BadRequest, "moved_penalty NaN"),
    (|m| (m.n_envs, m.moved_penalty) = (1, f64::INFINITY), Answer::BadRequest, "moved_penalty inf"),
    (|m| (m.n_envs, m.noise) = (1, 0), Answer::BadRequest, "needs the policy's noise"),
    (|m| m.n_envs = 1, Answer::BadRequest, "no training of 1 environments"),
    (|m| (m.n_envs, m.begins, m.version) = (1, 1, 9), Answer::BadRequest, "no version was pushed"),
    (|m| (m.n_envs, m.begins) = (257, 1), Answer::LimitExceeded, "257 environments"),
    (|m| (m.n_envs, m.n_steps) = (u64::MAX, u64::MAX), Answer::LimitExceeded, "18446744073709551615 steps"),
    // Their product is 0 where it wraps.
    (|m| (m.n_envs, m.n_steps) = (1 << 63, 2), Answer::LimitExceeded, "18446744073709551615 steps"),
];

fn refusal(client: &mut RolloutClient, bytes: &[u8]) -> (Answer, String) {
    match client.request_bytes(bytes).expect("sent").next(PATIENCE) {
        Err(RequestError::Refused { answer, text }) => (answer, text),
        other => panic!("not refused: {other:?}"),
    }
}

/// The place of a client, without its manners: any length beside any bytes.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
struct Envelope {
    length: u64,
    bytes: [u8; MAX_REQUEST],
}

// SAFETY: plain numbers of fixed size; the name is that of what the server reads.
unsafe impl ZeroCopySend for Envelope {
    unsafe fn type_name() -> &'static str {
        "nearl.rollout-envelope.v1"
    }
}

/// Sends envelopes with these lengths, each with a good request in it, and returns what is answered.
fn lies(name: &RobotName, lengths: &[u64]) -> Vec<(Answer, String)> {
    // SAFETY: plain call.
    let folder =
        Path::new("/dev/shm").join(format!("nearl-{}", unsafe { libc::geteuid() })).join(name.as_str());
    let token = std::fs::read_to_string(folder.join("token")).expect("token");
    let mut config = Config::default();
    let root = iceoryx2::prelude::Path::new(folder.to_str().expect("UTF-8").as_bytes()).expect("folder");
    config.global.set_root_path(&root);
    config.global.prefix = FileName::new(format!("nearl.{name}.{token}.").as_bytes()).expect("prefix");
    let node = NodeBuilder::new().config(&config).create::<ipc_threadsafe::Service>().expect("node");
    let topic = ServiceName::new(&format!("nearl/{name}/rollout")).expect("name");
    let service = node.service_builder(&topic).request_response::<Envelope, [f64]>();
    let service = service.response_user_header::<ReplyMessage>().open().expect("the server's service");
    let client = service.client_builder().create().expect("client");
    let mut envelope = Envelope { length: 0, bytes: [0; MAX_REQUEST] };
    let good = bytes_of(&message(&Request::new(1, 3)));
    envelope.bytes[..good.len()].copy_from_slice(&good);
    let mut answers = Vec::new();
    for length in lengths {
        envelope.length = *length;
        let pending = client.send_copy(envelope).expect("sent");
        answers.push(until("an answer to a lie", || {
            let reply = pending.receive().expect("reply")?;
            let header = *reply.user_header();
            Some((header.answer().expect("a known answer"), header.text()))
        }));
    }
    answers
}

#[test]
fn hostile_requests_are_refused_by_name_while_others_are_served() {
    let server = Server::start_with("hostile", &[]);
    let mut sent = 0;
    beside(&server, |_| {
        let mut client = server.client();
        for (spoil, answer, words) in SPOILT {
            let mut bad = message(&Request::new(1, 3));
            spoil(&mut bad);
            let (given, text) = refusal(&mut client, &bytes_of(&bad));
            assert!(given == *answer && text.contains(words), "'{words}' is not in {given}: {text}");
            sent += 1;
        }
        let good = bytes_of(&message(&Request::new(1, 3)));
        let longer = [&good[..], &[0; 8]].concat();
        for bytes in (1..good.len()).step_by(7).map(|n| &good[..n]).chain([&longer[..], &[7; MAX_REQUEST]]) {
            let (given, text) = refusal(&mut client, bytes);
            let words = format!("this one {}", bytes.len());
            assert!(
                given == Answer::BadRequest && text.contains(&words),
                "'{words}' is not in {given}: {text}"
            );
            sent += 1;
        }
        let lengths = [0, 1, good.len() as u64 - 1, MAX_REQUEST as u64 + 1, 1 << 63, u64::MAX];
        for (length, (given, text)) in lengths.iter().zip(lies(&server.0, &lengths)) {
            assert!(
                given == Answer::BadRequest && text.contains("a request has"),
                "{length}: {given}: {text}"
            );
            sent += 1;
        }
        let honest = lies(&server.0, &[good.len() as u64]);
        assert_eq!(honest[0].0, Answer::Accepted, "without the lie: {}", honest[0].1);
        // Odd, but allowed: random streams go on from the last to the first.
        let last = Training { stream: u64::MAX, ..GOOD };
        let asked = Request { training: Some(last), ..Request::new(u64::MAX, 4) };
        let mut parts = client.request(&asked).expect("request");
        while parts.next_part(PATIENCE).expect("part").is_some() {}
        assert!(parts.steps() > 0);
    });
    server.alone();
    let report = server.end();
    let refused = report["malformed"].as_u64().zip(report["limit"].as_u64()).map(|(a, b)| a + b);
    assert_eq!((refused, &report["failed"]), (Some(sent), &0.into()), "{report}");
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

/// A trainer that pushes anything.
struct Pusher(TrainerLink, u64);

impl Pusher {
    fn push(&mut self, bytes: &[u8]) -> ReceiptMessage {
        self.1 += 1;
        self.0.push(self.1, bytes).expect("push");
        self.0.wait_for_receipt(self.1, PATIENCE).expect("receipt")
    }
}

/// All a training of `version` collects from its begin, by environment: they come as they are done.
fn collected(
    client: &mut RolloutClient,
    training: Training,
    version: u64,
) -> Result<Vec<(usize, Vec<u64>)>, RequestError> {
    let asked = Request { training: Some(training), version: Some(version), ..Request::new(3, 20) };
    let mut parts = client.request(&asked)?;
    let mut all = Vec::new();
    while let Some(part) = parts.next_part(PATIENCE)? {
        all.extend(part);
    }
    let (mut rest, mut found) = (&all[..], Vec::new());
    while let [env, length, more @ ..] = rest {
        let (numbers, next) = more.split_at(*length as usize);
        found.push((*env as usize, bits(numbers)));
        rest = next;
    }
    found.sort();
    Ok(found)
}

type Change = fn(&mut Snapshot);

/// Snapshots with a right digest: what is done to a good one, the verdict, and words of it.
const HOSTILE: &[(Change, Verdict, &str)] = &[
    (|s| s.networks.policy.layers[0].weight[3] = f32::NAN, Verdict::NotFinite, "index 3"),
    (|s| s.networks.policy.layers[1].bias[0] = f32::INFINITY, Verdict::NotFinite, "index 0"),
    (|s| s.networks.policy.layers[0].weight[1] = 1e30, Verdict::NotFinite, "index 1"),
    (|s| s.networks.policy_log_std[0] = 1e30, Verdict::NotFinite, "log_std"),
    (|s| s.networks.normaliser.std[0] = 0.0, Verdict::NotFinite, "normaliser.std"),
    (
        |s| s.manifest.robot.bodies.iter_mut().for_each(|b| b.mass *= 1.5),
        Verdict::ForeignRobot,
        "the robot file",
    ),
    (|s| s.manifest.task.constraints.velocity = None, Verdict::ForeignRobot, "[constraints]"),
    (|s| s.manifest.task.time.dt *= 2.0, Verdict::ForeignRobot, "[time]"),
    (|s| s.manifest.action_upper[0] = 1e9, Verdict::ForeignRobot, "the range of its actuators"),
];

#[test]
fn hostile_snapshots_are_refused_by_name_and_the_last_good_one_stays_in_use() {
    let server = Server::start_with("pushed", &[]);
    let good = snapshot();
    let mut pusher = Pusher(TrainerLink::open(&server.0).expect("link"), 0);
    let mut client = server.client();
    let receipt = pusher.push(&good.to_bytes());
    assert_eq!(receipt.verdict(), Verdict::Accepted, "{}", receipt.text());
    let right = collected(&mut client, GOOD, 1).expect("a training");
    beside(&server, |_| {
        let bytes = good.to_bytes();
        let flipped: Vec<u8> = bytes.iter().enumerate().map(|(i, b)| b ^ u8::from(i == 9000)).collect();
        let deep = |open: &str, close: &str| {
            let deep = format!("{}1{}", open.repeat(200_000), close.repeat(200_000));
            let train = "\"train\":{";
            resigned(&bytes, |m| {
                assert!(m.contains(train));
                *m = m.replacen(train, &format!("{train}\"deep\":{deep},"), 1);
            })
        };
        // The same chain of bodies again and again: as deep as it is long.
        let mut chain = good.clone();
        let bodies = chain.manifest.robot.bodies.clone();
        (0..20_000 / bodies.len()).for_each(|_| chain.manifest.robot.bodies.extend(bodies.clone()));
        let mut refuse = |bytes: &[u8], verdict: Verdict, words: &str| {
            let receipt = pusher.push(bytes);
            let (given, text) = (receipt.verdict(), receipt.text());
            assert!(given == verdict && text.contains(words), "'{words}' is not in {given}: {text}");
            assert!(collected(&mut client, GOOD, 1).expect("the last good one") == right, "after {words}");
        };
        refuse(&flipped, Verdict::Corrupt, "digest mismatch");
        refuse(&bytes[..bytes.len() / 2], Verdict::Corrupt, "cut short");
        refuse(b"{", Verdict::Corrupt, "cut short");
        refuse(&deep("[", "]"), Verdict::Corrupt, "recursion limit");
        refuse(&deep("{\"a\":", "}"), Verdict::Corrupt, "recursion limit");
        refuse(&chain.to_bytes(), Verdict::Corrupt, "more than the 500");
        for (change, verdict, words) in HOSTILE {
            let mut bad = good.clone();
            change(&mut bad);
            refuse(&bad.to_bytes(), *verdict, words);
        }
        // Whole and of the task, but not what the training began with.
        let mut direct = good.clone();
        direct.manifest.policy = PolicyKind::Direct;
        let n_act = direct.manifest.action_lower.len();
        let last = direct.networks.policy.layers.last_mut().expect("layers");
        *last = DenseLayer {
            n_out: n_act,
            weight: last.weight[..n_act * last.n_in].to_vec(),
            bias: last.bias[..n_act].to_vec(),
            ..*last
        };
        direct.networks.policy_log_std = vec![0.0; n_act];
        direct.networks.idm = None;
        let receipt = pusher.push(&direct.to_bytes());
        assert_eq!(receipt.verdict(), Verdict::Accepted, "{}", receipt.text());
        let version = receipt.version;
        let error =
            collected(&mut client, Training { begins: false, ..GOOD }, version).unwrap_err().to_string();
        assert!(error.contains("bad-request") && error.contains("other networks"), "{error}");
        collected(&mut client, GOOD, version).expect("one that begins with it");
    });
    let report = server.end();
    assert_eq!((&report["failed"], &report["malformed"]), (&0.into(), &1.into()), "{report}");
}

/// A snapshot whose policy has a layer of `width` x `width`, which takes a while to look at.
fn wide(good: &Snapshot, width: usize) -> Snapshot {
    let mut wide = good.clone();
    let layers = &mut wide.networks.policy.layers;
    let (n_in, n_out) = (layers[0].n_in, layers.last().expect("layers").n_out);
    let layer = |n_in: usize, n_out: usize| DenseLayer {
        n_in,
        n_out,
        weight: vec![1e-4; n_in * n_out],
        bias: vec![0.0; n_out],
    };
    *layers = vec![layer(n_in, width), layer(width, width), layer(width, n_out)];
    wide
}

#[test]
fn while_a_large_snapshot_is_validated_everybody_is_served_but_those_who_wait_for_it() {
    let server = Server::start_with("large", &[]);
    let right = expected(&snapshot(), 5);
    let large = wide(&snapshot(), 3000).to_bytes();
    let mut link = TrainerLink::open(&server.0).expect("link");
    let (mut client, mut learner) = (server.client(), server.client());
    link.push(1, &large).expect("push");
    // Nobody answered the push yet: this waits for it, and is not told that nothing was pushed.
    let asked = Request { training: Some(GOOD), version: Some(1), ..Request::new(3, 2) };
    let mut parts = learner.request(&asked).expect("request");
    let mut served = 0;
    let receipt = until("the receipt", || {
        let mut rollouts = client.request(&Request::new(5, 1)).expect("request");
        let step = bits(&rollouts.next(PATIENCE).expect("a chunk").expect("a step").numbers);
        assert!(step == right[..step.len()], "other bits beside a validation");
        served += 1;
        link.receipt()
    });
    println!("{served} steps served while {} bytes were validated", large.len());
    assert_eq!(receipt.verdict(), Verdict::Accepted, "{}", receipt.text());
    while parts.next_part(PATIENCE).expect("a part of a training by what was pushed").is_some() {}
    assert!(parts.steps() > 0);
    // One waits for the end of the validation if all do, and a few may be over before it begins.
    assert!(served > 10, "{served} steps served");
    drop((client, learner, link));
    assert_eq!(server.end()["failed"], 0);
}

#[test]
fn trainings_keep_no_more_than_the_server_allows_all_of_them() {
    let server = Server::start_with("room", &["--max-envs", "8", "--max-steps", "4000"]);
    let before = resident(server.process().id());
    let mut clients: Vec<RolloutClient> = (0..6).map(|_| server.client()).collect();
    let ask = |client: &mut RolloutClient, n_envs, n_steps| {
        let training = Training { n_envs, ..GOOD };
        let mut parts = client.request(&Request { training: Some(training), ..Request::new(1, n_steps) })?;
        while parts.next_part(PATIENCE)?.is_some() {}
        Ok(())
    };
    let busy = |result: Result<(), RequestError>, words: &str| match result {
        Err(RequestError::Refused { answer: Answer::Busy, text }) => assert!(text.contains(words), "{text}"),
        other => panic!("{other:?} and not: {words}"),
    };
    let (first, others) = clients.split_first_mut().expect("clients");
    ask(first, 6, 100).expect("within the limits");
    ask(first, 8, 100).expect("the client's own environments are given up");
    for other in others.iter_mut() {
        busy(ask(other, 1, 1), "keep 9 environments and 801 steps, 8 and 4000 at most");
    }
    ask(first, 1, 4000).expect("as many steps as are kept");
    busy(ask(&mut others[0], 1, 1), "keep 2 environments and 4001 steps");
    drop(clients.remove(0));
    until("the environments of a client that left are free", || ask(&mut clients[0], 8, 500).ok());
    let after = resident(server.process().id());
    assert!(after < before + 40_000, "{before} kB before, {after} kB after");
    drop(clients);
    server.alone();
    server.end();
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

fn start(role: &str, server: &Server) -> Process {
    let mut command = Command::new(std::env::current_exe().expect("path of the test program"));
    command.args(["--exact", "serve_attack::client", "--ignored", "--nocapture"]);
    Process::start(command.env(ROLE, role).env(NAME, server.0.as_str()))
}

fn said(process: Process) -> String {
    let output = process.output();
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    let line = out.lines().find_map(|l| l.split_once("said "));
    line.unwrap_or_else(|| panic!("{}: {out}{err}", output.status)).1.to_owned()
}

#[test]
fn stopped_clients_lose_their_places_and_are_told_so() {
    let server = Server::start_with("stopped", &["--patience", "2", "--requests", "6"]);
    let stages = ["opened", "asked", "reading", "cancelled", "learning"];
    let stopped = stages.map(|stage| start(stage, &server));
    for (stage, process) in stages.iter().zip(&stopped) {
        let stat = format!("/proc/{}/stat", process.id());
        until(&format!("stopped once {stage}"), || {
            let text = std::fs::read_to_string(&stat).expect("stat of a child");
            text.rsplit(')').next().is_some_and(|rest| rest.trim_start().starts_with('T')).then_some(())
        });
    }
    beside(&server, |_| {
        // All places, with those that the stopped ones had.
        let mut clients: Vec<RolloutClient> = (0..5).map(|_| server.client()).collect();
        let mut taken: Vec<Rollouts> = Vec::new();
        for client in &mut clients {
            let rollouts = until("a place of a stopped client", || {
                // Those that have a place keep it by reading.
                taken.iter_mut().for_each(|other| drop(other.next(PATIENCE).expect("chunk")));
                let mut rollouts = client.request(&Request::new(1, ENDLESS)).expect("request");
                rollouts.next(PATIENCE).ok().map(|_| rollouts)
            });
            taken.push(rollouts);
        }
        drop(taken);
    });
    stopped.iter().for_each(|process| process.signal(libc::SIGCONT));
    for (stage, process) in stages.iter().zip(stopped) {
        if *stage == "opened" {
            // It never had a request; now it has one that nobody ends.
            process.kill();
            continue;
        }
        let said = said(process);
        let words = if *stage == "cancelled" { "the end" } else { "gave this request up" };
        assert!(said.contains(words), "{stage}: {said}");
    }
    server.alone();
    assert_eq!(server.end()["failed"], 0);
}

/// System calls that change what clients and server share.
const CALLS: [&str; 8] =
    ["openat", "mkdir", "ftruncate", "fallocate", "mmap", "write", "fchmod", "unlink,unlinkat"];

/// A client that is killed at the `when`-th call of a kind; true if it got to its end before that.
fn client_killed_at(server: &Server, call: &str, when: usize) -> bool {
    let mut command = Command::new("strace");
    command.args(["-f", "-qq", "-o", "/dev/null", "-e", &format!("trace={call}")]);
    command.args(["-e", &format!("inject={call}:signal=SIGKILL:when={when}")]);
    command.arg(std::env::current_exe().expect("path of the test program"));
    command.args(["--exact", "serve_attack::client", "--ignored"]);
    command.env(ROLE, "whole").env(NAME, server.0.as_str());
    command.stdout(Stdio::null()).stderr(Stdio::null()).status().expect("strace").success()
}

/// Every `NEARL_KILL_STRIDE`-th point (17 by default, 1 for all of them).
#[test]
fn a_client_killed_at_any_system_call_harms_no_other() {
    let traced = Command::new("strace").args(["-qq", "true"]).stderr(Stdio::null()).status();
    if !traced.is_ok_and(|status| status.success()) {
        return skip("clients killed at system calls: strace is missing, or may not trace here");
    }
    let stride = std::env::var("NEARL_KILL_STRIDE").map_or(17, |s| s.parse().expect("NEARL_KILL_STRIDE"));
    let server = Server::start_with("points", &[]);
    let mut points = 0;
    beside(&server, |_| {
        for call in CALLS {
            let mut when = 1 + call.len() % stride;
            while !client_killed_at(&server, call, when) {
                (points, when) = (points + 1, when + stride);
            }
        }
    });
    println!("{points} points");
    assert!(points > 8, "{points}");
    server.alone();
    // Every place for a client is free again.
    let clients: Vec<RolloutClient> = (0..24).map(|_| server.client()).collect();
    drop(clients);
    let report = server.end();
    assert_eq!((&report["failed"], &report["malformed"]), (&0.into(), &0.into()), "{report}");
}

#[test]
fn a_flood_of_requests_and_snapshots_keeps_nobody_from_being_served() {
    let server = Server::start_with("flood", &["--requests", "16"]);
    let bytes = snapshot().to_bytes();
    let mut early = 0;
    beside(&server, |is_served| {
        early = resident(server.process().id());
        let (sent, end) = (AtomicU64::new(0), std::time::Instant::now() + Duration::from_secs(3));
        let goes_on = || std::time::Instant::now() < end || !is_served();
        std::thread::scope(|scope| {
            let (goes_on, sent, server, bytes) = (&goes_on, &sent, &server, &bytes);
            for flooder in 0..8 {
                scope.spawn(move || {
                    let mut client = server.client();
                    while goes_on() {
                        // Asked and left at once: the places are free again, the work of looking at them is not.
                        let asked = match flooder % 2 {
                            0 => client.request_bytes(b"no request"),
                            _ => client.request(&Request::new(1, 0)),
                        };
                        drop(asked.expect("sent"));
                        sent.fetch_add(1, Ordering::Relaxed);
                    }
                });
            }
            scope.spawn(move || {
                let mut link = TrainerLink::open(&server.0).expect("link");
                for version in 1.. {
                    if !goes_on() {
                        break;
                    }
                    link.push(version, bytes).expect("push");
                }
            });
        });
        println!("{} requests dropped at once", sent.into_inner());
    });
    server.alone();
    let late = resident(server.process().id());
    assert!(late < early + 20_000, "{early} kB before the flood, {late} kB after");
    assert_eq!(server.end()["failed"], 0);
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

#[test]
fn another_user_can_neither_ask_nor_harm_the_server() {
    // SAFETY: plain call.
    if unsafe { libc::geteuid() } != 0 {
        return skip("the rollout server and another user: only root can become one");
    }
    let server = Server::start_with("two-users", &[]);
    // What the other user's own links would make, so that it can be taken away again.
    let own = Path::new("/dev/shm/nearl-65534");
    let had = own.exists();
    beside(&server, |_| {
        let mut command = Command::new(std::env::current_exe().expect("path of the test program"));
        command.args(["--exact", "serve_attack::client", "--ignored", "--nocapture"]);
        command.env(ROLE, "stranger").env(NAME, server.0.as_str());
        let stranger =
            Process::start(command.env("NEARL_TEST_ATTACK_PID", server.process().id().to_string()));
        let said = said(stranger);
        assert!(said.contains("no rollout server named"), "{said}");
    });
    let decoy = Path::new("/dev/shm").join(format!("nearl.{}.0000000000000000.decoy", server.0));
    // Whoever cleared up may have taken it away.
    let _ = std::fs::remove_file(decoy);
    if !had {
        let _ = std::fs::remove_dir_all(own);
    }
    server.alone();
    assert_eq!(server.end()["failed"], 0);
}
