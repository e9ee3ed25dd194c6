//! The projector: the nearest next state that every limit allows.
//!
//! [`Projector::project`] is the page to read; the stages it calls are in the files beside it.

mod active_set;
mod backup;
mod build;
mod choice;
mod conic;
mod coupled;
mod gradient;
mod keep;
mod kkt;
mod ladder;
mod modes;
mod moved;
mod nearer;
mod polish;
mod sent;
mod sources;
#[cfg(test)]
mod spoilt;
mod stages;
mod switch;

pub use coupled::{Problem, ProblemCone};
#[doc(hidden)]
pub use stages::{CoupledStages, Numbers};

use crate::checker::Checker;
use crate::jerk;
use crate::ledger::{BrakeReason, RefuseReason, Rung, Status};
use crate::row::Previous;
use crate::target::{Bounds, Braking, Consistency, Proposal, Settings, Target};
use crate::viability::{Dof, Interval, Kind, POSITION_TOLERANCE, Period, interval};
use crate::{Dynamics, LimitSet, Model, Recent};
use active_set::ActiveSet;
use backup::Backup;
use conic::Conic;
use coupled::Coupled;
use moved::Moving;
use nearer::Nearer;
use polish::Polish;
use sources::{Label, Sources};
use std::time::Instant;

/// No ends beside those of the box.
const FREE: [f64; 2] = [f64::NEG_INFINITY, f64::INFINITY];

/// Projects proposals for one robot at one control period.
///
/// With `T` the period, `y = v' - v` and `kappa` from [`Period`], the kinematic mode solves
///
/// ```text
///     min_y 1/2 |W (q (+) (T v + kappa T y) (-) q_hat) / (kappa T)|^2 + 1/2 |W (v + y - v_hat)|^2
///     s.t.  viability box of each dof,   lower <= G y <= upper,   |G_c y + c| <= radius
/// ```
///
/// with rows and cones from the limits (see [`row`](crate::row)), soft ones with a slack of their own,
///
/// and the free mode clamps `v'` to the box and `q'` to `q (+) [T v + kappa T lb, T v + kappa T ub]` cut with the
/// position limits. Dofs that are not controllable pass through; in rows and cones they are constants at the
/// velocity change they propose.
///
/// Nothing allocates after [`Projector::new`] but one small buffer inside each Clarabel solve. Given the same input, the
/// output has the same bits, whatever was projected before; what limits on jerk and torque rates know of the tick before, and
/// the brake that is stored, are inputs too, see [`Projector::set_previous`] and [`Projector::memory`].
pub struct Projector {
    model: Model,
    dynamics: Dynamics,
    limits: LimitSet,
    dofs: Dofs,
    settings: Settings,
    period: Period,
    /// `w_i^2` for each dof (nv).
    weight: Vec<f64>,
    /// Deceleration each dof brakes with (nv).
    braking: Vec<f64>,
    bounds: Bounds,
    intervals: Vec<Interval>,
    checker: Checker,
    coupled: Option<Stages>,
    /// What limits are moved to.
    moving: Moving,
    /// What a brake may count on: `limits`, or what is in force on the way to where they were moved.
    in_force: LimitSet,
    /// The limits one by one, to switch them on and off.
    switches: Vec<Switch>,
    /// Generalised forces beside the motors' (nv) [N·m or N].
    external: Vec<f64>,
    previous: History,
    /// Acceleration before this tick; where it is not known, 0 for what stands and what a brake would have had for what moves (nv).
    before: Vec<f64>,
    /// Between which accelerations each dof may be in this tick by its limit and its hard jerk (nv).
    accelerations: Vec<[f64; 2]>,
    backup: Backup,
    /// What looks odd about the limits.
    notes: Vec<String>,
    /// `q_hat (-) q` (nv).
    displacement: Vec<f64>,
    /// The measured state is outside what the dof's own limits allow (nv).
    outside: Vec<bool>,
    /// Unconstrained optimum of v' (nv).
    goal: Vec<f64>,
    /// Next velocity under construction (nv).
    v_next: Vec<f64>,
    /// The proposal's position and velocity belong together (nv).
    consistent: Vec<bool>,
    /// By how much more the proposal asks for than a dof that is to come back aims at [rad/s or m/s] (nv).
    pull: Vec<f64>,
    /// Free mode: position and velocity of the dof were clamped (nv).
    clamped: Vec<[bool; 2]>,
    /// Ends of the next velocities beside those of the box (nv).
    within: Vec<[f64; 2]>,
    /// Some hard row or cone is of what several joints do together.
    couples: bool,
    /// How the last tick ended.
    last: (Status, Rung),
    /// Scratch: velocities without denormal numbers (nv).
    normal: Vec<f64>,
    /// Scratch: a proposal without them.
    asked: Proposal,
    /// Velocities of the target that no brake was verified for (nv).
    v_wanted: Vec<f64>,
    /// Position, velocity and acceleration of the target that was found first.
    first: [Vec<f64>; 3],
    /// Velocities after a tick of the stored brake (nv).
    v_stop: Vec<f64>,
    tangent: Vec<f64>,
    integrated: Vec<f64>,
}

