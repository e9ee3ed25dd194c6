//! `nearl limits`: moves the limits of a running loop.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::Args;
use nearl_constraints::{Moved, read_task_text};

use super::{Failure, say, seconds};
use crate::link::{OperatorLink, RobotName, Verdict};

/// Move the limits of a running loop inside those it was started with, or back to them.
#[derive(Args, Debug)]
pub struct LimitsCommand {
    /// Name of the plant that the loop drives.
    pub name: String,
    /// Share of every limit on speed, above 0 and at most 1.
    #[arg(long, value_name = "SHARE", required_unless_present_any = ["set", "file", "reset"])]
    pub speed: Option<f64>,
    /// One more limit as TOML, for example `upper = { elbow = 1.0 }`; may stand several times.
    #[arg(long, value_name = "TOML")]
    pub set: Vec<String>,
    /// A TOML file of such lines.
    #[arg(long)]
    pub file: Option<PathBuf>,
    /// Back to the limits the loop was started with.
    #[arg(long, conflicts_with_all = ["speed", "set", "file"])]
    pub reset: bool,
    /// Longest wait for the loop and for its answer [s].
    #[arg(long, value_parser = seconds, default_value_t = 10.0)]
    pub patience: f64,
    /// Print the answer as JSON.
    #[arg(long)]
    pub json: bool,
}

impl LimitsCommand {
    /// Sends the limits and prints the loop's answer.
    ///
    /// # Errors
    /// One sentence: what is wrong with the limits, by name, or why the loop does not answer.
    pub fn run(self) -> Result<(), Failure> {
        let moved = self.moved()?;
        let (name, patience) = (RobotName::new(&self.name)?, Duration::from_secs_f64(self.patience));
        let mut link = OperatorLink::open(&name, patience)?;
        let start = Instant::now();
        let receipt = link.move_limits(&moved, patience)?;
        let (verdict, text, took) = (receipt.verdict(), receipt.text(), start.elapsed().as_secs_f64());
        if self.json {
            let told = serde_json::json!({ "verdict": verdict.name(), "text": text, "tick": receipt.tick, "seconds": took });
            say(told);
        }
        if verdict != Verdict::Accepted {
            let why =
                if verdict == Verdict::Other { "the loop keeps the limits it has" } else { verdict.name() };
            return Err(format!("{why}: {text}").into());
        }
        if !self.json {
            say(format!("{text} at tick {}, {:.0} ms after it was asked for", receipt.tick, 1e3 * took));
        }
        Ok(())
    }

    fn moved(&self) -> Result<Moved, Failure> {
        let mut text = self.set.join("\n");
        if let Some(file) = &self.file {
            let more = read_task_text(file).map_err(|e| format!("{}: {e}", file.display()))?;
            text = format!("{more}\n{text}");
        }
        let mut moved: Moved = toml::from_str(&text).map_err(|e| {
            format!(
                "limits cannot be read: {}; write for example upper = {{ elbow = 1.0 }}",
                crate::snapshot::one_line(&e.message())
            )
        })?;
        moved.speed = self.speed.unwrap_or(moved.speed);
        Ok(moved)
    }
}
