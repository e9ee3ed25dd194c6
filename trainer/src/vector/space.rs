//! What the numbers of an action mean in a vector, their bounds, and the snapshot behind environments whose caller proposes.

use std::path::Path;

use super::{Meaning, VectorError};
use crate::env::Spec;
use crate::{tasks, train};
use nearl_runtime::constraints::{Entry, Guard, LimitSet, Model, StateLayout};
use nearl_runtime::net::{Dense, DenseLayer};
use nearl_runtime::normaliser::Normaliser;
use nearl_runtime::task::IdmKind;
use nearl_runtime::{Controller, Manifest, Networks, PolicyKind, Snapshot, SnapshotError};

/// Names and range of an action.
pub(super) struct Space {
    pub(super) names: Vec<String>,
    pub(super) low: Vec<f64>,
    pub(super) high: Vec<f64>,
}

impl Space {
    pub(super) fn actions(spec: &Spec) -> Space {
        let names = spec.actuators.iter().map(|a| a.name.clone()).collect();
        Space { names, low: spec.action_low().collect(), high: spec.action_high().collect() }
    }

    /// A proposed position ranges over the joint's limits, a velocity over its own, or over the task's where the robot file has none; anything else is
    /// unbounded. A change ranges over [-1, 1].
    pub(super) fn proposals(snapshot: &Snapshot, meaning: Meaning) -> Result<Space, SnapshotError> {
        let controller = Controller::new(snapshot)?;
        let (model, layout) = (controller.model(), controller.layout());
        let (mut names, mut low, mut high) = (Vec::new(), Vec::new(), Vec::new());
        for k in 0..layout.n_state() {
            let (l, h) = match meaning {
                Meaning::Change => (-1.0, 1.0),
                _ => range(model, controller.limits(), layout, k),
            };
            names.push(layout.state_name(k).to_owned());
            low.push(l);
            high.push(h);
        }
        Ok(Space { names, low, high })
    }
}

fn range(model: &Model, limits: &LimitSet, layout: &StateLayout, k: usize) -> (f64, f64) {
    match layout.state_entry(k) {
        Entry::Position { idx_q, .. } => {
            (model.lower_position_limit()[idx_q], model.upper_position_limit()[idx_q])
        }
        Entry::Velocity { dof } => {
            let of_file = model.velocity_limit()[dof];
            let most = if of_file.is_finite() { of_file } else { limits.velocity[dof] };
            (-most, most)
        }
        Entry::Other => (f64::NEG_INFINITY, f64::INFINITY),
    }
}

/// A snapshot of the task alone: its inverse dynamics needs no learning.
pub(super) fn task_snapshot(task: &str) -> Result<Snapshot, VectorError> {
    let mut manifest = tasks::load(task, &[])?;
    if manifest.task.idm.kind == IdmKind::Learned {
        return Err(VectorError::Unusable(format!(
            "task '{task}' has a learned inverse model, so constraints=\"task\" has no way from a proposed state to an action; \
             give the run folder or the snapshot of an agent trained with pid2-ib, or say actions=\"guarded\" for limits on the actions themselves"
        )));
    }
    train::complete(&mut manifest)?;
    Ok(open(still(manifest)))
}

/// A policy that proposes the state it is in; `manifest` is complete.
pub(crate) fn still(manifest: Manifest) -> Snapshot {
    let (n_obs, n_state) = sizes(&manifest);
    let policy = Dense { layers: vec![zeros(n_obs, n_state)], skip: None };
    let normaliser = Normaliser::identity(n_obs, n_state);
    Snapshot {
        networks: Networks { normaliser, policy, policy_log_std: Vec::new(), idm: None, margins: Vec::new() },
        manifest,
    }
}

/// A policy whose actions are zero, of the task without its `[policy]`: who gives actions has a recipe of their own. `manifest` is complete.
pub(crate) fn idle(mut manifest: Manifest) -> Snapshot {
    manifest.policy = PolicyKind::Direct;
    manifest.task.policy = None;
    let ((n_obs, n_state), n_act) = (sizes(&manifest), manifest.action_lower.len());
    let policy = Dense { layers: vec![zeros(n_obs, n_act)], skip: None };
    let normaliser = Normaliser::identity(n_obs, n_state);
    Snapshot {
        networks: Networks {
            normaliser,
            policy,
            policy_log_std: vec![0.0; n_act],
            idm: None,
            margins: Vec::new(),
        },
        manifest,
    }
}

