//! Distances between bodies: from below by a plane between them, from above by two points of theirs. The points come from projections onto one
//! body and the other in turn, which are closed forms.

use crate::limits::{CollisionSection, Of};
use crate::motion::{Machine, Spot};
use crate::robot::Shape;
use crate::space::{ONE, Place, Vec3, apply, apply_back, dot, minus, norm, product, times, turn};

/// Projections in turn at most.
const MOST: usize = 2000;
/// Solids at most: pairs are looked at one by one.
const BODIES: usize = 500;
/// Cores so near touch [m].
const TOUCHING: f64 = 1e-9;

/// A solid on the robot or in the world.
#[derive(Debug)]
struct Body {
    name: String,
    /// The frame that carries it; none for an obstacle.
    frame: Option<String>,
    spot: Spot,
    shape: Shape,
}

/// All solids, the pairs that must not meet, and what they keep.
pub(crate) struct Collision {
    bodies: Vec<Body>,
    pairs: Vec<[usize; 2]>,
    /// Distance kept [m].
    pub(crate) margin: f64,
    slots: usize,
    pub(crate) is_hard: bool,
}

/// What is known of the least distance.
pub(crate) enum Gap {
    /// Every pair is at least as far apart.
    Kept,
    /// This pair is so near [m].
    Near(String, f64),
    /// The bounds on this pair did not meet.
    Open(String),
}

impl Collision {
    pub(crate) fn new(section: &CollisionSection, of: &Of<'_>) -> Result<Collision, String> {
        let mut bodies = Vec::new();
        for s in &section.shapes {
            let spot = match &s.frame {
                Some(frame) => of.machine.spot(frame).ok_or_else(|| {
                    format!("collision names frame '{frame}', which the robot does not have")
                })?,
                None => Spot { link: None, place: Place::HERE },
            };
            let [roll, pitch, yaw] = s.rpy;
            let axes = product(&product(&turn(ONE[2], yaw), &turn(ONE[1], pitch)), &turn(ONE[0], roll));
            let place = spot.place.then(&Place { at: s.position, axes });
            let name = s.name.clone().or(s.frame.clone()).ok_or("a shape of collision has no name")?;
            bodies.push(Body { name, frame: s.frame.clone(), spot: Spot { place, ..spot }, shape: s.shape });
        }
        for solid in of.robot.solids.iter().filter(|_| section.urdf) {
            let frame = solid.body.and_then(|k| of.robot.bodies.get(k)).map_or("universe", |body| &body.name);
            let (Some(spot), Some(shape)) = (of.machine.spot(frame), solid.shape) else { continue };
            let place = spot.place.then(&solid.placement);
            bodies.push(Body {
                name: frame.to_owned(),
                frame: Some(frame.to_owned()),
                spot: Spot { place, ..spot },
                shape,
            });
        }
        if bodies.len() > BODIES {
            return Err(format!("collision has {} solids, more than {BODIES}", bodies.len()));
        }
        let called = |body: &Body, name: &str| body.name == name || body.frame.as_deref() == Some(name);
        let meet = |a: &Body, b: &Body| {
            let listed =
                |[x, y]: &[String; 2]| (called(a, x) && called(b, y)) || (called(a, y) && called(b, x));
            let linked = a.frame.is_some() && b.frame.is_some() && !section.adjacent;
            let excused =
                (linked && of.machine.are_neighbours(&a.spot, &b.spot)) || section.ignore.iter().any(listed);
            let moved = of
                .controllable
                .iter()
                .any(|i| of.machine.moves(*i, &a.spot) != of.machine.moves(*i, &b.spot));
            let planes = matches!((a.shape, b.shape), (Shape::HalfSpace, Shape::HalfSpace));
            moved && !excused && !planes
        };
        let each = |a: usize| (a + 1..bodies.len()).map(move |b| [a, b]);
        let pairs: Vec<_> =
            (0..bodies.len()).flat_map(each).filter(|[a, b]| meet(&bodies[*a], &bodies[*b])).collect();
        let slots = section.rows.min(pairs.len());
        Ok(Collision { bodies, pairs, margin: section.margin, slots, is_hard: section.soft.is_none() })
    }

    /// Names of its rows in the log.
    pub(crate) fn row_names(&self) -> Vec<String> {
        if self.pairs.len() > self.slots {
            return (1..=self.slots).map(|k| format!("pair {k} by distance")).collect();
        }
        self.pairs.iter().map(|pair| self.name(pair)).collect()
    }

    fn name(&self, [a, b]: &[usize; 2]) -> String {
        format!("{} and {}", self.bodies[*a].name, self.bodies[*b].name)
    }

    /// Whether every pair is at least `least` apart [m] at the last [`Machine::go`].
    pub(crate) fn gap(&self, machine: &Machine, least: f64) -> Gap {
        let places: Vec<Place> = self.bodies.iter().map(|body| machine.place(&body.spot)).collect();
        for pair in &self.pairs {
            let solid = |k: usize| Solid { shape: self.bodies[k].shape, at: places[k] };
            let (a, b) = (solid(pair[0]), solid(pair[1]));
            match bounds(&a, &b, least) {
                (from, _) if from >= least => {}
                (_, to) if to < least => return Gap::Near(self.name(pair), to),
                _ => return Gap::Open(self.name(pair)),
            }
        }
        Gap::Kept
    }
}

/// A shape somewhere in the world, as a core and a radius around it.
struct Solid {
    shape: Shape,
    at: Place,
}

