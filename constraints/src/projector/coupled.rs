//! The problem of a tick with coupled rows, over the controllable dofs, the slacks `s` of soft rows and the cones:
//!
//! ```text
//!     min 1/2 sum_i h_i (y_i - goal_i)^2 + sum_r linear_r |s_r| + 1/2 quadratic_r s_r^2
//!     s.t.   lower <= y <= upper,   row_lower <= G y + s <= row_upper,   |G_c y + c| <= radius + s_c
//! ```
//!
//! Rows and cones are shares of the sizes of their limits. Dofs that are not controllable are constants, at the velocity
//! change their proposal asks for. Hard rows and cones have no slack.

use super::Dofs;
use crate::Soft;

/// The numbers of a tick; n dofs and m rows.
#[derive(Debug, Clone)]
pub(crate) struct Coupled {
    pub(crate) n: usize,
    pub(crate) m: usize,
    /// Diagonal of the Hessian (n).
    pub(crate) hessian: Vec<f64>,
    /// Unconstrained optimum (n).
    pub(crate) goal: Vec<f64>,
    /// Box (n).
    pub(crate) lower: Vec<f64>,
    /// Box (n).
    pub(crate) upper: Vec<f64>,
    /// Rows (m x n, row-major).
    pub(crate) rows: Vec<f64>,
    /// Lower bounds of the rows (m).
    pub(crate) row_lower: Vec<f64>,
    /// Upper bounds of the rows (m).
    pub(crate) row_upper: Vec<f64>,
    /// Size of each row's limit in its own unit (m).
    pub(crate) row_size: Vec<f64>,
    /// Softness of each row (m); `None` is hard.
    pub(crate) soft: Vec<Option<Soft>>,
    /// Rows whose bounds are equal (m).
    pub(crate) equality: Vec<bool>,
    pub(crate) cones: Vec<ConeRows>,
    /// Number of dofs that are not controllable.
    pub(crate) fixed: usize,
    /// Their columns of `G` (m x fixed, row-major).
    pub(crate) rows_fixed: Vec<f64>,
}

/// `|G y + c| <= radius + s`; infinite when switched off.
#[derive(Debug, Clone)]
pub(crate) struct ConeRows {
    /// dimension x n, row-major.
    pub(crate) g: Vec<f64>,
    /// Columns of the dofs that are not controllable (dimension x fixed).
    pub(crate) g_fixed: Vec<f64>,
    pub(crate) c: Vec<f64>,
    pub(crate) radius: f64,
    /// Softness; `None` is hard.
    pub(crate) soft: Option<Soft>,
    /// Size of the limit in its own unit.
    pub(crate) size: f64,
}

/// What a row asks for at most is this share of its range in the box away from the ends of that.
const INSIDE: f64 = 1e-9;

/// The least size numbers of a limit are multiplied by, so that disabled limits stay finite.
const ROOM: f64 = 1e6;

impl Coupled {
    pub(crate) fn new(
        hessian: Vec<f64>,
        soft: Vec<Option<Soft>>,
        equality: Vec<bool>,
        cones: &[(usize, Option<Soft>)],
        fixed: usize,
    ) -> Coupled {
        let (n, m) = (hessian.len(), soft.len());
        let cone = |(d, soft): &(usize, Option<Soft>)| ConeRows {
            soft: *soft,
            g: vec![0.0; d * n],
            g_fixed: vec![0.0; d * fixed],
            c: vec![0.0; *d],
            radius: ROOM,
            size: 1.0,
        };
        Coupled {
            n,
            m,
            hessian,
            goal: vec![0.0; n],
            lower: vec![0.0; n],
            upper: vec![0.0; n],
            rows: vec![0.0; n * m],
            row_lower: vec![f64::NEG_INFINITY; m],
            row_upper: vec![f64::INFINITY; m],
            row_size: vec![1.0; m],
            soft,
            equality,
            cones: cones.iter().map(cone).collect(),
            fixed,
            rows_fixed: vec![0.0; m * fixed],
        }
    }

    /// Takes row `r` from `g` over all dofs (nv), its bounds already in place, as share of `size`.
    pub(super) fn take_row(&mut self, r: usize, g: &[f64], size: f64, dofs: &Dofs, y: &[f64]) {
        let still: f64 = dofs.fixed.iter().map(|j| g[*j] * y[*j]).sum();
        for (to, j) in self.rows[r * self.n..(r + 1) * self.n].iter_mut().zip(&dofs.controllable) {
            *to = g[*j] / size;
        }
        self.row_lower[r] = (self.row_lower[r] - still) / size;
        self.row_upper[r] = (self.row_upper[r] - still) / size;
        for (to, j) in self.rows_fixed[r * self.fixed..(r + 1) * self.fixed].iter_mut().zip(&dofs.fixed) {
            *to = g[*j] / size;
        }
        self.row_size[r] = size;
    }

