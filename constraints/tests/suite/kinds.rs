//! What single kinds of limits promise, against formulas written down a second time.

use crate::common::solids::{obstacle, settings, solid};
use crate::common::*;
use nearl_constraints::geometry::Shape;
use nearl_constraints::limit::{AccelerationSettings, UserRowSettings, VelocityProfileSettings};
use nearl_constraints::*;

fn with(extra: Vec<Box<dyn Limit>>, settings: Settings) -> Projector {
    let mut limits = panda_limits(Some(1.0));
    limits.extend(extra);
    Projector::new(&panda(), &limits, &[0, 1, 2, 3, 4, 5, 6], settings).unwrap()
}

/// Bang-bang proposals at the limits, in closed loop.
fn storm(projector: &mut Projector, ticks: usize, seed: u64, mut see: impl FnMut(&[f64], &[f64], &Target)) {
    let mut random = Random(seed);
    let (mut q, mut v) = (vec![0.1, -0.4, 0.2, -1.8, 0.1, 1.9, 0.3], vec![0.0; 7]);
    let mut target = Target::new(projector.model());
    let mut side = [0.0; 7];
    for tick in 0..ticks {
        if tick % 300 == 0 {
            side = std::array::from_fn(|_| if random.next() < 0.5 { -9.0 } else { 9.0 });
        }
        let v_raw = (0..7).map(|i| side[i] + random.between(-1.0, 1.0)).collect();
        let raw = Proposal { q: (0..7).map(|i| q[i] + 0.01 * side[i]).collect(), v: v_raw };
        projector.project(&q, &v, &raw, &mut target);
        see(&q, &v, &target);
        (q, v) = (target.q.clone(), target.v.clone());
    }
}

/// The maker's rule of joint `i` of a Franka Research 3, as published.
fn fr3_upper(i: usize, q: f64) -> f64 {
    let (limit, offset, squared, at) = [
        (2.62, 0.30, 12.0, 2.75010),
        (2.62, 0.20, 5.17, 1.79180),
        (2.62, 0.20, 7.00, 2.90650),
        (2.62, 0.30, 8.00, -0.1458),
        (5.26, 0.35, 34.0, 2.81010),
        (4.18, 0.35, 11.0, 4.52050),
        (5.26, 0.35, 34.0, 3.01960),
    ][i];
    f64::min(limit, f64::max(0.0, -offset + f64::max(0.0, squared * (at - q)).sqrt()))
}

#[test]
fn the_fr3_rule_holds_at_every_tick() {
    for (braking, sub_steps) in [(10.0, 0), (10.0, 1), (20.0, 5)] {
        let limits: Vec<Box<dyn Limit>> = vec![
            Box::new(AccelerationLimit::new(AccelerationSettings::of(PerJoint::All(braking), None))),
            Box::new(VelocityProfileLimit::new(VelocityProfileSettings::Robot(limit::KnownRobot::Fr3))),
        ];
        let settings = Settings::new(0.001, sub_steps);
        let mut projector = Projector::new(&panda(), &limits, &[0, 1, 2, 3, 4, 5, 6], settings).unwrap();
        let (mut nearest, mut closest) = (f64::INFINITY, f64::INFINITY);
        storm(&mut projector, 20_000, 1, |_, _, target| {
            for i in 0..7 {
                nearest = nearest.min(fr3_upper(i, target.q[i]) - target.v[i]);
                closest = closest.min((fr3_upper(i, target.q[i]) - target.v[i]).abs());
            }
            assert!(target.ledger.status.is_ok(), "{:?}", target.ledger);
        });
        println!("braking {braking}: speed below the rule by {nearest:.1e} rad/s at least");
        assert!(nearest > -1e-9 && closest < 1e-2, "{nearest:e} {closest:e}");
    }
}

