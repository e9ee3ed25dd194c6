//! The controller of a snapshot in the loop: states in, [`Controller::update`], numbers out.

use std::cell::Cell;
use std::collections::BTreeMap;

use nearl_constraints::description::JointKind;
use nearl_constraints::{
    BrakeReason, Entry, Joint, Kind, Ledger, LimitSet, Moved, RefuseReason, Side, Status,
};

use crate::codes::LedgerStatus;
use crate::controller::{Controller, Noise, Output, State};
use crate::link::{
    LedgerNumbers, MAX_JOINTS, MAX_OBS, Message, PROPOSES_ACTIONS, PROPOSES_STATES, Robot, RobotMessage,
    RowsMessage, SnapshotBytes, StateMessage, Verdict, hash_names,
};
use crate::rt::brake::Brake;
use crate::rt::meaning::Meaning;
use crate::rt::pinned::{Pinned, UNITS, above};
use crate::rt::run::check_holding;
use crate::rt::tick::{Build, LoopController, MAX_ROWS, Outcome, Question, Refusal, Row, TickOutput};
use crate::rt::watch::{Watched, WatchedJoint};
use crate::snapshot::{Manifest, PolicyKind, Snapshot, SnapshotError};

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
        // A way to stop within other limits is none within these.
        if let Some((limits, memory)) = memory.split_first()
            && *limits == self.limits
        {
            self.controller.take_memory(memory);
            self.share(false);
        }
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

/// Builds [`Pilot`]s from snapshot bytes, within what is fixed, if anything is.
#[derive(Debug, Default)]
pub struct PilotBuilder {
    /// What the robot takes the numbers of an action for.
    pub meaning: Option<Meaning>,
    /// What no snapshot may loosen.
    pub pinned: Option<Pinned>,
    /// What another process was asked to propose, once and for all.
    pub asked: Option<Asked>,
}

/// What another process may propose: states or actions, a number for the names of their entries, how many there are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Asked(u32, u64, usize);

impl Build for PilotBuilder {
    type Controller = Pilot;

    fn build(&mut self, snapshot: &SnapshotBytes, robot: &RobotMessage) -> Result<Pilot, Refusal> {
        let parsed = Snapshot::from_bytes(&snapshot.bytes);
        let snapshot = parsed.map_err(|e| Refusal { verdict: Verdict::of(&e), text: e.to_string() })?;
        let pilot = Pilot::within(&snapshot, robot, self)?;
        if self.asked.is_some_and(|asked| pilot.takes != Some(asked)) {
            let text = "another process proposes, and the snapshot takes other proposals from it than the loop began with (states or actions, and of \
                        which joints); use one that takes the same, or start the loop anew";
            return Err(Refusal { verdict: Verdict::ForeignShape, text: text.into() });
        }
        Ok(pilot)
    }

    fn with_limits(&mut self, bytes: &[u8], moved: &Moved) -> Result<Vec<u8>, Refusal> {
        let refuse = |verdict, text: String| Err(Refusal { verdict, text });
        let mut snapshot = match Snapshot::from_bytes(bytes) {
            Ok(snapshot) => snapshot,
            Err(e) => return refuse(Verdict::of(&e), e.to_string()),
        };
        if !snapshot.manifest.proposes() {
            let text = "the snapshot in use gives actions that nothing projects, so that no limit of it can be moved; \
                        write guard = true under [constraints] of its task";
            return refuse(Verdict::Other, text.into());
        }
        if let Some(payload) = &moved.payload
            && !snapshot.manifest.robot.has_frame(&payload.frame)
        {
            let text = format!(
                "the robot carries a payload on frame '{}', which the snapshot's robot does not have; use a snapshot trained for this robot",
                payload.frame
            );
            return refuse(Verdict::ForeignRobot, text);
        }
        snapshot.manifest.moved = Some(moved.clone());
        if moved.payload.is_some()
            && let Err(text) = check_holding(&snapshot)
        {
            return refuse(Verdict::Other, format!("with the payload {text}"));
        }
        Ok(snapshot.to_bytes())
    }
}

/// What a plant must announce so that a snapshot with this manifest fits it.
///
/// # Errors
/// [`SnapshotError::Unusable`] with the sentence of the layer that refused robot, layout or limits.
pub fn describe(manifest: &Manifest, lockstep: bool) -> Result<Robot, SnapshotError> {
    let parts = crate::controller::Parts::new(manifest)?;
    let stated = Some(parts.projector.limits().clone());
    Ok(Robot { lockstep, stated, ..robot(&parts.model, parts.layout.names(), manifest) })
}

fn describe_controller(controller: &Controller, manifest: &Manifest) -> Robot {
    robot(controller.model(), controller.layout().names(), manifest)
}

