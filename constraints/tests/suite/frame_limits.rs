//! Limits on frames, energy and collisions: rows against finite differences, the checker against the rows, closed loops that never
//! break them, messages.

use crate::common::solids::*;
use crate::common::*;
use nearl_constraints::geometry::{Shape, separation};
use nearl_constraints::limit::{CollisionSettings, FrameSettings};
use nearl_constraints::row::{Motion, RowsMut, TickStart};
use nearl_constraints::*;

const DT: f64 = 1e-3;

/// A state and an acceleration somewhere inside the Panda's limits.
fn panda_state(random: &mut Random) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
    let m = panda();
    let between = |r: &mut Random, i: usize| {
        let (low, high) = (m.lower_position_limit()[i], m.upper_position_limit()[i]);
        r.between(low, high)
    };
    let q = (0..7).map(|i| between(random, i)).collect();
    let v = (0..7).map(|_| random.between(-1.5, 1.5)).collect();
    (q, v, (0..7).map(|_| random.between(-10.0, 10.0)).collect())
}

struct Filled {
    g: Vec<f64>,
    lower: Vec<f64>,
    upper: Vec<f64>,
}

fn fill(rows: &mut dyn Rows, model: &Model, q: &[f64], v: &[f64], period: &Period) -> Filled {
    let (nv, n) = (model.nv(), rows.sizes().len());
    let mut kinematics = Kinematics::new(model);
    kinematics.update(q, v, &vec![0.0; nv]);
    let mut f =
        Filled { g: vec![0.0; n * nv], lower: vec![f64::NEG_INFINITY; n], upper: vec![f64::INFINITY; n] };
    let mut tick = TickStart {
        q,
        v,
        period,
        mass: &[],
        motors: &[],
        bias: &[],
        kinematics: &mut kinematics,
        previous: None,
    };
    let (g, lower, upper) = (&mut f.g[..], &mut f.lower[..], &mut f.upper[..]);
    let outside = &mut vec![false; n][..];
    rows.fill(&mut tick, &mut RowsMut { g, lower, upper, outside, nv });
    f
}

fn excess_of(
    rows: &mut dyn Rows,
    model: &Model,
    q: &[f64],
    v: &[f64],
    y: &[f64],
    period: &Period,
) -> Vec<f64> {
    let nv = model.nv();
    let a: Vec<f64> = y.iter().map(|y| y / period.dt).collect();
    let v_next: Vec<f64> = (0..nv).map(|i| v[i] + y[i]).collect();
    let (mut q_next, mut d) = (q.to_vec(), Dynamics::new(model));
    let step: Vec<f64> = (0..nv).map(|i| period.dt * (v[i] + period.kappa * y[i])).collect();
    d.integrate(q, &step, &mut q_next);
    let mut kinematics = Kinematics::new(model);
    kinematics.update(q, v, &a);
    let mut excess = vec![f64::NAN; rows.sizes().len()];
    let mut motion = Motion {
        q,
        v,
        q_next: &q_next,
        v_next: &v_next,
        acceleration: &a,
        torque: &[],
        mass: &[],
        period,
        kinematics: &mut kinematics,
        previous: None,
    };
    rows.excess(&mut motion, &mut excess);
    excess
}

/// What rows and cones do by themselves, without a stored brake.
fn rows_alone(dt: f64, sub_steps: u32) -> Settings {
    Settings { braking: Braking::Certified, ..Settings::new(dt, sub_steps) }
}

