//! Every kind of limit, convention of sub-steps and way to brake is confirmed.

use std::time::Duration;

use nearl_verify::verify;
use serde_json::Value;

use super::{Alter, COUPLED, LIMITS, add, attack, copy, holds, limits_in, record, ticks, with_limit};
use crate::arm::Scratch;
use crate::attack::Attack;
use crate::toy::Name;

#[test]
fn a_flight_under_attack_is_verified_tick_by_tick() {
    let (_folder, log) = record("verify", &attack(LIMITS, 0.001, 1, 20));
    holds(&verify(&log).unwrap(), 1500);
}

#[test]
fn a_flight_of_a_real_loop_is_verified_to_its_stop() {
    let folder = Scratch::new("verify-loop");
    let slow = Attack { pause: Duration::from_micros(300), ticks: 600, ..attack(LIMITS, 0.001, 1, 20) };
    let (log, report) = slow.record(&Name::new("verify-loop").0, &folder.0);
    assert_eq!((report.log_drops, report.log_error.as_deref()), (0, None), "{report}");
    let found = verify(&log).unwrap();
    println!("{found}");
    assert_eq!((found.found, found.ticks), (0, report.ticks), "{found}");
    assert!(found.verified > 500 && found.optimal > 200, "{found}");
}

#[test]
fn every_convention_of_sub_steps_and_every_way_to_brake_is_verified() {
    for (sub_steps, dt, limits) in [
        (0, 0.001, LIMITS.to_owned()),
        (5, 0.01, LIMITS.to_owned()),
        (1, 0.02, LIMITS.to_owned()),
        (1, 0.002, LIMITS.replace("stored", "certified").replace("25.0", "3.0").replace("0.8", "1.0")),
        (0, 0.002, LIMITS.replace("stored", "certified").replace("25.0", "3.0").replace("0.8", "1.0")),
    ] {
        let (_folder, log) = record("verify-steps", &attack(&limits, dt, sub_steps, 5));
        holds(&verify(&log).unwrap(), 1500);
    }
}

#[test]
fn every_kind_of_limit_is_verified_alone_and_together() {
    for kinds in COUPLED.iter().map(|kind| (*kind).to_owned()).chain([COUPLED[..3].join("\n")]) {
        let (_folder, log) = record("verify-kinds", &attack(&format!("{LIMITS}\n{kinds}"), 0.002, 1, 5));
        let report = verify(&log).unwrap();
        println!("{kinds}\n{report}");
        assert_eq!((report.found, report.is_whole()), (0, true), "{kinds}\n{report}");
        assert!(report.verified + report.idle == 1500 && report.optimal > 200, "{kinds}\n{report}");
    }
}

/// In front of a position limit the steps of a period give a joint less acceleration than the nearest target has: another one is projected, which says
/// that it is not the nearest (`slowed`), and to which the action leads.
#[test]
fn limits_of_several_joints_are_verified_over_several_steps() {
    for kinds in COUPLED[..3].iter().map(|kind| (*kind).to_owned()).chain([COUPLED[..4].join("\n")]) {
        let flight = attack(&format!("{LIMITS}\n{kinds}"), 0.01, 5, 5);
        let (_folder, log) = record("verify-kinds-steps", &flight);
        let report = verify(&log).unwrap();
        println!("{kinds}\n{report}");
        assert_eq!((report.found, report.is_whole()), (0, true), "{kinds}\n{report}");
        assert!(report.verified + report.idle == 1500 && report.optimal > 200, "{kinds}\n{report}");
        // Solved for, and not on the way to a stored brake.
        let is_another = |t: &&Value| t["ledger"]["status"] == 4 && t["ledger"]["rung"].as_u64() < Some(3);
        let others = ticks(&log).iter().filter(is_another).count();
        assert!(others > 500, "{kinds}: {others} ticks were projected once more");
    }
}

/// A motor's line bounds the force at the speed of a period's start and end, where the steps of the period are reckoned with one by one.
#[test]
fn a_motor_s_line_is_verified_over_several_steps() {
    let line = COUPLED.iter().find(|kind| kind.starts_with("torque_speed")).expect("a motor's line");
    let (_folder, log) = record("verify-line-steps", &attack(&format!("{LIMITS}\n{line}"), 0.004, 4, 5));
    let report = verify(&log).unwrap();
    assert_eq!((report.found, report.is_whole()), (0, true), "{report}");
    assert!(report.verified + report.idle == 1500 && report.optimal > 200, "{report}");
}

/// Orders of an operator every 0.2 s, and back: speeds, positions, how fast a joint may speed up where jerk is soft, and what ties joints
/// together.
/// A plant that moves in next to no steps is what the period makes of it to second order. A brake that was verified a tick before may then end up
/// within the margin, and no further; with no margin to take it up, it ends beyond the limit, and is found. One that moves in several steps is
/// foreseen, and keeps what it has no margin for.
#[test]
fn a_flight_on_a_plant_that_differs_to_second_order_is_verified_within_its_margins() {
    let limits = LIMITS.replace("25.0", "8.0");
    for (sub_steps, plant_steps, dt, foreseen) in
        [(4, 4, 0.004, true), (0, 80, 0.02, false), (5, 5, 0.01, true)]
    {
        let mut braked = 0;
        for (margin, is_kept) in [("0.01", true), ("0.0", foreseen)] {
            let limits = limits.replace("margin = 0.01", &format!("margin = {margin}"));
            let flight = Attack { plant_steps, ticks: 3000, ..attack(&limits, dt, sub_steps, 20) };
            let (_folder, log) = record("verify-second-order", &flight);
            let report = verify(&log).unwrap();
            println!("{sub_steps} {plant_steps} {margin}: {report}");
            assert_eq!(report.found == 0, is_kept, "{report}");
            assert!(report.verified + report.found + report.idle == 3000, "{report}");
            let is_braked = |tick: &Value| (10..=13).contains(&tick["ledger"]["status"].as_u64().unwrap());
            braked += ticks(&log).iter().filter(|tick| is_braked(tick)).count();
        }
        assert!(braked > 20, "{braked}");
    }
}

