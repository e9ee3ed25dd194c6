//! What crosses between plant, runtime and trainer: plain numbers with a capacity fixed at compile time.
//!
//! | topic | from -> to | type |
//! |---|---|---|
//! | `state` | plant -> all on this host, the newest alone | [`StateMessage`] |
//! | `action` | runtime -> plant, the newest alone | [`ActionMessage`] |
//! | `robot` | plant -> all | [`RobotMessage`] |
//! | `tally` | plant -> all | [`TallyMessage`] |
//! | `transition` | runtime -> trainer | [`TransitionMessage`] |
//! | `snapshot` | trainer -> runtime | bytes with [`SnapshotHeader`] |
//! | `receipt` | runtime -> trainer, operator | [`ReceiptMessage`] |
//! | `limits` | operator -> runtime | [`LimitsMessage`] |
//! | `health` | runtime -> anyone | [`HealthMessage`] |
//! | `proposal` | proposer -> runtime, the newest alone | [`ProposalMessage`] |
//! | `asked` | runtime -> proposer | [`AskedMessage`] |
//! | `tick` | runtime -> viewers | [`TickMessage`] |
//! | `rows` | runtime -> viewers | [`RowsMessage`] |

use super::schema::message;

/// Capacity of q, v and the action vector in a message.
pub const MAX_JOINTS: usize = 64;
/// Capacity of the observation vector in a message.
pub const MAX_OBS: usize = 128;
/// Capacity of the joint name list in [`RobotMessage`] \[bytes\].
pub const MAX_NAMES: usize = 2048;
/// Capacity of the list of names in an [`AskedMessage`] \[bytes\].
pub const MAX_ASKED: usize = 4096;
/// Active rows a [`TickMessage`] has room for.
pub const MAX_ACTIVE: usize = 96;
/// Capacity of the row names in a [`RowsMessage`] \[bytes\].
pub const MAX_ROW_NAMES: usize = 8192;
/// Rows whose kind a [`RowsMessage`] has room for.
pub const MAX_KINDS: usize = 512;
/// Capacity of the task's name in a [`RowsMessage`] \[bytes\].
pub const MAX_TASK: usize = 128;
/// Capacity of the text in a [`LimitsMessage`] \[bytes\].
pub const MAX_MOVED: usize = 8192;
/// Capacity of the text in a [`ReceiptMessage`] \[bytes\].
pub const MAX_TEXT: usize = 1024;

/// This state begins an episode. For learning; the loop goes by the episode's number.
pub const STATE_RESET: u32 = 1;
/// The episode ended in a terminal state.
pub const STATE_TERMINATED: u32 = 2;
/// The episode was cut by a time limit.
pub const STATE_TRUNCATED: u32 = 4;
/// The plant braked by itself last, and applied no action; [`Exchange`](crate::link::Exchange) and [`PlantRunner`](crate::link::PlantRunner) set it.
pub const STATE_BRAKED: u32 = 8;
/// The plant waits for the action of every state (no real-time grid).
pub const ROBOT_LOCKSTEP: u32 = 1;
/// The plant states its limits by number; infinite is none.
pub const ROBOT_LIMITS: u32 = 2;

/// What is proposed: entries of the state.
pub const PROPOSES_STATES: u32 = 0;
/// What is proposed: commands of the joints.
pub const PROPOSES_ACTIONS: u32 = 1;

/// Limits that a plant may measure, by their place in a [`TallyMessage`].
pub const METERS: [&str; 4] = ["position", "velocity", "acceleration", "torque"];

message! {
    /// One sample of the plant, published on its time grid.
    StateMessage, "state", version 2 {
        /// Tick of the plant since its start.
        tick: u64,
        /// Grid time of the tick, monotonic \[ns\].
        due: u64,
        /// Time of the plant's own clock (simulated time in MuJoCo) \[s\].
        time: f64,
        /// Entries used in `q`.
        nq: u32,
        /// Entries used in `v`.
        nv: u32,
        /// Entries used in `applied`.
        nu: u32,
        /// Entries used in `obs`.
        n_obs: u32,
        /// Number of the episode, from 0.
        episode: u64,
        /// Tick within the episode.
        episode_tick: u64,
        /// Bits `STATE_*`.
        bits: u32,
        /// Entries of the last action the plant had to saturate.
        saturated: u32,
        /// Ticks the plant held the last action because none came in time.
        late: u64,
        /// Times the plant's watchdog braked.
        watchdog: u64,
        /// Configuration.
        q: [f64; MAX_JOINTS],
        /// Velocity.
        v: [f64; MAX_JOINTS],
        /// Action the plant applied in the last step, after saturation.
        applied: [f64; MAX_JOINTS],
        /// Observation of the policy.
        obs: [f64; MAX_OBS],
    }
}

