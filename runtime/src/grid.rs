//! The absolute time grid: slot n is due at `start + n dt`, whatever happened before.

/// Slots of a fixed period \[ns\]. Holds no clock: time is passed in.
///
/// A tick that ends after its successor was due is an overrun. The slots that have passed are skipped, never made up
/// for: the next slot is the first one in the future.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grid {
    start: u64,
    period: u64,
    slot: u64,
    overruns: u64,
    skipped: u64,
}

impl Grid {
    /// First slot at `start`, one every `period` \[ns\] (at least 1).
    pub fn new(start: u64, period: u64) -> Grid {
        Grid { start, period: period.max(1), slot: 0, overruns: 0, skipped: 0 }
    }

    /// Start \[ns\], slot, overruns and skipped slots, for [`Grid::resume`].
    pub fn place(&self) -> [u64; 4] {
        [self.start, self.slot, self.overruns, self.skipped]
    }

    /// Goes on where another grid of the same period was.
    pub fn resume(&mut self, place: [u64; 4]) {
        [self.start, self.slot, self.overruns, self.skipped] = place;
    }

    /// Number of the slot that is waited for.
    pub fn slot(&self) -> u64 {
        self.slot
    }

    /// Time at which the slot is due \[ns\].
    pub fn due(&self) -> u64 {
        self.start + self.slot * self.period
    }

    /// Ends the slot's tick at `now`; returns how many slots are skipped.
    pub fn finish(&mut self, now: u64) -> u64 {
        self.slot += 1;
        if now <= self.due() {
            return 0;
        }
        let skipped = (now - self.due()).div_ceil(self.period);
        self.overruns += 1;
        self.skipped += skipped;
        self.slot += skipped;
        skipped
    }

    /// Ticks that ended after their successor was due.
    pub fn overruns(&self) -> u64 {
        self.overruns
    }

    /// Slots left out.
    pub fn skipped(&self) -> u64 {
        self.skipped
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Scripted clock: (time spent in the tick, slots skipped) for a period of 10.
    #[test]
    fn accounting_is_exact_and_there_is_no_burst() {
        let mut grid = Grid::new(1000, 10);
        let script = [(3, 0), (10, 0), (11, 1), (20, 1), (21, 2), (0, 0), (105, 10), (9, 0)];
        let (mut slot, mut overruns, mut skipped) = (0, 0, 0);
        for (spent, skip) in script {
            assert_eq!(grid.slot(), slot);
            assert_eq!(grid.due(), 1000 + 10 * slot);
            let end = grid.due() + spent;
            assert_eq!(grid.finish(end), skip);
            assert!(grid.due() >= end, "the next slot must not be in the past");
            slot += 1 + skip;
            overruns += u64::from(skip > 0);
            skipped += skip;
        }
        assert_eq!((grid.overruns(), grid.skipped()), (overruns, skipped));
    }

    #[test]
    fn there_is_no_drift() {
        let period = 333_333;
        let mut grid = Grid::new(77, period);
        for n in 0..1_000_000_u64 {
            assert_eq!(grid.due(), 77 + n * period);
            grid.finish(grid.due() + n % period);
        }
        assert_eq!(grid.overruns(), 0);
    }
}
