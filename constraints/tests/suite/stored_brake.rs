//! The stored brake, on a robot for which no deceleration can be certified.

use crate::common::*;
use nearl_constraints::limit::{AccelerationSettings, PositionSettings};
use nearl_constraints::*;

/// Where the stored brake was looked at in few of its ticks, the others asked up to 1.3 % more of a motor than it has; where a
/// proposal was not a number, a brake that nobody had verified was executed, and asked 26 % more.
#[test]
fn no_brake_asks_more_of_a_motor_than_it_has() {
    let model = robot("g1/g1.urdf");
    let (limit, braking) = (PerJoint::All(60.0), Some(PerJoint::All(12.0)));
    let limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::scaled(0.15)),
        Box::new(AccelerationLimit::new(AccelerationSettings::of(limit, braking))),
        Box::new(TorqueLimit::default()),
    ];
    let settings = Settings { braking: Braking::Stored, ..Settings::new(0.001, 1) };
    let mut projector = Projector::new(&model, &limits, &(0..29).collect::<Vec<_>>(), settings).unwrap();
    let (mut raw, mut target) = (Proposal::new(&model), Target::new(&model));
    let (mut braked, mut nonfinite) = (0, 0);
    for seed in 0..4 {
        let mut random = Random(seed);
        let (low, high) = (model.lower_position_limit(), model.upper_position_limit());
        let mut q: Vec<f64> = (0..29).map(|i| 0.5 * (low[i] + high[i])).collect();
        let (mut v, mut side) = (vec![0.0; 29], [0.0; 29]);
        projector.forget();
        for tick in 0..1500 {
            if tick % 250 == 0 {
                side = std::array::from_fn(|_| if random.next() < 0.5 { -1.0 } else { 1.0 });
            }
            for i in 0..29 {
                raw.v[i] = side[i] * model.velocity_limit()[i];
                raw.q[i] = q[i] + 0.001 * raw.v[i];
            }
            if tick % 50 > 40 {
                raw.v[(random.next() * 29.0) as usize] = f64::NAN;
            }
            let status = projector.project(&q, &v, &raw, &mut target);
            braked += u32::from(status == Status::Braked(BrakeReason::NoVerifiedBrake));
            nonfinite += u32::from(status == Status::Braked(BrakeReason::NonFiniteProposal));
            assert_eq!(
                target.ledger.target_violations.total(),
                0,
                "seed {seed}, tick {tick}: {:?}",
                target.ledger
            );
            (q, v) = (target.q.clone(), target.v.clone());
        }
    }
    assert!(braked > 10 && nonfinite > 500, "{braked} {nonfinite}: this run proves nothing");
}

/// A push leads where no brake was verified from, and the one in force then asks motors for more than they may give: cut one by one, they threw the other
/// joints. What the motors may give is kept first, whatever else is broken on the way back.
#[test]
fn no_push_makes_a_brake_ask_more_of_a_motor_than_it_may_give() {
    let model = robot("panda/panda.urdf");
    let all: Vec<usize> = (0..7).collect();
    let (mut braked, mut broken, mut rested) = (0, 0, 0);
    for (dt, sub_steps) in [(0.001, 1), (0.004, 0), (0.01, 5)] {
        for acceleration in [25.0, 3.0] {
            let limits: Vec<Box<dyn Limit>> = vec![
                Box::new(PositionLimit::new(PositionSettings {
                    margin: PerJoint::All(0.01),
                    ..PositionSettings::default()
                })),
                Box::new(VelocityLimit::scaled(0.5)),
                Box::new(AccelerationLimit::new(AccelerationSettings::of(PerJoint::All(acceleration), None))),
                Box::new(TorqueLimit::scaled(0.8)),
            ];
            let settings = Settings { braking: Braking::Stored, ..Settings::new(dt, sub_steps) };
            let mut projector = Projector::new(&model, &limits, &all, settings).unwrap();
            let (mut raw, mut target) = (Proposal::new(&model), Target::new(&model));
            for seed in 0..4 {
                let mut random = Random(seed);
                let mut q = vec![0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8];
                let (mut v, mut wanted) = (vec![0.0; 7], [0.0; 7]);
                projector.forget();
                for tick in 0..1500 {
                    if tick % 20 == 0 {
                        wanted = std::array::from_fn(|_| 6.0 * random.next() - 3.0);
                    }
                    if tick % 25 == 24 && tick < 900 {
                        v.iter_mut().for_each(|v| *v += 3.0 * random.next() - 1.5);
                    }
                    for i in 0..7 {
                        raw.v[i] = if tick < 900 { wanted[i] } else { 0.0 };
                        raw.q[i] = q[i] + dt * raw.v[i];
                    }
                    let status = projector.project(&q, &v, &raw, &mut target);
                    let is_braked = matches!(status, Status::Braked(_));
                    braked += u32::from(is_braked);
                    let counts = &target.ledger.target_violations;
                    broken += u32::from(is_braked && counts.total() > 0);
                    assert_eq!(
                        counts.torque, 0,
                        "{dt}, {sub_steps}, seed {seed}, tick {tick}: {:?}",
                        target.ledger
                    );
                    (q, v) = (target.q.clone(), target.v.clone());
                }
                rested += u32::from(acceleration == 25.0 && v.iter().all(|v| v.abs() < 1e-6));
            }
        }
    }
    println!("{braked} braked, {broken} of them broke something, {rested} of 12 at rest");
    assert!(braked > 100 && broken > 20 && rested > 9, "{braked} {broken} {rested}: this run proves nothing");
}
