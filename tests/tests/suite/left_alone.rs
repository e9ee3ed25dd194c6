//! Robots of which a task commands some joints and leaves others alone (a gripper, a wrist that turns without end), and what robot files and recipes
//! say that no command follows from.

use std::path::{Path, PathBuf};

use nearl_runtime::constraints::Model;
use nearl_runtime::link::{ActionMessage, Message, Plant, StateMessage};
use nearl_runtime::{Controller, Manifest, doctor};
use nearl_tests::request;
use nearl_trainer::env::Env;
use nearl_trainer::import::{self, Setting};
use nearl_trainer::plant::MujocoPlant;
use nearl_trainer::rollout::stream;
use nearl_trainer::train::Training;
use nearl_trainer::{blank, export, robot, tasks};
use rand::RngExt;

use crate::leg::{fixture, leg};

/// An arm of two joints with a wrist without ends and two fingers, the right one first: in the order of names it is last.
fn arm(mimic: &str) -> String {
    let link = |name: &str, mass: f64| {
        format!(
            "<link name=\"{name}\"><inertial><origin xyz=\"0 0 0.1\"/><mass value=\"{mass}\"/>\
             <inertia ixx=\"0.01\" iyy=\"0.01\" izz=\"0.01\" ixy=\"0\" ixz=\"0\" iyz=\"0\"/></inertial></link>"
        )
    };
    let joint = |name: &str, of: [&str; 2], kind: &str, axis: &str, limit: &str, more: &str| {
        format!(
            "<joint name=\"{name}\" type=\"{kind}\"><origin xyz=\"0 0 0.3\"/><parent link=\"{}\"/><child link=\"{}\"/><axis xyz=\"{axis}\"/>\
             <limit {limit}/>{more}</joint>",
            of[0], of[1]
        )
    };
    let arm = "lower=\"-2\" upper=\"2\" effort=\"60\" velocity=\"3\"";
    let finger = "lower=\"0\" upper=\"0.04\" effort=\"20\" velocity=\"0.2\"";
    [
        "<robot name=\"arm\"><link name=\"base\"/>".to_string(),
        link("l1", 2.0),
        joint("shoulder", ["base", "l1"], "revolute", "0 1 0", arm, ""),
        link("l2", 1.0),
        joint("elbow", ["l1", "l2"], "revolute", "0 1 0", arm, ""),
        link("hand", 0.3),
        joint("wrist", ["l2", "hand"], "continuous", "0 0 1", "effort=\"5\" velocity=\"6\"", ""),
        link("right", 0.05),
        joint("finger_right", ["hand", "right"], "prismatic", "0 -1 0", finger, mimic),
        link("left", 0.05),
        joint("finger_left", ["hand", "left"], "prismatic", "0 1 0", finger, ""),
        "</robot>".to_string(),
    ]
    .concat()
}

const TASK: &str = r#"
name = "left-alone"
[model]
urdf = "arm.urdf"
[time]
dt = 0.004
sim_dt = 0.002
[state]
controllable = ["shoulder", "elbow"]
observation = ["q.shoulder", "q.elbow", "v.shoulder", "v.elbow"]
[constraints]
position = { margin = 0.02 }
velocity = { scale = 0.8 }
acceleration = { limit = 15.0 }
torque = {}
[reset]
q = { wrist = 0.5, finger_left = 0.01, finger_right = 0.03 }
[idm]
kind = "pinocchio"
"#;
const DRIVES: &str = "[command]\ninterface = \"pd\"\nstiffness = 100.0\ndamping = 10.0\n";
const REWARD: &str = "[scene]\narmature = 0.05\nsolids = false\n[reward]\nstill = \"-v.shoulder^2\"\n[train]\nn_envs = 4\nn_steps = 32\n";

/// A task file beside the robot `text` in `folder`.
fn write(folder: &Path, robot: &str, task: &str) -> String {
    std::fs::write(folder.join("arm.urdf"), robot).expect("robot");
    let file = folder.join("task.toml");
    std::fs::write(&file, task).expect("task");
    file.display().to_string()
}

