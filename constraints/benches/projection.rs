//! Measures the thread CPU time of whole ticks (assembly, Pinocchio, solve, checker, ledger) and counts their allocations, for each rung that answered.
//! `cargo bench -p nearl-constraints --bench projection`

#[path = "../tests/common/mod.rs"]
mod common;
#[path = "../tests/common/counting.rs"]
mod counting;

use common::*;
use nearl_constraints::*;
use rustix::time::{ClockId, clock_gettime};

const TICKS: usize = 50_000;

/// CPU time of this thread [ns].
fn now() -> i64 {
    let t = clock_gettime(ClockId::ThreadCPUTime);
    t.tv_sec * 1_000_000_000 + t.tv_nsec
}

/// What reading the clock costs [ns].
fn clock() -> i64 {
    let mut each: Vec<i64> = (0..2001).map(|_| -now() + now()).collect();
    each.sort_unstable();
    each[1000]
}

fn line(name: &str, rung: &str, times: &mut [i64], allocations: usize) {
    times.sort_unstable();
    let at = |share: f64| times[((times.len() - 1) as f64 * share) as usize] as f64 / 1000.0;
    println!(
        "| {name} | {rung} | {} | {:.1} | {:.1} | {:.1} | {allocations} |",
        times.len(),
        at(0.5),
        at(0.99),
        at(0.999)
    );
}

/// An adversarial closed loop: every dof is pushed by up to twice its acceleration in one direction, which turns now and then.
fn run(name: &str, mut projector: Projector, from: &[f64]) {
    let (clock, n, mut random) = (clock(), from.len(), Random(7));
    let mut target = Target::new(projector.model());
    let (mut q, mut v, mut side) = (from.to_vec(), vec![0.0; n], vec![1.0f64; n]);
    let reach: Vec<f64> = (0..n).map(|i| projector.limits().acceleration[i].min(1e3) * 2e-3).collect();
    let rungs = Rung::ALL.map(Rung::name);
    let mut times = rungs.map(|_| (Vec::with_capacity(TICKS), 0));
    for _ in 0..TICKS {
        for s in &mut side {
            if random.next() < 0.003 {
                *s = -*s;
            }
        }
        let y: Vec<f64> = (0..n).map(|i| side[i] * random.between(0.0, reach[i])).collect();
        let raw = consistent(&projector, &q, &v, &y);
        let (before, start) = (counting::allocations(), now());
        projector.project(&q, &v, &raw, &mut target);
        let (took, after) = (now() - start - clock, counting::allocations());
        let (each, allocations) = &mut times[target.ledger.rung.number() as usize];
        each.push(took);
        *allocations += after - before;
        q.copy_from_slice(&target.q);
        v.copy_from_slice(&target.v);
    }
    let mut all: Vec<i64> = times.iter().flat_map(|(t, _)| t.iter().copied()).collect();
    line(name, "**all**", &mut all, times.iter().map(|(_, a)| a).sum());
    for (rung, (t, allocations)) in rungs.iter().zip(&mut times) {
        if !t.is_empty() {
            line("", rung, t, *allocations);
        }
    }
}

/// Pinocchio's share of a tick with torque rows: M, nle, and inverse dynamics twice for the checker.
fn pinocchio(name: &str, model: &Model) {
    let (mut dynamics, n) = (Dynamics::new(model), model.nv());
    let (q, v) = (vec![0.3; n], vec![0.2; n]);
    let (mut mass, mut out) = (vec![0.0; n * n], vec![0.0; n]);
    let mut times: Vec<i64> = (0..TICKS / 10)
        .map(|_| {
            let start = now();
            dynamics.mass(&q, &mut mass);
            dynamics.nle(&q, &v, &mut out);
            dynamics.rnea(&q, &v, &v, &mut out);
            dynamics.rnea(&q, &v, &v, &mut out);
            now() - start
        })
        .collect();
    line(name, "M, nle, 2 x rnea", &mut times, 0);
}

/// All joints of a robot whose base stands still, with torque rows.
fn whole(model: &Model, velocity: f64, acceleration: f64, torque: f64) -> Projector {
    let limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::values(PerJoint::All(velocity))),
        Box::new(AccelerationLimit::uniform(acceleration)),
        Box::new(TorqueLimit::scaled(torque)),
    ];
    let dofs: Vec<usize> = (0..model.nv()).collect();
    Projector::new(model, &limits, &dofs, Settings::new(0.001, 1)).unwrap()
}

fn main() {
    let base = || Settings::new(0.001, 1);
    println!("| limits | rung | ticks | p50 [us] | p99 | p99.9 | allocations |");
    println!("|---|---|---|---|---|---|---|");
    let panda_from = [0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0];
    let panda_run = |name: &str, torque, settings| run(name, panda_projector(torque, settings), &panda_from);
    panda_run("Panda, box, 1 sub-step", None, base());
    panda_run("Panda, box, 5 sub-steps", None, Settings::new(0.001, 5));
    panda_run("Panda, box, free", None, Settings { consistency: Consistency::Free, ..base() });
    panda_run("Panda, torque rows at 92 %", Some(0.92), base());
    panda_run("Panda, the same, Clarabel only", Some(0.92), Settings { solver: Solver::Clarabel, ..base() });
    pinocchio("Panda", &panda());
    for (name, file, velocity, acceleration, torque) in [
        ("ANYmal, torque rows", "anymal/anymal.urdf", 8.0, 60.0, 0.5),
        ("G1, torque rows", "g1/g1.urdf", 8.0, 60.0, 0.9),
    ] {
        let model = robot(file);
        let projector = whole(&model, velocity, acceleration, torque);
        let l = projector.limits();
        let middle = |i: usize| match l.q_lower[i] + l.q_upper[i] {
            sum if sum.is_finite() => sum / 2.0,
            _ => 0.0,
        };
        let from: Vec<f64> = (0..model.nv()).map(middle).collect();
        run(name, projector, &from);
        pinocchio(name, &model);
    }
}
