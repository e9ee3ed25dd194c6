//! A robot with every kind of limit that a stored brake is verified for, with numbers taken from the robot itself.

use super::meter::{Ball, Curve, Meter};
use nearl_constraints::geometry::Shape;
use nearl_constraints::limit::{CollisionSettings, JointProfile, SolidSettings, VelocityProfileSettings};
use nearl_constraints::*;
use std::collections::BTreeMap;

/// Kinds of limits, each attacked alone and together; the joints' own limits hold in every scene. Hard jerk is not kept together with speed
/// profiles, so `all` is without it and `jerk+all` without those.
pub const KINDS: [&str; 14] = [
    "joints",
    "torque",
    "torque_speed",
    "velocity_profile",
    "locked",
    "frame",
    "frame_speed",
    "energy",
    "collision",
    "rows",
    "mixed_rows",
    "all",
    "jerk",
    "jerk+all",
];

/// What is worth something and no promise, attacked by the command alone.
pub const SOFT: [&str; 2] = ["soft_jerk", "torque_rate"];

/// Largest acceleration of every joint [rad/s² or m/s²].
pub const ACCELERATION: f64 = 10.0;

/// Largest jerk of every joint where that is limited [rad/s³ or m/s³].
pub const JERK: f64 = 300.0;

/// Limits, what measures them, and where a run starts.
pub struct Scene {
    pub limits: Vec<Box<dyn Limit>>,
    pub meters: Vec<Meter>,
    pub start: Vec<f64>,
}

/// What the numbers of a scene are made from.
struct Robot<'a> {
    model: &'a Model,
    frame: &'a str,
    start: Vec<f64>,
    tool: [f64; 3],
    /// Share of the motors that is enough to stand still nearly everywhere.
    share: f64,
}

impl Scene {
    /// The limits of `kind`, one of [`KINDS`] or several with `+` between them, on a fixed-base `model` whose joints have one dof each; `frame` is its tool.
    pub fn new(model: &Model, frame: &str, kind: &str) -> Scene {
        let robot = Robot::new(model, frame);
        let mut scene = Scene { limits: Vec::new(), meters: Vec::new(), start: robot.start.clone() };
        robot.joints(&mut scene);
        let asked = |name: &str| kind.split('+').any(|part| part == name);
        let apart = if asked("jerk") { "velocity_profile" } else { "jerk" };
        let all = |name: &str| asked("all") && name != apart && !SOFT.contains(&name);
        for name in KINDS.iter().chain(&SOFT).filter(|name| asked(name) || all(name)) {
            robot.add(name, &mut scene);
        }
        scene
    }
}

