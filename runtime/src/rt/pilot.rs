//! The controller of a snapshot in the loop: states in, [`Controller::update`], numbers out.

use nearl_constraints::{BrakeReason, Entry, Ledger, RefuseReason, Rung, Status};

use crate::controller::{Controller, Noise, Output, State};
use crate::link::{
    LedgerNumbers, MAX_JOINTS, MAX_OBS, Robot, RobotMessage, SnapshotBytes, StateMessage, Verdict, hash_names,
};
use crate::rt::brake::Brake;
use crate::rt::tick::{Build, Outcome, Refusal, Step, Tick};
use crate::snapshot::{Manifest, PolicyKind, Snapshot, SnapshotError};

/// A controller with its inputs and outputs, checked against the plant it drives.
pub struct Pilot {
    controller: Controller,
    brake: Option<Brake>,
    state: State,
    noise: Noise,
    output: Output,
    /// Which proposed entry is which (n_state).
    entries: Vec<Entry>,
    /// The policy proposes states; a direct one gives actions only.
    proposes: bool,
}

impl Pilot {
    /// Builds and validates the controller of `snapshot` for `robot`. Allocates and parses the robot file.
    pub fn new(snapshot: &Snapshot, robot: &RobotMessage) -> Result<Pilot, Refusal> {
        let refuse = |error: SnapshotError| Refusal { verdict: verdict(&error), text: error.to_string() };
        let controller = Controller::new(snapshot).map_err(refuse)?;
        compare(&describe_controller(&controller, &snapshot.manifest), robot)?;
        let layout = controller.layout();
        Ok(Pilot {
            brake: Brake::new(&snapshot.manifest).map_err(refuse)?,
            state: controller.state(),
            noise: controller.noise(),
            output: controller.output(),
            entries: (0..layout.n_state()).map(|k| layout.state_entry(k)).collect(),
            proposes: snapshot.manifest.policy != PolicyKind::Direct,
            controller,
        })
    }

    fn write(&self, step: &mut Step) {
        let (state, output) = (&self.state, &self.output);
        let (nq, nv) = (state.q.len(), state.v.len());
        step.nu = output.action.len() as u32;
        step.action[..output.action.len()].copy_from_slice(&output.action);
        step.log_prob_proposal = output.log_prob_proposal;
        step.log_prob_action = output.log_prob_action;
        for q in [&mut step.proposal_q, &mut step.target_q] {
            q[..nq].copy_from_slice(&state.q);
        }
        for v in [&mut step.proposal_v, &mut step.target_v] {
            v[..nv].copy_from_slice(&state.v);
        }
        step.ledger = LedgerNumbers { duration: output.duration_ns, ..LedgerNumbers::default() };
        if self.proposes {
            step.target_q[..nq].copy_from_slice(&output.next.q);
            step.target_v[..nv].copy_from_slice(&output.next.v);
            for (entry, value) in self.entries.iter().zip(&output.proposal) {
                match *entry {
                    Entry::Position { idx_q, .. } => step.proposal_q[idx_q] = *value,
                    Entry::Velocity { dof } => step.proposal_v[dof] = *value,
                    Entry::Other => {}
                }
            }
            step.ledger = numbers(&output.next.ledger);
        }
    }
}

impl Tick for Pilot {
    fn version(&self) -> u64 {
        self.controller.version()
    }

    fn tick(&mut self, state: &StateMessage, step: &mut Step) -> Outcome {
        self.state.q.copy_from_slice(state.q());
        self.state.v.copy_from_slice(state.v());
        self.state.obs.copy_from_slice(state.obs());
        let status = self.controller.update(&self.state, &self.noise, &mut self.output);
        self.write(step);
        outcome(status)
    }

    fn brake(&mut self, state: &StateMessage, step: &mut Step) -> Outcome {
        let Some(brake) = &mut self.brake else { return Outcome::Refused };
        let (nq, nv) = (state.q().len(), state.v().len());
        let (status, action) = brake.update(state.q(), state.v());
        step.nu = action.len() as u32;
        step.action[..action.len()].copy_from_slice(action);
        (step.log_prob_proposal, step.log_prob_action) = (0.0, 0.0);
        for q in [&mut step.proposal_q, &mut step.target_q] {
            q[..nq].copy_from_slice(&brake.target.q);
        }
        for v in [&mut step.proposal_v, &mut step.target_v] {
            v[..nv].copy_from_slice(&brake.target.v);
        }
        step.ledger = numbers(&brake.target.ledger);
        outcome(status)
    }

    fn reset(&mut self) {
        self.controller.reset();
    }
}

/// A braked target is checked and may be applied; a refused one may not.
fn outcome(status: Status) -> Outcome {
    if matches!(status, Status::Refused(_)) { Outcome::Refused } else { Outcome::Acted }
}

