//! What meters and evaluations print, against what MuJoCo has and against arithmetic by hand.

use nearl_runtime::Snapshot;
use nearl_runtime::link::{ActionMessage, Message, Plant};
use nearl_tests::random_policy;
use nearl_trainer::evaluate::{Evaluation, evaluate};
use nearl_trainer::plant::MujocoPlant;
use nearl_trainer::{env, rollout, tasks, train};

/// The two-link arm in a folder of its own, its robot file and its task changed.
fn two_link(
    robot: impl Fn(String) -> String,
    task: impl Fn(String) -> String,
) -> (tempfile::TempDir, String) {
    let folder = tempfile::tempdir().expect("a folder");
    let read = |name: &str| {
        let file = format!("{}/fixtures/{name}", env!("CARGO_MANIFEST_DIR"));
        std::fs::read_to_string(file).expect("a fixture")
    };
    std::fs::write(folder.path().join("two_link.xml"), robot(read("two_link.xml"))).expect("a robot");
    let file = folder.path().join("two_link.toml");
    std::fs::write(&file, task(read("two_link.toml"))).expect("a task");
    (folder, file.display().to_string())
}

/// Without dampers MuJoCo's Euler step is `v' = v + h a` with its own acceleration `a`: the plant's meter must find the largest `a` that
/// MuJoCo computed, in the tick in which it was, and count the ticks beyond the limit.
#[test]
fn the_plants_acceleration_is_that_of_mujoco() {
    let undamped = |text: String| {
        text.replace(r#" damping="3" stiffness="15" springref="0.3""#, "")
            .replace(r#" damping="1" stiffness="4""#, "")
    };
    let (_folder, file) = two_link(undamped, |text| text);
    let mut manifest = tasks::load(&file, &[]).expect("a task");
    train::complete(&mut manifest).expect("a whole task");
    let (limit, seed) = (30.0, 3);
    let mut plant = MujocoPlant::new(&manifest, seed, false).expect("a plant");
    let mut twin = env::of_task(&manifest, "two_link").expect("the same environment");
    twin.reset(&mut rollout::stream(seed, 0)).expect("the same start");
    let (mut beyond, mut most, mut at) = (0, f64::NEG_INFINITY, (0, 0));
    for tick in 0..400_u64 {
        let torque = [4.0 * (0.13 * tick as f64).sin(), 0.7 * (0.31 * tick as f64).cos()];
        let mut action = ActionMessage::zeroed();
        action.action[..2].copy_from_slice(&torque);
        plant.apply(&action);
        twin.step(&torque);
        let worst = twin.sim().acceleration().iter().map(|a| a.abs() - limit);
        let (dof, excess) = worst.enumerate().max_by(|a, b| a.1.total_cmp(&b.1)).expect("two dofs");
        beyond += u64::from(excess > 0.0);
        if excess > most {
            (most, at) = (excess, (dof, tick));
        }
    }
    let found = plant.meter().acceleration();
    assert!(beyond > 20 && beyond < 400, "{beyond} of 400 ticks are beyond the limit");
    assert_eq!((found.states, (found.index, found.at)), (beyond, at));
    assert!((found.excess - most).abs() < 1e-9 * limit, "{} instead of {most}", found.excess);
}

/// A push is no force of a motor, and a heavier robot than the file's needs no other one: the plant counts what its motors exert.
#[test]
fn the_plants_torque_is_that_of_its_motors() {
    let set = [
        "pushes={ every = 0.05, base = \"3 * uniform\", joints = \"3 * uniform\" }",
        "random={ mass = 1.4 }",
        "constraints.torque.scale=0.6",
        "termination={}",
    ];
    let mut manifest = tasks::load(&crate::leg::leg(), &set.map(String::from)).expect("a task");
    train::complete(&mut manifest).expect("a whole task");
    let mut plant = MujocoPlant::new(&manifest, 4, false).expect("a plant");
    let mut twin = env::of_task(&manifest, "leg").expect("the same environment");
    twin.reset(&mut rollout::stream(4, 0)).expect("the same start");
    let (mut beyond, mut most) = (0, 0.0_f64);
    for tick in 0..200_u64 {
        let target = [0.4 + 0.3 * (0.1 * tick as f64).sin(), -0.8 + 0.3 * (0.2 * tick as f64).cos()];
        let mut action = ActionMessage::zeroed();
        action.action[..2].copy_from_slice(&target);
        plant.apply(&action);
        twin.step(&target);
        let excess = [(6, 0.6 * 20.0), (7, 0.6 * 15.0)]
            .map(|(dof, most)| twin.sim().applied_force_of(dof).abs() - most);
        beyond += u64::from(excess.iter().any(|e| *e > 1e-9));
        most = most.max(excess[0]).max(excess[1]);
    }
    let found = plant.meter().records()[3].expect("torque is measured");
    assert!(beyond > 10 && beyond < 190, "{beyond} of 200 ticks are beyond the limit");
    assert_eq!((found.states, found.excess), (beyond, most));
}

fn raw(file: &str, seed: u64) -> (Snapshot, Evaluation) {
    let snapshot = random_policy(file, seed, 3.0);
    let found = evaluate(&snapshot, 4, 0, false).expect("an evaluation");
    (snapshot, found)
}

/// What a joint exceeded the robot's own limit by does not depend on the margin that a task keeps: without projection the motion is the same with
/// any margin, and the task without one says it directly.
#[test]
fn an_evaluation_tells_the_excess_beyond_the_real_limit_from_that_beyond_the_margin() {
    let wide = |text: String| text.replace("margin = 0.02", "margin = 0.5");
    let none = |text: String| text.replace("margin = 0.02", "margin = 0.0");
    let (_a, with) = two_link(|text| text, wide);
    let (_b, without) = two_link(|text| text, none);
    let ((_, with), (_, without)) = (raw(&with, 5), raw(&without, 5));
    let position =
        |e: &Evaluation| e.worst.iter().find(|w| w.limit == "position").cloned().expect("an excess");
    let (with, own) = (position(&with), position(&without));
    assert!(own.by > 0.0, "the motion never left the robot's own limits");
    assert_eq!(with.beyond_margin, own.by);
    assert!(with.by >= with.beyond_margin + 0.5 - 1e-12, "{} and {}", with.by, with.beyond_margin);
}

/// Mean and spread by hand, with n - 1; one episode has no spread.
#[test]
fn an_evaluation_has_the_spread_of_its_returns() {
    let (snapshot, found) = raw("Panda-reach", 6);
    let [a, b, c, d] = found.returns[..] else { panic!("four episodes: {:?}", found.returns) };
    let mean = (a + b + c + d) / 4.0;
    let variance = [a, b, c, d].map(|x| (x - mean) * (x - mean)).iter().sum::<f64>() / 3.0;
    assert!((found.mean_return() - mean).abs() < 1e-9 * mean.abs());
    assert!(variance > 0.0 && (found.std_return() - variance.sqrt()).abs() < 1e-9 * variance.sqrt());
    assert_eq!(evaluate(&snapshot, 1, 0, false).expect("an evaluation").std_return(), 0.0);
}
