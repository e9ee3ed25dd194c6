//! From a manifest and its settings to what is trained.

use super::{Experience, TrainError};
use crate::demos::DemoReward;
use crate::env::{Env, Spec};
use crate::learn::{
    Algorithm, Bc, Bco, CostLimited, Dapg, Dims, Gaifo, Gradient, Imitating, Kind, Learner, MOST_OUTPUTS,
    Nearl, Pid2, Pid2Il, Pid2Settings, Ppo, Soil,
};
use crate::rollout::RolloutError;
use crate::settings::{Exploration, TrainSettings};
use nearl_runtime::constraints::{Consistency, Guard};
use nearl_runtime::controller::{Parts, seen_entries};
use nearl_runtime::motors::Motors;
use nearl_runtime::recipe::Observer;
use nearl_runtime::task::{IdmKind, Task};
use nearl_runtime::{Manifest, PolicyKind};
use rand_chacha::ChaCha8Rng;

/// Fresh networks of the algorithm.
pub(super) fn learner(
    algo: Algorithm,
    manifest: &Manifest,
    settings: &TrainSettings,
    dims: Dims,
    threads: usize,
    rng: &mut ChaCha8Rng,
) -> Box<dyn Learner> {
    let (nets, ppo) = (&settings.nets, settings.ppo.clone());
    let kind = Kind {
        stochastic: manifest.policy == PolicyKind::Stochastic,
        learned: manifest.task.idm.kind == IdmKind::Learned,
    };
    let nearl = |settings, rng: &mut ChaCha8Rng| {
        Box::new(Nearl::new(dims.clone(), nets, ppo.clone(), settings, kind, threads, rng))
    };
    let pid2 = |bottleneck, rng: &mut ChaCha8Rng| {
        let warmup = warm_up_of_pid2(algo, settings);
        let own = Pid2Settings { warmup, ..settings.pid2.clone() };
        Pid2::new(dims.clone(), nets, ppo.clone(), own, kind, bottleneck, threads, rng)
    };
    let direct = |rng: &mut ChaCha8Rng| Ppo::new(dims.clone(), nets, ppo.clone(), threads, rng);
    let demos = settings.demos.clone();
    let (rows, likeness_lr) = (ppo.batch_size, settings.pid2.discriminator_lr);
    let learner: Box<dyn Learner> = match algo {
        Algorithm::Ppo => Box::new(direct(rng)),
        Algorithm::PpoCombined => nearl(settings.nearl.without_supervision(), rng),
        Algorithm::Nearl => nearl(settings.nearl.clone(), rng),
        Algorithm::Pid2Gan => Box::new(pid2(false, rng)),
        Algorithm::Pid2Ib => Box::new(pid2(true, rng)),
        Algorithm::Bc => Box::new(Imitating::<Bc>::new(pid2(true, rng), demos)),
        Algorithm::Soil => Box::new(Imitating::<Soil>::new(direct(rng), demos)),
        Algorithm::Dapg => Box::new(Imitating::<Dapg>::new(direct(rng), demos)),
        Algorithm::Pid2Il => {
            let likeness = demos.reward == DemoReward::Likeness;
            let imitating = Imitating::<Pid2Il>::new(pid2(true, rng), demos);
            Box::new(match likeness {
                true => imitating.by_likeness(&dims, nets, likeness_lr, rows, threads, rng),
                false => imitating,
            })
        }
        Algorithm::Bco => Box::new(Imitating::<Bco>::new(direct(rng), demos)),
        Algorithm::Gaifo => {
            let imitating = Imitating::<Gaifo>::new(direct(rng), demos);
            Box::new(imitating.by_likeness(&dims, nets, likeness_lr, rows, threads, rng))
        }
    };
    if !settings.cost.is_limited() {
        return learner;
    }
    Box::new(CostLimited::new(learner, settings.cost.clone(), &dims, nets, ppo, threads, rng))
}

/// Steps of the warm-up, which comes before the algorithm's first update.
pub(super) fn warm_up_steps(algo: Algorithm, settings: &TrainSettings, idm: IdmKind) -> u64 {
    match algo.demos() {
        // The robot's own equations learn from nothing; who puts out actions has an inverse model beside them that does.
        Some(_) if idm == IdmKind::Pinocchio && !algo.is_direct() => 0,
        Some(uses) if uses.warms_up => settings.demos.warmup,
        _ => warm_up_of_pid2(algo, settings),
    }
}

