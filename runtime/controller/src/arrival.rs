//! Which commands take the joints where they are to arrive.

use crate::controller::idx_q;
use crate::snapshot::Manifest;
use nearl_constraints::drive::{Arrival, Held};
use nearl_constraints::{Drive, LimitSet, Model, Period, PhysicsSteps, Target};

/// The commands of the controllable joints for the motion and the mean forces of a period ([`Drive::command`]). Where the plant makes several
/// physics steps of it and no joint has the target of a drive, the forces are those whose steps lead there ([`PhysicsSteps`]); no force and no
/// position leaves its limit for that.
pub(crate) struct Arrivals {
    period: Period,
    /// What a force may be depends on the speed: it is corrected towards zero only.
    by_speed: bool,
    dofs: Vec<usize>,
    /// By dof (nv).
    drives: Vec<Drive>,
    /// Configuration index of each dof; 0 where it has none of its own.
    idx_q: Vec<usize>,
    /// Dry friction by dof (nv), which torque limits leave to the motors beside what they allow.
    friction: Vec<f64>,
    steps: Option<PhysicsSteps>,
    commands: Vec<f64>,
    force: Vec<f64>,
    most: Vec<f64>,
}

impl Arrivals {
    /// For commands to `dofs`; `drives` (nv) says what they are. A dof that is not among them is `loose`, or keeps the acceleration it is given.
    pub(crate) fn new(
        m: &Manifest,
        model: &Model,
        dofs: &[usize],
        drives: &[Drive],
        loose: bool,
    ) -> Arrivals {
        let (nv, period) = (model.nv(), m.task.period());
        let is_led = |i: &usize| matches!(drives[*i], Drive::Position | Drive::Velocity);
        let follow: Vec<usize> =
            (0..nv).filter(|i| if dofs.contains(i) { is_led(i) } else { !loose }).collect();
        // A drive that is held on its target runs ahead of it: where it ends fast enough it has come too far.
        let has_targets = dofs.iter().any(|i| matches!(drives[*i], Drive::Pd { .. }));
        Arrivals {
            steps: PhysicsSteps::new(model, dofs, &follow, period).filter(|_| !has_targets),
            idx_q: idx_q(model),
            friction: model.friction().to_vec(),
            period,
            by_speed: m.task.constraints.torque_speed.is_some(),
            dofs: dofs.to_vec(),
            drives: drives.to_vec(),
            commands: vec![0.0; nv],
            force: vec![0.0; nv],
            most: vec![0.0; nv],
        }
    }

    /// The commands by dof (nv) that take `q`, `v` to `to` with the accelerations `a` (nv) and the mean forces `tau` (nv), while the
    /// generalised forces `external` (nv) act.
    pub(crate) fn commands(
        &mut self,
        (q, v): (&[f64], &[f64]),
        to: &Target,
        (a, tau): (&[f64], &[f64]),
        external: &[f64],
        limits: &LimitSet,
    ) -> &[f64] {
        self.force.copy_from_slice(tau);
        if let Some(steps) = &mut self.steps {
            for (i, most) in self.most.iter_mut().enumerate() {
                *most = if self.by_speed { tau[i].abs() } else { limits.effort[i] + self.friction[i] };
            }
            steps.drive((q, v), external, a, (&mut self.force, &self.most), limits);
        }
        for &i in &self.dofs {
            let iq = self.idx_q[i];
            let to = Arrival { q: to.q[iq], v: to.v[i], a: a[i], tau: self.force[i] };
            self.commands[i] = self.drives[i].command(&self.period, q[iq], v[i], &to);
        }
        &self.commands
    }

    /// The accelerations (nv) that what is `held` (nv) leads to by the physics steps; false where they are not made.
    pub(crate) fn foresee(
        &mut self,
        state: (&[f64], &[f64]),
        external: &[f64],
        held: &[Held],
        a: &mut [f64],
    ) -> bool {
        match &mut self.steps {
            Some(steps) => steps.accelerate(state, external, held, a),
            None => return false,
        }
        true
    }

    /// Whether what was foreseen last takes a joint beyond a position limit, or further beyond it than it is.
    pub(crate) fn go_beyond(&self, limits: &LimitSet) -> bool {
        self.steps.as_ref().is_some_and(|steps| steps.went_beyond(limits))
    }
}
