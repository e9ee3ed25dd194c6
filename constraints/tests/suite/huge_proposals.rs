//! Numbers no robot can reach, in a proposal that is otherwise fine.

use crate::common::*;
use nearl_constraints::*;

/// A position of 1e300 beside a speed that is allowed was taken for a consistent pair, passed on, and refused by the
/// checker: the whole robot braked although its nearest allowed state exists.
#[test]
fn a_huge_position_is_clamped_like_a_large_one() {
    let all = [0, 1, 2, 3, 4, 5, 6];
    let mut projector =
        Projector::new(&panda(), &panda_limits(Some(1.0)), &all, Settings::new(0.001, 1)).unwrap();
    let (q, v) = (vec![0.1, -0.4, 0.2, -1.8, 0.1, 1.9, 0.3], vec![0.0; 7]);
    let mut project = |position: f64| {
        let mut raw = Proposal { q: q.clone(), v: vec![1e-4; 7] };
        raw.q[4] = position;
        let mut target = Target::new(projector.model());
        let status = projector.project(&q, &v, &raw, &mut target);
        (status, target.q, target.v)
    };
    let large = project(1e3);
    assert_eq!(large.0, Status::Clamped);
    for huge in [1e12, 1e20, 1e100, 1e300] {
        assert_eq!(project(huge), large, "{huge:e}");
    }
}
