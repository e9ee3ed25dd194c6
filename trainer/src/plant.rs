//! MuJoCo as the robot behind a link: `nearl plant`.

use crate::env::{Env, EnvError, Limits, Meter, Spec};
use crate::foresight::Foresight;
use crate::rollout::stream;
use crate::watch::{Watch, WatchError};
use nearl_runtime::constraints::{Drive, Guard, LimitSet, Model, end_of_range};
use nearl_runtime::controller::Parts;
use nearl_runtime::link::{
    ActionMessage, Plant, Robot, STATE_RESET, STATE_TERMINATED, STATE_TRUNCATED, StateMessage, TallyMessage,
};
use nearl_runtime::rt::{Brake, describe};
use nearl_runtime::{Manifest, SnapshotError};
use rand_chacha::ChaCha8Rng;

/// Starts that are drawn for an episode before the plant gives up.
const MOST_DRAWS: usize = 100;

/// Excess over a limit that counts as rounding, in rad, rad/s or N m; for an acceleration what follows from that of a velocity.
pub const TOLERANCE: f64 = 1e-9;

/// A task's environment as a plant: measures its own limits, brakes by itself, starts episodes anew.
pub struct MujocoPlant {
    env: Box<dyn Env>,
    rng: ChaCha8Rng,
    watch: Watch,
    /// Asks the simulator where an action leads, if the task says so.
    foresight: Option<Foresight>,
    drive: Option<Brake>,
    robot: Robot,
    action: Vec<f64>,
    followers: Vec<Follower>,
    /// `action` was applied last, and the robot did not brake by itself.
    is_sent: bool,
    /// Configuration and velocity as the environment gives them, and as the robot's model has them.
    state: (Vec<f64>, Vec<f64>),
    seen: (Vec<f64>, Vec<f64>),
    places: Vec<Place>,
    episode: Episode,
    resets: bool,
}

#[derive(Default)]
struct Episode {
    number: u64,
    tick: u64,
    total: f64,
    last: f64,
    bits: u32,
    saturated: u32,
}

/// What the meter watches, in MuJoCo's order: the task's limits ([`end_of_range`]), and the robot file's effort where the task limits no
/// torque.
pub fn watched_limits(env: &dyn Env, model: &Model, set: &LimitSet) -> Limits {
    let spec = env.spec();
    let none = vec![f64::INFINITY; spec.nv];
    let mut watched = Limits {
        lower_position: vec![f64::NEG_INFINITY; spec.nq],
        upper_position: vec![f64::INFINITY; spec.nq],
        velocity: none.clone(),
        acceleration: none.clone(),
        effort: none,
    };
    for j in &spec.joints {
        let Some(m) = model.joints().iter().find(|m| m.name == j.name && m.nv == 1) else { continue };
        let [low, high] = [model.lower_position_limit()[m.idx_q], model.upper_position_limit()[m.idx_q]];
        watched.lower_position[j.idx_q] = end_of_range(set.q_lower[m.idx_v], low);
        watched.upper_position[j.idx_q] = end_of_range(set.q_upper[m.idx_v], high);
        watched.velocity[j.idx_v] = set.velocity[m.idx_v];
        watched.acceleration[j.idx_v] = set.acceleration[m.idx_v];
        watched.effort[j.idx_v] = model.effort_limit()[m.idx_v].min(set.effort[m.idx_v]);
    }
    watched
}

/// A joint that is sent positions, or the targets of a drive.
struct Follower {
    /// Its entry of an action.
    entry: usize,
    /// Where it is in the environment's state.
    at: (usize, usize),
    /// What it may decelerate by in a period [rad/s or m/s].
    slower: f64,
    /// Mean speed on the way to what it was sent last [rad/s or m/s]; of a target there is none.
    mean: f64,
    /// Stiffness, damping and largest force of a drive of targets.
    drive: Option<[f64; 3]>,
}