/// Demonstrations have a warm-up of their own.
pub(super) fn warm_up_of_pid2(algo: Algorithm, settings: &TrainSettings) -> u64 {
    match algo {
        Algorithm::Pid2Ib | Algorithm::Pid2Gan => settings.pid2.warmup,
        _ => 0,
    }
}

/// The warm-up of PID² finds what an action changes, for a policy that learns through the inverse model.
pub(super) fn check_warm_up(
    algo: Algorithm,
    settings: &TrainSettings,
    policy: PolicyKind,
) -> Result<(), TrainError> {
    let steps = warm_up_of_pid2(algo, settings);
    if steps == 0 || policy == PolicyKind::Deterministic {
        return Ok(());
    }
    Err(TrainError::Settings(format!(
        "[train.pid2.warmup]: {steps} steps, but here the policy explores in its proposals and does not learn through a learned inverse model; set it \
         to 0, or explore in the actions (idm.kind = \"learned\", exploration = \"action\")"
    )))
}

/// A limit on a cost needs one, and a learner that has it all from rewards.
pub(super) fn check_cost(algo: Algorithm, settings: &TrainSettings, spec: &Spec) -> Result<(), TrainError> {
    let limit = settings.cost.limit;
    if !settings.cost.is_limited() {
        return Ok(());
    }
    if !spec.has_cost {
        return Err(TrainError::Settings(format!(
            "[train.cost.limit]: {limit} an episode, but '{}' has no cost; write a [cost] into its task file, or leave the limit out",
            spec.name
        )));
    }
    if algo.demos().is_some() {
        return Err(TrainError::Settings(format!(
            "[train.cost.limit]: '{algo}' learns from demonstrations and keeps to no limit of {limit} on the cost; leave it out, or take ppo, \
             ppo-combined, nearl, pid2-gan or pid2-ib"
        )));
    }
    Ok(())
}

/// Sizes of the networks. A policy with a recipe sees what that computes, in which an inverse model would not find the state.
pub(super) fn dims(manifest: &Manifest, parts: &Parts, n_privileged: usize) -> Result<Dims, TrainError> {
    let (layout, policy) = (&parts.layout, manifest.task.policy.as_ref());
    let unusable = |reason| TrainError::Settings(format!("[policy] of '{}': {reason}", manifest.task.name));
    let observer = policy.map(|policy| Observer::new(policy, &parts.model, layout)).transpose();
    let observer = observer.map_err(unusable)?.flatten();
    let seen = match observer {
        Some(_) => Vec::new(),
        None => seen_entries(manifest, layout).map_err(RolloutError::from)?,
    };
    Ok(Dims {
        n_obs: observer.map_or(layout.n_obs(), |observer| observer.len()),
        n_privileged,
        n_state: layout.n_state(),
        n_act: manifest.action_lower.len(),
        seen_obs: seen.iter().map(|&k| layout.state()[k]).collect(),
        seen_state: seen,
    })
}

pub(super) fn policy_kind(
    algo: Algorithm,
    settings: &TrainSettings,
    task: &Task,
) -> Result<PolicyKind, TrainError> {
    let gradient = match algo {
        Algorithm::Nearl | Algorithm::PpoCombined => settings.nearl.gradient,
        _ => settings.pid2.gradient,
    };
    let coupled = task.constraints.consistency == Consistency::Kinematic;
    match (algo, settings.exploration, task.idm.kind) {
        (algo, ..) if algo.is_direct() => Ok(PolicyKind::Direct),
        (_, Exploration::Proposal, _) | (_, Exploration::Auto, IdmKind::Pinocchio) => Ok(PolicyKind::Stochastic),
        (_, _, IdmKind::Learned) if coupled && gradient != Gradient::StraightThrough => {
            Err(TrainError::Settings(format!(
                "[constraints.consistency]: 'kinematic' moves position and velocity of '{}' together, and the policy gradient through a learned \
                 inverse model passes clamped entries alone; use consistency = \"free\", or gradient = \"straight-through\" under [train.pid2] \
                 and [train.nearl]",
                task.name
            )))
        }
        (_, _, IdmKind::Learned) => Ok(PolicyKind::Deterministic),
        (_, Exploration::Action, IdmKind::Pinocchio) => Err(TrainError::Settings(
            "[train.exploration]: 'action' needs a learned inverse model, but idm.kind is 'pinocchio'; take it out, or use exploration = \"proposal\"".into(),
        )),
    }
}

