//! The model computes what MuJoCo 3.17.0 computes on the same file: numbers in `fixtures/mujoco.json`, written by
//! `fixtures/generate.py`.

use crate::common::described;
use nearl_constraints::{Dynamics, Model, Period, convention as c};
use serde_json::Value;
use std::path::{Path, PathBuf};

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn robots() -> Vec<(String, Value, Model)> {
    let text = std::fs::read_to_string(root().join("constraints/tests/fixtures/mujoco.json")).unwrap();
    let all: Value = serde_json::from_str(&text).unwrap();
    let load = |robot: &Value| {
        let path = root().join(robot["file"].as_str().unwrap());
        match path.extension().unwrap() == "urdf" {
            true => Model::from_urdf(&path).unwrap(),
            false => described(path.file_stem().unwrap().to_str().unwrap()),
        }
    };
    all.as_object().unwrap().iter().map(|(name, robot)| (name.clone(), robot.clone(), load(robot))).collect()
}

/// Largest difference over the largest number.
fn relative(ours: &[f64], theirs: &[f64]) -> f64 {
    assert_eq!(ours.len(), theirs.len());
    let size = theirs.iter().fold(1e-3f64, |m, x| m.max(x.abs()));
    ours.iter().zip(theirs).fold(0.0f64, |m, (a, b)| m.max((a - b).abs())) / size
}

#[test]
fn joints_ranges_and_mass_are_mujoco_s() {
    for (name, robot, model) in robots() {
        assert_eq!(
            (model.nq() as u64, model.nv() as u64),
            (robot["nq"].as_u64().unwrap(), robot["nv"].as_u64().unwrap())
        );
        assert!((model.total_mass() / robot["total_mass"].as_f64().unwrap() - 1.0).abs() < 1e-13, "{name}");
        let names: Vec<&str> =
            robot["joints"].as_array().unwrap().iter().map(|x| x.as_str().unwrap()).collect();
        assert_eq!(model.joints().iter().map(|j| j.name.as_str()).collect::<Vec<_>>(), names);
        for (k, joint) in model.joints().iter().enumerate().filter(|(_, j)| j.nq == 1) {
            let range = numbers(&robot["range"][k]);
            let (lower, upper) =
                (model.lower_position_limit()[joint.idx_q], model.upper_position_limit()[joint.idx_q]);
            match robot["limited"][k].as_bool().unwrap() {
                true => assert!(
                    (lower - range[0]).abs() < 1e-14 && (upper - range[1]).abs() < 1e-14,
                    "{name} {joint:?}"
                ),
                false => assert!(lower == f64::NEG_INFINITY && upper == f64::INFINITY, "{name} {joint:?}"),
            }
        }
    }
}

/// The projector's rows and what its checker asks for; with several physics steps in a period a mass matrix alone would not do.
#[test]
fn rows_of_the_motors_are_the_motors() {
    for (name, robot, model) in robots() {
        let (nq, nv) = (model.nq(), model.nv());
        let mut dynamics = Dynamics::new(&model);
        for (state, sub_steps) in
            robot["states"].as_array().unwrap().iter().zip([0, 1, 5].into_iter().cycle())
        {
            let (mut q, mut v, mut a) = (vec![0.0; nq], vec![0.0; nv], vec![0.0; nv]);
            c::q_from_mujoco(&model, &numbers(&state["qpos"]), &mut q);
            c::v_from_mujoco(&model, &q, &numbers(&state["qvel"]), &mut v);
            c::a_from_mujoco(&model, &q, &v, &numbers(&state["qacc"]), &mut a);
            let period = Period::new(0.01, sub_steps);
            let (mut rows, mut tau, mut checked) = (vec![0.0; nv * nv], vec![0.0; nv], vec![0.0; nv]);
            dynamics.motor_rows(&period, &q, &v, &mut rows, &mut tau);
            tau.iter_mut().zip(rows.chunks(nv)).for_each(|(tau, row)| {
                *tau += row.iter().zip(&a).map(|(r, a)| r * a).sum::<f64>();
            });
            dynamics.motors(&period, &q, &v, &a, &mut checked);
            let off = relative(&tau, &checked);
            assert!(off < 1e-11, "{name}, {sub_steps} sub-steps: {off:e}");
        }
    }
}

