//! Limits hold where the settings say nothing of braking, and numbers that are probably mistakes are named in a warning.

use crate::common::solids::*;
use crate::common::*;
use nearl_constraints::limit::{AccelerationSettings, JerkSettings, PositionSettings};
use nearl_constraints::*;

fn panda_with(acceleration: PerJoint, extra: Vec<Box<dyn Limit>>, settings: Settings) -> Projector {
    let mut limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::default()),
        Box::new(AccelerationLimit::new(AccelerationSettings::of(acceleration, None))),
    ];
    limits.extend(extra);
    Projector::new(&panda(), &limits, &[0, 1, 2, 3, 4, 5, 6], settings).unwrap()
}

/// Motors that cannot brake with what position limits count on broke their limits by 18 % under attack.
#[test]
fn torque_holds_by_default_where_braking_is_not_certified() {
    let torque: Vec<Box<dyn Limit>> = vec![Box::new(TorqueLimit::scaled(0.62))];
    let mut projector = panda_with(PerJoint::All(12.0), torque, Settings::new(0.001, 1));
    assert_eq!(projector.settings().braking, Braking::Stored);
    let (mut random, mut target) = (Random(11), Target::new(projector.model()));
    let (mut q, mut v) = (vec![0.1, -0.4, 0.2, -1.8, 0.1, 1.9, 0.3], vec![0.0; 7]);
    let mut side = [0.0; 7];
    for tick in 0..10_000 {
        if tick % 300 == 0 {
            side = std::array::from_fn(|_| if random.next() < 0.5 { -9.0 } else { 9.0 });
        }
        let raw = Proposal { q: (0..7).map(|i| q[i] + 0.01 * side[i]).collect(), v: side.to_vec() };
        projector.project(&q, &v, &raw, &mut target);
        assert_eq!(target.ledger.target_violations.total(), 0, "tick {tick}: {:?}", target.ledger);
        (q, v) = (target.q.clone(), target.v.clone());
    }
}

#[test]
fn what_is_chosen_depends_on_what_could_break() {
    let none = panda_with(PerJoint::All(10.0), vec![], Settings::new(0.001, 1));
    assert_eq!(none.settings().braking, Braking::Certified);
    assert_eq!(panda_projector(Some(1.0), Settings::new(0.001, 1)).settings().braking, Braking::Certified);
    let speed: Vec<Box<dyn Limit>> = vec![Box::new(FrameSpeedLimit::of("panda_hand", 0.25))];
    let cone = panda_with(PerJoint::All(10.0), speed, Settings::new(0.001, 1));
    assert_eq!(cone.settings().braking, Braking::Stored);
    let alone: Vec<Box<dyn Limit>> =
        vec![Box::new(VelocityLimit::default()), Box::new(FrameSpeedLimit::of("panda_hand", 0.25))];
    let endless = Projector::new(&panda(), &alone, &[0, 1, 2], Settings::new(0.001, 1)).unwrap();
    assert_eq!(endless.settings().braking, Braking::Certified);
    let notes = endless.notes().join("; ");
    assert!(notes.contains("'panda_joint1'") && notes.contains("frame_speed"), "{notes}");
    let below: Vec<Box<dyn Limit>> =
        vec![Box::new(FrameLimit::half_space("panda_hand", [0.0, 0.0, 1.0], [0.0, 0.0, 0.8], 2.0))];
    let plane = panda_with(PerJoint::All(10.0), below, Settings::new(0.001, 1));
    assert_eq!(plane.settings().braking, Braking::Stored);
}

/// Without a brake bodies went up to 77 mm into each other.
#[test]
fn bodies_without_a_brake_are_noted() {
    let notes = |braking: Braking| {
        let settings = Settings { braking, ..Settings::new(0.001, 1) };
        panda_with(PerJoint::All(10.0), vec![Box::new(panda_collision(2, 0.3))], settings).notes().join("; ")
    };
    assert!(
        notes(Braking::Certified).contains("bodies may come into each other"),
        "{}",
        notes(Braking::Certified)
    );
    assert!(!notes(Braking::Auto).contains("bodies"), "{}", notes(Braking::Auto));
}

