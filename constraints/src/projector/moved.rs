//! Limits that move while the robot does.
//!
//! The limits of the build can be kept for ever, and so can those they are moved to. On the way from the one to the other it may be that neither
//! can: a joint that moves fast when its limit becomes lower is outside that limit until it has slowed down. In each tick of the way the limit
//! in force is therefore the tightest that the brake in force keeps: the stored brake, or the deceleration `A_b` of each joint where none is
//! stored. With `s` the next velocity by that brake and `r` the position where it comes to rest,
//!
//! ```text
//!     |v'| <= max(V, |s|),    q <= max(q_max, r),    rows and cones: as far as that brake goes, and no further
//! ```
//!
//! The brake obeys all of it, so there is always an answer. The next brake is verified for the limit in force, so this limit never moves back.
//! The goal is put where the fastest way leads: a joint that is too fast, or could not stop in front of its new position limit, slows down by
//! `A_b`. Where the new limit on a frame, its speed, a body or the energy is not kept yet, all joints slow down in proportion, as fast as one of
//! them can; a speed or an energy that one period of this brings within its limit is held to it, and the proposal is followed otherwise.
//!
//! A joint of hard jerk goes on speeding up for a while as it begins to brake: `s` is the fastest that its brake becomes, and `r` as far as that goes
//! ([`smooth`]). For bodies one number is in force on the way: the least distance of all pairs.

mod numbers;
mod smooth;
mod way;

use super::Projector;
use super::backup::With;
use crate::jerk::Brake;
use crate::ledger::Status;
use crate::limit::Moved;
use crate::target::Braking;
use crate::viability::{Dof, Interval, POSITION_TOLERANCE};
use crate::{LimitError, LimitSet};
use way::{gain, rest, way};

/// A speed above its limit by this share is rounding.
const ROUNDING: f64 = 1e-9;

/// A state is beyond a cone that it exceeds by more than this share of its limit.
const TOO_FAST: f64 = 1e-6;

/// What limits are moved to, and what is in force on the way.
pub(super) struct Moving {
    /// Some limit is moved.
    pub(super) on: bool,
    /// As [`Projector::moved`].
    numbers: Vec<f64>,
    /// Where planes and obstacles are, and where they were built.
    places: Vec<[f64; 6]>,
    built: Vec<[f64; 6]>,
    /// Some hard row or cone is moved.
    pub(super) coupled: bool,
    /// Positions and speeds asked for, of the build where those are tighter.
    wanted: LimitSet,
    /// How fast each dof may speed up (nv) [rad/s² or m/s²].
    faster: Vec<f64>,
    /// Velocities that the fastest way allows (nv) [rad/s or m/s].
    lower: Vec<f64>,
    upper: Vec<f64>,
    /// In force: speeds (nv), how fast a dof may speed up (nv).
    speed: Vec<f64>,
    speeding: Vec<f64>,
    /// Share of its size that each cone is asked for, that it would have, and whether the state, or the brake in force, is beyond what is asked for (cones).
    shares: Vec<f64>,
    reached: Vec<f64>,
    late: Vec<bool>,
    /// The goal is this share of the velocity, as a row or cone is behind.
    slow: Option<f64>,
    /// Cones are held to what is asked for though the brake in force goes beyond: where that leaves no answer, they have these shares (cones), and the
    /// goal is that share of the velocity, if the state is beyond one.
    is_tight: bool,
    loose: Vec<f64>,
    slower: Option<f64>,
    /// Some joint is beyond the limits of the build.
    pub(super) beyond: bool,
}

impl Moving {
    pub(super) fn new(limits: &LimitSet, switches: usize, cones: usize, built: Vec<[f64; 6]>) -> Moving {
        let nv = limits.velocity.len();
        let infinite = || vec![f64::INFINITY; nv];
        let mut moving = Moving {
            on: false,
            numbers: vec![0.0; 4 * nv + 2 * switches + 6 * built.len()],
            places: built.clone(),
            built,
            coupled: false,
            wanted: limits.clone(),
            faster: infinite(),
            lower: infinite(),
            upper: infinite(),
            speed: infinite(),
            speeding: infinite(),
            shares: vec![1.0; cones],
            reached: vec![0.0; cones],
            late: vec![false; cones],
            slow: None,
            is_tight: false,
            loose: vec![1.0; cones],
            slower: None,
            beyond: false,
        };
        moving.still();
        moving
    }

