//! Motors of robots of one's own.

use nearl_runtime::{Controller, PolicyKind};
use nearl_tests::random_policy;
use nearl_trainer::learn::Algorithm;
use nearl_trainer::rollout::{make_env, stream};
use nearl_trainer::tasks;
use nearl_trainer::train::{Request, Training, complete};

use super::{fixture, urdf_arm, with_motors};

/// The same arm with motors of gear, gain and bias, and in another order: the state reached is the one that was projected, to rounding, and
/// the limits hold as they do with plain motors.
#[test]
fn motors_with_gear_gain_and_bias_in_any_order_reach_what_was_projected() {
    let folder = tempfile::tempdir().expect("folder");
    let both =
        "<motor joint=\"shoulder\" ctrlrange=\"-80 80\"/>\n    <motor joint=\"elbow\" ctrlrange=\"-30 30\"/>";
    let odd = "<general name=\"e\" joint=\"elbow\" gear=\"-6\" gainprm=\"2.5\" biastype=\"affine\" biasprm=\"0.5 0 0\" ctrlrange=\"-2.2 1.8\"/>\n\
               <motor name=\"s\" joint=\"shoulder\" gear=\"80\" ctrlrange=\"-1 1\"/>";
    let swings = [both, odd].map(|motors| {
        let snapshot = random_policy(&with_motors(folder.path(), both, motors), 5, 3.0);
        let mut env = make_env(&snapshot).expect("environment");
        let mut controller = Controller::new(&snapshot).expect("controller");
        let (mut state, mut out, noise) = (controller.state(), controller.output(), controller.noise());
        env.reset(&mut stream(5, 0)).expect("reset");
        let mut path = Vec::new();
        for _ in 0..3000 {
            env.observe(&mut state.obs);
            env.state(&mut state.q, &mut state.v);
            assert!(controller.update(&state, &noise, &mut out).is_ok());
            env.step(&out.action);
            let missed =
                env.qvel().iter().zip(&out.next.v).map(|(v, target)| (v - target).abs()).fold(0.0, f64::max);
            assert!(missed < 1e-9, "{motors}: a velocity missed by {missed} rad/s");
            path.extend_from_slice(env.qvel());
        }
        assert_eq!(env.counters().saturations, 0, "{motors}");
        path
    });
    let fastest = swings[0].iter().fold(0.0f64, |most, v| most.max(v.abs()));
    assert!(
        (3.9..4.0 + 1e-9).contains(&fastest),
        "{fastest} rad/s of 4: the limit was not reached, or broken"
    );
    let apart = swings[0].iter().zip(&swings[1]).take(200).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(apart < 1e-6, "the same policy moved the two arms {apart} rad/s apart");
}

/// Where the file says nothing of exploration, the one that the inverse model can have is taken.
#[test]
fn exploration_that_is_not_stated_fits_the_inverse_model() {
    let folder = tempfile::tempdir().expect("folder");
    for (kind, stated, policy) in [
        ("pinocchio", "", Ok(PolicyKind::Stochastic)),
        ("pinocchio", "exploration = \"action\"", Err("needs a learned inverse model")),
        ("learned", "", Ok(PolicyKind::Deterministic)),
        ("learned", "exploration = \"proposal\"", Ok(PolicyKind::Stochastic)),
    ] {
        let text = std::fs::read_to_string(fixture("two_link.toml")).expect("task");
        let text = text.replace("kind = \"pinocchio\"", &format!("kind = \"{kind}\""));
        let text = text.replace("exploration = \"proposal\"", stated);
        let text = match kind {
            "learned" => text.replace("\"kinematic\"", "\"free\"").replace("torque = {}", ""),
            _ => text,
        };
        std::fs::write(folder.path().join("two_link.toml"), text).expect("task");
        std::fs::copy(fixture("two_link.xml"), folder.path().join("two_link.xml")).expect("robot");
        let mut manifest =
            tasks::load(&folder.path().join("two_link.toml").display().to_string(), &[]).expect("task");
        complete(&mut manifest).expect("manifest");
        let request = Request { manifest, algo: Algorithm::Pid2Ib, steps: 1024, seed: 0, threads: 1 };
        let made = Training::new(&request);
        match (policy, made) {
            (Ok(policy), Ok(training)) => {
                assert_eq!(training.snapshot().manifest.policy, policy, "{kind}, {stated}")
            }
            (Err(says), Err(e)) => assert!(e.to_string().contains(says), "{e}"),
            (expected, made) => {
                panic!("{kind}, {stated}: {expected:?}, {:?}", made.err().map(|e| e.to_string()))
            }
        }
    }
}

