//! A target is taken only when its passage and a whole verified brake from it keep every hard limit.

use super::backup::{Passage, Refusal, With};
use super::ladder::ROW_TOLERANCE;
use super::{Projector, Stages};
use crate::ledger::{BrakeReason, Rung, Status};
use crate::target::{Proposal, Target};
use crate::{Braking, Kind};

/// Projections with rows of what was refused, in a tick.
const ROUNDS: usize = 3;

/// Share of the way to a target that is tried first where nothing was found near it.
const NEARLY: f64 = 0.98;

/// Tries on the way from one tick of the stored brake to the target.
const TRIES: usize = 4;

/// The bits of the projector that a brake is planned with, while the brakes themselves are borrowed.
macro_rules! with {
    ($projector:ident) => {
        With {
            limits: &$projector.in_force,
            dofs: &$projector.dofs,
            period: &$projector.period,
            external: &$projector.external,
            outside: &$projector.outside,
        }
    };
}

impl Projector {
    /// Takes the target if it breaks nothing and a brake from it is verified; else the nearest for which that is so as far as its rows
    /// are linear; else the furthest such state on the way from one tick of the stored brake to the target; else that tick. `checked`: the
    /// checker looked at the passage to the target last.
    pub(super) fn keep_a_brake(
        &mut self,
        q: &[f64],
        v: &[f64],
        proposal: &Proposal,
        target: &mut Target,
        status: Status,
        checked: bool,
    ) -> Status {
        self.backup.begin();
        if self.leads_to_a_brake(q, v, target, checked) {
            return self.taken(q, v, target, status);
        }
        // On the way to moved limits, what the brake in force breaks is all that may be broken.
        let on_the_way = self.moving.coupled && self.backup.stored;
        if !on_the_way && self.backup.excuse(&with!(self), q, v) {
            let inside = match self.backup.excuses_a_cone() {
                true => self.come_inside(q, v, proposal, target, (status, checked)),
                false => None,
            };
            if let Some(status) = inside {
                return self.taken(q, v, target, status);
            }
            if self.leads_to_a_brake(q, v, target, false) {
                return self.taken(q, v, target, status);
            }
        }
        if !self.backup.stored && !self.backup.verify(&with!(self), (q, v), &self.before) {
            return self.brake(q, v, Some(proposal), target, BrakeReason::NoVerifiedBrake);
        }
        self.v_wanted.copy_from_slice(&target.v);
        if !self.project_again(q, v, proposal, target) && !self.go_part_of_the_way(q, v, proposal, target) {
            self.keep_the_passage(q, v, proposal, target);
            self.keep_the_motors(q, v, Some(proposal), target);
            self.report_rung(q, v, target, Rung::StoredBrake);
            return Status::Braked(BrakeReason::NoVerifiedBrake);
        }
        self.report_rung(q, v, target, Rung::StoredBrake);
        if target.ledger.outside.is_empty() { Status::Slowed } else { self.named(v, &target.ledger.outside) }
    }

    /// The rows left no answer: what they ask for may be more than what they keep. Rows that no brake can keep are not left out.
    pub(super) fn without_an_answer(
        &mut self,
        q: &[f64],
        v: &[f64],
        proposal: &Proposal,
        target: &mut Target,
    ) -> Status {
        for &i in &self.dofs.controllable {
            self.v_next[i] = self.goal[i].clamp(self.bounds.v_lower[i], self.bounds.v_upper[i]);
        }
        self.v_wanted.copy_from_slice(&self.v_next);
        self.begin_again(v);
        if !self.take_nearer(v) {
            return self.brake(q, v, Some(proposal), target, BrakeReason::NoCertifiedAnswer);
        }
        self.write(q, v, Some(proposal), target);
        target.ledger.rung = Rung::StoredBrake;
        self.keep_a_brake(q, v, proposal, target, Status::Slowed, false)
    }

    /// A target that is not the nearest allowed state is checked for what its limits keep.
    fn taken(&mut self, q: &[f64], v: &[f64], target: &mut Target, status: Status) -> Status {
        if status == Status::Slowed {
            self.report_rung(q, v, target, Rung::StoredBrake);
            if !target.ledger.outside.is_empty() {
                return self.named(v, &target.ledger.outside);
            }
        }
        status
    }