#[test]
fn a_locked_joint_brakes_and_stays() {
    let mut projector =
        with(vec![Box::new(LockedJoints::of(vec!["panda_joint3".into()]))], Settings::new(0.001, 1));
    let (q, mut v) = (vec![0.1, -0.4, 0.2, -1.8, 0.1, 1.9, 0.3], vec![0.0; 7]);
    v[2] = 0.01;
    let raw = Proposal { q: q.clone(), v: vec![0.005; 7] };
    let mut target = Target::new(projector.model());
    projector.project(&q, &v, &raw, &mut target);
    let braking = PANDA_BRAKING[2] * 0.001;
    assert!((target.v[2] - (0.01 - braking)).abs() < 1e-12, "{}", target.v[2]);
    storm(&mut projector, 3000, 2, |_, v, target| {
        if v[2] == 0.0 {
            assert_eq!(target.v[2], 0.0);
        }
    });
}

#[test]
fn an_equal_row_couples_two_joints() {
    let mut settings = row("coupled", &[("v.panda_joint1", 1.0), ("v.panda_joint3", -2.0)]);
    settings.equals = Some(0.0);
    for solver in [Solver::Ladder, Solver::Clarabel] {
        let extra: Vec<Box<dyn Limit>> = vec![Box::new(UserRow::new(settings.clone()))];
        let mut projector = with(extra, Settings { solver, ..Settings::new(0.001, 1) });
        let (mut solved, mut furthest) = (0, 0.0f64);
        storm(&mut projector, 5000, 3, |_, _, target| {
            if target.ledger.status == Status::Solved {
                solved += 1;
                furthest = furthest.max((target.v[0] - 2.0 * target.v[2]).abs());
            }
        });
        println!("{solver:?}: {solved} solved, furthest from equal {furthest:.1e} rad/s");
        assert!(solved > 4000 && furthest < 1e-8, "{solver:?}: {solved} {furthest:e}");
    }
}

#[test]
fn a_sum_of_positions_stops_in_front_of_its_bound() {
    let mut settings = row("sum", &[("q.panda_joint1", 1.0), ("q.panda_joint3", 1.0)]);
    (settings.upper, settings.lower, settings.braking) = (Some(0.9), Some(-0.8), Some(3.0));
    let by_itself = Settings { braking: Braking::Certified, ..Settings::new(0.001, 1) };
    let mut projector = with(vec![Box::new(UserRow::new(settings))], by_itself);
    let (mut highest, mut lowest, mut braked) = (f64::MIN, f64::MAX, 0);
    storm(&mut projector, 20_000, 4, |_, _, target| {
        let sum = target.q[0] + target.q[2];
        (highest, lowest) = (highest.max(sum), lowest.min(sum));
        braked += usize::from(!target.ledger.status.is_ok());
    });
    println!("sum between {lowest} and {highest}, {braked} braked");
    assert!(highest <= 0.9 + 1e-9 && lowest >= -0.8 - 1e-9 && highest > 0.89 && braked == 0);
}

/// Beyond a row, a plane and a floor: named, and not called clean.
#[test]
fn what_is_outside_at_the_start_is_named() {
    let q = [0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0];
    let low =
        UserRowSettings { upper: Some(-2.0), braking: Some(2.0), ..row("elbow", &[("q.panda_joint4", 1.0)]) };
    let solids = [
        solid("panda_hand", Shape::Sphere { radius: 0.1 }, [0.0; 3]),
        obstacle("table", Shape::HalfSpace, [0.0, 0.0, 1.0]),
    ];
    let limits: [(Box<dyn Limit>, &str); 3] = [
        (Box::new(UserRow::new(low)), "elbow"),
        (Box::new(FrameLimit::half_space("panda_hand", [0.0, 0.0, 1.0], [0.0, 0.0, 0.3], 5.0)), "panda_hand"),
        (Box::new(CollisionLimit::new(settings(&solids))), "panda_hand and table"),
    ];
    for (limit, name) in limits {
        let mut projector = with(vec![limit], Settings::new(0.001, 1));
        let (mut target, raw) = (Target::new(projector.model()), Proposal { q: q.to_vec(), v: vec![0.0; 7] });
        let status = projector.project(&q, &[0.0; 7], &raw, &mut target);
        let names = projector.row_names();
        let outside: Vec<_> = target.ledger.outside.iter().map(|r| names[*r].as_str()).collect();
        assert_eq!((status, &outside[..]), (Status::Recovering, &[name][..]), "{:?}", target.ledger);
    }
}

