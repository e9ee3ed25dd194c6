//! Limits that tie joints together: what they ask of a passage, what they keep, and how they change with it.

use std::rc::Rc;

use serde::Deserialize;

use crate::drives::Drives;
use crate::limit_check::worst;
use crate::motion::{Machine, Spot};
use crate::period::Period;
use crate::space::{Vec3, dot, minus, norm, times};

/// Weights of a soft limit.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Soft {
    pub(crate) linear: f64,
    pub(crate) quadratic: f64,
}

impl Default for Soft {
    fn default() -> Soft {
        Soft { linear: 1.0, quadratic: 100.0 }
    }
}

/// A row or a cone of the projection.
#[derive(Clone, Debug)]
pub(crate) struct Row {
    /// As the log names it.
    pub(crate) kind: &'static str,
    /// What it is of: a joint, a frame.
    pub(crate) name: String,
    /// What its excess is a share of, in its own unit.
    pub(crate) size: f64,
    /// `None` is hard.
    pub(crate) soft: Option<Soft>,
    pub(crate) rule: Rule,
    /// Name of its limit.
    pub(crate) label: String,
    /// What is kept may be broken by so much, on the way to where it was moved ([`Row::breach`]).
    pub(crate) allowed: f64,
}

/// One summand of a user's row.
#[derive(Clone, Debug)]
pub(crate) struct Term {
    pub(crate) dof: usize,
    /// Configuration entry and coefficient.
    pub(crate) position: Option<(usize, f64)>,
    pub(crate) velocity: f64,
    pub(crate) acceleration: f64,
}

/// A sum that is held at one value.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Equal {
    /// It has no accelerations.
    pub(crate) is_of_state: bool,
    /// A brake that slows its joints down in proportion leaves it there.
    pub(crate) is_kept: bool,
}

/// What a row says.
#[derive(Clone, Debug)]
pub(crate) enum Rule {
    /// `|tau| <= most`.
    Torque { dof: usize, most: f64 },
    /// `|tau + slope v'| <= most`, or with the speed at the start of the period.
    TorqueSpeed { dof: usize, most: f64, slope: f64, at_start: bool },
    /// `|a - a_before| / T <= most`.
    Jerk { dof: usize, most: f64 },
    /// `|tau - tau_before| / T <= most`.
    TorqueRate { dof: usize, most: f64 },
    /// The force of a drive at one end of the period, or at its start what the range of the target makes of it.
    Drive { dof: usize, most: f64, at_end: bool, range: Option<(usize, [f64; 2])>, all: Rc<Drives> },
    /// `n . p <= offset`, and `braking` stops the point in front of it; the margin of a half-space, which may be put elsewhere.
    Plane { spot: Spot, point: Vec3, n: Vec3, offset: f64, braking: f64, half_space: Option<f64> },
    /// A sum of positions, velocities and accelerations.
    User {
        terms: Vec<Term>,
        lower: f64,
        upper: f64,
        braking: Option<f64>,
        is_equality: bool,
        /// Hard, with one value.
        equal: Option<Equal>,
        /// The largest coefficient.
        steepest: f64,
    },
    /// A pair of bodies, see [`Collision`](crate::collision::Collision).
    Pair,
    /// Speed of a point.
    Speed { spot: Spot, point: Vec3, most: f64 },
    /// Kinetic energy.
    Energy { most: f64 },
}

/// From the state that a tick acted upon to its target.
#[derive(Clone, Copy)]
pub(crate) struct Passage<'a> {
    pub(crate) q: &'a [f64],
    pub(crate) v: &'a [f64],
    pub(crate) q1: &'a [f64],
    pub(crate) v1: &'a [f64],
    /// `(v1 - v) / T`.
    pub(crate) a: &'a [f64],
    /// Motor forces on average over the period.
    pub(crate) tau: &'a [f64],
    /// Acceleration and motor forces of the tick before.
    pub(crate) before: Option<(&'a [f64], &'a [f64])>,
    /// Acceleration that led to the state (nv), where the log has the tick before.
    pub(crate) last: Option<&'a [f64]>,
    /// Position and velocity are targets apart.
    pub(crate) is_free: bool,
}