    /// From outside of a hard cone, a target that keeps it: the noise of a measured speed is gone in a period. Its brake may break by as
    /// much what the state breaks. `None` where no such target is found, and the one there was stays.
    fn come_inside(
        &mut self,
        q: &[f64],
        v: &[f64],
        proposal: &Proposal,
        target: &mut Target,
        (status, checked): (Status, bool),
    ) -> Option<Status> {
        self.backup.be_strict(true);
        if self.leads_to_a_brake(q, v, target, checked) {
            return Some(status);
        }
        let [first_q, first_v, first_a] = &mut self.first;
        first_q.copy_from_slice(&target.q);
        first_v.copy_from_slice(&target.v);
        first_a.copy_from_slice(&target.acceleration);
        let moved = target.ledger.moved;
        self.v_wanted.copy_from_slice(&target.v);
        let stored = self.backup.stored;
        if self.project_again(q, v, proposal, target)
            || (stored && self.go_part_of_the_way(q, v, proposal, target))
        {
            return Some(Status::Slowed);
        }
        self.backup.be_strict(false);
        let [first_q, first_v, first_a] = &self.first;
        target.q.copy_from_slice(first_q);
        target.v.copy_from_slice(first_v);
        target.acceleration.copy_from_slice(first_a);
        target.ledger.moved = moved;
        None
    }

    /// The passage to the target breaks no hard row or cone, and a brake from it is verified, which is then stored. `checked`: the checker
    /// looked at this passage last, so that its motor forces are known.
    fn leads_to_a_brake(&mut self, q: &[f64], v: &[f64], target: &Target, checked: bool) -> bool {
        let with = with!(self);
        let torque = checked.then(|| self.checker.torque());
        self.backup.allows(&with, (q, v), (&target.q, &target.v), torque)
            && self.backup.verify(&with, (&target.q, &target.v), &target.acceleration)
    }

    /// Projects with what was refused as rows, a few times; true when `target` then leads to a brake.
    fn project_again(&mut self, q: &[f64], v: &[f64], proposal: &Proposal, target: &mut Target) -> bool {
        if self.dofs.curved || self.coupled.is_none() {
            return false;
        }
        self.begin_again(v);
        for _ in 0..ROUNDS {
            let passage =
                Passage { from: (q, v), to: (&target.q, &target.v), acceleration: &target.acceleration };
            let Some(refusal) = self.backup.refusal(&with!(self), passage) else { return false };
            self.change(v, &target.v);
            if !self.cut(refusal, passage) || !self.take_nearer(v) {
                return false;
            }
            self.write(q, v, Some(proposal), target);
            self.v_wanted.copy_from_slice(&target.v);
            if self.leads_to_a_brake(q, v, target, false) {
                return true;
            }
        }
        false
    }

    /// Where the measured state is not the one that the stored brake was verified from, a tick of it may break by as much what it kept: the
    /// nearest state to it that breaks nothing takes its place, should one be found.
    fn keep_the_passage(&mut self, q: &[f64], v: &[f64], proposal: &Proposal, target: &mut Target) {
        if self.dofs.curved || self.coupled.is_none() || self.keeps(q, v, target) {
            return;
        }
        self.v_wanted.copy_from_slice(&self.v_stop);
        self.begin_again(v);
        if let Some(stages) = &mut self.coupled {
            stages.nearer.aim(&stages.y);
        }
        for _ in 0..ROUNDS {
            let passage =
                Passage { from: (q, v), to: (&target.q, &target.v), acceleration: &target.acceleration };
            self.backup.refuse_passage();
            self.change(v, &target.v);
            if !self.cut(Refusal::Passage, passage) || !self.take_nearer(v) {
                break;
            }
            self.write(q, v, Some(proposal), target);
            if self.keeps(q, v, target) {
                return;
            }
        }
        self.blend(0.0);
        self.write(q, v, Some(proposal), target);
    }

    /// A tick of a stored brake asks motors for no more than they may give: beyond that they would be cut one by one, and what the others give would throw the
    /// joints. Where it does, as after a push, the nearest velocities for which it does not: with every row that it keeps, or else within the box, or else
    /// within the acceleration limits, or else whatever they are.
    pub(super) fn keep_the_motors(
        &mut self,
        q: &[f64],
        v: &[f64],
        proposal: Option<&Proposal>,
        target: &mut Target,
    ) {
        if self.settings.braking != Braking::Stored || !self.fill_rows(q, v) {
            return;
        }
        self.change(v, &target.v);
        let Some(stages) = &mut self.coupled else { return };
        let Stages { problem: p, nearer, labels, y, .. } = stages;
        let is_motor =
            |r: usize| p.soft[r].is_none() && matches!(labels[r].kind, Kind::Torque | Kind::TorqueSpeed);
        if (0..p.m).all(|r| !is_motor(r) || p.excess(r, y) <= ROW_TOLERANCE) {
            return;
        }
        for attempt in 0..4 {
            nearer.begin(p, y);
            nearer.keep_only(|r| is_motor(r) || attempt == 0 && p.excess(r, y) <= ROW_TOLERANCE);
            nearer.aim(y);
            for (k, &i) in self.dofs.controllable.iter().enumerate() {
                let most = self.in_force.acceleration[i] * self.period.dt;
                match attempt {
                    0 | 1 => nearer.bound(k, self.bounds.v_lower[i] - v[i], self.bounds.v_upper[i] - v[i]),
                    2 => nearer.bound(k, -most, most),
                    _ => nearer.bound(k, f64::NEG_INFINITY, f64::INFINITY),
                }
            }
            if let Some(y) = nearer.solve() {
                for (y, &i) in y.iter().zip(&self.dofs.controllable) {
                    self.v_next[i] = v[i] + y;
                }
                self.consistent.fill(false);
                self.write(q, v, proposal, target);
                return;
            }
        }
    }

