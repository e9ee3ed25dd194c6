//! A motor turns controls into torques and back, and a description that is no robot is refused by name.

use nearl_constraints::RobotDescription;
use nearl_constraints::description::{Body, Command, JointDescription, JointKind, Motor, Range};
use nearl_constraints::geometry::Placement;

fn pendulum() -> RobotDescription {
    let body = |name: &str, parent, joint: &str| Body {
        name: name.to_string(),
        parent,
        placement: Placement::IDENTITY,
        mass: 1.0,
        com: [0.0, 0.0, -0.5],
        inertia: [0.1, 0.0, 0.0, 0.1, 0.0, 0.1],
        joints: vec![JointDescription {
            axis: [1.0, 0.0, 0.0],
            ..JointDescription::new(joint, JointKind::Hinge)
        }],
    };
    RobotDescription {
        name: "pendulum".to_string(),
        gravity: [0.0, 0.0, -9.81],
        bodies: vec![body("upper", None, "shoulder"), body("lower", Some(0), "elbow")],
        frames: Vec::new(),
        solids: Vec::new(),
        motors: vec![Motor::direct("shoulder", 0, Some(5.0)), Motor::direct("elbow", 1, None)],
        notes: Vec::new(),
    }
}

#[test]
fn controls_and_torques_invert_each_other() {
    let drive = Motor {
        command: Command::Pd,
        gear: -2.0,
        gain: 30.0,
        bias: [0.5, -30.0, -2.0],
        force_range: Some([-12.0, 7.0]),
        ..Motor::direct("shoulder", 0, Some(4.0))
    };
    for (u, q, v) in [(0.1, 0.2, -0.3), (-0.1, 0.0, 0.4)] {
        // force 30 u + 0.5 - 30 (-2 q) - 2 (-2 v), by hand; it is within the range
        let force = 30.0 * u + 0.5 + 60.0 * q + 4.0 * v;
        let torque = drive.torque(u, q, v);
        assert!((torque - -2.0 * f64::clamp(force, -12.0, 7.0)).abs() < 1e-12);
        if (-12.0..7.0).contains(&force) {
            assert!((drive.control(torque, q, v) - u).abs() < 1e-12);
        }
    }
    assert_eq!(drive.torque(9.0, 0.0, 0.0), -14.0);
    assert_eq!(drive.strength(), 14.0, "only the force range bounds a drive");
    let plain = Motor { gear: 3.0, gain: 2.0, bias: [1.0, 0.0, 0.0], ..Motor::direct("elbow", 0, Some(4.0)) };
    assert_eq!(plain.strength(), 21.0, "3 (2 * 4 - 1): the weaker direction");
    assert_eq!(Motor::direct("elbow", 0, None).strength(), f64::INFINITY);
}

#[test]
fn json_keeps_every_bit() {
    let mut robot = pendulum();
    robot.bodies[1].joints[0].range = Range::Limited(-0.1 - 0.2, 1.0 / 3.0);
    let text = serde_json::to_string(&robot).unwrap();
    assert_eq!(serde_json::from_str::<RobotDescription>(&text).unwrap(), robot);
    let strange = text.replacen("\"gravity\"", "\"weight\"", 1);
    assert!(serde_json::from_str::<RobotDescription>(&strange).is_err());
}

#[test]
fn what_is_no_robot_is_refused_by_name() {
    let refused = |change: &dyn Fn(&mut RobotDescription), words: &[&str]| {
        let mut robot = pendulum();
        change(&mut robot);
        let text = robot.check("arm.json").unwrap_err().to_string();
        words.iter().chain(&["arm.json"]).for_each(|w| assert!(text.contains(w), "'{w}' is not in: {text}"));
    };
    assert_eq!(pendulum().check("arm.json"), Ok(()));
    refused(&|r| r.bodies[0].mass = -1.0, &["body 'upper' has mass -1 kg"]);
    refused(&|r| r.bodies[1].parent = Some(1), &["'lower'", "depth first"]);
    refused(&|r| r.bodies[1].name = "upper".into(), &["body 'upper' is there more than once"]);
    refused(&|r| r.bodies[1].joints[0].axis = [0.0; 3], &["'elbow'", "length 0"]);
    refused(
        &|r| r.bodies[1].joints[0].range = Range::Limited(1.0, -1.0),
        &["'elbow'", "lower 1 above upper -1"],
    );
    refused(&|r| r.bodies[1].placement.rotation[0][0] = -1.0, &["body 'lower'", "rotation"]);
    refused(&|r| r.motors[1].joint = "wrist".into(), &["motor 'elbow'", "'wrist'"]);
    refused(&|r| r.motors[1].order = 0, &["'shoulder' and 'elbow'", "control 0"]);
    refused(&|r| r.motors[1].gain = 0.0, &["motor 'elbow' has gain 0"]);
    let chain = |r: &mut RobotDescription| {
        for k in 2..20_000 {
            let joint = JointDescription::new(&format!("j{k}"), JointKind::Hinge);
            let body = Body {
                name: format!("b{k}"),
                parent: Some(k - 1),
                joints: vec![joint],
                ..r.bodies[0].clone()
            };
            r.bodies.push(body);
        }
    };
    refused(&chain, &["20000 dofs", "500"]);
}
