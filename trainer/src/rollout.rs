//! Vectorised constrained rollouts: many environments, each through its own [`Controller`], on all cores.
//!
//! Every environment has its own random stream and nothing is shared while they run, so a seed gives the
//! same bits whatever the number of threads.

use crate::env::{Env, EnvError, Fault};
use crate::stats::RunningStats;
use nearl_runtime::{Controller, Networks, Noise, Output, PolicyKind, Snapshot, SnapshotError, State};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Why rollouts could not start.
#[derive(Debug, thiserror::Error)]
pub enum RolloutError {
    /// The environment.
    #[error(transparent)]
    Env(#[from] EnvError),
    /// The snapshot.
    #[error(transparent)]
    Snapshot(#[from] SnapshotError),
    /// The task's observation is not the environment's.
    #[error(
        "task '{task}' observes {task_says}, but its environment gives {env_says}; leave state.observation out to use the environment's"
    )]
    Observation {
        /// Task.
        task: String,
        /// In the task file.
        task_says: String,
        /// In the environment.
        env_says: String,
    },
}

/// What one environment collected: `n_steps` policy steps, row by row.
#[derive(Clone, Debug, Default)]
pub struct Segment {
    /// Network inputs (n_steps x n_obs).
    pub x: Vec<f32>,
    /// Sampled proposal, normalised change (n_steps x n_state).
    pub change: Vec<f32>,
    /// Projected change (n_steps x n_state).
    pub target_change: Vec<f32>,
    /// Bounds of the projection (n_steps x n_state).
    pub lower: Vec<f32>,
    /// See `lower`.
    pub upper: Vec<f32>,
    /// Reached change (n_steps x n_state).
    pub reached: Vec<f32>,
    /// Sampled action (n_steps x n_act).
    pub sampled: Vec<f32>,
    /// Executed action (n_steps x n_act).
    pub action: Vec<f32>,
    /// Log probability of what was sampled (n_steps).
    pub log_prob: Vec<f32>,
    /// Reward (n_steps).
    pub reward: Vec<f64>,
    /// The episode ended in a terminal state (n_steps).
    pub terminated: Vec<bool>,
    /// The episode was cut, by time or by the end of the segment (n_steps).
    pub truncated: Vec<bool>,
    /// Network input of the true final observation of each cut step: step and (n_obs).
    pub final_x: Vec<(usize, Vec<f32>)>,
}

/// What was counted while collecting.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tally {
    /// Return and length in policy steps of each finished episode.
    pub episodes: Vec<(f64, usize)>,
    /// Cost of each finished episode.
    pub costs: Vec<f64>,
    /// Control ticks.
    pub ticks: u64,
    /// Ticks whose raw proposal broke a constraint.
    pub raw_violations: u64,
    /// Ticks that began with a controllable joint already outside its limits: the projection can only lead it back.
    pub recovering: u64,
    /// Ticks that began inside and whose target broke a constraint, by the independent checker.
    pub projected_violations: u64,
    /// Ticks in which the projection moved the proposal.
    pub moved: u64,
    /// Sum of the weighted distances moved.
    pub distance: f64,
    /// Ticks after which the simulator's own state was outside a position or velocity limit.
    pub reached_violations: u64,
    /// Sum over ticks of the mean |reached - target| of the controllable entries, in units of the scale of change.
    pub residual: f64,
    /// Periods the physics could not be believed.
    pub faults: u64,
}

impl Tally {
    fn add(&mut self, other: &Self) {
        self.episodes.extend_from_slice(&other.episodes);
        self.costs.extend_from_slice(&other.costs);
        self.ticks += other.ticks;
        self.raw_violations += other.raw_violations;
        self.recovering += other.recovering;
        self.projected_violations += other.projected_violations;
        self.moved += other.moved;
        self.distance += other.distance;
        self.reached_violations += other.reached_violations;
        self.residual += other.residual;
        self.faults += other.faults;
    }
}

/// One environment with its controller and its random stream.
pub struct Worker {
    env: Box<dyn Env>,
    controller: Controller,
    kind: PolicyKind,
    rng: ChaCha8Rng,
    state: State,
    before: Vec<f64>,
    noise: Noise,
    out: Output,
    scale: Vec<f64>,
    gamma: f64,
    discounted: f64,
    episode: (f64, usize),
    cost: f64,
    ticks: usize,
    /// The collected rows.
    pub segment: Segment,
    /// What was counted.
    pub tally: Tally,
    /// Raw observations of the segment.
    pub obs_stats: RunningStats,
    /// Changes of the proposed state in the segment.
    pub change_stats: RunningStats,
    /// Discounted returns in the segment, for scaling the reward.
    pub return_stats: RunningStats,
}

/// All workers of a training.
pub struct Collector {
    workers: Vec<Mutex<Worker>>,
    threads: usize,
    n_steps: usize,
}

