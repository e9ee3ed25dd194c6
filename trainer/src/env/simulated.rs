//! A task from its rules: everything the tasks of this folder have in common.

use rand_chacha::ChaCha8Rng;

use super::rules::{Robot, Rules};
use super::{Counters, Env, EnvError, Fault, Moment, Spec, Step};
use crate::mj::{JointKind, MjError, ModelFormat, Sim};

/// A robot, its simulation and a task's rules.
pub(super) struct Simulated<R> {
    spec: Spec,
    robot: Robot,
    rules: R,
    sim: Sim,
    /// A control period ahead of `sim`, and the action that led there.
    ahead: Option<Sim>,
    foreseen: Vec<f64>,
    start: (Vec<f64>, Vec<f64>),
    /// Velocity that the last step ended with; empty where nothing changed it since.
    ended: Vec<f64>,
    counters: Counters,
    last_error: Option<MjError>,
}

impl<R: Rules> Simulated<R> {
    /// Boxes a task whose robot was compiled into `sim`.
    pub(super) fn boxed(spec: Spec, robot: Robot, rules: R, sim: Sim) -> Box<dyn Env> {
        let (start, nv) = ((vec![0.0; spec.nq], vec![0.0; spec.nv]), spec.nv);
        Box::new(Simulated {
            spec,
            robot,
            rules,
            sim,
            ahead: None,
            foreseen: Vec::new(),
            start,
            ended: Vec::with_capacity(nv),
            counters: Counters::default(),
            last_error: None,
        })
    }

    fn physics(&self) -> impl Fn(MjError) -> EnvError + use<R> {
        let task = self.spec.name.clone();
        move |source| EnvError::Physics { task: task.clone(), source }
    }

    fn faulty(&mut self, fault: Fault) -> Step {
        self.counters.faults += 1;
        Step { reward: 0.0, cost: 0.0, terminated: true, fault }
    }

    /// Configuration and velocity in MuJoCo's convention; as they are where their lengths are wrong.
    fn to_mujoco(&self, q: &[f64], v: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let (mut qpos, mut qvel) = (q.to_vec(), v.to_vec());
        if (qpos.len(), qvel.len()) == (self.spec.nq, self.spec.nv) {
            for joint in &self.spec.joints {
                match joint.kind {
                    JointKind::Slide | JointKind::Hinge => {}
                    JointKind::Ball => qpos[joint.idx_q..][..4].rotate_right(1),
                    JointKind::Free => {
                        let quaternion = &mut qpos[joint.idx_q + 3..][..4];
                        to_world(quaternion, &mut qvel[joint.idx_v..][..3]);
                        quaternion.rotate_right(1);
                    }
                }
            }
        }
        (qpos, qvel)
    }

    /// Puts the robot where a plant said it was.
    fn place(&mut self, at: &Moment<'_>) -> Result<(), EnvError> {
        let (qpos, qvel) = self.to_mujoco(at.q, at.v);
        self.foreseen.clear();
        self.sim.set_state(&qpos, &qvel).map_err(self.physics())?;
        self.sim.set_time(at.time);
        let (place, goal) = (self.rules.goal_in_observation(), self.rules.goal_mut());
        if let Some(seen) = at.obs.get(place).filter(|seen| seen.len() == goal.len()) {
            goal.copy_from_slice(seen);
        }
        Ok(())
    }

    fn simulate(&mut self, action: &[f64]) -> Result<(), MjError> {
        let same = |(a, b): (&f64, &f64)| a.to_bits() == b.to_bits();
        let is_foreseen = self.foreseen.len() == action.len() && self.foreseen.iter().zip(action).all(same);
        self.foreseen.clear();
        match self.ahead.as_mut().filter(|_| is_foreseen) {
            Some(ahead) => std::mem::swap(&mut self.sim, ahead),
            None => {
                self.rules.actuate(&self.spec, &mut self.sim, action);
                self.sim.step(self.spec.sub_steps)?;
            }
        }
        self.rules.finish(&mut self.sim)
    }

    /// A control period under `action` from the present state, in [`Simulated::ahead`].
    fn look_ahead(&mut self, action: &[f64]) -> Result<(), MjError> {
        let ahead = copied(&mut self.ahead, &self.sim)?;
        self.rules.actuate(&self.spec, ahead, action);
        ahead.step(self.spec.sub_steps)
    }
}

impl<R: Rules> Env for Simulated<R> {
    fn spec(&self) -> &Spec {
        &self.spec
    }

