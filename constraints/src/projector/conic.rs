//! Clarabel: for cones, and as the last resort; built once and updated in place.
//!
//! Variables are `u = y / sigma`, the lifted `z = G u`, one per row, and a slack `s` for each soft row and cone; without the lifting
//! each dense row would stand in the factor twice:
//!
//! ```text
//!     min 1/2 u'P u + c'u + linear's + 1/2 s'Q s
//!     s.t.   G u - z = 0 (equal rows: G u = b),   u <= u_max,   -u <= -u_min,
//!            z - s <= z_max,   -z - s <= -z_min,   -s <= 0,   |G_c u + c| <= radius + s
//! ```
//!
//! P is constant. A NaN that gets into it all the same would stay in Clarabel's buffers for good: the solver is thrown away after that
//! solve and built again in the next tick. Clarabel's own equilibration is frozen at set-up; the scaling by `sigma` and by the limits keeps
//! all numbers near 1 instead. Clarabel's `time_limit` counts all earlier solves too, so a call-back with a clock of its
//! own ends a solve that takes too long.

use super::coupled::Coupled;
use crate::LimitError;
use clarabel::algebra::CscMatrix;
use clarabel::solver::{DefaultSettings, DefaultSolver, IPSolver, SolverStatus, SupportedConeT};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// The solver and the numbers that change from tick to tick.
pub(crate) struct Conic {
    solver: Option<DefaultSolver<f64>>,
    shape: Shape,
    settings: DefaultSettings<f64>,
    /// When the solve has to end, in [ns] since `start`.
    ends: Arc<AtomicU64>,
    start: Instant,
    deadline: Option<Duration>,
    /// Unit of each variable (n) [rad/s].
    sigma: Vec<f64>,
    /// Largest entry of the Hessian in scaled variables.
    scale: f64,
    c: Vec<f64>,
    a: Vec<f64>,
    b: Vec<f64>,
    /// Answer (n).
    pub(crate) y: Vec<f64>,
    /// Signed multipliers of the box (n) and rows (m), as in the active-set stage, and of the cones.
    pub(crate) mu: Vec<f64>,
    pub(crate) lambda: Vec<f64>,
    pub(crate) nu: Vec<f64>,
    pub(crate) iterations: u32,
    p: CscMatrix<f64>,
    pattern: CscMatrix<f64>,
    /// The problem the solver was built with, for building it again.
    typical: Coupled,
}

/// Where things stand: sizes and offsets into rows and columns.
struct Shape {
    n: usize,
    m: usize,
    /// Column of each lifted row; none for equal rows.
    z: Vec<Option<usize>>,
    /// Column of each slack: of rows, then of cones.
    s: Vec<Option<usize>>,
    columns: usize,
    /// First row of: the upper box, upper rows (m each), lower rows, slacks.
    upper: usize,
    row_upper: usize,
    row_lower: usize,
    slack: usize,
    /// First row of each cone.
    cones: Vec<usize>,
    rows: usize,
}

/// Rows are tightened by this share of their limit, more than the solver's tolerance.
const TIGHTEN: f64 = 1e-9;

/// A bound this many `sigma` away is none. A goal as many widths of the box away is brought this near: farther ones spoil the scaling.
const FAR: f64 = 1e4;

impl Shape {
    fn new(p: &Coupled) -> Shape {
        let (n, m) = (p.n, p.m);
        let mut columns = n;
        let mut column = |wanted: bool| wanted.then(|| (columns, columns += 1).0);
        let z: Vec<Option<usize>> = (0..m).map(|r| column(!p.equality[r])).collect();
        let mut s: Vec<Option<usize>> =
            (0..m).map(|r| column(p.soft[r].is_some() && !p.equality[r])).collect();
        s.extend(p.cones.iter().map(|cone| column(cone.soft.is_some())));
        let row_upper = m + 2 * n;
        let count = z.iter().flatten().count();
        let (row_lower, slack) = (row_upper + count, row_upper + 2 * count);
        let mut rows = slack + s.iter().flatten().count();
        let mut cones = Vec::new();
        for cone in &p.cones {
            cones.push(rows);
            rows += 1 + cone.c.len();
        }
        Shape { n, m, z, s, columns, upper: m, row_upper, row_lower, slack, cones, rows }
    }

    /// Position of row `r` among the lifted rows.
    fn lifted(&self, r: usize) -> Option<usize> {
        self.z[r].map(|column| column - self.n)
    }

    /// Position among the slacks of row `r`, or of cone `r - m`.
    fn slack_of(&self, r: usize) -> Option<usize> {
        let first = self.n + self.z.iter().flatten().count();
        self.s[r].map(|column| column - first)
    }
}

