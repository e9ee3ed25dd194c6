//! The real `nearl` binary as child processes, for the tests of processes and of bad input.
#![allow(dead_code, unreachable_pub)] // each test binary uses a part of it

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

/// The bundled Panda.
pub fn panda() -> PathBuf {
    repository().join("examples/snapshots/panda-reach.safetensors")
}

/// Root of the checkout.
pub fn repository() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the tests lie in the checkout")
}

/// A program of this workspace, beside the test's own folder `target/<profile>/deps`.
pub fn program(name: &str) -> PathBuf {
    let own = std::env::current_exe().expect("path of the test program");
    let folder = own.parent().and_then(Path::parent).expect("target/<profile>/deps");
    let file = folder.join(name);
    let built = file.display();
    assert!(file.is_file(), "'{built}' is not built: run 'cargo build --release --bins' before the tests");
    file
}

/// A child that is killed whatever happens.
pub struct Process(Option<Child>);

impl Process {
    /// `nearl` with `arguments`.
    pub fn nearl(arguments: &[&str]) -> Process {
        let mut command = Command::new(program("nearl"));
        Process::start(command.args(arguments))
    }

    /// `command` with everything it prints kept.
    pub fn start(command: &mut Command) -> Process {
        Process::start_with(command, Stdio::null())
    }

    /// The same with standard input.
    pub fn start_with(command: &mut Command, input: Stdio) -> Process {
        let command = command.stdin(input).stdout(Stdio::piped()).stderr(Stdio::piped());
        Process(Some(command.spawn().expect("start of a child")))
    }

    /// Process id.
    pub fn id(&self) -> u32 {
        self.0.as_ref().expect("a running child").id()
    }

    /// Sends `signal`.
    pub fn signal(&self, signal: libc::c_int) {
        let id = self.0.as_ref().expect("a running child").id();
        let id = i32::try_from(id).expect("process id");
        // SAFETY: plain call on a child that has not been waited for.
        assert_eq!(unsafe { libc::kill(id, signal) }, 0, "signal {signal} to a child");
    }

    /// `kill -9`, and waits until it is gone.
    pub fn kill(mut self) {
        let mut child = self.0.take().expect("a running child");
        child.kill().expect("kill");
        let status = child.wait().expect("wait");
        assert!(status.code().is_none(), "the child had ended by itself ({status})");
    }

    /// Waits for its end; a child that hangs is killed and fails the test.
    pub fn output(mut self) -> Output {
        let mut child = self.0.take().expect("a running child");
        let end = Instant::now() + Duration::from_secs(60);
        while child.try_wait().expect("wait").is_none() {
            if Instant::now() > end {
                let _ = child.kill();
                let output = child.wait_with_output().expect("output");
                panic!("a child hung: {}", String::from_utf8_lossy(&output.stderr));
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        child.wait_with_output().expect("output")
    }

    /// Waits for its end with exit code 0 and reads the JSON object it printed.
    pub fn json(self) -> Value {
        let output = self.output();
        let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
        assert!(output.status.success(), "{}: {err}", output.status);
        serde_json::from_str(out.trim()).unwrap_or_else(|e| panic!("not one JSON object ({e}): {out}"))
    }

    /// SIGTERM, then [`Process::json`].
    pub fn end(self) -> Value {
        self.signal(libc::SIGTERM);
        self.json()
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

/// Says what is not tested here, past the harness that keeps what a test prints; with `NEARL_NO_SKIPS`, as where every means is at hand,
/// that is a failure.
pub fn skip(reason: &str) {
    assert!(std::env::var_os("NEARL_NO_SKIPS").is_none(), "not tested: {reason}");
    let _ = writeln!(std::io::stderr(), "SKIPPED, not tested: {reason}");
}

/// Resident memory of a process without what it shares [kB].
pub fn resident(id: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{id}/status")).expect("status of a process");
    let line = status.lines().find(|l| l.starts_with("RssAnon:")).expect("RssAnon");
    line.split_whitespace().nth(1).and_then(|n| n.parse().ok()).expect("a number of kB")
}

/// Waits until `take` answers; fails the test with `what` after 30 s.
pub fn until<T>(what: &str, mut take: impl FnMut() -> Option<T>) -> T {
    let end = Instant::now() + Duration::from_secs(30);
    loop {
        if let Some(value) = take() {
            return value;
        }
        assert!(Instant::now() < end, "within 30 s: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}
