//! Limits that are tighter for a while than a projector was built with.

use super::PerJoint;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// `{ speed = 0.3, upper = { elbow = 1.0 }, frame = { hand = 0.2 } }`: where limits are moved to while the robot runs. What is not named is as it was
/// built; nothing can be looser than that. See [`Projector::move_limits`](crate::Projector::move_limits).
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
        }
    }
}

impl Moved {
    /// Every speed at `share` of what was built.
    pub fn speed(share: f64) -> Moved {
        Moved { speed: share, ..Moved::default() }
    }
}