fn robot(model: &nearl_constraints::Model, observation: &[String], manifest: &Manifest) -> Robot {
    Robot {
        joints: model.joints().iter().map(|j| j.name.clone()).collect(),
        observation: observation.to_vec(),
        limits: limits_digest(model, manifest),
        stated: None,
        nq: model.nq(),
        nv: model.nv(),
        nu: manifest.action_lower.len(),
        dt: manifest.task.time.dt,
        lockstep: false,
    }
}

/// Digest of the robot file's limits, the actuators' range and what they are commanded: a robot with weaker motors is another robot.
fn limits_digest(model: &nearl_constraints::Model, manifest: &Manifest) -> u64 {
    let lists = [
        model.lower_position_limit(),
        model.upper_position_limit(),
        model.velocity_limit(),
        model.effort_limit(),
        &manifest.action_lower,
        &manifest.action_upper,
    ];
    let command = &manifest.task.command;
    let interface = (!command.is_effort()).then(|| format!("{command:?}"));
    hash_names(lists.into_iter().flatten().map(|x| x.to_bits().to_string()).chain(interface))
}

/// Refuses a snapshot made for another robot, naming what differs.
fn compare(own: &Robot, plant: &RobotMessage) -> Result<(), Refusal> {
    let refuse = |verdict, text| Err(Refusal { verdict, text });
    if hash_names(&own.joints) != plant.joints {
        let (at, ours, theirs) = plant.first_other_joint(&own.joints);
        let name = |name: Option<&str>| name.map_or("no joint".into(), |n| format!("`{n}`"));
        let text = format!(
            "joint {at} is {} in the snapshot, but {} on the plant; use a snapshot trained for this robot",
            name(ours),
            name(theirs.as_deref())
        );
        return refuse(Verdict::ForeignRobot, text);
    }
    let own_sizes =
        [(own.nq, MAX_JOINTS), (own.nv, MAX_JOINTS), (own.nu, MAX_JOINTS), (own.observation.len(), MAX_OBS)];
    for ((have, limit), (what, need)) in own_sizes.into_iter().zip(plant.sizes()) {
        if have != need as usize {
            let text = format!(
                "the snapshot has {have} {what}, the plant {need}; give the driver as many, or use a snapshot made for this plant"
            );
            return refuse(Verdict::ForeignShape, text);
        }
        if have > limit {
            let text = format!(
                "the snapshot has {have} {what}, and a message holds {limit}; use a smaller robot or task"
            );
            return refuse(Verdict::ForeignShape, text);
        }
    }
    if hash_names(&own.observation) != plant.observation {
        let text = "the observation entries of snapshot and plant have other names or another order; use a snapshot trained for this task";
        return refuse(Verdict::ForeignShape, text.into());
    }
    if (own.dt - plant.dt).abs() > 1e-9 {
        let text = format!(
            "the snapshot's control period is {} s, the plant's {} s; start the plant with the snapshot's task",
            own.dt, plant.dt
        );
        return refuse(Verdict::ForeignPeriod, text);
    }
    if plant.limits != 0 && own.limits != plant.limits {
        let text = "limits or actuator ranges differ between the snapshot's robot file and the plant's; train again with the plant's robot file";
        return refuse(Verdict::ForeignRobot, text.into());
    }
    Ok(())
}

/// Refuses a snapshot that allows a joint more than the plant states.
fn compare_limits(controller: &Controller, plant: &RobotMessage) -> Result<(), Refusal> {
    if !plant.states_limits() {
        return Ok(());
    }
    let (own, model) = (controller.limits(), controller.model());
    let mut found = Vec::new();
    for &i in controller.layout().controllable() {
        let joint = model.dof_name(i);
        let kinds = [
            ("velocity", own.velocity[i], plant.velocity[i], UNITS[1]),
            ("torque", own.effort[i], plant.effort[i], UNITS[3]),
            ("acceleration", own.acceleration[i], plant.acceleration[i], UNITS[2]),
            ("highest position", own.q_upper[i], plant.q_upper[i], UNITS[0]),
            ("lowest position below zero by", -own.q_lower[i], -plant.q_lower[i], UNITS[0]),
        ];
        let looser = kinds.into_iter().filter(|(_, is, was, _)| above(*is, *was));
        found.extend(looser.map(|(what, is, was, unit)| {
            format!("{what} of joint '{joint}' {is} {unit} in the snapshot, {was} on the plant")
        }));
    }
    if found.is_empty() {
        return Ok(());
    }
    let (shown, more) = (found.len().min(3), found.len().saturating_sub(3));
    let more = if more > 0 { format!("; and {more} more") } else { String::new() };
    let text = format!(
        "the snapshot allows more than the plant: {}{more}; train within the plant's limits, or start the plant with the snapshot's task",
        found[..shown].join("; ")
    );
    Err(Refusal { verdict: Verdict::Looser, text })
}
