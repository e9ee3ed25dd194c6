//! The stages for coupled rows on random problems. Their answers are compared with each other and with brute force, and must not depend on what
//! they solved before.

use crate::common::Random;
use nalgebra::{DMatrix, DVector};
use nearl_constraints::{CoupledStages, Numbers, Soft};

/// What a random problem is like.
#[derive(Clone, Copy)]
struct Kind {
    n: usize,
    m: usize,
    /// Share of soft rows and of equalities.
    soft: f64,
    equal: f64,
    /// Rows repeat, differ by little or are zero, and bounds are touched exactly.
    degenerate: bool,
}

/// A problem with a point inside its hard bounds, unless `empty`.
fn random_problem(kind: Kind, empty: bool, random: &mut Random) -> Numbers {
    let Kind { n, m, .. } = kind;
    let signed = |random: &mut Random| random.between(-1.0, 1.0);
    let inside: Vec<f64> = (0..n).map(|_| signed(random)).collect();
    let mut p = Numbers { hessian: (0..n).map(|_| random.between(0.3, 3.0)).collect(), ..Numbers::default() };
    for k in 0..n {
        p.lower.push(inside[k] - random.between(0.0, 1.0));
        p.upper.push(inside[k] + random.between(0.0, 1.0));
        let goal = match random.next() {
            x if x < 0.2 && kind.degenerate => p.upper[k],
            _ => 3.0 * signed(random),
        };
        p.goal.push(goal);
    }
    for r in 0..m {
        let mut row: Vec<f64> = (0..n).map(|_| signed(random)).collect();
        if kind.degenerate && r > 0 {
            let other = p.rows[(r - 1) * n..r * n].to_vec();
            match (random.next() * 5.0) as usize {
                0 => row = other.iter().map(|x| -2.0 * x).collect(),
                1 => row = other,
                2 => (0..n).for_each(|k| row[k] = f64::from(u8::from(k == r % n))),
                _ => {}
            }
        }
        let value: f64 = row.iter().zip(&inside).map(|(g, y)| g * y).sum();
        let soft = random.next() < kind.soft;
        let equal = !soft && random.next() < kind.equal;
        let off = if soft { 0.5 * signed(random) } else { 0.0 };
        let width = |random: &mut Random| match random.next() {
            x if x < 0.2 => f64::INFINITY,
            x if x < 0.4 && kind.degenerate => 0.0,
            _ => random.between(0.0, 0.6),
        };
        let (below, above) = if equal { (0.0, 0.0) } else { (width(random), width(random)) };
        p.rows.extend(row);
        p.row_lower.push(value + off - below);
        p.row_upper.push(value + off + above);
        p.equality.push(equal);
        let linear = if random.next() < 0.3 { 0.0 } else { random.between(0.0, 1.0) };
        p.soft.push(soft.then(|| Soft { linear, quadratic: random.between(0.2, 10.0) }));
    }
    if empty {
        // The first row asks for more than the box has.
        let most: f64 = (0..n).map(|k| (p.rows[k] * p.upper[k]).max(p.rows[k] * p.lower[k])).sum();
        (p.row_lower[0], p.row_upper[0]) = (most + 0.01, f64::INFINITY);
        (p.soft[0], p.equality[0]) = (None, false);
    }
    p
}

fn row_values(p: &Numbers, y: &[f64]) -> Vec<f64> {
    p.rows.chunks(y.len()).map(|g| g.iter().zip(y).map(|(g, y)| g * y).sum()).collect()
}

/// Distance and penalties of `y`, with the slacks it needs.
fn cost(p: &Numbers, y: &[f64]) -> f64 {
    let distance: f64 = (0..y.len()).map(|k| 0.5 * p.hessian[k] * (y[k] - p.goal[k]).powi(2)).sum();
    let penalty = row_values(p, y).into_iter().enumerate().map(|(r, value)| {
        let slack = (value - p.row_upper[r]).max(p.row_lower[r] - value).max(0.0);
        p.soft[r].map_or(0.0, |s| s.linear * slack + 0.5 * s.quadratic * slack * slack)
    });
    distance + penalty.sum::<f64>()
}

fn violation(p: &Numbers, y: &[f64]) -> f64 {
    let rows = row_values(p, y).into_iter().enumerate().filter(|(r, _)| p.soft[*r].is_none());
    let rows = rows.map(|(r, value)| (value - p.row_upper[r]).max(p.row_lower[r] - value));
    let box_ = (0..y.len()).map(|k| (y[k] - p.upper[k]).max(p.lower[k] - y[k]));
    rows.chain(box_).fold(0.0, f64::max)
}

/// The most steps one call may take: two tries.
fn bound(kind: Kind) -> u32 {
    11 * (kind.n + kind.m) as u32 + 10
}

