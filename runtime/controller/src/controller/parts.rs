//! What a controller is built from, and the checks that a snapshot fits it.

use super::Half;
use crate::motors::Motors;
use crate::snapshot::{Manifest, Networks, PolicyKind, SnapshotError};
use crate::task::{IdmInput, IdmKind};
use nearl_constraints::description::FrictionLaw;
use nearl_constraints::{
    AccelerationLimit, ActionLimit, Consistency, ConstraintSettings, Drive, DriveTorqueLimit, Entry,
    JerkLimit, Limit, LimitError, Model, Moved, PositionLimit, Projector, Settings, StateLayout, TorqueLimit,
    build_limits,
};

/// Robot, layout and projector of a task: what a controller needs beside its networks.
pub struct Parts {
    /// Robot model.
    pub model: Model,
    /// State layout.
    pub layout: StateLayout,
    /// Projector of the task's constraints.
    pub projector: Projector,
}

impl Parts {
    /// Builds and validates the three.
    ///
    /// # Errors
    /// [`SnapshotError::Unusable`] with the sentence of the layer that refused.
    pub fn new(m: &Manifest) -> Result<Self, SnapshotError> {
        let model = Self::robot(m)?;
        let s = &m.task.state;
        let layout =
            StateLayout::new(&model, &s.observation, s.propose.as_deref(), s.controllable.as_deref())
                .map_err(|e| unusable(&e))?;
        let projector = Self::projector(m, &model, layout.controllable())?;
        Ok(Self { model, layout, projector })
    }

    /// The robot model alone.
    ///
    /// # Errors
    /// As [`Parts::new`].
    pub fn robot(m: &Manifest) -> Result<Model, SnapshotError> {
        let mut robot = m.robot.clone();
        if let Some(payload) = m.moved.as_ref().and_then(|moved| moved.payload.as_ref()) {
            robot.carry(payload).map_err(|e| unusable(&e))?;
        }
        let model = Model::from_description(robot);
        match m.task.model.friction {
            FrictionLaw::Mujoco => model,
            law => model.and_then(|model| model.with_friction_law(law)),
        }
        .map_err(|e| unusable(&e))
    }

    /// The projector of the task's constraints for the dofs in `controllable`, ascending.
    ///
    /// # Errors
    /// As [`Parts::new`].
    pub fn projector(
        m: &Manifest,
        model: &Model,
        controllable: &[usize],
    ) -> Result<Projector, SnapshotError> {
        Self::projector_of(m, model, controllable, m.task.constraints.consistency)
    }

    /// The projector of the task's guard: an action decides one acceleration of each dof, so position and velocity belong together.
    ///
    /// # Errors
    /// As [`Parts::new`].
    pub fn guard_projector(
        m: &Manifest,
        model: &Model,
        controllable: &[usize],
    ) -> Result<Projector, SnapshotError> {
        Self::projector_of(m, model, controllable, Consistency::Kinematic)
    }

    /// What each dof of the model is commanded (nv).
    ///
    /// # Errors
    /// As [`Parts::new`].
    pub fn drives(m: &Manifest, model: &Model, controllable: &[usize]) -> Result<Vec<Drive>, SnapshotError> {
        m.task.command.drives(model, controllable).map_err(|e| unusable(&e))
    }

    /// The motors of the controllable joints, whose commands `drives` (nv) names.
    ///
    /// # Errors
    /// As [`Parts::new`].
    pub fn motors(model: &Model, controllable: &[usize], drives: &[Drive]) -> Result<Motors, SnapshotError> {
        Motors::new(model, controllable, drives).map_err(|e| unusable(&e))
    }

    /// What the task allows of actions, if it says so.
    ///
    /// # Errors
    /// [`SnapshotError::Unusable`] where another stage has the last word on the action, and as [`Parts::new`].
    pub fn action_limit(
        m: &Manifest,
        model: &Model,
        controllable: &[usize],
    ) -> Result<Option<ActionLimit>, SnapshotError> {
        let Some(settings) = &m.task.constraints.action else { return Ok(None) };
        let analytic = m.policy != PolicyKind::Direct && m.task.idm.kind == IdmKind::Pinocchio;
        let other = match m.task.constraints.guard {
            _ if analytic => Some("idm.kind = \"pinocchio\" gives the one torque that leads to the target"),
            guard if !guard.is_off() => {
                Some("[constraints] guard gives the one action that leads to an allowed state")
            }
            _ => None,
        };
        if let Some(other) = other {
            return Err(unusable(&format!(
                "[constraints.action] would change an action that is already decided: {other}; leave one of the two out"
            )));
        }
        let range = m.action_lower.iter().copied().zip(m.action_upper.iter().copied()).collect();
        ActionLimit::new(settings, model, controllable, range).map(Some).map_err(|e| unusable(&e))
    }

