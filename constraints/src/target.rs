//! What goes into a projection and what comes out of it. Units: rad or m, and per s, s².

use crate::ledger::Ledger;
use crate::{LimitError, Model};
use serde::{Deserialize, Serialize};
use std::time::Duration;

/// The raw next state a policy asks for. It is not a [`Target`] and cannot be sent to a robot.
#[derive(Debug, Clone, PartialEq)]
pub struct Proposal {
    /// Configuration at the end of the period (nq).
    pub q: Vec<f64>,
    /// Velocity at the end of the period (nv).
    pub v: Vec<f64>,
}

impl Proposal {
    /// The neutral configuration at rest, to be overwritten.
    pub fn new(model: &Model) -> Proposal {
        Proposal { q: model.neutral(), v: vec![0.0; model.nv()] }
    }
}

/// The nearest next state that every limit allows.
#[derive(Debug, Clone, PartialEq)]
pub struct Target {
    /// Configuration at the end of the period (nq).
    pub q: Vec<f64>,
    /// Velocity at the end of the period (nv).
    pub v: Vec<f64>,
    /// `(v' - v) / T` (nv): what inverse dynamics is asked for.
    pub acceleration: Vec<f64>,
    /// The report of the tick.
    pub ledger: Ledger,
}

impl Target {
    /// Memory for targets of `model`.
    pub fn new(model: &Model) -> Target {
        let zero = vec![0.0; model.nv()];
        let ledger = Ledger::new(8 * model.nv() + 64);
        Target { q: model.neutral(), v: zero.clone(), acceleration: zero, ledger }
    }
}

/// The box of the next state, per dof (nv). Infinite where nothing bounds it and for positions of joints with several
/// dofs.
#[derive(Debug, Clone, PartialEq)]
pub struct Bounds {
    /// Lowest next position.
    pub q_lower: Vec<f64>,
    /// Highest next position.
    pub q_upper: Vec<f64>,
    /// Lowest next velocity.
    pub v_lower: Vec<f64>,
    /// Highest next velocity.
    pub v_upper: Vec<f64>,
}

impl Bounds {
    pub(crate) fn new(nv: usize) -> Bounds {
        let (low, high) = (vec![f64::NEG_INFINITY; nv], vec![f64::INFINITY; nv]);
        Bounds { q_lower: low.clone(), q_upper: high.clone(), v_lower: low, v_upper: high }
    }
}

/// How the 2 n numbers of a proposal meet n dofs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Consistency {
    /// One acceleration per dof decides position and velocity: robots with analytic inverse dynamics.
    #[default]
    Kinematic,
    /// Position and velocity are projected apart: learned inverse dynamics, long periods.
    Free,
}

/// Which stages may solve coupled rows.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Solver {
    /// Closed form, exact active set, Clarabel.
    #[default]
    Ladder,
    /// Closed form for feasible proposals, otherwise Clarabel.
    Clarabel,
}

/// Whether actions that were not made from a projected state are checked before they are sent, and by what.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "GuardWord", into = "GuardWord")]
pub enum Guard {
    /// `false`: the action of a policy, or of a learned inverse model, goes to the actuators as it is.
    #[default]
    Off,
    /// `"drive"`: the targets of drives keep the drives' forces within the torque limits, and their change within the torque rate, in closed form;
    /// nothing is promised of the motion. For robots on legs.
    Drive,
    /// `"simulator"`: where a simulator is at hand (training, evaluation, `nearl plant`) it is asked where the action leads, contacts included.
    Simulator,
    /// `true`: the state that the robot model says it leads to is projected, and the action of the projected state is sent.
    Model,
}

