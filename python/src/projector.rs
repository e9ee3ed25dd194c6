//! The projector: the nearest next state that every limit allows.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use nearl_constraints::row::Previous;
use nearl_constraints::{self as constraints, Braking, Consistency, Proposal, Settings, Solver};
use nearl_trainer::many::{Projectors, Rows};
use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{array, array2, joint_names, matrix, number, rows, sub_steps, whole};
use crate::errors;
use crate::limits;
use crate::model::Model;
use crate::target::{Target, Targets};

/// Projects proposed next states: the nearest state at the end of a period that every limit allows.
///
/// "Nearest" is the smallest sum over the joints of `w² ((v' - v_proposal)² + ((q' - q_proposal) / (kappa dt))²)`: positions are divided by a
/// period so that both are velocities. `kappa` is 1 with one physics step a period and 1/2 at constant acceleration.
///
/// Safe to share between threads; projections of one object then wait for each other.
///
/// Args:
///     model (Model): the robot, with nq positions and nv velocities.
///     limits (list[Limit]): what must hold; a limit that is not given does not.
///     dt (float): control period [s].
///     controllable (list[str] | None): names of the joints that may be moved; all with one degree of freedom by default. Nothing holds
///         ball joints and floating bases.
///     consistency ("kinematic" | "free"): position and velocity belong together, or are clamped apart.
///     solver ("ladder" | "clarabel"): closed form, then active set, then Clarabel; or Clarabel at once.
///     sub_steps (int): how the plant moves within a period: n semi-implicit Euler steps of a simulator (1, as MuJoCo's Euler with one step
///         a period), or 0 for constant acceleration: a real robot, or Runge-Kutta.
///     velocity_weight (list[float] | None): w of each velocity (nv), from 0.001 to 1000; 1 each by default.
///     braking ("auto" | "certified" | "stored"): what makes sure that a way to stop is left; see docs/LIMITS.md.
///     deadline (float | None): time after which Clarabel gives up [s].
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct Projector {
    model: Py<Model>,
    names: Vec<String>,
    sizes: (usize, usize),
    controllable: Vec<usize>,
    dt: f64,
    projectors: Mutex<Projectors>,
}

type Problem<'py> = (
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray1<f64>>,
);

