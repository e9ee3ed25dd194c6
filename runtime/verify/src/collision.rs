//! Distances between bodies, enclosed from both sides: a plane between two bodies bounds their distance from below, a point of each from above.
//! The points come from projections onto one body and the other in turn, which are closed forms.

use std::collections::BTreeMap;

use crate::limits::{CollisionSection, Of};
use crate::motion::{Machine, Spot};
use crate::moved::Pose;
use crate::period::Period;
use crate::robot::Shape;
use crate::rows::{Passage, plane};
use crate::space::{ONE, Place, Vec3, apply, apply_back, dot, minus, norm, product, times, turn};

/// Projections in turn at most.
const MOST: usize = 2000;
/// Solids at most: pairs are looked at one by one.
const BODIES: usize = 500;
/// Cores so near touch [m].
const TOUCHING: f64 = 1e-9;
/// Places or lengths so near are the same [m].
const SAME: f64 = 1e-7;

/// A solid on the robot or in the world.
#[derive(Clone, Debug)]
struct Body {
    name: String,
    /// The frame that carries it; none for an obstacle.
    frame: Option<String>,
    spot: Spot,
    shape: Shape,
}

/// All solids, the pairs that must not meet, and what they keep.
#[derive(Clone)]
pub(crate) struct Collision {
    bodies: Vec<Body>,
    pairs: Vec<[usize; 2]>,
    /// Distance kept [m].
    pub(crate) margin: f64,
    slots: usize,
    pub(crate) is_hard: bool,
    /// Pairs farther apart have no row [m].
    influence: f64,
    /// Deceleration of a closing distance [m/s²].
    braking: f64,
}

/// What is known of the row of a pair at a passage.
pub(crate) enum Told {
    /// The pair is too far apart to have one.
    None,
    /// By how much the passage is more than the row allows, as a share of its braking, and how that changes with each velocity (nv).
    Row(f64, Vec<f64>),
    /// Why it is not known.
    Unknown(String),
}

