//! Rows of one's own over several joints, against sums that the test forms itself from the states that are reached.

use crate::common::*;
use nearl_constraints::limit::{AccelerationSettings, UserRowSettings};
use nearl_constraints::*;

fn row(name: &str, terms: &[(&str, f64)]) -> UserRowSettings {
    UserRowSettings {
        name: name.into(),
        terms: terms.iter().map(|(n, c)| (n.to_string(), *c)).collect(),
        lower: None,
        upper: None,
        equals: None,
        braking: None,
        margin: 0.0,
        soft: None,
    }
}

fn between(name: &str, terms: &[(&str, f64)], lower: f64, upper: f64) -> UserRowSettings {
    UserRowSettings { lower: Some(lower), upper: Some(upper), ..row(name, terms) }
}

/// The limits of single joints, all with 8 rad/s², and the rows.
fn limits(rows: &[UserRowSettings]) -> Vec<Box<dyn Limit>> {
    let acceleration = AccelerationSettings::of(PerJoint::All(8.0), None);
    let mut limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::scaled(1.0)),
        Box::new(AccelerationLimit::new(acceleration)),
    ];
    limits.extend(rows.iter().map(|row| Box::new(UserRow::new(row.clone())) as Box<dyn Limit>));
    limits
}

fn projector(model: &Model, rows: &[UserRowSettings], settings: Settings) -> Projector {
    let all: Vec<usize> = (0..model.nv()).collect();
    Projector::new(model, &limits(rows), &all, settings).unwrap()
}

/// Bang-bang proposals in closed loop: `see` gets the state of each tick, its target and the accelerations between them.
fn storm(
    projector: &mut Projector,
    start: &[f64],
    (ticks, seed): (usize, u64),
    mut see: impl FnMut(usize, &[f64], &Target, &[f64]),
) {
    let (dt, nv) = (projector.settings().dt, start.len());
    let (mut q, mut v, mut random) = (start.to_vec(), vec![0.0; nv], Random(seed));
    let (mut side, mut target) = (vec![1.0; nv], Target::new(projector.model()));
    for tick in 0..ticks {
        if random.next() < 0.02 {
            side = (0..nv).map(|_| if random.next() < 0.5 { -1.0 } else { 1.0 }).collect();
        }
        let raw = Proposal {
            q: (0..nv).map(|i| q[i] + 10.0 * side[i]).collect(),
            v: side.iter().map(|s| 100.0 * s).collect(),
        };
        projector.project(&q, &v, &raw, &mut target);
        let a: Vec<f64> = (0..nv).map(|i| (target.v[i] - v[i]) / dt).collect();
        see(tick, &v, &target, &a);
        (q, v) = (target.q.clone(), target.v.clone());
    }
}

const START: [f64; 7] = [0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0];

#[test]
fn a_speed_of_one_joint_and_an_acceleration_of_another_are_kept_together() {
    let terms = [("v.panda_joint4", 1.0), ("a.panda_joint2", 0.2)];
    let rows = [between("mix", &terms, -1.0, 1.0)];
    for (dt, sub_steps) in [(0.004, 1), (0.004, 0), (0.02, 0), (0.02, 5)] {
        for braking in [Braking::Auto, Braking::Stored] {
            let settings = Settings { braking, ..Settings::new(dt, sub_steps) };
            let mut projector = projector(&panda(), &rows, settings);
            let (mut largest, mut braked) = (0.0f64, 0);
            storm(&mut projector, &START, (3000, 3), |_, _, target, a| {
                largest = largest.max((target.v[3] + 0.2 * a[1]).abs());
                braked += usize::from(matches!(target.ledger.status, Status::Braked(_)));
                assert!(!target.ledger.target_breaks(), "{:?}", target.ledger);
            });
            println!("{dt} s, {sub_steps} steps, {braking:?}: {largest} of 1, braked in {braked} of 3000");
            assert!(largest < 1.0 + 1e-9, "{dt} {sub_steps} {braking:?}: {largest}");
            assert!(braked < 1000, "{braked}");
        }
    }
}
