//! What is described of a robot is what MuJoCo simulates: mass matrix, forces, limits and motors, on the bundled robots, on all robots
//! of Gymnasium, and on files of the kind that people keep (defaults, includes, replicas, meshes, several trees, ball joints).

use std::path::{Path, PathBuf};

use nearl_runtime::Snapshot;
use nearl_runtime::constraints::convention as c;
use nearl_runtime::constraints::description::{Command, RobotDescription};
use nearl_runtime::constraints::drive::Held;
use nearl_runtime::constraints::{
    AccelerationLimit, Dynamics, Limit, Model, Period, PeriodDynamics, PositionLimit, Projector, Settings,
};
use nearl_runtime::snapshot::{ModelFormat, Simulation};
use nearl_trainer::mj::{JointKind, Sim};
use nearl_trainer::robot;
use nearl_trainer::rollout::stream;
use rand::RngExt;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn file(path: &Path) -> Simulation {
    let text = std::fs::read_to_string(path).expect("robot file");
    Simulation { format: ModelFormat::Mjcf, text, folder: Some(robot::folder_of(path)) }
}

/// Largest difference over the largest number.
fn relative(ours: &[f64], theirs: &[f64]) -> f64 {
    assert_eq!(ours.len(), theirs.len());
    let size = theirs.iter().fold(1e-3f64, |m, x| m.max(x.abs()));
    ours.iter().zip(theirs).fold(0.0f64, |m, (a, b)| m.max((a - b).abs())) / size
}

struct Pair {
    name: String,
    description: RobotDescription,
    model: Model,
    dynamics: Dynamics,
    sim: Sim,
    random: nearl_trainer::env::ChaCha8Rng,
}

impl Pair {
    fn new(name: &str, file: &Simulation) -> Pair {
        let simulated = robot::compile(file, false).unwrap_or_else(|e| panic!("{name}: {e}"));
        let description = robot::describe(file, false).unwrap_or_else(|e| panic!("{name}: {e}"));
        let model = Model::from_description(description.clone()).unwrap_or_else(|e| panic!("{name}: {e}"));
        let (dynamics, sim) = (Dynamics::new(&model), Sim::new(&simulated).expect("simulation"));
        Pair { name: name.to_string(), description, model, dynamics, sim, random: stream(3, 0) }
    }

    fn number(&mut self) -> f64 {
        self.random.random_range(-1.7..1.7)
    }

    /// A random state in MuJoCo's convention; free and ball joints get any rotation.
    fn state(&mut self) -> (Vec<f64>, Vec<f64>) {
        let mut qpos = self.sim.model().qpos0().to_vec();
        for joint in self.sim.model().joints() {
            match joint.kind {
                JointKind::Hinge | JointKind::Slide => qpos[joint.idx_q] += 0.5 * self.number(),
                _ => {
                    let at = joint.idx_q + joint.nq - 4;
                    let x: [f64; 4] = std::array::from_fn(|_| self.number());
                    let length = x.iter().map(|x| x * x).sum::<f64>().sqrt();
                    (0..4).for_each(|k| qpos[at + k] = x[k] / length);
                }
            }
        }
        let qvel = (0..self.model.nv()).map(|_| 2.0 * self.number()).collect();
        (qpos, qvel)
    }

    fn check(&mut self) {
        let mujoco = self.sim.model().clone();
        let names = |m: &Model| m.joints().iter().map(|j| j.name.clone()).collect::<Vec<_>>();
        assert_eq!(names(&self.model), mujoco.joints().iter().map(|j| j.name.clone()).collect::<Vec<_>>());
        assert_eq!((self.model.nq(), self.model.nv()), (mujoco.nq(), mujoco.nv()), "{}", self.name);
        for (ours, theirs) in self.model.joints().iter().zip(mujoco.joints()).filter(|(j, _)| j.nq == 1) {
            let range = [self.model.lower_position_limit(), self.model.upper_position_limit()];
            assert_eq!(range.map(|limit| limit[ours.idx_q]), theirs.range, "{} {}", self.name, ours.name);
        }
        for _ in 0..4 {
            let (qpos, qvel) = self.state();
            self.motions(&qpos, &qvel);
            self.motors(&qpos, &qvel);
        }
    }

