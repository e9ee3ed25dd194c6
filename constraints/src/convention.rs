//! MuJoCo's and Pinocchio's coordinates of a floating base.
//!
//! A free joint has 7 configuration entries and 6 velocity entries in both, but not the same ones:
//!
//! | | MuJoCo | Pinocchio, and every `q`, `v`, `a` of this crate |
//! |---|---|---|
//! | quaternion | w x y z | x y z w |
//! | linear velocity | in the world frame | in the body frame: `v_body = R' v_world` |
//! | angular velocity | in the body frame | in the body frame |
//! | linear acceleration | `d/dt v_world` | `R' dv_world - omega x v_body` |
//!
//! Ball joints differ in the quaternion only; joints with one dof are the same. Lengths are nq for configurations,
//! nv for the others, input and output alike.

use crate::{Joint, Model};

/// Pinocchio configuration from MuJoCo's.
pub fn q_from_mujoco(model: &Model, mujoco: &[f64], q: &mut [f64]) {
    q.copy_from_slice(mujoco);
    for_each_quaternion(model, |at| q[at..at + 4].rotate_left(1));
}

/// MuJoCo configuration from Pinocchio's.
pub fn q_to_mujoco(model: &Model, q: &[f64], mujoco: &mut [f64]) {
    mujoco.copy_from_slice(q);
    for_each_quaternion(model, |at| mujoco[at..at + 4].rotate_right(1));
}

/// Pinocchio velocity from MuJoCo's, at the Pinocchio configuration `q`.
pub fn v_from_mujoco(model: &Model, q: &[f64], mujoco: &[f64], v: &mut [f64]) {
    v.copy_from_slice(mujoco);
    for_each_free(model, |joint| {
        let r = rotation(q, joint);
        write3(v, joint.idx_v, transposed_times(&r, read3(mujoco, joint.idx_v)));
    });
}

/// Position and velocity of one joint of `q`, `v`, written there in MuJoCo's convention, in Pinocchio's; its quaternion becomes one of length 1.
pub(crate) fn joint_from_mujoco(joint: &Joint, q: &mut [f64], v: &mut [f64]) {
    if let Some(at) = quaternion(joint) {
        q[at..at + 4].rotate_left(1);
        let length = q[at..at + 4].iter().map(|x| x * x).sum::<f64>().sqrt();
        q[at..at + 4].iter_mut().for_each(|x| *x /= length);
    }
    if joint.nq == 7 {
        let turned = transposed_times(&rotation(q, joint), read3(v, joint.idx_v));
        write3(v, joint.idx_v, turned);
    }
}

/// MuJoCo velocity from Pinocchio's, at the Pinocchio configuration `q`.
pub fn v_to_mujoco(model: &Model, q: &[f64], v: &[f64], mujoco: &mut [f64]) {
    mujoco.copy_from_slice(v);
    for_each_free(model, |joint| {
        let r = rotation(q, joint);
        write3(mujoco, joint.idx_v, times(&r, read3(v, joint.idx_v)));
    });
}

/// Pinocchio acceleration from MuJoCo's, at the Pinocchio state (`q`, `v`):
/// `a_body = R' a_world - omega x v_body`.
pub fn a_from_mujoco(model: &Model, q: &[f64], v: &[f64], mujoco: &[f64], a: &mut [f64]) {
    a.copy_from_slice(mujoco);
    for_each_free(model, |joint| {
        let r = rotation(q, joint);
        let turned = transposed_times(&r, read3(mujoco, joint.idx_v));
        let w = cross(read3(v, joint.idx_v + 3), read3(v, joint.idx_v));
        write3(a, joint.idx_v, [0, 1, 2].map(|i| turned[i] - w[i]));
    });
}

/// MuJoCo acceleration from Pinocchio's, at the Pinocchio state (`q`, `v`).
pub fn a_to_mujoco(model: &Model, q: &[f64], v: &[f64], a: &[f64], mujoco: &mut [f64]) {
    mujoco.copy_from_slice(a);
    for_each_free(model, |joint| {
        let r = rotation(q, joint);
        let (lin, w) = (read3(a, joint.idx_v), cross(read3(v, joint.idx_v + 3), read3(v, joint.idx_v)));
        write3(mujoco, joint.idx_v, times(&r, [0, 1, 2].map(|i| lin[i] + w[i])));
    });
}

/// Generalised force in MuJoCo's coordinates from Pinocchio's; forces transform like velocities.
pub fn tau_to_mujoco(model: &Model, q: &[f64], tau: &[f64], mujoco: &mut [f64]) {
    v_to_mujoco(model, q, tau, mujoco);
}

fn for_each_free(model: &Model, mut f: impl FnMut(&Joint)) {
    model.joints().iter().filter(|j| j.nq == 7 && j.nv == 6).for_each(&mut f);
}

/// Index of the first quaternion entry of each free and ball joint.
fn for_each_quaternion(model: &Model, mut f: impl FnMut(usize)) {
    model.joints().iter().filter_map(quaternion).for_each(&mut f);
}

/// Index of the first quaternion entry of a free or ball joint.
fn quaternion(joint: &Joint) -> Option<usize> {
    match (joint.nq, joint.nv) {
        (7, 6) => Some(joint.idx_q + 3),
        (4, 3) => Some(joint.idx_q),
        _ => None,
    }
}

/// A vector of the world in the axes of a body whose unit quaternion is x y z w: `R' v`.
///
/// # Panics
/// When the quaternion has fewer than four entries.
pub fn to_body(quaternion: &[f64], v: [f64; 3]) -> [f64; 3] {
    transposed_times(&rotation_of(quaternion), v)
}

/// Rotation matrix (rows) of a free joint.
fn rotation(q: &[f64], joint: &Joint) -> [[f64; 3]; 3] {
    rotation_of(&q[joint.idx_q + 3..])
}

/// Rotation matrix (rows) of the unit quaternion x y z w.
fn rotation_of(quaternion: &[f64]) -> [[f64; 3]; 3] {
    let [x, y, z, w] = [quaternion[0], quaternion[1], quaternion[2], quaternion[3]];
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

fn read3(x: &[f64], at: usize) -> [f64; 3] {
    [x[at], x[at + 1], x[at + 2]]
}

fn write3(x: &mut [f64], at: usize, value: [f64; 3]) {
    x[at..at + 3].copy_from_slice(&value);
}

fn times(r: &[[f64; 3]; 3], x: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|i| r[i][0] * x[0] + r[i][1] * x[1] + r[i][2] * x[2])
}

fn transposed_times(r: &[[f64; 3]; 3], x: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|i| r[0][i] * x[0] + r[1][i] * x[1] + r[2][i] * x[2])
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}
