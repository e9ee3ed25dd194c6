//! Several physics steps in a period: commands lead through the simulator's steps to what is asked for.

use super::friction::{arm, manifest, plant};
use nearl_constraints::{Drive, LimitSet, Model, Period, PeriodDynamics, PhysicsSteps};
use nearl_trainer::rollout::stream;
use rand::RngExt;

const ANY: [f64; 2] = [f64::NEG_INFINITY, f64::INFINITY];

/// Velocity change that is missing after the simulator's steps, as an acceleration [rad/s²]: with the mean forces of the period, and with those
/// found by its steps.
fn missed(friction: [f64; 3], damping: f64, dt: f64, n: u32) -> [f64; 2] {
    let text = arm(friction, damping);
    let model = Model::from_urdf_text(&text).expect("model");
    let (period, all) = (Period::new(dt, n), [0, 1, 2]);
    let mut sim = plant(&text, period.tau);
    let mut mean = PeriodDynamics::new(&model, &all, period);
    let mut steps = PhysicsSteps::new(&model, (&[Drive::Effort; 3], &[ANY; 3]), &all, &[], period)
        .expect("several steps");
    let (free, most) = (LimitSet::unlimited(3), [f64::INFINITY; 3]);
    let (mut rng, mut worst) = (stream(3, 0), [0.0_f64; 2]);
    for _ in 0..60 {
        let mut draw = |size: f64| [0, 1, 2].map(|_| rng.random_range(-size..size));
        let (q, v, a) = (draw(1.5), draw(2.0), draw(10.0));
        let (mut given, mut tau) = (a, [0.0; 3]);
        mean.update(&q, &v, &[0.0; 3]);
        mean.drive(&mut given, &mut tau);
        for worst in &mut worst {
            sim.set_state(&q, &v).expect("state");
            sim.force_mut().copy_from_slice(&tau);
            sim.step(n as usize).expect("steps");
            for i in 0..3 {
                *worst = worst.max(((sim.qvel()[i] - v[i]) / dt - a[i]).abs());
            }
            let mut foreseen = [0.0; 3];
            steps.drive((&q, &v), &[0.0; 3], &a, (&mut tau, &most), (&free, &[ANY; 3]));
            steps.accelerate((&q, &v), &[0.0; 3], (&tau, &most), &mut foreseen);
            (0..3).for_each(|i| assert!((foreseen[i] - a[i]).abs() < 2e-9, "{foreseen:?} for {a:?}"));
        }
    }
    worst
}

#[test]
fn forces_lead_through_the_simulator_s_steps_to_the_acceleration_asked_for() {
    for (damping, dt, n) in [(0.0, 0.01, 2), (0.5, 0.005, 2), (0.5, 0.01, 5), (2.0, 0.02, 10)] {
        let [mean, steps] = missed([0.0; 3], damping, dt, n);
        assert!(steps < 1e-7, "damping {damping}, {n} steps: {steps} rad/s² off");
        assert!(mean > 1e-3, "damping {damping}, {n} steps: the test would see nothing: {mean}");
    }
}

/// MuJoCo's dry friction sets in within each step.
#[test]
fn joints_that_rub_are_led_through_the_steps_too() {
    for (damping, dt, n) in [(0.0, 0.01, 2), (0.5, 0.01, 5)] {
        let [mean, steps] = missed([0.3, 0.2, 0.05], damping, dt, n);
        assert!(steps < 1e-4, "damping {damping}, {n} steps: {steps} rad/s² off");
        assert!(mean > 1e-2, "the test would see nothing: {mean}");
    }
}