    /// Mass matrix, column by column in MuJoCo's coordinates, and the forces of its own and of springs and dampers.
    fn motions(&mut self, qpos: &[f64], qvel: &[f64]) {
        let (m, nv, name) = (&self.model, self.model.nv(), &self.name);
        self.sim.set_state(qpos, qvel).expect("state");
        let (mut q, mut v) = (vec![0.0; m.nq()], vec![0.0; nv]);
        c::q_from_mujoco(m, qpos, &mut q);
        c::v_from_mujoco(m, &q, qvel, &mut v);
        let zeros = || vec![0.0; nv];
        let (mut mass, mut theirs) = (vec![0.0; nv * nv], vec![0.0; nv * nv]);
        self.dynamics.mass(&q, &mut mass);
        self.sim.mass(&mut theirs).expect("mass matrix");
        for k in 0..nv {
            let (mut unit, mut turned, mut out) = (zeros(), zeros(), zeros());
            unit[k] = 1.0;
            c::v_from_mujoco(m, &q, &unit, &mut turned);
            let column: Vec<f64> =
                (0..nv).map(|i| (0..nv).map(|j| mass[j * nv + i] * turned[j]).sum()).collect();
            c::tau_to_mujoco(m, &q, &column, &mut out);
            let off = relative(&out, &theirs[k * nv..(k + 1) * nv]);
            assert!(off < 1e-11, "{name}: column {k} of the mass matrix differs by {off:e}");
        }
        let (mut still, mut tau, mut out) = (zeros(), zeros(), zeros());
        c::a_from_mujoco(m, &q, &v, &zeros(), &mut still);
        self.dynamics.rnea(&q, &v, &still, &mut tau);
        c::tau_to_mujoco(m, &q, &tau, &mut out);
        let off = relative(&out, self.sim.nle());
        assert!(off < 1e-10, "{name}: nle differs by {off:e}");
        self.dynamics.aba(&q, &v, &tau, &mut out);
        let off = relative(&out, &still);
        assert!(off < 1e-9, "{name}: forward dynamics differ from inverse ones by {off:e}");
        let period = Period::new(0.01, 5);
        let mut rows = vec![0.0; nv * nv];
        self.dynamics.motor_rows(&period, &q, &v, &mut rows, &mut out);
        for (out, row) in out.iter_mut().zip(rows.chunks(nv)) {
            *out += row.iter().zip(&still).map(|(r, a)| r * a).sum::<f64>();
        }
        self.dynamics.motors_without_friction(&period, &q, &v, &still, &mut tau);
        let off = relative(&out, &tau);
        assert!(off < 1e-11, "{name}: rows of the motors differ by {off:e}");
        if !m.notes().iter().any(|note| note.contains("fluid") || note.contains("tendons")) {
            self.dynamics.passive(&q, &v, &mut tau);
            c::tau_to_mujoco(m, &q, &tau, &mut out);
            let off = relative(&out, self.sim.passive());
            assert!(off < 1e-11, "{name}: springs and dampers differ by {off:e}");
        }
    }

    /// Joint torques for controls within and beyond their ranges.
    fn motors(&mut self, qpos: &[f64], qvel: &[f64]) {
        self.sim.set_state(qpos, qvel).expect("state");
        let controls: Vec<f64> = (0..self.sim.model().nu()).map(|_| 3.0 * self.number()).collect();
        self.sim.ctrl_mut().copy_from_slice(&controls);
        self.sim.forward().expect("forces");
        let (mut theirs, mut ours) = (vec![0.0; self.model.nv()], vec![0.0; self.model.nv()]);
        self.sim.applied_force(&mut theirs);
        for motor in self.description.motors.iter().filter(|motor| motor.not_modelled.is_none()) {
            let joint = self.model.joint(&motor.joint).expect("its joint");
            let (q, v) = (qpos[joint.idx_q], qvel[joint.idx_v]);
            let torque = motor.torque(controls[motor.order], q, v);
            ours[joint.idx_v] += torque;
            let half = 0.5 * torque;
            let back = motor.torque(motor.control(half, q, v), q, v);
            let within = motor
                .control_range
                .is_none_or(|[low, high]| (low..=high).contains(&motor.control(half, q, v)));
            assert!(
                !within || (back - half).abs() <= 1e-9 * (1.0 + half.abs()),
                "{motor:?}: {back} and not {half}"
            );
        }
        for (joint, at) in self.description.joints().zip(self.model.joints()) {
            if let Some(effort) = joint.effort {
                ours[at.idx_v] = ours[at.idx_v].clamp(-effort, effort);
            }
        }
        let all = self.description.motors.iter().all(|motor| motor.not_modelled.is_none());
        if all && !self.description.notes.iter().any(|note| note.contains("actuator")) {
            let off = relative(&ours, &theirs);
            assert!(off < 1e-11, "{}: motors {ours:?} and not {theirs:?}", self.name);
        }
    }
}

