//! Hard jerk of one joint. In closed loop no limit is exceeded. The box holds all that a brake of bounded jerk can keep, which another, slower brake
//! shows; and it lies inside the largest set that any motion can keep, which Clarabel finds.

use crate::common::*;
use clarabel::algebra::CscMatrix;
use clarabel::solver::{DefaultSettingsBuilder, DefaultSolver, IPSolver, SolverStatus, SupportedConeT};
use nearl_constraints::jerk::interval;
use nearl_constraints::viability::Dof;
use nearl_constraints::*;

const PERIODS: [f64; 4] = [0.001, 0.002, 0.01, 0.02];
const SUB_STEPS: [u32; 3] = [0, 1, 5];

fn any_dof(random: &mut Random) -> Dof {
    let half = 10f64.powf(random.between(-2.0, 0.6));
    let a = 10f64.powf(random.between(0.0, 2.0));
    Dof {
        lower: -half,
        upper: half,
        velocity: 10f64.powf(random.between(-1.0, 1.0)),
        acceleration: a,
        deceleration: a * random.between(0.2, 1.5).min(1.0),
        jerk: a * 10f64.powf(random.between(0.0, 2.5)),
        ..Dof::FREE
    }
}

/// A joint in closed loop that presses against one side for a while, asks for anything now and then, and what that came to.
struct Joint {
    q: f64,
    v: f64,
    before: f64,
    side: f64,
    /// Largest excess of position [rad]; of velocity, acceleration and jerk as shares.
    worst: [f64; 4],
}

impl Joint {
    fn new() -> Joint {
        Joint { q: 0.0, v: 0.0, before: 0.0, side: 1.0, worst: [f64::NEG_INFINITY; 4] }
    }

    fn wish(&mut self, dof: &Dof, random: &mut Random) -> f64 {
        if random.next() < 0.01 {
            self.side = -self.side;
        }
        let a = dof.acceleration;
        if random.next() < 0.8 { 1e9 * self.side } else { random.between(-a, a) }
    }

    fn go(&mut self, dof: &Dof, a: f64, p: &Period) {
        let was = self.v;
        let (low, high);
        (self.q, self.v, low, high) = advance(self.q, self.v, a, p);
        let reached = (self.v - was) / p.dt;
        let seen = [
            (high - dof.upper).max(dof.lower - low),
            self.v.abs() / dof.velocity - 1.0,
            reached.abs() / dof.acceleration - 1.0,
            (reached - self.before).abs() / (dof.jerk * p.dt) - 1.0,
        ];
        (0..4).for_each(|k| self.worst[k] = self.worst[k].max(seen[k]));
        self.before = reached;
    }
}

#[test]
fn position_velocity_acceleration_and_jerk_of_a_joint_hold_at_once() {
    let mut random = Random(5);
    let (mut ticks, mut at_the_limit) = (0, 0);
    for case in 0..480 {
        let p = Period::new(PERIODS[case % 4], SUB_STEPS[case / 4 % 3]);
        let (dof, mut joint) = (any_dof(&mut random), Joint::new());
        for _ in 0..1000 {
            let x = interval(&dof, joint.q, joint.v, Some(joint.before), &p);
            assert!(x.outside.is_none() && x.lower <= x.upper, "{x:?}, {dof:?}, {p:?}");
            let wish = joint.wish(&dof, &mut random);
            at_the_limit += usize::from(wish > x.upper && x.upper_kind == Kind::Viability);
            joint.go(&dof, wish.clamp(x.lower, x.upper), &p);
            ticks += 1;
        }
        assert!(joint.worst.iter().all(|worst| *worst < 1e-9), "{:?}, {dof:?}, {p:?}", joint.worst);
    }
    assert!(at_the_limit > ticks / 50, "{at_the_limit} of {ticks}: this shows nothing");
}