/// Cores of two solids where they are nearest.
struct Nearest {
    points: [Vec3; 2],
    /// From the first to the second.
    normal: Vec3,
    distance: f64,
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
            let place = spot.place.then(&placed(s.position, s.rpy));
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
        let (margin, is_hard) = (section.margin, section.soft.is_none());
        let (influence, braking) = (section.influence, section.braking);
        Ok(Collision { bodies, pairs, margin, slots, is_hard, influence, braking })
    }

    /// The same with obstacles elsewhere.
    pub(crate) fn with(&self, places: &BTreeMap<String, Pose>) -> Collision {
        let mut moved = self.clone();
        for body in moved.bodies.iter_mut().filter(|body| body.frame.is_none()) {
            if let Some(to) = places.get(&body.name) {
                body.spot.place = placed(to.position, to.rpy);
            }
        }
        moved
    }

    /// The least distance of all pairs at the last [`Machine::go`], at most the influence [m]; none where that of some pair is not known.
    pub(crate) fn least(&self, machine: &Machine) -> Option<f64> {
        let mut least = self.influence;
        for pair in &self.pairs {
            machine.spend(10);
            let [a, b] = pair.map(|k| self.solid(machine, k));
            least = least.min(nearest(&a, &b)?.distance);
        }
        Some(least)
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
            if machine.is_spent() {
                return Gap::Open(self.name(pair));
            }
            match bounds(&a, &b, least, machine) {
                (from, _) if from >= least => {}
                (_, to) if to < least => return Gap::Near(self.name(pair), to),
                _ => return Gap::Open(self.name(pair)),
            }
        }
        Gap::Kept
    }

    /// Pairs farther apart have no row [m].
    pub(crate) fn influence(&self) -> f64 {
        self.influence
    }

    fn solid(&self, machine: &Machine, k: usize) -> Solid {
        Solid { shape: self.bodies[k].shape, at: machine.place(&self.bodies[k].spot) }
    }

    /// The pair whose row has this number at the last [`Machine::go`].
    fn pair_of(&self, machine: &Machine, slot: usize) -> Result<Option<[usize; 2]>, String> {
        if self.pairs.len() <= self.slots {
            return Ok(self.pairs.get(slot).copied());
        }
        let mut near = Vec::new();
        for pair in &self.pairs {
            machine.spend(10);
            let [a, b] = pair.map(|k| self.solid(machine, k));
            match nearest(&a, &b) {
                Some(found) if found.distance <= self.influence => near.push((found.distance, *pair)),
                Some(_) => {}
                None => {
                    return Err(format!(
                        "{} is no pair whose nearest points are known here",
                        self.name(pair)
                    ));
                }
            }
        }
        near.sort_by(|x, y| x.0.total_cmp(&y.0));
        let Some((distance, pair)) = near.get(slot) else { return Ok(None) };
        let twin =
            |k: Option<usize>| k.and_then(|k| near.get(k)).is_some_and(|n| (n.0 - distance).abs() < SAME);
        match twin(slot.checked_sub(1)) || twin(Some(slot + 1)) {
            true => Err("two pairs of bodies were as near as each other".into()),
            false => Ok(Some(*pair)),
        }
    }

    /// The row of a number at a passage: where the bodies are nearest if no joint accelerates, they may close in as fast as `braking` stops.
    pub(crate) fn row(&self, machine: &mut Machine, p: &Period, passage: &Passage<'_>, slot: usize) -> Told {
        let mut ahead = Vec::new();
        machine.moved(passage.q, passage.v, p.dt, &mut ahead);
        machine.go(&ahead, passage.v);
        let pair = match self.pair_of(machine, slot) {
            Ok(Some(pair)) => pair,
            Ok(None) => return Told::None,
            Err(why) => return Told::Unknown(why),
        };
        let several = || Told::Unknown(format!("the nearest points of {} may be several", self.name(&pair)));
        let spots = pair.map(|k| self.bodies[k].spot);
        let apart = |machine: &Machine, at: &Nearest| {
            let [a, b] = [0, 1].map(|k| machine.point(&spots[k], at.points[k]));
            (minus(a.velocity, b.velocity), minus(a.acceleration, b.acceleration))
        };
        let here = |machine: &Machine| {
            let [a, b] = pair.map(|k| self.solid(machine, k));
            nearest(&a, &b)
        };
        let Some(at) = here(machine) else { return several() };
        if at.distance > self.influence {
            return Told::None;
        }
        let (velocity, acceleration) = apart(machine, &at);
        let speed = dot(at.normal, velocity);
        let mut slope = vec![0.0; passage.v.len()];
        for (k, sign) in [(0, 1.0), (1, -1.0)] {
            machine.add_row(&spots[k], at.points[k], at.normal, sign / p.dt, &mut slope);
        }
        machine.go(&ahead, passage.v1);
        let then = dot(at.normal, apart(machine, &at).0);
        machine.go(passage.q, passage.v);
        let Some(was) = here(machine) else { return several() };
        let before = dot(was.normal, apart(machine, &was).0);
        let most = norm(acceleration);
        let c = ((speed - before) / p.dt).clamp(-most, most);
        Told::Row(plane(p, at.distance - self.margin, speed, c, then, self.braking), slope)
    }
}

/// A place by its position and roll, pitch and yaw.
fn placed(at: Vec3, [roll, pitch, yaw]: Vec3) -> Place {
    let axes = product(&product(&turn(ONE[2], yaw), &turn(ONE[1], pitch)), &turn(ONE[0], roll));
    Place { at, axes }
}

/// Where two solids are nearest; none where the points may be several, or are in each other.
fn nearest(a: &Solid, b: &Solid) -> Option<Nearest> {
    if let Shape::HalfSpace = a.shape {
        let found = nearest(b, a)?;
        let [x, y] = found.points;
        return Some(Nearest { points: [y, x], normal: times(-1.0, found.normal), ..found });
    }
    if let Shape::HalfSpace = b.shape {
        let up = apply(&b.at.axes, ONE[2]);
        let [start, end] = a.ends()?;
        let (low, high) = (dot(up, start), dot(up, end));
        if (low - high).abs() < SAME && norm(minus(start, end)) > SAME {
            return None;
        }
        let foot = minus(if low <= high { start } else { end }, times(a.radius(), up));
        let distance = dot(up, minus(foot, b.at.at));
        return Some(Nearest {
            points: [foot, minus(foot, times(distance, up))],
            normal: times(-1.0, up),
            distance,
        });
    }
    let ([a0, a1], [b0, b1]) = (a.ends()?, b.ends()?);
    let (along, across) = (minus(a1, a0), minus(b1, b0));
    let (aa, bb, ab) = (dot(along, along), dot(across, across), dot(along, across));
    // Parallel segments may be nearest along a stretch.
    if aa > SAME * SAME && bb > SAME * SAME && aa * bb - ab * ab < SAME * aa * bb {
        return None;
    }
    let share = |from: Vec3, to: Vec3, way: Vec3, length: f64| match length > SAME * SAME {
        true => (dot(way, minus(to, from)) / length).clamp(0.0, 1.0),
        false => 0.0,
    };
    let at = |from: Vec3, s: f64, way: Vec3| [0, 1, 2].map(|k| from[k] + s * way[k]);
    // One and the other in turn, from the nearest of the ends: a convex problem with bounds apart.
    let (mut s, mut t) = (0.5, 0.5);
    for _ in 0..MOST {
        let (s_before, t_before) = (s, t);
        t = share(b0, at(a0, s, along), across, bb);
        s = share(a0, at(b0, t, across), along, aa);
        if s == s_before && t == t_before {
            break;
        }
    }
    let (x, y) = (at(a0, s, along), at(b0, t, across));
    let between = minus(y, x);
    let gap = norm(between);
    if gap < TOUCHING {
        return None;
    }
    let normal = times(1.0 / gap, between);
    let out = |p: Vec3, by: f64| [0, 1, 2].map(|k| p[k] + by * normal[k]);
    let points = [out(x, a.radius()), out(y, -b.radius())];
    Some(Nearest { points, normal, distance: gap - a.radius() - b.radius() })
}

