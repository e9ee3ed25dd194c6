//! Tasks of the user's own: any robot with reward, cost, reset and termination written in the task file, and native
//! tasks with a cost added.
//!
//! `[reward]` and `[cost]` are named expressions whose sum counts, `[termination]` named conditions of which any ends the
//! episode, `[reset]` what is added to or replaces the robot file's initial state. The names are those of [`quantity`], the
//! arithmetic that of [`expression`]. Entries of `state.observation` are expressions too; without any, all positions and
//! velocities are observed.

mod commands;
mod contacts;
mod costed;
mod course;
mod curriculum;
mod expression;
mod lexer;
mod measured;
mod notes;
mod pushes;
mod quantity;
mod random;
mod settings;

use nearl_runtime::Manifest;
use nearl_runtime::constraints::description::Motor;
use nearl_runtime::constraints::{self, Guard, RobotDescription};
use nearl_runtime::snapshot::PolicyKind;
use nearl_runtime::task::{IdmKind, Task};
use rand_chacha::ChaCha8Rng;

use super::rules::{Robot, Rules, joint_names};
use super::simulated::Simulated;
use super::spec::{Constants, EPISODE, Spec};
use super::{Env, EnvError};
use crate::mj::{Actuator, Hold, JointKind, MjError, Model, ModelFormat, Sim};
use crate::{robot, scene};
use commands::Commands;
use contacts::Contacts;
use costed::Costed;
use course::Course;
use curriculum::Curriculum;
use expression::Expression;
use measured::Measured;
use notes::Notes;
use pushes::Pushes;
use quantity::{Before, Names, Outcome, Own, Place, Quantity, Seen, base};
use random::Random;
use settings::{Mistake, Start, Term, mistake, starts, terms};

/// The rules of a task file.
#[derive(Clone)]
struct User {
    observation: Vec<Expression<Quantity>>,
    reward: Vec<Term>,
    termination: Vec<Term>,
    start: Vec<Start>,
    before: Before,
    course: Course,
    /// Some expression reads the external forces on bodies.
    reads_external: bool,
    /// Where the commands are in the observation, if they stand there together.
    seen_commands: std::ops::Range<usize>,
    /// What is told of the episode.
    notes: Notes,
    privileged: Vec<Expression<Quantity>>,
    /// What lies between the robot and its controller, and the random numbers of its noise.
    measured: Option<Measured>,
    noise: ChaCha8Rng,
    max_episode_steps: usize,
    dt: f64,
    /// Motors that MuJoCo's model does not have; without any, the action is its control.
    drives: Vec<Drive>,
    held: Held,
}

/// MuJoCo's actuators that nobody commands, and the controls that keep their joints where the episode begins.
#[derive(Clone, Default)]
struct Held {
    holds: Vec<Hold>,
    controls: Vec<f64>,
    /// Controls of an episode that goes on from its middle.
    given: Option<Vec<f64>>,
}

impl Held {
    /// What a model holds that is commanded by `actuators`, at its initial configuration.
    fn new(model: &Model, actuators: &[Actuator]) -> Held {
        let holds = model.held(actuators);
        let mut held = Held { controls: vec![0.0; holds.len()], holds, given: None };
        held.begin(model.qpos0());
        held
    }

    fn begin(&mut self, qpos: &[f64]) {
        if let Some(given) = self.given.take() {
            return self.controls = given;
        }
        for (control, hold) in self.controls.iter_mut().zip(&self.holds) {
            *control = hold.idx_q.map_or(0.0, |idx_q| hold.gear * qpos[idx_q]);
        }
    }
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
    let own = Own { actuators: &env.spec().actuators, ..Own::default() };
    let names = Names::new(env.sim().model(), own, Place::Outcome);
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
    let add = scene::of(task, &file).map_err(|m| refused(origin, m))?;
    let model = robot::compile_in(&file, task.model.free_flyer, &add).map_err(physics)?;
    let (spec, rules) = parse(manifest, file.format, &model).map_err(|m| refused(origin, m))?;
    let make = if rules.changes_robot() { Sim::apart } else { Sim::new };
    let sim = make(&model).map_err(physics)?;
    let robot = Robot { text: file.text.into(), format: file.format };
    with_cost(Simulated::boxed(spec, robot, rules, sim), task, origin)
}

