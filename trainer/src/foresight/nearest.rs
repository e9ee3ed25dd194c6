//! The nearest action by linearised dynamics: a small quadratic programme whose rows may give way.

/// Sweeps over the rows.
const SWEEPS: usize = 500;
/// What a row's excess costs, in units of the distance: rows give way only where they cannot all hold.
const WORTH: f64 = 1e3;
/// Change of a multiplier that ends the sweeps.
const SMALL: f64 = 1e-9;

/// Solves
///
/// ```text
///     min_u 1/2 |u - asked|^2 + WORTH sum s      s.t.  lower - s <= S (u - trial) <= upper + s,   -1 <= u <= 1
/// ```
///
/// with rows scaled to unit length, by coordinate ascent on the dual (Hildreth 1957): a multiplier that would pass `WORTH` stays there. Exact in the
/// limit; an answer counts only after a step of the simulator.
pub struct Nearest {
    n: usize,
    u: Vec<f64>,
    /// Multiplier of each row (signed: positive at its upper bound), then of the box.
    multiplier: Vec<f64>,
    scale: Vec<f64>,
}

impl Nearest {
    /// For `n` actions and `rows` rows.
    pub fn new(n: usize, rows: usize) -> Nearest {
        Nearest { n, u: vec![0.0; n], multiplier: vec![0.0; rows + n], scale: vec![0.0; rows] }
    }

    /// The last solution (n).
    pub fn solution(&self) -> &[f64] {
        &self.u
    }

    /// Solves with `slope` (rows x n) at `trial` (n); `bounds` of a row are those of its change from there.
    pub fn solve(&mut self, asked: &[f64], trial: &[f64], slope: &[f64], bounds: impl Fn(usize) -> [f64; 2]) {
        let (n, rows) = (self.n, self.scale.len());
        self.u.copy_from_slice(asked);
        self.multiplier.fill(0.0);
        for (scale, row) in self.scale.iter_mut().zip(slope.chunks_exact(n)) {
            *scale = row.iter().map(|g| g * g).sum::<f64>().sqrt();
        }
        for _ in 0..SWEEPS {
            let mut change = 0.0_f64;
            for r in 0..rows {
                let (row, scale) = (&slope[r * n..(r + 1) * n], self.scale[r]);
                if scale < 1e-12 {
                    continue; // no action moves it
                }
                let [lower, upper] = bounds(r).map(|b| b / scale);
                let here: f64 =
                    row.iter().zip(self.u.iter().zip(trial)).map(|(g, (u, t))| g * (u - t)).sum::<f64>()
                        / scale;
                let old = self.multiplier[r];
                let new = ascend(old, here, lower, upper).clamp(-WORTH, WORTH);
                self.multiplier[r] = new;
                self.u.iter_mut().zip(row).for_each(|(u, g)| *u -= (new - old) * g / scale);
                change = change.max((new - old).abs());
            }
            for k in 0..n {
                let old = self.multiplier[rows + k];
                let new = ascend(old, self.u[k], -1.0, 1.0);
                self.multiplier[rows + k] = new;
                self.u[k] -= new - old;
                change = change.max((new - old).abs());
            }
            if change < SMALL {
                break;
            }
        }
        self.u.iter_mut().for_each(|u| *u = u.clamp(-1.0, 1.0));
    }
}

/// The multiplier of a row of unit length whose value is `here` under the multiplier `old`.
fn ascend(old: f64, here: f64, lower: f64, upper: f64) -> f64 {
    let free = here + old; // the value without this row
    if free > upper {
        free - upper
    } else if free < lower {
        free - lower
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two rows of which one holds: by hand, the nearest point of the line `x + y = 1` to (1, 0.5) is (0.75, 0.25).
    #[test]
    fn the_nearest_point_is_that_found_by_hand() {
        let mut nearest = Nearest::new(2, 2);
        let bounds = [[f64::NEG_INFINITY, 1.0], [-5.0, 5.0]];
        nearest.solve(&[1.0, 0.5], &[0.0, 0.0], &[1.0, 1.0, 1.0, -1.0], |r| bounds[r]);
        let u = nearest.solution();
        assert!((u[0] - 0.75).abs() < 1e-9 && (u[1] - 0.25).abs() < 1e-9, "{u:?}");
    }

    /// A row that the box forbids gives way as little as it can, and the other still holds.
    #[test]
    fn what_cannot_hold_gives_way() {
        let mut nearest = Nearest::new(2, 2);
        let bounds = [[3.0, f64::INFINITY], [f64::NEG_INFINITY, 0.5]];
        nearest.solve(&[0.0, 0.0], &[0.0, 0.0], &[1.0, 0.0, 0.0, 1.0], |r| bounds[r]);
        let u = nearest.solution();
        assert!((u[0] - 1.0).abs() < 1e-9 && u[1] <= 0.5, "{u:?}");
    }
}
