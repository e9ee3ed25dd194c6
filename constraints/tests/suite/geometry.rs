//! Distances between solids: worked by hand, and against a search over points of both.

use crate::common::Random;
use nearl_constraints::geometry::{Placement, Separation, Shape, separation};

const FAR: f64 = 1e9;

fn at(position: [f64; 3], rpy: [f64; 3]) -> Placement {
    Placement::new(position, rpy)
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Both orders agree; the normal is a unit vector along the nearest points.
fn apart(a: (&Shape, &Placement), b: (&Shape, &Placement)) -> Separation {
    let (s, t) = (separation(a, b, FAR).unwrap(), separation(b, a, FAR).unwrap());
    assert!((s.distance - t.distance).abs() < 1e-7 * (1.0 + s.distance.abs()), "{s:?} {t:?}");
    assert!((dot(s.normal, s.normal) - 1.0).abs() < 1e-12, "{s:?}");
    let gap = [0, 1, 2].map(|k| s.points[1][k] - s.points[0][k]);
    assert!((dot(gap, s.normal) - s.distance).abs() < 1e-9, "{s:?}");
    s
}

#[test]
fn distances_worked_by_hand() {
    use std::f64::consts::FRAC_PI_2;
    let ball = Shape::Sphere { radius: 0.1 };
    let capsule = Shape::Capsule { radius: 0.05, length: 0.4 };
    let cylinder = Shape::Cylinder { radius: 0.2, length: 1.0 };
    let cube = Shape::Box { size: [0.2, 0.4, 0.6] };
    let (o, x) = (at([0.0; 3], [0.0; 3]), |x: f64| at([x, 0.0, 0.0], [0.0; 3]));
    let lying = |p| at(p, [0.0, FRAC_PI_2, 0.0]); // own z along x
    let turned = |p| at(p, [0.0, 0.0, FRAC_PI_2 / 2.0]); // by 45 degrees about z
    type Solid<'a> = (&'a Shape, Placement);
    let cases: [(&str, Solid, Solid, f64); 15] = [
        ("balls", (&ball, o), (&ball, x(1.0)), 0.8),
        ("balls overlapping", (&ball, o), (&ball, x(0.15)), -0.05),
        ("upright capsules", (&capsule, o), (&capsule, x(0.3)), 0.2),
        ("capsule beside the end of another", (&capsule, o), (&capsule, lying([0.5, 0.0, 0.0])), 0.2),
        ("crossing capsules", (&capsule, o), (&capsule, lying([0.0, 0.12, 0.0])), 0.02),
        ("ball above a capsule", (&ball, at([0.0, 0.0, 0.5], [0.0; 3])), (&capsule, o), 0.15),
        ("ball at a box face", (&ball, x(0.5)), (&cube, o), 0.3),
        ("ball at a box corner", (&ball, at([0.4, 0.6, 0.3], [0.0; 3])), (&cube, o), 0.4),
        ("ball at a cylinder's side", (&ball, x(0.7)), (&cylinder, o), 0.4),
        ("ball in a box", (&ball, x(0.05)), (&cube, o), -0.15),
        ("boxes face to face", (&cube, o), (&cube, x(0.5)), 0.3),
        ("edge of a turned box", (&cube, o), (&cube, turned([0.6, 0.0, 0.0])), 0.5 - 0.3 / 2f64.sqrt()),
        ("boxes overlapping", (&cube, o), (&cube, x(0.17)), -0.03),
        ("cylinder beside a cylinder", (&cylinder, o), (&cylinder, x(0.5)), 0.1),
        ("lying cylinder at a box", (&cylinder, lying([1.0, 0.0, 0.0])), (&cube, o), 0.4),
    ];
    for (name, (a, pa), (b, pb), distance) in cases {
        let s = apart((a, &pa), (b, &pb));
        assert!((s.distance - distance).abs() < 1e-7, "{name}: {s:?}, not {distance}");
    }
}

#[test]
fn solids_over_a_floor() {
    let floor = at([5.0, -3.0, 0.25], [0.0; 3]);
    let ramp = at([0.0; 3], [0.5, 0.0, 0.0]); // normal (0, -sin, cos)
    let up = |s: &Separation| assert!(s.normal[2] < -0.999, "{s:?}");
    let lowest = [
        (Shape::Sphere { radius: 0.1 }, 0.1),
        (Shape::Capsule { radius: 0.05, length: 0.4 }, 0.25),
        (Shape::Cylinder { radius: 0.2, length: 1.0 }, 0.5),
        (Shape::Box { size: [0.2, 0.4, 0.6] }, 0.3),
    ];
    for (shape, reach) in lowest {
        for z in [2.0, 0.3] {
            let s = apart((&shape, &at([0.0, 0.0, z], [0.0; 3])), (&Shape::HalfSpace, &floor));
            assert!((s.distance - (z - 0.25 - reach)).abs() < 1e-12, "{shape:?} {s:?}");
            up(&s);
        }
    }
    let ball = Shape::Sphere { radius: 0.1 };
    let s = apart((&ball, &at([0.0, 0.0, 1.0], [0.0; 3])), (&Shape::HalfSpace, &ramp));
    assert!((s.distance - (0.5f64.cos() - 0.1)).abs() < 1e-12, "{s:?}");
    assert!(separation((&Shape::HalfSpace, &floor), (&Shape::HalfSpace, &ramp), FAR).is_none());
    assert!(separation((&ball, &at([0.0, 0.0, 9.0], [0.0; 3])), (&Shape::HalfSpace, &floor), 1.0).is_none());
}

