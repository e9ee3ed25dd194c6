//! Set points of joints that follow by themselves what they are sent: each begins where the one before ended, not where the joint is measured.
//! From there the drive's lag, its droop under a load and the noise of its encoder would go into the next set point, and add up.

use super::{History, Projector};
use crate::viability::Period;
use crate::{Drive, Proposal, Target};

/// How far a joint may lag behind the position it was sent: its way at the speed limit in this time [s], without one this itself [rad or m].
const FOLLOWING: f64 = 0.1;

/// After more periods than this the driver has long come to rest.
const MISSED: u64 = 1000;

/// What a joint was sent that follows by itself.
#[derive(Clone, Copy, Default)]
struct SetPoint {
    /// Position; 0 where it is sent velocities \[rad or m\].
    q: f64,
    /// Velocity at the end of its period.
    v: f64,
    /// Mean velocity of its period, by which a driver of positions goes on that hears nothing more.
    mean: f64,
}

/// A joint that follows by itself what it is sent.
struct Follower {
    dof: usize,
    /// Where it is sent positions: its entry of a configuration and how far it may be from the last one [rad or m].
    position: Option<(usize, f64)>,
    last: SetPoint,
    before: SetPoint,
}

/// What joints were sent that follow by themselves.
#[derive(Default)]
pub(super) struct Sent {
    joints: Vec<Follower>,
    /// How many of the last two set points are known.
    known: usize,
    /// Dofs that are further away, with their entry of a configuration: their set points wait at rest.
    waiting: Vec<(usize, usize)>,
}

impl Projector {
    /// The `drives` (nv) say which controllable joints follow by themselves what they are sent: [`Projector::depart`] has those go on from there.
    pub fn follow(&mut self, drives: &[Drive]) {
        let mut joints = Vec::new();
        let zero = SetPoint::default();
        for &dof in &self.dofs.controllable {
            let position = match (drives[dof], self.dofs.single[dof]) {
                (Drive::Position, Some(iq)) => {
                    let window = FOLLOWING * self.limits.velocity[dof];
                    Some((iq, if window.is_finite() { window } else { FOLLOWING }))
                }
                (Drive::Velocity, _) => None,
                _ => continue,
            };
            joints.push(Follower { dof, position, last: zero, before: zero });
        }
        self.previous.sent = Sent { waiting: Vec::with_capacity(joints.len()), known: 0, joints };
    }

    /// Whether dof `i` goes on from what it was sent, whatever is measured.
    pub fn follows(&self, i: usize) -> bool {
        self.previous.sent.joints.iter().any(|joint| joint.dof == i)
    }

    /// Puts what was sent in the tick before in the place of what is measured, `q` (nq) and `v` (nv), of joints that follow by themselves: a set
    /// point that began at the measured position would carry each error of the drive into the next. Of joints that are sent positions and are further
    /// from the last one than they move at their speed limit within 0.1 s (0.1 rad or m without one), what is projected next proposes rest: their set
    /// points wait for them.
    pub fn depart(&mut self, q: &mut [f64], v: &mut [f64]) {
        let sent = &mut self.previous.sent;
        sent.waiting.clear();
        if sent.known == 0 {
            return;
        }
        for &Follower { dof, position, last, .. } in &sent.joints {
            if let Some((iq, window)) = position {
                let away = (q[iq] - last.q).abs();
                if away.is_nan() {
                    continue; // a position that is no number stays, and is refused
                }
                if away > window {
                    sent.waiting.push((dof, iq));
                }
                q[iq] = last.q;
            }
            v[dof] = last.v;
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

    /// Periods passed in which nothing was sent, and the driver went on by itself as docs/CONNECT.md has it: positions from the last two on, slower
    /// in each period by what the joint may decelerate, velocities and forces as they were.
    pub fn miss(&mut self, periods: u64) {
        let Period { dt, kappa, .. } = self.period;
        let History { asked, sent, .. } = &mut self.previous;
        let mut asked = asked.get_mut();
        for Follower { dof, position, last, .. } in &mut sent.joints {
            for _ in 0..periods.min(MISSED) {
                let mut acceleration = 0.0;
                if position.is_some() {
                    let slower =
                        (self.limits.acceleration[*dof] * dt).min(last.mean.abs()).copysign(last.mean);
                    last.mean -= slower;
                    // A period that is slowed ends slower than it was on average.
                    last.v = (last.mean.abs() - (1.0 - kappa) * slower.abs()).max(0.0).copysign(last.mean);
                    last.q += dt * last.mean;
                    acceleration = -slower / dt;
                }
                if let Some(asked) = &mut asked {
                    asked[*dof] = acceleration;
                }
            }
        }
    }

    /// The target of the tick before came too late and was never sent: what was sent last is that of the tick before it.
    pub fn recall(&mut self) {
        let History { asked, sent, .. } = &mut self.previous;
        asked.recall();
        sent.known = sent.known.saturating_sub(1);
        sent.joints.iter_mut().for_each(|joint| joint.last = joint.before);
    }

    /// What was sent in the tick before is not what the robot does: the next tick begins where it is measured, and limits on a change from the tick
    /// before do not hold in it.
    pub fn lose(&mut self) {
        self.previous.asked.forget();
        self.previous.sent.forget();
    }
}

impl Sent {
    /// As if nothing had been sent.
    pub(super) fn forget(&mut self) {
        self.known = 0;
        self.waiting.clear();
    }

    /// Some set point waits for its joint.
    pub(super) fn waits(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Some joint follows by itself.
    pub(super) fn is_any(&self) -> bool {
        !self.joints.is_empty()
    }

    pub(super) fn write(&self, memory: &mut Vec<f64>) {
        if self.is_any() {
            memory.push(self.known as f64);
            for SetPoint { q, v, mean } in self.joints.iter().flat_map(|joint| [joint.last, joint.before]) {
                memory.extend([q, v, mean]);
            }
        }
    }

    /// Takes what [`Sent::write`] wrote; what is left of `memory`.
    pub(super) fn set<'m>(&mut self, memory: &'m [f64]) -> &'m [f64] {
        if !self.is_any() {
            return memory;
        }
        let (points, rest) = memory[1..].split_at(6 * self.joints.len());
        let of = |p: &[f64]| SetPoint { q: p[0], v: p[1], mean: p[2] };
        for (joint, points) in self.joints.iter_mut().zip(points.chunks_exact(6)) {
            (joint.last, joint.before) = (of(&points[..3]), of(&points[3..]));
        }
        self.known = memory[0] as usize;
        self.waiting.clear();
        rest
    }

    /// Makes `target` what was sent in the tick before.
    pub(super) fn remember(&mut self, target: &Target, period: &Period) {
        let Period { dt, kappa, .. } = *period;
        for joint in &mut self.joints {
            joint.before = joint.last;
            let (v, a) = (target.v[joint.dof], target.acceleration[joint.dof]);
            let (q, mean) = match joint.position {
                Some((iq, _)) if self.known > 0 => (target.q[iq], (target.q[iq] - joint.before.q) / dt),
                Some((iq, _)) => (target.q[iq], v - (1.0 - kappa) * dt * a), // from where it was measured
                None => (0.0, v),
            };
            joint.last = SetPoint { q, v, mean };
        }
        self.known = (self.known + 1).min(2);
    }
}