/// Speeds with accelerations of another joint, and sums of positions and of speeds that stay where they are.
#[test]
fn rows_of_several_joints_are_verified_with_what_a_brake_keeps_of_them() {
    let rows = [
        "{ name = \"mix\", terms = { \"v.panda_joint4\" = 1.0, \"a.panda_joint2\" = 0.05 }, lower = -0.8, upper = 0.8 }",
        "{ name = \"mimic\", terms = { \"q.panda_joint6\" = 1.0, \"q.panda_joint4\" = 0.8 }, equals = 0.0 }",
        "{ name = \"geared\", terms = { \"v.panda_joint1\" = 1.0, \"v.panda_joint3\" = -0.5 }, equals = 0.0 }",
    ];
    for (test, dt, sub_steps, rows) in [
        ("verify-rows-a", 0.001, 1, rows.join(", ")),
        ("verify-rows-b", 0.004, 1, rows[..1].join(", ")),
        ("verify-rows-c", 0.004, 1, rows[1..].join(", ")),
    ] {
        let limits = format!("{LIMITS}\nrows = [{rows}]");
        let (_folder, log) = record(test, &attack(&limits, dt, sub_steps, 20));
        holds(&verify(&log).unwrap(), 1500);
    }
}

#[test]
fn hard_jerk_is_verified_alone_and_with_what_ties_joints_together() {
    let jerk = format!("{LIMITS}\njerk = {{ limit = 600.0, hard = true }}");
    let certified = jerk.replace("stored", "certified").replace("25.0", "3.0").replace("0.8", "1.0");
    for (limits, dt, sub_steps) in [
        (jerk.clone(), 0.001, 1),
        (certified.clone(), 0.001, 1),
        (certified, 0.01, 1),
        (jerk.clone(), 0.01, 5),
        (jerk.clone() + "\nlocked = [\"panda_joint3\"]", 0.002, 1),
        (format!("{jerk}\n{}", COUPLED[0]), 0.002, 1),
        (format!("{jerk}\n{}", COUPLED[1]), 0.002, 0),
    ] {
        let (_folder, log) = record("verify-jerk", &attack(&limits, dt, sub_steps, 5));
        let report = verify(&log).unwrap();
        println!("{limits}, {sub_steps} steps of {dt} s\n{report}");
        assert_eq!((report.found, report.is_whole()), (0, true), "{limits} {dt}\n{report}");
        // Over several steps a joint may be a little outside of what its brake counts on, as its jerk bounds how much slower it may become for it.
        let outside = if sub_steps > 1 { report.verified / 100 } else { 0 };
        assert!(
            report.stoppable + outside >= report.verified && report.optimal > 150,
            "{limits} {dt}\n{report}"
        );
    }
    // Another jerk than the loop was built with is found out, looser or tighter.
    let (folder, log) = record("verify-jerk-edited", &attack(&jerk, 0.002, 1, 5));
    let other = folder.0.join("copy.mcap");
    for jerk in [550.0, 650.0] {
        let change = |constraints: &mut Value| constraints["jerk"]["limit"] = jerk.into();
        let facts = |facts: &mut _| limits_in(facts, &change);
        copy(&log, &other, &|_, _| true, &|bytes| with_limit(bytes, &change), &facts);
        let report = verify(&other).unwrap();
        assert!(report.found > 0, "jerk {jerk}\n{report}");
    }
}

#[test]
fn positions_and_velocities_that_are_clamped_apart_are_verified() {
    let free = "consistency = \"free\"\nposition = { margin = 0.01 }\nvelocity = { scale = 0.5 }\nacceleration = { limit = 3.0 }\n\
         braking = \"certified\"";
    let (folder, log) = record("verify-free", &attack(free, 0.002, 1, 5));
    let report = verify(&log).unwrap();
    println!("{report}");
    assert_eq!((report.found, report.is_whole()), (0, true), "{report}");
    assert!(report.optimal > 1400, "{report}");
    let at = ticks(&log)
        .iter()
        .rfind(|m| !m["ledger"]["active_rows"].as_array().unwrap().is_empty())
        .unwrap()["tick"]
        .as_u64()
        .unwrap();
    let other = folder.0.join("copy.mcap");
    let cases: [(&str, Alter<Value>); 4] = [
        ("target", &|m| add(&mut m["target_q"][0], 1e-5)),
        ("target", &|m| add(&mut m["target_v"][0], 1e-4)),
        ("multiplier", &|m| add(&mut m["ledger"]["active_rows"][0]["multiplier"], 0.1)),
        ("no active row", &|m| {
            m["ledger"]["active_rows"].as_array_mut().unwrap().remove(0);
            m["ledger"]["active"] = (m["ledger"]["active"].as_u64().unwrap() - 1).into();
        }),
    ];
    for (word, change) in cases {
        let edit = |topic: &str, m: &mut Value| {
            if topic == "tick" && m["tick"] == at {
                change(m);
            }
            true
        };
        copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
        let report = verify(&other).unwrap();
        println!("{word}: {:?}", report.violations.first());
        assert!(report.found > 0 && report.violations[0].tick == at, "{word}\n{report}");
    }
}