impl StateMessage {
    /// Sets or clears [`STATE_BRAKED`].
    pub(crate) fn set_braked(&mut self, braked: bool) {
        self.bits = self.bits & !STATE_BRAKED | if braked { STATE_BRAKED } else { 0 };
    }
}

message! {
    /// The action for one state.
    ActionMessage, "action", version 2 {
        /// Tick of the runtime.
        tick: u64,
        /// `header.seq` of the state it was computed from.
        state_seq: u64,
        /// `header.epoch` of that state.
        state_epoch: u64,
        /// [`crate::rt::Mode`] as a number.
        mode: u32,
        /// Entries used in `action`; 0 where the loop has none to give, in Hold or without a state or a model to brake by: the plant brakes by itself.
        nu: u32,
        /// Version of the snapshot that computed it.
        policy_version: u64,
        /// Action in the plant's units.
        action: [f64; MAX_JOINTS],
    }
}

message! {
    /// What the plant is; a snapshot for another robot is refused against it.
    RobotMessage, "robot", version 2, beside StateMessage, beside ActionMessage, buffer 1, history 1, subscribers 16 {
        /// Hash of the joint names in order, see [`crate::link::hash_names`].
        joints: u64,
        /// Hash of the observation entry names in order.
        observation: u64,
        /// Hash of the limits the plant enforces.
        limits: u64,
        /// Control period \[s\].
        dt: f64,
        /// Number of configuration entries.
        nq: u32,
        /// Number of velocity entries.
        nv: u32,
        /// Number of action entries.
        nu: u32,
        /// Number of observation entries.
        n_obs: u32,
        /// Bits `ROBOT_*`.
        bits: u32,
        /// Process that runs the plant.
        pid: u32,
        /// Lowest position the plant allows, by velocity entry; this and the next four count only with `ROBOT_LIMITS` [rad or m].
        q_lower: [f64; MAX_JOINTS],
        /// Highest position [rad or m].
        q_upper: [f64; MAX_JOINTS],
        /// Largest speed [rad/s or m/s].
        velocity: [f64; MAX_JOINTS],
        /// Largest acceleration [rad/s² or m/s²].
        acceleration: [f64; MAX_JOINTS],
        /// Largest motor force [N m or N].
        effort: [f64; MAX_JOINTS],
        /// Joint names, each followed by a line break, as UTF-8, zero padded.
        names: [u8; MAX_NAMES],
    }
}

message! {
    /// What the plant counted since its start, a few times a second and when its runtime leaves: how its states kept the limits, and what
    /// its episodes earned where it has any. No tick needs it.
    TallyMessage, "tally", version 1, buffer 1, history 1, subscribers 16 {
        /// Tick of the plant up to which it counted.
        tick: u64,
        /// Bit i is set if the plant measures the limit `METERS[i]`; the numbers of the others say nothing.
        measured: u64,
        /// Ticks that broke a limit, by `METERS`.
        violations: [u64; 4],
        /// Largest excess over a limit seen so far [rad or m, 1/s, 1/s2, N m], by `METERS`.
        worst: [f64; 4],
        /// Episodes finished.
        episodes: u64,
        /// Sum of rewards of the running episode; 0 for a plant that earns none.
        episode_return: f64,
        /// Return of the last finished episode, 0 before the first.
        last_return: f64,
    }
}

impl TallyMessage {
    /// Fills in what the meter of `METERS[i]` found.
    pub fn measure(&mut self, i: usize, violations: u64, worst: f64) {
        self.measured |= 1 << i;
        (self.violations[i], self.worst[i]) = (violations, worst);
    }

