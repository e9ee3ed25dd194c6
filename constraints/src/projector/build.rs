//! Building a projector: everything that can be wrong is found here.

use super::active_set::ActiveSet;
use super::backup::Backup;
use super::choice;
use super::conic::Conic;
use super::coupled::Coupled;
use super::moved::Moving;
use super::nearer::Nearer;
use super::polish::Polish;
use super::sources::{Measured, Sources};
use super::{Dofs, FREE, History, Projector, Stages, Switch};
use crate::checker::Checker;
use crate::ledger::{Rung, Status};
use crate::target::{Bounds, Braking, Consistency, Proposal, Settings, Solver};
use crate::viability::{Dof, Interval, Kind, Period};
use crate::{Dynamics, Limit, LimitError, LimitSet, Model, Soft};

impl Projector {
    /// A projector that moves the `controllable` dofs (indices into a velocity, any order) of `model` within `limits`.
    ///
    /// # Errors
    /// Settings out of their domain, dofs that do not exist, limits the robot file lacks or that contradict each other,
    /// position limits without an acceleration to brake with, coupled limits in free mode. Every joint is named.
    pub fn new(
        model: &Model,
        limits: &[Box<dyn Limit>],
        controllable: &[usize],
        settings: Settings,
    ) -> Result<Projector, LimitError> {
        let nv = model.nv();
        settings.validate(model)?;
        let dofs = Dofs::new(model, controllable, settings.consistency)?;
        if let (Some(limit), true) = (limits.first(), dofs.controllable.is_empty()) {
            let what = format!("no joint is controllable, so that '{}' would hold for none", limit.label());
            return Err(LimitError::Unusable {
                what,
                next: "name the joints in state.controllable, or drop the limits",
            });
        }
        check_names(model, limits)?;
        let switches = switches(model, limits, &dofs.controllable)?;
        let (each, limits) = (limits, LimitSet::collect(model, limits, &dofs.controllable)?);
        let period = Period::new(settings.dt, settings.sub_steps);
        let mut checker = Checker::new(model, each, &dofs.controllable, period, settings.consistency)?;
        let mut notes = choice::doubts(model, &limits, &dofs, &settings);
        notes.extend(each.iter().flat_map(|limit| limit.notes(model, &dofs.controllable)));
        notes.extend(
            each.iter().filter_map(|limit| choice::unheld(model, limit.as_ref(), &dofs.controllable)),
        );
        let braking = choice::braking(model, &limits, &dofs, &settings, &checker, &mut notes);
        let settings = Settings { braking, ..settings };
        if braking == Braking::Stored {
            checker.stop_in_whole_periods();
        }
        check_combination(model, &limits, &dofs, (settings.consistency, settings.braking))?;
        check_proportion(model, &limits, &checker)?;
        let weight: Vec<f64> = match &settings.velocity_weight {
            Some(w) => w.iter().map(|w| w * w).collect(),
            None => vec![1.0; nv],
        };
        let none = Interval {
            lower: f64::NEG_INFINITY,
            upper: f64::INFINITY,
            lower_kind: Kind::Acceleration,
            upper_kind: Kind::Acceleration,
            outside: None,
        };
        let zero = || vec![0.0; nv];
        let coupled = stages(model, each, &limits, &dofs, &weight, &settings)?;
        let cones = coupled.as_ref().map_or(0, |stages| stages.sources.cone_limits().count());
        let places = coupled.iter().flat_map(|stages| stages.sources.places());
        let places = places.map(|(.., place)| place.numbers).collect();
        Ok(Projector {
            couples: coupled.as_ref().is_some_and(|stages| stages.sources.couples_joints()),
            dynamics: Dynamics::new(model),
            checker,
            notes,
            moving: Moving::new(&limits, switches.len(), cones, places),
            in_force: limits.clone(),
            coupled,
            switches,
            external: zero(),
            previous: History::none(nv),
            before: zero(),
            accelerations: vec![FREE; model.nv()],
            braking: (0..nv).map(|i| Dof::of(&limits, i).braking(&period)).collect(),
            bounds: Bounds::new(nv),
            intervals: vec![none; nv],
            displacement: zero(),
            goal: zero(),
            v_next: zero(),
            consistent: vec![false; nv],
            clamped: vec![[false; 2]; nv],
            within: vec![FREE; nv],
            last: (Status::Unchanged, Rung::ClosedForm),
            normal: vec![0.0; model.nv()],
            asked: Proposal::new(model),
            v_wanted: zero(),
            outside: vec![false; model.nv()],
            pull: zero(),
            first: [model.neutral(), zero(), zero()],
            v_stop: zero(),
            tangent: zero(),
            backup: Backup::new(model, each, &dofs.controllable, &settings)?,
            integrated: model.neutral(),
            model: model.clone(),
            limits,
            dofs,
            settings,
            period,
            weight,
        })
    }
}

