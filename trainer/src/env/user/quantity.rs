//! What a name in an expression stands for.

use crate::mj::{Actuator, Joint, JointKind, Model, Sim};
use nearl_runtime::constraints::parts_of;

use super::course::Course;
use super::expression::Expression;
use super::lexer::quoted;

/// Something measured in the simulation, drawn for the episode or chosen by the policy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Quantity {
    /// `q.<joint>`: entry of `qpos` \[rad or m\].
    Position(usize),
    /// `v.<joint>`: entry of `qvel` \[rad/s or m/s\].
    Velocity(usize),
    /// `dq.<joint>`: change of an entry of `qpos` over the control period.
    Change(usize),
    /// `x.<body>`, `y.`, `z.`: world position of a body's frame \[m\].
    Place(usize, usize),
    /// `vx.<body>`, `vy.`, `vz.`: change of it over the control period, per second \[m/s\].
    Speed(usize, usize),
    /// `com.x`, `com.y`, `com.z`: centre of mass of all bodies \[m\].
    Centre(usize),
    /// `com.vx`, `com.vy`, `com.vz`: change of it over the control period, per second \[m/s\].
    CentreSpeed(usize),
    /// `cfrc.<body>.tx`, `.ty`, `.tz`, `.fx`, `.fy`, `.fz`: MuJoCo's external torque \[N·m\] and force \[N\] on a body in the last physics step.
    External(usize, usize),
    /// `ground.<body>`: height of the ground where the body is \[m\].
    Ground(usize),
    /// `base.vx`, `base.vy`, `base.vz`: velocity of the free base in its own axes \[m/s\].
    BaseLinear(usize),
    /// `base.wx`, `base.wy`, `base.wz`: its angular velocity there \[rad/s\].
    BaseAngular(usize),
    /// `gravity.x`, `gravity.y`, `gravity.z`: unit vector of gravity in the base's axes.
    Gravity(usize),
    /// `load.<body>`: sum of the normal forces of a body's contacts \[N\].
    Load(usize),
    /// `contact.<body>`: 1 where that is not 0.
    Contact(usize),
    /// `air.<body>`: time since the body's last contact \[s\].
    Air(usize),
    /// `landed.<body>`: in the control period of its first contact the time that it was in the air before \[s\], else 0.
    Landed(usize),
    /// `u.<actuator>`: entry of the action, as it was asked for.
    Action(usize),
    /// `u.squared`: sum of the squares of the action.
    Effort,
    /// `du.squared`: sum of the squares of the action's change since the control period before.
    ActionChange,
    /// `torque.<actuator>`: force on its joint in the last physics step \[N·m or N\]; index of the degree of freedom.
    Torque(usize),
    /// `torque.squared`: sum of the squares over the driven joints.
    TorqueSquared,
    /// `power`: sum of the magnitudes of force times velocity over the driven joints \[W\].
    Power,
    /// `dv.squared`: sum of the squares of the driven joints' mean accelerations over the control period \[rad²/s⁴ or m²/s⁴\].
    Acceleration,
    /// `dv.max`: largest magnitude of a driven joint's mean acceleration over the control period \[rad/s² or m/s²\].
    AccelerationMax,
    /// `command.<name>`: what the robot is asked to do.
    Command(usize),
    /// `torque.max`: largest magnitude of a force of an actuator \[N·m or N\].
    TorqueMax,
    /// `dtorque.max`: largest magnitude of its change since the control period before, per second \[N·m/s or N/s\].
    TorqueRateMax,
    /// `random.<what>`: mean of what was drawn for the robot of this episode.
    Drawn(usize),
    /// `level`: how far the curriculum has come, 0 to 1.
    Level,
    /// Time since the episode began \[s\].
    Time,
    /// Control period \[s\].
    Period,
    /// Uniform in \[-1, 1), one draw for each entry.
    Uniform,
    /// Standard normal, one draw for each entry.
    Normal,
}

/// Where a name may be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Place {
    /// In a reward, cost or termination: everything but random draws.
    Outcome,
    /// In an observation: no action, nothing over the period, no draws.
    Observation,
    /// At the start of an episode: draws alone.
    Start,
}

