//! Limits that move while the robot does: what is declared of the way holds under attack, and the way is as fast as it can be.

use crate::common::arms::{rail_arm, random_arm, small_arm};
use crate::common::*;
use nearl_constraints::*;

const SUB_STEPS: [u32; 3] = [0, 1, 5];
const PERIODS: [f64; 4] = [0.001, 0.002, 0.01, 0.02];

fn moved() -> Moved {
    Moved::default()
}

fn by_joint(model: &Model, value: impl Fn(usize) -> f64) -> Option<PerJoint> {
    Some(PerJoint::Each((0..model.nv()).map(value).collect()))
}

fn joints(acceleration: f64, torque: Option<f64>) -> Vec<Box<dyn Limit>> {
    let mut limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::default()),
        Box::new(AccelerationLimit::uniform(acceleration)),
    ];
    limits.extend(torque.map(|scale| Box::new(TorqueLimit::scaled(scale)) as Box<dyn Limit>));
    limits
}

fn middle(model: &Model) -> Vec<f64> {
    let (low, high) = (model.lower_position_limit(), model.upper_position_limit());
    (0..model.nv()).map(|i| 0.5 * (low[i] + high[i])).collect()
}

/// What was asked for last, as a test reads it.
struct Asked {
    speed: Vec<f64>,
    gain: Vec<f64>,
    lower: Vec<f64>,
    upper: Vec<f64>,
}

/// Limits of single joints at random, tighter and looser again.
fn draw(model: &Model, acceleration: f64, random: &mut Random) -> (Moved, Asked) {
    let (low, high) = (model.lower_position_limit(), model.upper_position_limit());
    let n = model.nv();
    let mut asked = Asked {
        speed: model.velocity_limit().to_vec(),
        gain: vec![acceleration; n],
        lower: low.to_vec(),
        upper: high.to_vec(),
    };
    let mut moved = moved();
    if random.next() < 0.6 {
        moved.speed = random.between(0.02, 1.0);
        asked.speed.iter_mut().for_each(|v| *v *= moved.speed);
    }
    if random.next() < 0.4 {
        let value = random.between(0.05, 1.0) * acceleration;
        moved.acceleration = Some(PerJoint::All(value));
        asked.gain.fill(value);
    }
    if random.next() < 0.6 {
        for i in 0..n {
            let (a, b) = (random.between(low[i], high[i]), random.between(low[i], high[i]));
            let gap = 0.3 - (a - b).abs();
            let wide = gap.max(0.0);
            (asked.lower[i], asked.upper[i]) =
                ((a.min(b) - wide).max(low[i]), (a.max(b) + wide).min(high[i]));
        }
        moved.lower = by_joint(model, |i| asked.lower[i]);
        moved.upper = by_joint(model, |i| asked.upper[i]);
    }
    (moved, asked)
}

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