/// Rows of the user's own have each a name, by which they are reported and switched, and limits of frames may have one, by which they are moved.
fn check_names(model: &Model, limits: &[Box<dyn Limit>]) -> Result<(), LimitError> {
    for kind in ["frame", "frame_speed"] {
        let of_kind = limits.iter().filter(|limit| limit.name() == kind).map(|limit| limit.label());
        // Several limits of one frame may go by its name, and are moved together.
        let names: Vec<&str> = of_kind.filter(|name| model.find_frame(name).is_err()).collect();
        if let Some((_, name)) = names.iter().enumerate().find(|(i, name)| names[..*i].contains(name)) {
            let what = format!("two limits of kind {kind} are named '{name}'");
            return Err(LimitError::Unusable { what, next: "give each a name of its own" });
        }
    }
    let names: Vec<&str> =
        limits.iter().filter(|limit| limit.name() == "rows").map(|limit| limit.label()).collect();
    for (i, name) in names.iter().enumerate() {
        let what = match (name.trim().is_empty(), names[..i].contains(name)) {
            (true, _) => "a row has no name".to_owned(),
            (_, true) => format!("two rows are named '{name}'"),
            _ => continue,
        };
        return Err(LimitError::Unusable { what, next: "give each a name of its own" });
    }
    Ok(())
}

impl Dofs {
    fn new(model: &Model, controllable: &[usize], consistency: Consistency) -> Result<Dofs, LimitError> {
        let nv = model.nv();
        let mut sorted = controllable.to_vec();
        sorted.sort_unstable();
        if let Some(i) = sorted.iter().find(|i| **i >= nv) {
            let what = "controllable dof".to_string();
            return Err(LimitError::BadValue { what, value: *i as f64, domain: "below the model's nv" });
        }
        if let Some(pair) = sorted.windows(2).find(|w| w[0] == w[1]) {
            let what = format!("joint '{}' is controllable twice", model.dof_name(pair[0]));
            return Err(LimitError::Unusable { what, next: "name it once" });
        }
        let has = |i: usize| sorted.binary_search(&i).is_ok();
        for joint in model.joints().iter().filter(|_| consistency == Consistency::Kinematic) {
            let count = (joint.idx_v..joint.idx_v + joint.nv).filter(|i| has(*i)).count();
            if count != 0 && count != joint.nv {
                let what = format!(
                    "only {count} of the {} dofs of joint '{}' are controllable",
                    joint.nv, joint.name
                );
                return Err(LimitError::Unusable { what, next: "control all of them or none" });
            }
        }
        let single = (0..nv).map(|i| {
            let joint = model.joint_of_dof(i);
            (joint.nq == 1 && joint.nv == 1).then_some(joint.idx_q)
        });
        let single: Vec<Option<usize>> = single.collect();
        let curved = single.iter().any(Option::is_none);
        Ok(Dofs { fixed: (0..nv).filter(|i| !has(*i)).collect(), controllable: sorted, single, curved })
    }
}

