//! What the projector reports about a tick. Training, the flight log and the operator read the same ledger.

use crate::viability::Kind;

/// How a tick ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// The proposal obeys everything and is returned bit for bit.
    Unchanged,
    /// Made consistent or clamped to the box; exact.
    Clamped,
    /// Coupled rows were active; the nearest allowed state was solved for and checked.
    Solved,
    /// No way to stop could be verified from the nearest allowed state, and this one is nearer to the stored brake; or the robot would not come to that
    /// state ([`Projector::project_within`](crate::Projector::project_within)).
    Slowed,
    /// A joint, a point of a frame, a pair of bodies or a row is outside its limits, see [`Ledger::outside`]: it may only come back
    /// or brake, the rest follows the proposal.
    Recovering,
    /// The state is outside limits that were moved ([`Projector::move_limits`](crate::Projector::move_limits)), see [`Ledger::outside`]: it
    /// is on the declared way to them, and inside all others.
    Tightening,
    /// The proposal was not used: every controllable joint brakes.
    Braked(BrakeReason),
    /// The target must not be used, though it is finite: it stands still at the measured or neutral position.
    Refused(RefuseReason),
}

impl Status {
    /// True when the target answers the proposal: the nearest allowed state, or one near it where the status says why; false when it brakes or is
    /// refused.
    pub fn is_ok(&self) -> bool {
        !matches!(self, Status::Braked(_) | Status::Refused(_))
    }

    /// Its name in one word, as Python and `nearl project` say it.
    pub fn name(&self) -> &'static str {
        match self {
            Status::Unchanged => "unchanged",
            Status::Clamped => "clamped",
            Status::Solved => "solved",
            Status::Slowed => "slowed",
            Status::Recovering => "recovering",
            Status::Tightening => "tightening",
            Status::Braked(_) => "braked",
            Status::Refused(_) => "refused",
        }
    }

    /// Why, where there is a reason.
    pub fn reason(&self) -> Option<&'static str> {
        Some(match self {
            Status::Unchanged | Status::Clamped | Status::Solved => return None,
            Status::Slowed => {
                "no way to stop could be verified from the nearest allowed state, or its physics steps do not lead there"
            }
            Status::Recovering => {
                "the measured state is outside what `outside` names, which may only come back or brake"
            }
            Status::Tightening => {
                "limits were moved, and the state is on the declared way to those that `outside` names"
            }
            Status::Braked(BrakeReason::NonFiniteProposal) => "the proposal holds NaN or infinity",
            Status::Braked(BrakeReason::NoCertifiedAnswer) => "no answer passed the checker",
            Status::Braked(BrakeReason::NoVerifiedBrake) => {
                "no way to stop could be verified; the stored brake is executed"
            }
            Status::Braked(BrakeReason::NonFiniteDynamics) => "the dynamics came out as NaN or infinity",
            Status::Refused(RefuseReason::NonFiniteState) => {
                "the measured state, what was observed beside it, or the tick before holds NaN or infinity"
            }
            Status::Refused(RefuseReason::WrongLength) => "a vector has the wrong length",
        })
    }
}

/// Why the joints brake.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BrakeReason {
    /// The proposal holds NaN or infinity.
    NonFiniteProposal,
    /// No answer passed the checker: the coupled rows leave nothing, or the solver failed.
    NoCertifiedAnswer,
    /// No way to stop could be verified; the stored brake is executed, or with none stored, each joint brakes for itself.
    NoVerifiedBrake,
    /// The dynamics came out as NaN or infinity.
    NonFiniteDynamics,
}

/// Why the tick was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RefuseReason {
    /// The measured state holds NaN or infinity.
    NonFiniteState,
    /// A slice does not have nq or nv numbers; nothing was written.
    WrongLength,
}

/// Which stage gave the answer, in the order in which they are tried; the number is the one in messages and logs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rung {
    /// Per-joint clamp.
    ClosedForm = 0,
    /// Exact active-set stage.
    ActiveSet = 1,
    /// Clarabel.
    Clarabel = 2,
    /// One of the two, without the soft rows.
    Relaxed = 4,
    /// The brake that was verified ticks ago.
    StoredBrake = 5,
    /// Per-joint brake.
    Brake = 3,
}

impl Rung {
    /// Every rung at the place of its [`number`](Self::number).
    pub const ALL: [Rung; 6] =
        [Self::ClosedForm, Self::ActiveSet, Self::Clarabel, Self::Brake, Self::Relaxed, Self::StoredBrake];

    /// Its number in messages and logs.
    pub fn number(self) -> u32 {
        self as u32
    }

