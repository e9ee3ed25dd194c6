//! Which commands take the joints where they are to arrive.

use crate::controller::{idx_q, target_ranges};
use crate::motors::Motors;
use crate::snapshot::Manifest;
use nearl_constraints::drive::{Arrival, Held, SHORT};
use nearl_constraints::{Drive, LimitSet, Model, Period, PeriodDynamics, PhysicsSteps, Target};

/// The commands of the controllable joints for the motion and the mean forces of a period ([`Drive::command`]). Where the plant makes several
/// physics steps of it, forces and the targets of drives are those whose steps lead there ([`PhysicsSteps`]); no force and no position leaves its
/// limit for that.
pub(crate) struct Arrivals {
    period: Period,
    /// By dof (nv), of motors whose force falls with their speed.
    lines: Vec<Option<Line>>,
    dofs: Vec<usize>,
    /// By dof (nv).
    drives: Vec<Drive>,
    /// Configuration index of each dof; 0 where it has none of its own.
    idx_q: Vec<usize>,
    /// Dry friction by dof (nv), which torque limits leave to the motors beside what they allow.
    friction: Vec<f64>,
    /// Forces of drives (nv) short of where MuJoCo's step is no longer implicit in their damping; infinite for the others.
    ends: Vec<f64>,
    steps: Option<PhysicsSteps>,
    commands: Vec<f64>,
    held: Vec<Held>,
    most: Vec<f64>,
    /// Between which velocities the joints end (nv), as far as it is known.
    within: Vec<[f64; 2]>,
}

/// Where a hard `torque_speed` leaves a motor so much force [N m or N] at standstill, and less by `slope` [N m s/rad or N s/m] of its speed.
#[derive(Clone, Copy)]
struct Line {
    most: f64,
    slope: f64,
}

impl Line {
    fn of(m: &Manifest, model: &Model, dof: usize) -> Option<Line> {
        let limit = m.task.constraints.torque_speed.as_ref().filter(|limit| limit.soft.is_none())?;
        let (stall, no_load) = (limit.stall.at(model, dof)?, limit.no_load.at(model, dof)?);
        let margin = limit.margin.as_ref().and_then(|margin| margin.at(model, dof)).unwrap_or(0.0);
        Some(Line { most: stall - margin, slope: stall / no_load })
    }

    /// The largest force in the direction of `force` at both speeds.
    fn most(self, force: f64, speeds: [f64; 2]) -> f64 {
        let along = speeds.map(|v| if force < 0.0 { -v } else { v });
        self.most - self.slope * along[0].max(along[1])
    }
}

/// Limits of single joints, and between which accelerations each dof may be in a tick [rad/s² or m/s²] (nv): see
/// [`Projector::limits_of_tick`](nearl_constraints::Projector::limits_of_tick).
pub(crate) type Within<'a> = (&'a LimitSet, &'a [[f64; 2]]);

const FREE: [f64; 2] = [f64::NEG_INFINITY, f64::INFINITY];

/// How often a tick is projected once more because physics steps do not lead to its target.
pub(crate) const ROUNDS: usize = 3;

impl Arrivals {
    /// For commands to `dofs`; `drives` (nv) says what they are, and the motors take them as far as their range goes. Of the others those that
    /// are `led` have the acceleration that they are given, none where nothing gives one.
    pub(crate) fn new(
        m: &Manifest,
        model: &Model,
        dofs: &[usize],
        (drives, motors): (&[Drive], &Motors),
        led: &[usize],
    ) -> Arrivals {
        let (nv, period) = (model.nv(), m.task.period());
        let by_position = |i: &usize| matches!(drives[*i], Drive::Position | Drive::Velocity);
        let follow: Vec<usize> =
            (0..nv).filter(|i| if dofs.contains(i) { by_position(i) } else { led.contains(i) }).collect();
        let ranges = target_ranges(m, nv, dofs, motors);
        let end = |i: usize| match model.drive_damping()[i] > 0.0 {
            true => (1.0 - SHORT) * model.effort_limit()[i],
            false => f64::INFINITY,
        };
        Arrivals {
            ends: (0..nv).map(end).collect(),
            steps: PhysicsSteps::new(model, (drives, &ranges), dofs, &follow, period),
            idx_q: idx_q(model),
            friction: model.friction().to_vec(),
            period,
            lines: (0..nv).map(|i| Line::of(m, model, i).filter(|_| drives[i] == Drive::Effort)).collect(),
            dofs: dofs.to_vec(),
            drives: drives.to_vec(),
            commands: vec![0.0; nv],
            held: (0..nv)
                .map(|i| if led.contains(&i) { Held::Acceleration(0.0) } else { Held::Force(0.0) })
                .collect(),
            most: vec![0.0; nv],
            within: vec![FREE; nv],
        }
    }

