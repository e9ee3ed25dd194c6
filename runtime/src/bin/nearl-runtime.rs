//! `nearl-runtime`: what a robot needs, without MuJoCo and Python.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use nearl_runtime::cli::{
    ExplainCommand, LimitsCommand, LoopBench, ReplayCommand, RunCommand, VerifyCommand, exit_code,
};
use nearl_runtime::doctor::DoctorCommand;
use nearl_runtime::tunnel::TunnelCommand;

#[derive(Parser)]
#[command(name = "nearl-runtime", version, about = "NEARL's real-time loop")]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Run a snapshot on a plant in real time.
    Run(Box<RunCommand>),
    /// Move the limits of a running loop inside those it was started with, or back to them.
    Limits(LimitsCommand),
    /// Compute every tick of a flight log again and compare it bit for bit.
    Replay(ReplayCommand),
    /// Confirm from a flight log alone that limits held, answers were optimal and a way to stop existed.
    Verify(VerifyCommand),
    /// Say what a code means and what to do.
    Explain(ExplainCommand),
    /// Check that a snapshot, this machine and a plant are ready.
    Doctor(DoctorCommand),
    /// Carry a robot's links to or from another host.
    Tunnel(TunnelCommand),
    /// Measure this machine: shared-memory round trip, or wake-up of an empty loop.
    Bench {
        #[command(subcommand)]
        what: LoopBench,
    },
}

fn main() -> ExitCode {
    nearl_runtime::stop::outlive_file_sizes();
    let result = match Arguments::parse().command {
        Command::Run(command) => command.run(),
        Command::Limits(command) => command.run(),
        Command::Replay(command) => command.run(),
        Command::Verify(command) => command.run(),
        Command::Explain(command) => command.run(Vec::new()),
        Command::Doctor(command) => command.run(),
        Command::Tunnel(command) => command.run(),
        Command::Bench { what } => what.run(),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            nearl_runtime::tell!("nearl-runtime: {error}");
            ExitCode::from(exit_code(&error))
        }
    }
}
