//! Warnings that are printed before a training begins.

use super::TrainError;
use super::setup::warm_up_steps;
use crate::demos::{DemoError, Demonstrations};
use crate::env::{ChaCha8Rng, Fault, SeedableRng, convert, unstated_steps};
use crate::learn::{Algorithm, NearlSettings, Pid2Settings};
use crate::rollout::RolloutError;
use crate::settings::TrainSettings;
use nearl_runtime::constraints::STOP_GAPS;
use nearl_runtime::constraints::description::Motor;
use nearl_runtime::controller::Parts;
use nearl_runtime::task::IdmKind;
use nearl_runtime::{Manifest, PolicyKind};
use std::path::Path;
use toml::Table;

/// Resets looked at, and their seed.
const RESETS: (usize, u64) = (64, 1);

/// One sentence for each thing about the task that runs and is hardly meant, with what to change: what [`doctor::advice`] finds, a penalty that
/// nothing is taken off by, and joints that an episode may begin with outside their limits. `manifest` is [`complete`](super::complete).
///
/// # Errors
/// [`TrainError`] of a task that cannot be trained at all.
///
/// [`doctor::advice`]: nearl_runtime::doctor::advice
pub fn advice(algo: Algorithm, manifest: &Manifest) -> Result<Vec<String>, TrainError> {
    let mut manifest = manifest.clone();
    if algo.is_direct() {
        manifest.policy = PolicyKind::Direct;
    }
    let mut lines = nearl_runtime::doctor::advice(&manifest)?;
    lines.extend(vain_penalty(algo, &manifest)?);
    lines.extend(vain_model(algo, &manifest)?);
    lines.extend(vain_draws(&manifest));
    lines.extend(beginnings(&manifest)?);
    let own = TrainSettings::read(&manifest.task.train).map_err(TrainError::Settings)?.demos;
    if algo.demos().is_some() && !own.file.is_empty() && manifest.proposes() {
        let demos = Demonstrations::load(Path::new(&own.file))?;
        let wrong = |reason| TrainError::Demos(DemoError::Wrong { file: own.file.clone(), reason });
        lines.extend(demonstrated(&demos.first(own.episodes).map_err(wrong)?, &manifest)?);
    }
    Ok(lines)
}

/// A penalty on what the projection moves, of actions that nothing projects.
fn vain_penalty(algo: Algorithm, manifest: &Manifest) -> Result<Option<String>, TrainError> {
    let penalty = TrainSettings::read(&manifest.task.train).map_err(TrainError::Settings)?.moved_penalty;
    Ok((penalty > 0.0 && !manifest.proposes()).then(|| {
        format!(
            "train.moved_penalty is {penalty} and takes nothing off any reward: no projection moves what '{algo}' puts out; write guard = true under \
             [constraints], or leave it out"
        )
    }))
}

/// Settings of the way through a learned inverse model, where the robot's own equations are the inverse model.
fn vain_model(algo: Algorithm, manifest: &Manifest) -> Result<Option<String>, TrainError> {
    if algo.is_direct() || manifest.task.idm.kind == IdmKind::Learned {
        return Ok(None);
    }
    let settings = TrainSettings::read(&manifest.task.train).map_err(TrainError::Settings)?;
    let differ =
        |own: Result<Table, _>, usual: Result<Table, toml::ser::Error>, keys: &[&str], section: &str| {
            let (own, usual) = (own.unwrap_or_default(), usual.unwrap_or_default());
            let changed = keys.iter().filter(|key| own.get(**key) != usual.get(**key));
            changed.map(|key| format!("train.{section}.{key}")).collect::<Vec<_>>()
        };
    let vain = match algo {
        Algorithm::Nearl | Algorithm::PpoCombined => {
            let (own, usual) = (Table::try_from(&settings.nearl), Table::try_from(NearlSettings::default()));
            differ(own, usual, &["gradient", "idm_threshold", "idm_threshold_per", "idm_lr"], "nearl")
        }
        _ => {
            let (own, usual) = (Table::try_from(&settings.pid2), Table::try_from(Pid2Settings::default()));
            let keys = [
                "bound_weight",
                "gradient",
                "null_space",
                "keep_actions",
                "idm_policy_gradient",
                "idm_threshold",
                "idm_threshold_per",
                "idm_lr",
            ];
            differ(own, usual, &keys, "pid2")
        }
    };
    Ok((!vain.is_empty()).then(|| {
        format!(
            "idm.kind is \"pinocchio\": the policy explores in its proposals, and no gradient passes projection and inverse model, so that {} would change \
             nothing; leave {} out, or take idm.kind = \"learned\"",
            vain.join(", "),
            if vain.len() == 1 { "it" } else { "them" }
        )
    }))
}