/// The ledger as plain numbers. Status: 0 to 3 in the order of [`Status`], 10 and up braked, 20 and up refused.
pub fn numbers(ledger: &Ledger) -> LedgerNumbers {
    LedgerNumbers {
        status: match ledger.status {
            Status::Unchanged => 0,
            Status::Clamped => 1,
            Status::Solved => 2,
            Status::Recovering => 3,
            Status::Slowed => 4,
            Status::Braked(BrakeReason::NonFiniteProposal) => 10,
            Status::Braked(BrakeReason::NoCertifiedAnswer) => 11,
            Status::Braked(BrakeReason::NonFiniteDynamics) => 12,
            Status::Braked(BrakeReason::NoVerifiedBrake) => 13,
            Status::Refused(RefuseReason::NonFiniteState) => 20,
            Status::Refused(RefuseReason::WrongLength) => 21,
        },
        rung: match ledger.rung {
            Rung::ClosedForm => 0,
            Rung::ActiveSet => 1,
            Rung::Clarabel => 2,
            Rung::Brake => 3,
            Rung::Relaxed => 4,
            Rung::StoredBrake => 5,
        },
        active: ledger.active.len() as u32,
        iterations: ledger.iterations,
        raw_violations: ledger.raw_violations.total(),
        projected_violations: ledger.violations.total(),
        moved: ledger.moved,
        slack: ledger.slack,
        residual: ledger.residual,
        duration: ledger.duration_ns,
    }
}

/// Builds [`Pilot`]s from snapshot bytes.
#[derive(Clone, Copy, Debug, Default)]
pub struct PilotBuilder;

impl Build for PilotBuilder {
    type Controller = Pilot;

    fn build(&mut self, snapshot: &SnapshotBytes, robot: &RobotMessage) -> Result<Pilot, Refusal> {
        let parsed = Snapshot::from_bytes(&snapshot.bytes);
        let snapshot = parsed.map_err(|e| Refusal { verdict: verdict(&e), text: e.to_string() })?;
        Pilot::new(&snapshot, robot)
    }
}

/// What a plant must announce so that a snapshot with this manifest fits it.
///
/// # Errors
/// [`SnapshotError::Unusable`] with the sentence of the layer that refused robot, layout or limits.
pub fn describe(manifest: &Manifest, lockstep: bool) -> Result<Robot, SnapshotError> {
    let parts = crate::controller::Parts::new(manifest)?;
    Ok(Robot { lockstep, ..robot(&parts.model, parts.layout.names(), manifest) })
}

fn describe_controller(controller: &Controller, manifest: &Manifest) -> Robot {
    robot(controller.model(), controller.layout().names(), manifest)
}

fn robot(model: &nearl_constraints::Model, observation: &[String], manifest: &Manifest) -> Robot {
    Robot {
        joints: model.joints().iter().map(|j| j.name.clone()).collect(),
        observation: observation.to_vec(),
        limits: limits_digest(model, manifest),
        nq: model.nq(),
        nv: model.nv(),
        nu: manifest.action_lower.len(),
        dt: manifest.task.time.dt,
        lockstep: false,
    }
}

/// Digest of the robot file's limits and the actuators' range: a robot with weaker motors is another robot.
fn limits_digest(model: &nearl_constraints::Model, manifest: &Manifest) -> u64 {
    let lists = [
        model.lower_position_limit(),
        model.upper_position_limit(),
        model.velocity_limit(),
        model.effort_limit(),
        &manifest.action_lower,
        &manifest.action_upper,
    ];
    hash_names(lists.into_iter().flatten().map(|x| x.to_bits().to_string()))
}

/// Refuses a snapshot made for another robot, naming what differs.
fn compare(own: &Robot, plant: &RobotMessage) -> Result<(), Refusal> {
    let refuse = |verdict, text| Err(Refusal { verdict, text });
    if hash_names(&own.joints) != plant.joints {
        let theirs = plant.joint_names();
        let at = own.joints.iter().zip(&theirs).position(|(a, b)| a != b);
        let at = at.unwrap_or(own.joints.len().min(theirs.len()));
        let name = |list: &[String]| list.get(at).map_or("no joint".into(), |n| format!("`{n}`"));
        let text = format!(
            "joint {at} is {} in the snapshot, but {} on the plant; use a snapshot trained for this robot",
            name(&own.joints),
            name(&theirs)
        );
        return refuse(Verdict::ForeignRobot, text);
    }
    let sizes = [
        ("configuration entries", own.nq, plant.nq, MAX_JOINTS),
        ("velocities", own.nv, plant.nv, MAX_JOINTS),
        ("actions", own.nu, plant.nu, MAX_JOINTS),
        ("observation entries", own.observation.len(), plant.n_obs, MAX_OBS),
    ];
    for (what, have, need, limit) in sizes {
        if have != need as usize || have > limit {
            let text = format!(
                "the snapshot has {have} {what}, the plant {need}, a message holds {limit}; use a snapshot trained for this task"
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

fn verdict(error: &SnapshotError) -> Verdict {
    match error {
        SnapshotError::Malformed { .. }
        | SnapshotError::Digest { .. }
        | SnapshotError::Foreign { .. }
        | SnapshotError::MissingTensor { .. } => Verdict::Corrupt,
        SnapshotError::Shape { .. } => Verdict::ForeignShape,
        SnapshotError::Value { .. } | SnapshotError::Canary { .. } => Verdict::NotFinite,
        _ => Verdict::Other,
    }
}