#[pymethods]
impl Projector {
    #[new]
    #[pyo3(signature = (
        model, limits, dt, controllable=None, consistency="kinematic", solver="ladder", sub_steps=1, velocity_weight=None, braking="auto",
        deadline=None
    ))]
    fn new(
        py: Python<'_>,
        model: Py<Model>,
        limits: &Bound<'_, PyAny>,
        dt: &Bound<'_, PyAny>,
        #[pyo3(from_py_with = controllable_names)] controllable: Option<Vec<String>>,
        consistency: &str,
        solver: &str,
        #[pyo3(from_py_with = sub_steps)] sub_steps: u32,
        velocity_weight: Option<Vec<f64>>,
        braking: &str,
        deadline: Option<f64>,
    ) -> PyResult<Projector> {
        let robot = &model.get().model;
        let (consistency, solver) = (
            choice(
                "consistency",
                consistency,
                &[("kinematic", Consistency::Kinematic), ("free", Consistency::Free)],
            )?,
            choice("solver", solver, &[("ladder", Solver::Ladder), ("clarabel", Solver::Clarabel)])?,
        );
        let braking = choice(
            "braking",
            braking,
            &[("auto", Braking::Auto), ("certified", Braking::Certified), ("stored", Braking::Stored)],
        )?;
        let deadline = match deadline.map(Duration::try_from_secs_f64) {
            None => None,
            Some(Ok(deadline)) => Some(deadline),
            Some(Err(_)) => {
                return Err(errors::value("deadline is a time in seconds, at least 0; pass such a number"));
            }
        };
        let settings = Settings {
            consistency,
            solver,
            velocity_weight,
            braking,
            deadline,
            ..Settings::new(number("dt", dt)?, sub_steps)
        };
        let balls = match controllable {
            None => {
                robot.joints().iter().filter(|joint| joint.nv == 3).map(|joint| joint.name.clone()).collect()
            }
            Some(_) => Vec::new(),
        };
        let controllable = dofs(robot, controllable)?;
        let limits = limits::boxed(limits, robot)?;
        let dofs = controllable.clone();
        let mut projectors =
            py.detach(|| Projectors::new(robot, limits, dofs, settings)).map_err(errors::value)?;
        let first = projectors.first();
        let (names, dt) = (first.row_names(), first.settings().dt);
        robot.notes().iter().chain(first.notes()).try_for_each(|note| errors::warn(py, note))?;
        if !balls.is_empty() {
            let names = balls.join("', '");
            let text = format!(
                "joint '{names}' moves in three directions at once, as a ball joint does: no limit of joints holds it, and its proposals stay as they are; \
                 leave it out of controllable=[...] to say that this is meant"
            );
            errors::warn(py, &text)?;
        }
        let sizes = (robot.nq(), robot.nv());
        Ok(Projector { names, sizes, controllable, dt, projectors: Mutex::new(projectors), model })
    }

    /// The nearest next state to `(q_proposal, v_proposal)` from the state `(q, v)`.
    ///
    /// Where a brake is stored, a call goes on from the one before: it may execute the way to stop that was verified then. Take a projector for each
    /// robot, and `project_batch` for states that do not follow one another. Entries of joints that are not `controllable` are not held: propose
    /// what these joints do, or where they are at rest.
    ///
    /// Args:
    ///     q (nq): measured configuration [rad, m], Pinocchio's convention.
    ///     v (nv): measured velocity [rad/s, m/s].
    ///     q_proposal (nq): configuration wanted at the end of the period.
    ///     v_proposal (nv): velocity wanted at the end of the period.
    ///     previous: acceleration (nv) [rad/s²] and motor force (nv) [N m, N] of the tick before, `(target.acceleration, tau)`: without it,
    ///         limits on jerk and on the rate of torque do not hold in this tick; hard jerk does for joints that stand.
    ///
    /// Returns:
    ///     Target: `q` (nq), `v` (nv), `acceleration` (nv), and the ledger's fields (`status`, `active`, `moved`, ...).
    #[pyo3(signature = (q, v, q_proposal, v_proposal, previous=None))]
    fn project(
        &self,
        q: &Bound<'_, PyAny>,
        v: &Bound<'_, PyAny>,
        q_proposal: &Bound<'_, PyAny>,
        v_proposal: &Bound<'_, PyAny>,
        #[pyo3(from_py_with = pair)] previous: Option<(Bound<'_, PyAny>, Bound<'_, PyAny>)>,
    ) -> PyResult<Target> {
        let (state, py) = (self.state(q, v, q_proposal, v_proposal)?, q.py());
        let model = self.model.get();
        let before = match &previous {
            None => None,
            Some((a, tau)) => Some((model.v("previous acceleration", a)?, model.v("previous torque", tau)?)),
        };
        let target = self.with(py, |projector, model| {
            let mut target = constraints::Target::new(model);
            projector.set_previous(
                before.as_ref().map(|(acceleration, torque)| Previous { acceleration, torque }),
            );
            projector.project(&state.0, &state.1, &state.2, &mut target);
            target
        });
        Target::of(py, target, &self.names)
    }

    /// The same for n rows at once, q and q_proposal (n x nq) [rad or m], v and v_proposal (n x nv) [rad/s or m/s], on `threads` threads (all
    /// cores by default). The order of rows does not matter: each begins with no
    /// stored brake. Limits on jerk and on the rate of torque are refused: they need the tick before, which a batch does not have.
    #[pyo3(signature = (q, v, q_proposal, v_proposal, threads=None))]
    fn project_batch(
        &self,
        q: &Bound<'_, PyAny>,
        v: &Bound<'_, PyAny>,
        q_proposal: &Bound<'_, PyAny>,
        v_proposal: &Bound<'_, PyAny>,
        #[pyo3(from_py_with = threads)] threads: Option<usize>,
    ) -> PyResult<Targets> {
        self.refuse_previous(
            q.py(),
            "a batch",
            "call project(..., previous=(acceleration, torque)) row by row, or build a projector without it",
        )?;
        let (rows, _) = self.rows(q, v, q_proposal, v_proposal)?;
        let targets = q.py().detach(|| self.lock().project(&rows, threads)).map_err(errors::value)?;
        Ok(Targets { targets, names: self.names.clone(), sizes: self.sizes })
    }

    /// The problem of such a projection, for other solvers: `H, c, G, h, A, b` of `min 1/2 x'H x + c'x` s.t. `G x <= h` and
    /// `A x = b`, with x the changes `v' - v` of the controllable dofs, then a slack for each soft row: of n entries, m inequalities and e
    /// equalities, H (n x n), c (n), G (m x n), h (m), A (e x n), b (e). Cones are not in it. Limits on jerk and on the rate of torque are
    /// refused as in a batch.
    fn problem<'py>(
        &self,
        q: &Bound<'py, PyAny>,
        v: &Bound<'py, PyAny>,
        q_proposal: &Bound<'py, PyAny>,
        v_proposal: &Bound<'py, PyAny>,
    ) -> PyResult<Problem<'py>> {
        self.refuse_previous(q.py(), "problem()", "build a projector without it")?;
        let (state, py) = (self.state(q, v, q_proposal, v_proposal)?, q.py());
        let problem = self.with(py, |projector, model| {
            let memory = projector.memory();
            projector.forget();
            projector.project(&state.0, &state.1, &state.2, &mut constraints::Target::new(model));
            projector.set_memory(&memory);
            projector.problem()
        });
        let problem = problem.ok_or_else(|| {
            errors::value("this projector has no coupled rows, so a projection is a clamp of each dof; add a TorqueLimit for a problem")
        })?;
        let n = problem.n;
        Ok((
            array2(py, problem.hessian, n)?,
            array(py, &problem.c),
            array2(py, problem.g, n)?,
            array(py, &problem.h),
            array2(py, problem.a, n)?,
            array(py, &problem.b),
        ))
    }

    /// Vector-Jacobian products of n projections: for the derivatives `dq` (n x nv) and `dv` (n x nv) of a scalar with respect to the
    /// targets, those with respect to `q_proposal` and `v_proposal`. Configurations count in tangent space. Limits on jerk and on the rate
    /// of torque are refused as in `project_batch`.
    #[pyo3(signature = (q, v, q_proposal, v_proposal, dq, dv, threads=None))]
    #[expect(clippy::too_many_arguments, reason = "states, proposals and their derivatives")]
    fn vjp_batch<'py>(
        &self,
        q: &Bound<'py, PyAny>,
        v: &Bound<'py, PyAny>,
        q_proposal: &Bound<'py, PyAny>,
        v_proposal: &Bound<'py, PyAny>,
        dq: &Bound<'py, PyAny>,
        dv: &Bound<'py, PyAny>,
        #[pyo3(from_py_with = threads)] threads: Option<usize>,
    ) -> PyResult<Pair<'py>> {
        self.refuse_previous(q.py(), "a batch", "build a projector without it")?;
        let (rows, n) = self.rows(q, v, q_proposal, v_proposal)?;
        let nv = self.sizes.1;
        let (dq, dv) = (matrix("dq", dq, n, nv)?, matrix("dv", dv, n, nv)?);
        let py = q.py();
        let run = || self.lock().vjp(&rows, (&dq, &dv), threads);
        let (dq_proposal, dv_proposal) = py.detach(run).map_err(errors::value)?;
        Ok((array2(py, dq_proposal, nv)?, array2(py, dv_proposal, nv)?))
    }

    /// Switches every limit of that name on or off.
    fn set_enabled(&self, name: &str, on: bool) -> PyResult<()> {
        self.lock().all().iter_mut().try_for_each(|p| p.set_enabled(name, on)).map_err(errors::value)
    }

    /// Moves limits inside those of the build, or back towards them, for all projections to come; what is not named is as it was built. A
    /// state outside of what is asked for has the status "tightening": it goes there on the way that docs/LIMITS.md declares.
    ///
    /// Args:
    ///     speed (float): share of every limit on speed, in (0, 1]: of joints and frames; kinetic energy has its square.
    ///     velocity (float | array (nv) | dict): largest speed by joint [rad/s, m/s].
    ///     acceleration (float | array (nv) | dict): how fast a joint may speed up [rad/s², m/s²]; slowing down keeps that of the build.
    ///     lower (float | array (nv) | dict): lowest position [rad, m].
    ///     upper (float | array (nv) | dict): highest position [rad, m].
    ///     frame (dict): by the name of a FrameLimit, how far inside all its planes lie [m].
    ///     frame_speed (dict): by the name of a FrameSpeedLimit, largest speed [m/s].
    ///     energy (float): largest kinetic energy [J].
    ///     plane (dict): by the name of a FrameLimit with a half-space, where its plane lies: its normal (3) and a point of it (3) [m].
    ///     body (dict): by the name of an obstacle of a CollisionLimit, where it stands: position (3) [m], roll, pitch and yaw (3) [rad].
    ///
    /// Raises:
    ///     ValueError: a limit would be wider than it was built or leaves no room to stop; a name is unknown; a hard limit on frames, bodies or
    ///         energy without a stored brake; nothing is changed then.
    #[pyo3(signature = (
        *, speed=1.0, velocity=None, acceleration=None, lower=None, upper=None, frame=None, frame_speed=None, energy=None, plane=None,
        body=None
    ))]
    fn move_limits(
        &self,
        speed: f64,
        #[pyo3(from_py_with = limits::velocity)] velocity: Option<limits::Values>,
        #[pyo3(from_py_with = limits::acceleration)] acceleration: Option<limits::Values>,
        #[pyo3(from_py_with = limits::lower)] lower: Option<limits::Values>,
        #[pyo3(from_py_with = limits::upper)] upper: Option<limits::Values>,
        #[pyo3(from_py_with = limits::frame)] frame: limits::Named,
        #[pyo3(from_py_with = limits::frame_speed)] frame_speed: limits::Named,
        #[pyo3(from_py_with = limits::energy)] energy: Option<f64>,
        #[pyo3(from_py_with = limits::plane)] plane: limits::Places,
        #[pyo3(from_py_with = limits::body)] body: limits::Places,
    ) -> PyResult<()> {
        let joints = [velocity, acceleration, lower, upper];
        let moved = limits::moved(speed, joints, [frame, frame_speed], energy, [plane, body]);
        self.lock().all().iter_mut().try_for_each(|p| p.move_limits(&moved)).map_err(errors::value)
    }

    /// Names of the limits and whether they hold.
    #[getter]
    fn enabled<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let out = PyDict::new(py);
        self.lock().first().enabled().try_for_each(|(name, on)| out.set_item(name, on))?;
        Ok(out)
    }

    /// Forces on the robot beside its motors, as generalised forces `J'f` (nv), for all projections to come: contact forces.
    fn set_external_forces(&self, forces: &Bound<'_, PyAny>) -> PyResult<()> {
        let forces = self.model.get().v("forces", forces)?;
        self.lock().all().iter_mut().try_for_each(|p| p.set_external_forces(&forces)).map_err(errors::value)
    }

    /// What the rows of a ledger's `active` are of: dofs, then coupled rows.
    #[getter]
    fn row_names(&self) -> Vec<String> {
        self.names.clone()
    }

    /// Names of the dofs the projector may move.
    #[getter]
    fn controllable(&self) -> Vec<&str> {
        self.controllable.iter().map(|i| self.names[*i].as_str()).collect()
    }

    /// Control period [s].
    #[getter]
    fn dt(&self) -> f64 {
        self.dt
    }

    /// The robot.
    #[getter]
    fn model(&self, py: Python<'_>) -> Py<Model> {
        self.model.clone_ref(py)
    }

    fn __repr__(&self) -> String {
        format!(
            "Projector(dt={}, controllable={:?}, limits={:?})",
            self.dt,
            self.controllable(),
            self.lock().limits()
        )
    }
}

