//! Every message names the file or the joint, the value, and what to do.

mod common;

use common::*;
use nearl_constraints::*;
use std::path::Path;

fn refuse_model(result: Result<Model, ModelError>, words: &[&str]) {
    let text = result.err().expect("an error").to_string();
    words.iter().for_each(|w| assert!(text.contains(w), "'{w}' is not in: {text}"));
}

fn refuse(limits: &[Box<dyn Limit>], dofs: &[usize], settings: Settings, words: &[&str]) {
    refuse_for(&panda(), limits, dofs, settings, words);
}

fn refuse_for(model: &Model, limits: &[Box<dyn Limit>], dofs: &[usize], settings: Settings, words: &[&str]) {
    let text = Projector::new(model, limits, dofs, settings).err().expect("an error").to_string();
    words.iter().for_each(|w| assert!(text.contains(w), "'{w}' is not in: {text}"));
}

fn urdf(limit: &str, mass: &str) -> String {
    format!(
        r#"<robot name="r"><link name="a"/><link name="b"><inertial><mass value="{mass}"/>
        <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
        <joint name="elbow" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>{limit}</joint></robot>"#
    )
}

const GOOD: &str = r#"<limit lower="-1" upper="1" effort="5" velocity="2"/>"#;

#[test]
fn models() {
    refuse_model(Model::from_urdf(Path::new("/no/such.urdf")), &["/no/such.urdf", "check the path"]);
    let empty = std::env::temp_dir().join(format!("nearl-empty-{}.urdf", std::process::id()));
    std::fs::write(&empty, "").unwrap();
    refuse_model(Model::from_urdf(&empty), &["nearl-empty", "empty"]);
    std::fs::remove_file(&empty).unwrap();
    refuse_model(Model::from_urdf_text("<robot>\n<link</robot>"), &["the URDF text", "2:"]);
    refuse_model(Model::from_urdf_text("<mujoco/>"), &["<mujoco>", "<robot>"]);
    refuse_model(Model::from_mjcf_text("<robot/>"), &["<robot>", "<mujoco>"]);
    let mass = |m: &str| Model::from_urdf_text(&urdf(GOOD, m));
    assert!(mass("1").is_ok());
    refuse_model(mass("-1"), &["link 'b' mass is -1 kg"]);
    refuse_model(mass("nan"), &["link 'b'", "'nan'"]);
    let limit = |l: &str| Model::from_urdf_text(&urdf(l, "1"));
    refuse_model(
        limit(r#"<limit lower="1" upper="-1" effort="5" velocity="2"/>"#),
        &["'elbow'", "lower 1 above upper -1"],
    );
    refuse_model(
        limit(r#"<limit lower="NaN" upper="1" effort="-5" velocity="2"/>"#),
        &["lower is 'NaN'", "effort is '-5'"],
    );
    let tree = |joint: &str| {
        Model::from_urdf_text(&urdf(GOOD, "1").replace("</robot>", &format!("{joint}</robot>")))
    };
    let third =
        r#"<link name="c"/><joint name="wrist" type="revolut"><parent link="a"/><child link="c"/></joint>"#;
    refuse_model(tree(third), &["joint 'wrist' has the type 'revolut'", "continuous"]);
    refuse_model(tree(r#"<link name="c"/>"#), &["'a', 'c'", "root"]);
    refuse_model(tree(r#"<link name="b"/>"#), &["link 'b' is there more than once"]);
    let nowhere = r#"<joint name="tip" type="fixed"><parent link="b"/><child link="hand"/></joint>"#;
    refuse_model(tree(nowhere), &["joint 'tip' has the child link 'hand', which is not there"]);
    let twice = r#"<joint name="tip" type="fixed"><parent link="a"/><child link="b"/></joint>"#;
    refuse_model(tree(twice), &["link 'b' is the child of joints 'elbow' and 'tip'"]);
    refuse_model(limit(""), &["joint 'elbow' states no effort and no velocity in <limit>"]);
    let flat = urdf(GOOD, "1").replace("0 0 1", "0 0 0");
    refuse_model(Model::from_urdf_text(&flat), &["joint 'elbow' has the axis 0 0 0"]);
    let mimic = r#"<link name="c"/><joint name="twin" type="continuous"><parent link="b"/><child link="c"/><mimic joint="elbow" multiplier="-1"/></joint>"#;
    let noted = tree(mimic).unwrap();
    assert!(noted.notes()[0].contains("joint 'twin' mimics 'elbow' in the file (multiplier -1, offset 0)"));
    let mut q = noted.neutral();
    q[1] = 0.5;
    assert!(noted.check_configuration(&q).unwrap_err().contains("(cos, sin) of continuous joint 'twin'"));
    assert_eq!(noted.check_configuration(&noted.neutral()), Ok(()));
    refuse_model(
        mass("1").and_then(|m| m.joint("elbwo").map(|_| m.clone())),
        &["'elbwo'", "did you mean 'elbow'"],
    );
    let two = "<mujoco><worldbody><body><joint/><geom size='1'/></body><body><joint/><geom size='1'/></body></worldbody></mujoco>";
    refuse_model(Model::from_mjcf_text(two), &["several top-level bodies"]);
    let ghost = "<mujoco><worldbody><body><joint name='a'/><geom size='1' contype='0' conaffinity='0'/></body></worldbody></mujoco>";
    refuse_model(Model::from_mjcf_text(ghost), &["geom without collision", "<inertial>"]);
    refuse_model(
        Model::from_mjcf_text("<mujoco><include file='x.xml'/></mujoco>"),
        &["<include>", "mj_saveLastXML"],
    );
    let range =
        "<mujoco><worldbody><body><joint name='a' range='3 1'/><geom size='1'/></body></worldbody></mujoco>";
    refuse_model(Model::from_mjcf_text(range), &["'a' range", "lower 3 above upper 1"]);
}

#[test]
fn limits_of_the_robot_file_that_are_not_there() {
    let bare = Model::from_urdf_text(&urdf(r#"<limit effort="0" velocity="0"/>"#, "1")).unwrap();
    let settings = || Settings::new(0.001, 1);
    let one = |l: Box<dyn Limit>| vec![l];
    refuse_for(
        &bare,
        &one(Box::new(PositionLimit::with_margin(0.0))),
        &[0],
        settings(),
        &["'elbow'", "lower and upper"],
    );
    refuse_for(
        &bare,
        &one(Box::new(VelocityLimit::scaled(1.0))),
        &[0],
        settings(),
        &["'elbow'", "velocity = {"],
    );
    refuse_for(&bare, &one(Box::new(TorqueLimit::scaled(1.0))), &[0], settings(), &["'elbow'", "effort"]);
    let cheetah = robot("gymnasium/half_cheetah.xml");
    let words = ["'bthigh', 'bshin', 'bfoot'", "velocity"];
    refuse_for(&cheetah, &one(Box::new(VelocityLimit::scaled(1.0))), &[3, 4, 5], settings(), &words);
    refuse_for(
        &cheetah,
        &one(Box::new(TorqueLimit::scaled(1.0))),
        &[0, 3],
        settings(),
        &["'rootx'", "do not control"],
    );
}

#[test]
fn limits_that_make_no_sense() {
    let s = || Settings::new(0.001, 1);
    refuse(
        &[Box::new(PositionLimit::with_margin(0.0))],
        &[0, 2],
        s(),
        &["'panda_joint1', 'panda_joint3'", "acceleration"],
    );
    let wide = || -> Box<dyn Limit> { Box::new(PositionLimit::with_margin(1.6)) };
    refuse(
        &[wide(), Box::new(AccelerationLimit::uniform(1.0))],
        &[3, 0, 1],
        s(),
        &["contradict", "panda_joint4"],
    );
    refuse(&[Box::new(PositionLimit::with_margin(-0.1))], &[0], s(), &["margin", "-0.1", "at least 0"]);
    refuse(&[Box::new(VelocityLimit::scaled(1.5))], &[0], s(), &["velocity scale", "1.5"]);
    refuse(&[Box::new(TorqueLimit::scaled(f64::NAN))], &[0], s(), &["torque scale", "NaN"]);
    refuse(&[Box::new(AccelerationLimit::uniform(0.0))], &[0], s(), &["acceleration", "0", "above 0"]);
    refuse(&[], &[7], s(), &["controllable dof", "7"]);
    refuse(&[], &[1, 1], s(), &["'panda_joint2'", "twice"]);
    refuse(&[], &[0], Settings::new(-0.1, 1), &["dt", "-0.1", "above 0 s"]);
    refuse(&[], &[0], Settings { velocity_weight: Some(vec![1.0]), ..s() }, &["velocity_weight"]);
    let singular = vec![1.0, 0.0, 1.0, f64::NAN, 1.0, -1.0, f64::INFINITY];
    let words = [
        "velocity_weight 0 of 'panda_joint2', NaN of 'panda_joint4', -1 of 'panda_joint6', inf of 'panda_joint7'",
    ];
    refuse(&[], &[0], Settings { velocity_weight: Some(singular), ..s() }, &words);
    let free = Settings { consistency: Consistency::Free, ..s() };
    refuse(&panda_limits(Some(1.0)), &[0], free, &["torque", "'panda_joint1'", "kinematic"]);
    refuse_for(&robot("gymnasium/ant.xml"), &[], &[2, 6], s(), &["1 of the 6 dofs", "'root'"]);
}

#[test]
fn task_files() {
    let read = |text: &str| toml::from_str::<ConstraintSettings>(text);
    let full = r#"
        consistency = "free"
        solver = "clarabel"
        position = { margin = 0.02 }
        velocity = { scale = 0.8 }
        acceleration = { limit = { panda_joint1 = 10.0 }, braking = 3 }
        torque = { scale = 0.9 }"#;
    let settings = read(full).unwrap();
    assert_eq!((settings.consistency, settings.solver), (Consistency::Free, Solver::Clarabel));
    let limits = build_limits(&settings, &panda()).unwrap();
    assert_eq!(
        limits.iter().map(|l| l.name()).collect::<Vec<_>>(),
        ["position", "velocity", "acceleration", "torque"]
    );
    let set = LimitSet::collect(&panda(), &limits, &[0, 1]).unwrap();
    assert_eq!((set.q_upper[0], set.velocity[0], set.acceleration[0]), (2.8973 - 0.02, 0.8 * 2.175, 10.0));
    assert_eq!((set.braking[0], set.effort[1], set.acceleration[1]), (3.0, 0.9 * 87.0, f64::INFINITY));
    assert_eq!(toml::from_str::<ConstraintSettings>(&toml::to_string(&settings).unwrap()).unwrap(), settings);
    assert!(read("position = { margn = 1 }").unwrap_err().to_string().contains("margn"));
    assert!(read("speed = 1").unwrap_err().to_string().contains("speed"));
    let unknown = read("acceleration = { limit = { panda_joint11 = 10.0 } }").unwrap();
    let text = build_limits(&unknown, &panda()).unwrap_err().to_string();
    assert!(text.contains("'panda_joint11'") && text.contains("did you mean 'panda_joint1'"), "{text}");
    let negative =
        build_limits(&read("velocity = { limit = -2 }").unwrap(), &panda()).unwrap_err().to_string();
    assert!(negative.contains("-2") && negative.contains("rad/s"), "{negative}");
}
