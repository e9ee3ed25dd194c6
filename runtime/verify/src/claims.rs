//! Confirms what one tick claims: its limits, its action, that its target is the nearest allowed state, and its way to stop.

use crate::before::{Asked, Told};
use crate::limit_check::{self, Fault, are_near, broken};
use crate::limits::{Consistency, Limits, Way};
use crate::moved::Moving;
use crate::optimum;
use crate::promise::{Promise, Sent};
use crate::proposed::{Moment, State, distance, unconstrained};
use crate::report::Report;
use crate::rows::{Passage, Row};
use crate::stop;
use crate::tick::{CLAMPED, Ledger, ROOM, Status, UNCHANGED};

/// A target's position is where its velocity leads, up to this share [rad or m].
const CONSISTENT: f64 = 1e-9;
/// A proposal that is passed on is moved by no more than this [rad/s or m/s]: it is computed anew from the one of its period.
const CHANGED: f64 = 1e-6;
/// Share of its size by which an action may differ from the one that leads to the target.
const ACTION: f64 = 1e-7;

/// A tick with what it acted upon.
pub(crate) struct Case<'a> {
    pub(crate) moment: Moment<'a>,
    pub(crate) status: Status,
    /// What was asked of the robot for what it did up to the tick.
    pub(crate) asked: &'a Asked,
    /// The brake that the tick before stored, empty where it stored none; None where the log does not have it.
    pub(crate) brake: Option<&'a [f64]>,
    /// What was projected, or why it is not known.
    pub(crate) proposal: Result<State, String>,
}

/// Confirms what a tick claims, and counts in a report what it could.
pub(crate) struct Claims<'a> {
    pub(crate) report: &'a mut Report,
    pub(crate) case: Case<'a>,
}

