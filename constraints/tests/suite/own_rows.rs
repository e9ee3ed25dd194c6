//! Rows of one's own over several joints, against sums that the test forms itself from the states that are reached.

use crate::common::*;
use nearl_constraints::limit::{AccelerationSettings, UserRowSettings};
use nearl_constraints::*;

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
fn a_row_that_standing_still_breaks_is_told() {
    let term = [("v.panda_joint1", 1.0)];
    for (row, is_told) in [
        (between("moves", &term, 0.1, 1.0), true),
        (equal("moves", &term, 0.2), true),
        (between("moves", &term, -0.1, 1.0), false),
        (UserRowSettings { margin: 0.2, ..between("moves", &term, -0.1, 1.0) }, true),
        (UserRowSettings { soft: Some(Soft::default()), ..between("moves", &term, 0.1, 1.0) }, false),
        (
            UserRowSettings { braking: Some(2.0), ..between("moves", &[("q.panda_joint1", 1.0)], 0.1, 1.0) },
            false,
        ),
    ] {
        let projector = projector(&panda(), std::slice::from_ref(&row), Settings::new(0.01, 1));
        let notes = projector.notes().join("; ");
        assert_eq!(notes.contains("row 'moves' does not let its joints stand still"), is_told, "{notes}");
    }
}

/// A deceleration that no joint gives decides nothing: the sum stops in front of its bound with what its joints have, 8 rad/s² each.
#[test]
fn a_sum_stops_in_front_of_its_bound_however_much_braking_is_asked_for() {
    let terms = [("q.panda_joint1", 1.0), ("q.panda_joint2", -0.5)];
    for braking in [4.0, 20.0, 1e3, 1e6] {
        let row = UserRowSettings { braking: Some(braking), ..between("sum", &terms, -0.2, 0.2) };
        for (dt, sub_steps) in [(0.001, 1), (0.01, 1), (0.01, 0), (0.01, 5)] {
            let mut projector = projector(&panda(), std::slice::from_ref(&row), Settings::new(dt, sub_steps));
            let mut largest = 0.0f64;
            storm(&mut projector, &START, (1500, 11), |_, _, target, _| {
                largest = largest.max((target.q[0] - 0.5 * target.q[1]).abs());
            });
            assert!(
                largest < 0.2 + 1e-8 && largest > 0.15,
                "{braking} rad/s², {dt} s, {sub_steps}: {largest}"
            );
        }
    }
}

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

fn equal(name: &str, terms: &[(&str, f64)], value: f64) -> UserRowSettings {
    UserRowSettings { equals: Some(value), ..row(name, terms) }
}

/// Two joints in one plane; the second mirrors the first where a row holds it there.
fn mirrored(ratio: f64) -> Model {
    let body = "<inertial><mass value=\"1\"/><origin xyz=\"0.2 0 0\"/>\
        <inertia ixx=\"0.02\" iyy=\"0.02\" izz=\"0.02\" ixy=\"0\" ixz=\"0\" iyz=\"0\"/></inertial>";
    Model::from_urdf_text(&format!(
        "<robot name=\"r\"><link name=\"a\"/><link name=\"b\">{body}</link><link name=\"c\">{body}</link>\
         <joint name=\"j\" type=\"revolute\"><parent link=\"a\"/><child link=\"b\"/><axis xyz=\"0 1 0\"/>\
         <limit lower=\"-1\" upper=\"1\" velocity=\"2\" effort=\"60\"/></joint>\
         <joint name=\"k\" type=\"revolute\"><parent link=\"b\"/><child link=\"c\"/><origin xyz=\"0.4 0 0\"/><axis xyz=\"0 1 0\"/>\
         <limit lower=\"{}\" upper=\"{}\" velocity=\"4\" effort=\"40\"/></joint></robot>",
        -ratio,
        0.9 * ratio,
    ))
    .unwrap()
}

