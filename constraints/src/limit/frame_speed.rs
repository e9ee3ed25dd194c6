//! How fast a point of a frame may move.

use super::clearance::Ahead;
use super::frame::{check, frame_of};
use super::margin::{is_zero, less};
use super::{About, Argument, Form, Limit, Takes};
use crate::kinematics::norm;
use crate::row::{Cone, Motion, Needs, TickStart};
use crate::{FrameId, Kind, LimitError, Model, Soft};
use serde::{Deserialize, Serialize};

/// What it says of itself.
pub(super) const ABOUT: About = About {
    class: "FrameSpeedLimit",
    promise: "The speed of a point of a frame stays below `limit` [m/s] in every direction: a second-order cone. `point` is \
        in the frame's axes [m].",
    example: "frame_speed = [{ frame = \"panda_hand\", limit = 0.25 }]",
    form: Form::Either,
    margin: "[m/s]",
    stricter: Some([
        "frame_speed = [{ frame = \"panda_hand\", limit = 0.25, margin = 0.1 }]",
        "frame_speed = [{ frame = \"panda_hand\", limit = 0.15 }]",
    ]),
    arguments: &[
        Argument::needed("frame", Takes::Text),
        Argument::needed("limit", Takes::Number),
        Argument::POINT,
        Argument::NAME,
        Argument::MARGIN,
        Argument::SOFT,
    ],
};

/// `frame_speed = [{ frame = "hand", limit = 0.25 }]`, also with `margin` and `soft`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrameSpeedSettings {
    /// Name to switch it on and off by; the frame's when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// A link, joint or site of the robot file.
    pub frame: String,
    /// The point, in the frame's axes \[m\].
    #[serde(default)]
    pub point: [f64; 3],
    /// Largest speed [m/s].
    pub limit: f64,
    /// Speed kept below the limit [m/s].
    #[serde(default, skip_serializing_if = "is_zero")]
    pub margin: f64,
    /// How much it resists; hard when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub soft: Option<Soft>,
}

/// `|J (v + y)| <= limit`: the speed of a point of a frame, with the Jacobian at `q (+) T v`, where the robot will be but for what the
/// velocity change does to its way: the speed at the end of the period is off by O(T |y| |v|).
///
/// That the joints can brake the point is not in it: as they stop one after the other it may first become faster. A stored brake
/// ([`Braking::Stored`](crate::Braking)) is verified for it.
#[derive(Debug, Clone)]
pub struct FrameSpeedLimit {
    settings: FrameSpeedSettings,
}

impl FrameSpeedLimit {
    /// From the task file's settings.
    pub fn new(settings: FrameSpeedSettings) -> FrameSpeedLimit {
        FrameSpeedLimit { settings }
    }

    /// The origin of `frame` moves by at most `limit` [m/s].
    pub fn of(frame: &str, limit: f64) -> FrameSpeedLimit {
        let frame = frame.to_string();
        let (name, point, margin, soft) = (None, [0.0; 3], 0.0, None);
        FrameSpeedLimit { settings: FrameSpeedSettings { name, frame, point, limit, margin, soft } }
    }
}

impl Limit for FrameSpeedLimit {
    fn name(&self) -> &'static str {
        "frame_speed"
    }

    fn label(&self) -> &str {
        self.settings.name.as_deref().unwrap_or(&self.settings.frame)
    }

    fn cone(&self, model: &Model, controllable: &[usize]) -> Result<Option<Box<dyn Cone>>, LimitError> {
        let s = &self.settings;
        let frame = frame_of(model, "frame_speed", &s.frame, controllable)?;
        check(&format!("speed limit of frame '{}'", s.frame), s.limit, s.limit > 0.0, "above 0 m/s")?;
        check(&format!("point of frame '{}'", s.frame), s.point.iter().sum(), true, "finite, in m")?;
        let limit = less(&format!("speed margin of frame '{}'", s.frame), s.limit, s.margin)?;
        Ok(Some(Box::new(SpeedCone {
            name: self.label().to_string(),
            frame,
            point: s.point,
            limit,
            ahead: Ahead::new(model),
            checker: Ahead::new(model),
        })))
    }

    fn soft(&self) -> Option<Soft> {
        self.settings.soft
    }
}

struct SpeedCone {
    name: String,
    frame: FrameId,
    point: [f64; 3],
    limit: f64,
    ahead: Ahead,
    /// Frames at the next velocity, for the checker.
    checker: Ahead,
}

impl Cone for SpeedCone {
    fn kind(&self) -> Kind {
        Kind::FrameSpeed
    }

    fn name(&self) -> String {
        self.name.clone()
    }

    fn dimension(&self) -> usize {
        3
    }

    fn size(&self) -> f64 {
        self.limit
    }

    fn needs(&self) -> Needs {
        Needs::default()
    }

    fn fill(&mut self, tick: &mut TickStart<'_>, g: &mut [f64], c: &mut [f64]) -> f64 {
        self.ahead.look(tick.q, tick.v, tick.period.dt).point_jacobian(self.frame, self.point, g);
        for (c, row) in c.iter_mut().zip(g.chunks_exact(tick.v.len())) {
            *c = row.iter().zip(tick.v).map(|(g, v)| g * v).sum();
        }
        self.limit
    }

    fn excess(&mut self, motion: &mut Motion<'_>) -> f64 {
        self.checker.look_at_frames(motion.q, motion.v, motion.period.dt);
        norm(self.checker.turn(motion.v_next).point(self.frame, self.point).velocity) / self.limit - 1.0
    }

    fn breach(&mut self, motion: &mut Motion<'_>) -> f64 {
        let then = self.checker.look_at_frames(motion.q_next, motion.v_next, 0.0);
        norm(then.point(self.frame, self.point).velocity) / self.limit - 1.0
    }
}
