//! Limits of single joints: what a task file may ask for, one implementation a file.
//!
//! A new one is a file with a type implementing [`Limit`], a field in [`ConstraintSettings`] and a line in
//! [`REGISTRY`].

mod acceleration;
mod position;
mod settings;
mod torque;
mod velocity;

pub use acceleration::{AccelerationLimit, AccelerationSettings};
pub use position::{PositionLimit, PositionSettings};
pub use settings::{ConstraintSettings, PerJoint};
pub use torque::{TorqueLimit, TorqueSettings};
pub use velocity::{VelocityLimit, VelocitySettings};

use crate::{LimitError, Model};

/// A hard limit on the motion of single joints.
pub trait Limit: Send + Sync + std::fmt::Debug {
    /// Name in the task file.
    fn name(&self) -> &'static str;

    /// Narrows `set` for the dofs in `controllable`.
    ///
    /// # Errors
    /// Unknown joints, values out of their domain, or limits the robot file does not state; every joint is listed.
    fn restrict(&self, model: &Model, controllable: &[usize], set: &mut LimitSet) -> Result<(), LimitError>;
}

/// The numbers all limits boil down to, one per dof (nv); infinite is none.
#[derive(Debug, Clone, PartialEq)]
pub struct LimitSet {
    /// Lowest position [rad or m].
    pub q_lower: Vec<f64>,
    /// Highest position [rad or m].
    pub q_upper: Vec<f64>,
    /// Largest speed V [rad/s or m/s].
    pub velocity: Vec<f64>,
    /// Largest acceleration A [rad/s² or m/s²].
    pub acceleration: Vec<f64>,
    /// Deceleration braking may count on, at most A [rad/s² or m/s²].
    pub braking: Vec<f64>,
    /// Largest motor force [N·m or N].
    pub effort: Vec<f64>,
}

impl LimitSet {
    /// No limits on `nv` dofs.
    pub fn unlimited(nv: usize) -> LimitSet {
        let none = vec![f64::INFINITY; nv];
        LimitSet {
            q_lower: vec![f64::NEG_INFINITY; nv],
            q_upper: none.clone(),
            velocity: none.clone(),
            acceleration: none.clone(),
            braking: none.clone(),
            effort: none,
        }
    }

    /// All `limits` together.
    ///
    /// # Errors
    /// Those of the limits; limits without any state between them.
    pub fn collect(
        model: &Model,
        limits: &[Box<dyn Limit>],
        controllable: &[usize],
    ) -> Result<LimitSet, LimitError> {
        let mut set = LimitSet::unlimited(model.nv());
        for limit in limits {
            limit.restrict(model, controllable, &mut set)?;
        }
        let empty = |i: &&usize| set.q_lower[**i] >= set.q_upper[**i];
        let list = listed(controllable.iter().filter(empty), |i| {
            let (low, high) = (set.q_lower[i], set.q_upper[i]);
            format!("joint '{}' would have to stay above {low} and below {high} rad or m", model.dof_name(i))
        });
        if list.is_empty() { Ok(set) } else { Err(LimitError::Contradictory { list }) }
    }

    /// True when the dof has a lower or an upper position limit.
    pub fn has_position(&self, dof: usize) -> bool {
        self.q_lower[dof].is_finite() || self.q_upper[dof].is_finite()
    }
}

/// Makes a limit from the task file's section, `None` when the section does not ask for it.
type Build = fn(&ConstraintSettings, &Model) -> Result<Option<Box<dyn Limit>>, LimitError>;

/// All limits by their name in the task file.
pub const REGISTRY: &[(&str, Build)] = &[
    ("position", |s, _| Ok(s.position.clone().map(|x| Box::new(PositionLimit::new(x)) as Box<dyn Limit>))),
    ("velocity", |s, _| Ok(s.velocity.clone().map(|x| Box::new(VelocityLimit::new(x)) as Box<dyn Limit>))),
    ("acceleration", |s, _| {
        Ok(s.acceleration.clone().map(|x| Box::new(AccelerationLimit::new(x)) as Box<dyn Limit>))
    }),
    ("torque", |s, _| Ok(s.torque.clone().map(|x| Box::new(TorqueLimit::new(x)) as Box<dyn Limit>))),
];

/// The limits that a task file's `[constraints]` asks for, checked against all joints of `model` they name.
///
/// # Errors
/// Unknown joints and values out of their domain. Limits that the robot file lacks are found by
/// [`Projector::new`](crate::Projector::new), which knows the controllable dofs.
pub fn build_limits(settings: &ConstraintSettings, model: &Model) -> Result<Vec<Box<dyn Limit>>, LimitError> {
    let mut limits = Vec::new();
    for (_, build) in REGISTRY {
        limits.extend(build(settings, model)?);
    }
    for limit in &limits {
        limit.restrict(model, &[], &mut LimitSet::unlimited(model.nv()))?;
    }
    Ok(limits)
}

/// "a; b; c" over dofs.
fn listed<'a>(dofs: impl Iterator<Item = &'a usize>, text: impl Fn(usize) -> String) -> String {
    dofs.map(|i| text(*i)).collect::<Vec<_>>().join("; ")
}

/// "'a', 'b'" over dofs.
fn quoted(model: &Model, dofs: &[usize]) -> String {
    dofs.iter().map(|i| format!("'{}'", model.dof_name(*i))).collect::<Vec<_>>().join(", ")
}