/// The dofs by role.
pub(crate) struct Dofs {
    /// Dofs the projector may move, ascending.
    pub(crate) controllable: Vec<usize>,
    /// The others.
    pub(crate) fixed: Vec<usize>,
    /// For each dof, the configuration entry of its joint when that has exactly one of each.
    pub(crate) single: Vec<Option<usize>>,
    /// Some joint has several dofs or a configuration on a circle: Pinocchio integrates.
    pub(crate) curved: bool,
}

/// The stages for coupled rows.
struct Stages {
    sources: Sources,
    /// Reports of rows, then cones.
    labels: Vec<Label>,
    problem: Coupled,
    active_set: ActiveSet,
    conic: Conic,
    polish: Polish,
    y: Vec<f64>,
    /// The last answer is the active-set stage's.
    exact: bool,
    /// The last answer of Clarabel is the optimum that Newton's method found near it.
    polished: bool,
    /// Bounds of soft rows (m) and radii of soft cones while they are left out.
    dropped: Vec<(f64, f64)>,
    nearer: Nearer,
    /// How what a target breaks changes with each dof (hard rows x n), and one of its rows (n).
    slopes: Vec<f64>,
    slope: Vec<f64>,
}

/// One limit, and whether it holds.
struct Switch {
    kind: &'static str,
    label: String,
    set: LimitSet,
    enabled: bool,
}

/// The last two ticks.
struct History {
    nv: usize,
    /// Accelerations (nv), then motor forces (nv), that they asked of the robot.
    asked: Recent,
    sent: sent::Sent,
}

impl History {
    fn none(nv: usize) -> History {
        History { nv, asked: Recent::new(2 * nv), sent: sent::Sent::default() }
    }

    fn get(&self) -> Option<Previous<'_>> {
        let (acceleration, torque) = self.asked.get()?.split_at(self.nv);
        Some(Previous { acceleration, torque })
    }

    /// Forgets both where the numbers are none: what limits on a change look back to is not known.
    fn push(&mut self, Previous { acceleration, torque }: Previous<'_>) {
        self.asked.push(acceleration.iter().chain(torque));
        if !(finite(acceleration) && finite(torque)) {
            self.asked.forget();
        }
    }
}

impl Projector {
    /// Projects `proposal` for the measured configuration `q` (nq) and velocity `v` (nv) into `target`.
    ///
    /// Every field of `target` is finite afterwards, whatever the input; only [`RefuseReason::WrongLength`] leaves it
    /// as it was.
    pub fn project(&mut self, q: &[f64], v: &[f64], proposal: &Proposal, target: &mut Target) -> Status {
        self.backup.mark();
        self.project_from_here(q, v, proposal, target)
    }

