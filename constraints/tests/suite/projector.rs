//! The projector against brute force, and its invariants.

use crate::common::*;
use nalgebra::{DMatrix, DVector};
use nearl_constraints::*;

fn settings() -> Settings {
    Settings::new(0.001, 1)
}

fn bits(x: &[f64]) -> Vec<u64> {
    x.iter().map(|x| x.to_bits()).collect()
}

fn same_bits(a: &Target, b: &Target) -> bool {
    bits(&a.q) == bits(&b.q) && bits(&a.v) == bits(&b.v) && bits(&a.acceleration) == bits(&b.acceleration)
}

/// Best point over all choices of active rows of `min 1/2 y'H y + c'y, G y <= h`, each solved as linear equations.
fn brute_force(p: &Problem) -> DVector<f64> {
    let (n, m) = (p.dofs.len(), p.h.len());
    let h = DMatrix::from_row_slice(n, n, &p.hessian);
    let (c, g) = (DVector::from_row_slice(&p.c), DMatrix::from_row_slice(m, n, &p.g));
    let mut best: Option<(f64, DVector<f64>)> = None;
    for mask in 0u32..1 << m {
        let active: Vec<usize> = (0..m).filter(|r| mask >> r & 1 == 1).collect();
        if active.len() > n {
            continue;
        }
        let k = active.len();
        let mut kkt = DMatrix::zeros(n + k, n + k);
        kkt.view_mut((0, 0), (n, n)).copy_from(&h);
        let mut rhs = DVector::zeros(n + k);
        rhs.rows_mut(0, n).copy_from(&-&c);
        for (a, r) in active.iter().enumerate() {
            kkt.view_mut((n + a, 0), (1, n)).copy_from(&g.row(*r));
            kkt.view_mut((0, n + a), (n, 1)).copy_from(&g.row(*r).transpose());
            rhs[n + a] = p.h[*r];
        }
        let Some(y) = kkt.full_piv_lu().solve(&rhs).map(|x| x.rows(0, n).into_owned()) else { continue };
        let size = |r: usize| 1.0 + p.h[r].abs();
        if y.iter().all(|x| x.is_finite()) && (0..m).all(|r| (g.row(r) * &y)[0] <= p.h[r] + 1e-9 * size(r)) {
            let cost = 0.5 * y.dot(&(&h * &y)) + c.dot(&y);
            if best.as_ref().is_none_or(|(least, _)| cost < *least) {
                best = Some((cost, y));
            }
        }
    }
    best.expect("a feasible point").1
}

/// Three joints of the Panda under torque limits low enough to bind.
fn three_joints(solver: Solver, seed: u64, mut check: impl FnMut(&Projector, &Target, &[f64])) -> usize {
    let model = panda();
    let mut limits = panda_limits(Some(0.5));
    limits[2] = Box::new(AccelerationLimit::uniform(40.0));
    let weight = vec![1.0, 2.0, 0.5, 1.5, 1.0, 1.0, 3.0];
    let settings = Settings { solver, velocity_weight: Some(weight), ..settings() };
    let mut projector = Projector::new(&model, &limits, &[1, 3, 5], settings).unwrap();
    let (mut random, mut solved) = (Random(seed), 0);
    let mut target = Target::new(&model);
    for _ in 0..300 {
        let (mut q, mut v) = (model.neutral(), vec![0.0; 7]);
        for i in [1, 3, 5] {
            let (low, high) = (projector.limits().q_lower[i], projector.limits().q_upper[i]);
            q[i] = random.between(low + 0.3, high - 0.3);
            v[i] = random.between(-0.5, 0.5);
        }
        let mut proposal = Proposal { q: q.clone(), v: v.clone() };
        for i in [1, 3, 5] {
            proposal.v[i] += random.between(-0.05, 0.05);
            proposal.q[i] += 0.001 * proposal.v[i] + random.between(-1e-5, 1e-5);
        }
        if projector.project(&q, &v, &proposal, &mut target) == Status::Solved {
            solved += 1;
            check(&projector, &target, &v);
        }
    }
    solved
}