/// "'a', 'b'" over the controllable dofs that are `wrong`.
fn named(model: &Model, dofs: &Dofs, wrong: impl Fn(usize) -> bool) -> String {
    let list = dofs.controllable.iter().filter(|i| wrong(**i));
    list.map(|i| format!("'{}'", model.dof_name(*i))).collect::<Vec<_>>().join(", ")
}

/// What a hard jerk needs, and what it is not kept together with.
fn check_jerk(
    model: &Model,
    limits: &LimitSet,
    dofs: &Dofs,
    consistency: Consistency,
) -> Result<(), LimitError> {
    let hard = |i: usize| limits.jerk[i].is_finite();
    let refused = |wrong: &dyn Fn(usize) -> bool, why: &str, next: &'static str| {
        let joints = named(model, dofs, |i| hard(i) && wrong(i));
        let what = format!("hard jerk of {joints} {why}");
        if joints.is_empty() { Ok(()) } else { Err(LimitError::Unusable { what, next }) }
    };
    let next = "add acceleration = { limit = ... } for them, or drop hard";
    refused(&|i| limits.acceleration[i].is_infinite(), "has no acceleration limit to brake with", next)?;
    let next = "set consistency = \"kinematic\" or drop the jerk limit";
    refused(
        &|_| consistency == Consistency::Free,
        "does not exist in free mode, where no acceleration is decided",
        next,
    )?;
    let next = "drop velocity_profile for them, or hard";
    refused(&|i| limits.profile[i] != [None, None], "is not kept together with a velocity profile", next)
}

/// A brake of bounded jerk slows each joint down in its own time, and not in proportion.
fn check_proportion(model: &Model, limits: &LimitSet, checker: &Checker) -> Result<(), LimitError> {
    for (names, dofs) in checker.in_proportion() {
        let joints = dofs.iter().filter(|i| limits.jerk[**i].is_finite());
        let joints = joints.map(|i| format!("'{}'", model.dof_name(*i))).collect::<Vec<_>>().join(", ");
        if !joints.is_empty() {
            let row = names.join("', '");
            let what = format!("row '{row}' holds {joints} at a value, which no brake of hard jerk keeps");
            return Err(LimitError::Unusable {
                what,
                next: "drop hard of the jerk, or give lower and upper",
            });
        }
    }
    Ok(())
}

/// The limits one by one.
fn switches(
    model: &Model,
    limits: &[Box<dyn Limit>],
    controllable: &[usize],
) -> Result<Vec<Switch>, LimitError> {
    let switch = |limit: &dyn Limit| {
        let mut set = LimitSet::unlimited(model.nv());
        limit.restrict(model, controllable, &mut set)?;
        Ok(Switch { kind: limit.name(), label: limit.label().to_string(), set, enabled: true })
    };
    limits.iter().map(|limit| switch(&**limit)).collect()
}

/// Limits that make no sense together.
pub(super) fn check_combination(
    model: &Model,
    limits: &LimitSet,
    dofs: &Dofs,
    (consistency, braking): (Consistency, Braking),
) -> Result<(), LimitError> {
    let names = |wrong: &dyn Fn(usize) -> bool| named(model, dofs, wrong);
    check_jerk(model, limits, dofs, consistency)?;
    match consistency {
        Consistency::Kinematic => {
            let joints = names(&|i| limits.has_position(i) && limits.acceleration[i].is_infinite());
            if !joints.is_empty() {
                let next = "add acceleration = { limit = ... }, in Python an AccelerationLimit: the deceleration their braking may count on";
                let limit = "position without acceleration";
                return Err(LimitError::Missing { limit, joints, next });
            }
        }
        Consistency::Free => {}
    }
    if braking == Braking::Stored {
        let joints = names(&|i| limits.braking[i].is_infinite());
        if !joints.is_empty() {
            let next = "add an acceleration limit, or set braking = \"certified\"";
            return Err(LimitError::Missing { limit: "a stored brake", joints, next });
        }
    }
    Ok(())
}