    /// Projects the same tick once more, for a robot whose joints come to no other velocities than those `within` (nv) [rad/s or m/s], as it has turned out
    /// after [`Projector::project`]: the nearest state of which that is true takes the place of one that is not. Where the box of a joint lies beyond its ends,
    /// it ends at the end of the box that is nearest to them.
    pub fn project_within(
        &mut self,
        (q, v): (&[f64], &[f64]),
        proposal: &Proposal,
        within: &[[f64; 2]],
        target: &mut Target,
    ) -> Status {
        if within.len() != self.within.len() {
            return Status::Refused(RefuseReason::WrongLength);
        }
        let (first_ns, raw) = (target.ledger.duration_ns, target.ledger.raw_violations);
        self.backup.go_back();
        self.within.copy_from_slice(within);
        let mut status = self.project_from_here(q, v, proposal, target);
        self.within.fill(FREE);
        target.ledger.duration_ns += first_ns;
        target.ledger.raw_violations = raw;
        if matches!(status, Status::Clamped | Status::Solved) {
            status = Status::Slowed;
        }
        (target.ledger.status, self.last.0) = (status, status);
        status
    }

    /// Projects the same tick once more, for a `proposal` that differs in dofs that are not controllable: they do otherwise than was thought in
    /// [`Projector::project`], as it has turned out after it. What the ledger says of the raw proposal stays.
    pub fn project_beside(
        &mut self,
        (q, v): (&[f64], &[f64]),
        proposal: &Proposal,
        target: &mut Target,
    ) -> Status {
        let (first_ns, raw) = (target.ledger.duration_ns, target.ledger.raw_violations);
        self.backup.go_back();
        let status = self.project_from_here(q, v, proposal, target);
        target.ledger.duration_ns += first_ns;
        target.ledger.raw_violations = raw;
        status
    }

    /// Whether a joint that comes to another velocity than its target's may break a hard limit of several joints, or its own of jerk in the next tick, which
    /// [`Projector::project_within`] is for. Not while limits are moved.
    pub fn needs_what_is_reached(&self) -> bool {
        (self.couples || self.limits.has_jerk()) && !self.moving.on
    }

    fn project_from_here(
        &mut self,
        q: &[f64],
        v: &[f64],
        proposal: &Proposal,
        target: &mut Target,
    ) -> Status {
        let start = Instant::now();
        target.ledger.reset();
        let mut normal = std::mem::take(&mut self.normal);
        let mut asked = std::mem::replace(&mut self.asked, Proposal { q: Vec::new(), v: Vec::new() });
        let v = without_denormals(v, &mut normal);
        let is_changed = self.previous.sent.waits() || proposal.v.iter().any(|x| x.is_subnormal());
        let status = match is_changed && self.lengths_fit(q, v, proposal, target) {
            true => {
                asked.q.clone_from(&proposal.q);
                asked.v.clone_from(&proposal.v);
                asked.v.iter_mut().filter(|x| x.is_subnormal()).for_each(|x| *x = 0.0);
                self.wait(q, v, &mut asked);
                self.ladder(start, (q, v), &asked, target)
            }
            false => self.ladder(start, (q, v), proposal, target),
        };
        (self.normal, self.asked) = (normal, asked);
        target.ledger.status = status;
        self.last = (status, target.ledger.rung);
        target.ledger.duration_ns = start.elapsed().as_nanos() as u64;
        status
    }