    /// Lets hard row `r` ask for no more than the box can give.
    pub(super) fn bring_nearer(&mut self, r: usize) {
        let ends = self.gradient(r).iter().zip(&self.lower).zip(&self.upper);
        let (low, high) = ends.fold((0.0, 0.0), |(low, high), ((g, lower), upper)| {
            (low + (g * lower).min(g * upper), high + (g * lower).max(g * upper))
        });
        let inside = INSIDE * (high - low);
        if inside.is_finite() {
            self.row_upper[r] = self.row_upper[r].max(low + inside);
            self.row_lower[r] = self.row_lower[r].min(high - inside);
        }
    }

    /// Row `r` of `G` (n).
    pub(crate) fn gradient(&self, r: usize) -> &[f64] {
        &self.rows[r * self.n..(r + 1) * self.n]
    }

    /// `G y` of row `r`.
    pub(crate) fn row(&self, r: usize, y: &[f64]) -> f64 {
        self.gradient(r).iter().zip(y).map(|(g, y)| g * y).sum()
    }

    /// By how much `y` exceeds row `r`; negative inside.
    pub(crate) fn excess(&self, r: usize, y: &[f64]) -> f64 {
        let value = self.row(r, y);
        (value - self.row_upper[r]).max(self.row_lower[r] - value)
    }

    /// Largest violation of a hard row by `y`.
    pub(crate) fn violation(&self, y: &[f64]) -> f64 {
        let hard = (0..self.m).filter(|r| self.soft[*r].is_none());
        hard.fold(0.0, |worst: f64, r| worst.max(self.excess(r, y)))
    }

    /// True when `y` leaves every soft row and cone without slack.
    pub(crate) fn obeys_soft(&self, y: &[f64], tolerance: f64) -> bool {
        let mut rows = (0..self.m).filter(|r| self.soft[*r].is_some());
        let mut cones = self.cones.iter().filter(|cone| cone.soft.is_some());
        rows.all(|r| self.excess(r, y) <= tolerance) && cones.all(|cone| cone.excess(y) <= tolerance)
    }

    /// Largest violation of a hard cone by `y`.
    pub(crate) fn cone_violation(&self, y: &[f64]) -> f64 {
        let hard = self.cones.iter().filter(|cone| cone.soft.is_none());
        hard.fold(0.0, |worst: f64, cone| worst.max(cone.excess(y)))
    }

    /// Largest violation of the optimality conditions: stationarity `H (y - goal) + G' lambda + mu + cones = 0`, where the
    /// force of a cone with multiplier `nu` is `nu G_c' (G_c y + c) / |G_c y + c|`, and complementarity (`unmatched`).
    pub(crate) fn residual(&self, y: &[f64], mu: &[f64], lambda: &[f64], nu: &[f64]) -> f64 {
        let stationary = self.stationarity(y, mu, lambda, nu);
        let stiffest = self.stiffest();
        let largest =
            |slopes: &mut dyn Iterator<Item = f64>| slopes.fold(0.0, |most: f64, g| most.max(g.abs()));
        let boxes = (0..self.n).map(|k| {
            let excess = if mu[k] > 0.0 { y[k] - self.upper[k] } else { self.lower[k] - y[k] };
            unmatched(mu[k].abs(), excess, 1.0, self.hessian[k], None)
        });
        let rows = (0..self.m).map(|r| {
            let (value, force) = (self.row(r, y), lambda[r]);
            let excess = match force {
                f if f > 0.0 => value - self.row_upper[r],
                f if f < 0.0 => self.row_lower[r] - value,
                _ => self.excess(r, y),
            };
            let slope = largest(&mut self.gradient(r).iter().copied());
            unmatched(force.abs(), excess, slope, stiffest, self.soft[r])
        });
        let cones = self.cones.iter().zip(nu).map(|(cone, nu)| {
            let slope = largest(&mut (0..self.n).map(|k| cone.slope(y, k)));
            unmatched(*nu, cone.excess(y), slope, stiffest, cone.soft)
        });
        boxes.chain(rows).chain(cones).fold(stationary, f64::max)
    }

