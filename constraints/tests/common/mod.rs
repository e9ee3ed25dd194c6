//! What the tests of the projector share.
#![allow(dead_code, unreachable_pub)]

pub mod arms;
#[path = "../../src/random.rs"]
mod random;
pub mod solids;

use nearl_constraints::*;
pub(crate) use random::Random;
use std::path::Path;

/// A robot of `examples/robots`.
pub fn robot(file: &str) -> Model {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/robots").join(file);
    match file.ends_with("urdf") {
        true => Model::from_urdf(&path).unwrap(),
        false => described(path.file_stem().unwrap().to_str().unwrap()),
    }
}

/// A robot that MuJoCo has read: `fixtures/robots/NAME.json`, written by `nearl robot --json`.
pub fn described(name: &str) -> Model {
    let file = format!("{}/tests/fixtures/robots/{name}.json", env!("CARGO_MANIFEST_DIR"));
    let description = serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap();
    Model::from_description(description).unwrap()
}

/// A row of one's own without bounds: hard, without margin.
pub fn row(name: &str, terms: &[(&str, f64)]) -> limit::UserRowSettings {
    limit::UserRowSettings {
        name: name.into(),
        terms: terms.iter().map(|(n, c)| (n.to_string(), *c)).collect(),
        lower: None,
        upper: None,
        equals: None,
        braking: None,
        margin: 0.0,
        soft: None,
    }
}

/// The robot with a floating base.
pub fn free(file: &str) -> Model {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/robots").join(file);
    Model::from_urdf_free_flyer(&path).unwrap()
}

pub fn panda() -> Model {
    robot("panda/panda.urdf")
}

/// The maker's acceleration limits [rad/s²].
pub const PANDA_ACCELERATION: [f64; 7] = [15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0];

/// Decelerations the motors can give in every state at 60 % of the speed: see `certify.rs` [rad/s²].
pub const PANDA_BRAKING: [f64; 7] = [4.0, 2.0, 4.0, 4.0, 6.0, 6.0, 10.0];

pub fn panda_joints(values: [f64; 7]) -> PerJoint {
    PerJoint::Joints((0..7).map(|k| (format!("panda_joint{}", k + 1), values[k])).collect())
}

/// Position, velocity (60 %) and acceleration limits, torque limits if asked for.
pub fn panda_limits(torque: Option<f64>) -> Vec<Box<dyn Limit>> {
    let (limit, braking) = (panda_joints(PANDA_ACCELERATION), Some(panda_joints(PANDA_BRAKING)));
    let mut limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::scaled(0.6)),
        Box::new(AccelerationLimit::new(limit::AccelerationSettings::of(limit, braking))),
    ];
    if let Some(scale) = torque {
        limits.push(Box::new(TorqueLimit::scaled(scale)));
    }
    limits
}

pub fn panda_projector(torque: Option<f64>, settings: Settings) -> Projector {
    Projector::new(&panda(), &panda_limits(torque), &[0, 1, 2, 3, 4, 5, 6], settings).unwrap()
}

/// A state inside all limits with room to brake.
pub fn inner_state(projector: &Projector, random: &mut Random) -> (Vec<f64>, Vec<f64>) {
    let (l, dt) = (projector.limits(), projector.settings().dt);
    let n = projector.model().nv();
    let q: Vec<f64> = (0..n).map(|i| random.between(l.q_lower[i], l.q_upper[i])).collect();
    let v = (0..n)
        .map(|i| {
            let room = (l.q_upper[i] - q[i]).min(q[i] - l.q_lower[i]);
            let most = (l.braking[i] * room).sqrt().min(l.velocity[i]) - l.acceleration[i] * dt;
            most.max(0.0) * random.between(-1.0, 1.0)
        })
        .collect();
    (q, v)
}

/// A proposal around the state; `size` 1 is about one period of full acceleration.
pub fn proposal(projector: &Projector, q: &[f64], v: &[f64], size: f64, random: &mut Random) -> Proposal {
    let (l, dt) = (projector.limits(), projector.settings().dt);
    let wish: Vec<f64> =
        (0..v.len()).map(|i| size * l.acceleration[i] * dt * random.between(-1.0, 1.0)).collect();
    Proposal {
        q: (0..q.len()).map(|i| q[i] + dt * (v[i] + wish[i] * random.next())).collect(),
        v: (0..v.len()).map(|i| v[i] + wish[i]).collect(),
    }
}

/// A proposal whose position and velocity belong together.
pub fn consistent(projector: &Projector, q: &[f64], v: &[f64], y: &[f64]) -> Proposal {
    let p = Period::new(projector.settings().dt, projector.settings().sub_steps);
    Proposal {
        q: (0..v.len()).map(|i| q[i] + (p.dt * v[i] + p.kappa * p.dt * y[i])).collect(),
        v: (0..v.len()).map(|i| v[i] + y[i]).collect(),
    }
}

/// Bang-bang for a while, joint by joint; at times towards a limit, at times to and fro.
pub struct Attack {
    random: Random,
    side: Vec<f64>,
}

impl Attack {
    pub fn new(seed: u64, nv: usize) -> Attack {
        Attack { random: Random(seed), side: vec![1.0; nv] }
    }

    pub fn propose(&mut self, model: &Model, dt: f64, q: &[f64], out: &mut Proposal) {
        for i in 0..model.nv() {
            if self.random.next() < dt / 0.3 {
                self.side[i] = if self.random.next() < 0.5 { -1.0 } else { 1.0 };
            }
            let speed = 3.0 * self.side[i] * model.velocity_limit()[i];
            (out.q[i], out.v[i]) = (q[i] + dt * speed, speed);
        }
    }
}

/// A period at acceleration `a`: the state after it, the lowest and the highest position of its physics steps or, without them, of all of it.
pub fn advance(q: f64, v: f64, a: f64, p: &Period) -> (f64, f64, f64, f64) {
    let (mut x, mut w, mut low, mut high) = (q, v, f64::INFINITY, f64::NEG_INFINITY);
    if p.sub_steps == 0 {
        let (end, turn) = (q + p.dt * v + 0.5 * p.dt * p.dt * a, -v / a);
        (low, high) = (end, end);
        if turn > 0.0 && turn < p.dt {
            let extreme = q + v * turn + 0.5 * a * turn * turn;
            (low, high) = (low.min(extreme), high.max(extreme));
        }
        return (end, v + p.dt * a, low, high);
    }
    for _ in 0..p.sub_steps {
        w += p.tau * a;
        x += p.tau * w;
        (low, high) = (low.min(x), high.max(x));
    }
    (x, w, low, high)
}
