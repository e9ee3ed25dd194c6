//! `[pushes]`: sudden changes of velocity, as somebody would push the robot.
//!
//! ```toml
//! [pushes]
//! every = 6.0                   # s between two pushes on average: each pause is drawn from half to one and a half of it
//! base = "0.5 * uniform"        # m/s, added to the horizontal velocity of the free base, one draw an axis
//! joints = "0.2 * normal"       # rad/s or m/s, added to the velocity of every joint with one degree of freedom
//! ```

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::commands::{drawn, periods};
use super::expression::Expression;
use super::quantity::{Names, Quantity, base};
use super::settings::{Mistake, Text, mistake};
use crate::mj::{Joint, Sim};

/// When and how the robot is pushed.
#[derive(Clone)]
pub(super) struct Pushes {
    every: u64,
    /// What is added to which entry of `qvel`.
    draws: Vec<(usize, Expression<Quantity>)>,
    next: u64,
}

impl Pushes {
    /// Reads the section; none where the task has none.
    pub(super) fn read(
        section: &toml::Table,
        joints: &[Joint],
        start: &Names,
        dt: f64,
    ) -> Result<Option<Pushes>, Mistake> {
        if section.is_empty() {
            return Ok(None);
        }
        let mut pushes = Pushes { every: 0, draws: Vec::new(), next: 0 };
        for (name, value) in section {
            let key = format!("pushes.{name}");
            let entries: Vec<usize> = match (name.as_str(), base(joints)) {
                ("every", _) => {
                    pushes.every = periods(value, dt).map_err(|e| mistake(key, e))?;
                    continue;
                }
                ("base", Some(base)) => vec![base.idx_v, base.idx_v + 1],
                ("base", None) => {
                    return Err(mistake(key, "the robot's base is fixed; push its joints with 'joints'"));
                }
                ("joints", _) => joints.iter().filter(|j| j.nv == 1).map(|j| j.idx_v).collect(),
                _ => return Err(mistake(key, "there are 'every', 'base' and 'joints'")),
            };
            let draw = Text::read(&key, value, start)?;
            pushes.draws.extend(entries.into_iter().map(|entry| (entry, draw.clone())));
        }
        match (pushes.every, pushes.draws.is_empty()) {
            (0, _) => Err(mistake("pushes.every", "it is missing; give the seconds between two pushes")),
            (_, true) => Err(mistake("pushes", "nothing is pushed; give 'base' or 'joints'")),
            _ => Ok(Some(pushes)),
        }
    }

    pub(super) fn begin(&mut self, rng: &mut ChaCha8Rng) {
        self.next = self.pause(rng);
    }

    fn pause(&self, rng: &mut ChaCha8Rng) -> u64 {
        ((self.every as f64 * rng.random_range(0.5..1.5)).round() as u64).max(1)
    }

    /// Pushes the robot if its time has come, after `ticks` control periods.
    pub(super) fn advance(&mut self, rng: &mut ChaCha8Rng, sim: &mut Sim, ticks: u64, level: f64) {
        if ticks < self.next {
            return;
        }
        for (entry, draw) in &self.draws {
            sim.qvel_mut()[*entry] += drawn(draw, rng, level);
        }
        self.next = ticks + self.pause(rng);
    }
}