fn furthest_from_brute_force(solver: Solver) -> (usize, f64) {
    let mut furthest = 0.0f64;
    let solved = three_joints(solver, 1, |projector, target, v| {
        let best = brute_force(&projector.problem().unwrap());
        for (k, i) in [1, 3, 5].into_iter().enumerate() {
            furthest = furthest.max((target.v[i] - v[i] - best[k]).abs());
        }
    });
    (solved, furthest)
}

#[test]
fn the_ladder_finds_what_brute_force_finds() {
    let (solved, furthest) = furthest_from_brute_force(Solver::Ladder);
    println!("{solved} solved, furthest {furthest:.1e} rad/s");
    assert!(solved > 100 && furthest < 1e-9, "{solved} {furthest:e}");
}

#[test]
fn clarabel_finds_what_brute_force_finds() {
    let (solved, furthest) = furthest_from_brute_force(Solver::Clarabel);
    println!("{solved} solved, furthest {furthest:.1e} rad/s");
    assert!(solved > 100 && furthest < 1e-6, "{solved} {furthest:e}");
}

/// Without coupled rows: more candidates, closed form against enumeration over the box.
#[test]
fn multipliers_are_nonnegative_and_stationary() {
    three_joints(Solver::Ladder, 9, |_, target, _| {
        assert_eq!(target.ledger.rung, Rung::ActiveSet);
        assert!(target.ledger.residual < 1e-9, "{:?}", target.ledger);
        assert!(target.ledger.active.iter().any(|row| row.kind == Kind::Torque));
        assert!(target.ledger.active.iter().all(|row| row.multiplier >= 0.0));
    });
}

#[test]
fn feasible_proposals_pass_bit_for_bit() {
    for torque in [None, Some(1.0)] {
        let mut projector = panda_projector(torque, settings());
        let (mut random, mut target) = (Random(2), Target::new(projector.model()));
        for _ in 0..2000 {
            let (q, v) = inner_state(&projector, &mut random);
            let y: Vec<f64> =
                (0..7).map(|i| 0.9 * PANDA_BRAKING[i] * 0.001 * random.between(-1.0, 1.0)).collect();
            let proposal = consistent(&projector, &q, &v, &y);
            assert_eq!(projector.project(&q, &v, &proposal, &mut target), Status::Unchanged);
            assert_eq!((bits(&target.q), bits(&target.v)), (bits(&proposal.q), bits(&proposal.v)));
            assert!(target.ledger.active.is_empty() && target.ledger.moved == 0.0);
            assert_eq!(target.ledger.raw_violations.total(), 0);
        }
    }
}

#[test]
fn projecting_twice_changes_nothing() {
    for (torque, sub_steps) in [(None, 0), (None, 5), (Some(0.6), 1)] {
        let mut projector = panda_projector(torque, Settings::new(0.001, sub_steps));
        let (mut random, mut first) = (Random(3), Target::new(projector.model()));
        let (mut second, mut clamped) = (first.clone(), 0);
        for _ in 0..2000 {
            let (q, v) = inner_state(&projector, &mut random);
            let size = 10f64.powf(random.between(-1.0, 4.0));
            let raw = proposal(&projector, &q, &v, size, &mut random);
            if !projector.project(&q, &v, &raw, &mut first).is_ok() {
                continue; // torque limits below what holds the arm up
            }
            clamped += 1;
            let again = Proposal { q: first.q.clone(), v: first.v.clone() };
            assert_eq!(
                projector.project(&q, &v, &again, &mut second),
                Status::Unchanged,
                "{:?}",
                first.ledger
            );
            assert!(same_bits(&first, &second));
        }
        assert!(clamped > 500, "{clamped}");
    }
}

