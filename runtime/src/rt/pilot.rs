//! The controller of a snapshot in the loop: states in, [`Controller::update`], numbers out.

mod builder;

use crate::codes::LedgerStatus;
use crate::controller::{Controller, Noise, Output, State};
use crate::link::{
    LedgerNumbers, MAX_OBS, Message, PROPOSES_ACTIONS, PROPOSES_STATES, RobotMessage, RowsMessage,
    StateMessage, Verdict, hash_names,
};
use crate::rt::brake::Brake;
use crate::rt::tick::{LoopController, MAX_ROWS, Outcome, Question, Refusal, Row, TickOutput};
use crate::rt::watch::{Watched, WatchedJoint};
use crate::snapshot::{Manifest, PolicyKind, Snapshot, SnapshotError};
pub use builder::{Asked, PilotBuilder, describe};
use builder::{compare, compare_limits, describe_controller};
use nearl_constraints::description::JointKind;
use nearl_constraints::{BrakeReason, Entry, Joint, Kind, Ledger, LimitSet, RefuseReason, Side, Status};
use std::cell::Cell;
use std::collections::BTreeMap;

/// A controller with its inputs and outputs, checked against the plant it drives.
pub struct Pilot {
    controller: Controller,
    brake: Option<Brake>,
    state: State,
    noise: Noise,
    out: Output,
    /// Which proposed entry is which (n_state).
    entries: Vec<Entry>,
    /// What each observation entry measures (n_obs).
    observed: Vec<Entry>,
    /// Joints whose samples are checked: degree of freedom, configuration index, largest speed V [rad/s or m/s].
    checked: Vec<(usize, usize, f64)>,
    /// Those of them whose measured velocity is reckoned with: the others go on from what they were sent.
    reckoned: Vec<(usize, usize, f64)>,
    /// Joints with a range: degree of freedom, configuration index, and the positions of which none is outside [rad or m].
    places: Vec<(usize, usize, [f64; 2])>,
    /// The policy proposes states; a direct one without a guard gives actions only.
    proposes: bool,
    /// A number for the limits of the joints: equal limits, equal numbers.
    limits: f64,
    /// Scratch, with room for what is shared.
    memory: Vec<f64>,
    /// A tick was begun whose answer is not taken yet: the brake has the memory from before it.
    tried: Cell<bool>,
    /// Ticks since the policy ran.
    period_tick: u32,
    /// What another process may propose: kind, hash of the names, their number.
    takes: Option<Asked>,
    /// Name of the task.
    task: String,
}

impl Pilot {
    /// What it takes from another process in place of its policy; none where nothing projects that.
    pub(crate) fn asks(&self) -> Option<Asked> {
        self.takes
    }

    /// Builds and validates the controller of `snapshot` for `robot`. Allocates and parses the robot file.
    pub fn new(snapshot: &Snapshot, robot: &RobotMessage) -> Result<Pilot, Refusal> {
        Pilot::within(snapshot, robot, &PilotBuilder::default())
    }

    /// [`Pilot::new`] of a snapshot that has to fit what is fixed at the start of a loop. Another robot's snapshot is refused as such first.
    fn within(snapshot: &Snapshot, robot: &RobotMessage, fixed: &PilotBuilder) -> Result<Pilot, Refusal> {
        let refuse = |error: SnapshotError| Refusal { verdict: Verdict::of(&error), text: error.to_string() };
        let mut controller = Controller::new(snapshot).map_err(refuse)?;
        compare(&describe_controller(&controller, &snapshot.manifest), robot)?;
        if let Some(meaning) = &fixed.meaning {
            meaning.admit(&snapshot.manifest)?;
        }
        if let Some(pinned) = &fixed.pinned {
            pinned.admit(&snapshot.manifest)?;
        }
        compare_limits(&controller, robot)?;
        let kind = match snapshot.manifest.policy {
            PolicyKind::Direct => PROPOSES_ACTIONS,
            _ => PROPOSES_STATES,
        };
        let checked = checked(&controller);
        let (mut reckoned, projector) = (checked.clone(), controller.projector());
        reckoned.retain(|joint| !projector.follows(joint.0));
        let names = controller.given_names().filter(|names| names.len() <= MAX_OBS);
        let layout = controller.layout();
        Ok(Pilot {
            takes: names.map(|names| Asked(kind, hash_names(&names), names.len())),
            brake: Brake::new(&snapshot.manifest).map_err(refuse)?,
            state: controller.state(),
            noise: controller.noise(),
            out: controller.output(),
            entries: (0..layout.n_state()).map(|k| layout.state_entry(k)).collect(),
            observed: layout.entries().to_vec(),
            checked,
            reckoned,
            places: places(&controller),
            proposes: snapshot.manifest.proposes(),
            limits: number_of(controller.limits()),
            memory: controller.memory(),
            tried: Cell::new(false),
            period_tick: 0,
            task: snapshot.manifest.task.name.clone(),
            controller,
        })
    }