    /// Nothing is moved.
    fn still(&mut self) {
        let nv = self.faster.len();
        self.numbers.fill(f64::INFINITY);
        self.numbers[2 * nv..3 * nv].fill(f64::NEG_INFINITY);
        let places = self.numbers.len() - 6 * self.built.len();
        let switches = (places - 4 * nv) / 2;
        self.numbers[4 * nv..4 * nv + switches].fill(0.0);
        self.numbers[4 * nv + switches..places].fill(1.0);
        self.numbers[places..].copy_from_slice(self.built.as_flattened());
    }
}

impl Projector {
    /// Moves limits inside those of the build, or back towards them, for the ticks to come; what `moved` does not name is as it was built.
    /// Where the robot is outside of what is asked for, it goes there on the way that docs/LIMITS.md declares, with
    /// [`Status::Tightening`](crate::Status::Tightening). Allocates.
    ///
    /// # Errors
    /// Limits wider than those of the build or without room to stop, unknown names, hard rows and cones without a stored brake, the free
    /// consistency, a payload, which changes the robot; nothing is changed then.
    pub fn move_limits(&mut self, moved: &Moved) -> Result<(), LimitError> {
        let numbers = self.moved_numbers(moved)?;
        self.set_moved(&numbers);
        Ok(())
    }

    /// Where limits are moved to, as plain numbers: largest speed, largest gain of speed, lowest and highest position of each dof (4 nv), then
    /// how far inside the rows of each limit lie \[m\] and the share that its cone has (2 for each limit), then six numbers for each plane and obstacle
    /// that may be put elsewhere ([`Place`](crate::row::Place)).
    pub fn moved(&self) -> &[f64] {
        &self.moving.numbers
    }

    /// Takes what [`Projector::moved`] or [`Projector::moved_numbers`] gave, of a projector with the same limits. Does not allocate.
    ///
    /// # Panics
    /// When it has another length.
    pub fn set_moved(&mut self, numbers: &[f64]) {
        self.moving.numbers.copy_from_slice(numbers);
        self.take_moved();
    }

    /// Takes over the numbers, beside the limits of the build that hold now.
    pub(super) fn take_moved(&mut self) {
        let (nv, switches) = (self.model.nv(), self.switches.len());
        let m = &mut self.moving;
        m.wanted.clear();
        m.wanted.tighten(&self.limits);
        for i in 0..nv {
            m.wanted.velocity[i] = m.wanted.velocity[i].min(m.numbers[i]);
            m.faster[i] = m.numbers[nv + i].min(self.limits.acceleration[i]);
            m.wanted.q_lower[i] = m.wanted.q_lower[i].max(m.numbers[2 * nv + i]);
            m.wanted.q_upper[i] = m.wanted.q_upper[i].min(m.numbers[3 * nv + i]);
        }
        let (insets, shares) = m.numbers[4 * nv..].split_at(switches);
        let (shares, places) = shares.split_at(switches);
        m.places.as_flattened_mut().copy_from_slice(places);
        let elsewhere = m.places != m.built;
        let joints = m.numbers[..2 * nv].iter().chain(&m.numbers[3 * nv..4 * nv]).any(|x| x.is_finite())
            || m.numbers[2 * nv..3 * nv].iter().any(|x| x.is_finite());
        m.coupled = insets.iter().any(|by| *by > 0.0) || shares.iter().any(|share| *share < 1.0) || elsewhere;
        m.on = joints || m.coupled;
        (m.slow, m.is_tight) = (None, false);
        for limit in 0..switches {
            self.checker.ask(limit, shares[limit], insets[limit]);
            self.backup.ask(limit, shares[limit], insets[limit]);
            if let Some(stages) = &mut self.coupled {
                stages.sources.inset(limit, insets[limit]);
            }
        }
        self.checker.put(&m.places);
        self.backup.put(&m.places);
        if let Some(stages) = &mut self.coupled {
            stages.sources.put(&m.places, &m.built);
            for c in 0..m.shares.len() {
                let limit = stages.sources.cone_limits().nth(c).map_or(0, |(limit, ..)| limit);
                m.shares[c] = shares[limit];
                stages.sources.set_share(c, shares[limit]);
            }
        }
        self.checker.move_limits(m.on, &self.limits);
        self.in_force.clear();
        self.in_force.tighten(&self.limits);
    }

