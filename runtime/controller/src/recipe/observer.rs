//! The observation of a policy made elsewhere, from the state.

use super::PolicySection;
use super::source::Source;
use crate::controller::State;
use nearl_constraints::{Model, StateLayout};

/// One term with its place in the observation.
struct Part {
    source: Source,
    scale: Vec<f64>,
    clip: [f64; 2],
    width: usize,
    /// Where its oldest values begin, and where the newest end.
    at: std::ops::Range<usize>,
}

/// Computes the terms of a [`PolicySection`] at each policy tick. Nothing is allocated after construction.
pub struct Observer {
    parts: Vec<Part>,
    observation: Vec<f64>,
    last: Vec<f32>,
    is_fresh: bool,
}

impl Observer {
    /// `None` where the section has no terms: the plant gives the observation itself.
    ///
    /// # Errors
    /// One sentence naming the term and what is missing.
    pub fn new(policy: &PolicySection, model: &Model, layout: &StateLayout) -> Result<Option<Self>, String> {
        if policy.observation.is_empty() {
            return Ok(None);
        }
        let (mut parts, mut at) = (Vec::new(), 0);
        for (k, term) in policy.observation.iter().enumerate() {
            let what = format!("policy.observation: term {} ('{}')", k + 1, term.term.name());
            let refuse = |e: String| format!("{what}: {e}");
            let source = Source::new(term, policy, model, layout).map_err(refuse)?;
            let width = source.width();
            if !(1..=1000).contains(&term.history) {
                return Err(refuse(format!("a history of {} ticks; give 1 to 1000", term.history)));
            }
            let clip = term.clip.unwrap_or([f64::NEG_INFINITY, f64::INFINITY]);
            if !matches!(clip[0].partial_cmp(&clip[1]), Some(o) if o.is_le()) {
                return Err(refuse(format!("a clip from {} to {}; give the lower first", clip[0], clip[1])));
            }
            let scale = term.scale.spread("its scale", width).map_err(refuse)?;
            let end = at + width * term.history;
            parts.push(Part { source, scale, clip, width, at: at..end });
            at = end;
        }
        let last = vec![0.0; policy.joints.len()];
        Ok(Some(Self { parts, observation: vec![0.0; at], last, is_fresh: true }))
    }

    /// Number of entries of each term, its history included.
    pub fn widths(&self) -> impl Iterator<Item = usize> {
        self.parts.iter().map(|part| part.at.len())
    }

    /// Number of entries.
    pub fn len(&self) -> usize {
        self.observation.len()
    }

    /// Never: an observer has terms.
    pub fn is_empty(&self) -> bool {
        self.observation.is_empty()
    }

    /// The observation at `time` \[s\] since the reset; to be called once in each policy tick.
    pub fn observe(&mut self, state: &State, time: f64) -> &[f64] {
        let mut observation = std::mem::take(&mut self.observation);
        self.shift_in(state, time, &mut observation);
        self.observation = observation;
        self.is_fresh = false;
        &self.observation
    }

    /// Writes what [`Observer::observe`] would give in `state` to `to` (len), and remembers nothing of it.
    pub fn peek(&self, state: &State, time: f64, to: &mut [f64]) {
        to.copy_from_slice(&self.observation);
        self.shift_in(state, time, to);
    }

    /// Replaces the oldest values of each term by those of `state`.
    fn shift_in(&self, state: &State, time: f64, observation: &mut [f64]) {
        for part in &self.parts {
            let all = &mut observation[part.at.clone()];
            all.copy_within(part.width.., 0);
            let start = all.len() - part.width;
            let (before, now) = all.split_at_mut(start);
            part.source.write(state, &self.last, time, now);
            for (x, scale) in now.iter_mut().zip(&part.scale) {
                *x = scale * x.clamp(part.clip[0], part.clip[1]);
            }
            if self.is_fresh {
                before.chunks_exact_mut(part.width.max(1)).for_each(|old| old.copy_from_slice(now));
            }
        }
    }

    /// What the policy gave for it.
    pub fn acted(&mut self, output: &[f32]) {
        self.last.copy_from_slice(output);
    }

    /// A new episode.
    pub fn reset(&mut self) {
        self.last.fill(0.0);
        self.is_fresh = true;
    }

    /// Appends what the next policy tick depends on beside its arguments: the terms of the ticks before and the last outputs.
    pub fn write_memory(&self, memory: &mut Vec<f64>) {
        memory.push(f64::from(u8::from(self.is_fresh)));
        memory.extend_from_slice(&self.observation);
        memory.extend(self.last.iter().map(|&x| f64::from(x)));
    }

    /// Takes what [`Observer::write_memory`] gave.
    ///
    /// # Panics
    /// When it has another length than [`Observer::memory_len`].
    pub fn set_memory(&mut self, memory: &[f64]) {
        let (observation, last) = memory[1..].split_at(self.observation.len());
        self.is_fresh = memory[0] != 0.0;
        self.observation.copy_from_slice(observation);
        assert_eq!(last.len(), self.last.len(), "the memory of another policy");
        self.last.iter_mut().zip(last).for_each(|(x, &value)| *x = value as f32);
    }

    /// Entries of its memory.
    pub fn memory_len(&self) -> usize {
        1 + self.observation.len() + self.last.len()
    }
}