/// A shape somewhere in the world, as a core and a radius around it.
struct Solid {
    shape: Shape,
    at: Place,
}

impl Solid {
    /// Ends of the core of a ball or a capsule.
    fn ends(&self) -> Option<[Vec3; 2]> {
        match self.shape {
            Shape::Sphere { .. } => Some([self.at.at; 2]),
            Shape::Capsule { length, .. } => {
                Some([-0.5, 0.5].map(|side| self.at.point([0.0, 0.0, side * length])))
            }
            _ => None,
        }
    }

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
fn bounds(a: &Solid, b: &Solid, least: f64, machine: &Machine) -> (f64, f64) {
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
        machine.spend(1);
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

    /// A robot without joints.
    fn still() -> Machine {
        let text = r#"{"gravity":[0,0,-10],"bodies":[],"frames":[],"solids":[],"motors":[]}"#;
        Machine::new(&serde_json::from_str(text).unwrap()).unwrap()
    }

    /// Nearest points by hand, and against the distance between bounds.
    #[test]
    fn nearest_points_of_balls_and_capsules_are_those_of_plane_geometry() {
        let ball = solid(Shape::Sphere { radius: 0.2 }, [2.0, 0.0, 0.1], ONE);
        let rod = solid(Shape::Capsule { radius: 0.1, length: 1.0 }, [0.0, 0.0, 0.0], ONE);
        let lying = solid(Shape::Capsule { radius: 0.1, length: 1.0 }, [1.0, 0.3, 0.2], turn(ONE[1], 1.2));
        let floor = solid(Shape::HalfSpace, [0.0, 0.0, -1.0], ONE);
        let found = nearest(&rod, &ball).unwrap();
        assert!((found.distance - 1.7).abs() < 1e-12 && (found.normal[0] - 1.0).abs() < 1e-12);
        assert!(norm(minus(found.points[1], [1.8, 0.0, 0.1])) < 1e-12, "{:?}", found.points);
        assert!((nearest(&floor, &rod).unwrap().distance - 0.4).abs() < 1e-12);
        assert!(
            nearest(&floor, &solid(lying.shape, [0.0; 3], turn(ONE[1], std::f64::consts::FRAC_PI_2)))
                .is_none()
        );
        let found = nearest(&rod, &lying).unwrap();
        let (from, to) = bounds(&rod, &lying, found.distance - 1e-6, &still());
        assert!(
            from >= found.distance - 1e-6 && to >= found.distance - 1e-9,
            "{from} {to} {}",
            found.distance
        );
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
        let machine = still();
        for (a, b, distance) in cases {
            let (from, to) = bounds(&a, b, distance - 1e-9, &machine);
            assert!(from >= distance - 1e-9, "{from} {distance}");
            assert!(to >= distance - 1e-12, "{to} {distance}");
            let (_, to) = bounds(&a, b, distance + 1e-9, &machine);
            assert!(to < distance + 1e-9 && to > distance - 1e-9, "{to} {distance}");
        }
    }

    #[test]
    fn bodies_in_each_other_are_not_apart() {
        let cube = |x: f64| solid(Shape::Box { size: [1.0; 3] }, [x, 0.0, 0.0], ONE);
        let (from, to) = bounds(&cube(0.0), &cube(0.9), 0.0, &still());
        assert!(from < 0.0 && to <= 0.0, "{from} {to}");
    }
}
