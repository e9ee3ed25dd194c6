//! Turns limits that are asked for by name into plain numbers, and refuses those that cannot be, with the reason.

use super::Moving;
use crate::kinematics::{dot, norm};
use crate::limit::Moved;
use crate::projector::Projector;
use crate::row::Place;
use crate::target::{Braking, Consistency};
use crate::viability::Dof;
use crate::{LimitError, PerJoint};

impl Projector {
    /// What [`Projector::move_limits`] would take over, for [`Projector::set_moved`].
    ///
    /// # Errors
    /// As there.
    pub fn moved_numbers(&self, moved: &Moved) -> Result<Vec<f64>, LimitError> {
        let (nv, switches) = (self.model.nv(), self.switches.len());
        let mut still = Moving::new(&self.limits, switches, 0, self.moving.built.clone());
        if *moved == Moved::default() {
            return Ok(still.numbers);
        }
        if self.settings.consistency == Consistency::Free {
            return Err(LimitError::Unusable {
                what: "limits are moved while positions and velocities are clamped apart".into(),
                next: "set consistency = \"kinematic\", or build another projector with tighter limits",
            });
        }
        if let Some(payload) = &moved.payload {
            return Err(LimitError::Unusable {
                what: format!(
                    "a payload of {} kg changes the robot that the projector was built for",
                    payload.mass
                ),
                next: "build another with Model::with_payload, or give it to a running loop with 'nearl limits'",
            });
        }
        let share = moved.speed;
        if !(share > 0.0 && share <= 1.0) {
            let domain = "above 0 and at most 1";
            return Err(LimitError::BadValue { what: "speed".into(), value: share, domain });
        }
        let numbers = &mut still.numbers;
        self.move_joints(moved, numbers)?;
        let (insets, shares) = numbers[4 * nv..].split_at_mut(switches);
        let (shares, places) = shares.split_at_mut(switches);
        self.move_frames(moved, insets)?;
        self.move_cones(moved, shares)?;
        self.move_places(moved, places)?;
        if share < 1.0 && shares.iter().all(|s| *s == 1.0) && numbers[..nv].iter().all(|v| v.is_infinite()) {
            let what = format!(
                "speed is {share} of no limit: the projector has none on velocity, frame speed or energy"
            );
            return Err(LimitError::Unusable { what, next: "build it with a velocity limit" });
        }
        Ok(still.numbers)
    }

    fn move_joints(&self, moved: &Moved, numbers: &mut [f64]) -> Result<(), LimitError> {
        let (nv, built) = (self.model.nv(), &self.limits);
        let given = |what, limit: &Option<PerJoint>, good: fn(f64) -> bool, domain| match limit {
            None => Ok(vec![None; nv]),
            Some(limit) => limit.values(&self.model, what, good, domain),
        };
        let (velocity, acceleration) = (
            given("velocity", &moved.velocity, |x| x > 0.0, "above 0 rad/s or m/s")?,
            given("acceleration", &moved.acceleration, |x| x > 0.0, "above 0 rad/s² or m/s²")?,
        );
        let (lower, upper) = (
            given("lower", &moved.lower, |_| true, "finite, in rad or m")?,
            given("upper", &moved.upper, |_| true, "finite, in rad or m")?,
        );
        for &i in &self.dofs.controllable {
            let name = self.model.dof_name(i);
            let inside = |what: &str, value: Option<f64>, limit: f64, wider: bool, unit: &str| match value {
                Some(value) if wider => Err(LimitError::Unusable {
                    what: format!(
                        "{what} {value} {unit} of joint '{name}' is beyond the {limit} {unit} of the build"
                    ),
                    next: "move limits inside those of the build, or build with wider ones",
                }),
                value => Ok(value),
            };
            let wider = |value: Option<f64>, limit: f64| value.is_some_and(|value| value > limit);
            let (v, a) = (built.velocity[i], built.acceleration[i]);
            let (low, high) = (built.q_lower[i], built.q_upper[i]);
            let speed = inside("velocity", velocity[i], v, wider(velocity[i], v), "rad/s or m/s")?;
            let gain =
                inside("acceleration", acceleration[i], a, wider(acceleration[i], a), "rad/s² or m/s²")?;
            if gain.is_some() && built.jerk[i].is_finite() {
                // Turned round at standstill, it speeds up by what it slowed down by, until that has fallen.
                return Err(LimitError::Unusable {
                    what: format!("acceleration of joint '{name}' is moved while its jerk is hard"),
                    next: "drop hard from jerk, or move speeds and positions alone",
                });
            }
            let up = inside("upper", upper[i], high, wider(upper[i], high), "rad or m")?;
            let down = inside("lower", lower[i], low, lower[i].is_some_and(|x| x < low), "rad or m")?;
            numbers[i] = (moved.speed * v).min(speed.unwrap_or(f64::INFINITY));
            if moved.speed == 1.0 && speed.is_none() {
                numbers[i] = f64::INFINITY;
            }
            numbers[nv + i] = gain.unwrap_or(f64::INFINITY);
            numbers[2 * nv + i] = down.unwrap_or(f64::NEG_INFINITY);
            numbers[3 * nv + i] = up.unwrap_or(f64::INFINITY);
            if up.is_some() || down.is_some() {
                self.leaves_room(i, down.unwrap_or(low), up.unwrap_or(high))?;
            }
        }
        Ok(())
    }

