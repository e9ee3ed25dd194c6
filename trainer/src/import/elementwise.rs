//! What happens to each entry alone before the first layer and after the last.

/// `y_i = clip(a_i x_i + b_i, lower_i, upper_i)`: closed under scaling, shifting and clipping.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Elementwise {
    pub(super) a: Vec<f64>,
    pub(super) b: Vec<f64>,
    pub(super) lower: Vec<f64>,
    pub(super) upper: Vec<f64>,
}

/// The entry's own number, or the one for all.
pub(super) fn of(row: &[f64], i: usize) -> f64 {
    if row.len() == 1 { row[0] } else { row[i] }
}

impl Elementwise {
    pub(super) fn identity(n: usize) -> Self {
        Self {
            a: vec![1.0; n],
            b: vec![0.0; n],
            lower: vec![f64::NEG_INFINITY; n],
            upper: vec![f64::INFINITY; n],
        }
    }

    /// Then `scale_i y_i + shift_i`.
    pub(super) fn affine(&mut self, scale: &[f64], shift: &[f64]) {
        for i in 0..self.a.len() {
            let (s, t) = (of(scale, i), of(shift, i));
            self.a[i] *= s;
            self.b[i] = s * self.b[i] + t;
            let ends = if s == 0.0 {
                [f64::NEG_INFINITY, f64::INFINITY]
            } else {
                [s * self.lower[i] + t, s * self.upper[i] + t]
            };
            (self.lower[i], self.upper[i]) = if s < 0.0 { (ends[1], ends[0]) } else { (ends[0], ends[1]) };
        }
    }

    /// Then `clip(y_i, lower_i, upper_i)`.
    pub(super) fn clip(&mut self, lower: &[f64], upper: &[f64]) {
        for i in 0..self.a.len() {
            let (l, u) = (of(lower, i), of(upper, i));
            self.lower[i] = self.lower[i].max(l).min(u);
            self.upper[i] = self.upper[i].max(l).min(u);
        }
    }

    /// Whether some entry is clipped.
    pub(super) fn clips(&self) -> bool {
        self.lower.iter().any(|l| l.is_finite()) || self.upper.iter().any(|u| u.is_finite())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_compose_in_their_order() {
        let mut e = Elementwise::identity(3);
        e.affine(&[2.0, -3.0, 0.0], &[1.0]);
        e.clip(&[-4.0], &[5.0]);
        e.affine(&[-1.0, 0.5, 2.0], &[0.25, 0.0, 1.0]);
        e.clip(&[-2.0], &[100.0]);
        let by_hand = [
            |x: f64| (-(2.0 * x + 1.0).clamp(-4.0, 5.0) + 0.25).clamp(-2.0, 100.0),
            |x: f64| (0.5 * (-3.0 * x + 1.0).clamp(-4.0, 5.0)).clamp(-2.0, 100.0),
            |x: f64| (2.0 * (0.0 * x + 1.0).clamp(-4.0, 5.0) + 1.0).clamp(-2.0, 100.0),
        ];
        for k in -40..=40 {
            let x = f64::from(k) * 0.25;
            for (i, f) in by_hand.iter().enumerate() {
                let y = (e.a[i] * x + e.b[i]).clamp(e.lower[i], e.upper[i]);
                assert!((y - f(x)).abs() < 1e-12, "{i} {x}: {y} {}", f(x));
            }
        }
    }
}
