//! The limits of a snapshot, read from `[constraints]` of its task: numbers for each joint, and rows over several.

use std::collections::BTreeMap;
use std::rc::Rc;

use serde::Deserialize;

use crate::collision::Collision;
use crate::drives::Drives;
use crate::motion::Machine;
use crate::robot::{Range, Robot, Shape};
use crate::rows::{BY_ITS_TARGET, Equal, Row, Rule, SHORT, Soft, Term};
use crate::space::{Vec3, dot, norm, times};

/// `[constraints]`. A key that is not known here is not verified, and refused by name.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Section {
    #[serde(default)]
    pub(crate) consistency: Consistency,
    #[serde(default)]
    #[allow(dead_code)] // any stage must give the same answer
    solver: serde::de::IgnoredAny,
    #[serde(default)]
    pub(crate) braking: Way,
    #[serde(default)]
    pub(crate) guard: serde_json::Value,
    /// Joints stop so far before the ends of their ranges at least [rad or m].
    #[serde(skip)]
    pub(crate) gap: f64,
    /// Share of the acceleration limit that braking leaves.
    #[serde(skip)]
    pub(crate) reserve: f64,
    /// Bounds actions by what was reached; no limit of a state.
    #[serde(default)]
    #[allow(dead_code)] // actions of a network are not verified
    reached: serde::de::IgnoredAny,
    position: Option<Position>,
    velocity: Option<Velocity>,
    acceleration: Option<Acceleration>,
    torque: Option<Torque>,
    jerk: Option<Jerk>,
    torque_speed: Option<TorqueSpeed>,
    torque_rate: Option<Rate>,
    velocity_profile: Option<Profiles>,
    #[serde(default)]
    locked: Vec<String>,
    #[serde(default)]
    frame: Vec<FrameSection>,
    #[serde(default)]
    frame_speed: Vec<FrameSpeed>,
    energy: Option<Energy>,
    collision: Option<CollisionSection>,
    /// Limits on actions; no limit of a state.
    pub(crate) action: Option<serde_json::Value>,
    #[serde(default)]
    rows: Vec<UserRow>,
}

/// How position and velocity of a proposal belong together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Consistency {
    #[default]
    Kinematic,
    Free,
}

/// What makes sure that a way to stop is left.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Way {
    #[default]
    Auto,
    Certified,
    Stored,
}

/// A number for every joint, by name, or in the order of the dofs.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
pub(crate) enum PerJoint {
    All(f64),
    Named(BTreeMap<String, f64>),
    Each(Vec<f64>),
}

impl PerJoint {
    pub(crate) fn of(&self, dof: usize, joint: &str) -> Option<f64> {
        match self {
            PerJoint::All(x) => Some(*x),
            PerJoint::Named(map) => map.get(joint).copied(),
            PerJoint::Each(list) => list.get(dof).copied(),
        }
    }
}

