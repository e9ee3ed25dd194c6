//! A Panda with random weights against forward dynamics, shared by the tests of the real controller.
#![allow(dead_code, unreachable_pub)] // each test binary uses a part of it

use std::path::{Path, PathBuf};
use std::thread::JoinHandle;
use std::time::Duration;

use nearl_constraints::{Dynamics, Model};
use nearl_runtime::link::*;
use nearl_runtime::net::{Activation, Dense, DenseLayer};
use nearl_runtime::normaliser::Normaliser;
use nearl_runtime::rt::*;
use nearl_runtime::snapshot::FORMAT;
use nearl_runtime::{Manifest, Networks, PolicyKind, Snapshot, Task};

use crate::toy::{self, Name, of_its_own};

pub const PATIENCE: Duration = Duration::from_secs(10);
pub const URDF: &str = include_str!("../../../examples/robots/panda/panda.urdf");
pub const TASK: &str = include_str!("../../../examples/tasks/Panda-reach.toml");
pub const N: usize = 7;

pub fn joint(i: usize) -> String {
    format!("panda_joint{}", i + 1)
}

/// Small linear congruential generator: weights in [-1, 1].
pub fn weights(seed: u64, n: usize) -> Vec<f32> {
    let mut x = seed;
    let mut next = || {
        x = x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (x >> 40) as f32 / (1 << 23) as f32 - 1.0
    };
    (0..n).map(|_| next()).collect()
}

pub fn snapshot(version: u64, change: impl FnOnce(&mut Manifest)) -> Snapshot {
    let mut task = Task::parse("Panda-reach.toml", TASK, &[]).unwrap();
    let entries = |kind: &'static str| (0..N).map(move |i| format!("{kind}.{}", joint(i)));
    task.state.observation = entries("q").chain(entries("v")).collect();
    let model = Model::from_urdf_text(URDF).unwrap();
    let effort = model.effort_limit().to_vec();
    let mut manifest = Manifest {
        format: FORMAT,
        task,
        robot: model.description().clone(),
        simulation: None,
        algo: "random".into(),
        policy: PolicyKind::Deterministic,
        activation: Activation::default(),
        functions: Vec::new(),
        version,
        steps: 0,
        action_lower: effort.iter().map(|e| -e).collect(),
        action_upper: effort,
        moved: None,
    };
    change(&mut manifest);
    let n = 2 * N;
    let layer = |seed, n_in, n_out| DenseLayer {
        n_in,
        n_out,
        weight: weights(seed, n_in * n_out),
        bias: weights(seed + 1, n_out),
    };
    let policy = Dense { layers: vec![layer(version, n, 16), layer(version + 7, 16, n)], skip: None };
    let normaliser = Normaliser::new(vec![0.0; n], vec![1.0; n], vec![0.5; n]);
    Snapshot {
        manifest,
        networks: Networks { normaliser, policy, policy_log_std: vec![], idm: None, margins: Vec::new() },
    }
}

/// Forward dynamics and one semi-implicit Euler step: `v' = v + T a`, `q' = q + T v'`.
pub struct Panda {
    pub dynamics: Dynamics,
    pub lower: Vec<f64>,
    pub upper: Vec<f64>,
    pub velocity: Vec<f64>,
    pub effort: Vec<f64>,
    pub q: Vec<f64>,
    pub v: Vec<f64>,
    pub worst: [f64; 3],
    pub speeds: Vec<f64>,
    pub braked: u64,
    /// The robot's own drives take it to the position it is sent.
    pub follows_positions: bool,
    /// Its largest acceleration then [rad/s²].
    pub accelerated: f64,
    /// Time it takes to measure: lockstep is faster than a trainer can push.
    pub pause: Duration,
    /// Physics steps in a period (0: constant acceleration), and the largest share by which a period is longer or shorter than told.
    pub moves: (u32, f64),
    pub periods: u64,
}

impl Panda {
    pub fn new() -> Panda {
        let model = Model::from_urdf_text(URDF).unwrap();
        Panda {
            lower: model.lower_position_limit().to_vec(),
            upper: model.upper_position_limit().to_vec(),
            velocity: model.velocity_limit().to_vec(),
            effort: model.effort_limit().to_vec(),
            dynamics: Dynamics::new(&model),
            q: vec![0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8],
            v: vec![0.0; N],
            worst: [f64::NEG_INFINITY; 3],
            speeds: Vec::new(),
            braked: 0,
            follows_positions: false,
            accelerated: 0.0,
            pause: Duration::ZERO,
            moves: (1, 0.0),
            periods: 0,
        }
    }
}

impl Plant for Panda {
    fn observe(&mut self, state: &mut StateMessage) {
        std::thread::sleep(self.pause);
        (state.nq, state.nv, state.nu, state.n_obs) = (7, 7, 7, 14);
        state.q_mut().copy_from_slice(&self.q);
        state.v_mut().copy_from_slice(&self.v);
        state.obs_mut()[..N].copy_from_slice(&self.q);
        state.obs_mut()[N..].copy_from_slice(&self.v);
    }

