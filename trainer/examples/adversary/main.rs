//! Attacks the projector in closed loop with MuJoCo and counts what breaks.
//!
//! `cargo run --release -p nearl-trainer --example adversary -- TICKS FOLDER [ROBOT ...]`
//!
//! TICKS are shared out over robots, ways of braking and attacks; `FOLDER/table.md` and `FOLDER/counts.jsonl` are written.
//!
//! The plant: MuJoCo at 1 kHz, one semi-implicit Euler step a tick, no joint stops, no clamp on motor forces. The motors get the
//! inverse dynamics of the target. What is counted is the simulator's own state, against the limits of the robot file.

mod attack;
#[path = "../../../constraints/src/random.rs"]
mod random;
mod victim;

use attack::{Attack, Kind};
use nearl_runtime::constraints::{BrakeReason, Braking, Dynamics, Proposal, Status, Target};
use random::Random;
use serde_json::json;
use std::collections::BTreeMap;
use std::error::Error;
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use victim::{DT, ROBOTS, Victim};

/// An excess above this share of the limit (of 1 where the limit is smaller) is a violation.
const TOLERANCE: f64 = 1e-9;

/// The robot is put into a new random state after this many ticks.
const EPISODE: usize = 25_000;

/// What one robot under one attack did.
#[derive(Default)]
struct Counts {
    ticks: u64,
    /// Ticks in which a joint broke its limit: position, velocity, acceleration, motor force.
    broken: [u64; 4],
    /// Largest excess of each [share].
    worst: [f64; 4],
    /// Ticks without an allowed state.
    empty: u64,
    /// Ticks in which no brake could be verified from the start of an episode or the last one stored was used.
    stored_brake: u64,
    /// Ticks braked because of a proposal that is no number.
    nonfinite: u64,
    other_brakes: u64,
    recovering: u64,
    solved: u64,
    /// Targets the independent checker refused.
    refused: u64,
    /// Largest distance of the reached state from the target: position, velocity, acceleration.
    missed: [f64; 3],
    unstable: u64,
}

impl Counts {
    fn status(&mut self, status: Status) {
        match status {
            Status::Solved => self.solved += 1,
            Status::Recovering => self.recovering += 1,
            Status::Slowed | Status::Braked(BrakeReason::NoVerifiedBrake) => self.stored_brake += 1,
            Status::Braked(BrakeReason::NoCertifiedAnswer) => self.empty += 1,
            Status::Braked(BrakeReason::NonFiniteProposal) => self.nonfinite += 1,
            Status::Braked(_) | Status::Refused(_) => self.other_brakes += 1,
            _ => {}
        }
    }

    fn count(&mut self, excess: [f64; 4]) {
        for (k, excess) in excess.into_iter().enumerate() {
            self.broken[k] += u64::from(excess > TOLERANCE || excess.is_nan());
            self.worst[k] = self.worst[k].max(excess);
        }
    }
}

/// Runs one closed loop.
fn run(job: &Job) -> Result<Counts, Box<dyn Error>> {
    let &Job { victim, braking, kind, ticks, seed } = job;
    let (n, mut random) = (victim.model.nv(), Random(seed ^ 0xa5a5));
    let mut projector = victim.projector(braking)?;
    let mut attack = Attack::new(kind, &victim.model, &victim.set, DT, seed);
    let (mut plant, mut dynamics) = (victim.plant()?, Dynamics::new(&victim.model));
    let (mut proposal, mut target) = (Proposal::new(&victim.model), Target::new(&victim.model));
    let (mut q, mut v, mut tau) = (vec![0.0; n], vec![0.0; n], vec![0.0; n]);
    let mut before = v.clone();
    let mut counts = Counts::default();
    for tick in 0..ticks {
        if tick % EPISODE == 0 {
            plant.set(&victim.start(&mut random), &vec![0.0; n])?;
            plant.read(&mut q, &mut v);
            projector.forget();
        }
        attack.propose(tick, &q, &v, &mut proposal);
        counts.status(projector.project(&q, &v, &proposal, &mut target));
        counts.refused += u64::from(target.ledger.target_violations.total() > 0);
        dynamics.rnea(&q, &v, &target.acceleration, &mut tau);
        before.copy_from_slice(&v);
        plant.step(&tau)?;
        plant.read(&mut q, &mut v);
        counts.unstable += u64::from(plant.unstable());
        let worst = excess(victim, (&q, &v), &before, &tau);
        counts.count(worst);
        if target.ledger.status == Status::Braked(BrakeReason::NoCertifiedAnswer)
            || worst.iter().any(|e| *e > TOLERANCE || e.is_nan())
        {
            tell(tick, &counts, worst, &proposal, &target);
        }
        for i in 0..n {
            let (dq, dv) = ((q[i] - target.q[i]).abs(), (v[i] - target.v[i]).abs());
            let m = &mut counts.missed;
            *m = [m[0].max(dq), m[1].max(dv), m[2].max(dv / DT)];
        }
    }
    counts.ticks = ticks as u64;
    Ok(counts)
}

/// Prints the first few ticks in which something went wrong.
fn tell(tick: usize, counts: &Counts, worst: [f64; 4], proposal: &Proposal, target: &Target) {
    if counts.empty + counts.broken.iter().sum::<u64>() <= 3 {
        let l = &target.ledger;
        eprintln!(
            "tick {tick}: {:?} by {:?}, excess {worst:?} (position, velocity, acceleration, torque), {:?}, {} outside; proposed {:?} {:?}",
            l.status,
            l.rung,
            l.target_violations,
            l.outside.len(),
            proposal.q,
            proposal.v
        );
    }
}