impl Conic {
    /// `sigma`: representative velocity changes (n); `typical`: a problem with representative rows.
    pub(crate) fn new(
        typical: &Coupled,
        sigma: Vec<f64>,
        max_iter: u32,
        deadline: Option<Duration>,
    ) -> Result<Conic, LimitError> {
        let shape = Shape::new(typical);
        let n = shape.n;
        let weights: Vec<f64> = (0..n).map(|k| typical.hessian[k] * sigma[k] * sigma[k]).collect();
        let scale = weights.iter().fold(f64::MIN_POSITIVE, |s: f64, w| s.max(*w));
        let mut diagonal: Vec<Option<f64>> = weights.iter().map(|w| Some(w / scale)).collect();
        diagonal.resize(shape.columns, None);
        let softness = typical.soft.iter().copied().chain(typical.cones.iter().map(|cone| cone.soft));
        for (column, soft) in shape.s.iter().zip(softness) {
            if let (Some(column), Some(soft)) = (column, soft) {
                diagonal[*column] = Some(soft.quadratic / scale);
            }
        }
        let p = diagonal_matrix(&diagonal);
        let mut conic = Conic {
            solver: None,
            settings: settings(max_iter),
            ends: Arc::new(AtomicU64::new(u64::MAX)),
            start: Instant::now(),
            deadline,
            scale,
            c: vec![0.0; shape.columns],
            a: vec![],
            b: vec![0.0; shape.rows],
            y: vec![0.0; n],
            mu: vec![0.0; n],
            lambda: vec![0.0; shape.m],
            nu: vec![0.0; shape.cones.len()],
            iterations: 0,
            pattern: pattern(&shape, typical),
            p,
            sigma,
            shape,
            typical: typical.clone(),
        };
        conic.a.clone_from(&conic.pattern.nzval);
        conic.build().map_err(|error| LimitError::Unusable {
            what: format!("Clarabel refused the problem of these limits: {error}"),
            next: "check the limits for extreme values",
        })?;
        Ok(conic)
    }

    /// A new solver. Allocates: at set-up, and when the old one had to be thrown away.
    fn build(&mut self) -> Result<(), String> {
        let typical = self.typical.clone();
        self.fill(&typical);
        self.pattern.nzval.copy_from_slice(&self.a);
        let mut cones = vec![
            SupportedConeT::ZeroConeT(self.shape.m),
            SupportedConeT::NonnegativeConeT(self.shape.slack - self.shape.upper + self.slacks()),
        ];
        cones.extend(typical.cones.iter().map(|cone| SupportedConeT::SecondOrderConeT(1 + cone.c.len())));
        cones.retain(|cone| *cone != SupportedConeT::ZeroConeT(0));
        let (p, a) = (&self.p, &self.pattern);
        let solver = DefaultSolver::new(p, &self.c, a, &self.b, &cones, self.settings.clone());
        let mut solver = solver.map_err(|e| e.to_string())?;
        if self.deadline.is_some() {
            let late = self.clock();
            solver.set_termination_callback(move |_: &_| late());
        }
        self.solver = Some(solver);
        self.run(&typical); // the first solve allocates more than the others
        Ok(())
    }

