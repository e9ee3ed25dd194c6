//! The projector: the nearest next state that every limit allows.

use std::sync::{Mutex, PoisonError};

use nearl_constraints::{self as constraints, Consistency, Proposal, Settings, Solver};
use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;

use crate::arrays::{array, array2, matrix, rows};
use crate::errors;
use crate::limits;
use crate::model::Model;
use crate::target::{Target, Targets};

/// Projects proposed next states. Safe to share between threads; projections of one object then wait for each other.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct Projector {
    model: Py<Model>,
    names: Vec<String>,
    sizes: (usize, usize),
    controllable: Vec<usize>,
    settings: Settings,
    limits: Vec<Box<dyn constraints::Limit>>,
    /// One for single projections and one more for each further thread of a batch.
    projectors: Mutex<Vec<constraints::Projector>>,
}

type Problem<'py> = (
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray1<f64>>,
);

#[pymethods]
impl Projector {
    #[new]
    #[pyo3(signature = (model, limits, dt, controllable=None, consistency="kinematic", solver="ladder", sub_steps=1, velocity_weight=None))]
    fn new(
        py: Python<'_>,
        model: Py<Model>,
        limits: Vec<Bound<'_, PyAny>>,
        dt: f64,
        controllable: Option<Vec<String>>,
        consistency: &str,
        solver: &str,
        sub_steps: u32,
        velocity_weight: Option<Vec<f64>>,
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
        let settings = Settings { consistency, solver, velocity_weight, ..Settings::new(dt, sub_steps) };
        let controllable = dofs(robot, controllable)?;
        let limits = limits::boxed(&limits)?;
        let first = py
            .detach(|| constraints::Projector::new(robot, &limits, &controllable, settings.clone()))
            .map_err(errors::value)?;
        let names = first.row_names();
        let sizes = (robot.nq(), robot.nv());
        Ok(Projector {
            names,
            sizes,
            controllable,
            settings,
            limits,
            projectors: Mutex::new(vec![first]),
            model,
        })
    }

    /// The nearest next state to `(q_proposal, v_proposal)` from the state `(q, v)`.
    fn project(
        &self,
        q: &Bound<'_, PyAny>,
        v: &Bound<'_, PyAny>,
        q_proposal: &Bound<'_, PyAny>,
        v_proposal: &Bound<'_, PyAny>,
    ) -> PyResult<Target> {
        let (state, py) = (self.state(q, v, q_proposal, v_proposal)?, q.py());
        let target = self.with(py, |projector, model| {
            let mut target = constraints::Target::new(model);
            projector.project(&state.0, &state.1, &state.2, &mut target);
            target
        });
        Target::of(py, target, &self.names)
    }

    /// The same for n rows at once, on `threads` threads (all cores by default). The order of rows does not matter.
    #[pyo3(signature = (q, v, q_proposal, v_proposal, threads=None))]
    fn project_batch(
        &self,
        q: &Bound<'_, PyAny>,
        v: &Bound<'_, PyAny>,
        q_proposal: &Bound<'_, PyAny>,
        v_proposal: &Bound<'_, PyAny>,
        threads: Option<usize>,
    ) -> PyResult<Targets> {
        let (nq, nv) = self.sizes;
        let (q_, n) = rows("q", q, nq)?;
        let batch = Batch {
            sizes: self.sizes,
            q: q_,
            v: matrix("v", v, n, nv)?,
            q_proposal: matrix("q_proposal", q_proposal, n, nq)?,
            v_proposal: matrix("v_proposal", v_proposal, n, nv)?,
        };
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let threads = threads.unwrap_or(cores).clamp(1, n.max(1));
        let targets = q.py().detach(|| self.batch(&batch, n, threads)).map_err(errors::value)?;
        Ok(Targets { targets, names: self.names.clone(), sizes: self.sizes })
    }

