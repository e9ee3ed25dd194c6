//! What Pinocchio's MJCF reader leaves out, read from the XML: units, defaults, ranges, springs, dampers, armature,
//! motor strength, gravity, total mass. What would be read wrongly is refused.

use crate::ModelError;
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use roxmltree::{Document, Node};

/// One joint of the file; angles in rad.
#[derive(Debug, Clone)]
pub(crate) struct MjcfJoint {
    pub(crate) name: String,
    pub(crate) kind: MjcfKind,
    /// `None`: declared unlimited.
    pub(crate) range: Option<(f64, f64)>,
    pub(crate) stiffness: f64,
    pub(crate) spring_reference: f64,
    pub(crate) damping: f64,
    pub(crate) armature: f64,
    /// Largest generalised force of the motors on this joint, infinite when no motor states one.
    pub(crate) effort: f64,
}

/// Joint types of MJCF.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum MjcfKind {
    Free,
    Ball,
    Slide,
    Hinge,
}

impl MjcfKind {
    /// Number of configuration and velocity entries.
    pub(crate) fn size(self) -> (usize, usize) {
        match self {
            MjcfKind::Free => (7, 6),
            MjcfKind::Ball => (4, 3),
            MjcfKind::Slide | MjcfKind::Hinge => (1, 1),
        }
    }
}

/// The corrections of a file. Joints stand in the order of MuJoCo's `qpos`, grouped by body.
#[derive(Debug)]
pub(crate) struct Mjcf {
    pub(crate) gravity: [f64; 3],
    pub(crate) total_mass: Option<f64>,
    /// Where the base stands, if it has no joint.
    pub(crate) base: Option<Isometry3<f64>>,
    pub(crate) bodies: Vec<Vec<MjcfJoint>>,
    pub(crate) notes: Vec<String>,
}

/// Reads the corrections from the text of a file named `file` in messages.
pub(crate) fn read(xml: &str, file: &str) -> Result<Mjcf, ModelError> {
    let malformed = |reason: String| ModelError::Malformed { file: file.to_string(), format: "MJCF", reason };
    let document = Document::parse(xml).map_err(|e| malformed(e.to_string()))?;
    let root = document.root_element();
    if !root.has_tag_name("mujoco") {
        return Err(malformed(format!("its root element is <{}>, not <mujoco>", root.tag_name().name())));
    }
    let reader = Reader { root, file, degrees: compiler(root, "angle") != Some("radian") };
    reader.refuse_unsupported()?;
    let mut mjcf = Mjcf {
        gravity: reader.gravity()?,
        total_mass: reader.total_mass()?,
        base: reader.base()?,
        bodies: Vec::new(),
        notes: reader.notes(),
    };
    for body in children(root, "worldbody").flat_map(|w| children(w, "body")) {
        reader.body(body, None, &mut mjcf.bodies)?;
    }
    reader.motors(&mut mjcf)?;
    Ok(mjcf)
}

struct Reader<'a, 'i: 'a> {
    root: Node<'a, 'i>,
    file: &'a str,
    degrees: bool,
}