/// Fills what the environment knows: observation names and the actuators' range. Returns the environment's constants.
///
/// # Errors
/// [`TrainError::Rollout`] when there is no such environment.
pub fn complete(manifest: &mut Manifest) -> Result<Spec, TrainError> {
    let env = crate::env::of_task(manifest, &manifest.task.name).map_err(RolloutError::from)?;
    let spec = env.spec();
    if manifest.task.state.observation.is_empty() {
        manifest.task.state.observation.clone_from(&spec.obs);
    }
    manifest.action_lower = spec.action_low().collect();
    manifest.action_upper = spec.action_high().collect();
    let guards = manifest.task.constraints.guard == Guard::Model;
    if manifest.task.idm.kind == IdmKind::Pinocchio || guards {
        check_motors(manifest, env.as_ref())?;
    }
    Ok(spec.clone())
}

/// Analytic inverse dynamics, and a guard, give one command a controllable joint: the actuators have to be these joints' motors or drives.
fn check_motors(manifest: &Manifest, env: &dyn Env) -> Result<(), TrainError> {
    let spec = env.spec();
    let Parts { model, layout, .. } = Parts::new(manifest).map_err(RolloutError::from)?;
    let controllable = layout.controllable();
    let drives = Parts::drives(manifest, &model, controllable).map_err(RolloutError::from)?;
    let joints: Vec<String> = controllable.iter().map(|dof| model.dof_name(*dof)).collect();
    let driven: Vec<&str> = spec.actuators.iter().map(|a| a.joint.as_str()).collect();
    let task = &manifest.task.name;
    if driven.len() != joints.len() || joints.iter().any(|joint| !driven.contains(&joint.as_str())) {
        return Err(TrainError::Settings(format!(
            "[idm] kind = \"pinocchio\" of '{task}' gives one torque a controllable joint ({}), but the actuators drive {}; \
             give each of these joints one motor, or take kind = \"learned\"",
            joints.join(", "),
            driven.join(", ")
        )));
    }
    Motors::new(&model, controllable, &drives)
        .map_err(|reason| TrainError::Settings(format!("[idm] of '{task}': {reason}")))?;
    Ok(())
}

pub(super) fn check_reward(task: &Task, experience: &Experience) -> Result<(), TrainError> {
    if matches!(experience, Experience::Scored(scorer) if scorer.rewards) {
        return Ok(());
    }
    let is_nothing = |v: &toml::Value| v.as_float() == Some(0.0) || v.as_integer() == Some(0);
    if task.reward.is_empty() || !task.reward.values().all(is_nothing) {
        return Ok(());
    }
    Err(TrainError::Settings(format!(
        "[reward] of '{}' is 0 whatever happens, and nothing can be learned from it; write what the task rewards",
        task.name
    )))
}

pub(super) fn check_outputs(task: &str, dims: &Dims) -> Result<(), TrainError> {
    let outputs = [("proposed entries", dims.n_state), ("actions", dims.n_act)];
    match outputs.into_iter().find(|(_, n)| *n > MOST_OUTPUTS) {
        None => Ok(()),
        Some((what, n)) => Err(TrainError::Settings(format!(
            "'{task}' has {n} {what}, and {MOST_OUTPUTS} can be learned; name fewer under state.propose"
        ))),
    }
}