/// Those of the joints that `drives` (nv) says are sent positions or targets; `set` limits their acceleration and force.
fn followers(spec: &Spec, model: &Model, drives: &[Drive], set: &LimitSet) -> Vec<Follower> {
    let joint_of = |dof: usize| {
        let own = spec.joints.iter().find(|joint| joint.idx_v == dof)?;
        let joint = model.joints().iter().find(|joint| joint.name == own.name && joint.nv == 1)?;
        Some(((own.idx_q, own.idx_v), joint.idx_v))
    };
    let follower = |(entry, dof): (usize, usize)| {
        let (at, dof) = joint_of(dof)?;
        let drive = match drives[dof] {
            Drive::Position => None,
            Drive::Pd { stiffness, damping } => {
                Some([stiffness, damping, model.effort_limit()[dof].min(set.effort[dof])])
            }
            Drive::Effort | Drive::Velocity => return None,
        };
        Some(Follower { entry, at, slower: spec.dt * set.acceleration[dof], mean: 0.0, drive })
    };
    spec.actuators.iter().map(|actuator| actuator.dof).enumerate().filter_map(follower).collect()
}

/// Where the entries of a joint are in the environment's state, and in that of the robot's model.
struct Place {
    from: (usize, usize),
    to: (usize, usize),
    /// Configuration entries and velocities.
    size: (usize, usize),
    /// The model has cosine and sine of the simulated angle.
    turns: bool,
}

/// The joints of the robot's model in the environment: their order may be another, and a joint that turns without end is one angle there.
///
/// # Errors
/// [`PlantError::Robot`] with the joint that is not simulated as the model has it.
fn places(spec: &Spec, model: &Model) -> Result<Vec<Place>, PlantError> {
    let refused = |name: &str, reason: String| {
        PlantError::Robot(format!(
            "joint '{name}' {reason}; import the policy, or make the snapshot, with this robot file anew"
        ))
    };
    let place = |joint: &nearl_runtime::constraints::Joint| {
        let found = spec.joints.iter().find(|own| own.name == joint.name);
        let own = found.ok_or_else(|| refused(&joint.name, "is not in the simulated robot".into()))?;
        let turns = (joint.nq, joint.nv) == (2, 1) && (own.nq, own.nv) == (1, 1);
        if !turns && (joint.nq, joint.nv) != (own.nq, own.nv) {
            let (nq, nv) = (joint.nq, joint.nv);
            let reason = format!(
                "has {nq} configuration entries and {nv} velocities in the snapshot, and {} and {} in the simulation",
                own.nq, own.nv
            );
            return Err(refused(&joint.name, reason));
        }
        let (from, to) = ((own.idx_q, own.idx_v), (joint.idx_q, joint.idx_v));
        Ok(Place { from, to, size: (own.nq, own.nv), turns })
    };
    match spec.joints.iter().find(|own| !model.joints().iter().any(|joint| joint.name == own.name)) {
        Some(own) => Err(refused(&own.name, "is simulated and not in the snapshot".into())),
        None => model.joints().iter().map(place).collect(),
    }
}