/// A plane that turns and shifts, and a post that somebody carries about.
#[test]
fn planes_and_bodies_that_are_put_elsewhere_keep_what_is_declared() {
    for (name, model, torque) in [("small", small_arm(), Some(0.6)), ("rail", rail_arm(), None)] {
        let frame = model.frame("tool").unwrap();
        let (mut kinematics, zero) = (Kinematics::new(&model), vec![0.0; model.nv()]);
        let q0 = middle(&model);
        kinematics.update(&q0, &zero, &zero);
        let at0 = kinematics.point(frame, [0.0; 3]).position;
        for (sub_steps, dt) in [(0, 0.001), (1, 0.002), (5, 0.01), (1, 0.02)] {
            let ball =
                |name: &str, frame: Option<&str>, position: [f64; 3], radius: f64| limit::SolidSettings {
                    name: Some(name.into()),
                    frame: frame.map(str::to_string),
                    shape: geometry::Shape::Sphere { radius },
                    position,
                    rpy: [0.0; 3],
                };
            let mut limits = joints(10.0, torque);
            let through = [at0[0] + 0.3, at0[1], at0[2]];
            limits.push(Box::new(FrameLimit::half_space("tool", [1.0, 0.0, 0.0], through, 3.0)));
            let shapes = vec![ball("hand", Some("tool"), [0.0; 3], 0.05), ball("post", None, [9.0; 3], 0.08)];
            limits.push(Box::new(CollisionLimit::of(shapes, 3.0)));
            let all: Vec<usize> = (0..model.nv()).collect();
            let mut projector = Projector::new(&model, &limits, &all, Settings::new(dt, sub_steps)).unwrap();
            assert!(projector.stores_a_brake());
            let (mut raw, mut target) = (Proposal::new(&model), Target::new(&model));
            let (mut q, mut v) = (q0.clone(), zero.clone());
            let (mut attack, mut random) = (Attack::new(11, model.nv()), Random(23));
            let (mut plane, mut post) = (([1.0, 0.0, 0.0], through), [9.0; 3]);
            let (mut on_the_way, mut outside, mut arrived) = (0, 0, 0);
            for tick in 0..(if dt < 0.005 { 3000 } else { 1000 }) {
                if random.next() < dt / 0.3 {
                    let mut moved = moved();
                    kinematics.update(&q, &v, &zero);
                    let at = kinematics.point(frame, [0.0; 3]).position;
                    (plane, post) = (([1.0, 0.0, 0.0], through), [9.0; 3]);
                    if random.next() < 0.6 {
                        let normal =
                            [random.between(0.5, 2.0), random.between(-1.0, 1.0), random.between(-1.0, 1.0)];
                        plane = (
                            normal,
                            std::array::from_fn(|k| at[k] + random.between(-0.03, 0.15) * normal[k]),
                        );
                        moved.plane.insert("tool".into(), limit::HalfSpace { normal, through: plane.1 });
                    }
                    if random.next() < 0.6 {
                        // Sometimes so near that they touch.
                        let way: [f64; 3] = std::array::from_fn(|_| random.between(-1.0, 1.0));
                        let size = way.iter().map(|x| x * x).sum::<f64>().sqrt().max(0.1);
                        let far = random.between(0.12, 0.4);
                        post = std::array::from_fn(|k| at[k] + far * way[k] / size);
                        moved.body.insert("post".into(), limit::Pose { position: post, rpy: [0.0; 3] });
                    }
                    projector.move_limits(&moved).unwrap();
                }
                attack.propose(&model, dt, &q, &mut raw);
                let status = projector.project(&q, &v, &raw, &mut target);
                kinematics.update(&target.q, &target.v, &zero);
                let at = kinematics.point(frame, [0.0; 3]).position;
                let size = plane.0.iter().map(|x| x * x).sum::<f64>().sqrt();
                let beyond = (0..3).map(|k| plane.0[k] * (at[k] - plane.1[k]) / size).sum::<f64>();
                let gap = (0..3).map(|k| (at[k] - post[k]).powi(2)).sum::<f64>().sqrt() - 0.13;
                let named = !target.ledger.outside.is_empty();
                let mut wrong = vec![];
                if !named && (beyond > 1e-9 || gap < -1e-9) {
                    wrong.push(format!("{beyond} m beyond the plane, {gap} m from the post"));
                }
                if target.ledger.target_violations.total() > 0 {
                    wrong.push(format!("the checker finds {:?}", target.ledger.target_violations));
                }
                if !wrong.is_empty() && outside < 3 {
                    println!("tick {tick} {status:?}: {wrong:?} {:?}", target.ledger);
                }
                outside += usize::from(!wrong.is_empty());
                arrived += usize::from(on_the_way > 0 && !named);
                on_the_way += usize::from(named);
                (q, v) = (target.q.clone(), target.v.clone());
            }
            println!("{name} {sub_steps} {dt}: {outside} outside, {on_the_way} on the way, {arrived} after");
            assert_eq!(outside, 0, "{name}, {sub_steps} steps of {dt} s");
            assert!(on_the_way > 20 && arrived > 20, "{name}, {dt} shows nothing");
        }
    }
}

