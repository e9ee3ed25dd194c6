//! The stored brake, on a robot for which no deceleration can be certified.

use crate::common::*;
use nearl_constraints::limit::AccelerationSettings;
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
