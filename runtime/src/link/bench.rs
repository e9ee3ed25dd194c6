//! Round trip of a state and its action through shared memory, without a loop in between.

use std::sync::atomic::{AtomicBool, Ordering};

use serde::Serialize;

use super::service::Bus;
use super::*;
use crate::rt::{Percentiles, clock, percentiles};

/// Round trips in [ns].
#[derive(Clone, Debug, Serialize)]
pub struct RoundTrip {
    /// Size of the state message [bytes].
    pub state_bytes: usize,
    /// Size of the action message [bytes].
    pub action_bytes: usize,
    /// One after the other.
    pub busy: Percentiles,
    /// One each millisecond, on an absolute grid.
    pub paced: Percentiles,
}

/// Measures `n` round trips busy and `n` paced at 1 kHz between two threads, both polling; segments are the same as
/// between processes. Removes the files of `name` afterwards: use a name of its own.
pub fn bench_round_trip(name: &RobotName, n: u64) -> Result<RoundTrip, LinkError> {
    let over = AtomicBool::new(false);
    let result = std::thread::scope(|scope| {
        let echo = scope.spawn(|| echo(name, &over));
        let result = measure(name, n);
        over.store(true, Ordering::Release);
        match echo.join() {
            Ok(echoed) => echoed.and(result),
            Err(_) => Err(name.transport("measure", "the echo thread panicked")),
        }
    });
    remove_files(name);
    result
}

fn echo(name: &RobotName, over: &AtomicBool) -> Result<(), LinkError> {
    let bus = Bus::join(name)?;
    let mut states = bus.inbox::<StateMessage>()?;
    let mut actions = bus.outbox::<ActionMessage>()?;
    let mut action = ActionMessage::zeroed();
    while !over.load(Ordering::Acquire) {
        match states.newest() {
            Some(state) => {
                action.state_seq = state.header.seq;
                actions.send(&mut action);
            }
            None => std::thread::yield_now(),
        }
    }
    Ok(())
}

fn measure(name: &RobotName, n: u64) -> Result<RoundTrip, LinkError> {
    let fail = |e: hdrhistogram::CreationError| name.transport("measure", e.to_string());
    let bus = Bus::join(name)?;
    let mut states = bus.outbox::<StateMessage>()?;
    let mut actions = bus.inbox::<ActionMessage>()?;
    let mut state = StateMessage::zeroed();
    let mut exchange = |patience: u64| {
        states.send(&mut state);
        let end = clock::now() + patience;
        while clock::now() < end {
            match actions.newest() {
                Some(action) if action.state_seq == state.header.seq => {
                    return Some(clock::now() - state.header.stamp);
                }
                _ => std::thread::yield_now(),
            }
        }
        None
    };
    // The first exchange waits for the echo thread to open its ends.
    let attached = (0..50).any(|_| exchange(100_000_000).is_some());
    if !attached {
        return Err(name.transport("measure", "the echo thread does not answer"));
    }
    let mut busy = hdrhistogram::Histogram::<u64>::new_with_bounds(1, 10_000_000_000, 3).map_err(fail)?;
    let mut paced = busy.clone();
    for _ in 0..n {
        exchange(1_000_000_000).into_iter().for_each(|t| busy.saturating_record(t));
    }
    let start = clock::now();
    for i in 0..n {
        clock::sleep_until(start + i * 1_000_000);
        exchange(1_000_000_000).into_iter().for_each(|t| paced.saturating_record(t));
    }
    Ok(RoundTrip {
        state_bytes: size_of::<StateMessage>(),
        action_bytes: size_of::<ActionMessage>(),
        busy: percentiles(&busy),
        paced: percentiles(&paced),
    })
}