/// A little beyond the row's bound the checker says so, a little inside it accepts. The checker uses no Jacobian.
#[test]
fn rows_and_checker_draw_the_same_line() {
    let m = panda();
    let frame = FrameLimit::inside("panda_hand", [0.2, -0.4, 0.1], [0.7, 0.4, 0.8], 3.0);
    let tilted = FrameLimit::new(FrameSettings {
        point: [0.05, 0.0, 0.1],
        margin: 0.01,
        half_space: Some(limit::HalfSpace { normal: [1.0, -2.0, 0.5], through: [0.4, 0.1, 0.4] }),
        ..toml::from_str("frame = \"panda_link7\"\nbraking = 2.0").unwrap()
    });
    let limits: [(&dyn Limit, u32); 3] = [(&frame, 300), (&tilted, 300), (&panda_collision(40, 0.4), 300)];
    for (limit, ticks) in limits {
        let mut rows = limit.rows(&m, &[0, 1, 2, 3, 4, 5, 6]).unwrap().unwrap();
        let (mut random, mut lines) = (Random(3), 0);
        for k in 0..ticks {
            let period = Period::new(DT, k % 3);
            let (q, v, a) = panda_state(&mut random);
            let f = fill(&mut *rows, &m, &q, &v, &period);
            for r in (0..f.upper.len()).filter(|r| f.upper[*r].is_finite()) {
                let g = &f.g[7 * r..7 * r + 7];
                let length: f64 = g.iter().map(|x| x * x).sum();
                let value: f64 = g.iter().zip(&a).map(|(g, a)| g * a * DT).sum();
                let size = rows.sizes()[r];
                if length * DT * DT < 1e-4 {
                    continue; // no joint moves the two apart
                }
                for beyond in [-1e-6, 1e-6] {
                    // The nearest acceleration whose row stands `beyond` its bound.
                    let to = (f.upper[r] + beyond * size.max(f.upper[r].abs()) - value) / length;
                    let y: Vec<f64> = (0..7).map(|i| a[i] * DT + to * g[i]).collect();
                    let excess = excess_of(&mut *rows, &m, &q, &v, &y, &period)[r];
                    let name = &rows.names()[r];
                    assert_eq!(
                        excess > 1e-9,
                        beyond > 0.0,
                        "{name}: {excess} at {beyond}, bound {}",
                        f.upper[r]
                    );
                }
                lines += 1;
            }
        }
        println!("{}: {lines} rows", limit.name());
        assert!(lines > 200, "{lines}");
    }
}

/// The row is the gradient of the distance, found by moving the joints.
#[test]
fn collision_rows_are_gradients_of_distances() {
    const H: f64 = 1e-6;
    let (m, mut random, mut seen) = (panda(), Random(11), 0);
    let bodies = panda_solids();
    let mut rows = panda_collision(40, 0.4).rows(&m, &[0, 1, 2, 3, 4, 5, 6]).unwrap().unwrap();
    let names = rows.names();
    let distance = |name: &str, q: &[f64]| {
        let mut k = Kinematics::new(&m);
        k.update(q, &[0.0; 7], &[0.0; 7]);
        let (a, b) = name.split_once(" and ").unwrap();
        let mut place = |name: &str| {
            let s = bodies.iter().find(|s| s.name.as_deref().or(s.frame.as_deref()) == Some(name)).unwrap();
            let f = k.frame(s.frame.as_ref().map_or(FrameId::WORLD, |f| m.frame(f).unwrap()));
            let at = geometry::Placement { position: f.position, rotation: f.rotation };
            (s.shape, at.then(&geometry::Placement::new(s.position, s.rpy)))
        };
        let ((a, at_a), (b, at_b)) = (place(a), place(b));
        separation((&a, &at_a), (&b, &at_b), 10.0).unwrap().distance
    };
    for _ in 0..200 {
        let (q, ..) = panda_state(&mut random);
        let f = fill(&mut *rows, &m, &q, &[0.0; 7], &Period::new(DT, 0));
        for r in (0..names.len()).filter(|r| f.upper[*r].is_finite()) {
            if distance(&names[r], &q) < 0.01 {
                continue; // where solids overlap, the depth may be overstated
            }
            for i in 0..7 {
                let moved = |h: f64| {
                    let mut q = q.clone();
                    q[i] += h;
                    distance(&names[r], &q)
                };
                let slope = (moved(H) - moved(-H)) / (2.0 * H);
                let ours = -f.g[7 * r + i] * DT; // the row is of the closing speed
                assert!((slope - ours).abs() < 2e-3, "{} joint {i}: {slope} {ours}", names[r]);
                seen += 1;
            }
        }
    }
    assert!(seen > 3000, "{seen}");
}

