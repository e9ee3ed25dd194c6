//! Clarabel as the judge of last resort, built once and updated in place.
//!
//! Variables are `u = y / sigma` and the lifted `z = A u`, one per torque row, as shares of their limits; without the
//! lifting each dense row would stand in the factor twice:
//!
//! ```text
//!     min 1/2 u'P u + c'u   s.t.   A u - z = 0,   u <= u_max,   -u <= -u_min,   z <= z_max,   -z <= -z_min
//! ```
//!
//! P is constant, so no NaN can enter it (a NaN in P stays in Clarabel's buffers for good). Clarabel's own equilibration is
//! frozen at set-up; the scaling by `sigma` and by the limits keeps all numbers near 1 instead. There is no
//! `time_limit`: it counts all earlier solves too.

use super::coupled::Coupled;
use crate::LimitError;
use clarabel::algebra::CscMatrix;
use clarabel::solver::{DefaultSettings, DefaultSolver, IPSolver, SolverStatus, SupportedConeT};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// The solver and the numbers that change from tick to tick.
pub(crate) struct Conic {
    solver: Option<DefaultSolver<f64>>,
    n: usize,
    m: usize,
    /// Unit of each variable (n) [rad/s].
    sigma: Vec<f64>,
    /// Largest entry of the Hessian in scaled variables.
    scale: f64,
    c: Vec<f64>,
    a: Vec<f64>,
    b: Vec<f64>,
    /// Answer (n).
    pub(crate) y: Vec<f64>,
    /// Signed multipliers of the box (n) and rows (m), as in the active-set stage.
    pub(crate) mu: Vec<f64>,
    pub(crate) lambda: Vec<f64>,
    /// Iterations of the last solve.
    pub(crate) iterations: u32,
}

/// Rows are tightened by this share of their limit, more than the solver's tolerance.
const TIGHTEN: f64 = 1e-9;

/// A bound this many `sigma` away is none.
const FAR: f64 = 1e4;

impl Conic {
    /// `sigma`: representative velocity changes (n); `typical`: a problem with representative rows.
    pub(crate) fn new(typical: &Coupled, sigma: Vec<f64>, max_iter: u32) -> Result<Conic, LimitError> {
        let (n, m) = (typical.n, typical.m);
        let weights: Vec<f64> = (0..n).map(|k| typical.hessian[k] * sigma[k] * sigma[k]).collect();
        let scale = weights.iter().fold(f64::MIN_POSITIVE, |s: f64, w| s.max(*w));
        let mut conic = Conic {
            solver: None,
            n,
            m,
            sigma,
            scale,
            c: vec![0.0; n + m],
            a: vec![],
            b: vec![0.0; 3 * m + 2 * n],
            y: vec![0.0; n],
            mu: vec![0.0; n],
            lambda: vec![0.0; m],
            iterations: 0,
        };
        let p = CscMatrix::new(
            n + m,
            n + m,
            (0..=n + m).map(|k| k.min(n)).collect(),
            (0..n).collect(),
            weights.iter().map(|w| w / scale).collect(),
        );
        let a = conic.pattern(typical);
        conic.a.clone_from(&a.nzval);
        conic.fill(typical);
        let mut cones = vec![SupportedConeT::ZeroConeT(m), SupportedConeT::NonnegativeConeT(2 * (n + m))];
        cones.retain(|cone| *cone != SupportedConeT::ZeroConeT(0));
        let solver = DefaultSolver::new(&p, &conic.c, &a, &conic.b, &cones, settings(max_iter));
        conic.solver = Some(solver.map_err(|error| LimitError::Unusable {
            what: format!("Clarabel refused the problem of these limits: {error}"),
            next: "check the limits for extreme values",
        })?);
        conic.solve(typical); // the first solve allocates more than the others
        Ok(conic)
    }

    /// Constraint matrix in compressed columns: [A; I; -I; 0; 0] for each u, [-1; 0; 0; I; -I] for each z.
    fn pattern(&self, p: &Coupled) -> CscMatrix<f64> {
        let (n, m) = (self.n, self.m);
        let (mut colptr, mut rowval, mut nzval) = (vec![0], vec![], vec![]);
        for k in 0..n {
            for r in 0..m {
                rowval.push(r);
                nzval.push(self.scaled(p, r, k));
            }
            rowval.extend([m + k, m + n + k]);
            nzval.extend([1.0, -1.0]);
            colptr.push(rowval.len());
        }
        for r in 0..m {
            rowval.extend([r, m + 2 * n + r, 2 * m + 2 * n + r]);
            nzval.extend([-1.0, 1.0, -1.0]);
            colptr.push(rowval.len());
        }
        CscMatrix::new(3 * m + 2 * n, n + m, colptr, rowval, nzval)
    }

    fn scaled(&self, p: &Coupled, r: usize, k: usize) -> f64 {
        p.rows[r * self.n + k] * self.sigma[k] / p.row_size[r]
    }

    /// Overwrites c, A and b with the numbers of the tick.
    fn fill(&mut self, p: &Coupled) {
        let (n, m) = (self.n, self.m);
        for k in 0..n {
            self.c[k] = -p.hessian[k] * self.sigma[k] * p.goal[k] / self.scale;
            self.b[m + k] = (p.upper[k] / self.sigma[k]).min(FAR);
            self.b[m + n + k] = (-p.lower[k] / self.sigma[k]).min(FAR);
            for r in 0..m {
                self.a[k * (m + 2) + r] = self.scaled(p, r, k);
            }
        }
        for r in 0..m {
            self.b[m + 2 * n + r] = p.row_upper[r] / p.row_size[r] - TIGHTEN;
            self.b[2 * m + 2 * n + r] = -p.row_lower[r] / p.row_size[r] - TIGHTEN;
        }
    }

    /// True when Clarabel returned something worth checking in `y`; its word on optimality is not taken.
    pub(crate) fn solve(&mut self, p: &Coupled) -> bool {
        self.fill(p);
        let finite = |x: &[f64]| x.iter().all(|x| x.is_finite());
        if !(finite(&self.c) && finite(&self.a) && finite(&self.b)) {
            return false;
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
        );
        if !(usable && solution.x.iter().all(|x| x.is_finite())) {
            // A spare in place of a buffer that may hold NaN; only a failed solve pays for the allocation.
            let healed = clarabel::solver::DefaultResiduals::new(self.n + self.m, self.b.len());
            solver.residuals = healed;
            return false;
        }
        let (n, m) = (self.n, self.m);
        for k in 0..n {
            self.y[k] = (solution.x[k] * self.sigma[k]).clamp(p.lower[k], p.upper[k]);
            self.mu[k] = (solution.z[m + k] - solution.z[m + n + k]) * self.scale / self.sigma[k];
        }
        for r in 0..m {
            let signed = solution.z[m + 2 * n + r] - solution.z[2 * m + 2 * n + r];
            self.lambda[r] = signed * self.scale / p.row_size[r];
        }
        true
    }
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