    fn ladder(
        &mut self,
        start: Instant,
        (q, v): (&[f64], &[f64]),
        proposal: &Proposal,
        target: &mut Target,
    ) -> Status {
        if !self.lengths_fit(q, v, proposal, target) {
            return Status::Refused(RefuseReason::WrongLength);
        }
        let before = self.previous.get().filter(|_| self.needs_previous());
        let known = before.is_none_or(|before| finite(before.acceleration) && finite(before.torque));
        if !(finite(q) && finite(v) && known) {
            return self.refuse(q, target);
        }
        self.update_bounds(q, v, target);
        if self.moving.on {
            self.move_coupled(q, v, &mut target.ledger.outside);
        }
        if !(finite(&proposal.q) && finite(&proposal.v)) {
            return self.brake(q, v, None, target, BrakeReason::NonFiniteProposal);
        }
        let previous = self.previous.get();
        let raw = self.checker.check(q, v, &proposal.q, &proposal.v, &self.external, previous);
        target.ledger.raw_violations = raw.counts;
        let mut answer = |projector: &mut Projector| match projector.settings.consistency {
            Consistency::Kinematic => projector.kinematic(q, v, proposal, target),
            Consistency::Free => projector.free(v, proposal, target),
        };
        let mut outcome = answer(self);
        if outcome == Err(BrakeReason::NoCertifiedAnswer) && self.loosen() {
            outcome = answer(self);
        }
        match outcome {
            Ok(status) => self.check_target(q, v, proposal, target, status),
            Err(BrakeReason::NoCertifiedAnswer) if self.searches_on(start) => {
                self.without_an_answer(q, v, proposal, target)
            }
            Err(reason) => self.brake(q, v, Some(proposal), target, reason),
        }
    }

    /// There is a stored brake to search with, and time left for it.
    fn searches_on(&self, start: Instant) -> bool {
        self.settings.braking == Braking::Stored
            && self.settings.deadline.is_none_or(|deadline| start.elapsed() < deadline)
    }

    /// The box of the last tick, per dof.
    pub fn bounds(&self) -> &Bounds {
        &self.bounds
    }

    /// The problem with coupled rows that the last tick solved or checked, for other solvers to compare with; `None`
    /// without coupled rows. Allocates.
    pub fn problem(&self) -> Option<Problem> {
        self.coupled.as_ref().map(|stages| Problem::of(&stages.problem, &self.dofs.controllable))
    }

    /// The dofs the projector may move, ascending.
    pub fn controllable(&self) -> &[usize] {
        &self.dofs.controllable
    }

    /// What is allowed and hardly meant, or not held: a sentence each, with joint, value and unit.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// The settings it was built with; [`Braking::Auto`] has become what was chosen.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// The model it was built for.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// `[v_lower, v_upper]` and `[q_lower, q_upper]` of each controllable dof from the viability box.
    fn update_bounds(&mut self, q: &[f64], v: &[f64], target: &mut Target) {
        let (t, kappa) = (self.period.dt, self.period.kappa);
        let free = self.settings.consistency == Consistency::Free;
        self.moving.beyond = false;
        for k in 0..self.dofs.controllable.len() {
            let i = self.dofs.controllable[k];
            let mut dof = Dof::of(&self.limits, i);
            dof.whole = self.settings.braking == Braking::Stored;
            if dof.acceleration.is_infinite() {
                // Free mode without braking: the cut below is all there is.
                (dof.lower, dof.upper) = (f64::NEG_INFINITY, f64::INFINITY);
            }
            let at = self.dofs.single[i].map_or(0.0, |iq| q[iq]);
            let hard_jerk = dof.jerk.is_finite();
            let mut reached = [-dof.acceleration, dof.acceleration];
            let mut x = match hard_jerk {
                true => {
                    let known = self.previous.get().map(|previous| previous.acceleration[i]);
                    let known = known.or((v[i] == 0.0).then_some(0.0));
                    let within = known.map(|a| a.clamp(-dof.acceleration, dof.acceleration));
                    self.before[i] =
                        within.unwrap_or_else(|| jerk::Brake::of(&dof, &self.period).curve(v[i]));
                    if let Some(before) = within {
                        let [least, most] = &mut reached;
                        (*least, *most) = (least.max(before - dof.jerk * t), most.min(before + dof.jerk * t));
                    }
                    jerk::interval(&dof, at, v[i], known, &self.period)
                }
                false => interval(&dof, at, v[i], &self.period),
            };
            self.accelerations[i] = reached;
            let exact = |kind: Kind, bound: f64, v_max: f64| match kind == Kind::Velocity
                && x.outside.is_none()
                && !hard_jerk
            {
                true => v_max,
                false => v[i] + t * bound,
            };
            let mut v_lower = exact(x.lower_kind, x.lower, -dof.velocity);
            let mut v_upper = exact(x.upper_kind, x.upper, dof.velocity).max(v_lower);
            let mut outside = x.outside.is_some() || self.is_beyond(i, at);
            self.moving.beyond |= outside;
            if self.moving.on {
                let (aim, hard, behind) = self.move_dof((at, v[i]), i, x);
                ([v_lower, v_upper], x) = (hard, aim);
                outside |= behind;
            }
            let [least, most] = self.within[i];
            if most < v_upper {
                (v_upper, x.upper_kind) = (most.max(v_lower), Kind::Position);
            }
            if least > v_lower {
                (v_lower, x.lower_kind) = (least.min(v_upper), Kind::Position);
            }
            (x.lower, x.upper) = match self.within[i] == FREE {
                true => (x.lower, x.upper),
                false => ((v_lower - v[i]) / t, (v_upper - v[i]) / t),
            };
            (self.bounds.v_lower[i], self.bounds.v_upper[i]) = (v_lower, v_upper);
            if let Some(iq) = self.dofs.single[i] {
                let reach = |v_next: f64| q[iq] + (t * v[i] + kappa * t * (v_next - v[i]));
                let (mut lower, mut upper) = (reach(v_lower), reach(v_upper));
                if free {
                    // Cut with the limits; beyond them, the reachable position nearest to them.
                    lower = lower.max(self.limits.q_lower[i]).min(upper);
                    upper = upper.min(self.limits.q_upper[i]).max(lower);
                }
                (self.bounds.q_lower[i], self.bounds.q_upper[i]) = (lower, upper);
            }
            self.outside[i] = outside;
            if outside {
                target.ledger.outside.push(i);
            }
            self.intervals[i] = x;
        }
    }