/// Entries of the observation and of a proposed state.
fn sizes(manifest: &Manifest) -> (usize, usize) {
    let n_obs = manifest.task.state.observation.len();
    (n_obs, manifest.task.state.propose.as_ref().map_or(n_obs, Vec::len))
}

/// A trained agent with its inverse model, its policy replaced by the caller.
pub(super) fn agent_snapshot(task: &str, file: &str) -> Result<Snapshot, VectorError> {
    let snapshot = Snapshot::load(Path::new(file))?;
    let Manifest { task: of, policy, .. } = &snapshot.manifest;
    if of.name != task {
        return Err(VectorError::Unusable(format!(
            "snapshot '{file}' was trained on '{}', not on '{task}'",
            of.name
        )));
    }
    if *policy == PolicyKind::Direct {
        return Err(VectorError::Unusable(format!(
            "snapshot '{file}' holds a policy that acts directly: it has no inverse model; give one trained with pid2-ib"
        )));
    }
    Ok(open(snapshot))
}

/// The same with a policy of zeros and unit deviation: the noise becomes the proposed change.
fn open(mut snapshot: Snapshot) -> Snapshot {
    let (n_obs, n_state) =
        (snapshot.networks.normaliser.mean.len(), snapshot.networks.normaliser.scale.len());
    snapshot.networks.policy = Dense { layers: vec![zeros(n_obs, n_state)], skip: None };
    snapshot.networks.policy_log_std = vec![0.0; n_state];
    snapshot.manifest.policy = PolicyKind::Stochastic;
    snapshot.manifest.functions.clear();
    snapshot
}

/// The task's limits around actions as the actuators take them: by the drives where the task guards these, by the robot model where it knows what
/// actions lead to, else by the simulator.
pub(super) fn guarded_snapshot(task: &str) -> Result<Snapshot, VectorError> {
    let mut manifest = tasks::load(task, &[])?;
    let guard = &mut manifest.task.constraints.guard;
    *guard = match (*guard, manifest.task.idm.kind) {
        // of the drives alone, as on the robot, or by the simulator, where the task says so
        (Guard::Drive, _) => Guard::Drive,
        (Guard::Simulator, _) => Guard::Simulator,
        (_, IdmKind::Pinocchio) => Guard::Model,
        _ => Guard::Simulator,
    };
    train::complete(&mut manifest)?;
    Ok(idle(manifest))
}

/// The notes of the robot and of the limits, where they are kept by the robot's dynamics.
pub(super) fn notes(snapshot: &Snapshot, spec: &Spec) -> Result<Vec<String>, VectorError> {
    let m = &snapshot.manifest;
    let by_model = m.task.idm.kind == IdmKind::Pinocchio && m.task.constraints.guard != Guard::Simulator;
    if !(by_model || m.bounds_drives()) {
        return Ok(Vec::new());
    }
    let mut notes = nearl_runtime::doctor::told_of_simulated(m)?;
    notes.extend(train::beginnings(m)?);
    // Of joints that nothing drives it is told with them.
    if by_model && spec.touching > 0 && !notes.iter().any(|note| note.contains("nothing touches")) {
        notes.push(format!(
            "{} geoms may touch something, and limits on the motion know of no contact: a joint that is hit leaves them; keep away by constraints.collision \
             or position, or take the contacts out (contype and conaffinity 0)",
            spec.touching
        ));
    }
    Ok(notes)
}

/// The task's limits on actions around actions as the actuators take them, and nothing else.
pub(super) fn limited_snapshot(task: &str) -> Result<Snapshot, VectorError> {
    let mut manifest = tasks::load(task, &[])?;
    if manifest.task.constraints.action.is_none() {
        return Err(VectorError::Unusable(format!(
            "actions is 'limited', but task '{task}' limits no actions; write power, delivered, square or rate under [constraints.action] of a task \
             file, or ask for 'guarded' actions, which keep the limits on states"
        )));
    }
    train::complete(&mut manifest)?;
    Ok(idle(manifest))
}

fn zeros(n_in: usize, n_out: usize) -> DenseLayer {
    DenseLayer { n_in, n_out, weight: vec![0.0; n_in * n_out], bias: vec![0.0; n_out] }
}
