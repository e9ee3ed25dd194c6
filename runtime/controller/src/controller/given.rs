//! What another process proposes in place of the policy.
//!
//! A proposal begins a policy period of its own. Where no other has come by the end of that period, the last one is held: the robot rests at the
//! positions it asked for, keeps its velocities where it had velocities alone, or repeats its commands.

use super::Controller;
use crate::snapshot::PolicyKind;
use nearl_constraints::Entry;

/// The newest proposal.
pub(super) struct Given {
    values: Vec<f64>,
    age: Age,
}

#[derive(Clone, Copy, PartialEq)]
enum Age {
    None,
    /// No tick has used it yet.
    New,
    Used,
}

impl Given {
    pub(super) fn new(n: usize) -> Given {
        Given { values: vec![0.0; n], age: Age::None }
    }

    pub(super) fn is_new(&self) -> bool {
        self.age == Age::New
    }

    pub(super) fn is_set(&self) -> bool {
        self.age != Age::None
    }

    pub(super) fn forget(&mut self) {
        self.age = Age::None;
    }
}

impl Controller {
    /// Proposes `values` in place of the policy from the next tick on, until the next call or [`Controller::reset`]: the entries of
    /// [`Controller::given_names`], as a state to be reached at the end of a policy period that begins with that tick, or as commands, which are rounded to
    /// single precision. The limits hold for them as for the policy's own. False, and nothing changes, where their number is another one.
    pub fn give(&mut self, values: &[f64]) -> bool {
        let fits = values.len() == self.given.values.len();
        if fits {
            self.given.values.copy_from_slice(values);
            self.given.age = Age::New;
        }
        fits
    }

    /// Names of what [`Controller::give`] takes: the proposed entries of the state, or the joints whose commands an action is, in its
    /// order. `None` for actions that no limit is held for.
    pub fn given_names(&self) -> Option<Vec<String>> {
        if self.kind != PolicyKind::Direct {
            return Some((0..self.layout.n_state()).map(|k| self.layout.state_name(k).to_owned()).collect());
        }
        let dofs = self.layout.controllable();
        let place = |k: usize| match (&self.guard, &self.drive_box) {
            (Some(guard), _) => Some(guard.place(k)),
            (None, Some(drives)) => Some(drives.place(k)),
            (None, None) => None,
        };
        let mut names = vec![String::new(); dofs.len()];
        for (k, &dof) in dofs.iter().enumerate() {
            self.model.dof_name(dof).clone_into(names.get_mut(place(k)?)?);
        }
        Some(names)
    }

    /// The given proposal as the policy's output of this tick.
    pub(super) fn propose_given(&mut self, out: &mut super::Output) {
        out.log_prob_proposal = 0.0;
        let is_new = self.given.is_new();
        self.given.age = Age::Used;
        if self.kind == PolicyKind::Direct {
            for (mean, value) in self.mean.iter_mut().zip(&self.given.values) {
                // A number beyond what the network's precision holds is its largest, and not infinite.
                *mean = value.clamp(f64::from(f32::MIN), f64::from(f32::MAX)) as f32;
            }
            return;
        }
        out.proposal.copy_from_slice(&self.given.values);
        for k in 0..self.layout.n_state() {
            let s = self.held.obs[self.layout.state()[k]];
            if !is_new
                && let Entry::Velocity { dof } = self.layout.state_entry(k)
                && self.is_position_proposed(dof)
            {
                out.proposal[k] = 0.0;
            }
            out.change[k] = ((out.proposal[k] - s) / self.normaliser.scale[k]) as f32;
        }
        self.set_goal(out);
        if !is_new {
            for k in 0..self.layout.n_state() {
                if let Entry::Position { dof, .. } = self.layout.state_entry(k) {
                    self.goal.v[dof] = 0.0;
                }
            }
        }
    }

    fn is_position_proposed(&self, dof: usize) -> bool {
        let is_it = |k| matches!(self.layout.state_entry(k), Entry::Position { dof: of, .. } if of == dof);
        (0..self.layout.n_state()).any(is_it)
    }
}
