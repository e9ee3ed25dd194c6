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