/// A point below a plane, its speed and the energy, all of which move.
#[test]
fn frames_speeds_and_energy_keep_what_is_declared_on_the_way_to_moved_limits() {
    for (name, model, torque) in [("small", small_arm(), 0.6), ("rail", rail_arm(), 0.9)] {
        let frame = model.frame("tool").unwrap();
        let (mut kinematics, zero) = (Kinematics::new(&model), vec![0.0; model.nv()]);
        let q0 = middle(&model);
        kinematics.update(&q0, &zero, &zero);
        let x0 = kinematics.point(frame, [0.0; 3]).position[0];
        for (sub_steps, dt) in [(0, 0.001), (1, 0.001), (1, 0.002), (5, 0.01), (1, 0.02)] {
            let mut limits = joints(10.0, Some(torque));
            limits.push(Box::new(FrameLimit::half_space("tool", [1.0, 0.0, 0.0], [x0 + 0.3, 0.0, 0.0], 3.0)));
            limits.push(Box::new(FrameSpeedLimit::of("tool", 0.8)));
            limits.push(Box::new(EnergyLimit::of(4.0)));
            let all: Vec<usize> = (0..model.nv()).collect();
            let mut projector = Projector::new(&model, &limits, &all, Settings::new(dt, sub_steps)).unwrap();
            assert!(projector.stores_a_brake());
            let (mut raw, mut target) = (Proposal::new(&model), Target::new(&model));
            let (mut q, mut v) = (q0.clone(), zero.clone());
            let (mut attack, mut random) = (Attack::new(3, model.nv()), Random(17));
            let (mut inset, mut speed, mut energy): (f64, f64, f64) = (0.0, 0.8, 4.0);
            let (mut on_the_way, mut outside, mut arrived, mut braked) = (0, 0, 0, 0);
            let ticks = if dt < 0.005 { 3000 } else { 1000 };
            for tick in 0..ticks {
                if random.next() < dt / 0.3 {
                    let mut moved = moved();
                    (inset, speed, energy) = (0.0, 0.8, 4.0);
                    if random.next() < 0.5 {
                        inset = random.between(0.0, 0.4);
                        moved.frame.insert("tool".into(), inset);
                    }
                    if random.next() < 0.5 {
                        speed = random.between(0.05, 0.8);
                        moved.frame_speed.insert("tool".into(), speed);
                    }
                    if random.next() < 0.5 {
                        energy = random.between(0.02, 4.0);
                        moved.energy = Some(energy);
                    }
                    projector.move_limits(&moved).unwrap();
                }
                attack.propose(&model, dt, &q, &mut raw);
                let status = projector.project(&q, &v, &raw, &mut target);
                kinematics.update(&target.q, &target.v, &zero);
                let at = kinematics.point(frame, [0.0; 3]);
                let fast = at.velocity.iter().map(|x| x * x).sum::<f64>().sqrt();
                let joule = kinematics.kinetic_energy(&target.q, &target.v);
                let named = !target.ledger.outside.is_empty();
                let mut wrong = vec![];
                let mut check = |name: &str, value: f64, limit: f64| {
                    if value > limit * (1.0 + 1e-9) + 1e-9 {
                        wrong.push(format!("{name}: {value} of {limit}"));
                    }
                };
                check("built plane", at.position[0], x0 + 0.3);
                check("built speed", fast, 0.8);
                check("built energy", joule, 4.0);
                if !named {
                    check("plane", at.position[0], x0 + 0.3 - inset);
                    check("speed", fast, speed);
                    check("energy", joule, energy);
                }
                if target.ledger.target_violations.total() > 0 {
                    wrong.push(format!("the checker finds {:?}", target.ledger.target_violations));
                }
                braked += usize::from(named && !status.is_ok());
                if !wrong.is_empty() && outside < 3 {
                    println!("tick {tick} {status:?}: {wrong:?} {:?}", target.ledger);
                }
                outside += usize::from(!wrong.is_empty());
                arrived += usize::from(on_the_way > 0 && !named);
                on_the_way += usize::from(named);
                (q, v) = (target.q.clone(), target.v.clone());
            }
            println!(
                "{name} {sub_steps} {dt}: {outside} outside, {on_the_way} on the way ({braked} braked), {arrived} after"
            );
            assert_eq!(outside, 0, "{name}, {sub_steps} steps of {dt} s");
            assert!(on_the_way > 20 && arrived > 20, "{name}, {dt} shows nothing");
        }
    }
}