    fn projector_of(
        m: &Manifest,
        model: &Model,
        controllable: &[usize],
        consistency: Consistency,
    ) -> Result<Projector, SnapshotError> {
        let of_states = ConstraintSettings { action: None, reached: None, ..m.task.constraints.clone() };
        let mut limits = build_limits(&of_states, model).map_err(|e| unusable(&e))?;
        if m.task.idm.kind == IdmKind::Pinocchio || m.guards() {
            keep_clear(&mut limits, m);
        }
        let drives = Self::drives(m, model, controllable)?;
        let is_pd = |drive: &Drive| matches!(drive, Drive::Pd { .. });
        if let Some(torque) = m.task.constraints.torque.clone().filter(|_| drives.iter().any(is_pd)) {
            // Of joints without motors the one who takes their commands speaks.
            let ranges = match Self::motors(model, controllable, &drives) {
                Ok(motors) => target_ranges(m, model.nv(), controllable, &motors),
                Err(_) => vec![[f64::NEG_INFINITY, f64::INFINITY]; model.nv()],
            };
            let torque = TorqueLimit::new(torque);
            limits.push(Box::new(DriveTorqueLimit::new(torque, &drives, &ranges, m.task.period())));
        }
        let settings = Settings {
            consistency,
            solver: m.task.constraints.solver,
            braking: m.task.constraints.braking,
            ..Settings::new(m.task.time.dt, m.task.sub_steps() as u32)
        };
        let projector = Projector::new(model, &limits, controllable, settings);
        let mut projector = projector.map_err(|e| match Self::motors(model, controllable, &drives) {
            // What is wrong with a motor says more than that its force is not known.
            Err(of_motor) if matches!(e, LimitError::Missing { limit: "torque", .. }) => of_motor,
            _ => unusable(&e),
        })?;
        projector.follow(&drives);
        if let Some(moved) = &m.moved {
            // The model has the payload.
            let moved = Moved { payload: None, ..moved.clone() };
            projector.move_limits(&moved).map_err(|e| unusable(&e))?;
        }
        Ok(projector)
    }
}

/// How far commands to the joints of `dofs` may go, by dof (nv): as far as the plant takes the actions.
pub fn target_ranges(m: &Manifest, nv: usize, dofs: &[usize], motors: &Motors) -> Vec<[f64; 2]> {
    let mut ranges = vec![[f64::NEG_INFINITY, f64::INFINITY]; nv];
    for (k, &i) in dofs.iter().enumerate() {
        let end = |of: &[f64]| of.get(motors.place(k)).map(|end| motors.command(k, *end));
        if let (Some(low), Some(high)) = (end(&m.action_lower), end(&m.action_upper)) {
            ranges[i] = [low.min(high), low.max(high)];
        }
    }
    ranges
}

/// Where motor forces are reckoned with, joints end before their stops, and braking leaves a reserve for what happens within a period.
fn keep_clear(limits: &mut [Box<dyn Limit>], m: &Manifest) {
    let (of, sub_steps) = (&m.task.constraints, m.task.sub_steps());
    for limit in limits {
        match limit.name() {
            "position" => {
                if let Some(position) = of.position.clone() {
                    *limit = Box::new(PositionLimit::before_stops(position, sub_steps));
                }
            }
            "acceleration" => {
                if let Some(acceleration) = of.acceleration.clone() {
                    *limit = Box::new(AccelerationLimit::over_steps(acceleration, &m.task.period()));
                }
            }
            "jerk" => {
                if let Some(jerk) = of.jerk.clone() {
                    *limit = Box::new(JerkLimit::over_steps(jerk, &m.task.period()));
                }
            }
            _ => {}
        }
    }
}

