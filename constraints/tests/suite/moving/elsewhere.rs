//! Planes, bodies, frames and energy that are attacked while their limits move.

use nearl_constraints::*;

use super::{joints, middle, moved};
use crate::common::arms::{rail_arm, small_arm};
use crate::common::*;

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
