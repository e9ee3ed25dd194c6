//! An operator moves the limits of a running loop: they hold from the tick of the receipt on, weights that come later keep them, what
//! cannot be is refused by name, and the log replays bit for bit.

use std::time::Duration;

use nearl_constraints::{Moved, PerJoint};
use nearl_runtime::Snapshot;
use nearl_runtime::controller::Controller;
use nearl_runtime::link::*;
use nearl_runtime::log::replay;
use nearl_runtime::rt::*;

use crate::arm::*;
use crate::toy::{self, Name};

/// Transitions of about so many ticks from now on.
fn ticks(trainer: &mut TrainerLink, count: usize) -> Vec<TransitionMessage> {
    while trainer.transition().is_some() {}
    let mut all = Vec::new();
    let end = std::time::Instant::now() + 12 * PATIENCE;
    while all.len() < count {
        assert!(std::time::Instant::now() < end, "{} of {count} transitions", all.len());
        match trainer.transition() {
            Some(transition) => all.push(transition),
            None => std::thread::sleep(Duration::from_millis(1)),
        }
    }
    all
}

/// Largest share of its limit that the speed of any target has.
fn fastest(all: &[TransitionMessage], limits: &[f64]) -> f64 {
    let share =
        |t: &TransitionMessage| t.target_v().iter().zip(limits).map(|(v, l)| v.abs() / l).fold(0.0, f64::max);
    all.iter().map(share).fold(0.0, f64::max)
}

#[test]
fn an_operator_moves_the_limits_of_a_running_loop() {
    let (name, folder) = (Name::new("limits"), Scratch::new("limits"));
    let first: Snapshot = stochastic(1);
    let limits = Controller::new(&first).unwrap().limits().velocity.clone();
    let (file, log) = (folder.0.join("first.safetensors"), folder.0.join("run.mcap"));
    first.save(&file).unwrap();
    let plant = start_with(&name, &first, FaultPlan::default(), Duration::from_micros(300));
    let stop = Stop::new();
    let settings = RunSettings { log: Some(log.clone()), ..toy::settings() };
    let running = execute_with(&name, &file, &stop, settings);
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    trainer.wait_for_runtime(PATIENCE).unwrap();
    let mut operator = OperatorLink::open(&name.0, PATIENCE).unwrap();
    let taken = OperatorLink::open(&name.0, PATIENCE).err().unwrap();
    assert!(matches!(taken, LinkError::Taken { role: "operator", .. }), "{taken}");

    let free = ticks(&mut trainer, 600);
    let most = fastest(&free, &limits);
    assert!(most > 0.05, "{most}: the policy hardly moves");
    let share = 0.5 * most;
    let receipt = operator.move_limits(&Moved::speed(share), PATIENCE).unwrap();
    assert_eq!((receipt.verdict(), receipt.text().as_str()), (Verdict::Accepted, "in force"));
    // From the tick of the swap the fastest joint needs (1 - share) V / 10 rad/s² at the most.
    let slowest = limits.iter().fold(0.0, |most: f64, v| most.max(*v)) * (most - share) / 10.0 / toy::DT;
    let _ = ticks(&mut trainer, slowest as usize + 100);
    let slow = ticks(&mut trainer, 600);
    assert!(fastest(&slow, &limits) <= share * (1.0 + 1e-9), "{} of {share}", fastest(&slow, &limits));
    assert!(
        fastest(&slow, &limits) > 0.8 * share,
        "{} of {share}: the policy hardly moves",
        fastest(&slow, &limits)
    );

    // Weights that come later keep what the operator said.
    trainer.push(2, &stochastic(2).to_bytes()).unwrap();
    assert_eq!(trainer.wait_for_receipt(2, PATIENCE).unwrap().verdict(), Verdict::Accepted);
    let pushed = ticks(&mut trainer, 600);
    assert_eq!(pushed.last().unwrap().policy_version, 2);
    assert!(fastest(&pushed, &limits) <= share * (1.0 + 1e-9), "{} of {share}", fastest(&pushed, &limits));

    // What cannot be is refused by name; the loop goes on as it was.
    let one = |value| Some(PerJoint::Joints([("panda_joint2".to_string(), value)].into()));
    for (moved, says) in [
        (
            Moved { velocity: one(99.0), ..Moved::default() },
            "velocity 99 rad/s or m/s of joint 'panda_joint2'",
        ),
        (Moved { upper: one(99.0), ..Moved::default() }, "upper 99 rad or m of joint 'panda_joint2'"),
        (Moved { speed: 0.0, ..Moved::default() }, "speed"),
        (Moved { speed: f64::NAN, ..Moved::default() }, "cannot be read"), // JSON has no such number
        (Moved { energy: Some(1.0), ..Moved::default() }, "energy"),
    ] {
        let receipt = operator.move_limits(&moved, PATIENCE).unwrap();
        assert_ne!(receipt.verdict(), Verdict::Accepted);
        assert!(receipt.text().contains(says), "{says}: {}", receipt.text());
    }
    let after = ticks(&mut trainer, 300);
    assert!(fastest(&after, &limits) <= share * (1.0 + 1e-9));

    // They outlive who asked for them, and go when somebody says so.
    drop(operator);
    assert!(fastest(&ticks(&mut trainer, 300), &limits) <= share * (1.0 + 1e-9));
    let mut operator = OperatorLink::open(&name.0, PATIENCE).unwrap();
    assert_eq!(operator.move_limits(&Moved::default(), PATIENCE).unwrap().verdict(), Verdict::Accepted);
    trainer.push(3, &first_again(3).to_bytes()).unwrap();
    assert_eq!(trainer.wait_for_receipt(3, PATIENCE).unwrap().verdict(), Verdict::Accepted);
    let loose = ticks(&mut trainer, 600);
    assert!(fastest(&loose, &limits) > share * 1.01, "{} of {share}", fastest(&loose, &limits));
    stop.request();
    let report = running.join().unwrap().unwrap();
    let (panda, _) = plant.end();
    assert!(panda.worst.iter().all(|worst| *worst <= 1e-9), "{:?}", panda.worst);
    assert_eq!((report.log_drops, report.log_error.as_deref()), (0, None));
    assert_eq!((report.counters.swaps, report.counters.target_violations), (4, 0), "{report}");
    let found = replay(&log).unwrap();
    assert_eq!((found.difference, found.ticks, found.swaps, found.complete), (None, report.ticks, 4, true));
}

/// The weights of the first snapshot under a new version.
fn first_again(version: u64) -> Snapshot {
    let mut snapshot = stochastic(1);
    snapshot.manifest.version = version;
    snapshot
}