impl<'a, 'i: 'a> Reader<'a, 'i> {
    fn unsupported(&self, feature: &str, next: &'static str) -> ModelError {
        ModelError::Unsupported { file: self.file.to_string(), feature: feature.to_string(), next }
    }

    /// Everything that would give a wrong mass matrix without a word.
    fn refuse_unsupported(&self) -> Result<(), ModelError> {
        let expand = "load it in MuJoCo and save the expanded model with mj_saveLastXML";
        for tag in ["include", "replicate", "attach", "frame", "composite", "flexcomp"] {
            if self.root.descendants().any(|n| n.has_tag_name(tag)) {
                return Err(self.unsupported(&format!("<{tag}>"), expand));
            }
        }
        for section in ["compiler", "default"] {
            if children(self.root, section).nth(1).is_some() {
                let next = "put all of it into one, the reader would take the first";
                return Err(self.unsupported(&format!("several <{section}> sections"), next));
            }
        }
        for key in ["inertiagrouprange", "boundmass", "boundinertia", "balanceinertia"] {
            if compiler(self.root, key).is_some() {
                return Err(
                    self.unsupported(&format!("compiler {key}"), "write explicit <inertial> elements")
                );
            }
        }
        for node in self.root.descendants() {
            let Some(text) = node.attribute("axisangle") else { continue };
            let axis = self.numbers(text, "axisangle")?;
            let length = axis.iter().take(3).map(|x| x * x).sum::<f64>().sqrt();
            if (length - 1.0).abs() > 1e-9 {
                let next = "divide the axis by its length, the reader takes it as it is";
                return Err(
                    self.unsupported(&format!("axisangle '{text}' with an axis of length {length}"), next)
                );
            }
        }
        let top = children(self.root, "worldbody").flat_map(|w| children(w, "body"));
        let massive: Vec<String> = top
            .filter(|b| b.descendants().any(|n| is_joint(n) || n.has_tag_name("geom")))
            .map(called)
            .collect();
        if massive.len() > 1 {
            let next = "keep one tree below <worldbody>, the reader would drop the others";
            return Err(self.unsupported(&format!("several top-level bodies: {}", massive.join(", ")), next));
        }
        let from_geoms = compiler(self.root, "inertiafromgeom");
        if from_geoms == Some("true") && self.root.descendants().any(|n| n.has_tag_name("inertial")) {
            let next = "take the <inertial> elements out, the reader would follow them";
            return Err(self.unsupported("compiler inertiafromgeom='true' beside <inertial>", next));
        }
        for geom in self.root.descendants().filter(|n| n.has_tag_name("geom")) {
            let Some(body) = geom.parent_element().filter(|p| p.has_tag_name("body")) else { continue };
            let from_inertial = from_geoms != Some("true") && children(body, "inertial").next().is_some();
            let is_massless = from_inertial || self.attribute(geom, "mass") == Some("0");
            let is_mesh =
                self.attribute(geom, "type") == Some("mesh") || self.attribute(geom, "mesh").is_some();
            if is_mesh && !is_massless {
                let next =
                    "give its body an <inertial>, the reader reads no meshes and would take it for massless";
                return Err(self.unsupported(&format!("mesh {} of {}", called(geom), called(body)), next));
            }
            let bodiless = [("contype", "1"), ("conaffinity", "1")]
                .iter()
                .all(|(key, default)| self.attribute(geom, key).unwrap_or(default).trim() == "0");
            if bodiless && !is_massless {
                let next = "give its body an <inertial>, the reader would take it for massless";
                let (geom, body) = (called(geom), called(body));
                let feature = format!("{geom} of {body} without collision (contype and conaffinity 0)");
                return Err(self.unsupported(&feature, next));
            }
        }
        self.refuse_forces()
    }

    /// Forces that would be missing without a word, or be there though they are switched off.
    fn refuse_forces(&self) -> Result<(), ModelError> {
        let flags = || children(self.root, "option").flat_map(|o| children(o, "flag"));
        for key in ["damper", "spring", "eulerdamp", "actuation"] {
            if flags().any(|f| f.attribute(key) == Some("disable")) {
                return Err(self.unsupported(&format!("flag {key}='disable'"), "take it out"));
            }
        }
        for motor in children(self.root, "actuator").flat_map(|a| a.children()).filter(Node::is_element) {
            for key in ["armature", "damping"] {
                let stated = self
                    .attribute(motor, key)
                    .filter(|text| text.split_whitespace().any(|x| x.parse() != Ok(0.0)));
                if let Some(text) = stated {
                    let next = "write it at the joint";
                    return Err(self.unsupported(&format!("{key}='{text}' of {}", called(motor)), next));
                }
            }
        }
        for node in self.root.descendants() {
            let stated = |key: &str| match self.attribute(node, key) {
                Some(text) => {
                    let numbers = self.numbers(text, &format!("{key} of {}", called(node)))?;
                    Ok(numbers
                        .iter()
                        .any(|x| *x != 0.0)
                        .then(|| format!("{key}='{text}' of {}", called(node))))
                }
                None => Ok(None),
            };
            if node.has_tag_name("body")
                && let Some(feature) = stated("gravcomp")?
            {
                return Err(self.unsupported(&feature, "take it out"));
            }
            if is_joint(node)
                && let Some(feature) = stated("springdamper")?
            {
                return Err(self.unsupported(&feature, "write stiffness and damping instead"));
            }
        }
        Ok(())
    }

    fn gravity(&self) -> Result<[f64; 3], ModelError> {
        let options = || children(self.root, "option");
        let off =
            options().flat_map(|o| children(o, "flag")).any(|f| f.attribute("gravity") == Some("disable"));
        if off {
            return Ok([0.0; 3]);
        }
        let Some(text) = options().filter_map(|o| o.attribute("gravity")).last() else {
            return Ok([0.0, 0.0, -9.81]);
        };
        let g = self.numbers(text, "option gravity")?;
        <[f64; 3]>::try_from(g)
            .map_err(|g| self.impossible(format!("option gravity has {} numbers", g.len())))
    }

    fn total_mass(&self) -> Result<Option<f64>, ModelError> {
        let Some(text) = compiler(self.root, "settotalmass") else { return Ok(None) };
        let mass = self.number(text, "compiler settotalmass")?;
        Ok((mass > 0.0).then_some(mass)) // MuJoCo: negative means off
    }

    /// The pose of the top-level body, which Pinocchio reads only where it has a joint.
    fn base(&self) -> Result<Option<Isometry3<f64>>, ModelError> {
        let mut top = children(self.root, "worldbody").flat_map(|w| children(w, "body"));
        let Some(base) = top.find(|b| b.descendants().any(is_joint)).filter(|b| !b.children().any(is_joint))
        else {
            return Ok(None);
        };
        for key in ["euler", "axisangle", "xyaxes", "zaxis"] {
            if base.attribute(key).is_some() {
                return Err(
                    self.unsupported(&format!("{key} of {}", called(base)), "write it as quat='w x y z'")
                );
            }
        }
        let numbers = |key: &str, otherwise: &[f64]| match base.attribute(key) {
            Some(text) => self.numbers(text, &format!("{key} of {}", called(base))),
            None => Ok(otherwise.to_vec()),
        };
        let (position, rotation) = (numbers("pos", &[0.0; 3])?, numbers("quat", &[1.0, 0.0, 0.0, 0.0])?);
        let (&[x, y, z], &[w, i, j, k]) = (&position[..], &rotation[..]) else {
            return Err(self.impossible(format!("pos or quat of {} has not 3 and 4 numbers", called(base))));
        };
        let rotation = UnitQuaternion::try_new(Quaternion::new(w, i, j, k), 1e-9)
            .ok_or_else(|| self.impossible(format!("quat of {} is zero", called(base))))?;
        Ok(Some(Isometry3::from_parts(Translation3::new(x, y, z), rotation)))
    }

    /// Forces of the file that are not part of the equations of motion here.
    fn notes(&self) -> Vec<String> {
        let mut notes = Vec::new();
        let mut note = |present: bool, text: &str| {
            if present {
                notes.push(text.to_string());
            }
        };
        let has = |tag: &str| self.root.children().any(|n| n.has_tag_name(tag) && n.has_children());
        note(has("equality"), "equality constraints are not modelled");
        note(has("tendon"), "tendons are not modelled");
        let joints = || self.root.descendants().filter(|n| is_joint(*n));
        let friction = |n: Node| self.attribute(n, "frictionloss").is_some_and(|x| x.trim() != "0");
        note(joints().any(friction), "joint frictionloss is not modelled");
        let fluid = ["density", "viscosity", "wind"];
        let air = children(self.root, "option").any(|o| fluid.iter().any(|k| o.attribute(*k).is_some()));
        note(air, "fluid forces are not modelled");
        notes
    }

    fn body(
        &self,
        body: Node<'a, 'i>,
        class: Option<&'a str>,
        out: &mut Vec<Vec<MjcfJoint>>,
    ) -> Result<(), ModelError> {
        let class = body.attribute("childclass").or(class);
        let joints: Vec<MjcfJoint> =
            body.children().filter(|n| is_joint(*n)).map(|n| self.joint(n)).collect::<Result<_, _>>()?;
        if !joints.is_empty() {
            out.push(joints);
        }
        for child in children(body, "body") {
            self.body(child, class, out)?;
        }
        Ok(())
    }

    fn joint(&self, node: Node<'a, 'i>) -> Result<MjcfJoint, ModelError> {
        let name = node.attribute("name").unwrap_or_default().to_string();
        let kind = match self.attribute(node, "type") {
            _ if node.has_tag_name("freejoint") => MjcfKind::Free,
            None | Some("hinge") => MjcfKind::Hinge,
            Some("slide") => MjcfKind::Slide,
            Some("ball") => MjcfKind::Ball,
            Some("free") => MjcfKind::Free,
            Some(other) => return Err(self.impossible(format!("joint '{name}' has type '{other}'"))),
        };
        let angle = if self.degrees && matches!(kind, MjcfKind::Hinge | MjcfKind::Ball) { RAD } else { 1.0 };
        let value = |key: &str| match self.attribute(node, key) {
            Some(text) => self.number(text, &format!("joint '{name}' {key}")),
            None => Ok(0.0),
        };
        if kind.size().1 > 1 && value("stiffness")? != 0.0 {
            let next = "set its stiffness to 0";
            return Err(self.unsupported(&format!("a spring on the {kind:?} joint '{name}'"), next));
        }
        let range = match self.limited(node, "limited", "range") {
            true if kind.size().1 == 1 => Some(self.range(node, "range", angle, &name)?),
            _ => None,
        };
        let effort = match self.limited(node, "actuatorfrclimited", "actuatorfrcrange") {
            true => symmetric(self.range(node, "actuatorfrcrange", 1.0, &name)?),
            false => f64::INFINITY,
        };
        Ok(MjcfJoint {
            kind,
            range,
            effort,
            stiffness: value("stiffness")?,
            spring_reference: value("springref")? * angle,
            damping: value("damping")?,
            armature: value("armature")?,
            name,
        })
    }

    /// Effort limit of each joint: the sum of its motors' `gear * ctrlrange * gain`, or less where a force range says so.
    fn motors(&self, mjcf: &mut Mjcf) -> Result<(), ModelError> {
        let mut sums: Vec<(String, f64)> = Vec::new();
        for node in children(self.root, "actuator").flat_map(|a| a.children()).filter(Node::is_element) {
            let Some(joint) = self.attribute(node, "joint").or_else(|| self.attribute(node, "jointinparent"))
            else {
                mjcf.notes
                    .push(format!("actuator <{}> without a joint is not modelled", node.tag_name().name()));
                continue;
            };
            let strength = self.motor(node, joint)?;
            match sums.iter_mut().find(|(name, _)| name == joint) {
                Some((_, sum)) => *sum += strength,
                None => sums.push((joint.to_string(), strength)),
            }
        }
        for joint in mjcf.bodies.iter_mut().flatten() {
            if let Some((_, sum)) = sums.iter().find(|(name, _)| *name == joint.name) {
                joint.effort = joint.effort.min(*sum);
            }
        }
        Ok(())
    }

    /// `|gear| * min(|gain| * ctrlrange, forcerange)` of one motor, infinite when neither range is stated.
    fn motor(&self, node: Node<'a, 'i>, joint: &str) -> Result<f64, ModelError> {
        let gear = match self.attribute(node, "gear") {
            Some(text) => self.first(text, &format!("actuator of '{joint}' gear"))?.unwrap_or(1.0).abs(),
            None => 1.0,
        };
        let mut force = f64::INFINITY;
        if self.limited(node, "ctrllimited", "ctrlrange")
            && let Some(gain) = self.gain(node, joint)?
        {
            force = gain.abs() * symmetric(self.range(node, "ctrlrange", 1.0, joint)?);
        }
        if self.limited(node, "forcelimited", "forcerange") {
            force = force.min(symmetric(self.range(node, "forcerange", 1.0, joint)?));
        }
        Ok(gear * force)
    }

    /// Force per control where that is all of the force. As in MuJoCo, <motor> sets gain and bias anew, wherever it stands.
    fn gain(&self, node: Node<'a, 'i>, joint: &str) -> Result<Option<f64>, ModelError> {
        let (mut gain, mut fixed, mut unbiased, mut shortcut) = (1.0, true, true, None);
        for setting in self.settings(node) {
            let law = ["gainprm", "gaintype", "biastype"].map(|key| setting.attribute(key));
            match (setting.tag_name().name(), shortcut) {
                ("motor", _) => (gain, fixed, unbiased, shortcut) = (1.0, true, true, None),
                ("general", Some(tag)) if tag == "adhesion" || law.iter().any(Option::is_some) => {
                    let feature = format!("<general> on top of <{tag}> for the actuator of '{joint}'");
                    return Err(self.unsupported(&feature, "put the two into different default classes"));
                }
                ("general", _) => {
                    if let Some(text) = law[0] {
                        gain = self.first(text, &format!("actuator of '{joint}' gainprm"))?.unwrap_or(gain);
                    }
                    fixed = law[1].map_or(fixed, |kind| kind == "fixed");
                    unbiased = law[2].map_or(unbiased, |kind| kind == "none");
                }
                (tag, _) => shortcut = Some(tag),
            }
        }
        Ok((shortcut.is_none() && fixed && unbiased).then_some(gain))
    }

    /// MuJoCo's tristate: stated, else true when the range is there (and `autolimits` is not off).
    fn limited(&self, node: Node<'a, 'i>, key: &str, range: &str) -> bool {
        match self.attribute(node, key) {
            Some("true") => true,
            Some("false") => false,
            _ => compiler(self.root, "autolimits") != Some("false") && self.attribute(node, range).is_some(),
        }
    }

    fn range(&self, node: Node<'a, 'i>, key: &str, unit: f64, joint: &str) -> Result<(f64, f64), ModelError> {
        let numbers =
            self.numbers(self.attribute(node, key).unwrap_or("0 0"), &format!("'{joint}' {key}"))?;
        match numbers[..] {
            [low, high] if low <= high => Ok((low * unit, high * unit)),
            [low, high] => {
                Err(self.impossible(format!("'{joint}' {key} has lower {low} above upper {high}")))
            }
            _ => Err(self.impossible(format!("'{joint}' {key} has {} numbers instead of 2", numbers.len()))),
        }
    }

    /// An attribute of `node`: its own, else that of its default class and the classes around it.
    fn attribute(&self, node: Node<'a, 'i>, key: &str) -> Option<&'a str> {
        let own = node.attribute(key);
        own.or_else(|| self.settings(node).iter().rev().find_map(|n| n.attribute(key)))
    }

    /// The elements that set attributes of `node`: its default classes from the outside in, then itself. Later ones win.
    fn settings(&self, node: Node<'a, 'i>) -> Vec<Node<'a, 'i>> {
        let mut settings = vec![node];
        if node.has_tag_name("freejoint") {
            return settings; // free joints of this form take no defaults
        }
        let class = node.attribute("class").or_else(|| {
            node.ancestors()
                .skip(1)
                .filter(|n| n.has_tag_name("body"))
                .find_map(|n| n.attribute("childclass"))
        });
        // MuJoCo keeps one actuator default a class, which every actuator tag sets.
        let actuator = node.parent_element().is_some_and(|p| p.has_tag_name("actuator"));
        let applies = |n: &Node| match actuator {
            true => ACTUATORS.contains(&n.tag_name().name()),
            false => n.tag_name() == node.tag_name(),
        };
        let mut at = self.default_class(class.unwrap_or("main"));
        while let Some(default) = at {
            settings.extend(default.children().rev().filter(applies));
            at = default.parent_element().filter(|p| p.has_tag_name("default"));
        }
        settings.reverse();
        settings
    }

    fn default_class(&self, class: &str) -> Option<Node<'a, 'i>> {
        let mut all = self.root.descendants().filter(|n| n.has_tag_name("default"));
        all.find(|n| n.attribute("class").unwrap_or("main") == class)
    }

    fn impossible(&self, list: String) -> ModelError {
        ModelError::Impossible { file: self.file.to_string(), list }
    }

    fn number(&self, text: &str, what: &str) -> Result<f64, ModelError> {
        match self.numbers(text, what)?[..] {
            [x] => Ok(x),
            _ => Err(self.impossible(format!("{what} is '{text}', not one number"))),
        }
    }

    /// The first of some numbers, if there is one.
    fn first(&self, text: &str, what: &str) -> Result<Option<f64>, ModelError> {
        Ok(self.numbers(text, what)?.first().copied())
    }

    fn numbers(&self, text: &str, what: &str) -> Result<Vec<f64>, ModelError> {
        let parse = |word: &str| word.parse::<f64>().ok().filter(|x| x.is_finite());
        text.split_whitespace()
            .map(|word| parse(word).ok_or_else(|| self.impossible(format!("{what} is '{text}'"))))
            .collect()
    }
}