impl Solid {
    fn radius(&self) -> f64 {
        match self.shape {
            Shape::Sphere { radius } | Shape::Capsule { radius, .. } => radius,
            _ => 0.0,
        }
    }

    /// The point of the core that is nearest to `x`.
    fn nearest(&self, x: Vec3) -> Vec3 {
        let [a, b, c] = apply_back(&self.at.axes, minus(x, self.at.at));
        let own = match self.shape {
            Shape::Sphere { .. } => [0.0; 3],
            Shape::Capsule { length, .. } => [0.0, 0.0, c.clamp(-0.5 * length, 0.5 * length)],
            Shape::Box { size: [x, y, z] } => {
                [a.clamp(-0.5 * x, 0.5 * x), b.clamp(-0.5 * y, 0.5 * y), c.clamp(-0.5 * z, 0.5 * z)]
            }
            Shape::Cylinder { radius, length } => {
                let out = a.hypot(b);
                let share = if out > radius { radius / out } else { 1.0 };
                [share * a, share * b, c.clamp(-0.5 * length, 0.5 * length)]
            }
            Shape::HalfSpace => [a, b, c.min(0.0)],
        };
        self.at.point(own)
    }

    /// How far the core reaches along the unit vector `n`.
    fn reach(&self, n: Vec3) -> f64 {
        let [a, b, c] = apply_back(&self.at.axes, n);
        let own = match self.shape {
            Shape::Sphere { .. } => 0.0,
            Shape::Capsule { length, .. } => 0.5 * length * c.abs(),
            Shape::Box { size: [x, y, z] } => 0.5 * (x * a.abs() + y * b.abs() + z * c.abs()),
            Shape::Cylinder { radius, length } => radius * a.hypot(b) + 0.5 * length * c.abs(),
            Shape::HalfSpace => f64::INFINITY,
        };
        dot(n, self.at.at) + own
    }
}

/// Bounds on the distance of two solids from below and from above [m], until it is known whether it is at least `least`.
fn bounds(a: &Solid, b: &Solid, least: f64) -> (f64, f64) {
    let around = a.radius() + b.radius();
    for (plane, other) in [(a, b), (b, a)] {
        if matches!(plane.shape, Shape::HalfSpace) {
            let up = apply(&plane.at.axes, ONE[2]);
            let low = -other.reach(times(-1.0, up)) - dot(up, plane.at.at) - around;
            return (low, low);
        }
    }
    let mut x = a.nearest(b.at.at);
    let (mut from, mut to) = (f64::NEG_INFINITY, f64::INFINITY);
    for _ in 0..MOST {
        let y = b.nearest(x);
        x = a.nearest(y);
        let between = minus(y, x);
        let distance = norm(between);
        to = f64::min(to, distance - around);
        if distance < TOUCHING {
            return (f64::NEG_INFINITY, least.min(0.0) - TOUCHING); // the cores are in each other
        }
        let n = times(1.0 / distance, between);
        let opposite = -b.reach(times(-1.0, n));
        from = f64::max(from, opposite - a.reach(n) - around);
        if from >= least || to < least {
            break;
        }
    }
    (from, to)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn solid(shape: Shape, at: Vec3, axes: crate::space::Mat3) -> Solid {
        Solid { shape, at: Place { at, axes } }
    }

    /// Distances by hand.
    #[test]
    fn distances_are_those_of_plane_geometry() {
        let cube =
            |x: f64, angle: f64| solid(Shape::Box { size: [1.0; 3] }, [x, 0.0, 0.0], turn(ONE[2], angle));
        let ball = solid(Shape::Sphere { radius: 0.2 }, [2.0, 0.0, 0.0], ONE);
        let rod = solid(
            Shape::Capsule { radius: 0.1, length: 1.0 },
            [0.0, 0.0, 2.0],
            turn(ONE[0], std::f64::consts::FRAC_PI_2),
        );
        let floor = solid(Shape::HalfSpace, [0.0, 0.0, -1.0], ONE);
        let drum = solid(Shape::Cylinder { radius: 0.5, length: 2.0 }, [3.0, 0.0, 0.0], ONE);
        let quarter = std::f64::consts::FRAC_PI_4;
        let cases = [
            (cube(0.0, 0.0), &ball, 1.3),
            (cube(0.0, quarter), &ball, 1.8 - 0.5 * 2f64.sqrt()),
            (cube(0.0, 0.0), &rod, 1.4),
            (cube(0.0, 0.0), &floor, 0.5),
            (cube(0.0, quarter), &drum, 2.5 - 0.5 * 2f64.sqrt()),
        ];
        for (a, b, distance) in cases {
            let (from, to) = bounds(&a, b, distance - 1e-9);
            assert!(from >= distance - 1e-9, "{from} {distance}");
            assert!(to >= distance - 1e-12, "{to} {distance}");
            let (_, to) = bounds(&a, b, distance + 1e-9);
            assert!(to < distance + 1e-9 && to > distance - 1e-9, "{to} {distance}");
        }
    }

    #[test]
    fn bodies_in_each_other_are_not_apart() {
        let cube = |x: f64| solid(Shape::Box { size: [1.0; 3] }, [x, 0.0, 0.0], ONE);
        let (from, to) = bounds(&cube(0.0), &cube(0.9), 0.0);
        assert!(from < 0.0 && to <= 0.0, "{from} {to}");
    }
}
