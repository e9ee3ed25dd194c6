//! Where a point of a frame may be: below a plane, inside a box.

use super::clearance::{AT, Ahead, Clearance};
use super::{About, Argument, Form, Limit, Takes};
use crate::kinematics::{dot, norm};
use crate::row::{Motion, Needs, Place, Rows, RowsMut, TickStart};
use crate::{FrameId, Kind, LimitError, Model, Period, PointMotion, Soft};
use serde::{Deserialize, Serialize};

/// What it says of itself.
pub(super) const ABOUT: About = About {
    class: "FrameLimit",
    promise: "A point of a frame stops in front of a plane, `normal . (p - through) <= 0`, or inside a box of world axes, \
        `box = { lower = [x, y, z], upper = [x, y, z] }`, or both, as far as `braking` [m/s²] can be delivered. `point` is in the frame's axes [m].",
    example: "frame = [{ frame = \"panda_hand\", half_space = { normal = [0, 0, -1], through = [0, 0, 0.1] }, braking = 5.0 \
        }]",
    form: Form::Either,
    margin: "from every plane [m]",
    stricter: Some([
        "frame = [{ frame = \"panda_hand\", half_space = { normal = [0, 0, -1], through = [0, 0, 0.1] }, braking = \
        5.0, margin = 0.3 }]",
        "frame = [{ frame = \"panda_hand\", half_space = { normal = [0, 0, -1], through = [0, 0, 0.4] }, braking = 5.0 \
        }]",
    ]),
    arguments: &[
        Argument::needed("frame", Takes::Text),
        Argument::needed("braking", Takes::Number),
        Argument::named("normal", Takes::Vector, "None").at("half_space.normal"),
        Argument::named("through", Takes::Vector, "None").at("half_space.through"),
        Argument::named("lower", Takes::Vector, "None").at("box.lower"),
        Argument::named("upper", Takes::Vector, "None").at("box.upper"),
        Argument::POINT,
        Argument::MARGIN,
        Argument::SOFT,
        Argument::NAME,
    ],
};

/// `frame = [{ frame = "hand", half_space = { normal = [0, 0, -1], through = [0, 0, 0.1] }, braking = 5.0 }]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrameSettings {
    /// Name to switch it on and off by; the frame's when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// A link, joint or site of the robot file.
    pub frame: String,
    /// The point, in the frame's axes \[m\].
    #[serde(default)]
    pub point: [f64; 3],
    /// The point stays in this half-space.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub half_space: Option<HalfSpace>,
    /// The point stays in this box.
    #[serde(default, rename = "box", skip_serializing_if = "Option::is_none")]
    pub inside: Option<FrameBox>,
    /// Deceleration of the point that may be counted on to stop in front of a plane [m/s²].
    pub braking: f64,
    /// Distance kept from every plane \[m\].
    #[serde(default)]
    pub margin: f64,
    /// How much it resists; hard when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub soft: Option<Soft>,
}

/// All `p` with `normal . (p - through) <= 0`: the normal points to where the point may not go.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HalfSpace {
    /// Direction in the world; any length.
    pub normal: [f64; 3],
    /// A point of the plane in the world \[m\].
    pub through: [f64; 3],
}

/// `lower <= p <= upper` in world axes; infinite is no face.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrameBox {
    /// Lowest x, y, z \[m\].
    pub lower: [f64; 3],
    /// Highest x, y, z \[m\].
    pub upper: [f64; 3],
}

/// `n . (p - p0) <= 0` for a point `p` of a frame and each plane, so that `braking` always stops the point in front of it.
///
/// With distance `d` to the plane, speed `w` and acceleration `c` towards it while no joint accelerates, and the Jacobian `J` of the
/// point at `q (+) T v`, where the robot then will be:
///
/// ```text
///     n' J y / T  <=  approach(d, w) - c
/// ```
///
/// [`approach`](crate::viability::approach) is the braking bound of a joint. The position at the end of the period is linearised in the
/// velocity change `y` alone: off by O((T y)²), about 1e-9 m at 1 kHz. Nobody certifies that the joints can brake the point by
/// `braking`: near a singularity or a joint limit the rows may contradict the joints' own limits, and a joint brake may then carry the
/// point beyond the plane.
#[derive(Debug, Clone)]
pub struct FrameLimit {
    settings: FrameSettings,
}

impl FrameLimit {
    /// From the task file's settings.
    pub fn new(settings: FrameSettings) -> FrameLimit {
        FrameLimit { settings }
    }

    /// The origin of `frame` stays where `normal . (p - through) <= 0` \[m\], braking by `braking` [m/s²].
    pub fn half_space(frame: &str, normal: [f64; 3], through: [f64; 3], braking: f64) -> FrameLimit {
        let half_space = Some(HalfSpace { normal, through });
        FrameLimit { settings: FrameSettings { half_space, ..FrameLimit::bare(frame, braking) } }
    }

