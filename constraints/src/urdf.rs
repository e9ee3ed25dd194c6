//! A robot from a URDF: links become bodies, fixed joints frames, in Pinocchio's order (the joints of a link by name).
//!
//! A file that describes no possible robot is refused, with everything that is wrong in one sentence. What a description cannot hold becomes a note.

mod check;
mod collision;
mod notes;

use crate::ModelError;
use crate::description::{Body, Frame, JointDescription, JointKind, Motor, Range, RobotDescription, mimics};
use crate::geometry::Placement;
pub(crate) use check::ROUNDING;
use check::{check_joint, check_link, check_tree};
use roxmltree::{Document, Node, ParsingOptions};
use std::collections::HashMap;

/// Acceleration of free fall that URDF implies [m/s²].
const GRAVITY: [f64; 3] = [0.0, 0.0, -9.81];

/// Larger files are refused while they are read.
const MOST_NODES: u32 = 1_000_000;

/// The parser compares the attributes of an element with each other: longer tags are refused before it [bytes].
const MOST_OF_A_TAG: usize = 4096;

/// Lengths of the tags, comments and declarations aside.
fn tags(xml: &str) -> impl Iterator<Item = usize> {
    let parts = xml.split('<').skip(1).filter(|part| !part.starts_with(['!', '?']));
    parts.map(|part| part.find('>').unwrap_or(part.len()))
}

/// Reads a text called `file` in messages; with `free_flyer` the root link floats on a joint called `root_joint`.
pub(crate) fn read(xml: &str, file: &str, free_flyer: bool) -> Result<RobotDescription, ModelError> {
    let malformed = |reason: String| ModelError::Malformed { file: file.to_string(), format: "URDF", reason };
    if let Some(length) = tags(xml).find(|length| *length > MOST_OF_A_TAG) {
        return Err(malformed(format!("one of its tags has {length} bytes, more than {MOST_OF_A_TAG}")));
    }
    let options = ParsingOptions { nodes_limit: MOST_NODES, ..ParsingOptions::default() };
    let document = Document::parse_with_options(xml, options).map_err(|e| malformed(e.to_string()))?;
    let root = document.root_element();
    if !root.has_tag_name("robot") {
        return Err(malformed(format!("its root element is <{}>, not <robot>", root.tag_name().name())));
    }
    let is_macro = |node: &Node| node.tag_name().namespace().is_some_and(|space| space.ends_with("xacro"));
    if let Some(node) = root.descendants().find(is_macro) {
        let name = node.tag_name().name();
        return Err(malformed(format!(
            "it has macros (<xacro:{name}>), of which the program xacro makes a URDF"
        )));
    }
    let mut wrong = Vec::new();
    children(root, "link").for_each(|link| check_link(link, &mut wrong));
    check_tree(root, &mut wrong);
    children(root, "joint").for_each(|joint| check_joint(joint, &mut wrong));
    let mut reader = Reader { robot: empty(root), wrong };
    if reader.wrong.is_empty() {
        reader.tree(root, free_flyer);
        reader.notes(root);
    }
    match reader.wrong.is_empty() {
        true => Ok(reader.robot),
        false => Err(ModelError::Impossible { file: file.to_string(), list: reader.wrong.join("; ") }),
    }
}

struct Reader {
    robot: RobotDescription,
    wrong: Vec<String>,
}

impl Reader {
    /// Adds the links depth first, without recursion: a chain may be long.
    fn tree(&mut self, root: Node, free_flyer: bool) {
        let links: HashMap<_, _> = children(root, "link").map(|link| (called(link), link)).collect();
        let mut below: HashMap<&str, Vec<Node>> = HashMap::new();
        let mut joints: Vec<_> = children(root, "joint").collect();
        joints.sort_by_key(|joint| called(*joint));
        joints.iter().for_each(|joint| below.entry(end(*joint, "parent")).or_default().push(*joint));
        let is_child = |link: &Node| joints.iter().any(|joint| end(*joint, "child") == called(*link));
        let Some(first) = children(root, "link").find(|link| !is_child(link)) else { return };
        let mut open = vec![(first, None, None)];
        let mut seen = 0;
        while let Some((link, joint, parent)) = open.pop() {
            let number = self.robot.bodies.len();
            self.body(link, joint, parent);
            if joint.is_none() && free_flyer {
                self.robot.bodies[0].joints.push(JointDescription::new("root_joint", JointKind::Free));
            }
            let next = below.get(called(link)).into_iter().flatten().rev();
            open.extend(next.map(|joint| (links[end(*joint, "child")], Some(*joint), Some(number))));
            seen += 1;
        }
        if seen < links.len() {
            let there = |name: &&&str| !self.robot.bodies.iter().any(|body| body.name == **name);
            let mut circle: Vec<_> = links.keys().filter(there).map(|name| format!("'{name}'")).collect();
            circle.sort();
            let names = circle.join(", ");
            self.wrong.push(format!(
                "the links {names} hang on each other in a circle and not on '{}'",
                called(first)
            ));
        }
    }

