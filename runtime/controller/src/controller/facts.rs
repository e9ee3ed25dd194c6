//! What a controller tells of itself: sizes, names, limits, and how far a state is from them.

use super::dial::Dial;
use super::{Controller, Excess, Inverse, Noise, Output, State};
use crate::PolicyKind;
use crate::normaliser::Normaliser;
use nearl_constraints::{LimitSet, Model, StateLayout, Target, end_of_range};

impl Controller {
    /// How far `state` is outside the limits of the controllable joints: the largest excess of a position and of a velocity; less than
    /// 1e-9 is none.
    pub fn excess(&self, state: &State) -> [Option<Excess>; 2] {
        self.excess_over(self.limits(), state)
    }

    /// The same over limits of one's own, by degree of freedom.
    pub fn excess_over(&self, l: &LimitSet, state: &State) -> [Option<Excess>; 2] {
        let mut worst = [None::<Excess>; 2];
        for &dof in self.layout.controllable() {
            let (iq, model) = (self.idx_q[dof], self.model());
            let (q, v) = (state.q[iq], state.v[dof]);
            let low = end_of_range(l.q_lower[dof], model.lower_position_limit()[iq]);
            let high = end_of_range(l.q_upper[dof], model.upper_position_limit()[iq]);
            let by = [(low - q).max(q - high), v.abs() - l.velocity[dof]];
            for (worst, by) in worst.iter_mut().zip(by) {
                *worst = Excess::larger(*worst, (by > 1e-9).then_some(Excess { dof, by }));
            }
        }
        worst
    }

    /// Mean `|reached - target|` over the entries of the controllable joints, in units of the scale of change: how far observation `obs`
    /// (n_obs) is from what `out` asked for. 0 for a policy on actions without a guard, which asks for no state.
    pub fn residual(&self, obs: &[f64], out: &Output) -> f64 {
        if self.kind == PolicyKind::Direct && self.guard.is_none() {
            return 0.0;
        }
        let seen = self.layout.controllable_state();
        let miss =
            |&k: &usize| (obs[self.layout.state()[k]] - out.target[k]).abs() / self.normaliser.scale[k];
        seen.iter().map(miss).sum::<f64>() / seen.len().max(1) as f64
    }

    /// The share of ticks that may end outside a position limit (`[constraints] reached`), where the task says one.
    pub fn asked(&self) -> Option<f64> {
        self.dial.as_ref().map(Dial::asked)
    }

    /// Which rows of [`Controller::margins`] configuration `q` is outside of.
    pub fn outside<'a>(&'a self, q: &'a [f64]) -> impl Iterator<Item = bool> + 'a {
        self.dial.iter().flat_map(|dial| dial.outside(q))
    }

    /// Whether actions are kept within limits of their own: forces of drives, or `[constraints] action`.
    pub fn bounds_actions(&self) -> bool {
        self.drive_box.is_some() || self.action_limit.is_some()
    }

    /// Number of entries that the policy sees.
    pub fn n_seen(&self) -> usize {
        self.policy.n_in()
    }

    /// The first entry of a joint's position or velocity that the observation lacks although the tick needs it: of every joint for analytic inverse
    /// dynamics and for an observation that is computed from the state, of those that are moved for a guard.
    pub fn first_unseen(&self) -> Option<String> {
        let of_all = matches!(self.inverse, Inverse::Analytic(_)) || self.foreign.remembers();
        let is_needed =
            |dof: usize| of_all || self.guard.is_some() && self.layout.controllable().contains(&dof);
        let needed = self.model.joints().iter().filter(|joint| is_needed(joint.idx_v));
        needed.filter_map(|joint| self.layout.first_unseen(joint)).next()
    }

    /// Writes an observation (n_obs) into `state`, and with it the joints' positions and velocities that it holds; the others stay.
    pub fn observed(&self, obs: &[f64], state: &mut State) {
        state.obs.copy_from_slice(obs);
        self.layout.read_state(obs, &mut state.q, &mut state.v);
    }

    /// Writes what the policy would see in `state` if it ran in the next tick, before the normaliser (n_seen).
    pub fn peek(&self, state: &State, seen: &mut [f64]) {
        self.foreign.peek(state, self.time(), seen);
    }

    /// Time since the reset [s].
    pub(super) fn time(&self) -> f64 {
        (self.earlier + self.tick) as f64 * self.dt
    }

    /// Limits by degree of freedom.
    pub fn limits(&self) -> &LimitSet {
        self.last_word().limits()
    }

    /// What the ledger's active rows are of: dofs, then coupled rows.
    pub fn row_names(&self) -> Vec<String> {
        self.last_word().row_names()
    }

    /// Kind of each row; none for those of single joints.
    pub fn row_kinds(&self) -> Vec<Option<nearl_constraints::Kind>> {
        self.last_word().row_kinds()
    }

    /// Robot model.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// State layout.
    pub fn layout(&self) -> &StateLayout {
        &self.layout
    }

    /// Observation normaliser and scale of change.
    pub fn normaliser(&self) -> &Normaliser {
        &self.normaliser
    }

    /// Version of the snapshot the networks came from.
    pub fn version(&self) -> u64 {
        self.version
    }

    /// Control period in \[s\].
    pub fn dt(&self) -> f64 {
        self.dt
    }

    /// Control ticks in one policy period.
    pub fn policy_every(&self) -> usize {
        self.policy_every
    }

    /// Size of the action.
    pub fn n_act(&self) -> usize {
        self.action_range.len()
    }

    /// A state of the right sizes, at rest in the neutral configuration.
    pub fn state(&self) -> State {
        State { q: self.model.neutral(), v: vec![0.0; self.model.nv()], obs: vec![0.0; self.layout.n_obs()] }
    }

    /// Zero noise of the right sizes.
    pub fn noise(&self) -> Noise {
        Noise { proposal: vec![0.0; self.layout.n_state()], action: vec![0.0; self.n_act()] }
    }

    /// An output of the right sizes.
    pub fn output(&self) -> Output {
        let (s, a) = (self.layout.n_state(), self.n_act());
        Output {
            x: vec![0.0; self.policy.n_in()],
            change: vec![0.0; s],
            proposal: vec![0.0; s],
            target: vec![0.0; s],
            target_change: vec![0.0; s],
            lower: vec![f32::NEG_INFINITY; s],
            upper: vec![f32::INFINITY; s],
            sampled: vec![0.0; a],
            action: vec![0.0; a],
            log_prob_proposal: 0.0,
            log_prob_action: 0.0,
            next: Target::new(&self.model),
            policy_tick: true,
            duration_ns: 0,
        }
    }
}