    /// The joint of dof `i`, at `at`, is beyond its range. Without an acceleration limit its interval does not know.
    fn is_beyond(&self, i: usize, at: f64) -> bool {
        self.dofs.single[i].is_some()
            && (at > self.limits.q_upper[i] + POSITION_TOLERANCE
                || at < self.limits.q_lower[i] - POSITION_TOLERANCE)
    }

    /// The independent checker has the last word.
    fn check_target(
        &mut self,
        q: &[f64],
        v: &[f64],
        proposal: &Proposal,
        target: &mut Target,
        status: Status,
    ) -> Status {
        let verdict = self.checker.check(q, v, &target.q, &target.v, &self.external, self.previous.get());
        target.ledger.target_violations = verdict.counts;
        let soft = target.ledger.active.iter().fold(0.0, |most: f64, row| most.max(row.slack));
        target.ledger.slack = verdict.worst.max(soft);
        let outside = &target.ledger.outside;
        let accepted =
            verdict.accepts() || (self.moving.beyond && verdict.counts.torque + verdict.counts.other == 0);
        let status = if outside.is_empty() { status } else { self.named(v, outside) };
        match self.settings.braking {
            _ if !accepted => self.brake(q, v, Some(proposal), target, BrakeReason::NoCertifiedAnswer),
            Braking::Stored => self.keep_a_brake(q, v, proposal, target, status, true),
            _ => status,
        }
    }

    /// Reports a target that is not the nearest allowed one.
    fn report_rung(&mut self, q: &[f64], v: &[f64], target: &mut Target, rung: Rung) {
        target.ledger.rung = rung;
        self.report_unsolved(q, v, target);
    }

    /// No rows hold a target that was not solved for; what it breaks, the checker says.
    fn report_unsolved(&mut self, q: &[f64], v: &[f64], target: &mut Target) {
        target.ledger.active.clear();
        let (checker, to) = (&mut self.checker, (&target.q[..], &target.v[..]));
        let verdict = match target.ledger.rung {
            Rung::StoredBrake => checker.check_brake(q, v, to.0, to.1, &self.external, self.previous.get()),
            _ => checker.check(q, v, to.0, to.1, &self.external, self.previous.get()),
        };
        target.ledger.target_violations = verdict.counts;
        target.ledger.slack = if verdict.worst.is_finite() { verdict.worst } else { f64::MAX };
    }

