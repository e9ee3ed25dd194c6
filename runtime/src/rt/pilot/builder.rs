//! Snapshots that become pilots, compared with what the loop runs.

use super::Pilot;
use crate::controller::Controller;
use crate::link::{MAX_JOINTS, MAX_OBS, Robot, RobotMessage, SnapshotBytes, Verdict, hash_names};
use crate::rt::meaning::Meaning;
use crate::rt::pinned::{Pinned, UNITS, above, first_few};
use crate::rt::run::check_holding;
use crate::rt::tick::{Build, Refusal};
use crate::snapshot::{Manifest, Snapshot, SnapshotError};
use nearl_constraints::Moved;

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
pub struct Asked(pub(super) u32, pub(super) u64, pub(super) usize);

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

pub(super) fn describe_controller(controller: &Controller, manifest: &Manifest) -> Robot {
    robot(controller.model(), controller.layout().names(), manifest)
}

pub(super) fn robot(model: &nearl_constraints::Model, observation: &[String], manifest: &Manifest) -> Robot {
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
pub(super) fn compare(own: &Robot, plant: &RobotMessage) -> Result<(), Refusal> {
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
pub(super) fn compare_limits(controller: &Controller, plant: &RobotMessage) -> Result<(), Refusal> {
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
    let text = format!(
        "the snapshot allows more than the plant: {}; train within the plant's limits, or start the plant with the snapshot's task",
        first_few(&found)
    );
    Err(Refusal { verdict: Verdict::Looser, text })
}