impl Claims<'_> {
    /// Limits, action, optimum and way to stop of what a snapshot promises; what the next tick is told of this one.
    ///
    /// # Errors
    /// What is broken, or why it cannot be said.
    pub(crate) fn confirm(&mut self, promise: &mut Promise) -> Result<Told, Fault> {
        self.as_executed(promise, Self::all)
    }

    /// The limits of a promise beside the snapshot's own.
    ///
    /// # Errors
    /// What is broken, or why it cannot be said.
    pub(crate) fn confirm_limits(&mut self, promise: &mut Promise) -> Result<(), Fault> {
        self.as_executed(promise, |claims, promise| {
            let motion = claims.motion(promise);
            claims.limits(promise, &motion)
        })
    }

    /// A plant that moves in several steps is off by the second order of its period, which margins are for: the brake that was verified a tick
    /// before is executed from where it ended, and keeps the limits without them.
    fn as_executed<T>(
        &mut self,
        promise: &mut Promise,
        confirm: impl FnOnce(&mut Self, &mut Promise) -> Result<T, Fault>,
    ) -> Result<T, Fault> {
        let of_brake = self.case.status == Status::Braked;
        if of_brake {
            promise.leave_out_margins();
        }
        let found = confirm(self, promise);
        if of_brake {
            promise.leave_out_margins();
        }
        found
    }

    /// Acceleration and motor forces of the tick.
    fn motion(&self, promise: &mut Promise) -> Told {
        let (Moment { tick, q, v, .. }, p) = (self.case.moment, promise.period);
        let a: Vec<f64> = (0..v.len()).map(|i| (tick.target_v[i] - v[i]) / p.dt).collect();
        let mut tau = vec![0.0; v.len()];
        promise.machine.motors(&p, q, v, &a, &mut tau);
        (a, tau)
    }

    fn passage<'b>(&'b self, promise: &Promise, (a, tau): &'b Told) -> Passage<'b> {
        let Moment { tick, q, v, last, .. } = self.case.moment;
        let before = self.case.asked.told.as_ref().map(|(a, tau)| (&a[..], &tau[..]));
        let is_free = promise.consistency == Consistency::Free;
        Passage { q, v, q1: &tick.target_q, v1: &tick.target_v, a, tau, before, last, is_free }
    }

    /// The tick brought a stored brake.
    fn is_stored(&self) -> bool {
        !self.case.moment.tick.brake.is_empty()
    }

    /// The limits of a promise, in which those in force are left.
    fn limits(&self, promise: &mut Promise, motion: &Told) -> Result<(), Fault> {
        let passage = self.passage(promise, motion);
        let (is_stored, excused) = (self.is_stored(), self.case.status == Status::Recovering);
        if promise.consistency == Consistency::Kinematic {
            follows(promise, &passage)?;
        }
        if let Some(mut moving) = promise.moving.take() {
            // What was built holds on any way, then what is in force on this one.
            promise.limits.clone_from(&moving.built);
            let held = holds(promise, &passage, is_stored, excused);
            let in_force = self.in_force(promise, &mut moving);
            promise.moving = Some(moving);
            held?;
            promise.limits = in_force?;
        }
        if promise.moving.is_none() || !excused {
            holds(promise, &passage, is_stored, excused)?;
        }
        Ok(())
    }

    fn all(&mut self, promise: &mut Promise) -> Result<Told, Fault> {
        let motion = self.motion(promise);
        self.limits(promise, &motion)?;
        let (case, passage) = (&self.case, self.passage(promise, &motion));
        let (tick, excused) = (case.moment.tick, case.status == Status::Recovering);
        if excused && !is_outside(promise, &case.moment, self.is_stored()) {
            return broken(
                "joints, frames, bodies and rows outside at the start of a tick that says it is recovering",
                0.0,
                1.0,
                "or more",
            );
        }
        if tick.ledger.target_violations > 0 && !excused && case.status != Status::Braked {
            return broken(
                "ledger.target_violations of a target within all limits",
                f64::from(tick.ledger.target_violations),
                0.0,
                "",
            );
        }
        actions(promise, &passage, &tick.action)?;
        match self.optimum(promise, &passage) {
            Ok(unbalanced) => {
                self.report.optimal += 1;
                self.report.unbalanced = self.report.unbalanced.max(unbalanced);
            }
            Err(Fault::Unknown(why)) => *self.report.not_compared.entry(why).or_default() += 1,
            Err(fault) => return Err(fault),
        }
        match self.stop(promise, &motion.0) {
            Ok(()) => self.report.stoppable += 1,
            Err(Fault::Unknown(why)) => *self.report.not_stopped.entry(why).or_default() += 1,
            Err(fault) => return Err(fault),
        }
        Ok(motion)
    }

    /// The limits in force at a tick whose limits were moved: those asked for where the tick says that they are reached.
    fn in_force(&self, promise: &mut Promise, moving: &mut Moving) -> Result<Limits, Fault> {
        if self.case.status == Status::Nearest {
            return Ok(moving.wanted.clone());
        }
        let Moment { q, v, last, .. } = self.case.moment;
        let is_stored = promise.way == Way::Stored || self.is_stored();
        if is_stored && self.case.brake.is_none() {
            return unknown(
                "their limits were moved, and the brake in force is of a tick that the log does not have",
            );
        }
        let brake = self.case.brake.filter(|brake| brake.len() == v.len());
        let Promise { machine, period, controllable, .. } = promise;
        let jerk = controllable.iter().any(|i| moving.built.joints[*i].jerk.is_finite());
        if jerk && last.is_none() && v.iter().any(|v| *v != 0.0) {
            return unknown(
                "their limits were moved, and the tick before, of which jerk speaks, is not known",
            );
        }
        let rest = vec![0.0; v.len()];
        Ok(moving.in_force(machine, (period, controllable), (q, v), (brake, last.unwrap_or(&rest))))
    }

    /// The target is the nearest allowed state to what was proposed; what its multipliers leave unbalanced.
    fn optimum(&self, promise: &mut Promise, passage: &Passage<'_>) -> Result<f64, Fault> {
        let (case, ledger) = (&self.case, &self.case.moment.tick.ledger);
        match case.status {
            Status::Recovering => return unknown("the robot was outside its limits"),
            Status::Tightening => {
                return unknown("the robot was on its way to limits that an operator moved");
            }
            Status::Slowed => {
                return unknown(
                    "no way to stop was found from the nearest allowed state, or its physics steps do not lead there (slowed)",
                );
            }
            Status::Braked | Status::Refused => return unknown("the proposal was not used: braked"),
            _ => {}
        }
        let proposal = case.proposal.as_ref().map_err(|why| Fault::Unknown(why.clone()))?;
        // Half a period more where a stored brake stops in whole ones.
        let whole = self.is_stored();
        if passage.is_free {
            return optimum::apart(promise, passage, proposal, ledger, whole).map(|()| 0.0);
        }
        let (one, other) = unconstrained(promise, passage, proposal);
        if !case.moment.by_policy && promise.limits.rows.iter().any(Row::needs_before) {
            return unknown("a brake is not told of the tick before, of which jerk and torque rate speak");
        }
        let unbalanced = optimum::confirm(promise, passage, [&one, &other], ledger, whole)?;
        let (said, found) = (ledger.moved, distance(promise, passage, proposal, &other));
        if ledger.status == UNCHANGED && found > CHANGED && !promise.limits_actions {
            return broken(
                "distance to the target of a proposal that is said to be unchanged",
                found,
                0.0,
                "rad/s or m/s",
            );
        }
        if !promise.limits_actions && !are_near(said, found, 1e-6 * (1e-3 + found)) {
            return broken("ledger.moved", said, found, "rad/s or m/s");
        }
        Ok(unbalanced)
    }

    /// There is a way to stop from the target.
    fn stop(&self, promise: &mut Promise, a: &[f64]) -> Result<(), Fault> {
        let tick = self.case.moment.tick;
        let (q, v) = (&tick.target_q, &tick.target_v);
        if self.case.status == Status::Recovering {
            return unknown("the robot was outside its limits");
        }
        if promise.consistency == Consistency::Free {
            return unknown("consistency = \"free\" promises none");
        }
        if self.is_stored() {
            stop::stored(promise, q, v, a, &tick.brake)
        } else if promise.way == Way::Stored {
            broken("number of stored decelerations", 0.0, v.len() as f64, "")
        } else {
            stop::certified(promise, q, v, a)
        }
    }
}

