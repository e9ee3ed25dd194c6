//! Faults of the projection and its solver: limits that leave no answer, a solver that is cut short or fails, states beyond what the motors can
//! brake, odd numbers.

use nearl_constraints::limit::UserRowSettings;
use nearl_constraints::{
    BrakeReason, Braking, Kind, Projector, Proposal, Rung, Settings, Soft, Solver, Status, Target,
};
use nearl_runtime::codes::LedgerStatus;
use nearl_runtime::controller::Parts;
use nearl_runtime::rt::*;
use nearl_runtime::{Manifest, Snapshot};

use super::ROUNDING;
use super::flight::{Flight, settings};
use crate::arm;
use crate::arm::*;

/// Torque limits far below what holding still needs leave nothing to choose from.
#[test]
fn torque_limits_that_leave_nothing_brake_and_name_the_status() {
    let mut weak = stochastic(1);
    weak.manifest.task.constraints.torque.as_mut().expect("the task has torque rows").scale = 0.01;
    let mut flight = Flight::new(&weak, settings(), FaultPlan::default());
    flight.fly(100);
    let ledger = flight.records[0].output.ledger;
    assert_eq!(ledger.status, LedgerStatus::BrakedNoCertifiedAnswer.number());
    assert!(ledger.target_violations > 0, "what the brake cannot keep is counted");
    assert_eq!(flight.first(Mode::Braking).unwrap().1, Reason::NoCertifiedAnswer);
    assert!(flight.panda.worst[2] <= ROUNDING, "the motors' own limits hold: {:?}", flight.panda.worst);
}

/// `velocity of joint 1 >= 0.5` beside `<= -0.5` [rad/s].
fn contradiction(soft: Option<Soft>) -> Snapshot {
    let row = |name: &str, lower, upper| UserRowSettings {
        name: name.into(),
        terms: [(format!("v.{}", arm::joint(0)), 1.0)].into(),
        lower,
        upper,
        equals: None,
        braking: None,
        soft,
        margin: 0.0,
    };
    let mut snapshot = stochastic(1);
    snapshot.manifest.task.constraints.rows =
        vec![row("left", Some(0.5), None), row("right", None, Some(-0.5))];
    snapshot
}

#[test]
fn fault_05_contradicting_soft_rows_give_way_by_name_and_hard_ones_brake() {
    let mut soft = Flight::new(&contradiction(Some(Soft::default())), settings(), FaultPlan::default());
    soft.fly(600);
    assert!(soft.records[1..].iter().all(|r| r.mode == Mode::Active), "{:?}", soft.counters());
    for record in &soft.records {
        let gave_way = |r: &&Row| Kind::ALL[r.kind as usize] == Kind::User && r.slack > 0.0;
        assert!(record.output.rows().iter().any(|r| gave_way(&r)), "the row that gave way is reported");
    }
    soft.assert_within_limits(ROUNDING);
    let mut hard = Flight::new(&contradiction(None), settings(), FaultPlan::default());
    hard.fly(100);
    let ledger = hard.records[0].output.ledger;
    assert_eq!(ledger.status, LedgerStatus::BrakedNoCertifiedAnswer.number());
    assert_eq!(hard.first(Mode::Braking).unwrap().1, Reason::NoCertifiedAnswer);
    assert!(hard.panda.worst.iter().all(|excess| *excess <= ROUNDING), "{:?}", hard.panda.worst);
    assert!(*hard.panda.speeds.last().unwrap() < 1e-2, "it stands still");
}

/// With motors of half their strength, so that torque rows are active.
fn panda_projector(change: impl FnOnce(&mut Settings)) -> (Projector, Vec<f64>) {
    let weaken = |m: &mut Manifest| m.task.constraints.torque.as_mut().expect("torque rows").scale = 0.5;
    let manifest = snapshot(1, weaken).manifest;
    let Parts { model, layout, projector } = Parts::new(&manifest).unwrap();
    let limits = nearl_constraints::build_limits(&manifest.task.constraints, &model).unwrap();
    let mut settings = projector.settings().clone();
    change(&mut settings);
    (Projector::new(&model, &limits, layout.controllable(), settings).unwrap(), Panda::new().q)
}