    /// Whether the time of the last solve is over.
    pub(crate) fn clock(&self) -> impl Fn() -> bool + Send + 'static {
        let (start, ends) = (self.start, self.ends.clone());
        move || start.elapsed().as_nanos() as u64 > ends.load(Ordering::Relaxed)
    }

    fn slacks(&self) -> usize {
        self.shape.s.iter().flatten().count()
    }

    /// Overwrites c, A and b with the numbers of the tick.
    fn fill(&mut self, p: &Coupled) {
        let (n, x) = (self.shape.n, &self.shape);
        let share = p.share_within(FAR);
        for k in 0..n {
            self.c[k] = -p.hessian[k] * self.sigma[k] * p.nearer_goal(k, share) / self.scale;
            self.b[x.upper + k] = (p.upper[k] / self.sigma[k]).min(FAR);
            self.b[x.upper + n + k] = (-p.lower[k] / self.sigma[k]).min(FAR);
        }
        for r in 0..x.m {
            let Some(at) = x.lifted(r) else {
                // Of a row that the state is outside of, the value next to where the proposal leads.
                let wanted = || p.row(r, &p.goal).clamp(p.row_lower[r], p.row_upper[r]);
                self.b[r] = match p.row_upper[r].is_finite() {
                    true if p.row_lower[r] < p.row_upper[r] => wanted(),
                    true => p.row_upper[r],
                    false => 0.0,
                };
                continue;
            };
            let tighten = if p.soft[r].is_some() { 0.0 } else { TIGHTEN };
            self.b[x.row_upper + at] = p.row_upper[r].clamp(-FAR, FAR) - tighten;
            self.b[x.row_lower + at] = (-p.row_lower[r]).clamp(-FAR, FAR) - tighten;
            if let (Some(column), Some(soft)) = (x.s[r], p.soft[r]) {
                self.c[column] = soft.linear / self.scale;
            }
        }
        for (k, (first, cone)) in x.cones.iter().zip(&p.cones).enumerate() {
            let tighten = if cone.soft.is_some() { 0.0 } else { TIGHTEN };
            self.b[*first] = cone.radius.min(FAR) * (1.0 - tighten);
            if let (Some(column), Some(soft)) = (x.s[x.m + k], cone.soft) {
                self.c[column] = soft.linear / self.scale;
            }
            for (b, c) in self.b[first + 1..].iter_mut().zip(&cone.c) {
                *b = *c;
            }
        }
        let mut next = 0;
        for k in 0..n {
            for r in 0..x.m {
                let off = x.lifted(r).is_none() && !p.row_upper[r].is_finite();
                self.a[next + r] = if off { 0.0 } else { p.rows[r * n + k] * self.sigma[k] };
            }
            next += x.m + 2;
            for cone in &p.cones {
                for d in 0..cone.c.len() {
                    self.a[next] = -cone.g[d * n + k] * self.sigma[k];
                    next += 1;
                }
            }
        }
    }

    /// True when Clarabel returned something worth checking in `y`; its word on optimality is not taken. A solver that
    /// was lost to a panic, or to a NaN in its P, is built again in the next tick.
    pub(crate) fn solve(&mut self, p: &Coupled) -> bool {
        if self.solver.is_none() && self.build().is_err() {
            return false;
        }
        self.fill(p);
        self.run(p)
    }

    fn run(&mut self, p: &Coupled) -> bool {
        let finite = |x: &[f64]| x.iter().all(|x| x.is_finite());
        if !(finite(&self.c) && finite(&self.a) && finite(&self.b)) {
            return false;
        }
        if let Some(deadline) = self.deadline {
            let ends = self.start.elapsed() + deadline;
            self.ends.store(ends.as_nanos() as u64, Ordering::Relaxed);
        }
        let Some(solver) = &mut self.solver else { return false };
        let (c, a, b) = (&self.c, &self.a, &self.b);
        let outcome = catch_unwind(AssertUnwindSafe(|| {
            let updated =
                solver.update_q(c).is_ok() && solver.update_A(a).is_ok() && solver.update_b(b).is_ok();
            updated && {
                solver.solve();
                true
            }
        }));
        match outcome {
            Ok(true) => self.read(p),
            Ok(false) => false,
            Err(_) => {
                self.solver = None; // its state is unknown after a panic
                false
            }
        }
    }

    fn read(&mut self, p: &Coupled) -> bool {
        let Some(solver) = &mut self.solver else { return false };
        let solution = &solver.solution;
        self.iterations = solution.iterations;
        let usable = matches!(
            solution.status,
            SolverStatus::Solved
                | SolverStatus::AlmostSolved
                | SolverStatus::MaxIterations
                | SolverStatus::InsufficientProgress
                | SolverStatus::CallbackTerminated
        );
        let is_sound = solver.data.P.nzval.iter().all(|p| p.is_finite());
        if !(is_sound && usable && solution.x.iter().all(|x| x.is_finite())) {
            // A spare in place of what may hold NaN; only a failed solve pays for the allocation.
            match is_sound {
                true => {
                    solver.residuals =
                        clarabel::solver::DefaultResiduals::new(self.shape.columns, self.shape.rows);
                }
                false => self.solver = None,
            }
            return false;
        }
        let (n, x) = (self.shape.n, &self.shape);
        for k in 0..n {
            self.y[k] = (solution.x[k] * self.sigma[k]).clamp(p.lower[k], p.upper[k]);
            self.mu[k] = (solution.z[x.upper + k] - solution.z[x.upper + n + k]) * self.scale / self.sigma[k];
        }
        for r in 0..x.m {
            self.lambda[r] = self.scale
                * match x.lifted(r) {
                    Some(at) => solution.z[x.row_upper + at] - solution.z[x.row_lower + at],
                    None => solution.z[r],
                };
        }
        for (nu, first) in self.nu.iter_mut().zip(&x.cones) {
            *nu = solution.z[*first] * self.scale;
        }
        true
    }

    /// The Hessian that the solver was built with (n).
    pub(crate) fn hessian(&self) -> &[f64] {
        &self.typical.hessian
    }

    /// Puts NaN in P.
    #[cfg(test)]
    pub(crate) fn spoil(&mut self) {
        let nan = vec![f64::NAN; self.p.nzval.len()];
        self.solver.as_mut().expect("a solver").update_P(&nan).expect("as many numbers as P has");
    }
}