/// From `v` to `v_new` at the braking deceleration: `(v - v_new) / A`, to the tick.
#[test]
fn a_slower_speed_is_reached_in_the_time_it_takes() {
    for (dt, share) in [(0.001, 0.3), (0.002, 0.5), (0.01, 0.25)] {
        let model = rail_arm();
        let all: Vec<usize> = (0..model.nv()).collect();
        let settings = Settings { braking: Braking::Certified, ..Settings::new(dt, 1) };
        let mut projector = Projector::new(&model, &joints(4.0, None), &all, settings).unwrap();
        let (mut raw, mut target) = (Proposal::new(&model), Target::new(&model));
        let (mut q, mut v) = (middle(&model), vec![0.0; model.nv()]);
        q[0] = -0.9;
        let mut run = |projector: &mut Projector, count: usize| {
            let mut ticks = 0;
            for _ in 0..count {
                raw.q.clone_from(&q);
                raw.v.fill(0.0);
                (raw.q[0], raw.v[0]) = (q[0] + 5.0 * dt, 5.0);
                let status = projector.project(&q, &v, &raw, &mut target);
                assert_eq!(target.ledger.target_violations.total(), 0);
                (q, v) = (target.q.clone(), target.v.clone());
                ticks += usize::from(status == Status::Tightening);
            }
            let held = target.ledger.active.iter().any(|row| row.row == 0 && row.kind == Kind::Velocity);
            (v[0], ticks, held)
        };
        let top = model.velocity_limit()[0];
        assert_eq!(run(&mut projector, (0.4 / dt) as usize), (top, 0, true));
        projector.move_limits(&Moved::speed(share)).unwrap();
        let best = ((top - share * top) / (4.0 * dt) - 1e-9).ceil() as usize;
        let (reached, took, _) = run(&mut projector, best);
        assert!((reached - share * top).abs() < 1e-12 && took == best, "{reached} in {took} of {best} ticks");
        let (_, late, held) = run(&mut projector, 5);
        assert!(late == 0 && held, "{late} {held}: a moved limit is reported as any other");
        projector.move_limits(&moved()).unwrap();
        assert!(run(&mut projector, best).0 > share * top);
    }
}