/// A URDF robot with a task of its own: MuJoCo compiles it, motors and limits are the file's.
#[test]
fn a_urdf_robot_has_a_task_of_its_own() {
    let folder = tempfile::tempdir().expect("folder");
    let snapshot = random_policy(&urdf_arm(folder.path(), ""), 3, 3.0);
    let robot = &snapshot.manifest.robot;
    assert_eq!(robot.motors.iter().map(|m| m.joint.as_str()).collect::<Vec<_>>(), ["z_shoulder", "a_elbow"]);
    let (mut env, mut controller) =
        (make_env(&snapshot).expect("environment"), Controller::new(&snapshot).expect("controller"));
    let (mut state, mut out, noise) = (controller.state(), controller.output(), controller.noise());
    env.reset(&mut stream(5, 0)).expect("reset");
    let mut fastest = 0.0f64;
    for _ in 0..5000 {
        env.observe(&mut state.obs);
        env.state(&mut state.q, &mut state.v);
        assert!(controller.update(&state, &noise, &mut out).is_ok());
        env.step(&out.action);
        let missed = env.qvel().iter().zip(&out.next.v).map(|(v, t)| (v - t).abs()).fold(0.0, f64::max);
        assert!(missed < 1e-9, "a velocity missed by {missed} rad/s");
        assert!(env.qpos()[0].abs() < 1.98 + 1e-9, "{} rad", env.qpos()[0]);
        fastest = env.qvel().iter().fold(fastest, |most, v| most.max(v.abs()));
    }
    assert!(
        (3.9..4.0 + 1e-9).contains(&fastest),
        "{fastest} rad/s of 4: the limit was not reached, or broken"
    );
}

/// A URDF's joints that are sent positions are servos with the gains of the section, which follow what is projected; without gains nothing could
/// be simulated.
#[test]
fn servos_of_a_urdf_follow_positions() {
    let folder = tempfile::tempdir().expect("folder");
    let servo = "\n[command]\ninterface = \"position\"\nstiffness = { z_shoulder = 4e4, a_elbow = 4e3 }\n\
                 damping = { z_shoulder = 80.0, a_elbow = 8.0 }\n";
    let snapshot = random_policy(&urdf_arm(folder.path(), servo), 3, 3.0);
    let (mut env, mut controller) =
        (make_env(&snapshot).expect("environment"), Controller::new(&snapshot).expect("controller"));
    let (mut state, mut out, noise) = (controller.state(), controller.output(), controller.noise());
    env.reset(&mut stream(5, 0)).expect("reset");
    let (mut missed, mut least, mut most) = (0.0f64, 0.0f64, 0.0f64);
    for _ in 0..5000 {
        env.observe(&mut state.obs);
        env.state(&mut state.q, &mut state.v);
        assert!(controller.update(&state, &noise, &mut out).is_ok());
        assert_eq!(out.action, out.next.q, "what is sent is the projected position");
        env.step(&out.action);
        missed = env.qpos().iter().zip(&out.next.q).map(|(q, t)| (q - t).abs()).fold(missed, f64::max);
        (least, most) = (least.min(env.qpos()[0]), most.max(env.qpos()[0]));
    }
    println!("missed {missed} rad, from {least} to {most} rad");
    assert!(missed < 0.1 && most - least > 0.3, "missed {missed} rad, from {least} to {most} rad");
    let bare = urdf_arm(folder.path(), "\n[command]\ninterface = \"position\"\n");
    let refused = tasks::load(&bare, &[]).map(|_| ()).expect_err("no servo").to_string();
    assert!(
        refused.contains("'z_shoulder' is sent 'position' commands") && refused.contains("stiffness"),
        "{refused}"
    );
}

/// Two motors of gear 3 and -2 turn one hinge: 2 N m, and what is summed over driven joints counts it once.
#[test]
fn a_joint_with_two_motors_is_summed_once() {
    const ROBOT: &str = "<mujoco><option timestep=\"0.01\"/><worldbody><body name=\"b\"><joint name=\"j\" axis=\"0 1 0\" damping=\".1\"/>\
        <geom type=\"capsule\" fromto=\"0 0 0 0 0 -.3\" size=\".03\" mass=\"1\"/></body></worldbody><actuator>\
        <motor name=\"a\" joint=\"j\" gear=\"3\" ctrlrange=\"-1 1\"/><motor name=\"b\" joint=\"j\" gear=\"-2\" ctrlrange=\"-1 1\"/></actuator></mujoco>";
    let folder = tempfile::tempdir().expect("folder");
    std::fs::write(folder.path().join("two.xml"), ROBOT).expect("robot");
    let file = folder.path().join("two.toml");
    let env_of = |reward: &str| {
        let text = format!(
            "name = \"two\"\n[model]\nmjcf = \"two.xml\"\n[time]\ndt = 0.01\nsim_dt = 0.01\n[state]\ncontrollable = []\n[reward]\nr = \"{reward}\"\n\
             [constraints]\n[idm]\nkind = \"learned\"\n"
        );
        std::fs::write(&file, text).expect("task");
        tasks::env(file.to_str().expect("UTF-8")).expect("task")
    };
    type Expected = fn(f64, f64) -> f64;
    let of: [(&str, Expected); 3] = [
        ("power", |_, v| (2.0 * v).abs()),
        ("torque.squared", |_, _| 4.0),
        ("dv.squared", |before, v| ((v - before) / 0.01).powi(2)),
    ];
    for (name, expected) in of {
        let mut env = env_of(name);
        env.reset(&mut stream(1, 0)).expect("reset");
        for _ in 0..3 {
            let before = env.qvel()[0];
            let reward = env.step(&[1.0, 0.5]).reward;
            let expected = expected(before, env.qvel()[0]);
            assert!((reward - expected).abs() < 1e-9 * (1.0 + expected), "{name}: {reward} {expected}");
        }
    }
}
