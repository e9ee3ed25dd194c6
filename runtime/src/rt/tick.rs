//! What the loop needs from a controller, and the record it leaves of each tick.

use crate::link::{
    LedgerNumbers, MAX_JOINTS, Message, ProposalMessage, RobotMessage, RowsMessage, SnapshotBytes,
    StateMessage, Verdict,
};
use crate::rt::watch::Watched;
use crate::rt::way::Apart;
use crate::rt::{Mode, Reason, Resume};
use nearl_constraints::Moved;

/// A controller as the loop sees it. `tick`, `brake` and `reset` run in the real-time thread: no allocation beyond
/// what the solver cannot avoid, no lock, no system call.
pub trait LoopController: Send + 'static {
    /// Version of the snapshot behind it.
    fn version(&self) -> u64;
    /// Computes the action for `state`.
    fn tick(&mut self, state: &StateMessage, output: &mut TickOutput) -> Outcome;
    /// Computes an action that brings the velocity to zero; [`Outcome::Refused`] leaves braking to the plant. Also
    /// called after a panic in `tick`: it must not rely on what `tick` may have left half done.
    fn brake(&mut self, state: &StateMessage, output: &mut TickOutput) -> Outcome;
    /// The next state begins a new episode, or follows a swap.
    fn reset(&mut self);
    /// What was answered in the tick before is not what the robot does.
    fn lose(&mut self) {}
    /// What was answered in the tick before came too late and was never applied.
    fn recall(&mut self) {}
    /// The plant has gone on by itself for so many periods, from what was answered last.
    fn miss(&mut self, _periods: u64) {}
    /// What it takes from another process in place of its policy; none where it takes nothing. Allocates; not for the real-time thread.
    fn question(&self) -> Option<Question> {
        None
    }
    /// Whether [`LoopController::question`] asks for these names (by their hash) and this many entries.
    fn takes(&self, _kind: u32, _names: u64, _n: usize) -> bool {
        false
    }
    /// Proposes `values` from the next tick on.
    fn give(&mut self, _values: &[f64]) {}
    /// Sets every entry of the proposal's noise; 0 on a robot unless a rehearsed fault asks for another number.
    fn set_noise(&mut self, _noise: f32) {}
    /// Draws the noise of `tick` from `seed`, if the policy runs in it.
    fn explore(&mut self, _seed: u64, _tick: u64) {}
    /// What the next tick depends on beside its state, in place of what is in `memory`; a way to stop that was verified, for one.
    /// Allocates only where `memory` has no room.
    fn save_memory(&self, _memory: &mut Vec<f64>) {}
    /// Whether [`LoopController::save_memory`] says everything that the next tick depends on beside its state: a loop can go on from there.
    fn is_memory_whole(&self) -> bool {
        false
    }
    /// What the rows of a ledger are of, by their number. Not for the real-time thread: it allocates.
    fn row_names(&self) -> Vec<String> {
        Vec::new()
    }
    /// What viewers are told of it. Not for the real-time thread: it allocates.
    fn told(&self) -> Box<RowsMessage> {
        let mut told = Box::new(RowsMessage::zeroed());
        told.set_row_names(&self.row_names());
        told
    }
    /// Its limits, by which the report of a run names what was found outside. Not for the real-time thread: it allocates.
    fn watched(&self) -> Watched {
        Watched::default()
    }
    /// Takes what another controller of the same robot saved in the tick before, if it fits.
    fn load_memory(&mut self, _memory: &[f64]) {}
    /// Moves `state` on by one period, to where the action in `output` was to take it.
    fn predict(&self, _state: &mut StateMessage, _output: &TickOutput) {}
    /// The first degree of freedom of `new` that cannot have come from `old` in `age` \[s\], allowing `jump` times its speed.
    fn implausible(&self, _old: &StateMessage, _new: &StateMessage, _age: f64, _jump: f64) -> Option<usize> {
        None
    }
    /// Joints whose measured velocity is reckoned with: degree of freedom, configuration index, largest speed [rad/s or m/s].
    fn speeds(&self) -> &[(usize, usize, f64)] {
        &[]
    }
    /// A degree of freedom of `state` that is further outside of its joint's range than any robot stands, in degrees for radians for one.
    fn elsewhere(&self, _state: &StateMessage) -> Option<usize> {
        None
    }
    /// Takes `output` back towards standing still: `share` in (0, 1) of the way to its target is left. Only where a model
    /// of the robot knows the action for that; the others stay as they are.
    fn soften(&mut self, _state: &StateMessage, _share: f64, _output: &mut TickOutput) {}
}

/// What a controller can be given in place of its policy's output.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Question {
    /// `PROPOSES_*` of the link.
    pub kind: u32,
    /// Names of the entries in order.
    pub names: Vec<String>,
    /// Control ticks in which a proposed state is to be reached.
    pub policy_every: usize,
}

/// How a tick of the controller ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// `output.action` is checked and may be applied.
    Acted,
    /// The same, but the proposal was discarded and every joint brakes; the ledger's status says why.
    Braked,
    /// There is no checked action: the loop brakes.
    Refused,
}

