//! Snapshots that are no policies, too large, or too many.

use nearl_runtime::link::{ReceiptMessage, TrainerLink, Verdict};
use nearl_runtime::net::DenseLayer;
use nearl_runtime::{PolicyKind, Snapshot};
use nearl_trainer::rollout_protocol::*;

use super::{GOOD, PATIENCE, beside, bits, expected, resigned, snapshot};
use crate::common::*;
use crate::serve_clients::Server;

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