impl<'a> Robot<'a> {
    fn new(model: &'a Model, frame: &'a str) -> Robot<'a> {
        let (low, high) = (model.lower_position_limit(), model.upper_position_limit());
        let start: Vec<f64> = (0..model.nv()).map(|i| 0.5 * (low[i] + high[i])).collect();
        let zero = vec![0.0; model.nv()];
        let mut kinematics = Kinematics::new(model);
        kinematics.update(&start, &zero, &zero);
        let tool = kinematics.point(model.frame(frame).unwrap(), [0.0; 3]).position;
        let (mut dynamics, mut tau, mut most) = (Dynamics::new(model), zero.clone(), 0.0f64);
        for k in 0..400 {
            let mix =
                |i: usize| (0.5 + 0.5 * f64::sin(f64::from(k) * (i as f64 + 1.0) * 0.7)).clamp(0.0, 1.0);
            let q: Vec<f64> = (0..model.nv()).map(|i| low[i] + mix(i) * (high[i] - low[i])).collect();
            dynamics.rnea(&q, &zero, &zero, &mut tau);
            most = (0..model.nv()).fold(most, |most, i| most.max(tau[i].abs() / model.effort_limit()[i]));
        }
        Robot { model, frame, start, tool, share: (1.5 * most).clamp(0.05, 1.0) }
    }

    fn joints(&self, scene: &mut Scene) {
        scene.limits.push(Box::new(PositionLimit::default()));
        scene.limits.push(Box::new(VelocityLimit::default()));
        scene.limits.push(Box::new(AccelerationLimit::uniform(ACCELERATION)));
        scene.meters.push(Meter::Joints { acceleration: ACCELERATION });
    }

    /// Adds a limit of the kind with its meter; nothing for the joints' own, which are there.
    fn add(&self, kind: &str, scene: &mut Scene) {
        let (limits, meters) = (&mut scene.limits, &mut scene.meters);
        let frame = self.model.frame(self.frame).unwrap();
        match kind {
            "torque" => {
                limits.push(Box::new(TorqueLimit::scaled(self.share)));
                meters.push(Meter::Torque { share: self.share });
            }
            "torque_speed" => self.motors(scene),
            "velocity_profile" => self.profile(scene),
            "locked" => {
                let joint = self.middle();
                limits.push(Box::new(LockedJoints::of(vec![self.model.dof_name(joint)])));
                meters.push(Meter::Locked { joint, at: self.start[joint] });
            }
            "frame" => {
                let lower = self.tool.map(|x| x - 0.15);
                let upper = self.tool.map(|x| x + 0.15);
                limits.push(Box::new(FrameLimit::inside(self.frame, lower, upper, 2.0)));
                meters.push(Meter::Frame { frame, lower, upper });
            }
            "frame_speed" => {
                limits.push(Box::new(FrameSpeedLimit::of(self.frame, 0.25)));
                meters.push(Meter::FrameSpeed { frame, limit: 0.25 });
            }
            "energy" => {
                let v: Vec<f64> = self.model.velocity_limit().iter().map(|v| 0.2 * v).collect();
                let limit = Kinematics::new(self.model).kinetic_energy(&self.start, &v);
                limits.push(Box::new(EnergyLimit::of(limit)));
                meters.push(Meter::Energy { limit });
            }
            "collision" => self.bodies(scene),
            "rows" => self.rows(scene),
            "mixed_rows" => self.mixed_rows(scene),
            "jerk" => {
                limits.push(Box::new(JerkLimit::hard(JERK)));
                meters.push(Meter::Jerk { limit: JERK, soft: false });
            }
            "soft_jerk" => {
                let (limit, soft) = (PerJoint::All(JERK), Some(Soft::default()));
                limits.push(Box::new(JerkLimit::new(limit::JerkSettings { limit, margin: None, soft })));
                meters.push(Meter::Jerk { limit: JERK, soft: true });
            }
            "torque_rate" => self.torque_rate(scene),
            _ => {}
        }
    }

    /// The joint in the middle of the arm.
    fn middle(&self) -> usize {
        self.model.nv() / 2
    }

    /// A value for each joint by its name.
    fn each<T>(&self, of: impl Fn(usize) -> T) -> Vec<(String, T)> {
        (0..self.model.nv()).map(|i| (self.model.dof_name(i), of(i))).collect()
    }

    /// From nothing to the robot file's torque in 50 ms.
    fn torque_rate(&self, scene: &mut Scene) {
        let most = |i: usize| 20.0 * self.model.effort_limit()[i];
        scene.limits.push(Box::new(TorqueRateLimit::new(limit::TorqueRateSettings {
            limit: PerJoint::Joints(self.each(most).into_iter().collect()),
            margin: None,
            soft: Soft::default(),
        })));
        scene.meters.push(Meter::TorqueRate { limits: (0..self.model.nv()).map(most).collect() });
    }

    fn motors(&self, scene: &mut Scene) {
        let stall = |i: usize| 1.2 * self.share * self.model.effort_limit()[i];
        let no_load = |i: usize| 1.5 * self.model.velocity_limit()[i];
        scene.limits.push(Box::new(TorqueSpeedLimit::new(limit::TorqueSpeedSettings {
            stall: PerJoint::Joints(self.each(stall).into_iter().collect()),
            no_load: PerJoint::Joints(self.each(no_load).into_iter().collect()),
            margin: None,
            soft: None,
        })));
        let line = (0..self.model.nv()).map(|i| (stall(i), no_load(i))).collect();
        scene.meters.push(Meter::TorqueSpeed { line });
    }

    fn profile(&self, scene: &mut Scene) {
        let (low, high) = (self.model.lower_position_limit(), self.model.upper_position_limit());
        let curve = |i: usize| Curve {
            limit: self.model.velocity_limit()[i],
            offset: 0.05,
            squared: ACCELERATION,
            lower: low[i],
            upper: high[i],
        };
        let profile = |c: Curve| JointProfile {
            limit: c.limit,
            offset: c.offset,
            squared: c.squared,
            lower: c.lower,
            upper: c.upper,
            margin: 0.0,
        };
        let joints: BTreeMap<_, _> = self.each(|i| profile(curve(i))).into_iter().collect();
        scene.limits.push(Box::new(VelocityProfileLimit::new(VelocityProfileSettings::Joints(joints))));
        scene.meters.push(Meter::Profile { curves: (0..self.model.nv()).map(curve).collect() });
    }

    /// A ball at the tool and one at the elbow, beside a ball that stands still and above a floor.
    fn bodies(&self, scene: &mut Scene) {
        let elbow = &self.model.joints()[self.middle()].name;
        let ball = |name: Option<&str>, frame: Option<&str>, radius: f64, position: [f64; 3]| SolidSettings {
            name: name.map(str::to_string),
            frame: frame.map(str::to_string),
            shape: Shape::Sphere { radius },
            position,
            rpy: [0.0; 3],
        };
        let [x, y, z] = self.tool;
        let (post, floor) = ([x, y + 0.2, z + 0.02], z - 0.25);
        let mut shapes = vec![
            ball(Some("tool"), Some(self.frame), 0.05, [0.0; 3]),
            ball(Some("elbow"), Some(elbow), 0.05, [0.0; 3]),
            ball(Some("post"), None, 0.08, post),
        ];
        shapes.push(SolidSettings {
            shape: Shape::HalfSpace,
            ..ball(Some("floor"), None, 1.0, [0.0, 0.0, floor])
        });
        let settings = CollisionSettings {
            shapes,
            urdf: false,
            ignore: vec![["tool".into(), "elbow".into()], ["elbow".into(), "floor".into()]],
            adjacent: false,
            braking: 2.0,
            margin: 0.0,
            influence: 0.2,
            rows: 8,
            soft: None,
        };
        scene.limits.push(Box::new(CollisionLimit::new(settings)));
        let of = |frame: &str| Ball { frame: self.model.frame(frame).unwrap(), radius: 0.05 };
        let (tool, elbow) = (of(self.frame), of(elbow));
        scene.meters.push(Meter::Collision { tool, elbow, post, radius: 0.08, floor });
    }

    /// The speed of one joint and the acceleration of another.
    fn mixed_rows(&self, scene: &mut Scene) {
        let joints @ [a, _] = [self.middle() - 1, self.middle()];
        let most = 0.4 * self.model.velocity_limit()[a];
        let share = most / ACCELERATION;
        scene.limits.push(self.row("mixed", joints, [("v", 1.0), ("a", share)], (-most, most), None));
        scene.meters.push(Meter::MixedRow { joints, share, most });
    }

    /// A sum of positions that stops in front of its bounds, and a sum of velocities.
    fn rows(&self, scene: &mut Scene) {
        let joints @ [a, b] = [self.middle() - 1, self.middle()];
        let at = self.start[a] + 0.7 * self.start[b];
        let (lower, upper) = (at - 0.4, at + 0.4);
        let most = 0.6 * self.model.velocity_limit()[a];
        scene.limits.push(self.row("positions", joints, [("q", 1.0), ("q", 0.7)], (lower, upper), Some(2.0)));
        scene.limits.push(self.row("speeds", joints, [("v", 1.0), ("v", 1.0)], (-most, most), None));
        scene.meters.push(Meter::Rows { joints, lower, upper, most });
    }

    /// A sum over two joints: of each what it is a term of, and its coefficient.
    fn row(
        &self,
        name: &str,
        joints: [usize; 2],
        terms: [(&str, f64); 2],
        (lower, upper): (f64, f64),
        braking: Option<f64>,
    ) -> Box<dyn Limit> {
        let of = joints.iter().zip(terms);
        let terms = of.map(|(i, (letter, c))| (format!("{letter}.{}", self.model.dof_name(*i)), c)).collect();
        Box::new(limit::UserRow::new(limit::UserRowSettings {
            name: name.to_string(),
            terms,
            lower: Some(lower),
            upper: Some(upper),
            equals: None,
            braking,
            margin: 0.0,
            soft: None,
        }))
    }
}