    /// What each controllable joint is commanded, in words with units, by its name.
    pub(crate) fn commands(&self, manifest: &Manifest) -> BTreeMap<String, String> {
        let (model, controllable) = (self.controller.model(), self.controller.layout().controllable());
        // Refused before, where they cannot be had.
        let drives = manifest.task.command.drives(model, controllable).unwrap_or_default();
        controllable.iter().filter_map(|&i| Some((model.dof_name(i), drives.get(i)?.to_string()))).collect()
    }

    /// Controller and brake have projectors of their own; what one verified, the other may count on.
    fn share(&mut self, from_brake: bool) {
        let Pilot { brake: Some(brake), controller, memory, .. } = self else { return };
        let (brake, controller) = (brake.projector(), controller.projector());
        let (from, to) = if from_brake { (brake, controller) } else { (controller, brake) };
        memory.clear();
        from.write_memory(memory);
        to.set_memory(memory);
    }

    fn write(&self, output: &mut TickOutput) {
        let (state, out) = (&self.state, &self.out);
        let (nq, nv) = (state.q.len(), state.v.len());
        output.set_brake(self.controller.stored_brake());
        output.nu = out.action.len() as u32;
        output.action[..out.action.len()].copy_from_slice(&out.action);
        output.period_tick = self.period_tick;
        output.log_prob_proposal = out.log_prob_proposal;
        output.log_prob_action = out.log_prob_action;
        for q in [&mut output.proposal_q, &mut output.target_q] {
            q[..nq].copy_from_slice(&state.q);
        }
        for v in [&mut output.proposal_v, &mut output.target_v] {
            v[..nv].copy_from_slice(&state.v);
        }
        output.ledger = self.without_projection();
        if self.proposes {
            output.target_q[..nq].copy_from_slice(&out.next.q);
            output.target_v[..nv].copy_from_slice(&out.next.v);
            for (entry, value) in self.entries.iter().zip(&out.proposal) {
                match *entry {
                    Entry::Position { idx_q, .. } => output.proposal_q[idx_q] = *value,
                    Entry::Velocity { dof } => output.proposal_v[dof] = *value,
                    Entry::Other => {}
                }
            }
            output.ledger = numbers(&out.next.ledger);
            write_rows(&out.next.ledger, output);
        }
    }
}

impl Pilot {
    /// The ledger of a tick in which nothing was projected: what was kept of the action's own limits, where it has any.
    fn without_projection(&self) -> LedgerNumbers {
        let (ledger, duration) = (&self.out.next.ledger, self.out.duration_ns);
        if !self.controller.bounds_actions() {
            let status = LedgerStatus::NotProjected.number();
            return LedgerNumbers { status, duration, ..LedgerNumbers::default() };
        }
        LedgerNumbers {
            status: LedgerStatus::ActionsBounded.number(),
            raw_violations: ledger.raw_violations.other,
            target_violations: ledger.target_violations.other,
            moved: ledger.moved,
            duration,
            ..LedgerNumbers::default()
        }
    }
}

