//! Percentiles of many times, of a run or a measurement.

use std::fmt;

use hdrhistogram::Histogram;
use serde::Serialize;

/// Percentiles of a time \[ns\].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Percentiles {
    /// Number of samples.
    pub count: u64,
    /// Median.
    pub p50: u64,
    /// 99 of 100 are below.
    pub p99: u64,
    /// 999 of 1000 are below.
    pub p999: u64,
    /// Largest.
    pub max: u64,
}

impl fmt::Display for Percentiles {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let us = |ns: u64| ns as f64 * 1e-3;
        let (p50, p99, p999, max) = (us(self.p50), us(self.p99), us(self.p999), us(self.max));
        write!(
            f,
            "p50 {p50:>8.1}  p99 {p99:>8.1}  p99.9 {p999:>8.1}  max {max:>9.1} us  ({} samples)",
            self.count
        )
    }
}

/// Those of a histogram of times [ns].
pub(crate) fn percentiles(histogram: &Histogram<u64>) -> Percentiles {
    Percentiles {
        count: histogram.len(),
        p50: histogram.value_at_quantile(0.5),
        p99: histogram.value_at_quantile(0.99),
        p999: histogram.value_at_quantile(0.999),
        max: histogram.max(),
    }
}
