//! `[curriculum]`: a level between 0 and 1 that rises and falls with what an environment's episodes were like. `level` is a name in `[commands]`,
//! `[pushes]`, `[random]`, `[noise]`, `[delay]` and `[reset]`.
//!
//! ```toml
//! [curriculum]
//! start = 0.0
//! step = 0.02
//! up = "length > 0.9 and reward.track > 0.7"     # `reward.<term>`: its mean a control period; `length`: share of the longest episode
//! down = "length < 0.4"
//! ```

use nearl_runtime::task::suggest;
use serde::Deserialize;

use super::expression::Expression;
use super::lexer::quoted;
use super::settings::{Mistake, Term, mistake};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Section {
    #[serde(default)]
    start: f64,
    step: f64,
    up: String,
    #[serde(default)]
    down: Option<String>,
}

/// Something told of an episode that ended.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Told {
    /// Mean of a term of the reward a control period.
    Term(usize),
    /// Share of the longest episode.
    Length,
}

/// When the level rises and falls. Only environments that learn climb: all others are at the top.
#[derive(Clone)]
pub(super) struct Curriculum {
    pub(super) start: f64,
    step: f64,
    up: Expression<Told>,
    down: Option<Expression<Told>>,
}

impl Curriculum {
    /// Reads the section; none where the task has none.
    pub(super) fn read(section: &toml::Table, reward: &[Term]) -> Result<Option<Curriculum>, Mistake> {
        if section.is_empty() {
            return Ok(None);
        }
        let section: Section = serde_path_to_error::deserialize(section.clone()).map_err(|e| {
            let path = e.path().to_string();
            let key = if path == "." { "curriculum".into() } else { format!("curriculum.{path}") };
            mistake(key, suggest(e.inner().message()))
        })?;
        for (key, value) in [("start", section.start), ("step", section.step)] {
            if !(0.0..=1.0).contains(&value) {
                return Err(mistake(format!("curriculum.{key}"), format!("{value} is outside [0, 1]")));
            }
        }
        if section.step == 0.0 {
            return Err(mistake(
                "curriculum.step",
                "0 leaves the level where it is; give what one episode adds, e.g. 0.02",
            ));
        }
        let resolve = |name: &str| {
            let term =
                name.strip_prefix("reward.").and_then(|name| reward.iter().position(|t| t.name == name));
            let told = if name == "length" { Some(Told::Length) } else { term.map(Told::Term) };
            told.ok_or_else(|| {
                let terms: Vec<_> = reward.iter().map(|t| format!("reward.{}", t.name)).collect();
                format!("unknown name '{name}'; there are length, {}", terms.join(", "))
            })
        };
        let compile = |key: &str, text: &str| {
            let key = format!("curriculum.{key}");
            Expression::parse(text, resolve).map_err(|e| mistake(key, format!("\"{}\": {e}", quoted(text))))
        };
        Ok(Some(Curriculum {
            start: section.start,
            step: section.step,
            up: compile("up", &section.up)?,
            down: section.down.as_deref().map(|text| compile("down", text)).transpose()?,
        }))
    }

    /// The level after an episode of `ticks` control periods, of at most `longest`, in which the terms of the reward summed to `sums`.
    pub(super) fn after(&self, level: f64, sums: &[f64], ticks: u64, longest: usize) -> f64 {
        if ticks == 0 {
            return level;
        }
        let told = |told| match told {
            Told::Term(i) => sums[i] / ticks as f64,
            Told::Length => ticks as f64 / longest as f64,
        };
        let climbs = self.up.holds(told);
        let falls = !climbs && self.down.as_ref().is_some_and(|down| down.holds(told));
        (level + self.step * (f64::from(u8::from(climbs)) - f64::from(u8::from(falls)))).clamp(0.0, 1.0)
    }
}
