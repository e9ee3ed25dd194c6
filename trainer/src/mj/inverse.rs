//! What drove the joints in a physics step, computed back from the motion by MuJoCo's inverse dynamics.

use std::sync::Arc;

use mujoco_rs::mujoco_c::mjtEnableBit;
use mujoco_rs::wrappers::mj_data::MjData;
use mujoco_rs::wrappers::mj_model::MjModel;

use super::{MjError, Sim, guard};

/// MuJoCo's inverse dynamics of a robot. It looks at the motion alone and never at what the actuators were told.
pub struct Inverse {
    model: Arc<MjModel>,
    state: MjData<Arc<MjModel>>,
}

impl Inverse {
    /// For the robot of `sim`; `None` for a Runge-Kutta integrator, whose step has no inverse.
    ///
    /// # Errors
    /// [`MjError::Engine`] when MuJoCo has no memory for it.
    pub fn new(sim: &Sim) -> Result<Option<Inverse>, MjError> {
        let own = sim.model();
        if own.is_runge_kutta() {
            return Ok(None);
        }
        let mut model = MjModel::clone(&own.0);
        // The acceleration is the difference of two velocities, and dampers act as the integrator has them.
        model.opt_mut().enableflags |= mjtEnableBit::mjENBL_INVDISCRETE as i32;
        let model = Arc::new(model);
        let state = guard::counting_warnings(|| MjData::try_new(Arc::clone(&model)));
        Ok(Some(Inverse { state: state.map_err(|e| MjError::Engine(e.to_string()))?, model }))
    }

    /// Writes the generalised force (nv) beside springs, dampers, dry friction and contacts that drove the last physics step of `sim`.
    ///
    /// # Errors
    /// [`MjError::Engine`].
    pub fn force(&mut self, sim: &Sim, force: &mut [f64]) -> Result<(), MjError> {
        let (qpos, qvel) = sim.before();
        self.state.qpos_mut().copy_from_slice(qpos);
        self.state.qvel_mut().copy_from_slice(qvel);
        let sim_dt = sim.model().sim_dt();
        for (a, (new, old)) in self.state.qacc_mut().iter_mut().zip(sim.qvel().iter().zip(qvel)) {
            *a = (new - old) / sim_dt;
        }
        let m: *const _ = self.model.ffi();
        // SAFETY: the pointer is handed to MuJoCo's own function only, with the model it was made of.
        let d: *mut _ = unsafe { self.state.ffi_mut() };
        guard::catching(|| unsafe { guard::mj_inverse(m, d) })?;
        force.copy_from_slice(self.state.qfrc_inverse());
        Ok(())
    }
}
