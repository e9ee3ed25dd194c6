//! What is told of an episode beside its return: the terms of the reward, `[metrics]`, and what was drawn.
//!
//! ```toml
//! [metrics]
//! speed_error = "abs(base.vx - command.vx)"      # its mean over the control periods of the episode
//! torque = { max = "torque.max" }                # its largest value
//! ```

use super::expression::Expression;
use super::quantity::{Names, Quantity};
use super::settings::{Mistake, Term, Text, can_head_a_column, mistake};

/// An expression told as its mean or its largest value.
#[derive(Clone)]
struct Metric {
    of: Expression<Quantity>,
    is_max: bool,
}

/// Numbers of an episode under way, by column: sums of the reward's terms, metrics, then what was drawn.
#[derive(Clone)]
pub(super) struct Notes {
    names: Vec<String>,
    values: Vec<f64>,
    terms: usize,
    metrics: Vec<Metric>,
    tells_delay: bool,
    tells_level: bool,
}

impl Notes {
    /// Reads `[metrics]`; `drawn` are the columns of what is drawn for the robot.
    pub(super) fn read(
        section: &toml::Table,
        reward: &[Term],
        outcome: &Names,
        drawn: Vec<String>,
        tells_delay: bool,
        tells_level: bool,
    ) -> Result<Notes, Mistake> {
        let mut names: Vec<String> = reward.iter().map(|term| format!("reward/{}", term.name)).collect();
        let mut metrics = Vec::new();
        for (name, value) in section {
            let key = format!("metrics.{name}");
            can_head_a_column(&key, name)?;
            let (is_max, value) = match value {
                toml::Value::Table(table) => match (table.len(), table.get("max")) {
                    (1, Some(value)) => (true, value),
                    _ => return Err(mistake(key, "write an expression for its mean, or { max = \"...\" }")),
                },
                value => (false, value),
            };
            metrics.push(Metric { of: Text::read(&key, value, outcome)?, is_max });
            names.push(format!("metrics/{name}"));
        }
        names.extend(drawn);
        if tells_delay {
            names.extend(["random/action_delay".to_string(), "random/observation_delay".to_string()]);
        }
        if tells_level {
            names.push("curriculum/level".to_string());
        }
        let values = vec![0.0; names.len()];
        Ok(Notes { names, values, terms: reward.len(), metrics, tells_delay, tells_level })
    }

    pub(super) fn names(&self) -> &[String] {
        &self.names
    }

    pub(super) fn values(&self) -> &[f64] {
        &self.values
    }

    /// Sums of the reward's terms.
    pub(super) fn sums(&self) -> &[f64] {
        &self.values[..self.terms]
    }

    pub(super) fn expressions(&self) -> impl Iterator<Item = &Expression<Quantity>> {
        self.metrics.iter().map(|metric| &metric.of)
    }

    /// A new episode of the robot, delays and level that were drawn.
    pub(super) fn begin(&mut self, drawn: &[f64], delay: Option<[usize; 2]>, level: f64) {
        self.values.fill(0.0);
        let drawn_at = self.terms + self.metrics.len();
        let delay = delay.filter(|_| self.tells_delay).into_iter().flatten().map(|periods| periods as f64);
        let told = drawn.iter().copied().chain(delay).chain(self.tells_level.then_some(level));
        self.values[drawn_at..].iter_mut().zip(told).for_each(|(to, value)| *to = value);
    }

    /// Adds what a term of the reward gave.
    pub(super) fn add(&mut self, term: usize, value: f64) {
        self.values[term] += value;
    }

    /// Takes the metrics of the control period after `ticks` others.
    pub(super) fn measure(&mut self, ticks: u64, read: impl Fn(Quantity) -> f64 + Copy) {
        for (metric, told) in self.metrics.iter().zip(&mut self.values[self.terms..]) {
            let value = metric.of.value(read);
            match metric.is_max {
                true if ticks == 0 => *told = value,
                true => *told = told.max(value),
                false => *told += (value - *told) / (ticks + 1) as f64,
            }
        }
    }
}