    /// A tick begins, of which nothing is known.
    pub(crate) fn begin(&mut self) {
        self.within.fill(FREE);
    }

    /// Between which velocities the joints can end (nv), where the commands found last do not lead from `v` (nv) to the target: one that was held back
    /// leaves others where rows of several joints do not allow them. `None` where they do.
    pub(crate) fn held_back(&mut self, v: &[f64], to: &Target) -> Option<&[[f64; 2]]> {
        let steps = self.steps.as_ref()?;
        steps.hold_back(v, &to.acceleration, &mut self.within).then_some(&self.within)
    }

    /// The commands by dof (nv) that take `q`, `v` to `to` with the accelerations `a` (nv) and the mean forces `tau` (nv), while the
    /// generalised forces `external` (nv) act.
    pub(crate) fn commands(
        &mut self,
        (q, v): (&[f64], &[f64]),
        to: &Target,
        (a, tau): (&[f64], &[f64]),
        external: &[f64],
        within: Within<'_>,
    ) -> &[f64] {
        let (limits, _) = within;
        for &i in &self.dofs {
            let iq = self.idx_q[i];
            let to = Arrival { q: to.q[iq], v: to.v[i], a: a[i], tau: tau[i] };
            self.commands[i] = self.drives[i].command(&self.period, q[iq], v[i], &to);
            if let (Drive::Pd { stiffness, damping }, true) = (self.drives[i], self.ends[i].is_finite()) {
                let target = |force: f64| q[iq] + (force + damping * v[i]) / stiffness;
                self.commands[i] = self.commands[i].max(target(-self.ends[i])).min(target(self.ends[i]));
            }
        }
        if let Some(steps) = &mut self.steps {
            for (i, most) in self.most.iter_mut().enumerate() {
                let by_speed = self.lines[i].map_or(f64::INFINITY, |line| line.most(tau[i], [v[i], to.v[i]]));
                *most = limits.effort[i].min(by_speed) + self.friction[i];
                if self.lines[i].is_some() {
                    *most = most.max(tau[i].abs()); // a brake is executed without margins
                }
            }
            steps.drive((q, v), external, a, (&mut self.commands, &self.most), within);
        }
        &self.commands
    }

    /// Writes the accelerations (nv) that `commands` (nv) lead to. Returns whether the physics steps on the way there take a joint beyond a position
    /// limit, or further beyond it than it is, or ask a drive for more than it may give.
    pub(crate) fn foresee(
        &mut self,
        (q, v): (&[f64], &[f64]),
        (dynamics, external): (&mut PeriodDynamics, &[f64]),
        commands: &[f64],
        limits: &LimitSet,
        a: &mut [f64],
    ) -> bool {
        if let Some(steps) = &mut self.steps {
            let all = limits.effort.iter().zip(&self.friction);
            self.most.iter_mut().zip(all).for_each(|(most, (effort, friction))| *most = effort + friction);
            steps.accelerate((q, v), external, (commands, &self.most), a);
            return steps.went_beyond(limits);
        }
        for &i in &self.dofs {
            self.held[i] = self.drives[i].held(&self.period, q[self.idx_q[i]], v[i], commands[i]);
        }
        dynamics.accelerate(&self.held, a);
        false
    }
}
