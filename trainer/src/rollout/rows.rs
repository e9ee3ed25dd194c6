//! Rows for the learner, policy step by policy step, wherever they were taken.

use super::Collected;
use nearl_runtime::normaliser::Normaliser;
use nearl_runtime::{Controller, Output};

/// Rows with what is counted beside them.
pub struct Rows {
    /// What was collected.
    pub collected: Collected,
    /// Observation index of each proposed entry.
    state: Vec<usize>,
    gamma: f64,
    /// What a unit of distance moved takes from the learner's reward.
    pub(super) moved_penalty: f64,
    /// Discounted return of the episode so far.
    pub(super) discounted: f64,
    /// The same of its cost.
    pub(super) discounted_cost: f64,
    change: Vec<f64>,
    /// Network input of the state after the last row, and what the value alone sees of it.
    after: Vec<f32>,
    after_privileged: Vec<f64>,
}

/// One policy step.
pub struct Period<'a> {
    /// What the controller put out in its last tick.
    pub out: &'a Output,
    /// Observation at its begin (n_obs).
    pub before: &'a [f64],
    /// Observation at its end (n_obs).
    pub after: &'a [f64],
    /// What the policy sees of its end, before the normaliser (n_seen).
    pub seen: &'a [f64],
    /// What the value alone sees at its begin and at its end (n_privileged each).
    pub privileged: [&'a [f64]; 2],
    /// The task's reward.
    pub reward: f64,
    /// The task's cost.
    pub cost: f64,
    /// Distance the projection moved the targets.
    pub moved: f64,
    /// The episode ended in a terminal state.
    pub terminated: bool,
    /// The episode was cut by time.
    pub truncated: bool,
}

impl Rows {
    /// No rows yet. `moved_penalty` is taken from the reward for each unit of distance moved [1 / (weight rad/s)].
    pub fn new(controller: &Controller, gamma: f64, moved_penalty: f64) -> Self {
        let layout = controller.layout();
        Self {
            collected: Collected::new(controller.n_seen(), layout.n_state()),
            state: layout.state().to_vec(),
            gamma,
            moved_penalty,
            discounted: 0.0,
            discounted_cost: 0.0,
            change: vec![0.0; layout.n_state()],
            after: vec![0.0; controller.n_seen()],
            after_privileged: Vec::new(),
        }
    }

    /// Rows so far.
    pub fn len(&self) -> usize {
        self.collected.segment.reward.len()
    }

    /// No rows yet.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Forgets rows and counts; the episode goes on.
    pub fn clear(&mut self) {
        self.collected.clear();
    }

    /// Adds a policy step.
    pub fn push(&mut self, p: &Period<'_>, normaliser: &Normaliser) {
        let reward = p.reward - self.moved_penalty * p.moved;
        self.discounted = self.discounted * self.gamma + reward;
        self.discounted_cost = self.discounted_cost * self.gamma + p.cost;
        for (change, &i) in self.change.iter_mut().zip(&self.state) {
            *change = p.after[i] - p.before[i];
        }
        let change = (&self.change[..], &normaliser.scale[..]);
        let sums = [(reward, self.discounted), (p.cost, self.discounted_cost)];
        self.collected.push(p.out, change, p.seen, sums, (p.terminated, false));
        normaliser.observation(p.seen, &mut self.after);
        let [before, after] = p.privileged;
        self.collected.segment.privileged.extend_from_slice(before);
        self.after_privileged.clear();
        self.after_privileged.extend_from_slice(after);
        if p.truncated && !p.terminated {
            self.cut();
        }
        if p.truncated || p.terminated {
            (self.discounted, self.discounted_cost) = (0.0, 0.0);
        }
    }

    /// Nothing follows the last row: its state gets a value, and no advantage flows across.
    pub fn cut(&mut self) {
        let (last, s) = (self.collected.segment.reward.len(), &mut self.collected.segment);
        if last > 0 && !s.terminated[last - 1] && !s.truncated[last - 1] {
            s.truncated[last - 1] = true;
            s.final_x.push((last - 1, self.after.clone()));
            s.final_privileged.extend_from_slice(&self.after_privileged);
        }
    }

    /// What comes next follows from nothing seen here.
    pub fn interrupt(&mut self) {
        self.cut();
        (self.discounted, self.discounted_cost) = (0.0, 0.0);
    }
}
