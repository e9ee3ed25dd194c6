//! `nearl train`: collect, estimate advantages, update, write. The loop of every algorithm.

mod advice;
mod columns;
mod imitation;
mod ranked;
mod resume;
mod run;
mod served;
mod setup;
mod source;
mod start_from;

pub use advice::{advice, ends_in_warm_up, unread};
pub(crate) use advice::{beginnings, demonstrated};
pub use columns::COLUMNS;
pub use ranked::RankedSource;
pub use run::{resume, resume_on, train, train_in, train_on};
pub use served::{PATIENCE as SERVER_PATIENCE, ServedError, ServedSource};
pub use setup::{complete, limit_scale};
pub use source::{Experience, Source, SourceError};

use crate::checkpoint::CheckpointError;
use crate::demos::DemoError;
use crate::evaluate::evaluate_by;
use crate::learn::{Algorithm, Batch, Dims, Learner, Metrics, Pace, Params, Stretch, UnknownAlgorithm};
use crate::rollout::{Collected, RolloutError, Scorer, Segment, Tally, WHERE_TO_LOOK, nth, stream};
use crate::run_folder::RunError;
use crate::settings::{ChangeScale, TrainSettings};
use crate::stats::RunningStats;
use imitation::Imitation;
use nearl_rollout_protocol::Layout;
use nearl_runtime::controller::{Parts, merge_margins};
use nearl_runtime::normaliser::Normaliser;
use nearl_runtime::snapshot::FAR;
use nearl_runtime::task::Task;
use nearl_runtime::{Controller, Manifest, Networks, PolicyKind, Snapshot, SnapshotError};
use rand_chacha::ChaCha8Rng;
use setup::{
    check_cost, check_experience, check_minibatch, check_outputs, check_reward, check_warm_up, dims, learner,
    policy_kind, warm_up_steps,
};
use std::sync::Arc;
use std::time::Instant;

/// Why a training could not start or go on.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// An algorithm that does not exist.
    #[error(transparent)]
    Algorithm(#[from] UnknownAlgorithm),
    /// The `[train]` section, or what does not fit the task.
    #[error("{0}")]
    Settings(String),
    /// Demonstrations.
    #[error(transparent)]
    Demos(#[from] DemoError),
    /// Rollouts.
    #[error(transparent)]
    Rollout(#[from] RolloutError),
    /// Where experience comes from.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// The run folder.
    #[error(transparent)]
    Run(#[from] RunError),
    /// The snapshot.
    #[error(transparent)]
    Snapshot(#[from] SnapshotError),
    /// The checkpoint.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// An observation that is no number of a robot.
    #[error(
        "the observation '{observation}' has a mean or a standard deviation of {value:e}, and none counts beyond {FAR:e}; scale that entry of state.observation"
    )]
    Far {
        /// As the task names it.
        observation: String,
        /// The statistic.
        value: f64,
    },
    /// An update left weights that are no numbers, or huge.
    #[error(
        "the training diverged after {steps} steps: tensor '{tensor}' has {value} at index {index}; train anew with a smaller train.ppo.lr, or another seed"
    )]
    Diverged {
        /// Steps before that update.
        steps: u64,
        /// The tensor of a snapshot.
        tensor: String,
        /// Where in it.
        index: usize,
        /// What is there.
        value: f64,
    },
}

