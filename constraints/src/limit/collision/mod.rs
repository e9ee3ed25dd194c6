//! Bodies of the robot keep clear of each other and of what stands around it.

mod pairs;

use super::clearance::{AT, Ahead};
use super::frame::check;
use super::{About, Argument, Form, Limit, Takes, quoted_names};
use crate::geometry::Shape;
use crate::row::{Motion, Needs, Place, Rows, RowsMut, TickStart};
use crate::{FrameId, Kind, LimitError, Model, Soft};
use pairs::{Body, Pairs, Reach};
use serde::{Deserialize, Serialize};

/// What it says of itself.
pub(super) const ABOUT: About = About {
    class: "CollisionLimit",
    promise: "Bodies keep `margin` apart, as far as `braking` [m/s²] can be delivered; `influence` [m] must exceed `margin \
        + w² / (2 braking)` at closing speed w. A `half_space` is what lies at `z <= 0` of its own axes. `urdf` adds the \
        robot file's own spheres, boxes, cylinders and capsules.",
    example: "collision = { shapes = [{ frame = \"panda_hand\", shape = { sphere = { radius = 0.1 } } }, { name = \
        \"floor\", shape = \"half_space\" }], braking = 2.0 }",
    form: Form::Either,
    margin: "[m]",
    stricter: Some([
        "collision = { shapes = [{ frame = \"panda_hand\", shape = { sphere = { radius = 0.1 } } }, { name = \
        \"floor\", shape = \"half_space\" }], braking = 2.0, margin = 0.3, influence = 0.5 }",
        "collision = { shapes = [{ frame = \"panda_hand\", shape = { sphere = { radius = 0.4 } } }, { name = \
        \"floor\", shape = \"half_space\" }], braking = 2.0, influence = 0.2 }",
    ]),
    arguments: &[
        Argument::needed("shapes", Takes::Solids),
        Argument::needed("braking", Takes::Number),
        Argument::MARGIN,
        Argument::named("urdf", Takes::Flag, "False"),
        Argument::named("ignore", Takes::Pairs, "()"),
        Argument::named("adjacent", Takes::Flag, "False"),
        Argument::named("influence", Takes::Number, "0.2"),
        Argument::named("rows", Takes::Count, "16"),
        Argument::SOFT,
    ],
};

/// `collision = { shapes = [{ frame = "hand", shape = { sphere = { radius = 0.1 } } }, { name = "floor", shape = "half_space" }],
/// braking = 2.0 }`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CollisionSettings {
    /// Solids of the robot and around it.
    #[serde(default)]
    pub shapes: Vec<SolidSettings>,
    /// Also take the spheres, boxes, cylinders and capsules of the URDF's `<collision>` elements.
    #[serde(default)]
    pub urdf: bool,
    /// Pairs of solids or links that may meet, by name.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub ignore: Vec<[String; 2]>,
    /// Also watch links that share a joint.
    #[serde(default)]
    pub adjacent: bool,
    /// Deceleration of a closing distance that may be counted on [m/s²].
    pub braking: f64,
    /// Distance kept \[m\].
    #[serde(default)]
    pub margin: f64,
    /// Pairs farther apart than this get no row \[m\].
    #[serde(default = "influence")]
    pub influence: f64,
    /// At most this many pairs have a row in a tick, the nearest first.
    #[serde(default = "rows")]
    pub rows: usize,
    /// How much the rows resist; hard when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub soft: Option<Soft>,
}

fn influence() -> f64 {
    0.2
}

fn rows() -> usize {
    16
}

/// One solid.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SolidSettings {
    /// Name in reports and in `ignore`; the frame's when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// What carries it; absent: an obstacle, placed in the world.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame: Option<String>,
    /// `{ sphere = { radius } }`, `{ capsule = { radius, length } }`, `{ cylinder = { radius, length } }`,
    /// `{ box = { size = [x, y, z] } }` or `"half_space"` (everything with z <= 0).
    pub shape: Shape,
    /// Its origin in the frame's axes \[m\].
    #[serde(default)]
    pub position: [f64; 3],
    /// Its roll, pitch and yaw in the frame's axes \[rad\].
    #[serde(default)]
    pub rpy: [f64; 3],
}

/// The distance of two solids, less the margin, never becomes negative: `braking` stops them in front of each other.
///
/// With unit normal `n` from body A to body B, the nearest point of each, distance `d^` and closing speed `w^ = n' (v_A - v_B)` of
/// these points at `q (+) T v`, where the robot will be if no joint accelerates:
///
/// ```text
///     n' (J_A - J_B) y / T  <=  approach(d, w) - c
/// ```
///
/// as for a [`FrameLimit`](super::FrameLimit), with the change `c` of the closing speed from `q` to there per second, for every pair within
/// `influence` (at most `rows` of them, the nearest first; the others have none).
///
/// # How exact
///
/// The distance at the end of the period is off by O((T y)²): microns at 10 ms. Where a
/// face or an edge turns nearly parallel to a surface the nearest point jumps, and `w` with it by the angular speed times the
/// width of the face: `margin` must cover what `braking` cannot. Nobody certifies that the joints can brake by `braking`: choose what they
/// can do everywhere (0.8 m/s² held on the Panda, 2 m/s² did not). `influence` must exceed `margin` plus the stopping
/// distance, closing speed² / (2 `braking`), or the row comes too late.
#[derive(Debug, Clone)]
pub struct CollisionLimit {
    settings: CollisionSettings,
}