/// Builds controllers from snapshot bytes; runs on a thread of its own, so it may take its time.
pub trait Build: Send + 'static {
    /// What it builds.
    type Controller: LoopController;
    /// Validates everything (digest, names, shapes, finite numbers, period, a trial tick) against `robot`.
    fn build(&mut self, snapshot: &SnapshotBytes, robot: &RobotMessage) -> Result<Self::Controller, Refusal>;

    /// The bytes of a snapshot with its limits moved.
    ///
    /// # Errors
    /// What cannot be moved, by name; of controllers without limits, everything.
    fn with_limits(&mut self, bytes: &[u8], moved: &Moved) -> Result<Vec<u8>, Refusal> {
        let _ = (bytes, moved);
        let text =
            "this loop has no limits that could be moved; run a snapshot that proposes states".to_owned();
        Err(Refusal { verdict: Verdict::Other, text })
    }
}

/// Why a snapshot was not taken.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// By reason.
    pub verdict: Verdict,
    /// One sentence: the thing, the values, the next step.
    pub text: String,
}

/// A controller's answer to one state. Vectors hold as many entries as the state says (nq, nv) and `nu` actions.
#[derive(Clone, Copy, Debug)]
pub struct TickOutput {
    /// Entries used in `action`.
    pub nu: u32,
    /// Proposed configuration (nq).
    pub proposal_q: [f64; MAX_JOINTS],
    /// Proposed velocity (nv).
    pub proposal_v: [f64; MAX_JOINTS],
    /// Projected configuration (nq).
    pub target_q: [f64; MAX_JOINTS],
    /// Projected velocity (nv).
    pub target_v: [f64; MAX_JOINTS],
    /// Action in the plant's units (nu).
    pub action: [f64; MAX_JOINTS],
    /// Ticks since the policy ran; 0 where it ran in this one.
    pub period_tick: u32,
    /// Log probability of the proposal.
    pub log_prob_proposal: f64,
    /// Log probability of the action.
    pub log_prob_action: f64,
    /// What the projection did.
    pub ledger: LedgerNumbers,
    /// The first active rows, as many as fit; `ledger.active` counts all.
    pub rows: [Row; MAX_ROWS],
    /// The first row that the state was found outside of, counted from 1 as [`Row::row`] is from 0; 0 for none.
    pub outside: u16,
    /// Entries used in `brake`; 0 where no way to stop is stored.
    pub n_brake: u32,
    /// The stored way to stop from the target (nv): the deceleration of each controllable degree of freedom until it stands [rad/s² or
    /// m/s²]; 0 for the others.
    pub brake: [f64; MAX_JOINTS],
}

/// Active rows an output has room for: a box row and two torque rows for each of 32 joints.
pub const MAX_ROWS: usize = 96;

/// A row that holds the target back, as plain numbers.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Row {
    /// Place in [`Kind::ALL`](nearl_constraints::Kind::ALL).
    pub kind: u8,
    /// 0 for the lower, 1 for the upper bound.
    pub side: u8,
    /// Number of the row: the degree of freedom, or beyond those a coupled row.
    pub row: u16,
    /// How hard it is leaned on, see [`nearl_constraints::ActiveRow`].
    pub multiplier: f64,
    /// By how much a soft row is exceeded, as a share of its size.
    pub slack: f64,
}

impl Row {
    /// Names of the bounds by their number.
    pub const SIDES: [&str; 2] = ["lower", "upper"];
}

impl TickOutput {
    /// All numbers zero.
    pub fn zeroed() -> TickOutput {
        let zero = [0.0; MAX_JOINTS];
        TickOutput {
            nu: 0,
            proposal_q: zero,
            proposal_v: zero,
            target_q: zero,
            target_v: zero,
            action: zero,
            period_tick: 0,
            log_prob_proposal: 0.0,
            log_prob_action: 0.0,
            ledger: LedgerNumbers::default(),
            rows: [Row::default(); MAX_ROWS],
            outside: 0,
            n_brake: 0,
            brake: zero,
        }
    }

    /// Takes the decelerations of a stored brake (nv).
    pub fn set_brake(&mut self, decelerations: Option<&[f64]>) {
        let decelerations = decelerations.filter(|b| b.len() <= MAX_JOINTS).unwrap_or_default();
        self.n_brake = decelerations.len() as u32;
        self.brake[..decelerations.len()].copy_from_slice(decelerations);
    }

    /// The decelerations of the stored brake; empty where none is stored.
    pub fn brake(&self) -> &[f64] {
        &self.brake[..(self.n_brake as usize).min(MAX_JOINTS)]
    }

    /// The active rows that fitted.
    pub fn rows(&self) -> &[Row] {
        &self.rows[..(self.ledger.active as usize).min(MAX_ROWS)]
    }
}

/// Leaves a count out of logs that have nothing to say of it, so that they read as those of builds without it.
fn is_zero(count: &u64) -> bool {
    *count == 0
}

