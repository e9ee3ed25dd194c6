//! Measures how long frames, distances and rows take on the Panda. `cargo bench -p nearl-constraints --bench kinematics`

#[path = "../tests/common/mod.rs"]
mod common;

use common::solids::panda_collision;
use common::*;
use nearl_constraints::row::{Motion, RowsMut, TickStart};
use nearl_constraints::*;
use std::time::Instant;

const TICKS: usize = 50_000;

/// Median and 99th percentile [us] of one call.
fn time(name: &str, mut call: impl FnMut(usize)) {
    let mut times: Vec<u128> = (0..TICKS)
        .map(|k| {
            let start = Instant::now();
            call(k);
            start.elapsed().as_nanos()
        })
        .collect();
    times.sort_unstable();
    let at = |share: f64| times[((TICKS - 1) as f64 * share) as usize] as f64 / 1000.0;
    println!("{name:<60} p50 {:>7.2} us  p99 {:>7.2} us", at(0.5), at(0.99));
}

/// Configurations of a slow motion through the workspace.
fn configuration(k: usize) -> [f64; 7] {
    let t = k as f64 * 1e-3;
    let (swing, middle) = ([0.5, 0.4, 0.3, 0.4, 0.5, 0.3, 0.2], [0.0, 0.0, 0.0, -1.8, 0.0, 1.6, 0.0]);
    [0, 1, 2, 3, 4, 5, 6].map(|i| middle[i] + swing[i] * (t * (1.0 + swing[i])).sin())
}

fn rows(name: &str, limit: &dyn Limit) {
    let (model, period) = (panda(), Period::new(1e-3, 1));
    let mut rows = limit.rows(&model, &[0, 1, 2, 3, 4, 5, 6]).unwrap().unwrap();
    let (mut kinematics, v, n) = (Kinematics::new(&model), [0.3; 7], rows.sizes().len());
    let (mut g, mut lower, mut upper) = (vec![0.0; 7 * n], vec![0.0; n], vec![0.0; n]);
    let mut outside = vec![false; n];
    time(&format!("{name}, {n} rows: fill"), |k| {
        let q = &configuration(k);
        let (mass, motors, bias, previous) = (&[][..], &[][..], &[][..], None);
        let kinematics = &mut kinematics;
        let mut tick = TickStart { q, v: &v, period: &period, mass, motors, bias, kinematics, previous };
        g.fill(0.0);
        upper.fill(f64::INFINITY);
        let (g, lower, upper, outside) = (&mut g[..], &mut lower[..], &mut upper[..], &mut outside[..]);
        rows.fill(&mut tick, &mut RowsMut { g, lower, upper, outside, nv: 7 });
    });
    time(&format!("{name}, {n} rows: checker"), |k| {
        let q = &configuration(k);
        let (q_next, v_next, acceleration, torque) = (q, &v, &[0.0; 7], &[]);
        let (period, kinematics, previous) = (&period, &mut kinematics, None);
        let mut motion = Motion {
            q,
            v: &v,
            q_next,
            v_next,
            acceleration,
            torque,
            mass: &[],
            period,
            kinematics,
            previous,
        };
        rows.excess(&mut motion, &mut upper);
    });
}

fn main() {
    let model = panda();
    let mut kinematics = Kinematics::new(&model);
    let frames = ["panda_link4", "panda_link6", "panda_hand"].map(|name| model.frame(name).unwrap());
    let mut jacobian = vec![0.0; 42];
    time("update", |k| kinematics.update(&configuration(k), &[0.3; 7], &[0.1; 7]));
    time("update, 3 frames with Jacobians", |k| {
        kinematics.update(&configuration(k), &[0.3; 7], &[0.1; 7]);
        for frame in frames {
            std::hint::black_box(kinematics.frame(frame));
            kinematics.jacobian(frame, &mut jacobian);
        }
    });
    rows("half-space", &FrameLimit::half_space("panda_hand", [0.0, 0.0, -1.0], [0.0, 0.0, 0.2], 2.0));
    rows("collisions", &panda_collision(16, 0.2));
}
