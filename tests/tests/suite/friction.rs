//! Dry friction: motors make up for MuJoCo's, limits hold whichever way a joint rubs, and what may be wrong is said in numbers.

use nearl_constraints::{
    AccelerationLimit, Dynamics, Limit, Model, Period, PositionLimit, Projector, Proposal, Settings, Target,
    TorqueLimit, VelocityLimit,
};
use nearl_trainer::mj;

/// A URDF of three joints whose last one is light and rubs as much as the others.
fn arm(friction: [f64; 3], damping: f64) -> String {
    let links = [("a", "0 1 0", 1.5, 0.012), ("b", "0 1 0", 0.8, 0.006), ("c", "1 0 0", 0.2, 0.0002)];
    let mut text = r#"<robot name="rubbing"><link name="base"/>"#.to_string();
    let mut parent = "base".to_string();
    for ((joint, axis, mass, inertia), friction) in links.into_iter().zip(friction) {
        text += &format!(
            r#"<link name="{joint}_link"><inertial><origin xyz="0.1 0 0.01"/><mass value="{mass}"/>
            <inertia ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial></link>
            <joint name="{joint}" type="revolute"><parent link="{parent}"/><child link="{joint}_link"/><origin xyz="0.25 0 0"/>
            <axis xyz="{axis}"/><limit lower="-2" upper="2" effort="30" velocity="3"/>
            <dynamics friction="{friction}" damping="{damping}"/></joint>"#
        );
        parent = format!("{joint}_link");
    }
    text + "</robot>"
}

const FRICTION: [f64; 3] = [1.0, 2.0, 1.0];

fn plant(text: &str, sim_dt: f64) -> mj::Sim {
    let options = mj::Options { sim_dt: Some(sim_dt), without_contacts: true, ..mj::Options::default() };
    mj::Sim::new(&mj::Model::from_text(text, mj::ModelFormat::Urdf, options).expect("plant"))
        .expect("simulation")
}

/// splitmix64 in [-1, 1).
fn uniform(seed: &mut u64) -> f64 {
    *seed = seed.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut z = *seed;
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 10) as f64 / (1u64 << 53) as f64 - 1.0
}

#[test]
fn a_urdf_s_friction_sets_in_as_the_simulator_has_it() {
    let text = arm(FRICTION, 0.5);
    let ours = Model::from_urdf_text(&text).expect("model");
    let theirs = mj::Model::from_text(&text, mj::ModelFormat::Urdf, mj::Options::default()).expect("plant");
    let theirs = Model::from_description(theirs.describe().expect("description")).expect("model");
    assert_eq!(ours.friction(), FRICTION);
    for i in 0..3 {
        let (a, b) = (ours.friction_onset()[i].expect("onset"), theirs.friction_onset()[i].expect("onset"));
        assert!(
            (a.inertia / b.inertia - 1.0).abs() < 1e-9 && (a.time / b.time - 1.0).abs() < 1e-12,
            "{a:?} {b:?}"
        );
    }
    // The light joint's friction is a damper at any speed allowed here: D (a + v / time) stays below 1 N m.
    assert!(ours.friction_onset()[2].expect("onset").inertia * (10.0 + 3.0 / 0.0095) < 1.0);
}

#[test]
fn motors_make_up_for_the_simulator_s_friction() {
    for damping in [0.0, 1.0] {
        let text = arm(FRICTION, damping);
        let model = Model::from_urdf_text(&text).expect("model");
        let (mut dynamics, mut sim, mut seed) = (Dynamics::new(&model), plant(&text, 0.001), 1);
        let (mut worst, mut without) = (0.0_f64, 0.0_f64);
        for k in 0..300 {
            // A joint at rest, hardly moving, and moving.
            let speed = [0.0, 1e-3, 2.0][k % 3];
            let q = [0, 1, 2].map(|_| uniform(&mut seed));
            let v = [0, 1, 2].map(|_| speed * uniform(&mut seed));
            let a = [0, 1, 2].map(|_| 10.0 * uniform(&mut seed));
            let mut off = |tau: &[f64; 3]| {
                sim.set_state(&q, &v).expect("state");
                sim.force_mut().copy_from_slice(tau);
                sim.step(1).expect("step");
                (0..3).map(|i| ((sim.qvel()[i] - v[i]) / 0.001 - a[i]).abs()).fold(0.0, f64::max)
            };
            let (mut tau, mut smooth) = ([0.0; 3], [0.0; 3]);
            dynamics.motors(&Period::new(0.001, 1), &q, &v, &a, &mut tau);
            dynamics.motors_without_friction(&Period::new(0.001, 1), &q, &v, &a, &mut smooth);
            (0..3).for_each(|i| assert!((tau[i] - smooth[i]).abs() <= FRICTION[i] + 1e-12));
            worst = worst.max(off(&tau));
            without = without.max(off(&smooth));
        }
        assert!(worst < 1e-6, "damping {damping}: {worst} rad/s² off");
        assert!(without > 10.0, "the test would see nothing: {without}");
    }
}