impl CollisionLimit {
    /// From the task file's settings.
    pub fn new(settings: CollisionSettings) -> CollisionLimit {
        CollisionLimit { settings }
    }

    /// `shapes` keep clear of each other, braking by `braking` [m/s²].
    pub fn of(shapes: Vec<SolidSettings>, braking: f64) -> CollisionLimit {
        CollisionLimit {
            settings: CollisionSettings {
                shapes,
                urdf: false,
                ignore: Vec::new(),
                adjacent: false,
                braking,
                margin: 0.0,
                influence: influence(),
                rows: rows(),
                soft: None,
            },
        }
    }

    /// All solids, the stated ones first.
    fn bodies(&self, model: &Model) -> Result<Vec<Body>, LimitError> {
        let mut bodies = Vec::new();
        for s in &self.settings.shapes {
            let frame = match &s.frame {
                Some(name) => model.find_frame(name).map_err(|near| LimitError::UnknownFrame {
                    limit: "collision",
                    name: name.clone(),
                    near,
                })?,
                None => FrameId::WORLD,
            };
            let link = s.frame.clone().unwrap_or_default();
            let name = s.name.as_ref().or(s.frame.as_ref()).ok_or_else(|| LimitError::Unusable {
                what: "an obstacle of collision has neither name nor frame".to_string(),
                next: "give it a name",
            })?;
            let is_obstacle = |of: &SolidSettings| of.frame.is_none() && of.name.as_ref() == Some(name);
            if s.frame.is_none() && self.settings.shapes.iter().filter(|of| is_obstacle(of)).count() > 1 {
                return Err(LimitError::Unusable {
                    what: format!("two obstacles of collision are named '{name}'"),
                    next: "give each a name of its own, by which it can be put elsewhere",
                });
            }
            s.shape.check(&format!("shape '{name}'"))?;
            let sum = s.position.iter().chain(&s.rpy).sum();
            check(&format!("position or rpy of shape '{name}'"), sum, true, "finite, in m and rad")?;
            bodies.push(Body::stated(name.clone(), link, frame, s));
        }
        if self.settings.urdf {
            self.add_links(model, &mut bodies)?;
        }
        Ok(bodies)
    }

    /// The primitives of the robot file.
    fn add_links(&self, model: &Model, bodies: &mut Vec<Body>) -> Result<(), LimitError> {
        let (mut found, mut bare) = (false, Vec::new());
        let robot = model.description();
        for solid in &robot.solids {
            let link = solid.body.map_or("universe", |body| &robot.bodies[body].name);
            let unknown =
                |near| LimitError::UnknownFrame { limit: "collision", name: link.to_string(), near };
            let frame = model.find_frame(link).map_err(unknown)?;
            match solid.shape {
                Some(shape) => {
                    shape.check(&format!("a collision solid of link '{link}'"))?;
                    bodies.push(Body::new(link.to_string(), link.to_string(), frame, shape, solid.placement));
                    found = true;
                }
                None if self.settings.shapes.iter().any(|s| s.frame.as_deref() == Some(link)) => {}
                None => bare.push(link),
            }
        }
        if !bare.is_empty() {
            let what = format!("the collision geometry of {} is a mesh", quoted_names(&bare));
            let next = "give each a shape in collision.shapes, or drop its <collision>";
            return Err(LimitError::Unusable { what, next });
        }
        if !found {
            let what = "collision says urdf = true, but the robot file has no primitive collision geometry"
                .to_string();
            return Err(LimitError::Unusable { what, next: "give collision.shapes instead" });
        }
        Ok(())
    }

    /// Numbers of bodies that must not meet.
    fn pairs(
        &self,
        model: &Model,
        bodies: &[Body],
        controllable: &[usize],
    ) -> Result<Vec<[usize; 2]>, LimitError> {
        for name in self.settings.ignore.iter().flatten() {
            if !bodies.iter().any(|b| b.called(name)) {
                let near = crate::error::near_names(name, bodies.iter().map(|b| b.name.as_str()));
                let what = format!("collision ignores '{name}', which is no solid{near}");
                return Err(LimitError::Unusable { what, next: "correct the name" });
            }
        }
        let ignored = |a: &Body, b: &Body| {
            let listed = |[x, y]: &[String; 2]| (a.called(x) && b.called(y)) || (a.called(y) && b.called(x));
            self.settings.ignore.iter().any(listed)
        };
        let meet = |a: &Body, b: &Body| {
            // What stands next to the first link shares no joint with it.
            let linked = !a.is_obstacle() && !b.is_obstacle() && !self.settings.adjacent;
            let excused = (linked && model.neighbours(a.frame, b.frame)) || ignored(a, b);
            let moves = |i: usize| model.moves(i, a.frame) != model.moves(i, b.frame);
            let moved = match controllable.is_empty() {
                true => (0..model.nv()).any(moves),
                false => controllable.iter().any(|i| moves(*i)),
            };
            let planes = a.is_plane() && b.is_plane();
            moved && !excused && !planes
        };
        let mut pairs = Vec::new();
        for a in 0..bodies.len() {
            pairs.extend((a + 1..bodies.len()).filter(|b| meet(&bodies[a], &bodies[*b])).map(|b| [a, b]));
        }
        Ok(pairs)
    }
}