fn random_shape(random: &mut Random) -> Shape {
    let mut size = || random.between(0.05, 0.6);
    let (radius, length, third) = (size(), size(), size());
    match (random.next() * 4.0) as u32 {
        0 => Shape::Sphere { radius },
        1 => Shape::Capsule { radius, length },
        2 => Shape::Cylinder { radius, length },
        _ => Shape::Box { size: [radius, length, third] },
    }
}

fn random_place(random: &mut Random, spread: f64) -> Placement {
    let mut three = |size: f64| [0; 3].map(|_| random.between(-size, size));
    at(three(spread), three(3.0))
}

/// The nearest point of a solid to `p`, by definition of each solid, in the solid's own axes.
fn nearest(shape: &Shape, place: &Placement, p: [f64; 3]) -> [f64; 3] {
    let r = [0, 1, 2].map(|k| p[k] - place.position[k]);
    let own = [0, 1, 2].map(|k| (0..3).map(|i| place.rotation[i][k] * r[i]).sum::<f64>());
    let ball = |x: [f64; 3], centre: [f64; 3], radius: f64| {
        let d = [0, 1, 2].map(|k| x[k] - centre[k]);
        let far = dot(d, d).sqrt().max(radius);
        [0, 1, 2].map(|k| centre[k] + d[k] * radius / far)
    };
    let local = match *shape {
        Shape::Sphere { radius } => ball(own, [0.0; 3], radius),
        Shape::Capsule { radius, length } => {
            ball(own, [0.0, 0.0, own[2].clamp(-0.5 * length, 0.5 * length)], radius)
        }
        Shape::Cylinder { radius, length } => {
            let flat = ball([own[0], own[1], 0.0], [0.0; 3], radius);
            [flat[0], flat[1], own[2].clamp(-0.5 * length, 0.5 * length)]
        }
        Shape::Box { size } => [0, 1, 2].map(|k| own[k].clamp(-0.5 * size[k], 0.5 * size[k])),
        Shape::HalfSpace => [own[0], own[1], own[2].min(0.0)],
    };
    place.place(local)
}

/// Alternating projections converge to the nearest points of two convex solids.
#[test]
fn distances_are_those_of_alternating_projections() {
    let (mut random, mut compared, mut overlapping) = (Random(5), 0, 0);
    for _ in 0..3000 {
        let (a, b) = (random_shape(&mut random), random_shape(&mut random));
        let (pa, pb) = (random_place(&mut random, 0.7), random_place(&mut random, 0.7));
        let s = apart((&a, &pa), (&b, &pb));
        let mut p = s.points[0]; // any start will do; a wrong one of ours would be left behind
        for k in 0..4000 {
            let q = nearest(&b, &pb, p);
            let back = nearest(&a, &pa, q);
            let moved = [0, 1, 2].map(|i| back[i] - p[i]);
            p = back;
            if k > 10 && dot(moved, moved) < 1e-24 {
                break;
            }
        }
        let d = {
            let q = nearest(&b, &pb, p);
            let d = [0, 1, 2].map(|i| q[i] - p[i]);
            dot(d, d).sqrt()
        };
        if s.distance > 1e-3 {
            assert!((d - s.distance).abs() < 1e-5, "{a:?} {b:?} {pa:?} {pb:?}: {s:?}, searched {d}");
            compared += 1;
        } else if s.distance < -1e-3 {
            assert!(d < 1e-3, "{a:?} {b:?}: {s:?}, but {d} apart");
            overlapping += 1;
        }
    }
    assert!(compared > 1000 && overlapping > 300, "{compared} {overlapping}");
}

/// Moving the second solid along the normal by the depth parts the two: an overlap is never understated.
#[test]
fn the_depth_of_an_overlap_parts_the_two() {
    let (mut random, mut seen) = (Random(6), 0);
    for _ in 0..2000 {
        let (a, b) = (random_shape(&mut random), random_shape(&mut random));
        let (pa, mut pb) = (random_place(&mut random, 0.2), random_place(&mut random, 0.2));
        let s = separation((&a, &pa), (&b, &pb), FAR).unwrap();
        if s.distance < 0.0 {
            pb.position = [0, 1, 2].map(|k| pb.position[k] - (s.distance - 1e-6) * s.normal[k]);
            let parted = separation((&a, &pa), (&b, &pb), FAR).unwrap();
            assert!(parted.distance > -1e-5, "{a:?} {b:?} {s:?} {parted:?}");
            seen += 1;
        }
    }
    assert!(seen > 1000, "{seen}");
}
