//! The Python that draws reports and videos, and the commands that are Python.

use super::Failure;
use clap::Args;
use std::ffi::{OsStr, OsString};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// What is handed on to a module of the Python package, `--help` too.
#[derive(Args)]
pub(super) struct InPython {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGUMENTS")]
    arguments: Vec<OsString>,
}

impl InPython {
    /// Becomes `-m MODULE`.
    ///
    /// # Errors
    /// No Python has the package.
    pub(super) fn run(self, module: &str) -> Result<(), Failure> {
        let python = Python::of(None).0;
        let is_there = "import importlib.util, sys; sys.exit(importlib.util.find_spec('nearl') is None)";
        let found = Command::new(&python).args(["-c", is_there]).stderr(Stdio::null()).status();
        let why = match found {
            Ok(status) if status.success() => {
                Command::new(&python).args(["-m", module]).args(self.arguments).exec().to_string()
            }
            Ok(_) => "the Python package 'nearl' is not in it".into(),
            Err(e) => e.to_string(),
        };
        Err(format!(
            "'{}' cannot run {module}: {why}; 'make package' installs the package into .venv of a checkout, or say with NEARL_PYTHON which \
             Python has it",
            python.display()
        )
        .into())
    }
}

/// A Python in which the package `nearl` is installed.
pub(super) struct Python(PathBuf);

impl Python {
    /// `given`; by default that of the package this command came with, else `.venv/bin/python`, else `python3`.
    pub(super) fn of(given: Option<&Path>) -> Python {
        let venv = || Some(PathBuf::from(".venv/bin/python")).filter(|python| python.exists());
        let package = || std::env::var_os("NEARL_PYTHON").map(PathBuf::from);
        let given = given.map(Path::to_path_buf);
        Python(given.or_else(package).or_else(venv).unwrap_or_else(|| "python3".into()))
    }

    /// Runs `-m MODULE ARGUMENTS` to its end.
    ///
    /// # Errors
    /// It cannot be started, or failed; with its last line.
    pub(super) fn module<S: AsRef<OsStr>>(&self, module: &str, arguments: &[S]) -> Result<(), Failure> {
        let python = self.0.display();
        let mut command = Command::new(&self.0);
        let run = command.args(["-m", module]).args(arguments).output();
        let run = run.map_err(|e| {
            format!("cannot start '{python}': {e}; say with NEARL_PYTHON where the package is")
        })?;
        if run.status.success() {
            return Ok(());
        }
        let why = String::from_utf8_lossy(&run.stderr);
        let last = why.trim().lines().last().unwrap_or("no message");
        Err(format!(
            "'{python} -m {module}' failed: {last}; install the package with 'make package', or say with NEARL_PYTHON where it is"
        )
        .into())
    }
}