    /// Last rung: a tick of a brake, see [`Projector::stop`].
    fn brake(
        &mut self,
        q: &[f64],
        v: &[f64],
        proposal: Option<&Proposal>,
        target: &mut Target,
        reason: BrakeReason,
    ) -> Status {
        self.v_next.copy_from_slice(proposal.map_or(v, |p| &p.v));
        self.consistent.fill(false);
        let unsolved = matches!(reason, BrakeReason::NoCertifiedAnswer | BrakeReason::NonFiniteDynamics);
        self.stop(q, v, target, !unsolved);
        self.write(q, v, proposal, target);
        self.keep_the_motors(q, v, proposal, target);
        let stored = self.settings.braking == Braking::Stored && self.backup.stored;
        self.name_cones(q, v, &mut target.ledger.outside);
        self.report_rung(q, v, target, if stored { Rung::StoredBrake } else { Rung::Brake });
        Status::Braked(reason)
    }

    /// `v_next` after a tick of the stored brake, as it was verified, or of the brake of each joint, `-sgn(v) min(A_b, |v| / T)` where its
    /// jerk is free, where none is stored: inside the box and, if `rows`, the nearest to it that the coupled rows allow, should they allow any.
    fn stop(&mut self, q: &[f64], v: &[f64], target: &mut Target, rows: bool) {
        let stored = self.settings.braking == Braking::Stored && self.backup.stored;
        for &i in &self.dofs.controllable {
            let dof = Dof::of(&self.limits, i);
            let most = if stored { self.backup.deceleration(i) } else { jerk::Brake::most(&dof) };
            let stop = match stored {
                _ if dof.jerk.is_finite() => {
                    let brake = jerk::Brake::new(&dof, most, &self.period);
                    v[i] + self.period.dt * brake.next(v[i], self.before[i])
                }
                true => self.backup.next_velocity(i, v[i], &self.period),
                false => v[i] - v[i].signum() * (self.braking[i] * self.period.dt).min(v[i].abs()),
            };
            self.v_next[i] = stop.clamp(self.bounds.v_lower[i], self.bounds.v_upper[i]);
        }
        if rows && !stored {
            self.goal.copy_from_slice(&self.v_next);
            let _ = self.coupled_rows(q, v, target); // without an answer the brake stays as it is
        }
    }

    /// A finite target that stands still, for a state nobody knows: joints whose configuration is known stay there.
    fn refuse(&self, q: &[f64], target: &mut Target) -> Status {
        target.q.copy_from_slice(q);
        for joint in self.model.joints() {
            let own = joint.idx_q..joint.idx_q + joint.nq;
            if !finite(&q[own.clone()]) {
                target.q[own.clone()].copy_from_slice(&self.model.raw_neutral()[own]);
            }
        }
        target.v.fill(0.0);
        target.acceleration.fill(0.0);
        target.ledger.rung = Rung::Brake;
        Status::Refused(RefuseReason::NonFiniteState)
    }

    fn lengths_fit(&self, q: &[f64], v: &[f64], proposal: &Proposal, target: &Target) -> bool {
        let (nq, nv) = (self.model.nq(), self.model.nv());
        [q.len(), proposal.q.len(), target.q.len()].iter().all(|n| *n == nq)
            && [v.len(), proposal.v.len(), target.v.len(), target.acceleration.len()].iter().all(|n| *n == nv)
    }
}

/// Velocities with 0 for what is no motion at all: a filter that fades leaves numbers below 1e-308, for which some processors need a hundred
/// times as long.
fn without_denormals<'a>(v: &'a [f64], scratch: &'a mut [f64]) -> &'a [f64] {
    if scratch.len() != v.len() || !v.iter().any(|x| x.is_subnormal()) {
        return v;
    }
    scratch.iter_mut().zip(v).for_each(|(to, &x)| *to = if x.is_subnormal() { 0.0 } else { x });
    scratch
}

fn finite(x: &[f64]) -> bool {
    x.iter().all(|x| x.is_finite())
}