/// The largest excess of a joint that brakes tick by tick: as hard as it may so that the deceleration still falls to zero before the joint
/// turns round, which is tried.
fn brakes(dof: &Dof, (mut q, mut v, mut a): (f64, f64, f64), p: &Period) -> f64 {
    let (step, most) = (dof.jerk * p.dt, dof.deceleration.min(dof.acceleration));
    let falls = |from: f64| {
        let (mut speed, mut left) = (0.0, from);
        while left > 0.0 {
            (speed, left) = (speed + p.dt * left, left - step);
        }
        speed
    };
    let mut worst = f64::NEG_INFINITY;
    loop {
        let (mut low, mut high) = (0.0, most);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            *(if falls(middle) <= v.abs() { &mut low } else { &mut high }) = middle;
        }
        a = (-low * v.signum()).clamp(a - step, a + step);
        let (least, furthest);
        (q, v, least, furthest) = advance(q, v, a, p);
        let beyond = (furthest - dof.upper).max(dof.lower - least).max(v.abs() - dof.velocity);
        worst = worst.max(beyond).max(a.abs() - dof.acceleration);
        if v.abs() < 1e-12 && a.abs() <= step {
            return worst;
        }
    }
}

#[test]
fn the_box_holds_what_the_brake_keeps_and_nothing_else() {
    let mut random = Random(6);
    let (mut inside, mut outside) = (0, 0);
    for case in 0..240 {
        let p = Period::new(PERIODS[2 + case % 2], SUB_STEPS[case / 2 % 3]);
        let (dof, mut joint) = (any_dof(&mut random), Joint::new());
        for tick in 0..600 {
            let x = interval(&dof, joint.q, joint.v, Some(joint.before), &p);
            let step = dof.jerk * p.dt;
            let low = (joint.before - step).max(-dof.acceleration);
            let high = (joint.before + step).min(dof.acceleration);
            for k in (0..11).filter(|_| tick % 60 == 59) {
                let a =
                    [x.lower, x.upper].get(k).copied().unwrap_or(low + (high - low) * (k as f64 - 2.0) / 8.0);
                let (q, v, least, furthest) = advance(joint.q, joint.v, a, &p);
                let now = (furthest - dof.upper).max(dof.lower - least).max(v.abs() - dof.velocity);
                let excess = now.max(brakes(&dof, (q, v, a), &p));
                if a >= x.lower && a <= x.upper {
                    assert!(excess < 1e-9, "{a} in {x:?} breaks by {excess:e}: {dof:?} {p:?}");
                    inside += 1;
                } else if (x.lower - a).max(a - x.upper) > 1e-6 * dof.acceleration {
                    assert!(excess > -1e-9, "{a} outside {x:?} keeps {excess:e}: {dof:?} {p:?}");
                    outside += 1;
                }
            }
            let wish = joint.wish(&dof, &mut random);
            joint.go(&dof, wish.clamp(x.lower, x.upper), &p);
        }
    }
    assert!(inside > 5000 && outside > 2000, "{inside} {outside}: this shows nothing");
}

/// The largest first acceleration of any motion of `n` periods from the state to rest that keeps the limits, positions at the ends of
/// periods alone; `side` -1: less the lowest.
fn largest(dof: &Dof, (q, v, before): (f64, f64, f64), p: &Period, n: usize, side: f64) -> f64 {
    let (mut columns, mut right, step) = (vec![Vec::new(); n], Vec::new(), dof.jerk * p.dt);
    let mut row = |of: &dyn Fn(usize) -> f64, at_most: f64| {
        let size = (0..n).fold(0.0, |size: f64, k| size.max(of(k).abs()));
        (0..n).filter(|k| of(*k) != 0.0).for_each(|k| columns[k].push((right.len(), of(k) / size)));
        right.push(at_most / size);
    };
    let unit = |k: usize, j: usize| f64::from(u8::from(k == j));
    row(&|_| p.dt, -v); // at rest in the end
    row(&|k| unit(k, n - 1), 0.0);
    for j in 0..n {
        for s in [1.0, -1.0] {
            row(&|k| s * unit(k, j), dof.acceleration);
            row(&|k| s * p.dt * f64::from(u8::from(k <= j)), dof.velocity - s * v);
            let first = if j == 0 { before } else { 0.0 };
            row(&|k| s * (unit(k, j) - if j > 0 { unit(k, j - 1) } else { 0.0 }), step + s * first);
            let room = if s > 0.0 { dof.upper - q } else { q - dof.lower };
            let ways = |k: usize| if k <= j { (j - k) as f64 + p.kappa } else { 0.0 };
            row(&|k| s * p.dt * p.dt * ways(k), room - s * (j as f64 + 1.0) * p.dt * v);
        }
    }
    let (mut starts, mut rows, mut values) = (vec![0], Vec::new(), Vec::new());
    for column in &columns {
        column.iter().for_each(|(r, x)| (rows.push(*r), values.push(*x)).1);
        starts.push(rows.len());
    }
    let g = CscMatrix::new(right.len(), n, starts, rows, values);
    let cones = [SupportedConeT::ZeroConeT(2), SupportedConeT::NonnegativeConeT(right.len() - 2)];
    let mut goal = vec![0.0; n];
    goal[0] = -side;
    let settings = DefaultSettingsBuilder::default().verbose(false).build().unwrap();
    let mut solver =
        DefaultSolver::new(&CscMatrix::zeros((n, n)), &goal, &g, &right, &cones, settings).unwrap();
    solver.solve();
    assert_eq!(solver.solution.status, SolverStatus::Solved);
    side * solver.solution.x[0]
}