    fn body(&mut self, link: Node, joint: Option<Node>, parent: Option<usize>) {
        let number = self.robot.bodies.len();
        let mut body = Body {
            name: called(link).to_string(),
            parent,
            placement: joint.map_or(Placement::IDENTITY, |joint| self.origin(joint)),
            mass: 0.0,
            com: [0.0; 3],
            inertia: [0.0; 6],
            joints: Vec::new(),
        };
        if let Some(inertial) = children(link, "inertial").next() {
            self.inertial(link, inertial, &mut body);
        }
        if let Some(joint) = joint {
            match self.joint(joint) {
                Some(joint) => body.joints.push(joint),
                None => self.robot.frames.push(Frame {
                    name: called(joint).to_string(),
                    body: Some(number),
                    placement: Placement::IDENTITY,
                }),
            }
        }
        let solids = children(link, "collision");
        self.robot.solids.extend(solids.filter_map(|c| collision::read(number, c, &mut self.wrong)));
        self.robot.bodies.push(body);
    }

    /// Mass, its centre, and the inertia `R I R'` in the link's axes.
    fn inertial(&mut self, link: Node, inertial: Node, body: &mut Body) {
        let at = self.origin(inertial);
        let name = called(link);
        let [mass] = self.numbers(name, inertial, "mass", ["value"]);
        let keys = ["ixx", "ixy", "ixz", "iyy", "iyz", "izz"];
        let [xx, xy, xz, yy, yz, zz] = self.numbers(name, inertial, "inertia", keys);
        let (own, r) = ([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], at.rotation);
        let entry = |i: usize, j: usize| -> f64 {
            (0..3).map(|k| (0..3).map(|l| r[i][k] * own[k][l] * r[j][l]).sum::<f64>()).sum()
        };
        (body.mass, body.com) = (mass, at.position);
        body.inertia = match r == Placement::IDENTITY.rotation {
            true => [xx, xy, xz, yy, yz, zz],
            false => [entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)],
        };
    }

    /// A moving joint; `None` for a fixed one.
    fn joint(&mut self, node: Node) -> Option<JointDescription> {
        let name = called(node);
        let kind = match node.attribute("type") {
            Some("revolute") => JointKind::Hinge,
            Some("continuous") => JointKind::Continuous,
            Some("prismatic") => JointKind::Slide,
            Some("floating") => JointKind::Free,
            Some("planar") => JointKind::Planar,
            _ => return None,
        };
        let mut joint = JointDescription::new(name, kind);
        let axis = self.axis(node);
        if kind == JointKind::Planar && axis != [0.0, 0.0, 1.0] {
            let text = "moves in its x-y plane here; turn its <origin> so that the axis is 0 0 1";
            self.wrong.push(format!("planar joint '{name}' has the axis {axis:?}, but {text}"));
        }
        if !kind.has_one_dof() {
            return Some(joint);
        }
        joint.axis = axis;
        let limit = |key| number(children(node, "limit").next()?, key);
        joint.range = match (limit("lower"), limit("upper")) {
            _ if kind == JointKind::Continuous => Range::Unlimited,
            (None, None) => Range::NotStated,
            (lower, upper) => Range::Limited(lower.unwrap_or(0.0), upper.unwrap_or(0.0)),
        };
        // A zero means that nobody filled it in.
        (joint.velocity, joint.effort) =
            (limit("velocity").filter(|x| *x > 0.0), limit("effort").filter(|x| *x > 0.0));
        let dynamics = children(node, "dynamics").next();
        [joint.damping, joint.friction] = ["damping", "friction"].map(|key| {
            let Some(text) = dynamics.and_then(|dynamics| dynamics.attribute(key)) else { return 0.0 };
            finite(text).unwrap_or_else(|| {
                self.wrong.push(format!("joint '{name}' has <dynamics> {key} '{text}', not a number"));
                0.0
            })
        });
        let order = self.robot.motors.len();
        self.robot.motors.push(Motor::direct(name, order, joint.effort));
        Some(joint)
    }

    /// The axis at length 1; along x where none is stated.
    fn axis(&mut self, joint: Node) -> [f64; 3] {
        let Some(axis) = children(joint, "axis").next() else { return [1.0, 0.0, 0.0] };
        let xyz: [f64; 3] = self.three(joint, axis, "xyz", "1 0 0");
        let length = xyz.iter().map(|x| x * x).sum::<f64>().sqrt();
        if length == 1.0 { xyz } else { xyz.map(|x| x / length) }
    }

    /// `<origin xyz rpy>` of an element.
    fn origin(&mut self, of: Node) -> Placement {
        let Some(origin) = children(of, "origin").next() else { return Placement::IDENTITY };
        let position = self.three(of, origin, "xyz", "0 0 0");
        match self.three(of, origin, "rpy", "0 0 0") {
            [0.0, 0.0, 0.0] => Placement { position, ..Placement::IDENTITY },
            rpy => Placement::new(position, rpy),
        }
    }

    fn three(&mut self, of: Node, node: Node, key: &str, otherwise: &str) -> [f64; 3] {
        let text = node.attribute(key).unwrap_or(otherwise);
        let numbers: Option<Vec<f64>> = text.split_whitespace().map(finite).collect();
        numbers.and_then(|x| x.try_into().ok()).unwrap_or_else(|| {
            let name = of.ancestors().find_map(|n| n.attribute("name")).unwrap_or("?");
            let (tag, inner) = (of.tag_name().name(), node.tag_name().name());
            self.wrong.push(format!("{tag} of '{name}' has {inner} {key} '{text}', not three numbers"));
            [0.0, 0.0, 1.0]
        })
    }

    /// Attributes that must be there.
    fn numbers<const N: usize>(&mut self, link: &str, of: Node, tag: &str, keys: [&str; N]) -> [f64; N] {
        let node = children(of, tag).next();
        keys.map(|key| {
            node.and_then(|node| number(node, key)).unwrap_or_else(|| {
                self.wrong.push(format!("link '{link}' has an <inertial> without {tag} {key}"));
                0.0
            })
        })
    }

    /// What the description leaves out, and links that move and weigh nothing.
    fn notes(&mut self, root: Node) {
        let robot = &mut self.robot;
        robot.notes.extend(children(root, "joint").filter_map(|joint| mimic(root, joint)));
        robot.notes.extend(children(root, "joint").flat_map(notes::of_joint));
        robot.notes.extend(notes::inertias(&robot.bodies));
        let mut weighs: Vec<bool> = robot.bodies.iter().map(|body| body.mass > 0.0).collect();
        for k in (0..robot.bodies.len()).rev().filter(|k| robot.bodies[*k].joints.is_empty()) {
            if let Some(parent) = robot.bodies[k].parent {
                weighs[parent] |= weighs[k];
            }
        }
        let light =
            robot.bodies.iter().zip(&weighs).filter(|(body, weighs)| !(body.joints.is_empty() || **weighs));
        let names: Vec<String> = light.map(|(body, _)| format!("'{}'", body.name)).collect();
        if !names.is_empty() {
            let names = names.join(", ");
            robot.notes.push(format!(
                "the moving links {names} have no mass: give each an <inertial>, or fix it to its parent"
            ));
        }
    }
}