/// What to train.
#[derive(Clone, Debug)]
pub struct Request {
    /// The task with its robot.
    pub manifest: Manifest,
    /// Algorithm.
    pub algo: Algorithm,
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

/// A training in progress.
pub struct Training {
    algo: Algorithm,
    settings: TrainSettings,
    snapshot: Snapshot,
    learner: Box<dyn Learner>,
    source: Box<dyn Source>,
    imitation: Option<Imitation>,
    /// Batches of the warm-up, after the first.
    warm_ups: u64,
    /// It started from the networks of another training.
    starts_warm: bool,
    origin: Option<serde_json::Value>,
    /// What gives rewards in the task's place.
    scorer: Option<Scorer>,
    /// The last batch: its memory is used again.
    batch: Batch,
    /// Return of the best networks so far without noise, and whether they are the present ones.
    best: Option<f64>,
    is_best: bool,
    dims: Dims,
    obs_stats: RunningStats,
    privileged_stats: RunningStats,
    change_stats: RunningStats,
    return_stats: RunningStats,
    cost_stats: RunningStats,
    rng: ChaCha8Rng,
    total: u64,
    seed: u64,
    recent: Vec<(f64, usize)>,
    recent_costs: Vec<f64>,
    /// What the environment tells of its episodes, by name.
    notes: Vec<String>,
    begin: Instant,
    /// Seconds of this training in earlier processes.
    earlier: f64,
    learning_seconds: f64,
}

/// Column of what an evaluation on the way finds.
pub(crate) const EVALUATED: &str = "eval/ep_rew_mean";
/// Seeds of evaluations on the way differ from those of training in these bits.
const EVALUATION: u64 = 0x6576_616c;

/// Random streams of a seed beyond the environments' own.
const LEARNER_STREAM: u64 = u64::MAX;

impl Training {
    /// Checks everything and makes environments, networks and statistics.
    ///
    /// # Errors
    /// [`TrainError`] in one sentence.
    pub fn new(request: &Request) -> Result<Self, TrainError> {
        Self::on(request, &Experience::Here)
    }

    /// The same with experience from elsewhere.
    ///
    /// # Errors
    /// [`TrainError`] in one sentence.
    pub fn on(request: &Request, experience: &Experience) -> Result<Self, TrainError> {
        let mut manifest = request.manifest.clone();
        check_reward(&manifest.task, experience)?;
        let settings = TrainSettings::read(&manifest.task.train).map_err(TrainError::Settings)?;
        manifest.algo = request.algo.to_string();
        manifest.policy = policy_kind(request.algo, &settings, &manifest.task)?;
        check_warm_up(request.algo, &settings, manifest.policy)?;
        let spec = complete(&mut manifest)?;
        let parts = Parts::new(&manifest)?;
        let dims = dims(&manifest, &parts, spec.privileged.len())?;
        check_outputs(&manifest.task.name, &dims)?;
        check_cost(request.algo, &settings, &spec)?;
        check_experience(&settings, &manifest.task, experience)?;
        let batch = settings.n_envs * settings.n_steps;
        check_minibatch(settings.ppo.batch_size, batch)?;
        let warm_ups = warm_up_steps(request.algo, &settings, manifest.task.idm.kind).div_ceil(batch as u64);
        let state = parts.layout.state();
        let imitation = Imitation::read(request.algo, &settings, &manifest, state, request.steps, warm_ups)?;
        let mut rng = stream(request.seed, LEARNER_STREAM);
        manifest.activation = settings.nets.activation;
        let mut learner =
            learner(request.algo, &manifest, &settings, dims.clone(), request.threads, &mut rng);
        if let Experience::Ranks(ranks) = experience {
            let join = |params: &mut Params| {
                params.ranks = Some(Arc::clone(ranks));
                Ok(())
            };
            learner.restore(&mut { join }).map_err(TrainError::Settings)?;
        }
        let mut normaliser = Normaliser::identity(dims.n_obs, dims.n_state);
        if settings.change_scale == ChangeScale::Limits {
            normaliser.scale = limit_scale(&parts, &manifest)?;
        }
        let networks = learner.networks(&normaliser);
        let mut snapshot = Snapshot { manifest, networks };
        if snapshot.manifest.task.constraints.reached.is_some() {
            snapshot.networks.margins = Controller::new(&snapshot)?.learned_margins();
        }
        let sizes = Layout { n_obs: dims.n_obs, n_state: dims.n_state, n_act: dims.n_act };
        let mut source = experience.open(&snapshot, sizes, &settings, request.threads, request.seed)?;
        let (mut obs_stats, mut change_stats) =
            (RunningStats::new(dims.n_obs), RunningStats::new(dims.n_state));
        if let Some(imitation) = &imitation {
            imitation.place(&mut *source)?;
            imitation.seed(&mut obs_stats, &mut change_stats);
        }
        Ok(Self {
            obs_stats,
            privileged_stats: RunningStats::new(dims.n_privileged),
            change_stats,
            return_stats: RunningStats::new(1),
            cost_stats: RunningStats::new(1),
            algo: request.algo,
            settings,
            snapshot,
            learner,
            source,
            imitation,
            warm_ups,
            starts_warm: false,
            origin: None,
            scorer: match experience {
                Experience::Scored(scorer) => Some(scorer.clone()),
                _ => None,
            },
            batch: Batch::default(),
            best: None,
            is_best: false,
            dims,
            rng,
            total: request.steps,
            seed: request.seed,
            recent: Vec::new(),
            recent_costs: Vec::new(),
            notes: spec.notes,
            begin: Instant::now(),
            earlier: 0.0,
            learning_seconds: 0.0,
        })
    }