/// Bang-bang proposals in a closed loop with MuJoCo: largest acceleration, speed and motor force beyond their limits.
fn attacked(text: &str, known: &str, sub_steps: u32, dt: f64) -> [f64; 3] {
    let model = Model::from_urdf_text(known).expect("model");
    let limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::default()),
        Box::new(AccelerationLimit::uniform(10.0)),
        Box::new(TorqueLimit::default()),
    ];
    let mut projector =
        Projector::new(&model, &limits, &[0, 1, 2], Settings::new(dt, sub_steps)).expect("projector");
    let (mut dynamics, mut sim, mut seed) =
        (Dynamics::new(&model), plant(text, dt / f64::from(sub_steps)), 3);
    let (mut proposal, mut target) = (Proposal::new(&model), Target::new(&model));
    let mut worst = [f64::NEG_INFINITY; 3];
    let mut sign = [1.0; 3];
    for tick in 0..3000 {
        let (q, v) = (sim.qpos().to_vec(), sim.qvel().to_vec());
        for i in 0..3 {
            if (tick + 37 * i) % 150 == 0 {
                sign[i] = uniform(&mut seed).signum();
            }
            // A third of the time a joint is to stand, where the sign of its velocity is noise.
            let wish = if tick % 450 < 150 { 0.0 } else { sign[i] * 100.0 };
            (proposal.v[i], proposal.q[i]) = (wish, q[i] + dt * wish);
        }
        projector.project(&q, &v, &proposal, &mut target);
        let mut tau = [0.0; 3];
        dynamics.motors(&Period::new(dt, sub_steps), &q, &v, &target.acceleration, &mut tau);
        sim.force_mut().copy_from_slice(&tau);
        sim.step(sub_steps as usize).expect("step");
        for i in 0..3 {
            worst[0] = worst[0].max(((sim.qvel()[i] - v[i]) / dt).abs() - 10.0);
            worst[1] = worst[1].max(sim.qvel()[i].abs() - 3.0);
            worst[2] = worst[2].max(tau[i].abs() - 30.0);
        }
    }
    worst
}

#[test]
fn a_joint_that_rubs_keeps_its_limits_under_attack() {
    let text = arm(FRICTION, 0.5);
    let [a, v, tau] = attacked(&text, &text, 1, 0.001);
    assert!(a < 1e-6 && v < 1e-9 && tau < 1e-9, "{a} rad/s², {v} rad/s, {tau} N m beyond");
    let [a, ..] = attacked(&text, &arm([0.0; 3], 0.5), 1, 0.001);
    assert!(a > 1.0, "the attack would see nothing: {a}");
}

#[test]
fn what_friction_may_do_is_said_by_joint_and_number() {
    let rail = r#"<robot name="rail"><link name="base"/><link name="cart"><inertial><mass value="2"/>
        <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
        <joint name="slide" type="prismatic"><parent link="base"/><child link="cart"/><axis xyz="1 0 0"/>
        <limit lower="-1" upper="1" effort="30" velocity="3"/><dynamics friction="3"/></joint></robot>"#;
    let model = Model::from_urdf_text(rail).expect("model");
    // 0.9 / 0.1 of 2 kg.
    assert!((model.friction_onset()[0].expect("onset").inertia - 18.0).abs() < 1e-9);
    let limits = |scale: f64| -> Vec<Box<dyn Limit>> {
        vec![
            Box::new(VelocityLimit::default()),
            Box::new(AccelerationLimit::uniform(10.0)),
            Box::new(TorqueLimit::scaled(scale)),
        ]
    };
    let projector = Projector::new(&model, &limits(1.0), &[0], Settings::new(0.001, 1)).expect("projector");
    // 3 N more than is thought or 3 N less: 6 N on 2 kg.
    let note = projector.notes().iter().find(|n| n.contains("friction")).expect("a note");
    assert!(note.contains("'slide' (3 N·m or N) by 3.000 of 10"), "{note}");
    assert_eq!(projector.limits().effort, [27.0]);
    let refusal = Projector::new(&model, &limits(0.1), &[0], Settings::new(0.001, 1)).err().expect("refused");
    assert!(
        refusal
            .to_string()
            .contains("'slide' may give 3 N·m or N, no more than the joint's dry friction of 3"),
        "{refusal}"
    );
}