    /// Refuses positions between which the joint cannot brake as it does in those of the build.
    fn leaves_room(&self, i: usize, low: f64, high: f64) -> Result<(), LimitError> {
        let (built, moved) =
            (Dof::of(&self.limits, i), Dof { lower: low, upper: high, ..Dof::of(&self.limits, i) });
        let name = self.model.dof_name(i);
        if self.dofs.single[i].is_none() {
            let what = format!("joint '{name}' has no range of positions, so that none can be moved");
            return Err(LimitError::Unusable { what, next: "leave it out, and name joints that have one" });
        }
        if built.acceleration.is_infinite() {
            let what =
                format!("joint '{name}' has no acceleration limit to stop with in front of a position");
            return Err(LimitError::Unusable { what, next: "build with acceleration = { limit = ... }" });
        }
        if low >= high || moved.braking(&self.period) < built.braking(&self.period) {
            let list = format!(
                "joint '{name}' would have to stay above {low} and below {high} rad or m, less than a period of braking by {} rad/s² or m/s² needs",
                built.braking(&self.period)
            );
            return Err(LimitError::Contradictory { list });
        }
        Ok(())
    }

    fn move_frames(&self, moved: &Moved, insets: &mut [f64]) -> Result<(), LimitError> {
        for (name, by) in &moved.frame {
            let mut any = false;
            for (limit, switch) in self.switches.iter().enumerate() {
                let rows = self.coupled.as_ref().and_then(|stages| stages.sources.most_inset(limit));
                let Some((most, hard)) = rows.filter(|_| switch.label == *name) else { continue };
                if !(*by >= 0.0 && *by < most) {
                    let what = format!(
                        "{by} m inside for the planes of frame limit '{name}' is not between 0 and {most} m"
                    );
                    return Err(LimitError::Unusable {
                        what,
                        next: "move planes inside where they were built",
                    });
                }
                self.can_stop("frame", name, hard)?;
                (insets[limit], any) = (*by, true);
            }
            if !any {
                return Err(self.unknown("frame", name));
            }
        }
        Ok(())
    }

    /// Planes and obstacles, wherever they are put.
    fn move_places(&self, moved: &Moved, numbers: &mut [f64]) -> Result<(), LimitError> {
        let places: Vec<_> = self.coupled.iter().flat_map(|stages| stages.sources.places()).collect();
        let finite = |what: String, values: &[f64]| match values.iter().find(|x| !x.is_finite()) {
            Some(x) => Err(LimitError::BadValue { what, value: *x, domain: "finite, in m or rad" }),
            None => Ok(()),
        };
        for (name, plane) in &moved.plane {
            let is_meant =
                |limit: usize, place: &Place| place.name.is_none() && self.switches[limit].label == *name;
            is_one("planes", name, places.iter().filter(|(limit, _, place)| is_meant(*limit, place)))?;
            let mut any = false;
            for ((limit, hard, place), to) in places.iter().zip(numbers.chunks_mut(6)) {
                if !is_meant(*limit, place) {
                    continue;
                }
                finite(format!("plane of '{name}'"), &[plane.normal, plane.through].concat())?;
                let length = norm(plane.normal);
                if length < 1e-9 {
                    let (what, domain) = (format!("length of the normal of '{name}'"), "above 0");
                    return Err(LimitError::BadValue { what, value: length, domain });
                }
                self.can_stop("frame", name, *hard)?;
                let n = plane.normal.map(|x| x / length);
                to[..3].copy_from_slice(&n);
                (to[3], any) = (dot(n, plane.through), true);
            }
            if !any {
                return Err(self.unknown("frame", name));
            }
        }
        for (name, pose) in &moved.body {
            is_one("obstacles", name, places.iter().filter(|(.., place)| place.name.as_ref() == Some(name)))?;
            let mut any = false;
            for ((_, hard, place), to) in places.iter().zip(numbers.chunks_mut(6)) {
                if place.name.as_ref() == Some(name) {
                    finite(format!("place of obstacle '{name}'"), &[pose.position, pose.rpy].concat())?;
                    self.can_stop("collision", name, *hard)?;
                    to[..3].copy_from_slice(&pose.position);
                    to[3..].copy_from_slice(&pose.rpy);
                    any = true;
                }
            }
            if !any {
                let known: Vec<&str> = places.iter().filter_map(|(.., p)| p.name.as_deref()).collect();
                let near = match known.is_empty() {
                    true => "; collision has none".to_string(),
                    false => crate::error::near_names(name, known.into_iter()),
                };
                let what = format!("no obstacle is called '{name}'{near}");
                return Err(LimitError::Unusable {
                    what,
                    next: "name one of collision.shapes without a frame",
                });
            }
        }
        Ok(())
    }

