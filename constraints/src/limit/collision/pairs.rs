//! Which solids are near each other now, and how fast they close.

use super::super::clearance::Clearance;
use super::SolidSettings;
use crate::geometry::{Placement, Separation, Shape, separation};
use crate::kinematics::{dot, minus, norm};
use crate::row::Place;
use crate::{FrameId, FrameMotion, Kinematics, Period};

/// A solid on a frame.
pub(super) struct Body {
    pub(super) name: String,
    /// Name of the frame; empty for an obstacle.
    link: String,
    pub(super) frame: FrameId,
    shape: Shape,
    local: Placement,
    radius: f64,
    /// Position and roll, pitch, yaw of an obstacle, which may be put elsewhere.
    stands: Option<[f64; 6]>,
}

impl Body {
    pub(super) fn new(name: String, link: String, frame: FrameId, shape: Shape, local: Placement) -> Body {
        Body { name, link, frame, shape, local, radius: shape.bounding_radius(), stands: None }
    }

    /// As the settings have it.
    pub(super) fn stated(name: String, link: String, frame: FrameId, s: &SolidSettings) -> Body {
        let ([x, y, z], [roll, pitch, yaw]) = (s.position, s.rpy);
        let stands = link.is_empty().then_some([x, y, z, roll, pitch, yaw]);
        Body { stands, ..Body::new(name, link, frame, s.shape, Placement::new(s.position, s.rpy)) }
    }

    pub(super) fn called(&self, name: &str) -> bool {
        self.name == name || self.link == name
    }

    pub(super) fn is_obstacle(&self) -> bool {
        self.link.is_empty()
    }

    pub(super) fn is_plane(&self) -> bool {
        self.shape == Shape::HalfSpace
    }
}

/// How far to look and how many pairs to report.
pub(super) struct Reach {
    pub(super) influence: f64,
    pub(super) rows: usize,
}

/// Two bodies near each other.
#[derive(Clone, Copy)]
pub(super) struct Near {
    /// Row it is written to.
    pub(super) slot: usize,
    pub(super) frames: [FrameId; 2],
    pub(super) between: Separation,
    /// Closing speed of the nearest points [m/s].
    speed: f64,
    /// The same before the period.
    before: f64,
    /// Size of the relative acceleration of these points, as points of the bodies, while no joint accelerates [m/s²].
    most: f64,
}

impl Near {
    /// Distance less `margin` and how it closes. The closing acceleration is the change of the closing speed over the period, which knows
    /// that the nearest points slide along both bodies; where they jump, no more than the points' own.
    pub(super) fn clearance(&self, margin: f64, period: &Period) -> Clearance {
        let c = ((self.speed - self.before) / period.dt).clamp(-self.most, self.most);
        Clearance::ahead(self.between.distance - margin, self.speed, c, period)
    }

    /// Closing speed of the same points at another velocity of the joints.
    pub(super) fn closing(&self, kinematics: &mut Kinematics) -> f64 {
        let [a, b] = [0, 1].map(|k| kinematics.frame(self.frames[k]).carry(self.between.points[k]));
        dot(self.between.normal, minus(a.velocity, b.velocity))
    }
}

/// All solids and the pairs to watch.
pub(super) struct Pairs {
    bodies: Vec<Body>,
    pairs: Vec<[usize; 2]>,
    reach: Reach,
    /// Of the bodies, at the begin of the period and at the state looked at.
    before: Vec<(FrameMotion, Placement)>,
    at: Vec<(FrameMotion, Placement)>,
    /// Distance and number of the nearest pairs.
    nearest: Vec<(usize, Separation)>,
    found: Vec<Near>,
}

impl Pairs {
    pub(super) fn new(bodies: Vec<Body>, pairs: Vec<[usize; 2]>, reach: Reach) -> Pairs {
        let room = || Vec::with_capacity(bodies.len());
        let (before, at, slots) = (room(), room(), reach.rows.min(pairs.len()));
        let (nearest, found) = (Vec::with_capacity(slots + 1), Vec::with_capacity(slots));
        Pairs { bodies, pairs, reach, before, at, nearest, found }
    }

    /// The obstacles, and where they stand.
    pub(super) fn places(&self) -> Vec<Place> {
        let stands = |body: &Body| Some(Place { name: Some(body.name.clone()), numbers: body.stands? });
        self.bodies.iter().filter_map(stands).collect()
    }

