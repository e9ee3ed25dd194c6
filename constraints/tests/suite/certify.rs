//! Which braking the Panda's motors can give.
use crate::common::*;
use nearl_constraints::*;

#[test]
fn the_panda_s_braking_is_within_its_motors_reach() {
    let model = panda();
    let all = [0, 1, 2, 3, 4, 5, 6];
    let set = LimitSet::collect(&model, &panda_limits(Some(1.0)), &all).unwrap();
    let certificate = certify_braking(&model, &set, &all, &Period::new(0.001, 1), 200_000, 1).unwrap();
    println!("{certificate:?}");
    assert!(certificate.holds() && certificate.scale >= 1.0, "{certificate:?}");
    // Ten times as much is not.
    let mut greedy = set.clone();
    greedy.braking.iter_mut().for_each(|a| *a *= 10.0);
    let refused = certify_braking(&model, &greedy, &all, &Period::new(0.001, 1), 10_000, 1).unwrap();
    assert!(!refused.holds() && refused.scale < 1.0);
}
