//! The guard of `guard = true`: forward dynamics say which state an action leads to, that state is projected, and inverse dynamics give the action
//! that leads to what the projection made of it.

use super::parts::{held_dofs, unusable};
use crate::arrival::{Arrivals, ROUNDS};
use crate::followers::Followers;
use crate::motors::Motors;
use crate::snapshot::{Manifest, SnapshotError};
use nearl_constraints::{Bounds, Drive, Model, PeriodDynamics, Projector, Proposal, StateLayout, Target};

/// Forward, project, back. With `S_c` the controllable dofs, whose motors the action (n_act) drives:
///
/// ```text
///     tau -> a with tau = R a + b + F(a)            forward dynamics over the period, with dry friction F
///         -> v + T a, q (+) (T v + kappa T^2 a)     the proposal
///         -> project -> a'                          as the proposal of any policy
///         -> tau' = R a' + b + F(a')                on S_c, while the other dofs follow ([`Followers`])
/// ```
///
/// Dofs that something holds where they are ([`held_dofs`]) have no acceleration, whatever that takes; the others follow from the forces.
/// Joints with a drive take their command for the force (see [`Drive`]). Where the plant makes several physics steps of a period they are made
/// one by one, forward and back. Where the projection moves nothing the action stays bit for bit.
pub(super) struct Guard {
    pub(super) projector: Projector,
    dynamics: PeriodDynamics,
    dofs: Vec<usize>,
    followers: Option<Followers>,
    motors: Motors,
    arrivals: Arrivals,
    pub(super) proposal: Proposal,
    /// Configuration index of each dof that is a joint of its own.
    single: Vec<Option<usize>>,
    commands: Vec<f64>,
    tau: Vec<f64>,
    a: Vec<f64>,
    /// Tangent displacement of the period, and where it leads.
    step: Vec<f64>,
    on: nearl_constraints::Dynamics,
}

impl Guard {
    /// The guard of a task whose actions are the commands to the controllable joints.
    ///
    /// # Errors
    /// [`SnapshotError::Unusable`] for actions that are no such forces, and limits that do not suffice for a promise.
    pub(super) fn new(m: &Manifest, model: &Model, layout: &StateLayout) -> Result<Guard, SnapshotError> {
        let dofs = layout.controllable().to_vec();
        let drives = super::Parts::drives(m, model, &dofs)?;
        let motors = super::Parts::motors(model, &dofs, &drives)?;
        check_actions(m, model, &dofs, &drives, &motors)?;
        let projector = super::Parts::guard_projector(m, model, &dofs)?;
        let nv = model.nv();
        let single = (0..nv).map(|i| {
            let joint = model.joint_of_dof(i);
            (joint.nq == 1 && joint.nv == 1).then_some(joint.idx_q)
        });
        let held = held_dofs(model, &dofs);
        let driven: Vec<usize> = (0..nv).filter(|i| dofs.contains(i) || held.contains(i)).collect();
        Ok(Guard {
            dynamics: PeriodDynamics::new(model, &driven, m.task.period()),
            followers: Followers::new(model, &driven),
            proposal: Proposal::new(model),
            single: single.collect(),
            commands: vec![0.0; nv],
            tau: vec![0.0; nv],
            arrivals: Arrivals::new(m, model, &dofs, (&drives, &motors), &held),
            motors,
            a: vec![0.0; nv],
            step: vec![0.0; nv],
            on: nearl_constraints::Dynamics::new(model),
            projector,
            dofs,
        })
    }

    /// Replaces `action` (n_act), which is finite and within the actuators' range, by the one of the nearest state that every limit allows; `next`
    /// is that state with its ledger. With `hold` off the action stays and `next` is where it leads.
    pub(super) fn update(&mut self, q: &[f64], v: &[f64], action: &mut [f64], next: &mut Target, hold: bool) {
        self.dynamics.update(q, v, self.projector.external_forces());
        let beyond = self.foresee(q, v, action);
        self.projector.project(q, v, &self.proposal, next);
        if !hold {
            self.projector.pass(q, v, &self.proposal, next);
        }
        if hold && (beyond || self.is_moved(next)) {
            if let Some(followers) = &mut self.followers {
                followers.follow(&mut self.dynamics, (q, v), &self.proposal, &mut self.projector, next);
            }
            self.lead((q, v), next, action);
            self.arrivals.begin();
            for _ in 0..if self.projector.needs_what_is_reached() { ROUNDS } else { 0 } {
                let Some(within) = self.arrivals.held_back(v, next) else { break };
                match &mut self.followers {
                    Some(followers) => {
                        followers.follow_within(
                            &mut self.dynamics,
                            (q, v),
                            within,
                            &mut self.projector,
                            next,
                        );
                    }
                    None => _ = self.projector.project_within((q, v), &self.proposal, within, next),
                }
                self.lead((q, v), next, action);
            }
        }
        if self.projector.needs_previous() {
            self.projector.remember(next);
        }
    }

