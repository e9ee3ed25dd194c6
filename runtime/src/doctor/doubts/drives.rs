//! What is doubtful of drives: their ranges, gains, and what they do within a period.

use super::{FAR, MOSTLY};
use crate::controller::{Parts, force_left, target_ranges};
use crate::snapshot::{Manifest, ModelFormat};
use nearl_constraints::description::{Command, Motor};
use nearl_constraints::{Drive, Dynamics, REGISTRY};

/// Simulated drives without a range of targets, which no environment takes.
pub(super) fn without_range(m: &Manifest, Parts { model, layout, .. }: &Parts) -> Option<String> {
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

/// What a guard on the forces of drives does not hold, and what the plant has that it does not reckon with.
pub(super) fn beyond_drives(
    m: &Manifest,
    Parts { model, layout, projector }: &Parts,
    drives: &[Drive],
) -> Vec<String> {
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

/// Drives that are held on a target for so long that they push otherwise at the end of a period than at its start.
pub(super) fn held_targets(
    m: &Manifest,
    Parts { model, layout, .. }: &Parts,
    drives: &[Drive],
) -> Option<String> {
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
pub(super) fn swung_targets(
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
pub(super) fn shaken_joints(
    m: &Manifest,
    Parts { model, layout, .. }: &Parts,
    drives: &[Drive],
) -> Option<String> {
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
pub(super) fn followed(
    m: &Manifest,
    Parts { model, layout, .. }: &Parts,
    drives: &[Drive],
) -> Option<String> {
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

/// Gains that `[command]` states other than the robot file's own drive has them; a policy's metadata has three decimals.
pub(super) fn other_gains(Parts { model, layout, .. }: &Parts, drives: &[Drive]) -> Option<String> {
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

/// Ends of the target of dof `i` [rad or m], and the part of the way to them that makes up for its dry friction, of a drive of targets.
pub(in crate::doctor) fn rubbing(
    m: &Manifest,
    parts: &Parts,
    drives: &[Drive],
    i: usize,
) -> Option<([f64; 2], f64)> {
    let Drive::Pd { stiffness, .. } = drives[i] else { return None };
    let (model, dofs) = (&parts.model, parts.layout.controllable());
    let [low, high] = target_ranges(m, model.nv(), dofs, &Parts::motors(model, dofs, drives).ok()?)[i];
    (high - low).is_finite().then(|| ([low, high], model.friction()[i] / stiffness))
}

/// Drives whose targets end before they could make up for the dry friction of their joints.
pub(super) fn stuck_targets(m: &Manifest, parts: &Parts, drives: &[Drive]) -> Option<String> {
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
pub(in crate::doctor) fn cut_targets(m: &Manifest, parts: &Parts, drives: &[Drive]) -> Option<String> {
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