/// What a controller never hears of is named: contacts and sensors of an MJCF file, where there are any.
#[test]
fn what_is_the_simulator_s_alone_is_named() {
    let folder = tempfile::tempdir().expect("folder");
    let told = |touch: &str, sensors: &str| {
        let text = format!(
            "<mujoco><worldbody><geom type=\"plane\" size=\"1 1 1\"/>\
             <body><joint name=\"j\"/><geom size=\".1\" mass=\"1\" {touch}/><site name=\"s\"/></body></worldbody>\
             <sensor>{sensors}</sensor></mujoco>"
        );
        let file = folder.path().join("r.xml");
        std::fs::write(&file, text).expect("robot");
        robot::simulated_alone(&file).expect("a robot").join("; ")
    };
    let off = "contype=\"0\" conaffinity=\"0\"";
    assert_eq!(told(off, ""), "");
    assert!(told("", "").contains("contacts are the simulator's alone: 2 geoms"), "{}", told("", ""));
    let sensors = "<gyro name=\"imu\" site=\"s\"/><touch site=\"s\"/>";
    assert!(told(off, sensors).ends_with("from the state: 'imu', number 1"), "{}", told(off, sensors));
    let urdf = root().join("examples/robots/panda/panda.urdf");
    assert_eq!(robot::simulated_alone(&urdf), Ok(Vec::new()));
}

#[test]
fn gymnasium_s_robots_are_mujoco_s() {
    let packages = PathBuf::from(std::env::var("NEARL_SITE_PACKAGES").expect("set in .cargo/config.toml"));
    let folder = packages.join("gymnasium/envs/mujoco/assets");
    let mut seen = 0;
    for entry in std::fs::read_dir(&folder).expect("Gymnasium is installed by 'make setup'") {
        let path = entry.expect("entry").path();
        if path.extension().is_some_and(|ending| ending == "xml") {
            Pair::new(&path.display().to_string(), &file(&path)).check();
            seen += 1;
        }
    }
    assert!(seen >= 13, "{seen} robots");
}

#[test]
fn odd_and_bundled_robots_are_mujoco_s() {
    for name in ["ant", "half_cheetah", "hopper", "walker2d_v5"] {
        Pair::new(name, &file(&root().join(format!("examples/robots/gymnasium/{name}.xml")))).check();
    }
    Pair::new("odd", &file(&root().join("constraints/tests/fixtures/odd.xml"))).check();
}

/// The stored descriptions that crates without MuJoCo test with are those of today.
#[test]
fn stored_descriptions_are_up_to_date() {
    for (name, path) in [
        ("ant", "examples/robots/gymnasium/ant.xml"),
        ("half_cheetah", "examples/robots/gymnasium/half_cheetah.xml"),
        ("hopper", "examples/robots/gymnasium/hopper.xml"),
        ("walker2d_v5", "examples/robots/gymnasium/walker2d_v5.xml"),
        ("odd", "constraints/tests/fixtures/odd.xml"),
    ] {
        let stored =
            std::fs::read_to_string(root().join(format!("constraints/tests/fixtures/robots/{name}.json")));
        let stored: RobotDescription = serde_json::from_str(&stored.expect("stored")).expect("a description");
        assert_eq!(
            robot::read_mjcf(&root().join(path)),
            Ok(stored),
            "write it with 'nearl robot --json {path}'"
        );
    }
}

