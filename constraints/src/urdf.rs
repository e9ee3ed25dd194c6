//! What a URDF really states about each joint, and the numbers in it that cannot be.
//!
//! Pinocchio turns missing position limits into [0, 0] and accepts lower above upper, zero effort and NaN.

use crate::ModelError;
use roxmltree::{Document, Node};

/// Position limits as stated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Stated {
    /// Both numbers are in the file.
    Range,
    /// A continuous joint: none by intention.
    Unlimited,
    /// A revolute or prismatic joint without them.
    Missing,
}

/// Movable joints by name.
pub(crate) fn read(xml: &str, file: &str) -> Result<Vec<(String, Stated)>, ModelError> {
    let malformed = |reason: String| ModelError::Malformed { file: file.to_string(), format: "URDF", reason };
    let document = Document::parse(xml).map_err(|e| malformed(e.to_string()))?;
    let root = document.root_element();
    if !root.has_tag_name("robot") {
        return Err(malformed(format!("its root element is <{}>, not <robot>", root.tag_name().name())));
    }
    let mut wrong = Vec::new();
    root.children().filter(|n| n.has_tag_name("link")).for_each(|link| check_link(link, &mut wrong));
    let joints = root.children().filter(|n| n.has_tag_name("joint"));
    let stated = joints.filter_map(|joint| check_joint(joint, &mut wrong)).collect();
    if !wrong.is_empty() {
        return Err(ModelError::Impossible { file: file.to_string(), list: wrong.join("; ") });
    }
    Ok(stated)
}

fn check_link(link: Node, wrong: &mut Vec<String>) {
    let name = link.attribute("name").unwrap_or("?");
    for part in link.children().filter(|n| n.has_tag_name("inertial")).flat_map(|i| i.children()) {
        for a in part.attributes().filter(|_| part.has_tag_name("mass") || part.has_tag_name("inertia")) {
            let value = a.value().trim().parse::<f64>().unwrap_or(f64::NAN);
            if !value.is_finite() {
                wrong.push(format!(
                    "link '{name}' {} {} is '{}'",
                    part.tag_name().name(),
                    a.name(),
                    a.value()
                ));
            } else if part.has_tag_name("mass") && value < 0.0 {
                wrong.push(format!("link '{name}' mass is {value} kg"));
            }
        }
    }
}

fn check_joint(joint: Node, wrong: &mut Vec<String>) -> Option<(String, Stated)> {
    let name = joint.attribute("name").unwrap_or("?").to_string();
    let kind = joint.attribute("type").unwrap_or("?");
    if !matches!(kind, "revolute" | "prismatic" | "continuous") {
        return None;
    }
    let limit = joint.children().find(|n| n.has_tag_name("limit"));
    let mut number = |key: &str| {
        let text = limit?.attribute(key)?;
        let value = text.trim().parse::<f64>().unwrap_or(f64::NAN);
        if !value.is_finite() || (matches!(key, "effort" | "velocity") && value < 0.0) {
            wrong.push(format!("joint '{name}' {key} is '{text}'"));
            return None;
        }
        Some(value)
    };
    let (lower, upper) = (number("lower"), number("upper"));
    let _ = (number("effort"), number("velocity"));
    if let (Some(lower), Some(upper)) = (lower, upper)
        && lower > upper
    {
        wrong.push(format!("joint '{name}' has lower {lower} above upper {upper}"));
    }
    let stated = match kind {
        "continuous" => Stated::Unlimited,
        _ if lower.is_some() && upper.is_some() => Stated::Range,
        _ => Stated::Missing,
    };
    Some((name, stated))
}
