//! Where the frames of a [`Model`] are and how they move: placements, Jacobians, velocities, accelerations.

use crate::pinocchio::{self, RawData};
use crate::{FrameId, Model};
use std::ffi::c_int;

/// Scratch of one thread. Nothing below allocates; a slice of the wrong length panics, and where Pinocchio throws the
/// numbers are NaN.
///
/// Everything is in world axes. An acceleration is the *classical* one, the second derivative of a position; gravity is
/// not part of it. Units: m, rad, s, N.
pub struct Kinematics {
    model: Model,
    scratch: RawData,
    jacobian: Vec<f64>,
}

/// A frame at the state last given to [`Kinematics::update`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameMotion {
    /// Origin [m].
    pub position: [f64; 3],
    /// Rotation matrix by rows: `x_world = position + rotation x_frame`.
    pub rotation: [[f64; 3]; 3],
    /// Velocity of the origin [m/s].
    pub velocity: [f64; 3],
    /// Angular velocity [rad/s].
    pub angular_velocity: [f64; 3],
    /// Acceleration of the origin [m/s²].
    pub acceleration: [f64; 3],
    /// Angular acceleration [rad/s²].
    pub angular_acceleration: [f64; 3],
}

/// A point fixed to a frame, at the state last given to [`Kinematics::update`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointMotion {
    /// Position [m].
    pub position: [f64; 3],
    /// Velocity [m/s].
    pub velocity: [f64; 3],
    /// Acceleration [m/s²].
    pub acceleration: [f64; 3],
}

impl Kinematics {
    /// Scratch for `model`.
    pub fn new(model: &Model) -> Kinematics {
        let jacobian = vec![0.0; 6 * model.nv()];
        Kinematics { scratch: RawData::new(model.raw()), model: model.clone(), jacobian }
    }

    /// Moves all frames and Jacobians to configuration `q` (nq), velocity `v` (nv) and acceleration `a` (nv).
    pub fn update(&mut self, q: &[f64], v: &[f64], a: &[f64]) {
        self.move_to(q, v, a, 1);
    }

    /// The same without Jacobians, which stay where the last [`update`](Kinematics::update) left them.
    pub fn update_frames(&mut self, q: &[f64], v: &[f64], a: &[f64]) {
        self.move_to(q, v, a, 0);
    }

    fn move_to(&mut self, q: &[f64], v: &[f64], a: &[f64], jacobians: c_int) {
        self.check(q, &[v, a]);
        let (m, d) = self.pointers();
        // SAFETY: lengths checked. Forward kinematics has no failure for arguments of the right length.
        let code = unsafe { pinocchio::nc_kinematics(m, d, q.as_ptr(), v.as_ptr(), a.as_ptr(), jacobians) };
        assert_eq!(code, 0, "forward kinematics: {}", pinocchio::last_error());
    }

    /// Placement, velocity and acceleration of `frame`.
    pub fn frame(&mut self, frame: FrameId) -> FrameMotion {
        let mut x = [f64::NAN; 24];
        let (m, d) = self.pointers();
        // SAFETY: room for 24 numbers; the shim checks the frame's number.
        let code = unsafe { pinocchio::nc_frame(m, d, frame.0 as c_int, x.as_mut_ptr()) };
        if code != 0 {
            x.fill(f64::NAN);
        }
        let three = |at: usize| [x[at], x[at + 1], x[at + 2]];
        FrameMotion {
            position: three(0),
            rotation: [three(3), three(6), three(9)],
            velocity: three(12),
            angular_velocity: three(15),
            acceleration: three(18),
            angular_acceleration: three(21),
        }
    }

    /// Position, velocity and acceleration of the point that has coordinates `local` [m] in `frame`.
    pub fn point(&mut self, frame: FrameId, local: [f64; 3]) -> PointMotion {
        let at = self.frame(frame);
        let position = at.place(local);
        at.carry(position)
    }

    /// Jacobian of `frame` (6 x nv, row-major): `J v` is the velocity of its origin, then its angular velocity.
    pub fn jacobian(&mut self, frame: FrameId, jacobian: &mut [f64]) {
        assert_eq!(jacobian.len(), 6 * self.model.nv(), "frame Jacobian: 6 * nv numbers");
        let (m, d) = self.pointers();
        // SAFETY: length checked; the shim checks the frame's number.
        let code = unsafe { pinocchio::nc_frame_jacobian(m, d, frame.0 as c_int, jacobian.as_mut_ptr()) };
        if code != 0 {
            jacobian.fill(f64::NAN);
        }
    }

