//! A robot whose policy is noise, on a plant that is the model itself, recorded by a real loop.
#![allow(dead_code, unreachable_pub)] // each program uses a part of it

use std::path::{Path, PathBuf};
use std::time::Duration;

use nearl_constraints::drive::Held;
use nearl_constraints::{Drive, Model, Moved, PeriodDynamics};
use nearl_runtime::link::*;
use nearl_runtime::log::{LogQueue, LogSummary, facts};
use nearl_runtime::net::{Activation, Dense, DenseLayer};
use nearl_runtime::normaliser::Normaliser;
use nearl_runtime::rt::*;
use nearl_runtime::snapshot::FORMAT;
use nearl_runtime::{Manifest, Networks, PolicyKind, Snapshot, Task};

/// What is attacked, and for how long.
#[derive(Clone)]
pub struct Attack {
    /// Robot (URDF).
    pub urdf: String,
    /// Where it starts (nq).
    pub start: Vec<f64>,
    /// `[constraints]`, as TOML without its heading.
    pub constraints: String,
    /// Control period [s].
    pub dt: f64,
    /// Physics steps in it; 0 for constant acceleration.
    pub sub_steps: u32,
    /// Euler steps in which the plant really moves; 0 is as the period says, which is one or constant acceleration.
    pub plant_steps: u32,
    pub policy_every: usize,
    pub seed: u64,
    pub ticks: u64,
    /// From which tick on limits are moved, and where to; of [`Attack::fly`].
    pub moves: Vec<(u64, Moved)>,
    /// Time that the plant takes to measure: a lockstep loop is faster than its log.
    pub pause: Duration,
    /// One of so many states is lost, and the driver holds; 0 is none. Of [`Attack::fly`], with joints that are sent positions or forces.
    pub lost: u64,
    /// One of so many answers comes too late: the driver holds, and says so in its next state; 0 is none. As for `lost`.
    pub late: u64,
    /// How far behind itself the robot is measured \[s\].
    pub lag: f64,
    /// What physics steps take implicitly of the damping of every drive [N·m·s/rad].
    pub drive_damping: f64,
}

fn weights(seed: u64, n: usize) -> Vec<f32> {
    let mut x = seed;
    let mut next = || {
        x = x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (x >> 40) as f32 / (1 << 23) as f32 - 1.0
    };
    (0..n).map(|_| next()).collect()
}

impl Attack {
    pub fn model(&self) -> Model {
        let mut robot = Model::from_urdf_text(&self.urdf).unwrap().description().clone();
        let joints = robot.bodies.iter_mut().flat_map(|body| &mut body.joints);
        joints.for_each(|joint| joint.drive_damping = self.drive_damping);
        Model::from_description(robot).unwrap()
    }

    /// A snapshot of random weights and a wide spread, `version` of them.
    pub fn snapshot(&self, version: u64) -> Snapshot {
        let model = self.model();
        let names =
            |letter: &'static str| model.joints().iter().map(move |j| format!("\"{letter}.{}\"", j.name));
        let state = names("q").chain(names("v")).collect::<Vec<_>>().join(", ");
        let sim_dt = if self.sub_steps == 0 { 0.0 } else { self.dt / f64::from(self.sub_steps) };
        let text = format!(
            "name = \"attack\"\n[model]\nurdf = \"robot.urdf\"\n[time]\ndt = {:?}\nsim_dt = {sim_dt:?}\npolicy_every = {}\n[state]\nobservation = [{state}]\n\
             [idm]\nkind = \"pinocchio\"\n[constraints]\n{}\n",
            self.dt, self.policy_every, self.constraints
        );
        let task = Task::parse("attack.toml", &text, &[]).unwrap();
        let effort = model.effort_limit().to_vec();
        let manifest = Manifest {
            format: FORMAT,
            task,
            robot: model.description().clone(),
            simulation: None,
            algo: "random".into(),
            policy: PolicyKind::Stochastic,
            activation: Activation::default(),
            functions: Vec::new(),
            version,
            steps: 0,
            action_lower: effort.iter().map(|e| -e).collect(),
            action_upper: effort,
            moved: None,
        };
        let n = 2 * model.nv();
        let seed = self.seed.wrapping_mul(1000).wrapping_add(version);
        let layer = |seed, n_in, n_out| DenseLayer {
            n_in,
            n_out,
            weight: weights(seed, n_in * n_out),
            bias: weights(seed + 1, n_out),
        };
        let policy = Dense { layers: vec![layer(seed, n, 16), layer(seed + 7, 16, n)], skip: None };
        let normaliser = Normaliser::new(vec![0.0; n], vec![1.0; n], vec![0.5; n]);
        Snapshot {
            manifest,
            networks: Networks {
                normaliser,
                policy,
                policy_log_std: vec![0.0; n],
                idm: None,
                margins: Vec::new(),
            },
        }
    }

