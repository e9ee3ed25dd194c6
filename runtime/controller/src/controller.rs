//! The controller: the page to read.
//!
//! ```text
//! state -> propose -> project -> inverse dynamics -> action
//! ```
//!
//! An action that comes out of a network takes the same way once more where the task asks for it (`[constraints] guard = true`): it proposes the
//! state that it leads to.
//!
//! Where the task asks for a share of ticks that may end outside (`[constraints] reached`), the state of each tick says what the tick before led
//! to, and the action is bounded as limits come near (`controller/dial.rs`).
//!
//! Where the physics steps of a period do not lead to a target (a position limit holds a joint back), and limits of several joints could be broken
//! for that, the tick is projected once more for the robot whose joints come no further ([`Projector::project_within`]).
//!
//! What it remembers from tick to tick is in `controller/memory.rs`, what it tells of itself in `controller/facts.rs`.
//!
//! Training, evaluation, the real-time loop and replay all call [`Controller::update`]. Noise is an
//! input: zero on the robot. Nothing is allocated after [`Controller::new`] but Clarabel's one block.

mod dial;
mod drive_box;
mod facts;
mod foreign;
mod given;
mod guard;
mod maths;
mod memory;
mod noise;
mod parts;

pub use dial::{Margin, merge_margins};
pub use drive_box::force_left;
pub use parts::{Parts, held_dofs, seen_entries, target_ranges};

use crate::idm::{AnalyticIdm, LearnedIdm};
use crate::net::{Activation, Forward, Function};
use crate::normaliser::Normaliser;
use crate::snapshot::{Networks, PolicyKind, Snapshot, SnapshotError};
use crate::task::IdmKind;
use dial::Dial;
use drive_box::DriveBox;
use foreign::Foreign;
use given::Given;
use guard::Guard;
use maths::{hermite, sample};
use nearl_constraints::{
    ActionLimit, ActionReport, Bounds, Entry, Ledger, Model, Projector, Proposal, RefuseReason, StateLayout,
    Status, Target,
};
pub(crate) use parts::idx_q;
use parts::{check_sizes, halves};
use std::time::Instant;

/// What is measured at the start of a tick.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct State {
    /// Configuration (nq).
    pub q: Vec<f64>,
    /// Velocity (nv).
    pub v: Vec<f64>,
    /// Observation (n_obs).
    pub obs: Vec<f64>,
}

/// Standard normal numbers of the tick; zero for deterministic behaviour.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Noise {
    /// Noise of a stochastic proposal (n_state).
    pub proposal: Vec<f32>,
    /// Noise of the action (n_act).
    pub action: Vec<f32>,
}

/// Everything a tick produced: what the rollout buffer stores, the log records and the link sends.
#[derive(Clone, Debug)]
pub struct Output {
    /// Network input (n_obs, or as many as `[policy] observation` has).
    pub x: Vec<f32>,
    /// Proposed normalised change (n_state), as sampled.
    pub change: Vec<f32>,
    /// Proposed state at the end of the policy period (n_state).
    pub proposal: Vec<f64>,
    /// Projected state at the end of the tick (n_state).
    pub target: Vec<f64>,
    /// Projected normalised change (n_state).
    pub target_change: Vec<f32>,
    /// Lowest and highest normalised change the projection lets through (n_state); infinite where free.
    pub lower: Vec<f32>,
    /// See `lower`.
    pub upper: Vec<f32>,
    /// Action before the actuators' range (n_act).
    pub sampled: Vec<f32>,
    /// Action (n_act), always finite and within the actuators' range.
    pub action: Vec<f64>,
    /// log pi(proposal | s); 0 for a deterministic policy.
    pub log_prob_proposal: f64,
    /// log I(a | s_c, s'_c), or log pi(a | s) for a direct policy; 0 for analytic inverse dynamics.
    pub log_prob_action: f64,
    /// Projected configuration and velocity with the ledger of the tick.
    pub next: Target,
    /// Whether the policy ran in this tick.
    pub policy_tick: bool,
    /// Duration of the update in \[ns\].
    pub duration_ns: u64,
}

