//! Tasks written in TOML: equal to native ones where they say the same, refused with the key where they are wrong, and
//! costs counted as Safety-Gymnasium counts them.

mod learning;
mod mistakes;
mod motors;
mod native;

use std::path::{Path, PathBuf};

use nearl_trainer::env::{self, Env};
use nearl_trainer::tasks;
use nearl_trainer::train::{Request, Training, complete};
use rand::RngExt;

fn fixture(name: &str) -> String {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures").join(name).display().to_string()
}

fn example(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/tasks").join(name)
}

/// The cart-pole in `folder` with `from` replaced by `to`, and its robot beside it.
fn edited(folder: &Path, from: &str, to: &str) -> String {
    let text = std::fs::read_to_string(example("cart-pole.toml")).expect("example");
    assert!(text.contains(from), "{from}");
    std::fs::copy(example("cart-pole.xml"), folder.join("cart-pole.xml")).expect("robot");
    let file = folder.join("mine.toml");
    std::fs::write(&file, text.replacen(from, to, 1)).expect("task");
    file.display().to_string()
}

fn random_action(env: &dyn Env, rng: &mut env::ChaCha8Rng) -> Vec<f64> {
    env.spec().action_low().zip(env.spec().action_high()).map(|(l, h)| rng.random_range(l..h)).collect()
}

const ELBOW: &str = "<motor joint=\"elbow\" ctrlrange=\"-30 30\"/>";

/// The two-link arm's task with another actuator.
fn with_motors(folder: &Path, from: &str, to: &str) -> String {
    let robot = std::fs::read_to_string(fixture("two_link.xml")).expect("robot");
    assert!(robot.contains(from));
    std::fs::write(folder.join("two_link.xml"), robot.replace(from, to)).expect("robot");
    let task = folder.join("two_link.toml");
    std::fs::copy(fixture("two_link.toml"), &task).expect("task");
    task.display().to_string()
}

fn trained(task: &str, algo: &str, steps: u64, set: &[&str]) -> (Training, Vec<f64>) {
    let set: Vec<String> = set.iter().map(|s| (*s).to_string()).collect();
    let mut manifest = tasks::load(task, &set).unwrap_or_else(|e| panic!("{e}"));
    complete(&mut manifest).expect("manifest");
    let mut training = Training::new(&Request {
        manifest,
        algo: algo.parse().expect("algorithm"),
        steps,
        seed: 0,
        threads: 2,
    })
    .expect("training");
    let mut returns = Vec::new();
    while !training.is_done() {
        returns.push(training.iterate().return_mean);
    }
    (training, returns)
}

/// The task file of an arm whose robot is a URDF, with another section.
fn urdf_arm(folder: &Path, section: &str) -> String {
    let link = |name: &str, z: f64| {
        format!(
            r#"<link name="{name}"><inertial><origin xyz="0 0 {z}"/><mass value="1"/><inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.01"/>
            </inertial></link>"#
        )
    };
    let joint = |name: &str, kind: &str, ends: [&str; 2], limit: &str| {
        format!(
            r#"<joint name="{name}" type="{kind}"><parent link="{}"/><child link="{}"/><origin xyz="0 0 -0.4"/><axis xyz="0 1 0"/>
            <limit {limit} effort="40" velocity="4"/><dynamics damping="0.5" friction="0"/></joint>"#,
            ends[0], ends[1]
        )
    };
    let text = format!(
        r#"<robot name="arm"><link name="base"/>{}{}{}{}</robot>"#,
        link("upper", -0.2),
        link("lower", -0.15),
        // in an order that is not that of the names
        joint("z_shoulder", "revolute", ["base", "upper"], r#"lower="-2" upper="2""#),
        joint("a_elbow", "continuous", ["upper", "lower"], ""),
    );
    std::fs::write(folder.join("arm.urdf"), &text).expect("robot");
    let task = std::fs::read_to_string(fixture("two_link.toml")).expect("task");
    let task = task
        .replace("mjcf = \"two_link.xml\"", "urdf = \"arm.urdf\"")
        .replace("-v.elbow^2", "-v.a_elbow^2")
        .replace("dt = 0.01\nsim_dt = 0.01", "dt = 0.002\nsim_dt = 0.002")
        .replace("[state]\n", "[state]\ncontrollable = [\"z_shoulder\", \"a_elbow\"]\n");
    let file = folder.join("arm.toml");
    std::fs::write(&file, task + section).expect("task");
    file.display().to_string()
}