/// Makes the environment of a snapshot's task and checks that its observation is the task's.
///
/// # Errors
/// [`RolloutError`].
pub fn make_env(snapshot: &Snapshot) -> Result<Box<dyn Env>, RolloutError> {
    let task = &snapshot.manifest.task;
    let env = crate::env::of_task(task, &snapshot.manifest.model, &task.name)?;
    if env.spec().obs != task.state.observation {
        return Err(RolloutError::Observation {
            task: task.name.clone(),
            task_says: task.state.observation.join(" "),
            env_says: env.spec().obs.join(" "),
        });
    }
    Ok(env)
}

impl Collector {
    /// `n_envs` environments that collect `n_steps` policy steps each, on `threads` threads.
    ///
    /// # Errors
    /// [`RolloutError`].
    pub fn new(
        snapshot: &Snapshot,
        n_envs: usize,
        n_steps: usize,
        threads: usize,
        gamma: f64,
        seed: u64,
    ) -> Result<Self, RolloutError> {
        let first = make_env(snapshot)?;
        let workers = (0..n_envs)
            .map(|i| Ok(Mutex::new(Worker::new(first.another()?, snapshot, gamma, stream(seed, i as u64))?)))
            .collect::<Result<Vec<_>, RolloutError>>()?;
        Ok(Self { workers, threads: threads.clamp(1, n_envs.max(1)), n_steps })
    }

    /// Hands new networks to every controller.
    pub fn set_networks(&mut self, networks: &Networks) {
        for w in &mut self.workers {
            let w = w.get_mut().unwrap_or_else(std::sync::PoisonError::into_inner);
            w.controller.set_networks(networks);
            w.scale.clone_from(&networks.normaliser.scale);
        }
    }

    /// Collects one segment in every environment.
    pub fn collect(&mut self) {
        let next = AtomicUsize::new(0);
        let run = || {
            while let Some(worker) = self.workers.get(next.fetch_add(1, Ordering::Relaxed)) {
                worker.lock().unwrap_or_else(std::sync::PoisonError::into_inner).collect(self.n_steps);
            }
        };
        std::thread::scope(|s| {
            for _ in 1..self.threads {
                s.spawn(run);
            }
            run();
        });
    }

    /// The workers in a fixed order.
    pub fn workers(&mut self) -> impl Iterator<Item = &mut Worker> {
        self.workers.iter_mut().map(|w| w.get_mut().unwrap_or_else(std::sync::PoisonError::into_inner))
    }

    /// Sums what was counted in the last segment, in a fixed order.
    pub fn tally(&mut self) -> Tally {
        let mut sum = Tally::default();
        for w in self.workers() {
            sum.add(&w.tally);
        }
        sum
    }
}

/// Random stream `index` of a seed.
pub fn stream(seed: u64, index: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(index);
    rng
}

impl Worker {
    /// An environment at the start of an episode.
    ///
    /// # Errors
    /// [`RolloutError`].
    pub fn new(
        env: Box<dyn Env>,
        snapshot: &Snapshot,
        gamma: f64,
        rng: ChaCha8Rng,
    ) -> Result<Self, RolloutError> {
        let controller = Controller::new(snapshot)?;
        let n_state = controller.layout().n_state();
        let mut worker = Self {
            kind: snapshot.manifest.policy,
            state: controller.state(),
            before: vec![0.0; n_state],
            noise: controller.noise(),
            out: controller.output(),
            scale: snapshot.networks.normaliser.scale.clone(),
            obs_stats: RunningStats::new(controller.layout().n_obs()),
            change_stats: RunningStats::new(n_state),
            return_stats: RunningStats::new(1),
            env,
            controller,
            rng,
            gamma,
            discounted: 0.0,
            episode: (0.0, 0),
            cost: 0.0,
            ticks: 0,
            segment: Segment::default(),
            tally: Tally::default(),
        };
        worker.restart()?;
        Ok(worker)
    }

    /// Switches the projection, for comparisons.
    pub fn set_projection(&mut self, on: bool) {
        self.controller.set_projection(on);
    }

    fn restart(&mut self) -> Result<(), EnvError> {
        self.env.reset(&mut self.rng)?;
        self.controller.reset();
        (self.episode, self.cost, self.ticks, self.discounted) = ((0.0, 0), 0.0, 0, 0.0);
        self.observe();
        Ok(())
    }

    fn observe(&mut self) {
        self.env.observe(&mut self.state.obs);
        self.env.state(&mut self.state.q, &mut self.state.v);
    }

    fn clear(&mut self) {
        let s = &mut self.segment;
        for column in
            [&mut s.x, &mut s.change, &mut s.target_change, &mut s.lower, &mut s.upper, &mut s.reached]
        {
            column.clear();
        }
        s.sampled.clear();
        s.action.clear();
        s.log_prob.clear();
        s.reward.clear();
        s.terminated.clear();
        s.truncated.clear();
        s.final_x.clear();
        self.tally = Tally::default();
        for stats in [&mut self.obs_stats, &mut self.change_stats, &mut self.return_stats] {
            stats.clear();
        }
    }