enum Inverse {
    /// A direct policy has no inverse model: its output is the mean action.
    Direct,
    Learned(Box<LearnedIdm>),
    Analytic(Box<AnalyticIdm>),
}

/// How far a joint is outside a limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Excess {
    /// Degree of freedom.
    pub dof: usize,
    /// Distance from the limit [rad or m, per s for a velocity].
    pub by: f64,
}

impl Excess {
    /// The larger of two.
    pub fn larger(a: Option<Excess>, b: Option<Excess>) -> Option<Excess> {
        match (a, b) {
            (Some(a), Some(b)) if b.by <= a.by => Some(a),
            (a, b) => b.or(a),
        }
    }
}

/// The half of a joint's state that is proposed alone.
#[derive(Clone, Copy)]
enum Half {
    Position,
    Velocity,
}

/// Propose, project, invert.
pub struct Controller {
    model: Model,
    layout: StateLayout,
    kind: PolicyKind,
    activation: Activation,
    functions: Vec<Function>,
    normaliser: Normaliser,
    foreign: Foreign,
    policy: Forward,
    policy_log_std: Vec<f32>,
    action_log_std: Vec<f32>,
    projector: Projector,
    inverse: Inverse,
    guard: Option<Guard>,
    dial: Option<Dial>,
    drive_box: Option<DriveBox>,
    action_limit: Option<ActionLimit>,
    action_range: Vec<(f64, f64)>,
    dt: f64,
    policy_every: usize,
    projection: bool,
    /// Configuration index of each one-dof joint, by degree of freedom.
    idx_q: Vec<usize>,
    halves: Vec<(usize, Half)>,
    tick: usize,
    /// Tick in which the first policy period of this rhythm began.
    begun: usize,
    given: Given,
    /// Ticks of the episode before `tick` counted from 0: those of the controller that this one took over from.
    earlier: usize,
    version: u64,
    /// How long each part of its memory is.
    remembered: memory::Lengths,
    mean: Vec<f32>,
    held: State,
    goal: Proposal,
    proposal: Proposal,
    start: State,
}

impl Controller {
    /// Builds and validates everything: robot, layout, limits, networks, and one canary inference.
    ///
    /// # Errors
    /// [`SnapshotError`] with the sentence of the layer that refused.
    pub fn new(snapshot: &Snapshot) -> Result<Self, SnapshotError> {
        let Parts { model, layout, projector } = Parts::new(&snapshot.manifest)?;
        let (m, n) = (&snapshot.manifest, &snapshot.networks);
        let n_act = m.action_lower.len();
        let kind = m.policy;
        let foreign = Foreign::new(m, &model, &layout)?;
        check_sizes(m, n, &layout, foreign.n_seen(&layout))?;
        let (inverse, action_log_std) = match (kind, m.task.idm.kind, &n.idm) {
            (PolicyKind::Direct, ..) => (Inverse::Direct, n.policy_log_std.clone()),
            (_, IdmKind::Pinocchio, _) => {
                let idm = AnalyticIdm::new(m, &model, layout.controllable())?;
                (Inverse::Analytic(Box::new(idm)), vec![0.0; n_act])
            }
            (_, IdmKind::Learned, Some((net, log_std))) => {
                let seen = seen_entries(m, &layout)?;
                let net = Forward::new(net, m.activation);
                (Inverse::Learned(Box::new(LearnedIdm::new(net, &layout, &seen))), log_std.clone())
            }
            (_, IdmKind::Learned, None) => {
                return Err(SnapshotError::MissingTensor { name: "idm.0.weight".into() });
            }
        };
        let guard = if m.guards() { Some(Guard::new(m, &model, &layout)?) } else { None };
        let bounds = m.bounds_drives();
        let drive_box = bounds.then(|| DriveBox::new(m, &model, layout.controllable(), &projector));
        let drive_box = drive_box.transpose()?;
        let action_limit = Parts::action_limit(m, &model, layout.controllable())?;
        let idx_q = idx_q(&model);
        let dial = Dial::new(m, &model, layout.controllable(), &idx_q, projector.limits())?;
        let zero = |n| vec![0.0; n];
        let rest = State { q: model.neutral(), v: zero(model.nv()), obs: zero(layout.n_obs()) };
        let proposal = Proposal { q: model.neutral(), v: zero(model.nv()) };
        let mut controller = Self {
            kind,
            activation: m.activation,
            normaliser: n.normaliser.clone(),
            foreign,
            policy: Forward::layered(&n.policy, m.policy_functions(n.policy.layers.len())),
            functions: m.policy_functions(n.policy.layers.len()),
            policy_log_std: n.policy_log_std.clone(),
            action_log_std,
            projector,
            inverse,
            guard,
            dial,
            drive_box,
            action_limit,
            action_range: m.action_lower.iter().copied().zip(m.action_upper.iter().copied()).collect(),
            dt: m.task.time.dt,
            policy_every: m.task.time.policy_every,
            projection: true,
            idx_q,
            halves: halves(&layout),
            tick: 0,
            begun: 0,
            given: Given::new(if kind == PolicyKind::Direct { n_act } else { layout.n_state() }),
            earlier: 0,
            version: m.version,
            remembered: memory::Lengths::default(),
            mean: vec![0.0; layout.n_state().max(n_act)],
            held: rest.clone(),
            goal: proposal.clone(),
            proposal,
            start: rest,
            layout,
            model,
        };
        controller.remembered = controller.lengths();
        controller.canary()?;
        controller.bring_margins(&n.margins)?;
        Ok(controller)
    }

