//! Limits that move while the loop runs.

use nearl_constraints::description::Payload;
use nearl_constraints::limit::{HalfSpace, Pose};
use nearl_constraints::{Kinematics, Moved, PerJoint};
use nearl_runtime::Snapshot;
use nearl_runtime::log::replay;
use nearl_verify::verify;
use serde_json::Value;

use super::{Alter, COUPLED, LIMITS, attack, copy, record, ticks};
use crate::attack::Attack;

fn orders(dt: f64, kinds: &str) -> Vec<(u64, Moved)> {
    let named = |joint: &str, x: f64| Some(PerJoint::Joints([(joint.to_owned(), x)].into()));
    let mut all = vec![
        Moved::speed(0.3),
        Moved::default(),
        Moved {
            upper: named("panda_joint4", -2.0),
            lower: named("panda_joint1", -0.1),
            acceleration: if kinds.contains("hard = true") { None } else { named("panda_joint2", 2.0) },
            ..Moved::default()
        },
        Moved { velocity: named("panda_joint6", 0.1), ..Moved::speed(0.6) },
        Moved::default(),
        Moved::speed(0.02),
        Moved::default(),
    ];
    let only = |name: &str, x: f64| [(name.to_owned(), x)].into();
    for moved in &mut all {
        if *moved == Moved::default() {
            continue;
        }
        if kinds.contains("\nframe = [") {
            moved.frame = only("panda_hand", 0.05);
        }
        if kinds.contains("frame_speed") {
            moved.frame_speed = only("tip", 0.1);
        }
        if kinds.contains("energy = ") {
            moved.energy = Some(0.1);
        }
    }
    let every = (0.2 / dt) as u64;
    all.into_iter().enumerate().map(|(k, moved)| ((k as u64 + 1) * every, moved)).collect()
}

#[test]
fn limits_that_an_operator_moves_are_verified_on_the_way_and_where_they_lead() {
    let certified = LIMITS.replace("stored", "certified").replace("25.0", "3.0").replace("0.8", "1.0");
    let tied = |kinds: &[&str]| format!("{LIMITS}\n{}", kinds.join("\n"));
    for (limits, dt, sub_steps) in [
        (LIMITS.to_owned(), 0.001, 1),
        (certified.clone(), 0.002, 1),
        (certified, 0.002, 0),
        (LIMITS.to_owned(), 0.01, 5),
        (tied(&COUPLED[..1]), 0.002, 1),
        (tied(&COUPLED[1..2]), 0.002, 0),
        (tied(&COUPLED[2..3]), 0.002, 1),
        (tied(&COUPLED[..4]), 0.002, 1),
    ] {
        let flight = Attack { moves: orders(dt, &limits), ..attack(&limits, dt, sub_steps, 5) };
        let (_folder, log) = record("verify-moved", &flight);
        let report = verify(&log).unwrap();
        println!("{limits}, {sub_steps} steps of {dt} s\n{report}");
        assert_eq!((report.found, report.is_whole()), (0, true), "{limits} {dt}\n{report}");
        let on_the_way = report.not_compared.iter().find(|(why, _)| why.contains("on its way"));
        assert!(
            on_the_way.is_some_and(|(_, ticks)| *ticks > 5),
            "{limits} {dt}: nothing was on its way\n{report}"
        );
        assert!(report.verified + report.idle == 1500 && report.optimal > 150, "{limits} {dt}\n{report}");
    }
}

/// A hand below a plane and clear of a ball that are both carried about, and a load that it takes up and sets down.
fn carried(dt: f64) -> Vec<(u64, Moved)> {
    let named = |name: &str| name.to_owned();
    let plane = |normal, through| [(named("panda_hand"), HalfSpace { normal, through })].into();
    let ball = |position| [(named("ball"), Pose { position, rpy: [0.0; 3] })].into();
    let load = |mass| {
        Some(Payload {
            frame: named("panda_hand"),
            mass,
            com: [0.01, 0.0, 0.05],
            inertia: [0.002, 0.0, 0.0, 0.002, 0.0, 0.001],
        })
    };
    let all = [
        Moved { plane: plane([0.3, 0.0, -1.0], [0.4, 0.0, 0.5]), ..Moved::default() },
        Moved { body: ball([0.55, 0.1, 0.6]), ..Moved::default() },
        Moved { payload: load(1.0), ..Moved::speed(0.5) },
        Moved { payload: load(1.6), plane: plane([0.0, 0.4, -1.0], [0.4, 0.0, 0.45]), ..Moved::default() },
        Moved { payload: load(0.4), body: ball([0.5, -0.15, 0.5]), ..Moved::default() },
        Moved::default(),
    ];
    let every = (0.2 / dt) as u64;
    all.into_iter().enumerate().map(|(k, moved)| ((k as u64 + 1) * every, moved)).collect()
}

