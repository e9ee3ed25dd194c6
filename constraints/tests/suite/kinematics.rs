//! Frames, Jacobians and energies are MuJoCo's (`fixtures/frames.json`, written by `fixtures/generate_frames.py`) and agree with
//! finite differences, with a fixed and with a floating base.

use crate::common::*;
use nearl_constraints::{Dynamics, FrameId, Kinematics, Model, convention as c};
use serde_json::Value;
use std::path::Path;

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

/// A robot of the fixture, and its numbers in our order of the joints (MuJoCo keeps the file's, Pinocchio sorts by name).
struct Robot {
    name: String,
    file: Value,
    model: Model,
    /// MuJoCo's entry of each of our configuration and velocity entries.
    at: (Vec<usize>, Vec<usize>),
}

fn robots() -> Vec<Robot> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let text = std::fs::read_to_string(root.join("constraints/tests/fixtures/frames.json")).unwrap();
    let all: Value = serde_json::from_str(&text).unwrap();
    let robot = |(name, file): (&String, &Value)| {
        let path = root.join("examples/robots").join(file["file"].as_str().unwrap());
        let model = match file["free_flyer"].as_bool().unwrap() {
            true => Model::from_urdf_free_flyer(&path).unwrap(),
            false => robot(file["file"].as_str().unwrap()),
        };
        let names: Vec<&str> =
            file["joints"].as_array().unwrap().iter().map(|x| x.as_str().unwrap()).collect();
        let (qadr, vadr) = (numbers(&file["qposadr"]), numbers(&file["dofadr"]));
        let mut at = (Vec::new(), Vec::new());
        for joint in model.joints() {
            let k = names.iter().position(|n| *n == joint.name).unwrap_or_else(|| panic!("{}", joint.name));
            at.0.extend((0..joint.nq).map(|i| qadr[k] as usize + i));
            at.1.extend((0..joint.nv).map(|i| vadr[k] as usize + i));
        }
        assert_eq!((names.len(), model.joints().len()), (names.len(), names.len()), "{name}");
        Robot { name: name.clone(), file: file.clone(), model, at }
    };
    all.as_object().unwrap().iter().map(robot).collect()
}

/// A state of the fixture in our order, and MuJoCo's numbers.
struct State<'a> {
    q: Vec<f64>,
    v: Vec<f64>,
    a: Vec<f64>,
    file: &'a Value,
}

impl Robot {
    fn states(&self) -> Vec<State<'_>> {
        let m = &self.model;
        let state = |file| -> State<'_> {
            let file: &Value = file;
            let take = |key: &str, at: &[usize]| {
                let all = numbers(&file[key]);
                at.iter().map(|i| all[*i]).collect::<Vec<f64>>()
            };
            let (qpos, qvel, qacc) =
                (take("qpos", &self.at.0), take("qvel", &self.at.1), take("qacc", &self.at.1));
            let (mut q, mut v, mut a) = (qpos.clone(), qvel.clone(), qacc.clone());
            c::q_from_mujoco(m, &qpos, &mut q);
            c::v_from_mujoco(m, &q, &qvel, &mut v);
            c::a_from_mujoco(m, &q, &v, &qacc, &mut a);
            State { q, v, a, file }
        };
        self.file["states"].as_array().unwrap().iter().map(state).collect()
    }

    /// A velocity-like vector of ours in MuJoCo's coordinates and order.
    fn to_mujoco(&self, q: &[f64], x: &[f64]) -> Vec<f64> {
        let (mut turned, mut out) = (x.to_vec(), x.to_vec());
        c::v_to_mujoco(&self.model, q, x, &mut turned);
        self.at.1.iter().enumerate().for_each(|(ours, theirs)| out[*theirs] = turned[ours]);
        out
    }
}

fn close(ours: &[f64], theirs: &[f64], tolerance: f64, what: &str) {
    assert_eq!(ours.len(), theirs.len(), "{what}");
    let size = theirs.iter().fold(1.0f64, |m, x| m.max(x.abs()));
    for (a, b) in ours.iter().zip(theirs) {
        assert!((a - b).abs() <= tolerance * size, "{what}: {a} against {b}, of {size}");
    }
}