#[test]
fn what_was_built_is_not_loosened_and_what_is_unknown_is_named() {
    let model = small_arm();
    let all: Vec<usize> = (0..6).collect();
    let mut limits = joints(10.0, Some(0.6));
    limits.push(Box::new(FrameSpeedLimit::of("tool", 0.8)));
    limits.push(Box::new(FrameLimit::inside("tool", [-1.0; 3], [1.0, 1.0, 0.5], 3.0)));
    let mut projector = Projector::new(&model, &limits, &all, Settings::new(0.001, 1)).unwrap();
    let one = |name: &str, value: f64| Some(PerJoint::Joints([(name.to_string(), value)].into()));
    let named = |name: &str, value: f64| [(name.to_string(), value)].into();
    let before = projector.moved().to_vec();
    let plane =
        |name: &str, normal| [(name.to_string(), limit::HalfSpace { normal, through: [0.0; 3] })].into();
    let nowhere = limit::Pose { position: [0.0; 3], rpy: [0.0; 3] };
    let load = description::Payload { frame: "tool".into(), mass: 1.5, com: [0.0; 3], inertia: [0.0; 6] };
    let cases = [
        (Moved::speed(1.5), vec!["speed", "1.5", "at most 1"]),
        (Moved::speed(f64::NAN), vec!["speed"]),
        (Moved { velocity: one("j2", 7.0), ..moved() }, vec!["velocity 7", "'j2'", "3.1", "rad/s"]),
        (Moved { velocity: one("j9", 1.0), ..moved() }, vec!["'j9'"]),
        (Moved { upper: one("j2", 3.5), ..moved() }, vec!["upper 3.5", "'j2'", "2.9", "rad"]),
        (
            Moved { lower: one("j2", 2.0), upper: one("j2", 1.0), ..moved() },
            vec!["'j2'", "above 2", "below 1"],
        ),
        (Moved { acceleration: one("j2", 11.0), ..moved() }, vec!["acceleration 11", "'j2'", "10"]),
        (Moved { acceleration: one("j2", f64::INFINITY), ..moved() }, vec!["acceleration", "'j2'"]),
        (Moved { frame: named("tool", 0.9), ..moved() }, vec!["0.9 m", "'tool'", "0.75"]),
        (Moved { frame: named("tol", 0.1), ..moved() }, vec!["'tol'", "tool"]),
        (Moved { frame_speed: named("tool", 0.9), ..moved() }, vec!["frame_speed 0.9 m/s", "'tool'", "0.8"]),
        (Moved { energy: Some(1.0), ..moved() }, vec!["energy"]),
        (Moved { plane: plane("tool", [0.0; 3]), ..moved() }, vec!["'tool'"]),
        (Moved { body: [("post".to_string(), nowhere)].into(), ..moved() }, vec!["'post'"]),
        (Moved { payload: Some(load), ..moved() }, vec!["payload of 1.5 kg", "nearl limits"]),
    ];
    for (moved, words) in cases {
        let error = projector.move_limits(&moved).unwrap_err().to_string();
        assert!(words.iter().all(|word| error.contains(word)), "{error}: {words:?}");
        assert_eq!(projector.moved(), before);
    }
    let certified = Settings { braking: Braking::Certified, ..Settings::new(0.001, 1) };
    let mut projector = Projector::new(&model, &limits, &all, certified).unwrap();
    let error = projector.move_limits(&Moved::speed(0.5)).unwrap_err().to_string();
    assert!(error.contains("frame_speed 'tool'") && error.contains("stored"), "{error}");
}

