//! The programme of [`Nearest`](super::Nearest) by Clarabel, for rows that contradict each other: there the dual ascent converges too slowly.

use clarabel::algebra::CscMatrix;
use clarabel::solver::{DefaultSettings, DefaultSolver, IPSolver, SolverStatus, SupportedConeT};

/// Minimises `1/2 |u - asked|^2 + worth sum s` over `u` (n) in [-1, 1] and the rows' excesses `s >= 0`, for rows (`slope`, rows x n) of unit length whose value
/// lies between `bounds`, less and more the excess; a row of zeros and an infinite bound say nothing. `None` where the solver gives up.
pub(super) fn solve(asked: &[f64], slope: &[f64], bounds: &[[f64; 2]], worth: f64) -> Option<Vec<f64>> {
    let (n, rows) = (asked.len(), bounds.len());
    let p = CscMatrix::new(
        n + rows,
        n + rows,
        (0..=n).chain(std::iter::repeat_n(n, rows)).collect(),
        (0..n).collect(),
        vec![1.0; n],
    );
    let cost: Vec<f64> = asked.iter().map(|a| -a).chain(vec![worth; rows]).collect();
    let mut lines = Lines::default();
    for (r, [lower, upper]) in bounds.iter().enumerate() {
        let row = &slope[r * n..(r + 1) * n];
        for (side, bound) in [(1.0, *upper), (-1.0, -*lower)] {
            if bound.is_finite() && row.iter().any(|g| *g != 0.0) {
                let entries = row.iter().enumerate().map(|(k, g)| (k, side * g));
                lines.push(entries.chain([(n + r, -1.0)]), bound);
            }
        }
        lines.push([(n + r, -1.0)], 0.0);
    }
    for k in 0..n {
        lines.push([(k, 1.0)], 1.0);
        lines.push([(k, -1.0)], 1.0);
    }
    let a = CscMatrix::new_from_triplets(lines.b.len(), n + rows, lines.row, lines.column, lines.value);
    let settings = DefaultSettings {
        verbose: false,
        tol_gap_abs: 1e-9,
        tol_gap_rel: 1e-9,
        tol_feas: 1e-9,
        ..DefaultSettings::default()
    };
    let cones = [SupportedConeT::NonnegativeConeT(lines.b.len())];
    let mut solver = DefaultSolver::new(&p, &cost, &a, &lines.b, &cones, settings).ok()?;
    solver.solve();
    let is_solved = matches!(solver.solution.status, SolverStatus::Solved | SolverStatus::AlmostSolved);
    is_solved.then(|| solver.solution.x[..n].iter().map(|u| u.clamp(-1.0, 1.0)).collect())
}

/// Rows `a x <= b` as triplets.
#[derive(Default)]
struct Lines {
    row: Vec<usize>,
    column: Vec<usize>,
    value: Vec<f64>,
    b: Vec<f64>,
}

impl Lines {
    fn push(&mut self, entries: impl IntoIterator<Item = (usize, f64)>, bound: f64) {
        for (column, value) in entries {
            self.row.push(self.b.len());
            self.column.push(column);
            self.value.push(value);
        }
        self.b.push(bound);
    }
}