    /// The origin of `frame` stays between `lower` and `upper` \[m\] in world axes, braking by `braking` [m/s²].
    pub fn inside(frame: &str, lower: [f64; 3], upper: [f64; 3], braking: f64) -> FrameLimit {
        let inside = Some(FrameBox { lower, upper });
        FrameLimit { settings: FrameSettings { inside, ..FrameLimit::bare(frame, braking) } }
    }

    fn bare(frame: &str, braking: f64) -> FrameSettings {
        FrameSettings {
            name: None,
            frame: frame.to_string(),
            point: [0.0; 3],
            half_space: None,
            inside: None,
            braking,
            margin: 0.0,
            soft: None,
        }
    }

    /// Names, unit normals and offsets `n . p0`.
    fn planes(&self) -> Result<Vec<Plane>, LimitError> {
        let s = &self.settings;
        let (frame, mut planes) = (&s.frame, Vec::new());
        if let Some(HalfSpace { normal, through }) = s.half_space {
            let length = norm(normal);
            check(&format!("length of the normal of frame '{frame}'"), length, length > 1e-9, "above 0")?;
            let n = normal.map(|x| x / length);
            let offset = dot(n, through);
            check(&format!("a point of the plane of frame '{frame}'"), offset, true, "finite, in m")?;
            planes.push(Plane { name: self.label().to_string(), n, offset });
        }
        if let Some(FrameBox { lower, upper }) = s.inside {
            for (k, axis) in ["x", "y", "z"].iter().enumerate() {
                let (low, high) = (lower[k], upper[k]);
                if low + s.margin >= high - s.margin || low.is_nan() || high.is_nan() {
                    let list = format!(
                        "frame '{frame}' would have to stay above {low} and below {high} m along {axis}"
                    );
                    return Err(LimitError::Contradictory { list });
                }
                for (sign, end, side) in [(1.0, high, "below"), (-1.0, -low, "above")] {
                    let mut n = [0.0; 3];
                    n[k] = sign;
                    if end.is_finite() {
                        let name = format!("{} {side} {axis} = {}", self.label(), sign * end);
                        planes.push(Plane { name, n, offset: end });
                    }
                }
            }
        }
        if planes.is_empty() {
            let what = format!("limit on frame '{frame}' states no place to be in");
            return Err(LimitError::Unusable { what, next: "give half_space or box" });
        }
        Ok(planes)
    }
}

/// Refuses a number that is not finite or not `good`.
pub(super) fn check(what: &str, value: f64, good: bool, domain: &'static str) -> Result<(), LimitError> {
    match value.is_finite() && good {
        true => Ok(()),
        false => Err(LimitError::BadValue { what: what.to_string(), value, domain }),
    }
}

/// The frame called `name`, which some controllable dof must move.
pub(super) fn frame_of(
    model: &Model,
    limit: &'static str,
    name: &str,
    controllable: &[usize],
) -> Result<FrameId, LimitError> {
    let unknown = |near| LimitError::UnknownFrame { limit, name: name.to_string(), near };
    let frame = model.find_frame(name).map_err(unknown)?;
    if !controllable.is_empty() && !controllable.iter().any(|i| model.moves(*i, frame)) {
        let what = format!("{limit} names frame '{name}', which no controllable joint moves");
        return Err(LimitError::Unusable { what, next: "name a frame further along the robot" });
    }
    Ok(frame)
}

impl Limit for FrameLimit {
    fn name(&self) -> &'static str {
        "frame"
    }

    fn label(&self) -> &str {
        self.settings.name.as_deref().unwrap_or(&self.settings.frame)
    }

    fn rows(&self, model: &Model, controllable: &[usize]) -> Result<Option<Box<dyn Rows>>, LimitError> {
        let s = &self.settings;
        let frame = frame_of(model, "frame", &s.frame, controllable)?;
        let of = |what: &str| format!("{what} of frame '{}'", s.frame);
        check(&of("braking"), s.braking, s.braking > 0.0, "above 0 m/s²")?;
        check(&of("margin"), s.margin, s.margin >= 0.0, "at least 0 m")?;
        check(&of("point"), s.point.iter().sum(), true, "finite, in m")?;
        let (planes, margin) = (self.planes()?, s.margin);
        let (jacobian, ahead) = (vec![0.0; 3 * model.nv()], Ahead::new(model));
        let sides = s.inside.map_or([f64::INFINITY; 3], |b| std::array::from_fn(|k| b.upper[k] - b.lower[k]));
        let room = 0.5 * sides.into_iter().fold(f64::INFINITY, f64::min) - s.margin;
        let (point, braking, inset, is_plane) = (s.point, s.braking, 0.0, s.half_space.is_some());
        let rows =
            FrameRows { frame, point, planes, margin, is_plane, braking, jacobian, ahead, inset, room };
        Ok(Some(Box::new(rows)))
    }

    fn soft(&self) -> Option<Soft> {
        self.settings.soft
    }
}