    /// [`Training::try_iterate`] on environments of this process, which neither fail nor stop.
    ///
    /// # Panics
    /// When the experience comes from elsewhere and ends.
    pub fn iterate(&mut self) -> Progress {
        match self.try_iterate() {
            Ok(Some(progress)) => progress,
            Ok(None) => panic!("the source of experience was stopped"),
            Err(e) => panic!("{e}"),
        }
    }

    /// Collects and learns once; `None` if a stop came before the batch was full. The first batch only fills the statistics of
    /// observations, changes and returns.
    ///
    /// # Errors
    /// [`TrainError::Source`].
    pub fn try_iterate(&mut self) -> Result<Option<Progress>, TrainError> {
        self.is_best = false;
        self.source.project(self.limits());
        if !self.source.collect(&self.snapshot)? {
            return Ok(None);
        }
        // a cost that is only counted spoils nothing that is learned
        let reads_cost = self.settings.cost.is_limited();
        let bad = |g: &&Collected| {
            let costs = g.segment.cost.iter().map(|x| ("cost", x)).filter(|_| reads_cost);
            let mut read = g.segment.reward.iter().map(|x| ("reward", x)).chain(costs);
            read.find(|(_, x)| !x.is_finite()).map(|(what, x)| (what, *x))
        };
        let (task, steps) = (&self.snapshot.manifest.task, self.snapshot.manifest.steps);
        if let Some((what, value)) = self.source.gathered().iter().find_map(|g| unseen(g, task)) {
            return Err(TrainError::Settings(format!(
                "{what} of '{}' came out as {value} after {steps} steps, and nothing can be learned from it; {WHERE_TO_LOOK}",
                task.name
            )));
        }
        if let Some((what, value)) = self.source.gathered().iter().find_map(bad) {
            let task = &task.name;
            return Err(TrainError::Settings(format!(
                "a {what} of '{task}' came out as {value} after {steps} steps, and nothing can be learned from it; look for a logarithm, root or \
                 quotient in [{what}] that leaves its domain"
            )));
        }
        let mut tally = Tally::default();
        self.source.gathered().iter().for_each(|g| tally.add(&g.tally));
        if tally.faults > 0 && tally.faults >= tally.ticks {
            let task = &self.snapshot.manifest.task.name;
            return Err(TrainError::Settings(format!(
                "the physics of '{task}' failed in all {} control periods of a batch, and nothing can be learned from it; look at [reset] and at \
                 the robot file's timestep",
                tally.ticks
            )));
        }
        self.recent.extend_from_slice(&tally.episodes);
        let excess = self.recent.len().saturating_sub(100);
        self.recent.drain(..excess);
        self.recent_costs.extend_from_slice(&tally.costs);
        self.recent_costs.drain(..excess);
        let pace = self.pace();
        let learns = self.snapshot.manifest.steps > 0;
        self.merge_statistics();
        let mut metrics = if learns {
            self.fill_batch();
            let start = Instant::now();
            let metrics = self.learn(pace);
            self.learning_seconds += start.elapsed().as_secs_f64();
            metrics
        } else {
            Metrics::new()
        };
        metrics.extend(self.source.notes());
        if self.imitation.as_ref().is_some_and(Imitation::is_tracked) {
            let rewards =
                self.source.gathered().into_iter().flat_map(|g| g.segment.reward.iter()).sum::<f64>();
            metrics
                .push(("tracking/reward", rewards / (self.settings.n_envs * self.settings.n_steps) as f64));
        }
        let (last, steps) = (self.snapshot.networks.clone(), self.snapshot.manifest.steps);
        self.snapshot.manifest.steps += (self.settings.n_envs * self.settings.n_steps) as u64;
        self.snapshot.manifest.version += 1;
        self.refresh();
        if let Err(error) = self.snapshot.networks.check() {
            self.snapshot.networks = last;
            self.snapshot.manifest.steps = steps;
            self.snapshot.manifest.version -= 1;
            return Err(match error {
                SnapshotError::Value { name: tensor, index, value } => {
                    TrainError::Diverged { steps, tensor, index, value }
                }
                SnapshotError::Far { name, index, value } if name != "normaliser.scale" => {
                    let names = &self.snapshot.manifest.task.state.observation;
                    let observation = names.get(index).cloned().unwrap_or_else(|| index.to_string());
                    TrainError::Far { observation, value }
                }
                other => other.into(),
            });
        }
        metrics.extend(self.pretrain());
        if self.passed(self.settings.eval_every) {
            metrics.push((EVALUATED, self.evaluate()?));
        }
        let mean =
            |f: fn(&(f64, usize)) -> f64| self.recent.iter().map(f).sum::<f64>() / self.recent.len() as f64;
        Ok(Some(Progress {
            steps: self.snapshot.manifest.steps,
            seconds: self.seconds(),
            return_mean: mean(|e| e.0),
            length_mean: mean(|e| e.1 as f64),
            cost_mean: self.recent_costs.iter().sum::<f64>() / self.recent_costs.len() as f64,
            tally,
            metrics,
        }))
    }