/// Random and bang-bang proposals against a floor, a post, a box and the arm itself, closed loop.
#[test]
fn no_proposal_closes_a_distance() {
    let m = panda();
    let mut limits = panda_limits(None);
    limits.push(Box::new(panda_collision(40, 0.8)));
    let mut projector = Projector::new(&m, &limits, &[0, 1, 2, 3, 4, 5, 6], rows_alone(DT, 1)).unwrap();
    let bodies = panda_solids();
    let mut k = Kinematics::new(&m);
    let mut least = |q: &[f64]| {
        k.update_frames(q, &[0.0; 7], &[0.0; 7]);
        let at: Vec<_> = bodies
            .iter()
            .map(|s| {
                let f = k.frame(s.frame.as_ref().map_or(FrameId::WORLD, |f| m.frame(f).unwrap()));
                let own = geometry::Placement { position: f.position, rotation: f.rotation };
                own.then(&geometry::Placement::new(s.position, s.rpy))
            })
            .collect();
        let mut least = f64::INFINITY;
        for a in 0..6 {
            for b in (a + 2..9).filter(|b| !(a == 0 && *b == 6)) {
                if let Some(s) = separation((&bodies[a].shape, &at[a]), (&bodies[b].shape, &at[b]), 1.0) {
                    least = least.min(s.distance);
                }
            }
        }
        least
    };
    let (mut random, mut target) = (Random(1), Target::new(&m));
    let (mut worst, mut active, mut braked) = (f64::INFINITY, 0, 0);
    for episode in 0..8 {
        let (mut q, mut v) = (vec![0.0, -0.3, 0.0, -1.8, 0.0, 1.5, 0.0], vec![0.0; 7]);
        assert!(least(&q) > 0.01);
        let mut pull = [0.0; 7];
        for tick in 0..2500 {
            if tick % 400 == 0 {
                pull = [0; 7].map(|_| random.between(-1.0, 1.0).signum() * 0.05);
            }
            let noise = if episode % 2 == 0 { 0.0 } else { 0.05 };
            let y: Vec<f64> = (0..7).map(|i| pull[i] + noise * random.between(-1.0, 1.0)).collect();
            let raw = consistent(&projector, &q, &v, &y);
            projector.project(&q, &v, &raw, &mut target);
            active += usize::from(target.ledger.active.iter().any(|a| a.kind == Kind::Collision));
            braked += usize::from(target.ledger.rung == Rung::Brake);
            q.copy_from_slice(&target.q);
            v.copy_from_slice(&target.v);
            worst = worst.min(least(&q));
        }
    }
    println!("least distance {worst:.6} m (margin 0.005), {active} of 20000 ticks at a row, {braked} braked");
    assert!(worst > 0.005 - 2e-5 && active > 5000 && braked == 0, "{worst} {active} {braked}");
}

/// A point pulled through a floor stops in front of it; what linearisation lets through is measured.
#[test]
fn a_hand_stops_in_front_of_a_plane() {
    let m = panda();
    for sub_steps in [0, 1, 4] {
        let mut limits = panda_limits(None);
        limits.push(Box::new(FrameLimit::half_space("panda_hand", [0.0, 0.0, -1.0], [0.0, 0.0, 0.2], 1.5)));
        let settings = rows_alone(DT, sub_steps);
        let mut projector = Projector::new(&m, &limits, &[0, 1, 2, 3, 4, 5, 6], settings).unwrap();
        let (mut random, mut target, mut k) = (Random(9), Target::new(&m), Kinematics::new(&m));
        let hand = m.frame("panda_hand").unwrap();
        let (mut lowest, mut active) = (f64::INFINITY, 0);
        for _ in 0..6 {
            let (mut q, mut v) = (vec![0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], vec![0.0; 7]);
            let pull = [0; 7].map(|_| random.between(-0.02, 0.02));
            for _ in 0..1500 {
                let down = [0.0, 0.03, 0.0, -0.02, 0.0, 0.0, 0.0];
                let y: Vec<f64> = (0..7).map(|i| pull[i] + down[i]).collect();
                let raw = consistent(&projector, &q, &v, &y);
                projector.project(&q, &v, &raw, &mut target);
                active += usize::from(target.ledger.active.iter().any(|a| a.kind == Kind::Frame));
                q.copy_from_slice(&target.q);
                v.copy_from_slice(&target.v);
                k.update_frames(&q, &v, &v);
                lowest = lowest.min(k.frame(hand).position[2]);
            }
        }
        println!("sub-steps {sub_steps}: lowest {lowest:.9} m above a plane at 0.2, {active} ticks at it");
        assert!(lowest > 0.2 - 1e-6 && active > 500, "{lowest} {active}");
    }
}

