//! Attacks an arm with Coulomb friction three times and writes a table: its model states no friction, MuJoCo's friction, and Coulomb's.
//!
//! `cargo run --release -p nearl-constraints --example coulomb -- ROBOT.urdf TICKS`

#![allow(unreachable_pub)]

mod plant;

use nearl_constraints::Model;
use nearl_constraints::description::FrictionLaw;
use plant::attacked;
use std::error::Error;
use std::path::Path;

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [file, ticks] = &args[..] else { return Err("usage: coulomb ROBOT.urdf TICKS".into()) };
    let (arm, ticks) = (Model::from_urdf(Path::new(file))?, ticks.parse()?);
    println!(
        "| period | steps of the model | friction taken for | ticks over | acceleration | velocity | position | torque |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    for dt in [0.001, 0.002, 0.01] {
        for sub_steps in [0, 1, 5] {
            for (law, name) in [
                (None, "none"),
                (Some(FrictionLaw::Mujoco), "MuJoCo's"),
                (Some(FrictionLaw::Coulomb), "Coulomb's"),
            ] {
                let seen = attacked(&arm, law, (dt, sub_steps), ticks);
                let [a, v, q, tau] = seen.worst;
                let share = 100.0 * seen.over as f64 / seen.ticks as f64;
                println!(
                    "| {} ms | {sub_steps} | {name} | {share:.2} % | {a:.2} | {v:.1e} | {q:.1e} | {tau:.2} |",
                    1000.0 * dt
                );
            }
        }
    }
    Ok(())
}