#[test]
fn what_is_put_elsewhere_and_what_is_taken_up_is_verified() {
    let ball = "collision = { shapes = [{ frame = \"panda_hand\", shape = { sphere = { radius = 0.08 } } }, \
         { name = \"ball\", shape = { sphere = { radius = 0.08 } }, position = [0.9, 0.5, 0.5] }], braking = 0.8 }";
    let limits = format!("{LIMITS}\n{}\n{ball}", COUPLED[0].replace("0.4]", "0.2]"));
    let jerk = format!("{limits}\njerk = {{ limit = 600.0, hard = true }}");
    for (limits, dt, sub_steps) in
        [(&limits, 0.001, 1), (&limits, 0.002, 0), (&limits, 0.01, 5), (&jerk, 0.002, 1)]
    {
        let flight = Attack { moves: carried(dt), ..attack(limits, dt, sub_steps, 5) };
        let (_folder, log) = record("verify-carried", &flight);
        let report = verify(&log).unwrap();
        println!("{limits}, {sub_steps} steps of {dt} s\n{report}");
        assert_eq!((report.found, report.complete), (0, true), "{limits} {dt}\n{report}");
        // A brake that was stored for another load is nothing that the log can confirm.
        let another_load =
            |why: &String| why == "the robot braked as was verified before it carried what it carries now";
        assert!(report.not_verified.keys().all(another_load), "{limits} {dt}\n{report}");
        assert!(report.verified + report.idle > 1400 && report.optimal > 100, "{limits} {dt}\n{report}");
        assert_eq!(replay(&log).unwrap().difference, None, "{limits} {dt}");
        // As if the plane, or the ball, had been put where the hand was, and as if the load had been another.
        let seen = ticks(&log);
        let hand = |orders: f64| {
            let tick = &seen[((orders * 0.2) / dt) as usize];
            let q: Vec<f64> = serde_json::from_value(tick["target_q"].clone()).unwrap();
            let mut kinematics = Kinematics::new(&flight.model());
            kinematics.update(&q, &[0.0; 7], &[0.0; 7]);
            kinematics.point(flight.model().frame("panda_hand").unwrap(), [0.0; 3]).position
        };
        let (under, there) = (hand(1.5), hand(2.5));
        let other = log.with_file_name("copy.mcap");
        let cases: [(&str, Alter<Moved>); 3] = [
            ("a plane", &|moved| {
                for plane in moved.plane.values_mut() {
                    plane.through = std::array::from_fn(|k| under[k] - 0.1 * plane.normal[k]);
                }
            }),
            ("a ball", &|moved| moved.body.values_mut().for_each(|body| body.position = there)),
            ("a load", &|moved| moved.payload.iter_mut().for_each(|load| load.mass *= 3.0)),
        ];
        for (word, change) in cases {
            let edit = |bytes: Vec<u8>| {
                let mut snapshot = Snapshot::from_bytes(&bytes).unwrap();
                snapshot.manifest.moved.iter_mut().for_each(change);
                snapshot.to_bytes()
            };
            copy(&log, &other, &|_, _| true, &edit, &|_| {});
            let report = verify(&other).unwrap();
            assert!(report.found > 0, "{word} {dt}\n{report}");
        }
    }
}

/// Speeds and positions that move while jerk is hard.
#[test]
fn limits_that_move_are_verified_where_jerk_is_hard() {
    let jerk = format!("{LIMITS}\njerk = {{ limit = 600.0, hard = true }}");
    let certified = jerk.replace("stored", "certified").replace("25.0", "3.0").replace("0.8", "1.0");
    for (limits, dt, sub_steps) in [(&jerk, 0.001, 1), (&certified, 0.002, 0), (&jerk, 0.01, 5)] {
        let flight = Attack { moves: orders(dt, limits), ..attack(limits, dt, sub_steps, 5) };
        let (_folder, log) = record("verify-moved-jerk", &flight);
        let report = verify(&log).unwrap();
        println!("{limits}, {sub_steps} steps of {dt} s\n{report}");
        assert_eq!((report.found, report.is_whole()), (0, true), "{limits} {dt}\n{report}");
        let on_the_way = report.not_compared.iter().find(|(why, _)| why.contains("on its way"));
        assert!(on_the_way.is_some_and(|(_, ticks)| *ticks > 5), "{limits} {dt}\n{report}");
        assert!(report.verified + report.idle == 1500 && report.optimal > 100, "{limits} {dt}\n{report}");
    }
}

#[test]
fn a_tick_beyond_the_way_to_moved_limits_is_named() {
    let flight = Attack { moves: orders(0.001, ""), ..attack(LIMITS, 0.001, 1, 20) };
    let (folder, log) = record("verify-moved-edited", &flight);
    let other = folder.0.join("copy.mcap");
    // As if the operator had asked for less than the loop was built with.
    let tighter = |bytes: Vec<u8>, change: &dyn Fn(&mut Moved)| {
        let mut snapshot = Snapshot::from_bytes(&bytes).unwrap();
        snapshot.manifest.moved.iter_mut().filter(|moved| **moved != Moved::default()).for_each(change);
        snapshot.to_bytes()
    };
    let cases: [(&str, Alter<Moved>); 4] = [
        ("speed of joint", &|moved| moved.speed *= 0.9),
        ("gain of speed of joint", &|moved| moved.acceleration = Some(PerJoint::All(1.5))),
        ("position of joint 'panda_joint2'", &|moved| {
            moved.upper = Some(PerJoint::Joints([("panda_joint2".to_owned(), -1.0)].into()));
        }),
        ("position of joint 'panda_joint4'", &|moved| {
            moved.lower = Some(PerJoint::Joints([("panda_joint4".to_owned(), -1.9)].into()));
        }),
    ];
    for (word, change) in cases {
        copy(&log, &other, &|_, _| true, &|bytes| tighter(bytes, change), &|_| {});
        let report = verify(&other).unwrap();
        println!("{word}: {report}");
        assert!(
            report.found > 0 && report.violations.iter().any(|v| v.what.contains(word)),
            "{word}\n{report}"
        );
    }
    // A tick that says it is on the way to limits that nobody moved.
    let (folder, log) = record("verify-not-moved", &Attack { ticks: 300, ..attack(LIMITS, 0.001, 1, 20) });
    let other = folder.0.join("copy.mcap");
    let edit = |topic: &str, m: &mut Value| {
        if topic == "tick" && m["tick"] == 200 {
            m["ledger"]["status"] = 6.into();
        }
        true
    };
    copy(&log, &other, &edit, &|bytes| bytes, &|_| {});
    let report = verify(&other).unwrap();
    assert!(report.found == 1 && report.violations[0].tick == 200, "{report}");
}
