//! Learning from a running loop: what the task says of states that came over a link, and plant, loop and trainer as processes.

use std::path::Path;

use crate::common::*;
use nearl_runtime::link::{HealthMessage, RobotName, TrainerLink, remove_files};
use nearl_trainer::env::{Env, Moment};
use nearl_trainer::rollout::stream;
use nearl_trainer::tasks;
use rand::RngExt;
use serde_json::Value;

/// State and observation of an environment, as a plant sends them.
#[derive(Clone)]
struct Sent {
    q: Vec<f64>,
    v: Vec<f64>,
    obs: Vec<f64>,
    time: f64,
}

impl Sent {
    fn by(env: &dyn Env) -> Sent {
        let spec = env.spec();
        let mut sent = Sent {
            q: vec![0.0; spec.nq],
            v: vec![0.0; spec.nv],
            obs: vec![0.0; spec.n_obs()],
            time: env.sim().time(),
        };
        env.state(&mut sent.q, &mut sent.v);
        env.observe(&mut sent.obs);
        sent
    }

    fn moment(&self) -> Moment<'_> {
        Moment { q: &self.q, v: &self.v, obs: &self.obs, time: self.time }
    }
}

/// The reward computed from two states is the one the simulator gave on the way. Ant's contact forces are not part of a state:
/// its reward is not asked for here, its termination is, and that its free joint comes back whole.
#[test]
fn what_happened_elsewhere_is_scored_as_if_it_had_happened_here() {
    let cart_pole = repository().join("examples/tasks/cart-pole.toml");
    let cart_pole = cart_pole.to_str().expect("UTF-8");
    for task in ["HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Panda-reach", cart_pole, "Ant-v5"] {
        let mut env = tasks::env(task).expect(task);
        let mut scoring = env.another().expect(task);
        let mut rng = stream(3, 1);
        let (mut ended, mut total) = (0, 0.0);
        for _ in 0..3 {
            env.reset(&mut rng).expect(task);
            for _ in 0..200 {
                let action: Vec<f64> =
                    env.spec().actuators.iter().map(|a| rng.random_range(a.low..a.high)).collect();
                let before = Sent::by(&*env);
                let step = env.step(&action);
                let after = Sent::by(&*env);
                let scored = scoring.score(&before.moment(), &after.moment(), &action).expect(task);
                assert_eq!(scored.terminated, step.terminated, "{task}");
                if task == "Ant-v5" {
                    let worst =
                        scoring.qpos().iter().zip(env.qpos()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                    let fastest =
                        scoring.qvel().iter().zip(env.qvel()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                    assert!(worst < 1e-12 && fastest < 1e-9, "{task}: {worst} {fastest}");
                } else {
                    assert!((scored.reward - step.reward).abs() < 1e-9, "{task}: {scored:?} {step:?}");
                }
                total += step.reward.abs();
                if step.terminated {
                    ended += 1;
                    break;
                }
            }
        }
        assert!(total > 0.1, "{task} rewards nothing");
        assert!(
            ended > 0 || ["HalfCheetah-v5", "Panda-reach", "Ant-v5"].contains(&task),
            "{task} never ended"
        );
    }
}

/// A robot name of its own, and nothing left of it at the end.
struct Name(RobotName);

impl Drop for Name {
    fn drop(&mut self) {
        remove_files(&self.0);
    }
}

/// 128 policy steps an iteration, of 20 ticks each but for one that an episode ends.
const SMALL: [&str; 3] = ["train.n_envs=2", "train.n_steps=64", "train.ppo.batch_size=32"];

fn trainer(name: &Name, out: &Path, more: &[&str]) -> Process {
    let out = out.to_str().expect("UTF-8");
    let mut arguments =
        vec!["train", "Panda-reach", "--from", name.0.as_str(), "--json", "--out", out, "--threads", "1"];
    SMALL.iter().for_each(|s| arguments.extend(["--set", s]));
    arguments.extend(more);
    Process::nearl(&arguments)
}

fn health(link: &mut TrainerLink, what: &str, is_so: impl Fn(&HealthMessage) -> bool) -> HealthMessage {
    until(what, || link.health().filter(&is_so))
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("not a number: {value}"))
}

#[test]
fn a_trainer_learns_from_a_running_loop_which_outlives_it() {
    let name = Name(RobotName::new(&format!("online-{}", std::process::id())).expect("name"));
    let folder = tempfile::tempdir().expect("folder");
    let panda = panda();
    let panda = panda.to_str().expect("UTF-8");
    let plant = Process::nearl(&["plant", "Panda-reach", "--name", name.0.as_str(), "--lockstep", "--json"]);
    let run = ["run", panda, "--plant", name.0.as_str(), "--explore", "7", "--json"];
    let runtime = Process::nearl(&run);
    let mut link = TrainerLink::open(&name.0).expect("link");
    let first = health(&mut link, "the loop runs", |_| true).policy_version;

    // Killed while it learns: the loop goes on.
    let killed = trainer(&name, &folder.path().join("killed"), &[]);
    health(&mut link, "two versions of the trainer", |h| h.policy_version >= first + 2);
    killed.kill();
    let before = health(&mut link, "health", |_| true);
    health(&mut link, "the loop goes on", |h| h.tick > before.tick + 500);

    // The next one runs to its end.
    let output = trainer(&name, &folder.path().join("run"), &["--steps", "512"]).output();
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{err}");
    let lines: Vec<Value> = out.lines().map(|l| serde_json::from_str(l).expect("JSON")).collect();
    let progress: Vec<&Value> = lines.iter().filter(|l| l["metrics"].is_object()).collect();
    assert_eq!(
        progress.iter().map(|p| number(&p["steps"])).collect::<Vec<_>>(),
        [128.0, 256.0, 384.0, 512.0],
        "{out}"
    );
    for p in &progress {
        assert!(number(&p["ticks"]) > 2000.0 && p["target_violations"] == 0, "{p}");
        assert!(number(&p["raw_violations"]) > 0.0, "exploration never left the limits: {p}");
    }
    for p in &progress[1..] {
        let metrics = p["metrics"].as_object().expect("metrics");
        for loss in ["train/value_loss", "train/policy_gradient_loss", "train/approx_kl", "online/version"] {
            assert!(metrics[loss].as_f64().is_some_and(f64::is_finite), "{loss}: {p}");
        }
    }
    // What the robot reached is measured, and the arm of the simulation misses its targets by rounding.
    let rows = std::fs::read_to_string(folder.path().join("run/metrics.csv")).expect("metrics");
    let column =
        rows.lines().next().and_then(|l| l.split(',').position(|c| c == "idm/residual")).expect("column");
    for row in rows.lines().skip(1) {
        let residual: f64 = row.split(',').nth(column).and_then(|c| c.parse().ok()).expect("a residual");
        assert!(residual > 0.0 && residual < 1e-6, "{row}");
    }
    let last = progress.last().expect("progress");
    let versions: Vec<f64> = progress.iter().map(|p| number(&p["metrics"]["online/version"])).collect();
    assert!(versions.windows(2).all(|w| w[0] < w[1]), "{versions:?}");
    // The loop had versions of the killed trainer, and its own first one: they are no rows.
    let left_out = number(&last["metrics"]["online/foreign"]) + number(&last["metrics"]["online/stale"]);
    assert!(left_out > 0.0, "{last}");

    let run = runtime.end();
    assert_eq!(
        (&run["counters"]["target_violations"], &run["modes"]["fault"]),
        (&0.into(), &0.into()),
        "{run}"
    );
    assert!(number(&run["counters"]["swaps"]) >= 6.0, "{run}");
    let plant = plant.end();
    for kind in ["position", "velocity", "torque"] {
        assert_eq!(plant["violations"][kind], 0, "{kind}: {plant}");
    }
}

/// Seed and tick give the noise, and the seed is in the log: every tick comes out again, bit for bit. In lockstep a run longer than
/// this may outrun its log.
#[test]
fn exploration_is_in_the_log() {
    let folder = tempfile::tempdir().expect("folder");
    let (panda, log) = (panda(), folder.path().join("flight.mcap"));
    let (panda, log) = (panda.to_str().expect("UTF-8"), log.to_str().expect("UTF-8"));
    let explore = |seed: &[&str]| {
        let name = Name(RobotName::new(&format!("explore-{}", std::process::id())).expect("name"));
        let plant =
            Process::nearl(&["plant", "Panda-reach", "--name", name.0.as_str(), "--lockstep", "--json"]);
        let run = ["run", panda, "--plant", name.0.as_str(), "--seconds", "0.4", "--log", log, "--json"];
        let run = Process::nearl(&[&run, seed].concat()).json();
        assert_eq!(
            (&run["log_drops"], &run["counters"]["target_violations"]),
            (&0.into(), &0.into()),
            "{run}"
        );
        assert_eq!(plant.end()["violations"]["velocity"], 0);
        let replay = Process::nearl(&["replay", log, "--json"]).json();
        assert!(replay["difference"].is_null() && number(&replay["ticks"]) >= 400.0, "{replay}");
        number(&run["plant"]["episode_return"])
    };
    let numbers = [&["--explore", "7"][..], &["--explore", "8"], &[]].map(explore);
    assert!(numbers[0] != numbers[1] && numbers[0] != numbers[2], "the noise does nothing: {numbers:?}");
}

#[test]
fn a_loop_without_noise_and_a_foreign_task_are_refused_in_a_sentence() {
    let name = Name(RobotName::new(&format!("quiet-{}", std::process::id())).expect("name"));
    let folder = tempfile::tempdir().expect("folder");
    let panda = panda();
    let _plant = Process::nearl(&["plant", "Panda-reach", "--name", name.0.as_str(), "--lockstep", "--json"]);
    let _runtime =
        Process::nearl(&["run", panda.to_str().expect("UTF-8"), "--plant", name.0.as_str(), "--json"]);
    let mut link = TrainerLink::open(&name.0).expect("link");
    health(&mut link, "the loop runs", |_| true);
    let refused = |process: Process, words: &[&str]| {
        let output = process.output();
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success() && words.iter().all(|w| text.contains(w)), "{text}");
    };
    refused(trainer(&name, &folder.path().join("quiet"), &[]), &["acts without noise", "--explore SEED"]);
    let out = folder.path().join("foreign");
    let foreign =
        ["train", "HalfCheetah-v5", "--from", name.0.as_str(), "--out", out.to_str().expect("UTF-8")];
    refused(Process::nearl(&foreign), &["foreign-robot", "panda_joint1"]);
}
