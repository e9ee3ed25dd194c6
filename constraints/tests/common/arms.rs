//! Invented robots, written link by link.

use nearl_constraints::Model;
use std::fmt::Write;

/// A joint and the link behind it.
struct Link {
    kind: &'static str,
    axis: &'static str,
    /// From the joint before [m].
    at: [f64; 3],
    limits: [f64; 2],
    velocity: f64,
    effort: f64,
    mass: f64,
    /// Centre of mass [m].
    com: [f64; 3],
}

fn turning(
    axis: &'static str,
    at: [f64; 3],
    limits: [f64; 2],
    effort: f64,
    mass: f64,
    com: [f64; 3],
) -> Link {
    Link { kind: "revolute", axis, at, limits, velocity: 3.1, effort, mass, com }
}

fn urdf(name: &str, links: &[Link], damping: f64, friction: f64) -> String {
    let mut text = format!("<robot name=\"{name}\"><link name=\"base\"/>");
    for (k, l) in links.iter().enumerate() {
        let parent = if k == 0 { "base".to_string() } else { format!("link{k}") };
        let (j, i) = (k + 1, 0.01 * l.mass);
        let [x, y, z] = l.at;
        let [cx, cy, cz] = l.com;
        let [low, high] = l.limits;
        write!(
            text,
            "<link name=\"link{j}\"><inertial><origin xyz=\"{cx} {cy} {cz}\"/><mass value=\"{}\"/>\
             <inertia ixx=\"{i}\" iyy=\"{i}\" izz=\"{i}\" ixy=\"0\" ixz=\"0\" iyz=\"0\"/></inertial></link>\
             <joint name=\"j{j}\" type=\"{}\"><parent link=\"{parent}\"/><child link=\"link{j}\"/>\
             <origin xyz=\"{x} {y} {z}\"/><axis xyz=\"{}\"/>\
             <limit lower=\"{low}\" upper=\"{high}\" velocity=\"{}\" effort=\"{}\"/>\
             <dynamics damping=\"{damping}\" friction=\"{friction}\"/></joint>",
            l.mass, l.kind, l.axis, l.velocity, l.effort,
        )
        .unwrap();
    }
    let k = links.len();
    text += &format!(
        "<link name=\"tool\"/><joint name=\"fix\" type=\"fixed\"><parent link=\"link{k}\"/><child link=\"tool\"/>\
         <origin xyz=\"0.1 0 0\"/></joint></robot>"
    );
    text
}

/// A small arm of six joints, 0.75 m long: text of its URDF, with dry friction [N·m] in every joint.
pub fn small_arm_text(friction: f64) -> String {
    let (y, z, x) = ("0 1 0", "0 0 1", "1 0 0");
    let links = [
        turning(z, [0.0, 0.0, 0.06], [-2.6, 2.6], 30.0, 0.7, [0.0, 0.0, 0.02]),
        turning(y, [0.0, 0.0, 0.045], [0.0, 2.9], 60.0, 1.2, [-0.11, 0.0, 0.0]),
        turning(y, [-0.35, 0.0, 0.0], [-2.8, 0.0], 30.0, 0.85, [0.11, 0.0, 0.02]),
        turning(y, [0.218, 0.0, 0.057], [-1.5, 1.5], 30.0, 0.57, [0.03, 0.0, 0.01]),
        turning(z, [0.07, 0.0, 0.0], [-1.3, 1.3], 30.0, 0.39, [0.02, 0.0, 0.0]),
        turning(x, [0.05, 0.0, 0.0], [-2.7, 2.7], 30.0, 0.3, [0.05, 0.0, 0.0]),
    ];
    urdf("small_arm", &links, 0.5, friction)
}

/// The small arm without friction.
pub fn small_arm() -> Model {
    Model::from_urdf_text(&small_arm_text(0.0)).unwrap()
}

/// A heavy arm on a rail: one sliding joint, four turning ones, weak at the elbow.
pub fn rail_arm() -> Model {
    let (y, z) = ("0 1 0", "0 0 1");
    let rail = Link {
        kind: "prismatic",
        axis: "1 0 0",
        at: [0.0, 0.0, 0.4],
        limits: [-1.0, 1.5],
        velocity: 1.2,
        effort: 900.0,
        mass: 12.0,
        com: [0.0; 3],
    };
    let links = [
        rail,
        turning(z, [0.0, 0.0, 0.2], [-3.0, 3.0], 150.0, 5.0, [0.0, 0.0, 0.1]),
        turning(y, [0.0, 0.0, 0.2], [-1.9, 1.9], 160.0, 4.0, [0.0, 0.0, 0.25]),
        turning(y, [0.0, 0.0, 0.5], [-2.4, 2.4], 60.0, 2.5, [0.0, 0.0, 0.2]),
        turning(y, [0.0, 0.0, 0.4], [-2.0, 2.0], 25.0, 1.0, [0.05, 0.0, 0.05]),
    ];
    Model::from_urdf_text(&urdf("rail_arm", &links, 1.0, 0.0)).unwrap()
}

/// An arm of `joints` turning joints about random axes, with random lengths, masses, ranges and motors.
pub fn random_arm(seed: u64, joints: usize) -> Model {
    let mut random = super::Random(seed);
    let mut links = Vec::new();
    for k in 0..joints {
        let axis = ["0 0 1", "0 1 0", "1 0 0"][if k == 0 { 0 } else { 1 + (random.next() * 1.6) as usize }];
        let at = [random.between(-0.05, 0.05), random.between(-0.05, 0.05), random.between(0.12, 0.35)];
        let limits = [random.between(-2.8, -1.2), random.between(1.0, 2.6)];
        let mass = random.between(0.4, 4.0) / (1.0 + k as f64);
        let com = [random.between(-0.03, 0.03), random.between(-0.03, 0.03), random.between(0.05, 0.15)];
        let effort = random.between(60.0, 160.0) / (1.0 + 0.5 * k as f64);
        links.push(Link {
            velocity: random.between(1.5, 4.0),
            ..turning(axis, at, limits, effort, mass, com)
        });
    }
    Model::from_urdf_text(&urdf("random_arm", &links, random.between(0.0, 0.5), 0.0)).unwrap()
}
