//! What the robot file has that projection and inverse dynamics do not reckon with, and settings that are hardly meant.

mod drives;

use crate::controller::{Parts, held_dofs};
use crate::snapshot::{Manifest, ModelFormat, PolicyKind};
use crate::task::IdmKind;
use crate::unreachable;
use drives::{
    beyond_drives, followed, held_targets, other_gains, shaken_joints, stuck_targets, swung_targets,
    without_range,
};
pub(super) use drives::{cut_targets, rubbing};
use nearl_constraints::description::mimics;
use nearl_constraints::{Drive, Kind, MADE_UP_FOR, Projector, REGISTRY};

/// One sentence for each, those of model and projector first.
pub(super) fn of(m: &Manifest, parts: &Parts) -> Vec<String> {
    let Parts { model, projector, layout, .. } = parts;
    let mut notes = [model.notes(), projector.notes()].concat();
    let settled = settled_mimics(m, parts);
    notes.retain(|note| !settled.iter().any(|begins| note.starts_with(begins)));
    // Joints that follow positions or velocities by themselves make up for their own friction.
    let by_force = |drive: &Drive| matches!(drive, Drive::Effort | Drive::Pd { .. });
    let drives = Parts::drives(m, model, layout.controllable());
    let Ok(drives) = drives else { return notes };
    if !moves_by_model(m) {
        notes.retain(|note| !note.starts_with(MADE_UP_FOR) && !note.starts_with("no brake "));
    }
    // Nothing is made up for by an inverse model that has learned what a robot does, friction and all.
    let by_equations = m.task.idm.kind == IdmKind::Pinocchio || m.guards() || m.bounds_drives();
    if !by_equations || !layout.controllable().iter().any(|&i| by_force(&drives[i])) {
        notes.retain(|note| !note.starts_with(MADE_UP_FOR));
    }
    if moves_by_model(m) || m.bounds_drives() {
        notes.extend(cut_targets(m, parts, &drives));
    }
    if moves_by_model(m) {
        notes.extend(stuck_targets(m, parts, &drives));
        notes.extend(held_targets(m, parts, &drives));
        notes.extend(swung_targets(m, parts, &drives));
        notes.extend(shaken_joints(m, parts, &drives));
        notes.extend(followed(m, parts, &drives));
    }
    notes.extend(other_gains(parts, &drives));
    notes.extend(undriven(m, parts));
    notes.extend(beyond_motors(m, parts, &drives));
    notes.extend(stopped(m, parts));
    notes.extend(unguarded(m, parts, &drives));
    notes.extend(without_range(m, parts));
    notes.extend(beyond_simulator(m));
    notes.extend(beyond_drives(m, parts, &drives));
    notes.extend(far_poses(m, model));
    notes.extend(other_steps(m));
    notes.extend(of_several_joints(m, projector));
    if moves_by_model(m) {
        notes.extend(unreachable::notes(model, projector.limits(), &m.task.constraints.frame));
    }
    notes
}

/// Limits on what joints do together, which several physics steps keep only approximately.
fn of_several_joints(m: &Manifest, projector: &Projector) -> Option<String> {
    let steps = m.task.sub_steps();
    let leads = m.guards() || m.task.idm.kind == IdmKind::Pinocchio;
    if steps < 2 || !leads || !moves_by_model(m) {
        return None;
    }
    let together = [Kind::Frame, Kind::FrameSpeed, Kind::Energy, Kind::Collision, Kind::User];
    let kinds: Vec<_> = projector.row_kinds().into_iter().flatten().collect();
    let name = |kind: &Kind| match kind {
        Kind::User => {
            let rows = m.task.constraints.rows.iter().filter(|row| row.soft.is_none());
            format!("rows ({})", rows.map(|row| format!("'{}'", row.name)).collect::<Vec<_>>().join(", "))
        }
        kind => kind.name().to_owned(),
    };
    let names: Vec<String> = together.iter().filter(|kind| kinds.contains(kind)).map(name).collect();
    let (sim_dt, every) = (m.task.time.sim_dt, m.task.time.policy_every * steps);
    (!names.is_empty()).then(|| {
        format!(
            "a control period has {steps} physics steps, and over several of them the limits on {} hold only approximately: the steps lead to another \
             place than constant accelerations do (at five steps of 2 ms the speed of a point was off by up to 0.02 %, by 1.7 % under drives of \
             targets, and a sum that is to stay equal by 0.012 rad; at ten steps of them fast drives leave a speed without bound); with one step they \
             hold: dt = {sim_dt}, and policy_every = {every} for the same period of the policy",
            names.join(", ")
        )
    })
}

