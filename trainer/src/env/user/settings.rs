//! The sections of a task file that describe a user's own environment.

use std::collections::BTreeMap;

use nearl_runtime::task::{Task, suggest};
use serde::Deserialize;

use super::expression::Expression;
use super::quantity::{Names, Quantity};

/// A number or an expression.
#[derive(Debug, Clone, Deserialize)]
#[serde(untagged)]
enum Text {
    Number(f64),
    Expression(String),
}

/// `[reset]`. Positions and velocities are those of the robot file at rest, changed by what is given here.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Reset {
    /// Added to every entry of `qpos`.
    position: Option<Text>,
    /// Added to every entry of `qvel`.
    velocity: Option<Text>,
    /// Replaces the position of a joint with one degree of freedom.
    q: BTreeMap<String, Text>,
    /// Replaces the velocity of a joint with one degree of freedom.
    v: BTreeMap<String, Text>,
}

/// A mistake in a task file: the key, and a sentence.
pub(super) struct Mistake {
    pub(super) key: String,
    pub(super) reason: String,
}

pub(super) fn mistake(key: impl Into<String>, reason: impl Into<String>) -> Mistake {
    Mistake { key: key.into(), reason: reason.into() }
}

/// Named expressions of `[reward]`, `[cost]` or `[termination]`, in the order of their names.
pub(super) fn terms(
    section: &str,
    table: &toml::Table,
    names: &Names,
) -> Result<Vec<Expression<Quantity>>, Mistake> {
    let compile = |(name, value): (&String, &toml::Value)| {
        let key = format!("{section}.{name}");
        let text: Text = value.clone().try_into().map_err(|_| {
            mistake(
                &key,
                "it is neither a number nor an expression in quotes; write for example \"vx.torso - 0.1\"",
            )
        })?;
        text.compile(names).map_err(|e| mistake(key, e))
    };
    table.iter().map(compile).collect()
}

impl Text {
    fn compile(&self, names: &Names) -> Result<Expression<Quantity>, String> {
        match self {
            Text::Number(x) if !x.is_finite() => Err(format!("{x} is not finite")),
            Text::Number(x) => names.compile(&format!("{x:?}")),
            Text::Expression(text) => names.compile(text),
        }
    }
}

/// One entry of the start: where it goes, whether it replaces what is there, and its value.
#[derive(Debug, Clone)]
pub(super) struct Start {
    pub(super) velocity: bool,
    pub(super) index: usize,
    pub(super) replace: bool,
    pub(super) value: Expression<Quantity>,
}

/// The starts of an episode, in the order they are drawn.
pub(super) fn starts(task: &Task, joints: &[crate::mj::Joint], names: &Names) -> Result<Vec<Start>, Mistake> {
    let reset: Reset = serde_path_to_error::deserialize(task.reset.clone())
        .map_err(|e| mistake(format!("reset.{}", e.path()), suggest(e.inner().message())))?;
    let size = |width: fn(&crate::mj::Joint) -> usize| joints.iter().map(width).sum::<usize>();
    let mut entries = Vec::new();
    for (key, text, velocity, n) in [
        ("position", &reset.position, false, size(|j| j.nq)),
        ("velocity", &reset.velocity, true, size(|j| j.nv)),
    ] {
        let Some(text) = text else { continue };
        let value = text.compile(names).map_err(|e| mistake(format!("reset.{key}"), e))?;
        entries.extend((0..n).map(|index| Start { velocity, index, replace: false, value: value.clone() }));
    }
    for (letter, given, velocity) in [("q", &reset.q, false), ("v", &reset.v, true)] {
        for (name, text) in given {
            let key = format!("reset.{letter}.{name}");
            let single = joints.iter().filter(|j| j.nq == 1);
            let joint = single.clone().find(|j| j.name == *name).ok_or_else(|| {
                let near = single.map(|j| (strsim::jaro_winkler(&j.name, name), &j.name));
                let near = near
                    .max_by(|a, b| a.0.total_cmp(&b.0))
                    .map_or(String::new(), |(_, n)| format!("; did you mean '{n}'?"));
                mistake(&key, format!("the robot has no joint '{name}' with one degree of freedom{near}"))
            })?;
            let index = if velocity { joint.idx_v } else { joint.idx_q };
            let value = text.compile(names).map_err(|e| mistake(key, e))?;
            entries.push(Start { velocity, index, replace: true, value });
        }
    }
    Ok(entries)
}
