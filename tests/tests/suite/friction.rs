//! Dry friction: motors make up for MuJoCo's, limits hold whichever way a joint rubs, and the doctor says by how much the friction may be wrong.

use nearl_constraints::{
    AccelerationLimit, Dynamics, Limit, Model, Period, Projector, Settings, TorqueLimit, VelocityLimit,
};
use nearl_runtime::{Controller, Snapshot};
use nearl_tests::{random_policy, training};
use nearl_trainer::mj;
use nearl_trainer::rollout::{make_env, stream};
use rand::RngExt;
use std::path::Path;

#[path = "../../../constraints/examples/coulomb/attack.rs"]
#[allow(dead_code, unreachable_pub)]
mod attack;
use attack::{FINE, Rubs, Seen, rub, uniform};

/// A URDF of three joints whose last one is light and rubs as much as the others.
pub(super) fn arm(friction: [f64; 3], damping: f64) -> String {
    let links = [("a", "0 1 0", 1.5, 0.012), ("b", "0 1 0", 0.8, 0.006), ("c", "1 0 0", 0.2, 0.0002)];
    let mut text = r#"<robot name="rubbing"><link name="base"/>"#.to_string();
    let mut parent = "base".to_string();
    for ((joint, axis, mass, inertia), friction) in links.into_iter().zip(friction) {
        text += &format!(
            r#"<link name="{joint}_link"><inertial><origin xyz="0.1 0 0.01"/><mass value="{mass}"/>
            <inertia ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial></link>
            <joint name="{joint}" type="revolute"><parent link="{parent}"/><child link="{joint}_link"/><origin xyz="0.25 0 0"/>
            <axis xyz="{axis}"/><limit lower="-2" upper="2" effort="30" velocity="3"/>
            <dynamics friction="{friction}" damping="{damping}"/></joint>"#
        );
        parent = format!("{joint}_link");
    }
    text + "</robot>"
}

const FRICTION: [f64; 3] = [1.0, 2.0, 1.0];

pub(super) fn plant(text: &str, sim_dt: f64) -> mj::Sim {
    let options = mj::Options { sim_dt: Some(sim_dt), without_contacts: true, ..mj::Options::default() };
    mj::Sim::new(&mj::Model::from_text(text, mj::ModelFormat::Urdf, options).expect("plant"))
        .expect("simulation")
}

#[test]
fn a_urdf_s_friction_sets_in_as_the_simulator_has_it() {
    let text = arm(FRICTION, 0.5);
    let ours = Model::from_urdf_text(&text).expect("model");
    let theirs = mj::Model::from_text(&text, mj::ModelFormat::Urdf, mj::Options::default()).expect("plant");
    let theirs = Model::from_description(theirs.describe().expect("description")).expect("model");
    assert_eq!(ours.friction(), FRICTION);
    for i in 0..3 {
        let (a, b) = (ours.friction_onset()[i].expect("onset"), theirs.friction_onset()[i].expect("onset"));
        assert!(
            (a.inertia / b.inertia - 1.0).abs() < 1e-9 && (a.time / b.time - 1.0).abs() < 1e-12,
            "{a:?} {b:?}"
        );
    }
    // The light joint's friction is a damper at any speed allowed here: D (a + v / time) stays below 1 N m.
    assert!(ours.friction_onset()[2].expect("onset").inertia * (10.0 + 3.0 / 0.0095) < 1.0);
}

#[test]
fn motors_make_up_for_the_simulator_s_friction() {
    for damping in [0.0, 1.0] {
        let text = arm(FRICTION, damping);
        let model = Model::from_urdf_text(&text).expect("model");
        let (mut dynamics, mut sim, mut seed) = (Dynamics::new(&model), plant(&text, 0.001), 1);
        let (mut worst, mut without) = (0.0_f64, 0.0_f64);
        for k in 0..300 {
            // A joint at rest, hardly moving, and moving.
            let speed = [0.0, 1e-3, 2.0][k % 3];
            let q = [0, 1, 2].map(|_| uniform(&mut seed));
            let v = [0, 1, 2].map(|_| speed * uniform(&mut seed));
            let a = [0, 1, 2].map(|_| 10.0 * uniform(&mut seed));
            let mut off = |tau: &[f64; 3]| {
                sim.set_state(&q, &v).expect("state");
                sim.force_mut().copy_from_slice(tau);
                sim.step(1).expect("step");
                (0..3).map(|i| ((sim.qvel()[i] - v[i]) / 0.001 - a[i]).abs()).fold(0.0, f64::max)
            };
            let (mut tau, mut smooth) = ([0.0; 3], [0.0; 3]);
            dynamics.motors(&Period::new(0.001, 1), &q, &v, &a, &mut tau);
            dynamics.motors_without_friction(&Period::new(0.001, 1), &q, &v, &a, &mut smooth);
            (0..3).for_each(|i| assert!((tau[i] - smooth[i]).abs() <= FRICTION[i] + 1e-12));
            worst = worst.max(off(&tau));
            without = without.max(off(&smooth));
        }
        assert!(worst < 1e-6, "damping {damping}: {worst} rad/s² off");
        assert!(without > 10.0, "the test would see nothing: {without}");
    }
}

