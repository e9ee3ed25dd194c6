//! Motor force limits of joints with drives, at both ends of a period.

use super::{Limit, TorqueLimit};
use crate::row::{Motion, Needs, Rows, RowsMut, TickStart};
use crate::{Drive, Kind, LimitError, Model, Soft};

/// `|K (q* - q) - D v| <= effort` at the start and at the end of a period. The force of a drive changes while its target is held:
/// the mean that [`TorqueLimit`] speaks of is not all. With constant acceleration it is a parabola whose ends are its largest values but for a
/// share of the order of `K T^2 a`.
#[derive(Debug, Clone)]
pub struct DriveTorqueLimit {
    torque: TorqueLimit,
    /// By dof (nv).
    drives: Vec<Drive>,
}

impl DriveTorqueLimit {
    /// The forces of `torque` for the joints that have a drive; `drives` by dof (nv).
    pub fn new(torque: TorqueLimit, drives: &[Drive]) -> DriveTorqueLimit {
        DriveTorqueLimit { torque, drives: drives.to_vec() }
    }
}

impl Limit for DriveTorqueLimit {
    fn name(&self) -> &'static str {
        "torque"
    }

    fn rows(&self, model: &Model, controllable: &[usize]) -> Result<Option<Box<dyn Rows>>, LimitError> {
        let efforts = self.torque.efforts(model, controllable)?;
        let drives = efforts.into_iter().filter_map(|(dof, effort)| match self.drives[dof] {
            Drive::Pd { stiffness, damping } => {
                Some(Joint { dof, effort, stiffness, damping, name: model.dof_name(dof) })
            }
            _ => None,
        });
        Ok(Some(Box::new(DriveTorqueRows { joints: drives.collect() })))
    }

    fn soft(&self) -> Option<Soft> {
        self.torque.soft()
    }
}

struct Joint {
    dof: usize,
    effort: f64,
    stiffness: f64,
    damping: f64,
    name: String,
}

/// Of each joint the start of the period, then its end.
struct DriveTorqueRows {
    joints: Vec<Joint>,
}

impl Rows for DriveTorqueRows {
    fn kind(&self) -> Kind {
        Kind::Torque
    }

    fn names(&self) -> Vec<String> {
        self.joints
            .iter()
            .flat_map(|j| ["start", "end"].map(|at| format!("{} at the {at}", j.name)))
            .collect()
    }

    fn sizes(&self) -> Vec<f64> {
        self.joints.iter().flat_map(|j| [j.effort, j.effort]).collect()
    }

    fn needs(&self) -> Needs {
        Needs { motors: true, ..Needs::default() }
    }

    /// With `tau` on average, `h` and `c` of the period, and the last evaluation of the drive at `e = T - tau_s`, where the joint has come
    /// to `q + e v + e T a / 2`:
    ///
    /// ```text
    ///     start = tau + K (h v + c a) + D h a          end = start - K (e v + e T a / 2) - D e a
    /// ```
    fn fill(&mut self, tick: &mut TickStart<'_>, rows: &mut RowsMut<'_>) {
        let period = *tick.period;
        let (t, lag, sag) = (period.dt, period.lag(), period.sag());
        let end = t - period.tau;
        for (r, j) in self.joints.iter().enumerate() {
            let v = tick.v[j.dof];
            let start = [j.stiffness * lag * v, j.stiffness * sag + j.damping * lag];
            let change = [j.stiffness * end * v, (0.5 * j.stiffness * t + j.damping) * end];
            let ends = [start, [start[0] - change[0], start[1] - change[1]]];
            for (k, [still, by_acceleration]) in ends.into_iter().enumerate() {
                let row = rows.row(2 * r + k);
                tick.motor(j.dof, row);
                row[j.dof] += by_acceleration / t;
                let still = still + tick.bias[j.dof];
                (rows.lower[2 * r + k], rows.upper[2 * r + k]) = (-j.effort - still, j.effort - still);
            }
        }
    }

    /// From the target position that the drive will be sent.
    fn excess(&mut self, motion: &mut Motion<'_>, excess: &mut [f64]) {
        let period = motion.period;
        let (t, end) = (period.dt, period.dt - period.tau);
        for (x, j) in excess.chunks_exact_mut(2).zip(&self.joints) {
            let (v, a) = (motion.v[j.dof], motion.acceleration[j.dof]);
            let drive = Drive::Pd { stiffness: j.stiffness, damping: j.damping };
            // Where the joint is does not matter, only how far the target is from there.
            let to = crate::drive::Arrival { q: 0.0, v: 0.0, a, tau: motion.torque[j.dof] };
            let target = drive.command(period, 0.0, v, &to);
            let force = |q: f64, v: f64| j.stiffness * (target - q) - j.damping * v;
            x[0] = force(0.0, v).abs() / j.effort - 1.0;
            x[1] = force(end * (v + 0.5 * t * a), v + end * a).abs() / j.effort - 1.0;
        }
    }
}