    /// An update from the batch, or a part of the warm-up.
    fn learn(&mut self, pace: Pace) -> Metrics {
        let iterations = self.snapshot.manifest.version;
        if iterations <= self.warm_ups {
            return self.learner.warm_up(&self.batch, &mut self.rng);
        }
        let Some(imitation) = &self.imitation else {
            return self.learner.update(&mut self.batch, pace, &mut self.rng);
        };
        if let Some(imitator) = self.learner.imitator() {
            let rows = imitation.batch(&self.snapshot.networks.normaliser);
            imitator.see(rows, imitation.weight(iterations));
        }
        let mut metrics = self.learner.update(&mut self.batch, pace, &mut self.rng);
        if self.algo.weighs_demonstrations() {
            metrics.push(("demos/weight", imitation.weight(iterations)));
        }
        metrics
    }

    /// Learns from the demonstrations alone, once, when the warm-up is over.
    fn pretrain(&mut self) -> Metrics {
        let now = self.imitation.as_ref().filter(|i| i.pretrains(self.snapshot.manifest.version));
        let (Some(imitation), Some(imitator)) = (now, self.learner.imitator()) else {
            return Metrics::new();
        };
        let normaliser = &self.snapshot.networks.normaliser;
        imitator.see(imitation.batch(normaliser), 0.0);
        let (metrics, normaliser) = (imitator.pretrain(&mut self.rng), normaliser.clone());
        self.renew(&normaliser);
        metrics
    }

