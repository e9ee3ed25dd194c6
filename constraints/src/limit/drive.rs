//! What joints with drives may be sent: force limits at both ends of a period, and the range of the target.

use super::{Limit, TorqueLimit};
use crate::row::{Motion, Needs, Rows, RowsMut, TickStart};
use crate::{Drive, Kind, LimitError, LimitSet, Model, Period, Soft};

/// `|K (q* - q) - D v| <= effort` at the start and at the end of a period, and `q*` within its range. The force of a drive changes while its target
/// is held: the mean that [`TorqueLimit`] speaks of is not all. With constant acceleration it is a parabola whose ends are its largest values but for
/// a share of the order of `K T^2 a`. A target that is cut at its range brakes the joint harder than its acceleration limit allows.
#[derive(Debug, Clone)]
pub struct DriveTorqueLimit {
    torque: TorqueLimit,
    /// By dof (nv).
    drives: Vec<Drive>,
    ranges: Vec<[f64; 2]>,
    period: Period,
}

impl DriveTorqueLimit {
    /// The forces of `torque` for the joints that have a drive, and the `ranges` of their targets [rad or m]; both by dof (nv).
    pub fn new(
        torque: TorqueLimit,
        drives: &[Drive],
        ranges: &[[f64; 2]],
        period: Period,
    ) -> DriveTorqueLimit {
        DriveTorqueLimit { torque, drives: drives.to_vec(), ranges: ranges.to_vec(), period }
    }
}

impl Limit for DriveTorqueLimit {
    fn name(&self) -> &'static str {
        "torque"
    }

    fn rows(&self, model: &Model, controllable: &[usize]) -> Result<Option<Box<dyn Rows>>, LimitError> {
        let efforts = self.torque.efforts(model, controllable)?;
        let share = if self.period.sub_steps == 1 { 1.0 } else { 1.0 - AWAY };
        let drives = efforts.into_iter().filter_map(|(dof, effort)| match self.drives[dof] {
            Drive::Pd { stiffness, damping } => {
                let joint = model.joint_of_dof(dof);
                // Where a joint is no number, its target is none either.
                let [low, high] =
                    if joint.nq == 1 { self.ranges[dof] } else { [f64::NEG_INFINITY, f64::INFINITY] };
                // A target makes up for any friction as well, where its range is wide enough.
                let rubs = model.friction()[dof] / stiffness;
                let range = if high - low > 2.0 * rubs { [low + rubs, high - rubs] } else { [low, high] };
                let (name, idx_q) = (model.dof_name(dof), joint.idx_q);
                Some(Joint { dof, idx_q, effort, stiffness, damping, range, share, is_cut: false, name })
            }
            _ => None,
        });
        Ok(Some(Box::new(DriveTorqueRows::new(drives.collect(), self.period))))
    }

    fn soft(&self) -> Option<Soft> {
        self.torque.soft()
    }
}

struct Joint {
    dof: usize,
    idx_q: usize,
    effort: f64,
    stiffness: f64,
    damping: f64,
    /// Of its target [rad or m].
    range: [f64; 2],
    /// Share of the way to the ends of the range that a target may go.
    share: f64,
    /// The range ends before what a brake may ask for.
    is_cut: bool,
    name: String,
}

impl Joint {
    fn drive(&self) -> Drive {
        Drive::Pd { stiffness: self.stiffness, damping: self.damping }
    }

    /// Least and largest target of a joint at `q`.
    fn targets(&self, q: f64) -> [f64; 2] {
        self.range.map(|end| q + self.share * (end - q))
    }

    /// Least and largest force at the start of a period that begins at `q`, `v`, by effort and range.
    fn forces(&self, q: f64, v: f64) -> [f64; 2] {
        let [low, high] = self.targets(q).map(|end| self.stiffness * (end - q) - self.damping * v);
        [low.clamp(-self.effort, self.effort), high.clamp(-self.effort, self.effort)]
    }
}

/// By which share of the way a target stays away from the end of its range where the rows know it on average alone: what leads through several
/// physics steps differs by that, or without steps what a drive makes of a period.
const AWAY: f64 = 0.2;

/// Ranges this close are the same [rad or m].
const NEAR: f64 = 1e-9;

/// What a row is of. A drive that is evaluated once has the same force at both ends.
#[derive(Clone, Copy, PartialEq)]
enum At {
    Start,
    End,
    Target,
}

impl At {
    fn name(self) -> &'static str {
        match self {
            At::Start => "at the start",
            At::End => "at the end",
            At::Target => "by its target",
        }
    }
}

/// Row by row the joint and what of it; one curve each, or what rises and falls between two ticks of a brake would be hidden below another.
struct DriveTorqueRows {
    joints: Vec<Joint>,
    rows: Vec<(usize, At)>,
    period: Period,
}

