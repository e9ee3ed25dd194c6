//! What a snapshot promises: robot, limits, and what the numbers of a tick mean.

use serde::Deserialize;
use serde_json::Value;

use crate::limits::{Consistency, Limits, Of, PerJoint, Section, Way};
use crate::motion::Machine;
use crate::moved::{Moved, Moving};
use crate::period::Period;
use crate::robot::{Payload, Robot};
use crate::rows::{Row, Rule};
use crate::tick::Tick;

/// The parts of a snapshot's manifest that are read.
#[derive(Deserialize)]
struct Manifest {
    task: Task,
    robot: Robot,
    /// Where an operator has moved the limits.
    moved: Option<Moved>,
    policy: String,
    action_lower: Vec<f64>,
    action_upper: Vec<f64>,
}

#[derive(Deserialize)]
struct Task {
    time: Time,
    state: State,
    constraints: Value,
    idm: Idm,
    #[serde(default)]
    command: Command,
}

#[derive(Deserialize)]
struct Time {
    dt: f64,
    #[serde(default = "one")]
    policy_every: u32,
    sim_dt: f64,
}

fn one() -> u32 {
    1
}

#[derive(Deserialize)]
struct State {
    #[serde(default)]
    observation: Vec<String>,
    propose: Option<Vec<String>>,
    controllable: Option<Vec<String>>,
}

#[derive(Deserialize)]
struct Idm {
    kind: String,
}

#[derive(Default, Deserialize)]
struct Command {
    interface: Option<Interfaces>,
    stiffness: Option<PerJoint>,
    damping: Option<PerJoint>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Interfaces {
    All(String),
    Joints(std::collections::BTreeMap<String, String>),
}

/// An entry of a proposal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Entry {
    Position { dof: usize, at: usize },
    Velocity { dof: usize },
}

/// What joints that follow by themselves were sent in a period.
#[derive(Clone)]
pub(crate) struct SetPoints {
    /// Configuration (nq).
    pub(crate) q: Vec<f64>,
    /// Velocity at the end of the period (nv).
    pub(crate) v: Vec<f64>,
    /// Mean velocity on the way, by which a driver of positions goes on (nv).
    pub(crate) mean: Vec<f64>,
}

/// What a joint is sent.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Sent {
    Force,
    Position,
    Velocity,
    Target { stiffness: f64, damping: f64 },
}

/// A controllable joint's entry of the action: `u = (torque / gear - bias) / gain` of a force, others as they are.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Action {
    pub(crate) dof: usize,
    pub(crate) place: usize,
    pub(crate) sent: Sent,
    pub(crate) gear: f64,
    pub(crate) gain: f64,
    pub(crate) bias: f64,
    /// Of the joint: the motor makes up for some of it [N·m or N].
    pub(crate) friction: f64,
    /// The largest force that a drive is sent for, where steps take its damping implicitly [N m or N]; infinite elsewhere.
    pub(crate) strength: f64,
    pub(crate) range: [f64; 2],
}

/// What is known of the way from a proposal to a target.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Projects {
    /// The point of a cubic from the state at the policy tick to the proposal.
    Proposals,
    /// The state that an action of the policy leads to, which the log has.
    Actions,
    /// The state that an action of an inverse model leads to, which it has not.
    Unlogged,
    /// Nothing.
    Nothing,
}

/// Share by which the torque of a brake may be more than was verified where the plant has come a little elsewhere.
const DRIFT: f64 = 0.01;