/// A name quoted from the manifest may hold line breaks.
pub(super) fn unusable(reason: &dyn std::fmt::Display) -> SnapshotError {
    SnapshotError::Unusable { reason: reason.to_string().replace(['\n', '\r'], " ") }
}

/// Controllable joints of which only one half is proposed.
pub(super) fn halves(layout: &StateLayout) -> Vec<(usize, Half)> {
    let mut found = Vec::new();
    for &dof in layout.controllable() {
        let is = |want: fn(Entry) -> Option<usize>| {
            (0..layout.n_state()).any(|k| want(layout.state_entry(k)) == Some(dof))
        };
        let position = is(|e| if let Entry::Position { dof, .. } = e { Some(dof) } else { None });
        let velocity = is(|e| if let Entry::Velocity { dof } = e { Some(dof) } else { None });
        match (position, velocity) {
            (true, false) => found.push((dof, Half::Position)),
            (false, true) => found.push((dof, Half::Velocity)),
            _ => {}
        }
    }
    found
}

/// Dofs of `model` that no command reaches, none of `controllable`, and that something holds where they are all the same ([`Model::held`]).
pub fn held_dofs(model: &Model, controllable: &[usize]) -> Vec<usize> {
    (0..model.nv()).filter(|&i| !controllable.contains(&i) && model.held()[i]).collect()
}

/// Configuration index of each degree of freedom that belongs to a one-dof joint; 0 elsewhere (never read).
pub(crate) fn idx_q(model: &Model) -> Vec<usize> {
    let mut idx = vec![0; model.nv()];
    for j in model.joints().iter().filter(|j| j.nv == 1) {
        idx[j.idx_v] = j.idx_q;
    }
    idx
}

/// The entries of the proposed state that a learned inverse model sees.
///
/// # Errors
/// [`SnapshotError::Unusable`] for a name that is not proposed.
pub fn seen_entries(m: &Manifest, layout: &StateLayout) -> Result<Vec<usize>, SnapshotError> {
    match &m.task.idm.input {
        IdmInput::Controllable => Ok(layout.controllable_state().to_vec()),
        IdmInput::Full => Ok((0..layout.n_state()).collect()),
        IdmInput::Names(names) => names
            .iter()
            .map(|name| {
                (0..layout.n_state()).find(|&k| layout.state_name(k) == name).ok_or_else(|| SnapshotError::Unusable {
                    reason: format!("idm.input names '{name}', which is not a proposed entry; name entries of state.propose"),
                })
            })
            .collect(),
    }
}

/// `o` is the number of entries that the policy sees.
pub(super) fn check_sizes(
    m: &Manifest,
    n: &Networks,
    layout: &StateLayout,
    o: usize,
) -> Result<(), SnapshotError> {
    let (s, a) = (layout.n_state(), m.action_lower.len());
    let direct = m.policy == PolicyKind::Direct;
    let out = if direct { a } else { s };
    let mut want = vec![
        ("normaliser.mean", n.normaliser.mean.len(), o),
        ("normaliser.std", n.normaliser.std.len(), o),
        ("normaliser.lower", if n.normaliser.clip.is_empty() { o } else { n.normaliser.clip.len() }, o),
        ("normaliser.scale", n.normaliser.scale.len(), s),
        ("policy.0.weight (inputs)", n.policy.n_in(), o),
        ("policy (outputs)", n.policy.n_out(), out),
        (
            "policy.log_std",
            n.policy_log_std.len(),
            if matches!(m.policy, PolicyKind::Deterministic | PolicyKind::State) { 0 } else { out },
        ),
        ("action_upper", m.action_upper.len(), a),
    ];
    if m.task.idm.kind == IdmKind::Pinocchio && !direct {
        want.push(("action_lower (one torque a controllable joint)", a, layout.controllable().len()));
    } else if let Some((net, log_std)) = &n.idm {
        want.push(("idm.0.weight (inputs)", net.n_in(), 2 * seen_entries(m, layout)?.len()));
        want.push(("idm (outputs)", net.n_out(), a));
        want.push(("idm.log_std", log_std.len(), a));
    }
    match want.into_iter().find(|(_, have, need)| have != need) {
        Some((name, have, need)) => Err(SnapshotError::Shape {
            name: name.into(),
            expected: format!("{need} wide"),
            actual: format!("{have} wide"),
        }),
        None => Ok(()),
    }
}
