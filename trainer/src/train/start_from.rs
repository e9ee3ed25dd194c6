//! A training that starts from the networks of another one.

use super::resume::{MARGINS, take_group, take_statistics};
use super::setup::{dims, limit_scale, warm_up_of_pid2};
use super::{Experience, Request, TrainError, Training};
use crate::checkpoint::{self, Checkpoint};
use crate::learn::Algorithm;
use crate::settings::{ChangeScale, TrainSettings};
use nearl_runtime::controller::Parts;
use nearl_runtime::task::IdmKind;
use nearl_runtime::{Manifest, PolicyKind};
use std::path::Path;

impl Training {
    /// [`Training::on`] with the networks and statistics of the run in folder `run` in place of fresh ones. Limits, reward, reset, seed and algorithm
    /// may be others; what the networks read and put out may not, nor their sizes. Optimisers, episodes and schedules begin anew, and there is no
    /// warm-up. Networks that the run had none of are fresh.
    ///
    /// # Errors
    /// [`TrainError`]: what [`Training::on`] refuses, a run without a checkpoint, or networks that do not fit.
    pub fn start_from(request: &Request, experience: &Experience, run: &Path) -> Result<Self, TrainError> {
        let file = checkpoint::path_in(run);
        if !file.is_file() {
            return Err(TrainError::Settings(format!(
                "start_from: '{}' is no run folder with something learned: there is no '{}'; give the folder that 'nearl train' wrote",
                run.display(),
                file.display()
            )));
        }
        let mut from = Checkpoint::load(&file)?;
        let mut training = Self::on(request, experience)?;
        if training.imitation.is_some() {
            return Err(TrainError::Settings(format!(
                "start_from: '{}' begins with its demonstrations; leave one of both out",
                request.algo
            )));
        }
        let refuse = |reason| {
            TrainError::Settings(format!(
                "start_from: the networks of '{}' do not fit '{}': {reason}",
                run.display(),
                request.manifest.task.name
            ))
        };
        let ours = &training.snapshot.manifest;
        if let Some(reason) = misfit(&from.header.manifest, training.algo, ours, &training.settings)? {
            return Err(refuse(reason));
        }
        let theirs = &from.header.manifest;
        training.origin = Some(serde_json::json!({
            "run": run, "task": theirs.task.name, "algo": theirs.algo, "seed": from.header.seed, "steps": theirs.steps
        }));
        let their_settings = TrainSettings::read(&theirs.task.train).map_err(TrainError::Settings)?;
        let fresh_spread = their_settings.ppo.log_std != training.settings.ppo.log_std;
        training.take(&mut from, fresh_spread).map_err(refuse)?;
        Ok(training)
    }

    /// Whether it started from the networks of another training, and has no warm-up.
    pub fn starts_warm(&self) -> bool {
        self.starts_warm
    }

    /// What it started from, as `env.json` has it.
    pub fn origin(&self) -> Option<&serde_json::Value> {
        self.origin.as_ref()
    }

    /// Takes what fits. A `log_std` that is not that of the run is meant, and stays.
    fn take(&mut self, from: &mut Checkpoint, fresh_spread: bool) -> Result<(), String> {
        let same = from.header.manifest.algo == self.snapshot.manifest.algo;
        let spreads = if fresh_spread { self.learner.spreads() } else { Vec::new() };
        self.learner.restore(&mut |params| {
            params.beta = from.take_f32("beta", 1)?[0];
            let own: Vec<_> =
                spreads.iter().map(|range| params.groups[0].p[range.clone()].to_vec()).collect();
            // policy, with its inverse model, and value
            (0..2).try_for_each(|n| take_group(params, n, from))?;
            for (range, own) in spreads.iter().zip(&own) {
                params.groups[0].p[range.clone()].copy_from_slice(own);
            }
            // the others are fresh where the run had none of their size
            for n in (2..params.groups.len()).filter(|_| same) {
                let _ = take_group(params, n, from);
            }
            Ok(())
        })?;
        take_statistics(self, from)?;
        let n = self.snapshot.networks.margins.len();
        if n > 0
            && let Ok(margins) = from.take_f64(MARGINS, Some(n))
        {
            self.snapshot.networks.margins = margins;
        }
        (self.warm_ups, self.starts_warm) = (0, true);
        let normaliser = self.normaliser();
        self.renew(&normaliser);
        Ok(())
    }
}