/// A payload is what a link of the URDF is that hangs fixed in the same place.
#[test]
fn a_payload_weighs_what_a_fixed_link_does() {
    let (x, y, z, roll, yaw) = (0.03, -0.02, 0.11, 0.4, -0.7);
    let inertia = [0.004, 0.0003, -0.0002, 0.005, 0.0001, 0.006];
    let [xx, xy, xz, yy, yz, zz] = inertia;
    let text = crate::common::arms::small_arm_text(0.0);
    // Where the tool is, turned, so that the axes of payload and body differ.
    let tool = "<origin xyz=\"0.1 0 0\"/></joint></robot>";
    assert!(text.contains(tool));
    let turned = format!("<origin xyz=\"0.1 0 0\" rpy=\"{roll} 0 {yaw}\"/></joint>");
    let held = format!(
        "<link name=\"load\"><inertial><origin xyz=\"{x} {y} {z}\"/><mass value=\"1.7\"/><inertia ixx=\"{xx}\" ixy=\"{xy}\" \
         ixz=\"{xz}\" iyy=\"{yy}\" iyz=\"{yz}\" izz=\"{zz}\"/></inertial></link><joint name=\"hold\" type=\"fixed\">\
         <parent link=\"tool\"/><child link=\"load\"/></joint></robot>"
    );
    let bare = Model::from_urdf_text(&text.replace(tool, &format!("{turned}</robot>"))).unwrap();
    let loaded = Model::from_urdf_text(&text.replace(tool, &format!("{turned}{held}"))).unwrap();
    let payload = description::Payload { frame: "tool".into(), mass: 1.7, com: [x, y, z], inertia };
    let carrying = bare.with_payload(&payload).unwrap();
    let (mut one, mut other, mut random) = (Dynamics::new(&loaded), Dynamics::new(&carrying), Random(3));
    let (mut tau, mut same, mut less) = ([0.0; 6], [0.0; 6], [0.0; 6]);
    for _ in 0..200 {
        let mut draw = || std::array::from_fn::<f64, 6, _>(|_| random.between(-2.0, 2.0));
        let (q, v, a) = (draw(), draw(), draw());
        one.rnea(&q, &v, &a, &mut tau);
        other.rnea(&q, &v, &a, &mut same);
        Dynamics::new(&bare).rnea(&q, &v, &a, &mut less);
        for i in 0..6 {
            assert!((tau[i] - same[i]).abs() < 1e-10 * tau[i].abs().max(1.0), "{i}: {tau:?} {same:?}");
        }
        assert!((0..6).any(|i| (tau[i] - less[i]).abs() > 0.1));
    }
    let of = |frame: &str, mass: f64, inertia: [f64; 6]| {
        let payload = description::Payload { frame: frame.into(), mass, com: [0.0; 3], inertia };
        bare.with_payload(&payload).err().map(|e| e.to_string())
    };
    let wrong = |frame: &str, mass: f64| of(frame, mass, [0.0; 6]).unwrap();
    // The moments of a ball in the wrong order, moments below 0, and one beyond the sum of the others.
    for no_body in
        [[0.1, 0.1, 0.1, 0.0, 0.0, 0.0], [-0.1, 0.0, 0.0, -0.1, 0.0, -0.1], [0.3, 0.0, 0.0, 0.1, 0.0, 0.1]]
    {
        let said = of("tool", 1.0, no_body).expect("no body has it");
        assert!(said.contains("is that of no body") && said.contains("xx, xy, xz, yy, yz, zz"), "{said}");
    }
    assert_eq!(of("tool", 1.0, [0.1, 0.0, 0.0, 0.1, 0.0, 0.1]), None, "a ball");
    assert_eq!(of("tool", 1.0, [0.1, 0.0, 0.0, 0.1, 0.0, 0.0]), None, "a rod");
    assert!(wrong("tol", 1.0).contains("no frame 'tol'") && wrong("tol", 1.0).contains("tool"));
    assert!(wrong("tool", -1.0).contains("mass -1 kg") && wrong("tool", f64::NAN).contains("NaN"));
    assert!(wrong("base", 1.0).contains("'base' is fixed to the world"), "{}", wrong("base", 1.0));
}

/// After limits have moved, a tick that claims the nearest allowed state names what holds every joint back that does not do as proposed.
#[test]
fn a_joint_that_moved_limits_hold_back_is_named_in_every_tick_that_claims_the_nearest() {
    let joints = [0, 1, 2, 3, 4, 5, 6];
    for (braking, sub_steps) in
        [(Braking::Auto, 1), (Braking::Stored, 0), (Braking::Stored, 5), (Braking::Certified, 1)]
    {
        let (mut claims, mut ways) = (0, 0);
        for seed in 0..4 {
            let mut limits = panda_limits(Some(1.0));
            limits[2] =
                Box::new(AccelerationLimit::new(limit::AccelerationSettings::of(PerJoint::All(8.0), None)));
            let settings = Settings { braking, ..Settings::new(0.004, sub_steps) };
            let mut projector = Projector::new(&panda(), &limits, &joints, settings).unwrap();
            let mut random = Random(seed);
            let (mut q, mut v) = (vec![0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], vec![0.0; 7]);
            let (mut side, mut target) = ([1.0; 7], Target::new(&panda()));
            for tick in 0..6000 {
                if tick % 60 == 0 {
                    let elbow = random.between(-2.5, -0.2);
                    let wrist = random.between(1.0, 3.0);
                    let upper = [("panda_joint4".to_string(), elbow), ("panda_joint6".to_string(), wrist)];
                    let moved = Moved {
                        upper: Some(PerJoint::Joints(upper.into_iter().collect())),
                        ..Moved::speed(random.between(0.2, 1.0))
                    };
                    let moved = if random.next() < 0.7 { moved } else { Moved::default() };
                    let _ = projector.move_limits(&moved);
                }
                if random.next() < 0.03 {
                    side = std::array::from_fn(|_| if random.next() < 0.5 { -1.0 } else { 1.0 });
                }
                let raw = Proposal {
                    q: (0..7).map(|i| q[i] + 10.0 * side[i]).collect(),
                    v: side.iter().map(|s| 100.0 * s).collect(),
                };
                let status = projector.project(&q, &v, &raw, &mut target);
                let ledger = &target.ledger;
                ways += usize::from(status == Status::Tightening);
                let coupled = ledger.active.iter().any(|row| row.row >= 7);
                if matches!(status, Status::Clamped | Status::Solved) && !coupled {
                    claims += 1;
                    for i in 0..7 {
                        let named = ledger.active.iter().any(|row| row.row == i && row.multiplier > 0.0);
                        assert!(
                            named,
                            "{braking:?} {seed} {tick}: joint {i} {} -> {}: {ledger:?}",
                            v[i], target.v[i]
                        );
                    }
                }
                (q, v) = (target.q.clone(), target.v.clone());
            }
        }
        println!("{braking:?}, {sub_steps} steps: {claims} claims, {ways} ticks on the way");
        assert!(claims > 3000 && ways > 100, "{claims} {ways}");
    }
}

