//! States as they are measured: with noise, a little outside, behind what was sent.

use crate::common::*;
use nearl_constraints::*;

/// Speed of the hand by differences of its place.
fn hand_speed(kinematics: &mut Kinematics, frame: FrameId, q: &[f64], v: &[f64]) -> f64 {
    let (zero, step) = (vec![0.0; v.len()], 1e-6);
    let mut at = |sign: f64| {
        let q: Vec<f64> = q.iter().zip(v).map(|(q, v)| q + sign * step * v).collect();
        kinematics.update(&q, &zero, &zero);
        kinematics.point(frame, [0.0; 3]).position
    };
    let (ahead, behind) = (at(1.0), at(-1.0));
    (0..3).map(|k| ((ahead[k] - behind[k]) / (2.0 * step)).powi(2)).sum::<f64>().sqrt()
}

/// A measured speed is beyond a limit by its noise; what is asked for in answer was, too.
#[test]
fn noise_of_a_measured_speed_does_not_reach_the_target() {
    let (model, dt, most) = (panda(), 0.005, 0.4);
    let mut limits = panda_limits(None);
    limits.push(Box::new(FrameSpeedLimit::of("panda_hand", most)));
    let mut projector =
        Projector::new(&model, &limits, &[0, 1, 2, 3, 4, 5, 6], Settings::new(dt, 1)).unwrap();
    let (mut kinematics, frame) = (Kinematics::new(&model), model.frame("panda_hand").unwrap());
    let (mut raw, mut target, mut random) = (Proposal::new(&model), Target::new(&model), Random(3));
    let (mut q, mut v) = (vec![0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], vec![0.0; 7]);
    let (mut near, mut beyond, mut braked, mut wish) = (0, 0, 0, [0.0; 7]);
    for tick in 0..4000 {
        if tick % 60 == 0 {
            wish = std::array::from_fn(|_| random.between(-2.0, 2.0));
        }
        let measured: Vec<f64> = v.iter().map(|v| v + random.between(-1e-4, 1e-4)).collect();
        for i in 0..7 {
            (raw.v[i], raw.q[i]) = (wish[i], q[i] + dt * wish[i]);
        }
        let status = projector.project(&q, &measured, &raw, &mut target);
        braked += u32::from(matches!(status, Status::Braked(_)));
        let speed = hand_speed(&mut kinematics, frame, &target.q, &target.v);
        near += u32::from(speed > 0.999 * most);
        let was = hand_speed(&mut kinematics, frame, &q, &measured);
        assert!(speed < was.max(most) * (1.0 + 1e-7), "tick {tick}, {status:?}: {speed} m/s after {was}");
        beyond += u32::from(speed > most * (1.0 + 1e-7));
        (q, v) = (target.q.clone(), target.v.clone());
    }
    let found = format!("{near} near the limit, {beyond} beyond, {braked} braked");
    assert!(near > 1000 && beyond < 4 && braked == 0, "{found}");
}

/// A joint that is a hair beyond what it can stop from brakes; the others go on. All of them braked, because the next acceleration was above
/// its limit by less than the box took for rounding and more than the checker did.
#[test]
fn a_joint_a_hair_outside_stops_no_other() {
    let model = panda();
    for stored in [false, true] {
        let mut limits = panda_limits(None);
        if stored {
            limits.push(Box::new(FrameSpeedLimit::of("panda_hand", 10.0)));
        }
        let settings = Settings::new(0.005, 1);
        let mut projector = Projector::new(&model, &limits, &[0, 1, 2, 3, 4, 5, 6], settings).unwrap();
        let (raw, mut target) = (Proposal::new(&model), Target::new(&model));
        let braking = projector.limits().braking[0];
        let upper = projector.limits().q_upper[0];
        // d = (v - b T / 2)^2 / 2 b is the edge, by hand
        let (v0, half) = (0.8, 0.5 * braking * 0.005);
        let edge = upper - (v0 - half) * (v0 - half) / (2.0 * braking);
        for beyond in [1e-10, 3e-10, 1e-9, 3e-9, 1e-8, 1e-7, 1e-6, 1e-5] {
            let mut q = vec![0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0];
            q[0] = edge + beyond;
            let mut v = vec![0.0; 7];
            v[0] = v0;
            let mut raw = raw.clone();
            raw.q.copy_from_slice(&q);
            (raw.v[0], raw.v[1]) = (2.0, 0.02);
            raw.q[1] = 0.005 * 0.02;
            projector.forget();
            let status = projector.project(&q, &v, &raw, &mut target);
            assert!(!matches!(status, Status::Braked(_)), "{stored}, {beyond}: {status:?}");
            assert!(target.v[1] > 0.015, "{stored}, {beyond}: {}", target.v[1]);
            let a = target.acceleration[0];
            let is_allowed = -PANDA_ACCELERATION[0] <= a && a <= -braking * (1.0 - 1e-8);
            assert!(is_allowed, "{stored}, {beyond}: {a} of {braking}");
        }
    }
}

