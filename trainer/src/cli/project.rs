//! `nearl project`: states and proposals in, targets out, one JSON object a line.
//!
//! Input `{"q": [..], "v": [..], "q_proposal": [..], "v_proposal": [..]}`; output
//! `{"q": [..], "v": [..], "status": "..", "active": [..], "outside": [..], "moved": .., "target_violations": .., ..}`.

use super::{Failure, of_file, say};
use crate::{env, tasks};
use clap::Args;
use nearl_runtime::Manifest;
use nearl_runtime::constraints::{Model, Projector, Proposal, Target};
use nearl_runtime::controller::Parts;
use serde::Deserialize;
use std::collections::BTreeSet;
use std::io::{BufRead, Read};

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

/// Longest line of input [bytes].
const MOST_LINE: u64 = 1 << 20;

/// The next line; none at the end. One without an end is refused before it fills the memory.
fn next_line(input: &mut impl BufRead) -> Result<Option<String>, String> {
    let mut line = Vec::new();
    let read = input.take(MOST_LINE + 1).read_until(b'\n', &mut line).map_err(|e| e.to_string())?;
    match read as u64 {
        0 => Ok(None),
        n if n > MOST_LINE => Err(format!("it is longer than {MOST_LINE} bytes; write one object a line")),
        _ => String::from_utf8(line).map(Some).map_err(|_| "stream did not contain valid UTF-8".into()),
    }
}

impl Project {
    pub(super) fn run(self) -> Result<(), Failure> {
        let mut manifest = tasks::load(&self.task, &self.set)?;
        let (model, mut projector) = robot(&mut manifest).map_err(|e| of_file(&self.task, &e))?;
        let (mut target, names) = (Target::new(&model), projector.row_names());
        let mut input = std::io::stdin().lock();
        for i in 0.. {
            let line = next_line(&mut input).map_err(|e| format!("standard input, line {}: {e}", i + 1))?;
            let Some(line) = line else { break };
            if line.trim().is_empty() {
                continue;
            }
            let line = parse(&line, &model).map_err(|e| format!("standard input, line {}: {e}", i + 1))?;
            let proposal = Proposal { q: line.q_proposal, v: line.v_proposal };
            projector.project(&line.q, &line.v, &proposal, &mut target);
            let l = &target.ledger;
            let active: Vec<_> = l
                .active
                .iter()
                .map(|a| {
                    let (kind, side) = (a.kind.name(), format!("{:?}", a.side));
                    serde_json::json!({ "kind": kind, "name": names[a.row], "side": side.to_lowercase(), "multiplier": a.multiplier, "slack": a.slack })
                })
                .collect();
            let outside: Vec<_> = l.outside.iter().map(|row| &names[*row]).collect();
            say(serde_json::json!({
                "q": target.q, "v": target.v, "status": l.status.name(), "reason": l.status.reason(), "rung": l.rung.name(),
                "active": active, "outside": outside, "moved": l.moved, "slack": l.slack, "iterations": l.iterations, "residual": l.residual,
                "raw_violations": l.raw_violations.total(), "target_violations": l.target_violations.total(), "duration_ns": l.duration_ns,
            }));
        }
        Ok(())
    }
}

/// Robot and projector of a task, which needs no environment to project: a file that names none has all joints of the robot file (but a
/// floating base) or those of `state.controllable`.
fn robot(manifest: &mut Manifest) -> Result<(Model, Projector), Failure> {
    if env::is_known(&manifest.task) {
        crate::train::complete(manifest)?;
        let Parts { model, projector, .. } = Parts::new(manifest)?;
        return Ok((model, projector));
    }
    let model = Parts::robot(manifest)?;
    let controllable = match &manifest.task.state.controllable {
        Some(names) => {
            let found: Result<Vec<_>, _> = names.iter().map(|name| model.joint(name)).collect();
            found?.iter().flat_map(|j| j.idx_v..j.idx_v + j.nv).collect()
        }
        None => model.joints().iter().filter(|j| j.nv == 1).map(|j| j.idx_v).collect::<BTreeSet<_>>(),
    };
    let controllable: Vec<usize> = controllable.into_iter().collect();
    let projector = Parts::projector(manifest, &model, &controllable)?;
    Ok((model, projector))
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
    if let Some((key, x, n)) = sizes.iter().find(|(_, x, n)| x.len() != *n) {
        return Err(format!("'{key}' has {} numbers, but the robot has {n}", x.len()));
    }
    for (key, q) in [("q", &input.q), ("q_proposal", &input.q_proposal)] {
        model.check_configuration(q).map_err(|e| format!("'{key}': {e}"))?;
    }
    Ok(input)
}