/// `|P(a) - P(b)| <= |a - b|` in the weighted metric of position (over kappa T) and velocity.
#[test]
fn projection_does_not_expand_distances() {
    let mut projector = panda_projector(Some(0.8), settings());
    let (mut random, mut one) = (Random(4), Target::new(projector.model()));
    let mut two = one.clone();
    let distance = |a: (&[f64], &[f64]), b: (&[f64], &[f64])| -> f64 {
        (0..7).map(|i| ((a.0[i] - b.0[i]) / 0.001).powi(2) + (a.1[i] - b.1[i]).powi(2)).sum::<f64>().sqrt()
    };
    let mut compared = 0;
    for _ in 0..3000 {
        let (q, v) = inner_state(&projector, &mut random);
        let (a, b) =
            (proposal(&projector, &q, &v, 2.0, &mut random), proposal(&projector, &q, &v, 2.0, &mut random));
        let ok =
            projector.project(&q, &v, &a, &mut one).is_ok() & projector.project(&q, &v, &b, &mut two).is_ok();
        if ok {
            compared += 1;
            let (before, after) =
                (distance((&a.q, &a.v), (&b.q, &b.v)), distance((&one.q, &one.v), (&two.q, &two.v)));
            assert!(after <= before * (1.0 + 1e-9) + 1e-9, "{after} > {before}");
        }
    }
    assert!(compared > 1000);
}

#[test]
fn no_input_makes_the_output_infinite() {
    let odd = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300, -1e300, 1e-310, 0.0];
    for (torque, consistency) in
        [(None, Consistency::Kinematic), (Some(1.0), Consistency::Kinematic), (None, Consistency::Free)]
    {
        let mut projector = panda_projector(torque, Settings { consistency, ..settings() });
        let (mut random, mut target) = (Random(5), Target::new(projector.model()));
        for k in 0..4000 {
            let (mut q, mut v) = inner_state(&projector, &mut random);
            let mut raw = proposal(&projector, &q, &v, 2.0, &mut random);
            let pick = |random: &mut Random| odd[(random.next() * odd.len() as f64) as usize];
            let at = (random.next() * 7.0) as usize;
            match k % 4 {
                0 => raw.q[at] = pick(&mut random),
                1 => raw.v[at] = pick(&mut random),
                2 => q[at] = pick(&mut random),
                _ => v[at] = pick(&mut random),
            }
            let status = projector.project(&q, &v, &raw, &mut target);
            let finite = |x: &[f64]| x.iter().all(|x| x.is_finite());
            if finite(&q) && finite(&v) && q.iter().chain(&v).all(|x| x.abs() < 1e299) {
                assert!(finite(&target.q) && finite(&target.v) && finite(&target.acceleration), "{status:?}");
            }
            match (finite(&q) && finite(&v), finite(&raw.q) && finite(&raw.v)) {
                (false, _) => assert_eq!(status, Status::Refused(RefuseReason::NonFiniteState)),
                (true, false) => assert_eq!(status, Status::Braked(BrakeReason::NonFiniteProposal)),
                _ => {}
            }
            assert!(
                finite(&target.q) && finite(&target.v) && finite(&target.acceleration),
                "{status:?} {q:?} {v:?}"
            );
            // Joints whose position is known stay there.
            let known = q.iter().zip(&target.q).filter(|(q, _)| q.is_finite());
            assert!(!matches!(status, Status::Refused(_)) || known.clone().all(|(q, to)| q == to), "{q:?}");
        }
    }
}

#[test]
fn wrong_lengths_are_refused() {
    let mut projector = panda_projector(None, settings());
    let mut target = Target::new(projector.model());
    let raw = Proposal::new(projector.model());
    let status = projector.project(&[0.0; 6], &[0.0; 7], &raw, &mut target);
    assert_eq!(status, Status::Refused(RefuseReason::WrongLength));
}

/// The same input gives the same bits after anything finite or not.
#[test]
fn history_leaves_no_trace() {
    for solver in [Solver::Ladder, Solver::Clarabel] {
        let alone = Settings { solver, braking: Braking::Certified, ..settings() };
        let fresh = || panda_projector(Some(0.6), alone.clone());
        let (mut used, mut random) = (fresh(), Random(6));
        let mut target = Target::new(used.model());
        for k in 0..40 {
            for _ in 0..20 {
                let (mut q, v) = inner_state(&used, &mut random);
                let mut raw = proposal(&used, &q, &v, 10f64.powf(random.between(-1.0, 6.0)), &mut random);
                if random.next() < 0.2 {
                    raw.v[k % 7] = f64::NAN;
                }
                if random.next() < 0.1 {
                    q[k % 7] = f64::INFINITY;
                }
                used.project(&q, &v, &raw, &mut target);
            }
            let (q, v) = inner_state(&used, &mut random);
            let raw = proposal(&used, &q, &v, 3.0, &mut random);
            let mut expected = target.clone();
            let status = fresh().project(&q, &v, &raw, &mut expected);
            assert_eq!(used.project(&q, &v, &raw, &mut target), status);
            assert!(same_bits(&target, &expected), "{solver:?} {status:?}");
        }
    }
}

