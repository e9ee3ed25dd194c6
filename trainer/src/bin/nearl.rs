//! The `nearl` command.

use nearl_trainer::cli::Cli;
use std::process::ExitCode;

#[global_allocator]
static ALLOCATOR: nearl_trainer::allocations::Counting = nearl_trainer::allocations::Counting;

fn main() -> ExitCode {
    nearl_runtime::stop::outlive_file_sizes();
    match Cli::read().run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            nearl_runtime::tell!("nearl: {e}");
            ExitCode::from(nearl_runtime::cli::exit_code(&e))
        }
    }
}
