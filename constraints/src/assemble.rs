//! From a description to a [`Model`]: joint by joint into Pinocchio, numbers into one vector each.
//!
//! Several joints of one body become a chain of joints whose bodies in between weigh nothing: the same equations of motion, and every
//! axis stands still in its joint's frame, which Pinocchio's derivatives take for granted.

use crate::ModelError;
use crate::description::{
    Body, Command, FrictionLaw, JointDescription, JointKind, Motor, Onset, Range, RobotDescription,
};
use crate::geometry::Placement;
use crate::model::{Inner, Joint, ModelFrame};
use crate::pinocchio::{self, RawData, RawModel};

/// Where a body is: the joint of Pinocchio's it moves with, its number among the moving bodies, and its place in that joint's frame.
type Place = (Option<usize>, Option<usize>, Placement);

const WORLD: Place = (None, None, Placement::IDENTITY);

/// Checks and builds; `file` names the robot in messages.
pub(crate) fn assemble(description: RobotDescription, file: &str) -> Result<Inner, ModelError> {
    description.check(file)?;
    let refused = |reason| ModelError::Refused { file: file.to_string(), reason };
    let mut tree = Tree::new(&description).map_err(refused)?;
    description.bodies.iter().try_for_each(|body| tree.add(body)).map_err(refused)?;
    for frame in &description.frames {
        let place = frame.body.map_or(WORLD, |body| tree.places[body]);
        tree.add_frame(&frame.name, false, place, &frame.placement).map_err(refused)?;
    }
    Ok(tree.finish(&description))
}

struct Tree {
    raw: RawModel,
    frames: Vec<ModelFrame>,
    /// Of the moving bodies: the one before each, and its first and last dof.
    chain: Vec<(Option<usize>, std::ops::Range<usize>)>,
    places: Vec<Place>,
    n_joints: usize,
    nv: usize,
}

impl Tree {
    fn new(description: &RobotDescription) -> Result<Tree, String> {
        let raw = RawModel::new(description.gravity)?;
        let world = ModelFrame { name: "universe".to_string(), body: true, moved_by: None };
        Ok(Tree { raw, frames: vec![world], chain: Vec::new(), places: Vec::new(), n_joints: 0, nv: 0 })
    }

    fn add(&mut self, body: &Body) -> Result<(), String> {
        let (mut joint, mut group, parent) = body.parent.map_or(WORLD, |parent| self.places[parent]);
        let mut place = parent.then(&body.placement);
        if !body.joints.is_empty() {
            let dofs: usize = body.joints.iter().map(|j| j.kind.size().1).sum();
            self.chain.push((group, self.nv..self.nv + dofs));
            group = Some(self.chain.len() - 1);
            self.nv += dofs;
        }
        for j in &body.joints {
            let base = place.then(&shift(j.anchor)).then(&at_zero(j));
            self.raw.add_joint(joint, j, &base)?;
            joint = Some(self.n_joints);
            self.n_joints += 1;
            self.add_frame(&j.name, false, (joint, group, Placement::IDENTITY), &Placement::IDENTITY)?;
            place = shift(j.anchor.map(|x| 0.0 - x));
        }
        // Even a body that weighs nothing would round what is there.
        if body.mass != 0.0 || body.inertia != [0.0; 6] {
            self.raw.append_body(joint, body, &place)?;
        }
        self.places.push((joint, group, place));
        self.add_frame(&body.name, true, (joint, group, place), &Placement::IDENTITY)
    }

    fn add_frame(&mut self, name: &str, body: bool, on: Place, inner: &Placement) -> Result<(), String> {
        let (joint, moved_by, place) = on;
        self.raw.add_frame(joint, &place.then(inner))?;
        self.frames.push(ModelFrame { name: name.to_string(), body, moved_by });
        Ok(())
    }

    fn finish(self, description: &RobotDescription) -> Inner {
        let (nq, nv) = (self.raw.nq(), self.raw.nv());
        let (zero, none) = (vec![0.0; nv], vec![f64::INFINITY; nv]);
        let mut inner = Inner {
            nq,
            nv,
            joints: Vec::new(),
            range_missing: Vec::new(),
            lower: vec![f64::NEG_INFINITY; nq],
            upper: vec![f64::INFINITY; nq],
            velocity: none.clone(),
            effort: none,
            armature: zero.clone(),
            damping: zero.clone(),
            drive_damping: zero.clone(),
            held: vec![false; nv],
            stiffness: zero.clone(),
            spring_reference: zero.clone(),
            friction: zero,
            onset: vec![None; nv],
            law: vec![FrictionLaw::default(); nv],
            total_mass: self.raw.mass(),
            neutral: self.raw.neutral(),
            frames: self.frames,
            chain: self.chain,
            description: description.clone(),
            raw: self.raw,
        };
        description.joints().for_each(|joint| inner.add(joint));
        inner.raw.set_armature(&inner.armature);
        inner.rub(description);
        inner
    }
}

