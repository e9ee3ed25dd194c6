//! The stored brake: before a target is taken, a whole brake from it is verified by inverse dynamics.
//!
//! In a brake every controllable joint slows down with a constant deceleration `b_i` until it stands. For the `k`-th tick
//! of it, with `N_i = floor(|v_i| / (b_i T))` full ticks before the last, shorter one,
//!
//! ```text
//!     v_k = v - k b T,   q_k = q + k T v - b T^2 (k (k - 1) / 2 + kappa k)     (k <= N_i, sign of v)
//! ```
//!
//! The motor forces at the ticks looked at must stay below [`SHARE`] of their limits, and every joint must stand before its
//! position limit. By induction there is always a way to stop: either the new state has a verified brake, or the old one has,
//! and the first tick of that brake leads to a state whose brake is the rest of it.

use super::Dofs;
use crate::viability::{Dof, Period};
use crate::{Dynamics, LimitSet, Model};

/// Share of the motors' limits a brake may use at the ticks looked at; the rest covers the ticks between them.
const SHARE: f64 = 0.97;

/// Ticks of a brake that are looked at, spread over its length.
const LOOKS: u32 = 24;

/// Decelerations tried, between the least that stops in time (0) and the largest braking may count on (1).
const TRIED: [f64; 4] = [1.0, 0.5, 0.2, 0.0];

/// Without a position limit near, a brake takes at least this share of the largest deceleration.
const LEAST: f64 = 0.05;

/// The last verified brake and the scratch to verify another.
pub(crate) struct Backup {
    /// A brake is stored.
    pub(crate) stored: bool,
    /// Its decelerations (nv).
    deceleration: Vec<f64>,
    /// The index into [`TRIED`] that passed last.
    favourite: usize,
    trial: Vec<f64>,
    q: Vec<f64>,
    v: Vec<f64>,
    a: Vec<f64>,
    tau: Vec<f64>,
}

impl Backup {
    pub(crate) fn new(model: &Model) -> Backup {
        let zero = || vec![0.0; model.nv()];
        Backup {
            stored: false,
            deceleration: zero(),
            favourite: 0,
            trial: zero(),
            q: model.neutral(),
            v: zero(),
            a: zero(),
            tau: zero(),
        }
    }

    /// As new: what is tried first next depends on nothing that was.
    pub(crate) fn forget(&mut self) {
        (self.stored, self.favourite) = (false, 0);
    }

    /// Stored or not, what passed last, and the decelerations.
    pub(crate) fn write_memory(&self, memory: &mut Vec<f64>) {
        memory.extend_from_slice(&[f64::from(u8::from(self.stored)), self.favourite as f64]);
        memory.extend_from_slice(&self.deceleration);
    }

    pub(crate) fn set_memory(&mut self, memory: &[f64]) {
        self.stored = memory[0] != 0.0;
        self.favourite = memory[1] as usize % TRIED.len();
        self.deceleration.copy_from_slice(&memory[2..]);
    }

    /// Looks for a brake from the state and stores it; the old one stays when there is none.
    pub(crate) fn verify(&mut self, with: &mut With<'_>, q: &[f64], v: &[f64]) -> bool {
        for k in 0..TRIED.len() {
            let index = (self.favourite + k) % TRIED.len();
            if self.plan(with, q, v, TRIED[index]) && self.within_reach(with, q, v) {
                (self.favourite, self.stored) = (index, true);
                self.deceleration.copy_from_slice(&self.trial);
                return true;
            }
        }
        false
    }

    /// Velocity of dof `i` after one tick of the stored brake.
    pub(crate) fn next_velocity(&self, i: usize, v: f64, period: &Period) -> f64 {
        v - v.signum() * (self.deceleration[i] * period.dt).min(v.abs())
    }

