//! Decides whether one section of `[constraints]` is at least as tight as another: number by number, by what each key means.

use serde_json::{Map, Value};

use super::above;

/// What a larger number does.
#[derive(Clone, Copy)]
enum Way {
    /// Allows more.
    Loosens,
    /// Allows less.
    Tightens,
}

/// Keys whose numbers have an order; whatever else a section says must stay as it is.
const WAYS: [(&str, Way); 13] = [
    ("power", Way::Loosens),
    ("delivered", Way::Loosens),
    ("square", Way::Loosens),
    ("rate", Way::Loosens),
    ("limit", Way::Loosens),
    ("scale", Way::Loosens),
    ("stall", Way::Loosens),
    ("no_load", Way::Loosens),
    ("braking", Way::Loosens),
    ("upper", Way::Loosens),
    ("lower", Way::Tightens),
    ("margin", Way::Tightens),
    ("influence", Way::Tightens),
];

/// One clause if `new` allows more than `old`: sections of the kind `kind`, null where there is none.
pub(super) fn looser(kind: &str, old: &Value, new: &Value, joints: &[&str]) -> Option<String> {
    match (old, new) {
        (Value::Null, _) => None,
        (Value::Array(old), new) => {
            let none = Vec::new();
            let new = new.as_array().unwrap_or(&none);
            old.iter().find_map(|entry| missing(kind, entry, new, joints))
        }
        (_, Value::Null) => Some(format!("no limit of kind '{kind}'")),
        (Value::Object(old), Value::Object(new)) => {
            entry(old, new, joints).map(|what| format!("{kind}: {what}"))
        }
        (old, new) => (old != new).then(|| format!("another '{kind}'")),
    }
}

/// A limit of a list that none of the new list keeps; those of the same name are compared.
fn missing(kind: &str, old: &Value, new: &[Value], joints: &[&str]) -> Option<String> {
    let old = old.as_object()?;
    let name = label(old);
    let same = new.iter().filter_map(Value::as_object).filter(|n| label(n) == name);
    let mut why = None;
    for candidate in same {
        match entry(old, candidate, joints) {
            None => return None,
            Some(what) => why = Some(format!("{kind} '{name}': {what}")),
        }
    }
    Some(why.unwrap_or_else(|| format!("no limit of kind '{kind}' named '{name}'")))
}

fn label(limit: &Map<String, Value>) -> &str {
    let text = |key: &str| limit.get(key).and_then(Value::as_str);
    text("name").or(text("frame")).unwrap_or_default()
}

/// The first key in which `new` allows more than `old`.
fn entry(old: &Map<String, Value>, new: &Map<String, Value>, joints: &[&str]) -> Option<String> {
    let keys = old.keys().chain(new.keys().filter(|key| !old.contains_key(*key)));
    keys.into_iter().find_map(|key| {
        let (was, is) = (old.get(key), new.get(key));
        match (key.as_str(), was, is) {
            _ if was == is => None,
            ("soft", None, Some(_)) => Some("soft where the loop has a hard one".into()),
            ("soft", Some(_), None) => None,
            ("soft", Some(was), Some(is)) => weaker(was, is).then(|| "softer than in the loop".into()),
            // Written for kinds that are soft without it.
            ("hard", None, Some(_)) => None,
            ("hard", Some(_), None) => Some("soft where the loop has a hard one".into()),
            (key, was, is) => match WAYS.iter().find(|(name, _)| *name == key) {
                Some((_, way)) => number(key, *way, was, is, joints),
                None => Some(format!("another '{key}'")),
            },
        }
    })
}

/// Weights of a soft limit: each may only grow.
fn weaker(was: &Value, is: &Value) -> bool {
    let weight = |soft: &Value, key: &str| soft.get(key).and_then(Value::as_f64).unwrap_or(0.0);
    ["linear", "quadratic"].iter().any(|key| weight(is, key) < weight(was, key))
}

