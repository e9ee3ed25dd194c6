//! Whether the robot can be held and brought to rest, and how drives are reckoned with.

use super::{Check, SAMPLES, doubts, fail, ok, warn};
use crate::codes::CheckCode;
use crate::controller::Parts;
use crate::gains;
use crate::holding;
use crate::snapshot::Manifest;
use nearl_constraints::{Drive, certify_braking};

/// Can the motors hold the robot everywhere within its position limits?
pub(super) fn holding(m: &Manifest, parts: &Parts) -> Check {
    let Parts { model, layout, projector } = parts;
    let controllable = layout.controllable();
    let limits = &holding::standing(projector.limits(), &m.task.constraints, model);
    if controllable.iter().all(|&i| limits.effort[i].is_infinite()) {
        return ok(CheckCode::Holding, "the task has no torque limit to compare gravity with".into());
    }
    let period = m.task.period();
    if let Some(text) = holding::refusal(model, limits, controllable, &period) {
        return if m.bounds_drives() {
            warn(CheckCode::Holding, text)
        } else {
            fail(CheckCode::Holding, text)
        };
    }
    let loads = holding::heaviest(model, limits, controllable, &period);
    if let Some(text) = out_of_reach(m, parts, &loads) {
        return warn(CheckCode::Holding, text);
    }
    let share = |l: &holding::Load| l.needed / l.effort;
    let floats = model.joints().iter().any(|j| j.nv > 1 && !controllable.contains(&j.idx_v));
    let held = if floats { ", with its base held: what legs carry comes on top" } else { "" };
    match loads.iter().max_by(|a, b| share(a).total_cmp(&share(b))) {
        None => ok(CheckCode::Holding, "no joint has a torque limit".into()),
        Some(l) => ok(
            CheckCode::Holding,
            format!(
                "standing still takes at most {:.1} of {:.1} N m or N, at joint '{}'{held}",
                l.needed, l.effort, l.joint
            ),
        ),
    }
}

/// Share of the range of a drive's targets at either end that friction and weight may take.
const TAKEN: f64 = 0.05;

/// Joints that their drives hold in a part of their limits alone, because friction and weight take the rest of the way to the end of their targets.
fn out_of_reach(m: &Manifest, parts: &Parts, loads: &[holding::Load]) -> Option<String> {
    let Parts { model, layout, projector } = parts;
    let drives =
        Parts::drives(m, model, layout.controllable()).ok().filter(|_| m.proposes() && !m.bounds_drives())?;
    let held = |&i: &usize| {
        let ([low, high], rubs) = doubts::rubbing(m, parts, &drives, i)?;
        let Drive::Pd { stiffness, .. } = drives[i] else { return None };
        let weight = loads.iter().find(|load| load.dof == i)?.needed;
        let way = rubs + weight / stiffness;
        let (iq, limits) = (model.joint_of_dof(i).idx_q, projector.limits());
        // Without a position limit the robot file's own ends, if it has any.
        let end = |limit: f64, of_file: f64| if limit.is_finite() { limit } else { of_file };
        let lower = end(limits.q_lower[i], model.lower_position_limit()[iq]);
        let upper = end(limits.q_upper[i], model.upper_position_limit()[iq]);
        let [from, to] = [low + way, high - way];
        let margin = (from - lower).max(upper - to);
        let is_far = margin.is_finite() && margin > TAKEN * (high - low);
        is_far.then(|| {
            let held = match from < to {
                true => format!(
                    "from {from:.4} to {to:.4} rad or m, {margin:.4} short of a limit on its position"
                ),
                false => "nowhere".into(),
            };
            format!(
                "'{}' {held} (friction {:.3}, weight and springs at most {weight:.3} N m or N, stiffness {stiffness})",
                model.dof_name(i),
                model.friction()[i],
            )
        })
    };
    let joints: Vec<String> = layout.controllable().iter().filter_map(held).collect();
    (!joints.is_empty()).then(|| {
        format!(
            "within the range of their targets drives are sure to hold {}: a joint that begins beyond is led back, and where no brake is found the whole robot \
             stands (braked-no-verified-brake); give position so much margin, the actuators more ctrlrange or stiffness, or begin inside",
            joints.join("; ")
        )
    })
}

