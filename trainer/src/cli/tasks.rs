//! `nearl tasks`.

use super::{Failure, say};
use crate::tasks;
use clap::Args;

#[derive(Args)]
pub(super) struct Tasks {
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

impl Tasks {
    pub(super) fn run(self) -> Result<(), Failure> {
        if self.json {
            let list: Vec<_> = tasks::names()
                .iter()
                .map(|n| serde_json::json!({ "name": n, "about": tasks::about(n) }))
                .collect();
            say(serde_json::to_string_pretty(&list)?);
        } else {
            for name in tasks::names() {
                say(format!("{name:<24}{}", tasks::about(name)));
            }
        }
        Ok(())
    }
}
