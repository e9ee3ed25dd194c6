//! The columns of `metrics.csv` and how an iteration fills them.

use super::{Progress, Training};
use crate::learn::Algorithm;

const REACHED: &str = "constraints/reached_violations";

/// Columns of `metrics.csv`: SB3's tags where they exist.
pub const COLUMNS: &[&str] = &[
    "time/total_timesteps",
    "time/seconds",
    "time/fps",
    "rollout/ep_rew_mean",
    "rollout/ep_len_mean",
    "rollout/ep_cost_mean",
    super::EVALUATED,
    "constraints/raw_violations",
    "constraints/target_violations",
    "constraints/recovering",
    REACHED,
    "constraints/moved",
    "constraints/distance",
    "constraints/avoided",
    "constraints/active_rows",
    "idm/residual",
    "idm/threshold",
    "idm/mse_before",
    "idm/mse_after",
    "idm/r2_before",
    "idm/r2_after",
    "idm/updated",
    "idm/divergence",
    "train/policy_gradient_loss",
    "train/approx_kl",
    "train/clip_fraction",
    "train/value_loss",
    "train/generator_loss",
    "train/clamped_fraction",
    "train/grad_norm",
    "train/std",
    "train/proposal_std",
    "train/policy_mse",
    "train/epochs",
    "train/learning_rate",
    "discriminator/loss",
    "discriminator/kl",
    "discriminator/accuracy",
    "discriminator/beta",
    "demos/cloning_mse",
    "demos/weight",
    "demos/loss",
    "likeness/loss",
    "likeness/accuracy",
    "likeness/reward",
    "tracking/reward",
    "cost/multiplier",
    "cost/value_loss",
];

impl Training {
    /// The progress as a row of `metrics.csv`.
    pub fn row(&self, p: &Progress) -> Vec<f64> {
        let t = &p.tally;
        let per_tick = |n: u64| n as f64 / t.ticks.max(1) as f64;
        // A policy on actions without a guard proposes nothing: nothing is projected, and no target is missed.
        let proposes = self.snapshot.manifest.proposes();
        let is_limited = proposes || self.snapshot.manifest.limits_actions();
        let of_limits = |name: &str| name.starts_with("constraints/") && name != REACHED;
        let value = |name: &str| match name {
            "idm/residual" if !proposes => f64::NAN,
            name if !is_limited && of_limits(name) => f64::NAN,
            "time/total_timesteps" => p.steps as f64,
            "time/seconds" => p.seconds,
            "time/fps" => p.steps as f64 / p.seconds,
            "rollout/ep_rew_mean" => p.return_mean,
            "rollout/ep_len_mean" => p.length_mean,
            "rollout/ep_cost_mean" => p.cost_mean,
            "constraints/raw_violations" => per_tick(t.raw_violations),
            "constraints/target_violations" => per_tick(t.target_violations),
            "constraints/recovering" => per_tick(t.recovering),
            REACHED => per_tick(t.reached_violations),
            "constraints/moved" => per_tick(t.moved),
            "constraints/distance" => t.distance / t.ticks.max(1) as f64,
            "constraints/avoided" => t.avoided as f64 / t.raw_violations as f64,
            "constraints/active_rows" => per_tick(t.active_rows),
            "idm/residual" => t.residual / t.ticks.max(1) as f64,
            "idm/threshold" => match self.algo {
                Algorithm::Nearl => self.settings.nearl.idm_threshold,
                _ => self.settings.pid2.idm_threshold,
            },
            other => p.metrics.iter().find(|(n, _)| *n == other).map_or(f64::NAN, |(_, v)| *v),
        };
        let episodes = t.episodes.len() as f64;
        let notes = (0..self.notes.len()).map(|i| t.notes.get(i).map_or(f64::NAN, |sum| sum / episodes));
        COLUMNS.iter().map(|c| value(c)).chain(notes).collect()
    }

    /// Columns of this training's `metrics.csv`: [`COLUMNS`], and what its environment tells of its episodes.
    pub fn columns(&self) -> Vec<&str> {
        COLUMNS.iter().copied().chain(self.notes.iter().map(String::as_str)).collect()
    }
}