/// How a task file writes a [`Guard`].
#[derive(Serialize, Deserialize)]
#[serde(untagged, expecting = "expected true, false, \"drive\" or \"simulator\"")]
enum GuardWord {
    Plain(bool),
    Named(GuardName),
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum GuardName {
    Drive,
    Simulator,
}

impl From<GuardWord> for Guard {
    fn from(word: GuardWord) -> Guard {
        match word {
            GuardWord::Plain(false) => Guard::Off,
            GuardWord::Plain(true) => Guard::Model,
            GuardWord::Named(GuardName::Drive) => Guard::Drive,
            GuardWord::Named(GuardName::Simulator) => Guard::Simulator,
        }
    }
}

impl From<Guard> for GuardWord {
    fn from(guard: Guard) -> GuardWord {
        match guard {
            Guard::Off => GuardWord::Plain(false),
            Guard::Model => GuardWord::Plain(true),
            Guard::Drive => GuardWord::Named(GuardName::Drive),
            Guard::Simulator => GuardWord::Named(GuardName::Simulator),
        }
    }
}

impl Guard {
    /// Nothing is checked.
    pub fn is_off(&self) -> bool {
        *self == Guard::Off
    }
}

/// Settings of a projector.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// Control period T \[s\].
    pub dt: f64,
    /// Semi-implicit Euler sub-steps of the plant in one period; 0 for constant acceleration or Runge-Kutta.
    pub sub_steps: u32,
    /// How the proposal is made consistent.
    pub consistency: Consistency,
    /// Which stages solve coupled rows.
    pub solver: Solver,
    /// Weight of each dof in the distance (nv); `None` is 1 for all.
    pub velocity_weight: Option<Vec<f64>>,
    /// Iterations allowed to Clarabel.
    pub max_iter: u32,
    /// Time allowed to one solve of Clarabel; its answer then counts only if it obeys everything, and nothing further is
    /// tried. `None`: as long as it takes.
    pub deadline: Option<Duration>,
    /// What makes sure that a way to stop is left.
    pub braking: Braking,
}

/// What makes sure that torque limits leave a way to stop.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Braking {
    /// `Stored` where a hard limit on torque by speed, frame speed or energy asks for it, or one on torque for which
    /// [`certify_braking`](crate::certify_braking) leaves less than 3 % of some motor, if every joint has an acceleration limit and is
    /// controllable; else `Certified`. Decided when the projector is built.
    #[default]
    Auto,
    /// The braking decelerations are within the motors' reach everywhere, which
    /// [`certify_braking`](crate::certify_braking) tells; nothing is done in a tick.
    Certified,
    /// Each tick verifies a whole brake from the new state by inverse dynamics; where none is found, the last one that
    /// was verified is executed.
    Stored,
}

impl Settings {
    /// Kinematic, ladder, unit weights, the way of braking that holds every hard limit.
    pub fn new(dt: f64, sub_steps: u32) -> Settings {
        Settings {
            dt,
            sub_steps,
            consistency: Consistency::Kinematic,
            solver: Solver::Ladder,
            velocity_weight: None,
            max_iter: 50,
            deadline: None,
            braking: Braking::Auto,
        }
    }

    /// Refuses what no projection could be made with.
    pub(crate) fn validate(&self, model: &Model) -> Result<(), LimitError> {
        let bad = |what: &str, value: f64, domain| {
            Err(LimitError::BadValue { what: what.to_string(), value, domain })
        };
        if !(self.dt.is_finite() && self.dt > 0.0) {
            return bad("control period dt", self.dt, "above 0 s");
        }
        if self.sub_steps > 1000 {
            return bad("sub_steps", f64::from(self.sub_steps), "at most 1000");
        }
        if self.max_iter == 0 {
            return bad("max_iter", 0.0, "at least 1");
        }
        let Some(weights) = &self.velocity_weight else { return Ok(()) };
        if weights.len() != model.nv() {
            return bad("length of velocity_weight", weights.len() as f64, "nv, one weight per dof");
        }
        let unusable = (0..weights.len()).filter(|i| !(1e-3..=1e3).contains(&weights[*i]));
        let named: Vec<String> =
            unusable.map(|i| format!("{} of '{}'", weights[i], model.dof_name(i))).collect();
        if named.is_empty() {
            return Ok(());
        }
        Err(LimitError::Unusable {
            what: format!("velocity_weight {} is not between 0.001 and 1000", named.join(", ")),
            next: "give every dof a positive, finite weight",
        })
    }
}