    /// Puts the obstacles elsewhere.
    pub(super) fn put(&mut self, numbers: &[[f64; 6]]) {
        let obstacles = self.bodies.iter_mut().filter(|body| body.stands.is_some());
        for (body, numbers) in obstacles.zip(numbers) {
            let [x, y, z, roll, pitch, yaw] = *numbers;
            (body.local, body.stands) = (Placement::new([x, y, z], [roll, pitch, yaw]), Some(*numbers));
        }
    }

    /// Number of rows.
    pub(super) fn slots(&self) -> usize {
        self.reach.rows.min(self.pairs.len())
    }

    /// With a row for every pair, their names; else the rank by distance.
    pub(super) fn names(&self) -> Vec<String> {
        if self.pairs.len() > self.reach.rows {
            return (1..=self.slots()).map(|k| format!("pair {k} by distance")).collect();
        }
        let name = |k: usize| self.bodies[k].name.as_str();
        self.pairs.iter().map(|[a, b]| format!("{} and {}", name(*a), name(*b))).collect()
    }

    /// Where the bodies are at the begin of the period.
    pub(super) fn begin(&mut self, kinematics: &mut Kinematics) {
        place(&self.bodies, kinematics, &mut self.before);
    }

    /// The least distance of all pairs, at most the influence [m]. Allocates nothing.
    pub(super) fn least(&mut self, kinematics: &mut Kinematics) -> f64 {
        place(&self.bodies, kinematics, &mut self.at);
        self.rank();
        self.nearest.iter().fold(self.reach.influence, |least, (_, between)| least.min(between.distance))
    }

    /// The nearest pairs within reach at the state `kinematics` is at, equal distances in the order of the pairs. Allocates nothing.
    pub(super) fn look(&mut self, kinematics: &mut Kinematics) -> &[Near] {
        place(&self.bodies, kinematics, &mut self.at);
        self.rank();
        self.found.clear();
        for (rank, (pair, between)) in self.nearest.iter().enumerate() {
            let [a, b] = self.pairs[*pair];
            let relative = |at: &[(FrameMotion, Placement)], points: [[f64; 3]; 2]| {
                let (on_a, on_b) = (at[a].0.carry(points[0]), at[b].0.carry(points[1]));
                (minus(on_a.velocity, on_b.velocity), minus(on_a.acceleration, on_b.acceleration))
            };
            let (velocity, acceleration) = relative(&self.at, between.points);
            let (x, y) =
                ((&self.bodies[a].shape, &self.before[a].1), (&self.bodies[b].shape, &self.before[b].1));
            let speed = dot(between.normal, velocity);
            let before = separation(x, y, f64::INFINITY)
                .map_or(speed, |was| dot(was.normal, relative(&self.before, was.points).0));
            self.found.push(Near {
                slot: if self.pairs.len() > self.reach.rows { rank } else { *pair },
                frames: [self.bodies[a].frame, self.bodies[b].frame],
                between: *between,
                speed,
                before,
                most: norm(acceleration),
            });
        }
        &self.found
    }

    /// Fills `nearest`, sorted by distance.
    fn rank(&mut self) {
        let slots = self.slots();
        self.nearest.clear();
        for (k, [a, b]) in self.pairs.iter().enumerate() {
            let (x, y) = (&self.bodies[*a], &self.bodies[*b]);
            let mut within = self.reach.influence;
            if self.nearest.len() == slots {
                within = within.min(self.nearest[slots - 1].1.distance);
            }
            let (at_x, at_y) = (&self.at[*a].1, &self.at[*b].1);
            if norm(minus(at_x.position, at_y.position)) - x.radius - y.radius > within {
                continue;
            }
            let Some(between) = separation((&x.shape, at_x), (&y.shape, at_y), within) else { continue };
            let place = self.nearest.partition_point(|(_, s)| s.distance <= between.distance);
            self.nearest.insert(place, (k, between));
            self.nearest.truncate(slots);
        }
    }
}

/// Moves the bodies with their frames.
fn place(bodies: &[Body], kinematics: &mut Kinematics, at: &mut Vec<(FrameMotion, Placement)>) {
    at.clear();
    at.extend(bodies.iter().map(|body| {
        let frame = kinematics.frame(body.frame);
        (frame, Placement { position: frame.position, rotation: frame.rotation }.then(&body.local))
    }));
}
