//! What is said of moved limits: their time, their names, a payload.

use nearl_constraints::*;

use super::{joints, middle, moved};
use crate::common::arms::{rail_arm, small_arm};
use crate::common::*;

/// From `v` to `v_new` at the braking deceleration: `(v - v_new) / A`, to the tick.
#[test]
fn a_slower_speed_is_reached_in_the_time_it_takes() {
    for (dt, share) in [(0.001, 0.3), (0.002, 0.5), (0.01, 0.25)] {
        let model = rail_arm();
        let all: Vec<usize> = (0..model.nv()).collect();
        let settings = Settings { braking: Braking::Certified, ..Settings::new(dt, 1) };
        let mut projector = Projector::new(&model, &joints(4.0, None), &all, settings).unwrap();
        let (mut raw, mut target) = (Proposal::new(&model), Target::new(&model));
        let (mut q, mut v) = (middle(&model), vec![0.0; model.nv()]);
        q[0] = -0.9;
        let mut run = |projector: &mut Projector, count: usize| {
            let mut ticks = 0;
            for _ in 0..count {
                raw.q.clone_from(&q);
                raw.v.fill(0.0);
                (raw.q[0], raw.v[0]) = (q[0] + 5.0 * dt, 5.0);
                let status = projector.project(&q, &v, &raw, &mut target);
                assert_eq!(target.ledger.target_violations.total(), 0);
                (q, v) = (target.q.clone(), target.v.clone());
                ticks += usize::from(status == Status::Tightening);
            }
            let held = target.ledger.active.iter().any(|row| row.row == 0 && row.kind == Kind::Velocity);
            (v[0], ticks, held)
        };
        let top = model.velocity_limit()[0];
        assert_eq!(run(&mut projector, (0.4 / dt) as usize), (top, 0, true));
        projector.move_limits(&Moved::speed(share)).unwrap();
        let best = ((top - share * top) / (4.0 * dt) - 1e-9).ceil() as usize;
        let (reached, took, _) = run(&mut projector, best);
        assert!((reached - share * top).abs() < 1e-12 && took == best, "{reached} in {took} of {best} ticks");
        let (_, late, held) = run(&mut projector, 5);
        assert!(late == 0 && held, "{late} {held}: a moved limit is reported as any other");
        projector.move_limits(&moved()).unwrap();
        assert!(run(&mut projector, best).0 > share * top);
    }
}

