//! Tasks of the user's own: any robot with reward, cost, reset and termination written in the task file, and native
//! tasks with a cost added.
//!
//! `[reward]` and `[cost]` are named expressions whose sum counts, `[termination]` named conditions of which any ends the
//! episode, `[reset]` what is added to or replaces the robot file's initial state. The names are those of [`quantity`], the
//! arithmetic that of [`expression`]. Entries of `state.observation` are expressions too; without any, all positions and
//! velocities are observed.

mod costed;
mod expression;
mod lexer;
mod quantity;
mod settings;

use nearl_runtime::Manifest;
use nearl_runtime::constraints::RobotDescription;
use nearl_runtime::constraints::description::Motor;
use nearl_runtime::task::Task;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::rules::{Robot, Rules, joint_names};
use super::simulated::Simulated;
use super::spec::{Constants, EPISODE, Spec};
use super::{Env, EnvError};
use crate::mj::{Actuator, JointKind, MjError, Model, ModelFormat, Sim};
use crate::robot;
use costed::Costed;
use expression::Expression;
use quantity::{Before, Names, Outcome, Place, Quantity, read_state};
use settings::{Mistake, Start, mistake, starts, terms};

/// The rules of a task file.
#[derive(Clone)]
struct User {
    observation: Vec<Expression<Quantity>>,
    reward: Vec<Expression<Quantity>>,
    termination: Vec<Expression<Quantity>>,
    start: Vec<Start>,
    before: Before,
    dt: f64,
    /// Motors that MuJoCo's model does not have; without any, the action is its control.
    drives: Vec<Drive>,
}

/// A motor and where its joint's entries are.
#[derive(Clone)]
struct Drive {
    motor: Motor,
    idx_q: usize,
    idx_v: usize,
}

/// Whether the task file describes an environment itself.
pub(super) fn is_own(task: &Task) -> bool {
    !task.reward.is_empty()
}

/// Adds the task file's cost, if it has one.
pub(super) fn with_cost(env: Box<dyn Env>, task: &Task, origin: &str) -> Result<Box<dyn Env>, EnvError> {
    if task.cost.is_empty() {
        return Ok(env);
    }
    let names = Names::new(env.sim().model(), Place::Outcome);
    let cost = terms("cost", &task.cost, &names).map_err(|m| refused(origin, m))?;
    Ok(Box::new(Costed::new(env, task.name.clone(), cost)))
}

/// The environment of a task that describes one; `origin` is the file or task in messages.
pub(super) fn build(manifest: &Manifest, origin: &str) -> Result<Box<dyn Env>, EnvError> {
    let physics = |source| EnvError::Physics { task: origin.into(), source };
    let task = &manifest.task;
    let Some(file) = robot::simulation(manifest) else {
        let reason =
            "the snapshot holds no robot file for the simulator; give the run's folder or the task file";
        return Err(refused(origin, mistake("model", reason)));
    };
    let model = robot::compile(&file, task.model.free_flyer).map_err(physics)?;
    let (spec, rules) = parse(manifest, file.format, &model).map_err(|m| refused(origin, m))?;
    let sim = Sim::new(&model).map_err(physics)?;
    let robot = Robot { text: file.text.into(), format: file.format };
    with_cost(Simulated::boxed(spec, robot, rules, sim), task, origin)
}

fn refused(origin: &str, mistake: Mistake) -> EnvError {
    EnvError::Task { origin: origin.into(), key: mistake.key, reason: mistake.reason }
}

fn parse(manifest: &Manifest, format: ModelFormat, model: &Model) -> Result<(Spec, User), Mistake> {
    let task = &manifest.task;
    let sub_steps = sub_steps(task, model)?;
    let (actuators, drives) = match format {
        ModelFormat::Mjcf => (model.joint_actuators().map_err(|e| mistake("model.mjcf", e))?, Vec::new()),
        ModelFormat::Urdf => drives(&manifest.robot, model).map_err(|e| mistake("model.urdf", e))?,
    };
    let listed =
        if task.state.observation.is_empty() { all_names(model) } else { task.state.observation.clone() };
    let seen = Names::new(model, Place::Observation);
    let observe =
        |name: &String| seen.compile(name).or_else(|e| seen.compile(&format!("{{{name}}}")).map_err(|_| e));
    let observation = listed.iter().map(observe).collect::<Result<_, _>>();
    let names = Names::new(model, Place::Outcome);
    let max_episode_steps = task.time.max_episode_steps.unwrap_or(EPISODE);
    let constants = Constants { name: task.name.clone(), sub_steps, max_episode_steps };
    let spec = Spec::new(model, constants, listed, actuators);
    let rules = User {
        observation: observation.map_err(|e| mistake("state.observation", e))?,
        reward: terms("reward", &task.reward, &names)?,
        termination: terms("termination", &task.termination, &names)?,
        start: starts(task, &spec.joints, &Names::new(model, Place::Start))?,
        before: Before::new(model),
        dt: spec.dt,
        drives,
    };
    Ok((spec, rules))
}

