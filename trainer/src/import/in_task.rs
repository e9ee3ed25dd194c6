//! From an imported network and a task to a snapshot: the task says what is observed, and what may be proposed or sent.

use super::assemble::{networks, recipe};
use super::metadata::{exported, is_exported_change};
use super::{ImportError, ImportedNetwork};
use crate::train::limit_scale;
use nearl_runtime::controller::Parts;
use nearl_runtime::net::{DenseLayer, Function};
use nearl_runtime::task::IdmKind;
use nearl_runtime::{Manifest, PolicyKind, Snapshot};

/// What the outputs of a policy are in its task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Gives {
    /// What the actuators get.
    Actuators,
    /// The next state, entry by entry.
    State,
    /// Its change, in units of what the limits allow in a policy period; in those of the state where `nearl export` wrote the file.
    Change,
}

impl Gives {
    /// All of them.
    pub const ALL: [Gives; 3] = [Gives::Actuators, Gives::State, Gives::Change];

    /// Its name, as environments have it.
    pub fn name(self) -> &'static str {
        match self {
            Gives::Actuators => "actuators",
            Gives::State => "state",
            Gives::Change => "change",
        }
    }

    /// The one of that name.
    ///
    /// # Errors
    /// The names that there are.
    pub fn named(name: &str) -> Result<Gives, String> {
        Gives::ALL.into_iter().find(|gives| gives.name() == name).ok_or_else(|| {
            let names = Gives::ALL.map(|gives| format!("'{}'", gives.name())).join(", ");
            format!("actions is '{name}', and what a policy gives is one of {names}")
        })
    }
}

/// The snapshot of a policy whose observation is the task's; `manifest` is complete.
///
/// # Errors
/// [`ImportError`] where sizes differ, or where no inverse dynamics leads from a proposed state to an action.
pub fn for_task(
    network: &ImportedNetwork,
    mut manifest: Manifest,
    gives: Gives,
) -> Result<Snapshot, ImportError> {
    let task = manifest.task.name.clone();
    let refuse = |reason: String| recipe(&task, &reason);
    let name = gives.name();
    if let Some(said @ ("change" | "state")) = exported(network)
        && said != name
    {
        return Err(refuse(format!(
            "the file's output is the '{said}' that 'nearl export' wrote, and it is imported with actions \"{name}\"; give actions \"{said}\""
        )));
    }
    let (n_in, n_obs) = (network.n_in(), manifest.task.state.observation.len());
    let n_state = manifest.task.state.propose.as_ref().map_or(n_obs, Vec::len);
    let (n_out, wanted, what) = match gives {
        Gives::Actuators => (network.n_out(), manifest.action_lower.len(), "action"),
        Gives::State | Gives::Change => (network.n_out(), n_state, "proposed"),
    };
    if (n_in, n_out) != (n_obs, wanted) {
        let proposes = match gives == Gives::Actuators && (n_in, n_out) == (n_obs, n_state) {
            true => "; one that proposes states is imported with actions \"state\" or \"change\"",
            false => "",
        };
        return Err(refuse(format!(
            "the policy takes {n_in} entries and gives {n_out}, but the task has {n_obs} observation and {wanted} {what} entries{proposes}"
        )));
    }
    manifest.functions.clone_from(&network.functions);
    manifest.algo = "import".into();
    let mut networks = networks(network, n_state);
    if gives == Gives::Actuators {
        manifest.policy = PolicyKind::Direct;
        for (i, [lower, upper]) in network.output.iter().enumerate() {
            manifest.action_lower[i] = manifest.action_lower[i].max(*lower);
            manifest.action_upper[i] = manifest.action_upper[i].min(*upper);
        }
    } else {
        check_proposing(&manifest).map_err(refuse)?;
        networks.policy_log_std.clear();
        clip(network, &mut networks.policy.layers, &mut manifest.functions);
        manifest.policy = if gives == Gives::State { PolicyKind::State } else { PolicyKind::Deterministic };
        if gives == Gives::Change {
            networks.normaliser.scale = units(network, &manifest)?;
        }
    }
    let snapshot = Snapshot { networks, manifest };
    snapshot.check().map_err(|e| refuse(e.to_string()))?;
    Ok(snapshot)
}

fn check_proposing(manifest: &Manifest) -> Result<(), String> {
    if manifest.task.idm.kind == IdmKind::Learned {
        return Err("the task has a learned inverse model, which is not in the policy's file, and nothing else leads from a proposed state to an action; \
                    write kind = \"pinocchio\" under [idm], or let the policy propose beside the loop that runs a trained agent (nearl.Proposer)"
            .into());
    }
    if manifest.task.policy.is_some() {
        return Err(
            "the task has [policy], whose policies give actions; leave it out of the task of a policy that proposes states".into(),
        );
    }
    Ok(())
}

/// The change of each entry that an output of 1 asks for.
fn units(network: &ImportedNetwork, manifest: &Manifest) -> Result<Vec<f64>, ImportError> {
    let refuse = |e: &dyn std::fmt::Display| recipe(&manifest.task.name, &e.to_string());
    let parts = Parts::new(manifest).map_err(|e| refuse(&e))?;
    if is_exported_change(network) {
        return Ok(vec![1.0; parts.layout.n_state()]);
    }
    limit_scale(&parts, manifest).map_err(|_| {
        refuse(
            &"a change of the state is a share of what the limits allow in a policy period, and not every proposed entry is of a joint with a velocity and an \
              acceleration limit; write both under [constraints], or train a policy that gives states and import it with actions \"state\"",
        )
    })
}

/// Puts the clip of the outputs behind the layers, as two layers more: a proposal has no range of its own that it is cut to.
/// `clip(x) = lower + relu(x - lower) - relu(x - upper)`.
fn clip(network: &ImportedNetwork, layers: &mut Vec<DenseLayer>, functions: &mut Vec<Function>) {
    if network.output.iter().flatten().all(|end| end.is_infinite()) {
        return;
    }
    let n = network.n_out();
    let mut bent = DenseLayer { n_in: n, n_out: 2 * n, weight: vec![0.0; 2 * n * n], bias: vec![0.0; 2 * n] };
    let mut sum = DenseLayer { n_in: 2 * n, n_out: n, weight: vec![0.0; 2 * n * n], bias: vec![0.0; n] };
    for (i, [lower, upper]) in network.output.iter().enumerate() {
        // slope and offset of what is bent, and its share of the sum
        let (first, second, from) = match (lower.is_finite(), upper.is_finite()) {
            (true, true) => ([1.0, -lower, 1.0], [1.0, -upper, -1.0], *lower),
            (true, false) => ([1.0, -lower, 1.0], [0.0; 3], *lower),
            (false, true) => ([-1.0, *upper, -1.0], [0.0; 3], *upper),
            (false, false) => ([1.0, 0.0, 1.0], [-1.0, 0.0, -1.0], 0.0),
        };
        for (unit, [slope, offset, share]) in [(2 * i, first), (2 * i + 1, second)] {
            bent.weight[unit * n + i] = slope as f32;
            bent.bias[unit] = offset as f32;
            sum.weight[i * 2 * n + unit] = share as f32;
        }
        sum.bias[i] = from as f32;
    }
    layers.extend([bent, sum]);
    functions.extend([Function::Relu, Function::Identity]);
}