/// In closed loop: what was cut short is used where the checker accepts it, and braked with its own reason where not.
#[test]
fn fault_06_an_answer_cut_by_cap_or_deadline_is_used_only_if_the_checker_accepts() {
    let brake = Status::Braked(BrakeReason::NoCertifiedAnswer);
    let (mut used, mut braked) = (0, 0);
    let cuts: [fn(&mut Settings); 5] = [
        |s| s.max_iter = 1,
        |s| s.max_iter = 4,
        |s| s.max_iter = 6,
        |s| s.max_iter = 8,
        |s| s.deadline = Some(std::time::Duration::ZERO),
    ];
    for cut in cuts {
        let mut cap = 0;
        let (mut capped, start) = panda_projector(|s| {
            s.solver = Solver::Clarabel;
            s.braking = Braking::Certified; // a stored brake finds a nearer state in place of this brake
            cut(s);
            cap = s.max_iter;
        });
        let (mut q, mut v) = (start, vec![0.0; N]);
        let mut target = Target::new(capped.model());
        let mut brakes = 0;
        for k in 0..600 {
            let wish: Vec<f64> = weights(k / 50, N).iter().map(|w| 2.0 * f64::from(*w)).collect();
            let status = capped.project(&q, &v, &Proposal { q: q.clone(), v: wish }, &mut target);
            let ledger = &target.ledger;
            assert_eq!(ledger.target_violations.total(), 0, "tick {k}: {status:?}");
            used += u32::from(ledger.rung == Rung::Clarabel && ledger.iterations == cap);
            if status == brake {
                brakes += 1;
                assert_eq!(numbers(ledger).status, LedgerStatus::BrakedNoCertifiedAnswer.number());
                assert!(matches!(ledger.rung, Rung::Brake | Rung::StoredBrake), "{:?}", ledger.rung);
            }
            (q, v) = (target.q.clone(), target.v.clone());
        }
        println!("cap {cap}: {brakes} of 600 ticks braked");
        braked += brakes;
    }
    assert!(used > 0 && braked > 0, "both branches: used {used}, braked {braked}");
}

/// Speeds whose squares are no numbers, are numbers that no solver makes anything of, and are merely far too large.
#[test]
fn fault_07_a_failed_solve_leaves_the_next_one_healthy() {
    let dynamics = Status::Braked(BrakeReason::NonFiniteDynamics);
    for solver in [Solver::Ladder, Solver::Clarabel] {
        let choose = |s: &mut Settings| (s.solver, s.braking) = (solver, Braking::Certified);
        let (mut used, q) = panda_projector(choose);
        let mut target = Target::new(used.model());
        for speed in [1e200, 1e150, 1e60, 1e12] {
            let wild = Proposal { q: q.clone(), v: vec![speed; N] };
            let status = used.project(&q, &[speed; N], &wild, &mut target);
            println!("{solver:?} at {speed:e}: {status:?}");
            assert!(!status.is_ok() || status == Status::Recovering, "{speed:e}: {status:?}");
            assert!(status == dynamics || speed < 1e200, "{speed:e}: {status:?}");
            let proposal = Proposal { q: q.clone(), v: vec![0.02; N] };
            let (mut new, _) = panda_projector(choose);
            let mut expected = Target::new(new.model());
            used.project(&q, &[0.0; N], &proposal, &mut target);
            new.project(&q, &[0.0; N], &proposal, &mut expected);
            let told = |t: &Target| (t.q.clone(), t.v.clone(), t.ledger.status);
            assert_eq!(told(&target), told(&expected), "{solver:?} after {speed:e}");
        }
    }
}

/// At speeds the motors cannot brake from, the answer is still finite and within the actuators' range.
#[test]
fn fault_36_torques_beyond_the_motors_are_never_sent() {
    let mut flight = Flight::new(&stochastic(1), settings(), FaultPlan::default());
    for speed in [3.0, 30.0, 300.0] {
        flight.panda.v = vec![speed; N];
        let (effort, before) = (flight.panda.effort.clone(), flight.records.len());
        flight.fly(20);
        for record in &flight.records[before..] {
            let action = &record.output.action[..record.output.nu as usize];
            assert!(action.iter().zip(&effort).all(|(a, e)| a.abs() <= *e), "{action:?}");
        }
    }
    assert!(flight.records.iter().any(|r| !matches!(r.output.ledger.status, 0..=2)), "no tick was hard");
}