impl DriveTorqueRows {
    fn new(joints: Vec<Joint>, period: Period) -> DriveTorqueRows {
        let has = |j: &Joint, at: At| match at {
            At::Start => true,
            At::End => period.sub_steps != 1,
            At::Target => j.range.iter().any(|end| end.is_finite()),
        };
        let of = |(k, j): (usize, &Joint)| {
            let parts: Vec<_> =
                [At::Start, At::End, At::Target].into_iter().filter(|at| has(j, *at)).collect();
            parts.into_iter().map(move |at| (k, at))
        };
        let rows = joints.iter().enumerate().flat_map(of).collect();
        DriveTorqueRows { joints, rows, period }
    }

    fn of_rows(&self) -> impl Iterator<Item = (&Joint, At)> {
        self.rows.iter().map(|(k, at)| (&self.joints[*k], *at))
    }
}

impl Rows for DriveTorqueRows {
    fn kind(&self) -> Kind {
        Kind::Torque
    }

    fn names(&self) -> Vec<String> {
        self.of_rows().map(|(j, at)| format!("{} {}", j.name, at.name())).collect()
    }

    fn sizes(&self) -> Vec<f64> {
        self.of_rows().map(|(j, _)| j.effort).collect()
    }

    fn needs(&self) -> Needs {
        Needs { motors: true, ..Needs::default() }
    }

    fn fit(&mut self, limits: &LimitSet) -> Result<(), LimitError> {
        for j in &mut self.joints {
            let reach = j.drive().reach(&self.period, j.effort, limits.velocity[j.dof]);
            let [low, high] = [limits.q_lower[j.dof] - reach, limits.q_upper[j.dof] + reach];
            j.is_cut =
                low.is_finite() && high.is_finite() && (low < j.range[0] - NEAR || high > j.range[1] + NEAR);
        }
        Ok(())
    }

    fn needs_a_brake(&self) -> bool {
        self.joints.iter().any(|j| j.is_cut)
    }

    /// With `tau` on average, `h` and `c` of the period, and the last evaluation of the drive at `e = T - tau_s`, where the joint has come
    /// to `q + e v + e T a / 2`:
    ///
    /// ```text
    ///     start = tau + K (h v + c a) + D h a          end = start - K (e v + e T a / 2) - D e a
    /// ```
    ///
    /// A target is within its range where the force at the start is within what the ends of the range make.
    fn fill(&mut self, tick: &mut TickStart<'_>, rows: &mut RowsMut<'_>) {
        let period = *tick.period;
        let (t, lag, sag) = (period.dt, period.lag(), period.sag());
        let end = t - period.tau;
        for (r, (k, at)) in self.rows.iter().enumerate() {
            let j = &self.joints[*k];
            let v = tick.v[j.dof];
            let mut force = [j.stiffness * lag * v, j.stiffness * sag + j.damping * lag];
            if *at == At::End {
                force[0] -= j.stiffness * end * v;
                force[1] -= (0.5 * j.stiffness * t + j.damping) * end;
            }
            let [still, by_acceleration] = force;
            let row = rows.row(r);
            tick.motor(j.dof, row);
            row[j.dof] += by_acceleration / t;
            let still = still + tick.bias[j.dof];
            let [low, high] = match at {
                At::Target => j.forces(tick.q[j.idx_q], v),
                _ => [-j.effort, j.effort],
            };
            (rows.lower[r], rows.upper[r]) = (low - still, high - still);
        }
    }

    /// From the target position that the drive will be sent.
    fn excess(&mut self, motion: &mut Motion<'_>, excess: &mut [f64]) {
        let period = motion.period;
        let (t, end) = (period.dt, period.dt - period.tau);
        for (x, (k, at)) in excess.iter_mut().zip(&self.rows) {
            let j = &self.joints[*k];
            let (v, a) = (motion.v[j.dof], motion.acceleration[j.dof]);
            // How far the target is from where the joint is.
            let to = crate::drive::Arrival { q: 0.0, v: 0.0, a, tau: motion.torque[j.dof] };
            let target = j.drive().command(period, 0.0, v, &to);
            let force = |q: f64, v: f64| j.stiffness * (target - q) - j.damping * v;
            *x = match at {
                At::Start => force(0.0, v).abs() / j.effort - 1.0,
                At::End => force(end * (v + 0.5 * t * a), v + end * a).abs() / j.effort - 1.0,
                At::Target => {
                    let q = motion.q[j.idx_q];
                    let [low, high] = j.targets(q);
                    j.stiffness * (q + target - high).max(low - q - target) / j.effort
                }
            };
        }
    }
}
