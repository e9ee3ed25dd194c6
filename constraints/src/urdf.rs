//! What a URDF really states about each joint, and the numbers in it that cannot be.
//!
//! Pinocchio turns missing position limits into [0, 0] and accepts lower above upper, zero effort and NaN.

use crate::ModelError;
use crate::geometry::{Placement, Shape};
use roxmltree::{Document, Node};

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

/// Movable joints by name, and the collision geometry.
pub(crate) fn read(xml: &str, file: &str) -> Result<(Joints, Vec<LinkShape>), ModelError> {
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
    let joints = root.children().filter(|n| n.has_tag_name("joint"));
    let stated = joints.filter_map(|joint| check_joint(joint, &mut wrong)).collect();
    if !wrong.is_empty() {
        return Err(ModelError::Impossible { file: file.to_string(), list: wrong.join("; ") });
    }
    Ok((stated, collisions))
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
