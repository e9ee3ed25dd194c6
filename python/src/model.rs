//! The robot model and its equations of motion.

use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

use nearl_constraints::{self as constraints, Dynamics, RobotDescription, convention};
use nearl_trainer::robot;
use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;

use crate::arrays::{array, array2, sub_steps, vector};
use crate::errors;

type Vector<'py> = Bound<'py, PyArray1<f64>>;

/// A robot from a URDF or MJCF file, or from its description. Configurations and velocities are in Pinocchio's convention; they differ
/// from MuJoCo's for a free base only, and `q_from_mujoco` and its like translate.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct Model {
    pub(crate) model: constraints::Model,
    dynamics: Mutex<Dynamics>,
}

#[pymethods]
impl Model {
    /// Reads a URDF file; the base is fixed to the world, or with `free_flyer` floats: seven positions (x, y, z and a quaternion x, y,
    /// z, w) and six velocities in the base's axes come first.
    #[staticmethod]
    #[pyo3(signature = (path, free_flyer=false))]
    fn from_urdf(py: Python<'_>, path: PathBuf, free_flyer: bool) -> PyResult<Model> {
        let read =
            if free_flyer { constraints::Model::from_urdf_free_flyer } else { constraints::Model::from_urdf };
        py.detach(|| read(&path)).map(Model::of).map_err(errors::model)
    }

    /// Names of the frames: links, joints and sites.
    #[getter]
    fn frame_names(&self) -> Vec<String> {
        self.model.frame_names().map(str::to_string).collect()
    }

