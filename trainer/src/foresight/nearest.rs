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

    /// The programme of [`Nearest`] with its excesses written out, by an interior point method. Its value.
    fn by_clarabel(asked: &[f64], trial: &[f64], slope: &[f64], bounds: &[[f64; 2]]) -> f64 {
        use clarabel::algebra::CscMatrix;
        use clarabel::solver::{DefaultSettings, DefaultSolver, IPSolver, SupportedConeT};
        let (n, rows) = (asked.len(), bounds.len());
        // Variables: the action, then an excess for each row.
        let mut p = vec![vec![0.0; n + rows]; n + rows];
        (0..n).for_each(|k| p[k][k] = 1.0);
        let cost: Vec<f64> = asked.iter().map(|a| -a).chain(vec![WORTH; rows]).collect();
        let (mut a, mut b) = (Vec::new(), Vec::new());
        for (r, [lower, upper]) in bounds.iter().enumerate() {
            let row = &slope[r * n..(r + 1) * n];
            let size = row.iter().map(|g| g * g).sum::<f64>().sqrt();
            let at: f64 = row.iter().zip(trial).map(|(g, t)| g * t).sum();
            for (side, bound) in [(1.0, upper + at), (-1.0, -lower - at)] {
                let mut line: Vec<f64> = row.iter().map(|g| side * g / size).collect();
                line.extend((0..rows).map(|k| if k == r { -1.0 } else { 0.0 }));
                (a.push(line), b.push(bound / size));
            }
            let line: Vec<f64> = (0..n + rows).map(|k| if k == n + r { -1.0 } else { 0.0 }).collect();
            (a.push(line), b.push(0.0));
        }
        for k in 0..n {
            for side in [1.0, -1.0] {
                let line: Vec<f64> = (0..n + rows).map(|i| if i == k { side } else { 0.0 }).collect();
                (a.push(line), b.push(1.0));
            }
        }
        let settings = DefaultSettings {
            verbose: false,
            tol_gap_abs: 1e-10,
            tol_gap_rel: 1e-10,
            tol_feas: 1e-10,
            ..DefaultSettings::default()
        };
        let cones = [SupportedConeT::NonnegativeConeT(b.len())];
        let (p, a) = (CscMatrix::from(p.iter()).to_triu(), CscMatrix::from(a.iter()));
        let mut solver = DefaultSolver::new(&p, &cost, &a, &b, &cones, settings).expect("a programme");
        solver.solve();
        solver.solution.obj_val + 0.5 * asked.iter().map(|x| x * x).sum::<f64>()
    }

    /// Against Clarabel, whose value is the least there is: random programmes of the sizes of the guard's, half of them with rows that cannot all hold. Prints the
    /// times of both with `--nocapture`.
    #[test]
    fn the_value_is_that_of_an_interior_point_method() {
        use rand::RngExt;
        use rand_chacha::ChaCha8Rng;
        use rand_chacha::rand_core::SeedableRng;
        use std::time::Instant;
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let (mut ours, mut theirs, mut worst, mut torn) = (0.0, 0.0, 0.0_f64, 0);
        for problem in 0..300 {
            let (n, rows) = (3 + problem % 6, 6 + problem % 11);
            let mut draw =
                |n: usize, size: f64| -> Vec<f64> { (0..n).map(|_| rng.random_range(-size..size)).collect() };
            let (asked, trial, slope) = (draw(n, 1.0), draw(n, 1.0), draw(n * rows, 2.0));
            let width = if problem % 2 == 0 { 1.5 } else { 0.1 };
            let bounds: Vec<[f64; 2]> = draw(rows, 1.0).iter().map(|x| [x - width, x + width]).collect();
            let mut nearest = Nearest::new(n, rows);
            let begin = Instant::now();
            nearest.solve(&asked, &trial, &slope, |r| bounds[r]);
            ours += begin.elapsed().as_secs_f64();
            let begin = Instant::now();
            let least = by_clarabel(&asked, &trial, &slope, &bounds);
            theirs += begin.elapsed().as_secs_f64();
            let u = nearest.solution();
            let mut value = 0.5 * u.iter().zip(&asked).map(|(u, a)| (u - a) * (u - a)).sum::<f64>();
            for (row, [lower, upper]) in slope.chunks_exact(n).zip(&bounds) {
                let size = row.iter().map(|g| g * g).sum::<f64>().sqrt();
                let at: f64 = row.iter().zip(u.iter().zip(&trial)).map(|(g, (u, t))| g * (u - t)).sum();
                value += WORTH * (lower - at).max(at - upper).max(0.0) / size;
            }
            torn += usize::from(least > 1.0 + n as f64 * 2.0);
            worst = worst.max((value - least) / least.max(1.0));
        }
        println!(
            "{:.1} us each, Clarabel {:.1} us; {torn} torn, worst {worst:.1e}",
            ours / 3e-4,
            theirs / 3e-4
        );
        assert!(torn > 100 && worst < 1e-3, "{worst}");
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
