//! A simulation held against its limits, tick by tick, by the simulator's own state.

use crate::env::{Env, LimitError, Limits, Meter};
use crate::mj::{Inverse, MjError};
use crate::plant::TOLERANCE;

/// Why limits cannot be watched.
#[derive(Debug, thiserror::Error)]
pub enum WatchError {
    /// The limits.
    #[error(transparent)]
    Limits(#[from] LimitError),
    /// MuJoCo.
    #[error(transparent)]
    Physics(#[from] MjError),
}

/// A [`Meter`] of a simulation, with the forces that drove its joints.
pub struct Watch {
    meter: Meter,
    /// `None` where MuJoCo's step has no inverse, so that torque is not measured.
    inverse: Option<Inverse>,
    force: Vec<f64>,
}

impl Watch {
    /// Of `env` and these limits, from its state on.
    ///
    /// # Errors
    /// [`WatchError`].
    pub fn new(env: &dyn Env, limits: Limits) -> Result<Watch, WatchError> {
        let inverse = Inverse::new(env.sim())?;
        let mut meter = Meter::new(limits, TOLERANCE, env.spec().dt)?;
        meter.begin(env.qvel());
        Ok(Watch { meter, inverse, force: vec![0.0; env.spec().nv] })
    }

    /// An episode of `env` begins.
    pub fn begin(&mut self, env: &dyn Env) {
        self.meter.begin(env.qvel());
    }

    /// Measures the control tick that `env` has just made.
    pub fn observe(&mut self, env: &dyn Env) {
        let sim = env.sim();
        let is_known = if env.is_disturbed() {
            self.force.fill(0.0);
            env.spec().actuators.iter().for_each(|a| self.force[a.dof] = sim.applied_force_of(a.dof));
            true
        } else {
            // A motion that MuJoCo cannot go back from is one of no known force.
            self.inverse.as_mut().is_some_and(|inverse| inverse.force(sim, &mut self.force).is_ok())
        };
        self.meter.observe(env.qpos(), env.qvel(), is_known.then_some(&self.force[..]));
    }

    /// What was measured.
    pub fn meter(&self) -> &Meter {
        &self.meter
    }
}
