//! Newton's method from an answer that is near the optimum: it ends at the optimum, or leaves the answer alone.

use super::*;
use crate::Soft;
use crate::random::Random;
use nalgebra::{DMatrix, DVector};
use std::cell::Cell;

/// A problem with a point inside everything hard: a box, `m` rows and two cones, every second one of them soft.
fn random_problem(n: usize, m: usize, random: &mut Random) -> Coupled {
    let soft = Soft { linear: 0.05, quadratic: 2.0 };
    let every_second = |r: usize| (r % 2 == 1).then_some(soft);
    let hessian = (0..n).map(|_| 1.5 + random.between(-1.0, 1.0)).collect();
    let softness = (0..m).map(every_second).collect();
    let cones = [(3, None), (n, Some(soft))];
    let mut p = Coupled::new(hessian, softness, vec![false; m], &cones, 0);
    let inside: Vec<f64> = (0..n).map(|_| random.between(-1.0, 1.0)).collect();
    for k in 0..n {
        (p.lower[k], p.upper[k]) =
            (inside[k] - 1.0 - random.between(-1.0, 1.0), inside[k] + 1.0 + random.between(-1.0, 1.0));
        p.goal[k] = 4.0 * random.between(-1.0, 1.0);
    }
    p.rows.iter_mut().for_each(|g| *g = random.between(-1.0, 1.0));
    for r in 0..m {
        let value = p.row(r, &inside);
        (p.row_lower[r], p.row_upper[r]) =
            (value - 0.6 - 0.5 * random.between(-1.0, 1.0), value + 0.6 + 0.5 * random.between(-1.0, 1.0));
    }
    for c in 0..2 {
        let cone = &mut p.cones[c];
        cone.g.iter_mut().chain(&mut cone.c).for_each(|g| *g = random.between(-1.0, 1.0));
        cone.radius = cone.norm(&inside) * 1.05;
    }
    p
}

/// How far `y` and its multipliers are from what makes a point the optimum of a convex problem, written for the textbook form: nothing
/// of `coupled.rs` but the numbers is used. Stationarity, feasibility, signs of the multipliers, complementarity.
fn from_optimal(p: &Coupled, y: &[f64], mu: &[f64], lambda: &[f64], nu: &[f64]) -> f64 {
    let y = DVector::from_column_slice(y);
    let rows = DMatrix::from_row_slice(p.m, p.n, &p.rows);
    let mut gradient = DVector::from_fn(p.n, |k, _| p.hessian[k] * (y[k] - p.goal[k]) + mu[k]);
    gradient += rows.transpose() * DVector::from_column_slice(lambda);
    let mut worst = 0.0f64;
    let mut held = |value: f64, low: f64, high: f64, multiplier: f64, soft: Option<Soft>| {
        let slack = (value - high).max(low - value).max(0.0);
        let allowed = match soft {
            None => slack,
            // The multiplier is the slope of the price: up to `linear` without slack, `linear + quadratic s` with it.
            Some(s) if slack > 1e-9 => (multiplier.abs() - s.linear - s.quadratic * slack).abs(),
            Some(s) => (multiplier.abs() - s.linear).max(0.0),
        };
        worst = worst.max(allowed);
        let room = if multiplier > 0.0 { high - value } else { value - low };
        worst = worst.max(multiplier.abs().min(room.max(0.0)));
    };
    for k in 0..p.n {
        held(y[k], p.lower[k], p.upper[k], mu[k], None);
    }
    let values = &rows * &y;
    for r in 0..p.m {
        held(values[r], p.row_lower[r], p.row_upper[r], lambda[r], p.soft[r]);
    }
    for (cone, nu) in p.cones.iter().zip(nu) {
        let g = DMatrix::from_row_slice(cone.c.len(), p.n, &cone.g);
        let point = &g * &y + DVector::from_column_slice(&cone.c);
        gradient += g.transpose() * &point * (nu / point.norm());
        held(point.norm(), f64::NEG_INFINITY, cone.radius, *nu, cone.soft);
    }
    worst.max(gradient.amax())
}

fn solved(p: &Coupled) -> Conic {
    let mut conic = Conic::new(p, vec![1.0; p.n], 100, None).unwrap();
    assert!(conic.solve(p));
    conic
}

#[test]
fn what_is_polished_is_the_optimum() {
    let (mut random, mut polished, mut before, mut after) = (Random(3), 0, 0.0f64, 0.0f64);
    let (mut hard, mut gives) = (0, 0);
    for k in 0..300 {
        let p = random_problem(2 + k % 13, k % 7, &mut random);
        let mut conic = solved(&p);
        let rough = from_optimal(&p, &conic.y, &conic.mu, &conic.lambda, &conic.nu);
        if Polish::new(&p).refine(&p, &mut conic, || false) {
            polished += 1;
            before = before.max(rough);
            let off = from_optimal(&p, &conic.y, &conic.mu, &conic.lambda, &conic.nu);
            after = after.max(off);
            hard += usize::from(conic.nu[0] > 1e-3);
            gives += usize::from(p.cones[1].norm(&conic.y) > p.cones[1].radius + 1e-3);
        }
    }
    println!("{polished} of 300 polished: {before:.0e} from optimal before, {after:.0e} after");
    println!("{hard} at the hard cone, {gives} beyond the soft one");
    assert!(polished >= 290 && after < 1e-10, "{polished} {after:e}");
    assert!(hard > 100 && gives > 100, "{hard} {gives}");
}

/// The point of a ball next to a goal outside it, which everybody knows.
#[test]
fn the_nearest_point_of_a_ball_is_found() {
    let mut p = Coupled::new(vec![1.0; 3], vec![], vec![], &[(3, None)], 0);
    (p.lower, p.upper, p.goal) = (vec![-5.0; 3], vec![5.0; 3], vec![3.0, 0.0, -4.0]);
    (p.cones[0].g, p.cones[0].radius) = (vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], 2.0);
    let mut conic = solved(&p);
    assert!(Polish::new(&p).refine(&p, &mut conic, || false));
    let expected = [1.2, 0.0, -1.6]; // 2 goal / |goal|
    assert!(conic.y.iter().zip(expected).all(|(y, x)| (y - x).abs() < 1e-14), "{:?}", conic.y);
    assert!((conic.nu[0] - 3.0).abs() < 1e-13); // |goal| - radius
}

/// Each step asks for the time; when it is over, Clarabel's answer stands as it was.
#[test]
fn polishing_ends_at_the_deadline() {
    let p = random_problem(9, 4, &mut Random(5));
    let steps = |most: u32| {
        let (mut conic, asked) = (solved(&p), Cell::new(0));
        let before = (conic.y.clone(), conic.mu.clone(), conic.lambda.clone(), conic.nu.clone());
        let late = || asked.replace(asked.get() + 1) >= most;
        let done = Polish::new(&p).refine(&p, &mut conic, late);
        let same = before == (conic.y, conic.mu, conic.lambda, conic.nu);
        (done, same, asked.get())
    };
    let (done, _, needed) = steps(u32::MAX);
    assert!(done && (2..=STEPS).contains(&needed), "{needed}");
    for most in 0..needed {
        assert_eq!(steps(most), (false, true, most + 1));
    }
}

/// The deadline is the one of the solve before it.
#[test]
fn the_time_of_the_solve_counts() {
    let p = random_problem(9, 4, &mut Random(5));
    let mut hurried = Conic::new(&p, vec![1.0; p.n], 100, Some(std::time::Duration::from_nanos(1))).unwrap();
    hurried.solve(&p);
    assert!(hurried.clock()() && !solved(&p).clock()());
}