    /// Collects `n_steps` policy steps.
    pub fn collect(&mut self, n_steps: usize) {
        self.clear();
        for t in 0..n_steps {
            self.draw(true);
            let (reward, terminated) = self.policy_step();
            let truncated = self.ticks >= self.env.spec().max_episode_steps;
            self.store(reward, terminated, truncated && !terminated, t, t + 1 == n_steps);
            if terminated || truncated {
                self.tally.episodes.push(self.episode);
                self.tally.costs.push(self.cost);
                // the same draws for a reset whatever happened before: an error here is a broken installation
                self.restart().unwrap_or_else(|e| panic!("{e}"));
            }
        }
    }

    /// One episode without noise: return and length in policy steps.
    pub fn evaluate(&mut self) -> (f64, usize) {
        self.clear();
        self.draw(false);
        loop {
            let (_, terminated) = self.policy_step();
            if terminated || self.ticks >= self.env.spec().max_episode_steps {
                let episode = self.episode;
                self.tally.costs.push(self.cost);
                self.restart().unwrap_or_else(|e| panic!("{e}"));
                return episode;
            }
        }
    }

    fn draw(&mut self, explore: bool) {
        let normal = |rng: &mut ChaCha8Rng| if explore { StandardNormal.sample(rng) } else { 0.0 };
        match self.kind {
            PolicyKind::Stochastic => self.noise.proposal.fill_with(|| normal(&mut self.rng)),
            _ => self.noise.action.fill_with(|| normal(&mut self.rng)),
        }
    }

    /// One proposal and the control ticks it spans.
    fn policy_step(&mut self) -> (f64, bool) {
        for (b, &i) in self.before.iter_mut().zip(self.controller.layout().state()) {
            *b = self.state.obs[i];
        }
        let mut reward = 0.0;
        for _ in 0..self.controller.policy_every() {
            let (r, terminated) = self.tick();
            reward += r;
            if terminated || self.ticks >= self.env.spec().max_episode_steps {
                self.finish_step(reward);
                return (reward, terminated);
            }
        }
        self.finish_step(reward);
        (reward, false)
    }

    fn finish_step(&mut self, reward: f64) {
        self.episode.0 += reward;
        self.episode.1 += 1;
        self.discounted = self.discounted * self.gamma + reward;
    }

    fn tick(&mut self) -> (f64, bool) {
        self.controller.update(&self.state, &self.noise, &mut self.out);
        let step = self.env.step(&self.out.action);
        self.ticks += 1;
        self.cost += step.cost;
        self.observe();
        let ledger = &self.out.next.ledger;
        self.tally.ticks += 1;
        self.tally.raw_violations += u64::from(ledger.raw_violations.total() > 0);
        self.tally.recovering += u64::from(ledger.outside > 0);
        self.tally.projected_violations += u64::from(ledger.violations.total() > 0 && ledger.outside == 0);
        self.tally.moved += u64::from(ledger.moved > 0.0);
        self.tally.distance += ledger.moved;
        self.tally.faults += u64::from(step.fault != Fault::None);
        self.tally.reached_violations += u64::from(self.controller.breaks_limits(&self.state));
        self.tally.residual += self.residual();
        (step.reward, step.terminated)
    }

    /// Mean |reached - target| over the controllable entries, in units of the scale of change.
    fn residual(&self) -> f64 {
        let layout = self.controller.layout();
        let seen = layout.controllable_state();
        let miss =
            |&k: &usize| (self.state.obs[layout.state()[k]] - self.out.target[k]).abs() / self.scale[k];
        seen.iter().map(miss).sum::<f64>() / seen.len().max(1) as f64
    }

    fn store(&mut self, reward: f64, terminated: bool, truncated: bool, t: usize, last: bool) {
        let (s, out) = (&mut self.segment, &self.out);
        s.x.extend_from_slice(&out.x);
        s.change.extend_from_slice(&out.change);
        s.target_change.extend_from_slice(&out.target_change);
        s.lower.extend_from_slice(&out.lower);
        s.upper.extend_from_slice(&out.upper);
        s.sampled.extend_from_slice(&out.sampled);
        s.action.extend(out.action.iter().map(|&a| a as f32));
        s.log_prob.push((out.log_prob_proposal + out.log_prob_action) as f32);
        s.reward.push(reward);
        s.terminated.push(terminated);
        s.truncated.push(truncated || (last && !terminated));
        for k in 0..self.before.len() {
            self.before[k] = self.state.obs[self.controller.layout().state()[k]] - self.before[k];
            s.reached.push((self.before[k] / self.scale[k]).clamp(-10.0, 10.0) as f32);
        }
        self.change_stats.push(&self.before);
        self.obs_stats.push(&self.state.obs);
        self.return_stats.push(&[self.discounted]);
        if (truncated || last) && !terminated {
            let mut x = vec![0.0; out.x.len()];
            self.controller.normaliser().observation(&self.state.obs, &mut x);
            s.final_x.push((t, x));
        }
    }
}
