//! Robots on legs: whatever targets their drives are given, forces and their change stay within what the motors allow, also where one policy
//! takes over from another. Balance is not promised; falls are counted.

use nearl_constraints::{Period, Status};
use nearl_runtime::command::CommandSection;
use nearl_runtime::controller::force_left;
use nearl_runtime::link::{ActionMessage, Message, Plant, StateMessage};
use nearl_runtime::net::{Dense, DenseLayer};
use nearl_runtime::normaliser::Normaliser;
use nearl_runtime::{Controller, Networks, PolicyKind, Snapshot, Task};
use nearl_tests::training;
use nearl_trainer::plant::MujocoPlant;
use nearl_trainer::rollout::stream;
use nearl_trainer::{mj, robot};
use rand::RngExt;

const XML: &str = include_str!("../../fixtures/quadruped.xml");
/// Stiffness [N m/rad], damping [N m s/rad] and torque rate [N m/s].
const GAINS: [f64; 3] = [40.0, 1.0, 4000.0];
const DT: f64 = 0.001;
/// By how much a joint may accelerate [rad/s²]; these light legs rarely do by more.
const ACCELERATION: f64 = 3000.0;
/// Ticks from one policy to the next.
const SWITCH: usize = 250;
const LEGS: [&str; 4] = ["FR", "FL", "RR", "RL"];
const JOINTS: [&str; 3] = ["hip", "thigh", "calf"];
const EFFORT: [f64; 3] = [23.7, 23.7, 35.55];
/// Standing.
const POSE: [f64; 3] = [0.0, 0.9, -1.8];

/// How targets reach the drives.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Way {
    /// As they are.
    Raw,
    /// The force is cut at the effort, as a drive does by itself.
    Cut,
    Guarded,
}

fn task(guard: &str) -> Task {
    let entries = |kind: &str| {
        let names = LEGS.iter().flat_map(|leg| JOINTS.map(|joint| format!("\"{kind}.{leg}_{joint}\"")));
        names.collect::<Vec<_>>().join(", ")
    };
    let [k, d, rate] = GAINS;
    let text = format!(
        "name = \"quadruped\"\n[model]\nmjcf = \"quadruped.xml\"\n[time]\ndt = {DT}\nsim_dt = 0.0005\npolicy_every = 20\n\
         [state]\nobservation = [{}, {}]\n[command]\ninterface = \"pd\"\nstiffness = {k:?}\ndamping = {d:?}\n\
         [constraints]\nguard = {guard}\ntorque = {{}}\nacceleration = {{ limit = {ACCELERATION:?} }}\ntorque_rate = {{ limit = {rate:?} }}\n\
         [idm]\nkind = \"pinocchio\"\n",
        entries("q"),
        entries("v")
    );
    Task::parse("quadruped.toml", &text, &[]).expect("task")
}

/// A policy of random targets around the standing pose, up to about a radian from it.
fn policy(seed: u64, guard: &str) -> Snapshot {
    let mut snapshot = training("Panda-reach", "ppo", 1, 1, &[]).snapshot().clone();
    let m = &mut snapshot.manifest;
    (m.task, m.robot) = (task(guard), robot::read_mjcf_text(XML).expect("robot"));
    (m.action_lower, m.action_upper) = (vec![-10.0; 12], vec![10.0; 12]);
    assert_eq!(m.policy, PolicyKind::Direct);
    let mut rng = stream(seed, 3);
    let mut layer = |n_in: usize, n_out: usize, gain: f32| DenseLayer {
        n_in,
        n_out,
        weight: (0..n_in * n_out).map(|_| gain * (2.0 * rng.random::<f32>() - 1.0)).collect(),
        bias: (0..n_out).map(|_| gain * (2.0 * rng.random::<f32>() - 1.0)).collect(),
    };
    let mut net = Dense { layers: vec![layer(24, 32, 0.5), layer(32, 12, 0.3)], skip: None };
    for (i, bias) in net.layers[1].bias.iter_mut().enumerate() {
        *bias += POSE[i % 3] as f32;
    }
    let normaliser = Normaliser::identity(24, 24);
    snapshot.networks =
        Networks { normaliser, policy: net, policy_log_std: vec![0.0; 12], idm: None, margins: Vec::new() };
    snapshot
}

