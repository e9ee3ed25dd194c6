//! Asking the loop to stop: SIGINT, SIGTERM, SIGHUP, or a call.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::low_level::{exit, register};

use crate::clock;

/// Signals so close to the first are the same wish [ns]: a shell sends one to a whole group, and a program in it passes it on.
const ONE_WISH: u64 = 200_000_000;
/// Exit code of a program that a second signal ended.
const ENDED: i32 = 130;

/// Set once; the loop then brakes to zero velocity and returns.
#[derive(Clone, Debug, Default)]
pub struct Stop(Arc<AtomicBool>);

impl Stop {
    /// A stop that only [`Stop::request`] sets.
    pub fn new() -> Stop {
        Stop::default()
    }

    /// Also set by the first of the [`ending`] signals; a second one, 0.2 s after it or later, ends the process at once with code 130.
    pub fn on_signals() -> std::io::Result<Stop> {
        let stop = Stop::default();
        let first = Arc::new(AtomicU64::new(0));
        for signal in ending() {
            let (is_asked, first) = (Arc::clone(&stop.0), Arc::clone(&first));
            // SAFETY: the handler reads the clock, reads and writes atomic numbers, and ends the process, which a handler may do.
            unsafe { register(signal, move || heed(&is_asked, &first)) }?;
        }
        Ok(stop)
    }

    /// Asks for the stop.
    pub fn request(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// True once it was asked for.
    pub fn is_requested(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

/// Has a write beyond the largest size of files (`ulimit -f`) fail as on a full disk, which is said in a sentence; the signal would end the program.
pub fn outlive_file_sizes() {
    // SAFETY: nothing runs where a signal is ignored.
    unsafe { libc::signal(libc::SIGXFSZ, libc::SIG_IGN) };
}

/// The signals that ask a program to end: SIGINT, SIGTERM, and SIGHUP, which a terminal sends that is closed, unless it is ignored as `nohup` has it.
pub fn ending() -> impl Iterator<Item = i32> {
    let mut now = std::mem::MaybeUninit::<libc::sigaction>::zeroed();
    // SAFETY: no action is set, and that of now is written to a place of its type.
    let read = unsafe { libc::sigaction(SIGHUP, std::ptr::null(), now.as_mut_ptr()) };
    // SAFETY: all zeroes are an action too.
    let is_ignored = read == 0 && unsafe { now.assume_init() }.sa_sigaction == libc::SIG_IGN;
    [SIGINT, SIGTERM].into_iter().chain((!is_ignored).then_some(SIGHUP))
}

/// What a signal does; `first` is when the first one came, 0 before \[ns\].
fn heed(is_asked: &AtomicBool, first: &AtomicU64) {
    let now = clock::now().max(1);
    match first.compare_exchange(0, now, Ordering::AcqRel, Ordering::Acquire) {
        Ok(_) if !is_asked.swap(true, Ordering::AcqRel) => {}
        Err(at) if now < at.saturating_add(ONE_WISH) => {}
        _ => exit(ENDED),
    }
}