    /// Asks for `steps` more than were done so far.
    pub fn extend(&mut self, steps: u64) {
        self.total = self.snapshot.manifest.steps + steps;
        if let Some(imitation) = &mut self.imitation {
            imitation.extend(self.total);
        }
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

    /// What each environment collected last, in a fixed order.
    pub fn segments(&mut self) -> impl Iterator<Item = &Segment> {
        self.source.gathered().into_iter().map(|g| &g.segment)
    }

    /// Seconds of training, those before a resume included.
    fn seconds(&self) -> f64 {
        self.earlier + self.begin.elapsed().as_secs_f64()
    }

    /// Seconds spent in updates.
    pub fn learning_seconds(&self) -> f64 {
        self.learning_seconds
    }

    /// Whether the last iteration passed a multiple of `every` steps; never with 0.
    fn passed(&self, every: u64) -> bool {
        let (steps, batch) =
            (self.snapshot.manifest.steps, (self.settings.n_envs * self.settings.n_steps) as u64);
        every > 0 && steps / every > (steps - batch) / every
    }

    /// Mean return of episodes without noise, the same ones each time; under the limits wherever the policy proposes.
    fn evaluate(&mut self) -> Result<f64, TrainError> {
        let (scorer, episodes) = (self.scorer.clone(), self.settings.eval_episodes);
        let found =
            evaluate_by(scorer, &self.snapshot, episodes, self.seed ^ EVALUATION, true)?.mean_return();
        self.is_best = found.is_finite() && self.best.is_none_or(|best| found > best);
        if self.is_best {
            self.best = Some(found);
        }
        Ok(found)
    }

    /// What the schedules of the run say now.
    fn pace(&self) -> Pace {
        let (s, done) = (&self.settings, self.fraction());
        let towards = |end: f64| (1.0 - done * (1.0 - end)) as f32;
        let rate = if s.anneal { towards(s.anneal_to) } else { 1.0 };
        Pace { rate, clip: towards(f64::from(s.ppo.clip_to)) }
    }

    /// Share of the environments that project while collecting.
    fn limits(&self) -> f64 {
        let s = &self.settings;
        match (s.project_in_training, s.limits_in > 0.0) {
            (false, _) => 0.0,
            (true, false) => 1.0,
            (true, true) => (self.fraction() / s.limits_in).min(1.0),
        }
    }

    fn merge_statistics(&mut self) {
        for g in self.source.gathered() {
            self.obs_stats.merge(&g.obs_stats);
            self.change_stats.merge(&g.change_stats);
            self.return_stats.merge(&g.return_stats);
            self.cost_stats.merge(&g.cost_stats);
            let rows = g.segment.privileged.chunks_exact(self.dims.n_privileged.max(1));
            rows.for_each(|row| _ = self.privileged_stats.push(row));
        }
        let gathered = self.source.gathered();
        let own = &mut self.snapshot.networks.margins;
        if let Some(margins) = merge_margins(gathered.iter().map(|g| &g.margins[..]))
            && margins.len() == own.len()
        {
            *own = margins;
        }
    }

    /// New networks and statistics for the next collection. What was learned from demonstrations stays what it was.
    fn refresh(&mut self) {
        let normaliser = self.normaliser();
        let iterations = self.snapshot.manifest.version;
        if self.imitation.is_some()
            && Imitation::carries(iterations)
            && let Some(imitator) = self.learner.imitator()
        {
            imitator.rescale(&self.snapshot.networks.normaliser, &normaliser);
        }
        self.renew(&normaliser);
    }

    /// The learner's networks in the snapshot; its margins stay.
    fn renew(&mut self, normaliser: &Normaliser) {
        let margins = std::mem::take(&mut self.snapshot.networks.margins);
        self.snapshot.networks = Networks { margins, ..self.learner.networks(normaliser) };
    }

    /// The statistics as they are.
    fn normaliser(&self) -> Normaliser {
        let scale = match self.settings.change_scale {
            ChangeScale::Running => self.change_stats.std(1e-4),
            ChangeScale::Limits => self.snapshot.networks.normaliser.scale.clone(),
        };
        let (mean, std) = match self.settings.normalise_obs {
            true => (self.obs_stats.mean.clone(), self.obs_stats.std(1e-4)),
            false => (vec![0.0; self.dims.n_obs], vec![1.0; self.dims.n_obs]),
        };
        Normaliser::new(mean, std, scale)
    }

    /// The collected segments as one batch with advantages.
    fn fill_batch(&mut self) {
        let n_steps = self.settings.n_steps;
        let proposes = self.snapshot.manifest.policy != PolicyKind::Direct;
        let length = self.recent.iter().map(|e| e.1 as f64).sum::<f64>() / self.recent.len() as f64;
        let cost: f64 = self.source.gathered().iter().flat_map(|g| &g.segment.cost).sum();
        let b = &mut self.batch;
        b.clear();
        b.n = self.settings.n_envs * n_steps;
        let (n_obs, n_privileged) = (self.dims.n_obs, self.dims.n_privileged);
        let stats = (&self.privileged_stats.mean, self.privileged_stats.std(1e-4));
        let for_value = |x: &[f32], privileged: &[f64], to: &mut Vec<f32>| {
            let moments = stats.0.iter().zip(&stats.1);
            to.extend_from_slice(x);
            to.extend(
                privileged.iter().zip(moments).map(|(p, (m, s))| ((p - m) / s).clamp(-10.0, 10.0) as f32),
            );
        };
        let scale = if self.settings.scale_reward { 1.0 / self.return_stats.std(1e-8)[0] } else { 1.0 };
        let cost_scale = self.settings.cost.is_limited().then(|| 1.0 / self.cost_stats.std(1e-8)[0]);
        b.episode_cost = cost / b.n as f64 * length;
        for g in self.source.gathered() {
            let s = &g.segment;
            b.obs.extend_from_slice(&s.x);
            if n_privileged > 0 {
                let rows = s.x.chunks_exact(n_obs).zip(s.privileged.chunks_exact(n_privileged));
                rows.for_each(|(x, privileged)| for_value(x, privileged, &mut b.seen_by_value));
            }
            if proposes {
                b.change.extend_from_slice(&s.change);
                b.target_change.extend_from_slice(&s.target_change);
                b.lower.extend_from_slice(&s.lower);
                b.upper.extend_from_slice(&s.upper);
            }
            b.reached.extend_from_slice(&s.reached);
            b.sampled.extend_from_slice(&s.sampled);
            b.action.extend_from_slice(&s.action);
            b.log_prob.extend_from_slice(&s.log_prob);
            let scaled = |of: &[f64], scale: f64| -> Vec<f32> {
                of.iter().map(|x| (x * scale).clamp(-10.0, 10.0) as f32).collect()
            };
            let reward = scaled(&s.reward, scale);
            let cost = cost_scale.map_or_else(Vec::new, |scale| scaled(&s.cost, scale));
            let mut final_obs = Vec::with_capacity(s.final_x.len() * (n_obs + n_privileged));
            for (i, (_, x)) in s.final_x.iter().enumerate() {
                for_value(x, &s.final_privileged[i * n_privileged..][..n_privileged], &mut final_obs);
            }
            let (terminated, truncated) = (s.terminated.clone(), s.truncated.clone());
            b.stretches.push(Stretch { reward, cost, terminated, truncated, final_obs });
        }
        b.discount = (self.settings.gamma as f32, self.settings.gae_lambda as f32);
        b.estimate(|x| self.learner.values(x));
        debug_assert_eq!(b.obs.len(), b.n * self.dims.n_obs);
    }
}

/// What policy or value saw that is no finite number, and that.
fn unseen(gathered: &Collected, task: &Task) -> Option<(String, f64)> {
    let privileged = || {
        let (k, value) = gathered.segment.privileged.iter().enumerate().find(|(_, x)| !x.is_finite())?;
        let names = &task.state.privileged;
        Some((format!("privileged '{}'", nth(names, k % names.len().max(1))), *value))
    };
    gathered.odd_observation(task).or_else(privileged)
}