fn unknown<T>(why: &str) -> Result<T, Fault> {
    Err(Fault::Unknown(why.to_owned()))
}

/// What a ledger says of one thing in several of its numbers.
pub(crate) fn agrees(ledger: &Ledger, status: Status, nv: usize) -> Result<(), Fault> {
    let rows = ledger.active_rows.len();
    let is_full = rows == ROOM && ledger.active > ROOM;
    if !(ledger.is_whole() || is_full) {
        return broken("ledger.active", ledger.active as f64, rows as f64, "active rows in its list");
    }
    if ledger.status == UNCHANGED && ledger.active > 0 {
        return broken(
            "number of active rows of a proposal that is said to be unchanged",
            ledger.active as f64,
            0.0,
            "",
        );
    }
    if ledger.status == CLAMPED
        && let Some(row) = ledger.active_rows.iter().map(|active| active.row).find(|row| *row >= nv)
    {
        return broken(
            "number of an active row of a proposal that is said to be clamped joint by joint",
            row as f64,
            nv as f64,
            "at most, less one",
        );
    }
    let must_be = match status {
        Status::Recovering | Status::Tightening => Some(true),
        Status::Nearest | Status::Slowed => Some(false),
        _ => None,
    };
    if must_be.is_some_and(|must_be| must_be != (ledger.outside > 0)) {
        let limit = f64::from(u8::from(ledger.outside == 0));
        let unit = if ledger.outside == 0 { "or more" } else { "" };
        let says = match status {
            Status::Recovering => "recovering",
            Status::Tightening => "tightening",
            Status::Slowed => "slowed",
            _ => "the nearest allowed state",
        };
        let what = format!("ledger.outside of a tick that says it is {says}");
        return broken(what, ledger.outside as f64, limit, unit);
    }
    // Of a target that was looked for otherwise, it is what that exceeds, and no row holds it.
    let slack = ledger.active_rows.iter().fold(0.0, |most: f64, row| most.max(row.slack));
    if ledger.slack < slack {
        return broken("ledger.slack", ledger.slack, slack, "of a limit's size, at least");
    }
    Ok(())
}

/// The limits of joints, then what ties joints together.
fn holds(promise: &mut Promise, passage: &Passage<'_>, stored: bool, excused: bool) -> Result<(), Fault> {
    let Promise { machine, limits, controllable, period, .. } = promise;
    limit_check::joints(limits, machine, controllable, period, passage, (stored, excused))?;
    limit_check::rows(limits, machine, period, passage, stored, excused)
}

