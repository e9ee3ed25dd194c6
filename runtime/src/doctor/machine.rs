//! What of the machine the loop runs on is looked at: memory, links that nobody uses, priority, clock.

use super::{Check, fail, ok, warn};
use crate::codes::CheckCode;
use crate::link::{RobotName, SHARED_MEMORY, check_memory, free_memory, home_of_user, remains};
use crate::rt::{PRIORITY, Stop, ThreadSettings, bench_wake, prepare};
use rustix::time::{ClockId, clock_getres};
use std::path::Path;

/// Room for the links.
pub(super) fn memory() -> Check {
    let megabytes = |bytes: u64| bytes >> 20;
    let needed = megabytes(SHARED_MEMORY);
    let result = RobotName::new(&format!("doctor{}", std::process::id()))
        .and_then(|name| check_memory(&name, SHARED_MEMORY));
    match result {
        Err(e) => fail(CheckCode::Memory, e.to_string()),
        Ok(()) => ok(
            CheckCode::Memory,
            format!("/dev/shm has {} MB free, a robot needs {needed}", megabytes(free_memory())),
        ),
    }
}

/// Links that only dead processes hold.
pub(super) fn stale_links() -> Check {
    let all = remains();
    let mut stale: Vec<_> = all.iter().filter(|r| r.is_stale()).collect();
    stale.sort_by_key(|r| -r.changed);
    if stale.is_empty() {
        let alive = all.iter().filter(|r| r.alive > 0).count();
        return ok(
            CheckCode::Links,
            format!("{alive} robots are running, no link of a dead process is left"),
        );
    }
    let kilobytes = stale.iter().map(|r| r.bytes).sum::<u64>() >> 10;
    let names: Vec<&str> = stale.iter().map(|r| r.name.as_str()).collect();
    warn(CheckCode::Links, left(&names, kilobytes, &home_of_user()))
}

/// Names of robots that are told one by one.
const NAMED: usize = 3;

/// What dead processes left of the links of this user's robots `names`, newest first.
pub(super) fn left(names: &[&str], kilobytes: u64, folder: &Path) -> String {
    let files = |name: &&str| format!("/dev/shm/nearl.{name}.* and {}/{name}", folder.display());
    let shown: Vec<String> = names.iter().take(NAMED).map(files).collect();
    let more = match names.len().saturating_sub(NAMED) {
        0 => String::new(),
        more => format!(" and those of {more} more (names in {})", folder.display()),
    };
    format!(
        "{kilobytes} kB of {} robots are held by dead processes: start a robot again, which cleans up, or delete {}{more}",
        names.len(),
        shown.join(", ")
    )
}

/// Asks the operating system for `wish` on a thread that ends at once.
fn wish(check: CheckCode, granted: &str, wish: ThreadSettings) -> Check {
    let thread = std::thread::Builder::new().spawn(move || prepare(&wish));
    match thread.map(std::thread::JoinHandle::join) {
        Ok(Ok(warnings)) if warnings.is_empty() => ok(check, granted.into()),
        Ok(Ok(warnings)) => warn(check, warnings.join("; ")),
        Ok(Err(_)) => fail(check, "the thread that asked panicked: report it with the message above".into()),
        Err(e) => fail(check, format!("no thread could be started ({e}): raise `ulimit -u`")),
    }
}

pub(super) fn priority() -> Check {
    let settings = ThreadSettings { priority: Some(PRIORITY), cpu: None, lock_memory: false };
    wish(CheckCode::Priority, &format!("SCHED_FIFO priority {PRIORITY} is granted"), settings)
}

pub(super) fn lock() -> Check {
    let settings = ThreadSettings { priority: None, cpu: None, lock_memory: true };
    wish(CheckCode::Lock, "memory can be locked", settings)
}

pub(super) fn clock() -> Check {
    let t = clock_getres(ClockId::Monotonic);
    let resolution = t.tv_sec as u64 * 1_000_000_000 + t.tv_nsec as u64;
    if resolution <= 1000 {
        return ok(CheckCode::Clock, format!("the monotonic clock counts {resolution} ns"));
    }
    let text = format!(
        "the monotonic clock counts {resolution} ns: boot with high-resolution timers (CONFIG_HIGH_RES_TIMERS)"
    );
    warn(CheckCode::Clock, text)
}

/// Shortest control period that is tried, and the shortest that is told by its number [s].
const SHORTEST: f64 = 2e-5;
const NANOSECOND: f64 = 1e-9;

/// One second of an empty loop beside the control period `dt` [s].
pub(super) fn wake(dt: f64) -> Check {
    if dt < SHORTEST {
        let period = if dt < NANOSECOND { format!("less than {NANOSECOND} s") } else { format!("{dt} s") };
        let text = format!("the period is {period}, which no loop here keeps: give at least {SHORTEST} s");
        return fail(CheckCode::WakeUp, text);
    }
    let period = dt.min(1e-3);
    let settings = ThreadSettings { priority: Some(PRIORITY), cpu: None, lock_memory: false };
    let late = match bench_wake(period, (1.0 / period).round() as u64, settings, &Stop::new()) {
        Ok((late, _)) => late,
        Err(e) => {
            return fail(CheckCode::WakeUp, format!("the empty loop did not run ({e}): raise `ulimit -u`"));
        }
    };
    let us = |ns: u64| ns as f64 * 1e-3;
    let found = format!(
        "an empty loop wakes up {:.0} us late (p50), {:.0} us (p99), {:.0} us at most; the period is {:.0} us",
        us(late.p50),
        us(late.p99),
        us(late.max),
        1e6 * dt
    );
    if late.p99 as f64 * 1e-9 < 0.5 * dt {
        return ok(CheckCode::WakeUp, found);
    }
    warn(
        CheckCode::WakeUp,
        format!("{found}: stop other programs, or keep a core free and give it with --cpu"),
    )
}