    /// Generalised forces `J'f` (nv) of wrenches on frames at `q` (nq), for `Projector.set_external_forces`: force [N] and moment
    /// about the frame's origin [N·m] by frame name, in world axes, from the environment on the robot.
    fn external_forces<'py>(
        &self,
        py: Python<'py>,
        q: &Bound<'_, PyAny>,
        wrenches: std::collections::BTreeMap<String, [f64; 6]>,
    ) -> PyResult<Vector<'py>> {
        let (q, zero) = (self.q("q", q)?, vec![0.0; self.model.nv()]);
        let mut kinematics = constraints::Kinematics::new(&self.model);
        kinematics.update(&q, &zero, &zero);
        let mut tau = zero;
        for (name, wrench) in wrenches {
            let frame = self.model.frame(&name).map_err(errors::model)?;
            kinematics.add_wrench(frame, wrench, &mut tau);
        }
        Ok(array(py, &tau))
    }

    /// Reads an MJCF file through MuJoCo, with what it includes and its meshes.
    #[staticmethod]
    fn from_mjcf(py: Python<'_>, path: PathBuf) -> PyResult<Model> {
        py.detach(|| robot::read_mjcf(&path)).map_err(errors::robot).and_then(Model::build)
    }

    /// Builds a robot from the JSON text of a description.
    #[staticmethod]
    fn from_description(text: &str) -> PyResult<Model> {
        let description = serde_json::from_str(text);
        description
            .map_err(|e| errors::value(format!("no description of a robot: {e}")))
            .and_then(Model::build)
    }

    /// The robot as plain numbers: bodies, joints, motors, frames and solids, as JSON text.
    fn description(&self) -> PyResult<String> {
        serde_json::to_string(self.model.description()).map_err(errors::value)
    }

    /// The robot with a body held fast in one of its frames: a model of its own, for which projectors are built anew.
    ///
    /// Args:
    ///     frame (str): a link or site of the robot file.
    ///     mass (float): [kg].
    ///     com (3): centre of mass in the frame's axes [m].
    ///     inertia (6): about the centre of mass in the frame's axes, xx, xy, xz, yy, yz, zz [kg m²].
    #[pyo3(signature = (frame, mass, com=[0.0; 3], inertia=[0.0; 6]))]
    fn with_payload(&self, frame: &str, mass: f64, com: [f64; 3], inertia: [f64; 6]) -> PyResult<Model> {
        let payload = constraints::description::Payload { frame: frame.to_string(), mass, com, inertia };
        self.model.with_payload(&payload).map(Model::of).map_err(errors::model)
    }

    /// Dry friction (nv) [N·m or N]: the force that a joint withstands before it moves.
    #[getter]
    fn friction<'py>(&self, py: Python<'py>) -> Vector<'py> {
        array(py, self.model.friction())
    }

    /// Reads a URDF text.
    #[staticmethod]
    fn from_urdf_text(py: Python<'_>, text: &str) -> PyResult<Model> {
        py.detach(|| constraints::Model::from_urdf_text(text)).map(Model::of).map_err(errors::model)
    }

    /// Reads an MJCF text through MuJoCo; files that it names are looked for in the current folder.
    #[staticmethod]
    fn from_mjcf_text(py: Python<'_>, text: &str) -> PyResult<Model> {
        py.detach(|| robot::read_mjcf_text(text)).map_err(errors::robot).and_then(Model::build)
    }

    /// Entries of a configuration.
    #[getter]
    fn nq(&self) -> usize {
        self.model.nq()
    }

    /// Degrees of freedom.
    #[getter]
    fn nv(&self) -> usize {
        self.model.nv()
    }

    /// Joints in the order of the degrees of freedom.
    #[getter]
    fn joint_names(&self) -> Vec<String> {
        self.model.joints().iter().map(|j| j.name.clone()).collect()
    }

    /// `(idx_q, nq, idx_v, nv)` of a joint.
    fn joint(&self, name: &str) -> PyResult<(usize, usize, usize, usize)> {
        let joint = self.model.joint(name).map_err(errors::model)?;
        Ok((joint.idx_q, joint.nq, joint.idx_v, joint.nv))
    }

    /// Lower position limits (nq) [rad or m]; minus infinity is none.
    #[getter]
    fn lower_position_limit<'py>(&self, py: Python<'py>) -> Vector<'py> {
        array(py, self.model.lower_position_limit())
    }

    /// Upper position limits (nq) [rad or m]; infinity is none.
    #[getter]
    fn upper_position_limit<'py>(&self, py: Python<'py>) -> Vector<'py> {
        array(py, self.model.upper_position_limit())
    }

    /// Velocity limits (nv) [rad/s or m/s]; infinity is none.
    #[getter]
    fn velocity_limit<'py>(&self, py: Python<'py>) -> Vector<'py> {
        array(py, self.model.velocity_limit())
    }

    /// Effort limits (nv) [N·m or N]; infinity is none.
    #[getter]
    fn effort_limit<'py>(&self, py: Python<'py>) -> Vector<'py> {
        array(py, self.model.effort_limit())
    }

    /// Rotor inertia (nv) [kg·m² or kg], already in the mass matrix.
    #[getter]
    fn armature<'py>(&self, py: Python<'py>) -> Vector<'py> {
        array(py, self.model.armature())
    }

    /// Viscous damping (nv) [N·m·s/rad or N·s/m].
    #[getter]
    fn damping<'py>(&self, py: Python<'py>) -> Vector<'py> {
        array(py, self.model.damping())
    }

    /// Mass of everything that moves [kg].
    #[getter]
    fn total_mass(&self) -> f64 {
        self.model.total_mass()
    }

    /// What the robot file describes that is not part of this model: forces, mimic joints.
    #[getter]
    fn notes(&self) -> Vec<String> {
        self.model.notes().to_vec()
    }

    /// The neutral configuration (nq).
    fn neutral<'py>(&self, py: Python<'py>) -> Vector<'py> {
        array(py, &self.model.neutral())
    }

    /// Mass matrix (nv x nv) [kg·m² or kg], armature included.
    fn mass_matrix<'py>(&self, q: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let q_ = self.q("q", q)?;
        let mut mass = vec![0.0; self.model.nv() * self.model.nv()];
        self.dynamics().mass(&q_, &mut mass);
        array2(q.py(), mass, self.model.nv())
    }

    /// Coriolis, centrifugal and gravity forces (nv) [N·m or N].
    fn nle<'py>(&self, q: &Bound<'py, PyAny>, v: &Bound<'py, PyAny>) -> PyResult<Vector<'py>> {
        let (q, v_) = (self.q("q", q)?, self.v("v", v)?);
        Ok(self.tangent(v.py(), |d, out| d.nle(&q, &v_, out)))
    }

    /// Inverse dynamics `tau = M a + nle` (nv) [N m or N] of q (nq) [rad or m], v (nv) [rad/s or m/s],
    /// a (nv) [rad/s² or m/s²], without springs and dampers; `motors` has them.
    fn rnea<'py>(
        &self,
        q: &Bound<'py, PyAny>,
        v: &Bound<'py, PyAny>,
        a: &Bound<'py, PyAny>,
    ) -> PyResult<Vector<'py>> {
        let (q, v_, a) = (self.q("q", q)?, self.v("v", v)?, self.v("a", a)?);
        Ok(self.tangent(v.py(), |d, out| d.rnea(&q, &v_, &a, out)))
    }

    /// Forward dynamics `a = M^-1 (tau - nle)` (nv) [rad/s² or m/s²] of q (nq) [rad or m], v (nv) [rad/s or m/s], tau (nv) [N m or N].
    fn aba<'py>(
        &self,
        q: &Bound<'py, PyAny>,
        v: &Bound<'py, PyAny>,
        tau: &Bound<'py, PyAny>,
    ) -> PyResult<Vector<'py>> {
        let (q, v_, tau) = (self.q("q", q)?, self.v("v", v)?, self.v("tau", tau)?);
        Ok(self.tangent(v.py(), |d, out| d.aba(&q, &v_, &tau, out)))
    }

    /// Forces of the joints' springs and dampers (nv) [N·m or N].
    fn passive<'py>(&self, q: &Bound<'py, PyAny>, v: &Bound<'py, PyAny>) -> PyResult<Vector<'py>> {
        let (q, v_) = (self.q("q", q)?, self.v("v", v)?);
        Ok(self.tangent(v.py(), |d, out| d.passive(&q, &v_, out)))
    }

    /// What the motors supply (nv) [N·m or N] to keep acceleration `a` over a control period of `dt` [s] that begins at `q`, `v`: `rnea` less
    /// the passive forces, on average over the period. `sub_steps` as for `Projector`.
    #[pyo3(signature = (q, v, a, dt, sub_steps=1))]
    fn motors<'py>(
        &self,
        q: &Bound<'py, PyAny>,
        v: &Bound<'py, PyAny>,
        a: &Bound<'py, PyAny>,
        dt: f64,
        #[pyo3(from_py_with = sub_steps)] sub_steps: u32,
    ) -> PyResult<Vector<'py>> {
        if !(dt.is_finite() && dt > 0.0) {
            return Err(errors::value(format!(
                "dt is {dt} s, no control period; give a positive number of seconds"
            )));
        }
        let period = constraints::Period::new(dt, sub_steps);
        let (q, v_, a) = (self.q("q", q)?, self.v("v", v)?, self.v("a", a)?);
        Ok(self.tangent(v.py(), |d, out| d.motors(&period, &q, &v_, &a, out)))
    }

    /// The configuration (nq) reached from `q` along the tangent displacement `dq` (nv).
    fn integrate<'py>(&self, q: &Bound<'py, PyAny>, dq: &Bound<'py, PyAny>) -> PyResult<Vector<'py>> {
        let (q_, dq) = (self.q("q", q)?, self.v("dq", dq)?);
        let mut out = vec![0.0; self.model.nq()];
        self.dynamics().integrate(&q_, &dq, &mut out);
        Ok(array(q.py(), &out))
    }

    /// The tangent displacement (nv) from `q0` to `q1` (nq).
    fn difference<'py>(&self, q0: &Bound<'py, PyAny>, q1: &Bound<'py, PyAny>) -> PyResult<Vector<'py>> {
        let (a, b) = (self.q("q0", q0)?, self.q("q1", q1)?);
        Ok(self.tangent(q0.py(), |d, out| d.difference(&a, &b, out)))
    }

    /// Configuration (nq) from MuJoCo's.
    fn q_from_mujoco<'py>(&self, qpos: &Bound<'py, PyAny>) -> PyResult<Vector<'py>> {
        let (given, mut q) = (self.q("qpos", qpos)?, vec![0.0; self.model.nq()]);
        convention::q_from_mujoco(&self.model, &given, &mut q);
        Ok(array(qpos.py(), &q))
    }

    /// Velocity (nv) from MuJoCo's, at the configuration `q` (not `qpos`).
    fn v_from_mujoco<'py>(&self, q: &Bound<'py, PyAny>, qvel: &Bound<'py, PyAny>) -> PyResult<Vector<'py>> {
        let (q_, given) = (self.q("q", q)?, self.v("qvel", qvel)?);
        Ok(self.tangent(q.py(), |_, out| convention::v_from_mujoco(&self.model, &q_, &given, out)))
    }

    /// Acceleration (nv) from MuJoCo's, at the state (`q`, `v`).
    fn a_from_mujoco<'py>(
        &self,
        q: &Bound<'py, PyAny>,
        v: &Bound<'py, PyAny>,
        qacc: &Bound<'py, PyAny>,
    ) -> PyResult<Vector<'py>> {
        let (q_, v, given) = (self.q("q", q)?, self.v("v", v)?, self.v("qacc", qacc)?);
        Ok(self.tangent(q.py(), |_, out| convention::a_from_mujoco(&self.model, &q_, &v, &given, out)))
    }

    /// Generalised force (nv) in MuJoCo's coordinates.
    fn tau_to_mujoco<'py>(&self, q: &Bound<'py, PyAny>, tau: &Bound<'py, PyAny>) -> PyResult<Vector<'py>> {
        let (q_, given) = (self.q("q", q)?, self.v("tau", tau)?);
        Ok(self.tangent(q.py(), |_, out| convention::tau_to_mujoco(&self.model, &q_, &given, out)))
    }

    fn __repr__(&self) -> String {
        format!("Model(nq={}, nv={}, joints={:?})", self.model.nq(), self.model.nv(), self.joint_names())
    }
}