/// Share of a drive's gains that is hardly known better.
const KNOWN: f64 = 0.2;

/// How well must the gains of the joints' drives be known?
pub(super) fn gains(m: &Manifest, parts: &Parts) -> Check {
    let Parts { model, layout, projector } = parts;
    let controllable = layout.controllable();
    let drives = match Parts::drives(m, model, controllable) {
        Ok(drives) => drives,
        Err(e) => return fail(CheckCode::Gains, e.to_string()),
    };
    if !m.proposes() || m.bounds_drives() {
        return ok(CheckCode::Gains, "no limit of the motion counts on the gains of a drive".into());
    }
    let all = gains::tolerances(model, projector.limits(), controllable, &drives);
    let Some(least) = all.iter().min_by(|a, b| a.share.total_cmp(&b.share)) else {
        return ok(CheckCode::Gains, "no limit of the motion counts on the gains of a drive".into());
    };
    let percent = |share: f64| format!("{:.0} %", 100.0 * share);
    if least.share >= KNOWN {
        let text = format!(
            "the gains of the drives may be off by {}, at joint '{}'",
            percent(least.share),
            least.joint
        );
        return ok(CheckCode::Gains, text);
    }
    let close: Vec<String> = all
        .iter()
        .filter(|t| t.share < KNOWN)
        .map(|t| {
            let gains::Tolerance { joint, share, damping, velocity, deceleration, inertia } = t;
            format!(
                "joint '{joint}' to {} (damping {damping} N m s/rad or N s/m, {velocity:.3} rad/s or m/s, {deceleration} rad/s² or m/s², \
                 inertia {inertia:.3} kg m² or kg)",
                percent(*share)
            )
        })
        .collect();
    warn(
        CheckCode::Gains,
        format!(
            "the limits count on the gains of the drives: {}; where damping is less than stated by that much, or stiffness more, a joint at its \
             speed limit cannot be braked",
            close.join("; ")
        ),
    )
}

/// Can the motors give the decelerations that the position limits count on?
pub(super) fn braking(m: &Manifest, parts: Parts) -> Check {
    let left_alone = doubts::left_alone(&parts, &[]);
    let Parts { model, layout, projector } = parts;
    let (limits, controllable) = (projector.limits(), layout.controllable());
    if controllable.iter().all(|&i| limits.effort[i].is_infinite()) {
        return ok(CheckCode::Braking, "the task has no torque limit, so there is nothing to certify".into());
    }
    if m.bounds_drives() {
        return ok(
            CheckCode::Braking,
            "nothing is promised of the motion (guard = \"drive\"), so there is no brake to certify".into(),
        );
    }
    if !m.proposes() {
        return ok(CheckCode::Braking, "no limit of the motion counts on the motors' brake".into());
    }
    let period = m.task.period();
    let (samples, seed) = SAMPLES;
    match certify_braking(&model, limits, controllable, &period, samples, seed) {
        Err(e) => fail(CheckCode::Braking, e.to_string()),
        Ok(c) => {
            let joint = model.dof_name(c.dof);
            // The search leaves what nothing commands at rest.
            let at_rest = match &left_alone[..] {
                [] => String::new(),
                joints => format!(" while {}, which nothing commands, stand still", joints.join(", ")),
            };
            let found = format!(
                "in the hardest of {} states '{joint}' might need {:.1} of its {:.1} N m or N to brake{at_rest}",
                c.samples, c.needed, c.effort
            );
            if c.holds() {
                return ok(CheckCode::Braking, found);
            }
            if projector.stores_a_brake() {
                let kept = "each tick verifies a way to stop before it takes a state (constraints.braking = \"stored\")";
                return ok(CheckCode::Braking, format!("{found}: too little, so {kept}"));
            }
            // Rounded down: what is advised must do.
            let scale = (100.0 * c.scale).floor() / 100.0;
            let smaller = match scale > 0.0 {
                true => format!(", or multiply constraints.acceleration.limit by {scale:.2} or less"),
                false => String::new(),
            };
            warn(
                CheckCode::Braking,
                format!("{found}, which is too little: set constraints.braking = \"stored\"{smaller}"),
            )
        }
    }
}