#[test]
fn hard_rows_without_a_state_brake_and_soft_ones_give_way() {
    let low = UserRowSettings { upper: Some(-0.5), ..row("low", &[("v.panda_joint1", 1.0)]) };
    let high = UserRowSettings { lower: Some(0.5), ..row("high", &[("v.panda_joint1", 1.0)]) };
    let (q, v) = (vec![0.1, -0.4, 0.2, -1.8, 0.1, 1.9, 0.3], vec![0.0; 7]);
    let raw = Proposal { q: q.clone(), v: vec![0.001; 7] };
    let mut target = Target::new(&panda());
    let rows = |soft| {
        let each = [&low, &high]
            .map(|s| Box::new(UserRow::new(UserRowSettings { soft, ..s.clone() })) as Box<dyn Limit>);
        with(each.into(), Settings::new(0.001, 1))
    };
    let status = rows(None).project(&q, &v, &raw, &mut target);
    assert_eq!((status, target.ledger.rung), (Status::Braked(BrakeReason::NoCertifiedAnswer), Rung::Brake));
    let mut soft = rows(Some(Soft::default()));
    let status = soft.project(&q, &v, &raw, &mut target);
    let slack: Vec<_> = target.ledger.active.iter().filter(|r| r.slack > 0.0).collect();
    let names = soft.row_names();
    assert_eq!(status, Status::Solved);
    assert_eq!(slack.iter().map(|r| names[r.row].as_str()).collect::<Vec<_>>(), ["low", "high"]);
    assert!(slack.iter().all(|r| (r.slack - 1.0).abs() < 0.05), "{slack:?}");
    assert_eq!(target.ledger.slack, slack.iter().fold(0.0, |most, r| f64::max(most, r.slack)));
}

/// Deceleration 10 rad/s^2 is more than the motors give in some states: torque rows then leave nothing, unless a verified brake
/// is kept.
#[test]
fn a_stored_brake_keeps_a_way_to_stop_where_braking_is_not_certified() {
    let limits = |scale: f64| -> Vec<Box<dyn Limit>> {
        vec![
            Box::new(PositionLimit::default()),
            Box::new(VelocityLimit::default()),
            Box::new(AccelerationLimit::uniform(12.0)),
            Box::new(TorqueLimit::scaled(scale)),
        ]
    };
    let mut lost = [0, 0];
    for (k, braking) in [Braking::Certified, Braking::Stored].into_iter().enumerate() {
        for seed in 0..5 {
            let settings = Settings { braking, ..Settings::new(0.001, 1) };
            let mut projector =
                Projector::new(&panda(), &limits(0.62), &[0, 1, 2, 3, 4, 5, 6], settings).unwrap();
            storm(&mut projector, 20_000, 10 + seed, |_, _, target| {
                lost[k] += usize::from(target.ledger.target_violations.total() > 0);
            });
        }
    }
    println!("ticks that break a limit: {} certified mode, {} stored brake", lost[0], lost[1]);
    assert!(lost[0] > 0, "the scene is too easy to show anything");
    assert_eq!(lost[1], 0);
}

/// A solve that is cut short counts only if it obeys everything; the ledger then says how far from the optimum it is.
#[test]
fn one_iteration_and_no_time_are_not_enough_and_it_says_so() {
    let hard = |settings: Settings| {
        let mut projector = panda_projector(Some(0.6), Settings { solver: Solver::Clarabel, ..settings });
        let (mut short, mut solved) = (0, 0);
        storm(&mut projector, 2000, 5, |_, _, target| {
            let braked = target.ledger.status == Status::Braked(BrakeReason::NoCertifiedAnswer);
            short += usize::from(braked || target.ledger.residual > 1e-6);
            solved += usize::from(target.ledger.rung == Rung::Clarabel);
            assert!(braked || target.ledger.target_violations.total() == 0, "{:?}", target.ledger);
        });
        (short, solved)
    };
    let settings = Settings::new(0.001, 1);
    let (short, solved) = hard(settings.clone());
    assert!(short == 0 && solved > 100, "{short} {solved}");
    assert!(hard(Settings { max_iter: 1, ..settings.clone() }).0 > 100);
    let deadline = Some(std::time::Duration::from_nanos(1));
    assert!(hard(Settings { deadline, ..settings }).0 > 100);
}

