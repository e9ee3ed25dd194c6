//! What a description must be before a model is built from it.

use super::payload::add;
use super::{Body, JointDescription, JointKind, Motor, Onset, Range, RobotDescription};
use crate::ModelError;
use crate::geometry::Placement;
use crate::urdf::ROUNDING;
use std::collections::{HashMap, HashSet};

/// Larger robots are refused before anything is built: the mass matrix grows with the square of the dofs.
const MOST_DOFS: usize = 500;
/// The same for bodies, frames, solids and motors, each.
const MOST: usize = 5000;
/// Rotations and axes may be this far from length 1, and rotations from right angles.
const UNIT: f64 = 1e-6;
/// A sentence names this many mistakes.
const SHOWN: usize = 8;

impl RobotDescription {
    /// Refuses what is no robot: sizes beyond reason, numbers that cannot be, names that stand for two things or for none.
    ///
    /// # Errors
    /// [`ModelError::TooLarge`], or [`ModelError::Impossible`] with every mistake; `file` is the name in the message.
    pub fn check(&self, file: &str) -> Result<(), ModelError> {
        self.check_sizes(file)?;
        let mut wrong = Vec::new();
        if self.gravity.iter().any(|x| !x.is_finite()) {
            wrong.push(format!("gravity is {:?}", self.gravity));
        }
        unique("body", self.bodies.iter().map(|b| b.name.as_str()), &mut wrong);
        unique("joint", self.joints().map(|j| j.name.as_str()), &mut wrong);
        self.check_tree(&mut wrong);
        self.bodies.iter().for_each(|body| check_body(body, &mut wrong));
        check_inertias(&self.bodies, &mut wrong);
        self.check_places(&mut wrong);
        self.check_motors(&mut wrong);
        if self.joints().next().is_none() {
            wrong.push("it has no movable joint (a body that flies needs free_flyer = true)".to_string());
        }
        if wrong.is_empty() {
            return Ok(());
        }
        let more = wrong.len().saturating_sub(SHOWN);
        wrong.truncate(SHOWN);
        if more > 0 {
            wrong.push(format!("and {more} more"));
        }
        Err(ModelError::Impossible { file: file.to_string(), list: wrong.join("; ") })
    }

    fn check_sizes(&self, file: &str) -> Result<(), ModelError> {
        let dofs = self.joints().map(|j| j.kind.size().1).sum::<usize>();
        let counts = [
            ("dofs", dofs, MOST_DOFS),
            ("bodies", self.bodies.len(), MOST),
            ("frames", self.frames.len(), MOST),
            ("solids", self.solids.len(), MOST),
            ("motors", self.motors.len(), MOST),
        ];
        match counts.into_iter().find(|(_, count, most)| count > most) {
            Some((what, count, most)) => {
                Err(ModelError::TooLarge { file: file.to_string(), what, count, most })
            }
            None => Ok(()),
        }
    }

    /// Depth first: the parent of a body is the body before it or one of its ancestors.
    fn check_tree(&self, wrong: &mut Vec<String>) {
        let mut open: Vec<usize> = Vec::new();
        for (number, body) in self.bodies.iter().enumerate() {
            match body.parent {
                None => open.clear(),
                Some(parent) => {
                    while open.last().is_some_and(|last| *last != parent) {
                        open.pop();
                    }
                    if open.is_empty() {
                        let name = &body.name;
                        wrong.push(format!(
                            "body '{name}' has parent {parent}, which is not open: list bodies depth first"
                        ));
                    }
                }
            }
            open.push(number);
        }
    }

    fn check_places(&self, wrong: &mut Vec<String>) {
        let frames = self.frames.iter().map(|f| (format!("frame '{}'", f.name), f.body, &f.placement));
        let solid = |number: usize| format!("solid {number}");
        let solids = self.solids.iter().enumerate().map(|(n, s)| (solid(n), s.body, &s.placement));
        for (what, body, placement) in frames.chain(solids) {
            if let Some(body) = body.filter(|body| *body >= self.bodies.len()) {
                wrong.push(format!("{what} is on body {body} of {}", self.bodies.len()));
            }
            check_placement(&what, placement, wrong);
        }
    }

