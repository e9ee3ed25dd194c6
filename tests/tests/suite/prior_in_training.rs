//! Constraints while collecting: the switch, the penalty for what the projection moved, and the ledger as metrics.

use nearl_tests::{request, training};
use nearl_trainer::train::{COLUMNS, Progress, Training};

const SHORT: [&str; 3] = ["train.n_envs=4", "train.n_steps=64", "train.ppo.batch_size=64"];
/// Tight enough that a fresh policy is moved in most ticks.
const TIGHT: &str = "constraints.velocity.limit=2.0";

fn first(algo: &str, set: &[&str]) -> (Training, Progress) {
    let mut t = training("HalfCheetah-v5", algo, 0, 1, &[&SHORT, set].concat());
    let progress = t.iterate();
    (t, progress)
}

fn cell(t: &Training, p: &Progress, column: &str) -> f64 {
    t.row(p)[COLUMNS.iter().position(|c| *c == column).expect(column)]
}

#[test]
fn the_ledger_is_in_the_metrics() {
    let (t, p) = first("pid2-ib", &[TIGHT]);
    let of = |column| cell(&t, &p, column);
    assert!(of("constraints/raw_violations") > 0.3, "{}", of("constraints/raw_violations"));
    let tally = &p.tally;
    assert_eq!(of("constraints/avoided"), tally.avoided as f64 / tally.raw_violations as f64);
    assert!(of("constraints/avoided") > 0.3 && of("constraints/avoided") <= 1.0);
    assert!(of("constraints/distance") > 0.0);
    assert!(of("constraints/active_rows") >= of("constraints/moved"), "what is moved is held by a row");
    let (t, p) = first("ppo", &[TIGHT]);
    for column in COLUMNS.iter().filter(|c| c.starts_with("constraints/") || **c == "idm/residual") {
        let measured = *column == "constraints/reached_violations";
        assert_eq!(
            cell(&t, &p, column).is_finite(),
            measured,
            "{column}: nothing is proposed, nothing is projected"
        );
    }
}

/// Under `guard = "drive"` the metrics say how often a policy asked a drive for too much.
#[test]
fn what_drives_are_asked_for_is_in_the_metrics() {
    let leg = concat!(env!("CARGO_MANIFEST_DIR"), "/fixtures/leg.toml");
    let mut t = training(leg, "ppo", 0, 1, &["constraints.torque_rate.limit=20.0"]);
    let p = t.iterate();
    let of = |column| cell(&t, &p, column);
    assert!(of("constraints/raw_violations") > 0.1, "{}", of("constraints/raw_violations"));
    assert_eq!((of("constraints/target_violations"), of("constraints/avoided")), (0.0, 1.0));
    assert!(of("idm/residual").is_nan(), "no state is proposed");
}

#[test]
fn without_projection_in_training_nothing_is_moved_nor_avoided() {
    let (t, p) = first("pid2-ib", &[TIGHT, "train.project_in_training=false"]);
    assert!(p.tally.raw_violations > 0 && p.tally.target_violations > 0);
    assert_eq!((p.tally.avoided, p.tally.moved, p.tally.active_rows), (0, 0, 0));
    // the controller that loads the snapshot projects all the same
    let (_, projected) = first("pid2-ib", &[TIGHT]);
    assert_eq!(projected.tally.target_violations, 0);
    let report = nearl_trainer::evaluate::evaluate(t.snapshot(), 1, 0, true).expect("episodes");
    assert_eq!(report.target_violations, 0);
}

/// Rewards of a segment with penalty c are those without it, less c times what was moved.
#[test]
fn the_penalty_is_the_distance_moved() {
    let collect = |penalty: &str| {
        let (mut t, p) = first("pid2-ib", &[TIGHT, penalty]);
        let rewards: Vec<f64> = t.segments().flat_map(|s| s.reward.clone()).collect();
        (rewards, p)
    };
    let (free, p) = collect("train.moved_penalty=0.0");
    let (penalised, q) = collect("train.moved_penalty=0.25");
    let paid: f64 = free.iter().zip(&penalised).map(|(f, p)| f - p).sum();
    assert!((paid - 0.25 * p.tally.distance).abs() < 1e-9 * paid, "{paid} {}", p.tally.distance);
    assert!(free.iter().zip(&penalised).all(|(f, p)| f >= p));
    assert_eq!(p.tally, q.tally, "the first batch and its returns are the same");
    let negative = Training::new(&request("HalfCheetah-v5", "pid2-ib", 0, 1, &["train.moved_penalty=-1.0"]));
    let error = negative.map(|_| ()).expect_err("refused").to_string();
    assert!(error.contains("[train.moved_penalty]: -1"), "{error}");
}

/// Limits on actions hold for a policy on actions and for a learned inverse model, while collecting and in evaluation; where each action is within
/// them is found from the formula and the velocities that Gymnasium's observation has.
#[test]
fn limits_on_actions_hold_while_collecting() {
    let tight = "constraints.action.power=2.0";
    for algo in ["ppo", "pid2-ib"] {
        let (t, p) = first(algo, &[tight, "train.ppo.log_std=0.5"]);
        let of = |column| cell(&t, &p, column);
        assert!(of("constraints/raw_violations") > 0.3, "{algo}: {}", of("constraints/raw_violations"));
        assert_eq!(of("constraints/target_violations"), 0.0, "{algo}");
        assert!(of("constraints/distance") > 0.1, "{algo}");
        let mut t = training("HalfCheetah-v5", algo, 0, 1, &[&SHORT[..], &[tight]].concat());
        t.iterate();
        let mut held = 0;
        for s in t.segments() {
            // the first batch: observations are not normalised yet
            for (x, a) in s.x.chunks_exact(17).zip(s.action.chunks_exact(6)) {
                let power: f32 = x[11..].iter().zip(a).map(|(w, a)| (w * a).abs()).sum();
                assert!(power <= 2.0 + 1e-4, "{algo}: {power}");
                held += u32::from(power > 2.0 - 1e-4);
            }
        }
        assert!(held > 10, "{algo}: {held} on the limit");
        let mut tighter = t.snapshot().clone();
        tighter.manifest.task.constraints.action = toml::from_str("square = 1e-6").expect("settings");
        let report = nearl_trainer::evaluate::evaluate(&tighter, 1, 0, true).expect("episodes");
        assert!(report.raw_violations > 0 && report.target_violations == 0, "{algo}: {report:?}");
    }
}

/// Where another stage has the last word on the action, limits on actions are refused by name.
#[test]
fn limits_on_actions_are_refused_where_the_action_is_decided_already() {
    for (task, algo, set, words) in [
        ("Panda-reach", "pid2-ib", "constraints.action.square=1.0", "pinocchio"),
        ("Panda-reach", "ppo", "constraints.guard=true", "guard"),
    ] {
        let set = [set, "constraints.action.square=1.0"];
        let asked = request(task, algo, 0, 1, &set);
        let refused = Training::new(&asked).map(|_| ()).expect_err(task).to_string();
        assert!(refused.contains("[constraints.action]") && refused.contains(words), "{refused}");
    }
}