    /// Largest entry of the Hessian.
    pub(crate) fn stiffest(&self) -> f64 {
        self.hessian.iter().fold(f64::MIN_POSITIVE, |most: f64, h| most.max(*h))
    }

    fn stationarity(&self, y: &[f64], mu: &[f64], lambda: &[f64], nu: &[f64]) -> f64 {
        (0..self.n).fold(0.0, |worst: f64, k| {
            let rows: f64 = (0..self.m).map(|r| lambda[r] * self.rows[r * self.n + k]).sum();
            let cones: f64 = self.cones.iter().zip(nu).map(|(cone, nu)| nu * cone.slope(y, k)).sum();
            worst.max((self.hessian[k] * (y[k] - self.goal[k]) + rows + cones + mu[k]).abs())
        })
    }

    /// False when anything is NaN or infinite that a solver would choke on.
    pub(crate) fn is_finite(&self) -> bool {
        let finite = |x: &[f64]| x.iter().all(|x| x.is_finite());
        let number = |x: &[f64]| x.iter().all(|x| !x.is_nan());
        let cones = self.cones.iter().all(|cone| finite(&cone.g) && finite(&cone.c) && !cone.radius.is_nan());
        finite(&self.hessian)
            && finite(&self.rows)
            && number(&self.row_lower)
            && number(&self.row_upper)
            && finite(&self.goal)
            && cones
    }

    /// Brings a goal so far outside that the answer would be all rounding nearer, along the way to the box: clamped dof by dof, it
    /// would pull another way.
    pub(crate) fn tame_goal(&mut self) {
        let share = self.share_within(FAR);
        for k in 0..self.n {
            self.goal[k] = self.nearer_goal(k, share);
        }
    }

    /// The share of the way from the box to the goal that is at most `widths` times the widest side of the box.
    pub(crate) fn share_within(&self, widths: f64) -> f64 {
        let sides = self.upper.iter().zip(&self.lower).map(|(upper, lower)| upper - lower);
        let widest = sides.filter(|side| side.is_finite()).fold(1e-6, f64::max).min(1.0);
        let way = (0..self.n).fold(0.0, |most: f64, k| most.max((self.goal[k] - self.in_box(k)).abs()));
        if way > widths * widest { widths * widest / way } else { 1.0 }
    }

    /// The goal of dof `k` at that share of the way.
    pub(crate) fn nearer_goal(&self, k: usize, share: f64) -> f64 {
        let start = self.in_box(k);
        if share < 1.0 { start + share * (self.goal[k] - start) } else { self.goal[k] }
    }

    fn in_box(&self, k: usize) -> f64 {
        self.goal[k].max(self.lower[k].max(-FAR)).min(self.upper[k].min(FAR))
    }
}

/// How far a multiplier (at least 0) and the excess of its bound are from belonging together, as a force on a velocity: the
/// smaller of what the multiplier would have to change by and what the bound would have to move by, through the stiffness
/// of the weights. Beyond a soft bound the multiplier is `linear + quadratic excess`, at it at most `linear`.
fn unmatched(multiplier: f64, excess: f64, slope: f64, stiffness: f64, soft: Option<Soft>) -> f64 {
    if slope <= 0.0 || excess == f64::NEG_INFINITY {
        return multiplier * slope;
    }
    let wanted = match soft {
        Some(soft) if excess > 0.0 => soft.linear + soft.quadratic * excess,
        Some(soft) if excess == 0.0 => multiplier.min(soft.linear),
        None if excess >= 0.0 => return 0.0, // a hard bound that is exceeded is the checker's business
        _ => 0.0,
    };
    ((multiplier - wanted).abs() * slope).min(excess.abs() / slope * stiffness)
}

impl ConeRows {
    /// Takes the cone from `g` over all dofs (dimension x nv), with `c` and the radius already in place.
    pub(super) fn take(&mut self, g: &[f64], nv: usize, size: f64, dofs: &Dofs, y: &[f64]) {
        let n = dofs.controllable.len();
        for (d, c) in self.c.iter_mut().enumerate() {
            let row = &g[d * nv..(d + 1) * nv];
            *c = (*c + dofs.fixed.iter().map(|j| row[*j] * y[*j]).sum::<f64>()) / size;
            for (k, j) in dofs.controllable.iter().enumerate() {
                self.g[d * n + k] = row[*j] / size;
            }
            for (u, j) in dofs.fixed.iter().enumerate() {
                self.g_fixed[d * dofs.fixed.len() + u] = row[*j] / size;
            }
        }
        self.size = size;
    }

