//! `guard = "drive"`: keeps the force of every drive, and its change, within what its motor allows, by bounds on the drive's target in
//! closed form. It is for robots on legs, and promises nothing about their motion or balance.

use super::Parts;
use super::parts::unusable;
use crate::snapshot::{Manifest, SnapshotError};
use nearl_constraints::{ActionReport, Drive, Model, Period, Projector, Recent};

/// A force further than this beyond its interval [N·m or N] counts as a limit that was broken.
const TOLERANCE: f64 = 1e-9;

/// Targets of drives that keep each drive's force, and its change from tick to tick, within the limits, whatever the rest of the robot does. With
/// `tau_before` the force at the start of the tick before, of effort `E` and rate `R`:
///
/// ```text
///     start:  |K (q* - q) - D v| <= E       and   |K (q* - q) - D v - tau_before| <= R T
///     end:    |K (q* - q - T v) - D v| <= E - (D T + kappa K T^2) A
/// ```
///
/// That is an interval of `q*` for each joint, and `tau_before` is always in the one of the start. `A` is the acceleration limit, where there is
/// one: by how much the joint may leave the path of its velocity within the tick, with `kappa` of [`Period`](nearl_constraints::Period). Where the end asks for
/// more than the start allows, the force goes as far as that does; where nothing is left of `E` there is no end to keep ([`force_left`]).
pub(super) struct DriveBox {
    joints: Vec<Joint>,
    period: Period,
    /// Forces at the start of the last ticks (n_act); not known at the start of an episode, when no rate holds.
    forces: Recent,
    /// Those of the tick under way (n_act).
    force: Vec<f64>,
}

struct Joint {
    /// Place in the action.
    at: usize,
    dof: usize,
    idx_q: usize,
    stiffness: f64,
    damping: f64,
    effort: f64,
    rate: f64,
    acceleration: f64,
}

impl DriveBox {
    /// For a task whose controllable joints all have drives.
    ///
    /// # Errors
    /// [`SnapshotError::Unusable`] naming the joint that has none, or no torque limit.
    pub(super) fn new(
        m: &Manifest,
        model: &Model,
        dofs: &[usize],
        projector: &Projector,
    ) -> Result<DriveBox, SnapshotError> {
        let (drives, limits) = (Parts::drives(m, model, dofs)?, projector.limits());
        let motors = Parts::motors(model, dofs, &drives);
        let rates = m.task.constraints.torque_rate.as_ref();
        let joint = |(k, &dof): (usize, &usize)| {
            let name = model.dof_name(dof);
            let Drive::Pd { stiffness, damping } = drives[dof] else {
                return Err(unusable(&format!(
                    "[constraints] guard = \"drive\" needs drives, but joint '{name}' is commanded {}; write [command] interface = \"pd\" with \
                     stiffness and damping",
                    drives[dof].name()
                )));
            };
            let effort = limits.effort[dof];
            if !effort.is_finite() {
                return Err(unusable(&format!(
                    "[constraints] guard = \"drive\" has no torque limit to keep for joint '{name}'; add torque = {{ scale = 1.0 }}"
                )));
            }
            let rate = rates.and_then(|rate| {
                let margin = rate.margin.as_ref().and_then(|margin| margin.at(model, dof)).unwrap_or(0.0);
                Some(rate.limit.at(model, dof)? - margin)
            });
            let rate = rate.unwrap_or(f64::INFINITY);
            let acceleration = Some(limits.acceleration[dof]).filter(|a| a.is_finite()).unwrap_or(0.0);
            let idx_q = model.joint_of_dof(dof).idx_q;
            let at = motors.as_ref().map_err(Clone::clone)?.place(k);
            Ok(Joint { at, dof, idx_q, stiffness, damping, effort, rate, acceleration })
        };
        let joints = dofs.iter().enumerate().map(joint).collect::<Result<Vec<_>, _>>()?;
        let n = joints.len();
        Ok(DriveBox { period: m.task.period(), forces: Recent::new(n), force: vec![0.0; n], joints })
    }

    /// Where in the action the `k`-th controllable joint's command is.
    pub(super) fn place(&self, k: usize) -> usize {
        self.joints[k].at
    }

    /// Puts the targets in `action` (n_act) into their intervals. What it returns has the distance of the target that was moved furthest
    /// [rad or m], and counts every drive that was asked for a force outside its interval. With `hold` off nothing is moved.
    pub(super) fn update(&mut self, q: &[f64], v: &[f64], action: &mut [f64], hold: bool) -> ActionReport {
        let mut report = ActionReport::default();
        let before = self.forces.get();
        for (k, (joint, given)) in self.joints.iter().zip(&mut self.force).enumerate() {
            let action = &mut action[joint.at];
            let (at, v) = (q[joint.idx_q], v[joint.dof]);
            let (low, high) = joint.forces(v, &self.period, before.map(|before| before[k]));
            let asked = joint.stiffness * (*action - at) - joint.damping * v;
            let broken = u32::from(asked < low - TOLERANCE || asked > high + TOLERANCE);
            report.raw_violations += broken;
            report.target_violations += if hold { 0 } else { broken };
            let force = if hold { asked.clamp(low, high) } else { asked };
            if force != asked {
                let target = at + (force + joint.damping * v) / joint.stiffness;
                report.moved = report.moved.max((target - *action).abs());
                *action = target;
            }
            *given = force;
        }
        self.forces.push(&self.force);
        report
    }

    pub(super) fn forget(&mut self) {
        self.forces.forget();
    }

    /// The target of the tick before came too late and was never sent.
    pub(super) fn recall(&mut self) {
        self.forces.recall();
    }

    /// Appends what the next tick depends on beside its arguments.
    pub(super) fn write_memory(&self, memory: &mut Vec<f64>) {
        self.forces.write(memory);
    }

    /// Takes what [`DriveBox::write_memory`] gave.
    pub(super) fn set_memory(&mut self, memory: &[f64]) {
        self.forces.read(memory);
    }
}

/// What the start of a tick may use of `effort`, so that its end keeps it where the joint accelerates by `acceleration` all along.
pub fn force_left(period: &Period, (stiffness, damping): (f64, f64), effort: f64, acceleration: f64) -> f64 {
    effort - (damping + period.kappa * stiffness * period.dt) * acceleration * period.dt
}

impl Joint {
    /// Least and largest force at the start of a tick.
    fn forces(&self, v: f64, period: &Period, before: Option<f64>) -> (f64, f64) {
        let step = self.rate * period.dt;
        let (mut low, mut high) = (-self.effort, self.effort);
        if let Some(before) = before {
            (low, high) = ((before - step).clamp(low, high), (before + step).clamp(low, high));
        }
        let falls = self.stiffness * period.dt * v;
        let room = force_left(period, (self.stiffness, self.damping), self.effort, self.acceleration);
        if room <= 0.0 {
            return (low, high);
        }
        ((falls - room).clamp(low, high), (falls + room).clamp(low, high))
    }
}
