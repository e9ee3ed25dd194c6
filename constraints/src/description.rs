//! A robot as plain numbers: what every reader of robot files makes, what a snapshot carries, and all a model is
//! built from.
//!
//! ```text
//!     body in its parent   X(q) = placement . J1(q1) . J2(q2) ...       one factor for each joint of the body, in their order
//!     hinge                J(q) = Trans(p) Rot(axis, q - reference) Trans(-p)
//!     slide                J(q) = Trans(axis (q - reference))
//! ```
//!
//! Axes and anchors `p` of a body's joints are in the body's axes, as they are where every joint is at its `reference`. Units: m, kg, rad,
//! s, N. Numbers that are not there are `None` and never infinite, so that the description can be written as JSON.

pub(crate) mod check;
mod motor;
mod payload;

use crate::geometry::{Placement, Shape};
use serde::{Deserialize, Serialize};

pub use crate::friction::{FrictionLaw, Onset};
pub use motor::{Command, Motor};
pub use payload::Payload;

/// A robot: bodies with their joints, depth first, and what stands on them. Serialisable; [`RobotDescription::check`] says whether it can be.
///
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotDescription {
    /// Name, for messages.
    pub name: String,
    /// Acceleration of free fall in world axes [m/s²].
    pub gravity: [f64; 3],
    /// Every body after its parent and directly after what hangs on that parent's earlier children (depth first).
    pub bodies: Vec<Body>,
    /// Named places on bodies beside the bodies' own: sites, and the joints a file keeps as fixed.
    pub frames: Vec<Frame>,
    /// Solids that collide.
    pub solids: Vec<Solid>,
    /// What drives the joints.
    pub motors: Vec<Motor>,
    /// What the robot file says that is not part of this description, one sentence each.
    pub notes: Vec<String>,
}

/// A rigid body. Without joints it is fixed to its parent.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Body {
    /// Name, of no other body.
    pub name: String,
    /// Number of the body it hangs on, smaller than its own; `None` for the world.
    pub parent: Option<usize>,
    /// Its place in the parent's axes with every joint at its reference.
    pub placement: Placement,
    /// Mass \[kg\]; 0 for a frame that weighs nothing.
    pub mass: f64,
    /// Centre of mass in own axes \[m\].
    pub com: [f64; 3],
    /// Inertia about the centre of mass in own axes, `xx, xy, xz, yy, yz, zz` [kg·m²].
    pub inertia: [f64; 6],
    /// What lets it move, from the parent outwards.
    pub joints: Vec<JointDescription>,
}

/// One joint of a body.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JointDescription {
    /// Name, of no other joint.
    pub name: String,
    /// What it lets move.
    pub kind: JointKind,
    /// Direction of a hinge's or slide's axis in the body's axes (length 1); the others have none and say `[0, 0, 1]`.
    pub axis: [f64; 3],
    /// A point of the axis, or the centre of a ball, in the body's axes \[m\].
    pub anchor: [f64; 3],
    /// Position at which the body stands at its placement [rad or m]; of hinges and slides only.
    pub reference: f64,
    /// Position limits.
    pub range: Range,
    /// Largest speed [rad/s or m/s].
    pub velocity: Option<f64>,
    /// Largest force of all motors together [N·m or N]. The motors' own ranges may allow less.
    pub effort: Option<f64>,
    /// Viscous damping [N·m·s/rad or N·s/m].
    pub damping: f64,
    /// What the drives of its motors damp, where a physics step of the plant takes that implicitly beside `damping`, as MuJoCo's `implicitfast`
    /// does [N·m·s/rad or N·s/m]. It is part of the motors' forces.
    #[serde(default, skip_serializing_if = "is_none")]
    pub drive_damping: f64,
    /// Spring [N·m/rad or N/m].
    pub stiffness: f64,
    /// Position at which the spring is at rest [rad or m].
    pub spring_reference: f64,
    /// Rotor inertia reflected to the joint [kg·m² or kg].
    pub armature: f64,
    /// Dry friction: the force that the joint withstands before it moves [N·m or N].
    pub friction: f64,
    /// How dry friction sets in; MuJoCo's usual way where nothing is stated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub friction_onset: Option<Onset>,
    /// What dry friction is taken to be.
    #[serde(default, skip_serializing_if = "is_mujoco")]
    pub friction_law: FrictionLaw,
    /// Something beside the motors named here holds it where it is, as a tendon or an equation does the fingers of a hand. Of one-dof joints only.
    #[serde(default, skip_serializing_if = "is_false")]
    pub held: bool,
}