/// `x` less a margin of the same joint.
fn less(x: f64, margin: &Option<PerJoint>, dof: usize, joint: &str) -> f64 {
    x - margin.as_ref().and_then(|m| m.of(dof, joint)).unwrap_or(0.0)
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Position {
    margin: Option<PerJoint>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Velocity {
    scale: Option<f64>,
    limit: Option<PerJoint>,
    margin: Option<PerJoint>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Acceleration {
    limit: PerJoint,
    braking: Option<PerJoint>,
    margin: Option<PerJoint>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Torque {
    #[serde(default = "one")]
    scale: f64,
    margin: Option<PerJoint>,
    soft: Option<Soft>,
}

fn one() -> f64 {
    1.0
}

/// `jerk`: soft unless it is said to be hard.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Jerk {
    limit: PerJoint,
    margin: Option<PerJoint>,
    soft: Option<Soft>,
    #[serde(default)]
    hard: bool,
}

/// `torque_rate`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Rate {
    limit: PerJoint,
    margin: Option<PerJoint>,
    #[serde(default)]
    soft: Soft,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct TorqueSpeed {
    stall: PerJoint,
    no_load: PerJoint,
    margin: Option<PerJoint>,
    soft: Option<Soft>,
}

#[derive(Debug, Deserialize)]
#[serde(untagged)]
enum Profiles {
    Robot(String),
    RobotLess { robot: String, margin: f64 },
    Joints(BTreeMap<String, JointProfile>),
}

#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct JointProfile {
    limit: f64,
    offset: f64,
    squared: f64,
    lower: f64,
    upper: f64,
    #[serde(default)]
    margin: f64,
}

/// Limits for Franka Research 3, Franka Control Interface documentation: limit, offset, squared, lower, upper of joints 1 to 7.
const FR3: [[f64; 5]; 7] = [
    [2.62, 0.30, 12.0, -2.7501, 2.7501],
    [2.62, 0.20, 5.17, -1.7918, 1.7918],
    [2.62, 0.20, 7.00, -2.9065, 2.9065],
    [2.62, 0.30, 8.00, -3.0481, -0.1458],
    [5.26, 0.35, 34.0, -2.8101, 2.8101],
    [4.18, 0.35, 11.0, 0.54092, 4.5205],
    [5.26, 0.35, 34.0, -3.0196, 3.0196],
];

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct FrameSection {
    name: Option<String>,
    frame: String,
    #[serde(default)]
    point: Vec3,
    half_space: Option<HalfSpace>,
    #[serde(rename = "box")]
    inside: Option<FrameBox>,
    braking: f64,
    #[serde(default)]
    margin: f64,
    soft: Option<Soft>,
}

/// A plane, by its normal and a point of it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct HalfSpace {
    pub(crate) normal: Vec3,
    pub(crate) through: Vec3,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct FrameBox {
    /// JSON has no infinity: `null` is no face.
    lower: [Option<f64>; 3],
    upper: [Option<f64>; 3],
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct FrameSpeed {
    name: Option<String>,
    frame: String,
    #[serde(default)]
    point: Vec3,
    limit: f64,
    #[serde(default)]
    margin: f64,
    soft: Option<Soft>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Energy {
    limit: f64,
    #[serde(default)]
    margin: f64,
    soft: Option<Soft>,
}

/// `collision`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CollisionSection {
    #[serde(default)]
    pub(crate) shapes: Vec<SolidSection>,
    #[serde(default)]
    pub(crate) urdf: bool,
    #[serde(default)]
    pub(crate) ignore: Vec<[String; 2]>,
    #[serde(default)]
    pub(crate) adjacent: bool,
    pub(crate) braking: f64,
    #[serde(default)]
    pub(crate) margin: f64,
    /// Pairs farther apart have no row.
    #[serde(default = "fifth")]
    pub(crate) influence: f64,
    #[serde(default = "sixteen")]
    pub(crate) rows: usize,
    pub(crate) soft: Option<Soft>,
}

fn fifth() -> f64 {
    0.2
}

fn sixteen() -> usize {
    16
}

/// One solid of `collision`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SolidSection {
    pub(crate) name: Option<String>,
    pub(crate) frame: Option<String>,
    pub(crate) shape: Shape,
    #[serde(default)]
    pub(crate) position: Vec3,
    #[serde(default)]
    pub(crate) rpy: Vec3,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct UserRow {
    name: String,
    terms: BTreeMap<String, f64>,
    lower: Option<f64>,
    upper: Option<f64>,
    equals: Option<f64>,
    braking: Option<f64>,
    #[serde(default)]
    margin: f64,
    soft: Option<Soft>,
}

/// A speed limit in front of a position: `v <= -offset + sqrt(2 deceleration (at - q))`, or 0.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Profile {
    pub(crate) at: f64,
    pub(crate) deceleration: f64,
    pub(crate) offset: f64,
}

/// The limits of one joint; infinite is none.
#[derive(Clone, Debug)]
pub(crate) struct Bounds {
    pub(crate) name: String,
    /// A slide's numbers are in m, a hinge's in rad.
    pub(crate) length: &'static str,
    pub(crate) lower: f64,
    pub(crate) upper: f64,
    pub(crate) velocity: f64,
    pub(crate) acceleration: f64,
    /// What braking counts on.
    pub(crate) braking: f64,
    /// In front of the lowest and the highest position.
    pub(crate) profile: [Option<Profile>; 2],
    pub(crate) is_locked: bool,
    /// Where it is hard [rad/s³ or m/s³].
    pub(crate) jerk: f64,
    /// What a brake counts on of it.
    pub(crate) braking_jerk: f64,
    /// How fast it may speed up, where that was moved [rad/s² or m/s²].
    pub(crate) faster: f64,
    /// What it brakes with where limits were moved: as it was built.
    pub(crate) built_brake: Option<f64>,
}

/// Everything `[constraints]` holds.
#[derive(Clone)]
pub(crate) struct Limits {
    /// By dof (nv).
    pub(crate) joints: Vec<Bounds>,
    /// Rows, then cones, in the order of their numbers in the log, which begin at nv.
    pub(crate) rows: Vec<Row>,
    pub(crate) collision: Option<Rc<Collision>>,
    /// By how much bodies may be nearer than their margin, on the way to where obstacles were put [m]; not a number where that is not known.
    pub(crate) nearer: f64,
}

/// What limits are read for.
pub(crate) struct Of<'a> {
    pub(crate) robot: &'a Robot,
    pub(crate) machine: &'a Machine,
    /// Ascending.
    pub(crate) controllable: &'a [usize],
    /// Stiffness and damping of the joints that are sent the target of their drive, by dof.
    pub(crate) drives: &'a [Option<[f64; 2]>],
    /// Dofs that forces move, ascending.
    pub(crate) free: &'a [usize],
    /// How far commands to the joints may go, by dof.
    pub(crate) ranges: &'a [[f64; 2]],
    /// Physics steps in a period.
    pub(crate) sub_steps: u32,
}

impl Of<'_> {
    fn name(&self, dof: usize) -> &str {
        self.robot.joints().nth(dof).map_or("", |joint| &joint.name)
    }

    fn dof(&self, name: &str) -> Result<usize, String> {
        self.robot
            .joints()
            .position(|j| j.name == name)
            .ok_or_else(|| format!("its limits name joint '{name}', which the robot does not have"))
    }

    fn spot(&self, name: &str) -> Result<crate::motion::Spot, String> {
        self.machine
            .spot(name)
            .ok_or_else(|| format!("its limits name frame '{name}', which the robot does not have"))
    }
}

