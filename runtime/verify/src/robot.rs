//! The robot of a snapshot, read from the numbers in its manifest.

use serde::Deserialize;

use crate::space::{Place, Vec3};

/// A robot as a snapshot describes it.
#[derive(Debug, Deserialize)]
pub(crate) struct Robot {
    /// Free fall [m/s²].
    pub(crate) gravity: Vec3,
    pub(crate) bodies: Vec<Body>,
    pub(crate) frames: Vec<Frame>,
    pub(crate) solids: Vec<Solid>,
    pub(crate) motors: Vec<Motor>,
}

/// A rigid body and the joints that let it move against its parent.
#[derive(Debug, Deserialize)]
pub(crate) struct Body {
    pub(crate) name: String,
    pub(crate) parent: Option<usize>,
    pub(crate) placement: Place,
    pub(crate) mass: f64,
    pub(crate) com: Vec3,
    /// About the centre of mass: `xx, xy, xz, yy, yz, zz` [kg·m²].
    pub(crate) inertia: [f64; 6],
    pub(crate) joints: Vec<Joint>,
}

/// A joint with one degree of freedom.
#[derive(Debug, Deserialize)]
pub(crate) struct Joint {
    pub(crate) name: String,
    pub(crate) kind: JointKind,
    pub(crate) axis: Vec3,
    pub(crate) anchor: Vec3,
    pub(crate) reference: f64,
    pub(crate) range: Range,
    pub(crate) velocity: Option<f64>,
    pub(crate) effort: Option<f64>,
    pub(crate) damping: f64,
    pub(crate) stiffness: f64,
    pub(crate) spring_reference: f64,
    pub(crate) armature: f64,
    /// Dry friction [N·m or N].
    #[serde(default)]
    pub(crate) friction: f64,
}

/// What a joint lets move.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum JointKind {
    Free,
    Ball,
    Hinge,
    Continuous,
    Slide,
    Planar,
}

/// Position limits of a joint.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Range {
    Limited(f64, f64),
    Unlimited,
    NotStated,
}

/// A named place.
#[derive(Debug, Deserialize)]
pub(crate) struct Frame {
    pub(crate) name: String,
    pub(crate) body: Option<usize>,
    pub(crate) placement: Place,
}

/// A solid that collides.
#[derive(Debug, Deserialize)]
pub(crate) struct Solid {
    pub(crate) body: Option<usize>,
    pub(crate) shape: Option<Shape>,
    pub(crate) placement: Place,
}

/// A primitive, centred at its origin.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum Shape {
    Sphere { radius: f64 },
    Capsule { radius: f64, length: f64 },
    Cylinder { radius: f64, length: f64 },
    Box { size: Vec3 },
    HalfSpace,
}

/// `torque = gear (gain u + bias_0 + bias_1 gear q + bias_2 gear v)`.
#[derive(Debug, Deserialize)]
pub(crate) struct Motor {
    pub(crate) joint: String,
    pub(crate) order: usize,
    pub(crate) gear: f64,
    pub(crate) gain: f64,
    pub(crate) bias: Vec3,
    pub(crate) control_range: Option<[f64; 2]>,
    pub(crate) force_range: Option<[f64; 2]>,
    pub(crate) not_modelled: Option<String>,
}

impl Motor {
    /// The largest torque that it gives both ways whatever the state [N·m or N].
    pub(crate) fn strength(&self) -> f64 {
        let both = |low: f64, high: f64| (-low).min(high).max(0.0);
        let is_plain = self.not_modelled.is_none() && self.bias[1] == 0.0 && self.bias[2] == 0.0;
        let by_control = self.control_range.filter(|_| is_plain).map(|[low, high]| {
            let (a, b) = (self.gain * low + self.bias[0], self.gain * high + self.bias[0]);
            both(a.min(b), a.max(b))
        });
        let by_force = self.force_range.map(|[low, high]| both(low, high));
        self.gear.abs() * by_control.unwrap_or(f64::INFINITY).min(by_force.unwrap_or(f64::INFINITY))
    }
}

impl Robot {
    /// All joints in the order of the velocities.
    pub(crate) fn joints(&self) -> impl Iterator<Item = &Joint> {
        self.bodies.iter().flat_map(|body| &body.joints)
    }

    /// The largest force of a joint, by its own limit and its motors' [N·m or N].
    pub(crate) fn effort(&self, joint: &Joint) -> f64 {
        let motors = self.motors.iter().filter(|motor| motor.joint == joint.name).map(Motor::strength);
        let all = motors.reduce(|sum, each| sum + each).unwrap_or(f64::INFINITY);
        joint.effort.unwrap_or(f64::INFINITY).min(all)
    }
}
