//! `nearl bench`: latency and throughput, each beside its own floor measured in the same run.

use super::{Failure, cores, say};
use crate::allocations::allocations;
use crate::learn::Algorithm;
use crate::preset::Preset;
use crate::rollout::{make_env, stream};
use crate::train::{Request, Training, complete};
use crate::{env, tasks};
use clap::{Args, Subcommand};
use hdrhistogram::Histogram;
use nearl_runtime::constraints::Rung;
use nearl_runtime::{Controller, Snapshot};
use rand_distr::{Distribution, StandardNormal};
use std::time::{Duration, Instant};

#[derive(Args)]
pub(super) struct Bench {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// Training steps per second, beside the physics alone.
    Train(TrainBench),
    /// One controller update: percentiles beside an empty timer.
    Update(Ticks),
    /// One projection: percentiles beside an empty timer.
    Projection(Ticks),
    /// Rollouts served over shared memory, beside as many collected in this process.
    Serve(super::bench_serve::ServeBench),
    /// Plant and loop of the Panda under load and hot swaps: everything the loop promises, counted.
    Soak(super::soak::Soak),
    #[command(flatten)]
    Loop(nearl_runtime::cli::LoopBench),
}

#[derive(Args)]
struct TrainBench {
    /// Task.
    #[arg(default_value = "HalfCheetah-v5")]
    task: String,
    #[arg(long, default_value = "pid2-ib", help = super::train::one_of())]
    algo: String,
    #[arg(long, help = super::train::one_preset())]
    preset: Option<Preset>,
    /// Seconds of training in each repetition.
    #[arg(long, default_value_t = 5.0)]
    seconds: f64,
    /// Repetitions, alternating with the physics.
    #[arg(long, default_value_t = 3)]
    repeat: usize,
    /// Seconds of the physics alone beside each repetition; 0 leaves it out.
    #[arg(long, default_value_t = 3.0)]
    physics_seconds: f64,
    /// Overrides of the task file, e.g. `train.ppo.batch_size=2048`.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Args)]
struct Ticks {
    /// Task.
    #[arg(default_value = "HalfCheetah-v5")]
    task: String,
    /// Ticks.
    #[arg(long, default_value_t = 100_000)]
    ticks: usize,
    /// Overrides of the task file.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

impl Bench {
    pub(super) fn run(self) -> Result<(), Failure> {
        match self.what {
            What::Train(b) => b.run(),
            What::Update(b) => b.run(true),
            What::Projection(b) => b.run(false),
            What::Serve(b) => b.run(),
            What::Soak(b) => b.run(),
            What::Loop(b) => b.run(),
        }
    }
}

fn request(task: &str, algo: Algorithm, preset: Option<Preset>, set: &[String]) -> Result<Request, Failure> {
    let mut manifest = tasks::load_with(task, preset, set)?;
    complete(&mut manifest)?;
    Ok(Request { manifest, algo, steps: u64::MAX, seed: 0, threads: cores() })
}

impl TrainBench {
    fn run(self) -> Result<(), Failure> {
        let algo: Algorithm = self.algo.parse()?;
        let request = request(&self.task, algo, self.preset, &self.set)?;
        let ticks = request.manifest.task.time.policy_every as f64;
        let (mut rates, mut ceilings, mut shares) = (Vec::new(), Vec::new(), Vec::new());
        for _ in 0..self.repeat.max(1) {
            let mut training = Training::new(&request)?;
            training.try_iterate()?;
            let (start, from) = (Instant::now(), training.snapshot().manifest.steps);
            while start.elapsed().as_secs_f64() < self.seconds {
                training.try_iterate()?;
            }
            let seconds = start.elapsed().as_secs_f64();
            rates.push((training.snapshot().manifest.steps - from) as f64 / seconds);
            shares.push(training.learning_seconds() / seconds);
            let physics_time = self.physics_seconds.min(self.seconds);
            if physics_time > 0.0 {
                let env = make_env(training.snapshot())?;
                let physics =
                    env::bench::physics(env.as_ref(), cores(), Duration::from_secs_f64(physics_time))?;
                ceilings.push(physics.steps_per_second() / ticks);
            }
        }
        let median = |x: &mut Vec<f64>| {
            x.sort_by(f64::total_cmp);
            x.get(x.len() / 2).copied()
        };
        let (Some(rate), Some(share)) = (median(&mut rates), median(&mut shares)) else { return Ok(()) };
        let ceiling = median(&mut ceilings);
        if self.json {
            say(
                serde_json::json!({ "task": self.task, "algo": algo.name(), "threads": cores(), "steps_per_s": rate,
                "physics_steps_per_s": ceiling, "fraction": ceiling.map(|c| rate / c), "update_share": share }),
            );
        } else {
            let beside = ceiling.map_or(String::new(), |c| {
                format!(" {:.0} % of the physics alone ({c:.0} steps/s),", 100.0 * rate / c)
            });
            say(format!(
                "{} {} on {} threads: {rate:.0} steps/s,{beside} updates take {:.0} % of the time",
                self.task,
                algo,
                cores(),
                100.0 * share
            ));
        }
        Ok(())
    }
}

impl Ticks {
    fn run(self, whole: bool) -> Result<(), Failure> {
        let algo = Algorithm::Pid2Ib;
        let training = Training::new(&request(&self.task, algo, None, &self.set)?)?;
        let snapshot = training.snapshot().clone();
        let Measured { update, projection, allocations, solves } = measure(&snapshot, self.ticks)?;
        let floor = timer(self.ticks);
        let h = if whole { &update } else { &projection };
        let what = if whole { "update" } else { "projection" };
        let p = |h: &Histogram<u64>, q: f64| h.value_at_quantile(q) as f64 / 1e3;
        if self.json {
            say(
                serde_json::json!({ "task": self.task, "what": what, "unit": "us", "p50": p(h, 0.5), "p99": p(h, 0.99),
                "p999": p(h, 0.999), "max": p(h, 1.0), "timer_p50": p(&floor, 0.5),
                "allocations": allocations, "clarabel_solves": solves }),
            );
        } else {
            say(format!("{} {what}, {} ticks [us]", self.task, self.ticks));
            for (name, h) in [(what, h), ("empty timer", &floor)] {
                say(format!(
                    "{name:<12} p50 {:.2}  p99 {:.2}  p99.9 {:.2}  max {:.1}",
                    p(h, 0.5),
                    p(h, 0.99),
                    p(h, 0.999),
                    p(h, 1.0)
                ));
            }
            say(format!(
                "{allocations} allocations in {} updates, {solves} of them solved by Clarabel",
                self.ticks
            ));
        }
        Ok(())
    }
}

fn histogram() -> Result<Histogram<u64>, Failure> {
    Ok(Histogram::new_with_bounds(1, 10_000_000_000, 3)?)
}

struct Measured {
    update: Histogram<u64>,
    projection: Histogram<u64>,
    /// Heap allocations of all updates.
    allocations: u64,
    solves: u64,
}

/// Closed loop with the task's environment; the policy is fresh, its exploration on.
fn measure(snapshot: &Snapshot, ticks: usize) -> Result<Measured, Failure> {
    let (mut env, mut controller) = (make_env(snapshot)?, Controller::new(snapshot)?);
    let (mut state, mut noise, mut out) = (controller.state(), controller.noise(), controller.output());
    let (mut update, mut projection) = (histogram()?, histogram()?);
    let mut rng = stream(0, 0);
    env.reset(&mut rng)?;
    let (mut since_reset, mut made, mut solves) = (0, 0, 0);
    for _ in 0..ticks {
        env.observe(&mut state.obs);
        env.state(&mut state.q, &mut state.v);
        noise.proposal.fill_with(|| StandardNormal.sample(&mut rng));
        noise.action.fill_with(|| StandardNormal.sample(&mut rng));
        let before = allocations();
        controller.update(&state, &noise, &mut out);
        made += allocations() - before;
        solves += u64::from(out.next.ledger.rung == Rung::Clarabel);
        update.saturating_record(out.duration_ns);
        projection.saturating_record(out.next.ledger.duration_ns);
        since_reset += 1;
        if env.step(&out.action).terminated || since_reset >= env.spec().max_episode_steps {
            env.reset(&mut rng)?;
            controller.reset();
            since_reset = 0;
        }
    }
    Ok(Measured { update, projection, allocations: made, solves })
}

fn timer(n: usize) -> Histogram<u64> {
    let mut h = histogram().unwrap_or_else(|e| unreachable!("{e}"));
    for _ in 0..n {
        let start = Instant::now();
        h.saturating_record(std::hint::black_box(start).elapsed().as_nanos() as u64);
    }
    h
}
