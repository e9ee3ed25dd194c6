//! What a URDF really states about each joint, and the numbers in it that cannot be.
//!
//! Pinocchio turns missing position limits into [0, 0] and accepts lower above upper, zero effort and NaN.

use crate::ModelError;
use crate::geometry::{Placement, Shape};
use roxmltree::{Document, Node};
use std::collections::{BTreeMap, BTreeSet};

/// One `<collision>` of a link.
#[derive(Debug, Clone)]
pub(crate) struct LinkShape {
    pub(crate) link: String,
    /// `None` for a mesh.
    pub(crate) shape: Option<Shape>,
    /// In the link's axes.
    pub(crate) placement: Placement,
}

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
type Joints = Vec<(String, Stated)>;

/// Movable joints by name, the collision geometry, and a note for each mimic joint.
type Read = (Joints, Vec<LinkShape>, Vec<String>);

/// Reads what Pinocchio does not tell; what cannot be is refused, all of it in one sentence.
pub(crate) fn read(xml: &str, file: &str) -> Result<Read, ModelError> {
    let malformed = |reason: String| ModelError::Malformed { file: file.to_string(), format: "URDF", reason };
    let document = Document::parse(xml).map_err(|e| malformed(e.to_string()))?;
    let root = document.root_element();
    if !root.has_tag_name("robot") {
        return Err(malformed(format!("its root element is <{}>, not <robot>", root.tag_name().name())));
    }
    let mut wrong = Vec::new();
    let mut collisions = Vec::new();
    for link in root.children().filter(|n| n.has_tag_name("link")) {
        check_link(link, &mut wrong);
        for node in link.children().filter(|n| n.has_tag_name("collision")) {
            collisions.extend(collision(link.attribute("name").unwrap_or("?"), node, &mut wrong));
        }
    }
    let joints = || root.children().filter(|n| n.has_tag_name("joint"));
    check_tree(root, &mut wrong);
    let mimics = joints().filter_map(mimic).collect();
    let stated = joints().filter_map(|joint| check_joint(joint, &mut wrong)).collect();
    if !wrong.is_empty() {
        return Err(ModelError::Impossible { file: file.to_string(), list: wrong.join("; ") });
    }
    Ok((stated, collisions, mimics))
}

/// Names once each, links that are there, and one root: what Pinocchio's reader says on standard error only.
fn check_tree(robot: Node, wrong: &mut Vec<String>) {
    let named = |tag| {
        robot.children().filter(move |n| n.has_tag_name(tag)).map(|n| n.attribute("name").unwrap_or("?"))
    };
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
    if roots.len() > 1 {
        let names = roots.iter().map(|n| format!("'{n}'")).collect::<Vec<_>>().join(", ");
        wrong.push(format!("the links {names} are no joint's child, but only one may be the root"));
    }
}

/// Pinocchio reads a mimic joint as one of its own.
fn mimic(joint: Node) -> Option<String> {
    let mimic = joint.children().find(|n| n.has_tag_name("mimic"))?;
    let (name, of) = (joint.attribute("name").unwrap_or("?"), mimic.attribute("joint").unwrap_or("?"));
    let number = |key, default| mimic.attribute(key).unwrap_or(default).to_string();
    let (multiplier, offset) = (number("multiplier", "1"), number("offset", "0"));
    Some(format!(
        "joint '{name}' mimics '{of}' in the file (multiplier {multiplier}, offset {offset}), but moves on its own in this model: leave it out of \
         the controllable joints, or hold both together with a row"
    ))
}

/// The solid of one `<collision>`; `None` when it holds none or impossible numbers.
fn collision(link: &str, node: Node, wrong: &mut Vec<String>) -> Option<LinkShape> {
    let mut numbers = |n: Node, key: &str, default: Option<&str>| -> Option<Vec<f64>> {
        let text = n.attribute(key).or(default).unwrap_or("");
        let parsed: Option<Vec<f64>> = text.split_whitespace().map(|word| word.parse().ok()).collect();
        let good = parsed.filter(|all| !all.is_empty() && all.iter().all(|x| x.is_finite()));
        if good.is_none() {
            wrong.push(format!("link '{link}' collision {} {key} is '{text}'", n.tag_name().name()));
        }
        good
    };
    let solid = node.children().find(|n| n.has_tag_name("geometry"))?.children().find(Node::is_element)?;
    let mut one = |key: &str| numbers(solid, key, None).map(|x| x[0]);
    let shape = match solid.tag_name().name() {
        "sphere" => Some(Shape::Sphere { radius: one("radius")? }),
        "cylinder" => Some(Shape::Cylinder { radius: one("radius")?, length: one("length")? }),
        "capsule" => Some(Shape::Capsule { radius: one("radius")?, length: one("length")? }),
        "box" => Some(Shape::Box { size: numbers(solid, "size", None)?.try_into().ok()? }),
        _ => None,
    };
    let mut placement = Placement::IDENTITY;
    if let Some(origin) = node.children().find(|n| n.has_tag_name("origin")) {
        let mut three = |key| numbers(origin, key, Some("0 0 0")).and_then(|x| x.try_into().ok());
        placement = Placement::new(three("xyz")?, three("rpy")?);
    }
    Some(LinkShape { link: link.to_string(), shape, placement })
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
            } else if matches!(a.name(), "ixx" | "iyy" | "izz") && value < 0.0 {
                wrong.push(format!("link '{name}' inertia {} is {value} kg m²", a.name()));
            }
        }
    }
}

fn check_joint(joint: Node, wrong: &mut Vec<String>) -> Option<(String, Stated)> {
    let name = joint.attribute("name").unwrap_or("?").to_string();
    let kind = joint.attribute("type").unwrap_or("?");
    const KINDS: [&str; 6] = ["revolute", "continuous", "prismatic", "fixed", "floating", "planar"];
    if !KINDS.contains(&kind) {
        wrong.push(format!("joint '{name}' has the type '{kind}', which is none of {}", KINDS.join(", ")));
    }
    if !KINDS[..3].contains(&kind) {
        return None;
    }
    let axis = joint.children().find(|n| n.has_tag_name("axis")).and_then(|n| n.attribute("xyz"));
    if axis.is_some_and(|xyz| xyz.split_whitespace().all(|x| x.parse() == Ok(0.0))) {
        wrong.push(format!("joint '{name}' has the axis 0 0 0"));
    }
    let limit = joint.children().find(|n| n.has_tag_name("limit"));
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