    /// Jacobian (3 x nv, row-major) of the point that has coordinates `local` [m] in `frame`: `J_p = J_v - [r]x J_w`.
    pub fn point_jacobian(&mut self, frame: FrameId, local: [f64; 3], jacobian: &mut [f64]) {
        let nv = self.model.nv();
        assert_eq!(jacobian.len(), 3 * nv, "point Jacobian: 3 * nv numbers");
        let at = self.frame(frame);
        let [x, y, z] = minus(at.place(local), at.position);
        let mut j = std::mem::take(&mut self.jacobian);
        self.jacobian(frame, &mut j);
        for i in 0..nv {
            let of = |k: usize| j[k * nv + i];
            jacobian[i] = of(0) + of(4) * z - of(5) * y;
            jacobian[nv + i] = of(1) + of(5) * x - of(3) * z;
            jacobian[2 * nv + i] = of(2) + of(3) * y - of(4) * x;
        }
        self.jacobian = j;
    }

    /// Adds `scale n' J_p` to `row` (nv), with `J_p` the Jacobian of the point of `frame` that is at `point` [m] in the
    /// world: `n' J_p = n' J_v + (r x n)' J_w`, `r` from the frame's origin to the point.
    pub fn add_row(&mut self, frame: FrameId, point: [f64; 3], n: [f64; 3], scale: f64, row: &mut [f64]) {
        let nv = self.model.nv();
        assert_eq!(row.len(), nv, "row: nv numbers");
        let origin = self.frame(frame).position;
        let mut j = std::mem::take(&mut self.jacobian);
        self.jacobian(frame, &mut j);
        let turn = cross(minus(point, origin), n);
        for (i, x) in row.iter_mut().enumerate() {
            let of = |k: usize| j[k * nv + i];
            *x += scale * (dot(n, [of(0), of(1), of(2)]) + dot(turn, [of(3), of(4), of(5)]));
        }
        self.jacobian = j;
    }

    /// Adds to `tau` (nv) [N·m or N] what a wrench on `frame` does to the joints: `tau += J' f`.
    ///
    /// `wrench`: force [N], then moment about the frame's origin [N·m], both in world axes, from the environment on the
    /// robot. With it the equations of motion are `M a + nle = tau_motor + passive + J' f`.
    pub fn add_wrench(&mut self, frame: FrameId, wrench: [f64; 6], tau: &mut [f64]) {
        let nv = self.model.nv();
        assert_eq!(tau.len(), nv, "generalised force: nv numbers");
        let mut j = std::mem::take(&mut self.jacobian);
        self.jacobian(frame, &mut j);
        for (i, x) in tau.iter_mut().enumerate() {
            *x += (0..6).map(|k| j[k * nv + i] * wrench[k]).sum::<f64>();
        }
        self.jacobian = j;
    }

    /// Kinetic energy [J] at (`q`, `v`), rotor inertias included. Leaves all frames at `q`, `v`; update before asking
    /// for accelerations.
    pub fn kinetic_energy(&mut self, q: &[f64], v: &[f64]) -> f64 {
        self.check(q, &[v]);
        let (mut energy, (m, d)) = (f64::NAN, self.pointers());
        // SAFETY: lengths checked.
        let code = unsafe { pinocchio::nc_kinetic_energy(m, d, q.as_ptr(), v.as_ptr(), &raw mut energy) };
        if code == 0 { energy } else { f64::NAN }
    }

    /// The model these frames belong to.
    pub fn model(&self) -> &Model {
        &self.model
    }

    fn pointers(&mut self) -> (*const pinocchio::NcModel, *mut pinocchio::NcData) {
        (self.model.raw().as_ptr(), self.scratch.as_ptr())
    }

    fn check(&self, q: &[f64], tangents: &[&[f64]]) {
        assert_eq!(q.len(), self.model.nq(), "configuration: nq numbers");
        for t in tangents {
            assert_eq!(t.len(), self.model.nv(), "velocity, acceleration: nv numbers");
        }
    }
}

impl FrameMotion {
    /// Where in the world [m] the point with coordinates `local` [m] is.
    pub fn place(&self, local: [f64; 3]) -> [f64; 3] {
        plus(self.position, self.rotation.map(|row| dot(row, local)))
    }

    /// Motion of the point fixed to this frame that is at `point` [m] in the world:
    /// `v + w x r` and `a + dw x r + w x (w x r)`.
    pub fn carry(&self, point: [f64; 3]) -> PointMotion {
        let (r, w) = (minus(point, self.position), self.angular_velocity);
        let turning = cross(w, r);
        let acceleration = plus(cross(self.angular_acceleration, r), cross(w, turning));
        PointMotion {
            position: point,
            velocity: plus(self.velocity, turning),
            acceleration: plus(self.acceleration, acceleration),
        }
    }
}

pub(crate) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(crate) fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub(crate) fn plus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

pub(crate) fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

pub(crate) fn norm(a: [f64; 3]) -> f64 {
    dot(a, a).sqrt()
}
