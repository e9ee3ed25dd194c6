//! A robot with Coulomb friction, which its model states.

use crate::common::robot;
use crate::coulomb_plant::attacked;
use nearl_constraints::Model;
use nearl_constraints::description::FrictionLaw;

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
