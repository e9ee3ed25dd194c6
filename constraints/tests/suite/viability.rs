//! Closed loop against an adversarial policy: the box is never empty and no position, sub-step positions included, is
//! beyond its limit.

use crate::common::Random;
use nearl_constraints::viability::{Dof, Period, interval};
use nearl_constraints::{
    AccelerationLimit, Limit, Model, PositionLimit, Projector, Proposal, Settings, Target, VelocityLimit,
};
use std::path::Path;

/// A period at acceleration `a`, as [`common::advance`](crate::common::advance) makes it; the extremes count the state before too.
fn advance(q: f64, v: f64, a: f64, p: &Period) -> (f64, f64, f64, f64) {
    let (x, w, low, high) = crate::common::advance(q, v, a, p);
    (x, w, low.min(q), high.max(q))
}

/// Runs `steps` periods on one dof: presses against one side most of the time, changes its mind now and then, asks for
/// random accelerations otherwise. Returns (states outside the set, largest violation).
fn attack(dof: &Dof, p: &Period, steps: usize, random: &mut Random) -> (usize, f64) {
    let (mut q, mut v, mut side) = (0.5 * (dof.lower + dof.upper), 0.0, 1.0);
    let (mut outside, mut violation) = (0, 0.0f64);
    for _ in 0..steps {
        let i = interval(dof, q, v, p);
        assert!(i.lower <= i.upper && i.lower.is_finite() && i.upper.is_finite());
        outside += usize::from(i.outside.is_some());
        if random.next() < 0.02 {
            side = if random.next() < 0.5 { -1.0 } else { 1.0 };
        }
        let a_max = dof.acceleration;
        let wish = match random.next() {
            x if x < 0.8 => side * 1e3 * a_max,
            x if x < 0.9 => random.between(-a_max, a_max),
            _ => random.between(i.lower, i.upper),
        };
        let (low, high);
        (q, v, low, high) = advance(q, v, wish.clamp(i.lower, i.upper), p);
        violation = violation.max(high - dof.upper).max(dof.lower - low).max(v.abs() - dof.velocity);
    }
    (outside, violation)
}

const PERIODS: [f64; 3] = [0.001, 0.01, 0.05];
const SUB_STEPS: [u32; 5] = [0, 1, 2, 5, 10];

#[test]
fn one_joint_never_leaves_its_set() {
    let dof =
        Dof { lower: -1.0, upper: 1.0, velocity: 5.0, acceleration: 20.0, deceleration: 20.0, ..Dof::FREE };
    for dt in PERIODS {
        for n in SUB_STEPS {
            let (outside, violation) = attack(&dof, &Period::new(dt, n), 100_000, &mut Random(7));
            println!("T {dt} n {n}: outside {outside}, violation {violation:.1e}");
            assert!(
                outside == 0 && violation <= 1e-9,
                "T {dt}, n {n}: {outside} outside, {violation:e} beyond"
            );
        }
    }
}

/// A joint within the tolerance of its limit that moved on was inside, and got 2e-7 rad beyond it before it stood.
#[test]
fn a_joint_that_cannot_stop_in_front_of_its_limit_is_named() {
    let (mut random, mut named, mut kept) = (Random(13), 0, 0);
    for case in 0..20_000 {
        let p = Period::new(PERIODS[case % 3], SUB_STEPS[case / 3 % 5]);
        let deceleration = 10f64.powf(random.between(0.0, 2.5));
        let (acceleration, whole) = (deceleration * random.between(1.0, 5.0), case % 2 == 0);
        let dof =
            Dof { lower: -1.0, upper: 1.0, velocity: 3.0, acceleration, deceleration, whole, ..Dof::FREE };
        let (mut q, mut v) = (1.0 + random.between(-1e-9, 1e-9), 10f64.powf(random.between(-9.0, -2.5)));
        if interval(&dof, q, v, &p).outside.is_some() {
            named += 1;
            continue;
        }
        kept += 1;
        for _ in 0..300 {
            let (start, high) = ((q, v), &mut 0.0);
            let upper = interval(&dof, q, v, &p).upper;
            (q, v, _, *high) = advance(q, v, upper, &p);
            assert!(*high <= 1.0 + 2e-9, "{high} from {start:?}: {dof:?}, {p:?}");
        }
    }
    assert!(named > 500 && kept > 1000, "{named} {kept}: this shows nothing");
}