/// Joints of one degree of freedom whose speed is limited.
fn checked(controller: &Controller) -> Vec<(usize, usize, f64)> {
    let (limits, layout) = (controller.limits(), controller.layout());
    let joints = controller.model().joints().iter().filter(|j| j.nv == 1);
    joints
        .filter(|j| layout.controllable().contains(&j.idx_v) && limits.velocity[j.idx_v].is_finite())
        .map(|j| (j.idx_v, j.idx_q, limits.velocity[j.idx_v]))
        .collect()
}

/// Where joints may stand where an episode begins: outside of their range by as much as it is wide, and by half a radian or metre.
fn places(controller: &Controller) -> Vec<(usize, usize, [f64; 2])> {
    let (model, layout) = (controller.model(), controller.layout());
    let place = |joint: &Joint| {
        let (lower, upper) =
            (model.lower_position_limit()[joint.idx_q], model.upper_position_limit()[joint.idx_q]);
        let away = (upper - lower).max(0.5);
        away.is_finite().then_some((joint.idx_v, joint.idx_q, [lower - away, upper + away]))
    };
    let joints = model.joints().iter().filter(|j| j.nv == 1 && j.nq == 1);
    joints.filter(|j| layout.controllable().contains(&j.idx_v)).filter_map(place).collect()
}

/// The low half of a hash of the limits.
fn number_of(limits: &LimitSet) -> f64 {
    let mut hash = blake3::Hasher::new();
    for values in [
        &limits.q_lower,
        &limits.q_upper,
        &limits.velocity,
        &limits.acceleration,
        &limits.braking,
        &limits.effort,
    ] {
        for value in values {
            hash.update(&value.to_le_bytes());
        }
    }
    let bytes = hash.finalize();
    f64::from(u32::from_le_bytes([0, 1, 2, 3].map(|k| bytes.as_bytes()[k])))
}

fn write_rows(ledger: &Ledger, output: &mut TickOutput) {
    output.outside = ledger.outside.first().map_or(0, |row| u16::try_from(row + 1).unwrap_or(u16::MAX));
    for (row, active) in output.rows.iter_mut().zip(ledger.active.iter().take(MAX_ROWS)) {
        let side = u8::from(active.side == Side::Upper);
        let (kind, number) = (active.kind as u8, active.row as u16);
        *row = Row { kind, side, row: number, multiplier: active.multiplier, slack: active.slack };
    }
}

impl LoopController for Pilot {
    fn version(&self) -> u64 {
        self.controller.version()
    }

    fn tick(&mut self, state: &StateMessage, output: &mut TickOutput) -> Outcome {
        self.state.q.copy_from_slice(state.q());
        self.state.v.copy_from_slice(state.v());
        self.state.obs.copy_from_slice(state.obs());
        // What softens this tick, or brakes in its place, knows of the tick before and not of this one's target.
        self.share(false);
        self.tried.set(true);
        let status = self.controller.update(&self.state, &self.noise, &mut self.out);
        self.period_tick = if self.out.policy_tick { 0 } else { self.period_tick + 1 };
        self.write(output);
        if self.proposes { outcome(status) } else { refused_or_acted(status) }
    }

    fn brake(&mut self, state: &StateMessage, output: &mut TickOutput) -> Outcome {
        if !self.tried.get() {
            self.share(false);
        }
        let Some(brake) = &mut self.brake else { return Outcome::Refused };
        let (nq, nv) = (state.q().len(), state.v().len());
        let (status, action) = brake.update(state.q(), state.v());
        output.nu = action.len() as u32;
        output.action[..action.len()].copy_from_slice(action);
        (output.log_prob_proposal, output.log_prob_action) = (0.0, 0.0);
        for q in [&mut output.proposal_q, &mut output.target_q] {
            q[..nq].copy_from_slice(&brake.target.q);
        }
        for v in [&mut output.proposal_v, &mut output.target_v] {
            v[..nv].copy_from_slice(&brake.target.v);
        }
        output.ledger = numbers(&brake.target.ledger);
        write_rows(&brake.target.ledger, output);
        output.set_brake(brake.projector().stored_brake());
        self.share(true);
        outcome(status)
    }

    fn reset(&mut self) {
        self.controller.reset();
        self.share(false);
    }

