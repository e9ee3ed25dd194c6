//! A shape as a core plus a radius around it, standing somewhere in the world, by its support function.

use super::{Placement, Shape};
use crate::kinematics::{cross, dot, norm};
use parry3d_f64::math::Vector;
use parry3d_f64::shape::SupportMap;

/// What is left of a shape when `radius` is taken off all around.
#[derive(Debug, Clone, Copy)]
pub(super) enum Core {
    /// A segment along z by its half length; of a sphere, 0.
    Segment(f64),
    /// Radius and half height.
    Cylinder(f64, f64),
    /// Half edges.
    Box([f64; 3]),
}

/// A core in the world.
#[derive(Debug, Clone, Copy)]
pub(super) struct Solid {
    pub(super) core: Core,
    pub(super) radius: f64,
    pub(super) at: Placement,
}

impl Solid {
    /// `None` for a half-space.
    pub(super) fn new(shape: &Shape, at: &Placement) -> Option<Solid> {
        let (core, radius) = match *shape {
            Shape::Sphere { radius } => (Core::Segment(0.0), radius),
            Shape::Capsule { radius, length } => (Core::Segment(0.5 * length), radius),
            Shape::Cylinder { radius, length } => (Core::Cylinder(radius, 0.5 * length), 0.0),
            Shape::Box { size } => (Core::Box(size.map(|x| 0.5 * x)), 0.0),
            Shape::HalfSpace => return None,
        };
        Some(Solid { core, radius, at: *at })
    }

    /// The point of the core that is farthest along `n` (world, world). Where a whole edge or face is, its middle, so that
    /// the answer does not jump between corners.
    pub(super) fn farthest(&self, n: [f64; 3]) -> [f64; 3] {
        /// Directions this close to parallel to a face see the whole face.
        const FLAT: f64 = 1e-9;
        let side = |x: f64| if x.abs() < FLAT { 0.0 } else { x.signum() };
        let [x, y, z] = self.at.turn_in(n);
        let local = match self.core {
            Core::Segment(half) => [0.0, 0.0, half * side(z)],
            Core::Cylinder(radius, half) => {
                let across = x.hypot(y);
                let share = if across < FLAT { 0.0 } else { radius / across };
                [share * x, share * y, half * side(z)]
            }
            Core::Box([a, b, c]) => [a * side(x), b * side(y), c * side(z)],
        };
        self.at.place(local)
    }

    /// Ends of a segment in the world.
    pub(super) fn segment(&self) -> Option<[[f64; 3]; 2]> {
        match self.core {
            Core::Segment(half) => Some([-half, half].map(|z| self.at.place([0.0, 0.0, z]))),
            _ => None,
        }
    }

    /// Axes [`overlap`] looks along.
    fn axes(&self) -> [[f64; 3]; 3] {
        [0, 1, 2].map(|k| self.at.rotation.map(|row| row[k]))
    }
}

/// Vertices, not face middles: GJK wants corners.
impl SupportMap for Solid {
    fn local_support_point(&self, dir: Vector) -> Vector {
        let [x, y, z] = self.at.turn_in([dir.x, dir.y, dir.z]);
        let local = match self.core {
            Core::Segment(half) => [0.0, 0.0, half.copysign(z)],
            Core::Cylinder(radius, half) => {
                let across = x.hypot(y);
                let share = if across > 0.0 { radius / across } else { 0.0 };
                [share * x, share * y, half.copysign(z)]
            }
            Core::Box([a, b, c]) => [a.copysign(x), b.copysign(y), c.copysign(z)],
        };
        let [x, y, z] = self.at.place(local);
        Vector::new(x, y, z)
    }
}

/// Direction along which two cores that touch or overlap are separated with the least motion: of the axes of both, their
/// cross products and the line between the centres. For two boxes that is the separating-axis theorem and exact; with
/// cylinders it overstates the depth.
pub(super) fn overlap(a: &Solid, b: &Solid) -> [f64; 3] {
    let between = [0, 1, 2].map(|k| b.at.position[k] - a.at.position[k]);
    let (mut best, mut separation) = ([0.0, 0.0, 1.0], f64::NEG_INFINITY);
    let mut see = |axis: [f64; 3]| {
        let length = norm(axis);
        if length < 1e-6 {
            return; // parallel edges, or the same centre: no direction
        }
        for n in [1.0 / length, -1.0 / length].map(|s| axis.map(|x| s * x)) {
            let gap = dot(n, b.farthest(n.map(|x| -x))) - dot(n, a.farthest(n));
            if gap > separation {
                (best, separation) = (n, gap);
            }
        }
    };
    see(between);
    for axis in a.axes().into_iter().chain(b.axes()) {
        see(axis);
    }
    for x in a.axes() {
        for y in b.axes() {
            see(cross(x, y));
        }
    }
    best
}