/// A plant that goes `more` faster in every period than it is asked to: beyond a limit it crept on for ever.
#[test]
fn what_is_beyond_a_limit_comes_back_against_an_error_of_every_period() {
    let (model, dt, more) = (panda(), 0.001, 1e-3);
    let mut projector = panda_projector(None, Settings::new(dt, 1));
    let (mut raw, mut target) = (Proposal::new(&model), Target::new(&model));
    let (mut q, mut v) = (vec![0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], vec![0.0; 7]);
    let upper = projector.limits().q_upper[0];
    q[0] = upper - 0.01;
    let mut furthest: f64 = 0.0;
    for _ in 0..20_000 {
        raw.q.copy_from_slice(&q);
        raw.q[0] += dt;
        raw.v.fill(0.0);
        raw.v[0] = 1.0;
        projector.project(&q, &v, &raw, &mut target);
        (q, v) = (target.q.clone(), target.v.clone());
        v[0] += more;
        q[0] += dt * more;
        furthest = furthest.max(q[0] - upper);
    }
    // it rests where what it comes back by in a period is what it goes on by: 20 T of that speed, and as much again on the way
    assert!(furthest < 40.0 * dt * more, "{furthest} rad");
}

/// By hand: set points of a joint that is sent positions go on from one another, those of one that is sent velocities from its last speed.
#[test]
fn joints_that_follow_go_on_from_what_they_were_sent() {
    let model = panda();
    let mut projector = panda_projector(None, Settings::new(0.01, 1));
    let mut drives = vec![Drive::Effort; model.nv()];
    (drives[0], drives[1]) = (Drive::Position, Drive::Velocity);
    projector.follow(&drives);
    assert!(projector.needs_previous());
    let window = 0.1 * projector.limits().velocity[0];
    let measured = || (vec![0.2, 0.3, 0.0, -1.5, 0.0, 1.5, 0.0], vec![0.01; model.nv()]);
    let (mut q, mut v) = measured();
    projector.depart(&mut q, &mut v);
    assert_eq!((q, v), measured()); // nothing was sent

    let mut target = Target::new(&model);
    target.q[0] = 0.2 + 0.5 * window;
    (target.v[0], target.v[1], target.v[2]) = (0.4, 0.5, 0.6);
    projector.remember(&target);
    let goes_on = |projector: &mut Projector| {
        let (mut q, mut v) = measured();
        projector.depart(&mut q, &mut v);
        (q[0], v[0], q[1], v[1], v[2])
    };
    assert_eq!(goes_on(&mut projector), (target.q[0], 0.4, 0.3, 0.5, 0.01));

    // further away than its way in 0.1 s: the set point goes on from itself all the same, and comes to rest with all that it may, 15 rad/s^2
    let (mut q, mut v) = measured();
    q[0] -= window;
    projector.depart(&mut q, &mut v);
    assert_eq!((q[0], v[0]), (target.q[0], 0.4));
    let (mut raw, mut next) = (Proposal::new(&model), Target::new(&model));
    raw.q.copy_from_slice(&q);
    raw.v.copy_from_slice(&v);
    (raw.q[0], raw.v[0]) = (q[0] + 0.01, 1.0);
    projector.project(&q, &v, &raw, &mut next);
    assert!((next.v[0] - (0.4 - 0.15)).abs() < 1e-12, "{}", next.v[0]);
    let (mut near_q, mut near_v) = measured();
    projector.depart(&mut near_q, &mut near_v);
    projector.project(&near_q, &near_v, &raw, &mut next);
    assert!(next.v[0] > 0.4, "{}", next.v[0]); // and goes on when it is there
    near_q[0] = f64::NAN;
    projector.depart(&mut near_q, &mut near_v);
    assert!(near_q[0].is_nan(), "{}", near_q[0]); // what is no number is not hidden

    let memory = projector.memory();
    projector.forget();
    assert_eq!(goes_on(&mut projector), (0.2, 0.01, 0.3, 0.01, 0.01));
    projector.set_memory(&memory);
    assert_eq!(goes_on(&mut projector), (target.q[0], 0.4, 0.3, 0.5, 0.01));
    projector.lose();
    assert_eq!(goes_on(&mut projector), (0.2, 0.01, 0.3, 0.01, 0.01));

    // two periods without an answer: 15 rad/s^2 take 0.15 rad/s off in each
    projector.remember(&target);
    projector.miss(2);
    let held = goes_on(&mut projector);
    assert!(
        (held.1 - 0.1).abs() < 1e-12 && (held.0 - target.q[0] - 0.01 * (0.25 + 0.1)).abs() < 1e-12,
        "{held:?}"
    );
    assert_eq!(held.3, 0.5);
    projector.miss(100);
    assert_eq!(goes_on(&mut projector).1, 0.0);

    // an answer that came too late was never sent: the driver went on from the two before it, by their mean speed of 0.3 rad/s, less 0.15
    let lasts = [0.2, 0.203, 0.209].map(|q| {
        target.q[0] = q;
        (target.v[0], target.v[1]) = (200.0 * (q - 0.2), q);
        target.clone()
    });
    projector.lose();
    lasts.iter().for_each(|last| projector.remember(last));
    projector.recall();
    let memory = projector.memory();
    projector.forget();
    projector.set_memory(&memory);
    projector.miss(1);
    let held = goes_on(&mut projector);
    assert!((held.0 - (0.203 + 0.01 * 0.15)).abs() < 1e-12 && (held.1 - 0.15).abs() < 1e-12, "{held:?}");
    assert_eq!(held.3, 0.203);
    projector.recall();
    assert_eq!(goes_on(&mut projector), (0.2, 0.01, 0.3, 0.01, 0.01)); // no more is known
}
