//! Forces of drives whose targets are held over several physics steps, on robots whose mass never changes: hand arithmetic, and the steps by hand.

use nearl_constraints::description::{Body, JointDescription, JointKind, Range};
use nearl_constraints::geometry::Placement;
use nearl_constraints::*;

/// Slides along x, each on the one before, 2 kg each, with these dampers [N s/m] and springs [N/m].
fn slides(own: &[[f64; 2]]) -> Model {
    let body = |(i, [damping, stiffness]): (usize, &[f64; 2])| Body {
        name: format!("b{i}"),
        parent: i.checked_sub(1),
        placement: Placement::IDENTITY,
        mass: 2.0,
        com: [0.0; 3],
        inertia: [0.1, 0.0, 0.0, 0.1, 0.0, 0.1],
        joints: vec![JointDescription {
            axis: [1.0, 0.0, 0.0],
            effort: Some(50.0),
            velocity: Some(5.0),
            damping: *damping,
            stiffness: *stiffness,
            ..JointDescription::new(&format!("j{i}"), JointKind::Slide)
        }],
    };
    let description = RobotDescription {
        name: "slides".to_string(),
        gravity: [0.0, 0.0, -9.81],
        bodies: own.iter().enumerate().map(body).collect(),
        frames: Vec::new(),
        solids: Vec::new(),
        motors: Vec::new(),
        notes: Vec::new(),
    };
    Model::from_description(description).unwrap()
}

/// The accelerations nearest to a proposal of these velocities that the drives of `gains` (stiffness, damping) can make over `period`.
fn nearest(model: &Model, gains: &[[f64; 2]], period: Period, v: &[f64], wanted: &[f64]) -> Vec<f64> {
    let drives: Vec<_> = gains
        .iter()
        .map(|[stiffness, damping]| Drive::Pd { stiffness: *stiffness, damping: *damping })
        .collect();
    let nv = model.nv();
    let ranges = vec![[f64::NEG_INFINITY, f64::INFINITY]; nv];
    let of_drives = DriveTorqueLimit::new(TorqueLimit::default(), &drives, &ranges, period);
    let limits: [Box<dyn Limit>; 2] = [Box::new(TorqueLimit::default()), Box::new(of_drives)];
    let settings = Settings { braking: Braking::Certified, ..Settings::new(period.dt, period.sub_steps) };
    let all: Vec<usize> = (0..nv).collect();
    let mut projector = Projector::new(model, &limits, &all, settings).unwrap();
    let q = vec![0.1; nv];
    let proposal =
        Proposal { q: (0..nv).map(|i| q[i] + period.dt * wanted[i]).collect(), v: wanted.to_vec() };
    let mut target = Target::new(model);
    projector.project(&q, v, &proposal, &mut target);
    assert_eq!(target.ledger.status, Status::Solved, "{:?}", target.ledger);
    target.acceleration.clone()
}

/// In two steps of length `tau` the force falls from `f` to `f - K tau v' - D (v' - v)`, `v' = v + tau f / m`: with the two on average `m a`,
///
/// ```text
///     f = (m a + K tau v / 2) / (1 - (K tau² + D tau) / 2 m)
/// ```
#[test]
fn over_two_steps_a_drive_starts_with_the_force_of_hand_arithmetic() {
    let (model, tau, [stiffness, damping]) = (slides(&[[0.0; 2]]), 0.0005, [2e5, 400.0]);
    for v in [0.3, -0.1, 0.6] {
        let a =
            nearest(&model, &[[stiffness, damping]], Period::new(2.0 * tau, 2), &[v], &[v.signum() * 9.0])[0];
        let start =
            (2.0 * a + 0.5 * stiffness * tau * v) / (1.0 - (stiffness * tau * tau + damping * tau) / 4.0);
        assert!((start.abs() - 0.99 * 50.0).abs() < 1e-8, "{v} m/s: {a} m/s², {start} N");
    }
}