    /// Entry `d` of `G y + c`.
    fn entry(&self, d: usize, y: &[f64]) -> f64 {
        let row = &self.g[d * y.len()..(d + 1) * y.len()];
        self.c[d] + row.iter().zip(y).map(|(g, y)| g * y).sum::<f64>()
    }

    /// By how much `y` exceeds the radius; negative inside.
    pub(crate) fn excess(&self, y: &[f64]) -> f64 {
        self.norm(y) - self.radius
    }

    /// `|G y + c|`.
    pub(crate) fn norm(&self, y: &[f64]) -> f64 {
        (0..self.c.len()).map(|d| self.entry(d, y).powi(2)).sum::<f64>().sqrt()
    }

    /// Derivative of the norm with respect to `y_k`.
    pub(crate) fn slope(&self, y: &[f64], k: usize) -> f64 {
        self.slope_along(y, |d| self.g[d * y.len() + k])
    }

    /// Derivative of the norm when `G y + c` moves along `direction`: `u' direction`.
    pub(crate) fn slope_along(&self, y: &[f64], direction: impl Fn(usize) -> f64) -> f64 {
        let norm = self.norm(y).max(f64::MIN_POSITIVE);
        (0..self.c.len()).map(|d| self.entry(d, y) * direction(d)).sum::<f64>() / norm
    }

    /// Second derivative of the norm along two directions: `a' (I - u u') b / norm`.
    pub(crate) fn curvature(
        &self,
        y: &[f64],
        a: impl Fn(usize) -> f64 + Copy,
        b: impl Fn(usize) -> f64 + Copy,
    ) -> f64 {
        let product: f64 = (0..self.c.len()).map(|d| a(d) * b(d)).sum();
        let norm = self.norm(y).max(f64::MIN_POSITIVE);
        (product - self.slope_along(y, a) * self.slope_along(y, b)) / norm
    }
}

/// Goals are kept within this many times the widest side of the box; without bounds, within this many rad/s or m/s.
const FAR: f64 = 1e6;

/// The problem of a tick in textbook form for other solvers to check ours, over `x = (y, s)` with a slack `s >= 0` for each soft
/// row, then for each soft cone: `min 1/2 x'H x + c'x` s.t. `G x <= h`, `A x = b` and `|C_k y + c_k| <= radius_k + s_k`.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// Dofs of the variables `y`.
    pub dofs: Vec<usize>,
    /// Number of variables: dofs, then slacks.
    pub n: usize,
    /// `H` (n x n, row-major).
    pub hessian: Vec<f64>,
    /// `c` (n).
    pub c: Vec<f64>,
    /// `G` (rows x n, row-major): upper box, lower box, upper rows, lower rows, `-s`; infinite bounds left out.
    pub g: Vec<f64>,
    /// `h` (rows).
    pub h: Vec<f64>,
    /// `A` (equalities x n, row-major).
    pub a: Vec<f64>,
    /// `b` (equalities).
    pub b: Vec<f64>,
    /// Cones that are switched on.
    pub cones: Vec<ProblemCone>,
}

/// `|C y + c| <= radius + s` of a [`Problem`].
#[derive(Debug, Clone, PartialEq)]
pub struct ProblemCone {
    /// `C` (dimension x dofs, row-major).
    pub g: Vec<f64>,
    /// `c` (dimension).
    pub c: Vec<f64>,
    /// Radius.
    pub radius: f64,
    /// Variable that is its slack `s`; `None` for a hard cone, which has none.
    pub slack: Option<usize>,
}

