//! What joints with drives may be sent: force limits at both ends of a period, and the range of the target.

use super::{Limit, TorqueLimit};
use crate::row::{Motion, Needs, Rows, RowsMut, TickStart};
use crate::within_period::WithinPeriod;
use crate::{Drive, Kind, LimitError, LimitSet, Model, Period, Soft};

/// `|K (q* - q) - D v| <= effort` at the start and at the end of a period, and `q*` within its range. The force of a drive changes while its target
/// is held, and the acceleration of its joint with it: the mean that [`TorqueLimit`] speaks of is not all. A target that is cut at its
/// range brakes the joint harder than its acceleration limit allows.
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
        let share = match self.period.sub_steps {
            0 => 1.0 - AWAY,
            1 => 1.0,
            _ => 1.0 - AWAY_OVER_STEPS,
        };
        let left = if self.period.sub_steps > 1 { 1.0 - SHORT } else { 1.0 };
        let drives = efforts.into_iter().filter_map(|(dof, effort)| match self.drives[dof] {
            Drive::Pd { stiffness, damping } => {
                let joint = model.joint_of_dof(dof);
                // Where a joint is no number, its target is none either.
                let [low, high] =
                    if joint.nq == 1 { self.ranges[dof] } else { [f64::NEG_INFINITY, f64::INFINITY] };
                // A target makes up for any friction as well, where its range is wide enough.
                let rubs = model.friction()[dof] / stiffness;
                let range = if high - low > 2.0 * rubs { [low + rubs, high - rubs] } else { [low, high] };
                let (name, idx_q, effort) = (model.dof_name(dof), joint.idx_q, left * effort);
                Some(Joint {
                    dof,
                    idx_q,
                    effort,
                    stiffness,
                    damping,
                    range,
                    share,
                    asks_for_a_brake: false,
                    name,
                })
            }
            _ => None,
        });
        let is_free = |i: &usize| match self.drives[*i] {
            Drive::Position | Drive::Velocity => false,
            _ => controllable.contains(i) || !model.held()[*i],
        };
        let free = (0..model.nv()).filter(is_free).collect();
        let within = WithinPeriod::new(model, &self.drives, free, self.period);
        Ok(Some(Box::new(DriveTorqueRows::new(drives.collect(), within, self.period))))
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
    /// Braking may ask for more than its range, or than what a force that changes within a period leaves.
    asks_for_a_brake: bool,
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

/// By which share of the way a target stays away from the end of its range: without physics steps, where the rows know a drive on average alone, and
/// over several, in which the robot's mass and weight change.
const AWAY: f64 = 0.2;
const AWAY_OVER_STEPS: f64 = 0.1;

/// By which share of it a force stays below its end over several physics steps, in which the robot's mass and weight change.
const SHORT: f64 = 0.01;

/// What a brake leaves of a drive's force over several physics steps, as a share of it, and of the way to the end of a range: the steps lead to the
/// velocities of constant accelerations on another way, and to other positions from period to period.
const RESERVE: f64 = 0.02;
const RESERVE_OF_TARGETS: f64 = 0.1;

/// What is left of a way to the end of a range is a share of at least this [rad or m].
const SHORTEST_WAY: f64 = 0.01;

/// Ranges this close are the same [rad or m].
const NEAR: f64 = 1e-9;

/// Share of its force by which a drive may push harder within a period than on average, before a brake is stored that reckons with it.
const SWINGS: f64 = 0.03;

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
    within: WithinPeriod,
    /// Where among its free dofs each of the joints is.
    places: Vec<usize>,
    period: Period,
}

impl DriveTorqueRows {
    fn new(joints: Vec<Joint>, within: WithinPeriod, period: Period) -> DriveTorqueRows {
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
        let places = joints.iter().filter_map(|j| within.free().iter().position(|i| *i == j.dof)).collect();
        DriveTorqueRows { joints, rows, within, places, period }
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
        Needs { motors: true, mass: self.period.sub_steps > 1, ..Needs::default() }
    }