    /// Decelerations of a brake from the state; false when some joint cannot stand before its limit.
    fn plan(&mut self, with: &With<'_>, q: &[f64], v: &[f64], share: f64) -> bool {
        for &i in &with.dofs.controllable {
            let dof = Dof::of(with.limits, i);
            let most = dof.braking(with.period);
            let room = match with.dofs.single[i] {
                Some(iq) if v[i] > 0.0 => dof.upper - q[iq],
                Some(iq) if v[i] < 0.0 => q[iq] - dof.lower,
                _ => f64::INFINITY,
            };
            let least = least_deceleration(room, v[i].abs(), with.period).max(LEAST * most);
            if least > most * (1.0 + 1e-9) {
                return false;
            }
            self.trial[i] = least.min(most) + share * (most - least.min(most));
        }
        true
    }

    /// The motors can give the planned brake: at ticks spread over it, and around those in which a joint comes to rest.
    fn within_reach(&mut self, with: &mut With<'_>, q: &[f64], v: &[f64]) -> bool {
        let dofs = with.dofs;
        let dt = with.period.dt;
        let full = |trial: &[f64], i: usize| (v[i].abs() / (trial[i] * dt)).floor().min(1e6) as u32;
        let last = dofs.controllable.iter().map(|i| full(&self.trial, *i)).max().unwrap_or(0) + 1;
        let stride = (last / LOOKS).max(1);
        let mut k = 0;
        while k < last + stride {
            if !self.holds_at(with, q, v, k.min(last)) {
                return false;
            }
            k += stride;
        }
        dofs.controllable.iter().filter(|i| stride > 1 && v[**i] != 0.0).all(|&i| {
            let rest = full(&self.trial, i);
            (rest.saturating_sub(1)..=rest + 1).all(|k| self.holds_at(with, q, v, k))
        })
    }

    fn holds_at(&mut self, with: &mut With<'_>, q: &[f64], v: &[f64], k: u32) -> bool {
        let (dt, kappa) = (with.period.dt, with.period.kappa);
        self.q.copy_from_slice(q);
        self.v.copy_from_slice(v);
        self.a.fill(0.0);
        for &i in &with.dofs.controllable {
            let (b, speed) = (self.trial[i], v[i].abs());
            let full = (speed / (b * dt)).floor();
            let ticks = f64::from(k).min(full);
            let mut left = speed - ticks * b * dt;
            let mut way = ticks * dt * speed - b * dt * dt * (0.5 * ticks * (ticks - 1.0) + kappa * ticks);
            if f64::from(k) > full {
                (way, left) = (way + dt * left * (1.0 - kappa), 0.0); // the last, shorter tick
            }
            self.a[i] = -v[i].signum() * b.min(left / dt);
            self.v[i] = v[i].signum() * left;
            if let Some(iq) = with.dofs.single[i] {
                self.q[iq] += v[i].signum() * way;
            }
        }
        with.dynamics.motors(with.period, &self.q, &self.v, &self.a, &mut self.tau);
        with.dofs
            .controllable
            .iter()
            .all(|&i| (self.tau[i] - with.external[i]).abs() <= SHARE * with.limits.effort[i])
    }
}

/// What a brake is planned with.
pub(crate) struct With<'a> {
    pub(crate) dynamics: &'a mut Dynamics,
    pub(crate) limits: &'a LimitSet,
    pub(crate) dofs: &'a Dofs,
    pub(crate) period: &'a Period,
    pub(crate) external: &'a [f64],
}

/// The least deceleration that stops within `room` from `speed`: the smaller root of `(speed - b tau / 2)^2 = 2 b room`.
fn least_deceleration(room: f64, speed: f64, period: &Period) -> f64 {
    if room.is_infinite() || speed == 0.0 {
        return 0.0;
    }
    let half = speed * period.tau + 2.0 * room.max(0.0);
    let root = (half * half - (period.tau * speed).powi(2)).max(0.0).sqrt();
    2.0 * speed * speed / (half + root).max(f64::MIN_POSITIVE)
}