/// Whether limits of the motion are kept by the robot's model: it makes up for friction, and counts on a brake.
fn moves_by_model(m: &Manifest) -> bool {
    m.proposes() && !m.bounds_drives()
}

/// Whether the robot's model says which forces lead to a target.
fn leads_by_model(m: &Manifest) -> bool {
    m.guards() || m.policy != PolicyKind::Direct && m.task.idm.kind == IdmKind::Pinocchio
}

/// How notes begin of joints that mimic others and that a row holds together, or that nothing commands.
fn settled_mimics(m: &Manifest, Parts { model, layout, .. }: &Parts) -> Vec<String> {
    let loose =
        |name: &str| model.joint(name).is_ok_and(|joint| !layout.controllable().contains(&joint.idx_v));
    let mut begins = Vec::new();
    for row in &m.task.constraints.rows {
        let terms: Vec<_> =
            row.terms.iter().filter_map(|(name, c)| Some((name.strip_prefix("q.")?, *c))).collect();
        let ([(a, of_a), (b, of_b)], Some(equals), None) = (&terms[..], row.equals, row.soft) else {
            continue;
        };
        // q_a + (of_b / of_a) q_b = equals / of_a, whichever of the two follows; without the sign of a zero.
        begins.push(mimics(a, b, 0.0 - of_b / of_a, equals / of_a + 0.0));
        begins.push(mimics(b, a, 0.0 - of_a / of_b, equals / of_b + 0.0));
    }
    let notes = model.notes().iter().filter(|note| {
        let mut names = note.split('\'').skip(1).step_by(2);
        note.starts_with("joint '") && note.contains("' mimics '") && names.by_ref().take(2).all(loose)
    });
    begins.extend(notes.cloned());
    begins
}

/// Limits that nothing is held to: those of states, of a policy that gives actions; and a policy made elsewhere that has none.
fn unguarded(m: &Manifest, Parts { model, layout, .. }: &Parts, drives: &[Drive]) -> Option<String> {
    let of = &m.task.constraints;
    // On legs: the first joint floats, and drives lead the others.
    let walks =
        model.joints().first().is_some_and(|j| j.nv == 6 && !layout.controllable().contains(&j.idx_v))
            && layout.controllable().iter().all(|&i| matches!(drives[i], Drive::Pd { .. }));
    let guard = if walks { "\"drive\"" } else { "true" };
    let has_limits = REGISTRY.iter().any(|kind| !(kind.build)(of).is_empty());
    if m.policy != PolicyKind::Direct {
        return (m.algo == "import" && !has_limits).then(|| {
            "no limit holds: [constraints] names none, so whatever the policy proposes is what its motors are asked for; name limits, torque = { scale = 1.0 } \
             among them"
                .into()
        });
    }
    let is_off = of.guard.is_off();
    if is_off && !has_limits && m.task.policy.is_some() && !m.limits_actions() {
        return Some(format!(
            "no limit holds: [constraints] names none, and guard is off, so this policy's actions are sent as they are; add guard = {guard} and the limits, \
             torque = {{ scale = 1.0 }} among them, to [constraints] of the recipe"
        ));
    }
    // A guard decides the action, and nothing beside it may change it.
    let (but, first) = match (of.reached, &of.action) {
        (Some(_), _) => (", but for the share that reached asks for,", "take reached out and "),
        (None, Some(_)) => ("", "take [constraints.action] out and "),
        (None, None) => ("", ""),
    };
    (is_off && has_limits).then(|| {
        format!(
            "the limits on states under [constraints]{but} hold for nothing: this policy gives actions, and guard is off; {first}add guard = {guard} to \
             [constraints] to hold {}",
            if walks { "those of its drives' forces (torque, torque_rate)" } else { "them" }
        )
    })
}