/// What an environment has beside MuJoCo's model.
#[derive(Clone, Copy, Default)]
pub(super) struct Own<'a> {
    /// Entries of the action.
    pub(super) actuators: &'a [Actuator],
    /// Names of the commands.
    pub(super) commands: &'a [String],
    /// Columns of what is drawn for the robot.
    pub(super) drawn: &'a [String],
    /// Contacts and forces are followed from step to step.
    pub(super) follows: bool,
}

/// The names of a robot.
pub(super) struct Names(Vec<(String, Quantity)>);

const AXES: [&str; 3] = ["x", "y", "z"];
/// Entries of an external force, in MuJoCo's order.
const WRENCH: [&str; 6] = ["tx", "ty", "tz", "fx", "fy", "fz"];

impl Names {
    pub(super) fn new(model: &Model, own: Own<'_>, place: Place) -> Names {
        let mut names = Names(Vec::new());
        if place == Place::Start {
            names.put("uniform", Quantity::Uniform);
            names.put("normal", Quantity::Normal);
            names.put("level", Quantity::Level);
            return names;
        }
        let outcome = place == Place::Outcome;
        names.put_joints(&model.joints(), own.follows, outcome);
        names.put_bodies(model, own.follows, outcome);
        if outcome {
            names.put_actions(own);
        }
        for (i, name) in own.commands.iter().enumerate() {
            names.put(format!("command.{name}"), Quantity::Command(i));
        }
        if own.follows {
            names.put("level", Quantity::Level);
            for (i, column) in own.drawn.iter().enumerate() {
                names.put(column.replacen('/', ".", 1), Quantity::Drawn(i));
            }
        }
        names.put("time", Quantity::Time);
        names.put("dt", Quantity::Period);
        names
    }

    fn put(&mut self, name: impl Into<String>, quantity: Quantity) {
        self.0.push((name.into(), quantity));
    }

    fn put_joints(&mut self, joints: &[Joint], follows: bool, outcome: bool) {
        for joint in joints {
            let (positions, velocities) = parts_of(joint.nq, joint.nv);
            for (k, part) in positions.iter().enumerate() {
                self.put(format!("q.{}{part}", joint.name), Quantity::Position(joint.idx_q + k));
                if outcome {
                    self.put(format!("dq.{}{part}", joint.name), Quantity::Change(joint.idx_q + k));
                }
            }
            for (k, part) in velocities.iter().enumerate() {
                self.put(format!("v.{}{part}", joint.name), Quantity::Velocity(joint.idx_v + k));
            }
        }
        if follows && base(joints).is_some() {
            for (axis, letter) in AXES.iter().enumerate() {
                self.put(format!("base.v{letter}"), Quantity::BaseLinear(axis));
                self.put(format!("base.w{letter}"), Quantity::BaseAngular(axis));
                self.put(format!("gravity.{letter}"), Quantity::Gravity(axis));
            }
        }
    }

    fn put_bodies(&mut self, model: &Model, follows: bool, outcome: bool) {
        for (axis, letter) in AXES.iter().enumerate() {
            self.put(format!("com.{letter}"), Quantity::Centre(axis));
            if outcome {
                self.put(format!("com.v{letter}"), Quantity::CentreSpeed(axis));
            }
        }
        for body in 1..model.n_bodies() {
            let name = model.body_name(body);
            for (axis, letter) in AXES.iter().enumerate() {
                self.put(format!("{letter}.{name}"), Quantity::Place(body, axis));
                if outcome {
                    self.put(format!("v{letter}.{name}"), Quantity::Speed(body, axis));
                }
            }
            if follows && outcome {
                for (k, entry) in WRENCH.iter().enumerate() {
                    self.put(format!("cfrc.{name}.{entry}"), Quantity::External(body, k));
                }
            }
            if follows {
                self.put(format!("load.{name}"), Quantity::Load(body));
                self.put(format!("contact.{name}"), Quantity::Contact(body));
                self.put(format!("air.{name}"), Quantity::Air(body));
                self.put(format!("landed.{name}"), Quantity::Landed(body));
                self.put(format!("ground.{name}"), Quantity::Ground(body));
            }
        }
    }

