//! The simulator as forward model: an action whose step would end outside the limits gives way to the nearest one found whose step does not.
//!
//! An action whose step ends inside is left as it is, and the environment takes that step over instead of simulating it twice. Limits are those on
//! positions and velocities of joints, of the state that is reached, contacts included; one period is looked ahead. [`Search`] is the search alone,
//! for any simulator.

mod interior;
mod nearest;
mod search;

pub use nearest::Nearest;
pub use search::{Bound, Search, Verdict};

use crate::env::{Env, Limits};

/// Checks the actions of one environment.
pub struct Foresight {
    search: Search,
    /// What each bound is on.
    bounded: Vec<Coordinate>,
    q: Vec<f64>,
    v: Vec<f64>,
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
        let (mut bounds, mut bounded) = (Vec::new(), Vec::new());
        for (i, (&lower, &upper)) in limits.lower_position.iter().zip(&limits.upper_position).enumerate() {
            if lower.is_finite() || upper.is_finite() {
                bounds.push(Bound::position(lower, upper));
                bounded.push(Coordinate::Position(i));
            }
        }
        for (i, &most) in limits.velocity.iter().enumerate().filter(|(_, most)| most.is_finite()) {
            bounds.push(Bound::velocity(most));
            bounded.push(Coordinate::Velocity(i));
        }
        let ranges: Vec<(f64, f64)> = spec.actuators.iter().map(|a| (a.low, a.high)).collect();
        let search = Search::new(bounds, &ranges, 0);
        Foresight { search, bounded, q: vec![0.0; spec.nq], v: vec![0.0; spec.nv] }
    }

    /// Replaces `action` (n_act) where its step would end outside; `env` then steps as foreseen when it is given the result.
    pub fn update(&mut self, env: &mut dyn Env, action: &mut [f64]) -> Verdict {
        let Foresight { search, bounded, q, v } = self;
        let mut foresee = |action: &[f64], values: &mut [f64]| {
            let is_believable = env.foresee(action, q, v);
            for (value, of) in values.iter_mut().zip(bounded.iter()) {
                *value = match *of {
                    Coordinate::Position(i) => q[i],
                    Coordinate::Velocity(i) => v[i],
                };
            }
            is_believable
        };
        search.update(&mut foresee, action)
    }
}