/// A folder of files as robots are kept in collections.
fn collection() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let write = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
        std::fs::write(path, text).expect("a file");
    };
    write(
        "meshes/wedge.obj",
        "v 0 0 0\nv 0.2 0 0\nv 0 0.1 0\nv 0 0 0.3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n",
    );
    write(
        "parts/finger.xml",
        r#"<mujocoinclude><body name="finger" pos="0 0.05 0.2"><joint name="finger" class="slider" range="0 0.04"/>
        <geom class="skin" mesh="wedge"/><site name="tip" pos="0 0 0.02" euler="0 30 0"/></body></mujocoinclude>"#,
    );
    write(
        "arm.xml",
        r#"<mujoco model="collected"><compiler angle="radian" meshdir="meshes" autolimits="true"/>
        <option timestep="0.002"><flag contact="disable"/></option>
        <default><default class="arm"><joint axis="0 0 1" damping="1.5" armature="0.1" frictionloss="0.2"/>
          <geom contype="0" conaffinity="0" density="700"/>
          <position kp="200" kv="20" inheritrange="1" forcerange="-87 87"/>
          <default class="slider"><joint type="slide" axis="0 1 0" damping="3"/></default>
          <default class="skin"><geom type="mesh"/></default></default></default>
        <asset><mesh name="wedge" file="wedge.obj" scale="1.5 1 1"/></asset>
        <worldbody>
          <frame pos="0.2 0.1 0.3" euler="0.3 -0.2 0.7">
            <body name="shoulder" childclass="arm"><joint name="shoulder" range="-2.9 2.9"/><geom class="skin" mesh="wedge"/>
              <body name="elbow" pos="0 0 0.33" quat="1 -1 0 0"><joint name="elbow" range="-1.8 1.8" ref="0.4" springref="0.1" stiffness="2"/>
                <joint name="elbow_roll" axis="1 2 -1" pos="0.01 0.02 0.03" actuatorfrcrange="-5 5"/><geom type="capsule" size="0.04 0.1"/>
                <include file="parts/finger.xml"/></body></body></frame>
          <body name="second" pos="1 0 0"><joint name="slide_x" type="slide" axis="1 0 0" ref="-0.3"/>
            <joint name="pole" type="ball" pos="0 0 0.1" damping="0.1"/>
            <geom type="cylinder" size="0.02 0.4" mass="0.7"/></body>
          <replicate count="3" offset="0 0.5 0" sep="_"><body name="cube" pos="0 0 2">
            <joint type="free" armature="0.3" damping="0.1"/><geom type="box" size="0.05 0.06 0.07"/></body></replicate>
        </worldbody>
        <actuator><general name="roll" joint="elbow_roll" gear="-3" gainprm="5" biastype="affine" biasprm="0.7 0 -0.3" ctrlrange="-2 1"/>
          <position name="elbow" class="arm" joint="elbow"/><velocity name="finger" joint="finger" kv="40" ctrlrange="-1 1"/>
          <motor name="slide" joint="slide_x" gear="4" ctrlrange="-3 3" armature="0.02" damping="0.5"/>
          <position name="shoulder" class="arm" joint="shoulder"/></actuator></mujoco>"#,
    );
    folder
}

#[test]
fn robots_as_people_keep_them_are_mujoco_s() {
    let folder = collection();
    let mut pair = Pair::new("collected", &file(&folder.path().join("arm.xml")));
    pair.check();
    let model = &pair.model;
    assert_eq!(pair.description.name, "collected");
    assert_eq!((model.joints().len(), model.nv()), (9, 5 + 3 + 18));
    assert!(model.frame("tip").is_ok() && model.frame("cube_1").is_ok() && model.frame("second").is_ok());
    let motor = |name: &str| pair.description.motors.iter().find(|m| m.name == name).expect("a motor");
    let commands = ["roll", "elbow", "finger", "slide"].map(|name| motor(name).command);
    assert_eq!(commands, [Command::Effort, Command::Pd, Command::Velocity, Command::Effort]);
    assert_eq!((motor("roll").order, motor("shoulder").order), (0, 4));
    let effort = |joint: &str| model.effort_limit()[model.joint(joint).expect("joint").idx_v];
    assert_eq!((effort("slide_x"), effort("shoulder"), effort("elbow_roll")), (12.0, 87.0, 5.0));
    assert_eq!(model.friction()[model.joint("elbow").expect("joint").idx_v], 0.2);
    assert_eq!(model.notes(), [] as [&str; 0]);
}