/// The arm that is attacked: MuJoCo with its own friction, or without any and with Coulomb's in steps of [`FINE`].
struct Arm {
    sim: mj::Sim,
    steps: u32,
    coulomb: Option<(Dynamics, Vec<f64>)>,
}

impl Arm {
    fn new(text: &str, dt: f64, sub_steps: u32, coulomb: bool) -> Arm {
        if coulomb {
            let model = Model::from_urdf_text(text).expect("model");
            let friction = model.friction().to_vec();
            let sim = plant(&smooth(text), FINE);
            return Arm {
                sim,
                steps: (dt / FINE).round() as u32,
                coulomb: Some((Dynamics::new(&model), friction)),
            };
        }
        let steps = sub_steps.max(1);
        let runge_kutta =
            r#"<mujoco><compiler fusestatic="false"/><option integrator="RK4"/></mujoco></robot>"#;
        let text = if sub_steps == 0 { text.replace("</robot>", runge_kutta) } else { text.to_string() };
        Arm { sim: plant(&text, dt / f64::from(steps)), steps, coulomb: None }
    }
}

impl Rubs for Arm {
    fn state(&self) -> (Vec<f64>, Vec<f64>) {
        (self.sim.qpos().to_vec(), self.sim.qvel().to_vec())
    }

    fn go(&mut self, tau: &[f64]) {
        self.sim.force_mut().copy_from_slice(tau);
        let Some((dynamics, friction)) = &mut self.coulomb else {
            return self.sim.step(self.steps as usize).expect("steps");
        };
        for _ in 0..self.steps {
            let [force, _] = rub(dynamics, (self.sim.qpos(), self.sim.qvel()), tau, friction);
            for (motor, (tau, force)) in self.sim.force_mut().iter_mut().zip(tau.iter().zip(&force)) {
                *motor = tau - force;
            }
            self.sim.step(1).expect("step");
        }
    }
}

/// The same robot without friction.
fn smooth(text: &str) -> String {
    let mut parts = text.split("friction=\"");
    let mut out = parts.next().unwrap_or_default().to_string();
    for part in parts {
        out += "friction=\"0\"";
        out += part.split_once('"').expect("a closing quote").1;
    }
    out
}

/// [`attack::attacked`] from the middle of the joints' ranges; the projector and the inverse dynamics are of the robot `known`.
fn attacked(arm: &mut Arm, known: &str, sub_steps: u32, dt: f64, ticks: usize) -> Seen {
    let model = Model::from_urdf_text(known).expect("model");
    let (low, high) = (model.lower_position_limit(), model.upper_position_limit());
    let middle: Vec<f64> = low.iter().zip(high).map(|(l, h)| 0.5 * (l + h)).collect();
    arm.sim.set_state(&middle, &vec![0.0; model.nv()]).expect("state");
    attack::attacked(arm, &model, (dt, sub_steps), ticks)
}

#[test]
fn a_joint_that_rubs_keeps_its_limits_under_attack() {
    let text = arm(FRICTION, 0.5);
    let attack = |known: &str| attacked(&mut Arm::new(&text, 0.001, 1, false), known, 1, 0.001, 3000);
    let [a, v, q, tau] = attack(&text).worst;
    assert!(
        a < 1e-6 && v < 1e-9 && q < 1e-9 && tau < 1e-9,
        "{a} rad/s², {v} rad/s, {q} rad, {tau} N m beyond"
    );
    let [a, ..] = attack(&smooth(&text)).worst;
    assert!(a > 1.0, "the attack would see nothing: {a}");
}