/// What the plant says of a joint: its entries in the configuration.
fn said<'a>(state: &'a StateMessage, model: &Model, joint: &str) -> &'a [f64] {
    let joint = model.joint(joint).expect("joint");
    &state.q[joint.idx_q..joint.idx_q + joint.nq]
}

#[test]
fn a_plant_brakes_where_some_joints_are_left_alone_and_one_turns_without_end() {
    for (drives, held) in [("", false), (DRIVES, true)] {
        let folder = tempfile::tempdir().expect("folder");
        let task = write(folder.path(), &arm(""), &format!("{TASK}{drives}"));
        let snapshot = blank::snapshot(&task, false).expect("a blank");
        let model = Controller::new(&snapshot).expect("a controller").model().clone();
        let mut plant = MujocoPlant::new(&snapshot.manifest, 0, false).expect("a plant");
        let mut state = StateMessage::zeroed();
        plant.observe(&mut state);
        assert_eq!((state.nq, state.nv, state.nu), (6, 5, 2));
        let near = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(near(said(&state, &model, "wrist"), &[0.5f64.cos(), 0.5f64.sin()]));
        // The model has the joints of a link by name, MuJoCo as the file lists them.
        assert!(near(said(&state, &model, "finger_left"), &[0.01]), "{:?}", &state.q[..6]);
        assert!(near(said(&state, &model, "finger_right"), &[0.03]), "{:?}", &state.q[..6]);
        (0..500).for_each(|_| plant.brake());
        plant.observe(&mut state);
        let elbow = model.joint("elbow").expect("joint").idx_v;
        assert!(state.v[elbow].abs() < 1e-2, "{}", state.v[elbow]);
        let [right, left] = ["finger_right", "finger_left"].map(|name| said(&state, &model, name)[0]);
        assert!(!held || ((right - 0.03).abs() < 5e-3 && (left - 0.01).abs() < 5e-3), "{right} {left}");
        let mut action = ActionMessage::zeroed();
        action.nu = 2;
        plant.apply(&action);
    }
}

/// By hand: 15 rad/s² take 0.06 rad/s off in a period of 4 ms.
#[test]
fn a_plant_of_positions_goes_on_slower_where_no_answer_came() {
    let folder = tempfile::tempdir().expect("folder");
    let position = "[command]\ninterface = { shoulder = \"position\", elbow = \"pd\" }\nstiffness = 100.0\ndamping = 10.0\n";
    let task = write(folder.path(), &arm(""), &format!("{TASK}{position}"));
    let snapshot = blank::snapshot(&task, false).expect("a blank");
    let mut plant = MujocoPlant::new(&snapshot.manifest, 0, false).expect("a plant");
    let mut action = ActionMessage::zeroed();
    action.nu = 2;
    for to in [[0.1, 0.3], [0.1004, 0.4]] {
        action.action[..2].copy_from_slice(&to);
        plant.apply(&action);
    }
    let mut state = StateMessage::zeroed();
    for to in [0.1004 + 0.004 * 0.04, 0.1004 + 0.004 * 0.04] {
        plant.hold(&action);
        plant.observe(&mut state);
        assert!(
            (state.applied[0] - to).abs() < 1e-15 && state.applied[1] == 0.4,
            "{:?}",
            &state.applied[..2]
        );
    }
    plant.brake();
    plant.apply(&action);
    plant.hold(&action);
    plant.observe(&mut state);
    assert_eq!(
        state.applied[..2],
        action.action[..2],
        "before it braked nothing was sent that it could go on from"
    );
}