/// The stages for coupled rows and cones, when there are any.
fn stages(
    model: &Model,
    each: &[Box<dyn Limit>],
    limits: &LimitSet,
    dofs: &Dofs,
    weight: &[f64],
    settings: &Settings,
) -> Result<Option<Stages>, LimitError> {
    let period = Period::new(settings.dt, settings.sub_steps);
    let mut sources = Sources::new(model, (each, limits), &dofs.controllable)?;
    let free = settings.consistency == Consistency::Free;
    let labels = sources.labels();
    if let Some(label) = labels.first().filter(|_| free) {
        let what = format!(
            "limits on {} of {} in free mode, where no acceleration is decided",
            label.kind.name(),
            labels
                .iter()
                .filter(|l| l.kind == label.kind)
                .map(|l| format!("'{}'", l.name))
                .collect::<Vec<_>>()
                .join(", ")
        );
        return Err(LimitError::Unusable { what, next: "set consistency = \"kinematic\" or drop them" });
    }
    let wanted = !sources.is_empty() || settings.solver == Solver::Clarabel;
    if !wanted || free || dofs.controllable.is_empty() {
        return Ok(None);
    }
    let sigma: Vec<f64> = dofs.controllable.iter().map(|i| typical_change(limits, *i, settings.dt)).collect();
    let hessian: Vec<f64> = dofs.controllable.iter().map(|i| 2.0 * weight[*i]).collect();
    let worth = hessian.iter().zip(&sigma).fold(0.0, |most: f64, (h, sigma)| most.max(h * sigma * sigma));
    let scaled = |s: Soft| Soft { linear: s.linear * worth, quadratic: s.quadratic * worth };
    let soft = sources.softness().into_iter().map(|s| s.map(scaled)).collect();
    let cones: Vec<_> = sources.cones().into_iter().map(|(d, soft)| (d, soft.map(scaled))).collect();
    let mut problem = Coupled::new(hessian, soft, sources.equalities(), &cones, dofs.fixed.len());
    for k in 0..problem.n {
        (problem.lower[k], problem.upper[k]) = (-sigma[k], sigma[k]);
    }
    let (zero, neutral) = (vec![0.0; model.nv()], model.neutral());
    let mut dynamics = Dynamics::new(model);
    let rest = Measured { q: &neutral, v: &zero, external: &zero, previous: None };
    sources.fill(&mut problem, &mut dynamics, &rest, dofs, &zero, &period);
    problem.equality = sources.equalities(); // whether or not that state is outside of them
    let conic = Conic::new(&problem, sigma, settings.max_iter, settings.deadline)?;
    let (n, m) = (problem.n, problem.m);
    let polish = Polish::new(&problem);
    let dropped = vec![(0.0, 0.0); m + cones.len()];
    let (active_set, y) = (ActiveSet::new(n, m), vec![0.0; n]);
    let nearer = Nearer::new(&problem, sources.asks_more());
    let (slopes, slope) = (vec![0.0; (m + cones.len()) * n], vec![0.0; n]);
    let (exact, polished) = (false, false);
    Ok(Some(Stages {
        sources,
        labels,
        problem,
        active_set,
        conic,
        polish,
        y,
        exact,
        polished,
        dropped,
        nearer,
        slopes,
        slope,
    }))
}

/// A velocity change of the size to expect in one period [rad/s or m/s].
fn typical_change(limits: &LimitSet, dof: usize, dt: f64) -> f64 {
    let (a, v) = (limits.acceleration[dof], limits.velocity[dof]);
    match (a.is_finite(), v.is_finite()) {
        (true, _) => a * dt,
        (false, true) => v,
        (false, false) => 1.0,
    }
}