#[test]
fn frames_are_mujoco_s() {
    for robot in robots() {
        let (m, nv) = (&robot.model, robot.model.nv());
        let mut k = Kinematics::new(m);
        for s in robot.states() {
            k.update(&s.q, &s.v, &s.a);
            for theirs in s.file["frames"].as_array().unwrap() {
                let link = theirs["name"].as_str().unwrap();
                let (id, what) = (m.frame(link).unwrap(), format!("{} {link}", robot.name));
                let f = k.frame(id);
                close(&f.position, &numbers(&theirs["position"]), 1e-12, &what);
                close(&f.rotation.concat(), &numbers(&theirs["rotation"]), 1e-12, &what);
                let velocity = [f.velocity, f.angular_velocity].concat();
                close(&velocity, &numbers(&theirs["velocity"]), 1e-12, &what);
                let acceleration = [f.acceleration, f.angular_acceleration].concat();
                close(&acceleration, &numbers(&theirs["acceleration"]), 1e-11, &what);

                let (mut j, jacobian) = (vec![0.0; 6 * nv], numbers(&theirs["jacobian"]));
                k.jacobian(id, &mut j);
                for i in 0..nv {
                    let mut unit = vec![0.0; nv];
                    unit[i] = 1.0;
                    let e = robot.to_mujoco(&s.q, &unit);
                    for r in 0..6 {
                        let column: f64 = (0..nv).map(|k| jacobian[r * nv + k] * e[k]).sum();
                        assert!((column - j[r * nv + i]).abs() < 1e-12, "{what} row {r} dof {i}");
                    }
                    assert_eq!(
                        m.moves(i, id),
                        (0..6).any(|r| j[r * nv + i] != 0.0),
                        "{what} {}",
                        m.dof_name(i)
                    );
                }
            }
            let energy = s.file["energy"].as_f64().unwrap();
            let ours = k.kinetic_energy(&s.q, &s.v);
            assert!((ours / energy - 1.0).abs() < 1e-12, "{}: {ours} J, MuJoCo {energy} J", robot.name);
        }
    }
}

#[test]
fn masses_and_forces_of_floating_bases_are_mujoco_s() {
    for robot in robots() {
        let (m, nv) = (&robot.model, robot.model.nv());
        let mass = robot.file["moving_mass"].as_f64().unwrap();
        assert!(
            (m.total_mass() / mass - 1.0).abs() < 1e-12,
            "{}: {} kg, {mass} kg",
            robot.name,
            m.total_mass()
        );
        let mut d = Dynamics::new(m);
        for s in robot.states() {
            let (mut tau, mut passive, mut rest) = (vec![0.0; nv], vec![0.0; nv], vec![0.0; nv]);
            d.rnea(&s.q, &s.v, &s.a, &mut tau);
            d.passive(&s.q, &s.v, &mut passive);
            close(&robot.to_mujoco(&s.q, &passive), &numbers(&s.file["passive"]), 1e-12, &robot.name);
            tau.iter_mut().zip(&passive).for_each(|(t, p)| *t -= p);
            close(&robot.to_mujoco(&s.q, &tau), &numbers(&s.file["inverse"]), 1e-11, &robot.name);
            c::a_from_mujoco(m, &s.q, &s.v, &vec![0.0; nv], &mut rest);
            d.rnea(&s.q, &s.v, &rest, &mut tau);
            close(&robot.to_mujoco(&s.q, &tau), &numbers(&s.file["nle"]), 1e-11, &robot.name);
        }
    }
}

/// Along `q(t) = q + t v + t^2 a / 2` with velocity `v + t a`, to second order.
#[test]
fn points_move_as_finite_differences_say() {
    const H: f64 = 1e-4;
    for robot in robots() {
        let (m, nv) = (&robot.model, robot.model.nv());
        let (mut k, mut d) = (Kinematics::new(m), Dynamics::new(m));
        let local = [0.1, -0.2, 0.3];
        for s in robot.states() {
            let link = s.file["frames"][1]["name"].as_str().unwrap();
            let id = m.frame(link).unwrap();
            let (v, a) = (s.v.clone(), s.a.iter().map(|x| 0.1 * x).collect::<Vec<f64>>());
            let mut at = |t: f64| {
                let dq: Vec<f64> = (0..nv).map(|i| t * v[i] + 0.5 * t * t * a[i]).collect();
                let mut q = s.q.clone();
                d.integrate(&s.q, &dq, &mut q);
                k.update(&q, &v, &a);
                k.point(id, local)
            };
            let (before, now, after) = (at(-H).position, at(0.0), at(H).position);
            for x in 0..3 {
                let speed = (after[x] - before[x]) / (2.0 * H);
                let acceleration = (after[x] - 2.0 * now.position[x] + before[x]) / (H * H);
                assert!((speed - now.velocity[x]).abs() < 1e-5, "{} {speed} {:?}", robot.name, now);
                let off = (acceleration - now.acceleration[x]).abs();
                assert!(off < 1e-4 * (10.0 + acceleration.abs()), "{} {acceleration} {now:?}", robot.name);
            }
            at(0.0);
            let mut j = vec![0.0; 3 * nv];
            k.point_jacobian(id, local, &mut j);
            let velocity: Vec<f64> = (0..3).map(|r| (0..nv).map(|i| j[r * nv + i] * v[i]).sum()).collect();
            close(&velocity, &now.velocity, 1e-12, &robot.name);
        }
    }
}

