//! `nearl tasks`.

use super::{Failure, say};
use crate::{env, tasks};
use clap::Args;

#[derive(Args)]
pub(super) struct Tasks {
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

impl Tasks {
    pub(super) fn run(self) -> Result<(), Failure> {
        let about = |name: &str| env::REGISTRY.iter().find(|e| e.name == name).map_or("", |e| e.about);
        if self.json {
            let list: Vec<_> =
                tasks::names().iter().map(|n| serde_json::json!({ "name": n, "about": about(n) })).collect();
            say(serde_json::to_string_pretty(&list)?);
        } else {
            for name in tasks::names() {
                say(format!("{name:<16}{}", about(name)));
            }
        }
        Ok(())
    }
}
