//! Starts `nearl` as a process of its own, for commands that show several of them at work.

use super::Failure;
use serde_json::Value;
use std::process::{Child, Command, Stdio};

/// A child that prints JSON, stopped whatever happens.
pub(super) struct Process(Option<Child>);

impl Process {
    /// Starts this program with other arguments.
    pub(super) fn nearl(arguments: &[&str]) -> Result<Process, Failure> {
        let program = std::env::current_exe()?;
        Ok(Process(Some(Command::new(program).args(arguments).stdout(Stdio::piped()).spawn()?)))
    }

    /// Asks it to end, as a terminal would.
    pub(super) fn stop(self) -> Process {
        if let Some(pid) = self.0.as_ref().and_then(|child| i32::try_from(child.id()).ok()) {
            // SAFETY: sends a signal to a child that has not been waited for.
            unsafe { libc::kill(pid, libc::SIGTERM) };
        }
        self
    }

    /// Waits and reads the JSON object it printed last.
    pub(super) fn json(mut self) -> Result<Value, Failure> {
        let Some(child) = self.0.take() else { return Err("the process was already read".into()) };
        let output = child.wait_with_output()?;
        last_json(&output.stdout).ok_or_else(|| {
            format!("'nearl' ended without a report ({}); its message is above", output.status).into()
        })
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        if let Some(mut child) = self.0.take() {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// The JSON object in the last line of what a program printed that begins like one.
pub(super) fn last_json(printed: &[u8]) -> Option<Value> {
    let text = String::from_utf8_lossy(printed);
    text.lines().rfind(|line| line.starts_with('{')).and_then(|line| serde_json::from_str(line).ok())
}
