//! How much kinetic energy the robot may carry.

use super::frame::check;
use super::margin::{is_zero, less};
use super::{About, Argument, Form, Limit, Takes};
use crate::row::{Cone, Motion, Needs, TickStart};
use crate::{Dynamics, Kind, Kinematics, LimitError, Model, Soft};
use serde::{Deserialize, Serialize};

/// What it says of itself.
pub(super) const ABOUT: About = About {
    class: "EnergyLimit",
    promise: "The kinetic energy of the whole robot stays below `limit` [J]: a second-order cone.",
    example: "energy = { limit = 2.0 }",
    form: Form::Either,
    margin: "[J]",
    stricter: Some(["energy = { limit = 2.0, margin = 1.5 }", "energy = { limit = 0.5 }"]),
    arguments: &[Argument::needed("limit", Takes::Number), Argument::MARGIN, Argument::SOFT],
};

/// `energy = { limit = 2.0 }`, also with `margin` and `soft`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnergySettings {
    /// Largest kinetic energy of the whole robot, rotors included \[J\].
    pub limit: f64,
    /// Energy kept below the limit \[J\].
    #[serde(default, skip_serializing_if = "is_zero")]
    pub margin: f64,
    /// How much it resists; hard when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub soft: Option<Soft>,
}

/// `1/2 (v + y)' M (v + y) <= limit`, as `|L' (v + y)| <= sqrt(2 limit)` with `M = L L'` at `q (+) T v`, where the robot will be but for what the
/// velocity change does to its way.
///
/// At the next configuration the energy differs by O(T |y| |v|²). As with [`FrameSpeedLimit`](super::FrameSpeedLimit), only a stored
/// brake is verified for it.
#[derive(Debug, Clone)]
pub struct EnergyLimit {
    settings: EnergySettings,
}

impl EnergyLimit {
    /// From the task file's settings.
    pub fn new(settings: EnergySettings) -> EnergyLimit {
        EnergyLimit { settings }
    }

    /// At most `limit` \[J\].
    pub fn of(limit: f64) -> EnergyLimit {
        EnergyLimit { settings: EnergySettings { limit, margin: 0.0, soft: None } }
    }
}

impl Limit for EnergyLimit {
    fn name(&self) -> &'static str {
        "energy"
    }

    fn cone(&self, model: &Model, _controllable: &[usize]) -> Result<Option<Box<dyn Cone>>, LimitError> {
        check("energy limit", self.settings.limit, self.settings.limit > 0.0, "above 0 J")?;
        let limit = less("energy margin", self.settings.limit, self.settings.margin)?;
        let (nv, dynamics, checker) = (model.nv(), Dynamics::new(model), Kinematics::new(model));
        let (q, step, mass) = (model.neutral(), vec![0.0; nv], vec![0.0; nv * nv]);
        Ok(Some(Box::new(EnergyCone { nv, limit, dynamics, checker, q, step, mass })))
    }

    fn soft(&self) -> Option<Soft> {
        self.settings.soft
    }
}

struct EnergyCone {
    nv: usize,
    limit: f64,
    dynamics: Dynamics,
    checker: Kinematics,
    /// `q (+) T v` (nq), `T v` (nv), mass matrix (nv x nv).
    q: Vec<f64>,
    step: Vec<f64>,
    mass: Vec<f64>,
}

impl EnergyCone {
    /// Writes `q (+) T v`.
    fn look_ahead(&mut self, q: &[f64], v: &[f64], dt: f64) {
        self.step.iter_mut().zip(v).for_each(|(step, v)| *step = dt * v);
        self.dynamics.integrate(q, &self.step, &mut self.q);
    }
}

impl Cone for EnergyCone {
    fn kind(&self) -> Kind {
        Kind::Energy
    }

    fn name(&self) -> String {
        "robot".to_string()
    }

    fn dimension(&self) -> usize {
        self.nv
    }

    fn size(&self) -> f64 {
        (2.0 * self.limit).sqrt()
    }

    fn needs(&self) -> Needs {
        Needs::default()
    }

    fn fill(&mut self, tick: &mut TickStart<'_>, g: &mut [f64], c: &mut [f64]) -> f64 {
        self.look_ahead(tick.q, tick.v, tick.period.dt);
        self.dynamics.mass(&self.q, &mut self.mass);
        factor(self.nv, &self.mass, g);
        for (c, row) in c.iter_mut().zip(g.chunks_exact(self.nv)) {
            *c = row.iter().zip(tick.v).map(|(g, v)| g * v).sum();
        }
        self.size()
    }

    fn excess(&mut self, motion: &mut Motion<'_>) -> f64 {
        self.look_ahead(motion.q, motion.v, motion.period.dt);
        let energy = self.checker.kinetic_energy(&self.q, motion.v_next);
        (energy / self.limit).sqrt() - 1.0
    }

    fn breach(&mut self, motion: &mut Motion<'_>) -> f64 {
        let energy = self.checker.kinetic_energy(motion.q_next, motion.v_next);
        (energy / self.limit).sqrt() - 1.0
    }
}

/// Writes `U = L'` (n x n, row-major, zero before) with `M = U' U`, row by row (Cholesky). A direction without inertia (a pivot that
/// is zero to rounding) gets a row of zeros: `|U x|² = x' M x` holds for it too.
fn factor(n: usize, mass: &[f64], u: &mut [f64]) {
    for i in 0..n {
        for j in i..n {
            let done: f64 = (0..i).map(|k| u[k * n + i] * u[k * n + j]).sum();
            u[i * n + j] = mass[i * n + j] - done;
        }
        let pivot = u[i * n + i];
        let scale = if pivot > 1e-14 * mass[i * n + i] { 1.0 / pivot.sqrt() } else { 0.0 };
        u[i * n + i..(i + 1) * n].iter_mut().for_each(|x| *x *= scale);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_factor_gives_the_quadratic_form_back() {
        // The third dof moves nothing of its own: M = B' B with a 2 x 3 B.
        let b = [[2.0, 1.0, -1.0], [0.0, 3.0, 2.0]];
        let mass: Vec<f64> = (0..9).map(|k| (0..2).map(|r| b[r][k / 3] * b[r][k % 3]).sum()).collect();
        let mut u = vec![0.0; 9];
        factor(3, &mass, &mut u);
        for i in 0..3 {
            for j in 0..3 {
                let product: f64 = (0..3).map(|k| u[k * 3 + i] * u[k * 3 + j]).sum();
                assert!((product - mass[i * 3 + j]).abs() < 1e-12, "{i} {j} {product}");
            }
        }
        assert_eq!(u[8], 0.0);
    }
}
