//! Speed limits that depend on the position, as robot makers state them.

use super::margin::{is_zero, less};
use super::{About, Argument, Form, Limit, LimitSet, Takes};
use crate::viability::Profile;
use crate::{LimitError, Model};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What it says of itself.
pub(super) const ABOUT: About = About {
    class: "VelocityProfileLimit",
    promise: "The speed limit falls in front of a position: Franka's published rule for a Research 3, or by joint `limit`, \
        `offset` [rad/s], `squared` [rad/s²], `lower` and `upper` [rad] in `v <= min(limit, -offset + sqrt(squared \
        (upper - q)))`.",
    example: "velocity_profile = \"fr3\"",
    form: Form::Hard,
    margin: "[rad/s, m/s], also `{ robot = \"fr3\", margin = 0.05 }`",
    stricter: Some([
        "velocity_profile = { panda_joint4 = { squared = 0.5, lower = -2.2, upper = -1.4, limit = 1.0, offset = 0.05, \
        margin = 0.1 } }",
        "velocity_profile = { panda_joint4 = { squared = 0.5, lower = -2.2, upper = -1.4, limit = 0.9, offset = 0.15 } \
        }",
    ]),
    arguments: &[Argument::needed("profile", Takes::Curves).at(""), Argument::MARGIN],
};

/// `velocity_profile = "fr3"`, `{ robot = "fr3", margin = 0.05 }`, or the curves joint by joint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "velocity_profile is \"fr3\", { robot = \"fr3\", margin = 0.05 }, or by joint { limit, offset, squared, lower, upper } and \
                 perhaps margin; it is always hard and takes no soft"
)]
pub enum VelocityProfileSettings {
    /// A robot whose published curves are built in; joints are found by their names, the same but for the end, `joint1` to `joint7`.
    Robot(KnownRobot),
    /// The same, less a margin.
    RobotLess(RobotProfile),
    /// Curves by joint.
    Joints(BTreeMap<String, JointProfile>),
}

/// A robot's published curves less a margin.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotProfile {
    /// Whose curves.
    pub robot: KnownRobot,
    /// Speed kept below them [rad/s or m/s].
    pub margin: f64,
}

/// Robots whose curves are built in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum KnownRobot {
    /// Franka Research 3 (Franka Control Interface documentation, "Limits for Franka Research 3").
    Fr3,
}

/// The two curves of a joint,
///
/// ```text
///     v <= min(limit, max(0, -offset + sqrt(squared (upper - q))))
///     v >= -min(limit, max(0, -offset + sqrt(squared (q - lower))))
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JointProfile {
    /// Largest speed [rad/s or m/s].
    pub limit: f64,
    /// Speed taken off the curves [rad/s or m/s].
    pub offset: f64,
    /// Twice the deceleration of the curves [rad/s² or m/s²].
    pub squared: f64,
    /// Position at which the lower curve ends [rad or m].
    pub lower: f64,
    /// Position at which the upper curve ends [rad or m].
    pub upper: f64,
    /// Speed kept below the curves and the limit [rad/s or m/s].
    #[serde(default, skip_serializing_if = "is_zero")]
    pub margin: f64,
}

const fn joint(limit: f64, offset: f64, squared: f64, lower: f64, upper: f64) -> JointProfile {
    JointProfile { limit, offset, squared, lower, upper, margin: 0.0 }
}

/// Joints 1 to 7 of the Franka Research 3.
const FR3: [JointProfile; 7] = [
    joint(2.62, 0.30, 12.0, -2.7501, 2.7501),
    joint(2.62, 0.20, 5.17, -1.7918, 1.7918),
    joint(2.62, 0.20, 7.00, -2.9065, 2.9065),
    joint(2.62, 0.30, 8.00, -3.0481, -0.1458),
    joint(5.26, 0.35, 34.0, -2.8101, 2.8101),
    joint(4.18, 0.35, 11.0, 0.54092, 4.5205),
    joint(5.26, 0.35, 34.0, -3.0196, 3.0196),
];

/// Position-dependent speed limits; exact at the end of every tick, for any period.
///
/// Where a joint brakes less than its curves fall, the curves of its own braking hold, which are lower.
#[derive(Debug, Clone)]
pub struct VelocityProfileLimit {
    settings: VelocityProfileSettings,
}

impl VelocityProfileLimit {
    /// From the task file's settings.
    pub fn new(settings: VelocityProfileSettings) -> VelocityProfileLimit {
        VelocityProfileLimit { settings }
    }

