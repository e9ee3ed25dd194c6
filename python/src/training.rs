//! A training in this process.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use nearl_trainer::checkpoint::{self, Checkpoint};
use nearl_trainer::env::Step;
use nearl_trainer::learn::ALGORITHMS;
use nearl_trainer::preset::Preset;
use nearl_trainer::ranks::{Ranks, from_first};
use nearl_trainer::rollout::Scorer;
use nearl_trainer::run_folder::{self, RunFolder};
use nearl_trainer::tasks;
use nearl_trainer::train::{self, Experience, Request, TrainError, complete};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays;
use crate::controller::Controller;
use crate::{errors, ranks};

/// Names of the algorithms, in the paper's order, with a line about each.
#[pyfunction]
pub(crate) fn algorithms() -> Vec<(&'static str, &'static str)> {
    ALGORITHMS.iter().map(|e| (e.name, e.about)).collect()
}

struct Inner {
    training: train::Training,
    /// Between `begin` and `end`.
    learns: bool,
    /// Open meanwhile.
    folder: Option<RunFolder>,
}

/// The Rust trainer, one iteration at a time (see `nearl.PID2`).
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct Training {
    inner: Mutex<Inner>,
    task: String,
    out: Option<PathBuf>,
    raised: Raised,
}

/// What a function of the caller raised first.
type Raised = Arc<Mutex<Option<PyErr>>>;

/// Environments of this process; with `scorer(obs, action, next_obs)` (1 x n each), which gives a reward or None and whether the episode ends,
/// these take the task's place. `rewards`: it gives rewards. With `ranks` those of the other ranks too.
fn experience(
    scorer: Option<Py<PyAny>>,
    rewards: bool,
    ranks: Option<&Arc<Ranks>>,
) -> PyResult<(Experience, Raised)> {
    let raised = Raised::default();
    let scorer = match (scorer, ranks) {
        (None, None) => return Ok((Experience::Here, raised)),
        (None, Some(ranks)) => return Ok((Experience::Ranks(Arc::clone(ranks)), raised)),
        (Some(scorer), None) => scorer,
        (Some(_), Some(_)) => {
            return Err(errors::value(
                "reward and termination are functions of one process, and ranks are several; write them into the task file, or leave ranks out",
            ));
        }
    };
    let kept = Arc::clone(&raised);
    let scorer = Scorer::new(rewards, move |obs, action, next_obs, step| {
        let asked = Python::attach(|py| {
            let row = |x: &[f64]| arrays::array2(py, x.to_vec(), x.len());
            scorer.call1(py, (row(obs)?, row(action)?, row(next_obs)?))?.extract::<(Option<f64>, bool)>(py)
        });
        match asked {
            Ok((reward, ends)) => {
                Step { reward: reward.unwrap_or(step.reward), terminated: step.terminated || ends, ..step }
            }
            Err(error) => {
                kept.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
                Step { reward: f64::NAN, terminated: true, ..step }
            }
        }
    });
    Ok((Experience::Scored(scorer), raised))
}

#[pymethods]
impl Training {
    /// `settings`: overrides of the task file, `key=value`, after those of `preset`. `out`: run folder to write, as `nearl train` does.
    /// `ranks`: those of a training on several hosts. `start_from`: run folder whose networks it starts from.
    #[new]
    #[pyo3(signature = (task, algo, seed, threads, settings, out, preset=None, scorer=None, rewards=false, ranks=None, start_from=None))]
    fn new(
        py: Python<'_>,
        task: &str,
        algo: &str,
        seed: u64,
        threads: usize,
        settings: Vec<String>,
        out: Option<PathBuf>,
        preset: Option<String>,
        scorer: Option<Py<PyAny>>,
        rewards: bool,
        ranks: Option<Py<PyAny>>,
        start_from: Option<PathBuf>,
    ) -> PyResult<Training> {
        let ranks = ranks::read(py, ranks)?;
        py.detach(|| {
            let (experience, raised) = experience(scorer, rewards, ranks.as_ref())?;
            let preset = preset
                .map(|name| name.parse::<Preset>())
                .transpose()
                .map_err(|e| errors::value(e.to_string()))?;
            let mut manifest = tasks::load_with(task, preset, &settings).map_err(errors::task)?;
            complete(&mut manifest).map_err(errors::train)?;
            let algo = algo.parse().map_err(|e| errors::train(TrainError::Algorithm(e)))?;
            let request = Request { manifest, algo, steps: 0, seed, threads: threads.max(1) };
            let training = match &start_from {
                Some(run) => train::Training::start_from(&request, &experience, run),
                None => train::Training::on(&request, &experience),
            };
            let training = training.map_err(errors::train)?;
            let mut advice = train::advice(algo, &request.manifest).map_err(errors::train)?;
            advice.extend(train::unread(&[algo], &settings));
            if let Some(out) = &out {
                let (manifest, columns) = (&training.snapshot().manifest, training.columns());
                RunFolder::create(out, manifest, seed, &columns, training.origin()).map_err(run)?;
            }
            Ok((Training::of(training, out, raised), advice))
        })
        .and_then(|(training, advice)| {
            advice.iter().try_for_each(|line| errors::warn(py, line))?;
            Ok(training)
        })
    }