    fn lose(&mut self) {
        self.controller.lose();
        self.share(false);
    }

    fn recall(&mut self) {
        self.controller.recall();
        self.share(false);
    }

    fn miss(&mut self, periods: u64) {
        self.controller.projector().miss(periods);
        self.share(false);
    }

    fn save_memory(&self, memory: &mut Vec<f64>) {
        self.tried.set(false);
        memory.clear();
        memory.push(self.limits);
        self.controller.write_memory(memory);
    }

    fn is_memory_whole(&self) -> bool {
        self.controller.is_memory_whole()
    }

    fn row_names(&self) -> Vec<String> {
        self.controller.row_names()
    }

    fn told(&self) -> Box<RowsMessage> {
        let mut told = Box::new(RowsMessage::zeroed());
        told.set_row_names(&self.row_names());
        told.set_row_kinds(&self.controller.row_kinds());
        told.set_task_name(&self.task);
        told.set_limits(self.controller.limits());
        told
    }

    fn watched(&self) -> Watched {
        let (model, limits) = (self.controller.model(), self.controller.limits());
        let controllable = self.controller.layout().controllable();
        let all = model.description().bodies.iter().flat_map(|body| &body.joints);
        let slides: Vec<&str> = all.filter(|j| j.kind == JointKind::Slide).map(|j| j.name.as_str()).collect();
        let joints = model.joints().iter().filter(|j| j.nq == 1 && j.nv == 1);
        let joints = joints
            .filter(|j| self.proposes && controllable.contains(&j.idx_v))
            .map(|j| WatchedJoint {
                joint: j.name.clone(),
                dof: j.idx_v,
                idx_q: j.idx_q,
                length: if slides.contains(&j.name.as_str()) { "m" } else { "rad" },
                lower: limits.q_lower[j.idx_v],
                upper: limits.q_upper[j.idx_v],
                velocity: limits.velocity[j.idx_v],
            })
            .collect();
        let of_row = |(name, kind): (String, Option<Kind>)| match kind {
            Some(kind) => format!("limit '{name}' of kind {}", kind.name()),
            None => format!("joint '{name}', which cannot stop in front of its limit"),
        };
        let rows = self.row_names().into_iter().zip(self.controller.row_kinds()).map(of_row).collect();
        Watched { joints, rows }
    }

    fn load_memory(&mut self, memory: &[f64]) {
        let Some((limits, memory)) = memory.split_first() else { return };
        self.controller.take_memory(memory);
        // A way to stop within other limits is none within these.
        if *limits != self.limits {
            self.controller.projector().forget_brake();
        }
        self.share(false);
    }

    fn question(&self) -> Option<Question> {
        let Asked(kind, ..) = self.takes?;
        let policy_every = self.controller.policy_every();
        Some(Question { kind, names: self.controller.given_names()?, policy_every })
    }

    fn takes(&self, kind: u32, names: u64, n: usize) -> bool {
        self.takes == Some(Asked(kind, names, n))
    }

    fn give(&mut self, values: &[f64]) {
        self.controller.give(values);
    }

    fn set_noise(&mut self, noise: f32) {
        self.noise.proposal.fill(noise);
    }

    fn explore(&mut self, seed: u64, tick: u64) {
        if self.controller.begins_period() {
            self.noise.draw(seed, tick);
        }
    }

    fn predict(&self, state: &mut StateMessage, output: &TickOutput) {
        (state.q, state.v) = (output.target_q, output.target_v);
        let count = self.observed.len().min(state.obs.len());
        for (value, entry) in state.obs[..count].iter_mut().zip(&self.observed) {
            match *entry {
                Entry::Position { idx_q, .. } => *value = output.target_q[idx_q],
                Entry::Velocity { dof } => *value = output.target_v[dof],
                Entry::Other => {}
            }
        }
    }

    fn speeds(&self) -> &[(usize, usize, f64)] {
        &self.reckoned
    }

