//! Limits of joints that are attacked while they move.

use nearl_constraints::*;

use super::{Asked, PERIODS, SUB_STEPS, draw, joints, middle};
use crate::common::arms::{rail_arm, random_arm, small_arm};
use crate::common::*;

/// Ticks outside what is declared, ticks on the way and ticks that moved limits hold something back.
#[derive(Debug, Default)]
struct Seen {
    outside: usize,
    on_the_way: usize,
    arrivals: usize,
}

fn attack_joints(
    model: &Model,
    limits: &[Box<dyn Limit>],
    settings: Settings,
    ticks: usize,
    seed: u64,
) -> Seen {
    let (all, dt, a): (Vec<usize>, f64, f64) = ((0..model.nv()).collect(), settings.dt, 10.0);
    let mut projector = Projector::new(model, limits, &all, settings).unwrap();
    let period = Period::new(dt, projector.settings().sub_steps);
    let (mut raw, mut target) = (Proposal::new(model), Target::new(model));
    let (mut q, mut v) = (middle(model), vec![0.0; model.nv()]);
    let (mut attack, mut random) = (Attack::new(seed, model.nv()), Random(seed + 100));
    let (_, mut asked) = draw(model, a, &mut Random(1));
    asked.speed.fill(f64::INFINITY);
    asked.lower.fill(f64::NEG_INFINITY);
    asked.upper.fill(f64::INFINITY);
    asked.gain.fill(f64::INFINITY);
    let mut dynamics = Dynamics::new(model);
    let (mut tau, mut seen) = (vec![0.0; model.nv()], Seen::default());
    let with_torque = limits.len() > 3;
    for tick in 0..ticks {
        if random.next() < dt / 0.2 {
            let (moved, new) = draw(model, a, &mut random);
            if projector.move_limits(&moved).is_ok() {
                asked = new;
            }
        }
        attack.propose(model, dt, &q, &mut raw);
        let status = projector.project(&q, &v, &raw, &mut target);
        let mut wrong = Vec::new();
        let mut check = |name: &str, i: usize, value: f64, limit: f64| {
            if value > limit + 1e-9 * limit.abs().max(1.0) {
                wrong.push(format!("{name} {i}: {value} of {limit}"));
            }
        };
        let mut away = false;
        for i in 0..model.nv() {
            let (v, v_next) = (v[i], target.v[i]);
            let (before, after) = (v.abs(), v_next.abs());
            check("built speed", i, after, model.velocity_limit()[i]);
            check("built position", i, target.q[i], model.upper_position_limit()[i]);
            check("built position", i, -target.q[i], -model.lower_position_limit()[i]);
            check("acceleration", i, (v_next - v).abs(), a * dt);
            // Where no brake is stored, the last period of braking may turn a joint round in front of a position.
            let turned = if projector.stores_a_brake() || v * v_next > 0.0 { 0.0 } else { a * dt - before };
            // Never faster than asked for, and slower in each tick until then.
            let known = if before > asked.speed[i] { before } else { asked.speed[i] };
            check("speed", i, after, known.max(turned));
            let gain = if v * v_next > 0.0 { after - before } else { after };
            check("gain", i, gain, (asked.gain[i] * dt).max(turned));
            // Behind a position it never moves further out once it stands, and stops in time to the best of the motors.
            for (d, limit) in [(1.0, asked.upper[i]), (-1.0, -asked.lower[i])] {
                if d * q[i] > limit + 1e-9 {
                    check("outward", i, d * v_next, (d * v).max(0.0));
                    away = true;
                }
            }
            away |= before > asked.speed[i] * (1.0 + 1e-9);
        }
        if with_torque {
            dynamics.motors(&period, &q, &v, &target.acceleration, &mut tau);
            for (i, tau) in tau.iter().enumerate() {
                check("torque", i, tau.abs(), model.effort_limit()[i]);
            }
        }
        let named = !target.ledger.outside.is_empty();
        if away && !named {
            wrong.push("outside, and not named".into());
        }
        if target.ledger.target_violations.total() > 0 {
            wrong.push(format!("the checker finds {:?}", target.ledger.target_violations));
        }
        if named && !matches!(status, Status::Tightening | Status::Braked(BrakeReason::NoVerifiedBrake)) {
            wrong.push("another status".into());
        }
        if !wrong.is_empty() && seen.outside < 3 {
            println!("tick {tick} {status:?}: {wrong:?} {:?}", target.ledger);
        }
        seen.outside += usize::from(!wrong.is_empty());
        seen.arrivals += usize::from(seen.on_the_way > 0 && !named);
        seen.on_the_way += usize::from(named);
        (q, v) = (target.q.clone(), target.v.clone());
    }
    seen
}