    /// The training of a run folder where it stopped, to go on in it. Of several ranks, the first alone reads and writes the folder.
    #[staticmethod]
    #[pyo3(signature = (path, threads, scorer=None, rewards=false, ranks=None))]
    fn resume(
        py: Python<'_>,
        path: PathBuf,
        threads: usize,
        scorer: Option<Py<PyAny>>,
        rewards: bool,
        ranks: Option<Py<PyAny>>,
    ) -> PyResult<Training> {
        let ranks = ranks::read(py, ranks)?;
        py.detach(|| {
            let (experience, raised) = experience(scorer, rewards, ranks.as_ref())?;
            let file = checkpoint::path_in(&path);
            let load = || Checkpoint::load(&file).map_err(|e| errors::train(e.into()));
            let (from, out) = match &ranks {
                None => (load()?, Some(path.clone())),
                Some(ranks) => {
                    let first = ranks.rank() == 0;
                    let own = if first { load()?.to_bytes() } else { Vec::new() };
                    let bytes = from_first(ranks, own).map_err(|e| errors::value(e.to_string()))?;
                    let from = Checkpoint::from_bytes(&format!("{} of rank 0", file.display()), &bytes);
                    (from.map_err(|e| errors::train(e.into()))?, first.then(|| path.clone()))
                }
            };
            let training = train::Training::resume_on(from, &file, &experience, None, threads.max(1));
            Ok(Training::of(training.map_err(errors::train)?, out, raised))
        })
    }

    /// Asks for `steps` more, at whose end the learning rate falls to zero, and holds the run folder until `end`. What there is to warn of:
    /// that they end before a reward, or a demonstration, is read.
    fn begin(&self, py: Python<'_>, steps: u64) -> PyResult<Option<String>> {
        py.detach(|| {
            let mut inner = self.lock();
            if inner.learns {
                return Err(errors::value("this agent is learning already, in another thread or around this callback; wait for its end"));
            }
            let manifest = &inner.training.snapshot().manifest;
            let algo = manifest.algo.parse().map_err(|e| errors::train(TrainError::Algorithm(e)))?;
            let warning = match inner.training.starts_warm() {
                true => None,
                false => train::ends_in_warm_up(algo, manifest.steps.saturating_add(steps), manifest)
                    .map_err(errors::train)?,
            };
            if let Some(out) = &self.out {
                let held = run_folder::lock(out).map_err(run)?;
                let file = checkpoint::path_in(out);
                let further = |c: &Checkpoint| c.header.manifest.steps > manifest.steps;
                if file.exists()
                    && further(&Checkpoint::load(&file).map_err(|e| errors::train(e.into()))?)
                {
                    return Err(errors::value(format!(
                        "the run in '{}' has gone on since this agent was made or loaded, at {} steps; load it again with \
                         PID2.load, or give another folder with run=",
                        out.display(),
                        manifest.steps
                    )));
                }
                let (steps, version) = (manifest.steps, manifest.version);
                let folder = RunFolder::reopen(out, held, &inner.training.columns(), steps, version);
                inner.folder = Some(folder.map_err(run)?);
            }
            inner.training.extend(steps);
            inner.learns = true;
            Ok(warning)
        })
    }

    /// Collects and learns once; metrics by column, those that exist.
    fn iterate<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let row = py.detach(|| {
            let mut inner = self.lock();
            let Inner { training, folder, .. } = &mut *inner;
            let progress = match folder {
                Some(folder) => training.iterate_in(folder),
                None => training.try_iterate(),
            };
            // What a function of the caller raised says more than what came of it.
            if let Some(raised) = self.raised.lock().unwrap_or_else(PoisonError::into_inner).take() {
                return Err(raised);
            }
            let stopped = || errors::value("the source of experience was stopped");
            let progress = progress.map_err(errors::train)?.ok_or_else(stopped)?;
            let columns: Vec<String> = training.columns().into_iter().map(str::to_owned).collect();
            Ok::<_, PyErr>(columns.into_iter().zip(training.row(&progress)).collect::<Vec<_>>())
        })?;
        let metrics = PyDict::new(py);
        for (name, value) in row.into_iter().filter(|(_, value)| value.is_finite()) {
            metrics.set_item(name, value)?;
        }
        Ok(metrics)
    }

    /// Writes snapshot and checkpoint, and leaves the run folder to others; nothing where there is none.
    fn end(&self, py: Python<'_>) -> PyResult<()> {
        py.detach(|| {
            let mut inner = self.lock();
            inner.learns = false;
            let Some(mut folder) = inner.folder.take() else { return Ok(()) };
            inner.training.save(&mut folder).map(drop).map_err(errors::train)
        })
    }

    /// A controller with what was learned so far.
    fn controller(&self, py: Python<'_>) -> PyResult<Controller> {
        py.detach(|| Controller::new(self.lock().training.snapshot()))
    }

    /// Whether the steps asked for are done.
    #[getter]
    fn done(&self) -> bool {
        self.lock().training.is_done()
    }

    /// Environment steps so far.
    #[getter]
    fn steps(&self) -> u64 {
        self.lock().training.snapshot().manifest.steps
    }

    /// Name of the task.
    #[getter]
    fn task(&self) -> &str {
        &self.task
    }
}

impl Training {
    fn of(training: train::Training, out: Option<PathBuf>, raised: Raised) -> Training {
        let task = training.snapshot().manifest.task.name.clone();
        Training { inner: Mutex::new(Inner { training, learns: false, folder: None }), task, out, raised }
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn run(error: run_folder::RunError) -> PyErr {
    errors::train(TrainError::Run(error))
}