#[test]
fn joints_that_a_row_holds_in_proportion_stay_so_while_they_brake() {
    for ratio in [1.0, 2.0, 0.4] {
        let model = mirrored(ratio);
        let rows = [equal("mimic", &[("q.k", 1.0), ("q.j", ratio)], 0.0)];
        for (dt, sub_steps) in [(0.001, 0), (0.004, 1), (0.02, 5)] {
            for torque in [false, true] {
                let mut limits = limits(&rows);
                if torque {
                    limits.push(Box::new(TorqueLimit::scaled(1.0)));
                }
                let mut projector =
                    Projector::new(&model, &limits, &[0, 1], Settings::new(dt, sub_steps)).unwrap();
                let (mut off, mut braked, mut range) = (0.0f64, 0, [f64::MAX, f64::MIN]);
                let ticks = (20.0 / dt) as usize;
                storm(&mut projector, &[0.0, 0.0], (ticks, 5), |tick, _, target, _| {
                    off = off.max((target.q[1] + ratio * target.q[0]).abs());
                    braked += usize::from(matches!(target.ledger.status, Status::Braked(_)));
                    range = [range[0].min(target.q[0]), range[1].max(target.q[0])];
                    assert!(
                        target.ledger.outside.is_empty() && !target.ledger.target_breaks(),
                        "{tick}: {target:?}"
                    );
                });
                let state = format!("ratio {ratio}, {dt} s, {sub_steps} steps, torque {torque}");
                println!("{state}: off by {off:.1e} rad, braked in {braked} of {ticks}, j in {range:.2?}");
                assert!(off < 1e-9, "{state}: {off:e}");
                assert!(braked < ticks / 2 && range[1] - range[0] > 1.0, "{state}: {braked} {range:?}");
            }
        }
    }
}

#[test]
fn two_joints_of_an_arm_stay_equal_while_all_move() {
    let rows = [equal("mimic", &[("q.panda_joint6", 1.0), ("q.panda_joint4", 1.0)], 0.0)];
    for sub_steps in [0, 1] {
        let mut projector = projector(&panda(), &rows, Settings::new(0.004, sub_steps));
        let (mut off, mut moving, mut counted) = (0.0f64, 0, 0);
        storm(&mut projector, &START, (6000, 0), |tick, _, target, _| {
            off = off.max((target.q[5] + target.q[3]).abs());
            moving += usize::from(tick > 5000 && target.v.iter().any(|v| v.abs() > 0.1));
            counted += usize::from(target.ledger.target_breaks());
        });
        println!("{sub_steps} steps: off by {off:.1e} rad, moving in {moving} of the last 999");
        assert!(off < 1e-9 && moving > 900 && counted == 0, "{off:e} {moving} {counted}");
    }
}

#[test]
fn speeds_in_a_fixed_proportion_stay_so_beside_other_rows() {
    let rows = [
        equal("geared", &[("v.panda_joint4", 1.0), ("v.panda_joint2", -0.7)], 0.0),
        between("mix", &[("v.panda_joint1", 0.8), ("a.panda_joint2", 0.2)], -1.0, 1.0),
        between("both", &[("v.panda_joint4", 1.0), ("v.panda_joint5", 0.6)], -0.5, 0.9),
    ];
    for (dt, sub_steps) in [(0.001, 1), (0.004, 0), (0.02, 5)] {
        let mut projector = projector(&panda(), &rows, Settings::new(dt, sub_steps));
        let (mut off, mut beyond) = (0.0f64, 0.0f64);
        storm(&mut projector, &START, (4000, 8), |_, _, target, a| {
            off = off.max((target.v[3] - 0.7 * target.v[1]).abs());
            beyond = beyond.max((0.8 * target.v[0] + 0.2 * a[1]).abs() - 1.0);
            let both = target.v[3] + 0.6 * target.v[4];
            beyond = beyond.max(both - 0.9).max(-0.5 - both);
        });
        println!("{dt} s, {sub_steps} steps: off by {off:.1e} rad/s, beyond by {beyond:.1e}");
        assert!(off < 1e-8 && beyond < 1e-9, "{dt} {sub_steps}: {off:e} {beyond:e}");
    }
}