#[test]
fn joints_keep_what_is_declared_on_the_way_to_moved_limits() {
    let robots = [("small", small_arm()), ("rail", rail_arm()), ("random", random_arm(4, 5))];
    for (name, model) in &robots {
        for sub_steps in SUB_STEPS {
            for dt in PERIODS {
                let ticks = if dt < 0.005 { 6000 } else { 3000 };
                let settings = Settings { braking: Braking::Certified, ..Settings::new(dt, sub_steps) };
                let seen = attack_joints(model, &joints(10.0, None), settings, ticks, 5);
                println!("{name} {sub_steps} {dt}: {seen:?}");
                assert_eq!(seen.outside, 0, "{name}, {sub_steps} steps of {dt} s: {seen:?}");
                assert!(seen.on_the_way > 20 && seen.arrivals > 20, "{name}, {dt}: {seen:?} shows nothing");
            }
        }
    }
}

#[test]
fn joints_with_torque_keep_what_is_declared_on_the_way_to_moved_limits() {
    let robots = [("small", small_arm(), 0.45), ("rail", rail_arm(), 0.8)];
    for (name, model, torque) in &robots {
        for sub_steps in SUB_STEPS {
            for dt in PERIODS {
                let ticks = if dt < 0.005 { 3000 } else { 1000 };
                let settings = Settings { braking: Braking::Stored, ..Settings::new(dt, sub_steps) };
                let seen = attack_joints(model, &joints(10.0, Some(*torque)), settings, ticks, 5);
                println!("{name} {sub_steps} {dt}: {seen:?}");
                assert_eq!(seen.outside, 0, "{name}, {sub_steps} steps of {dt} s: {seen:?}");
                assert!(seen.on_the_way > 20 && seen.arrivals > 20, "{name}, {dt}: {seen:?} shows nothing");
            }
        }
    }
}

/// The fastest that a joint becomes whose acceleration falls from `a` as its jerk lets it.
fn crest(v: f64, a: f64, step: f64, dt: f64) -> f64 {
    let (mut v, mut a) = (v, a - step);
    while a > 0.0 {
        (v, a) = (v + dt * a, a - step);
    }
    v
}

/// How far a joint goes at most that brakes from `v` after acceleration `a`: with what it speeds up by, for as long as its acceleration takes to
/// turn round, and then by the deceleration `b`, which falls to none once more.
fn farthest(v: f64, a: f64, b: f64, step: f64, dt: f64) -> f64 {
    let top = crest(v, a, step, dt).max(v).max(0.0) + dt * step;
    let turns = ((a.max(0.0) + b) / step + 2.0) * dt;
    top * top / (2.0 * b) + top * (2.0 * turns + 3.0 * dt)
}

