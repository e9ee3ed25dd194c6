//! Set points of joints that follow by themselves what they are sent: each begins where the one before ended, not where the joint is measured.
//! From there the drive's lag, its droop under a load and the noise of its encoder would go into the next set point, and add up.

use super::Projector;
use crate::viability::Period;
use crate::{Drive, Proposal, Target};

/// How far a joint may lag behind the position it was sent: its way at the speed limit in this time [s], without one this itself [rad or m].
const FOLLOWING: f64 = 0.1;

/// After more periods than this the driver has long come to rest.
const MISSED: u64 = 1000;

/// What joints were sent that follow by themselves.
#[derive(Default)]
pub(super) struct Sent {
    known: bool,
    /// Dofs that are sent positions, with their entry of a configuration and how far they may be from it [rad or m].
    positions: Vec<(usize, usize, f64)>,
    /// Those of them that are further away, with their entry: their set points wait at rest.
    waiting: Vec<(usize, usize)>,
    /// Dofs that are sent velocities.
    velocities: Vec<usize>,
    /// The target of the tick before (nq, nv).
    q: Vec<f64>,
    v: Vec<f64>,
}

impl Projector {
    /// The `drives` (nv) say which controllable joints follow by themselves what they are sent: [`Projector::depart`] has those go on from there.
    pub fn follow(&mut self, drives: &[Drive]) {
        let sent = &mut self.previous.sent;
        (sent.positions, sent.velocities, sent.waiting) = (Vec::new(), Vec::new(), Vec::new());
        for &i in &self.dofs.controllable {
            match (drives[i], self.dofs.single[i]) {
                (Drive::Position, Some(iq)) => {
                    let window = FOLLOWING * self.limits.velocity[i];
                    sent.positions.push((i, iq, if window.is_finite() { window } else { FOLLOWING }));
                }
                (Drive::Velocity, _) => sent.velocities.push(i),
                _ => {}
            }
        }
        sent.waiting.reserve(sent.positions.len());
        (sent.q, sent.v, sent.known) = (self.model.neutral(), vec![0.0; self.model.nv()], false);
    }

    /// Puts what was sent in the tick before in the place of what is measured, `q` (nq) and `v` (nv), of joints that follow by themselves: a set
    /// point that began at the measured position would carry each error of the drive into the next. Of joints that are sent positions and are further
    /// from the last one than they move at their speed limit within 0.1 s (0.1 rad or m without one), what is projected next proposes rest: their set
    /// points wait for them.
    pub fn depart(&mut self, q: &mut [f64], v: &mut [f64]) {
        let sent = &mut self.previous.sent;
        sent.waiting.clear();
        if !sent.known {
            return;
        }
        for &(i, iq, window) in &sent.positions {
            let away = (q[iq] - sent.q[iq]).abs();
            if away.is_nan() {
                continue; // a position that is no number stays, and is refused
            }
            if away > window {
                sent.waiting.push((i, iq));
            }
            (q[iq], v[i]) = (sent.q[iq], sent.v[i]);
        }
        for &i in &sent.velocities {
            v[i] = sent.v[i];
        }
    }

    /// Puts rest in the place of what is `asked` of joints whose set points wait, at `q`, `v`.
    pub(super) fn wait(&self, q: &[f64], v: &[f64], asked: &mut Proposal) {
        let Period { dt, kappa, .. } = self.period;
        for &(i, iq) in &self.previous.sent.waiting {
            let rest = self.rest(i, v[i]);
            asked.v[i] = rest;
            asked.q[iq] = q[iq] + dt * v[i] + kappa * dt * (rest - v[i]);
        }
    }

    /// Periods passed in which nothing was sent, and the driver went on by itself as docs/CONNECT.md has it: positions from the last one on, slower
    /// in each period by what the joint may decelerate, velocities as they were.
    pub fn miss(&mut self, periods: u64) {
        let (dt, sent) = (self.period.dt, &mut self.previous.sent);
        for &(i, iq, _) in &sent.positions {
            for _ in 0..periods.min(MISSED) {
                let slower = (self.limits.acceleration[i] * dt).min(sent.v[i].abs());
                sent.v[i] -= slower.copysign(sent.v[i]);
                sent.q[iq] += dt * sent.v[i];
            }
        }
    }

    /// What was sent in the tick before is not what the robot does: the next tick begins where it is measured.
    pub fn lose(&mut self) {
        self.previous.sent.forget();
    }
}

impl Sent {
    /// As if nothing had been sent.
    pub(super) fn forget(&mut self) {
        self.known = false;
        self.waiting.clear();
    }

    /// Some set point waits for its joint.
    pub(super) fn waits(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Some joint follows by itself.
    pub(super) fn is_any(&self) -> bool {
        !(self.positions.is_empty() && self.velocities.is_empty())
    }

    pub(super) fn write(&self, memory: &mut Vec<f64>) {
        if self.is_any() {
            memory.push(f64::from(u8::from(self.known)));
            memory.extend_from_slice(&self.q);
            memory.extend_from_slice(&self.v);
        }
    }

    /// Takes what [`Sent::write`] wrote; what is left of `memory`.
    pub(super) fn set<'m>(&mut self, memory: &'m [f64]) -> &'m [f64] {
        if !self.is_any() {
            return memory;
        }
        let (q, rest) = memory[1..].split_at(self.q.len());
        let (v, rest) = rest.split_at(self.v.len());
        self.known = memory[0] != 0.0;
        self.waiting.clear();
        self.q.copy_from_slice(q);
        self.v.copy_from_slice(v);
        rest
    }

    /// Makes `target` what was sent in the tick before.
    pub(super) fn remember(&mut self, target: &Target) {
        if self.is_any() {
            self.q.copy_from_slice(&target.q);
            self.v.copy_from_slice(&target.v);
            self.known = true;
        }
    }
}