/// Counts of the loop since its start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Counters {
    /// Ticks that ended after the next slot was due.
    pub overruns: u64,
    /// Slots left out because of overruns.
    pub skipped: u64,
    /// Ticks without a fresh state within the age limit.
    pub stale: u64,
    /// Ticks that used a state a second time (own clock only).
    pub repeated: u64,
    /// States the loop never saw.
    pub lost_states: u64,
    /// States with numbers that are not finite.
    pub bad_states: u64,
    /// States in which a joint jumped further than it can move.
    pub implausible_states: u64,
    /// States that repeat an older one although the plant should move.
    pub frozen_states: u64,
    /// States that came after a newer one, or twice.
    pub out_of_order: u64,
    /// Ticks that acted on a predicted state.
    pub held: u64,
    /// Ticks the controller refused.
    pub refused: u64,
    /// Ticks in which the projector discarded the proposal and braked.
    pub braked: u64,
    /// Controllers swapped in.
    pub swaps: u64,
    /// Actions that found the ring full.
    pub dropped_actions: u64,
    /// Records that found the ring full.
    pub dropped_records: u64,
    /// Ticks whose raw proposal broke a limit.
    pub raw_violations: u64,
    /// Ticks that began within the limits and whose target broke one.
    pub target_violations: u64,
    /// Ticks that began outside a limit, or on the way to limits that were moved: their targets can only come nearer.
    pub recovering: u64,
    /// Ticks that acted on what no projection has seen: their policy gives actions and proposes no state.
    pub unprojected: u64,
    /// Those of them whose action was kept within limits of its own, or within the forces that the drives' motors have.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub bounded_actions: u64,
    /// Proposals of another process that were taken.
    pub proposals: u64,
    /// Its proposals that a newer one overtook.
    pub overtaken_proposals: u64,
    /// Its proposals of other names or sizes, of another episode, or with numbers that are not finite.
    pub refused_proposals: u64,
    /// Ticks that acted on a proposal older than the age limit.
    pub held_proposals: u64,
    /// Ticks without a usable proposal.
    pub silent_proposer: u64,
    /// Ticks in each mode, by code.
    pub mode_ticks: [u64; Mode::ALL.len()],
}

/// What the state of a tick was worth.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Sensed {
    /// The measured state was acted upon.
    Measured,
    /// A predicted one was.
    Predicted,
    /// There was none: the plant brakes by itself.
    Missing,
}

/// Everything about one tick. Passed by value through a ring; about 11 kB.
#[derive(Clone, Copy, Debug)]
pub struct Record {
    /// Tick of the runtime, from 1.
    pub tick: u64,
    /// When the tick was due: the grid slot, or the stamp of the state it waited for \[ns\].
    pub due: u64,
    /// When it began \[ns\].
    pub begin: u64,
    /// When the action was handed over \[ns\].
    pub end: u64,
    /// Mode of the tick.
    pub mode: Mode,
    /// Why it is not Active.
    pub reason: Reason,
    /// Version of the snapshot in use.
    pub policy_version: u64,
    /// `state` is new in this tick.
    pub fresh: bool,
    /// A state came that was not newer than the one before, and was not used.
    pub ignored: bool,
    /// A controller was swapped in before this tick.
    pub swapped: bool,
    /// Number of the snapshot in use, in the order they were received; 0 for the first.
    pub snapshot: u64,
    /// A stop had been asked for when the tick began.
    pub stop: bool,
    /// What the state was worth.
    pub sensed: Sensed,
    /// A joint that goes elsewhere than its velocity says, once it is found in an episode.
    pub apart: Option<Apart>,
    /// Share of the way to the target that the first motion was given; 1 once it is over.
    pub ramp: f64,
    /// Noise of the proposal, in every entry.
    pub noise: f32,
    /// A proposal of another process came in this tick.
    pub heard: bool,
    /// That proposal; without one that of an earlier tick.
    pub proposal: ProposalMessage,
    /// Age of the proposal acted upon, from the state it was computed from \[ns\]; `u64::MAX` without one.
    pub proposal_age: u64,
    /// The newest state, as measured.
    pub state: StateMessage,
    /// The controller's answer; meaningless if `output.nu` is 0.
    pub output: TickOutput,
    /// Counts up to and with this tick.
    pub counters: Counters,
    /// What a replay can go on from after this tick, at some ticks.
    pub resume: Resume,
}

impl Record {
    pub(crate) fn new() -> Record {
        Record {
            tick: 0,
            due: 0,
            begin: 0,
            end: 0,
            mode: Mode::Hold,
            reason: Reason::None,
            policy_version: 0,
            fresh: false,
            ignored: false,
            swapped: false,
            snapshot: 0,
            stop: false,
            sensed: Sensed::Missing,
            apart: None,
            ramp: 1.0,
            noise: 0.0,
            heard: false,
            proposal: ProposalMessage::zeroed(),
            proposal_age: u64::MAX,
            state: StateMessage::zeroed(),
            output: TickOutput::zeroed(),
            counters: Counters::default(),
            resume: Resume::none(),
        }
    }
}