impl Section {
    /// The numbers that hold for the robot.
    ///
    /// # Errors
    /// A clause that names what cannot be verified.
    pub(crate) fn limits(&self, of: &Of<'_>) -> Result<Limits, String> {
        let mut joints: Vec<Bounds> =
            of.robot.joints().enumerate().map(|(dof, joint)| self.joint(of, dof, joint)).collect();
        if let Some(profiles) = &self.velocity_profile {
            profiles.apply(of, &mut joints)?;
        }
        for name in &self.locked {
            let dof = of.dof(name)?;
            joints[dof].is_locked = of.controllable.contains(&dof);
        }
        let mut rows = Vec::new();
        let mut efforts = Vec::new();
        if let Some(torque) = &self.torque {
            for &dof in of.controllable {
                let joint = of.robot.joints().nth(dof).ok_or("a joint is missing")?;
                // Whichever way a joint rubs, its motor can make up for it.
                let most = torque.scale * of.robot.usable(joint) - joint.friction;
                let effort = less(most, &torque.margin, dof, &joint.name);
                efforts.push((dof, effort));
                rows.push(Row::new(
                    "torque",
                    &joint.name,
                    effort,
                    torque.soft,
                    Rule::Torque { dof, most: effort },
                ));
            }
        }
        self.rates(of, &mut rows);
        for frame in &self.frame {
            frame.rows(of, &mut rows)?;
        }
        let collision =
            self.collision.as_ref().map(|section| Collision::new(section, of)).transpose()?.map(Rc::new);
        if let (Some(pairs), Some(section)) = (&collision, &self.collision) {
            for name in pairs.row_names() {
                rows.push(Row::new("collision", &name, section.braking, section.soft, Rule::Pair));
            }
        }
        for row in &self.rows {
            rows.push(row.row(of, &joints)?);
        }
        let soft = self.torque.as_ref().and_then(|torque| torque.soft);
        let all = Rc::new(Drives::new(of.drives, of.free.to_vec()));
        for &(dof, effort) in &efforts {
            let Some([stiffness, _]) = of.drives[dof] else { continue };
            let effort = if of.sub_steps > 1 { (1.0 - SHORT) * effort } else { effort };
            // A target makes up for any friction as well, where its range is wide enough.
            let rubs = of.robot.joints().nth(dof).map_or(0.0, |joint| joint.friction / stiffness);
            let [low, high] = of.ranges[dof];
            let range = if high - low > 2.0 * rubs { [low + rubs, high - rubs] } else { [low, high] };
            let range = of.machine.single(dof).map(|iq| (iq, range));
            let range = range.filter(|(_, ends)| ends.iter().any(|end| end.is_finite()));
            let parts = [
                Some((false, None, " at the start")),
                (of.sub_steps != 1).then_some((true, None, " at the end")), // with one step the force is the same
                range.is_some().then_some((false, range, BY_ITS_TARGET)),
            ];
            for (at_end, range, at) in parts.into_iter().flatten() {
                let all = all.clone();
                let rule = Rule::Drive { dof, most: effort, at_end, range, all };
                rows.push(Row::new("torque", &format!("{}{at}", of.name(dof)), effort, soft, rule));
            }
        }
        for speed in &self.frame_speed {
            let (spot, limit) = (of.spot(&speed.frame)?, speed.limit - speed.margin);
            let rule = Rule::Speed { spot, point: speed.point, most: limit };
            let label = speed.name.as_ref().unwrap_or(&speed.frame).clone();
            rows.push(Row {
                label: label.clone(),
                ..Row::new("frame_speed", &label, limit, speed.soft, rule)
            });
        }
        if let Some(energy) = &self.energy {
            let most = energy.limit - energy.margin;
            rows.push(Row::new("energy", "robot", (2.0 * most).sqrt(), energy.soft, Rule::Energy { most }));
        }
        Ok(Limits { joints, rows, collision, nearer: 0.0 })
    }