fn empty(root: Node) -> RobotDescription {
    RobotDescription {
        name: called(root).to_string(),
        gravity: GRAVITY,
        bodies: Vec::new(),
        frames: Vec::new(),
        solids: Vec::new(),
        motors: Vec::new(),
        notes: Vec::new(),
    }
}

/// A mimic joint is one of its own to the limits.
fn mimic(root: Node, joint: Node) -> Option<String> {
    let mimic = joint.children().find(|n| n.has_tag_name("mimic"))?;
    let (name, of) = (joint.attribute("name").unwrap_or("?"), mimic.attribute("joint").unwrap_or("?"));
    let (multiplier, offset) =
        (number(mimic, "multiplier").unwrap_or(1.0), number(mimic, "offset").unwrap_or(0.0));
    if children(root, "joint").all(|other| other.attribute("name") != Some(of)) {
        return Some(format!(
            "joint '{name}' mimics '{of}', which is not there: it moves by itself; correct the name in its <mimic>, or leave it out of the controllable joints"
        ));
    }
    let begins = mimics(name, of, multiplier, offset);
    let by = -multiplier;
    Some(format!(
        "{begins}: a simulation holds the two together, and the limits do not know of it; command both and hold them together with \
         rows = [{{ name = \"mimic\", terms = {{ \"q.{name}\" = 1.0, \"q.{of}\" = {by:?} }}, equals = {offset:?} }}] in [constraints], or leave both \
         out of the controllable joints"
    ))
}

fn children<'a, 'i: 'a>(node: Node<'a, 'i>, tag: &'a str) -> impl Iterator<Item = Node<'a, 'i>> {
    node.children().filter(move |n| n.has_tag_name(tag))
}

fn called<'a>(node: Node<'a, '_>) -> &'a str {
    node.attribute("name").unwrap_or("?")
}

/// The link at one end of a joint.
fn end<'a, 'i: 'a>(joint: Node<'a, 'i>, tag: &'a str) -> &'a str {
    children(joint, tag).find_map(|n| n.attribute("link")).unwrap_or("?")
}

fn number(node: Node, key: &str) -> Option<f64> {
    finite(node.attribute(key)?)
}

fn finite(word: &str) -> Option<f64> {
    word.trim().parse().ok().filter(|x: &f64| x.is_finite())
}
