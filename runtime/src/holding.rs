//! Checks whether the motors can hold the robot still against gravity, over configurations within the position limits.

use nearl_constraints::{ConstraintSettings, Dynamics, LimitSet, Model, Period};

/// Seeded configurations the search starts from, and steps of its grid over a joint's range.
const STARTS: usize = 2000;
const GRID: usize = 60;

/// What standing still asks of one motor where it asks most.
#[derive(Clone, Debug, PartialEq)]
pub struct Load {
    /// Degree of freedom.
    pub dof: usize,
    /// Joint.
    pub joint: String,
    /// Force it takes to stand still there [N m or N].
    pub needed: f64,
    /// Force it has [N m or N].
    pub effort: f64,
    /// Configuration (nq).
    pub q: Vec<f64>,
}

impl Load {
    /// The motor can hold it.
    pub fn holds(&self) -> bool {
        self.needed <= self.effort
    }
}

/// `limits` with the forces that the motors have at standstill: those of a hard `torque_speed` where they are less.
pub fn standing(limits: &LimitSet, of: &ConstraintSettings, model: &Model) -> LimitSet {
    let mut standing = limits.clone();
    if let Some(line) = of.torque_speed.as_ref().filter(|line| line.soft.is_none()) {
        for (i, effort) in standing.effort.iter_mut().enumerate() {
            let margin = line.margin.as_ref().and_then(|margin| margin.at(model, i)).unwrap_or(0.0);
            *effort = line.stall.at(model, i).map_or(*effort, |stall| effort.min(stall - margin));
        }
    }
    standing
}

/// For each controllable joint with a torque limit, the configuration within the position limits in which standing still asks most of its
/// motor: seeded starts, then joint by joint over a grid until nothing rises. Joints that are not controllable rest at the neutral
/// configuration, and a floating base is held. A search from below: what it finds is needed.
pub fn heaviest(model: &Model, limits: &LimitSet, controllable: &[usize], period: &Period) -> Vec<Load> {
    let mut search = Search {
        dynamics: Dynamics::new(model),
        period,
        rest: vec![0.0; model.nv()],
        tau: vec![0.0; model.nv()],
    };
    let ranges = ranges(model, limits, controllable);
    let limited: Vec<usize> =
        controllable.iter().copied().filter(|&i| limits.effort[i].is_finite()).collect();
    let mut loads: Vec<Load> = limited
        .iter()
        .map(|&dof| {
            let (joint, effort) = (model.dof_name(dof), limits.effort[dof]);
            Load { dof, joint, needed: 0.0, effort, q: model.neutral() }
        })
        .collect();
    let mut q = model.neutral();
    for start in 0..STARTS {
        spread(start, &ranges, &mut q);
        search.forces(&q);
        for load in &mut loads {
            search.take(load, &q);
        }
    }
    loads.iter_mut().for_each(|load| search.climb(load, &ranges));
    loads
}

/// The configuration `start` of a sequence that fills the ranges.
pub(crate) fn spread(start: usize, ranges: &[(usize, f64, f64)], q: &mut [f64]) {
    for (k, &(idx_q, low, high)) in ranges.iter().enumerate() {
        // Additive recurrence (Roberts 2018), spread a little beyond the ends and cut back: the ends are where arms are heaviest.
        let share = 1.2 * ((start + 1) as f64 * (1.0 / (k as f64 + 1.618)).fract()).fract() - 0.1;
        q[idx_q] = low + share.clamp(0.0, 1.0) * (high - low);
    }
}

/// Configuration index and range of each controllable joint of one degree of freedom.
pub(crate) fn ranges(model: &Model, limits: &LimitSet, controllable: &[usize]) -> Vec<(usize, f64, f64)> {
    let or = |x: f64, otherwise: f64| if x.is_finite() { x } else { otherwise };
    let joints = model.joints().iter().filter(|j| j.nq == 1 && j.nv == 1 && controllable.contains(&j.idx_v));
    joints
        .map(|j| {
            let (low, high) = (limits.q_lower[j.idx_v], limits.q_upper[j.idx_v]);
            (j.idx_q, or(low, -std::f64::consts::PI), or(high, std::f64::consts::PI))
        })
        .collect()
}

struct Search<'a> {
    dynamics: Dynamics,
    period: &'a Period,
    rest: Vec<f64>,
    tau: Vec<f64>,
}

impl Search<'_> {
    fn forces(&mut self, q: &[f64]) {
        self.dynamics.motors(self.period, q, &self.rest, &self.rest, &mut self.tau);
    }

    /// Keeps `q` if it asks more; true if it does.
    fn take(&self, load: &mut Load, q: &[f64]) -> bool {
        let needed = self.tau[load.dof].abs();
        let is_more = needed > load.needed * (1.0 + 1e-9);
        if is_more {
            load.needed = needed;
            load.q.copy_from_slice(q);
        }
        is_more
    }

    fn climb(&mut self, load: &mut Load, ranges: &[(usize, f64, f64)]) {
        for _ in 0..12 {
            let mut rose = false;
            for &(idx_q, low, high) in ranges {
                let mut q = load.q.clone();
                for step in 0..=GRID {
                    q[idx_q] = low + step as f64 / GRID as f64 * (high - low);
                    self.forces(&q);
                    rose |= self.take(load, &q);
                }
            }
            if !rose {
                return;
            }
        }
    }
}

/// One sentence naming every joint that cannot be held; none if all can.
pub fn refusal(model: &Model, limits: &LimitSet, controllable: &[usize], period: &Period) -> Option<String> {
    let loads = heaviest(model, limits, controllable, period);
    let weak: Vec<String> = loads
        .iter()
        .filter(|load| !load.holds())
        .map(|l| format!("joint '{}' needs {:.1} N m or N of its {:.1}", l.joint, l.needed, l.effort))
        .collect();
    (!weak.is_empty()).then(|| {
        format!(
            "the motors cannot hold the robot still everywhere within its position limits: {}; \
             raise constraints.torque.scale (or the stall of torque_speed), or narrow the position limits to where they can",
            weak.join("; ")
        )
    })
}