    fn joint(&self, of: &Of<'_>, dof: usize, joint: &crate::robot::Joint) -> Bounds {
        let name = joint.name.as_str();
        let is_slide = joint.kind == crate::robot::JointKind::Slide;
        let none = f64::INFINITY;
        let mut bounds = Bounds {
            name: joint.name.clone(),
            length: if is_slide { "m" } else { "rad" },
            lower: -none,
            upper: none,
            velocity: none,
            acceleration: none,
            braking: none,
            profile: [None; 2],
            is_locked: false,
            jerk: none,
            braking_jerk: none,
            faster: none,
            built_brake: None,
        };
        if !of.controllable.contains(&dof) {
            return bounds;
        }
        if let (Some(position), Range::Limited(lower, upper), Some(_)) =
            (&self.position, joint.range, of.machine.single(dof))
        {
            let margin = (-less(0.0, &position.margin, dof, name)).max(self.gap);
            (bounds.lower, bounds.upper) = (lower + margin, upper - margin);
        }
        if let Some(velocity) = &self.velocity {
            let file = joint.velocity.unwrap_or(none);
            let own = velocity.limit.as_ref().and_then(|limit| limit.of(dof, name));
            let scaled = match (velocity.scale, &velocity.limit) {
                (Some(scale), _) => scale * file,
                (None, None) => file,
                (None, Some(_)) => {
                    if own.is_none() {
                        file
                    } else {
                        none
                    }
                }
            };
            bounds.velocity = less(own.unwrap_or(none).min(scaled), &velocity.margin, dof, name);
        }
        if let Some(acceleration) = &self.acceleration {
            if let Some(limit) = acceleration.limit.of(dof, name) {
                bounds.acceleration = less(limit, &acceleration.margin, dof, name);
            }
            let stated = acceleration.braking.as_ref().and_then(|braking| braking.of(dof, name));
            bounds.braking = stated.unwrap_or(none).min((1.0 - self.reserve) * bounds.acceleration);
        }
        let jerk = self.jerk.as_ref().filter(|jerk| jerk.hard);
        if let Some((jerk, limit)) = jerk.and_then(|jerk| Some((jerk, jerk.limit.of(dof, name)?))) {
            bounds.jerk = less(limit, &jerk.margin, dof, name);
            bounds.braking_jerk = (1.0 - self.reserve) * bounds.jerk;
        }
        bounds
    }

