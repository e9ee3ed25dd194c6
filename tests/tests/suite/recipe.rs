//! What a policy made elsewhere sees is computed from the state; compared with hand arithmetic.

use nearl_runtime::State;
use nearl_runtime::constraints::{Model, StateLayout};
use nearl_runtime::recipe::{Observer, PolicySection};

const URDF: &str = include_str!("../../../examples/robots/solo12/solo12.urdf");

fn section(terms: &str) -> PolicySection {
    let text = format!("joints = [\"FR_KFE\", \"FL_HAA\"]\npose = [0.5, -0.25]\nobservation = [{terms}]");
    toml::from_str(&text).expect("a section")
}

fn setting(entries: &[&str]) -> (Model, StateLayout) {
    let model = Model::from_urdf_text_free_flyer(URDF).expect("solo12");
    let names: Vec<String> = entries.iter().map(|e| (*e).to_string()).collect();
    let layout = StateLayout::new(&model, &names, Some(&names[..1]), None).expect("layout");
    (model, layout)
}

fn close(have: &[f64], want: &[f64]) {
    assert_eq!(have.len(), want.len(), "{have:?} {want:?}");
    assert!(have.iter().zip(want).all(|(h, w)| (h - w).abs() < 1e-12), "{have:?} {want:?}");
}

/// A quarter turn about an axis of the world: gravity points along another axis of the base.
#[test]
fn terms_of_the_base() {
    let (model, layout) = setting(&["q.FR_KFE"]);
    let terms = r#"{ term = "projected_gravity" }, { term = "base_lin_vel", scale = 2.0 }, { term = "base_ang_vel", clip = [-1, 1] },
        { term = "base_lin_vel", point = [0, 0, 0.5] }"#;
    let mut observer = Observer::new(&section(terms), &model, &layout).expect("terms").expect("some");
    assert_eq!(observer.len(), 12);
    let mut state = State { q: model.neutral(), v: vec![0.0; model.nv()], obs: vec![0.0] };
    state.v[..6].copy_from_slice(&[1.0, 2.0, 3.0, 4.0, 0.5, -6.0]);
    let rest = [2.0, 4.0, 6.0, 1.0, 0.5, -1.0, 1.0 + 0.25, 2.0 - 2.0, 3.0];
    let half = 0.5_f64.sqrt();
    for (quaternion, down) in [
        ([0.0, 0.0, 0.0, 1.0], [0.0, 0.0, -1.0]),
        ([half, 0.0, 0.0, half], [0.0, -1.0, 0.0]), // rolled to its left side
        ([0.0, half, 0.0, half], [1.0, 0.0, 0.0]),  // nose down
        ([0.0, 0.0, half, half], [0.0, 0.0, -1.0]), // turned
    ] {
        state.q[3..7].copy_from_slice(&quaternion);
        close(observer.observe(&state, 0.0), &[&down[..], &rest].concat());
    }
}

#[test]
fn terms_of_joints_command_phase_and_memory() {
    let (model, layout) = setting(&["q.FR_KFE", "command.x"]);
    let terms = r#"{ term = "joint_pos" }, { term = "joint_vel", joints = ["HL_HFE"], history = 3 }, { term = "command", entries = ["command.x"] },
        { term = "last_action", history = 2 }, { term = "phase", period = 0.8, shifts = [0.0, 0.5] }, { term = "constant", value = [7] },
        { term = "velocity_commands", value = [0.25] }"#;
    let mut observer = Observer::new(&section(terms), &model, &layout).expect("terms").expect("some");
    let mut state = State { q: model.neutral(), v: vec![0.0; model.nv()], obs: vec![0.0, 0.0] };
    let at = |name: &str| model.joint(name).expect("a joint");
    let mut speeds: Vec<f64> = Vec::new();
    for reset in 0..2 {
        speeds.clear();
        observer.reset();
        let mut outputs = [[0.0_f32; 2]; 2];
        for tick in 0..5 {
            let t = f64::from(tick) + 10.0 * f64::from(reset);
            state.q[at("FR_KFE").idx_q] = 0.1 * t;
            state.q[at("FL_HAA").idx_q] = -0.2 * t;
            state.v[at("HL_HFE").idx_v] = 3.0 * t;
            state.obs[1] = 5.0 + t;
            let time = 0.02 * f64::from(tick);
            speeds.push(3.0 * t);
            let ago = |k: usize| speeds[speeds.len().saturating_sub(k + 1)];
            let angle = std::f64::consts::TAU * time / 0.8;
            let last: Vec<f64> = outputs.iter().flatten().map(|x| f64::from(*x)).collect();
            let joints = [0.1 * t - 0.5, -0.2 * t + 0.25, ago(2), ago(1), ago(0), 5.0 + t];
            let phase = [angle.cos(), -angle.cos(), angle.sin(), -angle.sin(), 7.0, 0.25];
            close(observer.observe(&state, time), &[&joints[..], &last, &phase].concat());
            outputs = [outputs[1], [t as f32, -t as f32]];
            observer.acted(&outputs[1]);
        }
    }
}

/// Every refusal names the term and what is missing.
#[test]
fn what_cannot_be_computed_is_named() {
    let (model, layout) = setting(&["q.FR_KFE"]);
    for (terms, said) in [
        (
            r#"{ term = "command", entries = ["command.x"] }"#,
            "term 1 ('command'): the plant does not observe 'command.x'",
        ),
        (r#"{ term = "command" }"#, "it names no entries"),
        (r#"{ term = "phase" }"#, "it has no period"),
        (r#"{ term = "joint_pos", joints = ["FR_KFF"] }"#, "FR_KFF"),
        (r#"{ term = "joint_vel", history = 0 }"#, "a history of 0 ticks"),
        (r#"{ term = "joint_vel", clip = [1, -1] }"#, "a clip from 1 to -1"),
    ] {
        let refused = Observer::new(&section(terms), &model, &layout).err().expect("refused");
        assert!(refused.contains(said), "{refused}");
    }
    let fixed = Model::from_urdf_text(URDF).expect("solo12");
    let names = ["q.FR_KFE".to_string()];
    let layout = StateLayout::new(&fixed, &names, None, None).expect("layout");
    let refused =
        Observer::new(&section(r#"{ term = "base_ang_vel" }"#), &fixed, &layout).err().expect("refused");
    assert!(refused.contains("the robot's base is fixed"), "{refused}");
}