type State = (Vec<f64>, Vec<f64>, Proposal);

impl Projector {
    fn state(
        &self,
        q: &Bound<'_, PyAny>,
        v: &Bound<'_, PyAny>,
        q_proposal: &Bound<'_, PyAny>,
        v_proposal: &Bound<'_, PyAny>,
    ) -> PyResult<State> {
        let model = self.model.get();
        let proposal =
            Proposal { q: model.q("q_proposal", q_proposal)?, v: model.v("v_proposal", v_proposal)? };
        let q = model.q("q", q)?;
        for (name, of) in [("q", &q), ("q_proposal", &proposal.q)] {
            model.model.check_configuration(of).map_err(|e| errors::value(format!("{name}: {e}")))?;
        }
        Ok((q, model.v("v", v)?, proposal))
    }

    /// Refuses limits that need the tick before, for `whom` without it.
    fn refuse_previous(&self, py: Python<'_>, whom: &str, next: &str) -> PyResult<()> {
        match self.with(py, |projector, _| projector.needs_previous()) {
            true => Err(errors::value(format!(
                "a limit on jerk or on the rate of torque needs the tick before, which {whom} does not have; {next}"
            ))),
            false => Ok(()),
        }
    }

    fn with<R: Send>(
        &self,
        py: Python<'_>,
        f: impl FnOnce(&mut constraints::Projector, &constraints::Model) -> R + Send,
    ) -> R {
        let model = &self.model.get().model;
        py.detach(|| f(self.lock().first(), model))
    }

