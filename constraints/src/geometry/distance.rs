//! Signed distance, normal and witness points of two solids.

use super::solid::{Solid, overlap};
use super::{Placement, Shape};
use crate::kinematics::{dot, minus, norm};
use parry3d_f64::math::{Pose, Vector};
use parry3d_f64::query::details::{
    closest_points_segment_segment_with_locations, closest_points_support_map_support_map_with_params,
};
use parry3d_f64::query::gjk::{GJKResult, VoronoiSimplex};
use parry3d_f64::shape::Segment;

/// Cores closer than this count as overlapping [m].
const TOUCHING: f64 = 1e-7;

/// How two solids stand to each other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Separation {
    /// Distance \[m\]; negative when they overlap: then the least motion found that parts them.
    pub distance: f64,
    /// Unit vector from the first to the second.
    pub normal: [f64; 3],
    /// The nearest point of each \[m\].
    pub points: [[f64; 3]; 2],
}

/// How solid `a` at `at_a` stands to solid `b` at `at_b`, `None` when they are farther apart than `within` \[m\] or both are
/// half-spaces.
///
/// Exact to rounding between spheres, capsules and half-spaces; relative 5e-8 where a box or a cylinder takes part. The
/// depth of an overlap is exact while the cores (a sphere's centre, a capsule's segment) do not meet, and for two boxes;
/// otherwise it may be overstated, never understated.
pub fn separation(
    (a, at_a): (&Shape, &Placement),
    (b, at_b): (&Shape, &Placement),
    within: f64,
) -> Option<Separation> {
    let found = match (Solid::new(a, at_a), Solid::new(b, at_b)) {
        (Some(a), Some(b)) => between(&a, &b, within)?,
        (Some(a), None) => above(&a, at_b),
        (None, Some(b)) => above(&b, at_a).swapped(),
        (None, None) => return None,
    };
    (found.distance <= within).then_some(found)
}

impl Separation {
    fn swapped(self) -> Separation {
        let [a, b] = self.points;
        Separation { normal: self.normal.map(|x| -x), points: [b, a], ..self }
    }

    /// From the nearest points of two cores and the direction between them.
    fn of(a: &Solid, b: &Solid, [pa, pb]: [[f64; 3]; 2], normal: [f64; 3], gap: f64) -> Separation {
        let out = |p: [f64; 3], by: f64| [0, 1, 2].map(|k| p[k] + by * normal[k]);
        Separation {
            distance: gap - a.radius - b.radius,
            normal,
            points: [out(pa, a.radius), out(pb, -b.radius)],
        }
    }
}

/// A solid over the half-space below `plane`.
fn above(solid: &Solid, plane: &Placement) -> Separation {
    let normal = plane.z().map(|x| -x);
    let core = solid.farthest(normal);
    let gap = -dot(normal, minus(core, plane.position));
    let distance = gap - solid.radius;
    let lowest = [0, 1, 2].map(|k| core[k] + solid.radius * normal[k]);
    let foot = [0, 1, 2].map(|k| lowest[k] + distance * normal[k]);
    Separation { distance, normal, points: [lowest, foot] }
}

fn between(a: &Solid, b: &Solid, within: f64) -> Option<Separation> {
    let reach = within + a.radius + b.radius;
    let points = match (a.segment(), b.segment()) {
        (Some(a), Some(b)) => Some(segments(a, b)),
        _ => match gjk(a, b, reach) {
            GJKResult::ClosestPoints(pa, pb, _) => Some([pa.to_array(), pb.to_array()]),
            GJKResult::Intersection => None,
            GJKResult::NoIntersection(_) | GJKResult::Proximity(_) => return None,
        },
    };
    if let Some([pa, pb]) = points {
        let d = minus(pb, pa);
        let gap = norm(d);
        if gap > TOUCHING {
            return Some(Separation::of(a, b, [pa, pb], d.map(|x| x / gap), gap));
        }
    }
    let normal = overlap(a, b);
    let points = [a.farthest(normal), b.farthest(normal.map(|x| -x))];
    let gap = dot(normal, minus(points[1], points[0]));
    Some(Separation::of(a, b, points, normal, gap))
}

fn segments(a: [[f64; 3]; 2], b: [[f64; 3]; 2]) -> [[f64; 3]; 2] {
    let segment = |[p, q]: [[f64; 3]; 2]| Segment::new(Vector::from_array(p), Vector::from_array(q));
    let (a, b) = (segment(a), segment(b));
    let (on_a, on_b) = closest_points_segment_segment_with_locations(&Pose::IDENTITY, &a, &b);
    [a.point_at(&on_a).to_array(), b.point_at(&on_b).to_array()]
}

fn gjk(a: &Solid, b: &Solid, reach: f64) -> GJKResult {
    let towards = Vector::from_array(minus(a.at.position, b.at.position));
    let simplex = &mut VoronoiSimplex::new();
    closest_points_support_map_support_map_with_params(&Pose::IDENTITY, a, b, reach, simplex, Some(towards))
}
