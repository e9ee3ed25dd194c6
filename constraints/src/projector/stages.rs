//! The stages for coupled rows alone, on a problem given as numbers, for benchmarks and tests.

use super::active_set::ActiveSet;
use super::conic::Conic;
use super::coupled::Coupled;
use crate::{LimitError, Soft};

/// A problem as in `coupled.rs`, without cones; n dofs and m rows.
#[derive(Debug, Clone, Default)]
pub struct Numbers {
    /// Diagonal of the Hessian (n).
    pub hessian: Vec<f64>,
    /// Unconstrained optimum (n).
    pub goal: Vec<f64>,
    /// Box (n).
    pub lower: Vec<f64>,
    /// Box (n).
    pub upper: Vec<f64>,
    /// Rows (m x n, row-major).
    pub rows: Vec<f64>,
    /// Lower bounds of the rows (m).
    pub row_lower: Vec<f64>,
    /// Upper bounds of the rows (m).
    pub row_upper: Vec<f64>,
    /// Softness of the rows (m).
    pub soft: Vec<Option<Soft>>,
    /// Rows whose bounds are equal (m).
    pub equality: Vec<bool>,
}

/// Both stages on problems of one shape: hessian, softness and equalities stay those of the first.
pub struct CoupledStages {
    problem: Coupled,
    active_set: ActiveSet,
    conic: Conic,
}

impl CoupledStages {
    /// # Errors
    /// Clarabel refuses the problem.
    pub fn new(first: &Numbers) -> Result<CoupledStages, LimitError> {
        let (soft, equality) = (first.soft.clone(), first.equality.clone());
        let mut problem = Coupled::new(first.hessian.clone(), soft, equality, &[], 0);
        put(&mut problem, first);
        let width = |k: usize| ((first.upper[k] - first.lower[k]) / 2.0).clamp(1e-3, 1e3);
        let sigma = (0..problem.n).map(width).collect();
        let conic = Conic::new(&problem, sigma, 50, None)?;
        Ok(CoupledStages { active_set: ActiveSet::new(problem.n, problem.m), problem, conic })
    }

    /// Takes over the numbers of the next problem.
    pub fn put(&mut self, numbers: &Numbers) {
        put(&mut self.problem, numbers);
    }

    /// The active-set stage, from where it last ended; true when it found the optimum.
    pub fn exact(&mut self) -> bool {
        self.active_set.solve(&self.problem)
    }

    /// The active-set stage showed that no answer exists.
    pub fn empty(&self) -> bool {
        self.active_set.empty
    }

    /// Lets the next [`exact`](Self::exact) start from the problem alone.
    pub fn forget(&mut self) {
        self.active_set.forget();
    }

    /// Clarabel; true when it has an answer that holds the hard rows to `tolerance`.
    pub fn clarabel(&mut self, tolerance: f64) -> bool {
        self.conic.solve(&self.problem) && self.problem.violation(&self.conic.y) <= tolerance
    }

    /// Answer of the active-set stage (n).
    pub fn exact_answer(&self) -> &[f64] {
        &self.active_set.y
    }

    /// Steps of the active-set stage.
    pub fn exact_iterations(&self) -> u32 {
        self.active_set.iterations
    }

    /// Multipliers of the box (n) and of the rows (m).
    pub fn multipliers(&self) -> (&[f64], &[f64]) {
        (&self.active_set.mu, &self.active_set.lambda)
    }

    /// Answer of Clarabel (n).
    pub fn clarabel_answer(&self) -> &[f64] {
        &self.conic.y
    }

    /// Iterations of Clarabel.
    pub fn clarabel_iterations(&self) -> u32 {
        self.conic.iterations
    }
}

fn put(problem: &mut Coupled, numbers: &Numbers) {
    problem.goal.copy_from_slice(&numbers.goal);
    problem.lower.copy_from_slice(&numbers.lower);
    problem.upper.copy_from_slice(&numbers.upper);
    problem.rows.copy_from_slice(&numbers.rows);
    problem.row_lower.copy_from_slice(&numbers.row_lower);
    problem.row_upper.copy_from_slice(&numbers.row_upper);
}
