//! Collision solids of a URDF.

use crate::description::Solid;
use crate::geometry::{Placement, Shape};
use roxmltree::Node;

/// The solid of one `<collision>` of a body; `None` when it holds none or impossible numbers.
pub(super) fn read(body: usize, node: Node, wrong: &mut Vec<String>) -> Option<Solid> {
    let link = node.parent_element().and_then(|link| link.attribute("name")).unwrap_or("?");
    let mut numbers = |n: Node, key: &str, default: Option<&str>, count: usize| -> Option<Vec<f64>> {
        let text = n.attribute(key).or(default).unwrap_or("");
        let parsed: Option<Vec<f64>> = text.split_whitespace().map(|word| word.parse().ok()).collect();
        let good = parsed.filter(|all| all.len() == count && all.iter().all(|x| x.is_finite()));
        if good.is_none() {
            let wanted = if count == 1 { "one number" } else { "three numbers" };
            wrong.push(format!(
                "link '{link}' collision {} {key} is '{text}', not {wanted}",
                n.tag_name().name()
            ));
        }
        good
    };
    let solid = node.children().find(|n| n.has_tag_name("geometry"))?.children().find(Node::is_element)?;
    let mut one = |key: &str| numbers(solid, key, None, 1).map(|x| x[0]);
    let shape = match solid.tag_name().name() {
        "sphere" => Some(Shape::Sphere { radius: one("radius")? }),
        "cylinder" => Some(Shape::Cylinder { radius: one("radius")?, length: one("length")? }),
        "capsule" => Some(Shape::Capsule { radius: one("radius")?, length: one("length")? }),
        "box" => Some(Shape::Box { size: numbers(solid, "size", None, 3)?.try_into().ok()? }),
        _ => None,
    };
    let mut placement = Placement::IDENTITY;
    if let Some(origin) = node.children().find(|n| n.has_tag_name("origin")) {
        let mut three = |key| numbers(origin, key, Some("0 0 0"), 3).and_then(|x| x.try_into().ok());
        placement = Placement::new(three("xyz")?, three("rpy")?);
    }
    Some(Solid { body: Some(body), shape, placement })
}
