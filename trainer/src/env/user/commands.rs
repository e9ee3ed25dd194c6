//! `[commands]`: what the robot is asked to do, drawn as an episode goes on.
//!
//! ```toml
//! [commands]
//! every = 5.0                              # s between two draws; once an episode when absent
//! vx = "if(abs(uniform) < 0.1, 0, uniform)"
//! ```

use std::ops::RangeInclusive;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::expression::Expression;
use super::quantity::{Names, Quantity};
use super::settings::{Mistake, Text, mistake};

/// The commands and their present values.
#[derive(Clone, Default)]
pub(super) struct Commands {
    names: Vec<String>,
    draws: Vec<Expression<Quantity>>,
    values: Vec<f64>,
    /// Control periods between two draws; 0: one draw an episode.
    every: u64,
}

impl Commands {
    /// Reads the section for control periods of `dt` \[s\].
    pub(super) fn read(section: &toml::Table, start: &Names, dt: f64) -> Result<Commands, Mistake> {
        let mut commands = Commands::default();
        for (name, value) in section {
            let key = format!("commands.{name}");
            if name == "every" {
                commands.every = periods(value, dt).map_err(|e| mistake(key, e))?;
                continue;
            }
            commands.draws.push(Text::read(&key, value, start)?);
            commands.names.push(name.clone());
        }
        commands.values = vec![0.0; commands.names.len()];
        match commands.is_empty() && !section.is_empty() {
            true => Err(mistake("commands", "it names no command; write for example vx = \"0.5 * uniform\"")),
            false => Ok(commands),
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.names.is_empty()
    }

    pub(super) fn names(&self) -> &[String] {
        &self.names
    }

    pub(super) fn values(&self) -> &[f64] {
        &self.values
    }

    pub(super) fn values_mut(&mut self) -> &mut [f64] {
        &mut self.values
    }

    /// Whether new ones are drawn after `ticks` control periods.
    pub(super) fn are_due(&self, ticks: u64) -> bool {
        self.every > 0 && ticks.is_multiple_of(self.every)
    }

    pub(super) fn draw(&mut self, rng: &mut ChaCha8Rng, level: f64) {
        for (value, draw) in self.values.iter_mut().zip(&self.draws) {
            *value = drawn(draw, rng, level);
        }
    }
}

/// A value of an expression over draws, from numbers of its own.
pub(super) fn drawn(of: &Expression<Quantity>, rng: &mut ChaCha8Rng, level: f64) -> f64 {
    let (uniform, normal): (f64, f64) = (rng.random_range(-1.0..1.0), StandardNormal.sample(rng));
    of.value(|quantity| match quantity {
        Quantity::Uniform => uniform,
        Quantity::Normal => normal,
        _ => level,
    })
}

/// Whether `of` is drawn within `domain` at all, at the lowest or the highest level.
pub(super) fn is_ever(of: &Expression<Quantity>, domain: &RangeInclusive<f64>) -> bool {
    draws(of).any(|value| domain.contains(&value))
}

/// Whether what is drawn is a number every time.
pub(super) fn is_a_number(of: &Expression<Quantity>) -> bool {
    draws(of).all(f64::is_finite)
}

/// Some draws, half of them at the lowest level and half at the highest.
fn draws(of: &Expression<Quantity>) -> impl Iterator<Item = f64> {
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    (0..128).map(move |k| drawn(of, &mut rng, f64::from(k % 2)))
}

/// Whole control periods of `dt` \[s\] in a time.
pub(super) fn periods(value: &toml::Value, dt: f64) -> Result<u64, String> {
    let seconds = value.as_float().or(value.as_integer().map(|i| i as f64));
    let periods = seconds.map(|s| (s / dt).round()).filter(|n| (1.0..1e9).contains(n));
    periods
        .map(|n| n as u64)
        .ok_or_else(|| format!("{value} is no time of a control period ({dt} s) or more; give seconds"))
}