#[derive(Debug)]
struct Peaks {
    /// Largest force at any physics step, as a share of the effort, of joints that have accelerated by no more than [`ACCELERATION`] since the tick began.
    force: f64,
    /// Of the others: in how many steps of a joint, and the largest force.
    sudden: u64,
    sudden_force: f64,
    /// Largest change of a force from tick to tick [N m/s], away from switches and at them.
    rate: [f64; 2],
    /// Ticks whose targets were moved.
    moved: u64,
    falls: u64,
}

fn run(way: Way, ticks: usize) -> Peaks {
    let guard = if way == Way::Guarded { "\"drive\"" } else { "false" };
    let policies: Vec<Snapshot> = (0..6).map(|seed| policy(seed, guard)).collect();
    let model = mj::Model::from_text(XML, mj::ModelFormat::Mjcf, mj::Options::default()).expect("plant");
    let mut sim = mj::Sim::new(&model).expect("simulation");
    let mut controller = Controller::new(&policies[0]).expect("controller");
    let (mut state, mut out, noise) = (controller.state(), controller.output(), controller.noise());
    let mut peaks = Peaks { force: 0.0, sudden: 0, sudden_force: 0.0, rate: [0.0; 2], moved: 0, falls: 0 };
    let mut before: Option<Vec<f64>> = None;
    for tick in 0..ticks {
        if tick % (4 * SWITCH) == 0 || sim.qpos()[2] < 0.12 {
            peaks.falls += u64::from(tick % (4 * SWITCH) != 0);
            let mut q = vec![0.0, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0];
            q.extend(LEGS.iter().flat_map(|_| POSE));
            sim.set_state(&q, &[0.0; 18]).expect("state");
            controller.reset();
            before = None;
        }
        let switched = tick % SWITCH == 0 && before.is_some();
        if switched {
            let memory = controller.memory();
            controller = Controller::new(&policies[tick / SWITCH % 6]).expect("controller");
            controller.take_memory(&memory);
        }
        state.q.copy_from_slice(sim.qpos());
        state.q[3..7].rotate_left(1);
        state.v.copy_from_slice(sim.qvel());
        state.obs[..12].copy_from_slice(&sim.qpos()[7..]);
        state.obs[12..].copy_from_slice(&sim.qvel()[6..]);
        controller.update(&state, &noise, &mut out);
        peaks.moved += u64::from(out.next.ledger.moved > 0.0);
        let force = |sim: &mj::Sim, i: usize| {
            let pull = GAINS[0] * (out.action[i] - sim.qpos()[7 + i]) - GAINS[1] * sim.qvel()[6 + i];
            if way == Way::Cut { pull.clamp(-EFFORT[i % 3], EFFORT[i % 3]) } else { pull }
        };
        let start: Vec<f64> = (0..12).map(|i| force(&sim, i)).collect();
        if let Some(before) = &before {
            let rate = start.iter().zip(before).map(|(a, b)| (a - b).abs() / DT).fold(0.0, f64::max);
            peaks.rate[usize::from(switched)] = peaks.rate[usize::from(switched)].max(rate);
        }
        before = Some(start);
        let begun = sim.qvel().to_vec();
        for step in 0..2 {
            for i in 0..12 {
                let pull = force(&sim, i);
                let change = (sim.qvel()[6 + i] - begun[6 + i]).abs();
                if change > ACCELERATION * 0.5 * DT * f64::from(step) + 1e-9 {
                    peaks.sudden += 1;
                    peaks.sudden_force = peaks.sudden_force.max(pull.abs() / EFFORT[i % 3]);
                } else {
                    peaks.force = peaks.force.max(pull.abs() / EFFORT[i % 3]);
                }
                sim.force_mut()[6 + i] = pull;
            }
            sim.step(1).expect("a step");
        }
    }
    peaks
}

#[test]
fn forces_and_their_change_stay_within_the_motors_also_where_policies_switch() {
    let [raw, cut, guarded] = [Way::Raw, Way::Cut, Way::Guarded].map(|way| run(way, 20_000));
    for (name, p) in [("raw", &raw), ("cut", &cut), ("guarded", &guarded)] {
        println!(
            "{name}: peak force {:.3} of the effort, rate {:.0} N m/s and {:.0} at a switch, {} falls, {} ticks moved, {} sudden",
            p.force, p.rate[0], p.rate[1], p.falls, p.moved, p.sudden
        );
    }
    assert!(raw.force > 1.2 && cut.rate[1] > 2.0 * GAINS[2], "the attack must be one");
    assert!(guarded.force <= 1.0 + 1e-9, "{}", guarded.force);
    assert!(guarded.sudden_force < 1.1, "{}", guarded.sudden_force);
    assert!(guarded.sudden < 4800, "{} of 480,000 steps of a joint are too sudden to judge", guarded.sudden);
    assert!(guarded.rate.iter().all(|rate| *rate <= GAINS[2] * (1.0 + 1e-9)), "{:?}", guarded.rate);
    assert!(guarded.moved > 100);
}