    /// Dofs and their curves.
    fn curves(&self, model: &Model) -> Result<Vec<(usize, JointProfile)>, LimitError> {
        match &self.settings {
            VelocityProfileSettings::Robot(KnownRobot::Fr3) => fr3(model, 0.0),
            VelocityProfileSettings::RobotLess(RobotProfile { robot: KnownRobot::Fr3, margin }) => {
                fr3(model, *margin)
            }
            VelocityProfileSettings::Joints(map) => {
                map.iter().map(|(name, curve)| named(model, name, curve)).collect()
            }
        }
    }
}

fn fr3(model: &Model, margin: f64) -> Result<Vec<(usize, JointProfile)>, LimitError> {
    let unusable = |what: String, next| Err(LimitError::Unusable { what, next });
    let joints = || model.joints().iter().filter(|j| (j.nq, j.nv) == (1, 1));
    let named = |name: String| joints().find(|j| j.name == name).map(|j| j.idx_v);
    let arms: Vec<(&str, Vec<usize>)> = joints()
        .filter_map(|j| j.name.strip_suffix("joint1"))
        .filter_map(|arm| {
            Some((arm, (1..=7).map(|k| named(format!("{arm}joint{k}"))).collect::<Option<_>>()?))
        })
        .collect();
    match &arms[..] {
        [(_, dofs)] => {
            Ok(dofs.iter().zip(FR3).map(|(i, curve)| (*i, JointProfile { margin, ..curve })).collect())
        }
        [] => {
            let ends = (1..=7).map(|k| format!("joint{k}"));
            let missing: Vec<String> = ends.filter(|end| !joints().any(|j| j.name.ends_with(end))).collect();
            let what = match &missing[..] {
                [] => "seven joints of one arm, alike but for joint1 to joint7".to_string(),
                _ => format!("joint whose name ends with {}", missing.join(", ")),
            };
            unusable(
                format!("velocity_profile = \"fr3\" finds no {what}"),
                "use it with a Franka Research 3, or give the curves by joint",
            )
        }
        _ => {
            let names: Vec<String> = arms.iter().map(|(arm, _)| format!("'{arm}joint1'")).collect();
            unusable(
                format!("velocity_profile = \"fr3\" finds several arms, from {} on", names.join(", ")),
                "give the curves by joint",
            )
        }
    }
}

fn named(model: &Model, name: &str, curve: &JointProfile) -> Result<(usize, JointProfile), LimitError> {
    let limit = "velocity_profile";
    let unknown = |near| LimitError::UnknownJoint { limit, name: name.to_string(), near };
    let joint = model.find(name).map_err(unknown)?;
    if (joint.nq, joint.nv) != (1, 1) {
        let why = match joint.nv {
            1 => "a continuous joint, whose position is (cos, sin) and no angle",
            _ => "a joint with several dofs",
        };
        return Err(LimitError::Unusable {
            what: format!("velocity_profile names '{name}', {why}"),
            next: "take it out",
        });
    }
    let bad = |what: &str, value: f64, domain: &'static str| {
        Err(LimitError::BadValue {
            what: format!("velocity_profile {what} of joint '{name}'"),
            value,
            domain,
        })
    };
    match curve {
        c if !(c.limit > 0.0 && c.limit.is_finite()) => bad("limit", c.limit, "above 0 rad/s or m/s"),
        c if !(c.offset >= 0.0 && c.offset.is_finite()) => bad("offset", c.offset, "at least 0 rad/s or m/s"),
        c if !(c.squared > 0.0 && c.squared.is_finite()) => {
            bad("squared", c.squared, "above 0 rad/s² or m/s²")
        }
        c if c.lower >= c.upper || (c.upper - c.lower).is_nan() => bad("lower", c.lower, "below upper"),
        c => Ok((joint.idx_v, *c)),
    }
}

impl Limit for VelocityProfileLimit {
    fn name(&self) -> &'static str {
        "velocity_profile"
    }

    fn named_joints(&self) -> Vec<&str> {
        match &self.settings {
            VelocityProfileSettings::Joints(map) => map.keys().map(String::as_str).collect(),
            _ => Vec::new(),
        }
    }

    fn restrict(&self, model: &Model, controllable: &[usize], set: &mut LimitSet) -> Result<(), LimitError> {
        for (i, c) in self.curves(model)? {
            if controllable.contains(&i) {
                let what = format!("velocity_profile margin of joint '{}'", model.dof_name(i));
                let (limit, offset) = (less(&what, c.limit, c.margin)?, c.offset + c.margin);
                let curve = |at: f64| Some(Profile { at, deceleration: 0.5 * c.squared, offset });
                set.velocity[i] = set.velocity[i].min(limit);
                set.profile[i] = [curve(c.lower), curve(c.upper)];
            }
        }
        Ok(())
    }
}