    /// Its name in words.
    pub fn name(self) -> &'static str {
        match self {
            Self::ClosedForm => "closed form",
            Self::ActiveSet => "active set",
            Self::Clarabel => "clarabel",
            Self::Brake => "brake",
            Self::Relaxed => "relaxed",
            Self::StoredBrake => "stored brake",
        }
    }
}

/// Which bound of a row is active.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// The lower bound.
    Lower,
    /// The upper bound.
    Upper,
}

/// A row that holds the target back.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ActiveRow {
    /// What the row stands for.
    pub kind: Kind,
    /// Index into [`Projector::row_names`](crate::Projector::row_names): the dof of a box row, beyond nv a coupled row.
    pub row: usize,
    /// Its active bound.
    pub side: Side,
    /// How hard it is leaned on, at least 0: derivative of the weighted squared distance with respect to the bound.
    /// Box rows [weight² rad/s], coupled rows [weight² (rad/s)² / unit of the row].
    pub multiplier: f64,
    /// By how much a soft row is exceeded, as a share of its size; 0 for hard rows.
    pub slack: f64,
}

/// Number of violated limits by kind.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Position limits.
    pub position: u32,
    /// Velocity limits, profiles and locked joints.
    pub velocity: u32,
    /// Acceleration limits.
    pub acceleration: u32,
    /// States from which braking comes too late.
    pub viability: u32,
    /// Motor force limits.
    pub torque: u32,
    /// Coupled limits of all other kinds.
    pub other: u32,
}

impl Counts {
    /// All of them.
    pub fn total(&self) -> u32 {
        self.position + self.velocity + self.acceleration + self.viability + self.torque + self.other
    }

    pub(crate) fn add(&mut self, kind: Kind) {
        *match kind {
            Kind::Position => &mut self.position,
            Kind::Velocity | Kind::VelocityProfile | Kind::Locked => &mut self.velocity,
            Kind::Acceleration => &mut self.acceleration,
            Kind::Viability => &mut self.viability,
            Kind::Torque => &mut self.torque,
            _ => &mut self.other,
        } += 1;
    }
}

/// The report of one tick.
#[derive(Debug, Clone, PartialEq)]
pub struct Ledger {
    /// How the tick ended.
    pub status: Status,
    /// Which stage gave the answer.
    pub rung: Rung,
    /// Rows that hold the target back: the box in the order of dofs, then the coupled rows.
    pub active: Vec<ActiveRow>,
    /// Weighted distance between proposal and target [weight rad/s].
    pub moved: f64,
    /// Largest share of its limit by which the target exceeds one: a soft one that gives way, or any while braking or recovering.
    pub slack: f64,
    /// Iterations of the active-set stage and of Clarabel.
    pub iterations: u32,
    /// Largest violation of the optimality conditions [weight² rad/s]; 0 for the closed form.
    pub residual: f64,
    /// Time the projection took \[ns\].
    pub duration_ns: u64,
    /// What the raw proposal would have violated.
    pub raw_violations: Counts,
    /// What the target violates, by the independent checker; zero unless braking or recovering.
    pub target_violations: Counts,
    /// What the measured state, or the brake in force where limits were moved, is beyond already, as in [`ActiveRow::row`]: dofs, then hard coupled rows.
    pub outside: Vec<usize>,
}

impl Ledger {
    /// Whether the tick began within the limits and its target breaks one: what `target_violations` of many ticks counts.
    pub fn target_breaks(&self) -> bool {
        self.target_violations.total() > 0 && self.outside.is_empty()
    }

    /// Memory for `rows` active rows.
    pub(crate) fn new(rows: usize) -> Ledger {
        Ledger {
            status: Status::Unchanged,
            rung: Rung::ClosedForm,
            active: Vec::with_capacity(rows),
            moved: 0.0,
            slack: 0.0,
            iterations: 0,
            residual: 0.0,
            duration_ns: 0,
            raw_violations: Counts::default(),
            target_violations: Counts::default(),
            outside: Vec::with_capacity(rows),
        }
    }

    /// Empties the report, keeping the memory.
    pub(crate) fn reset(&mut self) {
        let (mut active, mut outside) = (std::mem::take(&mut self.active), std::mem::take(&mut self.outside));
        active.clear();
        outside.clear();
        *self = Ledger { active, outside, ..Ledger::new(0) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rung_is_found_by_its_number() {
        for (number, rung) in Rung::ALL.into_iter().enumerate() {
            assert_eq!(rung.number(), number as u32, "{}", rung.name());
        }
    }
}
