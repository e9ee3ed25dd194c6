//! Prints how many control periods per second the physics of each task makes, without any learning.
//!
//! `cargo run --release -p nearl-trainer --example physics_speed -- [seconds per measurement] [task ...]`

use std::time::Duration;

use nearl_trainer::env;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let seconds: f64 = arguments.next().map_or(Ok(2.0), |text| text.parse())?;
    let asked: Vec<String> = arguments.collect();
    let tasks = if asked.is_empty() { env::names().map(str::to_owned).collect() } else { asked };
    let cores = std::thread::available_parallelism()?.get();
    println!("{:<16} {:>12} {:>12}", "task", "1 thread", format!("{cores} threads"));
    for task in tasks {
        let first = env::make(&task)?;
        let speed = |threads| env::bench::physics(first.as_ref(), threads, Duration::from_secs_f64(seconds));
        let (one, all) = (speed(1)?.steps_per_second(), speed(cores)?.steps_per_second());
        println!("{task:<16} {one:>12.0} {all:>12.0}");
    }
    Ok(())
}