/// Frames and bodies keep this far inside their boundary, for what a straight row misses of a curved way [m]; a projection's own choice.
const CREEP: f64 = 1e-4;
/// By which share of it the force of a drive stays below its end over several physics steps; a projection's own choice.
pub(crate) const SHORT: f64 = 0.01;
/// By which share of the way targets stay away from the ends of their range without physics steps, and over several; a projection's own choice.
const AWAY: f64 = 0.2;
const AWAY_OVER_STEPS: f64 = 0.1;
/// What is beyond it comes back in so many periods.
const RETURN: f64 = 20.0;
/// In front of a plane a row asks for at most so many times its braking.
const RECOVERY: f64 = 2.0;
/// A sum of positions so near its value is at it, in its own unit; one of speeds to a share of its size.
const AT: f64 = 1e-9;
const AT_SPEED: f64 = 2e-9;
/// Rate at which such a distance is taken off [1/s].
const TAKEN_OFF: f64 = 2.0;
/// A state so far outside what can stop is inside [rad or m].
const ROUNDING: f64 = 1e-10;

/// How the name of a row ends that is of the target of a drive.
pub(crate) const BY_ITS_TARGET: &str = " by its target";

impl Row {
    /// Its name as the subject of a sentence.
    pub(crate) fn subject(&self) -> String {
        if let Rule::Drive { range: Some(_), .. } = self.rule {
            return format!("target of the drive of '{}'", self.name.trim_end_matches(BY_ITS_TARGET));
        }
        match self.kind {
            "user" => format!("row '{}'", self.name),
            kind => format!("{kind} of '{}'", self.name),
        }
    }

    pub(crate) fn new(kind: &'static str, name: &str, size: f64, soft: Option<Soft>, rule: Rule) -> Row {
        Row { kind, name: name.to_owned(), size, soft, rule, label: String::new(), allowed: 0.0 }
    }

    /// Whether motor forces are in it.
    pub(crate) fn is_of_force(&self) -> bool {
        matches!(
            self.rule,
            Rule::Torque { .. } | Rule::TorqueSpeed { .. } | Rule::TorqueRate { .. } | Rule::Drive { .. }
        )
    }

    /// Whether it speaks of the tick before.
    pub(crate) fn needs_before(&self) -> bool {
        matches!(self.rule, Rule::Jerk { .. } | Rule::TorqueRate { .. })
    }

    /// Whether a state, not a motion, is beyond it: a measured state may be so already.
    pub(crate) fn is_of_state(&self) -> bool {
        match &self.rule {
            Rule::Plane { .. } | Rule::Speed { .. } | Rule::Energy { .. } => true,
            Rule::User { terms, .. } => terms.iter().all(|t| t.acceleration == 0.0),
            _ => false,
        }
    }

    /// Value, limit and unit of what the state after a passage keeps, for messages.
    pub(crate) fn value(
        &self,
        m: &mut Machine,
        p: &Period,
        passage: &Passage<'_>,
    ) -> (f64, f64, &'static str) {
        match &self.rule {
            Rule::Torque { dof, most } => (passage.tau[*dof], *most, "N m or N"),
            Rule::TorqueSpeed { dof, most, slope, at_start } => {
                let v = if *at_start { passage.v } else { passage.v1 };
                (passage.tau[*dof] + slope * v[*dof], *most, "N m or N")
            }
            Rule::Drive { dof, most, range, all, .. } => {
                let [below, above] = self.excess(m, p, passage);
                let side = if below > above { -1.0 } else { 1.0 };
                let force = side * (below.max(above) * most + most);
                let Some((iq, _)) = range else { return (force, side * most, "N m or N") };
                // The force of the passage and the one that is to hold there, each by its target.
                let [stiffness, damping] = all.gains(*dof);
                let (q, v) = (passage.q[*iq], passage.v[*dof]);
                let asked = passage.tau[*dof] + all.ends(m, p, passage)[*dof][0];
                let target = |force: f64| q + (force + damping * v) / stiffness;
                (target(asked), target(asked - side * below.max(above) * most), "rad or m")
            }
            Rule::Jerk { most, .. } => {
                (self.excess(m, p, passage)[1] * most + most, *most, "rad/s^3 or m/s^3")
            }
            Rule::TorqueRate { most, .. } => {
                (self.excess(m, p, passage)[1] * most + most, *most, "N m/s or N/s")
            }
            Rule::Plane { spot, point, n, offset, .. } => {
                m.go(passage.q1, passage.v1);
                (dot(*n, m.place(spot).point(*point)), *offset, "m")
            }
            Rule::User { lower, upper, .. } => {
                let value = self.sum(passage);
                (value, if value > *upper { *upper } else { *lower }, "")
            }
            Rule::Speed { spot, point, most } => {
                m.go(passage.q1, passage.v1);
                (m.speed(spot, *point), *most, "m/s")
            }
            Rule::Energy { most } => (m.energy(passage.q1, passage.v1), *most, "J"),
            Rule::Pair => (0.0, 0.0, "m"),
        }
    }