/// One Euler step of a base that floats with a joint on it, damped and with armature, spinning: what it does is foreseen to rounding.
#[test]
fn a_damped_base_that_spins_does_what_is_foreseen() {
    let text = r#"<mujoco><option timestep="0.01" gravity="0 0 -9.81"/><worldbody><body pos="0 0 1">
        <joint name="root" type="free" armature="0.2" damping="3"/><geom type="box" size="0.1 0.2 0.3" pos="0.05 0.02 0" mass="2"/>
        <body pos="0.2 0 0"><joint name="j" axis="0 1 0" damping="0.5"/><geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0" mass="0.7"/></body>
        </body></worldbody></mujoco>"#;
    let folder = tempfile::tempdir().expect("folder");
    std::fs::write(folder.path().join("base.xml"), text).expect("robot");
    let mut pair = Pair::new("base", &file(&folder.path().join("base.xml")));
    for _ in 0..5 {
        let (qpos, qvel) = pair.state();
        let (m, nv) = (&pair.model, pair.model.nv());
        let (mut q, mut v, mut a, mut theirs) =
            (vec![0.0; m.nq()], vec![0.0; nv], vec![0.0; nv], vec![0.0; nv]);
        c::q_from_mujoco(m, &qpos, &mut q);
        c::v_from_mujoco(m, &q, &qvel, &mut v);
        pair.sim.set_state(&qpos, &qvel).expect("state");
        pair.sim.step(1).expect("a step");
        let qacc: Vec<f64> = pair.sim.qvel().iter().zip(&qvel).map(|(new, old)| (new - old) / 0.01).collect();
        c::a_from_mujoco(m, &q, &v, &qacc, &mut theirs);
        let mut dynamics = PeriodDynamics::new(m, &[6], Period::new(0.01, 1));
        dynamics.update(&q, &v, &vec![0.0; nv]);
        dynamics.accelerate(&vec![Held::Force(0.0); nv], &mut a);
        let off = relative(&a, &theirs);
        assert!(off < 1e-10, "{a:?} and not {theirs:?}: {off:e}");
    }
}