    fn reset(&mut self, rng: &mut ChaCha8Rng) -> Result<(), EnvError> {
        self.foreseen.clear();
        let (qpos, qvel) = &mut self.start;
        qpos.copy_from_slice(self.sim.model().qpos0());
        qvel.fill(0.0);
        let started = self.rules.start(rng, &mut self.sim, qpos, qvel);
        let set = started
            .and_then(|()| self.rules.prepare(&mut self.sim))
            .and_then(|()| self.sim.set_state(qpos, qvel));
        self.rules.began(&self.sim);
        set.map_err(|e| match e {
            MjError::NotFinite { what, index, value } => EnvError::Task {
                origin: format!("task '{}'", self.spec.name),
                key: "reset".into(),
                reason: format!(
                    "{what}[{index}] came out as {value}; look for a logarithm, root or quotient that leaves its domain for some draws"
                ),
            },
            other => self.physics()(other),
        })
    }

    fn set_state(&mut self, qpos: &[f64], qvel: &[f64]) -> Result<(), EnvError> {
        self.foreseen.clear();
        let set = self.rules.prepare(&mut self.sim).and_then(|()| self.sim.set_state(qpos, qvel));
        self.rules.began(&self.sim);
        set.map_err(self.physics())
    }

    fn set_time(&mut self, time: f64) {
        self.foreseen.clear();
        self.sim.set_time(time);
    }

    fn step(&mut self, action: &[f64]) -> Step {
        assert_eq!(action.len(), self.spec.n_act(), "the action of '{}' has another length", self.spec.name);
        if action.iter().any(|a| !a.is_finite()) {
            return self.faulty(Fault::Action);
        }
        self.counters.steps += 1;
        let outside = action.iter().zip(&self.spec.actuators).filter(|(a, of)| **a < of.low || **a > of.high);
        self.counters.saturations += outside.count() as u64;

        self.rules.begin(&self.sim);
        let before = self.rules.progress(&self.sim);
        if let Err(error) = self.simulate(action) {
            self.last_error = Some(error);
            return self.faulty(Fault::Engine);
        }
        if self.sim.take_unstable() {
            return self.faulty(Fault::Unstable);
        }
        self.rules.follow(&self.sim, action);
        let (reward, terminated) = self.rules.score(&self.spec, &self.sim, before, action);
        self.ended.clear();
        if self.rules.pushes() {
            self.ended.extend_from_slice(self.sim.qvel());
        }
        self.rules.advance(&mut self.sim);
        Step { reward, cost: 0.0, terminated, fault: Fault::None }
    }

    fn foresee(&mut self, action: &[f64], qpos: &mut [f64], qvel: &mut [f64]) -> bool {
        assert_eq!(action.len(), self.spec.n_act(), "the action of '{}' has another length", self.spec.name);
        self.foreseen.clear();
        if action.iter().any(|a| !a.is_finite()) || self.look_ahead(action).is_err() {
            return false;
        }
        let Some(ahead) = self.ahead.as_mut().filter(|ahead| !ahead.is_unstable()) else { return false };
        qpos.copy_from_slice(ahead.qpos());
        qvel.copy_from_slice(ahead.qvel());
        self.foreseen.extend_from_slice(action);
        true
    }

    fn motor_forces(
        &mut self,
        q: &[f64],
        v: &[f64],
        action: &[f64],
        force: &mut [f64],
    ) -> Result<(), EnvError> {
        assert_eq!(action.len(), self.spec.n_act(), "the action of '{}' has another length", self.spec.name);
        let (qpos, qvel) = self.to_mujoco(q, v);
        self.foreseen.clear();
        let failed = self.physics();
        let ahead = copied(&mut self.ahead, &self.sim).map_err(&failed)?;
        ahead.set_state(&qpos, &qvel).map_err(&failed)?;
        self.rules.actuate(&self.spec, ahead, action);
        ahead.forward().map_err(&failed)?;
        ahead.applied_force(force);
        Ok(())
    }

    fn score(&mut self, from: &Moment<'_>, to: &Moment<'_>, action: &[f64]) -> Result<Step, EnvError> {
        self.place(from)?;
        self.ended.clear();
        self.rules.begin(&self.sim);
        let before = self.rules.progress(&self.sim);
        self.place(to)?;
        self.rules.finish(&mut self.sim).map_err(self.physics())?;
        let (reward, terminated) = self.rules.score(&self.spec, &self.sim, before, action);
        Ok(Step { reward, cost: 0.0, terminated, fault: Fault::None })
    }

    fn observe(&self, obs: &mut [f64]) {
        self.rules.observe(&self.sim, obs);
    }

    fn state(&self, q: &mut [f64], v: &mut [f64]) {
        let measured = self.rules.measured();
        convert(&self.spec, measured.unwrap_or((self.sim.qpos(), self.sim.qvel())), q, v);
    }