    /// Sum of the terms after the passage.
    fn sum(&self, passage: &Passage<'_>) -> f64 {
        let Rule::User { terms, .. } = &self.rule else { return 0.0 };
        let each = |t: &Term| {
            let at = t.position.map_or(0.0, |(iq, c)| c * passage.q1[iq]);
            at + t.velocity * passage.v1[t.dof] + t.acceleration * passage.a[t.dof]
        };
        terms.iter().map(each).sum()
    }

    /// By how much a passage is beyond the lower and the upper bound that the projection has to keep, as shares of the size; negative inside.
    pub(crate) fn excess(&self, m: &mut Machine, p: &Period, passage: &Passage<'_>) -> [f64; 2] {
        if matches!(self.rule, Rule::Plane { .. } | Rule::User { .. }) {
            m.spend(100 * (1 + p.sub_steps as usize));
        }
        let both = |value: f64, most: f64| [-value / most - 1.0, value / most - 1.0];
        let none = f64::NEG_INFINITY;
        match &self.rule {
            Rule::Torque { dof, most } => both(passage.tau[*dof], *most),
            Rule::TorqueSpeed { dof, most, slope, at_start } => {
                let v = if *at_start { passage.v } else { passage.v1 };
                both(passage.tau[*dof] + slope * v[*dof], *most)
            }
            Rule::Jerk { dof, most } => {
                passage.before.map_or([none; 2], |(a, _)| both((passage.a[*dof] - a[*dof]) / p.dt, *most))
            }
            Rule::TorqueRate { dof, most } => passage
                .before
                .map_or([none; 2], |(_, tau)| both((passage.tau[*dof] - tau[*dof]) / p.dt, *most)),
            Rule::Drive { dof, most, at_end, range, all } => {
                let (v, [stiffness, damping]) = (passage.v[*dof], all.gains(*dof));
                let force = passage.tau[*dof] + all.ends(m, p, passage)[*dof][usize::from(*at_end)];
                let [low, high] = range.map_or([-most, *most], |(iq, range)| {
                    let share = match p.sub_steps {
                        0 => 1.0 - AWAY,
                        1 => 1.0,
                        _ => 1.0 - AWAY_OVER_STEPS,
                    };
                    range.map(|end| {
                        (stiffness * share * (end - passage.q[iq]) - damping * v).max(-most).min(*most)
                    })
                });
                [(low - force) / most, (force - high) / most]
            }
            Rule::Plane { spot, point, n, offset, braking, .. } => {
                let mut ahead = Vec::new();
                m.moved(passage.q, passage.v, p.dt, &mut ahead);
                m.go(&ahead, passage.v);
                let at = m.point(spot, m.place(spot).point(*point));
                m.go(&ahead, passage.v1);
                let then = dot(*n, m.point(spot, m.place(spot).point(*point)).velocity);
                let (speed, c) = (dot(*n, at.velocity), dot(*n, at.acceleration));
                [none, plane(p, offset - dot(*n, at.at), speed, c, then, *braking)]
            }
            Rule::User { terms, lower, upper, braking, equal, steepest, .. } => match braking {
                None => {
                    let (value, [mut lower, mut upper]) = (self.sum(passage), [*lower, *upper]);
                    let still = Passage { q1: passage.q, v1: passage.v, ..*passage };
                    let now = self.sum(&still);
                    let is_beside = (now - lower).abs() > AT_SPEED * self.size;
                    if equal.is_some_and(|equal| equal.is_of_state) && is_beside {
                        (lower, upper) = (lower.min(now), upper.max(now)); // no further from it
                    }
                    [(lower - value) / self.size, (value - upper) / self.size]
                }
                Some(b) => {
                    let sum = |x: &dyn Fn(&Term) -> f64| terms.iter().map(x).sum::<f64>();
                    let weight = |t: &Term| t.position.map_or(0.0, |(_, c)| c);
                    let s = sum(&|t| t.position.map_or(0.0, |(iq, c)| c * passage.q[iq]));
                    let (w, a) =
                        (sum(&|t| weight(t) * passage.v[t.dof]), sum(&|t| weight(t) * passage.a[t.dof]));
                    if equal.is_some() {
                        let (off, left) = (s - lower, p.dt * w);
                        let (near, rate) = keeping(p, *b);
                        if off.abs() <= near && left.abs() <= near {
                            let held = -(w + rate * off) / p.dt;
                            return [(held - a) / b, (a - held) / b];
                        }
                        let further = (self.sum(passage) - lower).abs() - off.abs() - left.abs();
                        return [none, further / steepest];
                    }
                    let beyond = |d: f64, w: f64, a: f64| {
                        if d.is_finite() { (a - in_front(p, d, w, *b)) / b } else { none }
                    };
                    [beyond(s - lower, -w, -a), beyond(upper - s, w, a)]
                }
            },
            Rule::Speed { spot, point, most } => {
                let mut ahead = Vec::new();
                m.moved(passage.q, passage.v, p.dt, &mut ahead);
                m.go(&ahead, passage.v1);
                [none, m.speed(spot, *point) / most - 1.0]
            }
            Rule::Energy { most } => {
                let mut ahead = Vec::new();
                m.moved(passage.q, passage.v, p.dt, &mut ahead);
                [none, (m.energy(&ahead, passage.v1) / most).sqrt() - 1.0]
            }
            Rule::Pair => [none; 2],
        }
    }