/// A file that cannot be found, or that no numbers say, is one sentence.
#[test]
fn what_cannot_be_described_is_refused_by_name() {
    let refused = |body: &str, head: &str, words: &[&str]| {
        let text = format!(r#"<mujoco>{head}<worldbody><body name="arm" {body}</body></worldbody></mujoco>"#);
        let text = robot::read_mjcf_text(&text).expect_err("an error").to_string();
        words.iter().for_each(|w| assert!(text.contains(w), "'{w}' is not in: {text}"));
    };
    let geom = r#"<geom size="0.1" mass="1"/>"#;
    refused(
        &format!(r#"gravcomp="1"><joint name="a" damping="1"/>{geom}<body><joint/>{geom}</body>"#),
        r#"<option><flag eulerdamp="disable"/></option>"#,
        &["gravcomp is not the same for all bodies that move ('arm' 1, ", "eulerdamp"],
    );
    refused(
        &format!(r#"gravcomp="1"><joint name="a" actuatorgravcomp="true"/>{geom}"#),
        "",
        &["joint 'a' has its weight held by its actuator"],
    );
    refused(
        &format!(r#"><joint name="a" type="ball" stiffness="2"/>{geom}"#),
        "",
        &["joint 'a' has 3 dofs and a spring"],
    );
    refused(
        r#"><joint name="a"/><geom type="mesh" mesh="m"/>"#,
        r#"<asset><mesh name="m" file="no/such.obj"/></asset>"#,
        &["no/such.obj"],
    );
    refused("><joint name=\"a\"/>", "", &["mass"]);
    let still = robot::read_mjcf_text(&format!(
        "<mujoco><worldbody><body name='arm'>{geom}</body></worldbody></mujoco>"
    ));
    let words =
        Model::from_description(still.expect("a description")).err().expect("nothing moves").to_string();
    assert!(words.contains("no movable joint"), "{words}");
}

/// MuJoCo keeps one actuator default a class, which every tag sets: the strength is that of the compiled model.
#[test]
fn motor_strength_through_default_classes_is_mujoco_s() {
    let text = std::fs::read_to_string(root().join("tests/fixtures/motors.json")).expect("fixture");
    let cases: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    let (mut finite, mut infinite) = (0, 0);
    for case in cases.as_array().expect("cases") {
        let xml = case["xml"].as_str().expect("a robot");
        let model = Model::from_description(robot::read_mjcf_text(xml).expect("robot")).expect("model");
        let (ours, theirs) = (model.effort_limit()[0], case["effort"].as_f64().unwrap_or(f64::INFINITY));
        assert!(ours == theirs || (ours / theirs - 1.0).abs() < 1e-12, "{ours} and not {theirs}: {xml}");
        *(if theirs.is_finite() { &mut finite } else { &mut infinite }) += 1;
    }
    assert!(finite > 10 && infinite > 5, "{finite} {infinite}: this proves nothing");
}

/// A robot of several files belongs to its task wherever the task goes: into a run's folder and into a snapshot.
#[test]
fn a_task_finds_what_its_robot_includes() {
    let folder = tempfile::tempdir().expect("a folder");
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).expect("a file");
    write("wedge.obj", "v 0 0 0\nv 0.2 0 0\nv 0 0.1 0\nv 0 0 0.3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n");
    write(
        "link.xml",
        r#"<mujocoinclude><body name="link"><joint name="hinge" axis="0 1 0" damping="0.2"/><geom type="mesh" mesh="wedge"/></body></mujocoinclude>"#,
    );
    write(
        "robot.xml",
        r#"<mujoco><asset><mesh name="wedge" file="wedge.obj"/></asset><worldbody><include file="link.xml"/></worldbody>
        <actuator><motor joint="hinge" gear="2" ctrlrange="-3 3"/></actuator></mujoco>"#,
    );
    let task = std::fs::read_to_string(root().join("tests/fixtures/two_link.toml")).expect("task");
    let task = task
        .replace("two_link.xml", "robot.xml")
        .replace("v.elbow", "v.hinge")
        .replace("position = { margin = 0.02 }\n", "");
    write("task.toml", &task.replace("dt = 0.01\nsim_dt = 0.01", "dt = 0.002\nsim_dt = 0.002"));
    let snapshot = nearl_tests::random_policy(&folder.path().join("task.toml").display().to_string(), 1, 1.0);
    assert_eq!(snapshot.manifest.robot.bodies[0].name, "link");
    let again = Snapshot::from_bytes(&snapshot.to_bytes()).expect("a snapshot");
    assert_eq!(again.manifest.robot, snapshot.manifest.robot);
    nearl_trainer::rollout::make_env(&again).expect("the environment of a snapshot");
    let run = tempfile::tempdir().expect("a folder");
    let file =
        nearl_trainer::run_folder::write_task(run.path(), "task", &snapshot.manifest).expect("a task file");
    let loaded = nearl_trainer::tasks::load(&file.display().to_string(), &[]).expect("the task of a run");
    assert_eq!(loaded.robot, snapshot.manifest.robot);
}

/// A snapshot of the first format carried its robot as text: of a URDF it is read, of an MJCF it says what to do.
#[test]
fn snapshots_of_the_first_format() {
    let old =
        std::fs::read(root().join("tests/fixtures/format_1.safetensors")).expect("a snapshot of format 1");
    let snapshot = Snapshot::from_bytes(&old).expect("a URDF robot");
    assert_eq!(snapshot.manifest.format, 2);
    let urdf = Model::from_urdf(&root().join("examples/robots/panda/panda.urdf")).expect("the same robot");
    assert_eq!(&snapshot.manifest.robot, urdf.description());
    nearl_runtime::Controller::new(&snapshot).expect("a controller");
    assert!(!String::from_utf8_lossy(&snapshot.to_bytes()).contains("<robot"), "no XML in today's format");

    let foreign = resigned(&old, "\"model_format\":\"urdf\"", "\"model_format\":\"mjcf\"");
    let text = Snapshot::from_bytes(&foreign).expect_err("an MJCF robot").to_string();
    assert!(text.contains("format 1 with an MJCF robot") && text.contains("train again"), "{text}");
    let newer = resigned(&old, "\"format\":1", "\"format\":4");
    let text = Snapshot::from_bytes(&newer).expect_err("another format").to_string();
    assert!(text.contains("format 4 where this program reads 1 to 3"), "{text}");
}

/// The file with other words in its manifest, and a digest that fits.
fn resigned(file: &[u8], from: &str, to: &str) -> Vec<u8> {
    let length = u64::from_le_bytes(file[..8].try_into().expect("a length")) as usize;
    let mut header: serde_json::Value = serde_json::from_slice(&file[8..8 + length]).expect("a header");
    let old = header["__metadata__"]["nearl"].as_str().expect("a manifest").to_string();
    let (_, manifest) = old.split_once('\n').expect("a digest");
    assert!(manifest.contains(from), "{from}");
    let manifest = manifest.replacen(from, to, 1);
    let tensors: Vec<(String, Vec<usize>, Vec<u8>)> = header
        .as_object()
        .expect("an object")
        .iter()
        .filter(|(name, _)| *name != "__metadata__")
        .map(|(name, entry)| {
            let numbers =
                |key: &str| serde_json::from_value::<Vec<usize>>(entry[key].clone()).expect("numbers");
            let place = numbers("data_offsets");
            let data = &file[8 + length..];
            (name.clone(), numbers("shape"), data[place[0]..place[1]].to_vec())
        })
        .collect();
    let parts = tensors.iter().map(|(name, shape, data)| (name.as_str(), shape.as_slice(), data.as_slice()));
    let sum = nearl_runtime::snapshot::digest(&manifest, parts);
    header["__metadata__"]["nearl"] = format!("{sum}\n{manifest}").into();
    let header = serde_json::to_vec(&header).expect("a header");
    [&(header.len() as u64).to_le_bytes()[..], &header, &file[8 + length..]].concat()
}

/// MuJoCo takes a joint whose ends are swapped for one without limits; nobody who wrote them means that.
#[test]
fn a_range_with_swapped_ends_is_refused_and_a_joint_without_one_is_named() {
    let arm = |range: [&str; 2]| {
        let joint = |name: &str, range: &str| {
            format!(
                r#"<joint name="{name}" type="hinge" axis="0 1 0" {range}/><geom size="0.1" mass="1" pos=".2 0 0"/>"#
            )
        };
        let [first, second] = [joint("a", range[0]), joint("elbow", range[1])];
        robot::read_mjcf_text(&format!(
            r#"<mujoco><worldbody><body>{first}<body pos=".4 0 0">{second}</body></body></worldbody></mujoco>"#
        ))
        .expect("described")
    };
    let good = r#"range="-90 90""#;
    let swapped =
        Model::from_description(arm([good, r#"range="120 -20""#])).err().expect("refused").to_string();
    assert!(swapped.contains("joint 'elbow' has lower ") && swapped.contains(" above upper "), "{swapped}");
    for without in ["", r#"limited="false" range="-90 90""#] {
        let limits = |robot: RobotDescription| {
            let model = Model::from_description(robot).expect("a robot");
            let position: [Box<dyn Limit>; 2] =
                [Box::new(PositionLimit::with_margin(0.0)), Box::new(AccelerationLimit::uniform(5.0))];
            let settings = Settings::new(0.01, 0);
            Projector::new(&model, &position, &[0, 1], settings).map(|p| p.notes().join("; "))
        };
        let notes = limits(arm([good, without])).expect("a projector");
        assert!(notes.contains("the position limit does not hold for 'elbow'"), "{without}: {notes}");
        let refused = limits(arm([without, without])).expect_err("nothing to hold").to_string();
        assert!(refused.contains("the robot file gives none for 'a', 'elbow'"), "{without}: {refused}");
    }
}