/// A robot standing still on one foot needs what the foot's force times the Jacobian gives: with the weight of the whole robot
/// pushing at the centre of pressure, no force is missing at the base.
#[test]
fn a_wrench_on_a_foot_carries_the_robot() {
    let m = free("solo12/solo12.urdf");
    let (nv, feet) = (m.nv(), ["FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT"]);
    let (mut d, mut k) = (Dynamics::new(&m), Kinematics::new(&m));
    let (q, zero) = (m.neutral(), vec![0.0; nv]);
    k.update(&q, &zero, &zero);
    let (mut nle, mut contact) = (vec![0.0; nv], vec![0.0; nv]);
    d.nle(&q, &zero, &mut nle);
    for foot in feet {
        let force = m.total_mass() * 9.81 / 4.0;
        k.add_wrench(m.frame(foot).unwrap(), [0.0, 0.0, force, 0.0, 0.0, 0.0], &mut contact);
    }
    let missing: Vec<f64> = (0..6).map(|i| nle[i] - contact[i]).collect();
    assert!(nle[2] > 24.0 && missing[..3].iter().all(|x| x.abs() < 1e-9), "{missing:?}");
    // A pure moment about the vertical reaches the base unchanged.
    let mut moment = vec![0.0; nv];
    k.add_wrench(m.frame("FL_FOOT").unwrap(), [0.0, 0.0, 0.0, 0.0, 0.0, 2.0], &mut moment);
    close(&moment[..6], &[0.0, 0.0, 0.0, 0.0, 0.0, 2.0], 1e-12, "moment");
}

#[test]
fn the_world_does_not_move_and_names_are_helped_with() {
    let m = panda();
    let mut k = Kinematics::new(&m);
    k.update(&m.neutral(), &[1.0; 7], &[1.0; 7]);
    let world = k.point(FrameId::WORLD, [1.0, 2.0, 3.0]);
    assert_eq!((world.position, world.velocity, world.acceleration), ([1.0, 2.0, 3.0], [0.0; 3], [0.0; 3]));
    let mut j = vec![1.0; 42];
    k.jacobian(FrameId::WORLD, &mut j);
    assert_eq!(j, vec![0.0; 42]);
    assert_eq!(m.frame("universe"), Ok(FrameId::WORLD));
    assert_eq!(m.frame_name(m.frame("panda_hand").unwrap()), "panda_hand");
    let text = m.frame("panda_hnad").unwrap_err().to_string();
    assert!(text.contains("'panda_hnad'") && text.contains("did you mean 'panda_hand'"), "{text}");
}

#[test]
fn seven_robots_have_the_limits_their_files_state() {
    let count = |m: &Model| {
        let finite = |x: &[f64]| x.iter().filter(|x| x.is_finite()).count();
        let missing = (0..m.nv()).filter(|i| m.position_limit_missing(*i)).count();
        (
            m.nv(),
            finite(m.upper_position_limit()),
            finite(m.velocity_limit()),
            finite(m.effort_limit()),
            missing,
        )
    };
    for (file, nv) in [("panda", 7), ("ur5", 6), ("xarm7", 7)] {
        assert_eq!(count(&robot(&format!("{file}/{file}.urdf"))), (nv, nv, nv, nv, 0), "{file}");
    }
    for (file, nv) in [("solo12", 18), ("anymal", 18), ("g1", 35), ("simple_humanoid", 35)] {
        let (m, joints) = (free(&format!("{file}/{file}.urdf")), nv - 6);
        assert_eq!(count(&m), (nv, joints, joints, joints, 0), "{file}");
        assert_eq!((m.joints()[0].name.as_str(), m.dof_name(3).as_str()), ("root_joint", "root_joint[3]"));
    }
}