fn shapes(random: &mut Random) -> Kind {
    let (n, m) = (1 + (random.next() * 30.0) as usize, (random.next() * 41.0) as usize);
    let (soft, degenerate) = ([0.0, 0.3, 1.0][(random.next() * 3.0) as usize], random.next() < 0.4);
    // As many equalities as leave room to move.
    let equal = if random.next() < 0.5 { 0.0 } else { 0.25 * n as f64 / (m.max(1) as f64) };
    Kind { n, m, soft, equal: equal.min(0.3), degenerate }
}

/// On problems with a solution, the active-set stage is never worse than Clarabel, and both end at the same point.
#[test]
fn the_stages_agree() {
    let mut random = Random(11);
    let (mut solved, mut compared, mut tried, mut regular, mut furthest) = (0, 0, 0, 0, 0.0f64);
    for _ in 0..600 {
        let kind = shapes(&mut random);
        let first = random_problem(kind, false, &mut random);
        let mut stages = CoupledStages::new(&first).unwrap();
        stages.put(&first);
        tried += 1;
        let exact = stages.exact();
        assert!(stages.exact_iterations() <= bound(kind));
        assert!(!stages.empty());
        if exact {
            solved += 1;
            let y = stages.exact_answer();
            assert!(violation(&first, y) <= 1e-9, "{:e}", violation(&first, y));
        } else {
            assert!(kind.degenerate, "{} x {} unsolved", kind.n, kind.m);
        }
        // Rows without width are empty to Clarabel, which keeps a little inside of every row.
        if stages.clarabel(1e-7) && exact {
            let (ours, theirs) = (stages.exact_answer(), stages.clarabel_answer());
            let (a, b) = (cost(&first, ours), cost(&first, theirs));
            assert!(a <= b + 1e-6 * (1.0 + b.abs()), "{a} against {b}");
            let off = ours.iter().zip(theirs).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            if !kind.degenerate {
                compared += 1;
                furthest = furthest.max(off);
            }
        }
        regular += usize::from(!kind.degenerate);
    }
    println!("{solved} of {tried} solved, {compared} of {regular} compared, furthest {furthest:.1e}");
    assert!(solved * 100 >= tried * 99 && compared * 100 >= regular * 99, "{solved} {compared} {regular}");
    assert!(furthest < 1e-4, "{furthest:e}");
}

/// Best point over every choice of held bounds, each solved as linear equations over y and the slacks of soft rows.
fn brute_force(p: &Numbers) -> Option<(f64, DVector<f64>)> {
    let (n, m) = (p.goal.len(), p.soft.len());
    let column: Vec<Option<usize>> = {
        let mut next = n;
        p.soft.iter().map(|s| s.map(|_| (next, next += 1).0)).collect()
    };
    let size = n + column.iter().flatten().count();
    let mut all: Vec<(DVector<f64>, f64)> = vec![];
    let unit = |k: usize, sign: f64| DVector::from_fn(size, |i, _| if i == k { sign } else { 0.0 });
    for k in 0..n {
        all.extend([(unit(k, 1.0), p.upper[k]), (unit(k, -1.0), -p.lower[k])]);
    }
    for r in 0..m {
        for (sign, bound) in [(1.0, p.row_upper[r]), (-1.0, -p.row_lower[r])] {
            let mut g = DVector::zeros(size);
            (0..n).for_each(|k| g[k] = sign * p.rows[r * n + k]);
            column[r].into_iter().for_each(|s| g[s] = -1.0);
            if bound.is_finite() {
                all.push((g, bound));
            }
        }
        all.extend(column[r].map(|s| (unit(s, -1.0), 0.0)));
    }
    let mut h = DMatrix::zeros(size, size);
    let mut c = DVector::zeros(size);
    (0..n).for_each(|k| (h[(k, k)], c[k]) = (p.hessian[k], -p.hessian[k] * p.goal[k]));
    for (s, soft) in column.iter().zip(&p.soft) {
        if let (Some(s), Some(soft)) = (s, soft) {
            (h[(*s, *s)], c[*s]) = (soft.quadratic, soft.linear);
        }
    }
    let mut best: Option<(f64, DVector<f64>)> = None;
    for mask in 0u32..1 << all.len() {
        let active: Vec<usize> = (0..all.len()).filter(|r| mask >> r & 1 == 1).collect();
        if active.len() > size {
            continue;
        }
        let k = size + active.len();
        let (mut kkt, mut rhs) = (DMatrix::zeros(k, k), DVector::zeros(k));
        kkt.view_mut((0, 0), (size, size)).copy_from(&h);
        rhs.rows_mut(0, size).copy_from(&-&c);
        for (a, r) in active.iter().enumerate() {
            kkt.view_mut((0, size + a), (size, 1)).copy_from(&all[*r].0);
            kkt.view_mut((size + a, 0), (1, size)).copy_from(&all[*r].0.transpose());
            rhs[size + a] = all[*r].1;
        }
        let Some(x) = kkt.full_piv_lu().solve(&rhs).map(|x| x.rows(0, size).into_owned()) else { continue };
        let holds = all.iter().all(|(g, bound)| g.dot(&x) <= bound + 1e-9);
        if holds && x.iter().all(|x| x.is_finite()) {
            let cost = 0.5 * x.dot(&(&h * &x)) + c.dot(&x);
            if best.as_ref().is_none_or(|(least, _)| cost < *least) {
                best = Some((cost, x));
            }
        }
    }
    best
}

