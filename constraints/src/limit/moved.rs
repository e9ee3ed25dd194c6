//! Limits that are tighter for a while than a projector was built with.

use super::{HalfSpace, PerJoint};
use crate::description::Payload;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// `{ speed = 0.3, upper = { elbow = 1.0 }, frame = { hand = 0.2 } }`: where limits are moved to while the robot runs. What is not named is as it was
/// built. Joints, insets, speeds and energy can be no looser than that; where a plane lies, an obstacle stands and what is carried is the operator's word.
/// See [`Projector::move_limits`](crate::Projector::move_limits).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Moved {
    /// Share of every limit on speed, in (0, 1]: of joints and frames; kinetic energy has its square.
    pub speed: f64,
    /// Largest speed [rad/s or m/s].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub velocity: Option<PerJoint>,
    /// How fast a joint may speed up [rad/s² or m/s²]. Slowing down keeps the deceleration of the build: every stop counts on it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub acceleration: Option<PerJoint>,
    /// Lowest position [rad or m].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lower: Option<PerJoint>,
    /// Highest position [rad or m].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub upper: Option<PerJoint>,
    /// By the name of a `frame` limit: how far inside of where they were built all its planes lie \[m\].
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub frame: BTreeMap<String, f64>,
    /// By the name of a `frame_speed` limit: largest speed [m/s].
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub frame_speed: BTreeMap<String, f64>,
    /// Largest kinetic energy \[J\].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub energy: Option<f64>,
    /// By the name of a `frame` limit with a half-space: where its plane lies; the margin of the build is kept.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub plane: BTreeMap<String, HalfSpace>,
    /// By the name of an obstacle of `collision`: where it stands.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub body: BTreeMap<String, Pose>,
    /// What the robot carries, beside what its description has: for a controller that is built anew, and refused by a projector that runs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub payload: Option<Payload>,
}

/// `{ position = [0.5, 0, 0.3], rpy = [0, 0, 1.57] }`: a place in the world.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pose {
    /// Origin \[m\].
    pub position: [f64; 3],
    /// Roll, pitch and yaw \[rad\].
    #[serde(default)]
    pub rpy: [f64; 3],
}

impl Default for Moved {
    fn default() -> Moved {
        Moved {
            speed: 1.0,
            velocity: None,
            acceleration: None,
            lower: None,
            upper: None,
            frame: BTreeMap::new(),
            frame_speed: BTreeMap::new(),
            energy: None,
            plane: BTreeMap::new(),
            body: BTreeMap::new(),
            payload: None,
        }
    }
}

impl Moved {
    /// Every speed at `share` of what was built.
    pub fn speed(share: f64) -> Moved {
        Moved { speed: share, ..Moved::default() }
    }
}
