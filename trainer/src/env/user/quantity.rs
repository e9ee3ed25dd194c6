//! What a name in an expression stands for.

use crate::mj::{JointKind, Model, Sim};

use super::expression::Expression;

/// Something measured in the simulation or chosen by the policy.
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
    /// `u.<actuator>`: entry of the action, as it was asked for.
    Action(usize),
    /// `u.squared`: sum of the squares of the action.
    Effort,
    /// Time since the episode began \[s\].
    Time,
    /// Control period \[s\].
    Period,
    /// Uniform in \[-1, 1), one draw for each entry of a reset.
    Uniform,
    /// Standard normal, one draw for each entry of a reset.
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

/// The names of a robot.
pub(super) struct Names(Vec<(String, Quantity)>);

impl Names {
    pub(super) fn new(model: &Model, place: Place) -> Names {
        let mut names = Vec::new();
        let mut put = |name: String, quantity: Quantity| names.push((name, quantity));
        if place == Place::Start {
            put("uniform".into(), Quantity::Uniform);
            put("normal".into(), Quantity::Normal);
            return Names(names);
        }
        let outcome = place == Place::Outcome;
        for joint in model.joints() {
            let (positions, velocities) = parts(joint.kind);
            for (k, part) in positions.iter().enumerate() {
                put(format!("q.{}{part}", joint.name), Quantity::Position(joint.idx_q + k));
                if outcome {
                    put(format!("dq.{}{part}", joint.name), Quantity::Change(joint.idx_q + k));
                }
            }
            for (k, part) in velocities.iter().enumerate() {
                put(format!("v.{}{part}", joint.name), Quantity::Velocity(joint.idx_v + k));
            }
        }
        for body in 1..model.n_bodies() {
            for (axis, letter) in ["x", "y", "z"].iter().enumerate() {
                put(format!("{letter}.{}", model.body_name(body)), Quantity::Place(body, axis));
                if outcome {
                    put(format!("v{letter}.{}", model.body_name(body)), Quantity::Speed(body, axis));
                }
            }
        }
        if outcome {
            for (i, actuator) in model.actuators().iter().enumerate() {
                put(format!("u.{}", actuator.name), Quantity::Action(i));
            }
            put("u.squared".into(), Quantity::Effort);
        }
        put("time".into(), Quantity::Time);
        put("dt".into(), Quantity::Period);
        Names(names)
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
            let found = self.0.iter().find(|(n, _)| n == name).map(|(_, q)| *q);
            found.ok_or_else(|| format!("unknown name '{name}'{}", self.near(name)))
        };
        Expression::parse(text, resolve).map_err(|e| format!("\"{text}\": {e}"))
    }

    fn near(&self, name: &str) -> String {
        let scored = self.0.iter().map(|(n, _)| (strsim::jaro_winkler(n, name), n));
        match scored.max_by(|a, b| a.0.total_cmp(&b.0)) {
            Some((score, near)) if score > 0.75 => format!("; did you mean '{near}'?"),
            _ => {
                let all: Vec<_> = self.0.iter().take(12).map(|(n, _)| n.as_str()).collect();
                let more = if self.0.len() > all.len() { ", ..." } else { "" };
                format!("; there are {}{more}", all.join(", "))
            }
        }
    }
}

/// Suffixes of a joint's positions and velocities in MuJoCo's convention.
fn parts(kind: JointKind) -> (&'static [&'static str], &'static [&'static str]) {
    match kind {
        JointKind::Slide | JointKind::Hinge => (&[""], &[""]),
        JointKind::Ball => (&[".qw", ".qx", ".qy", ".qz"], &[".wx", ".wy", ".wz"]),
        JointKind::Free => {
            (&[".x", ".y", ".z", ".qw", ".qx", ".qy", ".qz"], &[".x", ".y", ".z", ".wx", ".wy", ".wz"])
        }
    }
}

/// What the simulation was like when the control period began.
#[derive(Debug, Clone, Default)]
pub(super) struct Before {
    q: Vec<f64>,
    x: Vec<[f64; 3]>,
}

impl Before {
    pub(super) fn new(model: &Model) -> Before {
        Before { q: vec![0.0; model.nq()], x: vec![[0.0; 3]; model.n_bodies()] }
    }

    pub(super) fn remember(&mut self, sim: &Sim) {
        self.q.copy_from_slice(sim.qpos());
        self.x.copy_from_slice(sim.positions());
    }
}

/// Reads quantities after a control period.
pub(super) struct Outcome<'a> {
    pub(super) sim: &'a Sim,
    pub(super) before: &'a Before,
    pub(super) action: &'a [f64],
    pub(super) dt: f64,
}

impl Outcome<'_> {
    pub(super) fn read(&self, quantity: Quantity) -> f64 {
        match quantity {
            Quantity::Change(i) => self.sim.qpos()[i] - self.before.q[i],
            Quantity::Speed(body, axis) => {
                (self.sim.positions()[body][axis] - self.before.x[body][axis]) / self.dt
            }
            Quantity::Action(i) => self.action[i],
            Quantity::Effort => super::super::rules::squared(self.action),
            state => read_state(self.sim, self.dt, state),
        }
    }
}

/// Reads what is known of a state alone; NaN for what is not.
pub(super) fn read_state(sim: &Sim, dt: f64, quantity: Quantity) -> f64 {
    match quantity {
        Quantity::Position(i) => sim.qpos()[i],
        Quantity::Velocity(i) => sim.qvel()[i],
        Quantity::Place(body, axis) => sim.positions()[body][axis],
        Quantity::Time => sim.time(),
        Quantity::Period => dt,
        _ => f64::NAN,
    }
}
