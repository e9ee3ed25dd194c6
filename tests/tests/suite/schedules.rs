//! What changes over a run: rates, limits that come in, statistics, evaluations and kept snapshots on the way.

use nearl_runtime::Snapshot;
use nearl_runtime::link::RobotName;
use nearl_tests::{request, training};
use nearl_trainer::train::{COLUMNS, Experience, Progress, Request, Training, train};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

const SHORT: [&str; 4] =
    ["train.n_envs=4", "train.n_steps=64", "train.ppo.batch_size=64", "train.ppo.n_epochs=2"];

fn cell(t: &Training, p: &Progress, column: &str) -> f64 {
    t.row(p)[COLUMNS.iter().position(|c| *c == column).expect(column)]
}

/// Numbers of `column` in each of `n` iterations of a run of `n` iterations.
fn course(task: &str, algo: &str, n: u64, set: &[&str], column: &str) -> Vec<f64> {
    let asked = Request { steps: 256 * n, ..request(task, algo, 0, 1, &[&SHORT, set].concat()) };
    let mut t = Training::new(&asked).expect("training");
    (0..n)
        .map(|_| {
            let p = t.iterate();
            cell(&t, &p, column)
        })
        .collect()
}

#[test]
fn rates_fall_to_what_is_asked_for() {
    let rates = |set: &[&str]| course("HalfCheetah-v5", "ppo", 5, set, "train/learning_rate")[1..].to_vec();
    let near = |got: Vec<f64>, want: [f64; 4]| {
        assert!(got.iter().zip(want).all(|(g, w)| (g / 3e-4 - w).abs() < 1e-5), "{got:?} {want:?}");
    };
    near(rates(&[]), [0.8, 0.6, 0.4, 0.2]);
    near(rates(&["train.anneal_to=0.5"]), [0.9, 0.8, 0.7, 0.6]);
    near(rates(&["train.anneal=false"]), [1.0; 4]);
}

/// From 0.25 to half of it in four iterations, of which the first only collects: the first update clips at 7/8 of it, the second at 6/8.
#[test]
fn the_clip_range_falls_to_what_is_asked_for() {
    let weights = |set: &[&str], iterations: usize| {
        let asked =
            Request { steps: 4 * 256, ..request("HalfCheetah-v5", "ppo", 0, 1, &[&SHORT, set].concat()) };
        let mut t = Training::new(&asked).expect("training");
        (0..iterations).for_each(|_| drop(t.iterate()));
        let p = t.snapshot().networks.policy.clone();
        p.layers.iter().flat_map(|l| l.weight.iter().map(|w| w.to_bits())).collect::<Vec<_>>()
    };
    let large = "train.ppo.lr=0.01"; // so that ratios leave the range
    let falling = [large, "train.ppo.clip_range=0.25", "train.ppo.clip_to=0.5"];
    let held = |range| [large, range, "train.ppo.clip_to=1.0"];
    assert!(weights(&falling, 2) == weights(&held("train.ppo.clip_range=0.21875"), 2), "7/8 of 0.25");
    assert!(weights(&falling, 2) != weights(&held("train.ppo.clip_range=0.25"), 2), "the range matters");
    assert!(weights(&falling, 3) != weights(&held("train.ppo.clip_range=0.21875"), 3), "it falls further");
}

/// Ticks are moved by the projection in as many environments as project.
#[test]
fn limits_come_in_environment_by_environment() {
    let tight = "constraints.velocity.limit=2.0";
    let moved = course("HalfCheetah-v5", "pid2-ib", 5, &[tight, "train.limits_in=0.8"], "constraints/moved");
    let all = course("HalfCheetah-v5", "pid2-ib", 5, &[tight], "constraints/moved");
    assert_eq!(moved[0], 0.0, "none at first");
    assert!(moved[1] > 0.0 && moved[1] < 0.5 * all[1], "one of four: {} beside {}", moved[1], all[1]);
    assert!(moved[4] > 0.8 * all[4], "all at the end: {} beside {}", moved[4], all[4]);
}

/// Limits come in environment by environment: where the environments are another process's, the setting is refused by name.
#[test]
fn limits_that_come_in_are_refused_where_environments_are_elsewhere() {
    let name = || RobotName::new("nobody").expect("name");
    let stop = || Arc::new(AtomicBool::new(false));
    let elsewhere = [Experience::Loop(name(), stop()), Experience::Served(name(), stop())];
    for (experience, way) in elsewhere.iter().zip(["--from", "--collect"]) {
        let asked = request("HalfCheetah-v5", "pid2-ib", 0, 1, &["train.limits_in=0.3"]);
        let refused = Training::on(&asked, experience).map(|_| ()).expect_err("refused").to_string();
        assert!(refused.contains("[train.limits_in]: 0.3") && refused.contains(way), "{refused}");
    }
    let asked = request("HalfCheetah-v5", "pid2-ib", 0, 1, &["train.project_in_training=false"]);
    let refused = Training::on(&asked, &elsewhere[0]).map(|_| ()).expect_err("refused").to_string();
    assert!(refused.contains("[train.project_in_training]"), "{refused}");
}