/// The target's position is where its velocity leads.
fn follows(promise: &Promise, passage: &Passage<'_>) -> Result<(), Fault> {
    let p = &promise.period;
    for &i in &promise.controllable {
        let Some(at) = promise.machine.single(i) else { continue };
        let leads = passage.q[at] + p.way(passage.v[i], passage.v1[i]);
        if !are_near(passage.q1[at], leads, CONSISTENT * leads.abs().max(1.0)) {
            let j = &promise.limits.joints[i];
            return broken(format!("target position of joint '{}'", j.name), passage.q1[at], leads, j.length);
        }
    }
    Ok(())
}

/// Something is outside its limits at the start of the tick.
fn is_outside(promise: &mut Promise, moment: &Moment<'_>, whole: bool) -> bool {
    let (Promise { machine, limits, controllable, period, .. }, Moment { q, v, last, .. }) =
        (promise, *moment);
    let joint = |&i: &usize| {
        let known = last.map(|last| last[i]);
        limits.joints[i].is_outside(period, machine.single(i).map(|at| q[at]), (v[i], known), whole)
    };
    if controllable.iter().any(joint) {
        return true;
    }
    if limits.rows.iter().any(|row| row.is_of_state() && crate::rows::is_beyond(row, machine, q, v)) {
        return true;
    }
    let Some(collision) = &limits.collision else { return false };
    machine.go(q, v);
    !matches!(collision.gap(machine, collision.margin), crate::collision::Gap::Kept)
}

/// The action is the one that leads to the target; where a joint rubs, to within its dry friction.
fn actions(promise: &mut Promise, passage: &Passage<'_>, found: &[f64]) -> Result<(), Fault> {
    let p = promise.period;
    let (lag, sag) = (0.5 * (p.dt - p.tau), (p.dt * p.dt - p.tau * p.tau) / 6.0);
    let (mut means, mut cut) = (Vec::new(), None);
    if !promise.actions.is_empty() && found.len() != promise.n_act {
        return broken("length of action", found.len() as f64, promise.n_act as f64, "");
    }
    for action in &promise.actions {
        let (i, joint) = (action.dof, &promise.limits.joints[action.dof].name);
        let Some(at) = promise.machine.single(i) else { continue };
        let (v, a, tau) = (passage.v[i], passage.a[i], passage.tau[i]);
        let (sent, by_friction, unit) = match action.sent {
            Sent::Force => {
                let share = action.gear * action.gain;
                ((tau / action.gear - action.bias) / action.gain, action.friction / share.abs(), "N m or N")
            }
            Sent::Position => (passage.q1[at], 0.0, "rad or m"),
            Sent::Velocity => (passage.v1[i], 0.0, "rad/s or m/s"),
            Sent::Target { stiffness, damping } => {
                let target = passage.q[at] + lag * v + sag * a + (tau + damping * (v + lag * a)) / stiffness;
                // No force goes to where a step is no longer implicit in the drive's damping.
                let [low, high] = [-action.strength, action.strength]
                    .map(|force| passage.q[at] + (force + damping * v) / stiffness);
                (target.max(low).min(high), action.friction / stiffness, "rad or m")
            }
        };
        let leads = sent.max(action.range[0]).min(action.range[1]);
        let is = found.get(action.place).copied().unwrap_or(f64::NAN);
        let size = 1.0 + leads.abs().max(action.range[1].abs().min(1e3));
        means.push(leads);
        let moves = matches!(action.sent, Sent::Force | Sent::Target { .. });
        if p.sub_steps > 1 && moves {
            continue;
        }
        // What a motor lacks of a force is its limit's matter; a position, a speed or a target that ends before leads elsewhere.
        if !matches!(action.sent, Sent::Force) && !are_near(sent, leads, by_friction + ACTION * size) {
            cut = cut.or(Some(i));
        }
        if !are_near(is, leads, by_friction + ACTION * size) {
            return broken(format!("action for joint '{joint}'"), is, leads, unit);
        }
    }
    if let Some(cut) = cut {
        return crate::cut::lead(promise, passage, found, cut);
    }
    if p.sub_steps > 1 && !means.is_empty() {
        crate::steps::lead(promise, passage, found, &means)
    } else {
        Ok(())
    }
}
