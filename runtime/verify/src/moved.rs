//! Limits that an operator moved inside those of the build, and what is in force on the way to them: as `docs/LIMITS.md` declares it, the
//! tightest that the brake in force keeps.

use std::collections::BTreeMap;

use serde::Deserialize;

use crate::jerk::Brake;
use crate::limits::{HalfSpace, Limits, PerJoint};
use crate::motion::Machine;
use crate::period::Period;
use crate::robot::Payload;
use crate::rows::{Passage, Rule};
use crate::space::{Vec3, dot, norm, times};
use crate::stop::{Coast, rest};

/// Looks at a brake in so many places, between which half of the second differences is allowed for.
const LOOKS: usize = 16;

/// Where limits are moved to; what is not named is as it was built.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Moved {
    speed: f64,
    velocity: Option<PerJoint>,
    acceleration: Option<PerJoint>,
    lower: Option<PerJoint>,
    upper: Option<PerJoint>,
    frame: BTreeMap<String, f64>,
    frame_speed: BTreeMap<String, f64>,
    energy: Option<f64>,
    /// Where planes lie and obstacles stand, by name.
    plane: BTreeMap<String, HalfSpace>,
    body: BTreeMap<String, Pose>,
    /// What the robot carries.
    pub(crate) payload: Option<Payload>,
}

/// A place in the world.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Pose {
    pub(crate) position: Vec3,
    #[serde(default)]
    pub(crate) rpy: Vec3,
}

impl Default for Moved {
    fn default() -> Moved {
        Moved {
            speed: 1.0,
            velocity: None,
            acceleration: None,
            lower: None,
            upper: None,
            frame: BTreeMap::new(),
            frame_speed: BTreeMap::new(),
            energy: None,
            plane: BTreeMap::new(),
            body: BTreeMap::new(),
            payload: None,
        }
    }
}

/// Limits of a build that were moved.
pub(crate) struct Moving {
    pub(crate) built: Limits,
    pub(crate) wanted: Limits,
    /// Scratch of a run: what each row is beyond what is wanted in each period (rows, periods).
    seen: Vec<Vec<f64>>,
    /// Obstacles that must not be met stand elsewhere.
    bodies: bool,
}

impl Moved {
    /// The limits that are wanted: those of the build, tighter.
    pub(crate) fn limits(&self, built: &Limits, p: &Period, dofs: &[usize]) -> Limits {
        let mut wanted = built.clone();
        for &i in dofs {
            let j = &mut wanted.joints[i];
            let named = |of: &Option<PerJoint>| of.as_ref().and_then(|of| of.of(i, &j.name));
            let (velocity, faster) = (named(&self.velocity), named(&self.acceleration));
            let (lower, upper) = (named(&self.lower), named(&self.upper));
            j.built_brake = Some(j.brake(p));
            j.velocity = (self.speed * j.velocity).min(velocity.unwrap_or(f64::INFINITY)).min(j.velocity);
            j.faster = faster.unwrap_or(f64::INFINITY);
            j.lower = j.lower.max(lower.unwrap_or(f64::NEG_INFINITY));
            j.upper = j.upper.min(upper.unwrap_or(f64::INFINITY));
        }
        for row in &mut wanted.rows {
            match &mut row.rule {
                Rule::Plane { offset, n, half_space, .. } => {
                    if let (Some(margin), Some(plane)) = (half_space, self.plane.get(&row.label)) {
                        *n = times(1.0 / norm(plane.normal), plane.normal);
                        *offset = dot(*n, plane.through) - *margin;
                    }
                    *offset -= self.frame.get(&row.label).copied().unwrap_or(0.0);
                }
                Rule::Speed { most, .. } => {
                    let own = self.frame_speed.get(&row.label).copied().unwrap_or(f64::INFINITY);
                    row.size = own.min(self.speed * *most).min(*most);
                    *most = row.size;
                }
                Rule::Energy { most } => {
                    *most =
                        self.energy.unwrap_or(f64::INFINITY).min(self.speed * self.speed * *most).min(*most);
                    row.size = (2.0 * *most).sqrt();
                }
                _ => {}
            }
        }
        if let Some(collision) = wanted.collision.as_mut().filter(|_| !self.body.is_empty()) {
            *collision = std::rc::Rc::new(collision.with(&self.body));
        }
        wanted
    }

    /// Of planes and obstacles that were put elsewhere nothing of the build holds.
    fn release(&self, built: &mut Limits) {
        for row in &mut built.rows {
            if let Rule::Plane { offset, half_space: Some(_), .. } = &mut row.rule
                && self.plane.contains_key(&row.label)
            {
                *offset = f64::INFINITY;
            }
        }
        if !self.body.is_empty() {
            built.collision = None;
        }
    }
}

impl Moving {
    pub(crate) fn new(mut built: Limits, moved: &Moved, p: &Period, dofs: &[usize]) -> Moving {
        let wanted = moved.limits(&built, p, dofs);
        moved.release(&mut built);
        let bodies = !moved.body.is_empty() && wanted.collision.as_ref().is_some_and(|c| c.is_hard);
        Moving { seen: vec![Vec::new(); built.rows.len()], built, wanted, bodies }
    }

