//! Watches how far the robot stays from its targets, before and after a swap. When that grows, the loop takes the earlier snapshot back.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use crate::rt::Record;

/// When a swapped-in snapshot is taken back.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "cli", derive(clap::Args))]
#[serde(deny_unknown_fields)]
pub struct RollbackSettings {
    /// Ticks over which the distance of reached and target velocity is averaged before and after a swap; 0 never goes back.
    #[cfg_attr(feature = "cli", arg(long = "rollback-window", value_name = "TICKS", default_value_t = RollbackSettings::default().window))]
    pub window: usize,
    /// The mean after a swap may be so many times the mean before.
    #[cfg_attr(feature = "cli", arg(long = "rollback-factor", value_name = "FACTOR", default_value_t = RollbackSettings::default().factor))]
    pub factor: f64,
    /// Means below this are no reason to go back [rad/s or m/s].
    #[cfg_attr(feature = "cli", arg(long = "rollback-floor", value_name = "SPEED", default_value_t = RollbackSettings::default().floor))]
    pub floor: f64,
}

impl Default for RollbackSettings {
    fn default() -> Self {
        RollbackSettings { window: 200, factor: 3.0, floor: 0.05 }
    }
}

impl RollbackSettings {
    /// Longest window of the residual \[ticks\]; its memory is taken at once.
    pub const MOST_WINDOW: usize = 1_000_000;
}

/// What a swap brought.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Weights {
    New,
    /// Only the limits are others.
    Same,
}

/// Sliding mean of the residual `sqrt(mean_i (v_i - v'_i)^2)`: velocity reached against velocity of the target.
pub(crate) struct Residual {
    settings: RollbackSettings,
    window: VecDeque<f64>,
    /// Mean before the swap that is being watched.
    before: Option<f64>,
}

impl Residual {
    pub(crate) fn new(settings: RollbackSettings) -> Residual {
        Residual { window: VecDeque::with_capacity(settings.window + 1), before: None, settings }
    }

    fn mean(&self) -> f64 {
        self.window.iter().sum::<f64>() / self.window.len().max(1) as f64
    }

    /// Takes in a tick and the one before it; the means before and after when the snapshot in use should be taken back. With the same `weights`
    /// as the tick before, what was begun is watched on, whatever the limits.
    pub(crate) fn observe(
        &mut self,
        previous: &Record,
        record: &Record,
        weights: Weights,
    ) -> Option<(f64, f64)> {
        if self.settings.window == 0 {
            return None;
        }
        if let Some(residual) = residual(previous, record) {
            self.window.push_back(residual);
            if self.window.len() > self.settings.window {
                self.window.pop_front();
            }
        }
        // By the number, because the tick of the swap itself may have come without a state or been dropped.
        if record.snapshot != previous.snapshot && weights == Weights::New {
            let is_known = 4 * self.window.len() >= self.settings.window;
            self.before = is_known.then(|| self.mean());
            self.window.clear();
            return None;
        }
        let before = self.before?;
        if self.window.len() < self.settings.window {
            return None;
        }
        self.before = None;
        let after = self.mean();
        let has_risen = after > self.settings.factor * before && after > self.settings.floor;
        has_risen.then_some((before, after))
    }
}

/// `None` unless `record` measured what the action of `previous` led to.
fn residual(previous: &Record, record: &Record) -> Option<f64> {
    let (old, new) = (&previous.state, &record.state);
    let follows = record.fresh && new.episode == old.episode && new.tick == old.tick + 1 && new.is_finite();
    if !(follows && previous.mode.acts() && previous.output.nu > 0) {
        return None;
    }
    let nv = new.v().len();
    let squares = new.v().iter().zip(&previous.output.target_v).map(|(v, target)| (v - target).powi(2));
    Some((squares.sum::<f64>() / nv.max(1) as f64).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rt::Mode;

    fn tick(n: u64, error: f64, snapshot: u64) -> Record {
        let mut record = Record::new();
        (record.mode, record.fresh, record.snapshot, record.output.nu) = (Mode::Active, true, snapshot, 1);
        (record.state.nv, record.state.tick) = (1, n);
        record.state.v[0] = error; // the target is 0
        record
    }

    fn run(errors: impl Iterator<Item = (f64, bool)>) -> Vec<u64> {
        let settings = RollbackSettings { window: 10, factor: 3.0, floor: 0.05 };
        let mut residual = Residual::new(settings);
        let mut snapshot = 0;
        let mut next = |(n, (error, swapped)): (usize, (f64, bool))| {
            snapshot += u64::from(swapped);
            tick(n as u64, error, snapshot)
        };
        let records: Vec<Record> = errors.enumerate().map(&mut next).collect();
        let pairs = records.windows(2);
        pairs.filter_map(|p| residual.observe(&p[0], &p[1], Weights::New).map(|_| p[1].state.tick)).collect()
    }

    #[test]
    fn a_risen_residual_is_found_once_and_a_full_window_after_the_swap() {
        let before = std::iter::repeat_n((0.02, false), 20);
        let after = std::iter::once((0.02, true)).chain(std::iter::repeat_n((0.1, false), 50));
        assert_eq!(run(before.chain(after)), [30]);
    }

    #[test]
    fn an_order_in_between_changes_nothing() {
        let settings = RollbackSettings { window: 10, factor: 3.0, floor: 0.05 };
        let found = |by_order: Weights| {
            let mut residual = Residual::new(settings);
            let snapshot = |n: u64| u64::from(n >= 20) + u64::from(n >= 25);
            let records: Vec<Record> =
                (0..60).map(|n| tick(n, if n > 20 { 0.1 } else { 0.02 }, snapshot(n))).collect();
            let weights = |record: &Record| if record.snapshot == 2 { by_order } else { Weights::New };
            let pairs = records.windows(2);
            pairs
                .filter_map(|p| residual.observe(&p[0], &p[1], weights(&p[1])).map(|_| p[1].state.tick))
                .collect::<Vec<_>>()
        };
        assert_eq!(found(Weights::Same), [30]);
        assert!(found(Weights::New).is_empty());
    }

    #[test]
    fn small_or_unchanged_residuals_are_no_reason() {
        let swap_to = |old, new| {
            let before = std::iter::repeat_n((old, false), 20);
            before.chain(std::iter::once((old, true))).chain(std::iter::repeat_n((new, false), 50))
        };
        assert!(run(swap_to(0.001, 0.04)).is_empty(), "below the floor");
        assert!(run(swap_to(0.5, 1.0)).is_empty(), "below the factor");
        assert!(run(std::iter::repeat_n((9.0, false), 50)).is_empty(), "no swap");
    }
}