/// 1e5 periods of an adversary in closed loop: nothing is ever empty, nothing is ever violated, and the torque rows do
/// hold proposals back.
#[test]
fn the_panda_stays_inside_everything() {
    for (sub_steps, torque) in [(1, 1.0), (0, 0.92), (5, 1.0)] {
        let mut projector = panda_projector(Some(torque), Settings::new(0.001, sub_steps));
        let (mut random, mut target) = (Random(7), Target::new(projector.model()));
        let (mut q, mut v) = (vec![0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], vec![0.0; 7]);
        let mut side = [1.0f64; 7];
        let (mut raw_violations, mut solved, mut clarabel) = (Counts::default(), 0, 0);
        for step in 0..100_000 {
            for s in &mut side {
                if random.next() < 0.003 {
                    *s = if random.next() < 0.5 { -1.0 } else { 1.0 };
                }
            }
            let y: Vec<f64> = (0..7).map(|i| side[i] * random.between(0.0, 0.05)).collect();
            let raw = consistent(&projector, &q, &v, &y);
            let status = projector.project(&q, &v, &raw, &mut target);
            let l = &target.ledger;
            assert!(
                matches!(status, Status::Unchanged | Status::Clamped | Status::Solved),
                "step {step}: {l:?} {q:?} {v:?}"
            );
            assert_eq!((l.target_violations.total(), l.outside.len()), (0, 0), "step {step}: {l:?}");
            (raw_violations.torque, raw_violations.position) = (
                raw_violations.torque + l.raw_violations.torque,
                raw_violations.position + l.raw_violations.position,
            );
            raw_violations.viability += l.raw_violations.viability;
            solved += usize::from(status == Status::Solved);
            clarabel += usize::from(l.rung == Rung::Clarabel);
            q.copy_from_slice(&target.q);
            v.copy_from_slice(&target.v);
        }
        println!(
            "n {sub_steps}, torque {torque}: {solved} solved, {clarabel} by Clarabel, raw {raw_violations:?}"
        );
        assert!(solved > 100, "torque rows never bound: {solved}");
    }
}

/// From any state met on the way, pushing for standstill stops inside the limits.
#[test]
fn braking_from_any_admissible_state_stops_inside() {
    let mut projector = panda_projector(Some(1.0), settings());
    let (mut random, mut target) = (Random(8), Target::new(projector.model()));
    let (mut q, mut v) = (vec![0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], vec![0.0; 7]);
    for _ in 0..60 {
        let side: Vec<f64> = (0..7).map(|_| random.between(-1.0, 1.0).signum()).collect();
        for _ in 0..random.between(1.0, 400.0) as usize {
            let raw = consistent(&projector, &q, &v, &side);
            projector.project(&q, &v, &raw, &mut target);
            (q, v) = (target.q.clone(), target.v.clone());
        }
        let nothing = Proposal { q: vec![f64::NAN; 7], v: vec![f64::NAN; 7] };
        let (mut qb, mut vb) = (q.clone(), v.clone());
        for _ in 0..1500 {
            let status = projector.project(&qb, &vb, &nothing, &mut target);
            assert_eq!(status, Status::Braked(BrakeReason::NonFiniteProposal));
            assert_eq!(target.ledger.target_violations.total(), 0, "{:?}", target.ledger);
            (qb, vb) = (target.q.clone(), target.v.clone());
        }
        assert!(vb.iter().all(|v| v.abs() < 1e-9), "{vb:?}");
    }
}