/// Largest excess over the limits of the reached state, of the acceleration that led there, and of the motor force used.
fn excess(victim: &Victim, (q, v): (&[f64], &[f64]), before: &[f64], tau: &[f64]) -> [f64; 4] {
    let (set, mut worst) = (&victim.set, [f64::NEG_INFINITY; 4]);
    for i in 0..v.len() {
        let share = |value: f64, limit: f64| (value - limit) / limit.abs().max(1.0);
        let each = [
            share(q[i], set.q_upper[i]).max(share(-q[i], -set.q_lower[i])),
            share(v[i].abs(), set.velocity[i]),
            share(((v[i] - before[i]) / DT).abs(), set.acceleration[i]),
            share(tau[i].abs(), set.effort[i]),
        ];
        for (worst, each) in worst.iter_mut().zip(each) {
            *worst = if each.is_nan() { f64::NAN } else { worst.max(each) };
        }
    }
    worst
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut words = std::env::args().skip(1);
    let usage = "usage: adversary TICKS FOLDER [ROBOT ...]";
    let (ticks, folder) = (words.next().ok_or(usage)?.parse::<f64>()?, words.next().ok_or(usage)?);
    let only: Vec<String> = words.collect();
    let chosen: Vec<_> =
        ROBOTS.iter().filter(|r| only.is_empty() || only.iter().any(|o| o == r.name)).collect();
    let robots = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/robots");
    let victims = chosen.iter().map(|r| Victim::new(r, &robots)).collect::<Result<Vec<_>, _>>()?;
    let mut jobs = Vec::new();
    for victim in &victims {
        let modes: &[Braking] = match victim.certified {
            Some(_) => &[Braking::Certified, Braking::Stored],
            None => &[Braking::Stored],
        };
        let each = (ticks / (chosen.len() * modes.len() * Kind::ALL.len()) as f64).ceil() as usize;
        for &braking in modes {
            jobs.extend((1..).zip(Kind::ALL).map(|(seed, kind)| Job {
                victim,
                braking,
                kind,
                ticks: each,
                seed,
            }));
        }
    }
    std::fs::create_dir_all(&folder)?;
    let (next, done) = (AtomicUsize::new(0), Mutex::new(BTreeMap::new()));
    let work = || -> Result<(), String> {
        loop {
            let k = next.fetch_add(1, Ordering::Relaxed);
            let Some(job) = jobs.get(k) else { return Ok(()) };
            let counts = run(job).map_err(|e| e.to_string())?;
            println!("{}", line(job, &counts));
            let mut done = done.lock().map_err(|e| e.to_string())?;
            done.insert(k, counts);
            write(Path::new(&folder), &jobs, &done).map_err(|e| format!("{folder}: {e}"))?;
        }
    };
    std::thread::scope(|scope| {
        let threads: Vec<_> =
            (0..std::thread::available_parallelism()?.get()).map(|_| scope.spawn(work)).collect();
        for thread in threads {
            thread.join().map_err(|_| "a thread of the adversary panicked")??;
        }
        Ok(())
    })
}

/// One closed loop.
struct Job<'a> {
    victim: &'a Victim,
    braking: Braking,
    kind: Kind,
    ticks: usize,
    seed: u64,
}

/// Writes what is done so far, in the order of the jobs and not of their ends.
fn write(folder: &Path, jobs: &[Job], done: &BTreeMap<usize, Counts>) -> std::io::Result<()> {
    let (mut table, mut lines) = (format!("{HEAD}\n"), String::new());
    for (k, counts) in done {
        table += &format!("{}\n", line(&jobs[*k], counts));
        lines += &format!("{}\n", record(&jobs[*k], counts));
    }
    std::fs::write(folder.join("table.md"), table)?;
    std::fs::write(folder.join("counts.jsonl"), lines)
}

const HEAD: &str = "\
| robot | braking | attack | ticks | position | velocity | acceleration | torque | worst excess | \
empty sets | stored brake | non-finite | other brakes | solved % | missed q, v, a |
|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|";

fn line(job: &Job, c: &Counts) -> String {
    let &Job { victim, braking, kind, .. } = job;
    let [p, v, a, t] = c.broken;
    let worst = c.worst.iter().fold(f64::NEG_INFINITY, |m, x| m.max(*x));
    let [mq, mv, ma] = c.missed;
    format!(
        "| {} | {} | {} | {} | {p} | {v} | {a} | {t} | {worst:.1e} | {} | {} | {} | {} | {:.1} | {mq:.0e}, {mv:.0e}, {ma:.0e} |",
        victim.name,
        format!("{braking:?}").to_lowercase(),
        kind.name(),
        c.ticks,
        c.empty,
        c.stored_brake,
        c.nonfinite,
        c.other_brakes + c.recovering,
        100.0 * c.solved as f64 / c.ticks as f64,
    )
}

fn record(job: &Job, c: &Counts) -> serde_json::Value {
    let &Job { victim, braking, kind, .. } = job;
    json!({
        "robot": victim.name, "dofs": victim.model.nv(), "braking": braking, "certified_share": victim.certified,
        "attack": kind.name(), "ticks": c.ticks, "position": c.broken[0], "velocity": c.broken[1],
        "acceleration": c.broken[2], "torque": c.broken[3], "worst": c.worst, "empty": c.empty,
        "stored_brake": c.stored_brake, "nonfinite": c.nonfinite, "other_brakes": c.other_brakes,
        "recovering": c.recovering, "solved": c.solved, "refused": c.refused, "missed": c.missed,
        "unstable": c.unstable, "tolerance": TOLERANCE,
    })
}