    /// By how much the motion, or the state that it ends in, is beyond the limit itself: a share of it, of a plane metres. `None` where no
    /// brake could keep it.
    pub(crate) fn breach(&self, m: &mut Machine, p: &Period, passage: &Passage<'_>) -> Option<f64> {
        Some(match &self.rule {
            Rule::Plane { spot, point, n, offset, .. } => {
                m.go(passage.q1, passage.v1);
                dot(*n, m.place(spot).point(*point)) - offset
            }
            Rule::Speed { spot, point, most } => {
                m.go(passage.q1, passage.v1);
                m.speed(spot, *point) / most - 1.0
            }
            Rule::Energy { most } => (m.energy(passage.q1, passage.v1) / most).sqrt() - 1.0,
            Rule::User { lower, braking, equal: Some(equal), steepest, .. } => {
                let off = (self.sum(passage) - lower).abs();
                match (equal.is_kept, braking) {
                    (true, Some(b)) => (off - 2.0 * keeping(p, *b).0) / steepest,
                    (true, None) => off / self.size - AT_SPEED,
                    (false, _) => return None,
                }
            }
            Rule::User { terms, lower, upper, braking, is_equality, steepest, .. } => {
                let stands = *lower <= 0.0 && *upper >= 0.0;
                let of_positions = terms.iter().any(|t| t.position.is_some());
                if braking.is_none() && (*is_equality || !(of_positions || stands)) {
                    return None;
                }
                let value = self.sum(passage);
                let size = if braking.is_some() { *steepest } else { self.size };
                (value - upper).max(lower - value) / size
            }
            Rule::Pair => return None,
            _ => worst(self.excess(m, p, passage)),
        })
    }

    /// By how much less another row of the same rule allows, in the measure of [`Row::breach`].
    pub(crate) fn looser(&self, other: &Row) -> f64 {
        match (&self.rule, &other.rule) {
            (Rule::Plane { offset, .. }, Rule::Plane { offset: wide, .. }) => wide - offset,
            (Rule::Speed { most, .. }, Rule::Speed { most: wide, .. }) => wide / most - 1.0,
            (Rule::Energy { most }, Rule::Energy { most: wide }) => (wide / most).sqrt() - 1.0,
            _ => 0.0,
        }
    }

