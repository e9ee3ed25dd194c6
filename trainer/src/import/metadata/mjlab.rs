//! What mjlab writes beside a policy, as a recipe.
//!
//! ```text
//!     joint_names = "hip,knee"        default_joint_pos = "0.100,0.200"        action_scale = "0.500,0.250" or "0.5"
//!     observation_names = "joint_vel,base_ang_vel"
//!     observation_terms_scale = "0.050,0.250;0.250;0.100"                      a number for each term, or one for each of its entries
//!     observation_terms_clip = "-inf;inf,-5.000;5.000"                         lowest and highest, before the scale
//!     observation_terms_history_length = "0,3"                                 0 as 1: the present alone
//! ```
//!
//! `None` is what versions before 1.6 write for a scale or a clip that is none.

use super::super::{ImportError, ImportedNetwork};
use super::states;
use nearl_runtime::recipe::{Term, TermKind};
use serde::Deserialize;
use toml::{Table, Value};

/// Stands for no end of a clip: numbers in a task file are finite.
const FAR: f64 = 1e30;
/// Most policy ticks that a term remembers, as in a recipe.
const MOST_HISTORY: usize = 1000;
/// What to do about terms that cannot be used.
const NEXT: &str = "state all of policy.observation in a recipe (--recipe FILE, in Python recipe=FILE), which comes before it";

const NAMES: &str = "observation_names";
const SCALES: &str = "observation_terms_scale";
const CLIPS: &str = "observation_terms_clip";
const HISTORIES: &str = "observation_terms_history_length";
const FLAT: &str = "observation_terms_flatten_history_dim";