    fn actual_state(&self, q: &mut [f64], v: &mut [f64]) {
        convert(&self.spec, (self.sim.qpos(), self.sim.qvel()), q, v);
    }

    fn is_disturbed(&self) -> bool {
        self.rules.changes_robot() || self.rules.pushes()
    }

    fn sim(&self) -> &Sim {
        &self.sim
    }

    fn ended(&self) -> &[f64] {
        if self.ended.is_empty() { self.sim.qvel() } else { &self.ended }
    }

    fn goal(&self) -> &[f64] {
        self.rules.goal()
    }

    fn set_goal(&mut self, goal: &[f64]) -> Result<(), EnvError> {
        let task = self.spec.name.clone();
        let kept = self.rules.goal_mut();
        if kept.len() != goal.len() || goal.is_empty() {
            return Err(EnvError::Goal { task, expected: kept.len(), got: goal.len() });
        }
        if let Some(index) = goal.iter().position(|g| !g.is_finite()) {
            let source = MjError::NotFinite { what: "goal", index, value: goal[index] };
            return Err(EnvError::Physics { task, source });
        }
        kept.copy_from_slice(goal);
        Ok(())
    }

    fn circumstances(&self) -> Vec<f64> {
        self.rules.circumstances()
    }

    fn set_circumstances(&mut self, circumstances: &[f64]) {
        self.rules.set_circumstances(circumstances);
    }

    fn start_curriculum(&mut self) {
        self.rules.start_curriculum();
    }

    fn privileged(&self, to: &mut [f64]) {
        self.rules.privileged(&self.sim, to);
    }

    fn notes(&self) -> &[f64] {
        self.rules.notes()
    }

    fn counters(&self) -> Counters {
        self.counters
    }

    fn last_error(&self) -> Option<&MjError> {
        self.last_error.as_ref()
    }

    fn model_text(&self) -> &str {
        &self.robot.text
    }

    fn model_format(&self) -> ModelFormat {
        self.robot.format
    }

    fn another(&self) -> Result<Box<dyn Env>, EnvError> {
        let make = if self.rules.changes_robot() { Sim::apart } else { Sim::new };
        let sim = make(self.sim.model()).map_err(self.physics())?;
        Ok(Simulated::boxed(self.spec.clone(), self.robot.clone(), self.rules.clone(), sim))
    }
}

/// `place`, made where there is none, as a copy of `sim`.
fn copied<'a>(place: &'a mut Option<Sim>, sim: &Sim) -> Result<&'a mut Sim, MjError> {
    let copy = match place {
        Some(copy) => copy,
        none => none.insert(Sim::new(sim.model())?),
    };
    copy.copy_from(sim)?;
    Ok(copy)
}

/// Writes a state of MuJoCo's convention as one of Pinocchio's.
pub(crate) fn convert(spec: &Spec, (qpos, qvel): (&[f64], &[f64]), q: &mut [f64], v: &mut [f64]) {
    q.copy_from_slice(qpos);
    v.copy_from_slice(qvel);
    for joint in &spec.joints {
        match joint.kind {
            JointKind::Slide | JointKind::Hinge => {}
            JointKind::Ball => rotate_left(&mut q[joint.idx_q..][..4]),
            JointKind::Free => {
                let quaternion = &mut q[joint.idx_q + 3..][..4];
                rotate_left(quaternion);
                to_body(quaternion, &mut v[joint.idx_v..][..3]);
            }
        }
    }
}

/// `w x y z` (of any length) to `x y z w` (of length one).
fn rotate_left(quaternion: &mut [f64]) {
    quaternion.rotate_left(1);
    let length = quaternion.iter().map(|c| c * c).sum::<f64>().sqrt();
    quaternion.iter_mut().for_each(|c| *c /= length);
}

/// `v <- R' v` for the rotation `R` (body to world) of the unit quaternion `x y z w`.
fn to_body(quaternion: &[f64], v: &mut [f64]) {
    rotate([-quaternion[0], -quaternion[1], -quaternion[2]], quaternion[3], v);
}

/// `v <- R v`, the inverse of [`to_body`].
fn to_world(quaternion: &[f64], v: &mut [f64]) {
    rotate([quaternion[0], quaternion[1], quaternion[2]], quaternion[3], v);
}

/// `v <- v + 2 w (u x v) + 2 u x (u x v)`.
fn rotate(u: [f64; 3], w: f64, v: &mut [f64]) {
    let cross = |a: [f64; 3], b: [f64; 3]| {
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    };
    let uv = cross(u, [v[0], v[1], v[2]]);
    let uuv = cross(u, uv);
    for i in 0..3 {
        v[i] += 2.0 * (uuv[i] + w * uv[i]);
    }
}
