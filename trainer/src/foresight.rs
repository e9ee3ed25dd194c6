//! The simulator as forward model: an action whose step would end outside the limits gives way to the nearest one found whose step does not.
//!
//! Every other action costs nothing but a copy of the state: its step is taken over as it was foreseen. Limits are those on positions and
//! velocities of joints, of the state that is reached, contacts included; one period is looked ahead.

mod interior;
mod nearest;

pub use nearest::Nearest;

use crate::env::{Env, Limits};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// Actions tried by linearised dynamics, one after the other.
const ROUNDS: usize = 4;
/// Actions drawn where these do not do.
const DRAWS: usize = 64;
/// Step of the differences, as a share of an action's range.
const STEP: f64 = 0.01;
/// How far inside the limits linearised dynamics aim, as a share of a velocity limit or of a joint's range.
const INSIDE: f64 = 1e-3;
/// What is outside by less is inside [rad or m, per s].
const ROUNDING: f64 = 1e-9;

/// What became of an action.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It leads to a state within the limits and was left as it is, bit for bit.
    Kept,
    /// Another one was found that does.
    Replaced,
    /// None was found; the one that leads least far outside was taken.
    Outside,
}

/// Checks the actions of one environment.
pub struct Foresight {
    rows: Vec<Row>,
    /// Middle and half range of each action.
    range: Vec<(f64, f64)>,
    nearest: Nearest,
    q: Vec<f64>,
    v: Vec<f64>,
    /// Actions in units of their half ranges: as asked for, under trial, best so far, and moved in one entry.
    asked: Vec<f64>,
    trial: Vec<f64>,
    best: Vec<f64>,
    beside: Vec<f64>,
    action: Vec<f64>,
    /// Value of each row under the trial (rows), and beside it.
    at: Vec<f64>,
    aside: Vec<f64>,
    /// Rows x actions.
    slope: Vec<f64>,
}

/// A position or a velocity that has limits.
struct Row {
    of: Coordinate,
    lower: f64,
    upper: f64,
    /// What its excess is measured by.
    size: f64,
}

#[derive(Clone, Copy)]
enum Coordinate {
    Position(usize),
    Velocity(usize),
}

impl Foresight {
    /// For the `limits` of `env`, in MuJoCo's order.
    pub fn new(env: &dyn Env, limits: &Limits) -> Foresight {
        let spec = env.spec();
        let mut rows = Vec::new();
        for (i, (&lower, &upper)) in limits.lower_position.iter().zip(&limits.upper_position).enumerate() {
            if lower.is_finite() || upper.is_finite() {
                let size = if (upper - lower).is_finite() { (upper - lower).max(1e-6) } else { 1.0 };
                rows.push(Row { of: Coordinate::Position(i), lower, upper, size });
            }
        }
        for (i, &most) in limits.velocity.iter().enumerate().filter(|(_, most)| most.is_finite()) {
            rows.push(Row { of: Coordinate::Velocity(i), lower: -most, upper: most, size: most.max(1e-6) });
        }
        let range: Vec<(f64, f64)> = spec
            .actuators
            .iter()
            .map(|a| (0.5 * (a.low + a.high), (0.5 * (a.high - a.low)).max(1e-9)))
            .collect();
        let (n, m) = (range.len(), rows.len());
        let zero = || vec![0.0; n];
        Foresight {
            nearest: Nearest::new(n, m),
            q: vec![0.0; spec.nq],
            v: vec![0.0; spec.nv],
            asked: zero(),
            trial: zero(),
            best: zero(),
            beside: zero(),
            action: zero(),
            at: vec![0.0; m],
            aside: vec![0.0; m],
            slope: vec![0.0; m * n],
            rows,
            range,
        }
    }

    /// Replaces `action` (n_act) where its step would end outside; `env` then steps as foreseen when it is given the result.
    pub fn update(&mut self, env: &mut dyn Env, action: &mut [f64]) -> Verdict {
        if !env.foresee(action, &mut self.q, &mut self.v) {
            return Verdict::Kept; // what the physics cannot do is the environment's to report
        }
        self.measure();
        let first = self.excess();
        if first <= 0.0 {
            return Verdict::Kept;
        }
        for (asked, (a, (middle, half))) in self.asked.iter_mut().zip(action.iter().zip(&self.range)) {
            *asked = ((a - middle) / half).clamp(-1.0, 1.0);
        }
        self.best.copy_from_slice(&self.asked);
        let mut least = self.by_slopes(env, first);
        if least > 0.0 {
            least = self.by_draws(env, least);
        }
        if least < first {
            for (a, (best, (middle, half))) in action.iter_mut().zip(self.best.iter().zip(&self.range)) {
                *a = middle + half * best;
            }
        }
        env.foresee(action, &mut self.q, &mut self.v);
        if least <= 0.0 { Verdict::Replaced } else { Verdict::Outside }
    }