/// Mass matrix: quadratic form in MuJoCo's velocities, so column k is M_pin applied to the converted unit vector k.
#[test]
fn equations_of_motion_are_mujoco_s() {
    for (name, robot, model) in robots() {
        let (nq, nv) = (model.nq(), model.nv());
        let mut dynamics = Dynamics::new(&model);
        let zeros = || vec![0.0; nv];
        for state in robot["states"].as_array().unwrap() {
            let (mut q, mut v, mut a) = (vec![0.0; nq], zeros(), zeros());
            c::q_from_mujoco(&model, &numbers(&state["qpos"]), &mut q);
            c::v_from_mujoco(&model, &q, &numbers(&state["qvel"]), &mut v);
            c::a_from_mujoco(&model, &q, &v, &numbers(&state["qacc"]), &mut a);

            let mut mass = vec![0.0; nv * nv];
            dynamics.mass(&q, &mut mass);
            let mut theirs_in_ours = Vec::new();
            for k in 0..nv {
                let (mut unit, mut column, mut out) = (zeros(), zeros(), zeros());
                unit[k] = 1.0;
                let mut turned = zeros();
                c::v_from_mujoco(&model, &q, &unit, &mut turned);
                for i in 0..nv {
                    column[i] = (0..nv).map(|j| mass[j * nv + i] * turned[j]).sum();
                }
                c::tau_to_mujoco(&model, &q, &column, &mut out);
                theirs_in_ours.extend(out);
            }
            let m_error = relative(&theirs_in_ours, &numbers(&state["mass"]));

            // MuJoCo's bias is the force at zero MuJoCo acceleration.
            let (mut a0, mut tau, mut out) = (zeros(), zeros(), zeros());
            c::a_from_mujoco(&model, &q, &v, &zeros(), &mut a0);
            dynamics.rnea(&q, &v, &a0, &mut tau);
            c::tau_to_mujoco(&model, &q, &tau, &mut out);
            let nle_error = relative(&out, &numbers(&state["nle"]));

            let mut passive = zeros();
            dynamics.passive(&q, &v, &mut passive);
            c::tau_to_mujoco(&model, &q, &passive, &mut out);
            let passive_error = relative(&out, &numbers(&state["passive"]));

            dynamics.rnea(&q, &v, &a, &mut tau);
            let needed: Vec<f64> = (0..nv).map(|i| tau[i] - passive[i]).collect();
            c::tau_to_mujoco(&model, &q, &needed, &mut out);
            let inverse_error = relative(&out, &numbers(&state["inverse"]));

            let (mut nle, mut back) = (zeros(), zeros());
            dynamics.nle(&q, &v, &mut nle);
            dynamics.aba(&q, &v, &tau, &mut back);
            let aba_error = relative(&back, &a);
            let sum: Vec<f64> =
                (0..nv).map(|i| nle[i] + (0..nv).map(|j| mass[j * nv + i] * a[j]).sum::<f64>()).collect();
            let sum_error = relative(&sum, &tau);
            println!(
                "{name}: M {m_error:.1e} nle {nle_error:.1e} passive {passive_error:.1e} inverse {inverse_error:.1e} aba {aba_error:.1e} sum {sum_error:.1e}"
            );
            assert!(m_error < 1e-12, "{name}: mass matrix differs by {m_error:e}");
            assert!(nle_error < 1e-10, "{name}: nle differs by {nle_error:e}");
            assert!(passive_error < 1e-12, "{name}: passive forces differ by {passive_error:e}");
            assert!(inverse_error < 1e-10, "{name}: inverse dynamics differs by {inverse_error:e}");
            assert!(aba_error < 1e-8 && sum_error < 1e-11, "{name}: {aba_error:e} {sum_error:e}");
        }
    }
}

#[test]
fn conversions_invert_each_other() {
    for (name, robot, model) in robots() {
        let state = &robot["states"][0];
        let (qpos, qvel, qacc) = (numbers(&state["qpos"]), numbers(&state["qvel"]), numbers(&state["qacc"]));
        let (mut q, mut back) = (qpos.clone(), qpos.clone());
        c::q_from_mujoco(&model, &qpos, &mut q);
        c::q_to_mujoco(&model, &q, &mut back);
        assert_eq!(back, qpos, "{name}");
        let (mut v, mut a, mut x) = (qvel.clone(), qvel.clone(), qvel.clone());
        c::v_from_mujoco(&model, &q, &qvel, &mut v);
        c::v_to_mujoco(&model, &q, &v, &mut x);
        assert!(relative(&x, &qvel) < 1e-14);
        c::a_from_mujoco(&model, &q, &v, &qacc, &mut a);
        c::a_to_mujoco(&model, &q, &v, &a, &mut x);
        assert!(relative(&x, &qacc) < 1e-14);
    }
}

#[test]
fn motor_strength_is_gear_times_control_range() {
    let of = |robot: &str, joint: &str| {
        let model = described(robot);
        model.effort_limit()[model.joint(joint).unwrap().idx_v]
    };
    assert_eq!(of("half_cheetah", "bfoot"), 60.0);
    assert_eq!(of("ant", "hip_1"), 150.0);
    assert_eq!(of("ant", "root"), f64::INFINITY);
    let odd = "odd";
    assert_eq!(of(odd, "turn"), 20.0); // ctrlrange -2 3 from the default class: the weaker side
    assert_eq!(of(odd, "elbow"), 4.0); // actuatorfrcrange below the motor's 100
    assert_eq!(of(odd, "tail_slide"), 10.0); // gain 5 x gear 2 x 1
    assert_eq!(of(odd, "slide"), f64::INFINITY);
}