#[test]
fn what_was_built_is_not_loosened_and_what_is_unknown_is_named() {
    let model = small_arm();
    let all: Vec<usize> = (0..6).collect();
    let mut limits = joints(10.0, Some(0.6));
    limits.push(Box::new(FrameSpeedLimit::of("tool", 0.8)));
    limits.push(Box::new(FrameLimit::inside("tool", [-1.0; 3], [1.0, 1.0, 0.5], 3.0)));
    let mut projector = Projector::new(&model, &limits, &all, Settings::new(0.001, 1)).unwrap();
    let one = |name: &str, value: f64| Some(PerJoint::Joints([(name.to_string(), value)].into()));
    let named = |name: &str, value: f64| [(name.to_string(), value)].into();
    let before = projector.moved().to_vec();
    let plane =
        |name: &str, normal| [(name.to_string(), limit::HalfSpace { normal, through: [0.0; 3] })].into();
    let nowhere = limit::Pose { position: [0.0; 3], rpy: [0.0; 3] };
    let load = description::Payload { frame: "tool".into(), mass: 1.5, com: [0.0; 3], inertia: [0.0; 6] };
    let cases = [
        (Moved::speed(1.5), vec!["speed", "1.5", "at most 1"]),
        (Moved::speed(f64::NAN), vec!["speed"]),
        (Moved { velocity: one("j2", 7.0), ..moved() }, vec!["velocity 7", "'j2'", "3.1", "rad/s"]),
        (Moved { velocity: one("j9", 1.0), ..moved() }, vec!["'j9'"]),
        (Moved { upper: one("j2", 3.5), ..moved() }, vec!["upper 3.5", "'j2'", "2.9", "rad"]),
        (
            Moved { lower: one("j2", 2.0), upper: one("j2", 1.0), ..moved() },
            vec!["'j2'", "above 2", "below 1"],
        ),
        (Moved { acceleration: one("j2", 11.0), ..moved() }, vec!["acceleration 11", "'j2'", "10"]),
        (Moved { acceleration: one("j2", f64::INFINITY), ..moved() }, vec!["acceleration", "'j2'"]),
        (Moved { frame: named("tool", 0.9), ..moved() }, vec!["0.9 m", "'tool'", "0.75"]),
        (Moved { frame: named("tol", 0.1), ..moved() }, vec!["'tol'", "tool"]),
        (Moved { frame_speed: named("tool", 0.9), ..moved() }, vec!["frame_speed 0.9 m/s", "'tool'", "0.8"]),
        (Moved { energy: Some(1.0), ..moved() }, vec!["energy"]),
        (Moved { plane: plane("tool", [0.0; 3]), ..moved() }, vec!["'tool'"]),
        (Moved { body: [("post".to_string(), nowhere)].into(), ..moved() }, vec!["'post'"]),
        (Moved { payload: Some(load), ..moved() }, vec!["payload of 1.5 kg", "nearl limits"]),
    ];
    for (moved, words) in cases {
        let error = projector.move_limits(&moved).unwrap_err().to_string();
        assert!(words.iter().all(|word| error.contains(word)), "{error}: {words:?}");
        assert_eq!(projector.moved(), before);
    }
    let certified = Settings { braking: Braking::Certified, ..Settings::new(0.001, 1) };
    let mut projector = Projector::new(&model, &limits, &all, certified).unwrap();
    let error = projector.move_limits(&Moved::speed(0.5)).unwrap_err().to_string();
    assert!(error.contains("frame_speed 'tool'") && error.contains("stored"), "{error}");
}

