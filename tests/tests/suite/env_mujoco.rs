//! The MuJoCo module: errors come back, warnings stay out of files, URDF frames survive.

use nearl_trainer::mj::{MjError, Model, ModelFormat, Options, Scene, Sim, last_warning, warnings};

/// Balls that start apart, in a simulation with `size` of working memory.
fn balls(size: usize) -> String {
    let ball = |i| format!(r#"<body pos="{i} 0 3"><freejoint/><geom size=".1"/></body>"#);
    let balls: String = (0..8).map(ball).collect();
    format!(
        r#"<mujoco><size memory="{size}"/><worldbody><geom type="plane" size="9 9 1"/>{balls}</worldbody></mujoco>"#
    )
}

const PENDULUM: &str = r#"<mujoco><worldbody><body name="rod"><joint name="hinge" axis="0 1 0"/>
    <geom type="sphere" size=".01" mass="2" pos="0 0 -.5"/></body></worldbody></mujoco>"#;

const ARM: &str = r#"<?xml version="1.0"?><robot name="arm"><link name="base"/>
    <link name="upper"><inertial><mass value="2"/><origin xyz="0 0 0.5"/>
      <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <link name="tool"/>
    <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
      <limit lower="-1" upper="2" effort="30" velocity="3"/><dynamics damping="0.5"/></joint>
    <joint name="wrist" type="fixed"><parent link="upper"/><child link="tool"/><origin xyz="0 0 1"/></joint></robot>"#;

fn mjcf(text: &str) -> Model {
    Model::from_text(text, ModelFormat::Mjcf, Options::default()).expect("the model compiles")
}

#[test]
fn a_robot_without_memory_is_refused_on_one_line() {
    let refused = Model::from_text(&balls(2000), ModelFormat::Mjcf, Options::default()).unwrap_err();
    let words = refused.to_string();
    assert!(words.contains("out of memory") && !words.contains('\n'), "{words}");
}

#[test]
fn a_fatal_error_resets_the_simulation_which_then_works_again() {
    // Memory enough for balls that fly, not for balls that touch: where that is depends on MuJoCo's inner workings.
    let mut failed = 0;
    for size in (8_000..200_000).step_by(1_000) {
        let Ok(mut sim) = Sim::new(&mjcf(&balls(size))) else { continue };
        let start = sim.qpos().to_vec();
        let mut touching = start.clone();
        touching.chunks_mut(7).zip(0u8..).for_each(|(ball, i)| {
            ball[..3].copy_from_slice(&[0.05 * f64::from(i % 3), 0.05 * f64::from(i / 3), 0.05]);
        });
        if let Err(error) = sim.set_state(&touching, &[0.0; 48]) {
            assert!(matches!(error, MjError::Engine(_)), "{error}");
            assert_eq!((sim.qpos(), sim.time()), (&start[..], 0.0));
            sim.step(20).expect("the simulation works again");
            assert!(sim.qvel()[2] < 0.0, "the balls fall");
            failed += 1;
        }
    }
    assert!(failed > 0, "no size made MuJoCo stop");
}

#[test]
fn a_robot_that_does_not_compile_is_refused_with_the_reason() {
    let refused =
        Model::from_text("<mujoco><worldbody><body/></mujoco>", ModelFormat::Mjcf, Options::default());
    assert!(matches!(refused, Err(MjError::Load(_))), "{refused:?}");
    let refused = Model::from_text("not a robot", ModelFormat::Urdf, Options::default());
    assert!(refused.unwrap_err().to_string().starts_with("MuJoCo cannot load the robot file: "));
}

/// MuJoCo's own sentence names the element and its line at the end, beyond what `mujoco-rs` has room for.
#[test]
fn the_reason_is_told_to_its_end() {
    let folder = tempfile::tempdir().expect("folder");
    std::fs::write(folder.path().join("words.xml"), "words, and no element").expect("file");
    let text = "<mujoco>\n  <include file=\"words.xml\"/>\n</mujoco>";
    let load = |scene: &Scene| {
        let options = Options::default();
        Model::with_scene(text, ModelFormat::Mjcf, Some(folder.path()), options, scene)
            .unwrap_err()
            .to_string()
    };
    for scene in [Scene::default(), Scene { floor: Some(1.0), ..Scene::default() }] {
        let words = load(&scene);
        assert!(words.contains("Include error") && words.ends_with("Element 'include', line 2"), "{words}");
    }
}

/// The library panics at a second geom of a name, and a ground is called `floor` more often than not.
#[test]
fn a_floor_beside_one_of_its_name_is_refused() {
    for (name, bumps, says) in
        [("floor", None, "adds 'floor'"), ("bumps", Some(0.05), "adds 'bumps'"), ("bumps", None, "")]
    {
        let text = PENDULUM.replacen(
            "<worldbody>",
            &format!("<worldbody><geom name=\"{name}\" type=\"plane\" size=\"1 1 1\"/>"),
            1,
        );
        let scene = Scene { floor: Some(1.0), bumps, ..Scene::default() };
        let loaded = Model::with_scene(&text, ModelFormat::Mjcf, None, Options::default(), &scene);
        let words = loaded.map_or_else(|refused| refused.to_string(), |_| String::new());
        assert!(words.contains(says) && words.is_empty() == says.is_empty(), "{name}: {words}");
    }
}

/// A physics step that is none, unless the task says another.
#[test]
fn a_timestep_that_is_none_is_refused() {
    for step in ["nan", "inf", "0", "-0.002"] {
        let text = PENDULUM.replacen("<mujoco>", &format!("<mujoco><option timestep=\"{step}\"/>"), 1);
        let load =
            |sim_dt| Model::from_text(&text, ModelFormat::Mjcf, Options { sim_dt, ..Options::default() });
        let refused = load(None).unwrap_err();
        assert!(matches!(refused, MjError::Timestep(_)), "{step}: {refused}");
        assert!(refused.to_string().contains("<option timestep>"), "{refused}");
        assert_eq!(load(Some(0.001)).expect("the task's own").sim_dt(), 0.001);
    }
}

#[test]
fn warnings_are_counted_and_leave_no_file() {
    let before = warnings();
    let cheetah = include_str!("../../../examples/robots/gymnasium/half_cheetah.xml");
    mjcf(cheetah);
    assert!(warnings() > before, "this robot file warns at every load");
    assert!(last_warning().is_some());
    assert!(!std::path::Path::new("MUJOCO_LOG.TXT").exists());
}

#[test]
fn a_bad_state_is_refused_and_nothing_changes() {
    let mut sim = Sim::new(&mjcf(PENDULUM)).expect("a simulation");
    sim.set_state(&[0.3], &[0.2]).expect("a state");
    assert_eq!(
        sim.set_state(&[0.0; 2], &[0.0]).unwrap_err(),
        MjError::Length { what: "qpos", expected: 1, got: 2 }
    );
    assert!(matches!(
        sim.set_state(&[0.0], &[f64::NAN]),
        Err(MjError::NotFinite { what: "qvel", index: 0, .. })
    ));
    assert_eq!((sim.qpos(), sim.qvel()), (&[0.3][..], &[0.2][..]));
}

#[test]
fn an_unstable_state_is_noticed_once() {
    let mut sim = Sim::new(&mjcf(PENDULUM)).expect("a simulation");
    assert!(!sim.take_unstable());
    sim.force_mut()[0] = 1e300;
    sim.step(3).expect("MuJoCo recovers by itself");
    assert!(sim.take_unstable());
    assert!(!sim.take_unstable());
}

#[test]
fn a_pendulum_moves_as_the_equation_says() {
    // I a = -m g l sin(q) + u, with I = m l^2 + 2/5 m r^2.
    let (m, l, r, q, u): (f64, f64, f64, f64, f64) = (2.0, 0.5, 0.01, 0.4, 3.0);
    let inertia = m * l * l + 0.4 * m * r * r;
    let expected = (u - m * 9.81 * l * q.sin()) / inertia;
    let mut sim = Sim::new(&mjcf(PENDULUM)).expect("a simulation");
    sim.set_state(&[q], &[0.0]).expect("a state");
    sim.force_mut()[0] = u;
    sim.forward().expect("an evaluation");
    assert!((sim.acceleration()[0] - expected).abs() < 1e-12, "{} {expected}", sim.acceleration()[0]);
    let mut force = [0.0];
    sim.applied_force(&mut force);
    assert_eq!(force, [u]);
}

#[test]
fn a_urdf_keeps_its_tool_frame_its_limits_and_its_damping() {
    let options = Options { sim_dt: Some(1e-3), without_contacts: true, ..Options::default() };
    let model = Model::from_text(ARM, ModelFormat::Urdf, options).expect("the model compiles");
    let joint = &model.joints()[0];
    assert_eq!((joint.name.as_str(), joint.range, joint.effort), ("shoulder", [-1.0, 2.0], 30.0));
    assert_eq!(model.total_mass(), 2.0);

    let mut sim = Sim::new(&model).expect("a simulation");
    sim.place(&[std::f64::consts::FRAC_PI_2]).expect("a configuration");
    let tool = sim.position(model.body("tool").expect("the tool is a body"));
    assert!((tool[0] - 1.0).abs() < 1e-15 && tool[2].abs() < 1e-15, "{tool:?}");
    assert_eq!(model.body("hand"), Err(MjError::NoBody("hand".into())));

    // (I + m l^2) a = m g l sin(q) - damping v' + u, and v' = v + dt a.
    let (q, v, u): (f64, f64, f64) = (0.5, 1.5, 2.0);
    let a = (2.0 * 9.81 * 0.5 * q.sin() - 0.5 * v + u) / (0.1 + 2.0 * 0.25 + 1e-3 * 0.5);
    sim.set_state(&[q], &[v]).expect("a state");
    sim.force_mut()[0] = u;
    sim.step(1).expect("a step");
    assert!((sim.qvel()[0] - (v + 1e-3 * a)).abs() < 1e-15, "{} {}", sim.qvel()[0], v + 1e-3 * a);
    assert!((sim.qpos()[0] - (q + 1e-3 * sim.qvel()[0])).abs() < 1e-15);
}