#[test]
fn a_joint_without_a_drive_and_a_robot_without_efforts_are_refused_in_a_sentence() {
    let refuse = |change: &dyn Fn(&mut Task)| {
        let mut snapshot = policy(1, "\"drive\"");
        change(&mut snapshot.manifest.task);
        Controller::new(&snapshot).map(|_| ()).expect_err("refused").to_string()
    };
    let text =
        refuse(&|task| task.command = section(r#"{"interface": {"FR_hip": "pd"}, "stiffness": 40.0}"#));
    assert!(text.contains("'FR_thigh'") && text.contains("commanded effort"), "{text}");
    let text = refuse(&|task| task.command = section(r#"{"interface": "pd"}"#));
    assert!(text.contains("no stiffness"), "{text}");
    let text = refuse(&|task| task.command = section(r#"{"interface": {"knee": "pd"}, "stiffness": 1.0}"#));
    assert!(text.contains("'knee' is no controllable joint"), "{text}");
    let text = refuse(&|task| task.constraints.torque = None);
    assert!(text.contains("torque = { scale = 1.0 }"), "{text}");
}

fn section(text: &str) -> CommandSection {
    serde_json::from_str(text).expect("a section")
}

/// What was allowed comes through bit for bit.
#[test]
fn targets_within_the_intervals_are_not_touched() {
    let (snapshot, mut rng) = (policy(2, "\"drive\""), stream(2, 4));
    let mut controller = Controller::new(&snapshot).expect("controller");
    let (mut state, mut out, noise) = (controller.state(), controller.output(), controller.noise());
    let mut same = 0;
    for _ in 0..500 {
        for (i, q) in state.q[7..].iter_mut().enumerate() {
            *q = POSE[i % 3] + rng.random_range(-0.3..0.3);
        }
        state.obs[..12].copy_from_slice(&state.q[7..]);
        controller.reset();
        controller.update(&state, &noise, &mut out);
        let mut broken = 0;
        for i in 0..12 {
            let asked = f64::from(out.sampled[i]);
            broken += u32::from(out.action[i] != asked);
            let force = GAINS[0] * (asked - state.q[7 + i]);
            // What the acceleration may add within the tick is kept free.
            let room = EFFORT[i % 3] - (GAINS[1] + 0.75 * GAINS[0] * DT) * ACCELERATION * DT; // two physics steps
            let allowed = force.abs() <= room;
            assert_eq!(allowed, out.action[i].to_bits() == asked.to_bits(), "{force} N m");
            same += usize::from(allowed);
        }
        let ledger = &out.next.ledger;
        assert_eq!((ledger.raw_violations.total(), ledger.target_violations.total()), (broken, 0));
        assert_eq!(ledger.status == Status::Clamped, broken > 0);
    }
    assert!(same > 1000, "{same}");
}

/// Physics steps by hand: a joint that accelerates as hard as it may ends with all of its effort, and no more.
#[test]
fn a_force_is_at_most_the_effort_at_the_end_of_a_tick_of_any_steps() {
    let ([k, d, _], acceleration, effort) = (GAINS, 300.0, EFFORT[0]);
    for steps in [1, 2, 5, 20_000] {
        let tau = 0.005 / f64::from(steps);
        let room = force_left(&Period::new(0.005, steps), (k, d), effort, acceleration);
        let (mut q, mut v) = (0.3, -2.0);
        let target = q + 0.005 * v + (d * v - room) / k; // the least that the end allows
        for _ in 0..steps {
            v += tau * acceleration;
            q += tau * v;
        }
        let end = k * (target - q) - d * v;
        assert!((end + effort).abs() < 1e-9, "{steps} steps: {end} N m");
    }
}

const ARM: &str = r#"<mujoco model="arm"><option timestep="0.002"/><compiler angle="radian" autolimits="true"/><worldbody>
<body><joint name="j1" axis="0 1 0" range="-2 2" damping="1" armature="0.1"/><geom type="capsule" size="0.03" fromto="0 0 0 0 0 0.3"/></body>
</worldbody><actuator><position name="a1" joint="j1" kp="200" kv="20" ctrlrange="-2.5 2.5" forcerange="-60 60"/></actuator></mujoco>"#;

/// Nothing knows how to brake drives of a policy that gives actions: the plant had sent every joint to 0 instead.
#[test]
fn a_plant_that_nothing_leads_has_its_drives_stay_where_they_were_sent() {
    let folder = tempfile::tempdir().expect("folder");
    std::fs::write(folder.path().join("arm.xml"), ARM).expect("robot");
    let task = "name = \"arm\"\n[model]\nmjcf = \"arm.xml\"\n[time]\ndt = 0.002\nsim_dt = 0.002\n[state]\ncontrollable = [\"j1\"]\n\
                observation = [\"q.j1\", \"v.j1\"]\n[command]\ninterface = \"pd\"\nstiffness = 200.0\ndamping = 20.0\n\
                [constraints]\nguard = \"drive\"\ntorque = { scale = 0.5 }\n[reset]\nq = { j1 = 1.0 }\n[reward]\nstill = 1.0\n[idm]\nkind = \"pinocchio\"\n\
                [train]\nn_envs = 2\nn_steps = 16\n[train.ppo]\nbatch_size = 32\n";
    let file = folder.path().join("arm.toml");
    std::fs::write(&file, task).expect("task");
    let snapshot = training(file.to_str().expect("UTF-8"), "ppo", 1, 1, &[]).snapshot().clone();
    let mut plant = MujocoPlant::new(&snapshot.manifest, 0, false).expect("a plant");
    let (mut state, mut action) = (StateMessage::zeroed(), ActionMessage::zeroed());
    let mut stays = |plant: &mut MujocoPlant, at: f64| {
        (0..500).for_each(|_| plant.brake());
        plant.observe(&mut state);
        assert!((state.q[0] - at).abs() < 0.05, "{} where it was to stay at {at}", state.q[0]);
    };
    stays(&mut plant, 1.0);
    (action.nu, action.action[0]) = (1, 1.1);
    (0..200).for_each(|_| plant.apply(&action));
    stays(&mut plant, 1.1);
    action.action[0] = -1.0;
    plant.apply(&action);
    let before = plant.meter().effort().expect("forces").states;
    (0..500).for_each(|_| plant.brake());
    assert_eq!(
        plant.meter().effort().expect("forces").states,
        before,
        "no brake asks for more than the limit"
    );
}

/// A policy that proposes states is projected, and the drives of its learned inverse model are bounded besides: the ledger of the tick says what
/// the projection did, and more was moved where drives were bounded.
#[test]
fn the_report_of_the_drives_does_not_hide_that_of_the_projection() {
    let set = ["idm.kind=\"learned\"", "time.policy_every=1", "constraints.braking=\"certified\""];
    let mut snapshot = training("Panda-reach", "pid2-ib", 1, 1, &set).snapshot().clone();
    for layer in &mut snapshot.networks.policy.layers {
        layer.weight.iter_mut().for_each(|w| *w *= 20.0);
    }
    let m = &mut snapshot.manifest;
    assert_eq!(m.policy, PolicyKind::Stochastic);
    m.task.command = section(r#"{"interface": "pd", "stiffness": 600.0, "damping": 40.0}"#);
    let free = Controller::new(&snapshot);
    snapshot.manifest.task.constraints.guard = serde_json::from_str("\"drive\"").expect("a guard");
    let mut pair = [free, Controller::new(&snapshot)].map(|controller| controller.expect("controller"));
    let (mut outs, noise) = (pair.each_ref().map(Controller::output), pair[0].noise());
    let (mut state, mut rng, mut projected, mut bounded) = (pair[0].state(), stream(1, 4), 0, 0);
    for _ in 0..200 {
        for (i, q) in [0.0, -0.8, 0.0, -2.3, 0.0, 1.6, 0.8].iter().enumerate() {
            state.q[i] = q + rng.random_range(-0.2..0.2);
        }
        state.obs[..7].copy_from_slice(&state.q);
        for (controller, out) in pair.iter_mut().zip(&mut outs) {
            controller.reset();
            controller.update(&state, &noise, out);
        }
        let [free, guarded] = outs.each_ref().map(|out| &out.next.ledger);
        assert_eq!(guarded.status, free.status);
        assert_eq!(guarded.active, free.active);
        assert!(guarded.moved >= free.moved && guarded.raw_violations.total() >= free.raw_violations.total());
        projected += u32::from(free.status != Status::Unchanged);
        bounded += u32::from(outs[0].action != outs[1].action);
    }
    assert!(projected > 100 && bounded > 100, "projected {projected}, bounded {bounded}");
}