/// Up to three dofs, rows hard, soft, equal and dependent, with and without a solution.
#[test]
fn brute_force_finds_nothing_better() {
    let mut random = Random(12);
    let (mut solved, mut empty) = (0, 0);
    for k in 0..240 {
        let n = 1 + k % 3;
        let kind = Kind { n, m: 1 + k % 2, soft: 0.4, equal: 0.2, degenerate: k % 5 < 2 };
        let p = random_problem(kind, k % 8 == 7, &mut random);
        let mut stages = CoupledStages::new(&p).unwrap();
        stages.put(&p);
        let exact = stages.exact();
        match brute_force(&p) {
            None => {
                empty += 1;
                assert!(!exact, "an answer where there is none");
            }
            Some((_, best)) => {
                assert!(exact && !stages.empty(), "problem {k} unsolved");
                solved += 1;
                let off = stages.exact_answer().iter().zip(best.iter()).map(|(a, b)| (a - b).abs());
                let off = off.fold(0.0, f64::max);
                assert!(off < 1e-7, "problem {k}: {off:e}");
            }
        }
    }
    assert!(solved > 150 && empty > 20, "{solved} {empty}");
}

/// What cannot be obeyed is said not to be, at every size and within the bound on steps.
#[test]
fn what_is_empty_is_found_empty() {
    let (mut random, mut shown) = (Random(13), 0);
    for _ in 0..400 {
        let kind = shapes(&mut random);
        let kind = Kind { m: kind.m.max(1), ..kind };
        let p = random_problem(kind, true, &mut random);
        let mut stages = CoupledStages::new(&p).unwrap();
        stages.put(&p);
        assert!(!stages.exact());
        shown += usize::from(stages.empty());
        assert!(stages.exact_iterations() <= bound(kind));
    }
    println!("{shown} of 400 shown to be empty");
    assert!(shown >= 390, "{shown}"); // Clarabel has the word in the others
}

/// Along a path of problems, as in closed loop and with jumps and empty ones between, the stage that starts from its last active
/// set gives the bits of one that starts from nothing.
#[test]
fn a_warm_start_changes_no_bit() {
    let mut random = Random(14);
    let (mut same, mut steps) = (0, [0u64; 2]);
    for path in 0..150 {
        let kind = Kind { n: 1 + path % 14, m: path % 17, soft: 0.2, equal: 0.05, degenerate: path % 3 == 0 };
        let mut p = random_problem(kind, false, &mut random);
        let (mut warm, mut cold) = (CoupledStages::new(&p).unwrap(), CoupledStages::new(&p).unwrap());
        for tick in 0..60 {
            let jump = if tick % 10 == 9 { 1.0 } else { 0.01 };
            let move_ = |x: &mut f64, random: &mut Random| *x += jump * random.between(-1.0, 1.0);
            p.goal.iter_mut().for_each(|x| move_(x, &mut random));
            if tick % 4 == 0 {
                p.rows.iter_mut().for_each(|x| *x += 0.1 * jump * random.between(-1.0, 1.0));
            }
            if tick % 7 == 0 && kind.m > 0 && !p.equality[0] {
                p.row_lower[0] -= 0.1; // may empty it or make room
                p.row_upper[0] = (p.row_upper[0] - 0.05).max(p.row_lower[0]);
            }
            warm.put(&p);
            cold.put(&p);
            cold.forget();
            let found = (warm.exact(), cold.exact());
            assert_eq!(found.0, found.1, "path {path} tick {tick}");
            assert!(!(found.0 && (warm.empty() || cold.empty())));
            steps[0] += u64::from(warm.exact_iterations());
            steps[1] += u64::from(cold.exact_iterations());
            if found.0 {
                same += 1;
                let bits = |x: &[f64]| x.iter().map(|x| x.to_bits()).collect::<Vec<u64>>();
                assert_eq!(bits(warm.exact_answer()), bits(cold.exact_answer()), "path {path} tick {tick}");
                let (a, b) = (warm.multipliers(), cold.multipliers());
                assert_eq!((bits(a.0), bits(a.1)), (bits(b.0), bits(b.1)), "path {path} tick {tick}");
            }
        }
    }
    println!("{same} answers with the same bits in {} steps warm, {} cold", steps[0], steps[1]);
    assert!(same > 4000 && steps[0] < steps[1]);
}