#[test]
fn a_task_with_a_reward_leaves_a_gripper_alone() {
    let folder = tempfile::tempdir().expect("folder");
    let task = write(folder.path(), &arm(""), &format!("{TASK}{DRIVES}{REWARD}"));
    // Analytic inverse dynamics of the commanded joints: this was refused, and is trained.
    let mut training =
        Training::new(&request(&task, "pid2-ib", 0, 1, &["train.ppo.batch_size=64"])).expect("trains");
    training.iterate();
    assert_eq!(training.snapshot().manifest.action_lower.len(), 2);
    let mut env = tasks::env(&task).expect("environment");
    let names: Vec<&str> = env.spec().actuators.iter().map(|a| a.joint.as_str()).collect();
    assert_eq!(names, ["shoulder", "elbow"]);
    let place = |env: &dyn Env, name: &str| {
        env.qpos()[env.spec().joints.iter().find(|joint| joint.name == name).expect("joint").idx_q]
    };
    let mut rng = stream(1, 0);
    env.reset(&mut rng).expect("reset");
    let drawn: Vec<[f64; 2]> = (0..200).map(|_| [0, 1].map(|_| rng.random_range(-0.5..0.5))).collect();
    for action in &drawn[..100] {
        env.step(action);
    }
    for (name, at) in [("wrist", 0.5), ("finger_left", 0.01), ("finger_right", 0.03)] {
        let is = place(env.as_ref(), name);
        assert!((is - at).abs() < 0.01, "{name} was left at {at} and is at {is}");
    }
    // An episode that is taken up in its middle goes on with what it held.
    let mut other = env.another().expect("another");
    other.set_circumstances(&env.circumstances());
    other.set_state(env.qpos(), env.qvel()).expect("state");
    for action in &drawn[100..] {
        let [a, b] = [env.as_mut(), other.as_mut()].map(|env| env.step(action).reward);
        assert_eq!((a, env.qpos(), env.qvel()), (b, other.qpos(), other.qvel()));
    }
}

const MJCF: &str = r#"<mujoco model="arm"><option timestep="0.002"/><compiler angle="radian" autolimits="true"/><worldbody>
<body><joint name="j1" axis="0 1 0" range="-2 2" damping="1" armature="0.1"/><geom type="capsule" size="0.03" fromto="0 0 0 0 0 0.3"/>
<body pos="0 0 0.3"><joint name="lf" type="slide" axis="0 1 0" range="0 0.04"/><geom size="0.02" mass="0.05" pos="0 0.05 0"/></body>
<body pos="0 0 0.3"><joint name="rf" type="slide" axis="0 -1 0" range="0 0.04"/><geom size="0.02" mass="0.05" pos="0 -0.05 0"/></body></body>
</worldbody><tendon><fixed name="split"><joint joint="lf" coef="0.5"/><joint joint="rf" coef="0.5"/></fixed></tendon>
<actuator><general name="grip" tendon="split" forcerange="-100 100" ctrlrange="0 255" gainprm="0.0157 0 0" biasprm="0 -100 -10" biastype="affine"/>
<position name="a1" joint="j1" kp="200" kv="20" ctrlrange="-2.5 2.5" forcerange="-60 60"/></actuator></mujoco>"#;

fn mjcf(folder: &Path, more: &str) -> String {
    std::fs::write(folder.join("arm.xml"), MJCF).expect("robot");
    let task = format!(
        "name = \"grip\"\n[model]\nmjcf = \"arm.xml\"\n[time]\ndt = 0.004\nsim_dt = 0\n[command]\ninterface = \"pd\"\nstiffness = 200.0\ndamping = 20.0\n\
         [constraints]\nposition = {{ margin = 0.02 }}\nvelocity = {{ limit = 2.0 }}\nacceleration = {{ limit = 20.0 }}\ntorque = {{}}\n\
         [idm]\nkind = \"pinocchio\"\n{more}"
    );
    let file = folder.join("task.toml");
    std::fs::write(&file, task).expect("task");
    file.display().to_string()
}

/// An MJCF states no speeds: the task's count, and an actuator's own range is that of its targets.
#[test]
fn drives_of_an_mjcf_are_sent_what_its_actuators_take_and_a_tendon_s_actuator_is_left_alone() {
    let folder = tempfile::tempdir().expect("folder");
    let state = "[state]\ncontrollable = [\"j1\"]\nobservation = [\"q.j1\", \"v.j1\"]\n";
    let task = mjcf(folder.path(), state);
    let snapshot = blank::snapshot(&task, false).expect("a blank");
    assert_eq!(
        (&snapshot.manifest.action_lower[..], &snapshot.manifest.action_upper[..]),
        (&[-2.5][..], &[2.5][..])
    );
    let notes = doctor::told(&snapshot.manifest).expect("notes").join("; ");
    assert!(
        notes.contains("actuator 'grip' does not drive a joint with one dof") && notes.contains("control 0"),
        "{notes}"
    );
    let mut plant = MujocoPlant::new(&snapshot.manifest, 0, false).expect("a plant");
    (0..50).for_each(|_| plant.brake());
    let all = mjcf(folder.path(), "[state]\nobservation = [\"q.j1\", \"v.j1\"]\n[reward]\nstill = 1.0\n");
    let error = tasks::load(&all, &[]).expect_err("every actuator is to be commanded").to_string();
    assert!(error.contains("'grip'") && error.contains("state.controllable"), "{error}");
}

