//! The search for an action whose step ends within bounds: by slopes, then among drawn ones, from several starts. What a step leads to, the caller says.

use super::Nearest;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// Searches, each from the best action so far, which is the one asked for at first.
const STARTS: usize = 4;
/// The one that begins in the middle of the range instead: a search goes on near its start, and there slopes are other ones.
const FROM_MIDDLE: usize = 2;
/// Actions tried by linearised dynamics, one after the other.
const ROUNDS: usize = 4;
/// Actions drawn where these do not do.
const DRAWS: usize = 64;
/// Step of the differences, as a share of an action's range.
const STEP: f64 = 0.01;
/// How far inside the bounds linearised dynamics aim, as a share of a velocity limit or of a joint's range.
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

impl Verdict {
    /// Its name in words.
    pub fn name(self) -> &'static str {
        match self {
            Self::Kept => "kept",
            Self::Replaced => "replaced",
            Self::Outside => "outside",
        }
    }
}

/// Between what a position or a velocity may be.
#[derive(Clone, Copy, Debug)]
pub struct Bound {
    lower: f64,
    upper: f64,
    /// What its excess is measured by.
    size: f64,
}

impl Bound {
    /// Of a position [rad or m]; an infinite bound is none.
    pub fn position(lower: f64, upper: f64) -> Bound {
        let size = if (upper - lower).is_finite() { (upper - lower).max(1e-6) } else { 1.0 };
        Bound { lower, upper, size }
    }

    /// Of a velocity [rad/s or m/s], in both directions.
    pub fn velocity(most: f64) -> Bound {
        Bound { lower: -most, upper: most, size: most.max(1e-6) }
    }
}

/// Writes the bounded values (bounds) that a step under an action (n_act) leads to; false where the physics cannot be believed.
pub(super) type Foresee<'a> = dyn FnMut(&[f64], &mut [f64]) -> bool + 'a;

/// Finds actions whose step ends within bounds.
pub struct Search {
    bounds: Vec<Bound>,
    /// Middle and half range of each action.
    range: Vec<(f64, f64)>,
    /// Of the drawn actions.
    seed: u64,
    nearest: Nearest,
    /// Actions in units of their half ranges: as asked for, at a start, under trial, best so far, and beside one of these.
    asked: Vec<f64>,
    start: Vec<f64>,
    trial: Vec<f64>,
    best: Vec<f64>,
    beside: Vec<f64>,
    action: Vec<f64>,
    /// Values under the trial (bounds), and beside it.
    at: Vec<f64>,
    aside: Vec<f64>,
    /// Bounds x actions.
    slope: Vec<f64>,
}

impl Search {
    /// For actions within `ranges`, lowest and highest of each (n_act). The same state, action and seed give the same result.
    pub fn new(bounds: Vec<Bound>, ranges: &[(f64, f64)], seed: u64) -> Search {
        let middle_and_half = |(low, high): &(f64, f64)| (0.5 * (low + high), (0.5 * (high - low)).max(1e-9));
        let range: Vec<(f64, f64)> = ranges.iter().map(middle_and_half).collect();
        let (n, m) = (range.len(), bounds.len());
        let zero = || vec![0.0; n];
        Search {
            nearest: Nearest::new(n, m),
            asked: zero(),
            start: zero(),
            trial: zero(),
            best: zero(),
            beside: zero(),
            action: zero(),
            at: vec![0.0; m],
            aside: vec![0.0; m],
            slope: vec![0.0; m * n],
            bounds,
            range,
            seed,
        }
    }

    /// Number of bounds.
    pub fn n_bounds(&self) -> usize {
        self.bounds.len()
    }

