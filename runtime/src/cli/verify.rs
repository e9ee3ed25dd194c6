//! `nearl verify`: confirms from a flight log alone what the loop promised.

use std::path::PathBuf;
use std::time::Instant;

use clap::Args;
use nearl_verify::{Report, verify};

use super::{Failure, say};

/// Exit code of a log that could not be verified whole.
pub const UNVERIFIED: u8 = 2;

/// Confirm from a flight log alone that every limit held, every answer was optimal, and a way to stop existed in every tick.
///
/// Exit code 0: all of it is so. 1: something is not. 2: some of it could not be verified, or the file is none.
#[derive(Args, Debug)]
pub struct VerifyCommand {
    /// Flight log (MCAP) of `nearl run --log`.
    pub file: PathBuf,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

/// A log that could not be verified, or not whole.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct Unverified(pub(crate) String);

impl VerifyCommand {
    /// Verifies and prints what was found.
    ///
    /// # Errors
    /// One sentence: how much does not hold, or what could not be verified ([`Unverified`]).
    pub fn run(self) -> Result<(), Failure> {
        let begin = Instant::now();
        let report = verify(&self.file).map_err(|e| Unverified(e.to_string()))?;
        let each = begin.elapsed().as_secs_f64() * 1e6 / report.ticks.max(1) as f64;
        let file = self.file.display().to_string();
        if self.json {
            say(serde_json::to_string(&report)?);
        } else {
            say(format!("{file}: {}", report.to_string().trim_end()));
            say(format!("  {each:.1} us a tick"));
        }
        conclude(&file, &report)
    }
}

fn conclude(file: &str, report: &Report) -> Result<(), Failure> {
    match report {
        _ if report.found > 0 => Err(format!(
            "{file}: {} of {} ticks do not hold what the log says; a log that `nearl replay` finds equal was not changed: then the loop failed, \
             or the robot came to its states by something else than its actions, as by a push, after a late answer, or because what measures them is \
             noisy",
            report.found, report.ticks
        )
        .into()),
        _ if report.is_whole() => Ok(()),
        _ if report.verified == 0 && report.unverified() == 0 => {
            Err(Box::new(Unverified(format!("{file}: no tick of it has an action, so that there is nothing to verify"))))
        }
        _ => Err(Box::new(Unverified(format!(
            "{file}: what was verified holds, but not all of it could be: {}; the reasons are above",
            missing(report)
        )))),
    }
}

/// What could not be verified.
fn missing(report: &Report) -> String {
    let ticks = (report.unverified() > 0).then(|| format!("{} ticks", report.unverified()));
    let end = (!report.complete).then(|| "what came after the end of the log".to_string());
    let file = (report.complete && !report.intact).then(|| "the end of the file".to_string());
    [ticks, end, file].into_iter().flatten().collect::<Vec<_>>().join(" and ")
}
