//! Policies made elsewhere.

use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

use nearl_runtime::net::{Dense, DenseLayer, Forward, Function};
use nearl_runtime::normaliser::Normaliser;
use nearl_trainer::import::{Gives, ImportedNetwork, Setting, for_task, read, snapshot};
use nearl_trainer::{blank, tasks};
use numpy::PyArray1;
use pyo3::prelude::*;

use crate::arrays::{array, matrix, vector};
use crate::controller::Controller;
use crate::errors;

/// One recipe file or several.
#[derive(FromPyObject)]
enum Recipes {
    One(PathBuf),
    Several(Vec<PathBuf>),
}

/// The networks of a policy made elsewhere: `clip(net(clip((obs - mean) / std)))`.
#[pyclass(module = "nearl._core", frozen)]
pub(crate) struct Policy {
    network: ImportedNetwork,
    run: Mutex<(Normaliser, Forward, Vec<f32>)>,
}

/// Weight (n_out x n_in), bias (n_out), and the name of what follows.
type LayerIn<'py> = (Bound<'py, PyAny>, Bound<'py, PyAny>, String);

#[pymethods]
impl Policy {
    /// Reads an ONNX file; `output` names the action where there are several outputs.
    #[staticmethod]
    #[pyo3(signature = (path, output=None))]
    fn from_onnx(py: Python<'_>, path: PathBuf, output: Option<String>) -> PyResult<Policy> {
        let network = py.detach(|| read(&path, output.as_deref())).map_err(errors::value)?;
        Ok(Policy::of(network))
    }

    /// Layers as arrays, first to last: weight (n_out x n_in), bias (n_out) and the function that follows. `mean` and `std` (n_in) are those of
    /// the observation; `clip` holds the lowest and highest network input, `output_clip` the lowest and highest
    /// output, one number or one for each (n_out).
    #[staticmethod]
    fn from_layers<'py>(
        layers: Vec<LayerIn<'py>>,
        mean: &Bound<'py, PyAny>,
        std: &Bound<'py, PyAny>,
        clip: (f64, f64),
        output_clip: (Bound<'py, PyAny>, Bound<'py, PyAny>),
    ) -> PyResult<Policy> {
        let mut dense = Dense::default();
        let mut functions = Vec::new();
        for (i, (weight, bias, function)) in layers.iter().enumerate() {
            let (n_out, n_in) = (bias.len()?, weight.get_item(0)?.len()?);
            let f32s = |x: Vec<f64>| x.into_iter().map(|x| x as f32).collect::<Vec<f32>>();
            let weight = f32s(matrix(&format!("weight of layer {i}"), weight, n_out, n_in)?);
            let bias = f32s(vector(&format!("bias of layer {i}"), bias, n_out)?);
            if dense.layers.last().is_some_and(|before| before.n_out != n_in) {
                return Err(errors::value(format!(
                    "layer {i} takes {n_in} entries where {} come",
                    dense.n_out()
                )));
            }
            dense.layers.push(DenseLayer { n_in, n_out, weight, bias });
            functions.push(function_of(function)?);
        }
        let (n_in, n_out) = (dense.n_in(), dense.n_out());
        if n_in == 0 || n_out == 0 {
            return Err(errors::value(
                "the policy has no layers; give at least one (weight, bias, function)",
            ));
        }
        let side = |name: &str, end: &Bound<'py, PyAny>| match end.extract::<f64>() {
            Ok(one) => Ok(vec![one; n_out]),
            Err(_) => vector(name, end, n_out),
        };
        let lower = side("output_clip[0]", &output_clip.0)?;
        let upper = side("output_clip[1]", &output_clip.1)?;
        Ok(Policy::of(ImportedNetwork {
            mean: vector("mean", mean, n_in)?,
            std: vector("std", std, n_in)?,
            clip: vec![[clip.0, clip.1]; n_in],
            output: lower.into_iter().zip(upper).map(|(lower, upper)| [lower, upper]).collect(),
            input_name: "obs".into(),
            output_name: "actions".into(),
            metadata: Default::default(),
            dense,
            functions,
        }))
    }

    /// The policy's output (n_out) for an observation (n_in), before scale and offset.
    fn __call__<'py>(&self, obs: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let py = obs.py();
        let obs = vector("obs", obs, self.network.n_in())?;
        let mut run = self.run.lock().unwrap_or_else(PoisonError::into_inner);
        let (normaliser, forward, x) = &mut *run;
        normaliser.observation(&obs, x);
        let y = forward.forward(x).iter().zip(&self.network.output);
        let y: Vec<f64> = y.map(|(y, [l, u])| f64::from(*y).max(*l).min(*u)).collect();
        Ok(array(py, &y))
    }

    /// The controller of the policy on a robot; `recipe` is a file, TOML or unitree's `deploy.yaml`, that says what it sees and what its
    /// outputs mean, or several, of which a later one comes before those before it.
    #[pyo3(signature = (robot, recipe=None, name="policy"))]
    fn controller(
        &self,
        py: Python<'_>,
        robot: PathBuf,
        recipe: Option<Recipes>,
        name: &str,
    ) -> PyResult<Controller> {
        let recipes = match recipe {
            None => Vec::new(),
            Some(Recipes::One(file)) => vec![file],
            Some(Recipes::Several(files)) => files,
        };
        let setting = Setting { name, robot: &robot, recipes: &recipes };
        let made = py.detach(|| snapshot(&self.network, &setting)).map_err(errors::value)?;
        Controller::new(&made)
    }

    /// The controller of the policy in a task that says what it observes; `actions` is what the policy gives: "actuators", "state" or "change".
    #[pyo3(signature = (task, settings=vec![], actions="actuators"))]
    fn in_task(
        &self,
        py: Python<'_>,
        task: &str,
        settings: Vec<String>,
        actions: &str,
    ) -> PyResult<Controller> {
        let gives = Gives::named(actions).map_err(errors::value)?;
        let made = py.detach(|| {
            let mut manifest = tasks::load(task, &settings).map_err(errors::task)?;
            blank::complete(&mut manifest).map_err(errors::vector)?;
            for_task(&self.network, manifest, gives).map_err(errors::value)
        })?;
        Controller::new(&made)
    }

    /// Inputs.
    #[getter]
    fn n_in(&self) -> usize {
        self.network.n_in()
    }

    /// Outputs.
    #[getter]
    fn n_out(&self) -> usize {
        self.network.n_out()
    }

    /// What follows each layer.
    #[getter]
    fn functions(&self) -> Vec<String> {
        self.network.functions.iter().map(|f| format!("{f:?}").to_lowercase()).collect()
    }

    /// Metadata of the file.
    #[getter]
    fn metadata(&self) -> std::collections::BTreeMap<String, String> {
        self.network.metadata.clone()
    }
}

impl Policy {
    fn of(network: ImportedNetwork) -> Policy {
        let clip = network.clip.clone();
        let normaliser =
            Normaliser { mean: network.mean.clone(), std: network.std.clone(), scale: Vec::new(), clip };
        let forward = Forward::layered(&network.dense, network.functions.clone());
        let x = vec![0.0; network.n_in()];
        Policy { network, run: Mutex::new((normaliser, forward, x)) }
    }
}

fn function_of(name: &str) -> PyResult<Function> {
    let known = Function::ALL.into_iter().find(|f| format!("{f:?}").to_lowercase() == name);
    known.ok_or_else(|| {
        let all: Vec<String> = Function::ALL.iter().map(|f| format!("{f:?}").to_lowercase()).collect();
        errors::value(format!("'{name}' is no function of a layer; they are {}", all.join(", ")))
    })
}
