//! The robot of a snapshot, read from the numbers in its manifest.

use serde::Deserialize;

use crate::space::{Mat3, Place, Vec3, dot, minus, plus, product, times};

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

/// A body held fast in a frame.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Payload {
    frame: String,
    mass: f64,
    #[serde(default)]
    com: Vec3,
    /// About its centre of mass, in the frame's axes: `xx, xy, xz, yy, yz, zz` [kg·m²].
    #[serde(default)]
    inertia: [f64; 6],
}

impl Robot {
    /// Adds a payload to the body that holds it: the second moments of both about their common centre of mass.
    ///
    /// # Errors
    /// A clause.
    pub(crate) fn carry(&mut self, load: &Payload) -> Result<(), String> {
        let frame = self.frames.iter().find(|f| f.name == load.frame).map(|f| (f.body, f.placement));
        let body = self.bodies.iter().position(|b| b.name == load.frame).map(|k| (Some(k), Place::HERE));
        let fixed = || format!("its payload is held by '{}', which does not move", load.frame);
        let (body, place) = body.or(frame).ok_or_else(fixed)?;
        let body = body.and_then(|body| self.bodies.get_mut(body)).ok_or_else(fixed)?;
        if !(load.mass > 0.0 && load.mass.is_finite()) {
            return Err(format!("its payload has a mass of {} kg", load.mass));
        }
        let at = place.point(load.com);
        let mass = body.mass + load.mass;
        let com = times(1.0 / mass, plus(times(body.mass, body.com), times(load.mass, at)));
        let full = |[xx, xy, xz, yy, yz, zz]: [f64; 6]| [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
        // R I R'
        let back = |m: &Mat3| [0, 1, 2].map(|i| [0, 1, 2].map(|j| m[j][i]));
        let turned = product(&product(&place.axes, &full(load.inertia)), &back(&place.axes));
        let mut sum = full(body.inertia);
        for (m, c) in [(body.mass, body.com), (load.mass, at)] {
            let d = minus(c, com);
            for i in 0..3 {
                for j in 0..3 {
                    sum[i][j] += m * (if i == j { dot(d, d) } else { 0.0 } - d[i] * d[j]);
                }
            }
        }
        let all: Mat3 = [0, 1, 2].map(|i| [0, 1, 2].map(|j| sum[i][j] + turned[i][j]));
        (body.mass, body.com) = (mass, com);
        body.inertia = [all[0][0], all[0][1], all[0][2], all[1][1], all[1][2], all[2][2]];
        Ok(())
    }
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
    /// What drives damp, where physics steps take it implicitly [N·m·s/rad or N·s/m].
    #[serde(default)]
    pub(crate) drive_damping: f64,
    /// Something that nobody commands holds it.
    #[serde(default)]
    pub(crate) held: bool,
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

    /// [`Robot::effort`], short of the end where a physics step is no longer implicit in a drive's damping [N·m or N].
    pub(crate) fn usable(&self, joint: &Joint) -> f64 {
        let effort = self.effort(joint);
        if joint.drive_damping > 0.0 { (1.0 - 1e-7) * effort } else { effort }
    }

    /// The largest force of a joint, by its own limit and its motors' [N·m or N].
    pub(crate) fn effort(&self, joint: &Joint) -> f64 {
        let motors = self.motors.iter().filter(|motor| motor.joint == joint.name).map(Motor::strength);
        let all = motors.reduce(|sum, each| sum + each).unwrap_or(f64::INFINITY);
        joint.effort.unwrap_or(f64::INFINITY).min(all)
    }
}
