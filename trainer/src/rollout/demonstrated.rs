//! Episodes beside demonstrations: where they begin, and how near the robot stays.

use crate::demos::{Frame, Frames};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::sync::Arc;

/// Demonstrations beside the episodes of one environment.
pub(super) struct Demonstrated {
    demos: Arc<Frames>,
    /// Share of the episodes that begin in a demonstrated state.
    share: f64,
    /// The least that a step has to be worth, where how near the demonstration is followed is the reward.
    tracked: Option<f64>,
    /// The frame of the present moment.
    at: usize,
    /// The present episode began in a frame: its return counts nowhere.
    pub(super) from_frame: bool,
    /// Time in the demonstration at which it did, otherwise 0 \[s\].
    pub(super) began: f64,
}

/// A policy step beside a demonstration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Followed {
    /// Its reward.
    pub(super) worth: f64,
    /// The demonstration ends here.
    pub(super) ended: bool,
    /// It is worth too little to go on.
    pub(super) strayed: bool,
}

impl Demonstrated {
    /// `None` without frames.
    pub(super) fn new(demos: Arc<Frames>, share: f64, tracked: Option<f64>) -> Option<Self> {
        (!demos.frames.is_empty()).then_some(Self {
            demos,
            share,
            tracked,
            at: 0,
            from_frame: false,
            began: 0.0,
        })
    }

    /// The frame of the present moment, where that matters.
    pub(super) fn frame(&self) -> Option<usize> {
        self.tracked.map(|_| self.at)
    }

    /// Goes on from a frame.
    pub(super) fn stand_at(&mut self, frame: usize) {
        self.at = frame.min(self.demos.frames.len() - 1);
    }

    /// Draws whether an episode that was just reset to `qpos` (nq) begins in a frame after all, and gives that. Where it does not, the
    /// robot is beside the first frame of the demonstration that begins nearest.
    pub(super) fn begin(&mut self, qpos: &[f64], rng: &mut ChaCha8Rng) -> Option<&Frame> {
        let frames = &self.demos.frames;
        self.from_frame = rng.random::<f64>() < self.share;
        self.began = 0.0;
        if self.from_frame {
            self.at = rng.random_range(0..frames.len());
            self.began = frames[self.at].time;
            return Some(&frames[self.at]);
        }
        if self.tracked.is_some() {
            let distance = |k: usize| frames[k].qpos.iter().zip(qpos).map(|(a, b)| (a - b).powi(2)).sum();
            let begins = (0..frames.len()).filter(|&k| k == 0 || frames[k - 1].left == 1);
            let nearest = begins.map(|k| (k, distance(k))).min_by(|a: &(_, f64), b| a.1.total_cmp(&b.1));
            self.at = nearest.map_or(0, |(k, _)| k);
        }
        None
    }

    /// What a policy step is worth that led to the observation `obs` (n_obs); `None` where the reward is another. Each entry that is
    /// followed gives `1 / (1 + e²)` of its error `e` in units of its spread over the demonstrations, and the mean of them is the reward, 1
    /// where all are met.
    pub(super) fn step(&mut self, obs: &[f64]) -> Option<Followed> {
        let (least, frame) = (self.tracked?, &self.demos.frames[self.at]);
        let errors = self.demos.followed.iter().zip(&frame.next).zip(&self.demos.units);
        let near: f64 = errors.map(|((&k, want), unit)| 1.0 / (1.0 + ((obs[k] - want) / unit).powi(2))).sum();
        let (worth, ended) = (near / self.demos.followed.len() as f64, frame.left == 1);
        self.at += usize::from(!ended);
        Some(Followed { worth, ended, strayed: worth < least })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demos::{Demonstrations, Episode};
    use rand_chacha::rand_core::SeedableRng;

    /// Two demonstrations of one joint, two and three steps long: its position is entry 1 of the observation, its speed entry 2.
    fn two() -> Arc<Frames> {
        let episode = |q: &[f64]| Episode {
            observations: q.iter().flat_map(|&q| [9.0, q, 7.0]).collect(),
            qpos: q.to_vec(),
            qvel: vec![0.0; q.len()],
            actions: Vec::new(),
            length: q.len() - 1,
        };
        let names = ["other", "q.joint", "v.joint"].map(String::from).to_vec();
        let episodes = vec![episode(&[0.0, 1.0, 2.0]), episode(&[5.0, 6.0, 7.0, 8.0])];
        Arc::new(Demonstrations { names, dt: 0.1, episodes }.frames(&[1, 2]))
    }

    #[test]
    fn a_step_is_worth_one_where_the_demonstration_is_met_and_less_with_the_square_of_its_distance() {
        let demos = two();
        // 0 1 2 5 6 7 8: mean 29/7, mean square 179/7
        let unit = (179.0 / 7.0 - (29.0f64 / 7.0).powi(2)).sqrt();
        assert!((demos.units[0] - unit).abs() < 1e-12, "{:?}", demos.units);
        let mut d = Demonstrated::new(demos, 0.0, Some(0.3)).expect("frames");
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        assert!(d.begin(&[4.0], &mut rng).is_none(), "no episode begins in a frame");
        assert_eq!(d.frame(), Some(2), "the second demonstration begins nearer");
        assert_eq!(d.step(&[0.0, 6.0]), Some(Followed { worth: 1.0, ended: false, strayed: false }));
        let far = d.step(&[0.0, 7.0 - 2.0 * unit]).expect("tracked");
        assert!((far.worth - 0.2).abs() < 1e-12 && far.strayed && !far.ended, "1 / (1 + 2²): {far:?}");
        assert_eq!(
            d.step(&[0.0, 8.0]),
            Some(Followed { worth: 1.0, ended: true, strayed: false }),
            "the last of three"
        );
    }

    #[test]
    fn an_episode_that_begins_in_a_frame_is_held_against_what_followed_there() {
        let demos = two();
        let mut d = Demonstrated::new(Arc::clone(&demos), 1.0, Some(0.0)).expect("frames");
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for _ in 0..20 {
            let Frame { qpos, left, .. } = d.begin(&[0.0], &mut rng).expect("a frame").clone();
            let ends: Vec<bool> = (1..=left)
                .map(|t| d.step(&[0.0, qpos[0] + t as f64]).expect("tracked"))
                .map(|step| {
                    assert!(step.worth == 1.0 && !step.strayed, "{step:?}");
                    step.ended
                })
                .collect();
            assert!(d.from_frame && ends.iter().position(|end| *end) == Some(left - 1), "{qpos:?}: {ends:?}");
        }
        let mut untracked = Demonstrated::new(demos, 1.0, None).expect("frames");
        assert!(untracked.begin(&[0.0], &mut rng).is_some() && untracked.step(&[0.0, 1.0]).is_none());
    }
}
