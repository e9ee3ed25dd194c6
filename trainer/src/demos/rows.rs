//! Demonstrations in network space, as the losses read them, and as states to begin an episode from.

use super::Demonstrations;
use crate::learn::Batch;
use crate::stats::RunningStats;
use nearl_runtime::normaliser::{CLIP, Normaliser};

/// A demonstrated state from which the expert went on.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Configuration (nq), MuJoCo's convention.
    pub qpos: Vec<f64>,
    /// Velocity (nv), MuJoCo's convention.
    pub qvel: Vec<f64>,
    /// Time since the episode began \[s\].
    pub time: f64,
    /// What is followed of the observation one step later.
    pub next: Vec<f64>,
    /// Steps that the demonstration goes on for, at least 1.
    pub left: usize,
}

/// Every state from which an expert went on, episode by episode.
#[derive(Clone, Debug, PartialEq)]
pub struct Frames {
    /// All but the last state of each episode.
    pub frames: Vec<Frame>,
    /// Observation index of each entry that is followed.
    pub followed: Vec<usize>,
    /// Standard deviation of each of these over the demonstrations, at least [`MIN_UNIT`] \[rad, m\].
    pub units: Vec<f64>,
}

/// Least unit of an entry that the demonstrations hardly move \[rad, m\].
pub const MIN_UNIT: f64 = 0.05;

/// How names of speeds begin. They jitter with every action, and follow where positions do.
const SPEED: &str = "v.";

impl Demonstrations {
    /// Transitions.
    pub fn n_steps(&self) -> usize {
        self.episodes.iter().map(|e| e.length).sum()
    }

    /// The first `n` episodes; all with 0.
    ///
    /// # Errors
    /// More than there are.
    pub fn first(mut self, n: usize) -> Result<Self, String> {
        let all = self.episodes.len();
        if n > all {
            return Err(format!(
                "train.demos.episodes asks for {n} episodes, and the file has {all}; give at most {all}, or 0 for all of them"
            ));
        }
        if n > 0 {
            self.episodes.truncate(n);
        }
        Ok(self)
    }

    /// Every state from which an expert went on, with what is to be followed of the one after it: of the proposed entries `state` (indices
    /// into the observation) all that are no speeds, or all where there is nothing else.
    pub fn frames(&self, state: &[usize]) -> Frames {
        let width = self.names.len();
        let (speeds, places): (Vec<_>, Vec<_>) =
            state.iter().partition(|&&k| self.names[k].starts_with(SPEED));
        let followed: Vec<usize> = if places.is_empty() { speeds } else { places };
        let mut frames = Vec::with_capacity(self.n_steps());
        let mut stats = RunningStats::new(followed.len());
        for e in &self.episodes {
            let (nq, nv) = (e.qpos.len() / (e.length + 1), e.qvel.len() / (e.length + 1));
            let entries =
                e.observations.chunks_exact(width).map(|row| followed.iter().map(|&k| row[k]).collect());
            let entries: Vec<Vec<f64>> = entries.collect();
            entries.iter().for_each(|row| _ = stats.push(row));
            let states = e.qpos.chunks_exact(nq).zip(e.qvel.chunks_exact(nv));
            for (t, ((q, v), next)) in states.zip(entries.into_iter().skip(1)).enumerate() {
                let time = t as f64 * self.dt;
                frames.push(Frame { qpos: q.to_vec(), qvel: v.to_vec(), time, next, left: e.length - t });
            }
        }
        Frames { frames, followed, units: stats.std(MIN_UNIT) }
    }

    /// Each transition as observation, change of the proposed entries `state` (indices into the observation) and action, in the units of
    /// `normaliser`. The transitions come round again until the rows are a multiple of `multiple`.
    pub fn batch(&self, normaliser: &Normaliser, state: &[usize], multiple: usize) -> Batch {
        let (width, n) = (self.names.len(), self.n_steps());
        let mut x = vec![0.0f32; width];
        let rows = n.next_multiple_of(multiple);
        let mut b = Batch { n: rows, advantage: vec![0.0; rows], ..Batch::default() };
        for e in &self.episodes {
            let n_act = e.actions.len() / e.length.max(1);
            for t in 0..e.length {
                let [now, next] = [t, t + 1].map(|t| &e.observations[t * width..][..width]);
                normaliser.observation(now, &mut x);
                b.obs.extend_from_slice(&x);
                let change =
                    |(&k, scale): (&usize, &f64)| ((next[k] - now[k]) / scale).clamp(-CLIP, CLIP) as f32;
                b.reached.extend(state.iter().zip(&normaliser.scale).map(change));
                b.action.extend(e.actions[t * n_act..][..n_act].iter().map(|&a| a as f32));
            }
        }
        let n_act = b.action.len() / n.max(1);
        for (list, width) in [(&mut b.obs, width), (&mut b.reached, state.len()), (&mut b.action, n_act)] {
            for i in n * width..b.n * width {
                list.push(list[i - n * width]);
            }
        }
        b
    }
}
