//! Equations of motion of a [`Model`]: `M(q) a + nle(q, v) = tau + passive(q, v)`.

use crate::Model;
use crate::pinocchio::{self, RawData};
use crate::viability::Period;
use std::ffi::c_int;

/// Scratch of one thread. Nothing below allocates; a slice of the wrong length panics, and where Pinocchio throws
/// the output is NaN.
///
/// Units: configuration in rad or m, velocity per s, generalised force in N·m or N.
pub struct Dynamics {
    model: Model,
    scratch: RawData,
    lengths: (usize, usize),
    passive: Vec<f64>,
}

impl Dynamics {
    /// Scratch for `model`.
    pub fn new(model: &Model) -> Dynamics {
        let lengths = (model.nq(), model.nv());
        let passive = vec![0.0; lengths.1];
        Dynamics { scratch: RawData::new(model.raw()), model: model.clone(), lengths, passive }
    }

    /// Inverse dynamics `tau = M a + nle`, without the passive forces: a motor supplies `tau - passive`.
    ///
    /// `q` (nq), `v`, `a`, `tau` (nv).
    pub fn rnea(&mut self, q: &[f64], v: &[f64], a: &[f64], tau: &mut [f64]) {
        self.check(q, &[v, a, tau]);
        // SAFETY: lengths checked.
        let code = unsafe {
            let (m, d) = self.pointers();
            pinocchio::nc_rnea(m, d, q.as_ptr(), v.as_ptr(), a.as_ptr(), tau.as_mut_ptr())
        };
        spoil(code, tau);
    }

    /// Mass matrix (nv x nv, column-major, symmetric, armature included).
    pub fn mass(&mut self, q: &[f64], mass: &mut [f64]) {
        self.check(q, &[]);
        assert_eq!(mass.len(), self.lengths.1 * self.lengths.1, "mass matrix: nv * nv numbers");
        // SAFETY: lengths checked.
        let code = unsafe {
            let (m, d) = self.pointers();
            pinocchio::nc_mass(m, d, q.as_ptr(), mass.as_mut_ptr())
        };
        spoil(code, mass);
    }

    /// Non-linear effects: Coriolis, centrifugal and gravity, `nle = rnea(q, v, 0)`.
    pub fn nle(&mut self, q: &[f64], v: &[f64], nle: &mut [f64]) {
        self.check(q, &[v, nle]);
        // SAFETY: lengths checked.
        let code = unsafe {
            let (m, d) = self.pointers();
            pinocchio::nc_nle(m, d, q.as_ptr(), v.as_ptr(), nle.as_mut_ptr())
        };
        spoil(code, nle);
    }

    /// Forward dynamics `a = M^-1 (tau - nle)`; pass `tau + passive` for the acceleration the robot makes.
    pub fn aba(&mut self, q: &[f64], v: &[f64], tau: &[f64], a: &mut [f64]) {
        self.check(q, &[v, tau, a]);
        // SAFETY: lengths checked.
        let code = unsafe {
            let (m, d) = self.pointers();
            pinocchio::nc_aba(m, d, q.as_ptr(), v.as_ptr(), tau.as_ptr(), a.as_mut_ptr())
        };
        spoil(code, a);
    }

    /// Springs and dampers of the joints: `passive = -stiffness (q - spring_reference) - damping v`.
    ///
    /// Springs act on joints with one dof; a free or ball joint has dampers only.
    pub fn passive(&self, q: &[f64], v: &[f64], passive: &mut [f64]) {
        self.passive_after(0.0, q, v, passive);
    }

    /// [`Dynamics::passive`] on average over a period without acceleration: springs meet the configuration half a period less half a
    /// sub-step later. Constant acceleration adds [`Period::resistance`].
    pub fn passive_over(&self, period: &Period, q: &[f64], v: &[f64], passive: &mut [f64]) {
        self.passive_after(0.5 * (period.dt - period.tau), q, v, passive);
    }

    fn passive_after(&self, time: f64, q: &[f64], v: &[f64], passive: &mut [f64]) {
        self.check(q, &[v, passive]);
        let m = &self.model;
        for joint in m.joints() {
            for i in joint.idx_v..joint.idx_v + joint.nv {
                let k = m.stiffness()[i];
                let at = q[joint.idx_q] + time * v[i];
                let spring = if k == 0.0 { 0.0 } else { k * (at - m.spring_reference()[i]) };
                passive[i] = -spring - m.damping()[i] * v[i];
            }
        }
    }

    /// What the motors supply (nv) to keep acceleration `a` over a period that begins at `q`, `v`, without external forces:
    /// `tau = rnea(q, v, a) - passive`, springs and dampers as they are on average over the period.
    pub fn motors(&mut self, period: &Period, q: &[f64], v: &[f64], a: &[f64], tau: &mut [f64]) {
        self.rnea(q, v, a, tau);
        let mut passive = std::mem::take(&mut self.passive);
        self.passive_over(period, q, v, &mut passive);
        for (i, tau) in tau.iter_mut().enumerate() {
            *tau += period.resistance(&self.model, i) * a[i] - passive[i];
        }
        self.passive = passive;
    }

    /// `out = q (+) dq`: the configuration reached from `q` (nq) along the tangent displacement `dq` (nv).
    pub fn integrate(&mut self, q: &[f64], dq: &[f64], out: &mut [f64]) {
        self.check(q, &[dq]);
        assert_eq!(out.len(), self.lengths.0, "configuration: nq numbers");
        // SAFETY: lengths checked.
        let code = unsafe {
            let (m, d) = self.pointers();
            pinocchio::nc_integrate(m, d, q.as_ptr(), dq.as_ptr(), out.as_mut_ptr())
        };
        spoil(code, out);
    }

    /// `dq = q1 (-) q0`: the tangent displacement (nv) that leads from `q0` to `q1` (nq).
    pub fn difference(&mut self, q0: &[f64], q1: &[f64], dq: &mut [f64]) {
        self.check(q0, &[dq]);
        assert_eq!(q1.len(), self.lengths.0, "configuration: nq numbers");
        // SAFETY: lengths checked.
        let code = unsafe {
            let (m, d) = self.pointers();
            pinocchio::nc_difference(m, d, q0.as_ptr(), q1.as_ptr(), dq.as_mut_ptr())
        };
        spoil(code, dq);
    }

    /// The model these equations belong to.
    pub fn model(&self) -> &Model {
        &self.model
    }

    fn pointers(&mut self) -> (*const pinocchio::NcModel, *mut pinocchio::NcData) {
        (self.model.raw().as_ptr(), self.scratch.as_ptr())
    }

    fn check(&self, q: &[f64], tangents: &[&[f64]]) {
        assert_eq!(q.len(), self.lengths.0, "configuration: nq numbers");
        for t in tangents {
            assert_eq!(t.len(), self.lengths.1, "velocity, acceleration, force: nv numbers");
        }
    }
}

/// A C++ exception must not look like a result.
fn spoil(code: c_int, out: &mut [f64]) {
    if code != 0 {
        out.fill(f64::NAN);
    }
}