    /// Newton's way: the nearest action by dynamics linearised at the last one, confirmed by a step. Least excess of those tried.
    fn by_slopes(&mut self, env: &mut dyn Env, first: f64) -> f64 {
        let (n, mut least) = (self.range.len(), first);
        self.trial.copy_from_slice(&self.asked);
        for _ in 0..ROUNDS {
            for k in 0..n {
                self.beside.copy_from_slice(&self.trial);
                let step = if self.trial[k] > 0.0 { -STEP } else { STEP };
                self.beside[k] += step;
                if !self.step(env, false) {
                    return least;
                }
                for (r, (aside, at)) in self.aside.iter().zip(&self.at).enumerate() {
                    self.slope[r * n + k] = (aside - at) / step;
                }
            }
            let Foresight { nearest, slope, rows, at, trial, asked, .. } = self;
            nearest.solve(asked, trial, slope, |r| {
                let (row, inside) = (&rows[r], INSIDE * rows[r].size);
                [row.lower + inside - at[r], row.upper - inside - at[r]]
            });
            self.trial.copy_from_slice(self.nearest.solution());
            self.beside.copy_from_slice(&self.trial);
            if !self.step(env, true) {
                return least;
            }
            let excess = self.excess();
            if excess < least {
                (least, _) = (excess, self.best.copy_from_slice(&self.trial));
            }
            if excess <= 0.0 {
                break;
            }
        }
        least
    }

    /// Draws around the best, over the whole range and from its corners, in turn; the nearest that is inside, else the least far outside.
    fn by_draws(&mut self, env: &mut dyn Env, first: f64) -> f64 {
        let (mut least, mut nearest) = (first, f64::INFINITY);
        let around = self.best.clone();
        // The same draws in every tick: what is sent depends on state and action alone.
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        for draw in 0..DRAWS {
            for (k, u) in self.beside.iter_mut().enumerate() {
                let r: f64 = rng.random_range(-1.0..1.0);
                *u = match draw % 4 {
                    0 | 2 => (around[k] + 0.5 * r * r * r).clamp(-1.0, 1.0),
                    1 => r,
                    _ => r.signum(),
                };
            }
            if !self.step(env, true) {
                continue;
            }
            let excess = self.excess();
            let way: f64 = self.beside.iter().zip(&self.asked).map(|(a, b)| (a - b) * (a - b)).sum();
            if (excess <= 0.0 && way < nearest) || (nearest.is_infinite() && excess < least) {
                least = excess.min(least);
                nearest = if excess <= 0.0 { way } else { nearest };
                self.best.copy_from_slice(&self.beside);
            }
            if nearest.is_finite() && draw >= DRAWS / 4 {
                break;
            }
        }
        least
    }

    /// Foresees the action `beside`; its rows go to `at` or `aside`. False when the physics cannot be believed.
    fn step(&mut self, env: &mut dyn Env, is_trial: bool) -> bool {
        for (a, (u, (middle, half))) in self.action.iter_mut().zip(self.beside.iter().zip(&self.range)) {
            *a = middle + half * u;
        }
        if !env.foresee(&self.action, &mut self.q, &mut self.v) {
            return false;
        }
        match is_trial {
            true => self.measure(),
            false => {
                let Foresight { rows, q, v, aside, .. } = self;
                aside.iter_mut().zip(rows.iter()).for_each(|(x, row)| *x = row.value(q, v));
            }
        }
        true
    }

    fn measure(&mut self) {
        let Foresight { rows, q, v, at, .. } = self;
        at.iter_mut().zip(rows.iter()).for_each(|(x, row)| *x = row.value(q, v));
    }

    /// Sum of the rows' excesses as shares of their sizes; 0 inside.
    fn excess(&self) -> f64 {
        let beyond = |(x, row): (&f64, &Row)| {
            let by = (row.lower - x).max(x - row.upper);
            if by > ROUNDING { by / row.size } else { 0.0 }
        };
        self.at.iter().zip(&self.rows).map(beyond).sum()
    }
}

impl Row {
    fn value(&self, q: &[f64], v: &[f64]) -> f64 {
        match self.of {
            Coordinate::Position(i) => q[i],
            Coordinate::Velocity(i) => v[i],
        }
    }
}