/// Commands that are drawn and that the policy does not see, and a curriculum whose level nothing reads.
fn vain_draws(manifest: &Manifest) -> Vec<String> {
    let task = &manifest.task;
    let is_drawn =
        |value: &toml::Value| value.as_str().is_some_and(|text| text.contains(char::is_alphabetic));
    let sees = |name: &str| {
        let entry = format!("command.{name}");
        task.state.observation.is_empty() || task.state.observation.contains(&entry)
    };
    let unseen =
        task.commands.iter().filter(|(name, value)| *name != "every" && is_drawn(value) && !sees(name));
    let mut lines: Vec<String> = unseen
        .map(|(name, _)| {
            format!(
                "[commands] {name} is drawn, and the policy does not see it; add \"command.{name}\" to [state] observation, or write one value for all \
                 episodes"
            )
        })
        .collect();
    let sections = [
        &task.commands,
        &task.pushes,
        &task.random,
        &task.noise,
        &task.delay,
        &task.reset,
        &task.reward,
        &task.cost,
        &task.termination,
        &task.metrics,
    ];
    let reads_level = |section: &&toml::Table| section.to_string().contains("level");
    if !task.curriculum.is_empty()
        && !sections.iter().any(reads_level)
        && !task.state.observation.iter().any(|name| name == "level")
    {
        lines.push(
            "[curriculum] has a level that nothing reads; write it into what is to grow with it, as \
                    mass = \"1 + 0.2 * level * uniform\" in [random]"
                .into(),
        );
    }
    lines
}

/// A sentence for each of the settings `set` (`key=value`) that none of the algorithms reads.
pub fn unread(algos: &[Algorithm], set: &[String]) -> Vec<String> {
    let reads = |section: &str, algo: &Algorithm| match section {
        "nearl" => matches!(algo, Algorithm::Nearl | Algorithm::PpoCombined),
        "pid2" => algo.reads_pid2(),
        "demos" => algo.demos().is_some(),
        _ => true,
    };
    let names = algos.iter().map(|algo| format!("'{algo}'")).collect::<Vec<_>>().join(" and ");
    let vain = set.iter().filter_map(|set| {
        let key = set.split('=').next().unwrap_or_default().trim();
        let section = key.strip_prefix("train.")?.split('.').next()?;
        let is_read = algos.iter().any(|algo| reads(section, algo));
        (!is_read).then(|| {
            format!(
                "{key} changes nothing: {names} {} no [train.{section}]; leave it out",
                match algos.len() {
                    1 => "reads",
                    _ => "read",
                }
            )
        })
    });
    vain.collect()
}

