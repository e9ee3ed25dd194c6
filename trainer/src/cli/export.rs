//! `nearl export`: the policy of a snapshot as an ONNX file.

use super::{Failure, say};
use crate::export::onnx;
use clap::Args;
use nearl_runtime::Snapshot;
use nearl_runtime::snapshot::{in_run, write_whole};
use std::path::PathBuf;

#[derive(Args)]
pub(super) struct Export {
    /// Run folder or snapshot file.
    snapshot: PathBuf,
    /// Where the ONNX file goes.
    #[arg(long)]
    out: PathBuf,
}

impl Export {
    pub(super) fn run(self) -> Result<(), Failure> {
        let snapshot = Snapshot::load(&in_run(&self.snapshot))?;
        let bytes = onnx(&snapshot)?;
        write_whole(&self.out, &bytes).map_err(|e| {
            format!("cannot write '{}': {e}; give another path, or make room", self.out.display())
        })?;
        let (n_in, n_out) = (snapshot.networks.policy.n_in(), snapshot.networks.policy.n_out());
        say(format!(
            "{}: obs [1, {n_in}] -> {} [1, {n_out}]",
            self.out.display(),
            crate::export::output(&snapshot)
        ));
        Ok(())
    }
}