/// A number, or numbers by joint.
fn number(key: &str, way: Way, was: Option<&Value>, is: Option<&Value>, joints: &[&str]) -> Option<String> {
    let by_joint = |v: Option<&Value>| v.is_some_and(|v| v.is_object() || v.is_array());
    let length = |v: Option<&Value>| v.and_then(Value::as_array).map(Vec::len);
    if [length(was), length(is)].into_iter().flatten().any(|n| n != joints.len()) {
        return Some(format!("another '{key}'"));
    }
    let none = match (key, way) {
        ("margin", _) => 0.0,
        (_, Way::Loosens) => f64::INFINITY,
        (_, Way::Tightens) => f64::NEG_INFINITY,
    };
    let of = |v: Option<&Value>, i: usize, joint: &str| match v {
        Some(Value::Object(map)) => map.get(joint).and_then(Value::as_f64).unwrap_or(none),
        Some(Value::Array(list)) => list.get(i).and_then(Value::as_f64).unwrap_or(none),
        other => other.and_then(Value::as_f64).unwrap_or(none),
    };
    let all = [""];
    let joints = if by_joint(was) || by_joint(is) { joints } else { &all };
    joints.iter().enumerate().find_map(|(i, joint)| {
        let (was, is) = (of(was, i, joint), of(is, i, joint));
        let is_looser = match way {
            Way::Loosens => above(is, was),
            Way::Tightens => above(-is, -was),
        };
        let at = if joint.is_empty() { String::new() } else { format!(" of joint '{joint}'") };
        is_looser.then(|| format!("{key}{at} {is} where the loop has {was}"))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn found(old: Value, new: Value) -> Option<String> {
        looser("kind", &old, &new, &["a", "b"])
    }

    #[test]
    fn numbers_are_compared_by_what_their_key_means() {
        let base = json!({"limit": 2.0, "margin": 0.1});
        assert_eq!(found(base.clone(), base.clone()), None);
        assert_eq!(found(base.clone(), json!({"limit": 1.5, "margin": 0.2})), None);
        for new in [
            json!({"limit": 2.5, "margin": 0.1}),
            json!({"limit": 2.0, "margin": 0.0}),
            json!({"limit": 2.0}),
        ] {
            assert!(found(base.clone(), new).is_some());
        }
        assert_eq!(found(json!({"limit": 2.0}), json!({"limit": {"a": 1.0, "b": 2.0}})), None);
        let one = found(json!({"limit": 2.0}), json!({"limit": {"a": 1.0}}));
        assert_eq!(one.unwrap(), "kind: limit of joint 'b' inf where the loop has 2");
        assert_eq!(found(json!({"limit": {"a": 1.0}}), json!({"limit": 1.0})), None);
    }

    #[test]
    fn lists_of_numbers_are_compared_dof_by_dof() {
        let list = json!({"limit": [1.0, 2.0]});
        assert_eq!(found(list.clone(), json!({"limit": [1.0, 1.5]})), None);
        assert_eq!(found(list.clone(), json!({"limit": 1.0})), None);
        assert_eq!(found(list.clone(), json!({"limit": {"a": 1.0, "b": 2.0}})), None);
        let looser = found(list.clone(), json!({"limit": [1.0, 9.0]}));
        assert_eq!(looser.unwrap(), "kind: limit of joint 'b' 9 where the loop has 2");
        assert!(found(list.clone(), json!({"limit": 2.0})).unwrap().contains("joint 'a' 2"));
        assert!(found(list.clone(), json!({"limit": [1.0]})).is_some(), "of another robot");
        assert!(found(json!({"margin": [0.1, 0.2]}), json!({"margin": [0.1, 0.1]})).is_some());
        assert!(found(list, json!({})).unwrap().contains("inf"));
    }

    #[test]
    fn what_is_hard_stays_hard_and_what_is_there_stays_there() {
        assert_eq!(found(Value::Null, json!({"limit": 1.0})), None, "one more limit tightens");
        assert!(found(json!({"limit": 1.0}), Value::Null).is_some());
        let soft = |w: f64| json!({"limit": 1.0, "soft": {"linear": w, "quadratic": 1.0}});
        assert!(found(json!({"limit": 1.0}), soft(1.0)).unwrap().contains("soft"));
        assert_eq!(found(soft(1.0), json!({"limit": 1.0})), None);
        assert_eq!(found(soft(1.0), soft(2.0)), None);
        assert!(found(soft(2.0), soft(1.0)).is_some());
        let hard = json!({"limit": 1.0, "hard": true});
        assert_eq!(found(soft(1.0), hard.clone()), None);
        assert!(found(hard.clone(), soft(1.0)).unwrap().contains("soft"));
        assert!(found(hard, json!({"limit": 1.0})).unwrap().contains("soft"));
    }

    #[test]
    fn lists_are_compared_by_name() {
        let hand = |limit: f64| json!({"frame": "hand", "limit": limit});
        let elbow = json!({"frame": "elbow", "limit": 1.0});
        assert_eq!(found(json!([hand(0.5)]), json!([elbow.clone(), hand(0.4)])), None);
        assert!(found(json!([hand(0.5)]), json!([elbow.clone(), hand(0.6)])).unwrap().contains("0.6"));
        assert!(found(json!([hand(0.5), elbow]), json!([hand(0.5)])).unwrap().contains("'elbow'"));
        assert!(
            found(json!([hand(0.5)]), json!([{"frame": "hand", "limit": 0.5, "point": [0, 0, 1]}])).is_some()
        );
    }
}