/// Fast swings at 10 ms: the closing speed changes by more than `braking` in a period while no joint accelerates.
#[test]
fn a_ball_stops_in_front_of_a_floor_however_fast_the_joints_turn() {
    let (m, dt) = (panda(), 0.01);
    let ball = solid("panda_hand", Shape::Sphere { radius: 0.05 }, [0.0; 3]);
    let floor = obstacle("floor", Shape::HalfSpace, [0.0, 0.0, 0.15]);
    let mut limits = panda_limits(None);
    let near = CollisionSettings { braking: 0.5, influence: 8.0, margin: 0.0, ..settings(&[ball, floor]) };
    limits.push(Box::new(CollisionLimit::new(near)));
    let mut projector = Projector::new(&m, &limits, &[0, 1, 2, 3, 4, 5, 6], rows_alone(dt, 1)).unwrap();
    let (mut random, mut target, mut k) = (Random(4), Target::new(&m), Kinematics::new(&m));
    let (hand, mut lowest, mut active) = (m.frame("panda_hand").unwrap(), f64::INFINITY, 0);
    for _ in 0..40 {
        let (mut q, mut v) = (vec![0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], vec![0.0; 7]);
        let mut pull = [0.0; 7];
        for tick in 0..300 {
            if tick % 60 == 0 {
                pull = [0; 7].map(|_| random.between(-1.0, 1.0).signum());
            }
            let raw = consistent(&projector, &q, &v, &pull);
            projector.project(&q, &v, &raw, &mut target);
            active += usize::from(target.ledger.active.iter().any(|a| a.kind == Kind::Collision));
            q.copy_from_slice(&target.q);
            v.copy_from_slice(&target.v);
            k.update_frames(&q, &v, &v);
            lowest = lowest.min(k.frame(hand).position[2] - 0.05);
        }
    }
    println!("lowest {lowest:.9} m above a floor at 0.15, {active} ticks at it");
    assert!(lowest > 0.15 - 2e-5 && active > 1000, "{lowest} {active}");
}

/// Speed of the hand and energy of the robot against what they mean, at every tick.
#[test]
fn cones_hold_speed_and_energy() {
    let m = panda();
    let hand = m.frame("panda_hand").unwrap();
    let cones: [(Box<dyn Limit>, Kind); 2] = [
        (Box::new(FrameSpeedLimit::of("panda_hand", 0.25)), Kind::FrameSpeed),
        (Box::new(EnergyLimit::of(0.8)), Kind::Energy),
    ];
    for (cone, kind) in cones {
        let mut limits = panda_limits(None);
        limits.push(cone);
        let mut projector = Projector::new(&m, &limits, &[0, 1, 2, 3, 4, 5, 6], rows_alone(DT, 1)).unwrap();
        let (mut random, mut target) = (Random(2), Target::new(&m));
        let (mut k, mut dynamics) = (Kinematics::new(&m), Dynamics::new(&m));
        let (mut q, mut v) = (vec![0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], vec![0.0; 7]);
        let (mut pull, mut largest, mut active, mut failed) = ([0.0; 7], 0.0f64, 0, 0);
        for tick in 0..2000 {
            if tick % 250 == 0 {
                pull = [0; 7].map(|_| random.between(-0.02, 0.02));
            }
            let raw = consistent(&projector, &q, &v, &pull);
            projector.project(&q, &v, &raw, &mut target);
            let ahead: Vec<f64> = (0..7).map(|i| q[i] + DT * v[i]).collect();
            let value = match kind {
                Kind::FrameSpeed => {
                    k.update_frames(&ahead, &target.v, &target.v);
                    k.frame(hand).velocity.iter().map(|x| x * x).sum::<f64>().sqrt() / 0.25
                }
                _ => {
                    let (mut with, mut without) = (vec![0.0; 7], vec![0.0; 7]);
                    dynamics.rnea(&ahead, &[0.0; 7], &target.v, &mut with);
                    dynamics.rnea(&ahead, &[0.0; 7], &[0.0; 7], &mut without);
                    (0..7).map(|i| 0.5 * target.v[i] * (with[i] - without[i])).sum::<f64>() / 0.8
                }
            };
            if target.ledger.rung == Rung::Brake {
                failed += 1;
            } else {
                largest = largest.max(value);
            }
            active += usize::from(target.ledger.active.iter().any(|a| a.kind == kind));
            q.copy_from_slice(&target.q);
            v.copy_from_slice(&target.v);
        }
        println!("{kind:?}: largest share {largest:.9}, {active} of 2000 ticks at the cone, {failed} braked");
        assert!(largest <= 1.0 + 1e-8 && active > 200 && failed < 20, "{kind:?} {largest} {active} {failed}");
    }
}

#[test]
fn a_floating_robot_watches_its_nearest_pairs() {
    let m = free("anymal/anymal.urdf");
    let nv = m.nv();
    let mut rows = CollisionLimit::new(CollisionSettings {
        urdf: true,
        shapes: vec![obstacle("floor", Shape::HalfSpace, [0.0; 3])],
        rows: 16,
        ..settings(&[])
    })
    .rows(&m, &(0..nv).collect::<Vec<_>>())
    .unwrap()
    .unwrap();
    assert_eq!((rows.names().len(), rows.names()[0].as_str()), (16, "pair 1 by distance"));
    let mut q = m.neutral();
    q[2] = 0.6;
    let f = fill(&mut *rows, &m, &q, &vec![0.0; nv], &Period::new(DT, 1));
    assert!(f.upper.iter().any(|u| u.is_finite()));
    // Nearest first: the slack of rows at rest grows with the distance.
    let finite: Vec<f64> = f.upper.iter().copied().filter(|u| u.is_finite()).collect();
    assert!(finite.windows(2).all(|w| w[0] <= w[1] + 1e-9), "{finite:?}");
}

