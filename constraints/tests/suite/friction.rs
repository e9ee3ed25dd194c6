//! A robot with Coulomb friction, which its model states.

use crate::common::{Random, robot};
use crate::coulomb_plant::attacked;
use nearl_constraints::description::FrictionLaw;
use nearl_constraints::drive::Held;
use nearl_constraints::{Dynamics, Model, Period, PeriodDynamics};

/// A UR5 whose joints rub by a law and have dampers, and whose last three links weigh a hundredth: their friction is a hundred times what
/// their motion takes.
fn rubbing(friction: f64, damping: f64, law: FrictionLaw) -> Model {
    let mut description = robot("ur5/ur5.urdf").description().clone();
    for joint in description.bodies.iter_mut().flat_map(|body| &mut body.joints) {
        (joint.friction, joint.damping, joint.friction_law) = (friction, damping, law);
    }
    for body in description.bodies.iter_mut().rev().take(3) {
        body.mass *= 0.01;
        body.inertia.iter_mut().for_each(|i| *i *= 0.01);
    }
    Model::from_description(description).unwrap()
}

fn near(a: &[f64], b: &[f64], by: f64) -> bool {
    a.iter().zip(b).all(|(a, b)| (a - b).abs() < by)
}

/// Forward dynamics with friction against back, by either law, with and without dampers, with joints that stand, turn round and move, and with
/// joints on which no motor acts; back is [`Dynamics::motors`].
#[test]
fn forces_of_a_robot_that_rubs_come_back() {
    let mut random = Random(7);
    for (damping, law) in
        [(0.0, FrictionLaw::Mujoco), (2.0, FrictionLaw::Mujoco), (2.0, FrictionLaw::Coulomb)]
    {
        let model = rubbing(3.0, damping, law);
        let mut dynamics = Dynamics::new(&model);
        for (dt, sub_steps) in [(0.001, 1), (0.01, 5), (0.002, 0), (0.01, 0)] {
            let period = Period::new(dt, sub_steps);
            let mut all = PeriodDynamics::new(&model, &[0, 1, 2, 3, 4, 5], period);
            let mut some = PeriodDynamics::new(&model, &[0, 2, 3], period);
            for k in 0..1000 {
                let (speed, strength) = ([0.0, 1e-3, 0.05, 2.0][k % 4], [0.3, 3.0, 30.0][k % 3]);
                let mut draw =
                    |size: f64| -> [f64; 6] { std::array::from_fn(|_| random.between(-size, size)) };
                let (q, v, mut tau) = (draw(2.0), draw(speed), draw(strength));
                let case = format!("damping {damping}, {law:?}, {dt} s in {sub_steps} steps, case {k}");
                let (mut a, mut back) = ([0.0; 6], [0.0; 6]);
                all.update(&q, &v, &[0.0; 6]);
                all.accelerate(&tau.map(Held::Force), &mut a);
                dynamics.motors(&period, &q, &v, &a, &mut back);
                assert!(near(&tau, &back, 1e-6), "{case}: {tau:?} {back:?} N m");
                let (mut again, mut forces) = (a, [0.0; 6]);
                all.drive(&mut again, &mut forces);
                assert!(near(&forces, &back, 1e-9), "{case}: {forces:?} {back:?} N m");
                // three motors, and joints that follow
                [1, 4, 5].iter().for_each(|&i| tau[i] = 0.0);
                some.update(&q, &v, &[0.0; 6]);
                some.accelerate(&tau.map(Held::Force), &mut a);
                dynamics.motors(&period, &q, &v, &a, &mut back);
                assert!(near(&tau, &back, 1e-6), "{case}, some motors: {tau:?} {back:?} N m");
                let mut again = [a[0], 0.0, a[2], a[3], 0.0, 0.0];
                some.drive(&mut again, &mut forces);
                assert!(near(&again, &a, 1e-5), "{case}, some motors: {again:?} {a:?} rad/s²");
                assert!(near(&forces, &tau, 1e-5), "{case}, some motors: {forces:?} {tau:?} N m");
            }
        }
    }
}

#[test]
fn an_arm_that_rubs_by_coulomb_s_law_keeps_its_limits_where_that_is_said() {
    let mut description = robot("ur5/ur5.urdf").description().clone();
    description.bodies.iter_mut().flat_map(|body| &mut body.joints).for_each(|joint| joint.friction = 3.0);
    let arm = Model::from_description(description).unwrap();
    let of = |law| attacked(&arm, law, (0.001, 0), 900);
    let (without, mujoco, coulomb) =
        (of(None), of(Some(FrictionLaw::Mujoco)), of(Some(FrictionLaw::Coulomb)));
    println!("{without:?}\n{mujoco:?}\n{coulomb:?}");
    assert!(without.over > 90 && mujoco.over > 90, "the attack would see nothing: {without:?} {mujoco:?}");
    assert!(20 * coulomb.over < without.over && coulomb.worst[0] < 1.0, "{coulomb:?}");
}
