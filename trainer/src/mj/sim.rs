//! One simulation: state in, forces in, state out.

use std::sync::Arc;

use mujoco_rs::mujoco_c::{mjData, mjModel};
use mujoco_rs::wrappers::mj_data::{MjData, MjtWarning};
use mujoco_rs::wrappers::mj_model::MjModel;

use super::{MjError, Model, guard};

/// The state of one simulation. Nothing is allocated after [`Sim::new`] but by MuJoCo's own warnings.
///
/// # Example
/// ```no_run
/// # use nearl_trainer::mj::{Model, ModelFormat, Options, Sim};
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let model = Model::from_text(&std::fs::read_to_string("arm.urdf")?, ModelFormat::Urdf, Options::default())?;
/// let mut sim = Sim::new(&model)?;
/// sim.set_state(&[0.0; 7], &[0.0; 7])?;
/// sim.force_mut().fill(1.0);
/// sim.step(1)?;
/// println!("{:?}", sim.qpos());
/// # Ok(()) }
/// ```
pub struct Sim {
    model: Model,
    state: MjData<Arc<MjModel>>,
    before: (Vec<f64>, Vec<f64>),
}

impl Sim {
    /// Allocates a simulation at the robot's initial configuration.
    ///
    /// # Errors
    /// [`MjError::Engine`] when MuJoCo has no memory for it or cannot evaluate the initial configuration.
    pub fn new(model: &Model) -> Result<Sim, MjError> {
        let state = guard::counting_warnings(|| MjData::try_new(Arc::clone(&model.0)));
        let state = state.map_err(|e| MjError::Engine(e.to_string()))?;
        let before = (vec![0.0; model.nq()], vec![0.0; model.nv()]);
        let mut sim = Sim { model: model.clone(), state, before };
        sim.reset()?;
        Ok(sim)
    }

    /// The robot.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Back to the initial configuration at rest, time 0, no forces; derived quantities evaluated.
    ///
    /// # Errors
    /// [`MjError::Engine`].
    pub fn reset(&mut self) -> Result<(), MjError> {
        self.call(|m, d| {
            // SAFETY: `call` passes this simulation's own model and state.
            unsafe { guard::mj_resetData(m, d) };
            unsafe { guard::mj_forward(m, d) }
        })
    }

    /// Starts from `qpos` (nq) and `qvel` (nv) in MuJoCo's convention: everything else, the solver's warm start and the
    /// time included, is reset first, so the trajectory that follows depends on these two and the actions alone.
    ///
    /// # Errors
    /// [`MjError::Length`], [`MjError::NotFinite`] (the state is left as it was), [`MjError::Engine`].
    pub fn set_state(&mut self, qpos: &[f64], qvel: &[f64]) -> Result<(), MjError> {
        check("qpos", qpos, self.model.nq())?;
        check("qvel", qvel, self.model.nv())?;
        let is_none = |at: &usize| qpos[*at..at + 4].iter().all(|x| *x == 0.0);
        let none = self.model.quaternions().find(is_none);
        if let Some(index) = none {
            return Err(MjError::NoRotation { index });
        }
        // SAFETY: own model and state.
        self.call(|m, d| unsafe { guard::mj_resetData(m, d) })?;
        self.state.qpos_mut().copy_from_slice(qpos);
        self.state.qvel_mut().copy_from_slice(qvel);
        // SAFETY: own model and state.
        self.call(|m, d| unsafe { guard::mj_forward(m, d) })
    }

    /// Moves the robot to `qpos` (nq) for its kinematics alone: [`Sim::position`] is valid, nothing else is.
    ///
    /// # Errors
    /// As [`Sim::set_state`].
    pub fn place(&mut self, qpos: &[f64]) -> Result<(), MjError> {
        check("qpos", qpos, self.model.nq())?;
        self.state.qpos_mut().copy_from_slice(qpos);
        self.update_kinematics()
    }

    /// Brings [`Sim::position`] up to the present configuration; a step leaves it one physics step behind.
    ///
    /// # Errors
    /// [`MjError::Engine`].
    pub fn update_kinematics(&mut self) -> Result<(), MjError> {
        // SAFETY: own model and state.
        self.call(|m, d| unsafe { guard::mj_kinematics(m, d) })
    }