/// Something has pushed one of the joints: named until the proposal has led them back, and no further away on the way.
#[test]
fn what_was_pushed_off_a_row_is_named_and_comes_back() {
    let rows = [equal("mimic", &[("q.panda_joint6", 1.0), ("q.panda_joint4", 1.0)], 0.0)];
    for (sub_steps, push) in [(0, 0.05), (1, -0.02), (5, 0.2)] {
        let mut projector = projector(&panda(), &rows, Settings::new(0.002, sub_steps));
        let mut q = START.to_vec();
        q[5] += push;
        let (mut v, mut target, mut off) = (vec![0.0; 7], Target::new(projector.model()), push.abs());
        let row = projector.row_names().iter().position(|name| name == "mimic").unwrap();
        // Over several physics steps a sum is at its value within B T^2 / 4.
        let at = if sub_steps > 1 { 0.25 * 10.0 * 0.002 * 0.002 } else { 1e-8 };
        let mut named = 0;
        for _ in 0..3000 {
            let raw = Proposal { q: START.to_vec(), v: vec![0.0; 7] };
            projector.project(&q, &v, &raw, &mut target);
            let now = (target.q[5] + target.q[3]).abs();
            let further = if sub_steps > 1 { at } else { off + 1e-9 };
            assert!(now <= further.max(off), "{now} after {off}: {:?}", target.ledger);
            named += usize::from(target.ledger.outside.contains(&row));
            assert!(off <= at || target.ledger.outside.contains(&row), "{off:e} {:?}", target.ledger);
            off = now;
            (q, v) = (target.q.clone(), target.v.clone());
        }
        println!(
            "{sub_steps} steps: off by {off:.1e} rad after {named} named ticks, {:?}",
            target.ledger.status
        );
        assert!(off < 1e-9 && named > 10 && named < 2900, "{off:e} {named} {:?}", target.ledger);
        assert!(target.ledger.outside.is_empty() && target.ledger.status.is_ok());
    }
}

/// A speed that stands at 0 and is to be kept at 0.2 rad/s: reached over several periods, as the joint can.
#[test]
fn a_speed_that_is_not_reached_at_once_is_reached_later() {
    let rows = [equal("belt", &[("v.panda_joint1", 1.0)], 0.2)];
    let mut projector = projector(&panda(), &rows, Settings::new(0.001, 1));
    let (mut q, mut v, mut target) = (START.to_vec(), vec![0.0; 7], Target::new(&panda()));
    for _ in 0..100 {
        let raw = Proposal { q: q.clone(), v: vec![5.0; 7] };
        projector.project(&q, &v, &raw, &mut target);
        (q, v) = (target.q.clone(), target.v.clone());
    }
    assert!((v[0] - 0.2).abs() < 1e-9, "{} {:?}", v[0], target.ledger);
}

#[test]
fn a_sum_that_joints_cannot_reach_is_refused() {
    let all = [0, 1, 2, 3, 4, 5, 6];
    let refused = |row: UserRowSettings| {
        Projector::new(&panda(), &limits(&[row]), &all, Settings::new(0.001, 1)).err().map(|e| e.to_string())
    };
    let far = refused(equal("far", &[("q.panda_joint6", 1.0)], 50.0)).unwrap();
    assert!(
        far.starts_with("row 'far' asks its sum to be 50, and the limits of its joints leave it -0.0"),
        "{far}"
    );
    assert!(far.contains("to 3.7525, all in the unit of the sum"), "{far}");
    let fast =
        refused(UserRowSettings { lower: Some(9.0), ..row("fast", &[("v.panda_joint1", 1.0)]) }).unwrap();
    assert!(fast.starts_with("row 'fast' asks its sum to reach 9"), "{fast}");
    assert_eq!(refused(equal("near", &[("q.panda_joint6", 1.0)], 3.0)), None);

    let mut smooth = limits(&[equal("tied", &[("q.panda_joint6", 1.0), ("q.panda_joint4", 1.0)], 0.0)]);
    smooth.push(Box::new(JerkLimit::hard(500.0)));
    let smooth = Projector::new(&panda(), &smooth, &all, Settings::new(0.001, 1)).err().unwrap().to_string();
    assert!(
        smooth.contains("'tied'") && smooth.contains("'panda_joint4'") && smooth.contains("hard jerk"),
        "{smooth}"
    );
}

/// A row of some kind over two joints that the start keeps: its terms as letter, joint and coefficient.
type Drawn = (UserRowSettings, Vec<(char, usize, f64)>);