/// Says so where a run of `steps` ends before a reward or a demonstration is read: the first batch fills the statistics, and a warm-up reads neither.
/// Nothing of one without a warm-up that clones demonstrations.
///
/// # Errors
/// [`TrainError`] of settings that cannot be read.
pub fn ends_in_warm_up(
    algo: Algorithm,
    steps: u64,
    manifest: &Manifest,
) -> Result<Option<String>, TrainError> {
    let settings = TrainSettings::read(&manifest.task.train).map_err(TrainError::Settings)?;
    let batch = (settings.n_envs * settings.n_steps) as u64;
    let warmup = warm_up_steps(algo, &settings, manifest.task.idm.kind);
    let end = batch * (1 + warmup.div_ceil(batch));
    let (unread, shorter) = match algo.demos() {
        Some(uses) if uses.warms_up => ("demonstrations", "shorten the warm-up with train.demos.warmup"),
        _ => ("a reward", "leave the warm-up out with train.pid2.warmup=0"),
    };
    if warmup == 0 {
        return Ok((algo.demos().is_none() && steps <= batch).then(|| {
            format!(
                "the run ends after {steps} steps, and the first batch, which fills the statistics of the observations, takes {batch}: nothing is \
                 learned; give it more, or smaller batches with train.n_envs and train.n_steps"
            )
        }));
    }
    Ok((steps <= end).then(|| {
        format!(
            "the run ends after {steps} steps, and first batch and warm-up take {end}: nothing is learned from {unread}; give it more, or {shorter}"
        )
    }))
}

/// Where a joint was furthest outside, and in how many of the states looked at.
#[derive(Clone, Copy, Default)]
struct Outside {
    by: f64,
    value: f64,
    states: usize,
}

/// What is outside.
#[derive(Clone, Copy, PartialEq)]
enum What {
    Position,
    /// Where a joint that is inside comes to rest.
    Rest,
    Velocity,
}

impl What {
    /// The limit that gives it more room.
    fn limit(self) -> &'static str {
        match self {
            What::Position | What::Rest => "position",
            What::Velocity => "velocity",
        }
    }
}

/// States of one task, held against the limits of its joints.
struct States {
    parts: Parts,
    /// Configuration and velocity, Pinocchio's convention.
    state: (Vec<f64>, Vec<f64>),
    /// Position and velocity of each dof, and where it comes to rest.
    found: Vec<[Outside; 3]>,
}

impl States {
    fn of(manifest: &Manifest) -> Result<Self, TrainError> {
        let parts = Parts::new(manifest)?;
        let (nq, nv) = (parts.model.nq(), parts.model.nv());
        Ok(Self { parts, state: (vec![0.0; nq], vec![0.0; nv]), found: vec![[Outside::default(); 3]; nv] })
    }

    /// Looks at the state that is written.
    fn look(&mut self, write: impl FnOnce(&mut [f64], &mut [f64])) {
        let (Parts { model, layout, projector }, (q, v)) = (&self.parts, &mut self.state);
        let limits = projector.limits();
        write(q, v);
        for &i in layout.controllable() {
            let at = q[model.joint_of_dof(i).idx_q];
            let beyond = |q: f64| (limits.q_lower[i] - q).max(q - limits.q_upper[i]);
            let rest = at + 0.5 * v[i] * v[i].abs() / limits.braking[i].min(limits.acceleration[i]);
            let tolerance = 1.5 * STOP_GAPS[1];
            let by = [beyond(at), v[i].abs() - limits.velocity[i], beyond(rest)];
            let is_inside = by[0] <= tolerance && by[1] <= tolerance;
            for (k, (by, value)) in by.into_iter().zip([at, v[i], rest]).enumerate() {
                let outside = &mut self.found[i][k];
                if by > tolerance && (k < 2 || is_inside) {
                    outside.states += 1;
                    if by > outside.by {
                        (outside.by, outside.value) = (by, value);
                    }
                }
            }
        }
    }

    /// A sentence for each joint that was outside. `whose` leads to the joint, as `64 episodes begin with`; `next` is what comes of it and what
    /// helps.
    fn sentences(&self, whose: &str, next: impl Fn(What) -> String) -> Vec<String> {
        let (Parts { model, layout, projector }, mut lines) = (&self.parts, Vec::new());
        let limits = projector.limits();
        for &i in layout.controllable() {
            let (name, [position, velocity, rest]) = (model.dof_name(i), self.found[i]);
            let mut say = |outside: Outside, how: &str, unit: &str, range: &str, what: What| {
                if outside.states > 0 {
                    lines.push(format!(
                        "{} of {whose} joint '{name}' {how} {:.4} {unit} where {range} is allowed: {}",
                        outside.states,
                        outside.value,
                        next(what)
                    ));
                }
            };
            let range = format!("{} to {}", limits.q_lower[i], limits.q_upper[i]);
            let there = "outside its limits, furthest at";
            say(position, there, "rad or m", &range, What::Position);
            let gone = "too fast to stop before the end of its range, furthest on to";
            say(rest, gone, "rad or m", &range, What::Rest);
            let range = format!("-{0} to {0}", limits.velocity[i]);
            say(velocity, there, "rad/s or m/s", &range, What::Velocity);
        }
        lines
    }
}