    /// With `S = max(V, |v|)` of the old state: `|v'| > jump S`, or `|q' - q| > jump age max(S, |v'|)`.
    fn implausible(&self, old: &StateMessage, new: &StateMessage, age: f64, jump: f64) -> Option<usize> {
        let jumped = |&&(dof, idx_q, limit): &&(usize, usize, f64)| {
            let speed = limit.max(old.v[dof].abs());
            let way = (new.q[idx_q] - old.q[idx_q]).abs();
            new.v[dof].abs() > jump * speed || way > jump * age * speed.max(new.v[dof].abs())
        };
        self.checked.iter().find(jumped).map(|joint| joint.0)
    }

    fn elsewhere(&self, state: &StateMessage) -> Option<usize> {
        let is_outside = |(_, idx_q, [lower, upper]): &&(usize, usize, [f64; 2])| {
            !(*lower..=*upper).contains(&state.q[*idx_q])
        };
        self.places.iter().find(is_outside).map(|place| place.0)
    }

    fn soften(&mut self, state: &StateMessage, share: f64, output: &mut TickOutput) {
        let Some(brake) = &mut self.brake else { return };
        let (nq, nv) = (state.q().len(), state.v().len());
        let (status, action) =
            brake.approach(state.q(), state.v(), &output.target_q[..nq], &output.target_v[..nv], share);
        if outcome(status) != Outcome::Acted {
            return;
        }
        output.action[..action.len()].copy_from_slice(action);
        output.target_q[..nq].copy_from_slice(&brake.target.q);
        output.target_v[..nv].copy_from_slice(&brake.target.v);
        let raw_violations = output.ledger.raw_violations;
        output.ledger = LedgerNumbers { raw_violations, ..numbers(&brake.target.ledger) };
        write_rows(&brake.target.ledger, output);
        output.set_brake(brake.projector().stored_brake());
        self.share(true);
    }
}

/// A direct policy projects nothing, so its ledger can only refuse.
fn refused_or_acted(status: Status) -> Outcome {
    if matches!(status, Status::Refused(_)) { Outcome::Refused } else { Outcome::Acted }
}

/// A braked target is checked and may be applied; a refused one may not.
fn outcome(status: Status) -> Outcome {
    match status {
        Status::Refused(_) => Outcome::Refused,
        Status::Braked(_) => Outcome::Braked,
        _ => Outcome::Acted,
    }
}

/// The code of a projection's status.
fn status(status: Status) -> LedgerStatus {
    match status {
        Status::Unchanged => LedgerStatus::Unchanged,
        Status::Clamped => LedgerStatus::Clamped,
        Status::Solved => LedgerStatus::Solved,
        Status::Recovering => LedgerStatus::Recovering,
        Status::Slowed => LedgerStatus::Slowed,
        Status::Tightening => LedgerStatus::Tightening,
        Status::Braked(BrakeReason::NoVerifiedBrake) => LedgerStatus::BrakedNoVerifiedBrake,
        Status::Braked(BrakeReason::NonFiniteProposal) => LedgerStatus::BrakedNonFiniteProposal,
        Status::Braked(BrakeReason::NoCertifiedAnswer) => LedgerStatus::BrakedNoCertifiedAnswer,
        Status::Braked(BrakeReason::NonFiniteDynamics) => LedgerStatus::BrakedNonFiniteDynamics,
        Status::Refused(RefuseReason::NonFiniteState) => LedgerStatus::RefusedNonFiniteState,
        Status::Refused(RefuseReason::WrongLength) => LedgerStatus::RefusedWrongLength,
    }
}

/// The ledger as plain numbers; the status is [`LedgerStatus::number`].
pub fn numbers(ledger: &Ledger) -> LedgerNumbers {
    LedgerNumbers {
        status: status(ledger.status).number(),
        rung: ledger.rung.number(),
        active: ledger.active.len() as u32,
        iterations: ledger.iterations,
        raw_violations: ledger.raw_violations.total(),
        target_violations: ledger.target_violations.total(),
        outside: ledger.outside.len() as u64,
        moved: ledger.moved,
        slack: ledger.slack,
        residual: ledger.residual,
        duration: ledger.duration_ns,
    }
}