/// No force is raised above what it may be: the joint falls short, and the others do not.
#[test]
fn forces_keep_to_their_largest() {
    let text = arm([0.0; 3], 0.5);
    let model = Model::from_urdf_text(&text).expect("model");
    let (period, all) = (Period::new(0.01, 5), [0, 1, 2]);
    let mut mean = PeriodDynamics::new(&model, &all, period);
    let mut steps = PhysicsSteps::new(&model, (&[Drive::Effort; 3], &[ANY; 3]), &all, &[], period)
        .expect("several steps");
    let (q, v, a) = ([0.5, -1.0, 0.3], [1.5, -1.8, 1.2], [8.0, 5.0, -9.0]);
    let (mut given, mut tau, mut reached) = (a, [0.0; 3], [0.0; 3]);
    mean.update(&q, &v, &[0.0; 3]);
    mean.drive(&mut given, &mut tau);
    let (first, mut free) = (tau, tau);
    steps.drive(
        (&q, &v),
        &[0.0; 3],
        &a,
        (&mut free, &[f64::INFINITY; 3]),
        (&LimitSet::unlimited(3), &[ANY; 3]),
    );
    for k in 0..3 {
        // where more is needed there is none, and where less is needed it is taken
        let mut most = [f64::INFINITY; 3];
        most[k] = first[k].abs();
        let mut tau = first;
        steps.drive((&q, &v), &[0.0; 3], &a, (&mut tau, &most), (&LimitSet::unlimited(3), &[ANY; 3]));
        steps.accelerate((&q, &v), &[0.0; 3], (&tau, &most), &mut reached);
        assert!(tau[k].abs() <= first[k].abs(), "{tau:?} from {first:?}");
        for i in (0..3).filter(|i| *i != k || free[k].abs() <= first[k].abs()) {
            assert!((reached[i] - a[i]).abs() < 1e-6, "joint {k} held: {reached:?} for {a:?}");
        }
    }
}

/// A robot whose equations have no solution has no forces to begin with; none are made up, and nothing panics.
#[test]
fn forces_that_are_no_numbers_stay() {
    let model = Model::from_urdf_text(&arm([0.0; 3], 0.5)).expect("model");
    let mut steps =
        PhysicsSteps::new(&model, (&[Drive::Effort; 3], &[ANY; 3]), &[0, 1, 2], &[], Period::new(0.01, 5))
            .expect("several steps");
    for most in [f64::INFINITY, 1.0, f64::NAN] {
        let mut tau = [1.0, f64::NAN, 2.0];
        steps.drive(
            (&[0.1; 3], &[0.2; 3]),
            &[0.0; 3],
            &[1.0; 3],
            (&mut tau, &[1.0, most, 1.0]),
            (&LimitSet::unlimited(3), &[ANY; 3]),
        );
        assert!(tau[0] == 1.0 && tau[1].is_nan() && tau[2] == 2.0, "{tau:?}");
    }
}

/// Of drives that are held on their targets for long, and of no others, doctor tells.
#[test]
fn targets_held_for_long_are_told() {
    let folder = tempfile::tempdir().expect("folder");
    std::fs::write(folder.path().join("arm.urdf"), arm([0.0; 3], 0.5)).expect("robot");
    let text = |dt: f64, sim_dt: f64, interface: &str| {
        format!(
            "name = \"arm\"\n[model]\nurdf = \"arm.urdf\"\n[time]\ndt = {dt}\nsim_dt = {sim_dt}\n[state]\nobservation = [\"q.a\", \"v.a\"]\n\
             [command]\n{interface}\n[constraints]\nposition = {{ margin = 0.02 }}\nvelocity = {{ limit = 2.0 }}\n\
             acceleration = {{ limit = 10.0 }}\ntorque = {{}}\nguard = true\n[idm]\nkind = \"pinocchio\"\n"
        )
    };
    let (stiff, soft) = ("interface = \"pd\"\nstiffness = 4000.0", "interface = \"pd\"\nstiffness = 2.0");
    let file = folder.path().join("arm.toml");
    for (dt, sim_dt, interface, is_told) in [
        (0.02, 0.002, stiff, true),
        (0.02, 0.002, soft, false),
        (0.002, 0.002, stiff, false),
        (0.01, 0.0, stiff, true),
        (0.01, 0.0, soft, false),
        (0.02, 0.002, "interface = \"effort\"", false),
    ] {
        let manifest = manifest(&file, &text(dt, sim_dt, interface));
        let told = nearl_runtime::doctor::told(&manifest).expect("a task").join("; ");
        assert_eq!(
            told.contains("a good part of the way to a target"),
            is_told,
            "{dt} {sim_dt} {interface}: {told}"
        );
    }
}
