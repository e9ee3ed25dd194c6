//! Worker processes: started, watched, told to stop.

use std::io::Read;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::{Found, Run, Sweep};

/// How often workers are looked at.
const PAUSE: Duration = Duration::from_millis(100);

/// What happened in a sweep.
#[derive(Debug)]
pub enum Event<'a> {
    /// A run was left alone, it was finished before.
    Skipped(&'a Run),
    /// A worker started.
    Started(&'a Run),
    /// A worker ended: `Ok`, or its last words.
    Ended(&'a Run, Result<(), String>),
    /// Time passed; steps done by all workers at work.
    Waiting(u64),
}

/// Runs that are not finished.
pub struct Left {
    /// Ended by themselves, with an error that was told.
    pub failed: usize,
    /// Stopped, or not begun.
    pub stopped: usize,
}

struct Worker<'a> {
    run: &'a Run,
    process: Child,
}

/// Trains what is not finished, `jobs` at a time, each on one thread. `stop` asks the workers to save and end, and starts no
/// more.
pub fn run(sweep: &Sweep, runs: &[Run], jobs: usize, stop: &AtomicBool, mut tell: impl FnMut(Event)) -> Left {
    let (mut waiting, mut working, mut told) = (runs.iter(), Vec::new(), false);
    let mut left = Left { failed: 0, stopped: 0 };
    loop {
        while working.len() < jobs.max(1) && !stop.load(Ordering::Relaxed) {
            let Some(run) = waiting.next() else { break };
            if run.found == Found::Finished {
                tell(Event::Skipped(run));
                continue;
            }
            match start(sweep, run) {
                Ok(process) => {
                    tell(Event::Started(run));
                    working.push(Worker { run, process });
                }
                Err(words) => {
                    left.failed += 1;
                    tell(Event::Ended(run, Err(words)));
                }
            }
        }
        if stop.load(Ordering::Relaxed) && !std::mem::replace(&mut told, true) {
            working.iter().for_each(|w| terminate(&w.process));
        }
        working.retain_mut(|worker: &mut Worker| match end(worker, sweep.steps) {
            None => true,
            Some(result) => {
                *(if told { &mut left.stopped } else { &mut left.failed }) += usize::from(result.is_err());
                tell(Event::Ended(worker.run, result));
                false
            }
        });
        let goes_on = !stop.load(Ordering::Relaxed) && waiting.len() > 0;
        if working.is_empty() && !goes_on {
            left.stopped += waiting.filter(|r| r.found != Found::Finished).count();
            return left;
        }
        tell(Event::Waiting(working.iter().map(|w| steps(&w.run.folder)).sum()));
        std::thread::sleep(PAUSE);
    }
}

/// Starts `nearl train` on one thread. Of a run without a checkpoint, which has nothing to go on from, what says that it is one is removed first.
fn start(sweep: &Sweep, run: &Run) -> Result<Child, String> {
    for name in ["env.json", "metrics.csv"].iter().filter(|_| run.found == Found::Broken) {
        let file = run.folder.join(name);
        match std::fs::remove_file(&file) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                return Err(format!("cannot remove '{}': {e}", file.display()));
            }
            _ => {}
        }
    }
    let program = std::env::current_exe().map_err(|e| format!("cannot find this program: {e}"))?;
    let mut command = Command::new(program);
    command.args(["train", &run.task, "--threads", "1", "--json"]);
    if run.found == Found::Resumable {
        command.arg("--resume").arg(&run.folder);
    } else {
        command.args(["--algo", run.algo.name(), "--seed", &run.seed.to_string()]);
        command.args(["--steps", &sweep.steps.to_string()]).arg("--out").arg(&run.folder);
        command.args(sweep.preset.iter().flat_map(|preset| ["--preset", preset.name()]));
        command.args(sweep.set.iter().flat_map(|set| ["--set", set]));
    }
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
    command.process_group(0); // Ctrl-C reaches the sweep alone, which asks its workers once
    // SAFETY: prctl is async-signal-safe and touches nothing of the parent.
    unsafe {
        command.pre_exec(|| {
            // a worker does not outlive its sweep
            libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGTERM);
            Ok(())
        });
    }
    command.spawn().map_err(|e| format!("cannot start a worker: {e}"))
}

fn terminate(process: &Child) {
    // SAFETY: a signal to a child that was not waited for yet.
    unsafe { libc::kill(process.id() as libc::pid_t, libc::SIGTERM) };
}

/// How the worker ended; none while it works. One that was asked to stop has saved what it learned, and is not finished.
fn end(worker: &mut Worker, wanted: u64) -> Option<Result<(), String>> {
    let status = match worker.process.try_wait() {
        Ok(None) => return None,
        Ok(Some(status)) => status,
        Err(e) => return Some(Err(e.to_string())),
    };
    let mut words = String::new();
    if let Some(mut error) = worker.process.stderr.take() {
        let _ = error.read_to_string(&mut words);
    }
    Some(match (status.success(), steps(&worker.run.folder)) {
        (true, done) if done >= wanted => Ok(()),
        (true, done) => Err(format!("stopped after {done} of {wanted} steps")),
        (false, _) => match words.trim().lines().last() {
            Some(last) => Err(last.trim_start_matches("nearl: ").to_string()),
            None => Err(format!("the worker ended with {status}")),
        },
    })
}

/// Steps in the last line of a run's metrics; 0 before the first.
fn steps(folder: &Path) -> u64 {
    let text = std::fs::read_to_string(folder.join("metrics.csv")).unwrap_or_default();
    text.lines().last().and_then(|l| l.split(',').next()).and_then(|s| s.parse().ok()).unwrap_or(0)
}
