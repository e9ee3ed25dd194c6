//! Demonstrations in network space, as the losses read them, and as states to begin an episode from.

use super::Demonstrations;
use crate::learn::Batch;
use nearl_runtime::normaliser::{CLIP, Normaliser};

/// A state of the simulator.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Configuration (nq), MuJoCo's convention.
    pub qpos: Vec<f64>,
    /// Velocity (nv), MuJoCo's convention.
    pub qvel: Vec<f64>,
}

impl Demonstrations {
    /// Transitions.
    pub fn n_steps(&self) -> usize {
        self.episodes.iter().map(|e| e.length).sum()
    }

    /// The first `n` episodes; all with 0 or more than there are.
    pub fn first(mut self, n: usize) -> Self {
        if n > 0 {
            self.episodes.truncate(n);
        }
        self
    }

    /// Every state from which an expert went on: all but the last of each episode.
    pub fn frames(&self) -> Vec<Frame> {
        let of = |e: &super::Episode| {
            let (nq, nv) = (e.qpos.len() / (e.length + 1), e.qvel.len() / (e.length + 1));
            let states = e.qpos.chunks_exact(nq).zip(e.qvel.chunks_exact(nv)).take(e.length);
            states.map(|(q, v)| Frame { qpos: q.to_vec(), qvel: v.to_vec() }).collect::<Vec<_>>()
        };
        self.episodes.iter().flat_map(of).collect()
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
