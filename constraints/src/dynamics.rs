//! Equations of motion of a [`Model`]: `M(q) a + nle(q, v) = tau + passive(q, v)`.

use crate::Model;
use crate::friction::MadeUpFor;
use crate::kinematics::cross;
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
    /// Some joint has a spring.
    sprung: bool,
    /// First dof of each free joint with a damper.
    floating: Vec<usize>,
    middle: Middle,
}

/// The state whose forces stand for those of a whole period, and scratch (nv, `q` nq).
#[derive(Default)]
struct Middle {
    q: Vec<f64>,
    v: Vec<f64>,
    step: Vec<f64>,
    force: Vec<f64>,
    behind: Vec<f64>,
    /// nv x nv.
    by_velocity: Vec<f64>,
}

impl Dynamics {
    /// Scratch for `model`.
    pub fn new(model: &Model) -> Dynamics {
        let lengths = (model.nq(), model.nv());
        let zero = || vec![0.0; lengths.1];
        let middle = Middle {
            q: model.neutral(),
            v: zero(),
            step: zero(),
            force: zero(),
            behind: zero(),
            by_velocity: vec![0.0; lengths.1 * lengths.1],
        };
        let sprung = model.stiffness().iter().any(|k| *k != 0.0);
        let is_damped = |i: usize| (i..i + 3).any(|i| model.damping()[i] != 0.0);
        let joints = model.joints().iter().filter(|joint| joint.nv == 6 && is_damped(joint.idx_v));
        let floating = joints.map(|joint| joint.idx_v).collect();
        Dynamics {
            scratch: RawData::new(model.raw()),
            model: model.clone(),
            lengths,
            sprung,
            floating,
            middle,
        }
    }

    /// By how much more than its entry of `a` each dof of a damped free joint accelerates in the world, at velocity `v`: `w x v`, as the axes turn with the
    /// base. A damper that a step takes implicitly acts on that.
    pub(crate) fn turning<'a>(&'a self, v: &'a [f64]) -> impl Iterator<Item = (usize, f64)> + 'a {
        self.floating.iter().flat_map(move |&i| {
            let turned = cross([v[i + 3], v[i + 4], v[i + 5]], [v[i], v[i + 1], v[i + 2]]);
            (0..3).map(move |k| (i + k, turned[k]))
        })
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
        self.passive_after(period.lag(), q, v, passive);
    }

