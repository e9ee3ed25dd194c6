//! Where states and answers are lost.

use nearl_verify::verify;
use serde_json::Value;

use super::{LIMITS, attack, copy, record, ticks};
use crate::attack::Attack;

/// Positions go on from what was sent, though the robot is measured 20 ms behind, every seventh state is lost, and every fifth and the next answer
/// come too late, in whose periods the driver holds: by differences of what the robot is sent, no acceleration is above its limit.
#[test]
fn set_points_of_a_robot_that_lags_keep_their_limits_over_states_and_answers_that_are_lost() {
    let positions = format!("{LIMITS}\n[command]\ninterface = \"position\"");
    for (lost, late) in [(0, 0), (7, 0), (0, 5), (7, 5)] {
        let flight = Attack { lost, late, lag: 0.02, ..attack(&positions, 0.004, 1, 20) };
        let (_folder, log) = record("verify-sent", &flight);
        let report = verify(&log).unwrap();
        println!("{lost}, {late}: {report}");
        assert_eq!((report.found, report.is_whole()), (0, true), "{report}");
        let (mut q, mut v, mut most, mut fastest) = (flight.start.clone(), vec![0.0; 7], 0.0f64, 0.0f64);
        for pair in ticks(&log).windows(2) {
            let between = |what: &str| {
                pair[1]["state"][what].as_u64().unwrap() - pair[0]["state"][what].as_u64().unwrap()
            };
            // the answer, unless the next state says that one more than those to lost states came too late; else the driver goes on slower
            let (periods, is_heard) = (between("seq"), between("late") < between("seq"));
            for period in 0..periods {
                for i in 0..7 {
                    let to = pair[0]["action"][i].as_f64().unwrap();
                    let speed = match period == 0 && is_heard {
                        true => (to - q[i]) / 0.004,
                        false => v[i] - f64::signum(v[i]) * (25.0 * 0.004_f64).min(v[i].abs()),
                    };
                    most = most.max((speed - v[i]).abs() / 0.004);
                    fastest = fastest.max(speed.abs());
                    (q[i], v[i]) = (q[i] + 0.004 * speed, speed);
                }
            }
        }
        assert!(most < 25.0 + 1e-6, "{lost}, {late}: {most} rad/s^2");
        assert!(fastest > 0.3, "{lost}, {late}: {fastest} rad/s prove nothing");
    }
}

/// Every seventh state is lost, every fifth answer and the next come too late, and the driver holds the forces of before. They then lead where nobody
/// foresaw: by as much faster as a period's acceleration makes, for each period. No force is above its limit all the same, on the way back neither, and
/// the change of a force, or of an acceleration, is that from what was sent before: it was reckoned from answers that nobody had applied.
#[test]
fn forces_keep_their_limits_and_rates_over_states_and_answers_that_are_lost() {
    let numbers = |value: &Value| -> Vec<f64> {
        value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
    };
    let largest =
        |a: &[f64], b: &[f64]| a.iter().zip(b).fold(0.0, |most: f64, (a, b)| most.max((a - b).abs()));
    for rates in ["", "torque_rate = { limit = 2000.0 }", "jerk = { limit = 600.0, hard = true }"] {
        for (lost, late, periods) in [(0, 0, 0.0), (7, 0, 1.0), (0, 5, 2.0), (7, 5, 3.0)] {
            let flight = Attack { lost, late, ..attack(&format!("{LIMITS}\n{rates}"), 0.004, 1, 20) };
            let (_folder, log) = record("verify-rate", &flight);
            let (mut before, mut compared) = (None::<[Vec<f64>; 2]>, 0);
            let [mut force_change, mut change, mut force, mut fastest] = [0.0f64; 4];
            for pair in ticks(&log).windows(2) {
                let tick = &pair[0];
                let between = |what: &str| {
                    pair[1]["state"][what].as_u64().unwrap() - tick["state"][what].as_u64().unwrap()
                };
                let (v, target, action) =
                    (numbers(&tick["state"]["v"]), numbers(&tick["target_v"]), numbers(&tick["action"]));
                fastest = fastest.max(largest(&v, &[0.0; 7]));
                let strength = |i: usize| if i < 4 { 0.8 * 87.0 } else { 0.8 * 12.0 };
                force = action.iter().enumerate().fold(force, |most, (i, f)| most.max(f.abs() / strength(i)));
                if between("late") >= between("seq") {
                    continue; // it came too late
                }
                let acceleration: Vec<f64> =
                    target.iter().zip(&v).map(|(to, from)| (to - from) / 0.004).collect();
                if let Some([before_force, before]) = &before {
                    let (status, slack) = (&tick["ledger"]["status"], &tick["ledger"]["slack"]);
                    let status = status.as_u64().unwrap();
                    // a brake that asks for more than the motors have gives way to them
                    if status < 10 {
                        change = change.max(largest(&acceleration, before));
                    }
                    // a soft rate gives way where something hard asks for it, and says so
                    if status <= 1 && slack.as_f64().unwrap() < 1e-9 {
                        force_change = force_change.max(largest(&action, before_force));
                        compared += 1;
                    }
                }
                before = Some([action, acceleration]);
            }
            let told = format!(
                "{rates} {lost}, {late}: {fastest} rad/s, {force} of the force, changes {force_change}, {change}"
            );
            println!("{told} of {compared}");
            assert!(force < 1.0 + 1e-6 && fastest > 1.0, "{told}");
            match rates.split(' ').next() {
                Some("torque_rate") => assert!(force_change < 8.0 + 1e-6 && compared > 100, "{told}"),
                Some("jerk") => assert!(change < 2.4 + 1e-6, "{told}"),
                _ => assert!(fastest < 1.305 + 0.1 * periods + 0.01, "{told}"),
            }
        }
    }
}

/// What a joint went on from in the first tick after a gap is not in the log, so that its acceleration there, of which the jerk of the next tick speaks,
/// is not known either: it was taken from the measured state, and honest logs were accused.
#[test]
fn a_jerk_after_a_gap_is_not_told_from_a_measured_state() {
    let limits =
        format!("{LIMITS}\njerk = {{ limit = 600.0, hard = true }}\n[command]\ninterface = \"position\"");
    let (folder, log) = record("verify-gap-jerk", &Attack { lag: 0.02, ..attack(&limits, 0.004, 1, 20) });
    let whole = verify(&log).unwrap();
    assert_eq!((whole.found, whole.is_whole()), (0, true), "{whole}");
    let other = folder.0.join("copy.mcap");
    for left_out in [300, 517, 733, 901, 1204] {
        let edit = |topic: &str, m: &mut Value| topic != "tick" || m["tick"] != left_out;
        copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
        let report = verify(&other).unwrap();
        assert_eq!(report.found, 0, "{left_out}: {report}");
        assert!((1..8).contains(&report.unverified()), "{left_out}: {report}");
    }
    // The set point that takes the place of a measured position does not hide one that is no number.
    let edit = |topic: &str, m: &mut Value| {
        if topic == "tick" && m["tick"] == 700 {
            m["state"]["q"][2] = Value::Null;
        }
        true
    };
    copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
    let report = verify(&other).unwrap();
    assert!(report.found > 0 && report.violations[0].what.contains("state.q[2]"), "{report}");
}