    /// Writes the action that leads to `next`.
    fn lead(&mut self, (q, v): (&[f64], &[f64]), next: &Target, action: &mut [f64]) {
        self.a.copy_from_slice(&next.acceleration);
        self.dynamics.drive(&mut self.a, &mut self.tau);
        let (external, within) = (self.projector.external_forces(), self.projector.limits_of_tick());
        let by = (&self.a[..], &self.tau[..]);
        let commands = self.arrivals.commands((q, v), next, by, external, within);
        for (k, &i) in self.dofs.iter().enumerate() {
            action[self.motors.place(k)] = self.motors.action(k, commands[i]);
        }
    }

    /// Writes the proposal: the state at the end of the period under `action`. Returns what [`Arrivals::foresee`] does.
    fn foresee(&mut self, q: &[f64], v: &[f64], action: &[f64]) -> bool {
        let period = *self.dynamics.period();
        let (t, kappa) = (period.dt, period.kappa);
        for (k, &i) in self.dofs.iter().enumerate() {
            self.commands[i] = self.motors.command(k, action[self.motors.place(k)]);
        }
        let by = (&mut self.dynamics, self.projector.external_forces());
        let beyond = self.arrivals.foresee((q, v), by, &self.commands, self.projector.limits(), &mut self.a);
        for i in 0..v.len() {
            let y = t * self.a[i];
            self.proposal.v[i] = v[i] + y;
            self.step[i] = t * v[i] + kappa * t * y;
        }
        if self.single.iter().any(Option::is_none) {
            self.on.integrate(q, &self.step, &mut self.proposal.q);
        }
        for (i, iq) in self.single.iter().enumerate() {
            if let Some(iq) = *iq {
                self.proposal.q[iq] = q[iq] + self.step[i];
            }
        }
        beyond
    }

    /// Whether the target differs from the proposal in a controllable joint.
    fn is_moved(&self, next: &Target) -> bool {
        let differs = |&i: &usize| {
            let q = |iq: usize| next.q[iq] != self.proposal.q[iq];
            next.v[i] != self.proposal.v[i] || self.single[i].is_some_and(q)
        };
        self.dofs.iter().any(differs)
    }

    /// Where in the action the `k`-th controllable joint's command is.
    pub(super) fn place(&self, k: usize) -> usize {
        self.motors.place(k)
    }

    pub(super) fn bounds(&self) -> &Bounds {
        self.projector.bounds()
    }
}

/// Each controllable joint needs a motor of known strength, which the action is the force of.
fn check_actions(
    m: &Manifest,
    model: &Model,
    dofs: &[usize],
    drives: &[Drive],
    motors: &Motors,
) -> Result<(), SnapshotError> {
    let refuse = |reason: String| Err(unusable(&reason));
    let of_force = |i: &usize| matches!(drives[*i], Drive::Effort | Drive::Pd { .. });
    if m.task.constraints.torque.is_none() && dofs.iter().any(of_force) {
        return refuse(
            "[constraints] guard = true without a torque limit would ask for more than the motors give; add torque = { scale = 1.0 }, and \
             consistency = \"kinematic\" where it is \"free\"".into(),
        );
    }
    if m.task.constraints.torque.as_ref().is_some_and(|torque| torque.soft.is_some())
        && dofs.iter().any(of_force)
    {
        return refuse(
            "[constraints] guard = true with a soft torque limit would ask for more than the motors give; take its soft out".into(),
        );
    }
    if m.action_lower.len() != dofs.len() {
        return refuse(format!(
            "[constraints] guard = true needs one motor for each controllable joint, but there are {} actions for {} joints; name the driven \
             joints in state.controllable",
            m.action_lower.len(),
            dofs.len()
        ));
    }
    for (k, &i) in dofs.iter().enumerate().filter(|(_, i)| drives[**i] == Drive::Effort) {
        let ends = [&m.action_lower, &m.action_upper].map(|range| motors.command(k, range[motors.place(k)]));
        let (low, high, effort) = (ends[0].min(ends[1]), ends[0].max(ends[1]), model.effort_limit()[i]);
        if high.min(-low) < effort * (1.0 - 1e-9) {
            return refuse(format!(
                "[constraints] guard = true needs actions that reach the torque limit, but that of joint '{}' goes from {low} to {high} N m or N and the \
                 joint's effort is {effort}; widen the motor's ctrlrange, or state the effort that it has",
                model.dof_name(i)
            ));
        }
    }
    Ok(())
}