/// A payload is what a link of the URDF is that hangs fixed in the same place.
#[test]
fn a_payload_weighs_what_a_fixed_link_does() {
    let (x, y, z, roll, yaw) = (0.03, -0.02, 0.11, 0.4, -0.7);
    let inertia = [0.004, 0.0003, -0.0002, 0.005, 0.0001, 0.006];
    let [xx, xy, xz, yy, yz, zz] = inertia;
    let text = crate::common::arms::small_arm_text(0.0);
    // Where the tool is, turned, so that the axes of payload and body differ.
    let tool = "<origin xyz=\"0.1 0 0\"/></joint></robot>";
    assert!(text.contains(tool));
    let turned = format!("<origin xyz=\"0.1 0 0\" rpy=\"{roll} 0 {yaw}\"/></joint>");
    let held = format!(
        "<link name=\"load\"><inertial><origin xyz=\"{x} {y} {z}\"/><mass value=\"1.7\"/><inertia ixx=\"{xx}\" ixy=\"{xy}\" \
         ixz=\"{xz}\" iyy=\"{yy}\" iyz=\"{yz}\" izz=\"{zz}\"/></inertial></link><joint name=\"hold\" type=\"fixed\">\
         <parent link=\"tool\"/><child link=\"load\"/></joint></robot>"
    );
    let bare = Model::from_urdf_text(&text.replace(tool, &format!("{turned}</robot>"))).unwrap();
    let loaded = Model::from_urdf_text(&text.replace(tool, &format!("{turned}{held}"))).unwrap();
    let payload = description::Payload { frame: "tool".into(), mass: 1.7, com: [x, y, z], inertia };
    let carrying = bare.with_payload(&payload).unwrap();
    let (mut one, mut other, mut random) = (Dynamics::new(&loaded), Dynamics::new(&carrying), Random(3));
    let (mut tau, mut same, mut less) = ([0.0; 6], [0.0; 6], [0.0; 6]);
    for _ in 0..200 {
        let mut draw = || std::array::from_fn::<f64, 6, _>(|_| random.between(-2.0, 2.0));
        let (q, v, a) = (draw(), draw(), draw());
        one.rnea(&q, &v, &a, &mut tau);
        other.rnea(&q, &v, &a, &mut same);
        Dynamics::new(&bare).rnea(&q, &v, &a, &mut less);
        for i in 0..6 {
            assert!((tau[i] - same[i]).abs() < 1e-10 * tau[i].abs().max(1.0), "{i}: {tau:?} {same:?}");
        }
        assert!((0..6).any(|i| (tau[i] - less[i]).abs() > 0.1));
    }
    let of = |frame: &str, mass: f64, inertia: [f64; 6]| {
        let payload = description::Payload { frame: frame.into(), mass, com: [0.0; 3], inertia };
        bare.with_payload(&payload).err().map(|e| e.to_string())
    };
    let wrong = |frame: &str, mass: f64| of(frame, mass, [0.0; 6]).unwrap();
    // The moments of a ball in the wrong order, moments below 0, and one beyond the sum of the others.
    for no_body in
        [[0.1, 0.1, 0.1, 0.0, 0.0, 0.0], [-0.1, 0.0, 0.0, -0.1, 0.0, -0.1], [0.3, 0.0, 0.0, 0.1, 0.0, 0.1]]
    {
        let said = of("tool", 1.0, no_body).expect("no body has it");
        assert!(said.contains("is that of no body") && said.contains("xx, xy, xz, yy, yz, zz"), "{said}");
    }
    assert_eq!(of("tool", 1.0, [0.1, 0.0, 0.0, 0.1, 0.0, 0.1]), None, "a ball");
    assert_eq!(of("tool", 1.0, [0.1, 0.0, 0.0, 0.1, 0.0, 0.0]), None, "a rod");
    assert!(wrong("tol", 1.0).contains("no frame 'tol'") && wrong("tol", 1.0).contains("tool"));
    assert!(wrong("tool", -1.0).contains("mass -1 kg") && wrong("tool", f64::NAN).contains("NaN"));
    assert!(wrong("base", 1.0).contains("'base' is fixed to the world"), "{}", wrong("base", 1.0));
}

/// After limits have moved, a tick that claims the nearest allowed state names what holds every joint back that does not do as proposed.
#[test]
fn a_joint_that_moved_limits_hold_back_is_named_in_every_tick_that_claims_the_nearest() {
    let joints = [0, 1, 2, 3, 4, 5, 6];
    for (braking, sub_steps) in
        [(Braking::Auto, 1), (Braking::Stored, 0), (Braking::Stored, 5), (Braking::Certified, 1)]
    {
        let (mut claims, mut ways) = (0, 0);
        for seed in 0..4 {
            let mut limits = panda_limits(Some(1.0));
            limits[2] =
                Box::new(AccelerationLimit::new(limit::AccelerationSettings::of(PerJoint::All(8.0), None)));
            let settings = Settings { braking, ..Settings::new(0.004, sub_steps) };
            let mut projector = Projector::new(&panda(), &limits, &joints, settings).unwrap();
            let mut random = Random(seed);
            let (mut q, mut v) = (vec![0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], vec![0.0; 7]);
            let (mut side, mut target) = ([1.0; 7], Target::new(&panda()));
            for tick in 0..6000 {
                if tick % 60 == 0 {
                    let elbow = random.between(-2.5, -0.2);
                    let wrist = random.between(1.0, 3.0);
                    let upper = [("panda_joint4".to_string(), elbow), ("panda_joint6".to_string(), wrist)];
                    let moved = Moved {
                        upper: Some(PerJoint::Joints(upper.into_iter().collect())),
                        ..Moved::speed(random.between(0.2, 1.0))
                    };
                    let moved = if random.next() < 0.7 { moved } else { Moved::default() };
                    let _ = projector.move_limits(&moved);
                }
                if random.next() < 0.03 {
                    side = std::array::from_fn(|_| if random.next() < 0.5 { -1.0 } else { 1.0 });
                }
                let raw = Proposal {
                    q: (0..7).map(|i| q[i] + 10.0 * side[i]).collect(),
                    v: side.iter().map(|s| 100.0 * s).collect(),
                };
                let status = projector.project(&q, &v, &raw, &mut target);
                let ledger = &target.ledger;
                ways += usize::from(status == Status::Tightening);
                let coupled = ledger.active.iter().any(|row| row.row >= 7);
                if matches!(status, Status::Clamped | Status::Solved) && !coupled {
                    claims += 1;
                    for i in 0..7 {
                        let named = ledger.active.iter().any(|row| row.row == i && row.multiplier > 0.0);
                        assert!(
                            named,
                            "{braking:?} {seed} {tick}: joint {i} {} -> {}: {ledger:?}",
                            v[i], target.v[i]
                        );
                    }
                }
                (q, v) = (target.q.clone(), target.v.clone());
            }
        }
        println!("{braking:?}, {sub_steps} steps: {claims} claims, {ways} ticks on the way");
        assert!(claims > 3000 && ways > 100, "{claims} {ways}");
    }
}