    fn passive_after(&self, time: f64, q: &[f64], v: &[f64], passive: &mut [f64]) {
        self.check(q, &[v, passive]);
        let m = &self.model;
        if !self.sprung {
            // As below with `spring = 0`, without a walk over the joints.
            let of = |(damping, v): (&f64, &f64)| -0.0 - damping * v;
            passive.iter_mut().zip(m.damping().iter().zip(v).map(of)).for_each(|(p, x)| *p = x);
            return;
        }
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
    /// [`Dynamics::motors_without_friction`], and what makes up for the dry friction of the joints, at most [`Model::friction`], as
    /// [`FrictionLaw`](crate::description::FrictionLaw) says.
    pub fn motors(&mut self, period: &Period, q: &[f64], v: &[f64], a: &[f64], tau: &mut [f64]) {
        self.motors_without_friction(period, q, v, a, tau);
        if self.model.friction().iter().all(|f| *f == 0.0) {
            return;
        }
        let mut m = std::mem::take(&mut self.middle);
        self.before_dampers(period, q, v, a, &mut m);
        for (i, tau) in tau.iter_mut().enumerate() {
            *tau += MadeUpFor::of(&self.model, i, period, v[i], a[i], m.step[i]).force;
        }
        self.middle = m;
    }

    /// `step = M^-1 (M + tau_s D) a`: the acceleration that an Euler step implicit in the damping `D` of joints and drives begins with to end
    /// with `a`.
    fn before_dampers(&mut self, period: &Period, q: &[f64], v: &[f64], a: &[f64], m: &mut Middle) {
        m.step.copy_from_slice(a);
        if (0..a.len()).any(|i| period.implicit(&self.model, i) > 0.0) {
            self.rnea(q, v, a, &mut m.force);
            for (i, force) in m.force.iter_mut().enumerate() {
                *force += period.implicit(&self.model, i) * a[i];
            }
            for (i, more) in self.turning(v) {
                m.force[i] += period.implicit(&self.model, i) * more;
            }
            self.aba(q, v, &m.force, &mut m.step);
        }
    }

    /// What the motors would supply (nv) if no joint rubbed. With the
    /// configuration `q* = q (+) h v` and the velocity `v + h a` at which the plant evaluates its forces on average (`h` is
    /// [`Period::lag`], 0 with one physics step in the period):
    ///
    /// ```text
    ///     tau = M(q*) a + nle(q*, v) + h (d nle / d v) a - passive
    /// ```
    ///
    /// It is linear in `a`, as the rows of the projector are ([`Dynamics::motor_rows`]), and off by `O(T^2)`; springs and dampers are
    /// averaged exactly.
    pub fn motors_without_friction(
        &mut self,
        period: &Period,
        q: &[f64],
        v: &[f64],
        a: &[f64],
        tau: &mut [f64],
    ) {
        self.check(q, &[v, a, tau]);
        let mut m = std::mem::take(&mut self.middle);
        let lag = period.lag();
        if lag == 0.0 {
            self.rnea(q, v, a, tau);
        } else {
            self.go_on(lag, q, v, &mut m);
            self.rnea(&m.q, v, a, tau);
            m.step.iter_mut().zip(a).for_each(|(step, a)| *step = lag * a);
            self.nle_along(v, &mut m);
            tau.iter_mut().zip(&m.force).for_each(|(tau, nle)| *tau += nle);
        }
        self.passive_over(period, q, v, &mut m.force);
        for (i, tau) in tau.iter_mut().enumerate() {
            *tau += period.resistance(&self.model, i) * a[i] - m.force[i];
        }
        for (i, more) in self.turning(v) {
            tau[i] += period.resistance(&self.model, i) * more;
        }
        self.middle = m;
    }

    /// [`Dynamics::motors_without_friction`] for any acceleration: `tau = rows a + bias`, with `rows` (nv x nv, row-major) and `bias` (nv).
    pub fn motor_rows(&mut self, period: &Period, q: &[f64], v: &[f64], rows: &mut [f64], bias: &mut [f64]) {
        self.check(q, &[v, bias]);
        let mut m = std::mem::take(&mut self.middle);
        let (nv, lag) = (self.lengths.1, period.lag());
        if lag == 0.0 {
            self.mass(q, rows);
            self.nle(q, v, bias);
        } else {
            self.go_on(lag, q, v, &mut m);
            self.mass(&m.q, rows);
            self.nle(&m.q, v, bias);
            self.nle_by_velocity(v, &mut m);
            rows.iter_mut().zip(&m.by_velocity).for_each(|(row, slope)| *row += lag * slope);
        }
        self.passive_over(period, q, v, &mut m.force);
        for i in 0..nv {
            rows[i * nv + i] += period.resistance(&self.model, i);
            bias[i] -= m.force[i];
        }
        for (i, more) in self.turning(v) {
            bias[i] += period.resistance(&self.model, i) * more;
        }
        self.middle = m;
    }

    /// `by_velocity = d nle / d v` (nv x nv, row-major) at `v`.
    fn nle_by_velocity(&mut self, v: &[f64], m: &mut Middle) {
        // SAFETY: `m` has been made for this model, and the lengths of `v` were checked.
        let code = unsafe {
            let (model, data) = self.pointers();
            let by_velocity = m.by_velocity.as_mut_ptr();
            pinocchio::nc_nle_by_velocity(model, data, m.q.as_ptr(), v.as_ptr(), by_velocity)
        };
        spoil(code, &mut m.by_velocity);
    }

    /// `force = (d nle / d v) step` at `v`. The non-linear effects are quadratic in the velocity, so that the central difference is the
    /// derivative for a step of any size.
    fn nle_along(&mut self, v: &[f64], m: &mut Middle) {
        let shift = |m: &mut Middle, sign: f64| {
            m.v.iter_mut().zip(v.iter().zip(&m.step)).for_each(|(x, (v, step))| *x = v + sign * step);
        };
        shift(m, -1.0);
        self.nle(&m.q, &m.v, &mut m.behind);
        shift(m, 1.0);
        self.nle(&m.q, &m.v, &mut m.force);
        m.force.iter_mut().zip(&m.behind).for_each(|(ahead, behind)| *ahead = 0.5 * (*ahead - behind));
    }

    /// Writes the configuration reached from `q` at velocity `v` after `time`.
    fn go_on(&mut self, time: f64, q: &[f64], v: &[f64], m: &mut Middle) {
        m.step.iter_mut().zip(v).for_each(|(step, v)| *step = time * v);
        self.integrate(q, &m.step, &mut m.q);
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