/// Settings that environments of this process alone can follow.
pub(super) fn check_experience(
    settings: &TrainSettings,
    task: &Task,
    experience: &Experience,
) -> Result<(), TrainError> {
    let (source, next) = match experience {
        Experience::Here | Experience::Scored(_) | Experience::Ranks(_) => return Ok(()),
        Experience::Loop(name, _) => (format!("the loop of '{name}'"), "--from"),
        Experience::Served(name, _) => (format!("the rollout server '{name}'"), "--collect"),
    };
    if settings.limits_in > 0.0 {
        return Err(TrainError::Settings(format!(
            "[train.limits_in]: {} asks for limits that come in one environment after another, and {source} projects in all of them; set it to 0, \
             or train without {next}",
            settings.limits_in
        )));
    }
    if !task.state.privileged.is_empty() && matches!(experience, Experience::Loop(..)) {
        return Err(TrainError::Settings(format!(
            "[state.privileged]: {source} knows no more of a robot than its policy sees; take it out, or train without {next}"
        )));
    }
    if matches!(experience, Experience::Loop(..))
        && let Some((key, name)) = followed(task)
    {
        return Err(TrainError::Settings(format!(
            "[{key}] reads '{name}', which is followed through the physics steps of a period, and {source} tells where each period begins and ends; take it \
             out, or train without {next}"
        )));
    }
    if task.constraints.reached.is_some() && matches!(experience, Experience::Loop(..)) {
        return Err(TrainError::Settings(format!(
            "[constraints.reached]: {source} learns margins of its own, without which its ticks cannot be computed again; take it out, or train \
             without {next}"
        )));
    }
    if !settings.project_in_training && matches!(experience, Experience::Loop(..)) {
        return Err(TrainError::Settings(format!(
            "[train.project_in_training]: {source} projects every target of a robot; set it to true, or train without {next}"
        )));
    }
    Ok(())
}

/// The first name in a reward, cost or end of the task that is followed from physics step to physics step, with its key.
fn followed(task: &Task) -> Option<(String, String)> {
    const NAMES: [&str; 3] = ["power", "du.squared", "dtorque.max"];
    const BEGIN: [&str; 6] = ["torque.", "load.", "contact.", "air.", "landed.", "cfrc."];
    let is_followed = |name: &&str| NAMES.contains(name) || BEGIN.iter().any(|begin| name.starts_with(begin));
    let sections = [("reward", &task.reward), ("cost", &task.cost), ("termination", &task.termination)];
    sections.into_iter().find_map(|(section, terms)| {
        terms.iter().find_map(|(key, text)| {
            let words = text.as_str()?.split(|c: char| !(c.is_alphanumeric() || "._".contains(c)));
            let name = words.map(|word| word.trim_matches('.')).find(is_followed)?;
            Some((format!("{section}.{key}"), name.to_owned()))
        })
    })
}

pub(super) fn check_minibatch(minibatch: usize, batch: usize) -> Result<(), TrainError> {
    if minibatch == 0
        || !minibatch.is_multiple_of(crate::learn::optimise::TILE)
        || !batch.is_multiple_of(minibatch)
    {
        return Err(TrainError::Settings(format!(
            "[train.ppo.batch_size]: {minibatch} must be a multiple of 32 that divides n_envs n_steps = {batch}"
        )));
    }
    Ok(())
}

/// What the limits allow in one policy period: `a_max T` for velocities, `v_max T` for positions.
///
/// # Errors
/// [`TrainError::Settings`] for an entry without such limits.
pub fn limit_scale(parts: &Parts, manifest: &Manifest) -> Result<Vec<f64>, TrainError> {
    use nearl_runtime::constraints::Entry;
    let period = manifest.task.time.dt * manifest.task.time.policy_every as f64;
    let limits = parts.projector.limits();
    let (velocity, acceleration) = (&limits.velocity, &limits.acceleration);
    (0..parts.layout.n_state())
        .map(|k| {
            let scale = match parts.layout.state_entry(k) {
                Entry::Position { dof, .. } => velocity[dof] * period,
                Entry::Velocity { dof } => acceleration[dof] * period,
                Entry::Other => f64::INFINITY,
            };
            let name = parts.layout.state_name(k);
            let of = &manifest.task.name;
            match parts.layout.state_entry(k) {
                _ if scale.is_finite() && scale > 0.0 => Ok(scale),
                Entry::Other => Err(TrainError::Settings(format!(
                    "changes of '{of}' cannot be scaled by its limits (actions = \"change\", change_scale = \"limits\"): '{name}' is no position or velocity \
                     of a joint; name those that a policy proposes under [state] propose, e.g. propose = [\"q.JOINT\", \"v.JOINT\"]"
                ))),
                _ => Err(TrainError::Settings(format!(
                    "changes of '{of}' cannot be scaled by its limits (actions = \"change\", change_scale = \"limits\"): no velocity or acceleration limit \
                     bounds '{name}'; give velocity and acceleration under [constraints], or leave '{name}' out of [state] propose"
                ))),
            }
        })
        .collect()
}