/// What a guard that steps a simulator does not look at, and what keeps it from knowing where an action leads.
fn beyond_simulator(m: &Manifest) -> Vec<String> {
    let of = &m.task.constraints;
    if m.without_simulator().is_none() {
        return Vec::new();
    }
    let looked_at = ["position", "velocity"];
    let named: Vec<_> =
        REGISTRY.iter().filter(|kind| !(kind.build)(of).is_empty()).map(|kind| kind.name).collect();
    let mut notes = Vec::new();
    if !named.contains(&"position") && !named.contains(&"velocity") {
        notes.push(
            "constraints.guard is \"simulator\", and [constraints] names neither position nor velocity: it keeps nothing else; name one of them, or leave \
             guard out"
                .into(),
        );
    }
    let others: Vec<_> = named.into_iter().filter(|name| !looked_at.contains(name)).collect();
    if !others.is_empty() {
        notes.push(format!(
            "constraints.guard is \"simulator\", which looks at positions and velocities alone: an action may break {} of [constraints]; write guard = true \
             to hold them, or leave out what position does not ask for",
            others.join(", ")
        ));
    }
    if m.task.delay.contains_key("action") {
        notes.push(
            "constraints.guard is \"simulator\", which looks one period ahead, and [delay] action has an action arrive later: limits are broken by what was \
             sent before, and each search for a better action is in vain; leave one of the two out"
                .into(),
        );
    }
    notes
}

/// The share of a drive's force below which a guard on forces leaves it little.
const MOSTLY: f64 = 0.5;

/// Joints whose pose, which positions and outputs of a policy are relative to, is outside of their range.
fn far_poses(m: &Manifest, model: &nearl_constraints::Model) -> Vec<String> {
    let Some(policy) = &m.task.policy else { return Vec::new() };
    let note = |(name, &pose): (&String, &f64)| {
        let at = model.joint(name).ok().filter(|joint| joint.nq == 1)?.idx_q;
        let (low, high) = (model.lower_position_limit()[at], model.upper_position_limit()[at]);
        (pose < low || pose > high).then(|| {
            format!(
                "[policy] pose of '{name}' is {pose} rad or m, outside of its range of {low} to {high}; is it in degrees, or of another joint? What the policy \
                 sees and asks for is relative to it"
            )
        })
    };
    policy.joints.iter().zip(&policy.pose).filter_map(note).collect()
}

/// MuJoCo's timestep where a file states none [s].
const TIMESTEP: f64 = 0.002;

/// Physics steps that limits are reckoned for, where the robot file's are others. What a file includes is not looked at.
fn other_steps(m: &Manifest) -> Option<String> {
    let file = m.simulation.as_ref().filter(|simulation| simulation.format == ModelFormat::Mjcf)?;
    let document = roxmltree::Document::parse(&file.text).ok()?;
    let root = document.root_element();
    if root.descendants().any(|element| element.has_tag_name("include")) {
        return None;
    }
    let stated = |name| {
        let options = root.children().filter(|element| element.has_tag_name("option"));
        options.filter_map(|option| option.attribute(name)).next_back()
    };
    let sim_dt = m.task.time.sim_dt;
    if let Some(integrator @ ("RK4" | "implicit")) = stated("integrator")
        && sim_dt > 0.0
    {
        return Some(format!(
            "[time] sim_dt is {sim_dt} s, and the robot file's integrator is {integrator}: limits are reckoned for steps of Euler's, and a simulation that \
             makes others leaves them; write integrator=\"implicitfast\" or \"Euler\" there, or sim_dt = 0 for a robot that makes no steps"
        ));
    }
    let timestep: f64 = stated("timestep").map_or(Some(TIMESTEP), |text| text.trim().parse().ok())?;
    (sim_dt > 0.0 && (sim_dt - timestep).abs() > 1e-12).then(|| {
        format!(
            "[time] sim_dt is {sim_dt} s, and the robot file's timestep is {timestep} s: limits are reckoned for steps of {sim_dt} s, and a simulation that \
             makes others leaves them; write sim_dt = {timestep}, or 0 for a robot that makes no steps"
        )
    })
}