    /// The passage to the target breaks no hard row or cone.
    fn keeps(&mut self, q: &[f64], v: &[f64], target: &Target) -> bool {
        self.backup.allows(&with!(self), (q, v), (&target.q, &target.v), None)
    }

    /// The second projection begins at `v_wanted`.
    fn begin_again(&mut self, v: &[f64]) {
        if let Some(stages) = &mut self.coupled {
            for (y, &i) in stages.y.iter_mut().zip(&self.dofs.controllable) {
                *y = self.v_wanted[i] - v[i];
            }
            stages.nearer.begin(&stages.problem, &stages.y);
        }
    }

    /// The velocity change to `to`, of the controllable dofs, becomes the stages' `y`.
    fn change(&mut self, v: &[f64], to: &[f64]) {
        if let Some(stages) = &mut self.coupled {
            for (y, &i) in stages.y.iter_mut().zip(&self.dofs.controllable) {
                *y = to[i] - v[i];
            }
        }
    }

    /// A row for each hard row that is broken at `refusal`; true when there is any.
    fn cut(&mut self, refusal: Refusal, passage: Passage<'_>) -> bool {
        let with = with!(self);
        let Some(stages) = &mut self.coupled else { return false };
        let n = self.dofs.controllable.len();
        let rows = stages.slopes.len() / n;
        let hard = self.backup.found().count().min(rows);
        for (k, &i) in self.dofs.controllable.iter().enumerate() {
            let slopes = &mut stages.slopes[k * rows..k * rows + hard];
            if !self.backup.slopes(&with, (refusal, passage), i, slopes) {
                return false;
            }
        }
        let mut any = false;
        for (r, breach) in self.backup.found().enumerate().filter(|(_, breach)| *breach > 0.0) {
            (0..n).for_each(|k| stages.slope[k] = stages.slopes[k * rows + r]);
            any |= stages.nearer.cut(breach, &stages.slope, &stages.y);
        }
        any
    }

    /// `v_next` from the second projection; false when that has no answer.
    fn take_nearer(&mut self, v: &[f64]) -> bool {
        let Some(stages) = &mut self.coupled else { return false };
        let Some(y) = stages.nearer.solve() else { return false };
        self.consistent.fill(false);
        for (y, &i) in y.iter().zip(&self.dofs.controllable) {
            self.v_next[i] = (v[i] + y).clamp(self.bounds.v_lower[i], self.bounds.v_upper[i]);
        }
        true
    }

    /// The furthest state that leads to a brake, on the way from one tick of the stored brake to the wanted velocities; false when that
    /// is the tick itself.
    fn go_part_of_the_way(&mut self, q: &[f64], v: &[f64], proposal: &Proposal, target: &mut Target) -> bool {
        let (mut good, mut bad) = (0.0, 1.0);
        self.stop(q, v, target, true);
        self.v_stop.copy_from_slice(&self.v_next);
        for k in 0..TRIES {
            let share = if k == 0 { NEARLY } else { 0.5 * (good + bad) };
            self.blend(share);
            self.write(q, v, Some(proposal), target);
            let leads = self.leads_to_a_brake(q, v, target, false);
            *(if leads { &mut good } else { &mut bad }) = share;
            if leads && k == 0 {
                break;
            }
        }
        self.blend(good);
        self.write(q, v, Some(proposal), target);
        good > 0.0
    }

    /// `v_next` between one tick of the stored brake (0) and the wanted velocities (1).
    fn blend(&mut self, share: f64) {
        self.consistent.fill(false);
        self.v_next.copy_from_slice(&self.v_wanted);
        for &i in &self.dofs.controllable {
            let mixed = self.v_stop[i] + share * (self.v_wanted[i] - self.v_stop[i]);
            self.v_next[i] = mixed.clamp(self.bounds.v_lower[i], self.bounds.v_upper[i]);
        }
    }
}
