//! Speed of the physics alone: the ceiling of any training on it.

use std::thread;
use std::time::{Duration, Instant};

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use super::{Env, EnvError};

/// Environments each thread goes round, as a rollout does.
const ENVS: usize = 8;

/// What [`physics`] measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Physics {
    /// Control periods simulated, all threads together.
    pub steps: u64,
    /// Wall-clock time \[s\].
    pub seconds: f64,
}

impl Physics {
    /// Control periods per second, all threads together.
    pub fn steps_per_second(&self) -> f64 {
        self.steps as f64 / self.seconds
    }
}

/// Steps copies of `first` with uniform random actions on `threads` threads for about `duration`, observing every state and starting a
/// new episode at every end. Nothing is learned: this is what training cannot exceed.
///
/// # Errors
/// [`EnvError`] of [`Env::another`] and [`Env::reset`].
pub fn physics(first: &dyn Env, threads: usize, duration: Duration) -> Result<Physics, EnvError> {
    let mut gangs = Vec::new();
    for _ in 0..threads.max(1) {
        gangs.push((0..ENVS).map(|_| first.another()).collect::<Result<Vec<_>, _>>()?);
    }
    let started = Instant::now();
    let end = started + duration;
    let steps = thread::scope(|scope| {
        let running: Vec<_> = gangs
            .into_iter()
            .zip(0u64..)
            .map(|(gang, seed)| scope.spawn(move || drive(gang, seed, end)))
            .collect();
        running
            .into_iter()
            .map(|thread| thread.join().expect("a benchmark thread panicked"))
            .sum::<Result<u64, _>>()
    })?;
    Ok(Physics { steps, seconds: started.elapsed().as_secs_f64() })
}

/// Steps every environment of a thread in turn until `end`, once at least: a thread that had no core till then has been measured too.
fn drive(mut envs: Vec<Box<dyn Env>>, seed: u64, end: Instant) -> Result<u64, EnvError> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let spec = envs[0].spec().clone();
    let ranges: Vec<_> = spec.action_low().zip(spec.action_high()).collect();
    let (mut obs, mut action) = (vec![0.0; spec.n_obs()], vec![0.0; spec.n_act()]);
    for env in &mut envs {
        env.reset(&mut rng)?;
    }
    let mut ages = vec![0; envs.len()];
    let mut steps = 0;
    while steps == 0 || Instant::now() < end {
        for (env, age) in envs.iter_mut().zip(&mut ages) {
            for (a, (low, high)) in action.iter_mut().zip(&ranges) {
                *a = rng.random_range(*low..*high);
            }
            *age += 1;
            steps += 1;
            if env.step(&action).terminated || *age == spec.max_episode_steps {
                env.reset(&mut rng)?;
                *age = 0;
            }
            env.observe(&mut obs);
        }
    }
    Ok(steps)
}