fn refused(origin: &str, mistake: Mistake) -> EnvError {
    EnvError::Task { origin: origin.into(), key: mistake.key, reason: mistake.reason }
}

fn parse(manifest: &Manifest, format: ModelFormat, model: &Model) -> Result<(Spec, User), Mistake> {
    let task = &manifest.task;
    let sub_steps = sub_steps(task, model)?;
    let wanted = commanded(manifest);
    let (actuators, drives) = match format {
        ModelFormat::Mjcf => {
            (model.joint_actuators(wanted).map_err(|e| mistake("model.mjcf", e))?, Vec::new())
        }
        ModelFormat::Urdf if model.nu() > 0 => (pd_actuators(manifest, model, wanted), Vec::new()),
        ModelFormat::Urdf => drives(&manifest.robot, model, wanted).map_err(|e| mistake("model.urdf", e))?,
    };
    let held = Held::new(model, &actuators);
    let joints = model.joints();
    let (start, dt) = (Names::new(model, Own::default(), Place::Start), model.sim_dt() * sub_steps as f64);
    let driven = actuators.iter().map(|actuator| actuator.dof).collect();
    let mut course =
        Course::new(dt, driven, base(&joints).map(|joint| (joint.idx_q, joint.idx_v)), manifest.robot.down());
    course.commands = Commands::read(&task.commands, &start, dt)?;
    course.pushes = Pushes::read(&task.pushes, &joints, &start, dt)?;
    course.random = Random::read(&task.random, model, &actuators, &start)?;
    let drawn = course.random.as_ref().map_or(Vec::new(), Random::names);
    let measured = Measured::read(&task.noise, &task.delay, &joints, &start)?;
    course.draws_more = measured.is_some();
    let commands = course.commands.names().to_vec();
    let own = Own { actuators: &actuators, commands: &commands, drawn: &drawn, follows: true };
    let names = Names::new(model, own, Place::Outcome);
    let seen = Names::new(model, own, Place::Observation);
    let listed = observed(task, model, &commands);
    // As a name first: a joint may be called `left-hip`, which is no difference.
    let observe = |text: &String| seen.compile(&format!("{{{text}}}")).or_else(|_| seen.compile(text));
    let observation: Result<Vec<_>, _> = listed.iter().map(observe).collect();
    let observation = observation.map_err(|e| mistake("state.observation", e))?;
    let (reward, termination) =
        (terms("reward", &task.reward, &names)?, terms("termination", &task.termination, &names)?);
    if let Some(term) = termination.iter().find(|term| term.of.constant().is_some_and(|x| x != 0.0)) {
        let reason = "it holds always, so that every episode ends after one control period; compare something of the robot";
        return Err(mistake(format!("termination.{}", term.name), reason));
    }
    let privileged: Result<Vec<_>, _> = task.state.privileged.iter().map(observe).collect();
    let privileged = privileged.map_err(|e| mistake("state.privileged", e))?;
    course.curriculum = Curriculum::read(&task.curriculum, &reward)?;
    let climbs = course.curriculum.is_some();
    let notes = Notes::read(&task.metrics, &reward, &names, drawn, measured.is_some(), climbs)?;
    let told = reward.iter().chain(&termination).map(|term| &term.of).chain(notes.expressions());
    let told: Vec<_> = told.chain(&observation).chain(&privileged).collect();
    let is_external = |quantity| matches!(quantity, Quantity::External(..));
    let reads_external = told.iter().flat_map(|e| e.quantities()).any(is_external);
    course.contacts = Contacts::of(model, told.into_iter());
    let max_episode_steps = task.time.max_episode_steps.unwrap_or(EPISODE);
    let constants = Constants { name: task.name.clone(), sub_steps, max_episode_steps };
    let seen_commands = place_of(&commands, &listed);
    let mut spec = Spec::new(model, constants, listed, actuators);
    spec.notes = notes.names().to_vec();
    spec.privileged.clone_from(&task.state.privileged);
    let rules = User {
        observation,
        notes,
        privileged,
        measured,
        noise: course.noise(),
        max_episode_steps,
        reward,
        termination,
        start: starts(task, &spec.joints, &start)?,
        before: Before::new(model),
        course,
        reads_external,
        seen_commands,
        dt: spec.dt,
        drives,
        held,
    };
    Ok((spec, rules))
}

