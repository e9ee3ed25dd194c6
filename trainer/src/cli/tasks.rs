//! `nearl tasks`: the bundled tasks, and what each of them needs.

use super::{Failure, say};
use crate::tasks;
use clap::Args;
use nearl_runtime::task::IdmKind;

#[derive(Args)]
pub(super) struct Tasks {
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

impl Tasks {
    pub(super) fn run(self) -> Result<(), Failure> {
        if self.json {
            let list = tasks::names().into_iter().map(row).collect::<Result<Vec<_>, _>>()?;
            say(serde_json::to_string_pretty(&list)?);
        } else {
            for name in tasks::names() {
                let needs = needs(name)?;
                let cost = if needs.has_cost { ", a cost" } else { "" };
                say(format!("{name:<22}{}", tasks::about(name)));
                say(format!(
                    "{:<22}{} observations, {} actions, a policy step of {} ms, episodes of {} control periods, inverse model: {}{cost}",
                    "", needs.n_obs, needs.n_act, needs.step_ms, needs.episode, needs.inverse_model
                ));
            }
            say("train one with 'nearl train TASK'; one of your own is a file (docs/TASKS.md)");
        }
        Ok(())
    }
}

/// What a policy of the task sees and gives, and when.
#[derive(serde::Serialize)]
struct Needs {
    n_obs: usize,
    n_act: usize,
    step_ms: f64,
    /// Control periods.
    episode: usize,
    inverse_model: &'static str,
    has_cost: bool,
}

fn needs(name: &str) -> Result<Needs, Failure> {
    let (task, env) = (tasks::load(name, &[])?.task, tasks::env(name)?);
    let spec = env.spec();
    let inverse_model = match task.idm.kind {
        IdmKind::Learned => "learned",
        IdmKind::Pinocchio => "analytic",
    };
    // in microseconds first, so that 50 ms is not 49.99999
    let step_ms = (1e6 * spec.dt * task.time.policy_every as f64).round() * 1e-3;
    let (n_obs, n_act, episode) = (spec.n_obs(), spec.n_act(), spec.max_episode_steps);
    Ok(Needs { n_obs, n_act, step_ms, episode, inverse_model, has_cost: spec.has_cost })
}

fn row(name: &'static str) -> Result<serde_json::Value, Failure> {
    Ok(serde_json::json!({ "name": name, "about": tasks::about(name), "needs": needs(name)? }))
}
