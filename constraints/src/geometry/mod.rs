//! Solid primitives and the distance between two of them.
//!
//! The distance comes from `parry3d-f64` (segments in closed form, the rest by GJK on support functions); half-spaces are done
//! here. Nothing in this module allocates.

mod distance;
mod solid;

pub use distance::{Separation, separation};

use crate::LimitError;
use crate::kinematics::{dot, plus};
use serde::{Deserialize, Serialize};

/// A solid in its own axes, centred at its origin. In a task file: `{ sphere = { radius = 0.1 } }` or `"half_space"`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Shape {
    /// A ball.
    Sphere {
        /// Radius \[m\].
        radius: f64,
    },
    /// All points within `radius` of a segment along z.
    Capsule {
        /// Radius \[m\].
        radius: f64,
        /// Length of the segment, between the centres of the two caps \[m\].
        length: f64,
    },
    /// A cylinder along z.
    Cylinder {
        /// Radius \[m\].
        radius: f64,
        /// Height \[m\].
        length: f64,
    },
    /// A cuboid.
    Box {
        /// Edge lengths along x, y and z \[m\].
        size: [f64; 3],
    },
    /// Everything with `z <= 0`: a floor, a wall.
    HalfSpace,
}

/// Position and rotation in a parent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Placement {
    /// Origin \[m\].
    pub position: [f64; 3],
    /// Rotation matrix by rows: `x_parent = position + rotation x`.
    pub rotation: [[f64; 3]; 3],
}

impl Placement {
    /// The parent's own origin and axes.
    pub const IDENTITY: Placement =
        Placement { position: [0.0; 3], rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]] };

    /// From a position \[m\] and URDF's roll, pitch, yaw \[rad\]: `R = Rz(yaw) Ry(pitch) Rx(roll)`.
    pub fn new(position: [f64; 3], rpy: [f64; 3]) -> Placement {
        let [(sr, cr), (sp, cp), (sy, cy)] = rpy.map(f64::sin_cos);
        let rotation = [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ];
        Placement { position, rotation }
    }

    /// `self` followed by `inner`, which is given in the axes of `self`.
    pub fn then(&self, inner: &Placement) -> Placement {
        let column = |k: usize| inner.rotation.map(|row| row[k]);
        let columns = [column(0), column(1), column(2)];
        Placement {
            position: self.place(inner.position),
            rotation: self.rotation.map(|row| columns.map(|c| dot(row, c))),
        }
    }

    /// Where in the parent \[m\] the point with coordinates `local` \[m\] is.
    pub fn place(&self, local: [f64; 3]) -> [f64; 3] {
        plus(self.position, self.rotation.map(|row| dot(row, local)))
    }

    /// A direction of the parent in own axes.
    fn turn_in(&self, x: [f64; 3]) -> [f64; 3] {
        [0, 1, 2].map(|k| (0..3).map(|i| self.rotation[i][k] * x[i]).sum())
    }

    /// Own z axis in the parent.
    fn z(&self) -> [f64; 3] {
        self.rotation.map(|row| row[2])
    }
}

impl Shape {
    /// Refuses sizes that are not above 0; `what` names the shape.
    pub(crate) fn check(&self, what: &str) -> Result<(), LimitError> {
        let sizes: &[(&str, f64)] = match *self {
            Shape::Sphere { radius } => &[("radius", radius)],
            Shape::Capsule { radius, length } | Shape::Cylinder { radius, length } => {
                &[("radius", radius), ("length", length)]
            }
            Shape::Box { size: [x, y, z] } => {
                &[("size along x", x), ("size along y", y), ("size along z", z)]
            }
            Shape::HalfSpace => &[],
        };
        match sizes.iter().find(|(_, x)| !(x.is_finite() && *x > 0.0)) {
            Some((size, value)) => {
                let what = format!("{size} of {what}");
                Err(LimitError::BadValue { what, value: *value, domain: "above 0 m" })
            }
            None => Ok(()),
        }
    }

    /// Radius of the ball around the origin that holds the solid \[m\]; infinite for a half-space.
    pub fn bounding_radius(&self) -> f64 {
        match *self {
            Shape::Sphere { radius } => radius,
            Shape::Capsule { radius, length } => radius + 0.5 * length,
            Shape::Cylinder { radius, length } => radius.hypot(0.5 * length),
            Shape::Box { size } => 0.5 * dot(size, size).sqrt(),
            Shape::HalfSpace => f64::INFINITY,
        }
    }
}
