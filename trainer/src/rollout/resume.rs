//! Saves an environment in the middle of an episode, and goes on from there.
//!
//! What follows a start depends on it, the goal and the actions alone ([`Env::set_state`](crate::env::Env::set_state)), so the
//! episode is kept as these and played again: no part of a simulator's memory has to be known.

use super::Worker;
use crate::checkpoint::{Checkpoint, Values, WorkerHeader};
use crate::env::Env;

/// How the present episode came to be.
#[derive(Clone, Debug, Default)]
pub(super) struct Episode {
    qpos: Vec<f64>,
    qvel: Vec<f64>,
    goal: Vec<f64>,
    circumstances: Vec<f64>,
    /// Every action so far (ticks x n_act).
    actions: Vec<f64>,
}

impl Episode {
    /// A new episode of an environment that was just reset.
    pub(super) fn begin(&mut self, env: &dyn Env) {
        let set = |to: &mut Vec<f64>, from: &[f64]| {
            to.clear();
            to.extend_from_slice(from);
        };
        set(&mut self.qpos, env.qpos());
        set(&mut self.qvel, env.qvel());
        set(&mut self.goal, env.goal());
        self.circumstances = env.circumstances();
        self.actions.clear();
    }

    /// Remembers an action.
    pub(super) fn push(&mut self, action: &[f64]) {
        self.actions.extend_from_slice(action);
    }
}

impl Worker {
    /// Puts the state between two segments into `to` as environment `i`.
    pub(crate) fn save(&self, i: usize, to: &mut Checkpoint) -> Result<(), String> {
        let rng = u64::try_from(self.rng.get_word_pos()).map_err(|e| format!("random stream: {e}"))?;
        to.header.workers.push(WorkerHeader { rng, ticks: self.ticks, length: self.episode.1 });
        let e = &self.history;
        let mut put = |name: &str, values: Vec<f64>| {
            to.tensors.insert(format!("env.{i}.{name}"), Values::F64(values));
        };
        put("qpos", e.qpos.clone());
        put("qvel", e.qvel.clone());
        put("goal", e.goal.clone());
        put("circumstances", e.circumstances.clone());
        put("actions", e.actions.clone());
        put("sums", vec![self.episode.0, self.rows.discounted, self.cost]);
        if self.env.spec().has_cost {
            put("discounted_cost", vec![self.rows.discounted_cost]);
        }
        put("obs", self.state.obs.clone());
        put("projector", self.controller.memory());
        if let Some(d) = &self.demonstrated {
            put("from_frame", vec![f64::from(u8::from(d.from_frame)), d.began]);
            d.frame().into_iter().for_each(|at| put("frame", vec![at as f64]));
        }
        Ok(())
    }

    /// Plays the episode of environment `i` up to where it was saved.
    ///
    /// # Errors
    /// One sentence: what does not fit, or that the environment does not repeat the episode.
    pub(crate) fn restore(&mut self, i: usize, from: &mut Checkpoint) -> Result<(), String> {
        let WorkerHeader { rng, ticks, length } = from.header.workers[i];
        let spec = self.env.spec();
        let n_act = spec.n_act();
        let mut take = |name: &str, n: Option<usize>| from.take_f64(&format!("env.{i}.{name}"), n);
        self.history = Episode {
            qpos: take("qpos", Some(spec.nq))?,
            qvel: take("qvel", Some(spec.nv))?,
            goal: take("goal", Some(self.env.goal().len()))?,
            circumstances: take("circumstances", Some(self.env.circumstances().len()))?,
            actions: take("actions", ticks.checked_mul(n_act))?,
        };
        let (sums, obs) = (take("sums", Some(3))?, take("obs", Some(self.state.obs.len()))?);
        let discounted_cost = if spec.has_cost { take("discounted_cost", Some(1))?[0] } else { 0.0 };
        let memory = take("projector", Some(self.controller.memory().len()))?;
        if let Some(d) = &mut self.demonstrated {
            let from_frame = take("from_frame", Some(2))?;
            (d.from_frame, d.began) = (from_frame[0] == 1.0, from_frame[1]);
            if d.frame().is_some() {
                d.stand_at(take("frame", Some(1))?[0] as usize);
            }
        }
        let changed =
            || format!("environment {i} does not repeat its episode: task, robot or MuJoCo changed");
        let e = &self.history;
        self.env.set_circumstances(&e.circumstances);
        if !e.goal.is_empty() {
            self.env.set_goal(&e.goal).map_err(|e| e.to_string())?;
        }
        self.env.set_state(&e.qpos, &e.qvel).map_err(|e| e.to_string())?;
        if let Some(d) = &self.demonstrated {
            self.env.set_time(d.began);
        }
        for action in e.actions.chunks_exact(n_act.max(1)) {
            if self.env.step(action).terminated {
                return Err(changed());
            }
        }
        if !self.controller.set_memory(&memory) {
            return Err(changed());
        }
        self.observe();
        let bits = |x: &[f64]| x.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        if bits(&self.state.obs) != bits(&obs) {
            return Err(changed());
        }
        (self.episode, self.ticks) = ((sums[0], length), ticks);
        (self.rows.discounted, self.cost) = (sums[1], sums[2]);
        self.rows.discounted_cost = discounted_cost;
        self.rng.set_word_pos(rng.into());
        Ok(())
    }
}