/// A moved limit of all joints together, once it is kept, is an ordinary one: no tick is on the way to it, and a robot that is to stand still does.
#[test]
fn a_moved_speed_or_energy_is_left_again_as_it_is_proposed() {
    for (name, model) in [("small", small_arm()), ("rail", rail_arm())] {
        for (sub_steps, dt) in [(0, 0.001), (1, 0.002), (5, 0.01)] {
            for share in [0.3, 0.9] {
                let mut limits = joints(10.0, None);
                limits.push(Box::new(FrameSpeedLimit::of("tool", 0.8)));
                limits.push(Box::new(EnergyLimit::of(4.0)));
                let all: Vec<usize> = (0..model.nv()).collect();
                let mut projector =
                    Projector::new(&model, &limits, &all, Settings::new(dt, sub_steps)).unwrap();
                projector.move_limits(&Moved::speed(share)).unwrap();
                let (mut raw, mut target) = (Proposal::new(&model), Target::new(&model));
                let (mut q, mut v) = (middle(&model), vec![0.0; model.nv()]);
                let mut random = Random(5);
                let mut wish = v.clone();
                let (mut held, mut followed) = (0, 0);
                let phase = (0.6 / dt) as usize; // long enough to stop in
                for tick in 0..20 * phase {
                    if tick % phase == 0 {
                        wish.iter_mut().for_each(|w| *w = random.between(-4.0, 4.0));
                        // The other half of the time it shall stand still.
                        if tick % (2 * phase) == 0 {
                            wish.fill(0.0);
                        }
                    }
                    for i in 0..model.nv() {
                        // Never faster away from where it is than the joints can be slowed down.
                        raw.v[i] = wish[i].clamp(v[i] - 9.0 * dt, v[i] + 9.0 * dt);
                        raw.q[i] = q[i] + dt * (0.5 * raw.v[i] + 0.5 * v[i]);
                    }
                    let status = projector.project(&q, &v, &raw, &mut target);
                    assert_eq!(target.ledger.target_violations.total(), 0, "{name}, tick {tick}: {status:?}");
                    assert!(
                        status != Status::Tightening && status.is_ok(),
                        "{name} {share} {dt}, tick {tick}: {status:?} {:?}",
                        target.ledger
                    );
                    held += usize::from(target.ledger.active.iter().any(|row| row.row >= model.nv()));
                    let is_still = target.v.iter().all(|v| v.abs() < 1e-9);
                    followed += usize::from(tick % (2 * phase) == phase - 1 && is_still);
                    (q, v) = (target.q.clone(), target.v.clone());
                }
                assert!(held > 5, "{name} {share} {dt}: held in {held} ticks alone");
                assert_eq!(followed, 10, "{name} {share} {dt}: it did not stand still as it was proposed");
            }
        }
    }
}