#[test]
fn outside_its_limits_a_joint_may_only_return() {
    let mut projector = panda_projector(Some(1.0), settings());
    let mut target = Target::new(projector.model());
    let (mut q, mut v) = (vec![0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], vec![0.0; 7]);
    q[0] = 2.8973 + 0.05;
    let mut returned = None;
    for step in 0..5000 {
        let raw = consistent(&projector, &q, &v, &[if step < 100 { 1.0 } else { -1.0 }; 7]);
        let status = projector.project(&q, &v, &raw, &mut target);
        assert!(target.v[0] <= 0.0 || q[0] <= 2.8973, "step {step}: {:?}", target.ledger);
        assert!(target.acceleration[0].abs() <= 15.0 + 1e-9);
        match q[0] > 2.8973 + 1e-9 {
            true => assert_eq!((status, &target.ledger.outside[..]), (Status::Recovering, &[0][..])),
            false => returned = returned.or(Some(step)),
        }
        (q, v) = (target.q.clone(), target.v.clone());
        if returned.is_some() {
            return;
        }
    }
    panic!("it never came back: {}", q[0]);
}

#[test]
fn free_mode_clamps_position_and_velocity_apart() {
    let model = robot("gymnasium/half_cheetah.xml");
    let limits: Vec<Box<dyn Limit>> =
        vec![Box::new(PositionLimit::with_margin(0.05)), Box::new(VelocityLimit::values(PerJoint::All(8.0)))];
    let settings = Settings { consistency: Consistency::Free, ..Settings::new(0.05, 5) };
    let mut projector = Projector::new(&model, &limits, &[3, 4, 5, 6, 7, 8], settings).unwrap();
    let mut target = Target::new(&model);
    let (q, v) = (vec![0.0; 9], vec![0.0; 9]);
    let mut raw = Proposal::new(&model);
    (raw.q[0], raw.v[0]) = (7.25, -3.0); // not controllable: passes
    (raw.q[3], raw.v[3]) = (0.2, 1.5); // inside: passes
    (raw.q[4], raw.v[4]) = (0.3, 11.0); // too fast
    raw.q[5] = -0.39; // within 0.05 of the lower limit -0.4, and reachable: 0.05 s at 8 rad/s and 0.6 of it
    let status = projector.project(&q, &v, &raw, &mut target);
    assert_eq!(status, Status::Clamped);
    assert_eq!((target.q[0], target.v[0], target.q[3], target.v[3]), (7.25, -3.0, 0.2, 1.5));
    assert!(target.v[4] == 8.0 && (target.q[5] + 0.24).abs() < 1e-12, "{target:?}");
    assert_eq!((projector.bounds().v_upper[4], projector.bounds().q_lower[5]), (8.0, target.q[5]));
    let kinds: Vec<Kind> = target.ledger.active.iter().map(|row| row.kind).collect();
    assert_eq!(kinds, [Kind::Velocity, Kind::Velocity, Kind::Velocity]);
    assert_eq!(target.ledger.raw_violations, Counts { velocity: 1, position: 1, ..Counts::default() });
    raw.v[4] = 0.0;
    (raw.q[4], raw.q[5]) = (0.0, 0.0);
    assert_eq!(projector.project(&q, &v, &raw, &mut target), Status::Unchanged);
    assert_eq!((bits(&target.q), bits(&target.v)), (bits(&raw.q), bits(&raw.v)));
}

/// Without an acceleration limit too: what begins outside is named, and its target is the nearest position to the limit that its speed reaches.
#[test]
fn free_mode_names_what_begins_outside_and_brings_it_back() {
    let model = robot("gymnasium/half_cheetah.xml");
    let limits: Vec<Box<dyn Limit>> =
        vec![Box::new(PositionLimit::default()), Box::new(VelocityLimit::values(PerJoint::All(2.0)))];
    let settings = Settings { consistency: Consistency::Free, ..Settings::new(0.01, 1) };
    let mut projector = Projector::new(&model, &limits, &[3, 4, 5, 6, 7, 8], settings).unwrap();
    let (mut target, raw, v) = (Target::new(&model), Proposal::new(&model), vec![0.0; 9]);
    let (low, high) = (model.lower_position_limit()[5], model.upper_position_limit()[5]);
    // A period reaches 0.02 rad, and the proposal is 0, inside of the range.
    for (at, to) in [
        (high + 0.005, high - 0.015),
        (high + 0.03, high + 0.01),
        (low - 0.005, low + 0.015),
        (low - 0.5, low - 0.48),
    ] {
        let mut q = vec![0.0; 9];
        q[5] = at;
        let status = projector.project(&q, &v, &raw, &mut target);
        assert_eq!((status, &target.ledger.outside[..]), (Status::Recovering, &[5][..]), "at {at}");
        assert!((target.q[5] - to).abs() < 1e-12, "at {at}: {target:?}");
    }
}