impl Inner {
    /// Appends a joint's numbers.
    fn add(&mut self, joint: &JointDescription) {
        let (idx_q, idx_v) = self.joints.last().map_or((0, 0), |j| (j.idx_q + j.nq, j.idx_v + j.nv));
        let (nq, nv) = joint.kind.size();
        if let (Range::Limited(lower, upper), 1) = (joint.range, nq) {
            (self.lower[idx_q], self.upper[idx_q]) = (lower, upper);
        }
        let motors = self.description.motors.iter().filter(|m| m.joint == joint.name);
        let servo = |m: &Motor| matches!(m.command, Command::Position | Command::Pd | Command::Velocity);
        let held = joint.held || motors.clone().any(servo);
        let strength = motors.map(|m| m.strength()).reduce(|sum, x| sum + x).unwrap_or(f64::INFINITY);
        for i in idx_v..idx_v + nv {
            self.velocity[i] = joint.velocity.unwrap_or(f64::INFINITY);
            self.effort[i] = joint.effort.unwrap_or(f64::INFINITY).min(strength);
            self.armature[i] = joint.armature;
            self.damping[i] = joint.damping;
            self.drive_damping[i] = joint.drive_damping;
            self.held[i] = held && nv == 1;
            self.stiffness[i] = joint.stiffness;
            self.spring_reference[i] = joint.spring_reference;
            self.friction[i] = if nv == 1 { joint.friction } else { 0.0 };
            self.onset[i] = joint.friction_onset;
            self.law[i] = joint.friction_law;
        }
        self.joints.push(Joint { name: joint.name.clone(), idx_q, nq, idx_v, nv });
        self.range_missing.push(joint.range == Range::NotStated);
    }
}

impl Inner {
    /// How friction sets in where the description does not say: by what a unit of force does with every joint at its reference.
    fn rub(&mut self, description: &RobotDescription) {
        let nv = self.nv;
        let (zero, mut reference) = (vec![0.0; nv], self.neutral.clone());
        for (joint, stated) in self.joints.iter().zip(description.joints()).filter(|(j, _)| j.nq == 1) {
            reference[joint.idx_q] = stated.reference;
        }
        let mut data = RawData::new(&self.raw);
        let mut accelerate = |force: &[f64]| {
            let mut a = vec![f64::NAN; nv];
            let (q, v, tau, out) = (reference.as_ptr(), zero.as_ptr(), force.as_ptr(), a.as_mut_ptr());
            // SAFETY: every length is the model's own. Where Pinocchio throws, the numbers are left.
            unsafe { pinocchio::nc_aba(self.raw.as_ptr(), data.as_ptr(), q, v, tau, out) };
            a
        };
        for i in 0..nv {
            if self.friction[i] == 0.0 || self.onset[i].is_some() {
                continue;
            }
            let mut unit = vec![0.0; nv];
            unit[i] = 1.0;
            let mobility = accelerate(&unit)[i] - accelerate(&zero)[i];
            self.onset[i] = (mobility.is_finite() && mobility > 0.0).then(|| Onset::usual(mobility));
        }
    }
}

fn shift(position: [f64; 3]) -> Placement {
    Placement { position, ..Placement::IDENTITY }
}

/// The joint's frame at position 0, in that at its reference.
fn at_zero(joint: &JointDescription) -> Placement {
    match joint.kind {
        _ if joint.reference == 0.0 => Placement::IDENTITY,
        JointKind::Slide => shift(joint.axis.map(|x| -joint.reference * x)),
        _ => Placement { position: [0.0; 3], rotation: about(joint.axis, -joint.reference) },
    }
}

/// Rotation by an angle about an axis, by rows: `1 + sin [n]x + (1 - cos) [n]x²` (Rodrigues).
fn about(n: [f64; 3], angle: f64) -> [[f64; 3]; 3] {
    let (s, c) = angle.sin_cos();
    let turn = [[0.0, -n[2], n[1]], [n[2], 0.0, -n[0]], [-n[1], n[0], 0.0]];
    [0, 1, 2].map(|i| {
        [0, 1, 2].map(|j| {
            let same = f64::from(u8::from(i == j));
            same + s * turn[i][j] + (1.0 - c) * (n[i] * n[j] - same)
        })
    })
}
