//! A tick allocates nothing, except one buffer inside each Clarabel solve.

use crate::common::*;
use crate::counting;
use nearl_constraints::*;

/// Ticks by rung, allocations by rung.
fn count(projector: &mut Projector, size: f64) -> ([usize; 6], [usize; 6]) {
    let (mut random, mut target) = (Random(1), Target::new(projector.model()));
    let (mut ticks, mut allocations) = ([0; 6], [0; 6]);
    for _ in 0..2000 {
        let (q, v) = inner_state(projector, &mut random);
        let raw = proposal(projector, &q, &v, size, &mut random);
        let before = counting::allocations();
        projector.project(&q, &v, &raw, &mut target);
        let rung = target.ledger.rung as usize;
        ticks[rung] += 1;
        allocations[rung] += counting::allocations() - before;
    }
    (ticks, allocations)
}

#[test]
fn ticks_do_not_allocate() {
    let settings = |solver| Settings { solver, ..Settings::new(0.001, 1) };
    for (torque, solver, size) in
        [(None, Solver::Ladder, 3.0), (Some(0.8), Solver::Ladder, 3.0), (Some(0.8), Solver::Clarabel, 3.0)]
    {
        let mut projector = panda_projector(torque, settings(solver));
        let (ticks, allocations) = count(&mut projector, size);
        println!("{torque:?} {solver:?}: ticks {ticks:?}, allocations {allocations:?}");
        let [closed, exact, clarabel, ..] = allocations;
        assert_eq!((closed, exact), (0, 0));
        assert!(clarabel <= ticks[Rung::Clarabel as usize], "{clarabel}");
    }
    let free = Settings { consistency: Consistency::Free, ..settings(Solver::Ladder) };
    assert_eq!(count(&mut panda_projector(None, free), 3.0).1, [0; 6]);
    frames(settings(Solver::Ladder));
}

/// Rows of frames and solids allocate nothing either. Where they contradict the joints' limits, Clarabel is asked in vain, which costs
/// a few more buffers.
fn frames(settings: Settings) {
    let low = FrameLimit::half_space("panda_hand", [0.0, 0.0, -1.0], [0.0, 0.0, 0.1], 2.0);
    let mut limits = panda_limits(None);
    limits.push(Box::new(low));
    limits.push(Box::new(solids::panda_collision(12, 0.3)));
    let mut projector = Projector::new(&panda(), &limits, &[0, 1, 2, 3, 4, 5, 6], settings.clone()).unwrap();
    let (ticks, allocations) = count(&mut projector, 3.0);
    println!("frames and solids: ticks {ticks:?}, allocations {allocations:?}");
    assert!(ticks[Rung::ActiveSet as usize] > 200 && allocations[..2] == [0, 0]);
    assert!(allocations[2..].iter().zip(&ticks[2..]).all(|(a, t)| *a <= 8 * t));
    let mut limits = panda_limits(None);
    limits.push(Box::new(FrameSpeedLimit::of("panda_hand", 1.0)));
    limits.push(Box::new(EnergyLimit::of(2.5)));
    let mut projector =
        Projector::new(&panda(), &limits, &[0, 1, 2, 3, 4, 5, 6], Settings { dt: 0.005, ..settings })
            .unwrap();
    let (ticks, allocations) = count(&mut projector, 3.0);
    println!("speed and energy: ticks {ticks:?}, allocations {allocations:?}");
    assert!(ticks[Rung::Clarabel as usize] > 20 && allocations[..2] == [0, 0]);
    assert!(allocations[2..].iter().zip(&ticks[2..]).all(|(a, t)| *a <= 8 * t));
}
