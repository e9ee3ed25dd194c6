//! Chooses the way of braking where the settings ask for none, and warns of limits that look like mistakes.

use super::Dofs;
use crate::checker::Checker;
use crate::period_dynamics::solve;
use crate::random::Random;
use crate::viability::{Kind, Period};
use crate::{Braking, Consistency, Dynamics, Limit, LimitSet, Model, Settings, certify_braking, friction};

/// States looked at, and their seed.
const SAMPLES: (usize, u64) = (2000, 7);

/// Configurations at which inertias are looked at.
const CONFIGURATIONS: usize = 200;

/// Share of a motor's force that certified braking must leave: the search is no proof.
const MARGIN: f64 = 0.03;

/// Share of an inertia that joints which nobody commands may take off before a brake that reckons with them as standing still is worth nothing.
const LIGHT: f64 = 0.05;

/// A joint that needs longer than this to stop has an acceleration or jerk limit nobody meant [s].
const LONGEST_STOP: f64 = 30.0;

/// A joint that is faster than this is stated in degrees [rad/s or m/s].
const FASTEST: f64 = 60.0;

/// A joint of a wider range is stated in degrees [rad or m].
const WIDEST: f64 = 60.0;

/// A longer control period controls nothing [s].
const LONGEST: f64 = 0.5;

/// The way of braking that `settings` ask for, or that holds every hard limit.
pub(super) fn braking(
    model: &Model,
    limits: &LimitSet,
    dofs: &Dofs,
    settings: &Settings,
    checker: &Checker,
    notes: &mut Vec<String>,
) -> Braking {
    let kinds = checker.hard_kinds();
    if settings.braking == Braking::Certified && kinds.contains(&Kind::Collision) {
        notes.push(
            "braking = \"certified\" stores no brake: bodies may come into each other where joints cannot stop as their rows ask; leave braking out, and one \
             is stored"
                .into(),
        );
    }
    if settings.braking != Braking::Auto {
        return settings.braking;
    }
    if settings.consistency == Consistency::Free || kinds.is_empty() {
        return Braking::Certified; // the boxes of single joints keep themselves
    }
    let names = |list: Vec<usize>| {
        list.iter().map(|i| format!("'{}'", model.dof_name(*i))).collect::<Vec<_>>().join(", ")
    };
    let endless: Vec<usize> =
        dofs.controllable.iter().copied().filter(|i| limits.braking[*i].is_infinite()).collect();
    if !endless.is_empty() {
        let names = names(endless);
        notes.push(format!(
            "no brake can be stored without an acceleration limit on {names}: {} may be broken when something forces a stop; add one",
            listed(&kinds)
        ));
        return Braking::Certified;
    }
    if !dofs.fixed.is_empty() {
        let mut joints: Vec<_> =
            dofs.fixed.iter().map(|i| format!("'{}'", model.joint_of_dof(*i).name)).collect();
        joints.dedup();
        let (joints, verb) = (joints.join(", "), if joints.len() == 1 { "is" } else { "are" });
        let share = carried_off(model, limits, dofs);
        if share > LIGHT {
            notes.push(format!(
                "no brake is stored because {joints} {verb} not controllable: {} may be broken when something forces a stop, and with it limits on position, \
                 velocity and acceleration; braking = \"stored\" verifies one as if nothing else moved",
                listed(&kinds)
            ));
            return Braking::Certified;
        }
        notes.push(format!(
            "a brake is stored as if {joints}, which {verb} not controllable, did not move: at most {:.1} % of what the motors accelerate gives way to \
             that, and {} may be broken by as much",
            100.0 * share,
            listed(&kinds)
        ));
        return Braking::Stored;
    }
    if kinds.iter().all(|kind| *kind == Kind::Torque) && !checker.needs_a_brake() {
        let period = Period::new(settings.dt, settings.sub_steps);
        let (samples, seed) = SAMPLES;
        // A brake of bounded jerk has every acceleration between the limits on its way.
        let mut all = limits.clone();
        for i in (0..model.nv()).filter(|i| limits.jerk[*i].is_finite()) {
            all.braking[i] = limits.acceleration[i];
        }
        let found = certify_braking(model, &all, &dofs.controllable, &period, samples, seed);
        if found.is_ok_and(|c| c.margin >= MARGIN) {
            return Braking::Certified;
        }
    }
    Braking::Stored
}