#[test]
fn many_joints_never_leave_their_sets() {
    let mut random = Random(11);
    for dt in PERIODS {
        for n in SUB_STEPS {
            for _ in 0..40 {
                let center = random.between(-3.0, 3.0);
                let half = 10f64.powf(random.between(-2.0, 0.6));
                let a_max = 10f64.powf(random.between(0.0, 3.0));
                let dof = Dof {
                    lower: center - half,
                    upper: center + half,
                    velocity: 10f64.powf(random.between(-1.0, 1.3)),
                    acceleration: a_max,
                    deceleration: a_max * random.between(0.1, 1.5).min(1.0),
                    ..Dof::FREE
                };
                let (outside, violation) = attack(&dof, &Period::new(dt, n), 2_500, &mut random);
                assert!(
                    outside == 0 && violation <= 1e-9,
                    "T {dt}, n {n}, {dof:?}: {outside} outside, {violation:e} beyond"
                );
            }
        }
    }
}

/// The whole Panda through its projector, all joints at once, at every period and number of physics steps.
#[test]
fn the_panda_never_leaves_its_set() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/robots/panda/panda.urdf");
    let model = Model::from_urdf(&file).expect("the bundled robot");
    for dt in PERIODS {
        for n in SUB_STEPS {
            let limits: [Box<dyn Limit>; 3] = [
                Box::new(PositionLimit::with_margin(0.0)),
                Box::new(VelocityLimit::scaled(1.0)),
                Box::new(AccelerationLimit::uniform(10.0)),
            ];
            let dofs: Vec<usize> = (0..7).collect();
            let mut projector =
                Projector::new(&model, &limits, &dofs, Settings::new(dt, n)).expect("the Panda's limits");
            let (outside, violation) = attack_robot(&model, &mut projector, &Period::new(dt, n), 100_000);
            assert!(
                outside == 0 && violation <= 1e-9,
                "T {dt}, n {n}: {outside} ticks outside or braked, {violation:e} beyond"
            );
        }
    }
}

/// As [`attack`] on every joint of a robot: (ticks outside the set or without an answer, largest violation).
fn attack_robot(model: &Model, projector: &mut Projector, p: &Period, steps: usize) -> (usize, f64) {
    let (mut random, mut side) = (Random(5), [1.0f64; 7]);
    let (mut proposal, mut target) = (Proposal::new(model), Target::new(model));
    let (lower, upper) = (model.lower_position_limit(), model.upper_position_limit());
    let mut q: Vec<f64> = lower.iter().zip(upper).map(|(l, u)| 0.5 * (l + u)).collect();
    let mut v = vec![0.0; model.nv()];
    let (mut outside, mut violation) = (0, 0.0f64);
    for _ in 0..steps {
        for i in 0..7 {
            if random.next() < 0.02 {
                side[i] = -side[i];
            }
            proposal.q[i] = q[i] + side[i] * random.between(0.0, 3.0);
            proposal.v[i] = side[i] * random.between(0.0, 1e3);
        }
        let status = projector.project(&q, &v, &proposal, &mut target);
        outside += usize::from(
            !status.is_ok()
                || !target.ledger.outside.is_empty()
                || target.ledger.target_violations.total() > 0,
        );
        for i in 0..7 {
            let (low, high);
            (q[i], v[i], low, high) = advance(q[i], v[i], target.acceleration[i], p);
            let speed = v[i].abs() - model.velocity_limit()[i];
            violation = violation.max(high - upper[i]).max(lower[i] - low).max(speed);
        }
    }
    (outside, violation)
}

/// Braking with all there is, from any state the box leads to, stops inside the limits.
#[test]
fn braking_from_any_admissible_state_stops_inside() {
    let mut random = Random(3);
    for dt in PERIODS {
        for n in SUB_STEPS {
            let p = Period::new(dt, n);
            let dof = Dof {
                lower: -0.7,
                upper: 0.4,
                velocity: 4.0,
                acceleration: 15.0,
                deceleration: 15.0,
                ..Dof::FREE
            };
            let (mut q, mut v) = (0.0, 0.0);
            for _ in 0..300 {
                for _ in 0..random.between(1.0, 30.0) as usize {
                    let i = interval(&dof, q, v, &p);
                    let a =
                        if random.next() < 0.7 { 1e9f64.copysign(v) } else { random.between(-15.0, 15.0) };
                    (q, v, _, _) = advance(q, v, a.clamp(i.lower, i.upper), &p);
                }
                let (mut qb, mut vb) = (q, v);
                for _ in 0..(4.0 / 15.0 / dt) as usize + 4 {
                    let i = interval(&dof, qb, vb, &p);
                    let a = nearl_constraints::viability::brake(&dof, vb, &p).clamp(i.lower, i.upper);
                    let (low, high);
                    (qb, vb, low, high) = advance(qb, vb, a, &p);
                    assert!(high <= 0.4 + 1e-9 && low >= -0.7 - 1e-9, "T {dt} n {n}: {low} {high}");
                }
                assert!(
                    vb.abs() < 1e-6 * 4.0 || vb.abs() < 15.0 * dt * 0.5,
                    "T {dt} n {n}: still moving at {vb}"
                );
            }
        }
    }
}