struct Plane {
    name: String,
    n: [f64; 3],
    /// Distance from the origin along `n`, without the margin.
    offset: f64,
}

struct FrameRows {
    frame: FrameId,
    point: [f64; 3],
    planes: Vec<Plane>,
    /// Distance kept from every plane [m].
    margin: f64,
    /// The first plane is that of a half-space.
    is_plane: bool,
    braking: f64,
    /// Of the point (3 x nv).
    jacobian: Vec<f64>,
    ahead: Ahead,
    /// Every plane lies this far further inside than it was built [m].
    inset: f64,
    /// Half the narrowest side of the box, less its margin [m].
    room: f64,
}

impl Plane {
    /// Of a point looked at ahead, to the plane less the margin and `inset` further inside.
    fn clearance(&self, (margin, inset): (f64, f64), p: &PointMotion, period: &Period) -> Clearance {
        let (d, c) = (self.offset - margin - inset - dot(self.n, p.position), dot(self.n, p.acceleration));
        Clearance::ahead(d, dot(self.n, p.velocity), c, period)
    }

    /// How far a point is beyond the plane less the margin and `inset` further inside [m].
    fn beyond(&self, (margin, inset): (f64, f64), p: &PointMotion) -> f64 {
        dot(self.n, p.position) - (self.offset - margin) + inset
    }
}

impl Rows for FrameRows {
    fn kind(&self) -> Kind {
        Kind::Frame
    }

    fn names(&self) -> Vec<String> {
        self.planes.iter().map(|p| p.name.clone()).collect()
    }

    fn sizes(&self) -> Vec<f64> {
        vec![self.braking; self.planes.len()]
    }

    fn needs(&self) -> Needs {
        Needs::default()
    }

    fn asks_more(&self) -> bool {
        true
    }

    fn inset(&mut self, by: f64) -> bool {
        self.inset = by;
        true
    }

    fn most_inset(&self) -> f64 {
        self.room
    }

    fn places(&self) -> Vec<Place> {
        let planes = self.planes.iter().take(usize::from(self.is_plane));
        planes.map(|p| Place { name: None, numbers: [p.n[0], p.n[1], p.n[2], p.offset, 0.0, 0.0] }).collect()
    }

    fn put(&mut self, numbers: &[[f64; 6]]) {
        for (plane, [x, y, z, offset, ..]) in self.planes.iter_mut().zip(numbers) {
            (plane.n, plane.offset) = ([*x, *y, *z], *offset);
        }
    }

    fn fill(&mut self, tick: &mut TickStart<'_>, rows: &mut RowsMut<'_>) {
        let (nv, j, period) = (rows.nv, &mut self.jacobian, tick.period);
        let kinematics = self.ahead.look(tick.q, tick.v, period.dt);
        let at = kinematics.point(self.frame, self.point);
        kinematics.point_jacobian(self.frame, self.point, j);
        for (r, plane) in self.planes.iter().enumerate() {
            for (i, g) in rows.row(r).iter_mut().enumerate() {
                *g = dot(plane.n, [j[i], j[nv + i], j[2 * nv + i]]) / period.dt;
            }
            let clearance = plane.clearance((self.margin, self.inset), &at, period);
            rows.upper[r] = clearance.bound(self.braking, period);
            rows.outside[r] = clearance.is_outside();
        }
        // Seen from where the point will be, that is off by the second order of the period.
        if rows.outside.contains(&true) {
            let now = self.ahead.look_at_frames(tick.q, tick.v, 0.0).point(self.frame, self.point);
            for (outside, plane) in rows.outside.iter_mut().zip(&self.planes) {
                *outside &= plane.beyond((self.margin, self.inset), &now) > AT;
            }
        }
    }

    fn excess(&mut self, motion: &mut Motion<'_>, out: &mut [f64]) {
        let at =
            self.ahead.look_at_frames(motion.q, motion.v, motion.period.dt).point(self.frame, self.point);
        let then = self.ahead.turn(motion.v_next).point(self.frame, self.point);
        for (x, plane) in out.iter_mut().zip(&self.planes) {
            let clearance = plane.clearance((self.margin, self.inset), &at, motion.period);
            *x = clearance.excess(dot(plane.n, then.velocity), self.braking, motion.period);
        }
    }

    /// Metres beyond the plane.
    fn breach(&mut self, motion: &mut Motion<'_>, out: &mut [f64]) {
        let then = self.ahead.look_at_frames(motion.q_next, motion.v_next, 0.0);
        let at = then.point(self.frame, self.point);
        for (x, plane) in out.iter_mut().zip(&self.planes) {
            *x = plane.beyond((self.margin, self.inset), &at);
        }
    }
}
