//! Running mean and variance, merged batch by batch in a fixed order so that a seed gives the same bits
//! whatever the number of threads.

/// Mean, sum of squared deviations and count of each entry (Chan, Golub & LeVeque 1979).
#[derive(Clone, Debug, PartialEq)]
pub struct RunningStats {
    /// Mean of each entry.
    pub mean: Vec<f64>,
    m2: Vec<f64>,
    count: f64,
}

impl RunningStats {
    /// No samples yet, `n` entries.
    pub fn new(n: usize) -> Self {
        Self { mean: vec![0.0; n], m2: vec![0.0; n], count: 0.0 }
    }

    /// Adds one sample (n); one with an entry that is not finite leaves the statistics as they are, and gives false.
    pub fn push(&mut self, x: &[f64]) -> bool {
        if x.iter().any(|v| !v.is_finite()) {
            return false;
        }
        self.count += 1.0;
        for ((m, s), &x) in self.mean.iter_mut().zip(&mut self.m2).zip(x) {
            let d = x - *m;
            *m += d / self.count;
            *s += d * (x - *m);
        }
        true
    }

    /// Adds the samples of `other`.
    pub fn merge(&mut self, other: &Self) {
        let total = self.count + other.count;
        if other.count == 0.0 {
            return;
        }
        for i in 0..self.mean.len() {
            let d = other.mean[i] - self.mean[i];
            self.mean[i] += d * other.count / total;
            self.m2[i] += other.m2[i] + d * d * self.count * other.count / total;
        }
        self.count = total;
    }

    /// Standard deviation of each entry; entries that never changed, and all before two samples, give `floor`.
    pub fn std(&self, floor: f64) -> Vec<f64> {
        self.m2
            .iter()
            .map(|s| if self.count < 2.0 { floor } else { (s / self.count).sqrt().max(floor) })
            .collect()
    }

    /// Mean, sum of squared deviations and count one after another (2 n + 1), for a checkpoint.
    pub fn to_vec(&self) -> Vec<f64> {
        [self.mean.as_slice(), &self.m2, &[self.count]].concat()
    }

    /// The inverse of [`RunningStats::to_vec`].
    ///
    /// # Panics
    /// When `x` has not 2 n + 1 entries.
    pub fn set(&mut self, x: &[f64]) {
        let n = self.mean.len();
        assert_eq!(x.len(), 2 * n + 1, "statistics of {n} entries");
        self.mean.copy_from_slice(&x[..n]);
        self.m2.copy_from_slice(&x[n..2 * n]);
        self.count = x[2 * n];
    }

    /// Forgets every sample.
    pub fn clear(&mut self) {
        *self = Self::new(self.mean.len());
    }
}

#[cfg(test)]
mod tests {
    use super::RunningStats;

    #[test]
    fn merged_batches_equal_the_whole() {
        let data: Vec<f64> = (0..100).map(|i| (f64::from(i) * 0.7).sin() * 3.0 + 1e3).collect();
        let (mut whole, mut merged) = (RunningStats::new(1), RunningStats::new(1));
        for chunk in data.chunks(17) {
            let mut part = RunningStats::new(1);
            for x in chunk {
                part.push(&[*x]);
                whole.push(&[*x]);
            }
            merged.merge(&part);
        }
        let mean = data.iter().sum::<f64>() / 100.0;
        let std = (data.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 100.0).sqrt();
        for s in [&whole, &merged] {
            assert!((s.mean[0] - mean).abs() < 1e-9 && (s.std(0.0)[0] - std).abs() < 1e-9);
        }
    }
}