    /// Rows of single joints beside the torque: jerk, torque by speed, torque rate.
    fn rates(&self, of: &Of<'_>, rows: &mut Vec<Row>) {
        let each = |limit: &PerJoint, margin: &Option<PerJoint>| -> Vec<(usize, f64)> {
            let value =
                |dof: &usize| Some((*dof, less(limit.of(*dof, of.name(*dof))?, margin, *dof, of.name(*dof))));
            of.controllable.iter().filter_map(value).collect()
        };
        if let Some(jerk) = self.jerk.as_ref().filter(|jerk| !jerk.hard) {
            let soft = Some(jerk.soft.unwrap_or_default());
            let row = |(dof, most)| Row::new("jerk", of.name(dof), most, soft, Rule::Jerk { dof, most });
            rows.extend(each(&jerk.limit, &jerk.margin).into_iter().map(row));
        }
        for at_start in [false, true] {
            let Some(motor) = &self.torque_speed else { break };
            for &dof in of.controllable {
                let joint = of.name(dof);
                if let (Some(stall), Some(no_load)) =
                    (motor.stall.of(dof, joint), motor.no_load.of(dof, joint))
                {
                    let friction = of.robot.joints().nth(dof).map_or(0.0, |joint| joint.friction);
                    let most = less(stall, &motor.margin, dof, joint) - friction;
                    let named = if at_start { format!("{joint} at the start") } else { joint.to_owned() };
                    let rule = Rule::TorqueSpeed { dof, most, slope: stall / no_load, at_start };
                    rows.push(Row::new("torque_speed", &named, most, motor.soft, rule));
                }
            }
        }
        if let Some(rate) = &self.torque_rate {
            let row = |(dof, most)| {
                Row::new("torque_rate", of.name(dof), most, Some(rate.soft), Rule::TorqueRate { dof, most })
            };
            rows.extend(each(&rate.limit, &rate.margin).into_iter().map(row));
        }
    }
}

impl Profiles {
    fn apply(&self, of: &Of<'_>, joints: &mut [Bounds]) -> Result<(), String> {
        let mut put = |dof: usize, [limit, offset, squared, lower, upper]: [f64; 5], margin: f64| {
            if of.controllable.contains(&dof) {
                let curve = |at| Some(Profile { at, deceleration: 0.5 * squared, offset: offset + margin });
                joints[dof].velocity = joints[dof].velocity.min(limit - margin);
                joints[dof].profile = [curve(lower), curve(upper)];
            }
        };
        let (robot, margin) = match self {
            Profiles::Joints(map) => {
                for (name, j) in map {
                    put(of.dof(name)?, [j.limit, j.offset, j.squared, j.lower, j.upper], j.margin);
                }
                return Ok(());
            }
            Profiles::Robot(robot) => (robot, 0.0),
            Profiles::RobotLess { robot, margin } => (robot, *margin),
        };
        if robot != "fr3" {
            return Err(format!("its velocity_profile is of '{robot}', which is not known here"));
        }
        for (dof, joint) in of.robot.joints().enumerate() {
            let number = joint.name.rsplit_once("joint").and_then(|(_, end)| end.parse::<usize>().ok());
            if let Some(curve) = number.and_then(|k| FR3.get(k.wrapping_sub(1))) {
                put(dof, *curve, margin);
            }
        }
        Ok(())
    }
}

