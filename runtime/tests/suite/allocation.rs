//! The real-time thread neither allocates nor frees between its first and its last tick, swaps included.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use crate::toy::*;
use nearl_runtime::link::*;
use nearl_runtime::rt::*;

thread_local! {
    /// Set by the controller's first tick on the thread that runs it.
    static IS_LOOP: Cell<bool> = const { Cell::new(false) };
}
static CALLS: AtomicU64 = AtomicU64::new(0);

struct Counting;

fn count() {
    if IS_LOOP.try_with(Cell::get).unwrap_or(false) {
        CALLS.fetch_add(1, Ordering::Relaxed);
    }
}

// SAFETY: every call is passed on to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: as above.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count();
        // SAFETY: as above.
        unsafe { System.dealloc(pointer, layout) }
    }
    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: as above.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Counts from its first tick until it brakes for the stop.
struct Watched {
    version: u64,
    allocates: bool,
}

impl LoopController for Watched {
    fn version(&self) -> u64 {
        self.version
    }
    fn tick(&mut self, state: &StateMessage, output: &mut TickOutput) -> Outcome {
        IS_LOOP.set(true);
        output.nu = 1;
        output.action[0] = -state.q()[0];
        if self.allocates {
            drop(std::hint::black_box(Box::new(state.q()[0])));
        }
        Outcome::Acted
    }
    fn brake(&mut self, _: &StateMessage, _: &mut TickOutput) -> Outcome {
        IS_LOOP.set(false);
        Outcome::Refused
    }
    fn reset(&mut self) {}
}

struct Any;

impl Build for Any {
    type Controller = Watched;
    fn build(&mut self, snapshot: &SnapshotBytes, _: &RobotMessage) -> Result<Watched, Refusal> {
        Ok(Watched { version: snapshot.header.version, allocates: false })
    }
}

fn calls_of_a_run(test: &str, allocates: bool, swaps: u64) -> u64 {
    CALLS.store(0, Ordering::Relaxed);
    let name = Name::new(test);
    let start = PointMass { q: 1.0, ..PointMass::default() };
    let plant = PlantThread::start(&name, start, PlantSettings::lockstep(DT));
    let (link, robot) = connect(&name.0, 5.0).unwrap();
    let stop = Stop::new();
    let running = std::thread::spawn({
        let stop = stop.clone();
        let first = Watched { version: 1, allocates };
        // Nothing is taken back: these controllers give no targets, and how far the body swings is not compared here.
        let rollback = RollbackSettings { window: 0, ..RollbackSettings::default() };
        let settings = RunSettings { rollback, ..settings() };
        move || run_loop(link, robot, first, Any, &settings, &stop).unwrap()
    });
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    trainer.wait_for_runtime(Duration::from_secs(10)).unwrap();
    for version in 2..2 + swaps {
        trainer.push(version, b"any").unwrap();
        trainer.wait_for_receipt(version, Duration::from_secs(10)).unwrap();
    }
    while trainer.state().is_none_or(|s| s.tick < 2000) {}
    stop.request();
    let report = running.join().unwrap();
    plant.end();
    assert!(report.ticks > 1000);
    assert_eq!(report.counters.swaps, swaps);
    CALLS.load(Ordering::Relaxed)
}

#[test]
fn nothing_is_allocated_or_freed_in_the_loop() {
    assert_eq!(calls_of_a_run("alloc", false, 5), 0);
    let calls = calls_of_a_run("alloc-control", true, 0);
    assert!(calls > 2000, "the counter must see a controller that allocates: {calls}");
}