    fn put_actions(&mut self, own: Own<'_>) {
        for (i, actuator) in own.actuators.iter().enumerate() {
            self.put(format!("u.{}", actuator.name), Quantity::Action(i));
            if own.follows {
                self.put(format!("torque.{}", actuator.name), Quantity::Torque(actuator.dof));
            }
        }
        self.put("u.squared", Quantity::Effort);
        if own.follows {
            self.put("du.squared", Quantity::ActionChange);
            self.put("torque.squared", Quantity::TorqueSquared);
            self.put("torque.max", Quantity::TorqueMax);
            self.put("dtorque.max", Quantity::TorqueRateMax);
            self.put("dv.squared", Quantity::Acceleration);
            self.put("dv.max", Quantity::AccelerationMax);
            self.put("power", Quantity::Power);
        }
    }

    /// Names of all positions, then of all velocities.
    pub(super) fn states(&self) -> Vec<String> {
        let those =
            |is: fn(Quantity) -> bool| self.0.iter().filter(move |(_, q)| is(*q)).map(|(n, _)| n.clone());
        let positions = those(|q| matches!(q, Quantity::Position(_)));
        positions.chain(those(|q| matches!(q, Quantity::Velocity(_)))).collect()
    }

    /// Compiles an expression over these names.
    ///
    /// # Errors
    /// A sentence; an unknown name comes with the most similar one.
    pub(super) fn compile(&self, text: &str) -> Result<Expression<Quantity>, String> {
        let resolve = |name: &str| {
            let mut found = self.0.iter().filter(|(n, _)| n == name).map(|(_, q)| *q);
            let Some(first) = found.next() else {
                return Err(format!("unknown name '{}'{}", quoted(name), self.near(quoted(name).as_str())));
            };
            if found.any(|other| other != first) {
                return Err(format!(
                    "'{}' stands for two things; give the joint, body or actuator that makes it so another name in the robot file",
                    quoted(name)
                ));
            }
            Ok(first)
        };
        Expression::parse(text, resolve).map_err(|e| format!("\"{}\": {e}", quoted(text)))
    }

    fn near(&self, name: &str) -> String {
        let scored = self.0.iter().map(|(n, _)| (strsim::jaro(n, name), n));
        let is_given = self.0.iter().any(|(n, _)| n.starts_with("command."));
        if name.starts_with("command.") && self.0.iter().any(|(_, quantity)| *quantity == Quantity::Uniform) {
            return ", as a draw reads no command; its names are uniform, normal and level".into();
        }
        if let Some(command) = name.strip_prefix("command.").filter(|_| !is_given) {
            return format!(
                ", as the task has no section [commands]; write one with a value or a draw for each: {command} = 0.0"
            );
        }
        match scored.max_by(|a, b| a.0.total_cmp(&b.0)) {
            Some((score, near)) if score > 0.75 => format!("; did you mean '{near}'?"),
            _ => {
                // Those that begin alike, where there are any.
                let begins = name.split_once('.').map(|(begin, _)| format!("{begin}."));
                let like = |n: &str| begins.as_ref().is_some_and(|begin| n.starts_with(begin));
                let is_one = self.0.iter().any(|(n, _)| like(n));
                let all = || self.0.iter().map(|(n, _)| n.as_str()).filter(|n| !is_one || like(n));
                let more = if all().count() > 12 { ", ..." } else { "" };
                format!("; there are {}{more}", all().take(12).collect::<Vec<_>>().join(", "))
            }
        }
    }
}

/// The joint by which the robot's base floats, if it does.
pub(super) fn base(joints: &[Joint]) -> Option<&Joint> {
    joints.iter().find(|joint| joint.kind == JointKind::Free)
}

/// What the simulation was like when the control period began.
#[derive(Debug, Clone, Default)]
pub(super) struct Before {
    q: Vec<f64>,
    v: Vec<f64>,
    x: Vec<[f64; 3]>,
    centre: [f64; 3],
}

impl Before {
    pub(super) fn new(model: &Model) -> Before {
        let (q, v) = (vec![0.0; model.nq()], vec![0.0; model.nv()]);
        Before { q, v, x: vec![[0.0; 3]; model.n_bodies()], centre: [0.0; 3] }
    }

    pub(super) fn remember(&mut self, sim: &Sim) {
        self.q.copy_from_slice(sim.qpos());
        self.v.copy_from_slice(sim.qvel());
        self.x.copy_from_slice(sim.positions());
        self.centre = sim.centre();
    }
}

/// Reads quantities after a control period.
pub(super) struct Outcome<'a> {
    pub(super) sim: &'a Sim,
    /// Velocity (nv) that the period ended with.
    pub(super) v: &'a [f64],
    pub(super) before: &'a Before,
    pub(super) action: &'a [f64],
    pub(super) dt: f64,
    /// What is followed from step to step; a cost beside another environment's reward has none.
    pub(super) course: Option<&'a Course>,
}