    /// One control tick. The same state, noise and history of ticks since [`Controller::reset`] give the same bits; with
    /// `[constraints] reached` the history since [`Controller::new`] does, as no episode ends what was learned.
    ///
    /// A state that is not finite is replaced by the last finite one and reported as such: the action is then what that one asked for,
    /// and no longer right once the robot has moved on. The real-time loop of `nearl-runtime` bridges a few such ticks and then brakes; so should a loop
    /// of your own. A state of another robot's size is refused, and the action stays as it was.
    pub fn update(&mut self, state: &State, noise: &Noise, out: &mut Output) -> Status {
        let begin = Instant::now();
        let sizes = |s: &State| [s.q.len(), s.v.len(), s.obs.len()];
        if sizes(state) != sizes(&self.held) {
            out.next.ledger.status = Status::Refused(RefuseReason::WrongLength);
            return out.next.ledger.status;
        }
        let held = self.hold_last_finite(state);
        self.learn(held);
        self.depart();
        self.propose(noise, out);
        self.project(out);
        self.invert(noise, out);
        self.bound(out);
        self.guard(out);
        self.limit_action(out);
        self.tick += 1;
        out.duration_ns = begin.elapsed().as_nanos() as u64;
        if held {
            out.next.ledger.status = Status::Refused(RefuseReason::NonFiniteState);
        }
        out.next.ledger.status
    }

    /// Copies the state in; a state with NaN or infinity is not, and the last finite one stays.
    fn hold_last_finite(&mut self, state: &State) -> bool {
        let finite = |x: &[f64]| x.iter().all(|v| v.is_finite());
        if !(finite(&state.q) && finite(&state.v) && finite(&state.obs)) {
            return true;
        }
        self.held.q.copy_from_slice(&state.q);
        self.held.v.copy_from_slice(&state.v);
        self.held.obs.copy_from_slice(&state.obs);
        false
    }

    /// Joints that follow by themselves what they are sent go on from there: see [`Projector::depart`]. The observation stays what is measured.
    fn depart(&mut self) {
        let last = self.guard.as_mut().map_or(&mut self.projector, |guard| &mut guard.projector);
        last.depart(&mut self.held.q, &mut self.held.v);
    }