/// What no motion at all can keep is not allowed, and little of what some motion can keep is left out.
#[test]
fn the_box_lies_in_the_largest_set_that_can_be_kept() {
    let (mut random, mut ends, mut gap, mut moved) = (Random(7), 0, 0.0, [0.0f64; 2]);
    for case in 0..12 {
        let p = Period::new(0.02, SUB_STEPS[case % 3]);
        let dof = Dof {
            lower: -0.8,
            upper: 0.6,
            velocity: random.between(0.8, 2.5),
            acceleration: 10.0,
            deceleration: 10.0,
            jerk: random.between(60.0, 400.0),
            ..Dof::FREE
        };
        let mut joint = Joint::new();
        for tick in 0..150 {
            let x = interval(&dof, joint.q, joint.v, Some(joint.before), &p);
            let wish = joint.wish(&dof, &mut random);
            let a = wish.clamp(x.lower, x.upper);
            let kind = if wish > a { x.upper_kind } else { x.lower_kind };
            if a != wish && tick % 4 == 0 {
                let side = (wish - a).signum();
                let best = match kind {
                    Kind::Viability | Kind::Velocity => {
                        largest(&dof, (joint.q, joint.v, joint.before), &p, 50, side)
                    }
                    _ => side * a,
                };
                let more = (best - side * a) / (dof.jerk * p.dt);
                assert!(more > -1e-5, "{a} is {more:e} steps beyond {best}: {x:?}");
                (ends, gap) = (ends + 1, gap + more.max(0.0));
                let far = wish.clamp(-dof.acceleration, dof.acceleration);
                moved = [moved[0] + (far - a).abs(), moved[1] + (far - side * best).abs()];
            }
            joint.go(&dof, a, &p);
        }
    }
    let (gap, further) = (gap / f64::from(ends), 100.0 * (moved[0] / moved[1] - 1.0));
    println!(
        "{ends} ends: {gap:.3} of a step of acceleration inside the largest set; {further:.2} % further from the proposal"
    );
    assert!(ends > 200 && further < 5.0, "{ends} {further}");
}

/// Panda's limits of joints with a hard jerk, and a projector of them.
fn panda_with_jerk(
    jerk: f64,
    more: Vec<Box<dyn Limit>>,
    settings: Settings,
) -> Result<Projector, LimitError> {
    let mut limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::default()),
        Box::new(AccelerationLimit::uniform(10.0)),
        Box::new(JerkLimit::hard(jerk)),
    ];
    limits.extend(more);
    Projector::new(&panda(), &limits, &[0, 1, 2, 3, 4, 5, 6], settings)
}

