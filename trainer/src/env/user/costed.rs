//! A task with a cost beside its reward.

use rand_chacha::ChaCha8Rng;

use super::quantity::{Before, Outcome};
use super::settings::Term;
use crate::env::{Counters, Env, EnvError, Fault, Moment, Spec, Step};
use crate::mj::{MjError, ModelFormat, Sim};

/// Another environment, counting what the task file's `[cost]` says. Body positions are as that environment evaluates them.
pub(super) struct Costed {
    inner: Box<dyn Env>,
    spec: Spec,
    cost: Vec<Term>,
    before: Before,
}

impl Costed {
    pub(super) fn new(inner: Box<dyn Env>, name: String, cost: Vec<Term>) -> Costed {
        let before = Before::new(inner.sim().model());
        Costed { spec: Spec { name, has_cost: true, ..inner.spec().clone() }, before, inner, cost }
    }
}

impl Costed {
    fn with_cost(&self, step: Step, action: &[f64]) -> Step {
        let (sim, v) = (self.inner.sim(), self.inner.ended());
        let outcome = Outcome { sim, v, before: &self.before, action, dt: self.spec.dt, course: None };
        let cost = self.cost.iter().map(|t| t.weight * t.of.value(|q| outcome.read(q))).sum();
        Step { cost, ..step }
    }
}

impl Env for Costed {
    fn spec(&self) -> &Spec {
        &self.spec
    }

    fn reset(&mut self, rng: &mut ChaCha8Rng) -> Result<(), EnvError> {
        self.inner.reset(rng)
    }

    fn set_state(&mut self, qpos: &[f64], qvel: &[f64]) -> Result<(), EnvError> {
        self.inner.set_state(qpos, qvel)
    }

    fn set_time(&mut self, time: f64) {
        self.inner.set_time(time);
    }

    fn step(&mut self, action: &[f64]) -> Step {
        self.before.remember(self.inner.sim());
        let step = self.inner.step(action);
        if step.fault != Fault::None {
            return step;
        }
        self.with_cost(step, action)
    }

    fn foresee(&mut self, action: &[f64], qpos: &mut [f64], qvel: &mut [f64]) -> bool {
        self.inner.foresee(action, qpos, qvel)
    }

    fn motor_forces(
        &mut self,
        q: &[f64],
        v: &[f64],
        action: &[f64],
        force: &mut [f64],
    ) -> Result<(), EnvError> {
        self.inner.motor_forces(q, v, action, force)
    }

    fn score(&mut self, from: &Moment<'_>, to: &Moment<'_>, action: &[f64]) -> Result<Step, EnvError> {
        // The state before is scored on its own first, so that what it began with can be remembered.
        self.inner.score(from, from, action)?;
        self.before.remember(self.inner.sim());
        let step = self.inner.score(from, to, action)?;
        Ok(self.with_cost(step, action))
    }

    fn observe(&self, obs: &mut [f64]) {
        self.inner.observe(obs);
    }

    fn state(&self, q: &mut [f64], v: &mut [f64]) {
        self.inner.state(q, v);
    }

    fn actual_state(&self, q: &mut [f64], v: &mut [f64]) {
        self.inner.actual_state(q, v);
    }

    fn is_disturbed(&self) -> bool {
        self.inner.is_disturbed()
    }

    fn sim(&self) -> &Sim {
        self.inner.sim()
    }

    fn ended(&self) -> &[f64] {
        self.inner.ended()
    }

    fn goal(&self) -> &[f64] {
        self.inner.goal()
    }

    fn set_goal(&mut self, goal: &[f64]) -> Result<(), EnvError> {
        self.inner.set_goal(goal)
    }

    fn circumstances(&self) -> Vec<f64> {
        self.inner.circumstances()
    }

    fn set_circumstances(&mut self, circumstances: &[f64]) {
        self.inner.set_circumstances(circumstances);
    }

    fn start_curriculum(&mut self) {
        self.inner.start_curriculum();
    }

    fn privileged(&self, to: &mut [f64]) {
        self.inner.privileged(to);
    }

    fn notes(&self) -> &[f64] {
        self.inner.notes()
    }

    fn counters(&self) -> Counters {
        self.inner.counters()
    }

    fn last_error(&self) -> Option<&MjError> {
        self.inner.last_error()
    }

    fn model_text(&self) -> &str {
        self.inner.model_text()
    }

    fn model_format(&self) -> ModelFormat {
        self.inner.model_format()
    }

    fn another(&self) -> Result<Box<dyn Env>, EnvError> {
        let inner = self.inner.another()?;
        Ok(Box::new(Costed::new(inner, self.spec.name.clone(), self.cost.clone())))
    }
}