/// Whether its simulation states its physics step, and joints that an episode may begin with outside their limits, a sentence each.
///
/// # Errors
/// [`TrainError`] of a task that cannot be simulated.
pub(crate) fn beginnings(manifest: &Manifest) -> Result<Vec<String>, TrainError> {
    let mut states = States::of(manifest)?;
    let mut env = crate::env::of_task(manifest, &manifest.task.name).map_err(RolloutError::from)?;
    let unstated = unstated_steps(manifest, env.spec());
    let mut rng = ChaCha8Rng::seed_from_u64(RESETS.1);
    let nothing: Vec<f64> = {
        let ranges = env.spec().action_low().zip(env.spec().action_high());
        ranges.map(|(low, high)| 0.0_f64.max(low).min(high)).collect()
    };
    let mut ended = 0;
    for _ in 0..RESETS.0 {
        env.reset(&mut rng).map_err(RolloutError::from)?;
        states.look(|q, v| env.state(q, v));
        let step = env.step(&nothing);
        ended += usize::from(step.terminated && step.fault == Fault::None);
    }
    let mut lines = Vec::from_iter(unstated);
    let is_own = !manifest.task.reward.is_empty();
    // Of a drive, 0 is a place to go to.
    let by_force = |motor: &Motor| motor.bias[1] == 0.0 && motor.bias[2] == 0.0;
    if is_own && ended == RESETS.0 && states.parts.model.motors().iter().all(by_force) {
        lines.push(format!(
            "{ended} of {0} episodes end with their first control period, without an action: a condition of [termination] holds at once ({1}); compare what it \
             reads with a number",
            RESETS.0,
            manifest.task.termination.keys().cloned().collect::<Vec<_>>().join(", ")
        ));
    }
    lines.extend(states.sentences(&format!("{} episodes begin with", RESETS.0), |what| match is_own {
        true if what == What::Rest => {
            "it goes there and comes back; draw it further inside or slower in [reset], or give constraints.position more room".into()
        }
        true => format!(
            "it comes back before it does anything else; draw it inside in [reset], or give constraints.{} more room",
            what.limit()
        ),
        false => format!(
            "it comes back before it does anything else; the bundled task draws it there, and no setting changes that: train on, or give \
             constraints.{} more room, or write a task of your own with [reward] and [reset] (docs: Train for your own robot)",
            what.limit()
        ),
    }));
    Ok(lines)
}