fn is_false(held: &bool) -> bool {
    !held
}

fn is_none(damping: &f64) -> bool {
    *damping == 0.0
}

fn is_mujoco(law: &FrictionLaw) -> bool {
    *law == FrictionLaw::Mujoco
}

/// What a joint lets move, and how many numbers say where it is and how fast.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JointKind {
    /// Everything: position and quaternion `x y z w`; six velocities in the body's axes.
    Free,
    /// Rotation about a point: quaternion `x y z w`; three velocities in the body's axes.
    Ball,
    /// Rotation about the axis: one angle.
    Hinge,
    /// Rotation about the axis without end: cosine and sine; one velocity.
    Continuous,
    /// Translation along the axis.
    Slide,
    /// Motion in the body's x-y plane: x, y, cosine and sine; three velocities.
    Planar,
}

/// Position limits of a joint.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Range {
    /// Lower and upper limit [rad or m].
    Limited(f64, f64),
    /// None, by intention.
    Unlimited,
    /// The file should state some and does not.
    NotStated,
}

/// A named place on a body.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Frame {
    /// Name. A body of the same name comes first where frames are looked up.
    pub name: String,
    /// Number of the body; `None` for the world.
    pub body: Option<usize>,
    /// In the body's axes.
    pub placement: Placement,
}

/// A solid on a body.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Solid {
    /// Number of the body; `None` for the world.
    pub body: Option<usize>,
    /// `None` for what is no primitive: a mesh, a height field.
    pub shape: Option<Shape>,
    /// In the body's axes.
    pub placement: Placement,
}

impl JointKind {
    /// Number of configuration and of velocity entries.
    pub fn size(self) -> (usize, usize) {
        match self {
            JointKind::Free => (7, 6),
            JointKind::Ball => (4, 3),
            JointKind::Hinge | JointKind::Slide => (1, 1),
            JointKind::Continuous => (2, 1),
            JointKind::Planar => (4, 3),
        }
    }

    /// True for a hinge, a slide and a continuous joint.
    pub fn has_one_dof(self) -> bool {
        self.size().1 == 1
    }
}

impl JointDescription {
    /// A joint that is at its body's origin, about or along z, and has no limits, forces or rotor.
    pub fn new(name: &str, kind: JointKind) -> JointDescription {
        JointDescription {
            name: name.to_string(),
            kind,
            axis: [0.0, 0.0, 1.0],
            anchor: [0.0; 3],
            reference: 0.0,
            range: Range::Unlimited,
            velocity: None,
            effort: None,
            damping: 0.0,
            drive_damping: 0.0,
            stiffness: 0.0,
            spring_reference: 0.0,
            armature: 0.0,
            friction: 0.0,
            friction_onset: None,
            friction_law: FrictionLaw::default(),
            held: false,
        }
    }
}

/// How the note of a joint begins that mimics another, `q = multiplier q_other + offset`: a task whose limits hold the two together needs it no more.
pub fn mimics(joint: &str, other: &str, multiplier: f64, offset: f64) -> String {
    format!("joint '{joint}' mimics '{other}' in the file (multiplier {multiplier}, offset {offset})")
}

impl RobotDescription {
    /// Unit vector of gravity in world axes; `0 0 -1` where the robot has no weight.
    pub fn down(&self) -> [f64; 3] {
        let size = self.gravity.iter().map(|g| g * g).sum::<f64>().sqrt();
        if size > 0.0 { self.gravity.map(|g| g / size) } else { [0.0, 0.0, -1.0] }
    }

    /// All joints in the order of the velocities.
    pub fn joints(&self) -> impl Iterator<Item = &JointDescription> {
        self.bodies.iter().flat_map(|body| &body.joints)
    }
}
