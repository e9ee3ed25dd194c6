//! A trainer that collects in a rollout server: the bits of a training in its own process, whoever else is served.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::channel;
use std::thread::JoinHandle;
use std::time::Duration;

use nearl_runtime::Snapshot;
use nearl_runtime::link::{RobotName, TrainerLink, Verdict, remove_files};
use nearl_runtime::rt::Stop;
use nearl_tests::request;
use nearl_trainer::rollout_protocol::*;
use nearl_trainer::serve::{Report, Settings, serve};
use nearl_trainer::train::{Experience, Training as Run};

const PATIENCE: Duration = Duration::from_secs(60);
const SMALL: [&str; 3] = ["train.n_envs=3", "train.n_steps=64", "train.ppo.batch_size=96"];

/// A server in a thread of this process, and nothing left of it at the end.
struct Serving {
    name: RobotName,
    stop: Stop,
    thread: Option<JoinHandle<Report>>,
}

impl Serving {
    fn start(what: &str, snapshot: Snapshot) -> Serving {
        let name = RobotName::new(&format!("{what}-{}", std::process::id())).expect("name");
        let (stop, (ready, wait)) = (Stop::new(), channel());
        let settings = Settings { threads: 2, requests: 8, max_steps: 2000, max_envs: 8, patience: PATIENCE };
        let thread = std::thread::spawn({
            let (name, stop) = (name.clone(), stop.clone());
            move || {
                let begin = || ready.send(()).expect("a test that waits");
                serve(&snapshot, &name, &settings, &stop, begin).expect("a server")
            }
        });
        wait.recv().expect("the server begins");
        Serving { name, stop, thread: Some(thread) }
    }

    fn experience(&self) -> Experience {
        Experience::Served(self.name.clone(), Arc::new(AtomicBool::new(false)))
    }

    fn client(&self) -> RolloutClient {
        RolloutClient::open(&self.name, PATIENCE).expect("a server")
    }

    fn end(mut self) -> Report {
        self.stop.request();
        let thread = self.thread.take().expect("once");
        let report = thread.join().expect("the server ends");
        remove_files(&self.name);
        report
    }
}

/// Weights and what was counted, iteration by iteration.
fn trace(run: &mut Run, iterations: usize) -> Vec<(Vec<u8>, String)> {
    (0..iterations)
        .map(|_| {
            let p = run.try_iterate().expect("experience").expect("no stop");
            (
                run.snapshot().to_bytes(),
                format!("{:?} {:?} {:?}", p.tally, p.return_mean.to_bits(), p.cost_mean.to_bits()),
            )
        })
        .collect()
}

#[test]
fn a_served_training_has_the_bits_of_one_in_this_process_whoever_else_is_served() {
    // A learned model and a cost; a direct policy; analytic dynamics and a stochastic proposal, in episodes that are cut.
    let tasks = [
        (
            "HalfCheetah-velocity",
            "pid2-ib",
            vec!["train.moved_penalty=0.01", "train.cost.limit=5.0", "train.cost.multiplier=0.5"],
        ),
        ("Hopper-v5", "ppo", vec!["train.project_in_training=false"]),
        ("Panda-reach", "nearl", vec![]),
    ];
    for (task, algo, more) in tasks {
        let set = [&SMALL[..], &more].concat();
        let asked = request(task, algo, 5, 2, &set);
        let mut here = Run::new(&asked).expect("training");
        let server = Serving::start("collect", here.snapshot().clone());
        let mut served = Run::on(&asked, &server.experience()).expect("served training");
        let over = Arc::new(AtomicBool::new(false));
        let mut other = server.client();
        let crowd = std::thread::spawn({
            let over = Arc::clone(&over);
            move || {
                let mut rows = 0;
                for seed in 0.. {
                    if over.load(Ordering::Relaxed) {
                        break;
                    }
                    let mut rollouts = other.request(&Request::new(seed, 500)).expect("request");
                    while rollouts.next(PATIENCE).expect("chunk").is_some() {}
                    rows += rollouts.steps();
                }
                rows
            }
        });
        let (here, served) = (trace(&mut here, 6), trace(&mut served, 6));
        over.store(true, Ordering::Relaxed);
        assert!(crowd.join().expect("the other client") >= 500);
        for (i, (here, served)) in here.iter().zip(&served).enumerate() {
            assert_eq!(here.1, served.1, "{task}: counts of iteration {i}");
            assert!(here.0 == served.0, "{task}: weights of iteration {i}");
        }
        let report = server.end();
        assert_eq!((report.failed, report.malformed, report.closed), (0, 0, 0), "{task}: {report:?}");
    }
}