    /// How the row's value changes with the velocity change of each dof (nv), in the row's unit. `forces` are the motors' forces for a unit of
    /// each acceleration (nv x nv), where the row is of forces.
    pub(crate) fn slope(
        &self,
        m: &mut Machine,
        p: &Period,
        passage: &Passage<'_>,
        forces: &[f64],
    ) -> Vec<f64> {
        let nv = passage.v.len();
        let mut out = vec![0.0; nv];
        let mut force =
            |dof: usize, scale: f64| (0..nv).for_each(|j| out[j] = scale * forces[dof * nv + j] / p.dt);
        match &self.rule {
            Rule::Torque { dof, .. } => force(*dof, 1.0),
            Rule::TorqueRate { dof, .. } => force(*dof, 1.0 / p.dt),
            Rule::TorqueSpeed { dof, slope, at_start, .. } => {
                force(*dof, 1.0);
                out[*dof] += if *at_start { 0.0 } else { *slope };
            }
            Rule::Drive { dof, at_end, all, .. } => {
                force(*dof, 1.0);
                let slopes = all.slopes(m, p, passage.q);
                (0..nv).for_each(|j| out[j] += slopes[j][*dof][usize::from(*at_end)] / p.dt);
            }
            Rule::Jerk { dof, .. } => out[*dof] = 1.0 / (p.dt * p.dt),
            Rule::Plane { spot, point, n, .. } => {
                let mut ahead = Vec::new();
                m.moved(passage.q, passage.v, p.dt, &mut ahead);
                m.go(&ahead, passage.v);
                m.add_row(spot, m.place(spot).point(*point), *n, 1.0 / p.dt, &mut out);
            }
            Rule::User { terms, braking, .. } => {
                for t in terms {
                    let by_position = if braking.is_some() { 1.0 / p.dt } else { p.kappa * p.dt };
                    out[t.dof] +=
                        t.position.map_or(0.0, |(_, c)| c * by_position) + t.velocity + t.acceleration / p.dt;
                }
            }
            Rule::Speed { spot, point, .. } => {
                let mut ahead = Vec::new();
                m.moved(passage.q, passage.v, p.dt, &mut ahead);
                m.go(&ahead, passage.v1);
                let at = m.place(spot).point(*point);
                let velocity = m.point(spot, at).velocity;
                m.add_row(
                    spot,
                    at,
                    times(1.0 / norm(velocity).max(f64::MIN_POSITIVE), velocity),
                    1.0,
                    &mut out,
                );
            }
            Rule::Energy { .. } => {
                let mut ahead = Vec::new();
                m.moved(passage.q, passage.v, p.dt, &mut ahead);
                m.mass_times(&ahead, passage.v1, &mut out);
                let energy: f64 = out.iter().zip(passage.v1).map(|(p, v)| p * v).sum();
                out.iter_mut().for_each(|x| *x /= energy.sqrt().max(f64::MIN_POSITIVE));
            }
            Rule::Pair => {}
        }
        out
    }
}

/// The largest acceleration of a sum towards a bound at distance `d`, at speed `w`: it stops in front of it with `b`, or brakes with `b` if it still can.
fn in_front(p: &Period, d: f64, w: f64, b: f64) -> f64 {
    if d <= 0.0 {
        return (-w / p.dt).clamp(-b, b);
    }
    let most = p.approach(d, w, b);
    if p.stopping(w, b) <= d + ROUNDING { most.max(-b) } else { most }
}

/// How near its value a sum of positions of this braking is at it, and the rate at which it is led there [1/s]: over several physics steps `B T² / 4`.
fn keeping(p: &Period, braking: f64) -> (f64, f64) {
    let fastest = 0.5 / p.dt;
    if p.sub_steps > 1 {
        (AT.max(0.25 * braking * p.dt * p.dt), fastest)
    } else {
        (AT, TAKEN_OFF.min(fastest))
    }
}

/// By how much closing in on a plane with the speed `then` at the end of a period is more than allowed, as a share of `b`. Distance, closing
/// speed and closing acceleration are those at `q + T v`, from which the joint-like motion begins a period earlier.
pub(crate) fn plane(p: &Period, distance: f64, speed: f64, c: f64, then: f64, b: f64) -> f64 {
    let w = speed - (p.dt + 0.5 * p.tau) * c;
    let d = distance - CREEP + p.dt * w + p.kappa * p.dt * p.dt * c;
    let a = c + (then - speed) / p.dt;
    let allowed = if d <= 0.0 {
        ((d.max(-CREEP) / (RETURN * p.dt) - w) / p.dt).clamp(-b, b)
    } else {
        let always = if p.stopping(w, b) <= d + ROUNDING { -b } else { -RECOVERY * b };
        p.approach(d, w, b).max(always)
    };
    (a - allowed) / b
}

/// Whether a point of a plane is beyond it already.
pub(crate) fn is_beyond(row: &Row, m: &mut Machine, q: &[f64], v: &[f64]) -> bool {
    let zero = vec![0.0; v.len()];
    let passage =
        Passage { q, v, q1: q, v1: v, a: &zero, tau: &zero, before: None, last: None, is_free: false };
    match &row.rule {
        Rule::Plane { spot, point, n, offset, .. } => {
            m.go(q, v);
            dot(*n, minus(m.place(spot).point(*point), times(*offset, *n))) > 0.0
        }
        Rule::User { terms, lower, upper, braking, equal, .. } => {
            let value = row.sum(&passage);
            let leaves = || terms.iter().any(|t| t.position.is_some_and(|(_, c)| c * v[t.dof] != 0.0));
            value > *upper || value < *lower || (equal.is_some() && braking.is_some() && leaves())
        }
        Rule::Speed { spot, point, most } => {
            m.go(q, v);
            m.speed(spot, *point) > *most
        }
        Rule::Energy { most } => m.energy(q, v) > *most,
        _ => false,
    }
}