    /// The policy's next state: `proposal_k = s_k + scale_k u_k`, with `u = pi(x) (+ sigma noise)`.
    fn propose(&mut self, noise: &Noise, out: &mut Output) {
        if self.given.is_new() {
            self.begun = self.tick;
        }
        out.policy_tick = self.begins_period();
        if !out.policy_tick {
            return;
        }
        let time = self.time();
        self.foreign.see(&self.held, time, &self.normaliser, &mut out.x);
        if self.given.is_set() {
            self.propose_given(out);
            return;
        }
        let mean = self.policy.forward(&out.x);
        self.mean[..mean.len()].copy_from_slice(mean);
        out.log_prob_proposal = 0.0;
        if self.kind == PolicyKind::Direct {
            self.command(noise, out);
            return;
        }
        let n = self.layout.n_state();
        out.change.copy_from_slice(&self.mean[..n]);
        if self.kind == PolicyKind::Stochastic {
            out.log_prob_proposal =
                sample(&self.mean[..n], &self.policy_log_std, &noise.proposal, &mut out.change);
        }
        for k in 0..n {
            let (s, scale) = (self.held.obs[self.layout.state()[k]], self.normaliser.scale[k]);
            let put_out = scale * f64::from(out.change[k]);
            if self.kind == PolicyKind::State {
                (out.proposal[k], out.change[k]) = (put_out, ((put_out - s) / scale) as f32);
            } else {
                out.proposal[k] = s + put_out;
            }
        }
        self.set_goal(out);
    }

    /// The commands of a policy of actions whose outputs stand for them: exploration is in the outputs, and the policy sees what it did.
    fn command(&mut self, noise: &Noise, out: &mut Output) {
        if !self.foreign.has_map() {
            return;
        }
        let n = self.action_range.len();
        out.log_prob_action = sample(&self.mean[..n], &self.action_log_std, &noise.action, &mut out.sampled);
        self.mean[..n].copy_from_slice(&out.sampled);
        self.foreign.command(&mut self.mean[..n]);
    }

    /// Scatters the proposed entries into configuration and velocity. Of a controllable joint with one half proposed the
    /// other follows at constant acceleration: `q' = q + T (v + v') / 2`. Whatever else is not proposed stays.
    fn set_goal(&mut self, out: &Output) {
        self.start.q.copy_from_slice(&self.held.q);
        self.start.v.copy_from_slice(&self.held.v);
        self.goal.q.copy_from_slice(&self.held.q);
        self.goal.v.copy_from_slice(&self.held.v);
        for k in 0..self.layout.n_state() {
            match self.layout.state_entry(k) {
                Entry::Position { idx_q, .. } => self.goal.q[idx_q] = out.proposal[k],
                Entry::Velocity { dof } => self.goal.v[dof] = out.proposal[k],
                Entry::Other => {}
            }
        }
        let period = self.policy_every as f64 * self.dt;
        for &(dof, half) in &self.halves {
            let (iq, v) = (self.idx_q[dof], self.start.v[dof]);
            match half {
                Half::Velocity => self.goal.q[iq] = self.start.q[iq] + 0.5 * period * (v + self.goal.v[dof]),
                Half::Position => self.goal.v[dof] = 2.0 * (self.goal.q[iq] - self.start.q[iq]) / period - v,
            }
        }
    }

    /// The nearest state that every hard constraint allows at the end of this tick.
    fn project(&mut self, out: &mut Output) {
        if self.kind == PolicyKind::Direct {
            out.next.ledger.status = Status::Unchanged;
            return;
        }
        if self.guard.is_some() {
            self.projector.forget(); // the guard remembers the tick before: it has the last word
        }
        self.interpolate();
        self.projector.project(&self.held.q, &self.held.v, &self.proposal, &mut out.next);
        if !self.projection {
            self.projector.pass(&self.held.q, &self.held.v, &self.proposal, &mut out.next);
        }
        if !matches!(self.inverse, Inverse::Analytic(_)) {
            self.conclude(out);
        }
    }

    /// The target is what it stays.
    fn conclude(&mut self, out: &mut Output) {
        if self.projector.needs_previous() {
            self.projector.remember(&out.next);
        }
        self.report(self.projector.bounds(), out);
    }

