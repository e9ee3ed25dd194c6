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
    #[arg(long, value_name = "SHARE")]
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
        if self.speed.is_none() && self.set.is_empty() && self.file.is_none() && !self.reset {
            return Err(
                "nothing is said to move: give --speed SHARE, --set LIMIT, --file FILE or --reset".into()
            );
        }
        let mut text = self.set.join("\n");
        if let Some(file) = &self.file {
            let more = read_task_text(file).map_err(|e| format!("{}: {e}", file.display()))?;
            text = format!("{more}\n{text}");
        }
        let unread = |e: toml::de::Error| {
            let at = e.span().map_or("", |span| text[..span.end].lines().next_back().unwrap_or_default());
            format!(
                "limits cannot be read: {}, in '{}'; write each once, for example upper = {{ elbow = 1.0 }}",
                crate::snapshot::one_line(&e.message()),
                crate::snapshot::one_line(&at)
            )
        };
        let given: toml::Table = toml::from_str(&text).map_err(unread)?;
        let mut moved: Moved = toml::from_str(&text).map_err(unread)?;
        if let Some(share) = self.speed {
            if let Some(also) = given.get("speed") {
                return Err(format!(
                    "--speed {share} and speed = {also} both say the share of speed; give one"
                )
                .into());
            }
            if !(share > 0.0 && share <= 1.0) {
                return Err(
                    format!("--speed {share} is not usable: give a share above 0 and at most 1").into()
                );
            }
            moved.speed = share;
        }
        Ok(moved)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        limits: LimitsCommand,
    }

    fn parse(words: &[&str]) -> Result<Moved, String> {
        let line = Line::parse_from([&["limits", "arm"], words].concat());
        line.limits.moved().map_err(|e| e.to_string())
    }

    #[test]
    fn what_is_said_twice_or_not_at_all_is_refused() {
        assert_eq!(parse(&["--speed", "0.3"]), Ok(Moved::speed(0.3)));
        assert_eq!(parse(&["--set", "speed = 0.3"]), Ok(Moved::speed(0.3)));
        assert_eq!(parse(&["--reset"]), Ok(Moved::default()));
        for (words, says) in [
            (&[][..], "nothing is said to move: give --speed SHARE, --set LIMIT, --file FILE or --reset"),
            (&["--speed", "nan"], "--speed NaN is not usable: give a share above 0"),
            (&["--speed", "0"], "--speed 0 is not usable"),
            (&["--speed", "0.6", "--set", "speed=0.5"], "--speed 0.6 and speed = 0.5 both say"),
            (&["--set", "velocity={a=1.9}", "--set", "velocity={b=1.0}"], "duplicate key, in 'velocity'"),
            (&["--set", "velocty={a=1.9}"], "unknown field `velocty`"),
        ] {
            let text = parse(words).unwrap_err();
            assert!(text.contains(says), "{words:?}: {text}");
        }
    }
}