#[test]
fn what_cannot_be_collected_is_refused_by_name() {
    let asked = request("Hopper-v5", "ppo", 0, 1, &SMALL);
    let server = Serving::start("collect-refused", Run::new(&asked).expect("training").snapshot().clone());
    let error = |task: &str, set: &[&str]| {
        let asked = request(task, "ppo", 0, 1, &[&SMALL[..], set].concat());
        let mut run = Run::on(&asked, &server.experience()).expect("a server");
        run.try_iterate().expect_err("a refusal").to_string()
    };
    let text = error("Hopper-v5", &["constraints.velocity.limit=3.0"]);
    assert!(text.contains("task 'Hopper-v5' in [constraints]") && text.contains("foreign-robot"), "{text}");
    assert!(error("Walker2d-v5", &[]).contains("differs from the server's task 'Hopper-v5'"));
    assert!(error("Hopper-v5", &["train.n_envs=9"]).contains("9 environments are more than the 8"));
    assert!(error("Hopper-v5", &["train.n_steps=1024"]).contains("3072 steps are more than the 2000"));
    // What is pushed must be whole.
    let mut link = TrainerLink::open(&server.name).expect("link");
    let mut bytes = Run::new(&asked).expect("training").snapshot().to_bytes();
    let last = bytes.len() - 1;
    bytes[last] ^= 1;
    link.push(1, &bytes).expect("push");
    let receipt = link.wait_for_receipt(1, PATIENCE).expect("receipt");
    assert_eq!(receipt.verdict(), Verdict::Corrupt, "{}", receipt.text());
    let training = Training { n_envs: 2, begins: true, stream: 0, gamma: 0.9, moved_penalty: 0.0 };
    let mut client = server.client();
    let mut refused = |training, version| {
        let asked = Request { training: Some(training), version, ..Request::new(0, 10) };
        match client.request(&asked).expect("request").next_part(PATIENCE) {
            Err(RequestError::Refused { answer: Answer::BadRequest, text }) => text,
            other => panic!("not refused: {other:?}"),
        }
    };
    assert!(refused(Training { begins: false, ..training }, None).contains("no training of 2 environments"));
    assert!(refused(training, Some(77)).contains("not 77"));
    // A rollout does not get what was pushed for a training, and neither kind passes for the other.
    let mut rollouts =
        client.request(&Request { training: Some(training), ..Request::new(0, 10) }).expect("request");
    assert!(rollouts.next(PATIENCE).unwrap_err().to_string().contains("part of a training"));
    drop(rollouts);
    let mut rollouts = client.request(&Request::new(0, 10)).expect("request");
    assert!(rollouts.next_part(PATIENCE).unwrap_err().to_string().contains("a chunk instead"));
    drop(rollouts);
    assert_eq!(server.end().failed, 0);
}

#[test]
fn a_busy_server_is_asked_again() {
    let asked = request("Hopper-v5", "ppo", 0, 1, &SMALL);
    let server = Serving::start("collect-busy", Run::new(&asked).expect("training").snapshot().clone());
    let mut run = Run::on(&asked, &server.experience()).expect("a server");
    let mut clients: Vec<RolloutClient> = (0..8).map(|_| server.client()).collect();
    let taken: Vec<Rollouts> = clients
        .iter_mut()
        .map(|client| {
            let mut rollouts = client.request(&Request::new(1, 2000)).expect("request");
            rollouts.next(PATIENCE).expect("chunk").expect("chunk");
            rollouts
        })
        .collect();
    let over = std::thread::spawn(move || {
        std::thread::sleep(Duration::from_millis(200));
        drop(taken);
    });
    trace(&mut run, 2);
    over.join().expect("the places are free again");
    assert!(server.end().busy >= 1);
}

#[test]
fn a_server_that_ends_keeps_what_was_learned() {
    let asked = request("Hopper-v5", "ppo", 0, 1, &SMALL);
    let server = Serving::start("collect-ends", Run::new(&asked).expect("training").snapshot().clone());
    let mut run = Run::on(&asked, &server.experience()).expect("a server");
    trace(&mut run, 2);
    let before = run.snapshot().to_bytes();
    server.end();
    let error = run.try_iterate().expect_err("no server").to_string();
    assert!(
        error.contains("no rollout server") || error.contains("ended") || error.contains("server"),
        "{error}"
    );
    assert!(run.snapshot().to_bytes() == before);
}

#[test]
fn a_training_is_stopped_in_the_middle_and_begins_anew() {
    let asked = request("Hopper-v5", "ppo", 3, 1, &SMALL);
    let server = Serving::start("collect-stop", Run::new(&asked).expect("training").snapshot().clone());
    let stop = Arc::new(AtomicBool::new(false));
    let experience = Experience::Served(server.name.clone(), Arc::clone(&stop));
    let mut run = Run::on(&asked, &experience).expect("a server");
    let first = trace(&mut run, 1);
    stop.store(true, Ordering::Relaxed);
    assert!(run.try_iterate().expect("no error").is_none(), "a stop ends the collection");
    drop(run);
    stop.store(false, Ordering::Relaxed);
    let mut again = Run::on(&asked, &experience).expect("a server");
    assert!(trace(&mut again, 1) == first);
    server.end();
}
