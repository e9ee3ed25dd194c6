//! `nearl train`: collect, estimate advantages, update, write. The loop of every algorithm.

use crate::learn::{Batch, Dims, Learner, Metrics, Pid2, Ppo, advantages};
use crate::rollout::{Collector, RolloutError, Tally, stream};
use crate::run_folder::{RunError, RunFolder};
use crate::settings::{ChangeScale, Exploration, TrainSettings};
use crate::stats::RunningStats;
use nearl_runtime::controller::{Parts, seen_entries};
use nearl_runtime::normaliser::Normaliser;
use nearl_runtime::task::IdmKind;
use nearl_runtime::{Manifest, PolicyKind, Snapshot, SnapshotError};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Names of the algorithms.
pub const ALGORITHMS: &[(&str, &str)] = &[
    ("ppo", "the paper's RL-Pure: a Gaussian policy on actions, nothing proposed or projected"),
    ("pid2-gan", "policy, inverse dynamics and a discriminator without a bottleneck"),
    ("pid2-ib", "policy, inverse dynamics and a discriminator with the information bottleneck"),
];

/// Why a training could not start or go on.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// An algorithm that does not exist.
    #[error("no algorithm '{0}'; give one of ppo, pid2-gan, pid2-ib")]
    Algorithm(String),
    /// The `[train]` section, or what does not fit the task.
    #[error("{0}")]
    Settings(String),
    /// Rollouts.
    #[error(transparent)]
    Rollout(#[from] RolloutError),
    /// The run folder.
    #[error(transparent)]
    Run(#[from] RunError),
    /// The snapshot.
    #[error(transparent)]
    Snapshot(#[from] SnapshotError),
}

/// What to train.
#[derive(Clone, Debug)]
pub struct Request {
    /// The task with its robot.
    pub manifest: Manifest,
    /// Name of the algorithm.
    pub algo: String,
    /// Environment steps (policy steps).
    pub steps: u64,
    /// Seed of everything random.
    pub seed: u64,
    /// Threads for rollouts and updates.
    pub threads: usize,
}

/// What one iteration tells.
#[derive(Clone, Debug)]
pub struct Progress {
    /// Steps so far.
    pub steps: u64,
    /// Seconds so far.
    pub seconds: f64,
    /// Mean return of the last 100 episodes; NaN before the first.
    pub return_mean: f64,
    /// Mean length of the last 100 episodes in policy steps.
    pub length_mean: f64,
    /// Mean cost of the last 100 episodes.
    pub cost_mean: f64,
    /// Counts of the iteration.
    pub tally: Tally,
    /// Numbers of the update.
    pub metrics: Metrics,
}

/// Columns of `metrics.csv`: SB3's tags where they exist.
pub const COLUMNS: &[&str] = &[
    "time/total_timesteps",
    "time/seconds",
    "time/fps",
    "rollout/ep_rew_mean",
    "rollout/ep_len_mean",
    "rollout/ep_cost_mean",
    "constraints/raw_violations",
    "constraints/target_violations",
    "constraints/recovering",
    "constraints/reached_violations",
    "constraints/moved",
    "constraints/distance",
    "idm/residual",
    "idm/threshold",
    "idm/mse_before",
    "idm/mse_after",
    "idm/updated",
    "train/policy_gradient_loss",
    "train/approx_kl",
    "train/clip_fraction",
    "train/value_loss",
    "train/generator_loss",
    "train/clamped_fraction",
    "train/grad_norm",
    "train/std",
    "discriminator/loss",
    "discriminator/kl",
    "discriminator/accuracy",
    "discriminator/beta",
];

/// A training in progress.
pub struct Training {
    settings: TrainSettings,
    snapshot: Snapshot,
    learner: Box<dyn Learner>,
    collector: Collector,
    dims: Dims,
    obs_stats: RunningStats,
    change_stats: RunningStats,
    return_stats: RunningStats,
    rng: rand_chacha::ChaCha8Rng,
    total: u64,
    recent: Vec<(f64, usize)>,
    recent_costs: Vec<f64>,
    begin: Instant,
    learning_seconds: f64,
}

/// Random streams of a seed beyond the environments' own.
const LEARNER_STREAM: u64 = u64::MAX;

impl Training {
    /// Checks everything and makes environments, networks and statistics.
    ///
    /// # Errors
    /// [`TrainError`] in one sentence.
    pub fn new(request: &Request) -> Result<Self, TrainError> {
        let mut manifest = request.manifest.clone();
        let settings = TrainSettings::read(&manifest.task.train).map_err(TrainError::Settings)?;
        manifest.algo.clone_from(&request.algo);
        manifest.policy = policy_kind(&request.algo, &settings, manifest.task.idm.kind)?;
        complete(&mut manifest)?;
        let parts = Parts::new(&manifest)?;
        let seen = seen_entries(&manifest, &parts.layout)?;
        let dims = Dims {
            n_obs: parts.layout.n_obs(),
            n_state: parts.layout.n_state(),
            n_act: manifest.action_lower.len(),
            seen_obs: seen.iter().map(|&k| parts.layout.state()[k]).collect(),
            seen_state: seen,
        };
        let batch = settings.n_envs * settings.n_steps;
        check_minibatch(settings.ppo.batch_size, batch)?;
        let mut rng = stream(request.seed, LEARNER_STREAM);
        let stochastic = manifest.policy == PolicyKind::Stochastic;
        let (ppo, pid2) = (settings.ppo.clone(), settings.pid2.clone());
        let learner: Box<dyn Learner> = match request.algo.as_str() {
            "ppo" => Box::new(Ppo::new(dims.clone(), ppo, request.threads, &mut rng)),
            name => Box::new(Pid2::new(
                dims.clone(),
                ppo,
                pid2,
                stochastic,
                name == "pid2-ib",
                request.threads,
                &mut rng,
            )),
        };
        let mut normaliser = Normaliser::identity(dims.n_obs, dims.n_state);
        if settings.change_scale == ChangeScale::Limits {
            normaliser.scale = limit_scale(&parts, &manifest)?;
        }
        let networks = learner.networks(&normaliser);
        let snapshot = Snapshot { manifest, networks };
        let mut collector = Collector::new(
            &snapshot,
            settings.n_envs,
            settings.n_steps,
            request.threads,
            settings.gamma,
            request.seed,
        )?;
        collector.workers().for_each(|w| w.set_projection(settings.project));
        Ok(Self {
            obs_stats: RunningStats::new(dims.n_obs),
            change_stats: RunningStats::new(dims.n_state),
            return_stats: RunningStats::new(1),
            settings,
            snapshot,
            learner,
            collector,
            dims,
            rng,
            total: request.steps,
            recent: Vec::new(),
            recent_costs: Vec::new(),
            begin: Instant::now(),
            learning_seconds: 0.0,
        })
    }

    /// Collects and learns once. The first batch only fills the statistics of observations, changes and returns.
    pub fn iterate(&mut self) -> Progress {
        self.collector.set_networks(&self.snapshot.networks);
        self.collector.collect();
        let tally = self.collector.tally();
        self.recent.extend_from_slice(&tally.episodes);
        let excess = self.recent.len().saturating_sub(100);
        self.recent.drain(..excess);
        self.recent_costs.extend_from_slice(&tally.costs);
        self.recent_costs.drain(..excess);
        let rate = if self.settings.anneal { 1.0 - self.fraction() as f32 } else { 1.0 };
        let learns = self.snapshot.manifest.steps > 0;
        self.merge_statistics();
        let metrics = if learns {
            let batch = self.batch();
            let start = Instant::now();
            let metrics = self.learner.update(&batch, rate, &mut self.rng);
            self.learning_seconds += start.elapsed().as_secs_f64();
            metrics
        } else {
            Metrics::new()
        };
        self.snapshot.manifest.steps += (self.settings.n_envs * self.settings.n_steps) as u64;
        self.snapshot.manifest.version += 1;
        self.refresh();
        let mean =
            |f: fn(&(f64, usize)) -> f64| self.recent.iter().map(f).sum::<f64>() / self.recent.len() as f64;
        Progress {
            steps: self.snapshot.manifest.steps,
            seconds: self.begin.elapsed().as_secs_f64(),
            return_mean: mean(|e| e.0),
            length_mean: mean(|e| e.1 as f64),
            cost_mean: self.recent_costs.iter().sum::<f64>() / self.recent_costs.len() as f64,
            tally,
            metrics,
        }
    }

    /// Asks for `steps` more than were asked for, or were done, so far.
    pub fn extend(&mut self, steps: u64) {
        self.total = self.total.max(self.snapshot.manifest.steps) + steps;
    }

    /// Whether the requested steps are done.
    pub fn is_done(&self) -> bool {
        self.snapshot.manifest.steps >= self.total
    }

    /// Done part of the requested steps, at most 1.
    pub fn fraction(&self) -> f64 {
        (self.snapshot.manifest.steps as f64 / self.total.max(1) as f64).min(1.0)
    }

    /// What a controller runs on now.
    pub fn snapshot(&self) -> &Snapshot {
        &self.snapshot
    }

    /// Seconds spent in updates.
    pub fn learning_seconds(&self) -> f64 {
        self.learning_seconds
    }

    fn merge_statistics(&mut self) {
        for w in self.collector.workers() {
            self.obs_stats.merge(&w.obs_stats);
            self.change_stats.merge(&w.change_stats);
            self.return_stats.merge(&w.return_stats);
        }
    }

    /// New networks and statistics for the next collection.
    fn refresh(&mut self) {
        let scale = match self.settings.change_scale {
            ChangeScale::Running => self.change_stats.std(1e-4),
            ChangeScale::Limits => self.snapshot.networks.normaliser.scale.clone(),
        };
        let normaliser =
            Normaliser { mean: self.obs_stats.mean.clone(), std: self.obs_stats.std(1e-4), scale };
        self.snapshot.networks = self.learner.networks(&normaliser);
    }

    /// The collected segments as one batch with advantages.
    fn batch(&mut self) -> Batch {
        let n_steps = self.settings.n_steps;
        let mut b = Batch { n: self.settings.n_envs * n_steps, ..Batch::default() };
        let scale = if self.settings.scale_reward { 1.0 / self.return_stats.std(1e-8)[0] } else { 1.0 };
        let mut cuts = Vec::new();
        for w in self.collector.workers() {
            let s = &w.segment;
            b.obs.extend_from_slice(&s.x);
            b.proposal.extend_from_slice(&s.change);
            b.lower.extend_from_slice(&s.lower);
            b.upper.extend_from_slice(&s.upper);
            b.reached.extend_from_slice(&s.reached);
            b.sampled.extend_from_slice(&s.sampled);
            b.action.extend_from_slice(&s.action);
            b.log_prob.extend_from_slice(&s.log_prob);
            let reward: Vec<f32> = s.reward.iter().map(|r| (r * scale).clamp(-10.0, 10.0) as f32).collect();
            let finals: Vec<f32> = s.final_x.iter().flat_map(|(_, x)| x.iter().copied()).collect();
            cuts.push((reward, finals, s.terminated.clone(), s.truncated.clone()));
        }
        let values = self.learner.values(&b.obs);
        for (i, (reward, finals, terminated, truncated)) in cuts.iter().enumerate() {
            let final_values = self.learner.values(finals);
            let (gamma, lambda) = (self.settings.gamma as f32, self.settings.gae_lambda as f32);
            let value = &values[i * n_steps..][..n_steps];
            let a = advantages(reward, value, terminated, truncated, &final_values, gamma, lambda);
            b.advantage.extend(a.advantage);
            b.returns.extend(a.returns);
        }
        debug_assert_eq!(b.obs.len(), b.n * self.dims.n_obs);
        b
    }

    /// The progress as a row of `metrics.csv`.
    pub fn row(&self, p: &Progress) -> Vec<f64> {
        let t = &p.tally;
        let per_tick = |n: u64| n as f64 / t.ticks.max(1) as f64;
        let value = |name: &str| match name {
            "time/total_timesteps" => p.steps as f64,
            "time/seconds" => p.seconds,
            "time/fps" => p.steps as f64 / p.seconds,
            "rollout/ep_rew_mean" => p.return_mean,
            "rollout/ep_len_mean" => p.length_mean,
            "rollout/ep_cost_mean" => p.cost_mean,
            "constraints/raw_violations" => per_tick(t.raw_violations),
            "constraints/target_violations" => per_tick(t.projected_violations),
            "constraints/recovering" => per_tick(t.recovering),
            "constraints/reached_violations" => per_tick(t.reached_violations),
            "constraints/moved" => per_tick(t.moved),
            "constraints/distance" => t.distance / t.ticks.max(1) as f64,
            "idm/residual" => t.residual / t.ticks.max(1) as f64,
            "idm/threshold" => self.settings.pid2.idm_threshold,
            other => p.metrics.iter().find(|(n, _)| *n == other).map_or(f64::NAN, |(_, v)| *v),
        };
        COLUMNS.iter().map(|c| value(c)).collect()
    }
}

fn policy_kind(algo: &str, settings: &TrainSettings, idm: IdmKind) -> Result<PolicyKind, TrainError> {
    match (algo, settings.exploration, idm) {
        ("ppo", ..) => Ok(PolicyKind::Direct),
        ("pid2-gan" | "pid2-ib", Exploration::Proposal, IdmKind::Pinocchio) => Ok(PolicyKind::Stochastic),
        ("pid2-gan" | "pid2-ib", Exploration::Action, IdmKind::Learned) => Ok(PolicyKind::Deterministic),
        ("pid2-gan" | "pid2-ib", Exploration::Action, IdmKind::Pinocchio) => Err(TrainError::Settings(
            "[train.exploration]: 'action' needs a learned inverse model, but idm.kind is 'pinocchio'; use exploration = \"proposal\"".into(),
        )),
        ("pid2-gan" | "pid2-ib", Exploration::Proposal, IdmKind::Learned) => Err(TrainError::Settings(
            "[train.exploration]: 'proposal' needs analytic inverse dynamics, but idm.kind is 'learned'; use exploration = \"action\"".into(),
        )),
        _ => Err(TrainError::Algorithm(algo.into())),
    }
}

/// Fills what the environment knows: observation names and the actuators' range.
///
/// # Errors
/// [`TrainError::Rollout`] when there is no such environment.
pub fn complete(manifest: &mut Manifest) -> Result<(), TrainError> {
    let env = crate::env::of_task(&manifest.task, &manifest.model, &manifest.task.name)
        .map_err(RolloutError::from)?;
    let spec = env.spec();
    if manifest.task.state.observation.is_empty() {
        manifest.task.state.observation.clone_from(&spec.obs);
    }
    manifest.action_lower = spec.action_low().collect();
    manifest.action_upper = spec.action_high().collect();
    Ok(())
}

fn check_minibatch(minibatch: usize, batch: usize) -> Result<(), TrainError> {
    if minibatch == 0
        || !minibatch.is_multiple_of(crate::learn::optimise::TILE)
        || !batch.is_multiple_of(minibatch)
    {
        return Err(TrainError::Settings(format!(
            "[train.ppo.batch_size]: {minibatch} must be a multiple of 32 that divides n_envs n_steps = {batch}"
        )));
    }
    Ok(())
}

/// What the limits allow in one policy period: `a_max T` for velocities, `v_max T` for positions.
fn limit_scale(parts: &Parts, manifest: &Manifest) -> Result<Vec<f64>, TrainError> {
    use nearl_runtime::constraints::Entry;
    let period = manifest.task.time.dt * manifest.task.time.policy_every as f64;
    let limits = parts.projector.limits();
    let (velocity, acceleration) = (&limits.velocity, &limits.acceleration);
    (0..parts.layout.n_state())
        .map(|k| {
            let scale = match parts.layout.state_entry(k) {
                Entry::Position { dof, .. } => velocity[dof] * period,
                Entry::Velocity { dof } => acceleration[dof] * period,
                Entry::Other => f64::INFINITY,
            };
            let name = parts.layout.state_name(k);
            if scale.is_finite() && scale > 0.0 {
                Ok(scale)
            } else {
                Err(TrainError::Settings(format!(
                    "[train.change_scale]: 'limits' needs a velocity and an acceleration limit for '{name}'; set [constraints] or use change_scale = \"running\""
                )))
            }
        })
        .collect()
}

/// Trains to the end in a run folder; `report` sees each iteration and may stop the training by returning `false`.
///
/// # Errors
/// [`TrainError`].
pub fn train(
    request: &Request,
    out: &Path,
    mut report: impl FnMut(&Progress, f64) -> bool,
) -> Result<PathBuf, TrainError> {
    let mut training = Training::new(request)?;
    let mut folder = RunFolder::create(out, &training.snapshot().manifest, request.seed, COLUMNS)?;
    let (mut next_save, every) = (request.steps / 10, (request.steps / 10).max(1));
    loop {
        let progress = training.iterate();
        folder.row(&training.row(&progress))?;
        let go_on = report(&progress, training.fraction());
        if training.is_done() || !go_on {
            break;
        }
        if progress.steps >= next_save {
            folder.save("latest", training.snapshot())?;
            next_save += every;
        }
    }
    Ok(folder.save("final", training.snapshot())?)
}