    /// Replaces `action` (n_act) where its step would end outside, or where the physics cannot be believed. The last step foreseen is that of the result.
    pub fn update(&mut self, foresee: &mut Foresee, action: &mut [f64]) -> Verdict {
        // Where the physics cannot be believed nothing says that it ends inside.
        let first = if foresee(action, &mut self.at) { self.excess(&self.at) } else { f64::INFINITY };
        if first <= 0.0 {
            return Verdict::Kept;
        }
        for (asked, (a, (middle, half))) in self.asked.iter_mut().zip(action.iter().zip(&self.range)) {
            *asked = ((a - middle) / half).clamp(-1.0, 1.0);
        }
        self.best.copy_from_slice(&self.asked);
        // The same draws in every tick: what is sent depends on state and action alone.
        let (mut least, mut rng) = (first, ChaCha8Rng::seed_from_u64(self.seed));
        for start in 0..STARTS {
            match start {
                FROM_MIDDLE => self.start.fill(0.0),
                _ => self.start.copy_from_slice(&self.best),
            }
            least = self.by_slopes(foresee, least);
            if least > 0.0 {
                least = self.by_draws(foresee, &mut rng, least);
            }
            if least <= 0.0 {
                break;
            }
        }
        if least < first {
            for (a, (best, (middle, half))) in action.iter_mut().zip(self.best.iter().zip(&self.range)) {
                *a = middle + half * best;
            }
        }
        foresee(action, &mut self.at);
        if least <= 0.0 { Verdict::Replaced } else { Verdict::Outside }
    }

    /// Newton's way: the action nearest to the start by dynamics linearised at the last one, confirmed by a step. Least excess of those tried.
    fn by_slopes(&mut self, foresee: &mut Foresee, first: f64) -> f64 {
        let (n, mut least) = (self.range.len(), first);
        self.trial.copy_from_slice(&self.start);
        for round in 0..=ROUNDS {
            self.beside.copy_from_slice(&self.trial);
            let excess = self.ahead(foresee);
            if excess < least {
                (least, _) = (excess, self.best.copy_from_slice(&self.trial));
            }
            if excess <= 0.0 || excess.is_infinite() || round == ROUNDS {
                break;
            }
            for k in 0..n {
                self.beside.copy_from_slice(&self.trial);
                let step = if self.trial[k] > 0.0 { -STEP } else { STEP };
                self.beside[k] += step;
                self.scale();
                if !foresee(&self.action, &mut self.aside) {
                    return least;
                }
                for (r, (aside, at)) in self.aside.iter().zip(&self.at).enumerate() {
                    self.slope[r * n + k] = (aside - at) / step;
                }
            }
            let Search { nearest, slope, bounds, at, trial, start, .. } = self;
            nearest.solve(start, trial, slope, |r| {
                let (bound, inside) = (&bounds[r], INSIDE * bounds[r].size);
                [bound.lower + inside - at[r], bound.upper - inside - at[r]]
            });
            self.trial.copy_from_slice(self.nearest.solution());
        }
        least
    }

    /// Draws around the best, over the whole range and from its corners, in turn; the nearest that is inside, else the least far outside.
    fn by_draws(&mut self, foresee: &mut Foresee, rng: &mut ChaCha8Rng, first: f64) -> f64 {
        let (mut least, mut nearest) = (first, f64::INFINITY);
        let around = self.best.clone();
        for draw in 0..DRAWS {
            for (k, u) in self.beside.iter_mut().enumerate() {
                let r: f64 = rng.random_range(-1.0..1.0);
                *u = match draw % 4 {
                    0 | 2 => (around[k] + 0.5 * r * r * r).clamp(-1.0, 1.0),
                    1 => r,
                    _ => r.signum(),
                };
            }
            let excess = self.ahead(foresee);
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

    /// Excess after a step under `beside`, whose values are then in `at`; infinite where the physics cannot be believed.
    fn ahead(&mut self, foresee: &mut Foresee) -> f64 {
        self.scale();
        if foresee(&self.action, &mut self.at) { self.excess(&self.at) } else { f64::INFINITY }
    }

    /// Writes `beside` in units of the action.
    fn scale(&mut self) {
        for (a, (u, (middle, half))) in self.action.iter_mut().zip(self.beside.iter().zip(&self.range)) {
            *a = middle + half * u;
        }
    }

    /// How far `values` (bounds) are outside, in shares of the bounds' sizes; 0 inside, infinite where one is no number.
    pub fn excess(&self, values: &[f64]) -> f64 {
        let beyond = |(x, bound): (&f64, &Bound)| {
            let by = (bound.lower - x).max(x - bound.upper);
            match x.is_nan() {
                true => f64::INFINITY,
                false if by > ROUNDING => by / bound.size,
                false => 0.0,
            }
        };
        values.iter().zip(&self.bounds).map(beyond).sum()
    }
}
