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
    refuse_model(Model::from_mjcf_text(two), &["several top-level bodies", "unnamed body in line 1"]);
    let two = two.replacen("<body>", "<body name='left'>", 1).replacen("<body>", "<body name='right'>", 1);
    refuse_model(Model::from_mjcf_text(&two), &["body 'left', body 'right'"]);
    let ghost = "<mujoco><worldbody><body><joint name='a'/><geom size='1' contype='0' conaffinity='0'/></body></worldbody></mujoco>";
    let words = ["an unnamed geom in line 1 of an unnamed body in line 1 without collision", "<inertial>"];
    refuse_model(Model::from_mjcf_text(ghost), &words);
    let ghost = ghost.replace("<body>", "<body name='arm'>").replace("<geom ", "<geom name='skin' ");
    refuse_model(Model::from_mjcf_text(&ghost), &["geom 'skin' of body 'arm' without collision"]);
    refuse_model(
        Model::from_mjcf_text("<mujoco><include file='x.xml'/></mujoco>"),
        &["<include>", "mj_saveLastXML"],
    );
    let range =
        "<mujoco><worldbody><body><joint name='a' range='3 1'/><geom size='1'/></body></worldbody></mujoco>";
    refuse_model(Model::from_mjcf_text(range), &["'a' range", "lower 3 above upper 1"]);
}

/// MuJoCo reads them one after the other into one class; Pinocchio reads the first.
#[test]
fn several_sections_of_a_kind() {
    let file = |more: &str| {
        Model::from_mjcf_text(&format!(
            "<mujoco><default><joint damping='1'/></default>{more}<worldbody><body name='arm'><joint name='a'/>\
             <geom size='1' mass='1'/></body></worldbody></mujoco>"
        ))
    };
    assert_eq!(file("").unwrap().damping(), [1.0]);
    let one = "put all of it into one";
    refuse_model(file("<default><joint damping='2'/></default>"), &["several <default> sections", one]);
    refuse_model(file("<compiler/><compiler angle='radian'/>"), &["several <compiler> sections", one]);
}

/// Its body would weigh nothing.
#[test]
fn a_mesh_that_is_to_give_the_mass() {
    let file = |defaults: &str, body: &str, geom: &str| {
        Model::from_mjcf_text(&format!(
            "<mujoco><default>{defaults}</default><asset><mesh name='m' vertex='0 0 0 1 0 0 0 1 0 0 0 1'/></asset>\
             <worldbody><body name='arm'><joint name='a'/>{body}<geom name='g' mesh='m' {geom}/></body></worldbody></mujoco>"
        ))
    };
    let words = ["mesh geom 'g' of body 'arm'", "give its body an <inertial>"];
    refuse_model(file("", "", "type='mesh'"), &words);
    refuse_model(file("<geom type='mesh'/>", "", ""), &words);
    let inertial = "<inertial pos='0 0 0' mass='2' diaginertia='1 1 1'/>";
    assert_eq!(file("", inertial, "type='mesh'").unwrap().total_mass(), 2.0);
    assert!(file("", "<geom size='1' mass='1'/>", "type='mesh' mass='0'").is_ok());
}

/// Forces that MuJoCo leaves out or adds, and masses that it takes from elsewhere.
#[test]
fn switches_that_would_be_overlooked() {
    let file = |head: &str, body: &str, motor: &str| {
        Model::from_mjcf_text(&format!(
            "<mujoco>{head}<worldbody><body name='arm'><joint name='a' damping='1'/>{body}<geom size='1' mass='1'/></body></worldbody>\
             <actuator><motor name='m' joint='a' {motor}/></actuator></mujoco>"
        ))
    };
    for flag in ["damper", "spring", "eulerdamp", "actuation"] {
        let head = format!("<option><flag {flag}='disable'/></option>");
        refuse_model(file(&head, "", ""), &[&format!("flag {flag}='disable'"), "take it out"]);
    }
    refuse_model(file("", "", "armature='0.1'"), &["armature='0.1' of motor 'm'", "at the joint"]);
    refuse_model(file("", "", "damping='2 0'"), &["damping='2 0' of motor 'm'", "at the joint"]);
    let inertial = "<inertial pos='0 0 0' mass='2' diaginertia='1 1 1'/>";
    let geoms = "<compiler inertiafromgeom='true'/>";
    refuse_model(file(geoms, inertial, ""), &["inertiafromgeom='true' beside <inertial>"]);
    assert!(file(geoms, "", "damping='0'").is_ok());
    assert!(file("<option><flag contact='disable' eulerdamp='enable'/></option>", inertial, "").is_ok());
}

/// In MuJoCo the first joint has stiffness 40 and damping 8 (`jnt_stiffness`, `dof_damping`); these forces were zero here.
#[test]
fn forces_that_would_be_missing() {
    let file = |defaults: &str, body: &str, joint: &str| {
        Model::from_mjcf_text(&format!(
            "<mujoco><default>{defaults}</default><worldbody><body name='arm' {body}><joint name='a' {joint}/>\
             <geom size='1' mass='1'/></body></worldbody></mujoco>"
        ))
    };
    let spring = ["springdamper='0.1 1' of joint 'a'", "write stiffness and damping instead"];
    refuse_model(file("", "", "springdamper='0.1 1'"), &spring);
    refuse_model(file("<joint springdamper='0.1 1'/>", "", ""), &spring);
    let inner = "<default class='c'><joint springdamper='0.1 1'/></default>";
    refuse_model(file(inner, "childclass='c'", ""), &spring);
    refuse_model(file("", "gravcomp='1'", ""), &["gravcomp='1' of body 'arm'", "take it out"]);
    for (defaults, body, joint) in [
        ("<joint springdamper='0.1 1'/>", "", "springdamper='0 0'"),
        (inner, "", ""),
        ("", "gravcomp='0'", "actuatorgravcomp='true'"), // compensates what no body asks for
        ("", "", "stiffness='40' damping='8'"),
    ] {
        assert!(file(defaults, body, joint).is_ok(), "{defaults} {body} {joint}");
    }
}

