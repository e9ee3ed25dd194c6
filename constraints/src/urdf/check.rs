//! Finds numbers and names of a URDF that no robot can have, and reports all of them in one sentence.

use roxmltree::Node;
use std::collections::{BTreeMap, BTreeSet};

/// A moment of inertia that is negative by less is 0 as a program wrote it [kg·m²].
pub(crate) const ROUNDING: f64 = 1e-12;

/// Types of joints that URDF has.
const KINDS: [&str; 6] = ["revolute", "continuous", "prismatic", "fixed", "floating", "planar"];

/// Names once each, links that are there, one root, and no circles.
pub(super) fn check_tree(robot: Node, wrong: &mut Vec<String>) {
    let all = |tag| robot.children().filter(move |n: &Node| n.has_tag_name(tag));
    let named = |tag| all(tag).map(|n| n.attribute("name").unwrap_or("?"));
    let nameless = |node: &Node| node.attribute("name").is_none_or(|name| name.trim().is_empty());
    wrong.extend(all("link").filter(nameless).map(|_| "a <link> has no name".to_string()));
    wrong.extend(all("joint").filter(nameless).map(|joint| {
        let end =
            |tag: &str| joint.children().find(|n| n.has_tag_name(tag)).and_then(|n| n.attribute("link"));
        let (parent, child) = (end("parent").unwrap_or("?"), end("child").unwrap_or("?"));
        format!("the <joint> between the links '{parent}' and '{child}' has no name")
    }));
    for joint in all("joint") {
        let Some(mimic) = joint.children().find(|n| n.has_tag_name("mimic")) else { continue };
        let name = joint.attribute("name").unwrap_or("?");
        match mimic.attribute("joint") {
            None => wrong.push(format!("joint '{name}' has a <mimic> without joint")),
            Some(of) if of == name => wrong.push(format!("joint '{name}' mimics itself")),
            Some(_) => {}
        }
        for key in ["multiplier", "offset"] {
            let Some(text) = mimic.attribute(key) else { continue };
            if !text.trim().parse::<f64>().is_ok_and(f64::is_finite) {
                wrong.push(format!("joint '{name}' has <mimic> {key} '{text}', not a number"));
            }
        }
    }
    for tag in ["link", "joint"] {
        let mut seen = BTreeSet::new();
        let again: BTreeSet<_> = named(tag).filter(|name| !seen.insert(*name)).collect();
        wrong.extend(again.iter().map(|name| format!("{tag} '{name}' is there more than once")));
    }
    let links: BTreeSet<_> = named("link").collect();
    let mut parents = BTreeMap::new();
    for joint in robot.children().filter(|n| n.has_tag_name("joint")) {
        let name = joint.attribute("name").unwrap_or("?");
        let mut end = |tag: &str| {
            let link = joint.children().find(|n| n.has_tag_name(tag)).and_then(|n| n.attribute("link"));
            match link {
                None => wrong.push(format!("joint '{name}' has no <{tag} link=...>")),
                Some(link) if !links.contains(link) => {
                    wrong.push(format!("joint '{name}' has the {tag} link '{link}', which is not there"));
                }
                Some(_) => {}
            }
            link
        };
        let (_, child) = (end("parent"), end("child"));
        if let Some(other) = child.and_then(|child| parents.insert(child, name)) {
            wrong.push(format!(
                "link '{}' is the child of joints '{other}' and '{name}'",
                child.unwrap_or("?")
            ));
        }
    }
    let roots: Vec<_> = links.iter().filter(|link| !parents.contains_key(*link)).collect();
    if links.is_empty() {
        wrong.push("it has no <link>".to_string());
    } else if roots.is_empty() {
        wrong.push("every link is some joint's child, but one must be the root".to_string());
    }
    if roots.len() > 1 {
        let names = roots.iter().map(|n| format!("'{n}'")).collect::<Vec<_>>().join(", ");
        wrong.push(format!("the links {names} are no joint's child, but only one may be the root"));
    }
}

pub(super) fn check_link(link: Node, wrong: &mut Vec<String>) {
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
            } else if matches!(a.name(), "ixx" | "iyy" | "izz") && value < -ROUNDING {
                wrong.push(format!("link '{name}' inertia {} is {value} kg m²", a.name()));
            }
        }
    }
}

pub(super) fn check_joint(joint: Node, wrong: &mut Vec<String>) {
    let name = joint.attribute("name").unwrap_or("?");
    let kind = joint.attribute("type").unwrap_or("?");
    if !KINDS.contains(&kind) {
        wrong.push(format!("joint '{name}' has the type '{kind}', which is none of {}", KINDS.join(", ")));
    }
    if !KINDS[..3].contains(&kind) {
        return;
    }
    let axis = joint.children().find(|n| n.has_tag_name("axis")).and_then(|n| n.attribute("xyz"));
    if axis.is_some_and(|xyz| xyz.split_whitespace().all(|x| x.parse() == Ok(0.0))) {
        wrong.push(format!("joint '{name}' has the axis 0 0 0"));
    }
    let mut limits = joint.children().filter(|n| n.has_tag_name("limit"));
    let limit = limits.next();
    if limits.next().is_some() {
        wrong.push(format!(
            "joint '{name}' has more than one <limit>, and nothing says which holds: keep one"
        ));
    }
    if kind != "continuous" {
        let missing =
            ["effort", "velocity"].into_iter().filter(|key| limit.is_none_or(|l| !l.has_attribute(*key)));
        let missing: Vec<_> = missing.collect();
        if !missing.is_empty() {
            wrong.push(format!("joint '{name}' states no {} in <limit>", missing.join(" and no ")));
        }
    }
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
    if kind == "continuous" {
        return;
    }
    // One end alone: URDF takes the other for 0.
    if let (Some(lower), Some(upper)) = (lower.or(upper.map(|_| 0.0)), upper.or(lower.map(|_| 0.0)))
        && lower > upper
    {
        wrong.push(format!("joint '{name}' has lower {lower} above upper {upper}"));
    }
}