/// A snapshot's promise.
pub(crate) struct Promise {
    pub(crate) machine: Machine,
    pub(crate) limits: Limits,
    /// The same without margins, where the plant is the model to second order only: of the brake in force, whose torque may be more by [`DRIFT`].
    pub(crate) without_margins: Option<(Limits, Option<Moving>)>,
    pub(crate) controllable: Vec<usize>,
    pub(crate) period: Period,
    pub(crate) policy_every: u32,
    pub(crate) proposed: Vec<Entry>,
    pub(crate) projects: Projects,
    pub(crate) consistency: Consistency,
    pub(crate) way: Way,
    /// Controllable joints that follow by themselves what they are sent: dof, entry of a configuration and how far they may be from it
    /// where they are sent a position, else none.
    follows: Vec<(usize, Option<(usize, f64)>)>,
    /// Of analytic inverse dynamics; empty where a network gives the action.
    pub(crate) actions: Vec<Action>,
    /// Entries of an action.
    pub(crate) n_act: usize,
    /// Limits on actions, and those of drives, change `moved`.
    pub(crate) limits_actions: bool,
    /// Where an operator has moved its limits; `limits` are then those in force for a tick.
    pub(crate) moving: Option<Moving>,
    /// What the robot carries beside what its description has.
    pub(crate) payload: Option<Payload>,
    /// A unit of softness: the weighted squared distance of the largest velocity change of one period.
    pub(crate) worth: f64,
}

/// The manifest of a snapshot's bytes (safetensors), as text.
///
/// # Errors
/// A clause.
fn manifest(bytes: &[u8]) -> Result<String, String> {
    let length =
        bytes.first_chunk::<8>().map(|b| u64::from_le_bytes(*b)).ok_or("it is shorter than a header")?;
    let end = usize::try_from(length).ok().and_then(|n| n.checked_add(8));
    let header = end.and_then(|end| bytes.get(8..end)).ok_or("its header is longer than the file")?;
    let header: Value = serde_json::from_slice(header).map_err(|e| format!("its header is damaged: {e}"))?;
    let text = header["__metadata__"]["nearl"].as_str().ok_or("it has no manifest")?;
    text.split_once('\n')
        .map(|(_, manifest)| manifest.to_owned())
        .ok_or_else(|| "its manifest is cut".to_owned())
}

/// The set points of a joint that is sent positions wait where it is further from the last one than its way at the speed limit in this time [s];
/// without one, than this [rad or m].
const FOLLOWING: f64 = 0.1;
/// After more periods than this a driver that holds has long come to rest.
const MISSED: u64 = 1000;

/// The limits with every margin at 0, but for that of bodies, which is their limit.
fn without_margins(limits: &Value) -> Value {
    let mut limits = limits.clone();
    let kinds = limits.as_object_mut().into_iter().flatten().filter(|(kind, _)| *kind != "collision");
    for (_, kind) in kinds {
        let each = match kind {
            Value::Array(all) => all.iter_mut().collect(),
            one => vec![one],
        };
        for margin in each.into_iter().filter_map(|one| one.get_mut("margin")) {
            match margin {
                Value::Object(joints) => joints.values_mut().for_each(|x| *x = 0.0.into()),
                Value::Array(joints) => joints.iter_mut().for_each(|x| *x = 0.0.into()),
                all => *all = 0.0.into(),
            }
        }
    }
    limits
}

impl Promise {
    /// The promise of a snapshot, given as the bytes of its file; `pinned` takes the place of its limits.
    ///
    /// # Errors
    /// A clause that says what of it is not known here.
    pub(crate) fn read(bytes: &[u8], pinned: Option<&Value>) -> Result<Promise, String> {
        let mut manifest: Manifest =
            serde_json::from_str(&manifest(bytes)?).map_err(|e| format!("its manifest is damaged: {e}"))?;
        if let Some(payload) = manifest.moved.as_ref().and_then(|moved| moved.payload.as_ref()) {
            manifest.robot.carry(payload)?;
        }
        Promise::of(&manifest, pinned)
    }