    /// Name, ticks outside and largest excess of each limit; `None` for one that the plant does not measure.
    pub fn meters(&self) -> [(&'static str, Option<(u64, f64)>); 4] {
        std::array::from_fn(|i| {
            let found = (self.measured >> i & 1 == 1).then_some((self.violations[i], self.worst[i]));
            (METERS[i], found)
        })
    }
}

/// What the ledger of a tick says, as plain numbers.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LedgerNumbers {
    /// Status code of the projection.
    pub status: u32,
    /// Rung of the ladder that answered.
    pub rung: u32,
    /// Active rows.
    pub active: u32,
    /// Solver iterations.
    pub iterations: u32,
    /// Limits the raw proposal broke.
    pub raw_violations: u32,
    /// Limits the projected target breaks, by the independent check.
    pub target_violations: u32,
    /// Limits that the tick began outside.
    pub outside: u64,
    /// Weighted distance between proposal and target.
    pub moved: f64,
    /// Largest slack of a soft row.
    pub slack: f64,
    /// Residual of the independent check.
    pub residual: f64,
    /// Time of the projection \[ns\].
    pub duration: u64,
}

impl LedgerNumbers {
    /// Whether the tick began within the limits and its target broke one: what `target_violations` of many ticks counts.
    pub fn target_breaks(&self) -> bool {
        self.target_violations > 0 && self.outside == 0
    }
}

message! {
    /// One tick as the trainer learns from it.
    TransitionMessage, "transition", version 4, buffer 1024, history 0, subscribers 2 {
        /// Tick of the runtime.
        tick: u64,
        /// `header.epoch` of the plant.
        state_epoch: u64,
        /// `header.seq` of the state.
        state_seq: u64,
        /// `header.seq` of the state that followed; more than one ahead means states were missed.
        next_state_seq: u64,
        /// Version of the snapshot that acted.
        policy_version: u64,
        /// Number of the episode.
        episode: u64,
        /// Bits `STATE_*` of the next state.
        next_bits: u32,
        /// [`crate::rt::Mode`] as a number.
        mode: u32,
        /// Entries used in q.
        nq: u32,
        /// Entries used in v.
        nv: u32,
        /// Entries used in `action`.
        nu: u32,
        /// Entries used in `obs`.
        n_obs: u32,
        /// 1 if the noise of the tick was drawn from `explore`, 0 if there was none.
        explores: u32,
        /// Ticks since the policy ran; 0 where it ran in this one.
        period_tick: u32,
        /// Seed of the noise: [`Noise::draw`](crate::Noise::draw) with it and the last tick in which the policy ran gives the noise again.
        explore: u64,
        /// Time of the plant's own clock \[s\].
        time: f64,
        /// Log probability of the proposal.
        log_prob_proposal: f64,
        /// Log probability of the action.
        log_prob_action: f64,
        /// Projection of the tick.
        ledger: LedgerNumbers,
        /// Configuration.
        q: [f64; MAX_JOINTS],
        /// Velocity.
        v: [f64; MAX_JOINTS],
        /// Proposed configuration.
        proposal_q: [f64; MAX_JOINTS],
        /// Proposed velocity.
        proposal_v: [f64; MAX_JOINTS],
        /// Projected configuration.
        target_q: [f64; MAX_JOINTS],
        /// Projected velocity.
        target_v: [f64; MAX_JOINTS],
        /// Action.
        action: [f64; MAX_JOINTS],
        /// Observation.
        obs: [f64; MAX_OBS],
    }
}

message! {
    /// Header that travels with the bytes of a snapshot.
    SnapshotHeader, "snapshot", version 1, buffer 1, history 1, subscribers 4 {
        /// Version given by the trainer; must grow.
        version: u64,
        /// Number of bytes.
        length: u64,
    }
}

impl Default for SnapshotHeader {
    fn default() -> Self {
        <Self as super::Message>::zeroed()
    }
}

message! {
    /// Where an operator moves the limits of the loop.
    LimitsMessage, "limits", version 1, buffer 4, history 0, subscribers 2 {
        /// Counts the orders of one operator upwards.
        version: u64,
        /// Bytes used in `text`.
        length: u64,
        /// [`Moved`](nearl_constraints::Moved) as JSON.
        text: [u8; MAX_MOVED],
    }
}

