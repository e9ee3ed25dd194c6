//! A robot with its limits, built twice: as the projector's model and as MuJoCo's plant.

use crate::random::Random;
use nearl_runtime::constraints::limit::AccelerationSettings;
use nearl_runtime::constraints::*;
use nearl_trainer::mj;
use std::error::Error;
use std::path::Path;

/// Control period and physics step [s].
pub(crate) const DT: f64 = 1e-3;

/// A robot of `examples/robots`, bolted down, with the shares of its limits it may use.
pub(crate) struct Robot {
    pub(crate) name: &'static str,
    /// Share of the file's speed limits.
    speed: f64,
    /// Acceleration limits, joint by joint; a single one holds for all [rad/s²].
    acceleration: &'static [f64],
}

pub(crate) const ROBOTS: [Robot; 5] = [
    Robot { name: "panda", speed: 0.6, acceleration: &[45.0, 22.5, 30.0, 37.5, 45.0, 60.0, 60.0] },
    Robot { name: "ur5", speed: 0.6, acceleration: &[60.0] },
    Robot { name: "xarm7", speed: 0.5, acceleration: &[30.0] },
    Robot { name: "anymal", speed: 0.8, acceleration: &[300.0] },
    Robot { name: "g1", speed: 0.15, acceleration: &[60.0] },
];

/// What a robot is attacked with.
pub(crate) struct Victim {
    pub(crate) name: &'static str,
    pub(crate) model: Model,
    pub(crate) limits: Vec<Box<dyn Limit>>,
    pub(crate) set: LimitSet,
    /// Deceleration that is within the motors' reach everywhere, as a share of the acceleration limits; `None`: none is.
    pub(crate) certified: Option<f64>,
    plant: mj::Model,
    /// For each dof of the model, MuJoCo's.
    order: Vec<usize>,
}

impl Victim {
    /// The robot; braking counts on what is certified or, where nothing is, on a fifth of the acceleration limits.
    pub(crate) fn new(robot: &Robot, folder: &Path) -> Result<Victim, Box<dyn Error>> {
        let text = std::fs::read_to_string(folder.join(robot.name).join(format!("{}.urdf", robot.name)))?;
        let model = Model::from_urdf_text(&text)?;
        let certified = certified_share(&model, robot)?;
        let limits = limits(&model, robot, certified.unwrap_or(0.2));
        let set = LimitSet::collect(&model, &limits, &every(&model))?;
        let options = mj::Options { sim_dt: Some(DT), without_contacts: true, ..mj::Options::default() };
        let plant = mj::Model::from_text(&without_stops(&text), mj::ModelFormat::Urdf, options)?;
        let joints = plant.joints();
        let find =
            |j: &Joint| joints.iter().find(|m| m.name == j.name).map(|m| m.idx_v).ok_or(j.name.clone());
        let order = model.joints().iter().map(find).collect::<Result<Vec<_>, _>>()?;
        Ok(Victim { name: robot.name, model, limits, set, certified, plant, order })
    }

    pub(crate) fn projector(&self, braking: Braking) -> Result<Projector, LimitError> {
        let settings = Settings { braking, ..Settings::new(DT, 1) };
        Projector::new(&self.model, &self.limits, &every(&self.model), settings)
    }

    pub(crate) fn plant(&self) -> Result<Plant<'_>, mj::MjError> {
        Ok(Plant { sim: mj::Sim::new(&self.plant)?, order: &self.order })
    }

    /// A random configuration to start from at rest, in which the motors hold the robot.
    pub(crate) fn start(&self, random: &mut Random) -> Vec<f64> {
        let (n, mut dynamics) = (self.model.nv(), Dynamics::new(&self.model));
        let (zero, mut nle) = (vec![0.0; n], vec![0.0; n]);
        loop {
            let (low, high) = (&self.set.q_lower, &self.set.q_upper);
            let q: Vec<f64> =
                (0..n).map(|i| low[i] + (high[i] - low[i]) * random.between(0.02, 0.98)).collect();
            dynamics.nle(&q, &zero, &mut nle);
            if nle.iter().zip(&self.set.effort).all(|(nle, effort)| nle.abs() < 0.8 * effort) {
                return q;
            }
        }
    }
}

/// MuJoCo in the model's order of joints.
pub(crate) struct Plant<'a> {
    sim: mj::Sim,
    order: &'a [usize],
}

impl Plant<'_> {
    pub(crate) fn set(&mut self, q: &[f64], v: &[f64]) -> Result<(), mj::MjError> {
        let (mut qpos, mut qvel) = (vec![0.0; q.len()], vec![0.0; v.len()]);
        for (i, m) in self.order.iter().enumerate() {
            (qpos[*m], qvel[*m]) = (q[i], v[i]);
        }
        self.sim.set_state(&qpos, &qvel)
    }

    /// One period with the motor forces `tau`.
    pub(crate) fn step(&mut self, tau: &[f64]) -> Result<(), mj::MjError> {
        for (i, m) in self.order.iter().enumerate() {
            self.sim.force_mut()[*m] = tau[i];
        }
        self.sim.step(1)
    }

    pub(crate) fn read(&self, q: &mut [f64], v: &mut [f64]) {
        for (i, m) in self.order.iter().enumerate() {
            (q[i], v[i]) = (self.sim.qpos()[*m], self.sim.qvel()[*m]);
        }
    }

    pub(crate) fn unstable(&mut self) -> bool {
        self.sim.take_unstable()
    }
}

fn every(model: &Model) -> Vec<usize> {
    (0..model.nv()).collect()
}

fn limits(model: &Model, robot: &Robot, share: f64) -> Vec<Box<dyn Limit>> {
    let a = |i: usize| robot.acceleration[i.min(robot.acceleration.len() - 1)];
    let per_joint = |share: f64| {
        PerJoint::Joints(model.joints().iter().map(|j| (j.name.clone(), share * a(j.idx_v))).collect())
    };
    let acceleration = AccelerationSettings::of(per_joint(1.0), Some(per_joint(share)));
    vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::scaled(robot.speed)),
        Box::new(AccelerationLimit::new(acceleration)),
        Box::new(TorqueLimit::default()),
    ]
}

/// The largest share of the acceleration limits, in steps of a fifth, that [`certify_braking`] lets braking count on.
fn certified_share(model: &Model, robot: &Robot) -> Result<Option<f64>, LimitError> {
    let mut share = 1.0;
    while share > 0.02 {
        let set = LimitSet::collect(model, &limits(model, robot, share), &every(model))?;
        let certificate = certify_braking(model, &set, &every(model), &Period::new(DT, 1), 50_000, 1)?;
        if certificate.margin > 0.02 {
            return Ok(Some(share));
        }
        share *= 0.8;
    }
    Ok(None)
}

/// The robot file without position limits: MuJoCo would stop the joints by itself, and hide what the projector lets through.
fn without_stops(urdf: &str) -> String {
    let mut text = urdf.to_string();
    for name in [" lower=\"", " upper=\""] {
        while let Some(at) = text.find(name) {
            let end = at + name.len() + text[at + name.len()..].find('"').unwrap_or(0) + 1;
            text.replace_range(at..end, "");
        }
    }
    text
}
