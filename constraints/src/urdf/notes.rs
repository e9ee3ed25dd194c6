//! What a URDF states and this program does not take as it stands, one sentence each.

use super::{called, children, number};
use crate::description::Body;
use crate::description::check::is_of_mass;
use roxmltree::Node;

/// Limits of a joint that are not used, or that stand for nothing.
pub(super) fn of_joint(joint: Node) -> Vec<String> {
    let (name, mut notes) = (called(joint), Vec::new());
    let kind = joint.attribute("type").unwrap_or("?");
    if !matches!(kind, "revolute" | "continuous" | "prismatic") {
        return notes;
    }
    if let Some(limit) = children(joint, "limit").next() {
        for (key, what) in [("velocity", "speed"), ("effort", "force")] {
            if number(limit, key) == Some(0.0) {
                notes.push(format!(
                    "joint '{name}' states {key} 0 in <limit>, which is read as not filled in: its {what} has no limit; write the number"
                ));
            }
        }
        for (stated, missing) in [("lower", "upper"), ("upper", "lower")] {
            if kind != "continuous" && limit.has_attribute(stated) && !limit.has_attribute(missing) {
                notes.push(format!(
                    "joint '{name}' states {stated} and no {missing} in <limit>, which URDF takes for 0; write {missing} if it is another"
                ));
            }
        }
    }
    if let Some(soft) = children(joint, "safety_controller").next() {
        let stated = ["soft_lower_limit", "soft_upper_limit"].map(|key| Some((key, soft.attribute(key)?)));
        let stated: Vec<_> = stated.iter().flatten().map(|(key, value)| format!("{key} {value}")).collect();
        if !stated.is_empty() {
            notes.push(format!(
                "joint '{name}' has {} in <safety_controller>, which is not used: <limit> holds; write the narrower range into <limit>, or give \
                 position a margin",
                stated.join(" and ")
            ));
        }
    }
    notes
}

/// Bodies whose inertia no distribution of mass has.
pub(super) fn inertias(bodies: &[Body]) -> Option<String> {
    let names: Vec<String> =
        bodies.iter().filter(|b| !is_of_mass(b.inertia)).map(|b| format!("'{}'", b.name)).collect();
    (!names.is_empty()).then(|| {
        format!(
            "the inertia of {} is that of no body: one principal moment exceeds the sum of the other two; correct ixx to izz of each <inertial>",
            names.join(", ")
        )
    })
}