    /// Box, aim and what is in force of dof `i`, whose box by the limits of the build is `built`.
    pub(super) fn move_dof(
        &mut self,
        (q, v): (f64, f64),
        i: usize,
        built: Interval,
    ) -> (Interval, [f64; 2], bool) {
        let (t, limits) = (self.period.dt, &self.limits);
        let dof =
            |limits: &LimitSet| Dof { whole: self.settings.braking == Braking::Stored, ..Dof::of(limits, i) };
        let (dof, wanted) = (dof(limits), dof(&self.moving.wanted));
        if dof.jerk.is_finite() {
            return self.move_smooth((q, v), i, (&dof, &wanted), built);
        }
        let stored = (self.settings.braking == Braking::Stored && self.backup.stored)
            .then(|| self.backup.next_velocity(i, v, &self.period));
        let way = way((&dof, &wanted), (q, v), built, stored, self.moving.faster[i], &self.period);
        let deceleration =
            stored.and_then(|_| self.backup.decelerations()).map_or(dof.braking(&self.period), |d| d[i]);
        let rest = rest(v, deceleration, &self.period);
        let m = &mut self.moving;
        let aim = [v + t * way.aim.lower, v + t * way.aim.upper];
        (m.lower[i], m.upper[i]) = (aim[0], aim[1]);
        // A brake that is the bound itself differs from it by rounding, and does not move it.
        let rounding = ROUNDING * dof.braking(&self.period).min(1e6) * t;
        let stop = match way.stop {
            s if s > aim[1] && s - aim[1] <= rounding => aim[1],
            s if s < aim[0] && aim[0] - s <= rounding => aim[0],
            s => s,
        };
        let hard = [aim[0].min(stop), aim[1].max(stop)];
        m.speed[i] = wanted.velocity.max(way.stop.abs());
        m.speeding[i] = m.faster[i].max(gain(v, way.stop) / t);
        let f = &mut self.in_force;
        f.q_upper[i] = wanted.upper.max((q + rest.max(0.0)).min(dof.upper));
        f.q_lower[i] = wanted.lower.min((q + rest.min(0.0)).max(dof.lower));
        let beyond = |x: f64, limit: f64| x > limit + POSITION_TOLERANCE;
        let slower = hard[0] < aim[0] || aim[1] < hard[1];
        let behind = slower || beyond(f.q_upper[i], wanted.upper) || beyond(-f.q_lower[i], -wanted.lower);
        (way.aim, hard, !way.arrived || behind)
    }

    /// What is in force of rows and cones, and whether all joints slow down; `rows` gets the reports of those on their way.
    pub(super) fn move_coupled(&mut self, q: &[f64], v: &[f64], rows: &mut Vec<usize>) {
        let m = &mut self.moving;
        (m.slow, m.is_tight) = (None, false);
        self.checker.hold(&self.in_force, &m.speed, &m.speeding);
        if !m.coupled {
            return;
        }
        let with = With {
            limits: &self.in_force,
            dofs: &self.dofs,
            period: &self.period,
            external: &self.external,
            outside: &self.outside,
        };
        let mut further = false;
        if self.settings.braking == Braking::Stored {
            self.backup.measure_the_way(&with, (q, v), &self.before);
            for (k, (most, on)) in self.backup.on_the_way().enumerate() {
                if most > 0.0 {
                    name(rows, self.checker.hard_row(k));
                }
                further |= on;
            }
            self.checker.allow(self.backup.allowed_on_the_way());
        }
        let Some(stages) = &mut self.coupled else { return };
        let m = &mut self.moving;
        // As it is, and where it leads if no joint slows down.
        self.checker.shares_of((q, v), &self.external, &mut m.reached);
        let mut late = false;
        for c in 0..m.shares.len() {
            m.late[c] = m.reached[c] > m.shares[c] * (1.0 + TOO_FAST);
            if m.late[c] {
                name(rows, self.checker.cone_row(c));
            }
            late |= m.late[c];
        }
        let mut slowest: f64 = 1.0;
        if late {
            self.tangent.iter_mut().zip(v).for_each(|(step, v)| *step = self.period.dt * v);
            self.dynamics.integrate(q, &self.tangent, &mut self.integrated);
            self.checker.shares((q, v), (&self.integrated, v), &self.external, &mut m.reached);
            let late = (0..m.shares.len()).filter(|c| m.late[*c]);
            slowest = late.fold(1.0, |least: f64, c| least.min(m.shares[c] / m.reached[c]));
        }
        let quickest = self.dofs.controllable.iter().filter(|i| v[**i] != 0.0);
        let most =
            quickest.fold(1.0, |most: f64, &i| most.min(self.braking[i] * self.period.dt / v[i].abs()));
        // What a period of slowing down reaches is kept from this tick on, whatever is proposed.
        let is_jerky = self.dofs.controllable.iter().any(|i| self.limits.jerk[*i].is_finite());
        let is_near = if is_jerky { !late } else { slowest >= 1.0 - most };
        // After a tick of the brake in force.
        self.v_stop.copy_from_slice(v);
        for &i in &self.dofs.controllable {
            let stored = self.settings.braking == Braking::Stored && self.backup.stored;
            self.v_stop[i] = match stored {
                _ if self.limits.jerk[i].is_finite() => {
                    let dof = Dof::of(&self.limits, i);
                    let most = if stored { self.backup.deceleration(i) } else { Brake::most(&dof) };
                    v[i] + self.period.dt * Brake::new(&dof, most, &self.period).next(v[i], self.before[i])
                }
                true => self.backup.next_velocity(i, v[i], &self.period),
                false => v[i] - v[i].signum() * (self.braking[i] * self.period.dt).min(v[i].abs()),
            };
            self.tangent[i] = self.period.dt * (v[i] + self.period.kappa * (self.v_stop[i] - v[i]));
        }
        self.dynamics.integrate(q, &self.tangent, &mut self.integrated);
        // The brake is verified for what it keeps, which is less than what its rows ask for.
        let next = (&self.integrated[..], &self.v_stop[..]);
        self.checker.shares_of(next, &self.external, &mut m.reached);
        for c in 0..m.shares.len() {
            let goes_on = m.reached[c].min(1.0) > m.shares[c] * (1.0 + ROUNDING);
            if goes_on {
                name(rows, self.checker.cone_row(c));
            }
            m.late[c] |= goes_on;
        }
        self.checker.shares((q, v), next, &self.external, &mut m.reached);
        for c in 0..m.shares.len() {
            let in_force = if m.late[c] { m.shares[c].max(m.reached[c].min(1.0)) } else { m.shares[c] };
            self.checker.set_in_force(c, in_force);
            stages.sources.set_share(c, if is_near { m.shares[c] } else { in_force });
            m.loose[c] = in_force;
            m.is_tight |= is_near && in_force > m.shares[c];
        }
        m.slower = late.then_some((1.0 - most).max(slowest));
        if !is_near || further {
            let least = if further { 0.0 } else { slowest };
            m.slow = Some((1.0 - most).max(least));
        }
    }

