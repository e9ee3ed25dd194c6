//! Around a policy made elsewhere: computes its observation from the state, and turns its outputs into what the motors are sent.

use super::parts::unusable;
use super::{Parts, State};
use crate::normaliser::Normaliser;
use crate::recipe::{ActionMap, Observer};
use crate::snapshot::{Manifest, PolicyKind, SnapshotError};
use nearl_constraints::{Model, StateLayout};

/// `[policy]` of a task, ready for ticks. A task without the section has neither.
#[derive(Default)]
pub(super) struct Foreign {
    observer: Option<Observer>,
    map: Option<ActionMap>,
}

impl Foreign {
    /// # Errors
    /// [`SnapshotError::Unusable`] naming the term, joint or key.
    pub(super) fn new(m: &Manifest, model: &Model, layout: &StateLayout) -> Result<Self, SnapshotError> {
        let Some(policy) = &m.task.policy else { return Ok(Self::default()) };
        if m.policy != PolicyKind::Direct {
            return Err(unusable(
                &"[policy] is for policies of actions, and this one proposes states; give actions=\"guarded\" (make_vec, ProjectedEnv), train with --algo \
                  ppo, or take the section out",
            ));
        }
        let observer = Observer::new(policy, model, layout).map_err(|e| unusable(&e))?;
        let drives = Parts::drives(m, model, layout.controllable())?;
        let motors = Parts::motors(model, layout.controllable(), &drives)?;
        let map = ActionMap::new(policy, model, layout, &drives, motors).map_err(|e| unusable(&e))?;
        Ok(Self { observer, map: Some(map) })
    }

    /// Number of entries that the policy sees.
    pub(super) fn n_seen(&self, layout: &StateLayout) -> usize {
        self.observer.as_ref().map_or(layout.n_obs(), Observer::len)
    }

    /// Writes the network input at `time` [s] since the reset to `x` (n_seen).
    pub(super) fn see(&mut self, state: &State, time: f64, normaliser: &Normaliser, x: &mut [f32]) {
        match &mut self.observer {
            Some(observer) => normaliser.observation(observer.observe(state, time), x),
            None => normaliser.observation(&state.obs, x),
        }
    }

    /// Writes what the policy would see in `state` at `time` [s] since the reset, before the normaliser (n_seen).
    pub(super) fn peek(&self, state: &State, time: f64, to: &mut [f64]) {
        match &self.observer {
            Some(observer) => observer.peek(state, time, to),
            None => to.copy_from_slice(&state.obs),
        }
    }

    /// Whether outputs become commands: exploration is then in the outputs.
    pub(super) fn has_map(&self) -> bool {
        self.map.is_some()
    }

    /// Turns the outputs of a policy of actions (n_act) into what the motors are sent.
    pub(super) fn command(&mut self, outputs: &mut [f32]) {
        let Some(map) = &mut self.map else { return };
        map.clip(outputs);
        if let Some(observer) = &mut self.observer {
            observer.acted(outputs);
        }
        map.command(outputs);
    }

    /// A new episode.
    pub(super) fn reset(&mut self) {
        if let Some(observer) = &mut self.observer {
            observer.reset();
        }
    }

    /// Whether a tick depends on the ones before.
    pub(super) fn remembers(&self) -> bool {
        self.observer.is_some()
    }

    /// Appends what the next policy tick depends on; `ticks` were since the reset.
    pub(super) fn write_memory(&self, ticks: usize, memory: &mut Vec<f64>) {
        if let Some(observer) = &self.observer {
            memory.push(ticks as f64);
            observer.write_memory(memory);
        }
    }

    /// Takes what [`Foreign::write_memory`] gave; returns the ticks since the reset.
    pub(super) fn set_memory(&mut self, memory: &[f64]) -> usize {
        let (Some(observer), Some((ticks, rest))) = (&mut self.observer, memory.split_first()) else {
            return 0;
        };
        observer.set_memory(rest);
        *ticks as usize
    }
}
