//! The vector-Jacobian product against central differences.

use crate::common::*;
use nearl_constraints::*;

/// Largest error of the product for random cotangents over random ticks, relative to the largest entry, and the number of
/// ticks by status that were compared; ticks in which the active set changes within the step are left out.
fn compare(projector: &mut Projector, size: f64, seed: u64) -> (f64, usize, usize) {
    let mut random = Random(seed);
    let n = projector.model().nv();
    let (mut worst, mut compared, mut solved) = (0.0f64, 0, 0);
    let mut target = Target::new(projector.model());
    for _ in 0..400 {
        let (q, v) = inner_state(projector, &mut random);
        let raw = proposal(projector, &q, &v, size, &mut random);
        let p = Period::new(projector.settings().dt, projector.settings().sub_steps);
        let gap = |i: usize| raw.q[i] - q[i] - p.dt * v[i] - p.kappa * p.dt * (raw.v[i] - v[i]);
        if (0..n).any(|i| gap(i).abs() < 1e-8) {
            continue; // position and velocity that belong together but for rounding are taken to
        }
        let status = projector.project(&q, &v, &raw, &mut target);
        let kinds: Vec<_> = target.ledger.active.iter().map(|r| (r.row, r.side as u8)).collect();
        let (dq, dv): (Vec<f64>, Vec<f64>) =
            (0..n).map(|_| (random.between(-1.0, 1.0), random.between(-1.0, 1.0))).unzip();
        let (mut gq, mut gv) = (vec![0.0; n], vec![0.0; n]);
        projector.vjp(&dq, &dv, &mut gq, &mut gv);
        let mut numeric = vec![];
        let mut same = status != Status::Recovering;
        for k in 0..2 * n {
            let step = if k < n { 1e-7 } else { 1e-6 };
            let mut value = |sign: f64| {
                let mut moved = raw.clone();
                if k < n {
                    moved.q[k] += sign * step
                } else {
                    moved.v[k - n] += sign * step
                }
                projector.project(&q, &v, &moved, &mut target);
                same &=
                    kinds == target.ledger.active.iter().map(|r| (r.row, r.side as u8)).collect::<Vec<_>>();
                let along: f64 = (0..n).map(|i| dq[i] * target.q[i] + dv[i] * target.v[i]).sum();
                along
            };
            numeric.push((value(1.0) - value(-1.0)) / (2.0 * step));
        }
        if !same {
            continue;
        }
        compared += 1;
        solved += usize::from(status == Status::Solved);
        let analytic: Vec<f64> = gq.into_iter().chain(gv).collect();
        for half in [0..n, n..2 * n] {
            let largest = half.clone().fold(1e-3, |m: f64, k| m.max(numeric[k].abs()).max(analytic[k].abs()));
            for k in half {
                let error = (analytic[k] - numeric[k]).abs() / largest;
                worst = worst.max(error);
            }
        }
    }
    (worst, compared, solved)
}

#[test]
fn the_product_is_the_derivative() {
    for (name, torque, settings, size) in [
        ("box", None, Settings::new(0.001, 1), 1.5),
        ("torque rows", Some(0.15), Settings::new(0.001, 1), 1.5),
        (
            "weights",
            Some(0.4),
            Settings {
                velocity_weight: Some(vec![1.0, 2.0, 0.5, 1.5, 1.0, 0.7, 3.0]),
                ..Settings::new(0.002, 0)
            },
            1.5,
        ),
        ("free", None, Settings { consistency: Consistency::Free, ..Settings::new(0.001, 1) }, 1.5),
    ] {
        // The derivative is of the nearest allowed state, which a stored brake may hold back.
        let mut projector = panda_projector(torque, Settings { braking: Braking::Certified, ..settings });
        let (worst, compared, solved) = compare(&mut projector, size, 3);
        println!("{name:12} {compared} ticks, {solved} solved, largest relative error {worst:.1e}");
        assert!(
            compared > 100 && (torque.is_none() || solved > 50) && worst < 2e-4,
            "{name}: {worst:e} over {compared}"
        );
    }
}

#[test]
fn joints_that_are_not_controlled_move_the_rows() {
    let limits = panda_limits(Some(0.12));
    let settings = Settings::new(0.001, 1);
    let mut projector = Projector::new(&panda(), &limits, &[0, 1, 3], settings).unwrap();
    let (q, v) = (vec![0.1, -0.4, 0.2, -1.8, 0.1, 1.9, 0.3], vec![0.0; 7]);
    let mut raw = Proposal { q: q.clone(), v: vec![0.004; 7] };
    raw.v[1] = -0.007;
    let mut target = Target::new(projector.model());
    let status = projector.project(&q, &v, &raw, &mut target);
    assert_eq!(status, Status::Solved, "{:?}", target.ledger);
    let (mut gq, mut gv) = (vec![0.0; 7], vec![0.0; 7]);
    projector.vjp(&[0.0; 7], &[1.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0], &mut gq, &mut gv);
    for j in [2, 4, 5, 6] {
        let mut value = |sign: f64| {
            let mut moved = raw.clone();
            moved.v[j] += sign * 1e-7;
            projector.project(&q, &v, &moved, &mut target);
            target.v[0] + target.v[1] + target.v[3]
        };
        let numeric = (value(1.0) - value(-1.0)) / 2e-7;
        assert!((numeric - gv[j]).abs() < 1e-5, "joint {j}: {numeric} {}", gv[j]);
    }
    assert!(gv[5].abs() > 1e-3, "{gv:?}");
}
