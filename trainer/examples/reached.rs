//! Reached states outside the limits, without and with the simulator's guard, beside the share that no sampled action avoids.
//!
//!     cargo run --release -p nearl-trainer --example reached -- SNAPSHOT TICKS SEED
//!
//! One line of comma-separated numbers for each mode, in the order of the header it prints.

use std::path::Path;
use std::time::Instant;

use nearl_runtime::{Controller, Noise, Output, Snapshot, State};
use nearl_trainer::env::{ChaCha8Rng, Env, Limits};
use nearl_trainer::foresight::Foresight;
use nearl_trainer::plant::watched_limits;
use nearl_trainer::rollout::{make_env, stream};
use rand::RngExt;

/// Actions sampled in a tick that ends outside.
const SAMPLES: usize = 400;
/// Share of the ticks that the guard may take for one of time.
const TIMED: usize = 5;

struct Run {
    env: Box<dyn Env>,
    controller: Controller,
    foresight: Option<Foresight>,
    limits: Limits,
    state: State,
    noise: Noise,
    out: Output,
    starts: ChaCha8Rng,
    draws: ChaCha8Rng,
    q: Vec<f64>,
    v: Vec<f64>,
}

#[derive(Default)]
struct Count {
    ticks: usize,
    outside: usize,
    unavoidable: usize,
    from_inside: [usize; 3],
    returns: Vec<f64>,
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [file, ticks, seed] = &args[..] else { return Err("give SNAPSHOT TICKS SEED".into()) };
    let (ticks, seed) = (ticks.parse::<usize>()?, seed.parse::<u64>()?);
    let snapshot = Snapshot::load(Path::new(file))?;
    println!(
        "task,guard,ticks,outside,unavoidable,began_inside,outside_from_inside,unavoidable_from_inside,mean_return,episodes,steps_per_second"
    );
    for guarded in [false, true] {
        let mut run = Run::new(&snapshot, guarded, seed)?;
        let count = run.count(ticks)?;
        let speed = Run::new(&snapshot, guarded, seed)?.speed(ticks * TIMED)?;
        let [began, out, lost] = count.from_inside;
        let mean = count.returns.iter().sum::<f64>() / count.returns.len().max(1) as f64;
        println!(
            "{},{},{},{},{},{began},{out},{lost},{mean:.1},{},{speed:.0}",
            snapshot.manifest.task.name,
            if guarded { "simulator" } else { "none" },
            count.ticks,
            count.outside,
            count.unavoidable,
            count.returns.len()
        );
    }
    Ok(())
}

impl Run {
    fn new(snapshot: &Snapshot, guarded: bool, seed: u64) -> Result<Run, Box<dyn std::error::Error>> {
        let (env, controller) = (make_env(snapshot)?, Controller::new(snapshot)?);
        let limits = watched_limits(&*env, controller.model(), controller.limits());
        let (nq, nv) = (env.spec().nq, env.spec().nv);
        Ok(Run {
            foresight: guarded.then(|| Foresight::new(&*env, &limits)),
            state: controller.state(),
            noise: controller.noise(),
            out: controller.output(),
            starts: stream(seed, 0),
            draws: stream(seed, 1),
            q: vec![0.0; nq],
            v: vec![0.0; nv],
            env,
            controller,
            limits,
        })
    }

    /// Whether a state (MuJoCo's order) is outside the task's limits.
    fn is_outside(&self, q: &[f64], v: &[f64]) -> bool {
        let l = &self.limits;
        let beyond = |i: usize| q[i] < l.lower_position[i] - 1e-9 || q[i] > l.upper_position[i] + 1e-9;
        (0..q.len()).any(beyond) || (0..v.len()).any(|i| v[i].abs() > l.velocity[i] + 1e-9)
    }

    fn choose(&mut self) {
        self.env.observe(&mut self.state.obs);
        self.env.state(&mut self.state.q, &mut self.state.v);
        self.controller.update(&self.state, &self.noise, &mut self.out);
        if let Some(foresight) = &mut self.foresight {
            foresight.update(&mut *self.env, &mut self.out.action);
        }
    }

    /// As in training: several thousand steps, none of them looked at.
    fn speed(&mut self, ticks: usize) -> Result<f64, Box<dyn std::error::Error>> {
        self.env.reset(&mut self.starts)?;
        let (begin, mut length) = (Instant::now(), 0);
        for _ in 0..ticks {
            self.choose();
            let step = self.env.step(&self.out.action);
            length += 1;
            if step.terminated || length >= self.env.spec().max_episode_steps {
                self.env.reset(&mut self.starts)?;
                self.controller.reset();
                length = 0;
            }
        }
        Ok(ticks as f64 / begin.elapsed().as_secs_f64())
    }

    fn count(&mut self, ticks: usize) -> Result<Count, Box<dyn std::error::Error>> {
        let mut count = Count::default();
        self.env.reset(&mut self.starts)?;
        let (mut total, mut length) = (0.0, 0);
        while count.ticks < ticks || length > 0 {
            let inside = !self.is_outside(self.env.qpos(), self.env.qvel());
            self.choose();
            let (mut q, mut v) = (std::mem::take(&mut self.q), std::mem::take(&mut self.v));
            let outside = self.env.foresee(&self.out.action, &mut q, &mut v) && self.is_outside(&q, &v);
            let lost = outside && !self.is_avoidable(&mut q, &mut v);
            (self.q, self.v) = (q, v);
            let step = self.env.step(&self.out.action);
            count.ticks += 1;
            count.outside += usize::from(outside);
            count.unavoidable += usize::from(lost);
            let of = [inside, inside && outside, inside && lost];
            count.from_inside.iter_mut().zip(of).for_each(|(n, is)| *n += usize::from(is));
            (total, length) = (total + step.reward, length + 1);
            if step.terminated || length >= self.env.spec().max_episode_steps {
                count.returns.push(total);
                self.env.reset(&mut self.starts)?;
                self.controller.reset();
                (total, length) = (0.0, 0);
            }
        }
        Ok(count)
    }

    /// Whether one of [`SAMPLES`] actions (near the chosen one, anywhere, at the corners) ends inside.
    fn is_avoidable(&mut self, q: &mut [f64], v: &mut [f64]) -> bool {
        let ranges: Vec<(f64, f64)> = self.env.spec().actuators.iter().map(|a| (a.low, a.high)).collect();
        (0..SAMPLES).any(|k| {
            let draw = |(i, (low, high)): (usize, &(f64, f64))| {
                let r: f64 = self.draws.random_range(-1.0..1.0);
                let half = 0.5 * (high - low);
                match k % 4 {
                    0 | 2 => (self.out.action[i] + half * r * r * r).clamp(*low, *high),
                    1 => low + half * (r + 1.0),
                    _ => {
                        if r > 0.0 {
                            *high
                        } else {
                            *low
                        }
                    }
                }
            };
            let action: Vec<f64> = ranges.iter().enumerate().map(draw).collect();
            self.env.foresee(&action, q, v) && !self.is_outside(q, v)
        })
    }
}
