//! The extension module `nearl._core`: Rust objects for Python, nothing computed here.
//!
//! Arrays come in as anything NumPy accepts and go out as float64. Whatever takes longer than a few microseconds runs with
//! the interpreter released. Errors are the Rust sentence: `OSError` for files that cannot be read, `ValueError` otherwise.

mod arrays;
mod controller;
mod env;
mod errors;
mod limits;
mod link;
mod loop_link;
mod model;
mod nearest;
mod plant;
mod policy;
mod projector;
mod proposer;
mod ranks;
mod target;
mod training;
mod vec_env;
mod view_link;

use pyo3::prelude::*;

#[pymodule]
mod _core {
    #[pymodule_export]
    use super::controller::Controller;
    #[pymodule_export]
    use super::env::{Env, max_episode_steps, tasks};
    #[pymodule_export]
    use super::link::{RolloutClient, Rollouts, rollout_ledger};
    #[pymodule_export]
    use super::loop_link::{LoopClient, loop_modes};
    #[pymodule_export]
    use super::model::{Model, makes_euler_steps};
    #[pymodule_export]
    use super::nearest::{ActionSearch, nearest_action};
    #[pymodule_export]
    use super::plant::{LoopThread, Plant};
    #[pymodule_export]
    use super::policy::Policy;
    #[pymodule_export]
    use super::projector::Projector;
    #[pymodule_export]
    use super::proposer::{ProposerClient, blank};
    #[pymodule_export]
    use super::target::{Ledger, Target, Targets};
    #[pymodule_export]
    use super::training::{Training, algorithms};
    #[pymodule_export]
    use super::vec_env::VecEnv;
    #[pymodule_export]
    use super::view_link::ViewClient;

    use pyo3::prelude::*;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        super::limits::add_to(module)
    }

    /// Version of the package.
    #[pymodule_export]
    #[allow(non_upper_case_globals)]
    const __version__: &str = env!("CARGO_PKG_VERSION");
}
