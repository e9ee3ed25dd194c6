//! `nearl blank`: a task as a snapshot without a policy.

use super::{Failure, of_file, say};
use clap::Args;
use nearl_runtime::cli::quoted;
use std::path::PathBuf;

#[derive(Args)]
pub(super) struct Blank {
    /// Bundled task or TOML file.
    task: String,
    /// Where the snapshot goes.
    #[arg(long)]
    out: PathBuf,
    /// What is proposed are commands of the joints, guarded, in place of states.
    #[arg(long)]
    actions: bool,
}

impl Blank {
    pub(super) fn run(self) -> Result<(), Failure> {
        let snapshot =
            crate::blank::snapshot(&self.task, self.actions).map_err(|e| of_file(&self.task, &e))?;
        snapshot.save(&self.out)?;
        let notes = nearl_runtime::doctor::told(&snapshot.manifest)?;
        let what = if self.actions { "actions" } else { "states" };
        say(format!(
            "{}: no policy; start the loop with `nearl run {} --plant NAME --proposer`, and propose {what}",
            self.out.display(),
            quoted(&self.out)
        ));
        notes.iter().for_each(|note| say(format!("  note: {note}")));
        Ok(())
    }
}