    fn check_motors(&self, wrong: &mut Vec<String>) {
        let joints: HashMap<&str, JointKind> = self.joints().map(|j| (j.name.as_str(), j.kind)).collect();
        let mut orders = HashMap::new();
        for motor in &self.motors {
            let name = &motor.name;
            match joints.get(motor.joint.as_str()) {
                None => {
                    wrong.push(format!("motor '{name}' drives joint '{}', which is not there", motor.joint))
                }
                Some(kind) if !kind.has_one_dof() => {
                    wrong.push(format!(
                        "motor '{name}' drives joint '{}', which has {} dofs",
                        motor.joint,
                        kind.size().1
                    ));
                }
                Some(_) => {}
            }
            if let Some(other) = orders.insert(motor.order, name) {
                wrong.push(format!("motors '{other}' and '{name}' take the same control {}", motor.order));
            }
            if motor.order >= MOST {
                wrong.push(format!("motor '{name}' takes control {}", motor.order));
            }
            check_motor(motor, wrong);
        }
    }
}

fn unique<'a>(what: &str, names: impl Iterator<Item = &'a str>, wrong: &mut Vec<String>) {
    let mut seen = HashSet::new();
    let twice = names.filter(|name| !seen.insert(*name));
    wrong.extend(twice.map(|name| format!("{what} '{name}' is there more than once")));
}

fn check_body(body: &Body, wrong: &mut Vec<String>) {
    let name = &body.name;
    check_placement(&format!("body '{name}'"), &body.placement, wrong);
    if !(body.mass.is_finite() && body.mass >= 0.0) {
        wrong.push(format!("body '{name}' has mass {} kg", body.mass));
    }
    if body.com.iter().chain(&body.inertia).any(|x| !x.is_finite()) {
        wrong.push(format!("body '{name}' has a centre of mass or an inertia that is not finite"));
    }
    if [0, 3, 5].iter().any(|k| body.inertia[*k] < -ROUNDING) {
        wrong.push(format!("body '{name}' has a negative moment of inertia"));
    }
    for joint in &body.joints {
        check_joint(joint, wrong);
    }
    if let Some(free) = body.joints.iter().find(|j| j.kind == JointKind::Free)
        && body.joints.len() > 1
    {
        wrong.push(format!("body '{name}' has joints beside the free joint '{}'", free.name));
    }
}

/// Refuses inertias that are negative about some axis, where they are still so with all that hangs rigidly together: an antenna of a milligram takes nothing
/// from the body that carries it, and what is fixed to the world does not move.
fn check_inertias(bodies: &[Body], wrong: &mut Vec<String>) {
    if !bodies.iter().any(|body| is_indefinite(body.inertia)) {
        return;
    }
    // Of a body with joints: with all that hangs on it without a joint in between.
    let mut rigid = bodies.to_vec();
    // By body: the one whose joints move it, and its place in that one's axes.
    let mut carried: Vec<Option<(usize, Placement)>> = Vec::with_capacity(bodies.len());
    for (i, body) in bodies.iter().enumerate() {
        let by_parent = body.parent.filter(|p| *p < i).and_then(|p| carried[p]);
        let by = match body.joints.is_empty() {
            true => by_parent.map(|(by, at)| (by, at.then(&body.placement))),
            false => Some((i, Placement::IDENTITY)),
        };
        if let Some((by, at)) = by.filter(|(by, _)| *by != i) {
            add(&mut rigid[by], body.mass, body.com, body.inertia, &at);
        }
        carried.push(by);
    }
    for (body, carried) in bodies.iter().zip(&carried).filter(|(body, _)| is_indefinite(body.inertia)) {
        if carried.as_ref().is_some_and(|(by, _)| is_indefinite(rigid[*by].inertia)) {
            wrong.push(format!(
                "the inertia of body '{}' is negative about some axis: correct its products of inertia",
                body.name
            ));
        }
    }
}

