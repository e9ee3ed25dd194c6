//! `[policy]` of a task: how a policy made elsewhere sees the state, and what its outputs mean. Plain data, computed by the controller, so that a
//! plant need not know the policy.
//!
//! ```toml
//! [policy]
//! joints = ["FL_hip_joint", "FL_thigh_joint"]     # in the policy's order
//! pose = [0.1, 0.9]                               # what positions and targets are relative to
//! action = { scale = 0.25 }                       # target = pose + scale output
//! observation = [
//!     { term = "base_ang_vel", scale = 0.2 },
//!     { term = "projected_gravity" },
//!     { term = "command", entries = ["command.vx", "command.vy", "command.yaw"] },
//!     { term = "joint_pos" },
//!     { term = "joint_vel", scale = 0.05, history = 3 },
//!     { term = "last_action" },
//! ]
//! ```

mod map;
mod observer;
mod source;

use crate::task::names;
use serde::{Deserialize, Serialize};

pub use map::ActionMap;
pub use observer::Observer;

/// `[policy]`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicySection {
    /// Joints of one degree of freedom in the policy's order: of its joint terms and of its outputs.
    #[serde(deserialize_with = "names::list")]
    pub joints: Vec<String>,
    /// Their positions that `joint_pos` and the outputs are relative to [rad or m]; 0 when absent.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub pose: Vec<f64>,
    /// What the outputs mean.
    #[serde(default)]
    pub action: ActionSection,
    /// The terms of the observation in the policy's order; empty where the plant gives the observation itself.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub observation: Vec<Term>,
}

/// `[policy] action`: joint `i` is commanded `offset_i + scale_i clip(output_i)`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ActionSection {
    /// One number for all joints or one for each.
    pub scale: Numbers,
    /// The same; when absent the pose for joints that are commanded positions, and 0 for those that are commanded velocities or forces.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub offset: Option<Numbers>,
    /// Lowest and highest output, before the scale. What `last_action` sees is clipped too.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub clip: Option<[Numbers; 2]>,
}

impl PolicySection {
    /// What is added to the scaled output of each joint, which is commanded a position or not.
    ///
    /// # Errors
    /// One sentence, for a pose or an offset of another length.
    pub fn offset(&self, takes_position: &[bool]) -> Result<Vec<f64>, String> {
        let n = self.joints.len();
        if !self.pose.is_empty() && self.pose.len() != n {
            return Err(format!(
                "policy.pose has {} positions for {n} joints; give one for each",
                self.pose.len()
            ));
        }
        match &self.action.offset {
            Some(offset) => offset.spread("policy.action.offset", n),
            None if self.pose.is_empty() => Ok(vec![0.0; n]),
            None => {
                Ok(self.pose.iter().zip(takes_position).map(|(at, is)| if *is { *at } else { 0.0 }).collect())
            }
        }
    }
}

/// One number for all entries, or one for each.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "expected a number or a list of numbers")]
pub enum Numbers {
    /// The same for all.
    All(f64),
    /// One for each.
    Each(Vec<f64>),
}

impl Default for Numbers {
    fn default() -> Self {
        Self::All(1.0)
    }
}

impl Numbers {
    /// `n` of them.
    ///
    /// # Errors
    /// One sentence, where there are not as many or one is not a number; `what` is named.
    pub fn spread(&self, what: &str, n: usize) -> Result<Vec<f64>, String> {
        let values = match self {
            Self::All(x) => vec![*x; n],
            Self::Each(list) => list.clone(),
        };
        if values.len() != n {
            return Err(format!(
                "{what} has {} numbers for {n} entries; give one for all or one for each",
                values.len()
            ));
        }
        match values.iter().find(|x| !x.is_finite()) {
            Some(x) => Err(format!("{what} has {x}, which is not a number; give finite ones")),
            None => Ok(values),
        }
    }
}

/// One term of the observation: `scale clip(value)`, for the last `history` policy ticks, oldest first.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Term {
    /// What it is.
    pub term: TermKind,
    /// Joints of `joint_pos` and `joint_vel`; those of the policy when absent.
    #[serde(default, deserialize_with = "names::optional", skip_serializing_if = "Option::is_none")]
    pub joints: Option<Vec<String>>,
    /// Entries of the plant's observation that a `command` or `observed` term reads.
    #[serde(default, deserialize_with = "names::list", skip_serializing_if = "Vec::is_empty")]
    pub entries: Vec<String>,
    /// What a `constant` is, or a `command` that no plant gives.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub value: Vec<f64>,
    /// Multiplies the value after the clip.
    #[serde(default)]
    pub scale: Numbers,
    /// Lowest and highest value, before the scale.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clip: Option<[f64; 2]>,
    /// Policy ticks that are seen, the current one last. The first one after a reset stands for those before it.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub history: usize,
    /// Duration of a cycle of `phase` \[s\].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub period: Option<f64>,
    /// Shifts of the `phase`s, in cycles: `cos` of each, then `sin` of each; one phase without shift when absent.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub shifts: Vec<f64>,
    /// Point of the base whose velocity `base_lin_vel` is, in the base's axes \[m\]; its origin when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub point: Option<[f64; 3]>,
}