    /// The problem of such a projection, for other solvers: `H, c, G, h` of `min 1/2 y'H y + c'y` s.t. `G y <= h`, with
    /// `y = v' - v` of the controllable dofs.
    fn problem<'py>(
        &self,
        q: &Bound<'py, PyAny>,
        v: &Bound<'py, PyAny>,
        q_proposal: &Bound<'py, PyAny>,
        v_proposal: &Bound<'py, PyAny>,
    ) -> PyResult<Problem<'py>> {
        let (state, py) = (self.state(q, v, q_proposal, v_proposal)?, q.py());
        let problem = self.with(py, |projector, model| {
            projector.project(&state.0, &state.1, &state.2, &mut constraints::Target::new(model));
            projector.problem()
        });
        let problem = problem.ok_or_else(|| {
            errors::value("this projector has no coupled rows, so a projection is a clamp of each dof; add a TorqueLimit for a problem")
        })?;
        let n = problem.c.len();
        Ok((
            array2(py, problem.hessian, n)?,
            array(py, &problem.c),
            array2(py, problem.g, n)?,
            array(py, &problem.h),
        ))
    }

    /// Names of the dofs the projector may move.
    #[getter]
    fn controllable(&self) -> Vec<&str> {
        self.controllable.iter().map(|i| self.names[*i].as_str()).collect()
    }

    /// Control period [s].
    #[getter]
    fn dt(&self) -> f64 {
        self.settings.dt
    }

    /// The robot.
    #[getter]
    fn model(&self, py: Python<'_>) -> Py<Model> {
        self.model.clone_ref(py)
    }

    fn __repr__(&self) -> String {
        format!(
            "Projector(dt={}, controllable={:?}, limits={:?})",
            self.settings.dt,
            self.controllable(),
            self.limits
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
        Ok((model.q("q", q)?, model.v("v", v)?, proposal))
    }

    fn with<R: Send>(
        &self,
        py: Python<'_>,
        f: impl FnOnce(&mut constraints::Projector, &constraints::Model) -> R + Send,
    ) -> R {
        let model = &self.model.get().model;
        py.detach(|| f(&mut self.projectors.lock().unwrap_or_else(PoisonError::into_inner)[0], model))
    }

    fn batch(
        &self,
        batch: &Batch,
        n: usize,
        threads: usize,
    ) -> Result<Vec<constraints::Target>, constraints::LimitError> {
        let model = &self.model.get().model;
        let mut projectors = self.projectors.lock().unwrap_or_else(PoisonError::into_inner);
        while projectors.len() < threads {
            projectors.push(constraints::Projector::new(
                model,
                &self.limits,
                &self.controllable,
                self.settings.clone(),
            )?);
        }
        let mut targets = vec![constraints::Target::new(model); n];
        let size = n.div_ceil(threads).max(1);
        std::thread::scope(|scope| {
            for ((i, chunk), projector) in targets.chunks_mut(size).enumerate().zip(projectors.iter_mut()) {
                scope.spawn(move || batch.project(i * size, projector, chunk));
            }
        });
        Ok(targets)
    }
}

/// States and proposals, row by row.
struct Batch {
    sizes: (usize, usize),
    q: Vec<f64>,
    v: Vec<f64>,
    q_proposal: Vec<f64>,
    v_proposal: Vec<f64>,
}

impl Batch {
    fn project(
        &self,
        first: usize,
        projector: &mut constraints::Projector,
        targets: &mut [constraints::Target],
    ) {
        let (nq, nv) = self.sizes;
        let mut proposal = Proposal { q: vec![0.0; nq], v: vec![0.0; nv] };
        for (i, target) in (first..).zip(targets) {
            proposal.q.copy_from_slice(&self.q_proposal[i * nq..][..nq]);
            proposal.v.copy_from_slice(&self.v_proposal[i * nv..][..nv]);
            projector.project(&self.q[i * nq..][..nq], &self.v[i * nv..][..nv], &proposal, target);
        }
    }
}

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