impl FrameSection {
    fn rows(&self, of: &Of<'_>, rows: &mut Vec<Row>) -> Result<(), String> {
        let spot = of.spot(&self.frame)?;
        let label = self.name.as_ref().unwrap_or(&self.frame);
        let mut plane = |name: &str, n: Vec3, offset: f64, is_half_space: bool| {
            let rule = Rule::Plane {
                spot,
                point: self.point,
                n,
                offset: offset - self.margin,
                braking: self.braking,
                half_space: is_half_space.then_some(self.margin),
            };
            let row = Row::new("frame", name, self.braking, self.soft, rule);
            rows.push(Row { label: label.clone(), ..row });
        };
        if let Some(half) = &self.half_space {
            let n = times(1.0 / norm(half.normal), half.normal);
            plane(label, n, dot(n, half.through), true);
        }
        if let Some(inside) = &self.inside {
            for (k, axis) in ["x", "y", "z"].iter().enumerate() {
                for (sign, end, side) in [(1.0, inside.upper[k], "below"), (-1.0, inside.lower[k], "above")] {
                    let mut n = [0.0; 3];
                    n[k] = sign;
                    if let Some(end) = end {
                        plane(&format!("{label} {side} {axis} = {end}"), n, sign * end, false);
                    }
                }
            }
        }
        Ok(())
    }
}

impl UserRow {
    fn row(&self, of: &Of<'_>, joints: &[Bounds]) -> Result<Row, String> {
        let term = |(name, c): (&String, &f64)| -> Result<Term, String> {
            let unknown =
                || format!("its row '{}' names '{name}', which is no state of the robot", self.name);
            let (letter, joint) = name.split_once('.').ok_or_else(unknown)?;
            let dof = of.dof(joint)?;
            match letter {
                "q" => Ok(Term {
                    dof,
                    position: of.machine.single(dof).map(|iq| (iq, *c)),
                    velocity: 0.0,
                    acceleration: 0.0,
                }),
                "v" => Ok(Term { dof, position: None, velocity: *c, acceleration: 0.0 }),
                "a" => Ok(Term { dof, position: None, velocity: 0.0, acceleration: *c }),
                _ => Err(unknown()),
            }
        };
        let terms = self.terms.iter().map(term).collect::<Result<Vec<_>, _>>()?;
        let none = f64::INFINITY;
        let lower = self.equals.or(self.lower.map(|x| x + self.margin)).unwrap_or(-none);
        let upper = self.equals.or(self.upper.map(|x| x - self.margin)).unwrap_or(none);
        let largest =
            [lower, upper].into_iter().filter(|x| x.is_finite()).fold(0.0, |most: f64, x| most.max(x.abs()));
        let steepest = self.terms.values().fold(0.0, |most: f64, c| most.max(c.abs()));
        let is_of = |letter: &str| self.terms.keys().all(|name| name.starts_with(letter));
        let is_equal = self.equals.is_some() && self.soft.is_none();
        let is_value = is_equal && is_of("q.");
        // What each of the joints alone can give.
        let each = self.terms.values().zip(&terms).map(|(c, t)| {
            let joint = &joints[t.dof];
            c.abs() * joint.braking.min(joint.acceleration)
        });
        let least = each.fold(none, f64::min);
        let own = is_value.then_some(if least.is_finite() { least } else { steepest });
        // And what all of them give together.
        let all = self.terms.values().zip(&terms).map(|(c, t)| c.abs() * joints[t.dof].acceleration);
        let most: f64 = all.sum();
        let braking = self.braking.map(|braking| braking.min(most)).or(own);
        let size = match braking {
            Some(braking) => braking,
            None if largest > 0.0 => largest,
            None => steepest,
        };
        let is_moved = terms.iter().all(|t| of.controllable.contains(&t.dof));
        let rests = is_value || (lower == 0.0 && (is_of("v.") || is_of("a.")));
        let equal = is_equal.then_some(Equal {
            is_of_state: terms.iter().all(|t| t.acceleration == 0.0),
            is_kept: is_moved && rests,
        });
        let is_equality = self.equals.is_some();
        let rule = Rule::User { terms, lower, upper, braking, is_equality, equal, steepest };
        Ok(Row::new("user", &self.name, size, self.soft, rule))
    }
}
