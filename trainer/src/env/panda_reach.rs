//! Panda-reach: bring a torque-controlled arm's hand to a goal and hold it there, against gravity.
//!
//! The action is the seven joint torques \[N·m\], clamped at the robot file's effort limits. One physics step is one control
//! period, 1 ms unless the task file says otherwise, so inside the joint stops
//!
//! `v' = v + dt a`, `q' = q + dt v'`, `M(q) a = action - nle(q, v)`
//!
//! holds to rounding: a constraint on `a` is a constraint on what happens. Contacts are left out; the joint stops act as
//! MuJoCo's soft stops.
//!
//! `reward = dt (-10 d + 10 exp(-(d / 0.05)^2))` with `d` \[m\] the distance of hand and goal: a slope from everywhere, and a
//! bonus of the same size within about 5 cm that makes holding still at the goal the best thing to do. A period of a 50 Hz
//! policy is 20 of these; an episode (2 s) returns about -9 for holding the start and +14 for going straight to the goal.

use std::borrow::Cow;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::rules::{Robot, Rules, add_uniform, joint_names};
use super::simulated::Simulated;
use super::spec::{Constants, Spec};
use super::{Env, EnvError};
use crate::mj::{Actuator, Joint, MjError, Model, ModelFormat, Options, Sim};

pub(super) const NAME: &str = "Panda-reach";
pub(super) const ABOUT: &str = "seven-joint arm under torque control, reach a point";
const ROBOT: Robot = Robot {
    text: Cow::Borrowed(include_str!("../../../examples/robots/panda/panda.urdf")),
    format: ModelFormat::Urdf,
};
const HAND: &str = "panda_hand";
/// Control period, unless the task file has another [s].
pub(super) const DT: f64 = 1e-3;
/// Length of an episode [s].
const EPISODE: f64 = 2.0;
/// Pose to start from \[rad\]: elbow bent, hand in front of the base and pointing down.
const READY: [f64; 7] = [
    0.0,
    -std::f64::consts::FRAC_PI_4,
    0.0,
    -3.0 * std::f64::consts::FRAC_PI_4,
    0.0,
    std::f64::consts::FRAC_PI_2,
    std::f64::consts::FRAC_PI_4,
];
const RESET_NOISE: f64 = 0.1;
/// Goals are hand positions at joint positions drawn this far around [`READY`] \[rad\], inside the joint limits.
const GOAL_SPREAD: f64 = 1.0;
/// Distance of start and goal configurations from the joint limits \[rad\].
const LIMIT_MARGIN: f64 = 0.05;
/// Goals are above this \[m\], the table the arm stands on being 0.
const LOWEST_GOAL: f64 = 0.05;
const SLOPE: f64 = 10.0;
const BONUS: f64 = 10.0;
const NEAR: f64 = 0.05;

#[derive(Clone)]
struct PandaReach {
    hand: usize,
    /// Range of each joint without its margin \[rad\].
    ranges: [[f64; 2]; 7],
    goal: [f64; 3],
}

pub(super) fn build() -> Result<Box<dyn Env>, EnvError> {
    build_at(DT)
}

/// Control periods of `dt` [s] in an episode.
pub(super) const fn periods(dt: f64) -> usize {
    (EPISODE / dt).round() as usize
}

/// With another control period [s]; its episodes last as long.
pub(super) fn build_at(dt: f64) -> Result<Box<dyn Env>, EnvError> {
    let physics = |source| EnvError::Physics { task: NAME.into(), source };
    let options = Options { sim_dt: Some(dt), without_contacts: true, ..Options::default() };
    let model = Model::from_text(&ROBOT.text, ROBOT.format, options).map_err(physics)?;
    let joints = model.joints();
    let expected = READY.len();
    if joints.len() != expected || model.nq() != expected {
        return Err(physics(MjError::Length {
            what: "Panda-reach's start pose",
            expected: model.nq(),
            got: expected,
        }));
    }
    let mut names = joint_names(&model, 0);
    names.extend(["goal.x", "goal.y", "goal.z", "error.x", "error.y", "error.z"].map(String::from));
    let task = Constants { name: NAME.into(), sub_steps: 1, max_episode_steps: periods(dt) };
    let spec = Spec::new(
        &model,
        task,
        names,
        joints.iter().enumerate().map(|(k, joint)| torque(k, joint)).collect(),
    );
    let ranges =
        std::array::from_fn(|j| [joints[j].range[0] + LIMIT_MARGIN, joints[j].range[1] - LIMIT_MARGIN]);

    let mut sim = Sim::new(&model).map_err(physics)?;
    let hand = model.body(HAND).map_err(physics)?;
    sim.set_state(&READY, &[0.0; 7]).map_err(physics)?;
    let goal = sim.position(hand);
    Ok(Simulated::boxed(spec, ROBOT, PandaReach { hand, ranges, goal }, sim))
}

