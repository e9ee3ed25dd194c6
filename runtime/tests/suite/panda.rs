//! The real controller in the loop: a Panda with random weights, over real links, against forward dynamics.

use crate::toy;
use std::path::Path;
use std::time::Duration;

use crate::arm::*;
use crate::toy::Name;
use nearl_constraints::ConstraintSettings;
use nearl_runtime::link::*;
use nearl_runtime::rt::*;
use nearl_runtime::{Manifest, PolicyKind};

#[test]
fn random_weights_swapped_in_motion_break_no_limit_and_the_stop_ends_at_rest() {
    let name = Name::new("panda");
    let first = snapshot(1, |_| {});
    let file = File::new("panda", &first);
    let plant = start(&name, &first);
    let stop = Stop::new();
    let running = execute(&name, &file.0, &stop);
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    trainer.wait_for_runtime(Duration::from_secs(20)).unwrap();
    for version in 2..=6 {
        trainer.push(version, &snapshot(version, |_| {}).to_bytes()).unwrap();
        let receipt = trainer.wait_for_receipt(version, Duration::from_secs(20)).unwrap();
        assert_eq!(receipt.verdict(), Verdict::Accepted, "{}", receipt.text());
        // Each policy gets the same time to set the arm in motion, however fast the swaps are.
        while trainer.state().is_none_or(|s| s.tick < receipt.tick + 600) {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
    stop.request();
    let report = running.join().unwrap().unwrap();
    let (plant, counted) = plant.end();
    println!("{report}");
    assert_eq!(report.counters.swaps, 5);
    assert_eq!(report.versions.iter().map(|v| v.1).collect::<Vec<_>>(), [1, 2, 3, 4, 5, 6]);
    assert!(report.counters.raw_violations > 1000, "the raw policy must break limits: {:?}", report.counters);
    assert_eq!(report.counters.target_violations, 0);
    assert_eq!(counted.late, 0);
    assert!(
        plant.worst.iter().all(|excess| *excess <= 1e-9),
        "position, velocity, torque: {:?}",
        plant.worst
    );
    let fastest = plant.speeds.iter().copied().fold(0.0, f64::max);
    assert!(fastest > 0.5, "the arm must move for this to mean anything: {fastest} rad/s");
    assert!(*plant.speeds.last().unwrap() < 1e-2, "it stops by its own torques");
}

/// A policy of torques under its guard: the same promise in the loop, over hot swaps, with a brake of its own at the end.
#[test]
fn random_torques_are_guarded_in_the_loop() {
    let name = Name::new("panda-guarded");
    let guarded = |version| {
        let mut snapshot = snapshot(version, |m| {
            m.policy = PolicyKind::Direct;
            m.task.constraints.guard = nearl_constraints::Guard::Model;
        });
        let policy = &mut snapshot.networks.policy;
        let last = policy.layers.last_mut().unwrap();
        (last.n_out, last.weight) = (N, weights(version + 3, 16 * N).iter().map(|w| 40.0 * w).collect());
        last.bias = weights(version + 4, N);
        snapshot.networks.policy_log_std = vec![0.0; N];
        snapshot
    };
    let file = File::new("panda-guarded", &guarded(1));
    let plant = start(&name, &guarded(1));
    let stop = Stop::new();
    let running = execute(&name, &file.0, &stop);
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    trainer.wait_for_runtime(Duration::from_secs(20)).unwrap();
    for version in 2..=4 {
        trainer.push(version, &guarded(version).to_bytes()).unwrap();
        let receipt = trainer.wait_for_receipt(version, Duration::from_secs(20)).unwrap();
        assert_eq!(receipt.verdict(), Verdict::Accepted, "{}", receipt.text());
        while trainer.state().is_none_or(|s| s.tick < receipt.tick + 600) {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
    stop.request();
    let report = running.join().unwrap().unwrap();
    let (plant, counted) = plant.end();
    assert_eq!((report.counters.swaps, report.counters.target_violations, counted.late), (3, 0, 0));
    assert!(report.counters.raw_violations > 1000, "{:?}", report.counters);
    assert!(
        plant.worst.iter().all(|excess| *excess <= 1e-9),
        "position, velocity, torque: {:?}",
        plant.worst
    );
    assert!(plant.speeds.iter().copied().fold(0.0, f64::max) > 0.5, "the arm must move");
    assert!(*plant.speeds.last().unwrap() < 1e-2, "it stops by its own torques");
}

/// What a UR or KUKA controller is sent: positions, which are those of the projected state.
#[test]
fn position_commands_lead_within_the_limits_and_are_refused_by_a_robot_that_takes_torques() {
    let name = Name::new("panda-positions");
    let positions = |version| {
        snapshot(version, |m| {
            m.task.command = toml::from_str("interface = \"position\"").unwrap();
            m.action_lower.fill(-10.0); // beyond every joint's range: what is sent is bounded by the limits
            m.action_upper.fill(10.0);
        })
    };
    let first = positions(1);
    let file = File::new("panda-positions", &first);
    let plant = start_panda(&name, &first, Panda { follows_positions: true, ..Panda::new() });
    let stop = Stop::new();
    let running = execute(&name, &file.0, &stop);
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    trainer.wait_for_runtime(Duration::from_secs(20)).unwrap();
    while trainer.state().is_none_or(|s| s.tick < 3000) {
        std::thread::sleep(Duration::from_millis(1));
    }
    let torques = snapshot(2, |m| (m.action_lower, m.action_upper) = (vec![-10.0; N], vec![10.0; N]));
    trainer.push(2, &torques.to_bytes()).unwrap();
    let receipt = trainer.wait_for_receipt(2, Duration::from_secs(20)).unwrap();
    assert_ne!(receipt.verdict(), Verdict::Accepted, "{}", receipt.text());
    stop.request();
    let report = running.join().unwrap().unwrap();
    let (plant, counted) = plant.end();
    assert!(report.counters.raw_violations > 500, "the raw policy must break limits: {:?}", report.counters);
    assert_eq!((report.counters.target_violations, counted.late), (0, 0));
    assert!(plant.worst[..2].iter().all(|excess| *excess <= 1e-9), "position, velocity: {:?}", plant.worst);
    assert!(plant.accelerated <= 10.0 + 1e-5, "acceleration: {} rad/s^2", plant.accelerated);
    let fastest = plant.speeds.iter().copied().fold(0.0, f64::max);
    assert!(fastest > 0.5, "the arm must move for this to mean anything: {fastest} rad/s");
    assert!(*plant.speeds.last().unwrap() < 1e-2, "it stops by the positions it is sent");
}

/// A robot that is switched on outside its limits: which joint, by how much, and what became of the ticks.
#[test]
fn a_joint_found_outside_its_limits_is_named_in_the_report() {
    let name = Name::new("panda-outside");
    let first = snapshot(1, |_| {});
    let file = File::new("panda-outside", &first);
    let mut panda = Panda { pause: Duration::from_micros(300), ..Panda::new() };
    panda.q[0] = panda.upper[0] + 0.05;
    let at = panda.q[0];
    // The margin of the task is part of the limit that is kept.
    let limit = panda.upper[0] - 0.01;
    let plant = start_panda(&name, &first, panda);
    let settings = RunSettings { ticks: Some(600), ..toy::settings() };
    let report = execute_with(&name, &file.0, &Stop::new(), settings).join().unwrap().unwrap();
    plant.end();
    let [found] = &report.outside[..] else { panic!("{report}") };
    let near = |a: f64, b: f64| (a - b).abs() < 1e-12;
    assert!(found.joint == "panda_joint1" && found.what == "highest position", "{found}");
    assert!(near(found.value, at) && near(found.limit, limit) && found.unit == "rad", "{found} {at} {limit}");
    assert!(found.tick < 20, "{found}");
    let recovering = report.statuses["recovering"];
    assert!(recovering > 100 && recovering >= report.counters.recovering, "{report}");
    let text = report.to_string();
    assert!(text.contains(&format!("found outside    joint 'panda_joint1' at {at} rad")), "{text}");
    assert!(text.contains(&format!("recovering {recovering}")), "{text}");
}

/// A robot that is switched on with its hand above a ceiling that no joint's range knows of: the limit is named.
#[test]
fn a_limit_of_several_joints_that_was_left_is_named_in_the_report() {
    let name = Name::new("panda-above");
    let ceiling = "frame = [{ name = \"ceiling\", frame = \"panda_hand\", braking = 1.0, \
                   half_space = { normal = [0, 0, 1], through = [0, 0, 0.3] } }]";
    let first = snapshot(1, |m| {
        m.task.constraints.frame = toml::from_str::<ConstraintSettings>(ceiling).unwrap().frame
    });
    let file = File::new("panda-above", &first);
    let plant = start_panda(&name, &first, Panda { pause: Duration::from_micros(300), ..Panda::new() });
    let settings = RunSettings { ticks: Some(200), ..toy::settings() };
    let report = execute_with(&name, &file.0, &Stop::new(), settings).join().unwrap().unwrap();
    plant.end();
    let [found] = &report.outside[..] else { panic!("{report}") };
    assert!(found.joint.is_empty() && found.row == "limit 'ceiling' of kind frame", "{found}");
    let text = report.to_string();
    assert!(text.contains("found outside    limit 'ceiling' of kind frame (no joint is beyond"), "{text}");
}

#[test]
fn foreign_and_damaged_snapshots_are_refused_by_reason_while_the_loop_runs() {
    let name = Name::new("panda-foreign");
    let first = snapshot(1, |_| {});
    let file = File::new("panda-foreign", &first);
    let plant = start(&name, &first);
    let stop = Stop::new();
    let running = execute(&name, &file.0, &stop);
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    trainer.wait_for_runtime(Duration::from_secs(20)).unwrap();

    let mut flipped = snapshot(2, |_| {}).to_bytes();
    *flipped.last_mut().unwrap() ^= 1;
    let good = snapshot(3, |_| {}).to_bytes();
    let renamed = |m: &mut Manifest| {
        let robot = serde_json::to_string(&m.robot).unwrap().replace("panda_joint3", "elbow");
        m.robot = serde_json::from_str(&robot).unwrap();
        m.task.state.observation.iter_mut().for_each(|n| *n = n.replace("panda_joint3", "elbow"));
        m.task.state.propose.iter_mut().flatten().for_each(|n| *n = n.replace("panda_joint3", "elbow"));
    };
    let slower = |m: &mut Manifest| (m.task.time.dt, m.task.time.sim_dt) = (0.002, 0.002);
    let swapped = |m: &mut Manifest| m.task.state.observation.swap(0, 1);
    let mut diverged = snapshot(8, |_| {});
    diverged.networks.policy.layers[0].bias[0] = f32::NAN;
    let cases = [
        (2, flipped, Verdict::Corrupt, "digest"),
        (3, good[..good.len() / 2].to_vec(), Verdict::Corrupt, "cut short"),
        (4, snapshot(4, renamed).to_bytes(), Verdict::ForeignRobot, "`elbow`"),
        (5, snapshot(5, slower).to_bytes(), Verdict::ForeignPeriod, "0.002 s"),
        (6, snapshot(6, swapped).to_bytes(), Verdict::ForeignShape, "order"),
        (8, diverged.to_bytes(), Verdict::NotFinite, "NaN"),
    ];
    for (version, bytes, verdict, word) in cases {
        trainer.push(version, &bytes).unwrap();
        let receipt = trainer.wait_for_receipt(version, Duration::from_secs(20)).unwrap();
        assert_eq!(receipt.verdict(), verdict, "{}", receipt.text());
        assert!(receipt.text().contains(word), "{}", receipt.text());
    }
    stop.request();
    let report = running.join().unwrap().unwrap();
    let (plant, _) = plant.end();
    assert_eq!((report.counters.swaps, report.refused_snapshots), (0, 6));
    assert_eq!((report.counters.stale, report.modes["fault"], report.modes["degraded"]), (0, 0, 0));
    assert!(plant.worst.iter().all(|e| *e <= 1e-9), "position, velocity, torque: {:?}", plant.worst);
}

#[test]
fn a_wrong_start_is_one_sentence() {
    let name = Name::new("panda-start");
    let other =
        File::new("panda-start", &snapshot(1, |m| (m.task.time.dt, m.task.time.sim_dt) = (0.002, 0.002)));
    let plant = start(&name, &snapshot(1, |_| {}));
    let error = |file: &Path, settings: RunSettings| {
        run(&settings, file, &name.0, &Stop::new()).map(|_| ()).unwrap_err().to_string()
    };
    let text = error(&other.0, toy::settings());
    assert!(text.contains("0.002 s") && text.contains("0.001 s"), "{text}");
    let text = error(Path::new("/nowhere.safetensors"), toy::settings());
    assert!(text.contains("/nowhere.safetensors"), "{text}");
    let good = File::new("panda-start-good", &snapshot(1, |_| {}));
    let text = error(&good.0, RunSettings { rate: Some(500.0), ..toy::settings() });
    assert!(text.contains("500") && text.contains("1000"), "{text}");
    plant.end();
}