/// Two slides, whose drives push each other, by the steps of `2 (x0'' + x1'') ..`, made by hand with the commands that lead to the projected accelerations.
#[test]
fn over_several_steps_the_largest_force_is_the_limit() {
    let own = [[3.0, 40.0], [1.0, 0.0]];
    let (model, gains) = (slides(&own), [[6e4, 500.0], [4e4, 200.0]]);
    for (steps, wanted) in [(2, [4.0, -4.0]), (5, [4.0, -4.0]), (5, [-4.0, -4.0]), (10, [4.0, 4.0])] {
        let period = Period::new(0.001 * f64::from(steps), steps);
        let v = [0.12, -0.05];
        let a = nearest(&model, &gains, period, &v, &wanted);
        // The force of each drive is its command's less what the motion takes: linear, so that three runs tell the commands.
        let run = |held: [f64; 2]| {
            let (mut x, mut speed, mut forces) = ([0.1; 2], v, Vec::new());
            for _ in 0..steps {
                let force = [0, 1].map(|i| held[i] - gains[i][0] * x[i] - gains[i][1] * speed[i]);
                forces.push(force);
                let push = [0, 1].map(|i| force[i] - own[i][1] * x[i] - own[i][0] * speed[i]);
                // [[4 + tau d0, 2], [2, 2 + tau d1]] a = push
                let mass = [4.0 + period.tau * own[0][0], 2.0, 2.0 + period.tau * own[1][0]];
                let det = mass[0] * mass[2] - mass[1] * mass[1];
                let by = [
                    (mass[2] * push[0] - mass[1] * push[1]) / det,
                    (mass[0] * push[1] - mass[1] * push[0]) / det,
                ];
                for i in 0..2 {
                    speed[i] += period.tau * by[i];
                    x[i] += period.tau * speed[i];
                }
            }
            (speed, forces)
        };
        let still = run([0.0; 2]).0;
        let [first, second] = [run([1e4, 0.0]).0, run([0.0, 1e4]).0];
        let slope = [0, 1].map(|i| [(first[i] - still[i]) / 1e4, (second[i] - still[i]) / 1e4]);
        let missing = [0, 1].map(|i| v[i] + period.dt * a[i] - still[i]);
        let det = slope[0][0] * slope[1][1] - slope[0][1] * slope[1][0];
        let held = [
            (missing[0] * slope[1][1] - missing[1] * slope[0][1]) / det,
            (missing[1] * slope[0][0] - missing[0] * slope[1][0]) / det,
        ];
        let (speed, forces) = run(held);
        assert!((0..2).all(|i| (speed[i] - v[i] - period.dt * a[i]).abs() < 1e-9), "{speed:?} {a:?}");
        let ends = [forces[0], forces[steps as usize - 1]];
        let largest = ends.iter().flatten().fold(0.0, |most: f64, force| most.max(force.abs()));
        assert!((largest - 0.99 * 50.0).abs() < 1e-6, "{steps} steps: {ends:?}");
    }
}

/// A drive whose target is at its end where it holds a joint against its weight can hardly brake it on the way back inside: `K T v` more than the weight,
/// after a tick at `v`. Such joints stood still for ever, whatever was proposed.
#[test]
fn a_joint_that_hangs_at_the_end_of_its_target_comes_back() {
    for (stiffness, dt, ticks) in [(4000.0, 0.002, 2000), (400.0, 0.002, 4000), (1600.0, 0.001, 4000)] {
        let mut description = slides(&[[0.0, 0.0]]).description().clone();
        description.gravity = [9.81, 0.0, 0.0];
        let joint = &mut description.bodies[0].joints[0];
        joint.range = Range::Limited(-1.0, 1.0);
        let model = Model::from_description(description).unwrap();
        let (period, drives) = (Period::new(dt, 1), [Drive::Pd { stiffness, damping: 0.0 }]);
        let of_drives = DriveTorqueLimit::new(TorqueLimit::default(), &drives, &[[-1.0, 1.0]], period);
        let limits: [Box<dyn Limit>; 5] = [
            Box::new(PositionLimit::default()),
            Box::new(VelocityLimit::scaled(1.0)),
            Box::new(AccelerationLimit::new(limit::AccelerationSettings::of(PerJoint::All(5.0), None))),
            Box::new(TorqueLimit::default()),
            Box::new(of_drives),
        ];
        let settings = Settings { braking: Braking::Stored, ..Settings::new(dt, 1) };
        let mut projector = Projector::new(&model, &limits, &[0], settings).unwrap();
        // 2 kg hang at the lower end of the target: `K (q* - q) = -2 g` with `q* = -1`
        let begin = -1.0 + 2.0 * 9.81 / stiffness;
        let (mut q, mut v, mut target) = (vec![begin], vec![0.0], Target::new(&model));
        let mut proposal = Proposal::new(&model);
        for _ in 0..ticks {
            // a speed at which it stops within what is left to there
            let speed: f64 = (0.5 - q[0]).clamp(0.0, 1.0);
            (proposal.q[0], proposal.v[0]) = (q[0] + dt * speed, speed);
            projector.project(&q, &v, &proposal, &mut target);
            assert_eq!(target.ledger.target_violations.total(), 0, "{:?}", target.ledger);
            (q, v) = (target.q.clone(), target.v.clone());
        }
        println!("{stiffness} N/m: from {begin} to {} m, at {} m/s", q[0], v[0]);
        assert!(q[0] > begin + 0.5, "{stiffness} N/m: from {begin} to {} m", q[0]);
    }
}
