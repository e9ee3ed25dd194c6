//! What a log's metadata says of the loop, beside the snapshot that the log carries.

use std::collections::BTreeMap;

use serde_json::{Value, json};

use crate::promise::Promise;
use crate::tick::{Numbered, STATUSES};

/// Modes and rungs by their number.
const MODES: [&str; 5] = ["hold", "active", "degraded", "braking", "fault"];
const RUNGS: &str = "closed form,active set,clarabel,brake,relaxed,stored brake";
/// Bytes that the names of joints may take in a plant's announcement, with a break after each: those beyond are left out.
const NAMES: usize = 2048;
/// Two periods are the same up to this [s].
const PERIOD: f64 = 1e-9;
/// Digits of a digest that the metadata has.
const DIGITS: usize = 16;
/// Characters of a value in a message.
const SHOWN: usize = 60;

/// One clause for each entry of the metadata that is not what the first snapshot, with number and bytes, has. What only `nearl run` writes may be
/// missing in the log of another program.
///
/// # Errors
/// A clause: what of the snapshot cannot be read.
pub(crate) fn differ(
    facts: &BTreeMap<String, String>,
    first: &Numbered,
    bytes: &[u8],
) -> Result<Vec<String>, String> {
    let manifest = Promise::manifest(bytes)?;
    let mut found = Vec::new();
    let mut compare = |key: &str, is_same: &dyn Fn(&str) -> bool, have: String, is_needed: bool| {
        let text = facts.get(key).map(String::as_str);
        if text.map_or(!is_needed, is_same) {
            return;
        }
        let text = text.map_or("missing".to_owned(), |text| format!("'{}'", short(text)));
        found.push(format!("metadata `{key}` is {text}, and the snapshot in the log has '{}'", short(&have)));
    };
    let dt = manifest["task"]["time"]["dt"].as_f64().unwrap_or(f64::NAN);
    let is_dt = |text: &str| text.parse::<f64>().is_ok_and(|is| (is - dt).abs() <= PERIOD);
    compare("dt", &is_dt, dt.to_string(), true);
    let bodies = manifest["robot"]["bodies"].as_array().into_iter().flatten();
    let joints = bodies.flat_map(|body| body["joints"].as_array().into_iter().flatten());
    let joints: Vec<&str> = joints.filter_map(|joint| joint["name"].as_str()).map(bare).collect();
    let is_cut = joints.iter().map(|name| name.len() + 1).sum::<usize>() > NAMES;
    let is_joints = |text: &str| {
        let names: Vec<&str> = text.split(',').map(bare).collect();
        names == joints || (is_cut && !text.is_empty() && joints.starts_with(&names))
    };
    compare("joints", &is_joints, joints.join(","), true);
    let is_json = |want: &Value, text: &str| serde_json::from_str::<Value>(text).is_ok_and(|is| is == *want);
    let rows = json!(first.rows);
    compare("rows", &|text| is_json(&rows, text), rows.to_string(), true);
    let digest = first.digest.get(..DIGITS).unwrap_or_default();
    compare("digest", &|text| text == digest, digest.to_owned(), false);
    let version = manifest["version"].to_string();
    compare("version", &|text| text == version, version.clone(), false);
    let task = manifest["task"]["name"].as_str().unwrap_or_default();
    compare("task", &|text| text == task, task.to_owned(), false);
    // Legends of numbers in the ticks.
    let mut legend = |key: &str, is_same: bool| {
        if !is_same {
            found.push(format!("metadata `{key}` is not the list that this version of a log has"));
        }
    };
    let statuses: Value = STATUSES.iter().map(|(n, name)| (n.to_string(), json!(name))).collect();
    let is = |key: &str, want: &Value| facts.get(key).is_some_and(|text| is_json(want, text));
    legend("statuses", is("statuses", &statuses));
    legend("modes", is("modes", &json!(MODES)));
    legend("rungs", facts.get("rungs").is_some_and(|text| text == RUNGS));
    Ok(found)
}

/// A name without braces around it, which is the same name.
fn bare(name: &str) -> &str {
    name.strip_prefix('{').and_then(|rest| rest.strip_suffix('}')).unwrap_or(name)
}

fn short(text: &str) -> String {
    let mut shown: String = text.chars().take(SHOWN).collect();
    if shown.len() < text.len() {
        shown.push('…');
    }
    shown
}