const RAD: f64 = std::f64::consts::PI / 180.0;

/// What may stand for an actuator in a default class.
const ACTUATORS: [&str; 10] = [
    "general",
    "motor",
    "position",
    "velocity",
    "intvelocity",
    "damper",
    "cylinder",
    "muscle",
    "adhesion",
    "dcmotor",
];

/// "body 'arm'", or "an unnamed body in line 7".
fn called(node: Node) -> String {
    let tag = node.tag_name().name();
    match node.attribute("name") {
        Some(name) => format!("{tag} '{name}'"),
        None => format!("an unnamed {tag} in line {}", node.document().text_pos_at(node.range().start).row),
    }
}

/// The force available in both directions.
fn symmetric((low, high): (f64, f64)) -> f64 {
    (-low).min(high).max(0.0)
}

fn is_joint(node: Node) -> bool {
    let in_body = node.parent_element().is_some_and(|p| p.has_tag_name("body"));
    in_body && (node.has_tag_name("joint") || node.has_tag_name("freejoint"))
}

fn children<'a, 'i: 'a>(node: Node<'a, 'i>, tag: &'a str) -> impl Iterator<Item = Node<'a, 'i>> {
    node.children().filter(move |n| n.has_tag_name(tag))
}

/// A setting of the <compiler> element.
fn compiler<'a>(root: Node<'a, '_>, key: &str) -> Option<&'a str> {
    root.children().find(|n| n.has_tag_name("compiler")).and_then(|n| n.attribute(key))
}
