//! A plant and a loop for half a second, with a flight log, and what the log says: Foxglove opens the same file.

use nearl_runtime::log::replay;
use std::path::Path;
use std::process::Command;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let file = std::env::args().nth(1).ok_or("give a file to write, e.g. runs/arm.mcap")?;
    let name = format!("example{}", std::process::id());
    let nearl = |arguments: &[&str]| Command::new("target/release/nearl").args(arguments).spawn();
    let mut plant = nearl(&["plant", "Panda-reach", "--name", &name, "--lockstep", "--seconds", "5"])?;
    let snapshot = "examples/snapshots/panda-reach.safetensors";
    let ended = nearl(&["run", snapshot, "--plant", &name, "--seconds", "0.5", "--log", &file])?.wait();
    plant.kill()?;
    plant.wait()?;
    ended?;

    let found = replay(Path::new(&file))?;
    println!("{} ticks in the log, computed again", found.ticks);
    match found.difference {
        None => println!("every one is the same, bit for bit"),
        Some(difference) => return Err(difference.to_string().into()),
    }
    Ok(())
}