/// The joints whose motors alone the action is for; every motor's where it names none. A network's action without a guard, and without a recipe,
/// is one of all motors.
fn commanded(manifest: &Manifest) -> Option<&[String]> {
    let task = &manifest.task;
    let by_joint = task.idm.kind == IdmKind::Pinocchio
        || task.constraints.guard == Guard::Model
        || task.policy.is_some();
    task.state.controllable.as_deref().filter(|_| by_joint)
}

/// What the task observes: what it lists, else all positions, then all velocities, then the commands.
fn observed(task: &Task, model: &Model, commands: &[String]) -> Vec<String> {
    if !task.state.observation.is_empty() {
        return task.state.observation.clone();
    }
    let commands = commands.iter().map(|name| format!("command.{name}"));
    all_names(model).into_iter().chain(commands).collect()
}

/// Where the commands stand in the observation, one after another; an empty range where they do not.
fn place_of(commands: &[String], listed: &[String]) -> std::ops::Range<usize> {
    let names: Vec<String> = commands.iter().map(|name| format!("command.{name}")).collect();
    let at = listed.windows(names.len().max(1)).position(|window| window == names);
    at.map_or(0..0, |at| at..at + names.len())
}

/// The motors of a URDF, which MuJoCo does not know: actions within their ranges, and the joints they drive.
fn drives(
    robot: &RobotDescription,
    model: &Model,
    wanted: Option<&[String]>,
) -> Result<(Vec<Actuator>, Vec<Drive>), String> {
    let (joints, mut motors) = (model.joints(), robot.motors.clone());
    motors.sort_by_key(|motor| motor.order);
    let mut found = (Vec::new(), Vec::new());
    for (control, motor) in motors.into_iter().enumerate() {
        if wanted.is_some_and(|names| !names.contains(&motor.joint)) {
            continue;
        }
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
            control,
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

/// The drives that the scene gave the joints of a URDF. Their targets range over all that may ask for the whole effort somewhere, at any
/// speed that is allowed.
fn pd_actuators(manifest: &Manifest, model: &Model, wanted: Option<&[String]>) -> Vec<Actuator> {
    let joints = model.joints();
    let period = manifest.task.period();
    let speed = |name: &str| {
        let stated =
            manifest.robot.joints().find(|joint| joint.name == name).and_then(|joint| joint.velocity);
        let dof = joints.iter().find(|joint| joint.name == name).map_or(usize::MAX, |joint| joint.idx_v);
        let asked = manifest.task.constraints.velocity.as_ref().and_then(|v| v.limit.as_ref()?.of(name, dof));
        stated.into_iter().chain(asked).fold(0.0, f64::max)
    };
    // What a policy of actions may send is what it explores; where the model finds the target, a joint may turn on and on.
    let turns = if manifest.policy == PolicyKind::Direct { 1.0 } else { 1e3 };
    let mut actuators = model.actuators();
    actuators.retain(|actuator| wanted.is_none_or(|names| names.contains(&actuator.joint)));
    for actuator in &mut actuators {
        let id = actuator.control;
        let ([low, high], reach) = match joints.iter().find(|joint| joint.idx_v == actuator.dof) {
            Some(joint) => {
                let [stiffness, _, by_v] = model.gains(id).unwrap_or([1.0, -1.0, 0.0]);
                let drive = constraints::Drive::Pd { stiffness, damping: -by_v };
                (joint.range, drive.reach(&period, model.strength(id), speed(&actuator.joint)))
            }
            None => ([f64::NEG_INFINITY, f64::INFINITY], 0.0),
        };
        let turns = turns * 2.0 * std::f64::consts::PI;
        (actuator.low, actuator.high) = (low.max(-turns) - reach, high.min(turns) + reach);
    }
    actuators
}

/// Physics steps in a control period, by the robot file's own step.
fn sub_steps(task: &Task, model: &Model) -> Result<usize, Mistake> {
    let (t, sim_dt) = (&task.time, model.sim_dt());
    if t.sim_dt != 0.0 && !model.is_euler() {
        let reason = format!(
            "{}, or write sim_dt = 0: the projector cannot count on the file's steps then, and limits are exact no more",
            model.not_euler()
        );
        return Err(mistake("time.sim_dt", reason));
    }
    if t.sim_dt != 0.0 && (t.sim_dt - sim_dt).abs() > 1e-12 {
        let reason = match (task.scene.contains_key("timestep"), &task.model.urdf) {
            (false, Some(_)) => format!(
                "{} s, but the simulation of a URDF makes steps of {sim_dt} s unless it is told otherwise; write [scene] timestep = {0}",
                t.sim_dt
            ),
            (is_scene, _) => format!(
                "{} s, but {} is {sim_dt} s; write that, or 0 for another integrator than Euler",
                t.sim_dt,
                if is_scene { "[scene] timestep" } else { "the robot file's timestep" }
            ),
        };
        return Err(mistake("time.sim_dt", reason));
    }
    let steps = (t.dt / sim_dt).round();
    if steps < 1.0 || (t.dt / sim_dt - steps).abs() > 1e-9 {
        let reason = match task.model.urdf {
            Some(_) => format!(
                "{} s is not a whole number of physics steps, which take {sim_dt} s for a URDF; write them as [scene] timestep, or another dt",
                t.dt
            ),
            None => format!(
                "{} s is not a whole number of the robot file's timestep of {sim_dt} s; change one of them",
                t.dt
            ),
        };
        return Err(mistake("time.dt", reason));
    }
    Ok(steps as usize)
}

/// All positions, then all velocities.
fn all_names(model: &Model) -> Vec<String> {
    if model.joints().iter().all(|j| matches!(j.kind, JointKind::Slide | JointKind::Hinge)) {
        return joint_names(model, 0);
    }
    Names::new(model, Own::default(), Place::Observation).states()
}

impl User {
    /// Measures the present state, where noise or a delay lies before it.
    fn measure(&mut self, sim: &Sim) {
        let (course, dt, observation) = (&self.course, self.dt, &self.observation);
        let Some(measured) = &mut self.measured else { return };
        measured.measure(sim, &mut self.noise, course.level, |q, v, obs| {
            let seen = Seen { sim, q, v, dt, course: Some(course) };
            obs.clear();
            obs.extend(observation.iter().map(|e| e.value(|quantity| seen.read(quantity))));
        });
    }
}

impl Rules for User {
    fn start(
        &mut self,
        rng: &mut ChaCha8Rng,
        _: &mut Sim,
        qpos: &mut [f64],
        qvel: &mut [f64],
    ) -> Result<(), MjError> {
        self.course.end(self.notes.sums(), self.max_episode_steps);
        for entry in &self.start {
            let value = commands::drawn(&entry.value, rng, self.course.level);
            let to = if entry.velocity { &mut qvel[entry.index] } else { &mut qpos[entry.index] };
            *to = if entry.replace { value } else { *to + value };
        }
        self.course.draw(rng);
        Ok(())
    }

    fn prepare(&mut self, sim: &mut Sim) -> Result<(), MjError> {
        self.course.prepare(sim)
    }

    fn began(&mut self, sim: &Sim) {
        self.course.begin();
        self.noise = self.course.noise();
        let level = self.course.level;
        if let Some(measured) = &mut self.measured {
            measured.begin(self.course.rng(), level);
        }
        let delay = self.measured.as_ref().map(Measured::delay);
        self.notes.begin(self.course.random.as_ref().map_or(&[], Random::notes), delay, level);
        self.held.begin(sim.qpos());
        self.measure(sim);
    }

    fn begin(&mut self, sim: &Sim) {
        self.before.remember(sim);
    }

    fn actuate(&self, spec: &Spec, sim: &mut Sim, action: &[f64]) {
        let action = self.measured.as_ref().map_or(action, |measured| measured.arriving(action));
        if self.drives.is_empty() {
            let controls = sim.ctrl_mut();
            spec.actuators.iter().zip(action).for_each(|(of, action)| controls[of.control] = *action);
            let held = self.held.holds.iter().zip(&self.held.controls);
            return held.for_each(|(hold, control)| controls[hold.control] = *control);
        }
        let strength = self.course.random.as_ref().map(|random| &random.strength);
        for (i, (drive, action)) in self.drives.iter().zip(action).enumerate() {
            let (q, v) = (sim.qpos()[drive.idx_q], sim.qvel()[drive.idx_v]);
            let strength = strength.map_or(1.0, |strength| strength[i]);
            sim.force_mut()[drive.idx_v] = strength * drive.motor.torque(*action, q, v);
        }
    }

    fn progress(&self, _: &Sim) -> f64 {
        0.0
    }

    /// Kinematics at the new state: MuJoCo's step leaves them at the old one, to which the contact forces belong.
    fn finish(&self, sim: &mut Sim) -> Result<(), MjError> {
        if self.reads_external {
            sim.compute_contact_forces()?;
        }
        sim.update_kinematics()
    }

    fn follow(&mut self, sim: &Sim, action: &[f64]) {
        self.course.follow(sim, action);
        if let Some(measured) = &mut self.measured {
            measured.ask(action);
        }
    }

    fn advance(&mut self, sim: &mut Sim) {
        self.course.advance(sim);
        self.measure(sim);
    }

    fn score(&mut self, spec: &Spec, sim: &Sim, _: f64, action: &[f64]) -> (f64, bool) {
        let (before, course) = (&self.before, Some(&self.course));
        let outcome = Outcome { sim, v: sim.qvel(), before, action, dt: spec.dt, course };
        let mut reward = 0.0;
        for (i, term) in self.reward.iter().enumerate() {
            let value = term.weight * term.of.value(|q| outcome.read(q));
            self.notes.add(i, value);
            reward += value;
        }
        self.notes.measure(self.course.ticks(), |q| outcome.read(q));
        (reward, self.termination.iter().any(|term| term.of.holds(|q| outcome.read(q))))
    }

    fn observe(&self, sim: &Sim, obs: &mut [f64]) {
        if let Some(reading) = self.measured.as_ref().and_then(Measured::reading) {
            return obs.copy_from_slice(&reading.obs);
        }
        let seen = Seen { sim, q: sim.qpos(), v: sim.qvel(), dt: self.dt, course: Some(&self.course) };
        for (o, e) in obs.iter_mut().zip(&self.observation) {
            *o = e.value(|q| seen.read(q));
        }
    }

    fn goal(&self) -> &[f64] {
        self.course.commands.values()
    }

    fn goal_mut(&mut self) -> &mut [f64] {
        self.course.commands.values_mut()
    }

    fn goal_in_observation(&self) -> std::ops::Range<usize> {
        self.seen_commands.clone()
    }

    fn circumstances(&self) -> Vec<f64> {
        [self.course.circumstances(), self.held.controls.clone()].concat()
    }

    fn set_circumstances(&mut self, circumstances: &[f64]) {
        let own = circumstances.len().saturating_sub(self.held.controls.len());
        let (course, held) = circumstances.split_at(own);
        self.course.set_circumstances(course);
        self.held.given = (held.len() == self.held.controls.len()).then(|| held.to_vec());
    }

    fn start_curriculum(&mut self) {
        self.course.start_curriculum();
    }

    fn privileged(&self, sim: &Sim, to: &mut [f64]) {
        let seen = Seen { sim, q: sim.qpos(), v: sim.qvel(), dt: self.dt, course: Some(&self.course) };
        for (to, e) in to.iter_mut().zip(&self.privileged) {
            *to = e.value(|q| seen.read(q));
        }
    }

    fn measured(&self) -> Option<(&[f64], &[f64])> {
        let reading = self.measured.as_ref().and_then(Measured::reading)?;
        Some((&reading.q, &reading.v))
    }

    fn changes_robot(&self) -> bool {
        self.course.random.is_some()
    }

    fn pushes(&self) -> bool {
        self.course.pushes.is_some()
    }

    fn notes(&self) -> &[f64] {
        self.notes.values()
    }
}