fn drawn(k: usize, random: &mut Random) -> Drawn {
    let (i, step) = ((7.0 * random.next()) as usize % 7, 1 + (6.0 * random.next()) as usize % 6);
    let j = (i + step) % 7;
    let mut c = || random.between(0.3, 1.5) * if random.next() < 0.5 { -1.0 } else { 1.0 };
    let (c, d) = (c(), c());
    let (lower, upper) = (-random.between(0.1, 1.0), random.between(0.1, 1.0));
    let at = c * START[i] + d * START[j];
    let (terms, bounds, braking) = match random.next() {
        x if x < 0.15 => (vec![('v', i, c), ('v', j, d)], [Some(lower), Some(upper), None], None),
        x if x < 0.3 => {
            (vec![('a', i, c), ('a', j, d)], [Some(10.0 * lower), Some(10.0 * upper), None], None)
        }
        x if x < 0.45 => (vec![('v', i, c), ('a', j, 0.2 * d)], [Some(-1.0), Some(1.0), None], None),
        x if x < 0.55 => (vec![('q', i, c), ('v', j, d)], [None, Some(c * START[i] + 0.3), None], None),
        x if x < 0.7 => {
            (vec![('q', i, c), ('q', j, d)], [Some(at + lower), Some(at + upper), None], Some(2.0))
        }
        x if x < 0.85 => (vec![('v', i, c), ('v', j, d)], [None, None, Some(0.0)], None),
        _ => (vec![('q', i, c), ('q', j, d)], [None, None, Some(at)], None),
    };
    let named = terms.iter().map(|(letter, i, c)| (format!("{letter}.panda_joint{}", i + 1), *c)).collect();
    let [lower, upper, equals] = bounds;
    let name = format!("r{k}");
    (UserRowSettings { terms: named, lower, upper, equals, braking, ..row(&name, &[]) }, terms)
}

#[test]
fn drawn_rows_of_all_kinds_are_kept() {
    let (mut braked, mut ticks) = (0, 0);
    for seed in 0..60 {
        let mut random = Random(seed + 1);
        let settings = Settings::new(
            [0.001, 0.004, 0.02][(3.0 * random.next()) as usize % 3],
            [0, 1, 5][(3.0 * random.next()) as usize % 3],
        );
        let count = 1 + (2.0 * random.next()) as usize % 2;
        let rows: Vec<Drawn> = (0..count).map(|k| drawn(k, &mut random)).collect();
        let settings_of: Vec<UserRowSettings> = rows.iter().map(|(row, _)| row.clone()).collect();
        let solver = if seed % 6 == 5 { Solver::Clarabel } else { Solver::Ladder };
        let mut limits = limits(&settings_of);
        if random.next() < 0.3 {
            limits.push(Box::new(TorqueLimit::scaled(1.0)));
        }
        let settings = Settings { solver, ..settings };
        let mut projector = Projector::new(&panda(), &limits, &[0, 1, 2, 3, 4, 5, 6], settings).unwrap();
        let mut here = 0;
        storm(&mut projector, &START, (1000, seed + 7), |tick, _, target, a| {
            here += usize::from(matches!(target.ledger.status, Status::Braked(_)));
            for (row, terms) in &rows {
                let value: f64 = terms
                    .iter()
                    .map(|(letter, i, c)| {
                        c * match letter {
                            'q' => target.q[*i],
                            'v' => target.v[*i],
                            _ => a[*i],
                        }
                    })
                    .sum();
                let [lower, upper] = [row.lower.or(row.equals), row.upper.or(row.equals)];
                let beyond = (value - upper.unwrap_or(f64::MAX)).max(lower.unwrap_or(f64::MIN) - value);
                let most = if row.equals.is_some() { 1e-8 } else { 2e-9 };
                assert!(
                    beyond < most,
                    "seed {seed}, tick {tick}: {beyond:e} beyond {row:?}: {:?}",
                    target.ledger
                );
            }
        });
        if here > 500 {
            println!("seed {seed}: braked in {here} of 1000: {settings_of:?}");
        }
        (braked, ticks) = (braked + here, ticks + 1000);
    }
    println!("braked in {braked} of {ticks}");
    assert!(braked < ticks / 5, "{braked} of {ticks}");
}