    /// Advances `sub_steps` physics steps with the controls and forces set before.
    ///
    /// # Errors
    /// [`MjError::Engine`]; the simulation is then back at its initial state.
    pub fn step(&mut self, sub_steps: usize) -> Result<(), MjError> {
        let Some(all_but_one) = sub_steps.checked_sub(1) else { return Ok(()) };
        if all_but_one > 0 {
            self.steps(all_but_one)?;
        }
        self.before.0.copy_from_slice(self.state.qpos());
        self.before.1.copy_from_slice(self.state.qvel());
        self.steps(1)
    }

    fn steps(&mut self, count: usize) -> Result<(), MjError> {
        self.call(|m, d| {
            for _ in 0..count {
                // SAFETY: own model and state.
                unsafe { guard::mj_step(m, d) }
            }
        })
    }

    /// Becomes what `other`, a simulation of the same robot, is: what follows is the same, bit for bit.
    ///
    /// # Errors
    /// [`MjError::Engine`].
    ///
    /// # Panics
    /// When the robots differ.
    pub fn copy_from(&mut self, other: &Sim) -> Result<(), MjError> {
        assert!(Arc::ptr_eq(&self.model.0, &other.model.0), "a copy of another robot's state");
        self.before.clone_from(&other.before);
        let from: *const mjData = other.state.ffi();
        self.call(|m, d| {
            // SAFETY: both states belong to this model.
            unsafe { guard::mj_copyData(d, m, from) };
        })
    }

    /// Configuration (nq) and velocity (nv) in which the last physics step began.
    pub fn before(&self) -> (&[f64], &[f64]) {
        (&self.before.0, &self.before.1)
    }

    /// Evaluates accelerations and forces at the present state, for [`Sim::acceleration`] and its like.
    ///
    /// # Errors
    /// [`MjError::Engine`].
    pub fn forward(&mut self) -> Result<(), MjError> {
        // SAFETY: own model and state.
        self.call(|m, d| unsafe { guard::mj_forward(m, d) })
    }

    /// Computes the contact forces read by [`Sim::contact_forces`].
    ///
    /// # Errors
    /// [`MjError::Engine`].
    pub fn compute_contact_forces(&mut self) -> Result<(), MjError> {
        // SAFETY: own model and state.
        self.call(|m, d| unsafe { guard::mj_rnePostConstraint(m, d) })
    }

    /// Whether MuJoCo found a non-finite or huge state since the last call and put the robot back to its initial one.
    pub fn take_unstable(&mut self) -> bool {
        // SAFETY: only counters are written.
        let counters = unsafe { &mut self.state.ffi_mut().warning };
        let mut unstable = false;
        for kind in [MjtWarning::mjWARN_BADQPOS, MjtWarning::mjWARN_BADQVEL, MjtWarning::mjWARN_BADQACC] {
            unstable |= std::mem::take(&mut counters[kind as usize].number) > 0;
        }
        unstable
    }

    /// What [`Sim::take_unstable`] would say.
    pub fn is_unstable(&self) -> bool {
        let counters = &self.state.ffi().warning;
        let kinds = [MjtWarning::mjWARN_BADQPOS, MjtWarning::mjWARN_BADQVEL, MjtWarning::mjWARN_BADQACC];
        kinds.into_iter().any(|kind| counters[kind as usize].number > 0)
    }

    /// Configuration (nq), MuJoCo's convention.
    pub fn qpos(&self) -> &[f64] {
        self.state.qpos()
    }

    /// Velocity (nv), MuJoCo's convention.
    pub fn qvel(&self) -> &[f64] {
        self.state.qvel()
    }

    /// Velocity (nv) to be changed between two steps: a push.
    pub fn qvel_mut(&mut self) -> &mut [f64] {
        self.state.qvel_mut()
    }

    /// Acceleration (nv) of the last evaluation.
    pub fn acceleration(&self) -> &[f64] {
        self.state.qacc()
    }

    /// Sets the simulated time \[s\].
    pub fn set_time(&mut self, time: f64) {
        // SAFETY: one number is written.
        unsafe { self.state.ffi_mut() }.time = time;
    }

    /// Simulated time \[s\].
    pub fn time(&self) -> f64 {
        self.state.time()
    }

    /// Controls of the actuators (nu), kept until changed or reset.
    pub fn ctrl_mut(&mut self) -> &mut [f64] {
        self.state.ctrl_mut()
    }

    /// Generalised force (nv) on the joints beside the actuators' \[N or N·m\], kept until changed or reset.
    pub fn force_mut(&mut self) -> &mut [f64] {
        self.state.qfrc_applied_mut()
    }