/// A robot that starts too fast, beyond a limit, and unaccelerated for all anybody knows comes back with its jerk.
#[test]
fn from_outside_a_joint_comes_back_with_bounded_jerk() {
    for (dt, sub_steps) in [(0.001, 1), (0.002, 0), (0.01, 5)] {
        let mut projector = panda_with_jerk(300.0, Vec::new(), Settings::new(dt, sub_steps)).unwrap();
        let model = panda();
        let (mut raw, mut target) = (Proposal::new(&model), Target::new(&model));
        let mut q: Vec<f64> = (0..7).map(|i| model.upper_position_limit()[i] + 0.02).collect();
        let (mut v, mut before) = (vec![0.3; 7], vec![0.0; 7]);
        v[0] = 1.2 * model.velocity_limit()[0];
        q[0] = 0.0;
        let torque = vec![0.0; 7];
        for tick in 0..(4.0 / dt) as usize {
            for i in 0..7 {
                raw.v[i] = if tick % 2 == 0 && tick < 300 { 3.0 } else { -0.2 };
                raw.q[i] = q[i] + dt * raw.v[i];
            }
            projector.set_previous(Some(row::Previous { acceleration: &before, torque: &torque }));
            let status = projector.project(&q, &v, &raw, &mut target);
            assert!(
                tick > 0 || (status == Status::Recovering && target.ledger.outside == [0, 1, 2, 3, 4, 5, 6])
            );
            for i in 0..7 {
                let jerk = (target.acceleration[i] - before[i]).abs() / dt;
                assert!(jerk <= 300.0 * (1.0 + 1e-9), "tick {tick}, joint {i}: {jerk} rad/s³");
                assert!(target.acceleration[i].abs() <= 10.0 * (1.0 + 1e-9), "tick {tick}, joint {i}");
            }
            (q, v, before) = (target.q.clone(), target.v.clone(), target.acceleration.clone());
        }
        for i in 0..7 {
            assert!(q[i] <= model.upper_position_limit()[i] + 1e-9, "joint {i} stays at {} ({dt})", q[i]);
            assert!(v[i].abs() <= model.velocity_limit()[i], "joint {i}: {}", v[i]);
        }
    }
}

/// To come nearest to standing in each tick would swing about it.
#[test]
fn a_joint_that_is_to_stand_stands() {
    let mut projector = panda_with_jerk(100.0, Vec::new(), Settings::new(0.001, 1)).unwrap();
    let model = panda();
    let (mut raw, mut target) = (Proposal::new(&model), Target::new(&model));
    let mut q: Vec<f64> =
        (0..7).map(|i| 0.5 * (model.lower_position_limit()[i] + model.upper_position_limit()[i])).collect();
    let mut v: Vec<f64> = (0..7).map(|i| 0.1 * f64::from(i)).collect();
    for _ in 0..1000 {
        for i in 0..7 {
            raw.v[i] = projector.rest(i, v[i]);
            raw.q[i] = q[i] + 0.001 * raw.v[i];
        }
        projector.project(&q, &v, &raw, &mut target);
        projector.remember(&target);
        (q, v) = (target.q.clone(), target.v.clone());
    }
    assert!(v.iter().all(|v| v.abs() < 1e-12) && target.acceleration.iter().all(|a| a.abs() < 1e-9), "{v:?}");
}

/// Of a jerk so small that a brake has more periods than there are numbers the search for its end had none.
#[test]
fn a_tick_ends_however_small_the_jerk_is() {
    for jerk in [1e-300, 1e-18, 1e-12, 1e300] {
        let mut projector = panda_with_jerk(jerk, Vec::new(), Settings::new(0.01, 1)).unwrap();
        let model = panda();
        let (q, v) = (vec![0.0, -0.5, 0.0, -1.5, 0.0, 1.5, 0.0], vec![0.1; 7]);
        let (raw, mut target) = (Proposal { q: q.clone(), v: vec![1.0; 7] }, Target::new(&model));
        for _ in 0..2 {
            projector.project(&q, &v, &raw, &mut target);
            projector.remember(&target);
            assert!(target.q.iter().chain(&target.v).all(|x| x.is_finite()), "{jerk}: {target:?}");
        }
    }
}

