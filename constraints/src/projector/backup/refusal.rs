//! What keeps a target from being taken, and how that changes with the velocity change of each joint: rows for a second projection.

use super::{Backup, Plan, ROUNDING, TRIED, With};

/// Share of the largest velocity change of a period by which slopes are looked at.
const PROBE: f64 = 1e-4;

/// Ticks looked at from the first that fails to the end of a brake.
const LATER: u32 = 4;

/// Where a target, or the brake that was planned from it, is furthest beyond some hard row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Refusal {
    /// In the passage to it.
    Passage,
    /// In this tick of the brake.
    Brake(u32),
}

/// From one state to the next in one period.
#[derive(Clone, Copy)]
pub(crate) struct Passage<'a> {
    pub(crate) from: (&'a [f64], &'a [f64]),
    pub(crate) to: (&'a [f64], &'a [f64]),
    /// Acceleration of the passage (nv).
    pub(crate) acceleration: &'a [f64],
}

impl Backup {
    /// Why the target of `passage` is refused: the passage itself or a tick of the brake that is tried first; `None` where that shows nothing
    /// wrong. The breaches of the rows there are [`Backup::found`].
    pub(crate) fn refusal(&mut self, with: &With<'_>, passage: Passage<'_>) -> Option<Refusal> {
        if !self.allows(with, passage.from, passage.to, None) {
            self.refuse_passage();
            return Some(Refusal::Passage);
        }
        let (q, v) = passage.to;
        if !self.plan(with, (q, v), passage.acceleration, self.tried_first()) {
            return None;
        }
        if self.within_reach(with, q, v) {
            return None;
        }
        // From the tick that failed to the end of the brake, the worst of a few.
        let (first, last) = (*self.ticks.last()?, *self.cuts.last()?);
        let (mut worst, mut at) = (ROUNDING, None);
        for n in 0..=LATER {
            let tick = first + last.saturating_sub(first) * n / LATER;
            self.look(with, q, v, tick, 0);
            let most = self.breach.iter().zip(&self.allowed).fold(0.0, |most: f64, (b, a)| most.max(b - a));
            if most > worst {
                (worst, at) = (most, Some(tick));
                self.keep_found();
                self.spared.copy_from_slice(&self.allowed);
            }
        }
        at.map(Refusal::Brake)
    }

    /// By how much each hard row is broken where the last target was refused, less what is allowed.
    pub(crate) fn found(&self) -> impl Iterator<Item = f64> {
        self.found.iter().zip(&self.spared).map(|(found, spared)| found - spared)
    }

    /// Writes to `slopes` (hard rows) how the breaches of a refusal change with the velocity change of dof `i`, by a difference; false where
    /// that is not known.
    pub(crate) fn slopes(
        &mut self,
        with: &With<'_>,
        (refusal, passage): (Refusal, Passage<'_>),
        i: usize,
        slopes: &mut [f64],
    ) -> bool {
        let Some(iq) = with.dofs.single[i] else { return false };
        let (q, v) = passage.to;
        let dt = with.period.dt;
        // Towards standstill, where the number of ticks of a brake does not grow.
        let probe = -v[i].signum() * PROBE * with.limits.acceleration[i].min(1e6) * dt;
        let mut near = std::mem::take(&mut self.near);
        near.q.copy_from_slice(q);
        near.v.copy_from_slice(v);
        near.a.copy_from_slice(passage.acceleration);
        near.q[iq] += with.period.kappa * dt * probe;
        near.v[i] += probe;
        near.a[i] += probe / dt;
        let known = match refusal {
            Refusal::Passage => {
                self.allows(with, passage.from, (&near.q, &near.v), None);
                true
            }
            Refusal::Brake(tick) => {
                let planned = self.plan(with, (&near.q, &near.v), &near.a, self.tried_first());
                if planned {
                    self.look(with, &near.q, &near.v, tick, 0);
                }
                planned
            }
        };
        self.near = near;
        for ((slope, then), now) in slopes.iter_mut().zip(&self.breach).zip(&self.found) {
            *slope = (then - now) / probe;
        }
        known
    }

    fn tried_first(&self) -> Plan {
        TRIED[self.favourite]
    }

    /// The passage that was looked at last is refused.
    pub(crate) fn refuse_passage(&mut self) {
        self.keep_found();
        for r in 0..self.spared.len() {
            self.spared[r] = self.allowed_in_a_passage(r);
        }
    }

    fn keep_found(&mut self) {
        let rows = self.allowed.len();
        self.found.copy_from_slice(&self.breach[..rows]);
    }
}