    /// No answer keeps cones to what is asked for: they go as far as the brake in force does. False where they have done so.
    pub(super) fn loosen(&mut self) -> bool {
        let m = &mut self.moving;
        let Some(stages) = self.coupled.as_mut().filter(|_| m.is_tight) else { return false };
        (0..m.loose.len()).for_each(|c| stages.sources.set_share(c, m.loose[c]));
        (m.slow, m.is_tight) = (m.slow.or(m.slower), false);
        true
    }

    /// Puts the goal where the fastest way leads.
    pub(super) fn aim(&mut self, v: &[f64]) {
        if !self.moving.on {
            return;
        }
        for &i in &self.dofs.controllable {
            let m = &self.moving;
            let mut goal = match m.slow {
                Some(_) if self.limits.jerk[i].is_finite() => {
                    let brake = Brake::of(&Dof::of(&self.limits, i), &self.period);
                    v[i] + self.period.dt * brake.next(v[i], self.before[i])
                }
                slow => slow.map_or(self.goal[i], |share| share * v[i]),
            };
            // What the box bounds, it clamps and reports by itself.
            if m.lower[i] > self.bounds.v_lower[i] {
                goal = goal.max(m.lower[i]);
            }
            if m.upper[i] < self.bounds.v_upper[i] {
                goal = goal.min(m.upper[i]);
            }
            self.consistent[i] &= goal == self.goal[i];
            self.goal[i] = goal;
        }
    }

    /// Names the hard cones that the state itself is beyond, where that is why it brakes.
    pub(super) fn name_cones(&mut self, q: &[f64], v: &[f64], rows: &mut Vec<usize>) {
        let m = &mut self.moving;
        if m.shares.is_empty() {
            return;
        }
        self.checker.shares_of((q, v), &self.external, &mut m.reached);
        for c in 0..m.shares.len() {
            if m.reached[c] > m.shares[c] * (1.0 + TOO_FAST) {
                name(rows, self.checker.cone_row(c));
            }
        }
    }

    /// The status of a tick whose state or brake is outside of something.
    pub(super) fn named(&self, v: &[f64], outside: &[usize]) -> Status {
        let built = |row: &usize| {
            let stages = self.coupled.as_ref().filter(|_| *row >= v.len());
            stages.is_some_and(|stages| {
                let r = row - v.len();
                r < stages.problem.m && !stages.sources.is_moved(r)
            })
        };
        let recovering = !self.moving.on || self.moving.beyond || outside.iter().any(built);
        if recovering { Status::Recovering } else { Status::Tightening }
    }
}

/// Adds a row that is not there yet.
fn name(rows: &mut Vec<usize>, row: usize) {
    if !rows.contains(&row) {
        rows.push(row);
    }
}
