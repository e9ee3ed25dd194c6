//! Time of a projection on the Panda, by the rung that answered. `cargo bench -p nearl-constraints`

#[path = "../tests/common/mod.rs"]
mod common;

use common::*;
use nearl_constraints::*;
use std::time::Instant;

const TICKS: usize = 50_000;

/// Median and 99th percentile [us] of each rung over an adversarial closed loop.
fn run(name: &str, torque: Option<f64>, settings: Settings) {
    let mut projector = panda_projector(torque, settings);
    let (mut random, mut target) = (Random(7), Target::new(projector.model()));
    let (mut q, mut v) = (vec![0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], vec![0.0; 7]);
    let (mut side, mut times) = ([1.0f64; 7], [(); 4].map(|_| Vec::with_capacity(TICKS)));
    for _ in 0..TICKS {
        for s in &mut side {
            if random.next() < 0.003 {
                *s = -*s;
            }
        }
        let y: Vec<f64> = (0..7).map(|i| side[i] * random.between(0.0, 0.05)).collect();
        let raw = consistent(&projector, &q, &v, &y);
        let start = Instant::now();
        projector.project(&q, &v, &raw, &mut target);
        times[target.ledger.rung as usize].push(start.elapsed().as_nanos());
        q.copy_from_slice(&target.q);
        v.copy_from_slice(&target.v);
    }
    for (rung, t) in ["closed form", "active set", "Clarabel", "brake"].iter().zip(&mut times) {
        if !t.is_empty() {
            t.sort_unstable();
            let at = |share: f64| t[((t.len() - 1) as f64 * share) as usize] as f64 / 1000.0;
            println!(
                "{name:<40} {rung:<12} {:>7} ticks  p50 {:>8.2} us  p99 {:>8.2} us",
                t.len(),
                at(0.5),
                at(0.99)
            );
        }
    }
}

/// Pinocchio's share of a tick with torque rows: M, nle, and inverse dynamics twice for the checker.
fn pinocchio() {
    let model = panda();
    let mut dynamics = Dynamics::new(&model);
    let (q, v) = (vec![0.3; 7], vec![0.2; 7]);
    let (mut mass, mut out) = (vec![0.0; 49], vec![0.0; 7]);
    let start = Instant::now();
    for _ in 0..TICKS {
        dynamics.mass(&q, &mut mass);
        dynamics.nle(&q, &v, &mut out);
        dynamics.rnea(&q, &v, &v, &mut out);
        dynamics.rnea(&q, &v, &v, &mut out);
    }
    let each = start.elapsed().as_nanos() as f64 / TICKS as f64 / 1000.0;
    println!("{:<40} {each:.2} us", "Pinocchio: M, nle, 2 x rnea");
}

fn main() {
    let base = || Settings::new(0.001, 1);
    pinocchio();
    run("box, 1 sub-step", None, base());
    run("box, 5 sub-steps", None, Settings::new(0.001, 5));
    run("box, free", None, Settings { consistency: Consistency::Free, ..base() });
    run("box and torque rows", Some(0.92), base());
    run("box and torque rows, Clarabel only", Some(0.92), Settings { solver: Solver::Clarabel, ..base() });
}