/// Why a plant could not start.
#[derive(Debug, thiserror::Error)]
pub enum PlantError {
    /// The environment.
    #[error(transparent)]
    Env(#[from] EnvError),
    /// The task's robot, layout or limits.
    #[error(transparent)]
    Task(#[from] SnapshotError),
    /// The robot that is simulated is not the one that is controlled.
    #[error("the simulation is not of the robot that is controlled: {0}")]
    Robot(String),
    /// Limits or MuJoCo, for what is watched.
    #[error(transparent)]
    Watch(#[from] WatchError),
}

impl MujocoPlant {
    /// A plant of the task at the start of its first episode. `resets`: episodes end and start as in training; otherwise
    /// the robot simply goes on.
    ///
    /// # Errors
    /// [`PlantError`].
    pub fn new(manifest: &Manifest, seed: u64, resets: bool) -> Result<Self, PlantError> {
        let mut env = crate::env::of_plant(manifest, &manifest.task.name)?;
        let Parts { model, layout, projector, .. } = Parts::new(manifest)?;
        let mut rng = stream(seed, 0);
        env.reset(&mut rng)?;
        let limits = watched_limits(env.as_ref(), &model, projector.limits());
        let watch = Watch::new(env.as_ref(), limits.clone())?;
        let (n_act, nq, nv) = (env.spec().n_act(), env.spec().nq, env.spec().nv);
        let commanded = manifest.action_lower.len();
        if n_act != commanded {
            return Err(PlantError::Robot(format!(
                "the snapshot commands {commanded} motors, and the simulation takes {n_act}; name the joints that are commanded in state.controllable, with \
                 idm.kind = \"pinocchio\" or guard = true"
            )));
        }
        let asks = manifest.task.constraints.guard == Guard::Simulator;
        let drives = Parts::drives(manifest, &model, layout.controllable())?;
        let mut plant = Self {
            followers: followers(env.spec(), &model, &drives, projector.limits()),
            foresight: asks.then(|| Foresight::new(env.as_ref(), &limits)),
            watch,
            drive: Brake::new(manifest)?,
            robot: describe(manifest, false)?,
            places: places(env.spec(), &model)?,
            seen: (vec![0.0; model.nq()], vec![0.0; model.nv()]),
            env,
            rng,
            action: vec![0.0; n_act],
            is_sent: false,
            state: (vec![0.0; nq], vec![0.0; nv]),
            episode: Episode { bits: STATE_RESET, ..Episode::default() },
            resets,
        };
        plant.stay();
        Ok(plant)
    }

    /// Drives begin an episode on the positions that their joints are at.
    fn stay(&mut self) {
        self.action.fill(0.0);
        for Follower { entry, at, mean, .. } in &mut self.followers {
            (self.action[*entry], *mean) = (self.env.qpos()[at.0], 0.0);
        }
    }

    /// What joints that are sent positions do without any: they slow down.
    fn slow_down(&mut self) {
        let dt = self.dt();
        for Follower { entry, slower, mean, .. } in self.followers.iter_mut().filter(|f| f.drive.is_none()) {
            *mean -= slower.min(mean.abs()).copysign(*mean);
            self.action[*entry] += dt * *mean;
        }
    }

    /// What motors do that nothing tells how to brake: forces and speeds are none, and a drive stays on its target, with no more than its largest force.
    fn let_go(&mut self) {
        self.slow_down();
        for (entry, action) in self.action.iter_mut().enumerate() {
            if !self.followers.iter().any(|follower| follower.entry == entry) {
                *action = 0.0;
            }
        }
        for Follower { entry, at, drive, .. } in &self.followers {
            let Some([stiffness, damping, most]) = drive else { continue };
            let (q, v) = (self.env.qpos()[at.0], self.env.qvel()[at.1]);
            let force = (stiffness * (self.action[*entry] - q) - damping * v).clamp(-most, *most);
            self.action[*entry] = q + (force + damping * v) / stiffness;
        }
    }

    /// What the plant announces.
    pub fn robot(&self, lockstep: bool) -> Robot {
        Robot { lockstep, ..self.robot.clone() }
    }

    /// Control period in \[s\].
    pub fn dt(&self) -> f64 {
        self.env.spec().dt
    }

    /// Physics step \[s\] that a task has to state for its limits to be exact here; none where the integrator is no Euler.
    pub fn sim_dt(&self) -> Option<f64> {
        let spec = self.env.spec();
        spec.semi_implicit_euler.then_some(spec.sim_dt)
    }

    /// The meter of the simulator's own state.
    pub fn meter(&self) -> &Meter {
        self.watch.meter()
    }

    /// Brings the state of the robot's model up to date.
    fn see(&mut self) {
        let ((q, v), (to_q, to_v)) = (&mut self.state, &mut self.seen);
        self.env.state(q, v);
        for Place { from, to, size, turns } in &self.places {
            match turns {
                true => (to_q[to.0 + 1], to_q[to.0]) = q[from.0].sin_cos(),
                false => to_q[to.0..to.0 + size.0].copy_from_slice(&q[from.0..from.0 + size.0]),
            }
            to_v[to.1..to.1 + size.1].copy_from_slice(&v[from.1..from.1 + size.1]);
        }
    }

    fn advance(&mut self) {
        if self.episode.bits & (STATE_TERMINATED | STATE_TRUNCATED) != 0 && self.resets {
            self.begin_episode();
            return;
        }
        self.episode.bits = 0;
        if let Some(foresight) = &mut self.foresight {
            foresight.update(self.env.as_mut(), &mut self.action);
        }
        let step = self.env.step(&self.action);
        let e = &mut self.episode;
        (e.tick, e.total) = (e.tick + 1, e.total + step.reward);
        let range = &self.env.spec().actuators;
        e.saturated =
            self.action.iter().zip(range).filter(|(a, r)| **a < r.low || **a > r.high).count() as u32;
        if step.terminated {
            e.bits |= STATE_TERMINATED;
        } else if self.resets && e.tick >= self.env.spec().max_episode_steps as u64 {
            e.bits |= STATE_TRUNCATED;
        }
        self.watch.observe(self.env.as_ref());
    }

    fn begin_episode(&mut self) {
        // A start of one's own may be undefined for some of its draws; a plant that stops would stop a robot.
        let mut refused = 0;
        while let Err(e) = self.env.reset(&mut self.rng) {
            refused += 1;
            assert!(refused < MOST_DRAWS, "{e}");
            nearl_runtime::tell!("nearl: the start of an episode is drawn again: {e}");
        }
        self.watch.begin(self.env.as_ref());
        self.stay();
        self.is_sent = false;
        let e = &mut self.episode;
        *e = Episode { number: e.number + 1, last: e.total, bits: STATE_RESET, ..Episode::default() };
    }
}

impl Plant for MujocoPlant {
    fn observe(&mut self, s: &mut StateMessage) {
        self.see();
        let ((q, v), spec) = (&self.seen, self.env.spec());
        (s.nq, s.nv) = (q.len() as u32, v.len() as u32);
        (s.nu, s.n_obs) = (spec.n_act() as u32, spec.n_obs() as u32);
        s.q[..q.len()].copy_from_slice(q);
        s.v[..v.len()].copy_from_slice(v);
        self.env.observe(&mut s.obs[..spec.n_obs()]);
        s.applied[..self.action.len()].copy_from_slice(&self.action);
        s.time = self.env.sim().time();
        let e = &self.episode;
        (s.episode, s.episode_tick, s.bits, s.saturated) = (e.number, e.tick, e.bits, e.saturated);
    }

    fn tally(&self, t: &mut TallyMessage) {
        let e = &self.episode;
        (t.episodes, t.episode_return, t.last_return) = (e.number, e.total, e.last);
        for (i, found) in self.watch.meter().records().into_iter().enumerate() {
            found.iter().for_each(|worst| t.measure(i, worst.states, worst.excess));
        }
    }

    fn apply(&mut self, action: &ActionMessage) {
        let dt = self.dt();
        for Follower { entry, mean, .. } in self.followers.iter_mut().filter(|f| f.drive.is_none()) {
            *mean = if self.is_sent { (action.action[*entry] - self.action[*entry]) / dt } else { 0.0 };
        }
        let n = self.action.len();
        self.action.copy_from_slice(&action.action[..n]);
        self.is_sent = true;
        self.advance();
    }

    fn hold(&mut self, _action: &ActionMessage) {
        self.slow_down();
        self.advance();
    }

    /// The drive's own brake, where analytic inverse dynamics knows the torque that stops the robot; elsewhere motors are let go, and drives stay.
    fn brake(&mut self) {
        self.is_sent = false;
        if self.drive.is_some() {
            self.see();
        }
        match &mut self.drive {
            Some(brake) => {
                let (_, torque) = brake.update(&self.seen.0, &self.seen.1);
                self.action.copy_from_slice(torque);
            }
            None => self.let_go(),
        }
        self.advance();
    }
}
