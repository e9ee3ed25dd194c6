//! Where on the base mjlab measures `base_lin_vel`: at the site of a velocimeter in the robot file, which the metadata does not say.

use super::super::{ImportError, ImportedNetwork};
use super::{is_of_mjlab, states};
use nearl_runtime::constraints::RobotDescription;
use nearl_runtime::constraints::description::{Frame, JointKind};
use nearl_runtime::constraints::geometry::Placement;
use toml::{Table, Value};

/// The velocimeter that mjlab's robots have.
const MJLABS: &str = "imu_lin_vel";
const TERM: &str = "base_lin_vel";
/// Distances in metres, and entries of rotations, that are none.
const NOTHING: f64 = 1e-6;

/// Gives the term `base_lin_vel` of mjlab's metadata its point. `text` is the robot file, `file` its name. What is left to say is returned.
///
/// # Errors
/// [`ImportError::Robot`] where the file's velocimeter measures what no term computes, or nobody knows which one is meant.
pub(in super::super) fn place(
    table: &mut Table,
    (network, recipes): (&ImportedNetwork, &[Table]),
    (file, text, robot): (&str, &str, &RobotDescription),
) -> Result<Option<String>, ImportError> {
    let terms = table.get_mut("policy").and_then(|policy| policy.get_mut("observation"));
    let terms = terms.and_then(Value::as_array_mut).into_iter().flatten().filter_map(Value::as_table_mut);
    let mut terms: Vec<_> = terms.filter(|t| t.get("term").and_then(Value::as_str) == Some(TERM)).collect();
    if terms.is_empty() || !is_of_mjlab(network) || states(recipes, "observation") {
        return Ok(None);
    }
    let point = point(text, robot).map_err(|reason| {
        let next = "state all of policy.observation in a recipe (--recipe FILE, in Python recipe=FILE), with the point of its base_lin_vel";
        ImportError::Robot(format!("{file}: {reason}; {next}"))
    })?;
    let Some(point) = point else {
        return Ok(Some(format!(
            "the policy's metadata does not say where on the base its {TERM} was measured, and {file} has no velocimeter there: it is computed at the \
             base's origin; if the policy learned with a velocimeter elsewhere, state policy.observation in a recipe, with point = [x, y, z] for {TERM}"
        )));
    };
    if point.iter().any(|x| x.abs() > NOTHING) {
        let point = Value::Array(point.map(Value::from).to_vec());
        terms.iter_mut().for_each(|term| drop(term.insert("point".into(), point.clone())));
    }
    Ok(None)
}

/// The point of the base where the file's velocimeter is; `None` where the base has none.
fn point(text: &str, robot: &RobotDescription) -> Result<Option<[f64; 3]>, String> {
    let base = robot.bodies.iter().position(|body| body.joints.iter().any(|j| j.kind == JointKind::Free));
    let all = velocimeters(text)?;
    let placed = |name: &str| robot.frames.iter().find(|frame| frame.name == name);
    let named: Vec<_> = all.iter().filter(|v| v.name == MJLABS).collect();
    let frames: Vec<&Frame> = match named[..] {
        [] => all.iter().filter_map(|v| placed(&v.site)).filter(|frame| frame.body == base).collect(),
        _ => named.iter().filter_map(|v| placed(&v.site)).collect(),
    };
    let Some(first) = frames.first() else { return Ok(None) };
    if first.body != base {
        return Err(format!(
            "the velocimeter '{MJLABS}' is at site '{}', which is not on the base",
            first.name
        ));
    }
    let off = |a: &[f64; 3], b: &[f64; 3]| a.iter().zip(b).any(|(a, b)| (a - b).abs() > NOTHING);
    if let Some(other) = frames.iter().find(|f| off(&f.placement.position, &first.placement.position)) {
        return Err(format!(
            "it has velocimeters at the sites '{}' and '{}' of the base, and the policy's metadata does not say which one {TERM} is of",
            first.name, other.name
        ));
    }
    let own = Placement::IDENTITY.rotation;
    if let Some(turned) = frames.iter().find(|f| (0..3).any(|i| off(&f.placement.rotation[i], &own[i]))) {
        return Err(format!(
            "the velocimeter at site '{}' is turned against the base, and {TERM} is computed in the base's axes",
            turned.name
        ));
    }
    Ok(Some(first.placement.position))
}

struct Velocimeter {
    name: String,
    site: String,
}

/// The velocimeters that an MJCF names; a URDF has none.
///
/// # Errors
/// A sentence where the text cannot be searched.
fn velocimeters(text: &str) -> Result<Vec<Velocimeter>, String> {
    let document = roxmltree::Document::parse(text).map_err(|e| {
        format!("it cannot be searched for a velocimeter, by which {TERM} was measured ({e})")
    })?;
    let all = document.descendants().filter(|element| element.has_tag_name("velocimeter"));
    let all = all.map(|element| {
        let get = |key: &str| element.attribute(key).unwrap_or_default().to_owned();
        Velocimeter { name: get("name"), site: get("site") }
    });
    Ok(all.collect())
}