/// A policy that was trained here, exported and imported: the clip of its outputs is not the range of its drives.
#[test]
fn a_policy_of_drives_comes_back_with_the_range_of_its_drives() {
    let mut training = Training::new(&request(&leg(), "ppo", 0, 1, &[])).expect("trains");
    (0..2).for_each(|_| drop(training.iterate()));
    let snapshot = training.snapshot().clone();
    let network =
        import::onnx("policy.onnx", &export::onnx(&snapshot).expect("exports"), None, None).expect("reads");
    let urdf: PathBuf = fixture("leg.urdf");
    let back =
        import::snapshot(&network, &Setting { name: "back", robot: &urdf, recipes: &[] }).expect("imports");
    let range = |m: &Manifest| [m.action_lower.clone(), m.action_upper.clone()];
    let close = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9);
    let [own, again] = [range(&snapshot.manifest), range(&back.manifest)];
    assert!(own.iter().zip(&again).all(|(a, b)| close(a, b)), "{own:?} {again:?}");
    // What the policy can ask for: pose + 0.5 x (2 either way).
    assert!(own[0][0] < 0.4 - 1.0 - 0.5 && own[1][0] > 0.4 + 1.0 + 0.5, "{own:?}");
    let mut both = [&snapshot, &back].map(|s| Controller::new(s).expect("controller"));
    assert_eq!(both[0].state().obs.len(), both[1].state().obs.len());
    let mut rng = stream(3, 0);
    for _ in 0..100 {
        let drawn: Vec<f64> = (0..40).map(|_| rng.random_range(-0.5..0.5)).collect();
        let actions = both.each_mut().map(|controller| {
            let (mut state, mut out) = (controller.state(), controller.output());
            let n = state.obs.len();
            state.obs.copy_from_slice(&drawn[..n]);
            state.q[7..9].copy_from_slice(&drawn[20..22]);
            state.v.copy_from_slice(&drawn[22..30]);
            controller.update(&state, &controller.noise(), &mut out);
            out.action
        });
        // Exported networks have numbers of 32 bits.
        let same = actions[0].iter().zip(&actions[1]).all(|(a, b)| (a - b).abs() < 1e-6);
        assert!(same, "{actions:?}");
    }
}

/// What a `<mimic>` is to simulation and limits, until the task says how the two are held.
#[test]
fn the_note_of_a_mimic_stands_until_a_row_holds_the_joints_or_nothing_commands_them() {
    let folder = tempfile::tempdir().expect("folder");
    let all = "controllable = [\"shoulder\", \"elbow\", \"finger_left\", \"finger_right\"]\nobservation = [\"q.shoulder\", \"q.elbow\", \"q.finger_left\", \
               \"q.finger_right\", \"v.shoulder\", \"v.elbow\", \"v.finger_left\", \"v.finger_right\"]";
    let some = "controllable = [\"shoulder\", \"elbow\"]\nobservation = [\"q.shoulder\", \"q.elbow\", \"v.shoulder\", \"v.elbow\"]";
    let margin = "margin = { shoulder = 0.01 }";
    let both = TASK.replace(some, all).replace("margin = 0.02", margin);
    let mimics = "<mimic joint=\"finger_left\"/>";
    let told = |task: &str| {
        let file = write(folder.path(), &arm(mimics), task);
        doctor::told(&tasks::load(&file, &[]).unwrap_or_else(|e| panic!("{e}"))).expect("notes").join("; ")
    };
    let simulated = REWARD.replace("armature = 0.05\n", "");
    for more in ["", simulated.as_str()] {
        let text = told(&format!("{both}{more}"));
        let row = "rows = [{ name = \"mimic\", terms = { \"q.finger_right\" = 1.0, \"q.finger_left\" = -1.0 }, equals = 0.0 }]";
        assert!(text.contains("'finger_right' mimics 'finger_left'") && text.contains(row), "{text}");
        assert!(!text.contains("equality"), "{text}");
        let held = format!("{both}{more}").replace("torque = {}", &format!("torque = {{}}\n{row}"));
        assert!(!told(&held).contains("mimics"), "{}", told(&held));
        let other = held.replace("-1.0 }", "-0.5 }");
        assert!(told(&other).contains("mimics"), "another multiplier is not the file's");
        assert!(!told(&format!("{TASK}{more}")).contains("mimics"));
    }
    // What it says of the simulation: the follower follows, though nothing drives it.
    let file = write(folder.path(), &arm(mimics), &format!("{both}{simulated}"));
    let mut env = tasks::env(&file).expect("environment");
    env.reset(&mut stream(0, 0)).expect("reset");
    let at = |env: &dyn Env, name: &str| {
        env.qpos()[env.spec().joints.iter().find(|joint| joint.name == name).expect("joint").idx_q]
    };
    let push: Vec<f64> =
        env.spec().actuators.iter().map(|a| if a.joint == "finger_left" { 2.0 } else { 0.0 }).collect();
    for _ in 0..100 {
        env.step(&push);
    }
    let [left, right] = ["finger_left", "finger_right"].map(|name| at(env.as_ref(), name));
    assert!((left - right).abs() < 5e-3, "{left} {right}");
}

