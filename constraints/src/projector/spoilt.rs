//! A projector whose solver is spoilt: NaN in the Hessian of its problem, or in Clarabel's P.

use super::*;
use crate::random::Random;
use crate::target::Solver;
use crate::{AccelerationLimit, Limit, PositionLimit, TorqueLimit, VelocityLimit};

const PANDA: &str = include_str!("../../../examples/robots/panda/panda.urdf");
const TICKS: usize = 600;

/// The Panda with torque rows and brakes that are certified, so that every tick has its input alone.
fn projector(solver: Solver) -> Projector {
    let model = Model::from_urdf_text(PANDA).unwrap();
    let limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::default()),
        Box::new(AccelerationLimit::uniform(3.0)),
        Box::new(TorqueLimit::default()),
    ];
    let dofs: Vec<usize> = (0..7).collect();
    let settings = Settings { solver, braking: Braking::Certified, ..Settings::new(0.001, 1) };
    Projector::new(&model, &limits, &dofs, settings).unwrap()
}

/// The tick that meets the NaN brakes within every limit; the one after it has the bits of a projector that never met one.
#[test]
fn fault_07_a_nan_in_p_brakes_in_its_tick_and_the_next_is_as_if_new() {
    let hessian: fn(&mut Stages) = |stages| stages.problem.hessian[3] = f64::NAN;
    let all_of_p: fn(&mut Stages) = |stages| stages.conic.spoil();
    for (solver, spoil, reason) in [
        (Solver::Ladder, hessian, BrakeReason::NonFiniteDynamics),
        (Solver::Clarabel, hessian, BrakeReason::NonFiniteDynamics),
        (Solver::Clarabel, all_of_p, BrakeReason::NoCertifiedAnswer),
    ] {
        let (mut spoilt, mut sound) = (projector(solver), projector(solver));
        let mut q = vec![0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8];
        let (mut v, mut random) = (vec![0.0; 7], Random(7));
        let (mut target, mut expected) = (Target::new(&spoilt.model), Target::new(&spoilt.model));
        let (mut met, mut brakes) = (false, 0);
        let mut wish = vec![0.0; 7];
        for tick in 0..TICKS {
            if tick % 50 == 0 {
                wish.iter_mut().for_each(|w| *w = 5.0 * random.between(-1.0, 1.0));
            }
            if tick % 9 == 0 && !met {
                spoil(spoilt.coupled.as_mut().unwrap());
                met = true;
            }
            let proposal = Proposal { q: q.clone(), v: wish.clone() };
            let status = spoilt.project(&q, &v, &proposal, &mut target);
            let healthy = sound.project(&q, &v, &proposal, &mut expected);
            let is_as_new = (status, &target.q, &target.v) == (healthy, &expected.q, &expected.v);
            if met && !is_as_new {
                assert_eq!(status, Status::Braked(reason), "tick {tick}");
                assert!(
                    finite(&target.q) && finite(&target.v) && finite(&target.acceleration),
                    "tick {tick}"
                );
                assert_eq!(target.ledger.target_violations.total(), 0, "tick {tick}");
                (met, brakes) = (false, brakes + 1);
            } else {
                assert!(is_as_new, "tick {tick}: {status:?} and {healthy:?}");
            }
            (q, v) = (target.q.clone(), target.v.clone());
        }
        assert!(brakes > 20, "{solver:?}: {brakes} ticks met the NaN");
    }
}

/// The rows are reckoned with a robot whose links weigh nearly nothing: what they let through is beyond the motors of the true one, which the
/// checker knows.
#[test]
fn fault_36_what_rows_of_a_wrong_robot_let_through_the_checker_rejects() {
    let model = Model::from_urdf_text(PANDA).unwrap();
    let mut light = model.description().clone();
    for body in &mut light.bodies {
        (body.mass, body.inertia) = (1e-2 * body.mass, body.inertia.map(|x| 1e-2 * x));
    }
    let light = Model::from_description(light).unwrap();
    let limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::default()),
        Box::new(AccelerationLimit::uniform(10.0)),
        Box::new(TorqueLimit::scaled(0.5)),
    ];
    let dofs: Vec<usize> = (0..7).collect();
    let settings = Settings { braking: Braking::Certified, ..Settings::new(0.001, 1) };
    let projector = || Projector::new(&model, &limits, &dofs, settings.clone()).unwrap();
    let (mut sound, mut wrong) = (projector(), projector());
    wrong.dynamics = Dynamics::new(&light);
    let q = vec![0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8];
    let (v, mut random) = (vec![0.0; 7], Random(11));
    let mut target = Target::new(&model);
    let mut rejected = 0;
    for tick in 0..TICKS {
        let wish = (0..7).map(|_| 5.0 * random.between(-1.0, 1.0)).collect();
        let proposal = Proposal { q: q.clone(), v: wish };
        let status = sound.project(&q, &v, &proposal, &mut target);
        assert!(status.is_ok() && target.ledger.target_violations.total() == 0, "tick {tick}: {status:?}");
        let status = wrong.project(&q, &v, &proposal, &mut target);
        rejected += u32::from(status == Status::Braked(BrakeReason::NoCertifiedAnswer));
        assert!(!status.is_ok() || target.ledger.target_violations.total() == 0, "tick {tick}: {status:?}");
        // From rest the brake stays at rest, which the motors can hold.
        assert_eq!(target.ledger.target_violations.total(), 0, "tick {tick}: {status:?}");
    }
    assert!(rejected > 20, "{rejected} targets of the wrong rows were rejected");
}