fn check_joint(joint: &JointDescription, wrong: &mut Vec<String>) {
    let name = &joint.name;
    let length = joint.axis.iter().map(|x| x * x).sum::<f64>().sqrt();
    if (length - 1.0).abs().is_nan() || (length - 1.0).abs() > UNIT {
        wrong.push(format!("joint '{name}' has an axis of length {length}"));
    }
    if let Range::Limited(lower, upper) = joint.range {
        if lower > upper {
            wrong.push(format!("joint '{name}' has lower {lower} above upper {upper}"));
        }
        if !(lower.is_finite() && upper.is_finite()) {
            wrong.push(format!("joint '{name}' has a range from {lower} to {upper}"));
        }
    }
    let never_negative = [
        ("velocity", joint.velocity.unwrap_or(0.0)),
        ("effort", joint.effort.unwrap_or(0.0)),
        ("damping", joint.damping),
        ("drive damping", joint.drive_damping),
        ("armature", joint.armature),
        ("friction", joint.friction),
    ];
    for (what, value) in never_negative.into_iter().filter(|(_, x)| !(x.is_finite() && *x >= 0.0)) {
        wrong.push(format!("joint '{name}' {what} is {value}"));
    }
    let onset = joint.friction_onset.map_or([1.0, 1.0], |onset| [onset.inertia, onset.time]);
    if let Some(Onset { steps, .. }) = joint.friction_onset
        && !(steps.is_finite() && steps >= 0.0)
    {
        wrong.push(format!("joint '{name}' friction onset steps is {steps}"));
    }
    for (what, value) in ["inertia", "time"].iter().zip(onset).filter(|(_, x)| !(x.is_finite() && *x > 0.0)) {
        wrong.push(format!("joint '{name}' friction onset {what} is {value}"));
    }
    let any = [
        ("stiffness", joint.stiffness),
        ("spring reference", joint.spring_reference),
        ("reference", joint.reference),
    ];
    let anchor = joint.anchor.iter().map(|x| ("anchor", *x));
    for (what, value) in any.into_iter().chain(anchor).filter(|(_, x)| !x.is_finite()) {
        wrong.push(format!("joint '{name}' {what} is {value}"));
    }
    if joint.kind.size() != (1, 1) && (joint.stiffness, joint.reference) != (0.0, 0.0) {
        wrong.push(format!("joint '{name}' is neither hinge nor slide, but has a spring or a reference"));
    }
}

fn check_motor(motor: &Motor, wrong: &mut Vec<String>) {
    let name = &motor.name;
    for (what, value) in [("gear", motor.gear), ("gain", motor.gain)] {
        if !value.is_finite() || value == 0.0 && motor.not_modelled.is_none() {
            wrong.push(format!("motor '{name}' has {what} {value}"));
        }
    }
    if motor.bias.iter().any(|x| !x.is_finite()) {
        wrong.push(format!("motor '{name}' has bias {:?}", motor.bias));
    }
    for (what, range) in [("control", motor.control_range), ("force", motor.force_range)] {
        if let Some([low, high]) = range.filter(|[l, h]| !(l.is_finite() && h.is_finite() && l <= h)) {
            wrong.push(format!("motor '{name}' has a {what} range from {low} to {high}"));
        }
    }
}

/// Whether a moment of inertia about some axis is negative by more than a file's rounding.
pub(super) fn is_indefinite([xx, xy, xz, yy, yz, zz]: [f64; 6]) -> bool {
    let more = ROUNDING + 1e-4 * (xx + yy + zz).abs();
    !has_no_negative_eigenvalue([xx + more, xy, xz, yy + more, yz, zz + more])
}

/// A principal moment may exceed the sum of the others by this share of all three before anything is said of it: files are rounded.
const ROUNDED: f64 = 0.01;

/// Whether some distribution of mass has this inertia: whether `tr(I) / 2 - I` has no negative eigenvalue.
pub(crate) fn is_of_mass([xx, xy, xz, yy, yz, zz]: [f64; 6]) -> bool {
    let trace = xx + yy + zz;
    let half = (0.5 + ROUNDED) * trace;
    trace <= 0.0
        || has_no_negative_eigenvalue([half - xx, -xy, -xz, half - yy, -yz, half - zz].map(|x| x / trace))
}

/// Whether a symmetric matrix (`xx xy xz yy yz zz`) has no negative eigenvalue, by its principal minors.
fn has_no_negative_eigenvalue([a, d, e, b, f, c]: [f64; 6]) -> bool {
    let pairs = [a * b - d * d, a * c - e * e, b * c - f * f];
    let all = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e);
    [a, b, c, all].iter().chain(&pairs).all(|minor| *minor >= 0.0)
}

fn check_placement(what: &str, placement: &Placement, wrong: &mut Vec<String>) {
    let r = &placement.rotation;
    let dot = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let square =
        (0..3).all(|i| (0..3).all(|j| (dot(r[i], r[j]) - f64::from(u8::from(i == j))).abs() <= UNIT));
    let determinant = (0..3)
        .map(|i| r[0][i] * (r[1][(i + 1) % 3] * r[2][(i + 2) % 3] - r[1][(i + 2) % 3] * r[2][(i + 1) % 3]));
    if !square || determinant.sum::<f64>() < 0.0 {
        wrong.push(format!("{what} has a rotation that is none: {r:?}"));
    }
    if placement.position.iter().any(|x| !x.is_finite()) {
        wrong.push(format!("{what} is at {:?}", placement.position));
    }
}