fn one() -> usize {
    1
}

fn is_one(n: &usize) -> bool {
    *n == 1
}

/// What a term is. The names of mjlab, Isaac Lab and unitree_rl_lab for the same are understood.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TermKind {
    /// Positions of joints relative to the pose [rad or m].
    #[default]
    #[serde(alias = "joint_pos_rel", alias = "dof_pos")]
    JointPos,
    /// Velocities of joints [rad/s or m/s].
    #[serde(alias = "joint_vel_rel", alias = "dof_vel")]
    JointVel,
    /// Unit vector of gravity in the base's axes.
    #[serde(alias = "gravity")]
    ProjectedGravity,
    /// Linear velocity of the base in its own axes [m/s].
    BaseLinVel,
    /// Angular velocity of the base in its own axes [rad/s].
    #[serde(alias = "gyro")]
    BaseAngVel,
    /// What the robot is asked to do: entries of the plant's observation, or a fixed value.
    #[serde(alias = "velocity_commands", alias = "generated_commands", alias = "commands")]
    Command,
    /// The policy's outputs of its last tick, 0 after a reset.
    #[serde(alias = "actions", alias = "last_actions", alias = "prev_action", alias = "previous_action")]
    LastAction,
    /// Where a gait is in its cycle.
    #[serde(alias = "gait_phase")]
    Phase,
    /// Entries of the plant's observation by name.
    Observed,
    /// Fixed numbers.
    Constant,
}

impl TermKind {
    /// The name in a task file.
    pub fn name(self) -> &'static str {
        match self {
            Self::JointPos => "joint_pos",
            Self::JointVel => "joint_vel",
            Self::ProjectedGravity => "projected_gravity",
            Self::BaseLinVel => "base_lin_vel",
            Self::BaseAngVel => "base_ang_vel",
            Self::Command => "command",
            Self::LastAction => "last_action",
            Self::Phase => "phase",
            Self::Observed => "observed",
            Self::Constant => "constant",
        }
    }

    /// The unit of its values, before the scale.
    pub fn unit(self) -> &'static str {
        match self {
            Self::JointPos => "rad or m",
            Self::JointVel => "rad/s or m/s",
            Self::BaseLinVel => "m/s",
            Self::BaseAngVel => "rad/s",
            _ => "",
        }
    }
}

/// One line, as `nearl doctor` prints it.
impl std::fmt::Display for PolicySection {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let terms: Vec<String> = self.observation.iter().map(Term::to_string).collect();
        let seen = if terms.is_empty() { "the plant's observation".to_string() } else { terms.join("; ") };
        write!(f, "sees {seen}; commands {} = ", self.joints.join(", "))?;
        match &self.action.offset {
            None if self.pose.is_empty() => {}
            None => write!(f, "pose {:?} (of joints that are commanded positions) + ", self.pose)?,
            Some(offset) => write!(f, "{offset} + ")?,
        }
        write!(f, "{} x output", self.action.scale)?;
        match &self.action.clip {
            Some([lower, upper]) => write!(f, " within {lower} to {upper}"),
            None => Ok(()),
        }
    }
}

impl std::fmt::Display for Term {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", self.term.name())?;
        if !self.term.unit().is_empty() {
            write!(f, " [{}]", self.term.unit())?;
        }
        if let Some(joints) = &self.joints {
            write!(f, " of {}", joints.join(", "))?;
        }
        if let Some(period) = self.period {
            write!(f, " of {period} s")?;
        }
        if !self.shifts.is_empty() {
            write!(f, ", shifts {:?} cycles", self.shifts)?;
        }
        if let Some(point) = self.point {
            write!(f, " of point {point:?} m")?;
        }
        if !self.entries.is_empty() && self.value.is_empty() {
            write!(f, " from {}", self.entries.join(", "))?;
        }
        if !self.value.is_empty() {
            write!(f, " {:?}", self.value)?;
        }
        if let Some([lower, upper]) = self.clip {
            write!(f, ", clip {lower} to {upper}")?;
        }
        if self.scale != Numbers::default() {
            write!(f, ", scale {}", self.scale)?;
        }
        if self.history > 1 {
            write!(f, ", history {}", self.history)?;
        }
        Ok(())
    }
}

impl std::fmt::Display for Numbers {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::All(x) => write!(f, "{x}"),
            Self::Each(list) => write!(f, "{list:?}"),
        }
    }
}
