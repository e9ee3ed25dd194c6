//! What a worker collected, as plain numbers on their way from one process to another, bit for bit.

use super::{Collected, Segment, Tally};
use crate::stats::RunningStats;
use nearl_rollout_protocol::Layout;

impl Collected {
    /// Appends everything to `numbers`: each list by its length and its entries, narrow ones in pairs.
    pub fn carry(&self, numbers: &mut Vec<f64>) {
        let (s, t) = (&self.segment, &self.tally);
        for list in narrow(s) {
            push(numbers, pairs(list));
        }
        push(numbers, s.reward.iter().copied());
        push(numbers, s.cost.iter().copied());
        for list in [&s.terminated, &s.truncated] {
            push(numbers, list.iter().map(|&bit| f64::from(u8::from(bit))));
        }
        push(numbers, s.final_x.iter().map(|(t, _)| *t as f64));
        push(numbers, s.final_x.iter().flat_map(|(_, x)| x).map(|&x| f64::from(x)));
        push(numbers, s.privileged.iter().copied());
        push(numbers, s.final_privileged.iter().copied());
        push(numbers, t.episodes.iter().flat_map(|&(total, length)| [total, length as f64]));
        push(numbers, t.costs.iter().copied());
        push(numbers, t.notes.iter().copied());
        push(numbers, t.ledger().into_iter());
        for stats in [&self.obs_stats, &self.change_stats, &self.return_stats, &self.cost_stats] {
            push(numbers, stats.to_vec().into_iter());
        }
        push(numbers, self.odd.iter().copied());
        push(numbers, self.margins.iter().copied());
    }

    /// The inverse of [`Collected::carry`] for `n_steps` steps of these sizes; `None` for numbers of any other shape.
    pub fn read(mut numbers: &[f64], sizes: Layout, n_steps: usize) -> Option<Self> {
        let Layout { n_obs, n_state, n_act } = sizes;
        let from = &mut numbers;
        let mut s = Segment::default();
        let widths = [n_obs, n_state, n_state, n_state, n_state, n_state, n_act, n_act, 1];
        for (list, width) in narrow_mut(&mut s).into_iter().zip(widths) {
            let length = n_steps * width;
            list.extend(exactly(from, length.div_ceil(2))?.iter().flat_map(|&pair| split(pair)).take(length));
        }
        s.reward.extend_from_slice(exactly(from, n_steps)?);
        s.cost.extend_from_slice(exactly(from, n_steps)?);
        for list in [&mut s.terminated, &mut s.truncated] {
            list.extend(exactly(from, n_steps)?.iter().map(|&bit| bit != 0.0));
        }
        let cuts = pull(from)?;
        let final_x = exactly(from, cuts.len() * n_obs)?.chunks_exact(n_obs.max(1));
        for (&t, x) in cuts.iter().zip(final_x) {
            s.final_x.push((t as usize, x.iter().map(|&x| x as f32).collect()));
        }
        s.privileged = pull(from)?.to_vec();
        s.final_privileged = pull(from)?.to_vec();
        let (episodes, costs, notes) = (pull(from)?.as_chunks::<2>().0, pull(from)?, pull(from)?);
        let tally = Tally {
            episodes: episodes.iter().map(|&[total, length]| (total, length as usize)).collect(),
            costs: costs.to_vec(),
            notes: notes.to_vec(),
            ..Tally::of_ledger(pull(from)?.try_into().ok()?)
        };
        let mut stats = |n: usize| {
            let mut stats = RunningStats::new(n);
            stats.set(exactly(from, 2 * n + 1)?);
            Some(stats)
        };
        let (obs_stats, change_stats) = (stats(n_obs)?, stats(n_state)?);
        let (return_stats, cost_stats) = (stats(1)?, stats(1)?);
        let odd = pull(from)?.to_vec();
        let margins = pull(from)?.to_vec();
        let (n, cuts) = (s.privileged.len(), s.final_x.len());
        let privileged_fit = n % n_steps.max(1) == 0 && s.final_privileged.len() * n_steps == n * cuts;
        let cuts_fit = s.final_x.iter().all(|(t, _)| *t < n_steps);
        (from.is_empty() && cuts_fit && privileged_fit).then_some(Self {
            segment: s,
            tally,
            obs_stats,
            odd,
            change_stats,
            return_stats,
            cost_stats,
            margins,
        })
    }
}

fn narrow(s: &Segment) -> [&[f32]; 9] {
    let Segment { x, change, target_change, lower, upper, reached, sampled, action, log_prob, .. } = s;
    [x, change, target_change, lower, upper, reached, sampled, action, log_prob]
}

fn narrow_mut(s: &mut Segment) -> [&mut Vec<f32>; 9] {
    let Segment { x, change, target_change, lower, upper, reached, sampled, action, log_prob, .. } = s;
    [x, change, target_change, lower, upper, reached, sampled, action, log_prob]
}

/// Two narrow numbers in the place of a wide one, bit by bit.
fn pairs(list: &[f32]) -> impl Iterator<Item = f64> {
    let bits = |x: Option<&f32>| u64::from(x.map_or(0, |x| x.to_bits()));
    list.chunks(2).map(move |pair| f64::from_bits(bits(pair.first()) | bits(pair.get(1)) << 32))
}

fn split(pair: f64) -> [f32; 2] {
    let bits = pair.to_bits();
    [f32::from_bits(bits as u32), f32::from_bits((bits >> 32) as u32)]
}

fn push(numbers: &mut Vec<f64>, list: impl Iterator<Item = f64>) {
    let place = numbers.len();
    numbers.push(0.0);
    numbers.extend(list);
    numbers[place] = (numbers.len() - place - 1) as f64;
}

/// The next list.
fn pull<'a>(from: &mut &'a [f64]) -> Option<&'a [f64]> {
    let (&length, rest) = from.split_first()?;
    let (list, rest) = rest.split_at_checked(length as usize)?;
    *from = rest;
    Some(list)
}

/// The next list, of `length` entries.
fn exactly<'a>(from: &mut &'a [f64], length: usize) -> Option<&'a [f64]> {
    pull(from).filter(|list| list.len() == length)
}
