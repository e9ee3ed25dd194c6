//! A wall clock that jumps an hour forth and two back, in the middle of motion: this program takes the place of the C library's
//! readers of the clock, for its own threads and every library in it.

mod arm;
mod toy;

use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use arm::*;
use nearl_runtime::link::*;
use nearl_runtime::rt::*;
use toy::Name;

static JUMPS: AtomicBool = AtomicBool::new(false);
/// Seconds the wall clock is off.
static OFFSET: AtomicI64 = AtomicI64::new(0);
static READS: AtomicU64 = AtomicU64::new(0);

/// The C library's reader of clocks, with a script for the wall clock.
///
/// # Safety
/// As the C library's.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn clock_gettime(clock: libc::clockid_t, time: *mut libc::timespec) -> libc::c_int {
    // SAFETY: the caller's pointer, for the kernel to write to.
    let result = unsafe { libc::syscall(libc::SYS_clock_gettime, clock, time) } as libc::c_int;
    let is_wall = matches!(clock, libc::CLOCK_REALTIME | libc::CLOCK_REALTIME_COARSE | libc::CLOCK_TAI);
    if result == 0 && is_wall && JUMPS.load(Ordering::Relaxed) {
        READS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the kernel has just written there.
        unsafe { (*time).tv_sec += OFFSET.load(Ordering::Relaxed) };
    }
    result
}

/// As above, for those who ask for microseconds.
///
/// # Safety
/// As the C library's.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn gettimeofday(time: *mut libc::timeval, _: *mut libc::c_void) -> libc::c_int {
    let mut now = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: a place of our own.
    let result = unsafe { clock_gettime(libc::CLOCK_REALTIME, &raw mut now) };
    if result == 0 && !time.is_null() {
        // SAFETY: the caller's pointer, which is not null.
        unsafe { *time = libc::timeval { tv_sec: now.tv_sec, tv_usec: now.tv_nsec / 1000 } };
    }
    result
}

/// Seconds since 1970 by the wall clock of this program.
fn wall() -> i64 {
    SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0, |d| d.as_secs() as i64)
}

/// Real actions, in order, and what the loop reported; the wall clock jumps at ticks 200, 400, ... if `jumps`.
fn fly(test: &str, jumps: bool) -> (Vec<[u64; N]>, RunReport, Panda) {
    struct Jumping {
        panda: Panda,
        jumps: bool,
        ticks: i64,
        actions: Vec<[u64; N]>,
    }
    impl Plant for Jumping {
        fn observe(&mut self, state: &mut StateMessage) {
            self.ticks += 1;
            if self.jumps && self.ticks % 200 == 0 {
                OFFSET.store([3600, -7200, 0][(self.ticks / 200) as usize % 3], Ordering::Relaxed);
            }
            self.panda.observe(state);
        }
        fn apply(&mut self, action: &ActionMessage) {
            self.actions.push(std::array::from_fn(|i| action.action[i].to_bits()));
            self.panda.apply(action);
        }
        fn brake(&mut self) {
            self.panda.brake();
        }
    }
    let (name, first) = (Name::new(test), snapshot(1, |_| {}));
    let file = File::new(test, &first);
    let link = PlantLink::open(&name.0, &describe(&first.manifest, true).unwrap()).unwrap();
    let (stop, over) = (Stop::new(), Stop::new());
    let plant = std::thread::spawn({
        let over = over.clone();
        move || {
            let mut plant = Jumping { panda: Panda::new(), jumps, ticks: 0, actions: Vec::new() };
            PlantRunner::new(link, PlantSettings::lockstep(toy::DT)).unwrap().run(&mut plant, &over);
            (plant.actions, plant.panda)
        }
    });
    let settings = RunSettings { ticks: Some(1500), ..toy::settings() };
    let report = execute_with(&name, &file.0, &stop, settings).join().unwrap().unwrap();
    over.request();
    let (actions, panda) = plant.join().unwrap();
    (actions, report, panda)
}

#[test]
fn fault_21_a_wall_clock_that_jumps_changes_no_bit() {
    let (before, begin) = (wall(), std::time::Instant::now());
    JUMPS.store(true, Ordering::Relaxed);
    OFFSET.store(-86_400, Ordering::Relaxed);
    assert!((wall() - before + 86_400).abs() < 600, "the script works: a day earlier");
    assert!(begin.elapsed() < Duration::from_secs(600), "and leaves the monotonic clock alone");
    OFFSET.store(0, Ordering::Relaxed);
    let (actions, report, arm) = fly("wall-clock", true);
    JUMPS.store(false, Ordering::Relaxed);
    println!("the wall clock was read {} times, by whomever", READS.load(Ordering::Relaxed));
    let (calm, calm_report, _) = fly("wall-clock-calm", false);
    let n = 1500;
    assert!(actions.len() >= n && actions[..n] == calm[..n], "an action differs");
    for report in [&report, &calm_report] {
        assert_eq!(
            (report.modes["active"], report.last_mode, report.reason),
            (n as u64, Mode::Braking, Reason::Stop)
        );
        assert_eq!((report.counters.stale, report.counters.overruns, report.counters.lost_states), (0, 0, 0));
    }
    assert!(arm.worst.iter().all(|e| *e <= 1e-9), "position, velocity, torque: {:?}", arm.worst);
    assert!(arm.speeds.iter().any(|v| *v > 0.1), "the arm must move for this to mean anything");
}