    fn fit(&mut self, limits: &LimitSet) -> Result<(), LimitError> {
        for j in &mut self.joints {
            let reach = j.drive().reach(&self.period, j.effort, limits.velocity[j.dof]);
            let [low, high] = [limits.q_lower[j.dof] - reach, limits.q_upper[j.dof] + reach];
            let beyond = low < j.range[0] - NEAR || high > j.range[1] + NEAR;
            let swing = j.stiffness * self.period.lag() * limits.velocity[j.dof];
            j.asks_for_a_brake = low.is_finite() && high.is_finite() && beyond
                || swing.is_finite() && swing > SWINGS * j.effort;
        }
        Ok(())
    }

    fn needs_a_brake(&self) -> bool {
        self.joints.iter().any(|j| j.asks_for_a_brake)
    }

    fn reserves(&self) -> Vec<f64> {
        let of = |at| if at == At::Target { RESERVE_OF_TARGETS } else { RESERVE };
        let over_steps = self.period.sub_steps > 1;
        self.of_rows().map(|(_, at)| if over_steps { of(at) } else { 0.0 }).collect()
    }

    /// The mean force and what [`WithinPeriod`] adds at either end. A target is within its range where the force at the start is within what the ends of
    /// the range make.
    fn fill(&mut self, tick: &mut TickStart<'_>, rows: &mut RowsMut<'_>) {
        let (t, nv) = (tick.period.dt, tick.v.len());
        let n = self.within.free().len();
        let v = tick.v;
        // each acceleration by itself, then the velocities
        self.within.update(tick.mass, nv, n + 1, |r, i, c| match c {
            _ if c == n => [v[i], 0.0],
            _ => [0.0, f64::from(u8::from(c == r))],
        });
        for (r, (k, at)) in self.rows.iter().enumerate() {
            let (j, place) = (&self.joints[*k], self.places[*k]);
            let more = |c: usize, motion: [f64; 2]| match at {
                At::End => self.within.at_end(place, c, motion),
                At::Start | At::Target => self.within.at_start(place, c, motion),
            };
            let row = rows.row(r);
            tick.motor(j.dof, row);
            for (c, &i) in self.within.free().iter().enumerate() {
                row[i] += more(c, [0.0, f64::from(u8::from(c == place))]) / t;
            }
            let still = more(n, [v[j.dof], 0.0]) + tick.bias[j.dof];
            let [low, high] = match at {
                At::Target => j.forces(tick.q[j.idx_q], v[j.dof]),
                _ => [-j.effort, j.effort],
            };
            (rows.lower[r], rows.upper[r]) = (low - still, high - still);
        }
    }

    fn excess(&mut self, motion: &mut Motion<'_>, excess: &mut [f64]) {
        let (v, a) = (motion.v, motion.acceleration);
        self.within.update(motion.mass, v.len(), 1, |_, i, _| [v[i], a[i]]);
        for (x, (k, at)) in excess.iter_mut().zip(&self.rows) {
            let (j, place) = (&self.joints[*k], self.places[*k]);
            let moved = [v[j.dof], a[j.dof]];
            let start = motion.torque[j.dof] + self.within.at_start(place, 0, moved);
            *x = match at {
                At::Start => start.abs() / j.effort - 1.0,
                At::End => {
                    (motion.torque[j.dof] + self.within.at_end(place, 0, moved)).abs() / j.effort - 1.0
                }
                At::Target => {
                    // The target that the drive will be sent.
                    let q = motion.q[j.idx_q];
                    let target = q + (start + j.damping * v[j.dof]) / j.stiffness;
                    let [low, high] = j.targets(q);
                    let beyond = |by: f64, way: f64| by / way.max(SHORTEST_WAY);
                    beyond(target - high, j.range[1] - q).max(beyond(low - target, q - j.range[0]))
                }
            };
        }
    }
}