/// A moved limit of all joints together, once it is kept, is an ordinary one: no tick is on the way to it, and a robot that is to stand still does.
#[test]
fn a_moved_speed_or_energy_is_left_again_as_it_is_proposed() {
    for (name, model) in [("small", small_arm()), ("rail", rail_arm())] {
        for (sub_steps, dt) in [(0, 0.001), (1, 0.002), (5, 0.01)] {
            for share in [0.3, 0.9] {
                let mut limits = joints(10.0, None);
                limits.push(Box::new(FrameSpeedLimit::of("tool", 0.8)));
                limits.push(Box::new(EnergyLimit::of(4.0)));
                let all: Vec<usize> = (0..model.nv()).collect();
                let mut projector =
                    Projector::new(&model, &limits, &all, Settings::new(dt, sub_steps)).unwrap();
                projector.move_limits(&Moved::speed(share)).unwrap();
                let (mut raw, mut target) = (Proposal::new(&model), Target::new(&model));
                let (mut q, mut v) = (middle(&model), vec![0.0; model.nv()]);
                let mut random = Random(5);
                let mut wish = v.clone();
                let (mut held, mut followed) = (0, 0);
                let phase = (0.6 / dt) as usize; // long enough to stop in
                for tick in 0..20 * phase {
                    if tick % phase == 0 {
                        wish.iter_mut().for_each(|w| *w = random.between(-4.0, 4.0));
                        // The other half of the time it shall stand still.
                        if tick % (2 * phase) == 0 {
                            wish.fill(0.0);
                        }
                    }
                    for i in 0..model.nv() {
                        // Never faster away from where it is than the joints can be slowed down.
                        raw.v[i] = wish[i].clamp(v[i] - 9.0 * dt, v[i] + 9.0 * dt);
                        raw.q[i] = q[i] + dt * (0.5 * raw.v[i] + 0.5 * v[i]);
                    }
                    let status = projector.project(&q, &v, &raw, &mut target);
                    assert_eq!(target.ledger.target_violations.total(), 0, "{name}, tick {tick}: {status:?}");
                    assert!(
                        status != Status::Tightening && status.is_ok(),
                        "{name} {share} {dt}, tick {tick}: {status:?} {:?}",
                        target.ledger
                    );
                    held += usize::from(target.ledger.active.iter().any(|row| row.row >= model.nv()));
                    let is_still = target.v.iter().all(|v| v.abs() < 1e-9);
                    followed += usize::from(tick % (2 * phase) == phase - 1 && is_still);
                    (q, v) = (target.q.clone(), target.v.clone());
                }
                assert!(held > 5, "{name} {share} {dt}: held in {held} ticks alone");
                assert_eq!(followed, 10, "{name} {share} {dt}: it did not stand still as it was proposed");
            }
        }
    }
}
