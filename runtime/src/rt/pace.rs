//! Whether the plant keeps the control period, by its own clock.

/// A period may be so much shorter or longer in the long run, as a share of it.
const OFF: f64 = 0.2;
/// So many in a row say that it is no jitter: of one that is even over half a period either way, 0.3 of the periods are that long, and 0.3^16 = 4e-9 of
/// them end a row of these.
const IN_A_ROW: i32 = 16;

/// Periods in a row that were too long, or negative, too short.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Pace(i32);

impl Pace {
    /// `passed` \[s\] of the plant's clock in what should be `periods` of `period` [ns]. A clock that stands says nothing.
    pub(crate) fn take(&mut self, passed: f64, periods: u64, period: u64) {
        let share = passed / (periods as f64 * period as f64 * 1e-9);
        self.0 = if share > 1.0 + OFF {
            self.0.clamp(0, IN_A_ROW - 1) + 1
        } else if share < 1.0 - OFF && share > 0.0 {
            self.0.clamp(1 - IN_A_ROW, 0) - 1
        } else {
            0
        };
    }

    /// The plant exchanges in another period than it said.
    pub(crate) fn is_wrong(self) -> bool {
        self.0.abs() >= IN_A_ROW
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: u64 = 2_000_000;

    fn after(passed: impl Iterator<Item = f64>) -> Pace {
        passed.fold(Pace::default(), |mut pace, passed| {
            pace.take(passed, 1, PERIOD);
            pace
        })
    }

    #[test]
    fn a_period_that_stays_another_one_is_wrong() {
        for (passed, wrong) in
            [(0.002, false), (0.0023, false), (0.004, true), (0.001, true), (2.0, true), (0.0, false)]
        {
            assert_eq!(after(std::iter::repeat_n(passed, 16)).is_wrong(), wrong, "{passed} s");
            assert!(!after(std::iter::repeat_n(passed, 15)).is_wrong(), "{passed} s");
        }
        let mut lost = Pace::default();
        (0..100).for_each(|_| lost.take(0.004, 2, PERIOD));
        assert!(!lost.is_wrong(), "two periods where one state was lost");
    }

    #[test]
    fn jitter_and_a_pause_are_none() {
        let jitter = (0..100_000u64).map(|k| {
            0.002 * (0.5 + (k.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40) as f64 / (1u64 << 24) as f64)
        });
        assert!(!after(jitter).is_wrong());
        let pauses = (0..1000).map(|k| if k % 16 == 0 { 0.002 } else { 0.02 });
        assert!(!after(pauses).is_wrong());
        assert!(!after(std::iter::repeat_n(0.004, 100).chain([0.002])).is_wrong(), "it may come back");
    }
}