pub(super) fn recipe(network: &ImportedNetwork, recipes: &[Table]) -> Result<Table, ImportError> {
    let get = |key: &str| network.metadata.get(key).map(String::as_str).filter(|v| !v.is_empty());
    let joints = list(get("joint_names").unwrap_or_default());
    let mut policy = Table::new();
    policy.insert("joints".into(), strings(&joints));
    if let Some(pose) = get("default_joint_pos") {
        policy.insert("pose".into(), numbers("default_joint_pos", pose, joints.len())?.into());
    }
    if let Some(scale) = get("action_scale") {
        let scale = match scale.parse::<f64>() {
            Ok(one) if one.is_finite() => Value::from(one),
            _ => numbers("action_scale", scale, joints.len())?.into(),
        };
        policy.insert("action".into(), Table::from_iter([("scale".to_string(), scale)]).into());
    }
    if !states(recipes, "observation") {
        policy.insert("observation".into(), terms(network, &joints)?);
    }
    in_this_order(&policy, recipes, &joints)?;
    let mut table = Table::from_iter([("policy".to_string(), Value::from(policy))]);
    if let (Some(k), Some(d)) = (get("joint_stiffness"), get("joint_damping")) {
        let by_joint = |key, text| -> Result<Value, ImportError> {
            let values = numbers(key, text, joints.len())?;
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

/// Refuses what the metadata states by joint where a recipe states the joints otherwise, and not that.
fn in_this_order(policy: &Table, recipes: &[Table], joints: &[String]) -> Result<(), ImportError> {
    let mut orders = recipes.iter().filter_map(|recipe| recipe.get("policy")?.get("joints"));
    if orders.next_back().is_none_or(|stated| *stated == strings(joints)) {
        return Ok(());
    }
    let is_list = |of: Option<&Value>| of.and_then(|of| of.get("scale")).is_some_and(Value::is_array);
    let of_joint = |term: &Value| {
        let name = term.get("term").and_then(Value::as_str).unwrap_or_default();
        ["joint_pos", "joint_vel", "actions", "last_action"].contains(&name) && is_list(Some(term))
    };
    let terms = policy.get("observation").and_then(Value::as_array);
    let by_joint = [
        ("pose", policy.contains_key("pose")),
        ("action", is_list(policy.get("action"))),
        ("observation", terms.is_some_and(|terms| terms.iter().any(of_joint))),
    ];
    let missing = by_joint.into_iter().filter(|(key, is)| *is && !states(recipes, key));
    let missing: Vec<String> = missing.map(|(key, _)| format!("policy.{key}")).collect();
    if missing.is_empty() {
        return Ok(());
    }
    let keys = missing.join(", ");
    Err(refuse(
        "joint_names",
        format!(
            "a recipe states policy.joints otherwise, and the metadata has numbers for {keys} in this order; state {keys} in the recipe too, or leave its \
             joints out"
        ),
    ))
}

/// The terms by name; the command takes the entries that the others leave.
fn terms(network: &ImportedNetwork, joints: &[String]) -> Result<Value, ImportError> {
    let names = list(network.metadata.get(NAMES).map_or("", String::as_str));
    let columns = Columns::new(network, &names)?;
    let mut terms = Vec::new();
    for (k, name) in names.iter().enumerate() {
        terms.push(columns.term(k, name)?);
    }
    let command = terms.iter().rposition(|term| term.kind == TermKind::Command);
    let known = terms.iter().enumerate().filter(|(k, _)| Some(*k) != command);
    let known: usize = known.map(|(_, term)| term.width(joints.len()) * term.history).sum();
    for (k, (name, term)) in names.iter().zip(&mut terms).enumerate() {
        let mut width = term.width(joints.len());
        if Some(k) == command {
            width = network.n_in().saturating_sub(known) / term.history;
            term.table.insert("entries".into(), strings(&command_entries(width)));
        }
        let given = term.table.get("scale").and_then(Value::as_array).map_or(width, Vec::len);
        if given != width {
            let at = k + 1;
            let reason =
                format!("entry {at} has {given} numbers for the {width} entries of term '{name}'; {NEXT}");
            return Err(refuse(SCALES, reason));
        }
    }
    Ok(Value::Array(terms.into_iter().map(|term| Value::from(term.table)).collect()))
}

/// A term of a recipe.
struct Read {
    table: Table,
    kind: TermKind,
    history: usize,
}

impl Read {
    /// Entries of one tick, where it is no command.
    fn width(&self, joints: usize) -> usize {
        match self.kind {
            TermKind::JointPos | TermKind::JointVel | TermKind::LastAction => joints,
            _ => 3,
        }
    }
}

/// What the metadata says of the terms, a value for each; `None` where it has no such key.
struct Columns {
    scales: Option<Vec<String>>,
    clips: Option<Vec<String>>,
    histories: Option<Vec<String>>,
    flat: Option<Vec<String>>,
}

impl Columns {
    fn new(network: &ImportedNetwork, names: &[String]) -> Result<Self, ImportError> {
        let each = |key| entries(network, key, names);
        Ok(Self {
            scales: each(SCALES)?,
            clips: each(CLIPS)?,
            histories: each(HISTORIES)?,
            flat: each(FLAT)?,
        })
    }

    /// Term `k` with its scale, clip and history.
    fn term(&self, k: usize, name: &str) -> Result<Read, ImportError> {
        let mut table = Table::from_iter([("term".to_string(), Value::from(name))]);
        let unknown = |_| refuse(NAMES, format!("term '{name}' is none that this program computes; {NEXT}"));
        let kind = Term::deserialize(table.clone()).map_err(unknown)?.term;
        let of = |values: &Option<Vec<String>>| values.as_ref().map(|v| v[k].clone()).filter(|v| v != "None");
        let refuse = |key: &str, value: &str, reason: &str| {
            refuse(key, format!("entry {} (term '{name}') is '{value}', {reason}; {NEXT}", k + 1))
        };
        if let Some(text) = of(&self.scales) {
            let reason = "no number and no numbers with ';' between them";
            let each = finite(&text).ok_or_else(|| refuse(SCALES, &text, reason))?;
            table.insert("scale".into(), if each.len() == 1 { each[0].into() } else { floats(&each) });
        }
        if let Some(text) = of(&self.clips) {
            let reason = "where the lowest and the highest value with ';' between them are expected";
            let ends = clip(&text).ok_or_else(|| refuse(CLIPS, &text, reason))?;
            ends.and_then(|ends| table.insert("clip".into(), floats(&ends)));
        }
        let mut history = 1;
        if let Some(text) = of(&self.histories) {
            let reason = "no number of ticks from 0 to 1000";
            history = ticks(&text).ok_or_else(|| refuse(HISTORIES, &text, reason))?.max(1);
        }
        let is_flat = |text: &String| text == "True" || finite(text) == Some(vec![1.0]);
        if let Some(text) = of(&self.flat).filter(|text| history > 1 && !is_flat(text)) {
            return Err(refuse(FLAT, &text, "and a history is read where it is flat ('True')"));
        }
        table.insert("history".into(), (history as i64).into());
        Ok(Read { table, kind, history })
    }
}

/// The values of a key, one for each term.
fn entries(
    network: &ImportedNetwork,
    key: &str,
    names: &[String],
) -> Result<Option<Vec<String>>, ImportError> {
    let Some(text) = network.metadata.get(key).filter(|text| !text.is_empty()) else { return Ok(None) };
    let values: Vec<String> = text.split(',').map(|part| part.trim().to_string()).collect();
    if values.len() == names.len() {
        return Ok(Some(values));
    }
    let (n, of) = (values.len(), names.len());
    Err(refuse(key, format!("'{text}' has {n} entries for the {of} terms of {NAMES}; {NEXT}")))
}

/// Numbers with `;` between them.
fn split(text: &str) -> Option<Vec<f64>> {
    text.split(';').map(|part| part.trim().parse::<f64>().ok()).collect()
}

fn finite(text: &str) -> Option<Vec<f64>> {
    split(text).filter(|values| values.iter().all(|x| x.is_finite()))
}

/// `low;high`; within, `None` where neither end cuts anything. `None` where it is no clip.
fn clip(text: &str) -> Option<Option<[f64; 2]>> {
    let [low, high] = <[f64; 2]>::try_from(split(text)?).ok()?;
    let is_clip = low <= high && low < f64::INFINITY && high > f64::NEG_INFINITY;
    let cuts = low.is_finite() || high.is_finite();
    is_clip.then(|| cuts.then(|| [low.max(-FAR), high.min(FAR)]))
}

/// A whole number of ticks.
fn ticks(text: &str) -> Option<usize> {
    let ticks = text.parse::<f64>().ok().filter(|n| n.fract() == 0.0)?;
    (0.0..=MOST_HISTORY as f64).contains(&ticks).then_some(ticks as usize)
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

fn floats(values: &[f64]) -> Value {
    Value::Array(values.iter().map(|v| Value::from(*v)).collect())
}

/// A number for each joint.
fn numbers(key: &str, text: &str, joints: usize) -> Result<Vec<Value>, ImportError> {
    let values = list(text)
        .iter()
        .map(|part| part.parse::<f64>().ok().filter(|x| x.is_finite()))
        .collect::<Option<Vec<_>>>();
    let values = values
        .ok_or_else(|| refuse(key, format!("'{text}' is no list of numbers; export the policy again")))?;
    match values.len() == joints {
        false => {
            Err(refuse(key, format!("{} numbers for {joints} joints; export the policy again", values.len())))
        }
        true => Ok(values.into_iter().map(Value::from).collect()),
    }
}

fn refuse(key: &str, reason: String) -> ImportError {
    ImportError::Metadata { key: key.into(), reason }
}