    fn lock(&self) -> MutexGuard<'_, Projectors> {
        self.projectors.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn rows(
        &self,
        q: &Bound<'_, PyAny>,
        v: &Bound<'_, PyAny>,
        q_proposal: &Bound<'_, PyAny>,
        v_proposal: &Bound<'_, PyAny>,
    ) -> PyResult<(Rows, usize)> {
        let (nq, nv) = self.sizes;
        let (q, n) = rows("q", q, nq)?;
        let rows = Rows {
            q,
            v: matrix("v", v, n, nv)?,
            q_proposal: matrix("q_proposal", q_proposal, n, nq)?,
            v_proposal: matrix("v_proposal", v_proposal, n, nv)?,
        };
        for (name, of) in [("q", &rows.q), ("q_proposal", &rows.q_proposal)] {
            for (row, of) in of.chunks_exact(nq.max(1)).enumerate() {
                let checked = self.model.get().model.check_configuration(of);
                checked.map_err(|e| errors::value(format!("{name}[{row}]: {e}")))?;
            }
        }
        Ok((rows, n))
    }
}

fn controllable_names(value: &Bound<'_, PyAny>) -> PyResult<Option<Vec<String>>> {
    if value.is_none() { Ok(None) } else { joint_names("controllable", value).map(Some) }
}

