//! The independent judge: evaluates the limits themselves at a next state. It shares no code with the projector's
//! assembly: no boxes, no rows, no mass matrix; the motor force comes from inverse dynamics.

use crate::ledger::Counts;
use crate::viability::{Kind, Period};
use crate::{Consistency, Dynamics, LimitSet, Model};

/// A violation counts above this share of its limit (of 1 where the limit is smaller).
pub const TOLERANCE: f64 = 1e-9;

/// What a next state violates.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Verdict {
    /// Number of violations by kind.
    pub counts: Counts,
    /// The largest, as a share of its limit.
    pub worst: f64,
    /// Dof of the largest.
    pub worst_dof: usize,
}

impl Verdict {
    /// True when every limit holds.
    pub fn accepts(&self) -> bool {
        self.counts.total() == 0
    }

    fn see(&mut self, kind: Kind, dof: usize, value: f64, limit: f64) {
        if limit == f64::INFINITY && !value.is_nan() {
            return;
        }
        let excess = (value - limit) / limit.abs().max(1.0);
        if excess.is_nan() || excess > TOLERANCE {
            self.counts.add(kind);
            if excess.is_nan() || excess > self.worst {
                (self.worst, self.worst_dof) = (excess, dof);
            }
        }
    }
}

/// Scratch and constants of the judge.
pub struct Checker {
    dynamics: Dynamics,
    limits: LimitSet,
    dofs: Vec<(usize, usize)>,
    period: Period,
    consistency: Consistency,
    torque: bool,
    a: Vec<f64>,
    tau: Vec<f64>,
    passive: Vec<f64>,
}

impl Checker {
    /// A judge of `limits` on the `controllable` dofs.
    pub fn new(
        model: &Model,
        limits: &LimitSet,
        controllable: &[usize],
        period: Period,
        consistency: Consistency,
    ) -> Checker {
        let zero = || vec![0.0; model.nv()];
        let torque = controllable.iter().any(|i| limits.effort[*i].is_finite());
        Checker {
            dynamics: Dynamics::new(model),
            limits: limits.clone(),
            dofs: controllable.iter().map(|i| (*i, model.joint_of_dof(*i).idx_q)).collect(),
            period,
            consistency,
            torque,
            a: zero(),
            tau: zero(),
            passive: zero(),
        }
    }

    /// Judges going from (`q`, `v`) to (`q_next`, `v_next`) in one period; configurations nq, velocities nv.
    pub fn check(&mut self, q: &[f64], v: &[f64], q_next: &[f64], v_next: &[f64]) -> Verdict {
        let mut verdict = Verdict::default();
        for k in 0..self.dofs.len() {
            let (i, iq) = self.dofs[k];
            let a = (v_next[i] - v[i]) / self.period.dt;
            verdict.see(Kind::Velocity, i, v_next[i].abs(), self.limits.velocity[i]);
            verdict.see(Kind::Acceleration, i, a.abs(), self.limits.acceleration[i]);
            if self.limits.has_position(i) {
                self.positions(i, (q[iq], v[i]), (q_next[iq], v_next[i]), &mut verdict);
            }
        }
        if self.torque {
            self.motors(q, v, v_next, &mut verdict);
        }
        verdict
    }

    /// Next position inside both limits, sub-step positions inside, room to brake.
    fn positions(&self, i: usize, now: (f64, f64), next: (f64, f64), verdict: &mut Verdict) {
        let (low, high) = (self.limits.q_lower[i], self.limits.q_upper[i]);
        let kinematic = self.consistency == Consistency::Kinematic;
        let (t, tau) = (self.period.dt, self.period.tau);
        // A whole period of braking from standstill must not carry the dof beyond the limits on the other side.
        let room = (high - low) / (self.period.kappa * t * t + 0.5 * (t - 0.5 * tau).powi(2));
        let a_max = self.limits.braking[i].min(self.limits.velocity[i] / t).min(room);
        let (mut highest, mut lowest) = (next.0, next.0);
        if kinematic {
            let (mut q, mut v) = now;
            let a = (next.1 - v) / self.period.dt;
            for _ in 0..self.period.sub_steps {
                v += a * self.period.tau;
                q += v * self.period.tau;
                (highest, lowest) = (highest.max(q), lowest.min(q));
            }
            let turn = -v / a; // constant acceleration: the extreme is where the velocity is zero
            if self.period.sub_steps == 0 && turn > 0.0 && turn < self.period.dt {
                let extreme = q + v * turn + 0.5 * a * turn * turn;
                (highest, lowest) = (highest.max(extreme), lowest.min(extreme));
            }
        }
        verdict.see(Kind::Position, i, highest, high);
        verdict.see(Kind::Position, i, -lowest, -low);
        if kinematic && a_max.is_finite() {
            let half = 0.5 * a_max * tau;
            let stop = |speed: f64| (speed - half).max(0.0).powi(2) / (2.0 * a_max); // braking distance
            verdict.see(Kind::Viability, i, next.0 + stop(next.1), high.max(next.0));
            verdict.see(Kind::Viability, i, stop(-next.1) - next.0, (-low).max(-next.0));
        }
    }

    /// `|rnea(q, v, (v' - v) / T) - passive| <= effort`.
    fn motors(&mut self, q: &[f64], v: &[f64], v_next: &[f64], verdict: &mut Verdict) {
        for i in 0..v.len() {
            self.a[i] = (v_next[i] - v[i]) / self.period.dt;
        }
        self.dynamics.rnea(q, v, &self.a, &mut self.tau);
        self.dynamics.passive(q, v, &mut self.passive);
        for &(i, _) in &self.dofs {
            let motor = self.tau[i] - self.passive[i];
            verdict.see(Kind::Torque, i, motor.abs(), self.limits.effort[i]);
        }
    }
}
