//! A control tick allocates nothing; where Clarabel answers, its own timers take one small block a solve.

use nearl_runtime::Controller;
use nearl_tests::{random_policy, training};
use nearl_trainer::rollout::{make_env, stream};
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

thread_local! {
    static COUNT: Cell<u64> = const { Cell::new(0) };
}

struct Counting;

// SAFETY: every call is passed on to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let _ = COUNT.try_with(|c| c.set(c.get() + 1));
        // SAFETY: as above.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Allocations and Clarabel solves of `ticks` updates in closed loop.
fn count(snapshot: &nearl_runtime::Snapshot, ticks: usize) -> (u64, u64) {
    let (mut env, mut controller) = (make_env(snapshot).expect("env"), Controller::new(snapshot).expect("controller"));
    let (mut state, mut out, noise) = (controller.state(), controller.output(), controller.noise());
    env.reset(&mut stream(0, 0)).expect("reset");
    let (mut allocations, mut solves) = (0, 0);
    for _ in 0..ticks {
        env.observe(&mut state.obs);
        env.state(&mut state.q, &mut state.v);
        let before = COUNT.get();
        controller.update(&state, &noise, &mut out);
        allocations += COUNT.get() - before;
        solves += u64::from(out.next.ledger.rung == nearl_constraints::Rung::Clarabel);
        if env.step(&out.action).terminated {
            env.reset(&mut stream(1, 0)).expect("reset");
        }
    }
    (allocations, solves)
}

#[test]
fn an_update_allocates_nothing_beyond_clarabel() {
    drop(std::hint::black_box(Box::new(1)));
    assert!(COUNT.get() > 0, "the counter counts");
    for task in ["HalfCheetah-v5", "Hopper-v5", "Ant-v5"] {
        let (allocations, _) = count(training(task, "pid2-ib", 0, 1, &[]).snapshot(), 3000);
        assert_eq!(allocations, 0, "{task}");
    }
    let (allocations, solves) = count(&random_policy("Panda-reach", 3, 3.0), 5000);
    assert!(allocations <= solves, "Panda-reach: {allocations} allocations for {solves} Clarabel solves");
}