#[test]
fn messages_name_the_frame() {
    let m = panda();
    let refuse = |limit: &dyn Limit, dofs: &[usize], words: &[&str]| {
        let text =
            limit.rows(&m, dofs).err().or_else(|| limit.cone(&m, dofs).err()).expect("an error").to_string();
        words.iter().for_each(|w| assert!(text.contains(w), "'{w}' is not in: {text}"));
    };
    let plane = |frame: &str, n| FrameLimit::half_space(frame, n, [0.0; 3], 5.0);
    refuse(&plane("panda_hnad", [0.0, 0.0, 1.0]), &[0], &["'panda_hnad'", "did you mean 'panda_hand'"]);
    refuse(&plane("panda_hand", [0.0; 3]), &[0], &["normal of frame 'panda_hand'", "is 0"]);
    refuse(
        &plane("panda_link2", [0.0, 0.0, 1.0]),
        &[5, 6],
        &["'panda_link2'", "no controllable joint moves"],
    );
    refuse(&FrameLimit::inside("panda_hand", [0.0; 3], [1.0, 0.0, 1.0], 5.0), &[0], &["above 0", "along y"]);
    refuse(
        &FrameLimit::inside("panda_hand", [0.0; 3], [1.0; 3], -5.0),
        &[0],
        &["braking of frame 'panda_hand' is -5"],
    );
    refuse(&FrameSpeedLimit::of("panda_hand", f64::NAN), &[0], &["speed limit of frame 'panda_hand' is NaN"]);
    refuse(&EnergyLimit::of(0.0), &[0], &["energy limit is 0", "J"]);
    let ball = Shape::Sphere { radius: 0.1 };
    let two = [solid("panda_hand", ball, [0.0; 3]), obstacle("floor", Shape::HalfSpace, [0.0; 3])];
    let with = |f: &dyn Fn(&mut CollisionSettings)| {
        let mut s = settings(&two);
        f(&mut s);
        CollisionLimit::new(s)
    };
    refuse(&with(&|s| s.shapes[0].frame = Some("hand".into())), &[0], &["'hand'", "panda_hand"]);
    refuse(
        &with(&|s| s.shapes[0].shape = Shape::Sphere { radius: -0.1 }),
        &[0],
        &["radius of shape 'panda_hand' is -0.1"],
    );
    refuse(
        &with(&|s| s.ignore = vec![["panda_hand".into(), "flor".into()]]),
        &[0],
        &["'flor'", "did you mean 'floor'"],
    );
    refuse(&with(&|s| s.urdf = true), &[0], &["no primitive collision geometry"]);
    refuse(&with(&|s| s.shapes.truncate(1)), &[0], &["no two solids"]);
    refuse(&with(&|s| s.influence = 0.001), &[0], &["influence is 0.001", "above the margin"]);
    let mesh = r#"<robot name="r"><link name="a"><collision><geometry><box size="1 1 1"/></geometry></collision></link>
        <link name="b"><collision><geometry><mesh filename="b.stl"/></geometry></collision>
        <inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
        <joint name="j" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint></robot>"#;
    let (m, limit) =
        (Model::from_urdf_text(mesh).unwrap(), with(&|s| (s.urdf, s.shapes) = (true, Vec::new())));
    let text = limit.rows(&m, &[0]).err().unwrap().to_string();
    assert!(text.contains("'b'") && text.contains("mesh"), "{text}");
    for (from, to, said) in [
        ("1 1 1", "1 x", "box size is '1 x', not three numbers"),
        ("1 1 1", "1 1", "box size is '1 1', not three numbers"),
        ("<box size=\"1 1 1\"/>", "<sphere radius=\"1 7\"/>", "sphere radius is '1 7', not one number"),
        ("<collision>", "<collision><origin xyz=\"0 0\"/>", "origin xyz is '0 0', not three numbers"),
    ] {
        let text = Model::from_urdf_text(&mesh.replacen(from, to, 1)).err().unwrap().to_string();
        assert!(text.contains(&format!("link 'a' collision {said}")), "{text}");
    }
}
