//! `nearl import`: a policy in an ONNX file becomes a snapshot.

use super::{Failure, say};
use crate::import::{Setting, read, snapshot};
use clap::Args;
use nearl_runtime::cli::quoted;
use std::path::PathBuf;

#[derive(Args)]
pub(super) struct Import {
    /// ONNX file.
    policy: PathBuf,
    /// Robot file, URDF or MJCF.
    #[arg(long)]
    robot: PathBuf,
    /// What the policy sees and what its outputs mean (TOML, or unitree's deploy.yaml), where the file's metadata does not say it. Given
    /// twice, the second comes before the first.
    #[arg(long)]
    recipe: Vec<PathBuf>,
    /// Which of several outputs is the action.
    #[arg(long)]
    output: Option<String>,
    /// Where the snapshot goes.
    #[arg(long)]
    out: PathBuf,
}

impl Import {
    pub(super) fn run(self) -> Result<(), Failure> {
        let network = read(&self.policy, self.output.as_deref())?;
        let stem = self.policy.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        let name: String = stem.chars().map(|c| if c.is_alphanumeric() { c } else { '-' }).collect();
        let name = if name.is_empty() { "policy".to_string() } else { name };
        let setting = Setting { name: &name, robot: &self.robot, recipes: &self.recipe };
        let made = snapshot(&network, &setting)?;
        made.save(&self.out)?;
        let notes = nearl_runtime::doctor::told(&made.manifest)?;
        say(format!(
            "{}: {} inputs, layers {:?}, {} joints; look at it with `nearl doctor {}`, run it with `nearl run {} --plant NAME`",
            self.out.display(),
            network.n_in(),
            &network.dense.widths()[1..],
            network.n_out(),
            quoted(&self.out),
            quoted(&self.out)
        ));
        notes.iter().for_each(|note| say(format!("  note: {note}")));
        Ok(())
    }
}