    fn apply(&mut self, action: &ActionMessage) {
        let (mut passive, mut a) = (vec![0.0; N], vec![0.0; N]);
        if self.follows_positions {
            for (i, sent) in action.action().iter().enumerate() {
                let v = (sent - self.q[i]) / toy::DT;
                (self.accelerated, self.v[i], self.q[i]) =
                    (self.accelerated.max((v - self.v[i]).abs() / toy::DT), v, *sent);
                let position = (self.q[i] - self.upper[i]).max(self.lower[i] - self.q[i]);
                self.worst[0] = self.worst[0].max(position);
                self.worst[1] = self.worst[1].max(v.abs() - self.velocity[i]);
            }
            self.speeds.push(self.v.iter().fold(0.0, |m, v| f64::max(m, v.abs())));
            return;
        }
        let (steps, jitter) = self.moves;
        self.periods += 1;
        let period = toy::DT * (1.0 + jitter * f64::from(weights(self.periods, 1)[0]));
        for _ in 0..steps.max(1) {
            self.dynamics.passive(&self.q, &self.v, &mut passive);
            let tau: Vec<f64> = action.action().iter().zip(&passive).map(|(t, p)| t + p).collect();
            self.dynamics.aba(&self.q, &self.v, &tau, &mut a);
            for i in 0..N {
                let h = period / f64::from(steps.max(1));
                if steps == 0 {
                    self.q[i] += h * self.v[i] + 0.5 * h * h * a[i];
                    self.v[i] += h * a[i];
                } else {
                    self.v[i] += h * a[i];
                    self.q[i] += h * self.v[i];
                }
            }
        }
        for i in 0..N {
            let excess = [
                (self.q[i] - self.upper[i]).max(self.lower[i] - self.q[i]),
                self.v[i].abs() - self.velocity[i],
                action.action()[i].abs() - self.effort[i],
            ];
            for k in 0..3 {
                self.worst[k] = self.worst[k].max(excess[k]);
            }
        }
        self.speeds.push(self.v.iter().fold(0.0, |m, v| f64::max(m, v.abs())));
    }

    fn brake(&mut self) {
        self.braked += 1;
        self.v.fill(0.0);
    }
}

/// The same with a Gaussian policy of nearly no spread: noise is what can spoil its proposal.
pub fn stochastic(version: u64) -> Snapshot {
    let mut snapshot = snapshot(version, |m| m.policy = PolicyKind::Stochastic);
    snapshot.networks.policy_log_std = vec![-10.0; 2 * N];
    snapshot
}

/// A plant on a thread of its own.
pub struct ArmThread {
    pub stop: Stop,
    thread: JoinHandle<(FaultyPlant<Panda>, PlantReport)>,
}

impl ArmThread {
    pub fn end(self) -> (Panda, PlantReport) {
        self.stop.request();
        let (faulty, report) = self.thread.join().unwrap();
        (faulty.plant, report)
    }
}

pub fn start(name: &Name, snapshot: &Snapshot) -> ArmThread {
    start_with(name, snapshot, FaultPlan::default(), Duration::ZERO)
}

pub fn start_with(name: &Name, snapshot: &Snapshot, plan: FaultPlan, pause: Duration) -> ArmThread {
    start_faulty(name, snapshot, plan, Panda { pause, ..Panda::new() })
}

pub fn start_panda(name: &Name, snapshot: &Snapshot, panda: Panda) -> ArmThread {
    start_faulty(name, snapshot, FaultPlan::default(), panda)
}

fn start_faulty(name: &Name, snapshot: &Snapshot, plan: FaultPlan, panda: Panda) -> ArmThread {
    let link = PlantLink::open(&name.0, &describe(&snapshot.manifest, true).unwrap()).unwrap();
    let stop = Stop::new();
    let thread = std::thread::spawn({
        let stop = stop.clone();
        move || {
            let mut plant = FaultyPlant::new(panda, plan);
            let runner = PlantRunner::new(link, PlantSettings::lockstep(toy::DT)).unwrap();
            let report = runner.run(&mut plant, &stop);
            (plant, report)
        }
    });
    ArmThread { stop, thread }
}

pub struct File(pub PathBuf);

impl File {
    pub fn new(test: &str, snapshot: &Snapshot) -> File {
        let path = std::env::temp_dir().join(format!("nearl-{}.safetensors", of_its_own(test)));
        snapshot.save(&path).unwrap();
        File(path)
    }
}

impl Drop for File {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

pub type Running = JoinHandle<Result<RunReport, RunError>>;

pub fn execute(name: &Name, file: &Path, stop: &Stop) -> Running {
    execute_with(name, file, stop, toy::settings())
}

pub fn execute_with(name: &Name, file: &Path, stop: &Stop, settings: RunSettings) -> Running {
    let (name, file, stop) = (name.0.clone(), file.to_owned(), stop.clone());
    std::thread::spawn(move || run(&settings, &file, &name, &stop))
}

/// A folder that is removed at the end.
pub struct Scratch(pub PathBuf);

impl Scratch {
    pub fn new(test: &str) -> Scratch {
        let folder = std::env::temp_dir().join(format!("nearl-test-{}", of_its_own(test)));
        std::fs::create_dir_all(&folder).unwrap();
        Scratch(folder)
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}
