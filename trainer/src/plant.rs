//! MuJoCo as the robot behind a link: `nearl plant`.

use crate::env::{Env, EnvError, Limits, Meter};
use crate::foresight::Foresight;
use crate::mj::{Inverse, MjError};
use crate::rollout::stream;
use nearl_runtime::constraints::{Guard, LimitSet, Model, end_of_range};
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
    meter: Meter,
    /// Asks the simulator where an action leads, if the task says so.
    foresight: Option<Foresight>,
    /// `None` where MuJoCo's step has no inverse, so that torque is not measured.
    inverse: Option<Inverse>,
    drive: Option<Brake>,
    robot: Robot,
    action: Vec<f64>,
    force: Vec<f64>,
    /// Configuration and velocity in Pinocchio's convention.
    state: (Vec<f64>, Vec<f64>),
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

/// Why a plant could not start.
#[derive(Debug, thiserror::Error)]
pub enum PlantError {
    /// The environment.
    #[error(transparent)]
    Env(#[from] EnvError),
    /// The task's robot, layout or limits.
    #[error(transparent)]
    Task(#[from] SnapshotError),
    /// MuJoCo.
    #[error(transparent)]
    Physics(#[from] MjError),
    /// The limits to watch.
    #[error(transparent)]
    Limits(#[from] crate::env::LimitError),
}

impl MujocoPlant {
    /// A plant of the task at the start of its first episode. `resets`: episodes end and start as in training; otherwise
    /// the robot simply goes on.
    ///
    /// # Errors
    /// [`PlantError`].
    pub fn new(manifest: &Manifest, seed: u64, resets: bool) -> Result<Self, PlantError> {
        let mut env = crate::env::of_plant(manifest, &manifest.task.name)?;
        let Parts { model, projector, .. } = Parts::new(manifest)?;
        let mut rng = stream(seed, 0);
        env.reset(&mut rng)?;
        let limits = watched_limits(env.as_ref(), &model, projector.limits());
        let mut meter = Meter::new(limits.clone(), TOLERANCE, env.spec().dt)?;
        meter.begin(env.qvel());
        let (n_act, nq, nv) = (env.spec().n_act(), env.spec().nq, env.spec().nv);
        let asks = manifest.task.constraints.guard == Guard::Simulator;
        Ok(Self {
            foresight: asks.then(|| Foresight::new(env.as_ref(), &limits)),
            meter,
            inverse: Inverse::new(env.sim())?,
            drive: Brake::new(manifest)?,
            robot: describe(manifest, false)?,
            env,
            rng,
            action: vec![0.0; n_act],
            force: vec![0.0; nv],
            state: (vec![0.0; nq], vec![0.0; nv]),
            episode: Episode { bits: STATE_RESET, ..Episode::default() },
            resets,
        })
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
        &self.meter
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
        let sim = self.env.sim();
        let known = if self.env.is_disturbed() {
            self.force.fill(0.0);
            self.env.spec().actuators.iter().for_each(|a| self.force[a.dof] = sim.applied_force_of(a.dof));
            true
        } else {
            // A motion that MuJoCo cannot go back from is one of no known force.
            self.inverse.as_mut().is_some_and(|inverse| inverse.force(sim, &mut self.force).is_ok())
        };
        self.meter.observe(self.env.qpos(), self.env.qvel(), known.then_some(&self.force[..]));
    }

    fn begin_episode(&mut self) {
        // A start of one's own may be undefined for some of its draws; a plant that stops would stop a robot.
        let mut refused = 0;
        while let Err(e) = self.env.reset(&mut self.rng) {
            refused += 1;
            assert!(refused < MOST_DRAWS, "{e}");
            eprintln!("nearl: the start of an episode is drawn again: {e}");
        }
        self.meter.begin(self.env.qvel());
        let e = &mut self.episode;
        *e = Episode { number: e.number + 1, last: e.total, bits: STATE_RESET, ..Episode::default() };
    }
}

impl Plant for MujocoPlant {
    fn observe(&mut self, s: &mut StateMessage) {
        let spec = self.env.spec();
        (s.nq, s.nv) = (spec.nq as u32, spec.nv as u32);
        (s.nu, s.n_obs) = (spec.n_act() as u32, spec.n_obs() as u32);
        self.env.state(&mut s.q[..spec.nq], &mut s.v[..spec.nv]);
        self.env.observe(&mut s.obs[..spec.n_obs()]);
        s.applied[..self.action.len()].copy_from_slice(&self.action);
        s.time = self.env.sim().time();
        let e = &self.episode;
        (s.episode, s.episode_tick, s.bits, s.saturated) = (e.number, e.tick, e.bits, e.saturated);
    }

    fn tally(&self, t: &mut TallyMessage) {
        let e = &self.episode;
        (t.episodes, t.episode_return, t.last_return) = (e.number, e.total, e.last);
        for (i, found) in self.meter.records().into_iter().enumerate() {
            found.iter().for_each(|worst| t.measure(i, worst.states, worst.excess));
        }
    }

    fn apply(&mut self, action: &ActionMessage) {
        let n = self.action.len();
        self.action.copy_from_slice(&action.action[..n]);
        self.advance();
    }

    /// The drive's own brake, where analytic inverse dynamics knows the torque that stops the robot; no action elsewhere.
    fn brake(&mut self) {
        self.action.fill(0.0);
        if let Some(brake) = &mut self.drive {
            self.env.state(&mut self.state.0, &mut self.state.1);
            let (_, torque) = brake.update(&self.state.0, &self.state.1);
            self.action.copy_from_slice(torque);
        }
        self.advance();
    }
}