message! {
    /// The runtime's reply to one snapshot, or to limits that were moved.
    ReceiptMessage, "receipt", version 2, buffer 8, history 1, subscribers 8 {
        /// `header.epoch` of the trainer that sent the snapshot, or of the operator.
        trainer_epoch: u64,
        /// Version of the snapshot replied to.
        version: u64,
        /// First tick of the new controller if accepted.
        tick: u64,
        /// [`crate::link::Verdict`] as a number.
        verdict: u32,
        /// Bytes used in `text`.
        length: u32,
        /// One sentence.
        text: [u8; MAX_TEXT],
    }
}

message! {
    /// What a process beside the loop proposes in place of its policy.
    ProposalMessage, "proposal", version 1 {
        /// `header.epoch` of the state it was computed from.
        state_epoch: u64,
        /// `header.seq` of that state.
        state_seq: u64,
        /// `header.stamp` of that state \[ns\]: its age counts from there.
        state_stamp: u64,
        /// [`hash_names`](crate::link::hash_names) of what is proposed, in order.
        names: u64,
        /// `PROPOSES_*`.
        kind: u32,
        /// Entries used in `values`.
        n: u32,
        /// The proposal.
        values: [f64; MAX_OBS],
    }
}

message! {
    /// What a loop asks of its proposer, and what has become of the proposals so far; about ten times a second.
    AskedMessage, "asked", version 1, beside ProposalMessage, buffer 1, history 1, subscribers 8 {
        /// `PROPOSES_*`.
        kind: u32,
        /// Number of entries.
        n: u32,
        /// Hash of their names in order.
        hash: u64,
        /// Control period \[s\].
        dt: f64,
        /// Control ticks in which a proposed state is to be reached.
        policy_every: u64,
        /// Age of a proposal from which on it is held \[s\].
        age_limit: f64,
        /// So long is it held before the loop brakes \[s\].
        hold: f64,
        /// Proposals taken.
        taken: u64,
        /// Proposals that a newer one overtook before the loop read them.
        overtaken: u64,
        /// Proposals refused: of other names or sizes, of another episode, with numbers that are not finite.
        refused: u64,
        /// Ticks that acted on a proposal older than the age limit.
        held: u64,
        /// Ticks without a usable proposal.
        silent: u64,
        /// [`crate::rt::Mode`] as a number.
        mode: u32,
        /// Fills the line.
        reserved: u32,
        /// Names of what is asked for, each followed by a line break, as UTF-8, zero padded.
        names: [u8; MAX_ASKED],
    }
}

message! {
    /// How the loop is doing, about ten times a second.
    HealthMessage, "health", version 3, buffer 2, history 1, subscribers 8 {
        /// Ticks so far.
        tick: u64,
        /// [`crate::rt::Mode`] as a number.
        mode: u32,
        /// Process of the runtime.
        pid: u32,
        /// Version of the snapshot in use.
        policy_version: u64,
        /// Ticks for which the loop took longer than a period, from the state (on its own grid: from the slot) to the action.
        overruns: u64,
        /// Slots left out because of overruns.
        skipped: u64,
        /// Ticks without a fresh state.
        stale: u64,
        /// States refused (not finite, wrong sizes).
        refused_states: u64,
        /// States lost between plant and loop.
        lost_states: u64,
        /// Controllers swapped in.
        swaps: u64,
        /// Snapshots refused.
        refused_snapshots: u64,
        /// Snapshots taken back because the robot no longer reached its targets.
        rolled_back: u64,
        /// [`crate::rt::Reason`] as a number.
        reason: u32,
        /// 1 while no new snapshot came for longer than `--snapshot-age`.
        aged: u32,
        /// Flight log records dropped.
        log_drops: u64,
        /// Ticks whose raw proposal broke a limit.
        raw_violations: u64,
        /// Ticks that began within the limits and whose target broke one.
        target_violations: u64,
        /// Wake-up latency p50, p99, p99.9, max \[ns\].
        wake: [u64; 4],
        /// Compute time p50, p99, p99.9, max \[ns\].
        compute: [u64; 4],
    }
}

