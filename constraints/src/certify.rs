//! Checks whether the motors can give the deceleration that position limits count on ([`viability`](crate::viability)), by inverse dynamics
//! at random states within the limits.

use crate::random::Random;
use crate::viability::{Dof, Period};
use crate::{Dynamics, LimitError, LimitSet, Model};

/// The hardest state met while looking for one in which braking asks too much.
#[derive(Debug, Clone, PartialEq)]
pub struct Certificate {
    /// `(effort - needed) / effort` there; negative: not certified.
    pub margin: f64,
    /// Dof whose motor is the weakest there.
    pub dof: usize,
    /// Force it might need [N·m or N].
    pub needed: f64,
    /// Force it has [N·m or N].
    pub effort: f64,
    /// Configuration (nq).
    pub q: Vec<f64>,
    /// Velocity (nv).
    pub v: Vec<f64>,
    /// Largest factor on all braking decelerations for which every state looked at passes; 0 when gravity and
    /// Coriolis forces alone are too much somewhere.
    pub scale: f64,
    /// Number of states looked at.
    pub samples: usize,
}

impl Certificate {
    /// True when no state was found in which braking asks too much.
    pub fn holds(&self) -> bool {
        self.margin >= 0.0
    }
}

/// Looks for a state of the viable set in which the motors could not give the decelerations B braking counts on:
///
/// ```text
///     sum_j |rows_ij| B_j + |bias_i| <= effort_i
/// ```
///
/// with the motor forces `rows a + bias` of [`Dynamics::motor_rows`],
/// over `samples` seeded random states, a tenth of the positions and half of the velocities at their limits. While it
/// holds, the torque rows never empty the box. It is a search, not a proof: keep some margin. Dofs that are not
/// controllable rest at the neutral configuration.
///
/// # Errors
/// A controllable dof without acceleration or velocity limit; all are named.
pub fn certify_braking(
    model: &Model,
    limits: &LimitSet,
    controllable: &[usize],
    period: &Period,
    samples: usize,
    seed: u64,
) -> Result<Certificate, LimitError> {
    let open = |i: &&usize| limits.braking[**i].is_infinite() || limits.velocity[**i].is_infinite();
    let names: Vec<String> =
        controllable.iter().filter(open).map(|i| format!("'{}'", model.dof_name(*i))).collect();
    if !names.is_empty() {
        let what = format!(
            "braking cannot be certified without acceleration and velocity limits on {}",
            names.join(", ")
        );
        return Err(LimitError::Unusable { what, next: "add both limits for them" });
    }
    let mut search = Search::new(model, limits, controllable, period, seed);
    for _ in 0..samples {
        search.look();
    }
    Ok(search.worst)
}

struct Search<'a> {
    limits: &'a LimitSet,
    controllable: &'a [usize],
    model: &'a Model,
    period: &'a Period,
    dynamics: Dynamics,
    random: Random,
    q: Vec<f64>,
    v: Vec<f64>,
    motors: Vec<f64>,
    bias: Vec<f64>,
    worst: Certificate,
}

impl<'a> Search<'a> {
    fn new(
        model: &'a Model,
        limits: &'a LimitSet,
        controllable: &'a [usize],
        period: &'a Period,
        seed: u64,
    ) -> Search<'a> {
        let (nv, zero) = (model.nv(), vec![0.0; model.nv()]);
        let worst = Certificate {
            margin: f64::INFINITY,
            dof: 0,
            needed: 0.0,
            effort: f64::INFINITY,
            q: model.neutral(),
            v: zero.clone(),
            scale: f64::INFINITY,
            samples: 0,
        };
        Search {
            limits,
            controllable,
            model,
            period,
            dynamics: Dynamics::new(model),
            random: Random(seed),
            q: model.neutral(),
            v: zero.clone(),
            motors: vec![0.0; nv * nv],
            bias: zero,
            worst,
        }
    }

    fn look(&mut self) {
        self.sample();
        self.dynamics.motor_rows(self.period, &self.q, &self.v, &mut self.motors, &mut self.bias);
        let nv = self.v.len();
        for &i in self.controllable {
            let effort = self.limits.effort[i];
            let still = self.bias[i].abs();
            let row = &self.motors[i * nv..(i + 1) * nv];
            let moving: f64 = self.controllable.iter().map(|j| row[*j].abs() * self.limits.braking[*j]).sum();
            let (margin, scale) = (1.0 - (still + moving) / effort, ((effort - still) / moving).max(0.0));
            self.worst.scale = self.worst.scale.min(scale);
            if margin < self.worst.margin {
                let needed = still + moving;
                let (q, v) = (self.q.clone(), self.v.clone());
                self.worst = Certificate { margin, dof: i, needed, effort, q, v, ..self.worst };
            }
        }
        self.worst.samples += 1;
    }

    /// A state of the viable set.
    fn sample(&mut self) {
        for k in 0..self.controllable.len() {
            let i = self.controllable[k];
            let joint = self.model.joint_of_dof(i);
            let v_max = self.limits.velocity[i];
            let mut reach = v_max;
            if joint.nq == 1 && joint.nv == 1 {
                let or = |x: f64, otherwise: f64| if x.is_finite() { x } else { otherwise };
                let low = or(self.limits.q_lower[i], -std::f64::consts::PI);
                let high = or(self.limits.q_upper[i], std::f64::consts::PI);
                let share = (1.1 * self.random.next() - 0.05).clamp(0.0, 1.0);
                let q = low + share * (high - low);
                self.q[joint.idx_q] = q;
                let dof = Dof::of(self.limits, i);
                let a = dof.braking(self.period);
                let room = if self.random.next() < 0.5 { dof.upper - q } else { q - dof.lower };
                reach = v_max.min((2.0 * a * room.max(0.0)).sqrt() + 0.5 * a * self.period.tau);
            }
            let share = self.random.between(-2.0, 2.0).clamp(-1.0, 1.0);
            self.v[i] = share * reach;
        }
    }
}