/// What MuJoCo makes of these depends on gains that the reader does not follow: 7, 3 and -5 times the control, and so on.
#[test]
fn actuators_whose_default_class_mixes_shortcuts() {
    let file = |defaults: &str, actuator: &str| {
        Model::from_mjcf_text(&format!(
            "<mujoco><default>{defaults}</default><worldbody><body name='arm'><joint name='a'/>\
             <geom size='1' mass='1'/></body></worldbody>\
             <actuator>{actuator}</actuator></mujoco>"
        ))
    };
    for (tag, defaults, actuator) in [
        ("position", "<position kp='7'/><general biastype='none'/>", "<general joint='a' ctrlrange='-1 1'/>"),
        (
            "position",
            "<position kp='7'/>",
            "<general joint='a' ctrlrange='-1 1' gainprm='3' biastype='none'/>",
        ),
        ("damper", "<damper kv='5' ctrlrange='0 1'/>", "<general joint='a' gaintype='fixed'/>"),
        ("adhesion", "<adhesion gain='5' ctrlrange='0 1'/>", "<general joint='a'/>"),
    ] {
        let words =
            [&format!("<general> on top of <{tag}> for the actuator of 'a'"), "different default classes"];
        refuse_model(file(defaults, actuator), &words);
    }
    let unlimited = file("<position kp='7'/><general biastype='none'/>", "<general joint='a'/>");
    assert_eq!(unlimited.unwrap().effort_limit(), [f64::INFINITY]);
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

fn serial(names: &[&str]) -> Model {
    let links = (0..=names.len()).map(|k| {
        format!(
            r#"<link name="l{k}"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>"#
        )
    });
    let joints = names.iter().enumerate().map(|(k, name)| {
        let (kind, limit) = match name.starts_with("endless") {
            true => ("continuous", r#"<limit effort="5" velocity="2"/>"#),
            false => ("revolute", GOOD),
        };
        format!(
            r#"<joint name="{name}" type="{kind}"><parent link="l{k}"/><child link="l{}"/><axis xyz="0 0 1"/>{limit}</joint>"#,
            k + 1
        )
    });
    Model::from_urdf_text(&format!(r#"<robot name="r">{}</robot>"#, links.chain(joints).collect::<String>()))
        .unwrap()
}

/// The curve of a continuous joint looked at the cosine of its angle, and the checker with it: neither did anything.
#[test]
fn velocity_profiles_of_other_joints() {
    let built = |model: &Model, line: &str, dofs: &[usize]| {
        let text = format!("acceleration = {{ limit = 10.0 }}\n{line}");
        let limits = build_limits(&toml::from_str::<ConstraintSettings>(&text).unwrap(), model)?;
        Projector::new(model, &limits, dofs, Settings::new(0.001, 1))
    };
    let refuse = |model: &Model, line: &str, dofs: &[usize], words: &[&str]| {
        let text = built(model, line, dofs).err().expect("an error").to_string();
        words.iter().for_each(|w| assert!(text.contains(w), "'{w}' is not in: {text}"));
    };
    let curve = |joint: &str| {
        format!(
            "velocity_profile = {{ {joint} = {{ limit = 1.0, offset = 0.0, squared = 1.0, lower = -0.5, upper = 0.5 }} }}"
        )
    };
    let mixed = serial(&["elbow", "endless"]);
    let words = ["velocity_profile names 'endless', a continuous joint", "take it out"];
    refuse(&mixed, &curve("endless"), &[0, 1], &words);
    refuse(&mixed, &curve("endless"), &[0], &words);
    assert!(built(&mixed, &curve("elbow"), &[0, 1]).is_ok());
    let ant = robot("gymnasium/ant.xml");
    refuse(&ant, &curve("root"), &[6], &["velocity_profile names 'root', a joint with several dofs"]);

    let fr3 = "velocity_profile = \"fr3\"";
    let names = |arm: &str| (1..=7).map(|k| format!("{arm}joint{k}")).collect::<Vec<_>>();
    let of = |names: &[String]| serial(&names.iter().map(String::as_str).collect::<Vec<_>>());
    let all: Vec<usize> = (0..14).collect();
    let two = of(&[names("left_"), names("right_")].concat());
    let words = ["several arms", "'left_joint1', 'right_joint1'", "give the curves by joint"];
    refuse(&two, fr3, &all, &words);
    refuse(&of(&names("endless_")), fr3, &all[..7], &["no joint whose name ends with joint1, joint2"]);
    let torn = of(&[&names("left_")[..3], &names("right_")[3..]].concat());
    refuse(&torn, fr3, &all[..7], &["no seven joints of one arm"]);

    let fingers = ["finger_joint1".to_string(), "finger_joint2".to_string()];
    let held = of(&[&fingers[..], &names("fr3_")].concat());
    let speeds = built(&held, fr3, &all[..9]).unwrap().limits().velocity.clone();
    let none = f64::INFINITY;
    assert_eq!(speeds, [none, none, 2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26]);
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