message! {
    /// What a tick did, for those who look on: what holds the target back and how hard, and the way to stop that is stored.
    TickMessage, "tick", version 1, buffer 32, history 0, subscribers 4 {
        /// Tick of the runtime.
        tick: u64,
        /// When it was due, began, and handed its action over \[ns\].
        due: u64,
        /// See `due`.
        begin: u64,
        /// See `due`.
        end: u64,
        /// Control period: the next tick is due that long after this one \[ns\].
        period: u64,
        /// Version of the snapshot in use.
        policy_version: u64,
        /// Number of that snapshot, as in a [`RowsMessage`].
        snapshot: u64,
        /// Number of the episode.
        episode: u64,
        /// Ticks so far for which the loop took longer than a period, from the state (on its own grid: from the slot) to the action.
        overruns: u64,
        /// Ticks so far whose raw proposal broke a limit.
        raw_violations: u64,
        /// Ticks so far that began within the limits and whose target broke one.
        target_violations: u64,
        /// [`crate::rt::Mode`] as a number.
        mode: u32,
        /// [`crate::rt::Reason`] as a number.
        reason: u32,
        /// Entries used in q.
        nq: u32,
        /// Entries used in v.
        nv: u32,
        /// Entries used in `action`; 0 where the plant brakes by itself, and then proposal, target, ledger and rows say nothing.
        nu: u32,
        /// Entries used in the arrays of the active rows; `ledger.active` counts all.
        n_active: u32,
        /// Entries used in `brake`; 0 where no way to stop is stored.
        n_brake: u32,
        /// Fills the line.
        reserved: u32,
        /// Projection of the tick.
        ledger: LedgerNumbers,
        /// Measured configuration.
        q: [f64; MAX_JOINTS],
        /// Measured velocity.
        v: [f64; MAX_JOINTS],
        /// Proposed configuration.
        proposal_q: [f64; MAX_JOINTS],
        /// Proposed velocity.
        proposal_v: [f64; MAX_JOINTS],
        /// Projected configuration.
        target_q: [f64; MAX_JOINTS],
        /// Projected velocity.
        target_v: [f64; MAX_JOINTS],
        /// Action.
        action: [f64; MAX_JOINTS],
        /// Deceleration of each degree of freedom until it stands: the stored way to stop [rad/s² or m/s²].
        brake: [f64; MAX_JOINTS],
        /// Number of each active row, as [`RowsMessage`] names them.
        rows: [u32; MAX_ACTIVE],
        /// Its kind, place in [`Kind::ALL`](nearl_constraints::Kind::ALL).
        kinds: [u32; MAX_ACTIVE],
        /// 0 for its lower, 1 for its upper bound.
        sides: [u32; MAX_ACTIVE],
        /// How hard it is leaned on, see [`nearl_constraints::ActiveRow`].
        multipliers: [f64; MAX_ACTIVE],
        /// By how much a soft row is exceeded, as a share of its size.
        slacks: [f64; MAX_ACTIVE],
    }
}

message! {
    /// What the snapshot in use was made for, what its rows are of and which limits it keeps, about ten times a second.
    RowsMessage, "rows", version 2, buffer 1, history 1, subscribers 4 {
        /// Number of the snapshot, in the order they were received.
        snapshot: u64,
        /// Bytes used in `names`.
        length: u64,
        /// Bytes used in `task`.
        task_length: u64,
        /// Entries used in `kinds`.
        n_kinds: u64,
        /// Degrees of freedom whose limits are given; they are those of the first rows. 0 where none are known.
        n_limits: u64,
        /// Lowest position that the projection allows, infinite where there is no limit; as the next four [rad or m].
        q_lower: [f64; MAX_JOINTS],
        /// Highest position [rad or m].
        q_upper: [f64; MAX_JOINTS],
        /// Largest speed [rad/s or m/s].
        velocity: [f64; MAX_JOINTS],
        /// Largest acceleration [rad/s² or m/s²].
        acceleration: [f64; MAX_JOINTS],
        /// Largest motor force [N m or N].
        effort: [f64; MAX_JOINTS],
        /// Kind of each row, one more than its place in [`Kind::ALL`](nearl_constraints::Kind::ALL); 0 for a row of a single joint.
        kinds: [u8; MAX_KINDS],
        /// Name of the task, as UTF-8, zero padded; cut where it is longer.
        task: [u8; MAX_TASK],
        /// Row names by number, each followed by a line break, as UTF-8; those beyond the capacity are missing.
        names: [u8; MAX_ROW_NAMES],
    }
}