/// Hard jerk: what speeds up when limits become tighter goes on doing so for as long as its acceleration takes to fall, and no longer.
#[test]
fn joints_of_hard_jerk_keep_what_is_declared_on_the_way_to_moved_limits() {
    const A: f64 = 10.0;
    let robots =
        [("small", small_arm(), None), ("rail", rail_arm(), Some(0.9)), ("random", random_arm(4, 5), None)];
    for (name, model, torque) in &robots {
        for (sub_steps, dt, jerk) in
            [(0, 0.001, 300.0), (1, 0.001, 100.0), (1, 0.002, 300.0), (5, 0.01, 200.0), (0, 0.02, 300.0)]
        {
            let mut limits = joints(A, *torque);
            limits.push(Box::new(JerkLimit::hard(jerk)));
            let braking = if torque.is_some() { Braking::Stored } else { Braking::Certified };
            let settings = Settings { braking, ..Settings::new(dt, sub_steps) };
            let n = model.nv();
            let all: Vec<usize> = (0..n).collect();
            let mut projector = Projector::new(model, &limits, &all, settings).unwrap();
            let (mut raw, mut target) = (Proposal::new(model), Target::new(model));
            let (mut q, mut v, mut a) = (middle(model), vec![0.0; n], vec![0.0; n]);
            let (mut attack, mut random) = (Attack::new(7, n), Random(19));
            let mut asked: Option<Asked> = None;
            let (mut ends, mut on_the_way, mut arrived, mut outside) = (vec![[f64::INFINITY; 2]; n], 0, 0, 0);
            let step = jerk * dt;
            for tick in 0..(if dt < 0.005 { 5000 } else { 2000 }) {
                if random.next() < dt / 0.2 {
                    let (mut moved, new) = draw(model, A, &mut random);
                    moved.acceleration = None; // refused by name
                    if projector.move_limits(&moved).is_ok() {
                        // Certified brakes are the quickest, so that this is how far a joint may go beyond.
                        let reach = |i: usize, d: f64| d * q[i] + farthest(d * v[i], d * a[i], A, step, dt);
                        ends = (0..n)
                            .map(|i| [new.upper[i].max(reach(i, 1.0)), (-new.lower[i]).max(reach(i, -1.0))])
                            .collect();
                        asked = Some(new);
                    }
                }
                attack.propose(model, dt, &q, &mut raw);
                let status = projector.project(&q, &v, &raw, &mut target);
                let named = !target.ledger.outside.is_empty();
                let mut wrong = Vec::new();
                let mut check = |what: &str, i: usize, value: f64, limit: f64| {
                    if value > limit + 1e-9 * limit.abs().max(1.0) {
                        wrong.push(format!("{what} {i}: {value} of {limit}"));
                    }
                };
                for i in 0..n {
                    check("built speed", i, target.v[i].abs(), model.velocity_limit()[i]);
                    check("built position", i, target.q[i], model.upper_position_limit()[i]);
                    check("built position", i, -target.q[i], -model.lower_position_limit()[i]);
                    check("acceleration", i, target.acceleration[i].abs(), A);
                    check("jerk", i, (target.acceleration[i] - a[i]).abs(), step);
                    let Some(asked) = &asked else { continue };
                    for (d, speed) in [(1.0, asked.speed[i]), (-1.0, asked.speed[i])] {
                        check("speed", i, d * target.v[i], speed.max(crest(d * v[i], d * a[i], step, dt)));
                    }
                    if braking == Braking::Certified {
                        check("way", i, target.q[i], ends[i][0]);
                        check("way", i, -target.q[i], ends[i][1]);
                    }
                    if !named {
                        check("speed asked for", i, target.v[i].abs(), asked.speed[i]);
                        check("position asked for", i, target.q[i], asked.upper[i]);
                        check("position asked for", i, -target.q[i], -asked.lower[i]);
                    }
                }
                if target.ledger.target_violations.total() > 0 {
                    wrong.push(format!("the checker finds {:?}", target.ledger.target_violations));
                }
                if named
                    && !matches!(status, Status::Tightening | Status::Braked(BrakeReason::NoVerifiedBrake))
                {
                    wrong.push("another status".into());
                }
                if !wrong.is_empty() && outside < 3 {
                    println!("tick {tick} {status:?}: {wrong:?} {:?}", target.ledger);
                }
                outside += usize::from(!wrong.is_empty());
                arrived += usize::from(on_the_way > 0 && !named);
                on_the_way += usize::from(named);
                projector.remember(&target);
                (q, v, a) = (target.q.clone(), target.v.clone(), target.acceleration.clone());
            }
            println!(
                "{name} {sub_steps} {dt} {jerk}: {outside} outside, {on_the_way} on the way, {arrived} after"
            );
            assert_eq!(outside, 0, "{name}, {sub_steps} steps of {dt} s, {jerk} rad/s³");
            assert!(on_the_way > 20 && arrived > 20, "{name}, {dt} shows nothing");
        }
    }
}
