//! Attacks every kind of limit alone and all together, at four periods and three numbers of physics steps, and writes a table.
//!
//! `cargo run --release -p nearl-constraints --example attack -- ROBOT.urdf FRAME TICKS [KIND ...]`
//!
//! TICKS is for each line of the table. A KIND may be several, `jerk+torque`. `soft_jerk` and `torque_rate` are soft: the table says by how much they
//! are exceeded.

#![allow(unreachable_pub)]

mod attacker;
mod meter;
#[path = "../../src/random.rs"]
mod random;
mod run;
mod scene;

use nearl_constraints::*;
use random::Random;
use run::{Seen, attack};
use scene::{KINDS, SOFT, Scene};
use std::error::Error;
use std::path::Path;

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [file, frame, ticks, kinds @ ..] = &args[..] else {
        return Err("usage: attack ROBOT.urdf FRAME TICKS [KIND ...]".into());
    };
    let (model, ticks) = (Model::from_urdf(Path::new(file))?, ticks.parse()?);
    println!(
        "| limits | period | steps | ticks | over | worst excess | slowed | braked | further: mean, most |"
    );
    println!("|---|---|---|---|---|---|---|---|---|");
    let every = || KINDS.iter().chain(&SOFT).map(|kind| kind.to_string()).collect();
    for kind in &(if kinds.is_empty() { every() } else { kinds.to_vec() }) {
        for dt in [0.001, 0.002, 0.01, 0.02] {
            for sub_steps in [0, 1, 5] {
                let settings = Settings { braking: Braking::Stored, ..Settings::new(dt, sub_steps) };
                let seen = attack(&model, &Scene::new(&model, frame, kind), &settings, ticks, 1);
                line(kind, dt, sub_steps, &seen);
            }
        }
    }
    Ok(())
}

fn line(kind: &str, dt: f64, sub_steps: u32, s: &Seen) {
    let share = |count: usize| 100.0 * count as f64 / s.ticks as f64;
    let mean = s.further.0 / ((s.slowed + s.braked).max(1) as f64);
    println!(
        "| {kind} | {} ms | {sub_steps} | {} | {} | {:.1e} | {:.1} % | {:.1} % | {mean:.2}, {:.2} |",
        1000.0 * dt,
        s.ticks,
        s.over,
        s.worst,
        share(s.slowed),
        share(s.braked),
        s.further.1
    );
}