/// The motors of a URDF, which MuJoCo does not know: actions within their ranges, and the joints they drive.
fn drives(robot: &RobotDescription, model: &Model) -> Result<(Vec<Actuator>, Vec<Drive>), String> {
    let (joints, mut motors) = (model.joints(), robot.motors.clone());
    motors.sort_by_key(|motor| motor.order);
    let mut found = (Vec::new(), Vec::new());
    for motor in motors {
        let Some([low, high]) = motor.control_range else {
            return Err(format!(
                "joint '{}' states no effort, and the action is chosen within it; write it into <limit>",
                motor.joint
            ));
        };
        let Some(joint) = joints.iter().find(|joint| joint.name == motor.joint) else {
            return Err(format!("MuJoCo has no joint '{}'; join it to the others", motor.joint));
        };
        found.0.push(Actuator {
            name: motor.name.clone(),
            joint: motor.joint.clone(),
            dof: joint.idx_v,
            gear: motor.gear,
            is_plain: true,
            low,
            high,
        });
        found.1.push(Drive { motor, idx_q: joint.idx_q, idx_v: joint.idx_v });
    }
    match found.0.is_empty() {
        true => Err("the robot has no joint that a motor could drive".into()),
        false => Ok(found),
    }
}

/// Physics steps in a control period, by the robot file's own step.
fn sub_steps(task: &Task, model: &Model) -> Result<usize, Mistake> {
    let (t, sim_dt) = (&task.time, model.sim_dt());
    if t.sim_dt != 0.0 && !model.is_euler() {
        let reason = "the robot file's integrator is not Euler, so the projector cannot count on its steps; write sim_dt = 0";
        return Err(mistake("time.sim_dt", reason));
    }
    if t.sim_dt != 0.0 && (t.sim_dt - sim_dt).abs() > 1e-12 {
        return Err(mistake(
            "time.sim_dt",
            format!(
                "{} s, but the robot file's timestep is {sim_dt} s; write that, or 0 for another integrator than Euler",
                t.sim_dt
            ),
        ));
    }
    let steps = (t.dt / sim_dt).round();
    if steps < 1.0 || (t.dt / sim_dt - steps).abs() > 1e-9 {
        let reason = format!(
            "{} s is not a whole number of the robot file's timestep of {sim_dt} s; change one of them",
            t.dt
        );
        return Err(mistake("time.dt", reason));
    }
    Ok(steps as usize)
}

/// All positions, then all velocities.
fn all_names(model: &Model) -> Vec<String> {
    if model.joints().iter().all(|j| matches!(j.kind, JointKind::Slide | JointKind::Hinge)) {
        return joint_names(model, 0);
    }
    Names::new(model, Place::Observation).states()
}

impl Rules for User {
    fn start(
        &mut self,
        rng: &mut ChaCha8Rng,
        _: &mut Sim,
        qpos: &mut [f64],
        qvel: &mut [f64],
    ) -> Result<(), MjError> {
        for entry in &self.start {
            let (uniform, normal) = (rng.random_range(-1.0..1.0), StandardNormal.sample(rng));
            let value = entry.value.value(|q| if q == Quantity::Uniform { uniform } else { normal });
            let to = if entry.velocity { &mut qvel[entry.index] } else { &mut qpos[entry.index] };
            *to = if entry.replace { value } else { *to + value };
        }
        Ok(())
    }

    fn begin(&mut self, sim: &Sim) {
        self.before.remember(sim);
    }

    fn actuate(&self, _: &Spec, sim: &mut Sim, action: &[f64]) {
        if self.drives.is_empty() {
            return sim.ctrl_mut().copy_from_slice(action);
        }
        for (drive, action) in self.drives.iter().zip(action) {
            let (q, v) = (sim.qpos()[drive.idx_q], sim.qvel()[drive.idx_v]);
            sim.force_mut()[drive.idx_v] = drive.motor.torque(*action, q, v);
        }
    }

    fn progress(&self, _: &Sim) -> f64 {
        0.0
    }

    /// Kinematics at the new state: MuJoCo's step leaves them at the old one.
    fn finish(&self, sim: &mut Sim) -> Result<(), MjError> {
        sim.update_kinematics()
    }

    fn score(&self, spec: &Spec, sim: &Sim, _: f64, action: &[f64]) -> (f64, bool) {
        let outcome = Outcome { sim, before: &self.before, action, dt: spec.dt };
        let reward = self.reward.iter().map(|e| e.value(|q| outcome.read(q))).sum();
        (reward, self.termination.iter().any(|e| e.holds(|q| outcome.read(q))))
    }

    fn observe(&self, sim: &Sim, obs: &mut [f64]) {
        for (o, e) in obs.iter_mut().zip(&self.observation) {
            *o = e.value(|q| read_state(sim, self.dt, q));
        }
    }
}