/// How far the two-link arm of the fixtures, whose joints rub by MuJoCo's `frictionloss`, came beyond the limits of its task file under a
/// random policy (acceleration [rad/s²], speed [rad/s], position [rad], torque [N m]), and how near to its limits of speed. The policy
/// proposes states, or gives forces to a guard.
fn task_that_rubs(known: bool, guarded: bool) -> ([f64; 4], f64) {
    let folder = tempfile::tempdir().expect("folder");
    let fixture = |name: &str| {
        std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures").join(name))
            .expect(name)
    };
    // friction is a constraint of the simulator, which by default leaves its solution where it hardly gets better: 5e-9 rad here
    let rubs = fixture("two_link.xml")
        .replace("integrator=\"Euler\"", "integrator=\"Euler\" tolerance=\"0\"")
        .replace("range=\"-2 2\"", "range=\"-2 2\" frictionloss=\"6\"")
        .replace("range=\"-2.2 2.2\"", "range=\"-2.2 2.2\" frictionloss=\"2\"");
    let task = folder.path().join("two_link.toml");
    std::fs::write(folder.path().join("two_link.xml"), rubs).expect("robot");
    std::fs::write(&task, fixture("two_link.toml")).expect("task");
    let file = task.to_str().expect("UTF-8");
    let mut snapshot = if guarded { random_forces(file, 5, 60.0) } else { random_policy(file, 5, 3.0) };
    let friction: Vec<f64> = snapshot.manifest.robot.joints().map(|j| j.friction).collect();
    assert_eq!(friction, [6.0, 2.0], "the robot of the task has the friction of its file");
    if !known {
        for joint in snapshot.manifest.robot.bodies.iter_mut().flat_map(|body| &mut body.joints) {
            (joint.friction, joint.friction_onset) = (0.0, None);
        }
    }
    let dt = snapshot.manifest.task.time.dt;
    let mut env = make_env(&snapshot).expect("environment");
    let mut controller = Controller::new(&snapshot).expect("controller");
    let (mut state, mut out, mut noise) = (controller.state(), controller.output(), controller.noise());
    let mut rng = stream(5, 1);
    env.reset(&mut stream(5, 0)).expect("reset");
    let (mut worst, mut fastest) = ([f64::NEG_INFINITY; 4], 0.0_f64);
    for tick in 0..20_000 {
        if guarded && tick % 25 == 0 {
            noise.action.fill_with(|| rng.random_range(-200.0..200.0));
        }
        env.observe(&mut state.obs);
        env.state(&mut state.q, &mut state.v);
        controller.update(&state, &noise, &mut out);
        env.step(&out.action);
        for (i, (limit, effort)) in [(1.98, 80.0), (2.18, 30.0)].into_iter().enumerate() {
            let (q, v) = (env.qpos()[i], env.qvel()[i]);
            let beyond = [
                (v - state.v[i]).abs() / dt - 30.0,
                v.abs() - 4.0,
                q.abs() - limit,
                out.action[i].abs() - effort,
            ];
            (0..4).for_each(|k| worst[k] = worst[k].max(beyond[k]));
            fastest = fastest.max(v.abs() / 4.0);
        }
    }
    (worst, fastest)
}

/// The task under a guard, with a network whose forces swing through all that the motors give.
fn random_forces(task: &str, seed: u64, gain: f32) -> Snapshot {
    let mut snapshot = training(task, "ppo", seed, 1, &["constraints.guard=true"]).snapshot().clone();
    let mut rng = stream(seed, 9);
    for layer in &mut snapshot.networks.policy.layers {
        let weights = layer.weight.iter_mut().chain(&mut layer.bias);
        weights.for_each(|w| *w = gain * (2.0 * rng.random::<f32>() - 1.0));
    }
    assert!(snapshot.manifest.guards());
    snapshot
}

#[test]
fn a_task_whose_robot_rubs_keeps_its_limits_in_the_simulator() {
    for guarded in [false, true] {
        let ([a, v, q, tau], fastest) = task_that_rubs(true, guarded);
        let beyond = format!("guarded: {guarded}; {a} rad/s², {v} rad/s, {q} rad, {tau} N m beyond");
        assert!(a < 1e-6 && v < 1e-9 && q < 1e-9 && tau <= 0.0, "{beyond}");
        assert!(fastest > 0.98, "guarded: {guarded}; the limits were not reached: {fastest}");
        let ([a, ..], _) = task_that_rubs(false, guarded);
        assert!(a > 1.0, "guarded: {guarded}; the test would see nothing: {a}");
    }
}