impl Model {
    fn build(description: RobotDescription) -> PyResult<Model> {
        constraints::Model::from_description(description).map(Model::of).map_err(errors::model)
    }

    pub(crate) fn of(model: constraints::Model) -> Model {
        Model { dynamics: Mutex::new(Dynamics::new(&model)), model }
    }

    pub(crate) fn q(&self, name: &str, value: &Bound<'_, PyAny>) -> PyResult<Vec<f64>> {
        vector(name, value, self.model.nq())
    }

    pub(crate) fn v(&self, name: &str, value: &Bound<'_, PyAny>) -> PyResult<Vec<f64>> {
        vector(name, value, self.model.nv())
    }

    fn dynamics(&self) -> std::sync::MutexGuard<'_, Dynamics> {
        self.dynamics.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn tangent<'py>(&self, py: Python<'py>, f: impl FnOnce(&mut Dynamics, &mut [f64])) -> Vector<'py> {
        let mut out = vec![0.0; self.model.nv()];
        f(&mut self.dynamics(), &mut out);
        array(py, &out)
    }
}

/// Whether a physics step of an MJCF file is an Euler step that limits can count on: `Euler`, and `implicitfast` where joints and drives alone damp.
#[pyfunction]
pub(crate) fn makes_euler_steps(py: Python<'_>, path: PathBuf) -> PyResult<bool> {
    py.detach(|| robot::makes_euler_steps(&path)).map_err(errors::robot)
}
