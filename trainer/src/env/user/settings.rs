//! The sections of a task file that describe a user's own environment.

use std::collections::BTreeMap;

use nearl_runtime::constraints::parts_of;
use nearl_runtime::task::{Task, suggest};
use serde::Deserialize;

use super::expression::Expression;
use super::quantity::{Names, Quantity};
use crate::mj::Joint;
use crate::scene;

/// A number or an expression.
#[derive(Debug, Clone, Deserialize)]
#[serde(untagged)]
pub(super) enum Text {
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

pub(super) use scene::Mistake;

pub(super) fn mistake(key: impl Into<String>, reason: impl Into<String>) -> Mistake {
    Mistake { key: key.into(), reason: reason.into() }
}

/// A named expression and its weight.
#[derive(Debug, Clone)]
pub(super) struct Term {
    pub(super) name: String,
    pub(super) of: Expression<Quantity>,
    pub(super) weight: f64,
}

/// `{ weight = 0.5, of = "..." }`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Weighted {
    weight: f64,
    of: String,
}

/// What is told by a name has a column of that name.
///
/// # Errors
/// An empty name, and one with signs that a table of numbers or a terminal takes for something else.
pub(super) fn can_head_a_column(key: &str, name: &str) -> Result<(), Mistake> {
    let odd = |c: char| c.is_control() || c == ',' || c == '"' || ('\u{2028}'..='\u{202e}').contains(&c);
    match name.is_empty() || name.contains(odd) {
        true => Err(mistake(
            key,
            "a name has letters, digits, spaces and signs, and no comma, quote or end of a line; give it another",
        )),
        false => Ok(()),
    }
}

/// Terms of a section at most.
const MOST_TERMS: usize = 1000;

/// Named expressions of `[reward]`, `[cost]` or `[termination]`, in the order of their names.
pub(super) fn terms(section: &str, table: &toml::Table, names: &Names) -> Result<Vec<Term>, Mistake> {
    if table.len() > MOST_TERMS {
        let (n, key) = (table.len(), section.to_owned());
        return Err(mistake(
            key,
            format!("it has {n} terms, more than the {MOST_TERMS} that are read; join some of them"),
        ));
    }
    let compile = |(name, value): (&String, &toml::Value)| {
        let key = format!("{section}.{name}");
        can_head_a_column(&key, name)?;
        let (weight, of) = match value {
            toml::Value::Table(table) if section != "termination" => {
                let weighted: Weighted = serde_path_to_error::deserialize(table.clone())
                    .map_err(|e| mistake(&key, suggest(e.inner().message())))?;
                if !weighted.weight.is_finite() {
                    return Err(mistake(key, format!("the weight {} is no number", weighted.weight)));
                }
                (weighted.weight, Text::Expression(weighted.of).compile(names).map_err(|e| mistake(&key, e))?)
            }
            value => (1.0, Text::read(&key, value, names)?),
        };
        Ok(Term { name: name.clone(), of, weight })
    };
    table.iter().map(compile).collect()
}

impl Text {
    /// Compiles the value of `key`.
    pub(super) fn read(
        key: &str,
        value: &toml::Value,
        names: &Names,
    ) -> Result<Expression<Quantity>, Mistake> {
        let text: Text = value.clone().try_into().map_err(|_| {
            mistake(
                key,
                "it is neither a number nor an expression in quotes; write for example \"vx.torso - 0.1\"",
            )
        })?;
        text.compile(names).map_err(|e| mistake(key, e))
    }

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
pub(super) fn starts(task: &Task, joints: &[Joint], names: &Names) -> Result<Vec<Start>, Mistake> {
    let reset: Reset = serde_path_to_error::deserialize(task.reset.clone())
        .map_err(|e| mistake(format!("reset.{}", e.path()), suggest(e.inner().message())))?;
    let size = |width: fn(&Joint) -> usize| joints.iter().map(width).sum::<usize>();
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
            let index = entry(joints, name, velocity).map_err(|e| mistake(&key, e))?;
            let value = text.compile(names).map_err(|e| mistake(key, e))?;
            entries.push(Start { velocity, index, replace: true, value });
        }
    }
    Ok(entries)
}

/// Where the entry `name` is in `qpos` or `qvel`: a joint with one degree of freedom, or a part of another, `root.z`. The four parts of a
/// rotation depend on each other and are left out.
fn entry(joints: &[Joint], name: &str, velocity: bool) -> Result<usize, String> {
    let mut known = Vec::new();
    for joint in joints {
        let (positions, velocities) = parts_of(joint.nq, joint.nv);
        let (first, parts) = if velocity { (joint.idx_v, velocities) } else { (joint.idx_q, positions) };
        let whole = parts.iter().enumerate().filter(|(_, part)| !part.starts_with(".q"));
        known.extend(whole.map(|(k, part)| (format!("{}{part}", joint.name), first + k)));
    }
    if let Some((_, index)) = known.iter().find(|(known, _)| known == name) {
        return Ok(*index);
    }
    let near = known.iter().map(|(known, _)| (strsim::jaro(known, name), known));
    let near = near
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map_or(String::new(), |(_, n)| format!("; did you mean '{n}'?"));
    Err(format!(
        "the robot has no joint '{name}' with one degree of freedom, nor such a part of a joint{near}"
    ))
}