impl Limit for CollisionLimit {
    fn name(&self) -> &'static str {
        "collision"
    }

    fn rows(&self, model: &Model, controllable: &[usize]) -> Result<Option<Box<dyn Rows>>, LimitError> {
        let s = &self.settings;
        check("collision braking", s.braking, s.braking > 0.0, "above 0 m/s²")?;
        check("collision margin", s.margin, s.margin >= 0.0, "at least 0 m")?;
        check("collision influence", s.influence, s.influence > s.margin, "above the margin, in m")?;
        check("collision rows", s.rows as f64, s.rows > 0, "at least 1")?;
        let bodies = self.bodies(model)?;
        let pairs = self.pairs(model, &bodies, controllable)?;
        if pairs.is_empty() {
            let what = "collision has no two solids that could meet".to_string();
            return Err(LimitError::Unusable { what, next: "add shapes, or drop the limit" });
        }
        let reach = Reach { influence: s.influence, rows: s.rows };
        Ok(Some(Box::new(CollisionRows {
            pairs: Pairs::new(bodies, pairs, reach),
            braking: s.braking,
            margin: s.margin,
            ahead: Ahead::new(model),
        })))
    }

    fn soft(&self) -> Option<Soft> {
        self.settings.soft
    }
}

struct CollisionRows {
    pairs: Pairs,
    braking: f64,
    margin: f64,
    ahead: Ahead,
}

impl Rows for CollisionRows {
    fn kind(&self) -> Kind {
        Kind::Collision
    }

    fn names(&self) -> Vec<String> {
        self.pairs.names()
    }

    fn sizes(&self) -> Vec<f64> {
        vec![self.braking; self.pairs.slots()]
    }

    fn needs(&self) -> Needs {
        Needs::default()
    }

    fn asks_more(&self) -> bool {
        true
    }

    fn places(&self) -> Vec<Place> {
        self.pairs.places()
    }

    fn put(&mut self, numbers: &[[f64; 6]]) {
        self.pairs.put(numbers);
    }

    fn fill(&mut self, tick: &mut TickStart<'_>, rows: &mut RowsMut<'_>) {
        let (scale, period) = (1.0 / tick.period.dt, tick.period);
        self.pairs.begin(self.ahead.look_at_frames(tick.q, tick.v, 0.0));
        let kinematics = self.ahead.look(tick.q, tick.v, period.dt);
        for near in self.pairs.look(kinematics) {
            let row = rows.row(near.slot);
            for (k, sign) in [(0, scale), (1, -scale)] {
                let (frame, point) = (near.frames[k], near.between.points[k]);
                if frame != FrameId::WORLD {
                    kinematics.add_row(frame, point, near.between.normal, sign, row);
                }
            }
            let clearance = near.clearance(self.margin, period);
            rows.upper[near.slot] = clearance.bound(self.braking, period);
            rows.outside[near.slot] = clearance.is_outside();
        }
        // Seen from where the robot will be, that is off by the second order of the period.
        if rows.outside.contains(&true) {
            let now = self.ahead.look_at_frames(tick.q, tick.v, 0.0);
            if self.pairs.least(now) >= self.margin - AT {
                rows.outside.fill(false);
            }
        }
    }

    fn excess(&mut self, motion: &mut Motion<'_>, out: &mut [f64]) {
        out.fill(f64::NEG_INFINITY);
        self.pairs.begin(self.ahead.look_at_frames(motion.q, motion.v, 0.0));
        let near = self.pairs.look(self.ahead.look_at_frames(motion.q, motion.v, motion.period.dt));
        let then = self.ahead.turn(motion.v_next);
        for near in near {
            let clearance = near.clearance(self.margin, motion.period);
            out[near.slot] = clearance.excess(near.closing(then), self.braking, motion.period);
        }
    }

    /// Metres by which the two nearest bodies are closer than the margin, in the first place: which pair is in which slot changes
    /// along a motion. The other places break nothing, and are no rows that a brake cannot keep.
    fn breach(&mut self, motion: &mut Motion<'_>, out: &mut [f64]) {
        out.fill(-1.0);
        let then = self.ahead.look_at_frames(motion.q_next, motion.v_next, 0.0);
        out[0] = self.margin - self.pairs.least(then);
    }
}
