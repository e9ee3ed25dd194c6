//! Round trip of a state and its action through shared memory, without a loop in between.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use serde::Serialize;

use super::*;
use crate::clock;
use crate::percentiles::{Percentiles, percentiles};

/// Joints of the robot whose ticks are sent: an arm's.
const JOINTS: usize = 7;
/// Wait for the other end [ns].
const PATIENCE: u64 = 1_000_000_000;

/// Round trips in \[ns\].
#[derive(Clone, Debug, Serialize)]
pub struct RoundTrip {
    /// Joints of the robot whose states and actions were sent; its observation is their positions and velocities.
    pub joints: usize,
    /// One after the other.
    pub busy: Percentiles,
    /// One each millisecond, on an absolute grid.
    pub paced: Percentiles,
}

/// Measures `n` round trips busy and `n` paced at 1 kHz between the links of a plant and a runtime on two threads, both polling; the
/// memory is the same as between processes. Removes the files of `name` afterwards: use a name of its own.
pub fn bench_round_trip(name: &RobotName, n: u64) -> Result<RoundTrip, LinkError> {
    let over = AtomicBool::new(false);
    let result = std::thread::scope(|scope| {
        let plant = PlantLink::open(name, &robot())?;
        let answering = scope.spawn(|| answer(name, &over));
        let result = measure(plant, n);
        over.store(true, Ordering::Release);
        match answering.join() {
            Ok(answered) => answered.and(result),
            Err(_) => Err(name.transport("measure", "the answering thread panicked")),
        }
    });
    remove_files(name);
    result
}

fn robot() -> Robot {
    let names = |what| (0..JOINTS).map(move |j| format!("{what}{j}"));
    Robot {
        joints: names("joint").collect(),
        observation: names("q.joint").chain(names("v.joint")).collect(),
        limits: 0,
        stated: None,
        nq: JOINTS,
        nv: JOINTS,
        nu: JOINTS,
        dt: 1e-3,
        lockstep: true,
    }
}

/// Answers every state with an action, as a runtime that needs no time would.
fn answer(name: &RobotName, over: &AtomicBool) -> Result<(), LinkError> {
    let mut link = RuntimeLink::open(name)?;
    link.wait_for_plant(Duration::from_nanos(PATIENCE))?;
    let (mut action, mut poll) = (ActionMessage::zeroed(), Poll::default());
    action.nu = JOINTS as u32;
    while !over.load(Ordering::Acquire) {
        match link.newest_state() {
            Some(state) => {
                (action.state_epoch, action.state_seq) = (state.header.epoch, state.header.seq);
                action.action_mut().copy_from_slice(state.q());
                link.send_action(&mut action);
                poll = Poll::default();
            }
            None => poll.again(),
        }
    }
    Ok(())
}

/// Polling that leaves the core to others after a while: without a second core nothing would ever answer.
#[derive(Default)]
struct Poll(u32);

impl Poll {
    fn again(&mut self) {
        self.0 += 1;
        if self.0 < 10_000 {
            std::hint::spin_loop();
        } else {
            std::thread::yield_now();
        }
    }
}

fn measure(mut link: PlantLink, n: u64) -> Result<RoundTrip, LinkError> {
    let name = link.name().clone();
    let histogram = || {
        let made = hdrhistogram::Histogram::<u64>::new_with_bounds(1, 10 * PATIENCE, 3);
        made.map_err(|e| name.transport("measure", e.to_string()))
    };
    let (mut busy, mut paced) = (histogram()?, histogram()?);
    let mut state = StateMessage::zeroed();
    (state.nq, state.nv, state.nu) = (JOINTS as u32, JOINTS as u32, JOINTS as u32);
    state.n_obs = 2 * JOINTS as u32;
    state.q_mut().fill(0.5);
    let mut exchange = |link: &mut PlantLink, patience: u64| {
        link.send_state(&mut state);
        let (sent, mut poll) = (state.header, Poll::default());
        while clock::now() < sent.stamp + patience {
            match link.newest_action() {
                Some(action) if action.state_seq == sent.seq => return Some(clock::now() - sent.stamp),
                _ => poll.again(),
            }
        }
        None
    };
    let mut is_answered = || link.announce() && exchange(&mut link, PATIENCE / 50).is_some();
    // The first exchange waits for the other thread to open its ends.
    if !(0..50).any(|_| is_answered()) {
        return Err(name.transport("measure", "the answering thread does not answer"));
    }
    for _ in 0..n {
        exchange(&mut link, PATIENCE).into_iter().for_each(|t| busy.saturating_record(t));
    }
    let start = clock::now();
    for i in 0..n {
        clock::sleep_until(start + i * 1_000_000);
        exchange(&mut link, PATIENCE).into_iter().for_each(|t| paced.saturating_record(t));
    }
    Ok(RoundTrip { joints: JOINTS, busy: percentiles(&busy), paced: percentiles(&paced) })
}
