//! Every message names the file or the joint, the value, and what to do.

use crate::common::*;
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
    refuse_model(Model::from_urdf_text("<robot name=\"r\"/>"), &["it has no <link>"]);
    let macros =
        r#"<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="arm.xacro"/></robot>"#;
    refuse_model(Model::from_urdf_text(macros), &["<xacro:include>", "the program xacro makes a URDF"]);
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
}

/// Each of these was read as something else, or not at all, without a word.
#[test]
fn urdfs_that_say_too_little_or_the_impossible() {
    let with = |from: &str, to: &str| {
        let text = urdf(GOOD, "1");
        assert!(text.contains(from));
        Model::from_urdf_text(&text.replacen(from, to, 1))
    };
    refuse_model(with(r#"<mass value="1"/>"#, ""), &["link 'b' has an <inertial> without mass value"]);
    refuse_model(with(r#"izz="1""#, ""), &["link 'b' has an <inertial> without inertia izz"]);
    refuse_model(
        with("<axis", r#"<origin xyz="0 1"/><axis"#),
        &["joint of 'elbow'", "xyz '0 1'", "three numbers"],
    );
    let circle = "</robot>";
    let joints = ["c", "d"].map(|link| format!(r#"<link name="{link}"/>"#)).concat()
        + r#"<joint name="x" type="fixed"><parent link="c"/><child link="d"/></joint>"#
        + r#"<joint name="y" type="fixed"><parent link="d"/><child link="c"/></joint></robot>"#;
    refuse_model(with(circle, &joints), &["'c', 'd'", "in a circle"]);
    let planar = with(r#"type="revolute""#, r#"type="planar""#);
    assert_eq!(planar.map(|m| (m.nq(), m.nv())), Ok((4, 3)));
    let tilted = with(
        r#"type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>"#,
        r#"type="planar"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>"#,
    );
    refuse_model(tilted, &["planar joint 'elbow'", "0 0 1"]);
    let weightless = with("<inertial>", "<inertial/><x>").map_err(|e| e.to_string());
    assert!(weightless.is_err(), "not XML");
    let light = r#"<link name="c"/><joint name="wrist" type="continuous"><parent link="b"/><child link="c"/></joint></robot>"#;
    let light = with("</robot>", light).unwrap();
    assert!(light.notes()[0].contains("the moving links 'c' have no mass"), "{:?}", light.notes());
    let base_only = with(r#"type="revolute""#, r#"type="fixed""#);
    refuse_model(base_only, &["the URDF text", "no movable joint"]);
}

/// By its size, before anything is built; reading does not recurse.
#[test]
fn a_chain_of_twenty_thousand_joints_is_refused() {
    let links: String = (0..20_001).map(|k| format!(r#"<link name="l{k}"/>"#)).collect();
    let joints: String = (0..20_000)
        .map(|k| {
            let (parent, child) = (format!("l{k}"), format!("l{}", k + 1));
            format!(r#"<joint name="j{k}" type="continuous"><parent link="{parent}"/><child link="{child}"/></joint>"#)
        })
        .collect();
    let text = format!(r#"<robot name="worm">{links}{joints}</robot>"#);
    refuse_model(Model::from_urdf_text(&text), &["the URDF text has 20000 dofs", "500"]);
    let fixed = text.replace("continuous", "fixed");
    refuse_model(Model::from_urdf_text(&fixed), &["20001 bodies", "5000"]);
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
        &["leaves nothing of its range", "panda_joint4"],
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

/// What a file states and nobody would miss until the robot moves is said or refused, each by its joint.
#[test]
fn urdf_limits_are_never_dropped_without_a_word() {
    let model = |joint: &str| Model::from_urdf_text(&urdf(joint, "1"));
    let note = |joint: &str, words: &[&str]| {
        let notes = model(joint).expect("a robot").notes().join("; ");
        words.iter().for_each(|w| assert!(notes.contains(w), "'{w}' is not in: {notes}"));
    };
    assert!(model(GOOD).expect("a robot").notes().is_empty());
    let soft = format!(
        r#"{GOOD}<safety_controller soft_lower_limit="-0.5" soft_upper_limit="0.5" k_velocity="1"/>"#
    );
    note(
        &soft,
        &["joint 'elbow' has soft_lower_limit -0.5 and soft_upper_limit 0.5", "is not used", "margin"],
    );
    let zero = r#"<limit lower="-1" upper="1" effort="0" velocity="0"/>"#;
    note(zero, &["joint 'elbow' states velocity 0 in <limit>", "joint 'elbow' states effort 0 in <limit>"]);
    let upper = r#"<limit upper="1" effort="5" velocity="2"/>"#;
    note(upper, &["joint 'elbow' states upper and no lower in <limit>, which URDF takes for 0"]);
    let bounded = model(upper).expect("a robot");
    assert_eq!((bounded.lower_position_limit(), bounded.upper_position_limit()), (&[0.0][..], &[1.0][..]));
    refuse_model(
        model(r#"<limit lower="1" effort="5" velocity="2"/>"#),
        &["joint 'elbow' has lower 1 above upper 0"],
    );
    let nobody = format!(r#"{GOOD}<mimic joint="zz"/>"#);
    note(&nobody, &["joint 'elbow' mimics 'zz', which is not there: it moves by itself"]);
    refuse_model(model(&format!(r#"{GOOD}<mimic joint="elbow"/>"#)), &["joint 'elbow' mimics itself"]);
    for (key, value) in [("multiplier", "nan"), ("multiplier", "inf"), ("offset", "-inf"), ("offset", "half")]
    {
        refuse_model(
            model(&format!(r#"{GOOD}<mimic joint="elbow" {key}="{value}"/>"#)),
            &[&format!("joint 'elbow' has <mimic> {key} '{value}', not a number")],
        );
    }
    let text = urdf(GOOD, "1");
    for nameless in [text.replace(r#" name="elbow""#, ""), text.replace(r#""elbow""#, r#""""#)] {
        let words = ["the <joint> between the links 'a' and 'b' has no name"];
        refuse_model(Model::from_urdf_text(&nameless), &words);
    }
    // What hangs rigidly on a body counts with it; the numbers are those of a TIAGo's antenna, whose inertia is negative about an axis.
    let antenna = |on: &str, scale: f64| {
        let [xx, xy, xz, yy, yz, zz] =
            [2.371e-8, 6.119e-8, 1.179e-8, 2.833e-8, 7.74e-9, 3.849e-8].map(|x| scale * x);
        let link = format!(
            r#"<link name="antenna"><inertial><origin xyz="0 0 0.1"/><mass value="1e-6"/><inertia ixx="{xx}" ixy="{xy}" ixz="{xz}" iyy="{yy}" iyz="{yz}"
            izz="{zz}"/></inertial></link><joint name="weld" type="fixed"><parent link="{on}"/><child link="antenna"/>
            <origin rpy="0.3 0.2 0.1"/></joint></robot>"#
        );
        Model::from_urdf_text(&text.replace("</robot>", &link))
    };
    for (on, scale) in [("b", 1.0), ("a", 1.0), ("a", 1e9)] {
        let notes = antenna(on, scale).expect("a robot").notes().join("; ");
        assert!(notes.contains("the inertia of 'antenna' is that of no body"), "{notes}");
    }
    refuse_model(antenna("b", 1e9), &["the inertia of body 'antenna' is negative about some axis"]);
    for (moments, is_body) in [([1.0, 1.0, 2.0], true), ([0.1, 0.1, 10.0], false), ([1.0, 0.5, 1.49], true)] {
        let [xx, yy, zz] = moments;
        let text = text.replace(
            r#"ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1""#,
            &format!(r#"ixx="{xx}" ixy="0" ixz="0" iyy="{yy}" iyz="0" izz="{zz}""#),
        );
        let notes = Model::from_urdf_text(&text).expect("a robot").notes().join("; ");
        assert_eq!(notes.contains("the inertia of 'b' is that of no body"), !is_body, "{moments:?}: {notes}");
    }
}

/// Limits that hold for fewer joints than are controllable name the others; those that hold for none are refused.
#[test]
fn limits_for_some_joints_name_the_others() {
    use nearl_constraints::description::Range;
    let robot = |unlimited: &[usize]| {
        let mut robot = panda().description().clone();
        let mut joints: Vec<_> = robot.bodies.iter_mut().flat_map(|b| &mut b.joints).collect();
        unlimited.iter().for_each(|i| joints[*i].range = Range::Unlimited);
        Model::from_description(robot).expect("a robot")
    };
    let position: [Box<dyn Limit>; 2] =
        [Box::new(PositionLimit::with_margin(0.0)), Box::new(AccelerationLimit::uniform(5.0))];
    let settings = Settings::new(0.01, 0);
    let notes = |model: &Model, limits: &[Box<dyn Limit>]| {
        Projector::new(model, limits, &[0, 1, 2], settings.clone()).expect("a projector").notes().join("; ")
    };
    assert!(!notes(&robot(&[]), &position).contains("position limit"));
    let some = notes(&robot(&[1]), &position);
    assert!(some.contains("the position limit does not hold for 'panda_joint2'"), "{some}");
    let words = ["position", "'panda_joint1', 'panda_joint2', 'panda_joint3'", "write a range into it"];
    refuse_for(&robot(&[0, 1, 2]), &position, &[0, 1, 2], settings.clone(), &words);
    let by_joint = |joints: &[&str]| -> [Box<dyn Limit>; 1] {
        let map = joints.iter().map(|name| (name.to_string(), 3.0)).collect();
        [Box::new(AccelerationLimit::new(AccelerationSettings::of(PerJoint::Joints(map), None)))]
    };
    let some = notes(&robot(&[]), &by_joint(&["panda_joint1", "panda_joint3"]));
    assert!(some.contains("the acceleration limit does not name 'panda_joint2'"), "{some}");
    let all = notes(&robot(&[]), &by_joint(&["panda_joint1", "panda_joint2", "panda_joint3"]));
    assert!(!all.contains("does not name"), "{all}");
    refuse(
        &by_joint(&[]),
        &[0, 1, 2],
        settings.clone(),
        &["acceleration limit is an empty table, which holds for no joint"],
    );
    // A motor's line needs both of its ends.
    let line = |stall: &[&str], no_load: &[&str]| -> [Box<dyn Limit>; 1] {
        let of = |names: &[&str]| PerJoint::Joints(names.iter().map(|n| (n.to_string(), 80.0)).collect());
        let (stall, no_load, margin, soft) = (of(stall), of(no_load), None, None);
        [Box::new(TorqueSpeedLimit::new(TorqueSpeedSettings { stall, no_load, margin, soft }))]
    };
    refuse(
        &line(&["panda_joint1"], &["panda_joint3"]),
        &[0, 1, 2],
        settings.clone(),
        &["torque_speed names joint 'panda_joint1' in stall and not in no_load"],
    );
    refuse(
        &line(&["panda_joint1"], &[]),
        &[0, 1, 2],
        settings.clone(),
        &["torque_speed no_load is an empty table"],
    );
    let none = serde_json::from_str(r#"{ "name": "r", "terms": {}, "upper": 1.0 }"#).unwrap();
    refuse(&[Box::new(UserRow::new(none))], &[0, 1, 2], settings.clone(), &["row 'r' has no terms"]);
    let row = |coefficient: f64| -> [Box<dyn Limit>; 1] {
        let terms = [("v.panda_joint1".to_string(), coefficient)].into();
        let bounds = (Some(-1.0), Some(1.0));
        [Box::new(UserRow::new(UserRowSettings {
            name: "r".into(),
            terms,
            lower: bounds.0,
            upper: bounds.1,
            equals: None,
            braking: None,
            margin: 0.0,
            soft: None,
        }))]
    };
    assert!(Projector::new(&panda(), &row(1e12), &[0], settings.clone()).is_ok());
    for huge in [1e308, -2e12, f64::NAN] {
        refuse(
            &row(huge),
            &[0],
            settings.clone(),
            &["coefficient of 'v.panda_joint1' in row 'r'", "at most 1e12"],
        );
    }
}