    /// Writes the target, and what the projection lets through, entry by entry.
    fn report(&self, bounds: &Bounds, out: &mut Output) {
        for k in 0..self.layout.n_state() {
            let s = self.held.obs[self.layout.state()[k]];
            let scale = self.normaliser.scale[k];
            let (target, lower, upper) = match self.layout.state_entry(k) {
                Entry::Position { idx_q, dof } => {
                    (out.next.q[idx_q], bounds.q_lower[dof], bounds.q_upper[dof])
                }
                Entry::Velocity { dof } => (out.next.v[dof], bounds.v_lower[dof], bounds.v_upper[dof]),
                Entry::Other => (out.proposal[k], f64::NEG_INFINITY, f64::INFINITY),
            };
            out.target[k] = target;
            out.target_change[k] = ((target - s) / scale) as f32;
            (out.lower[k], out.upper[k]) = match self.projection {
                true => (((lower - s) / scale) as f32, ((upper - s) / scale) as f32),
                false => (f32::NEG_INFINITY, f32::INFINITY),
            };
        }
    }

    /// Where the proposal wants the robot at the end of this tick: on the cubic from the state at the
    /// policy tick to the proposed state, `tick % policy_every + 1` control periods along.
    fn interpolate(&mut self) {
        let k = self.policy_every;
        let j = (self.tick - self.begun) % k + 1;
        if j == k {
            self.proposal.q.copy_from_slice(&self.goal.q);
            self.proposal.v.copy_from_slice(&self.goal.v);
            return;
        }
        let (s, period) = (j as f64 / k as f64, k as f64 * self.dt);
        self.proposal.q.copy_from_slice(&self.held.q);
        self.proposal.v.copy_from_slice(&self.held.v);
        for &dof in self.layout.controllable() {
            let idx_q = self.idx_q[dof];
            let (q0, q1) = (self.start.q[idx_q], self.goal.q[idx_q]);
            let (v0, v1) = (self.start.v[dof] * period, self.goal.v[dof] * period);
            (self.proposal.q[idx_q], self.proposal.v[dof]) = {
                let (q, v) = hermite(s, q0, v0, q1, v1);
                (q, v / period)
            };
        }
    }

    /// The action that takes the robot to the target.
    fn invert(&mut self, noise: &Noise, out: &mut Output) {
        let n = out.action.len();
        match &mut self.inverse {
            Inverse::Direct if self.foreign.has_map() => {}
            Inverse::Direct => {
                out.log_prob_action =
                    sample(&self.mean[..n], &self.action_log_std, &noise.action, &mut out.sampled);
            }
            Inverse::Learned(idm) => {
                let mean = idm.mean(&out.x, &out.target_change);
                out.log_prob_action = sample(mean, &self.action_log_std, &noise.action, &mut out.sampled);
            }
            Inverse::Analytic(idm) => {
                out.log_prob_action = 0.0;
                let (q, v, next) = (&self.held.q, &self.held.v, &mut out.next);
                match self.projection && self.guard.is_none() {
                    true => idm.lead((q, v), &self.proposal, &mut self.projector, next, &mut out.action),
                    false => idm.action(q, v, next, self.projector.limits_of_tick(), &mut out.action),
                }
                self.conclude(out);
            }
        }
        let given = if self.foreign.has_map() { &self.mean[..n] } else { &out.sampled[..] };
        for (i, (a, &(lower, upper))) in out.action.iter_mut().zip(&self.action_range).enumerate() {
            if !matches!(self.inverse, Inverse::Analytic(_)) {
                *a = f64::from(given[i]);
            }
            *a = if a.is_finite() { a.clamp(lower, upper) } else { 0.0 };
        }
    }

    /// What the last tick led to, for the share of ticks that may end outside.
    fn learn(&mut self, held: bool) {
        let Some(dial) = self.dial.as_mut().filter(|_| self.projection) else { return };
        if held {
            dial.interrupt();
        }
        dial.learn(&self.held.q);
    }