/// The table of `results/friction`, of the URDF file that `NEARL_ROBOT` names.
#[test]
#[ignore = "a table of minutes; results/friction/run.sh writes it"]
fn table() {
    let file = std::env::var("NEARL_ROBOT").expect("NEARL_ROBOT names a URDF file");
    let text = std::fs::read_to_string(&file).expect("robot");
    let ticks: usize = std::env::var("NEARL_TICKS").map_or(4000, |n| n.parse().expect("a number of ticks"));
    let text = without_solids(&text);
    println!(
        "| period | steps | friction of plant, model | ticks over | acceleration | velocity | position | torque |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    for (dt, sub_steps) in [0.001, 0.002, 0.01].into_iter().flat_map(|dt| [1, 5, 0].map(|n| (dt, n))) {
        for (rubs, known, coulomb) in [
            (false, false, false),
            (true, false, false),
            (true, true, false),
            (true, false, true),
            (true, true, true),
        ] {
            if coulomb && sub_steps != 0 {
                continue;
            }
            let of = |rubs: bool| if rubs { text.clone() } else { smooth(&text) };
            let mut arm = Arm::new(&of(rubs), dt, sub_steps, coulomb);
            let seen = attacked(&mut arm, &of(known), sub_steps, dt, ticks);
            let plant = if coulomb {
                "Coulomb's"
            } else if rubs {
                "MuJoCo's"
            } else {
                "none"
            };
            let model = if known { "modelled" } else { "none" };
            let [a, v, q, tau] = seen.worst;
            let share = 100.0 * seen.over as f64 / ticks as f64;
            println!(
                "| {} ms | {sub_steps} | {plant}, {model} | {share:.2} % | {a:.2} | {v:.1e} | {q:.1e} | {tau:.2} |",
                1000.0 * dt
            );
        }
    }
}

/// A URDF without what is drawn and touched, whose meshes may be elsewhere.
fn without_solids(text: &str) -> String {
    let mut text = text.to_string();
    for tag in ["visual", "collision"] {
        while let (Some(begin), Some(end)) = (text.find(&format!("<{tag}>")), text.find(&format!("</{tag}>")))
        {
            text.replace_range(begin..end + tag.len() + 3, "");
        }
    }
    text
}

#[test]
fn what_friction_may_do_is_said_by_joint_and_number() {
    let rail = r#"<robot name="rail"><link name="base"/><link name="cart"><inertial><mass value="2"/>
        <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
        <joint name="slide" type="prismatic"><parent link="base"/><child link="cart"/><axis xyz="1 0 0"/>
        <limit lower="-1" upper="1" effort="30" velocity="3"/><dynamics friction="3"/></joint></robot>"#;
    let model = Model::from_urdf_text(rail).expect("model");
    // 0.9 / 0.1 of 2 kg.
    assert!((model.friction_onset()[0].expect("onset").inertia - 18.0).abs() < 1e-9);
    let limits = |scale: f64| -> Vec<Box<dyn Limit>> {
        vec![
            Box::new(VelocityLimit::default()),
            Box::new(AccelerationLimit::uniform(10.0)),
            Box::new(TorqueLimit::scaled(scale)),
        ]
    };
    let projector = Projector::new(&model, &limits(1.0), &[0], Settings::new(0.001, 1)).expect("projector");
    // 3 N more than is thought or 3 N less: 6 N on 2 kg.
    let note = projector.notes().iter().find(|n| n.contains("friction")).expect("a note");
    assert!(note.contains("'slide' (3 N·m or N) by 3.000 of 10"), "{note}");
    assert_eq!(projector.limits().effort, [27.0]);
    let refusal = Projector::new(&model, &limits(0.1), &[0], Settings::new(0.001, 1)).err().expect("refused");
    assert!(
        refusal
            .to_string()
            .contains("'slide' may give 3 N·m or N, no more than the joint's dry friction of 3"),
        "{refusal}"
    );
}