/// Limits were taken for joints that are not controllable, and held nothing there.
#[test]
fn a_limit_names_the_joints_that_it_cannot_hold() {
    let (model, seventh) = (panda(), "panda_joint7".to_string());
    let of = |value: f64| PerJoint::Joints([(seventh.clone(), value)].into());
    let named: Vec<(&str, Box<dyn Limit>)> = vec![
        ("locked", Box::new(LockedJoints::of(vec![seventh.clone()]))),
        ("velocity", Box::new(VelocityLimit::values(of(0.2)))),
        ("acceleration", Box::new(AccelerationLimit::new(AccelerationSettings::of(of(5.0), None)))),
        ("jerk", Box::new(JerkLimit::new(JerkSettings { limit: of(50.0), margin: None, soft: None }))),
        (
            "position",
            Box::new(PositionLimit::new(PositionSettings { margin: of(0.1), ..Default::default() })),
        ),
    ];
    for (name, limit) in named {
        let limits: Vec<Box<dyn Limit>> = vec![Box::new(AccelerationLimit::uniform(10.0)), limit];
        let notes = |controllable: &[usize]| {
            let projector =
                Projector::new(&model, &limits, controllable, Settings::new(0.001, 1)).expect(name);
            projector.notes().join("; ")
        };
        let said = format!("'{name}' names 'panda_joint7' and does not hold there");
        assert!(notes(&[0, 1]).contains(&said), "{name}: {}", notes(&[0, 1]));
        assert!(!notes(&[5, 6]).contains("does not hold there"), "{name}: {}", notes(&[5, 6]));
    }
}

/// A base that nobody drives left the choice at `certified` without a word.
#[test]
fn a_robot_that_cannot_store_a_brake_says_so() {
    let model = free("solo12/solo12.urdf");
    let limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::values(PerJoint::All(15.0))),
        Box::new(AccelerationLimit::uniform(100.0)),
        Box::new(TorqueLimit::scaled(0.5)),
    ];
    let legs: Vec<usize> = (6..model.nv()).collect();
    let projector = Projector::new(&model, &limits, &legs, Settings::new(0.001, 1)).unwrap();
    assert_eq!(projector.settings().braking, Braking::Certified);
    let base = format!("because '{}' is not controllable: torque may be broken", model.joints()[0].name);
    assert!(projector.notes().iter().any(|note| note.contains(&base)), "{:?}", projector.notes());
}

#[test]
fn numbers_nobody_means_are_named() {
    let fast: Vec<Box<dyn Limit>> = vec![
        Box::new(VelocityLimit::values(PerJoint::All(160.0))),
        Box::new(AccelerationLimit::uniform(0.001)),
    ];
    let projector = Projector::new(&panda(), &fast, &[0], Settings::new(5.0, 1)).unwrap();
    let notes = projector.notes().join("\n");
    for part in ["160 rad/s", "robot file says", "0.001 rad/s²", "5 s", "'panda_joint1'"] {
        assert!(notes.contains(part), "{part} in {notes}");
    }
    assert!(panda_with(PerJoint::All(10.0), vec![], Settings::new(0.001, 1)).notes().is_empty());
}

#[test]
fn braking_above_the_acceleration_limit_is_refused_by_name() {
    let settings = AccelerationSettings::of(PerJoint::All(10.0), Some(PerJoint::All(12.0)));
    let limits: Vec<Box<dyn Limit>> = vec![Box::new(AccelerationLimit::new(settings))];
    let error = Projector::new(&panda(), &limits, &[2], Settings::new(0.001, 1)).err().unwrap().to_string();
    assert!(error.contains("'panda_joint3'") && error.contains("12") && error.contains("10"), "{error}");
}

#[test]
fn a_list_is_one_number_for_each_dof() {
    let by_list = panda_with(PerJoint::Each(PANDA_ACCELERATION.to_vec()), vec![], Settings::new(0.001, 1));
    let by_name = panda_with(panda_joints(PANDA_ACCELERATION), vec![], Settings::new(0.001, 1));
    assert_eq!(by_list.limits(), by_name.limits());
    let short: Vec<Box<dyn Limit>> =
        vec![Box::new(AccelerationLimit::new(AccelerationSettings::of(PerJoint::Each(vec![1.0; 6]), None)))];
    let error = Projector::new(&panda(), &short, &[2], Settings::new(0.001, 1)).err().unwrap().to_string();
    assert!(error.contains("6 numbers") && error.contains("7 dofs"), "{error}");
}

/// The report said 0 beside a row that gave way by a fifth.
#[test]
fn slack_is_that_of_soft_rows_too() {
    let soft = limit::TorqueSettings { scale: 0.05, soft: Some(Soft::default()), ..Default::default() };
    let torque: Vec<Box<dyn Limit>> = vec![Box::new(TorqueLimit::new(soft))];
    let mut projector = panda_with(PerJoint::All(10.0), torque, Settings::new(0.001, 1));
    let (q, v) = (vec![0.1, -0.4, 0.2, -1.8, 0.1, 1.9, 0.3], vec![0.0; 7]);
    let (mut target, raw) = (Target::new(projector.model()), Proposal { q: q.clone(), v: vec![0.01; 7] });
    projector.project(&q, &v, &raw, &mut target);
    let most = target.ledger.active.iter().fold(0.0, |most: f64, row| most.max(row.slack));
    assert!(most > 0.0 && target.ledger.slack == most, "{most} {:?}", target.ledger);
}