#[test]
fn what_hard_jerk_is_not_kept_with_is_refused_by_name() {
    let said = |result: Result<Projector, LimitError>| result.err().expect("it was accepted").to_string();
    let profile = VelocityProfileLimit::new(limit::VelocityProfileSettings::Joints(
        [(
            "panda_joint2".to_string(),
            limit::JointProfile {
                limit: 1.0,
                offset: 0.0,
                squared: 4.0,
                lower: -1.5,
                upper: 1.5,
                margin: 0.0,
            },
        )]
        .into(),
    ));
    let text = said(panda_with_jerk(300.0, vec![Box::new(profile)], Settings::new(0.001, 1)));
    assert!(
        text.contains("hard jerk of 'panda_joint2' is not kept together with a velocity profile"),
        "{text}"
    );
    let free = Settings { consistency: Consistency::Free, ..Settings::new(0.001, 1) };
    let text = said(panda_with_jerk(300.0, Vec::new(), free));
    assert!(text.contains("does not exist in free mode"), "{text}");
    let alone: [Box<dyn Limit>; 1] = [Box::new(JerkLimit::hard(300.0))];
    let text = said(Projector::new(&panda(), &alone, &[0, 3], Settings::new(0.001, 1)));
    assert!(text.contains("hard jerk of 'panda_joint1', 'panda_joint4' has no acceleration limit"), "{text}");
    let mut moves = panda_with_jerk(300.0, Vec::new(), Settings::new(0.001, 1)).unwrap();
    let slower = Moved { acceleration: Some(PerJoint::All(2.0)), ..Moved::default() };
    let text = moves.move_limits(&slower).unwrap_err().to_string();
    assert!(text.contains("acceleration of joint 'panda_joint1' is moved while its jerk is hard"), "{text}");
    let both = "{ \"limit\": 1.0, \"hard\": true, \"soft\": { \"linear\": 1.0 } }";
    let text = serde_json::from_str::<limit::JerkSettings>(both).unwrap_err().to_string();
    assert!(text.contains("drop hard or soft"), "{text}");
    for settings in
        ["{\"limit\":1.0,\"hard\":true}", "{\"limit\":1.0,\"soft\":{\"linear\":1.0,\"quadratic\":100.0}}"]
    {
        let read: limit::JerkSettings = serde_json::from_str(settings).unwrap();
        assert_eq!(serde_json::to_string(&read).unwrap(), settings);
    }
}

/// What is told of the tick before is no number, or more than the joint can do.
#[test]
fn a_tick_before_that_cannot_have_been_is_refused_or_counts_as_the_limit() {
    let (model, dt, most, jerk) = (panda(), 0.004, 8.0, 300.0);
    let limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::scaled(1.0)),
        Box::new(AccelerationLimit::new(limit::AccelerationSettings::of(PerJoint::All(most), None))),
        Box::new(JerkLimit::hard(jerk)),
    ];
    let q = [0.1, -0.4, 0.2, -1.8, 0.1, 1.9, 0.3];
    let v = [0.5; 7];
    let still = Proposal { q: q.to_vec(), v: vec![0.0; 7] };
    let mut target = Target::new(&model);
    for (before, torque) in [(f64::NAN, 0.0), (f64::INFINITY, 0.0), (0.0, f64::NAN), (f64::NEG_INFINITY, 0.0)]
    {
        let mut projector =
            Projector::new(&model, &limits, &[0, 1, 2, 3, 4, 5, 6], Settings::new(dt, 1)).unwrap();
        projector.set_previous(Some(row::Previous { acceleration: &[before; 7], torque: &[torque; 7] }));
        let status = projector.project(&q, &v, &still, &mut target);
        assert_eq!(status, Status::Refused(RefuseReason::NonFiniteState), "{before} {torque}");
        assert!(target.v.iter().all(|v| *v == 0.0) && status.reason().unwrap().contains("the tick before"));
        projector.set_previous(None);
        assert!(projector.project(&q, &v, &still, &mut target).is_ok());
    }
    for before in [1e300, 100.0, 9.0, 8.0] {
        let mut projector =
            Projector::new(&model, &limits, &[0, 1, 2, 3, 4, 5, 6], Settings::new(dt, 1)).unwrap();
        projector.set_previous(Some(row::Previous { acceleration: &[before; 7], torque: &[0.0; 7] }));
        let status = projector.project(&q, &v, &still, &mut target);
        for (i, v1) in target.v.iter().enumerate() {
            let a = (v1 - v[i]) / dt;
            // The least that a joint at its limit may go on with.
            assert!((a - (most - jerk * dt)).abs() < 1e-9, "{before}: joint {i} at {a} rad/s², {status:?}");
        }
        assert!(status.is_ok(), "{before}: {status:?}");
    }
}

#[test]
fn forces_from_outside_that_are_no_numbers_are_refused_by_joint() {
    let mut projector = panda_projector(Some(1.0), Settings::new(0.004, 1));
    projector.set_external_forces(&[1.0; 7]).unwrap();
    for wrong in [f64::NAN, f64::INFINITY] {
        let mut forces = [0.0; 7];
        forces[2] = wrong;
        let said = projector.set_external_forces(&forces).unwrap_err().to_string();
        assert!(said.contains("external force on 'panda_joint3'") && said.contains("finite"), "{said}");
        assert_eq!(projector.external_forces(), [1.0; 7]);
    }
}