/// A floating base passes through, its legs are projected; the base enters the torque rows as it was proposed.
#[test]
fn a_floating_base_passes_through() {
    let model = robot("gymnasium/ant.xml");
    let legs: Vec<usize> = (6..14).collect();
    let limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::values(PerJoint::All(6.0))),
        Box::new(AccelerationLimit::uniform(100.0)),
        Box::new(TorqueLimit::scaled(0.05)),
    ];
    let mut projector = Projector::new(&model, &limits, &legs, Settings::new(0.01, 0)).unwrap();
    let (mut random, mut target, mut solved) = (Random(9), Target::new(&model), 0);
    for _ in 0..200 {
        let mut q = model.neutral();
        for i in 7..15 {
            let (low, high) = (model.lower_position_limit()[i], model.upper_position_limit()[i]);
            q[i] = 0.5 * (low + high) + random.between(-0.1, 0.1);
        }
        let v: Vec<f64> = (0..14).map(|_| random.between(-0.2, 0.2)).collect();
        let mut raw = Proposal { q: q.clone(), v: v.clone() };
        (raw.q[0], raw.v[2]) = (random.next(), v[2] + 0.02 * random.next());
        for i in 6..14 {
            raw.v[i] += random.between(-1.0, 1.0);
        }
        let status = projector.project(&q, &v, &raw, &mut target);
        assert!(status.is_ok(), "{:?}", target.ledger);
        assert_eq!((bits(&target.q[..7]), bits(&target.v[..6])), (bits(&raw.q[..7]), bits(&raw.v[..6])));
        assert_eq!(target.ledger.target_violations.total(), 0);
        solved += usize::from(status == Status::Solved);
    }
    println!("{solved} solved");
    assert!(solved > 20);
}

/// Joints with a rotation: the target is reached by integrating on the manifold, and projecting twice changes nothing.
#[test]
fn rotations_are_integrated() {
    let model = robot("gymnasium/ant.xml");
    let all: Vec<usize> = (0..14).collect();
    let limits: Vec<Box<dyn Limit>> =
        vec![Box::new(VelocityLimit::values(PerJoint::All(3.0))), Box::new(AccelerationLimit::uniform(50.0))];
    let mut projector = Projector::new(&model, &limits, &all, Settings::new(0.01, 0)).unwrap();
    let (mut random, mut target, mut dynamics) = (Random(11), Target::new(&model), Dynamics::new(&model));
    let mut second = target.clone();
    for _ in 0..500 {
        let numbers = |random: &mut Random, size: f64| -> Vec<f64> {
            (0..14).map(|_| random.between(-size, size)).collect()
        };
        let (mut q, mut raw) = (model.neutral(), Proposal::new(&model));
        dynamics.integrate(&model.neutral(), &numbers(&mut random, 1.0), &mut q);
        let v = numbers(&mut random, 2.5);
        dynamics.integrate(&q, &numbers(&mut random, 0.05), &mut raw.q);
        raw.v.copy_from_slice(&numbers(&mut random, 4.0));
        assert_eq!(projector.project(&q, &v, &raw, &mut target), Status::Clamped);
        let mut moved = vec![0.0; 14];
        dynamics.difference(&q, &target.q, &mut moved);
        for i in 0..14 {
            let expected = 0.01 * v[i] + 0.5 * 0.01 * (target.v[i] - v[i]);
            assert!(
                (moved[i] - expected).abs() < 1e-12 && target.v[i].abs() <= 3.0,
                "{i}: {} {expected}",
                moved[i]
            );
            assert!(target.acceleration[i].abs() <= 50.0 + 1e-9);
        }
        let again = Proposal { q: target.q.clone(), v: target.v.clone() };
        assert_eq!(projector.project(&q, &v, &again, &mut second), Status::Unchanged);
        assert!(same_bits(&target, &second));
    }
}