#[test]
fn what_no_robot_and_no_task_can_mean_is_refused_with_the_key() {
    let folder = tempfile::tempdir().expect("folder");
    let refused = |robot: &str, task: &str| {
        let file = write(folder.path(), robot, task);
        match tasks::load(&file, &[]) {
            Err(e) => e.to_string(),
            Ok(m) => Controller::new(&blank_of(&file, &m)).map(|_| ()).expect_err("refused").to_string(),
        }
    };
    fn blank_of(file: &str, _: &Manifest) -> nearl_runtime::Snapshot {
        blank::snapshot(file, false).unwrap_or_else(|e| panic!("{e}"))
    }
    let twice = arm("<limit lower=\"0\" upper=\"0.02\" effort=\"20\" velocity=\"0.2\"/>");
    let text = refused(&twice, TASK);
    assert!(text.contains("joint 'finger_right' has more than one <limit>"), "{text}");
    let asks = TASK.replace("\"v.elbow\"]", "\"v.elbow\", \"command.vx\"]");
    let text = refused(&arm(""), &format!("{asks}{DRIVES}{REWARD}"));
    assert!(
        text.contains("command.vx") && text.contains("[commands]") && text.contains("vx = 0.0"),
        "{text}"
    );
    let fingers = TASK
        .replace("\"elbow\"]", "\"elbow\", \"finger_left\"]")
        .replace("\"v.shoulder\"", "\"q.finger_left\", \"v.finger_left\", \"v.shoulder\"");
    let file = write(folder.path(), &arm(""), &fingers);
    let text = blank::snapshot(&file, false).expect_err("no room").to_string();
    for words in ["constraints.position.margin 0.02", "'finger_left'", "from 0 to 0.04"] {
        assert!(text.contains(words), "'{words}' is not in: {text}");
    }
}

/// A scene in many files: as MuJoCo loads it.
#[test]
fn a_kitchen_of_forty_files_is_read() {
    let folder = tempfile::tempdir().expect("folder");
    let part = |k: usize| {
        format!("<mujoco><worldbody><geom name=\"g{k}\" type=\"sphere\" size=\"0.1\"/></worldbody></mujoco>")
    };
    (0..40).for_each(|k| std::fs::write(folder.path().join(format!("{k}.xml")), part(k)).expect("part"));
    let includes: String = (0..40).map(|k| format!("<include file=\"{k}.xml\"/>")).collect();
    let whole = "<mujoco><worldbody><body><joint name=\"j\"/><geom size=\"0.1\"/></body></worldbody>";
    let file = folder.path().join("kitchen.xml");
    std::fs::write(&file, format!("{whole}{includes}</mujoco>")).expect("kitchen");
    robot::read_mjcf(&file).unwrap_or_else(|e| panic!("{e}"));
}