    fn move_cones(&self, moved: &Moved, shares: &mut [f64]) -> Result<(), LimitError> {
        let cones = self.coupled.iter().flat_map(|stages| stages.sources.cone_limits());
        let mut named = 0;
        for (limit, size, hard) in cones {
            let switch = &self.switches[limit];
            let (value, built) = match switch.kind {
                "energy" => (moved.energy, 0.5 * size * size),
                _ => (moved.frame_speed.get(&switch.label).copied(), size),
            };
            named += usize::from(value.is_some());
            let (kind, unit) = if switch.kind == "energy" { ("energy", "J") } else { ("frame_speed", "m/s") };
            if let Some(value) = value.filter(|value| !(*value > 0.0 && *value <= built)) {
                let what = format!(
                    "{kind} {value} {unit} of '{}' is not above 0 and at most the {built} {unit} of the build",
                    switch.label
                );
                return Err(LimitError::Unusable { what, next: "move limits inside those of the build" });
            }
            let share = value
                .map_or(1.0, |value| if kind == "energy" { (value / built).sqrt() } else { value / built });
            shares[limit] = share.min(moved.speed);
            if shares[limit] < 1.0 {
                self.can_stop(kind, &switch.label, hard)?;
            }
        }
        if let Some(name) = moved
            .frame_speed
            .keys()
            .find(|name| !self.switches.iter().any(|s| s.kind == "frame_speed" && s.label == **name))
        {
            return Err(self.unknown("frame_speed", name));
        }
        if moved.energy.is_some()
            && named == moved.frame_speed.len()
            && !self.switches.iter().any(|s| s.kind == "energy")
        {
            return Err(self.unknown("energy", "energy"));
        }
        Ok(())
    }

    /// A hard row or cone can be moved where a stored brake says how far the way there goes.
    fn can_stop(&self, kind: &str, name: &str, hard: bool) -> Result<(), LimitError> {
        if hard && self.settings.braking != Braking::Stored {
            let what = format!("the hard limit {kind} '{name}' cannot be moved without a stored brake");
            return Err(LimitError::Unusable { what, next: "set braking = \"stored\"" });
        }
        Ok(())
    }

    fn unknown(&self, kind: &str, name: &str) -> LimitError {
        let known = self.switches.iter().filter(|s| s.kind == kind).map(|s| s.label.as_str());
        let near = crate::error::near_names(name, known);
        LimitError::Unusable {
            what: format!("no limit {kind} is called '{name}'{near}"),
            next: "name one that the projector was built with",
        }
    }
}

/// Of several that have a name all would be put where one is meant to be; those that lie in the same place are one.
fn is_one<'a>(
    what: &str,
    name: &str,
    mut found: impl Iterator<Item = &'a (usize, bool, Place)>,
) -> Result<(), LimitError> {
    let Some((.., first)) = found.next() else { return Ok(()) };
    if found.all(|(.., other)| other.numbers == first.numbers) {
        return Ok(());
    }
    Err(LimitError::Unusable {
        what: format!(
            "several {what} are called '{name}' and lie apart, so that one of them cannot be meant"
        ),
        next: "give each limit or shape a name of its own",
    })
}