/// An arm of one joint that rubs [N·m], with a motor of so much effort [N·m].
fn elbow(friction: &str, effort: u32) -> String {
    format!(
        r#"<robot name="r"><link name="base"/><link name="arm"><inertial><origin xyz="0 0 0.1"/><mass value="1"/>
        <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/></inertial></link><joint name="elbow" type="revolute"><parent link="base"/>
        <child link="arm"/><axis xyz="0 1 0"/><dynamics friction="{friction}"/><limit lower="-1" upper="1" effort="{effort}" velocity="3"/></joint></robot>"#
    )
}

/// The manifest of a task, before any training; `text` is written into `file`.
pub(super) fn manifest(file: &std::path::Path, text: &str) -> nearl_runtime::Manifest {
    std::fs::write(file, text).expect("task");
    let mut manifest = nearl_trainer::tasks::load(&file.display().to_string(), &[]).expect("a task");
    nearl_trainer::blank::complete(&mut manifest).expect("complete");
    manifest
}

/// Of a policy of actions, limits of the motion count on friction and brakes where the robot's model guards them. A guard of drives promises none, and the
/// simulator's asks neither.
#[test]
fn friction_and_brakes_are_told_where_a_limit_counts_on_them() {
    let folder = tempfile::tempdir().expect("folder");
    std::fs::write(folder.path().join("arm.urdf"), elbow("0.4", 2)).expect("robot");
    let text = "name = \"arm\"\n[model]\nurdf = \"arm.urdf\"\n[time]\ndt = 0.002\nsim_dt = 0.0\n[state]\nobservation = [\"q.elbow\", \"v.elbow\"]\n\
        [command]\ninterface = \"pd\"\nstiffness = 100.0\ndamping = 10.0\n[constraints]\nposition = {}\nvelocity = {}\nacceleration = { limit = 80.0 }\n\
        torque = {}\nbraking = \"certified\"\nguard = GUARD\n[idm]\nkind = \"pinocchio\"\n";
    let file = folder.path().join("arm.toml");
    for (guard, tells) in [("true", true), ("\"drive\"", false), ("\"simulator\"", false)] {
        let mut manifest = manifest(&file, &text.replace("GUARD", guard));
        // A policy of states is projected, whatever guards actions.
        let projected = nearl_runtime::doctor::advice(&manifest).expect("advice").join("; ");
        manifest.policy = nearl_runtime::PolicyKind::Direct;
        let advice = nearl_runtime::doctor::advice(&manifest).expect("advice").join("; ");
        let told = nearl_runtime::doctor::told(&manifest).expect("a task").join("; ");
        assert_eq!(told.contains("friction"), tells, "{guard}: {told}");
        for what in ["friction", "might need"] {
            assert!(projected.contains(what), "{guard}, {what}: {projected}");
            assert_eq!(advice.contains(what), tells, "{guard}, {what}: {advice}");
        }
    }
}

/// Doctor, import and blank say what friction is taken to be, unless the drives make up for their own.
#[test]
fn a_task_says_which_of_its_joints_rub() {
    let folder = tempfile::tempdir().expect("folder");
    let told = |interface: &str, friction: &str, actions: bool| {
        std::fs::write(folder.path().join("arm.urdf"), elbow(friction, 20)).expect("robot");
        let text = format!(
            "name = \"arm\"\n[model]\nurdf = \"arm.urdf\"\n[time]\ndt = 0.002\nsim_dt = 0.0\n[state]\nobservation = [\"q.elbow\", \"v.elbow\"]\n\
             [command]\n{interface}\n[constraints]\nposition = {{}}\nvelocity = {{}}\nacceleration = {{ limit = 8.0 }}\ntorque = {{}}\n[idm]\n\
             kind = \"pinocchio\"\n"
        );
        let file = folder.path().join("arm.toml");
        std::fs::write(&file, text).expect("task");
        let snapshot =
            nearl_trainer::blank::snapshot(&file.display().to_string(), actions).expect("a snapshot");
        nearl_runtime::doctor::told(&snapshot.manifest).expect("a task").join("; ")
    };
    for interface in ["interface = \"effort\"", "interface = \"pd\"\nstiffness = 100.0\ndamping = 10.0"] {
        for actions in [false, true] {
            let notes = told(interface, "0.4", actions);
            assert!(
                notes.contains("made up for as MuJoCo") && notes.contains("'elbow' (0.4"),
                "{interface}: {notes}"
            );
            assert!(!told(interface, "0", actions).contains("friction"), "{interface}");
        }
    }
    assert!(
        !told("interface = \"position\"", "0.4", true).contains("friction"),
        "the drive makes up for its own"
    );
}