/// The robot model carries a payload that its motors cannot hold up, or links of nearly no mass, so that the inertia
/// matrix is singular up to rounding.
#[test]
fn fault_36_a_wrong_payload_and_a_singular_inertia_brake() {
    let loaded = |mass: f64| {
        let mut snapshot = stochastic(1);
        let bodies = &mut snapshot.manifest.robot.bodies;
        bodies.iter_mut().find(|body| body.mass == 0.735522).expect("the last link").mass = mass;
        snapshot
    };
    let mut heavy = Flight::new(&loaded(60.0), settings(), FaultPlan::default());
    heavy.fly(100);
    assert_eq!(
        heavy.records[0].output.ledger.status,
        LedgerStatus::BrakedNoCertifiedAnswer.number(),
        "no torque within the motors' range holds it"
    );
    assert_eq!(heavy.first(Mode::Braking).unwrap().1, Reason::NoCertifiedAnswer);
    let mut light = stochastic(1);
    for body in light.manifest.robot.bodies.iter_mut().filter(|body| body.inertia != [0.0; 6]) {
        body.inertia = [1e-14, 0.0, 0.0, 1e-14, 0.0, 1e-14];
    }
    let mut singular = Flight::new(&light, settings(), FaultPlan::default());
    singular.panda.q = vec![0.0; N]; // stretched out
    singular.panda.q[3] = singular.panda.upper[3] - 0.02;
    singular.fly(300);
    for flight in [&heavy, &singular] {
        for record in &flight.records {
            let action = &record.output.action[..record.output.nu as usize];
            let within = action.iter().zip(&flight.panda.effort).all(|(a, e)| a.abs() <= *e);
            assert!(within, "{action:?}");
        }
        assert!(flight.panda.worst[2] <= ROUNDING, "{:?}", flight.panda.worst);
    }
}

/// The same decisions, the same work (rung and iterations of every tick), the same motion up to rounding; the times are
/// printed.
#[test]
fn fault_37_denormal_numbers_change_nothing() {
    let fly = |tiny: f64, faults: &[(u64, u64, FaultKind)]| {
        let mut flight = Flight::new(&stochastic(1), settings(), super::flight::plan(faults));
        (flight.panda.q[0], flight.panda.v) = (tiny, vec![tiny; N]);
        flight.fly(600);
        flight
    };
    let denormal = FaultKind::Proposal { number: Odd::Denormal };
    let (with, without) = (fly(1e-310, &[(1, 600, denormal)]), fly(0.0, &[]));
    assert!(with.records[0].state.v().iter().all(|v| v.is_subnormal()));
    assert!(with.records.iter().all(|r| r.noise.is_subnormal()));
    for (a, b) in with.records.iter().zip(&without.records) {
        let work =
            |r: &Record| (r.mode, r.output.ledger.rung, r.output.ledger.iterations, r.output.ledger.status);
        assert_eq!(work(a), work(b), "tick {}", a.tick);
    }
    let difference = |a: &[f64], b: &[f64]| a.iter().zip(b).fold(0.0, |m, (a, b)| f64::max(m, (a - b).abs()));
    assert!(difference(&with.panda.q, &without.panda.q) < 1e-9);
    with.assert_within_limits(ROUNDING);
    // A processor that takes denormal numbers one by one needs a hundred times as long for each. The same ticks with and without in turns: the
    // quickest of each, which other programs did not hold up.
    let quickest = |flight: Flight, best: &mut [u64]| {
        let times = flight.records.iter().map(|r| r.output.ledger.duration);
        best.iter_mut().zip(times).for_each(|(best, time)| *best = time.min(*best));
    };
    let (mut tiny, mut plain) = ([u64::MAX; 600], [u64::MAX; 600]);
    for _ in 0..5 {
        quickest(fly(1e-310, &[(1, 600, denormal)]), &mut tiny);
        quickest(fly(0.0, &[]), &mut plain);
    }
    let ratio = tiny.iter().sum::<u64>() as f64 / plain.iter().sum::<u64>() as f64;
    println!("projections with denormal numbers: {ratio:.2} of the time without");
    assert!(ratio < 3.0, "denormal numbers take {ratio:.2} times as long");
    // In the flight only the first state is denormal; here every state and every proposal is.
    let quickest = |tiny: f64| {
        let (mut projector, q) = panda_projector(|_| {});
        let (proposal, mut target) =
            (Proposal { q: q.clone(), v: vec![tiny; N] }, Target::new(projector.model()));
        let times = (0..600).map(|_| {
            projector.project(&q, &[tiny; N], &proposal, &mut target);
            target.ledger.duration_ns
        });
        times.min().unwrap()
    };
    let ratio = quickest(1e-310) as f64 / quickest(1e-3) as f64;
    println!("projections of denormal states: {ratio:.2} of the time without");
    assert!(ratio < 3.0, "denormal states take {ratio:.2} times as long");
}
