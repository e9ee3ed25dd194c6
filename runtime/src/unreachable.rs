//! Finds planes and boxes that points of the robot never reach the right side of, alone or all at once. With these every tick only comes back, and
//! never arrives.

use nearl_constraints::description::{JointDescription, JointKind};
use nearl_constraints::limit::FrameSettings;
use nearl_constraints::{FrameId, Kinematics, LimitSet, Model};

use crate::holding::{ranges, spread};

/// Seeded poses that are looked at, how many of the best are improved joint by joint, in so many rounds over a grid of a joint's range.
const POSES: usize = 1024;
const STARTS: usize = 8;
const ROUNDS: usize = 12;
const GRID: usize = 60;
/// What a search over a grid may leave \[m\].
const NEAR: f64 = 1e-3;

/// One sentence for each hard limit of a frame that holds in none of the poses found within the position limits, else one where all of them never hold
/// at once. Only robots of hinges, and of slides that end somewhere, are looked at: others may come anywhere.
pub fn notes(model: &Model, limits: &LimitSet, frames: &[FrameSettings]) -> Vec<String> {
    let hard = frames.iter().filter(|of| of.soft.is_none());
    let is_bounded = |joint: &JointDescription| match joint.kind {
        JointKind::Hinge => true,
        JointKind::Slide => model
            .joint(&joint.name)
            .is_ok_and(|of| limits.q_lower[of.idx_v].is_finite() && limits.q_upper[of.idx_v].is_finite()),
        _ => false,
    };
    if !model.description().joints().all(is_bounded) {
        return Vec::new();
    }
    let joints: Vec<usize> = (0..model.nv()).collect();
    let ranges = ranges(model, limits, &joints);
    let looked = |of: &FrameSettings| Some((of.clone(), model.frame(&of.frame).ok()?));
    let all: Vec<_> = hard.filter_map(looked).collect();
    let least = |points: &[(FrameSettings, FrameId)]| {
        Search { kinematics: Kinematics::new(model), rest: vec![0.0; model.nv()], points }.least(&ranges)
    };
    let name = |(of, _): &(FrameSettings, FrameId)| of.name.as_ref().unwrap_or(&of.frame).clone();
    let note = |one: &(FrameSettings, FrameId)| {
        let least = least(std::slice::from_ref(one));
        (least > NEAR).then(|| {
            format!(
                "the limit of frame '{}' holds in no pose found within the position limits, the nearest is {least:.3} m outside of it: every tick would \
                 be `recovering`; correct it, or leave it out",
                name(one)
            )
        })
    };
    let mut notes: Vec<String> = all.iter().filter_map(note).collect();
    if notes.is_empty() && all.len() > 1 {
        let least = least(&all);
        let names: Vec<String> = all.iter().map(|one| format!("'{}'", name(one))).collect();
        notes.extend((least > NEAR).then(|| {
            format!(
                "the limits of frames {} hold each alone, and in no pose found within the position limits all at once, the nearest is {least:.3} m outside \
                 of one: every tick would be `recovering`; correct one, or leave it out",
                names.join(", ")
            )
        }));
    }
    notes
}

struct Search<'a> {
    kinematics: Kinematics,
    rest: Vec<f64>,
    points: &'a [(FrameSettings, FrameId)],
}

impl Search<'_> {
    /// How far outside its limit the worst of the points is at best \[m\]; 0 inside.
    fn least(&mut self, ranges: &[(usize, f64, f64)]) -> f64 {
        let mut q = self.kinematics.model().neutral();
        let mut best: Vec<(f64, Vec<f64>)> = Vec::with_capacity(POSES);
        for start in 0..POSES {
            spread(start, ranges, &mut q);
            let outside = self.outside(&q);
            if outside <= 0.0 {
                return 0.0;
            }
            best.push((outside, q.clone()));
        }
        best.sort_by(|a, b| a.0.total_cmp(&b.0));
        best.truncate(STARTS);
        best.into_iter().fold(f64::INFINITY, |least, (outside, q)| least.min(self.nearer(outside, q, ranges)))
    }

    /// The same from `q`, joint by joint until nothing falls, on ever finer grids.
    fn nearer(&mut self, mut outside: f64, mut q: Vec<f64>, ranges: &[(usize, f64, f64)]) -> f64 {
        let mut width = 1.0;
        for _ in 0..ROUNDS {
            let before = outside;
            for &(idx_q, low, high) in ranges {
                let (mut at, half) = (q[idx_q], 0.5 * width * (high - low));
                let middle = at;
                for step in 0..=GRID {
                    let to = middle - half + step as f64 / GRID as f64 * 2.0 * half;
                    q[idx_q] = to.max(low).min(high);
                    let now = self.outside(&q);
                    if now < outside {
                        (outside, at) = (now, q[idx_q]);
                    }
                }
                q[idx_q] = at;
            }
            if outside <= 0.0 {
                return 0.0;
            }
            if outside > 0.99 * before {
                width *= 0.2;
            }
        }
        outside
    }

    fn outside(&mut self, q: &[f64]) -> f64 {
        self.kinematics.update(q, &self.rest, &self.rest);
        let far = |(of, frame): &(FrameSettings, FrameId)| {
            let p = self.kinematics.point(*frame, of.point).position;
            let mut most = f64::NEG_INFINITY;
            if let Some(plane) = &of.half_space {
                let length = plane.normal.iter().map(|n| n * n).sum::<f64>().sqrt();
                let along: f64 = (0..3).map(|k| plane.normal[k] * (p[k] - plane.through[k])).sum();
                most = along / length;
            }
            if let Some(inside) = &of.inside {
                for (k, p) in p.iter().enumerate() {
                    most = most.max(inside.lower[k] - p).max(p - inside.upper[k]);
                }
            }
            most + of.margin
        };
        self.points.iter().map(far).fold(f64::NEG_INFINITY, f64::max)
    }
}
