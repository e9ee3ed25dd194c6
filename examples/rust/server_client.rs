//! Constrained rollouts from a server on this machine: `nearl serve` in a process of its own, a client here.
//!
//! `cargo build --release --bins` builds the server.

use nearl_runtime::link::RobotName;
use nearl_trainer::rollout_protocol::{Request, RolloutClient};
use std::process::{Command, Stdio};
use std::time::Duration;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let name = format!("example{}", std::process::id());
    let mut server = Command::new("target/release/nearl")
        .args(["serve", "examples/snapshots/panda-reach.safetensors", "--name", &name])
        .stdout(Stdio::null())
        .spawn()?;
    let result = collect(&RobotName::new(&name)?);
    server.kill()?;
    server.wait()?;
    let (steps, reward) = result?;
    println!("{steps} steps, reward {reward:.2}");
    Ok(())
}

fn collect(name: &RobotName) -> Result<(usize, f64), Box<dyn std::error::Error>> {
    let patience = Duration::from_secs(20);
    let mut client = RolloutClient::open(name, patience)?;
    let mut rollouts = client.request(&Request::new(0, 1000))?;
    let (mut steps, mut reward) = (0, 0.0);
    while let Some(chunk) = rollouts.next(patience)? {
        let rewards: Vec<f64> = chunk.column("reward").map(|entry| entry[0]).collect();
        (steps, reward) = (steps + rewards.len(), reward + rewards.iter().sum::<f64>());
    }
    Ok((steps, reward))
}