    /// Records a flight into `folder` and returns its log.
    pub fn record(&self, name: &RobotName, folder: &Path) -> (PathBuf, RunReport) {
        let first = self.snapshot(1);
        let file = folder.join("attack.safetensors");
        first.save(&file).unwrap();
        let log = folder.join("attack.mcap");
        let link = PlantLink::open(name, &describe(&first.manifest, true).unwrap()).unwrap();
        let stop = Stop::new();
        let plant = std::thread::spawn({
            let (stop, mut twin, dt) = (stop.clone(), Twin::new(self), self.dt);
            move || PlantRunner::new(link, PlantSettings::lockstep(dt)).unwrap().run(&mut twin, &stop)
        });
        let settings = RunSettings {
            log: Some(log.clone()),
            ticks: Some(self.ticks),
            explore: Some(self.seed),
            thread: ThreadSettings { priority: None, cpu: None, lock_memory: false },
            ..RunSettings::default()
        };
        let report = run(&settings, &file, name, &Stop::new()).unwrap();
        stop.request();
        plant.join().unwrap();
        (log, report)
    }
}

impl Attack {
    /// Records a flight into `folder` without threads and links, as fast as its log is written.
    pub fn fly(&self, folder: &Path) -> (PathBuf, LogSummary) {
        self.fly_with(&self.snapshot(1), folder)
    }

    /// The same with a snapshot of this robot.
    pub fn fly_with(&self, first: &Snapshot, folder: &Path) -> (PathBuf, LogSummary) {
        let robot = describe(&first.manifest, true).unwrap();
        let robot = robot.message(&RobotName::new("flight").unwrap()).unwrap();
        let controller = Pilot::new(first, &robot).unwrap();
        let period = (self.dt * 1e9).round() as u64;
        let settings = CoreSettings {
            period,
            sync: Sync::Plant,
            age_limit: 20 * period,
            real_time: false,
            stop_speed: 1e-2,
            jump: 0.0,
            ramp: 50,
            modes: ModeLimits::default(),
            explore: Some(self.seed),
            proposer: None,
        };
        let mut facts = facts(&robot, &settings, &FaultPlan::default());
        facts.insert("limits".into(), Pinned::of(&first.manifest, "the snapshot").unwrap().to_json());
        facts.insert("rows".into(), serde_json::json!(controller.row_names()).to_string());
        let path = folder.join("attack.mcap");
        let mut log = LogQueue::create(&path, &facts, 0).unwrap();
        log.push_snapshot(0, 1, first.to_bytes(), controller.row_names());
        let mut core = Core::new(settings, Box::new(Loaded { id: 0, controller }), 0, FaultPlan::default());
        let mut twin = Twin::new(self);
        let mut late = 0;
        for tick in 1..=self.ticks {
            if self.lost > 0 && tick % self.lost == 0 {
                late += 1;
                twin.hold(first);
                continue;
            }
            let mut state = StateMessage::zeroed();
            twin.measure(&mut state);
            for i in 0..twin.v.len() {
                let behind = twin.q[i] - self.lag * twin.v[i];
                state.q_mut()[i] = behind;
                state.obs_mut()[i] = behind;
            }
            (state.header.epoch, state.header.seq, state.header.stamp) = (1, tick, tick * period);
            (state.tick, state.late) = (tick, late);
            let moved = self.moves.iter().find(|(at, _)| *at == tick);
            if let Some((_, moved)) = moved {
                let mut next = self.snapshot(1);
                next.manifest.moved = Some(moved.clone());
                let controller = Pilot::new(&next, &robot).unwrap();
                let id = core.controller.id + 1;
                log.push_snapshot(id, 1, next.to_bytes(), controller.row_names());
                *core.controller = Loaded { id, controller };
                twin.carry(self, moved);
            }
            core.swap(moved.is_some());
            let (begin, fresh) = (tick * period, Some(&state));
            core.update(&Inputs { due: 0, begin, stop: false, fresh, proposal: None });
            core.close(begin + 1000);
            log.push(&core.record);
            while log.waiting() > 100 {
                std::thread::sleep(Duration::from_micros(100));
            }
            if self.late > 0 && tick % self.late < self.late.min(2) {
                late += 1;
                twin.hold(first);
                continue;
            }
            let output = &core.record.output;
            twin.act(&output.action[..output.nu as usize]);
        }
        (path, log.finish())
    }
}