/// What networks of `theirs` read or put out that is not that of `ours`, or another size.
fn misfit(
    theirs: &Manifest,
    algo: Algorithm,
    ours: &Manifest,
    settings: &TrainSettings,
) -> Result<Option<String>, TrainError> {
    let their_algo: Algorithm = theirs.algo.parse().map_err(TrainError::Algorithm)?;
    let their_settings = TrainSettings::read(&theirs.task.train).map_err(TrainError::Settings)?;
    let (their_parts, parts) = (Parts::new(theirs)?, Parts::new(ours)?);
    let proposed = |parts: &Parts| -> Vec<String> {
        (0..parts.layout.n_state()).map(|k| parts.layout.state_name(k).to_string()).collect()
    };
    let read = |m: &Manifest| m.task.state.observation.clone();
    let private = |m: &Manifest| m.task.state.privileged.clone();
    let differ = [
        ("the observation", "state.observation", read(theirs), read(ours)),
        ("what the value sees besides", "state.privileged", private(theirs), private(ours)),
        ("the proposed state", "state.propose", proposed(&their_parts), proposed(&parts)),
    ];
    for (what, key, theirs, ours) in differ {
        if let Some(reason) = other_entry(what, key, &theirs, &ours) {
            return Ok(Some(reason));
        }
    }
    let (have, need) = (theirs.action_lower.len(), ours.action_lower.len());
    if have != need {
        return Ok(Some(format!("its actions have {have} entries, and {need} are needed")));
    }
    if theirs.policy != ours.policy {
        return Ok(Some(format!(
            "a policy of '{their_algo}' is {} there and one of '{algo}' is {} here; give the same algorithm, inverse model ([idm]) and train.exploration",
            kind(theirs.policy),
            kind(ours.policy)
        )));
    }
    if theirs.task.policy != ours.task.policy {
        return Ok(Some("[policy] is another there, and the networks see something else".into()));
    }
    let n = ours.task.state.privileged.len();
    if dims(theirs, &their_parts, n)? != dims(ours, &parts, n)? {
        return Ok(Some("the inverse model sees other entries of the state there; give the same [idm] and state.controllable".into()));
    }
    let period = |m: &Manifest| m.task.time.dt * m.task.time.policy_every as f64;
    let (a, b) = (period(theirs), period(ours));
    if (a - b).abs() > 1e-9 * b {
        return Ok(Some(format!(
            "its policy runs every {a} s, and every {b} s here (time.dt, time.policy_every): a proposal and what is learned of its values are for that long"
        )));
    }
    let learned = ours.policy != PolicyKind::Direct && ours.task.idm.kind == IdmKind::Learned;
    if let Some(key) = other_sizes(&their_settings, settings, learned) {
        return Ok(Some(format!("[train.nets] has another {key}; give the same sizes, or the same preset")));
    }
    let warm = |algo, settings| warm_up_of_pid2(algo, settings) > 0;
    if warm(their_algo, &their_settings) != warm(algo, settings) {
        return Ok(Some(format!(
            "a warm-up of PID² makes other networks, and that of '{their_algo}' was {0} steps where '{algo}' has {1}; set train.pid2.warmup={0}",
            warm_up_of_pid2(their_algo, &their_settings),
            warm_up_of_pid2(algo, settings)
        )));
    }
    let (a, b) = (&their_settings, settings);
    if (a.normalise_obs, a.change_scale) != (b.normalise_obs, b.change_scale) {
        return Ok(Some("train.normalise_obs or train.change_scale is another there; give the same".into()));
    }
    if b.change_scale == ChangeScale::Limits
        && limit_scale(&their_parts, theirs)? != limit_scale(&parts, ours)?
    {
        return Ok(Some(
            "train.change_scale = \"limits\" makes a proposal mean something else under other limits; train both with \"running\"".into(),
        ));
    }
    Ok(None)
}

fn kind(policy: PolicyKind) -> &'static str {
    match policy {
        PolicyKind::Direct => "one of actions",
        PolicyKind::Deterministic => "one of states that explores in its actions",
        PolicyKind::Stochastic => "one of states that explores in its proposals",
        PolicyKind::State => "one that was imported and puts out whole states",
    }
}

/// The first entry in which two lists differ.
fn other_entry(what: &str, key: &str, theirs: &[String], ours: &[String]) -> Option<String> {
    let n = theirs.len().max(ours.len());
    let at = (0..n).find(|&k| theirs.get(k) != ours.get(k))?;
    let name = |list: &[String]| list.get(at).map_or("nothing".to_string(), |name| format!("'{name}'"));
    Some(format!("entry {at} of {what} is {} there and {} here ({key})", name(theirs), name(ours)))
}

/// The first size in which the networks differ; the inverse model's matters where the policy `learned` one.
fn other_sizes(theirs: &TrainSettings, ours: &TrainSettings, learned: bool) -> Option<String> {
    let table = |s: &TrainSettings| {
        toml::Table::try_from(&s.nets).unwrap_or_else(|e| unreachable!("it was read from TOML: {e}"))
    };
    let (a, b) = (table(theirs), table(ours));
    let keys = ["policy", "value", "activation", "idm", "idm_residual"];
    let counts = if learned { 5 } else { 3 };
    let key = keys.into_iter().take(counts).find(|key| a.get(*key) != b.get(*key))?;
    Some(format!("{key} ({} there, {} here)", a[key], b[key]))
}
