//! Measures the wake-up of an empty loop: no loop on this machine can be faster.

use crate::clock;
use crate::grid::Grid;
use crate::percentiles::{Percentiles, percentiles};
use crate::stop::Stop;
use crate::thread::{ThreadSettings, prepare};

/// Sleeps through `ticks` slots of `dt` \[s\] on a thread with `settings`, or until `stop`, and returns how late \[ns\] it woke, with one
/// sentence for each thing the operating system refused.
pub fn bench_wake(
    dt: f64,
    ticks: u64,
    settings: ThreadSettings,
    stop: &Stop,
) -> std::io::Result<(Percentiles, Vec<String>)> {
    let mut late = hdrhistogram::Histogram::<u64>::new_with_bounds(1, 10_000_000_000, 3)
        .map_err(|e| std::io::Error::other(e.to_string()))?;
    let stop = stop.clone();
    let loop_body = move || {
        let warnings = prepare(&settings);
        let period = clock::nanoseconds(dt);
        let mut grid = Grid::new(clock::now() + period, period);
        for _ in 0..ticks {
            if stop.is_requested() {
                break;
            }
            clock::sleep_until(grid.due());
            let now = clock::now();
            late.saturating_record(now - grid.due());
            grid.finish(now);
        }
        (percentiles(&late), warnings)
    };
    let thread = std::thread::Builder::new().name("nearl-rt".into()).spawn(loop_body)?;
    thread.join().map_err(|_| std::io::Error::other("the loop thread panicked"))
}