/// `T sqrt(K / I)` of a drive that is held on its target for `T` above which it has moved its joint a good part of the way there: where the physics steps
/// are foreseen one by one, and where they are not known.
const FAR: [f64; 2] = [1.0, 0.2];

/// Motors whose strength no limit knows, and that targets are given to.
fn beyond_motors(m: &Manifest, Parts { model, layout, .. }: &Parts, drives: &[Drive]) -> Option<String> {
    let of = &m.task.constraints;
    let is_kept = of.position.is_some() || of.velocity.is_some() || of.acceleration.is_some();
    let by_model = m.policy != PolicyKind::Direct && m.task.idm.kind == IdmKind::Pinocchio;
    let weak = layout
        .controllable()
        .iter()
        .filter(|&&i| drives[i] == Drive::Effort && model.effort_limit()[i].is_finite());
    let weak: Vec<String> = weak.map(|&i| format!("'{}'", model.dof_name(i))).collect();
    (is_kept && by_model && of.torque.is_none() && !weak.is_empty()).then(|| {
        format!(
            "without a torque limit a target may ask for more than the motors of {} give, and the joint then leaves its limits though the target keeps \
             them; add torque = {{ scale = 1.0 }} to [constraints]",
            weak.join(", ")
        )
    })
}

/// Joints that nothing keeps from the stops at the ends of their ranges, though their motion has limits: a stop knows none.
fn stopped(m: &Manifest, Parts { model, layout, projector }: &Parts) -> Option<String> {
    let limits = projector.limits();
    let by_model = leads_by_model(m);
    let meets = |&&i: &&usize| {
        let at = model.joint_of_dof(i).idx_q;
        let (low, high) = (model.lower_position_limit()[at], model.upper_position_limit()[at]);
        let runs_on =
            low.is_finite() && limits.q_lower[i] < low || high.is_finite() && limits.q_upper[i] > high;
        let is_limited =
            [limits.velocity[i], limits.acceleration[i], limits.jerk[i]].iter().any(|x| x.is_finite());
        runs_on && is_limited && !limits.locked[i]
    };
    let joints: Vec<String> =
        layout.controllable().iter().filter(meets).map(|&i| format!("'{}'", model.dof_name(i))).collect();
    (by_model && !joints.is_empty()).then(|| {
        format!(
            "nothing keeps {} from the end of the range in the robot file: a stop there, on the robot or in a simulation, throws a joint out of its limits on \
             velocity and acceleration; add position = {{ margin = 0.0 }} to [constraints], or take the range out of the robot file",
            joints.join(", ")
        )
    })
}

/// Joints that nothing commands, quoted, but for those with a dof in `held`.
pub(super) fn left_alone(Parts { model, layout, .. }: &Parts, held: &[usize]) -> Vec<String> {
    let commanded = layout.controllable();
    let is_left = |i: usize| !commanded.contains(&i) && !held.contains(&i);
    let left = model.joints().iter().filter(|j| (j.idx_v..j.idx_v + j.nv).any(is_left));
    left.map(|j| format!("'{}'", j.name)).collect()
}

/// What the robot's model does not promise of joints that nothing drives.
fn undriven(m: &Manifest, parts: &Parts) -> Option<String> {
    let loose = left_alone(parts, &held_dofs(&parts.model, parts.layout.controllable()));
    let by_model = leads_by_model(m);
    let (who, instead) = match m.guards() {
        true => {
            ("guard = true reckons", "guard = \"drive\" for a robot on legs, or \"simulator\" in training")
        }
        false => ("inverse dynamics by the model reckon", "[idm] kind = \"learned\" for a robot on legs"),
    };
    (by_model && !loose.is_empty()).then(|| {
        format!(
            "{who} with {} as with joints that nothing drives and nothing touches: on the ground or in contact the limits of the others hold as far as that \
             is so; where they swing they may push the others harder than their motors can hold, which then leave their limits on position, velocity and \
             acceleration; take {instead}",
            loose.join(", ")
        )
    })
}