/// Joints that are outside their limits in demonstrated states, a sentence each; nothing of demonstrations of another robot, which
/// [`Demonstrations::check`] refuses. `manifest` is [`complete`](super::complete).
///
/// # Errors
/// [`TrainError`] of a task that cannot be simulated.
pub(crate) fn demonstrated(demos: &Demonstrations, manifest: &Manifest) -> Result<Vec<String>, TrainError> {
    let mut states = States::of(manifest)?;
    let env = crate::env::of_task(manifest, &manifest.task.name).map_err(RolloutError::from)?;
    let (nq, nv) = (env.qpos().len(), env.qvel().len());
    if demos
        .episodes
        .iter()
        .any(|e| (e.qpos.len(), e.qvel.len()) != ((e.length + 1) * nq, (e.length + 1) * nv))
    {
        return Ok(Vec::new());
    }
    let mut all = 0;
    for (qpos, qvel) in
        demos.episodes.iter().flat_map(|e| e.qpos.chunks_exact(nq).zip(e.qvel.chunks_exact(nv)))
    {
        states.look(|q, v| convert(env.spec(), (qpos, qvel), q, v));
        all += 1;
    }
    Ok(states.sentences(&format!("{all} demonstrated states have"), |what| {
        format!(
            "what is projected does not follow it there; demonstrate inside the limits of this robot, or give constraints.{} more room",
            what.limit()
        )
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::preset::Preset;
    use crate::tasks;

    /// What a guard cannot be beside is to be taken out first.
    #[test]
    fn limits_that_hold_for_nothing_lead_to_a_task_that_is_taken() {
        for (own, first) in [
            ("velocity.limit=10.0", "guard is off; add guard = true"),
            ("reached=0.02", "guard is off; take reached out and add guard = true"),
            ("action.square=2.0", "guard is off; take [constraints.action] out and add guard = true"),
        ] {
            let set = vec!["constraints.velocity.limit=8.0".into(), format!("constraints.{own}")];
            let mut manifest = tasks::load_with("HalfCheetah-v5", None, &set).expect("task");
            crate::train::complete(&mut manifest).expect("environment");
            let lines = advice(Algorithm::Ppo, &manifest).expect("advice");
            assert!(lines.iter().any(|line| line.contains(first)), "{own}: {lines:?}");
        }
    }

    /// A command that the policy does not see, and a level that nothing reads.
    #[test]
    fn draws_that_change_nothing_are_named() {
        let said = |set: &[&str]| {
            let set: Vec<String> = set.iter().map(|s| (*s).into()).collect();
            vain_draws(&tasks::load_with("HalfCheetah-v5", None, &set).expect("task"))
        };
        let seen = "state.observation=[\"q.rooty\", \"command.vx\"]";
        assert_eq!(said(&["commands.vx=\"uniform\""]), [""; 0], "without a list all are observed");
        assert_eq!(said(&["commands.vx=\"uniform\"", seen]), [""; 0]);
        assert_eq!(
            said(&["commands.vx=0.5", "commands.every=2.0", "state.observation=[\"q.rooty\"]"]),
            [""; 0],
            "one value"
        );
        let lines = said(&["commands.vx=\"uniform\"", "commands.vy=\"normal\"", seen]);
        assert!(lines.len() == 1 && lines[0].contains("[commands] vy is drawn"), "{lines:?}");
        let grows = ["curriculum.step=0.1", "curriculum.up=\"length > 0.5\""];
        let lines = said(&grows);
        assert!(
            lines.len() == 1 && lines[0].starts_with("[curriculum] has a level that nothing reads"),
            "{lines:?}"
        );
        assert_eq!(said(&[&grows[..], &["random.mass=\"1 + level * uniform\""]].concat()), [""; 0]);
    }

    #[test]
    fn settings_of_an_inverse_model_that_does_not_learn_are_named() {
        let said = |algo, set: &[&str]| {
            let set: Vec<String> = set.iter().map(|s| (*s).into()).collect();
            let mut manifest = tasks::load_with("Panda-reach", None, &set).expect("task");
            crate::train::complete(&mut manifest).expect("environment");
            let lines = advice(algo, &manifest).expect("advice");
            lines.into_iter().find(|line| line.contains("would change nothing"))
        };
        let both = ["train.pid2.bound_weight=5", "train.pid2.idm_lr=1e-3"];
        let line = said(Algorithm::Pid2Ib, &both).expect("advice");
        assert!(line.contains("train.pid2.bound_weight, train.pid2.idm_lr would change nothing"), "{line}");
        assert_eq!(said(Algorithm::Pid2Ib, &["train.pid2.idm_lr=3e-4", "train.pid2.lr=1e-3"]), None);
        assert_eq!(said(Algorithm::Nearl, &both), None, "what another algorithm reads");
        assert!(said(Algorithm::Nearl, &["train.nearl.idm_threshold=0.1"]).is_some());
        assert_eq!(said(Algorithm::Ppo, &both), None);
    }

    /// As where the comparison was forgotten: any value that is not 0 counts as true.
    #[test]
    fn a_condition_that_ends_every_episode_at_once_is_told() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/tasks/cart-pole.toml");
        let told = |condition: &str| {
            let set = [format!("termination={{ far = \"{condition}\" }}")];
            let mut manifest = tasks::load_with(&file.display().to_string(), None, &set).expect("task");
            crate::train::complete(&mut manifest).expect("environment");
            advice(Algorithm::Ppo, &manifest).expect("advice").join("\n")
        };
        let forgotten = told("abs(v.hinge) + 0.1");
        assert!(
            forgotten.contains("64 of 64 episodes end with their first control period")
                && forgotten.contains("(far)"),
            "{forgotten}"
        );
        assert!(!told("abs(v.hinge) > 100").contains("first control period"));
    }

    #[test]
    fn settings_that_no_algorithm_of_the_run_reads_are_named() {
        let set = ["train.pid2.lr=1e-3", "train.ppo.lr=1e-3", "train.n_envs=8", "train.nearl.idm_lr=1e-3"];
        let set = set.map(String::from);
        let said = |algos: &[Algorithm]| unread(algos, &set).join("\n");
        let ppo = said(&[Algorithm::Ppo]);
        assert!(
            ppo.starts_with("train.pid2.lr changes nothing: 'ppo' reads no [train.pid2]; leave it out"),
            "{ppo}"
        );
        assert!(ppo.contains("train.nearl.idm_lr") && ppo.lines().count() == 2, "{ppo}");
        assert_eq!(said(&[Algorithm::Ppo, Algorithm::Pid2Ib, Algorithm::Nearl]), "", "one of them reads it");
        let two = said(&[Algorithm::Ppo, Algorithm::Gaifo]);
        assert_eq!(
            two,
            "train.nearl.idm_lr changes nothing: 'ppo' and 'gaifo' read no [train.nearl]; leave it out"
        );
    }

    /// The robot's own equations learn from no noise.
    #[test]
    fn an_inverse_model_that_does_not_learn_is_not_warmed_up() {
        let manifest = tasks::load_with("Panda-reach", None, &[]).expect("task");
        for (algo, warms_up) in [(Algorithm::Bc, false), (Algorithm::Pid2Il, false), (Algorithm::Soil, true)]
        {
            assert_eq!(ends_in_warm_up(algo, 1, &manifest).expect("settings").is_some(), warms_up, "{algo}");
        }
    }

    /// 2048 steps a batch: one for the statistics and eight of the warm-up.
    #[test]
    fn a_run_that_ends_in_its_warm_up_is_told_so() {
        let said = |algo, steps, set: &[&str]| {
            let set: Vec<String> = set.iter().map(|s| (*s).into()).collect();
            let manifest = tasks::load_with("Hopper-v5", Some(Preset::Strong), &set).expect("task");
            ends_in_warm_up(algo, steps, &manifest).expect("settings")
        };
        let short = said(Algorithm::Pid2Ib, 18_432, &[]).expect("too short");
        assert!(
            short.starts_with("the run ends after 18432 steps, and first batch and warm-up take 18432"),
            "{short}"
        );
        assert_eq!(said(Algorithm::Pid2Ib, 18_433, &[]), None);
        let single = said(Algorithm::Ppo, 2048, &[]).expect("too short");
        assert!(single.contains("takes 2048: nothing is learned"), "{single}");
        assert_eq!(said(Algorithm::Ppo, 2049, &[]), None);
        let cloned = said(Algorithm::Pid2Il, 18_432, &[]).expect("too short");
        assert!(
            cloned.contains("warm-up take 18432: nothing is learned from demonstrations")
                && cloned.ends_with("with train.demos.warmup"),
            "{cloned}"
        );
        assert_eq!(said(Algorithm::Pid2Il, 18_433, &[]), None);
        assert_eq!(said(Algorithm::Ppo, 10_000, &[]), None);
        assert_eq!(said(Algorithm::Pid2Ib, 10_000, &["train.pid2.warmup=0"]), None);
    }
}
