//! Requests that nobody sane sends.

use std::path::Path;

use iceoryx2::prelude::*;
use nearl_runtime::link::{Header, Message, RobotName};
use nearl_trainer::rollout_protocol::*;

use super::{ENDLESS, GOOD, PATIENCE, beside};
use crate::common::*;
use crate::serve_clients::Server;

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
