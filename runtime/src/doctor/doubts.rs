//! What the robot file has that projection and inverse dynamics do not reckon with, and settings that are hardly meant.

use nearl_constraints::description::{Command, Motor, mimics};
use nearl_constraints::{Drive, Dynamics, Kind, MADE_UP_FOR, Projector, REGISTRY};

use crate::controller::{Parts, force_left, held_dofs, target_ranges};
use crate::snapshot::{Manifest, ModelFormat, PolicyKind};
use crate::task::IdmKind;
use crate::unreachable;

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

/// Simulated drives without a range of targets, which no environment takes.
fn without_range(m: &Manifest, Parts { model, layout, .. }: &Parts) -> Option<String> {
    let file = m.simulation.as_ref().filter(|simulation| simulation.format == ModelFormat::Mjcf)?;
    if file.text.contains("clampctrl") {
        return None; // switched off, ranges that are there count for nothing
    }
    let named = |&i: &usize| {
        let joint = model.dof_name(i);
        let motor = model.motors().iter().find(|motor| motor.joint == joint)?;
        (motor.follows_positions() && motor.control_range.is_none()).then(|| format!("'{}'", motor.name))
    };
    let names: Vec<String> = layout.controllable().iter().filter_map(named).collect();
    (!names.is_empty()).then(|| {
        format!(
            "actuators {} have no ctrlrange, and no training and no `nearl plant` takes such a robot file: give each a ctrlrange that goes beyond the range of \
             its joint by up to forcerange / kp",
            names.join(", ")
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

/// What a guard on the forces of drives does not hold, and what the plant has that it does not reckon with.
fn beyond_drives(m: &Manifest, Parts { model, layout, projector }: &Parts, drives: &[Drive]) -> Vec<String> {
    if !m.bounds_drives() {
        return Vec::new();
    }
    let mut notes = Vec::new();
    let kept = ["torque", "torque_rate", "acceleration"];
    let named = REGISTRY.iter().filter(|kind| !(kind.build)(&m.task.constraints).is_empty());
    let others: Vec<_> = named.map(|kind| kind.name).filter(|name| !kept.contains(name)).collect();
    if !others.is_empty() {
        notes.push(format!(
            "constraints.guard is \"drive\", which keeps the forces of drives and nothing of the motion: nothing holds {} of [constraints]; leave them out, or \
             write guard = true for a robot whose joints are all driven",
            others.join(", ")
        ));
    }
    let (period, limits) = (m.task.period(), projector.limits());
    let swings = |&i: &usize| {
        let Drive::Pd { stiffness, damping } = drives[i] else { return None };
        let (effort, acceleration) = (limits.effort[i], limits.acceleration[i]);
        let left = force_left(&period, (stiffness, damping), effort, acceleration);
        (acceleration.is_finite() && left < MOSTLY * effort).then(|| {
            let left = if left > 0.0 { format!("{left:.3}") } else { "nothing".into() };
            format!(
                "'{}' ({left} of {effort:.3} N m or N at {acceleration} rad/s² or m/s²)",
                model.dof_name(i)
            )
        })
    };
    let joints: Vec<String> = layout.controllable().iter().filter_map(swings).collect();
    if !joints.is_empty() {
        notes.push(format!(
            "joints at their limits on acceleration change the force of their drives within a period of {} s by so much that little of it may be used at its \
             start, or, where nothing is left, that its end is not kept: {}; shorten time.dt, or lower the acceleration to what these joints do",
            period.dt,
            joints.join(", ")
        ));
    }
    let (delay, noise, random) = (&m.task.delay, &m.task.noise, &m.task.random);
    let has = |table: &toml::Table, section: &str, keys: &[&str]| -> Vec<String> {
        keys.iter().filter(|key| table.contains_key(**key)).map(|key| format!("{section}.{key}")).collect()
    };
    let bias = noise.get("bias").and_then(toml::Value::as_table).cloned().unwrap_or_default();
    let otherwise = [
        has(delay, "delay", &["action", "observation"]),
        has(noise, "noise", &["q", "v"]),
        has(&bias, "noise.bias", &["q", "v"]),
        has(random, "random", &["stiffness", "damping", "strength"]),
    ]
    .concat();
    if !otherwise.is_empty() {
        notes.push(format!(
            "constraints.guard is \"drive\", which reckons with the state that is measured, targets that act at once and the gains of [command]: beside {} the \
             forces of the simulated drives leave their limits; `nearl eval` counts the ticks",
            otherwise.join(", ")
        ));
    }
    notes
}

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

/// Drives that are held on a target for so long that they push otherwise at the end of a period than at its start.
fn held_targets(m: &Manifest, Parts { model, layout, .. }: &Parts, drives: &[Drive]) -> Option<String> {
    let (steps, dt, nv) = (m.task.sub_steps(), m.task.time.dt, model.nv());
    let mut mass = vec![0.0; nv * nv];
    Dynamics::new(model).mass(&model.neutral(), &mut mass);
    let is_long = |&i: &usize| match drives[i] {
        Drive::Pd { stiffness, .. } => {
            let inertia = mass[i * nv + i];
            let far = dt * (stiffness / inertia).sqrt();
            (steps != 1 && far > FAR[usize::from(steps == 0)]).then(|| {
                format!("'{}' (stiffness {stiffness} on {} kg m² or kg)", model.dof_name(i), short(inertia))
            })
        }
        _ => None,
    };
    let long: Vec<String> = layout.controllable().iter().filter_map(is_long).collect();
    (!long.is_empty()).then(|| {
        let why = match steps {
            0 => "the motion on the way is foreseen to second order alone without time.sim_dt",
            _ => "the robot is led far on the way",
        };
        format!(
            "a period of {dt} s takes the drives of {} a good part of the way to a target, and {why}: limits on position, velocity and acceleration may \
             be left; set time.dt to the length of a physics step and time.policy_every to as many as there were, or give position a margin",
            long.join(", ")
        )
    })
}

/// Share of a drive's force by which it may change within a period at the speed limit of its joint, before what is reckoned of it is off by too much.
const SWINGS: f64 = 0.5;

/// Drives that push so much less at the end of a period than at its start, where their joints pass the targets that are held, that little is left to brake.
fn swung_targets(
    m: &Manifest,
    Parts { model, layout, projector }: &Parts,
    drives: &[Drive],
) -> Option<String> {
    let (period, limits) = (m.task.period(), projector.limits());
    let swings = |&i: &usize| match drives[i] {
        Drive::Pd { stiffness, .. } => {
            let change = stiffness * limits.velocity[i] * (period.dt - period.tau);
            (change.is_finite() && change > SWINGS * limits.effort[i]).then(|| {
                format!(
                    "'{}' ({} of its {} N m or N)",
                    model.dof_name(i),
                    short(change),
                    short(limits.effort[i])
                )
            })
        }
        _ => None,
    };
    let joints: Vec<String> = layout.controllable().iter().filter_map(swings).collect();
    (period.sub_steps > 1 && !joints.is_empty()).then(|| {
        format!(
            "at their speed limits the drives of {} change their force by so much within a period of {} s while their target is held, and may not be able to \
             brake then: limits on position, velocity and acceleration may be left; set time.dt to the length of a physics step and time.policy_every to as \
             many as there were, or lower the speed limits",
            joints.join(", "),
            period.dt
        )
    })
}

/// An explicit damper of a drive grows without bound where it takes away twice a velocity in a physics step.
const SHAKES: f64 = 2.0;

/// Drives whose damping the physics steps of the simulation cannot make.
fn shaken_joints(m: &Manifest, Parts { model, layout, .. }: &Parts, drives: &[Drive]) -> Option<String> {
    let (period, nv) = (m.task.period(), model.nv());
    if period.sub_steps < 2 {
        return None; // exact, or without steps
    }
    let mut mass = vec![0.0; nv * nv];
    Dynamics::new(model).mass(&model.neutral(), &mut mass);
    let shakes = |&i: &usize| match drives[i] {
        Drive::Pd { damping, .. } => {
            let inertia = mass[i * nv + i] + period.tau * (model.damping()[i] + model.drive_damping()[i]);
            (damping * period.tau > SHAKES * inertia).then(|| {
                format!("'{}' (damping {damping} on {} kg m² or kg)", model.dof_name(i), short(inertia))
            })
        }
        _ => None,
    };
    let joints: Vec<String> = layout.controllable().iter().filter_map(shakes).collect();
    (!joints.is_empty()).then(|| {
        format!(
            "a physics step of {} s takes away more than twice the velocity by the damping of the drives of {}, which shakes them apart: take \
             integrator=\"implicitfast\" in the robot file, shorter steps or less damping",
            period.tau,
            joints.join(", ")
        )
    })
}

/// Simulated drives that are sent positions or velocities, whose limits are of what is sent.
fn followed(m: &Manifest, Parts { model, layout, .. }: &Parts, drives: &[Drive]) -> Option<String> {
    m.simulation.as_ref().filter(|simulation| simulation.format == ModelFormat::Mjcf)?;
    let follows = |&&i: &&usize| {
        let follows = match drives[i] {
            Drive::Position => Motor::follows_positions,
            Drive::Velocity => Motor::follows_speeds,
            _ => return false,
        };
        model.motors().iter().any(|motor| motor.joint == model.dof_name(i) && follows(motor))
    };
    let joints: Vec<String> =
        layout.controllable().iter().filter(follows).map(|&i| format!("'{}'", model.dof_name(i))).collect();
    (!joints.is_empty()).then(|| {
        format!(
            "limits hold for what {} are sent, and not for where the drives of the robot file take them, which lag behind and overshoot; take interface = \
             \"pd\" with the gains of these drives, whose limits are those of the joints, or leave margins",
            joints.join(", ")
        )
    })
}

/// Three digits.
fn short(x: f64) -> String {
    if x.abs() < 1e-3 { format!("{x:.2e}") } else { format!("{x:.3}") }
}

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

/// Gains that `[command]` states other than the robot file's own drive has them; a policy's metadata has three decimals.
fn other_gains(Parts { model, layout, .. }: &Parts, drives: &[Drive]) -> Option<String> {
    let same = |a: f64, b: f64| (a - b).abs() <= 1e-3 * a.abs().max(1.0);
    let other = |&i: &usize| {
        let (Drive::Pd { stiffness, damping }, joint) = (drives[i], model.dof_name(i)) else { return None };
        let is_drive =
            |motor: &&Motor| motor.joint == joint && motor.gear == 1.0 && motor.follows_positions();
        let motor = model.motors().iter().find(is_drive)?;
        let (of_file, damped) = (motor.gain, 0.0 - motor.bias[2]);
        let differs = !(same(stiffness, of_file) && same(damping, damped));
        differs.then(|| {
            format!(
                "'{joint}' has stiffness {stiffness} and damping {damping} by [command], {of_file} and {damped} by the robot file"
            )
        })
    };
    let joints: Vec<String> = layout.controllable().iter().filter_map(other).collect();
    (!joints.is_empty()).then(|| {
        format!(
            "[command] contradicts the drives of the robot file, and targets and limits count on [command]: {} [N m/rad or N/m, N m s/rad or N s/m]; write the \
             gains that the robot has into both",
            joints.join("; ")
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

/// Ends of the target of dof `i` [rad or m], and the part of the way to them that makes up for its dry friction, of a drive of targets.
pub(super) fn rubbing(m: &Manifest, parts: &Parts, drives: &[Drive], i: usize) -> Option<([f64; 2], f64)> {
    let Drive::Pd { stiffness, .. } = drives[i] else { return None };
    let (model, dofs) = (&parts.model, parts.layout.controllable());
    let [low, high] = target_ranges(m, model.nv(), dofs, &Parts::motors(model, dofs, drives).ok()?)[i];
    (high - low).is_finite().then(|| ([low, high], model.friction()[i] / stiffness))
}

/// Drives whose targets end before they could make up for the dry friction of their joints.
fn stuck_targets(m: &Manifest, parts: &Parts, drives: &[Drive]) -> Option<String> {
    let stuck = |&i: &usize| {
        let ([low, high], way) = rubbing(m, parts, drives, i)?;
        (2.0 * way > high - low).then(|| {
            let friction = parts.model.friction()[i];
            format!(
                "'{}' ({} N m or N, which takes {} rad or m of the {} that its range has)",
                parts.model.dof_name(i),
                short(friction),
                short(2.0 * way),
                short(high - low)
            )
        })
    };
    let joints: Vec<String> = parts.layout.controllable().iter().filter_map(stuck).collect();
    (!joints.is_empty()).then(|| {
        format!(
            "no target of their range has the drives of {} make up for dry friction either way: their limits on acceleration, velocity and position are not \
             promised, nor are those of the joints that move them; give the actuators more ctrlrange or stiffness, or leave the joints out of \
             state.controllable",
            joints.join(", ")
        )
    })
}

/// Targets that a drive is not sent because its range ends before.
pub(super) fn cut_targets(m: &Manifest, parts: &Parts, drives: &[Drive]) -> Option<String> {
    let Parts { model, layout, projector } = parts;
    let torque = m.task.constraints.torque.as_ref();
    if m.task.sub_steps() == 1
        && projector.stores_a_brake()
        && torque.is_some_and(|torque| torque.soft.is_none())
    {
        return None; // kept inside, and a brake that stays inside is there
    }
    let (dofs, limits) = (layout.controllable(), projector.limits());
    let ranges = target_ranges(m, model.nv(), dofs, &Parts::motors(model, dofs, drives).ok()?);
    let (promised, asks) = match m.bounds_drives() {
        true => ("limits on torque are", "a torque limit"),
        false => ("limits on acceleration, velocity and position are", "braking"),
    };
    let cut = |&i: &usize| {
        // At rest at least, where no speed is known.
        let speed = Some(limits.velocity[i]).filter(|v| v.is_finite() || !m.bounds_drives()).unwrap_or(0.0);
        let reach = drives[i].reach(&m.task.period(), limits.effort[i], speed);
        let [low, high] = ranges[i];
        // Without a position limit the robot file's own ends.
        let iq = model.joint_of_dof(i).idx_q;
        let file = [model.lower_position_limit()[iq], model.upper_position_limit()[iq]];
        let [lower, upper] = if m.bounds_drives() { file } else { [limits.q_lower[i], limits.q_upper[i]] };
        let [needed_low, needed_high] = [lower - reach, upper + reach];
        let short =
            reach.is_finite() && reach > 0.0 && (low > needed_low + 1e-9 || high < needed_high - 1e-9);
        let short = short && needed_low.is_finite() && needed_high.is_finite();
        short.then(|| {
            format!(
                "'{}' from {low:.3} to {high:.3} where {asks} may ask for {needed_low:.3} to {needed_high:.3}",
                model.dof_name(i)
            )
        })
    };
    let joints: Vec<String> = dofs.iter().filter_map(cut).collect();
    let states_range = |motor: &Motor| {
        matches!(motor.command, Command::Position | Command::Pd) && motor.control_range.is_some()
    };
    let next = match model.motors().iter().any(states_range) {
        true => "give the actuators that ctrlrange, less speed or less damping",
        false => "make the snapshot anew with this robot file and these limits",
    };
    (!joints.is_empty()).then(|| {
        format!(
            "a drive's targets are cut at its range, and {promised} not promised where they are: {} [rad or m]; {next}",
            joints.join(", ")
        )
    })
}