    fn of(m: &Manifest, pinned: Option<&Value>) -> Result<Promise, String> {
        let machine = Machine::new(&m.robot)?;
        let written = pinned.unwrap_or(&m.task.constraints);
        let section = |written: &Value| {
            Section::deserialize(written).map_err(|e| format!("its limits hold what is not known here: {e}"))
        };
        let (bare, mut section) = (section(&without_margins(written))?, section(written)?);
        let joint = |name: &str| m.robot.joints().position(|j| j.name == name);
        let entry = |name: &String| {
            let (letter, rest) = name.split_once('.')?;
            let dof = joint(rest)?;
            match letter {
                "q" => machine.single(dof).map(|at| Entry::Position { dof, at }),
                "v" => Some(Entry::Velocity { dof }),
                _ => None,
            }
        };
        let state = &m.task.state;
        let proposed: Vec<Entry> =
            state.propose.as_ref().unwrap_or(&state.observation).iter().filter_map(entry).collect();
        let of = |e: &Entry| match e {
            Entry::Position { dof, .. } | Entry::Velocity { dof } => *dof,
        };
        let mut controllable: Vec<usize> = match &state.controllable {
            Some(names) => names.iter().filter_map(|name| joint(name)).collect(),
            None => proposed.iter().map(of).collect(),
        };
        controllable.sort_unstable();
        controllable.dedup();
        let sub_steps =
            if m.task.time.sim_dt == 0.0 { 0 } else { (m.task.time.dt / m.task.time.sim_dt).round() as u32 };
        if sub_steps > 1000 || m.task.time.dt.is_nan() || m.task.time.dt <= 0.0 {
            return Err(format!("its control period of {} s has {sub_steps} physics steps", m.task.time.dt));
        }
        // Joints whose forces are reckoned with end so far before their stops [rad or m], and their braking leaves a share of the limit.
        if m.task.idm.kind == "pinocchio" || section.guard.as_bool() == Some(true) {
            (section.gap, section.reserve) =
                if sub_steps == 1 { (1e-6, 0.0) } else { (1e-4, (4.0 * m.task.time.dt).clamp(0.02, 0.2)) };
        }
        let period = Period::new(m.task.time.dt, sub_steps);
        let sent: Vec<Sent> = m
            .robot
            .joints()
            .enumerate()
            .map(|(dof, j)| m.task.command.sent(dof, &j.name))
            .collect::<Result<_, _>>()?;
        let drives: Vec<_> = sent
            .iter()
            .map(|sent| match sent {
                Sent::Target { stiffness, damping } => Some([*stiffness, *damping]),
                _ => None,
            })
            .collect();
        let mut ranges = vec![[f64::NEG_INFINITY, f64::INFINITY]; machine.nv()];
        for action in m.actions(&controllable, &sent).unwrap_or_default() {
            let [low, high] = action.range;
            if !(low.is_nan() || high.is_nan()) {
                ranges[action.dof] = [low, high];
            }
        }
        let is_free = |(dof, joint): (usize, &crate::robot::Joint)| {
            let is_led = matches!(sent[dof], Sent::Position | Sent::Velocity);
            (!is_led && (controllable.contains(&dof) || !joint.held)).then_some(dof)
        };
        let free: Vec<usize> = m.robot.joints().enumerate().filter_map(is_free).collect();
        let (controls, drives, ranges) = (&controllable[..], &drives[..], &ranges[..]);
        let robot = &m.robot;
        let of =
            Of { robot, machine: &machine, controllable: controls, drives, free: &free, ranges, sub_steps };
        let limits = section.limits(&of)?;
        let mut bare = (sub_steps != 1).then(|| bare.limits(&of)).transpose()?;
        for row in bare.iter_mut().flat_map(|limits| &mut limits.rows) {
            // Of the motion that a brake was to make; what its action asks of a motor is looked at by itself.
            if let Rule::Torque { most, .. } = &mut row.rule {
                *most *= 1.0 + DRIFT;
            }
        }
        let (is_direct, is_analytic) = (m.policy == "direct", m.task.idm.kind == "pinocchio");
        let guards = section.guard.as_bool() == Some(true);
        let projects = match (is_direct, is_analytic) {
            (false, true) => Projects::Proposals,
            (true, _) if guards => Projects::Actions,
            (true, _) => Projects::Nothing,
            (false, false) if guards => Projects::Unlogged,
            (false, false) => Projects::Proposals,
        };
        let follows = |&dof: &usize| match sent[dof] {
            Sent::Position => {
                let most = FOLLOWING * limits.joints[dof].velocity;
                let most = if most.is_finite() { most } else { FOLLOWING };
                machine.single(dof).map(|at| (dof, Some((at, most))))
            }
            Sent::Velocity => Some((dof, None)),
            _ => None,
        };
        let follows = controllable.iter().filter_map(follows).collect();
        let is_known = (is_analytic && !is_direct) || (guards && controllable.len() == machine.nv());
        let actions = if is_known { m.actions(&controllable, &sent)? } else { Vec::new() };
        let change = |dof: &usize| {
            let joint = &limits.joints[*dof];
            match (joint.acceleration.is_finite(), joint.velocity.is_finite()) {
                (true, _) => joint.acceleration * period.dt,
                (false, true) => joint.velocity,
                (false, false) => 1.0,
            }
        };
        let moving = |limits: &Limits| {
            m.moved.as_ref().map(|moved| Moving::new(limits.clone(), moved, &period, &controllable))
        };
        let without_margins = bare.map(|limits| (limits.clone(), moving(&limits)));
        let moving = moving(&limits);
        let worth = controllable.iter().map(change).fold(0.0, |most: f64, x| most.max(2.0 * x * x));
        let consistency =
            if projects == Projects::Proposals { section.consistency } else { Consistency::Kinematic };
        Ok(Promise {
            machine,
            limits,
            without_margins,
            controllable,
            period,
            policy_every: m.task.time.policy_every.max(1),
            proposed,
            projects,
            consistency,
            way: section.braking,
            follows,
            actions,
            n_act: m.action_lower.len(),
            limits_actions: section.action.is_some() || section.guard == "drive",
            moving,
            payload: m.moved.as_ref().and_then(|moved| moved.payload.clone()),
            worth,
        })
    }