    /// Bounds what motors do where a position limit comes near, by the margins learned so far.
    fn bound(&mut self, out: &mut Output) {
        let Some(dial) = self.dial.as_mut().filter(|_| self.projection) else { return };
        let proposed = (self.kind != PolicyKind::Direct).then_some(&self.proposal.q[..]);
        dial.bound(&self.held.q, &self.held.v, proposed, &mut out.action);
    }

    /// The action of the nearest allowed state in place of one that leads elsewhere. Of a direct policy, where its action leads is what it
    /// proposes.
    fn guard(&mut self, out: &mut Output) {
        if let Some(drives) = &mut self.drive_box {
            let report = drives.update(&self.held.q, &self.held.v, &mut out.action, self.projection);
            self.count(report, &mut out.next.ledger);
        }
        let Some(guard) = &mut self.guard else { return };
        guard.update(&self.held.q, &self.held.v, &mut out.action, &mut out.next, self.projection);
        for (a, &(lower, upper)) in out.action.iter_mut().zip(&self.action_range) {
            *a = if a.is_finite() { a.clamp(lower, upper) } else { 0.0 };
        }
        if self.kind != PolicyKind::Direct {
            return;
        }
        for k in 0..self.layout.n_state() {
            out.proposal[k] = match self.layout.state_entry(k) {
                Entry::Position { idx_q, .. } => guard.proposal.q[idx_q],
                Entry::Velocity { dof } => guard.proposal.v[dof],
                Entry::Other => self.held.obs[self.layout.state()[k]],
            };
        }
        if let Some(guard) = &self.guard {
            self.report(guard.bounds(), out);
        }
    }

    /// The nearest action that the task's limits on actions allow.
    fn limit_action(&mut self, out: &mut Output) {
        let Some(limit) = &mut self.action_limit else { return };
        let report = limit.project(&self.held.v, &mut out.action, self.projection);
        self.count(report, &mut out.next.ledger);
    }

    /// Adds to the ledger what was done to the action. Of a direct policy, whose state nothing projects, the ledger says nothing else.
    fn count(&self, report: ActionReport, ledger: &mut Ledger) {
        if self.kind == PolicyKind::Direct {
            (ledger.raw_violations.other, ledger.target_violations.other, ledger.moved) = (0, 0, 0.0);
            ledger.status = if report.moved > 0.0 { Status::Clamped } else { Status::Unchanged };
        }
        ledger.raw_violations.other += report.raw_violations;
        ledger.target_violations.other += report.target_violations;
        ledger.moved += report.moved;
    }

    /// One inference at rest must give numbers.
    fn canary(&mut self) -> Result<(), SnapshotError> {
        let mut out = self.output();
        let (state, noise) = (self.held.clone(), self.noise());
        self.update(&state, &noise, &mut out);
        self.reset();
        let values =
            out.change.iter().chain(&out.sampled).map(|&x| f64::from(x)).chain(out.action.iter().copied());
        match values.enumerate().find(|(_, v)| !v.is_finite()) {
            Some((index, value)) => Err(SnapshotError::Canary { index, value }),
            None => Ok(()),
        }
    }

    /// Takes new networks of the same shapes, as the learner makes them, and the margins that come with them, if any do. Allocates; not for the loop.
    pub fn set_networks(&mut self, networks: &Networks) {
        self.normaliser = networks.normaliser.clone();
        self.policy = Forward::layered(&networks.policy, self.functions.clone());
        self.policy_log_std.clone_from(&networks.policy_log_std);
        match (&mut self.inverse, &networks.idm) {
            (Inverse::Learned(idm), Some((net, log_std))) => {
                idm.set_net(Forward::new(net, self.activation));
                self.action_log_std.clone_from(log_std);
            }
            (Inverse::Direct, _) => self.action_log_std.clone_from(&networks.policy_log_std),
            _ => {}
        }
        if let Some(dial) = &mut self.dial
            && networks.margins.len() == dial.learned_len()
        {
            dial.bring(&networks.margins);
        }
    }

    /// Switches the projection off (or on again): the raw proposal becomes the target. For comparisons only.
    pub fn set_projection(&mut self, on: bool) {
        self.projection = on;
    }
}
