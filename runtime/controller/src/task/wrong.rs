//! What is wrong in a task file: where it stands, and what to do.

use super::TaskError;
use serde_path_to_error::Segment;
use toml::de::{DeArray, DeTable};

pub(super) fn first_line(s: &str) -> String {
    s.lines().next().unwrap_or_default().to_string()
}

pub(super) fn line_of(text: &str, span: Option<std::ops::Range<usize>>) -> String {
    span.map_or(String::new(), |s| format!(":{}", 1 + text[..s.start.min(text.len())].matches('\n').count()))
}

/// A key of a section, or a place in a list.
#[derive(Clone, Debug)]
pub(super) enum Step {
    Key(String),
    At(usize),
}

/// The way to a value, up to where it is known.
pub(super) fn steps(path: &serde_path_to_error::Path) -> Vec<Step> {
    let step = |segment: &Segment| match segment {
        Segment::Map { key } | Segment::Enum { variant: key } => Some(Step::Key(key.clone())),
        Segment::Seq { index } => Some(Step::At(*index)),
        Segment::Unknown => None,
    };
    path.iter().map_while(step).collect()
}

/// `:12`, where `path` stands in the text, or what of it stands there, and how many of its steps do; nothing for the file as a whole.
pub(super) fn line_of_key(text: &str, path: &[Step]) -> (String, usize) {
    let Ok(document) = DeTable::parse(text) else { return (String::new(), 0) };
    let (mut table, mut list, mut span, mut depth) = (Some(document.get_ref()), None, None, 0);
    for step in path {
        let found = match step {
            Step::Key(key) => table
                .and_then(|t| t.get_key_value(key.as_str()))
                .map(|(key, value)| (key.span(), value.get_ref())),
            Step::At(index) => {
                list.and_then(|l: &DeArray<'_>| l.get(*index)).map(|value| (value.span(), value.get_ref()))
            }
        };
        let Some((place, value)) = found else { break };
        (span, depth) = (Some(place), depth + 1);
        table = value.as_table();
        list = value.as_array();
    }
    (line_of(text, span), depth)
}

/// `:12 [section.key]`, where the keys stand in the text of a task file; `None` where they do not.
pub fn place(text: &str, keys: &[&str]) -> Option<String> {
    let path: Vec<Step> = keys.iter().map(|key| Step::Key((*key).to_owned())).collect();
    let (line, depth) = line_of_key(text, &path);
    (depth == path.len()).then(|| format!("{line}{}", bracket(&keys.join("."))))
}

/// Sections whose own checks speak of a number that is not finite; the learner's may have some.
const CHECKED_ELSEWHERE: [&str; 3] = ["time", "scene", "train"];

/// The first number that is NaN or infinite: as JSON it would be no number, and a snapshot with it could not be read.
pub(super) fn first_odd(table: &toml::Table) -> Option<(Vec<Step>, f64)> {
    let mut sections = table.iter().filter(|(key, _)| !CHECKED_ELSEWHERE.contains(&key.as_str()));
    sections.find_map(|(key, value)| odd_within(value, &[Step::Key(key.clone())]))
}

fn odd_within(value: &toml::Value, path: &[Step]) -> Option<(Vec<Step>, f64)> {
    let below = |step: Step, value: &toml::Value| odd_within(value, &[path, &[step]].concat());
    match value {
        toml::Value::Float(x) if !x.is_finite() => Some((path.to_vec(), *x)),
        toml::Value::Table(table) => table.iter().find_map(|(key, x)| below(Step::Key(key.clone()), x)),
        toml::Value::Array(list) => list.iter().enumerate().find_map(|(i, x)| below(Step::At(i), x)),
        _ => None,
    }
}

/// The refusal of it.
pub(super) fn odd(file: &str, line: &str, path: &[Step], value: f64) -> TaskError {
    let mut key = String::new();
    for step in path {
        match step {
            Step::Key(name) if key.is_empty() => key.push_str(name),
            Step::Key(name) => key = format!("{key}.{name}"),
            Step::At(index) => key = format!("{key}[{index}]"),
        }
    }
    let reason = format!("{value} is not finite, and a snapshot cannot hold it; give a finite number");
    TaskError::Invalid { file: file.into(), place: format!("{line}{}", bracket(&key)), reason }
}

/// ` [key]`; nothing for the file as a whole.
pub(super) fn bracket(key: &str) -> String {
    if key == "." { String::new() } else { format!(" [{key}]") }
}

/// `unknown field 'velocty', expected ...` gains the nearest key.
pub fn suggest(message: &str) -> String {
    let message = first_line(message);
    if message == "missing field `idm`" {
        return "missing section [idm]; write it with kind = \"pinocchio\" (the model's own, where each controllable joint has a motor) or kind = \"learned\""
            .into();
    }
    if let Some(section) =
        ["model", "time", "state", "constraints"].iter().find(|s| message == format!("missing field `{s}`"))
    {
        let empty = if *section == "constraints" { ", empty where there are no limits" } else { "" };
        return format!("section [{section}] is missing; write it{empty} (docs: Tasks)");
    }
    if let Some(key) = message.strip_prefix("missing field ") {
        return format!("{key} is missing; add it");
    }
    if let Some(said) = of_another_kind(&message) {
        return said;
    }
    let mut quoted = message.split('`').skip(1).step_by(2);
    let Some(unknown) = quoted.next().filter(|_| message.starts_with("unknown ")) else { return message };
    let near = quoted.map(|k| (strsim::jaro(unknown, k), k)).max_by(|a, b| a.0.total_cmp(&b.0));
    match near {
        Some((score, key)) if score > 0.7 => format!("{message}; did you mean '{key}'?"),
        _ => message,
    }
}

/// `invalid type: integer `3`, expected a string` in the words of who writes the file.
fn of_another_kind(message: &str) -> Option<String> {
    let said = message.strip_prefix("invalid type: ").or_else(|| message.strip_prefix("invalid value: "))?;
    let (is, wanted) = said.rsplit_once(", expected ")?;
    if wanted == "string only" {
        return Some("it is no text; give one in quotes".into());
    }
    let is = ["string ", "integer ", "floating point ", "boolean "]
        .iter()
        .find_map(|kind| is.strip_prefix(kind))
        .map_or_else(
            || is.replace("sequence", "a list").replace("map", "a section"),
            |value| value.replace('`', ""),
        );
    let wanted = match wanted {
        "f64" | "f32" => "a number",
        "usize" | "u64" | "u32" | "u16" | "u8" => "a whole number from 0 on",
        "isize" | "i64" | "i32" => "a whole number",
        "a string" => "a text in quotes",
        "a boolean" => "true or false",
        "a sequence" => "a list in brackets",
        "a map" => "keys and their values, as { key = value }",
        other if other.starts_with("struct ") => "keys and their values, as { key = value }",
        other => other,
    };
    Some(format!("it is {is}; give {wanted}"))
}

/// A section that is written as a list, whose entries would be taken for its keys in turn, or a list that may not be empty, and what to do.
pub(super) fn listed(table: &toml::Table) -> Option<(String, &'static str)> {
    let sections = ["model", "time", "state", "idm", "policy", "command", "constraints"];
    if let Some(key) = sections.into_iter().find(|key| table.get(*key).is_some_and(toml::Value::is_array)) {
        return Some((key.into(), "it is a list; give keys and their values, as { key = value }"));
    }
    let observed = table.get("state").and_then(|state| state.get("observation")?.as_array());
    if observed.is_some_and(Vec::is_empty) {
        return Some((
            "state.observation".into(),
            "it is empty; name entries, or leave it out, which observes all that the environment has",
        ));
    }
    let limits = table.get("constraints")?.as_table()?;
    // Names of joints are a list, and so are limits of several frames.
    let is_number = |value: &toml::Value| value.is_float() || value.is_integer() || value.is_bool();
    let is_plain = |value: &toml::Value| value.as_array().is_some_and(|list| list.iter().any(is_number));
    let (key, _) = limits.iter().find(|(_, value)| is_plain(value))?;
    let reason = "it is a list; give keys and their values, those of single joints by name, as limit = { shoulder = 2.0 }";
    Some((format!("constraints.{key}"), reason))
}
