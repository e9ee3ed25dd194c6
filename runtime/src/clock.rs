//! Monotonic time, absolute sleeping, and a bell between two threads. The wall clock is never read.

use std::sync::atomic::{AtomicU32, Ordering};

use rustix::thread::futex;
use rustix::time::{ClockId, Timespec, clock_gettime};

const SECOND: u64 = 1_000_000_000;

/// Monotonic time \[ns\]; the same clock in every process of the machine.
pub fn now() -> u64 {
    let t = clock_gettime(ClockId::Monotonic);
    t.tv_sec as u64 * SECOND + t.tv_nsec as u64
}

fn timespec(at: u64) -> Timespec {
    Timespec { tv_sec: (at / SECOND) as i64, tv_nsec: (at % SECOND) as _ }
}

/// Sleeps until the monotonic time `at` \[ns\]. Signals do not shorten the sleep.
pub fn sleep_until(at: u64) {
    let at = timespec(at);
    while rustix::thread::clock_nanosleep_absolute(ClockId::Monotonic, &at).is_err() {}
}

/// Seconds as nanoseconds.
pub fn nanoseconds(seconds: f64) -> u64 {
    (seconds * 1e9).round() as u64
}

/// Wakes one waiting thread: a counter and a futex, no lock. A ring between `seen` and `wait` is not lost.
#[derive(Debug, Default)]
pub struct Bell(AtomicU32);

impl Bell {
    /// Wakes the waiting thread, if there is one.
    pub fn ring(&self) {
        self.0.fetch_add(1, Ordering::Release);
        let _ = futex::wake(&self.0, futex::Flags::PRIVATE, 1);
    }

    /// Rings so far; read it before looking for work, then pass it to [`Bell::wait`].
    pub fn seen(&self) -> u32 {
        self.0.load(Ordering::Acquire)
    }

    /// Waits for a ring after `seen`, at the latest until the monotonic time `until` \[ns\].
    pub fn wait(&self, seen: u32, until: u64) {
        let until = timespec(until);
        let any = std::num::NonZeroU32::MAX;
        // Wakes early for signals and rings in between: the caller looks at its work and the clock again.
        let _ = futex::wait_bitset(&self.0, futex::Flags::PRIVATE, seen, Some(&until), any);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ring_before_the_wait_is_not_lost() {
        let bell = Bell::default();
        let seen = bell.seen();
        bell.ring();
        bell.wait(seen, now() + 3600 * SECOND); // would sleep for an hour
    }

    #[test]
    fn sleeping_never_ends_early() {
        let at = now() + 200_000;
        sleep_until(at);
        assert!(now() >= at);
        let bell = Bell::default();
        let at = now() + 200_000;
        while now() < at {
            bell.wait(bell.seen(), at);
        }
    }
}
