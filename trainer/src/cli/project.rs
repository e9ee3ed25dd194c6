//! `nearl project`: states and proposals in, targets out, one JSON object a line.
//!
//! Input `{"q": [..], "v": [..], "q_proposal": [..], "v_proposal": [..]}`; output
//! `{"q": [..], "v": [..], "status": "..", "active": [..], "moved": .., "iterations": .., "residual": ..}`.

use super::{Failure, say};
use crate::tasks;
use clap::Args;
use nearl_runtime::constraints::{Model, Proposal, Target};
use nearl_runtime::controller::Parts;
use serde::Deserialize;
use std::io::BufRead;

#[derive(Args)]
pub(super) struct Project {
    /// Task name (see `nearl tasks`) or TOML file.
    task: String,
    /// Overrides of the task file.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    q: Vec<f64>,
    v: Vec<f64>,
    q_proposal: Vec<f64>,
    v_proposal: Vec<f64>,
}

impl Project {
    pub(super) fn run(self) -> Result<(), Failure> {
        let mut manifest = tasks::load(&self.task, &self.set)?;
        crate::train::complete(&mut manifest)?;
        let Parts { model, mut projector, .. } = Parts::new(&manifest)?;
        let (mut target, names) = (Target::new(&model), projector.row_names());
        for (i, line) in std::io::stdin().lock().lines().enumerate() {
            let line = line.map_err(|e| format!("standard input, line {}: {e}", i + 1))?;
            if line.trim().is_empty() {
                continue;
            }
            let input = parse(&line, &model).map_err(|e| format!("standard input, line {}: {e}", i + 1))?;
            let proposal = Proposal { q: input.q_proposal, v: input.v_proposal };
            projector.project(&input.q, &input.v, &proposal, &mut target);
            let l = &target.ledger;
            let active: Vec<_> = l
                .active
                .iter()
                .map(|a| {
                    let (kind, side) = (a.kind.name(), format!("{:?}", a.side));
                    serde_json::json!({ "kind": kind, "name": names[a.row], "side": side.to_lowercase(), "multiplier": a.multiplier, "slack": a.slack })
                })
                .collect();
            say(serde_json::json!({
                "q": target.q, "v": target.v, "status": format!("{:?}", l.status), "rung": format!("{:?}", l.rung), "active": active,
                "moved": l.moved, "slack": l.slack, "iterations": l.iterations, "residual": l.residual,
                "raw_violations": l.raw_violations.total(), "violations": l.violations.total(), "duration_ns": l.duration_ns,
            }));
        }
        Ok(())
    }
}

fn parse(line: &str, model: &Model) -> Result<Line, String> {
    let input: Line = serde_json::from_str(line).map_err(|e| {
        format!("{e}; write {{\"q\": [..], \"v\": [..], \"q_proposal\": [..], \"v_proposal\": [..]}}")
    })?;
    let sizes = [
        ("q", &input.q, model.nq()),
        ("v", &input.v, model.nv()),
        ("q_proposal", &input.q_proposal, model.nq()),
        ("v_proposal", &input.v_proposal, model.nv()),
    ];
    match sizes.iter().find(|(_, x, n)| x.len() != *n) {
        Some((key, x, n)) => Err(format!("'{key}' has {} numbers, but the robot has {n}", x.len())),
        None => Ok(input),
    }
}