fn threads(value: &Bound<'_, PyAny>) -> PyResult<Option<usize>> {
    if value.is_none() { Ok(None) } else { whole("threads", value, 1).map(|n| Some(n as usize)) }
}

fn pair<'py>(value: &Bound<'py, PyAny>) -> PyResult<Option<(Bound<'py, PyAny>, Bound<'py, PyAny>)>> {
    value.extract().map_err(|_| {
        errors::value("previous is no pair; give the acceleration and the motor force of the tick before: previous=(target.acceleration, tau)")
    })
}

/// Two matrices.
type Pair<'py> = (Bound<'py, PyArray2<f64>>, Bound<'py, PyArray2<f64>>);

/// Degrees of freedom of the joints named; all joints with one position and one velocity entry when none are named.
fn dofs(model: &constraints::Model, names: Option<Vec<String>>) -> PyResult<Vec<usize>> {
    match names {
        None => Ok(model.joints().iter().filter(|j| j.nv == 1).map(|j| j.idx_v).collect()),
        Some(names) => names
            .iter()
            .map(|name| {
                let joint = model.joint(name).map_err(errors::model)?;
                match joint.nv {
                    1 => Ok(joint.idx_v),
                    n => Err(errors::value(format!(
                        "controllable names joint '{name}', which has {n} degrees of freedom; name joints with one"
                    ))),
                }
            })
            .collect(),
    }
}

fn choice<T: Copy>(what: &str, given: &str, known: &[(&str, T)]) -> PyResult<T> {
    match known.iter().find(|(name, _)| *name == given) {
        Some((_, value)) => Ok(*value),
        None => {
            let names: Vec<String> = known.iter().map(|(name, _)| format!("\"{name}\"")).collect();
            Err(errors::value(format!("{what} is \"{given}\"; use {}", names.join(" or "))))
        }
    }
}