    /// What is in force for a tick at `q`, `v` after one at the accelerations `last` while the stored brake is `brake`; without one each joint brakes by
    /// itself.
    pub(crate) fn in_force(
        &mut self,
        machine: &mut Machine,
        (p, dofs): (&Period, &[usize]),
        (q, v): (&[f64], &[f64]),
        (brake, last): (Option<&[f64]>, &[f64]),
    ) -> Limits {
        let mut force = self.wanted.clone();
        for &i in dofs {
            let (j, b) = (&mut force.joints[i], &self.built.joints[i]);
            if b.jerk.is_finite() {
                // A brake may speed up and go on for a while before it slows down.
                let own = Brake::new(b.braking_jerk, brake.map_or(b.stops(p), |brake| brake[i]), p);
                let a = own.next(v[i], last[i]);
                let v1 = own.velocity(v[i], a);
                let [above, below] = [1.0, -1.0].map(|sign| {
                    let (place, fastest) = own.highest(sign * v1, sign * a);
                    let way = p.farthest(sign * v[i], sign * a).max(sign * p.way(v[i], v1) + place);
                    (way.max(0.0), fastest)
                });
                j.velocity = j.velocity.max(above.1).max(below.1);
                if let Some(at) = machine.single(i) {
                    j.upper = j.upper.max((q[at] + above.0).min(b.upper));
                    j.lower = j.lower.min((q[at] - below.0).max(b.lower));
                }
                continue;
            }
            let most = b.brake(p);
            let own = brake.map_or(most, |brake| brake[i]);
            let slower = (v[i].abs() - own * p.dt).max(0.0);
            let mut speed = slower;
            if let (Some(at), None) = (machine.single(i), brake) {
                // Stopped in front of a position it may be turned round in its last period.
                let room = (b.upper - q[at]).min(q[at] - b.lower);
                if p.stopping(v[i].abs(), most) + 2.0 * most * p.dt * p.dt >= room {
                    speed = speed.max(most * p.dt);
                    j.faster = j.faster.max(most);
                }
            }
            j.velocity = j.velocity.max(speed).min(b.velocity);
            if let Some(at) = machine.single(i) {
                let way = v[i].signum() * rest(v[i].abs(), own, p);
                j.upper = j.upper.max((q[at] + way.max(0.0)).min(b.upper));
                j.lower = j.lower.min((q[at] + way.min(0.0)).max(b.lower));
            }
        }
        if let Some(brake) = brake {
            self.allow(machine, (p, dofs), (q, v), (brake, last), &mut force);
        }
        force
    }

    /// Allows rows that were moved what the brake makes of them, and half of its second differences between the places that are looked at.
    fn allow(
        &mut self,
        machine: &mut Machine,
        (p, dofs): (&Period, &[usize]),
        (q, v): (&[f64], &[f64]),
        (brake, last): (&[f64], &[f64]),
        force: &mut Limits,
    ) {
        let is_moved = |r: &usize| self.wanted.rows[*r].is_of_state() && self.wanted.rows[*r].soft.is_none();
        let rows: Vec<usize> = (0..self.wanted.rows.len()).filter(is_moved).collect();
        if rows.is_empty() && !self.bodies {
            return;
        }
        let mut near = Vec::new();
        self.seen.iter_mut().for_each(Vec::clear);
        let mut coast = Coast::new(q, v, last);
        loop {
            // What a state is, not what leads to it.
            let moves = coast.period(machine, &self.built, (p, dofs), brake);
            let at = coast.passage();
            let still = Passage { q: at.q, v: at.v, q1: at.q, v1: at.v, ..at };
            for &r in &rows {
                if let Some(by) = self.wanted.rows[r].breach(machine, p, &still) {
                    self.seen[r].push(by);
                }
            }
            if let Some(collision) = self.wanted.collision.as_ref().filter(|_| self.bodies) {
                machine.go(still.q, still.v);
                near.push(collision.margin - collision.least(machine).unwrap_or(f64::NAN));
            }
            if !moves || coast.is_too_long(machine) {
                break;
            }
            coast.go_on();
        }
        let worst = |seen: &[f64]| {
            let apart = seen.len() / LOOKS + 1;
            let most = seen.iter().fold(0.0, |most: f64, by| most.max(*by));
            let bend = |k: usize| (seen[k + 2 * apart] - 2.0 * seen[k + apart] + seen[k]).abs();
            let bends = (0..seen.len().saturating_sub(2 * apart)).map(bend).fold(0.0, f64::max);
            if most > 0.0 { most + 0.5 * bends } else { 0.0 }
        };
        // Where some distance is not known, the whole is not.
        force.nearer = if near.iter().any(|by| by.is_nan()) { f64::NAN } else { worst(&near) };
        for r in rows {
            let most = worst(&self.seen[r]);
            if most > 0.0 {
                let row = &mut force.rows[r];
                row.allowed = most.min(row.looser(&self.built.rows[r]));
            }
        }
    }
}