/// Models and projectors move between threads.
#[test]
fn projectors_are_send() {
    fn send<T: Send>() {}
    fn sync<T: Send + Sync>() {}
    send::<Projector>();
    sync::<Model>();
    sync::<Target>();
}

#[test]
fn both_solvers_agree() {
    let mut ladder = panda_projector(Some(0.7), settings());
    let mut clarabel = panda_projector(Some(0.7), Settings { solver: Solver::Clarabel, ..settings() });
    let (mut random, mut a) = (Random(10), Target::new(ladder.model()));
    let (mut b, mut both, mut furthest) = (a.clone(), 0, 0.0f64);
    for _ in 0..2000 {
        let (q, v) = inner_state(&ladder, &mut random);
        let raw = proposal(&ladder, &q, &v, 1.5, &mut random);
        let (one, two) = (ladder.project(&q, &v, &raw, &mut a), clarabel.project(&q, &v, &raw, &mut b));
        assert_eq!(one.is_ok(), two.is_ok(), "{:?}\n{:?}", a.ledger, b.ledger);
        if one == Status::Solved {
            both += 1;
            furthest = (0..7).fold(furthest, |m, i| m.max((a.v[i] - b.v[i]).abs()));
        }
    }
    println!("{both} solved, furthest {furthest:.1e} rad/s");
    assert!(both > 100 && furthest < 1e-6, "{both} {furthest:e}");
}

/// A tick that is projected once more begins as the tick did, whatever the first time stored, and ends between the ends that are known by then, as near to the
/// proposal as the rows allow.
#[test]
fn a_tick_is_projected_once_more_within_ends() {
    let limits = || {
        let mut limits = panda_limits(None);
        limits.push(Box::new(FrameSpeedLimit::of("panda_hand", 0.4)));
        limits
    };
    let new = || Projector::new(&panda(), &limits(), &[0, 1, 2, 3, 4, 5, 6], settings()).unwrap();
    let (mut twice, mut once, mut random) = (new(), new(), Random(11));
    assert!(twice.needs_what_is_reached() && !panda_projector(Some(0.6), settings()).needs_what_is_reached());
    let (mut first, mut second, mut alone) =
        (Target::new(twice.model()), Target::new(twice.model()), Target::new(twice.model()));
    let (mut q, mut v) = (vec![0.0, -0.5, 0.0, -1.5, 0.0, 1.5, 0.0], vec![0.0; 7]);
    let mut slower = 0;
    for tick in 0..400 {
        let raw = proposal(&twice, &q, &v, 3.0, &mut random);
        twice.project(&q, &v, &raw, &mut first);
        let mut ends = [[f64::NEG_INFINITY, f64::INFINITY]; 7];
        let joint = tick % 7;
        let bounds = twice.bounds();
        ends[joint][1] = 0.5 * (first.v[joint] + bounds.v_lower[joint]);
        let (lower, end) = (bounds.v_lower[joint], ends[joint][1]);
        let status = twice.project_within((&q, &v), &raw, &ends, &mut second);
        assert!(second.v[joint] <= end.max(lower) + 1e-12, "{tick}: {} beyond {end}", second.v[joint]);
        assert_eq!(second.ledger.target_violations.total(), 0, "{tick}: {status:?}");
        let is_slowed = status == Status::Slowed;
        assert!(
            is_slowed || matches!(status, Status::Unchanged | Status::Recovering | Status::Braked(_)),
            "{status:?}"
        );
        slower += usize::from(is_slowed && second.v[joint] < first.v[joint] - 1e-9);
        // of the same bits as without a first time
        once.project(&q, &v, &raw, &mut alone);
        assert!(same_bits(&alone, &first), "{tick}");
        once.project_within((&q, &v), &raw, &ends, &mut alone);
        assert!(same_bits(&alone, &second), "{tick}");
        assert_eq!(once.memory(), twice.memory());
        (q, v) = (second.q.clone(), second.v.clone());
    }
    assert!(slower > 200, "{slower}");
}