    /// The manifest of a snapshot, given as the bytes of its file.
    ///
    /// # Errors
    /// A clause.
    pub(crate) fn manifest(bytes: &[u8]) -> Result<Value, String> {
        serde_json::from_str(&manifest(bytes)?).map_err(|e| format!("its manifest is damaged: {e}"))
    }

    /// The limits that the snapshot itself states, to compare with those of a loop.
    pub(crate) fn stated(bytes: &[u8]) -> Result<Value, String> {
        Ok(Promise::manifest(bytes)?["task"]["constraints"].clone())
    }

    /// Takes the limits without margins for those with them, and the other way round.
    pub(crate) fn leave_out_margins(&mut self) {
        if let Some((limits, moving)) = &mut self.without_margins {
            std::mem::swap(limits, &mut self.limits);
            std::mem::swap(moving, &mut self.moving);
        }
    }

    /// Whether some joint goes on from what it was sent in the tick before.
    pub(crate) fn follows(&self) -> bool {
        !self.follows.is_empty()
    }

    /// Puts what was `sent` in the tick before in the place of what is measured. Returns the dofs that are too far from it: their set points wait at rest.
    pub(crate) fn depart(&self, sent: &SetPoints, q: &mut [f64], v: &mut [f64]) -> Vec<usize> {
        let mut waiting = Vec::new();
        for &(dof, position) in &self.follows {
            if let Some((at, most)) = position {
                let away = (q[at] - sent.q[at]).abs();
                if away.is_nan() {
                    continue; // a position that is no number stays, and is named
                }
                if away > most {
                    waiting.push(dof);
                }
                q[at] = sent.q[at];
            }
            v[dof] = sent.v[dof];
        }
        waiting
    }

    /// What drivers make of what was `sent` in `periods` in which they hear nothing more: positions go on by their mean speed, slower in each.
    pub(crate) fn hold(&self, sent: &mut SetPoints, periods: u64) {
        let dt = self.period.dt;
        for &(dof, position) in &self.follows {
            let Some((at, _)) = position else { continue };
            for _ in 0..periods.min(MISSED) {
                let v = sent.mean[dof];
                let slower = v.signum() * (v.abs() - self.built().joints[dof].acceleration * dt).max(0.0);
                let by = (1.0 - self.period.kappa) * (v.abs() - slower.abs());
                (sent.v[dof], sent.mean[dof]) = (v.signum() * (slower.abs() - by).max(0.0), slower);
                sent.q[at] += dt * slower;
            }
        }
    }

    /// The same of what they are asked for then (nv): what the last of the `periods` does to their mean speed.
    pub(crate) fn hold_asked(&self, sent: &SetPoints, periods: u64, a: &mut [f64]) {
        let mut by_then = sent.clone();
        self.hold(&mut by_then, periods.min(MISSED) - 1);
        let before = by_then.mean.clone();
        self.hold(&mut by_then, 1);
        for &(dof, position) in &self.follows {
            a[dof] = position.map_or(0.0, |_| (by_then.mean[dof] - before[dof]) / self.period.dt);
        }
    }