impl Problem {
    pub(crate) fn of(p: &Coupled, dofs: &[usize]) -> Problem {
        let slack_of: Vec<Option<usize>> = {
            let mut next = p.n;
            let cones = p.cones.iter().map(|cone| cone.soft);
            p.soft.iter().copied().chain(cones).map(|s| s.map(|_| (next, next += 1).0)).collect()
        };
        let n = p.n + slack_of.iter().flatten().count();
        let mut problem = Problem {
            dofs: dofs.to_vec(),
            n,
            hessian: vec![0.0; n * n],
            c: vec![0.0; n],
            g: vec![],
            h: vec![],
            a: vec![],
            b: vec![],
            cones: vec![],
        };
        let unit = |k: usize, sign: f64| (0..n).map(move |j| if j == k { sign } else { 0.0 });
        (0..p.n).for_each(|k| problem.push(unit(k, 1.0), p.upper[k]));
        (0..p.n).for_each(|k| problem.push(unit(k, -1.0), -p.lower[k]));
        let row = |r: usize, sign: f64| {
            let slack = slack_of[r];
            (0..n).map(move |k| match k < p.n {
                true => sign * p.rows[r * p.n + k],
                false => -f64::from(u8::from(slack == Some(k))),
            })
        };
        for r in (0..p.m).filter(|r| p.equality[*r] && p.soft[*r].is_none() && p.row_upper[*r].is_finite()) {
            problem.a.extend(row(r, 1.0));
            problem.b.push(p.row_upper[r]);
        }
        for r in (0..p.m).filter(|r| !p.equality[*r] || p.soft[*r].is_some()) {
            problem.push(row(r, 1.0), p.row_upper[r]);
            problem.push(row(r, -1.0), -p.row_lower[r]);
        }
        for k in 0..p.n {
            problem.hessian[k * n + k] = p.hessian[k];
            problem.c[k] = -p.hessian[k] * p.goal[k];
        }
        let softness = p.soft.iter().copied().chain(p.cones.iter().map(|cone| cone.soft));
        for (slack, soft) in slack_of.iter().zip(softness) {
            if let (Some(k), Some(soft)) = (*slack, soft) {
                problem.hessian[k * n + k] = soft.quadratic;
                problem.c[k] = soft.linear;
                problem.push(unit(k, -1.0), 0.0);
            }
        }
        let finite = p.cones.iter().zip(&slack_of[p.m..]).filter(|(cone, _)| cone.radius.is_finite());
        let cone = |(cone, slack): (&ConeRows, &Option<usize>)| ProblemCone {
            g: cone.g.clone(),
            c: cone.c.clone(),
            radius: cone.radius,
            slack: *slack,
        };
        problem.cones = finite.map(cone).collect();
        problem
    }

    fn push(&mut self, row: impl Iterator<Item = f64>, bound: f64) {
        if bound.is_finite() {
            self.g.extend(row);
            self.h.push(bound);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `min 1/2 |y - (2, 1)|^2` with `y_0 + y_1 <= 1`: by hand (1, 0), and the row pulls with 1.
    #[test]
    fn forces_that_balance_are_no_optimum_where_their_bound_is_far() {
        let mut p = Coupled::new(vec![1.0; 2], vec![None], vec![false], &[], 0);
        (p.lower, p.upper, p.goal) = (vec![-5.0; 2], vec![5.0; 2], vec![2.0, 1.0]);
        (p.rows, p.row_upper) = (vec![1.0, 1.0], vec![1.0]);
        assert_eq!(p.residual(&[1.0, 0.0], &[0.0; 2], &[1.0], &[]), 0.0);
        let short = p.residual(&[0.2, -0.8], &[0.0; 2], &[1.8], &[]); // balanced, 1.6 inside
        assert!((short - 1.6).abs() < 1e-12, "{short}");
        let boxed = p.residual(&[1.0, 0.0], &[1.0, 1.0], &[0.0], &[]); // the box is 4 and 5 away
        assert_eq!(boxed, 1.0);
    }

    /// The same with the row soft, `0.1 s + 1/2 2 s^2`: beyond it the row pulls with `0.1 + 2 s`.
    #[test]
    fn a_soft_row_pulls_as_hard_as_it_is_exceeded() {
        let soft = Soft { linear: 0.1, quadratic: 2.0 };
        let mut p = Coupled::new(vec![1.0; 2], vec![Some(soft)], vec![false], &[], 0);
        (p.lower, p.upper, p.goal) = (vec![-5.0; 2], vec![5.0; 2], vec![2.0, 1.0]);
        (p.rows, p.row_upper) = (vec![1.0, 1.0], vec![1.0]);
        // y = goal - lambda (1, 1), lambda = 0.1 + 2 (2 - 2 lambda): lambda = 4.1 / 5.
        let lambda: f64 = 0.82;
        let y = [2.0 - lambda, 1.0 - lambda];
        assert!(p.residual(&y, &[0.0; 2], &[lambda], &[]) < 1e-12);
        let inside = p.residual(&[0.9, -0.1], &[0.0; 2], &[1.1], &[]); // 0.2 inside, and yet it pulls
        assert!((inside - 0.2).abs() < 1e-12, "{inside}");
    }
}