/// The largest share of the inertia of the controllable dofs that the others take off by giving way: the sum of the eigenvalues of
/// `M_cc^-1 M_cf M_ff^-1 M_fc`, at configurations within the limits. Not finite, or above 1, where a mass matrix is none.
fn carried_off(model: &Model, limits: &LimitSet, dofs: &Dofs) -> f64 {
    let (nv, controllable, fixed) = (model.nv(), &dofs.controllable, &dofs.fixed);
    let (n, m) = (controllable.len(), fixed.len());
    let mut dynamics = Dynamics::new(model);
    let mut random = Random(SAMPLES.1);
    let (mut q, mut mass) = (model.neutral(), vec![0.0; nv * nv]);
    let block = |mass: &[f64], rows: &[usize], columns: &[usize]| -> Vec<f64> {
        rows.iter().flat_map(|i| columns.iter().map(move |j| mass[j * nv + i])).collect()
    };
    let mut most: f64 = 0.0;
    for _ in 0..CONFIGURATIONS {
        for &i in controllable {
            let joint = model.joint_of_dof(i);
            if joint.nq == 1 && joint.nv == 1 {
                let or = |x: f64, otherwise: f64| if x.is_finite() { x } else { otherwise };
                let (low, high) = (
                    or(limits.q_lower[i], -std::f64::consts::PI),
                    or(limits.q_upper[i], std::f64::consts::PI),
                );
                q[joint.idx_q] = random.between(low, high);
            }
        }
        dynamics.mass(&q, &mut mass);
        let mut follows = block(&mass, fixed, controllable);
        solve(m, n, &mut block(&mass, fixed, fixed), &mut follows);
        let couples = block(&mass, controllable, fixed);
        let mut lost: Vec<f64> = (0..n * n)
            .map(|k| (0..m).map(|f| couples[k / n * m + f] * follows[f * n + k % n]).sum())
            .collect();
        solve(n, n, &mut block(&mass, controllable, controllable), &mut lost);
        let share: f64 = (0..n).map(|i| lost[i * n + i]).sum();
        if !share.is_finite() {
            return f64::INFINITY;
        }
        most = most.max(share);
    }
    most
}

fn listed(kinds: &[Kind]) -> String {
    let mut names: Vec<_> = kinds.iter().map(|kind| kind.name()).collect();
    names.dedup();
    names.join(", ")
}

/// The joints that a limit names and does not hold for.
pub(super) fn unheld(model: &Model, limit: &dyn Limit, controllable: &[usize]) -> Option<String> {
    let is_held = |name: &&str| {
        let of_joint =
            |joint: &crate::Joint| (joint.idx_v..joint.idx_v + joint.nv).any(|i| controllable.contains(&i));
        model.find(name).is_ok_and(of_joint)
    };
    let names: Vec<String> = limit
        .named_joints()
        .into_iter()
        .filter(|name| !is_held(name))
        .map(|name| format!("'{name}'"))
        .collect();
    let subject = format!("'{}' names {}", limit.label(), names.join(", "));
    (!names.is_empty()).then(|| {
        format!("{subject} and does not hold there, for they are not controllable; make them so (state.controllable of a task), or take them out")
    })
}

/// One sentence for each number that is allowed and hardly meant.
pub(super) fn doubts(model: &Model, limits: &LimitSet, dofs: &Dofs, settings: &Settings) -> Vec<String> {
    let mut notes = Vec::new();
    if settings.dt > LONGEST {
        let dt = settings.dt;
        notes.push(format!(
            "the control period is {dt} s, between two ticks nobody looks; is it milliseconds?"
        ));
    }
    for &i in &dofs.controllable {
        let (name, v, a) = (model.dof_name(i), limits.velocity[i], limits.acceleration[i]);
        let stated = model.velocity_limit()[i];
        if v.is_finite() && (v > 5.0 * stated || v > FASTEST) {
            let file =
                if stated.is_finite() { format!(", the robot file says {stated}") } else { String::new() };
            notes.push(format!("the velocity limit of '{name}' is {v} rad/s or m/s{file}; is it degrees?"));
        }
        if a.is_finite() && v.is_finite() && v / a > LONGEST_STOP {
            let time = v / a;
            notes.push(format!(
                "the acceleration limit of '{name}' is {a} rad/s² or m/s²: from {v} rad/s or m/s it needs {time:.0} s to stop"
            ));
        }
        let j = limits.jerk[i];
        let time = if v * j < a * a { 2.0 * (v / j).sqrt() } else { v / a + a / j };
        if j.is_finite() && v.is_finite() && time > LONGEST_STOP && v / a <= LONGEST_STOP {
            notes.push(format!(
                "the jerk limit of '{name}' is {j} rad/s³ or m/s³: from {v} rad/s or m/s it needs {time:.0} s to stop"
            ));
        }
        let range = limits.q_upper[i] - limits.q_lower[i];
        if range.is_finite() && range > WIDEST {
            notes.push(format!("the range of '{name}' is {range:.1} rad or m; is it degrees?"));
        }
    }
    notes.extend(rubbing(model, limits, dofs, &Period::new(settings.dt, settings.sub_steps)));
    notes
}

/// What dry friction may do to the accelerations that are kept, by joint.
fn rubbing(model: &Model, limits: &LimitSet, dofs: &Dofs, period: &Period) -> Option<String> {
    if model.friction().iter().all(|f| *f == 0.0) {
        return None;
    }
    let off = friction::doubt(model, limits, period);
    let joint = |&i: &usize| {
        let (name, f, a) = (model.dof_name(i), model.friction()[i], limits.acceleration[i]);
        let limit = if a.is_finite() { format!(" of {a}") } else { String::new() };
        format!("'{name}' ({f} N·m or N) by {:.3}{limit}", off[i])
    };
    let joints: Vec<String> = dofs.controllable.iter().filter(|i| off[**i] > 0.0).map(joint).collect();
    (!joints.is_empty()).then(|| {
        format!(
            "{} as MuJoCo has it; where joints rub otherwise, accelerations leave what is asked for, and their limits, by at \
             most so many rad/s² or m/s²: {}; measure the friction and write it into the robot file",
            friction::MADE_UP_FOR,
            joints.join(", ")
        )
    })
}
