//! Braking on the robot model alone: projector and analytic inverse dynamics, no network.
//!
//! It shares nothing with the controller, so whatever failed there (weights, a solver, a panic) leaves it intact.

use nearl_constraints::{Period, Projector, Proposal, Status, Target};

use crate::controller::Parts;
use crate::idm::AnalyticIdm;
use crate::snapshot::{Manifest, PolicyKind, SnapshotError};
use crate::task::IdmKind;

/// Brings the controllable joints to rest as fast as every limit allows.
pub struct Brake {
    projector: Projector,
    idm: AnalyticIdm,
    proposal: Proposal,
    pub(crate) target: Target,
    /// Degree of freedom and configuration index of each controllable joint.
    joints: Vec<(usize, usize)>,
    range: Vec<(f64, f64)>,
    period: Period,
    action: Vec<f64>,
    /// Where the tick begins (nq, nv).
    from: (Vec<f64>, Vec<f64>),
}

impl Brake {
    /// `None` where no analytic inverse dynamics knows the action that stops the robot.
    ///
    /// # Errors
    /// [`SnapshotError::Unusable`] with the sentence of the layer that refused robot, layout or limits.
    pub fn new(manifest: &Manifest) -> Result<Option<Brake>, SnapshotError> {
        let guards = manifest.guards();
        let analytic = manifest.task.idm.kind == IdmKind::Pinocchio && manifest.policy != PolicyKind::Direct;
        if !(guards || analytic) {
            return Ok(None);
        }
        let Parts { model, layout, projector, .. } = Parts::new(manifest)?;
        let controllable = layout.controllable();
        let projector =
            if guards { Parts::guard_projector(manifest, &model, controllable)? } else { projector };
        let joints = model.joints().iter().filter(|j| j.nv == 1 && controllable.contains(&j.idx_v));
        Ok(Some(Brake {
            idm: AnalyticIdm::new(manifest, &model, controllable)?,
            proposal: Proposal::new(&model),
            target: Target::new(&model),
            joints: joints.map(|j| (j.idx_v, j.idx_q)).collect(),
            range: manifest.action_lower.iter().copied().zip(manifest.action_upper.iter().copied()).collect(),
            period: manifest.task.period(),
            from: (model.neutral(), vec![0.0; model.nv()]),
            action: vec![0.0; manifest.action_lower.len()],
            projector,
        }))
    }

    /// The projector, whose memory is the controller's too.
    pub(crate) fn projector(&mut self) -> &mut Projector {
        &mut self.projector
    }

    /// Proposes rest, `v' = 0` and `q' = q + T v - kappa T v`, or with hard jerk what leads there, and returns the command (of motors the torque
    /// [N m]) for the nearest allowed state. Joints that are not controllable keep their velocity.
    pub fn update(&mut self, q: &[f64], v: &[f64]) -> (Status, &[f64]) {
        self.begin(q, v);
        self.act()
    }

    /// The same for a proposal between rest and a target (nq, nv): `share` of the way from the one to the other.
    pub fn approach(
        &mut self,
        q: &[f64],
        v: &[f64],
        target_q: &[f64],
        target_v: &[f64],
        share: f64,
    ) -> (Status, &[f64]) {
        self.begin(q, v);
        for &(dof, idx_q) in &self.joints {
            let (rest_q, rest_v) = (self.proposal.q[idx_q], self.proposal.v[dof]);
            self.proposal.q[idx_q] = rest_q + share * (target_q[idx_q] - rest_q);
            self.proposal.v[dof] = rest_v + share * (target_v[dof] - rest_v);
        }
        self.act()
    }

    /// Proposes rest for where the tick begins: as measured, or of joints that follow by themselves what they were sent.
    fn begin(&mut self, q: &[f64], v: &[f64]) {
        let Period { dt, kappa, .. } = self.period;
        let (from_q, from_v) = &mut self.from;
        from_q.copy_from_slice(q);
        from_v.copy_from_slice(v);
        self.projector.depart(from_q, from_v);
        let (q, v) = (&self.from.0, &self.from.1);
        self.proposal.q.copy_from_slice(q);
        self.proposal.v.copy_from_slice(v);
        for &(dof, idx_q) in &self.joints {
            let rest = self.projector.rest(dof, v[dof]);
            self.proposal.v[dof] = rest;
            self.proposal.q[idx_q] = q[idx_q] + dt * v[dof] + kappa * dt * (rest - v[dof]);
        }
    }

    fn act(&mut self) -> (Status, &[f64]) {
        let (q, v) = (&self.from.0, &self.from.1);
        self.projector.project(q, v, &self.proposal, &mut self.target);
        self.idm.lead((q, v), &self.proposal, &mut self.projector, &mut self.target, &mut self.action);
        if self.projector.needs_previous() {
            self.projector.remember(&self.target);
        }
        for (action, &(lower, upper)) in self.action.iter_mut().zip(&self.range) {
            *action = if action.is_finite() { action.clamp(lower, upper) } else { 0.0 };
        }
        (self.target.ledger.status, &self.action)
    }
}