    /// Whether a tick depends on what was sent before it.
    pub(crate) fn goes_on(&self) -> bool {
        let Limits { rows, joints, .. } = self.built();
        self.follows() || rows.iter().any(Row::needs_before) || joints.iter().any(|j| j.jerk.is_finite())
    }

    /// What is sent with the target of `tick` that began at `from` (nq, nv). Targets of a wrong length send nothing.
    pub(crate) fn sends(&self, tick: &Tick, from: Option<&(Vec<f64>, Vec<f64>)>) -> SetPoints {
        let (q, v) = (tick.target_q.clone(), tick.target_v.clone());
        let mut mean = v.clone();
        for &(dof, position) in &self.follows {
            if let (Some((at, _)), Some((from, _))) = (position, from)
                && let (Some(mean), Some(to)) = (mean.get_mut(dof), q.get(at))
            {
                *mean = (to - from[at]) / self.period.dt;
            }
        }
        SetPoints { q, v, mean }
    }

    /// The limits as they were built.
    pub(crate) fn built(&self) -> &Limits {
        self.moving.as_ref().map_or(&self.limits, |moving| &moving.built)
    }

    /// Whether a dof is proposed as a position, and as a velocity.
    pub(crate) fn halves(&self, dof: usize) -> (bool, bool) {
        let has = |want: &dyn Fn(&Entry) -> bool| self.proposed.iter().any(want);
        let position = has(&|e| matches!(e, Entry::Position { dof: d, .. } if *d == dof));
        (position, has(&|e| matches!(e, Entry::Velocity { dof: d } if *d == dof)))
    }
}

impl Command {
    fn sent(&self, dof: usize, joint: &str) -> Result<Sent, String> {
        let interface = match &self.interface {
            None => "effort",
            Some(Interfaces::All(all)) => all,
            Some(Interfaces::Joints(map)) => map.get(joint).map_or("effort", String::as_str),
        };
        let number = |values: &Option<PerJoint>| values.as_ref().and_then(|values| values.of(dof, joint));
        match interface {
            "effort" => Ok(Sent::Force),
            "position" => Ok(Sent::Position),
            "velocity" => Ok(Sent::Velocity),
            "pd" => {
                let damping = number(&self.damping).unwrap_or(0.0);
                Ok(number(&self.stiffness)
                    .map_or(Sent::Force, |stiffness| Sent::Target { stiffness, damping }))
            }
            other => Err(format!("joint '{joint}' is sent '{other}', which is not known here")),
        }
    }
}

impl Manifest {
    /// Entries of the action in the order of the controllable joints.
    fn actions(&self, controllable: &[usize], sent: &[Sent]) -> Result<Vec<Action>, String> {
        let motors = controllable.iter().map(|&dof| {
            let joint = self.robot.joints().nth(dof).map_or("", |j| &j.name);
            self.robot
                .motors
                .iter()
                .find(|m| m.joint == joint)
                .ok_or_else(|| format!("joint '{joint}' has no motor"))
        });
        let motors = motors.collect::<Result<Vec<_>, _>>()?;
        let action = |(dof, motor): (&usize, &&crate::robot::Motor)| {
            let place = motors.iter().filter(|other| other.order < motor.order).count();
            let range = [self.action_lower.get(place), self.action_upper.get(place)]
                .map(|end| end.copied().unwrap_or(f64::NAN));
            Action {
                dof: *dof,
                place,
                sent: sent[*dof],
                gear: motor.gear,
                gain: motor.gain,
                bias: motor.bias[0],
                friction: self.robot.joints().nth(*dof).map_or(0.0, |joint| joint.friction),
                strength: self
                    .robot
                    .joints()
                    .nth(*dof)
                    .filter(|joint| joint.drive_damping > 0.0)
                    .map_or(f64::INFINITY, |joint| self.robot.usable(joint)),
                range,
            }
        };
        Ok(controllable.iter().zip(&motors).map(action).collect())
    }
}