/// A diagonal matrix in compressed columns; `None` is no entry.
fn diagonal_matrix(diagonal: &[Option<f64>]) -> CscMatrix<f64> {
    let (mut colptr, mut rowval, mut nzval) = (vec![0], vec![], vec![]);
    for (k, value) in diagonal.iter().enumerate() {
        if let Some(value) = value {
            rowval.push(k);
            nzval.push(*value);
        }
        colptr.push(rowval.len());
    }
    CscMatrix::new(diagonal.len(), diagonal.len(), colptr, rowval, nzval)
}

/// Constraint matrix in compressed columns, with the numbers of `p` to come: `[G; I; -I; 0; 0; 0; -G_c]` for each u,
/// `[-1; 0; 0; I; -I; 0; 0]` for each z, `[0; 0; 0; -I; -I; -I; 0]` for the s of a row, `[0; 0; 0; 0; 0; -I; -1]` for that of a cone.
fn pattern(x: &Shape, p: &Coupled) -> CscMatrix<f64> {
    let (mut colptr, mut rowval, mut nzval) = (vec![0], vec![], vec![]);
    for k in 0..x.n {
        rowval.extend(0..x.m);
        nzval.extend(std::iter::repeat_n(1.0, x.m));
        rowval.extend([x.upper + k, x.upper + x.n + k]);
        nzval.extend([1.0, -1.0]);
        for (first, cone) in x.cones.iter().zip(&p.cones) {
            rowval.extend(first + 1..=first + cone.c.len());
            nzval.extend(std::iter::repeat_n(1.0, cone.c.len()));
        }
        colptr.push(rowval.len());
    }
    for r in 0..x.m {
        if let Some(at) = x.lifted(r) {
            rowval.extend([r, x.row_upper + at, x.row_lower + at]);
            nzval.extend([-1.0, 1.0, -1.0]);
            colptr.push(rowval.len());
        }
    }
    for r in 0..x.m {
        if let (Some(at), Some(slack)) = (x.lifted(r), x.slack_of(r)) {
            rowval.extend([x.row_upper + at, x.row_lower + at, x.slack + slack]);
            nzval.extend([-1.0, -1.0, -1.0]);
            colptr.push(rowval.len());
        }
    }
    for (c, first) in x.cones.iter().enumerate() {
        if let Some(slack) = x.slack_of(x.m + c) {
            rowval.extend([x.slack + slack, *first]);
            nzval.extend([-1.0, -1.0]);
            colptr.push(rowval.len());
        }
    }
    CscMatrix::new(x.rows, x.columns, colptr, rowval, nzval)
}

fn settings(max_iter: u32) -> DefaultSettings<f64> {
    DefaultSettings {
        verbose: false,
        presolve_enable: false,
        input_sparse_dropzeros: false,
        direct_solve_method: "qdldl".to_string(),
        max_threads: 1,
        max_iter,
        time_limit: f64::INFINITY,
        tol_gap_abs: 1e-12,
        tol_gap_rel: 1e-12,
        tol_feas: 1e-11,
        ..DefaultSettings::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `min 1/2 (y - goal)^2` in two variables with `y_0 + y_1 <= 1`.
    fn problem() -> Coupled {
        let mut p = Coupled::new(vec![1.0; 2], vec![None], vec![false], &[], 0);
        (p.lower, p.upper, p.goal) = (vec![-5.0; 2], vec![5.0; 2], vec![2.0, 1.0]);
        (p.rows, p.row_upper) = (vec![1.0, 1.0], vec![1.0]);
        p
    }

    fn answers(conic: &mut Conic) -> bool {
        let y = [1.0, 0.0]; // by hand: equal steps back along (1, 1)
        conic.solve(&problem()) && conic.y.iter().zip(y).all(|(a, b)| (a - b).abs() < 1e-6)
    }

    #[test]
    fn a_solver_with_a_nan_in_its_hessian_answers_in_the_tick_after() {
        let mut conic = Conic::new(&problem(), vec![1.0; 2], 50, None).unwrap();
        assert!(answers(&mut conic));
        conic.spoil();
        assert!(!answers(&mut conic), "a NaN in P gives no answer");
        assert!(answers(&mut conic), "a new solver answers, and nobody had to put P right");
    }

    #[test]
    fn a_solver_that_panics_is_replaced_in_the_tick_after() {
        let mut conic = Conic::new(&problem(), vec![1.0; 2], 50, None).unwrap();
        conic.solver.as_mut().unwrap().data.A.rowval.fill(usize::MAX / 2);
        assert!(!answers(&mut conic), "a panic gives no answer");
        assert!(conic.solver.is_none());
        assert!(answers(&mut conic), "a new solver answers");
    }
}
