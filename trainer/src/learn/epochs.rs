//! The passes of an update over its batch: all in one go, or one at a time where something is done between them.

use super::Batch;
use super::optimise::{Params, PhaseReport, Phases, Schedule, optimise};
use super::ppo::PpoSettings;
use rand_chacha::ChaCha8Rng;

/// What the schedule of the run says of this update.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pace {
    /// Factor on the learning rates of policy and value.
    pub rate: f32,
    /// Factor on the clip range.
    pub clip: f32,
}

impl Default for Pace {
    fn default() -> Self {
        Self { rate: 1.0, clip: 1.0 }
    }
}

/// What the passes came to.
pub(super) struct Passes {
    /// Of each phase, averaged over the passes.
    pub(super) reports: Vec<PhaseReport>,
    /// Passes over the batch.
    pub(super) epochs: usize,
    /// Factor on the rates that these passes had ([`Params::adapted`]).
    pub(super) adapted: f32,
}

/// An update of policy, value and what learns beside them.
pub(super) struct Update<'a> {
    /// Settings of the surrogate.
    pub(super) ppo: &'a PpoSettings,
    /// What the schedule of the run says.
    pub(super) pace: Pace,
    /// Threads.
    pub(super) threads: usize,
    /// Phases to run.
    pub(super) phases: &'a [usize],
    /// The phase of the surrogate: its second sum is the divergence from the policy that collected.
    pub(super) actor: usize,
}

/// Largest and smallest learning rate that the divergence may ask for.
const RATES: [f32; 2] = [1e-5, 1e-2];

impl Update<'_> {
    /// Passes over the whole batch; of them all `ppo.n_epochs`, or fewer where the divergence grows beyond `ppo.target_kl`.
    /// `between` comes before each pass, which it is told, if it is `apart`.
    pub(super) fn run<P: Phases>(
        &self,
        algorithm: &mut P,
        params: &mut Params,
        batch: &mut Batch,
        rng: &mut ChaCha8Rng,
        apart: bool,
        mut between: impl FnMut(usize, &mut P, &Params, &mut Batch, &mut ChaCha8Rng),
    ) -> Passes {
        let ppo = self.ppo;
        let apart = apart || ppo.target_kl > 0.0 || ppo.desired_kl > 0.0;
        let n = if apart { ppo.n_epochs } else { 1 };
        let mut schedule = self.schedule();
        schedule.epochs = ppo.n_epochs / n;
        let adapted = params.adapted;
        let mut sum = vec![PhaseReport::default(); self.phases.len()];
        let (mut passes, mut divergence) = (0, 0.0);
        for pass in 0..n {
            if apart {
                between(pass, algorithm, params, batch, rng);
            }
            let reports = optimise(&*algorithm, params, batch, self.phases, schedule, rng);
            sum.iter_mut().zip(&reports).for_each(|(sum, report)| sum.add(report));
            passes += 1;
            let at = self.phases.iter().position(|phase| *phase == self.actor);
            divergence = at.map_or(0.0, |k| reports[k].mean[1]);
            if ppo.target_kl > 0.0 && divergence > f64::from(1.5 * ppo.target_kl) {
                break;
            }
        }
        sum.iter_mut().for_each(|report| report.average(passes as f64));
        self.adapt(params, divergence);
        Passes { reports: sum, epochs: passes * schedule.epochs, adapted }
    }

    /// All passes over the batch.
    pub(super) fn schedule(&self) -> Schedule {
        let Self { ppo, pace, threads, .. } = *self;
        let (epochs, minibatch) = (ppo.n_epochs, ppo.batch_size);
        Schedule { epochs, minibatch, threads, rate: pace.rate, clip: ppo.clip_range * pace.clip }
    }

    /// A rate for the next update that holds the divergence between half and twice `ppo.desired_kl`.
    fn adapt(&self, params: &mut Params, divergence: f64) {
        let wanted = f64::from(self.ppo.desired_kl);
        if wanted <= 0.0 {
            return;
        }
        let factor = if divergence > 2.0 * wanted {
            1.0 / 1.5
        } else if divergence < 0.5 * wanted {
            1.5
        } else {
            1.0
        };
        let [least, most] = RATES.map(|rate| rate / self.ppo.lr);
        params.adapted = (params.adapted * factor).clamp(least.min(1.0), most.max(1.0));
    }
}