/// A joint with position and velocity that belong together: the pair is refused, and where the gradient passes straight through,
/// PPO's ratio is 1 before the first step.
#[test]
fn with_coupled_entries_the_first_ratio_is_one() {
    let kinematic = "constraints.consistency=kinematic";
    let pair = request("HalfCheetah-v5", "pid2-ib", 0, 1, &[&SHORT, [kinematic].as_slice()].concat());
    let refused = Training::new(&pair).map(|_| ()).expect_err("refused").to_string();
    assert!(refused.contains("consistency = \"free\"") && refused.contains("straight-through"), "{refused}");
    // one pass over one minibatch: the divergence that is reported is that before the step
    let whole = ["train.ppo.batch_size=256", "train.ppo.n_epochs=1", "train.pid2.gradient=straight-through"];
    for set in [&[kinematic][..], &["constraints.velocity.limit=2.0"]] {
        let set = [&whole[..], set, &["train.pid2.idm_threshold=1e9"]].concat();
        let kl = course("HalfCheetah-v5", "pid2-ib", 3, &set, "train/approx_kl");
        assert!(kl[1..].iter().all(|kl| kl.abs() < 1e-6), "{set:?}: {kl:?}");
    }
}

/// The first observation of an episode counts: four environments of 64 steps without an end see 4 x 65.
#[test]
fn observations_after_a_reset_are_in_the_statistics() {
    let mut t = training("HalfCheetah-v5", "ppo", 0, 1, &SHORT);
    t.iterate();
    let stats = t.checkpoint().expect("checkpoint").take_f64("stats.obs", None).expect("statistics");
    assert_eq!(stats.last(), Some(&260.0));
    t.iterate();
    let stats = t.checkpoint().expect("checkpoint").take_f64("stats.obs", None).expect("statistics");
    assert_eq!(stats.last(), Some(&516.0), "the second stretch begins where the first ended");
}

#[test]
fn without_normaliser_networks_see_what_was_observed() {
    let mut t =
        training("HalfCheetah-v5", "ppo", 0, 1, &[&SHORT[..], &["train.normalise_obs=false"]].concat());
    t.iterate();
    let n = &t.snapshot().networks.normaliser;
    assert!(n.mean.iter().all(|m| *m == 0.0) && n.std.iter().all(|s| *s == 1.0));
}

#[test]
fn the_best_networks_and_every_nth_are_kept() {
    let folder = tempfile::tempdir().expect("folder");
    let out = folder.path().join("run");
    let set =
        [&SHORT[..], &["train.eval_every=512", "train.eval_episodes=2", "train.save_every=1000"]].concat();
    let asked = Request { steps: 256 * 8, ..request("Hopper-v5", "pid2-ib", 0, 2, &set) };
    let mut evaluated = Vec::new();
    train(&asked, &out, |p, _| {
        evaluated.push((p.steps, p.metrics.iter().find(|(n, _)| *n == "eval/ep_rew_mean").map(|m| m.1)));
        true
    })
    .expect("training");
    let found: Vec<(u64, f64)> = evaluated.iter().filter_map(|(s, e)| Some((*s, (*e)?))).collect();
    assert_eq!(found.iter().map(|f| f.0).collect::<Vec<_>>(), [512, 1024, 1536, 2048]);
    let best = found.iter().fold((0, f64::NEG_INFINITY), |a, b| if b.1 > a.1 { *b } else { a });
    let of = |name: &str| {
        let file = out.join("checkpoints").join(format!("{name}.safetensors"));
        Snapshot::load(&file).unwrap_or_else(|e| panic!("{name}: {e}"))
    };
    assert_eq!(of("best").manifest.steps, best.0, "{found:?}");
    assert_eq!((of("step_1024").manifest.steps, of("step_2048").manifest.steps), (1024, 2048));
    assert_eq!(of("final").manifest.steps, 2048);
}

/// PPO on the paper's two networks: nothing but the policy gradient teaches the inverse model.
#[test]
fn ppo_on_the_combined_policy_has_no_supervised_loss() {
    let set = [&SHORT[..], &["train.nearl.idm_threshold=0.0"]].concat();
    let mut t = training("HalfCheetah-v5", "ppo-combined", 0, 1, &set);
    t.iterate();
    let p = t.iterate();
    assert_eq!(cell(&t, &p, "idm/updated"), 0.0);
    assert!(cell(&t, &p, "train/policy_mse").is_nan());
    assert!(cell(&t, &p, "idm/r2_after").is_finite() && cell(&t, &p, "train/clamped_fraction").is_finite());
}
