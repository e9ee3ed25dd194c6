//! Limits that an operator moved inside those of the build, and what is in force on the way to them: as `docs/LIMITS.md` declares it, the
//! tightest that the brake in force keeps.

use std::collections::BTreeMap;

use serde::Deserialize;

use crate::limits::{Limits, PerJoint};
use crate::motion::Machine;
use crate::period::Period;
use crate::rows::{Passage, Rule};
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
        }
    }
}

/// Limits of a build that were moved.
pub(crate) struct Moving {
    pub(crate) built: Limits,
    pub(crate) wanted: Limits,
    /// Scratch of a run: what each row is beyond what is wanted in each period (rows, periods).
    seen: Vec<Vec<f64>>,
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
                Rule::Plane { offset, .. } => *offset -= self.frame.get(&row.label).copied().unwrap_or(0.0),
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
        wanted
    }
}

impl Moving {
    pub(crate) fn new(built: Limits, moved: &Moved, p: &Period, dofs: &[usize]) -> Moving {
        let wanted = moved.limits(&built, p, dofs);
        Moving { seen: vec![Vec::new(); built.rows.len()], built, wanted }
    }

    /// What is in force for a tick at `q`, `v` while the stored brake is `brake`; without one each joint brakes by itself.
    pub(crate) fn in_force(
        &mut self,
        machine: &mut Machine,
        (p, dofs): (&Period, &[usize]),
        (q, v): (&[f64], &[f64]),
        brake: Option<&[f64]>,
    ) -> Limits {
        let mut force = self.wanted.clone();
        for &i in dofs {
            let (j, b) = (&mut force.joints[i], &self.built.joints[i]);
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
            self.allow(machine, (p, dofs), (q, v), brake, &mut force);
        }
        force
    }

    /// Allows rows that were moved what the brake makes of them, and half of its second differences between the places that are looked at.
    fn allow(
        &mut self,
        machine: &mut Machine,
        (p, dofs): (&Period, &[usize]),
        (q, v): (&[f64], &[f64]),
        brake: &[f64],
        force: &mut Limits,
    ) {
        let is_moved = |r: &usize| self.wanted.rows[*r].is_of_state() && self.wanted.rows[*r].soft.is_none();
        let rows: Vec<usize> = (0..self.wanted.rows.len()).filter(is_moved).collect();
        if rows.is_empty() {
            return;
        }
        self.seen.iter_mut().for_each(Vec::clear);
        let mut coast = Coast::new(q, v, &vec![0.0; v.len()]);
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
            if !moves || coast.is_too_long(machine) {
                break;
            }
            coast.go_on();
        }
        for r in rows {
            let seen = &self.seen[r];
            let apart = seen.len() / LOOKS + 1;
            let most = seen.iter().fold(0.0, |most: f64, by| most.max(*by));
            let bend = |k: usize| (seen[k + 2 * apart] - 2.0 * seen[k + apart] + seen[k]).abs();
            let bends = (0..seen.len().saturating_sub(2 * apart)).map(bend).fold(0.0, f64::max);
            if most > 0.0 {
                let row = &mut force.rows[r];
                row.allowed = (most + 0.5 * bends).min(row.looser(&self.built.rows[r]));
            }
        }
    }
}
