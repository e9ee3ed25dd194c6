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
    /// Of a frame (6 x nv, row-major).
    jacobian: Vec<f64>,
    /// Column of each dof, for the point at the world's origin (nv x 6).
    columns: Vec<f64>,
}

/// A frame at the state last given to [`Kinematics::update`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameMotion {
    /// Origin \[m\].
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
    /// Position \[m\].
    pub position: [f64; 3],
    /// Velocity [m/s].
    pub velocity: [f64; 3],
    /// Acceleration [m/s²].
    pub acceleration: [f64; 3],
}

impl Kinematics {
    /// Scratch for `model`.
    pub fn new(model: &Model) -> Kinematics {
        let (jacobian, columns) = (vec![0.0; 6 * model.nv()], vec![0.0; 6 * model.nv()]);
        Kinematics { scratch: RawData::new(model.raw()), model: model.clone(), jacobian, columns }
    }

    /// Moves all frames and Jacobians to configuration `q` (nq), velocity `v` (nv) and acceleration `a` (nv).
    pub fn update(&mut self, q: &[f64], v: &[f64], a: &[f64]) {
        let columns = self.columns.as_mut_ptr();
        self.move_to(q, v, a, columns);
    }

    /// The same without Jacobians, which stay where the last [`update`](Kinematics::update) left them.
    pub fn update_frames(&mut self, q: &[f64], v: &[f64], a: &[f64]) {
        self.move_to(q, v, a, std::ptr::null_mut());
    }

    fn move_to(&mut self, q: &[f64], v: &[f64], a: &[f64], columns: *mut f64) {
        self.check(q, &[v, a]);
        let (m, d) = self.pointers();
        // SAFETY: lengths checked, `columns` is null or has room for 6 nv numbers. Forward kinematics has no failure for arguments of
        // the right length.
        let code = unsafe { pinocchio::nc_kinematics(m, d, q.as_ptr(), v.as_ptr(), a.as_ptr(), columns) };
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

    /// Position, velocity and acceleration of the point that has coordinates `local` \[m\] in `frame`.
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

    /// Jacobian (3 x nv, row-major) of the point that has coordinates `local` \[m\] in `frame`.
    pub fn point_jacobian(&mut self, frame: FrameId, local: [f64; 3], jacobian: &mut [f64]) {
        let nv = self.model.nv();
        assert_eq!(jacobian.len(), 3 * nv, "point Jacobian: 3 * nv numbers");
        jacobian.fill(0.0);
        let point = self.frame(frame).place(local);
        let (x, rest) = jacobian.split_at_mut(nv);
        let (y, z) = rest.split_at_mut(nv);
        self.add_row(frame, point, [1.0, 0.0, 0.0], 1.0, x);
        self.add_row(frame, point, [0.0, 1.0, 0.0], 1.0, y);
        self.add_row(frame, point, [0.0, 0.0, 1.0], 1.0, z);
    }

    /// Adds `scale n' J_p` to `row` (nv), with `J_p` the Jacobian of the point of `frame` that is at `point` \[m\] in the
    /// world. A column with linear part `s_v` at the world's origin and angular part `s_w` moves the point by
    /// `s_v + s_w x p`, so the entry is `n . s_v + (p x n) . s_w`.
    pub fn add_row(&self, frame: FrameId, point: [f64; 3], n: [f64; 3], scale: f64, row: &mut [f64]) {
        assert_eq!(row.len(), self.model.nv(), "row: nv numbers");
        let turn = cross(point, n);
        self.model.for_each_dof(frame, |i| {
            let [a, b, c, d, e, f] = self.columns[6 * i..6 * i + 6] else { return };
            row[i] += scale * (dot(n, [a, b, c]) + dot(turn, [d, e, f]));
        });
    }

    /// Adds to `tau` (nv) [N·m or N] what a wrench on `frame` does to the joints: `tau += J' f`.
    ///
    /// `wrench`: force \[N\], then moment about the frame's origin [N·m], both in world axes, from the environment on the
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

    /// Kinetic energy \[J\] at (`q`, `v`), rotor inertias included. Leaves all frames at `q`, `v`; update before asking
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
    /// Where in the world \[m\] the point with coordinates `local` \[m\] is.
    pub fn place(&self, local: [f64; 3]) -> [f64; 3] {
        plus(self.position, self.rotation.map(|row| dot(row, local)))
    }

    /// Motion of the point fixed to this frame that is at `point` \[m\] in the world:
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
