//! The metadata of an ONNX file as a recipe: our own, or mjlab's.

use super::{ImportError, ImportedNetwork};
use nearl_runtime::constraints::MAX_TASK_BYTES;
use nearl_runtime::recipe::{Term, TermKind};
use serde::Deserialize;
use toml::{Table, Value};

/// Key of the recipe in files of `nearl export`: a task file in TOML.
pub(crate) const RECIPE: &str = "nearl_recipe";

/// What the metadata says, as sections of a task file; empty where it says nothing.
pub(super) fn recipe(network: &ImportedNetwork) -> Result<Table, ImportError> {
    if let Some(text) = network.metadata.get(RECIPE) {
        let refuse =
            |e: toml::de::Error| ImportError::Metadata { key: RECIPE.into(), reason: e.message().into() };
        if text.len() as u64 > MAX_TASK_BYTES {
            let reason = format!("it has {} bytes, more than the limit of {MAX_TASK_BYTES}", text.len());
            return Err(ImportError::Metadata { key: RECIPE.into(), reason });
        }
        return toml::from_str(text).map_err(refuse);
    }
    if is_exported_change(network) {
        let reason = "the file's output 'change' is a change of state that 'nearl export' wrote of a policy that proposes, and a recipe is of a policy of \
                      actions; import it into its task (--task FILE --actions change, in Python task= and actions='change')";
        return Err(ImportError::Recipe(reason.into()));
    }
    if network.metadata.contains_key("observation_names") && network.metadata.contains_key("joint_names") {
        return mjlab(network);
    }
    Ok(Table::new())
}

/// The keys of `[constraints]` in the metadata: limits that an import without a recipe has, and one with a recipe that does not say otherwise.
pub fn brought(network: &ImportedNetwork) -> Vec<String> {
    let table = recipe(network).unwrap_or_default();
    let limits = table.get("constraints").and_then(Value::as_table);
    limits.map_or(Vec::new(), |limits| limits.keys().cloned().collect())
}

/// Whether 'nearl export' wrote it of a policy that proposes: then the outputs are in the units of the state.
pub(super) fn is_exported_change(network: &ImportedNetwork) -> bool {
    exported(network) == Some("change")
}

/// What the outputs are of a file that 'nearl export' wrote: "actions", "change" or "state".
pub(super) fn exported(network: &ImportedNetwork) -> Option<&str> {
    network.metadata.contains_key("task").then_some(network.output_name.as_str())
}

fn mjlab(network: &ImportedNetwork) -> Result<Table, ImportError> {
    let get = |key: &str| network.metadata.get(key).map(String::as_str).filter(|v| !v.is_empty());
    let joints = list(get("joint_names").unwrap_or_default());
    let mut policy = Table::new();
    policy.insert("joints".into(), strings(&joints));
    if let Some(pose) = get("default_joint_pos") {
        policy.insert("pose".into(), numbers("default_joint_pos", pose, Some(joints.len()))?);
    }
    if let Some(scale) = get("action_scale") {
        let scale = match scale.parse::<f64>() {
            Ok(one) => Value::from(one),
            Err(_) => numbers("action_scale", scale, Some(joints.len()))?,
        };
        policy.insert("action".into(), Table::from_iter([("scale".to_string(), scale)]).into());
    }
    policy.insert("observation".into(), terms(network, &joints)?);
    let mut table = Table::from_iter([("policy".to_string(), Value::from(policy))]);
    if let (Some(k), Some(d)) = (get("joint_stiffness"), get("joint_damping")) {
        let by_joint = |key, text| -> Result<Value, ImportError> {
            let values = numbers(key, text, Some(joints.len()))?;
            let values = values.as_array().cloned().unwrap_or_default();
            Ok(Table::from_iter(joints.iter().cloned().zip(values)).into())
        };
        let command = [
            ("interface".to_string(), Value::from("pd")),
            ("stiffness".to_string(), by_joint("joint_stiffness", k)?),
            ("damping".to_string(), by_joint("joint_damping", d)?),
        ];
        table.insert("command".into(), Table::from_iter(command).into());
    }
    Ok(table)
}

/// The terms by name; the command takes the entries that the others leave.
fn terms(network: &ImportedNetwork, joints: &[String]) -> Result<Value, ImportError> {
    let names = list(network.metadata.get("observation_names").map_or("", String::as_str));
    let each = |key: &str| network.metadata.get(key).map(|v| list(v)).filter(|v| v.len() == names.len());
    let (scales, histories) = (each("observation_terms_scale"), each("observation_terms_history_length"));
    if let Some(clip) = each("observation_terms_clip").filter(|c| c.iter().any(|v| v != "None")) {
        let reason = format!("clips {clip:?} are not read; state them in a recipe");
        return Err(ImportError::Metadata { key: "observation_terms_clip".into(), reason });
    }
    let (mut terms, mut command, mut known) = (Vec::new(), None, 0);
    for (k, name) in names.iter().enumerate() {
        let value = Table::from_iter([("term".to_string(), Value::from(name.as_str()))]);
        let term = Term::deserialize(value.clone()).map_err(|_| ImportError::Metadata {
            key: "observation_names".into(),
            reason: format!("term '{name}' is none that this program computes; describe it in a recipe"),
        })?;
        let mut table = value;
        let number = |values: &Option<Vec<String>>| values.as_ref().and_then(|v| v[k].parse::<f64>().ok());
        if let Some(scale) = number(&scales) {
            table.insert("scale".into(), scale.into());
        }
        let history = number(&histories).filter(|h| *h >= 1.0).unwrap_or(1.0) as i64;
        table.insert("history".into(), history.into());
        match term.term {
            TermKind::JointPos | TermKind::JointVel | TermKind::LastAction => {
                known += joints.len() * history as usize
            }
            TermKind::Command => command = Some((k, history as usize)),
            _ => known += 3 * history as usize,
        }
        terms.push(table);
    }
    if let Some((k, history)) = command {
        let left = network.n_in().saturating_sub(known) / history.max(1);
        terms[k].insert("entries".into(), strings(&command_entries(left)));
    }
    Ok(Value::Array(terms.into_iter().map(Value::from).collect()))
}

/// Names of the plant's entries that a command of `n` numbers is read from.
fn command_entries(n: usize) -> Vec<String> {
    match n {
        3 => ["lin_vel_x", "lin_vel_y", "ang_vel_z"].map(|part| format!("command.{part}")).to_vec(),
        _ => (0..n).map(|i| format!("command.{i}")).collect(),
    }
}

fn list(text: &str) -> Vec<String> {
    text.split(',').map(|part| part.trim().to_string()).filter(|part| !part.is_empty()).collect()
}

fn strings(values: &[String]) -> Value {
    Value::Array(values.iter().map(|v| Value::from(v.as_str())).collect())
}

fn numbers(key: &str, text: &str, count: Option<usize>) -> Result<Value, ImportError> {
    let refuse = |reason| ImportError::Metadata { key: key.into(), reason };
    let values = list(text).iter().map(|part| part.parse::<f64>()).collect::<Result<Vec<_>, _>>();
    let values = values.map_err(|_| refuse(format!("'{text}' is no list of numbers")))?;
    match count.filter(|&n| n != values.len()) {
        Some(n) => Err(refuse(format!("{} numbers for {n} joints", values.len()))),
        None => Ok(Value::Array(values.into_iter().map(Value::from).collect())),
    }
}
