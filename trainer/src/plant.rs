//! MuJoCo as the robot behind a link: `nearl plant`.

use crate::env::{Env, EnvError, Limits, Meter};
use crate::rollout::stream;
use nearl_constraints::{LimitSet, Model, Target};
use nearl_runtime::idm::AnalyticIdm;
use nearl_runtime::link::{
    ActionMessage, Plant, Robot, STATE_RESET, STATE_TERMINATED, STATE_TRUNCATED, StateMessage, hash_names,
};
use rand_chacha::ChaCha8Rng;

/// Excess over a limit that counts as rounding, in rad, rad/s or N m.
pub const TOLERANCE: f64 = 1e-9;

/// A task's environment as a plant: measures its own limits, brakes by itself, starts episodes anew.
pub struct MujocoPlant {
    env: Box<dyn Env>,
    rng: ChaCha8Rng,
    meter: Meter,
    limits: PlantLimits,
    drive: Option<Drive>,
    action: Vec<f64>,
    force: Vec<f64>,
    episode: Episode,
    resets: bool,
}

/// Limits by degree of freedom in MuJoCo's order.
#[derive(Clone, Debug)]
pub struct PlantLimits {
    /// What the meter watches.
    pub watched: Limits,
    /// Braking deceleration by degree of freedom.
    pub braking: Vec<f64>,
}

#[derive(Default)]
struct Episode {
    number: u64,
    tick: u64,
    total: f64,
    last: f64,
    reward: f64,
    bits: u32,
    saturated: u32,
}

impl PlantLimits {
    /// The robot's own position and effort limits, and the task's velocity and acceleration limits.
    pub fn new(env: &dyn Env, model: &Model, set: &LimitSet) -> Self {
        let spec = env.spec();
        let none = vec![f64::INFINITY; spec.nv];
        let mut watched = Limits {
            lower_position: vec![f64::NEG_INFINITY; spec.nq],
            upper_position: vec![f64::INFINITY; spec.nq],
            velocity: none.clone(),
            effort: none.clone(),
        };
        let mut braking = none;
        for j in spec.joints.iter() {
            let Ok(m) = model.joint(&j.name) else { continue };
            if m.nv != 1 {
                continue;
            }
            watched.lower_position[j.idx_q] = set.q_lower[m.idx_v];
            watched.upper_position[j.idx_q] = set.q_upper[m.idx_v];
            watched.velocity[j.idx_v] = set.velocity[m.idx_v];
            watched.effort[j.idx_v] = model.effort_limit()[m.idx_v];
            braking[j.idx_v] = set.acceleration[m.idx_v];
        }
        Self { watched, braking }
    }

    /// Hash of the limits, announced with the plant.
    pub fn digest(&self) -> u64 {
        hash_names([format!("{:?}", self.watched)])
    }
}

impl MujocoPlant {
    /// A plant at the start of its first episode. `resets`: episodes end and start as in training; otherwise the robot
    /// simply goes on.
    ///
    /// # Errors
    /// [`EnvError`] when MuJoCo cannot evaluate the state.
    pub fn new(
        mut env: Box<dyn Env>,
        model: &Model,
        limits: PlantLimits,
        seed: u64,
        resets: bool,
    ) -> Result<Self, EnvError> {
        let mut rng = stream(seed, 0);
        env.reset(&mut rng)?;
        let (n_act, nv) = (env.spec().n_act(), env.spec().nv);
        let meter = Meter::new(limits.watched.clone(), TOLERANCE)
            .unwrap_or_else(|e| unreachable!("limits of a built projector: {e}"));
        let episode = Episode { bits: STATE_RESET, ..Episode::default() };
        let drive = Drive::new(env.as_ref(), model, &limits);
        Ok(Self {
            env,
            rng,
            meter,
            limits,
            drive,
            action: vec![0.0; n_act],
            force: vec![0.0; nv],
            episode,
            resets,
        })
    }

    /// What the plant announces.
    pub fn robot(&self, lockstep: bool) -> Robot {
        let spec = self.env.spec();
        let mut joints: Vec<_> = spec.joints.iter().collect();
        joints.sort_by_key(|j| j.idx_v);
        Robot {
            joints: joints.iter().map(|j| j.name.clone()).collect(),
            observation: spec.obs.clone(),
            limits: self.limits.digest(),
            nq: spec.nq,
            nv: spec.nv,
            nu: spec.n_act(),
            dt: spec.dt,
            lockstep,
        }
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
        let step = self.env.step(&self.action);
        let e = &mut self.episode;
        (e.tick, e.reward, e.total) = (e.tick + 1, step.reward, e.total + step.reward);
        let range = &self.env.spec().actuators;
        e.saturated =
            self.action.iter().zip(range).filter(|(a, r)| **a < r.low || **a > r.high).count() as u32;
        if step.terminated {
            e.bits |= STATE_TERMINATED;
        } else if self.resets && e.tick >= self.env.spec().max_episode_steps as u64 {
            e.bits |= STATE_TRUNCATED;
        }
        self.env.sim().applied_force(&mut self.force);
        self.meter.observe(self.env.qpos(), self.env.qvel(), &self.force);
    }

    fn begin_episode(&mut self) {
        self.env.reset(&mut self.rng).unwrap_or_else(|e| panic!("{e}"));
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
        (s.reward, s.episode_return, s.last_return, s.episodes) = (e.reward, e.total, e.last, e.number);
        let m = &self.meter;
        let (p, v, t) = (m.position(), m.velocity(), m.effort());
        s.violations = [p.states, v.states, 0, t.states];
        s.worst = [p.excess, v.excess, 0.0, t.excess];
    }

    fn apply(&mut self, action: &ActionMessage) {
        let n = self.action.len();
        self.action.copy_from_slice(&action.action[..n]);
        self.advance();
    }

    /// The drive's own brake: `a = -sgn(v) min(A, |v| / dt)` through inverse dynamics where every joint has a motor and a
    /// braking limit; no action elsewhere.
    fn brake(&mut self) {
        self.action.fill(0.0);
        if let Some(drive) = &mut self.drive {
            self.env.state(&mut drive.q, &mut drive.next.v);
            let dt = self.env.spec().dt;
            for (i, a) in drive.next.acceleration.iter_mut().enumerate() {
                let v = drive.next.v[i];
                *a = -v.signum() * self.limits.braking[i].min(v.abs() / dt);
            }
            let v = drive.next.v.clone();
            drive.idm.torque(&drive.q, &v, &drive.next, &mut self.action);
            for (a, range) in self.action.iter_mut().zip(&self.env.spec().actuators) {
                *a = a.clamp(range.low, range.high);
            }
        }
        self.advance();
    }
}

/// Inverse dynamics in the drives, for braking without a runtime.
struct Drive {
    idm: AnalyticIdm,
    q: Vec<f64>,
    next: Target,
}

impl Drive {
    /// `None` where a joint has no motor or no braking limit.
    fn new(env: &dyn Env, model: &Model, limits: &PlantLimits) -> Option<Self> {
        let spec = env.spec();
        let dofs: Vec<usize> = (0..spec.nv).collect();
        let driven = spec.n_act() == spec.nv && limits.braking.iter().all(|a| a.is_finite());
        driven.then(|| Self {
            idm: AnalyticIdm::new(model, &dofs),
            q: model.neutral(),
            next: Target::new(model),
        })
    }
}
