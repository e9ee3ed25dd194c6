//! `nearl import`: a policy in an ONNX file becomes a snapshot.

use super::{Failure, of_file, say};
use crate::import::{Gives, Setting, brought, for_task, read, snapshot};
use crate::{blank, tasks};
use clap::Args;
use nearl_runtime::PolicyKind;
use nearl_runtime::cli::quoted;
use std::path::{Path, PathBuf};

#[derive(Args)]
pub(super) struct Import {
    /// ONNX file.
    policy: PathBuf,
    /// Robot file, URDF or MJCF; or --task.
    #[arg(long, required_unless_present = "task")]
    robot: Option<PathBuf>,
    /// What the policy sees and what its outputs mean (TOML, or unitree's deploy.yaml), where the file's metadata does not say it. Given
    /// twice, the second comes before the first.
    #[arg(long)]
    recipe: Vec<PathBuf>,
    /// In place of robot and recipe, the task whose observation the policy sees: a bundled one or a TOML file.
    #[arg(long, conflicts_with_all = ["robot", "recipe"])]
    task: Option<String>,
    /// What the policy gives in its task.
    #[arg(long, requires = "task", default_value = "actuators", value_parser = Gives::ALL.map(Gives::name))]
    actions: String,
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
        let made = match (&self.task, &self.robot) {
            (Some(task), _) => {
                let mut manifest = tasks::load(task, &[])?;
                blank::complete(&mut manifest).map_err(|e| of_file(task, &e))?;
                for_task(&network, manifest, Gives::named(&self.actions)?)?
            }
            (None, Some(robot)) => {
                let name = name_of(&self.policy);
                snapshot(&network, &Setting { name: &name, robot, recipes: &self.recipe })?
            }
            (None, None) => return Err("give --robot or --task".into()),
        };
        made.save(&self.out)?;
        let notes = nearl_runtime::doctor::told(&made.manifest)?;
        say(format!(
            "{}: {} inputs, layers {:?}, {}; look at it with `nearl doctor {}`, run it with `nearl run {} --plant NAME`",
            self.out.display(),
            network.n_in(),
            &network.dense.widths()[1..],
            match made.manifest.policy {
                PolicyKind::Direct => format!("{} joints", network.n_out()),
                _ => format!("{} proposed entries", network.n_out()),
            },
            quoted(&self.out),
            quoted(&self.out)
        ));
        let brought = brought(&network);
        if self.task.is_none() && !brought.is_empty() {
            let merged =
                if self.recipe.is_empty() { "" } else { ", where the recipe does not say otherwise" };
            say(format!("  [constraints] of the policy's metadata: {}{merged}", brought.join(", ")));
        }
        notes.iter().for_each(|note| say(format!("  note: {note}")));
        Ok(())
    }
}

/// Name of the task that is made for a policy's file.
fn name_of(policy: &Path) -> String {
    let stem = policy.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    let name: String = stem.chars().map(|c| if c.is_alphanumeric() { c } else { '-' }).collect();
    if name.is_empty() { "policy".to_string() } else { name }
}
