//! What a case may cost: memory by a counting allocator, time by a thread that ends the process.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

thread_local! {
    static LIVE: Cell<i64> = const { Cell::new(0) };
    static PEAK: Cell<i64> = const { Cell::new(0) };
}

/// The system's allocator; counts the bytes that the calling thread holds.
pub struct Counting;

fn count(bytes: i64) {
    let _ = LIVE.try_with(|live| {
        live.set(live.get() + bytes);
        let _ = PEAK.try_with(|peak| peak.set(peak.get().max(live.get())));
    });
}

// SAFETY: every call is passed on to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size() as i64);
        // SAFETY: as above.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count(-(layout.size() as i64));
        // SAFETY: as above.
        unsafe { System.dealloc(pointer, layout) }
    }
}

/// Bytes `f` held at most beyond what was held before.
pub fn peak_of(f: impl FnOnce()) -> u64 {
    let before = LIVE.get();
    PEAK.set(before);
    f();
    (PEAK.get() - before).max(0) as u64
}

/// A case may take this long before it counts as hung: far more than the slowest takes on a loaded machine.
const PATIENCE: Duration = Duration::from_secs(120);

/// Ends the process when a case hangs.
pub struct Watch {
    start: Instant,
    /// When the case began [ms]; no case when it is far in the future.
    began: Arc<AtomicU64>,
}

impl Watch {
    pub fn new(target: &'static str) -> Watch {
        let watch = Watch { start: Instant::now(), began: Arc::new(AtomicU64::new(u64::from(u32::MAX))) };
        let (start, began) = (watch.start, Arc::downgrade(&watch.began));
        std::thread::spawn(move || {
            while let Some(began) = began.upgrade() {
                let began = Duration::from_millis(began.load(Ordering::Relaxed));
                if start.elapsed() > began + PATIENCE {
                    eprintln!("{target}: the case that began after {began:?} hangs; run it by its seed");
                    std::process::abort();
                }
                std::thread::sleep(Duration::from_millis(200));
            }
        });
        watch
    }

    /// A case begins; how long all of them have taken.
    pub fn begin(&self) -> Duration {
        self.began.store(self.start.elapsed().as_millis() as u64, Ordering::Relaxed);
        self.start.elapsed()
    }
}
