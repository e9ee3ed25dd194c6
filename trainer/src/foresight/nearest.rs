//! The nearest action by linearised dynamics: a small quadratic programme whose rows may give way.

use super::interior;

/// Sweeps over the rows.
const SWEEPS: usize = 100;
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
/// with rows scaled to unit length, by coordinate ascent on the dual (Hildreth 1957): a multiplier that would pass `WORTH` stays there. Where the sweeps have
/// not settled, because rows contradict each other, Clarabel solves it. An answer counts only after a step of the simulator.
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

    /// Solves with `slope` (rows x n) at `trial` (n); `bounds` of a row are those of its change from there. Allocates only where the sweeps do not settle.
    pub fn solve(&mut self, asked: &[f64], trial: &[f64], slope: &[f64], bounds: impl Fn(usize) -> [f64; 2]) {
        if self.ascend_all(asked, trial, slope, &bounds) {
            return;
        }
        let unit: Vec<f64> = slope
            .chunks_exact(self.n)
            .zip(&self.scale)
            .flat_map(|(row, scale)| row.iter().map(move |g| if *scale < 1e-12 { 0.0 } else { g / scale }))
            .collect();
        let of_value = |(r, row): (usize, &[f64])| {
            let at: f64 = row.iter().zip(trial).map(|(g, t)| g * t).sum();
            bounds(r).map(|b| b / self.scale[r].max(1e-12) + at)
        };
        let bounds: Vec<[f64; 2]> = unit.chunks_exact(self.n).enumerate().map(of_value).collect();
        if let Some(found) = interior::solve(asked, &unit, &bounds, WORTH) {
            self.u = found;
        }
    }

    /// The sweeps alone; whether they settled.
    fn ascend_all(
        &mut self,
        asked: &[f64],
        trial: &[f64],
        slope: &[f64],
        bounds: impl Fn(usize) -> [f64; 2],
    ) -> bool {
        let (n, rows) = (self.n, self.scale.len());
        self.u.copy_from_slice(asked);
        self.multiplier.fill(0.0);
        for (scale, row) in self.scale.iter_mut().zip(slope.chunks_exact(n)) {
            *scale = row.iter().map(|g| g * g).sum::<f64>().sqrt();
        }
        let mut change = 0.0_f64;
        for _ in 0..SWEEPS {
            change = 0.0;
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
        change < SMALL
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

    /// Value of the programme at `u`.
    fn value(u: &[f64], asked: &[f64], trial: &[f64], slope: &[f64], bounds: &[[f64; 2]]) -> f64 {
        let way = u.iter().zip(asked).map(|(u, a)| (u - a) * (u - a)).sum::<f64>();
        let excess = slope.chunks_exact(u.len()).zip(bounds).map(|(row, [lower, upper])| {
            let size = row.iter().map(|g| g * g).sum::<f64>().sqrt();
            let at: f64 = row.iter().zip(u.iter().zip(trial)).map(|(g, (u, t))| g * (u - t)).sum();
            (lower - at).max(at - upper).max(0.0) / size
        });
        0.5 * way + WORTH * excess.sum::<f64>()
    }

    /// No point near the solution has a lower value: random programmes of the sizes of the guard's, half of them with rows that cannot all hold. Prints with
    /// `--nocapture` what both ways take, and what the ascent alone is worth.
    #[test]
    fn no_point_has_a_lower_value() {
        use rand::RngExt;
        use rand_chacha::ChaCha8Rng;
        use rand_chacha::rand_core::SeedableRng;
        use std::time::Instant;
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let (mut seconds, mut counts, mut worst) = ([0.0; 2], [0; 2], [0.0_f64; 2]);
        for problem in 0..300 {
            let (n, rows) = (3 + problem % 6, 6 + problem % 11);
            let mut draw =
                |n: usize, size: f64| -> Vec<f64> { (0..n).map(|_| rng.random_range(-size..size)).collect() };
            let (asked, trial, slope) = (draw(n, 1.0), draw(n, 1.0), draw(n * rows, 2.0));
            let width = if problem % 2 == 0 { 1.5 } else { 0.1 };
            let bounds: Vec<[f64; 2]> = draw(rows, 1.0).iter().map(|x| [x - width, x + width]).collect();
            let mut nearest = Nearest::new(n, rows);
            let begin = Instant::now();
            let converged = nearest.ascend_all(&asked, &trial, &slope, |r| bounds[r]);
            let alone = value(nearest.solution(), &asked, &trial, &slope, &bounds);
            let middle = Instant::now();
            nearest.solve(&asked, &trial, &slope, |r| bounds[r]);
            let which = usize::from(!converged);
            seconds[which] += if converged { begin.elapsed() / 2 } else { middle.elapsed() }.as_secs_f64();
            counts[which] += 1;
            let u = nearest.solution().to_vec();
            let found = value(&u, &asked, &trial, &slope, &bounds);
            worst[which] = worst[which].max((alone - found) / found.max(1.0));
            for step in 0..60 {
                let size = 0.3_f64.powi(1 + step % 6);
                let beside: Vec<f64> =
                    u.iter().zip(draw(n, size)).map(|(u, d)| (u + d).clamp(-1.0, 1.0)).collect();
                let least = value(&beside, &asked, &trial, &slope, &bounds);
                assert!(least > found - 1e-5 * found.max(1.0), "problem {problem}: {least} < {found}");
            }
        }
        let each = [0, 1].map(|k| 1e6 * seconds[k] / f64::from(counts[k]));
        println!(
            "{} by ascent, {:.1} us each; {} go on to Clarabel, {:.1} us each, where the ascent alone is up to {:.1} times worse",
            counts[0], each[0], counts[1], each[1], worst[1]
        );
        assert!(counts[0] > 100 && counts[1] > 50, "{counts:?}");
        assert!(worst[0] < 1e-6 && worst[1] > 0.1, "{worst:?}");
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