/// The plant that the model says it is: forces, or the targets of drives, are held for a period.
struct Twin {
    dynamics: PeriodDynamics,
    drives: Vec<Drive>,
    /// Of its period in a control period.
    steps: u32,
    q: Vec<f64>,
    v: Vec<f64>,
    a: Vec<f64>,
    held: Vec<Held>,
    /// What it was sent last.
    last: Vec<f64>,
    pause: Duration,
}

impl Twin {
    fn new(attack: &Attack) -> Twin {
        let model = attack.model();
        let all: Vec<usize> = (0..model.nv()).collect();
        // as many steps as the model says, unless it is told otherwise
        let steps = if attack.plant_steps == 0 { attack.sub_steps } else { attack.plant_steps };
        let period = match steps {
            0 => nearl_constraints::Period::new(attack.dt, 0),
            steps => nearl_constraints::Period::new(attack.dt / f64::from(steps), 1),
        };
        let zero = vec![0.0; model.nv()];
        Twin {
            steps: steps.max(1),
            drives: attack.snapshot(1).manifest.task.command.drives(&model, &all).unwrap(),
            dynamics: PeriodDynamics::new(&model, &all, period),
            q: attack.start.clone(),
            v: zero.clone(),
            a: zero,
            held: vec![Held::Force(0.0); model.nv()],
            last: Vec::new(),
            pause: attack.pause,
        }
    }
}

impl Twin {
    /// The plant has in its hand what the operator says.
    fn carry(&mut self, attack: &Attack, moved: &Moved) {
        let bare = attack.model();
        let model =
            moved.payload.as_ref().map_or(Ok(bare.clone()), |payload| bare.with_payload(payload)).unwrap();
        let all: Vec<usize> = (0..model.nv()).collect();
        self.dynamics = PeriodDynamics::new(&model, &all, *self.dynamics.period());
    }

    /// What a driver does without an answer: of positions it goes on, slower by what the joints may decelerate, of forces it holds them.
    fn hold(&mut self, snapshot: &Snapshot) {
        if self.drives.iter().all(|drive| matches!(drive, Drive::Effort)) {
            return self.step();
        }
        let period = self.dynamics.period().dt * f64::from(self.steps);
        let most =
            snapshot.manifest.task.constraints.acceleration.as_ref().and_then(|a| a.limit.of("", 0)).unwrap();
        for (q, v) in self.q.iter_mut().zip(&mut self.v) {
            *v -= v.signum() * (most * period).min(v.abs());
            *q += period * *v;
        }
    }

    fn measure(&self, state: &mut StateMessage) {
        let n = self.v.len() as u32;
        (state.nq, state.nv, state.nu, state.n_obs) = (n, n, n, 2 * n);
        state.q_mut().copy_from_slice(&self.q);
        state.v_mut().copy_from_slice(&self.v);
        let n = self.v.len();
        state.obs_mut()[..n].copy_from_slice(&self.q);
        state.obs_mut()[n..].copy_from_slice(&self.v);
    }

    /// A period under these motor forces; none, and the motors hold it where it stands.
    fn act(&mut self, forces: &[f64]) {
        forces.clone_into(&mut self.last);
        self.step();
    }

    fn step(&mut self) {
        if self.last.is_empty() {
            return;
        }
        let (zero, period) = (vec![0.0; self.v.len()], *self.dynamics.period());
        let (dt, kappa) = (period.dt, period.kappa);
        for _ in 0..self.steps {
            for (i, (held, command)) in self.held.iter_mut().zip(&self.last).enumerate() {
                *held = self.drives[i].held(&period, self.q[i], self.v[i], *command);
            }
            self.dynamics.update(&self.q, &self.v, &zero);
            self.dynamics.accelerate(&self.held, &mut self.a);
            for i in 0..self.v.len() {
                self.q[i] += dt * self.v[i] + kappa * dt * dt * self.a[i];
                self.v[i] += dt * self.a[i];
            }
        }
    }
}

impl Plant for Twin {
    fn observe(&mut self, state: &mut StateMessage) {
        std::thread::sleep(self.pause);
        self.measure(state);
    }

    fn apply(&mut self, action: &ActionMessage) {
        self.act(action.action());
    }

    fn brake(&mut self) {
        self.v.fill(0.0);
    }
}
