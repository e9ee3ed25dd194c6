//! The `nearl` command.

use clap::Parser;
use nearl_trainer::cli::Cli;
use std::process::ExitCode;

fn main() -> ExitCode {
    match Cli::parse().run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("nearl: {e}");
            ExitCode::FAILURE
        }
    }
}