/// The force that is sent acts from the start of a period to its end: it stays below the motor's line at both speeds.
#[test]
fn the_line_of_a_motor_holds_at_the_start_and_at_the_end_of_a_period() {
    let model = two_joint_arm();
    let (stall, no_load) = ([40.0, 12.0], 4.0);
    let by_joint = |values: [f64; 2]| PerJoint::Each(values.to_vec());
    for (dt, sub_steps) in [(0.005, 0), (0.02, 0), (0.005, 1), (0.02, 1), (0.02, 5)] {
        let limits: Vec<Box<dyn Limit>> = vec![
            Box::new(PositionLimit::default()),
            Box::new(VelocityLimit::scaled(1.0)),
            Box::new(AccelerationLimit::new(AccelerationSettings::of(PerJoint::All(20.0), None))),
            Box::new(TorqueSpeedLimit::new(limit::TorqueSpeedSettings {
                stall: by_joint(stall),
                no_load: PerJoint::All(no_load),
                margin: None,
                soft: None,
            })),
        ];
        let mut projector = Projector::new(&model, &limits, &[0, 1], Settings::new(dt, sub_steps)).unwrap();
        let mut dynamics = Dynamics::new(&model);
        let period = Period::new(dt, sub_steps);
        let (mut q, mut v, mut random) = (vec![1.57, 0.0], vec![0.0; 2], Random(1));
        let (mut side, mut target, mut tau) = ([1.0; 2], Target::new(&model), [0.0; 2]);
        let (mut worst, mut moved) = ([f64::MIN; 2], 0.0f64);
        for tick in 0..4000 {
            if tick % 20 == 0 {
                side = std::array::from_fn(|_| if random.next() < 0.5 { -1.0 } else { 1.0 });
            }
            let raw = Proposal { q: q.clone(), v: side.iter().map(|s| 100.0 * s).collect() };
            projector.project(&q, &v, &raw, &mut target);
            let a: Vec<f64> = (0..2).map(|i| (target.v[i] - v[i]) / dt).collect();
            dynamics.motors_without_friction(&period, &q, &v, &a, &mut tau);
            for i in 0..2 {
                for (worst, v) in worst.iter_mut().zip([v[i], target.v[i]]) {
                    *worst = worst.max((tau[i] + stall[i] / no_load * v).abs() / stall[i] - 1.0);
                }
                moved = moved.max(target.v[i].abs());
            }
            (q, v) = (target.q.clone(), target.v.clone());
        }
        println!(
            "{dt} s, {sub_steps} steps: beyond the line by {worst:.1?} at start and end, up to {moved:.2} rad/s"
        );
        assert!(worst.iter().all(|x| *x < 1e-9) && moved > 0.5, "{worst:?} {moved}");
    }
}

/// Two joints in one plane, the first against gravity.
fn two_joint_arm() -> Model {
    let body = |mass: f64| {
        format!(
            "<inertial><mass value=\"{mass}\"/><origin xyz=\"0.2 0 0\"/>\
             <inertia ixx=\"0.02\" iyy=\"0.02\" izz=\"0.02\" ixy=\"0\" ixz=\"0\" iyz=\"0\"/></inertial>"
        )
    };
    let limit = "<limit lower=\"-3\" upper=\"3\" velocity=\"4\" effort=\"100\"/>";
    Model::from_urdf_text(&format!(
        "<robot name=\"r\"><link name=\"a\"/><link name=\"b\">{}</link><link name=\"c\">{}</link>\
         <joint name=\"j\" type=\"revolute\"><parent link=\"a\"/><child link=\"b\"/><axis xyz=\"0 1 0\"/>{limit}</joint>\
         <joint name=\"k\" type=\"revolute\"><parent link=\"b\"/><child link=\"c\"/><origin xyz=\"0.4 0 0\"/><axis xyz=\"0 1 0\"/>{limit}</joint></robot>",
        body(2.0),
        body(1.0),
    ))
    .unwrap()
}