impl Outcome<'_> {
    pub(super) fn read(&self, quantity: Quantity) -> f64 {
        let (sim, before) = (self.sim, self.before);
        match quantity {
            Quantity::Change(i) => sim.qpos()[i] - before.q[i],
            Quantity::Speed(body, axis) => (sim.positions()[body][axis] - before.x[body][axis]) / self.dt,
            Quantity::CentreSpeed(axis) => (sim.centre()[axis] - before.centre[axis]) / self.dt,
            Quantity::External(body, k) => sim.contact_forces()[body][k],
            Quantity::Action(i) => self.action[i],
            Quantity::Effort => super::super::rules::squared(self.action),
            Quantity::ActionChange => self.course.map_or(0.0, |course| course.action_change),
            Quantity::Torque(dof) => sim.applied_force_of(dof),
            Quantity::TorqueSquared => self.over_drives(|dof| sim.applied_force_of(dof).powi(2)).sum(),
            Quantity::TorqueMax => self.course.map_or(0.0, |course| course.forces.largest),
            Quantity::TorqueRateMax => self.course.map_or(0.0, |course| course.forces.fastest / self.dt),
            Quantity::Power => self.over_drives(|dof| (sim.applied_force_of(dof) * self.v[dof]).abs()).sum(),
            Quantity::Acceleration => self.over_drives(|dof| self.acceleration(dof).powi(2)).sum(),
            Quantity::AccelerationMax => {
                self.over_drives(|dof| self.acceleration(dof).abs()).fold(0.0, f64::max)
            }
            state => Seen { sim, q: sim.qpos(), v: self.v, dt: self.dt, course: self.course }.read(state),
        }
    }

    fn over_drives(&self, of: impl Fn(usize) -> f64) -> impl Iterator<Item = f64> {
        self.course.into_iter().flat_map(|course| &course.driven).map(move |&dof| of(dof))
    }

    /// Mean acceleration of a degree of freedom over the control period.
    fn acceleration(&self, dof: usize) -> f64 {
        (self.v[dof] - self.before.v[dof]) / self.dt
    }
}

/// Reads what is known of a state alone; NaN for what is not.
pub(super) struct Seen<'a> {
    pub(super) sim: &'a Sim,
    /// Configuration (nq) and velocity (nv) in MuJoCo's convention, as they are or as they are measured.
    pub(super) q: &'a [f64],
    pub(super) v: &'a [f64],
    pub(super) dt: f64,
    pub(super) course: Option<&'a Course>,
}

impl Seen<'_> {
    pub(super) fn read(&self, quantity: Quantity) -> f64 {
        let Some(course) = self.course else { return self.read_state(quantity) };
        match quantity {
            Quantity::Load(body) => course.contacts.load[body],
            Quantity::Contact(body) => f64::from(u8::from(course.contacts.load[body] > 0.0)),
            Quantity::Air(body) => course.contacts.air[body],
            Quantity::Landed(body) => course.contacts.landed[body],
            Quantity::Command(i) => course.commands.values()[i],
            Quantity::Level => course.level,
            Quantity::Drawn(i) => course.random.as_ref().map_or(f64::NAN, |random| random.notes()[i]),
            Quantity::BaseLinear(axis) => {
                course.to_base(self.q, [0, 1, 2].map(|i| self.v[course.base.1 + i]))[axis]
            }
            Quantity::BaseAngular(axis) => self.v[course.base.1 + 3 + axis],
            Quantity::Gravity(axis) => course.to_base(self.q, course.down)[axis],
            state => self.read_state(state),
        }
    }

    fn read_state(&self, quantity: Quantity) -> f64 {
        match quantity {
            Quantity::Position(i) => self.q[i],
            Quantity::Velocity(i) => self.v[i],
            Quantity::Place(body, axis) => self.sim.positions()[body][axis],
            Quantity::Centre(axis) => self.sim.centre()[axis],
            Quantity::Ground(body) => {
                let [x, y, _] = self.sim.positions()[body];
                self.sim.ground(x, y)
            }
            Quantity::Time => self.sim.time(),
            Quantity::Period => self.dt,
            _ => f64::NAN,
        }
    }
}
