//! `[train.demos]` of the task file: which demonstrations are learned from, and how.

use serde::{Deserialize, Serialize};

/// What an algorithm that imitates is rewarded by.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DemoReward {
    /// The reward of the task.
    #[default]
    Task,
    /// How much a transition of states looks demonstrated, as `gaifo`; the reward of the task is not read.
    Likeness,
    /// How near the proposed positions are to the demonstrated ones of the same moment; the reward of the task is not read.
    Tracking,
}

/// `[train.demos]`, read by the algorithms that learn from demonstrations.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DemoSettings {
    /// File of demonstrations (`.npz`); empty: none.
    pub file: String,
    /// Episodes of the file that are used, the first ones; 0: all.
    pub episodes: usize,
    /// What `pid2-il` is rewarded by.
    pub reward: DemoReward,
    /// With [`DemoReward::Tracking`], an episode ends once a step is worth less than this; 0: never.
    pub stray: f64,
    /// Share of the episodes that begin in a random frame of the demonstrations, for `bc`, `soil` and `pid2-il`.
    pub resets: f64,
    /// Steps of the fresh networks' own noise from which the inverse model learns before anything else; no effect for `dapg` and `gaifo`.
    pub warmup: u64,
    /// Passes of behaviour cloning over the demonstrations before the first update; no effect for `soil` and `gaifo`.
    pub epochs: usize,
    /// Learning rate of behaviour cloning.
    pub lr: f32,
    /// Rows of a minibatch of behaviour cloning, a multiple of 32.
    pub batch_size: usize,
    /// The discriminator of `pid2-il` takes demonstrations for real too.
    pub in_discriminator: bool,
    /// Weight of the demonstrations in the policy gradient of `dapg` and `soil`, for as many rows of them as of own experience.
    pub weight: f64,
    /// Factor on that weight from one update to the next.
    pub decay: f64,
    /// The weight decays as if the run had a hundred updates, however many it has.
    pub decay_over_run: bool,
}

impl Default for DemoSettings {
    fn default() -> Self {
        Self {
            file: String::new(),
            episodes: 0,
            reward: DemoReward::default(),
            stray: 0.0,
            resets: 0.5,
            warmup: 16_384,
            epochs: 20,
            lr: 1e-3,
            batch_size: 32,
            in_discriminator: true,
            weight: 0.01,
            decay: 0.95,
            decay_over_run: false,
        }
    }
}

/// Updates of a run over which the weight decays with [`DemoSettings::decay_over_run`].
const HUNDRED: f64 = 100.0;

impl DemoSettings {
    /// Numbers as accepted.
    ///
    /// # Errors
    /// One sentence naming the key.
    pub fn check(&self) -> Result<(), String> {
        let share = |x: f64| (0.0..=1.0).contains(&x);
        let at_least = |x: f64| x >= 0.0 && x.is_finite();
        let above = |x: f64| x > 0.0 && x.is_finite();
        type Domain = (fn(f64) -> bool, &'static str);
        let (share, at_least, above): (Domain, Domain, Domain) =
            ((share, "within [0, 1]"), (at_least, "finite and at least 0"), (above, "finite and above 0"));
        for (key, value, (allowed, domain)) in [
            ("stray", self.stray, share),
            ("resets", self.resets, share),
            ("lr", f64::from(self.lr), above),
            ("weight", self.weight, at_least),
            ("decay", self.decay, share),
        ] {
            if !allowed(value) {
                let value = value as f32; // as it was written
                return Err(format!("[train.demos.{key}]: {value} is not {domain}; correct it"));
            }
        }
        if self.batch_size == 0 || !self.batch_size.is_multiple_of(crate::learn::optimise::TILE) {
            return Err(format!(
                "[train.demos.batch_size]: {} is no multiple of 32; give 32 or more",
                self.batch_size
            ));
        }
        Ok(())
    }

    /// Weight of the demonstrations in the policy gradient after `updates` updates of a run of `of`, per row of them and of own experience.
    pub fn weight(&self, updates: u64, of: u64) -> f64 {
        let stretch = if self.decay_over_run { HUNDRED / of.max(1) as f64 } else { 1.0 };
        self.weight * self.decay.powf(updates as f64 * stretch)
    }
}

#[cfg(test)]
mod tests {
    use super::DemoSettings;

    /// 0.01 times 0.95 an update; over a run of a thousand, a tenth of that an update.
    #[test]
    fn the_weight_decays_by_update_or_over_the_run() {
        let literal = DemoSettings::default();
        assert!((literal.weight(2, 1000) - 0.01 * 0.95 * 0.95).abs() < 1e-12);
        let over = DemoSettings { decay_over_run: true, ..literal };
        assert!((over.weight(1000, 1000) - 0.01 * 0.95f64.powi(100)).abs() < 1e-12);
        assert!((over.weight(20, 1000) - 0.01 * 0.95f64.powi(2)).abs() < 1e-12);
    }

    #[test]
    fn numbers_with_which_nothing_is_learned_are_refused_by_name() {
        for (wrong, words) in [
            (DemoSettings { resets: 1.5, ..DemoSettings::default() }, "[train.demos.resets]: 1.5 is not"),
            (
                DemoSettings { lr: 0.0, ..DemoSettings::default() },
                "[train.demos.lr]: 0 is not finite and above 0",
            ),
            (DemoSettings { batch_size: 33, ..DemoSettings::default() }, "[train.demos.batch_size]: 33"),
        ] {
            let error = wrong.check().expect_err("refused");
            assert!(error.starts_with(words), "{error}");
        }
    }
}