    /// Writes what drove each degree of freedom in the last physics step (nv): actuators plus [`Sim::force_mut`].
    pub fn applied_force(&self, force: &mut [f64]) {
        let (actuators, applied) = (self.state.qfrc_actuator(), self.state.qfrc_applied());
        for (i, f) in force.iter_mut().enumerate() {
            *f = actuators[i] + applied[i];
        }
    }

    /// What drove one degree of freedom in the last physics step: the entry of [`Sim::applied_force`].
    pub fn applied_force_of(&self, dof: usize) -> f64 {
        self.state.qfrc_actuator()[dof] + self.state.qfrc_applied()[dof]
    }

    /// Writes the sum of the normal forces of each body's contacts \[N\] (n_bodies), as of the last evaluation.
    pub fn contact_loads(&self, load: &mut [f64]) {
        load.fill(0.0);
        let body_of = self.model.0.geom_bodyid();
        for (i, contact) in self.state.contact().iter().enumerate() {
            let normal = self.state.contact_force(i)[0];
            for geom in contact.geom {
                if let Some(body) = usize::try_from(geom).ok().and_then(|geom| body_of.get(geom)) {
                    load[*body as usize] += normal;
                }
            }
        }
    }

    /// Position of a body's frame in the world \[m\], as of the last evaluation.
    pub fn position(&self, body: usize) -> [f64; 3] {
        self.state.xpos()[body]
    }

    /// MuJoCo's own state.
    pub(super) fn data(&self) -> &MjData<Arc<MjModel>> {
        &self.state
    }

    /// Position of every body's frame in the world \[m\], the world included, as of the last evaluation.
    pub fn positions(&self) -> &[[f64; 3]] {
        self.state.xpos()
    }

    /// Centre of mass of all bodies \[m\], as of the last evaluation.
    pub fn centre(&self) -> [f64; 3] {
        let (mass, at) = (self.model.0.body_mass(), self.state.xipos());
        let total: f64 = mass.iter().sum();
        [0, 1, 2].map(|axis| mass.iter().zip(at).map(|(m, x)| m * x[axis]).sum::<f64>() / total)
    }

    /// External force on each body `[torque, force]`, the world included, after [`Sim::compute_contact_forces`].
    pub fn contact_forces(&self) -> &[[f64; 6]] {
        self.state.cfrc_ext()
    }

    /// Writes the mass matrix (nv x nv, symmetric, armature included) of the last evaluation.
    ///
    /// # Errors
    /// [`MjError::Length`].
    pub fn mass(&self, mass: &mut [f64]) -> Result<(), MjError> {
        let expected = self.model.nv() * self.model.nv();
        let got = mass.len();
        self.state.full_m(mass).map_err(|_| MjError::Length { what: "mass", expected, got })
    }

    /// Coriolis, centrifugal and gravity forces (nv) of the last evaluation.
    pub fn nle(&self) -> &[f64] {
        self.state.qfrc_bias()
    }

    /// Spring and damper forces (nv) of the last evaluation.
    pub fn passive(&self) -> &[f64] {
        self.state.qfrc_passive()
    }

    /// [`Sim::call`] with a robot to be changed, which must be this simulation's own.
    pub(super) fn call_with_model(&mut self, run: impl Fn(*mut mjModel, *mut mjData)) -> Result<(), MjError> {
        self.call(|m, d| run(m.cast_mut(), d))
    }

    /// Runs MuJoCo on this simulation; after a fatal error the state is reset, because it was left half computed.
    fn call(&mut self, run: impl Fn(*const mjModel, *mut mjData)) -> Result<(), MjError> {
        let m: *const mjModel = self.model.0.ffi();
        // SAFETY: the pointer is handed to MuJoCo's own functions only.
        let d: *mut mjData = unsafe { self.state.ffi_mut() };
        let result = guard::catching(|| run(m, d));
        if result.is_err() {
            // SAFETY: as above.
            guard::catching(|| unsafe { guard::mj_resetData(m, d) })?;
        }
        result
    }
}

fn check(what: &'static str, values: &[f64], expected: usize) -> Result<(), MjError> {
    if values.len() != expected {
        return Err(MjError::Length { what, expected, got: values.len() });
    }
    match values.iter().position(|v| !v.is_finite()) {
        Some(index) => Err(MjError::NotFinite { what, index, value: values[index] }),
        None => Ok(()),
    }
}