/// A joint driven by its own torque, up to its effort limit.
fn torque(control: usize, joint: &Joint) -> Actuator {
    let name = joint.name.clone();
    Actuator {
        joint: name.clone(),
        name,
        dof: joint.idx_v,
        gear: 1.0,
        is_plain: true,
        control,
        low: -joint.effort,
        high: joint.effort,
    }
}

impl PandaReach {
    fn error(&self, sim: &Sim) -> [f64; 3] {
        let hand = sim.position(self.hand);
        std::array::from_fn(|k| self.goal[k] - hand[k])
    }

    fn distance(&self, sim: &Sim) -> f64 {
        self.error(sim).iter().map(|e| e * e).sum::<f64>().sqrt()
    }

    /// A hand position that some joint positions within the limits reach.
    fn draw_goal(&mut self, rng: &mut ChaCha8Rng, sim: &mut Sim) -> Result<(), MjError> {
        loop {
            let q: [f64; 7] = std::array::from_fn(|j| {
                let [low, high] = self.ranges[j];
                rng.random_range((READY[j] - GOAL_SPREAD).max(low)..(READY[j] + GOAL_SPREAD).min(high))
            });
            sim.place(&q)?;
            self.goal = sim.position(self.hand);
            // About three in four are high enough.
            if self.goal[2] > LOWEST_GOAL {
                return Ok(());
            }
        }
    }
}

impl Rules for PandaReach {
    fn start(
        &mut self,
        rng: &mut ChaCha8Rng,
        sim: &mut Sim,
        qpos: &mut [f64],
        _: &mut [f64],
    ) -> Result<(), MjError> {
        self.draw_goal(rng, sim)?;
        qpos.copy_from_slice(&READY);
        add_uniform(rng, RESET_NOISE, qpos);
        for (q, [low, high]) in qpos.iter_mut().zip(self.ranges) {
            *q = q.clamp(low, high);
        }
        Ok(())
    }

    fn actuate(&self, spec: &Spec, sim: &mut Sim, action: &[f64]) {
        for (i, torque) in sim.force_mut().iter_mut().enumerate() {
            *torque = action[i].clamp(spec.actuators[i].low, spec.actuators[i].high);
        }
    }

    fn progress(&self, _: &Sim) -> f64 {
        0.0
    }

    /// Kinematics at the new state: MuJoCo's step leaves them at the old one.
    fn finish(&self, sim: &mut Sim) -> Result<(), MjError> {
        sim.update_kinematics()
    }

    fn score(&mut self, spec: &Spec, sim: &Sim, _: f64, _: &[f64]) -> (f64, bool) {
        let d = self.distance(sim);
        (spec.dt * (BONUS * (-(d / NEAR).powi(2)).exp() - SLOPE * d), false)
    }

    fn observe(&self, sim: &Sim, obs: &mut [f64]) {
        obs[..7].copy_from_slice(sim.qpos());
        obs[7..14].copy_from_slice(sim.qvel());
        obs[14..17].copy_from_slice(&self.goal);
        obs[17..].copy_from_slice(&self.error(sim));
    }

    fn goal(&self) -> &[f64] {
        &self.goal
    }

    fn goal_in_observation(&self) -> std::ops::Range<usize> {
        14..17
    }

    fn goal_mut(&mut self) -> &mut [f64] {
        &mut self.goal
    }
}
