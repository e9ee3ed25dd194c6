//! The `nearl` command line: one file a subcommand.

mod bench;
mod bench_serve;
mod blank;
mod demo;
mod demos;
mod eval;
mod export;
mod import;
mod plant;
mod process;
mod project;
mod python;
mod robot;
mod serve;
mod soak;
mod sweep;
mod tasks;
mod train;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use nearl_runtime::constraints::read_task_text;

pub use nearl_runtime::cli::Failure;
pub(crate) use nearl_runtime::cli::say;

/// What is said of control periods with a [`Fault`](crate::env::Fault).
fn unstable(periods: u64) -> String {
    format!(
        "{periods} control periods could not be simulated (the state blew up): each ended its episode with the reward 0; look at masses, gears, \
         actuator ranges and the physics step"
    )
}

/// Let a learned policy move a robot without ever breaking its limits.
#[derive(Parser)]
#[command(name = "nearl", version, about, propagate_version = true)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Train a policy on MuJoCo.
    Train(train::Train),
    /// Train tasks x algorithms x seeds on all cores.
    Sweep(sweep::SweepCommand),
    /// Make a snapshot of a policy in an ONNX file.
    Import(import::Import),
    /// Write a snapshot's policy as an ONNX file.
    Export(export::Export),
    /// Write a task as a snapshot without a policy, for a process that proposes in its place.
    Blank(blank::Blank),
    /// Run episodes without noise, raw and projected.
    Eval(eval::Eval),
    /// Plant and runtime as two processes, a hot swap, and the report.
    Demo(demo::Demo),
    /// Demonstrations: record and check them.
    #[command(subcommand)]
    Demos(demos::Demos),
    /// Project proposals read as JSON lines.
    Project(project::Project),
    /// Measure this machine.
    Bench(bench::Bench),
    /// MuJoCo as the robot, in real time, over shared memory.
    Plant(plant::PlantCommand),
    /// Run a snapshot on a plant in real time.
    Run(Box<nearl_runtime::cli::RunCommand>),
    /// Constrained rollouts for other processes, over shared memory.
    Serve(serve::Serve),
    /// Move the limits of a running loop inside those it was started with, or back to them.
    Limits(nearl_runtime::cli::LimitsCommand),
    /// Compute every tick of a flight log again and compare it bit for bit.
    Replay(nearl_runtime::cli::ReplayCommand),
    /// Confirm from a flight log alone that limits held, answers were optimal and a way to stop existed.
    Verify(nearl_runtime::cli::VerifyCommand),
    /// Say what a code in a report, a log or a refusal means, and what to do.
    Explain(nearl_runtime::cli::ExplainCommand),
    /// Check that a snapshot, this machine and a plant are ready.
    Doctor(nearl_runtime::doctor::DoctorCommand),
    /// Carry a robot's links to or from another host.
    Tunnel(nearl_runtime::tunnel::TunnelCommand),
    /// Say what is read from a robot file: joints, limits, motors, and what is left out.
    Robot(robot::RobotCommand),
    /// List the bundled tasks.
    Tasks(tasks::Tasks),
    /// A running loop, or a training, in a browser.
    #[command(disable_help_flag = true)]
    View(python::InPython),
    /// One HTML page about runs and flights.
    #[command(disable_help_flag = true)]
    Report(python::InPython),
    /// A video of a trained policy, or of demonstrations.
    #[command(disable_help_flag = true)]
    Video(python::InPython),
    /// TensorBoard's files from run folders.
    #[command(disable_help_flag = true)]
    Tensorboard(python::InPython),
}

impl Cli {
    /// Reads the command line; ends the program where it is refused.
    pub fn read() -> Cli {
        let given = minus_is_a_sign(Cli::command()).get_matches();
        Cli::from_arg_matches(&given).unwrap_or_else(|e| e.exit())
    }

    /// Runs the subcommand.
    ///
    /// # Errors
    /// One sentence naming the thing and the next step.
    pub fn run(self) -> Result<(), Failure> {
        match self.command {
            Command::Train(c) => c.run(),
            Command::Sweep(c) => c.run(),
            Command::Import(c) => c.run(),
            Command::Export(c) => c.run(),
            Command::Blank(c) => c.run(),
            Command::Eval(c) => c.run(),
            Command::Demo(c) => c.run(),
            Command::Demos(c) => c.run(),
            Command::Project(c) => c.run(),
            Command::Bench(c) => c.run(),
            Command::Plant(c) => c.run(),
            Command::Run(c) => c.run(),
            Command::Serve(c) => c.run(),
            Command::Limits(c) => c.run(),
            Command::Replay(c) => c.run(),
            Command::Verify(c) => c.run(),
            Command::Explain(c) => c.run(crate::rollout_protocol::Answer::explanations()),
            Command::Doctor(c) => c.run(),
            Command::Tunnel(c) => c.run(),
            Command::Robot(c) => c.run(),
            Command::Tasks(c) => c.run(),
            Command::View(c) => c.run("nearl.view"),
            Command::Report(c) => c.run("nearl.report"),
            Command::Video(c) => c.run("nearl.video"),
            Command::Tensorboard(c) => c.run("nearl.tensorboard"),
        }
    }
}

/// `--steps -5` is refused for its number, not as an option `-5` that there is not.
fn minus_is_a_sign(command: clap::Command) -> clap::Command {
    let is_value = |arg: &clap::Arg| arg.get_action().takes_values() && !arg.is_allow_hyphen_values_set();
    let command = command.mut_args(|arg| if is_value(&arg) { arg.allow_negative_numbers(true) } else { arg });
    command.mut_subcommands(minus_is_a_sign)
}

/// An error of a task with the file that the task was read from, where it is one, and the line of the limit that it begins with.
fn of_file(task: &str, error: &dyn std::fmt::Display) -> Failure {
    let said = error.to_string();
    if said.contains(task) {
        return said.into();
    }
    let Ok(text) = read_task_text(task.as_ref()) else { return said.into() };
    let reason = said.strip_prefix("task cannot be used: ").unwrap_or(&said);
    let limit = reason.split_whitespace().next().unwrap_or_default();
    let place = nearl_runtime::task::place(&text, &["constraints", limit]).unwrap_or_default();
    format!("{task}{place}: {said}").into()
}

/// A number of threads or jobs.
pub(crate) fn at_least_one(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(0) | Err(_) => Err(format!("'{text}' is not a whole number above 0")),
        Ok(n) => Ok(n),
    }
}

/// Cores of this machine.
pub(crate) fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}
