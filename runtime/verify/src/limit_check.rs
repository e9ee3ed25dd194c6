//! Whether the passage from a state to its target keeps every hard limit.

use crate::collision::Gap;
use crate::jerk::Brake;
use crate::limits::{Bounds, Limits};
use crate::motion::{Machine, SPENT};
use crate::period::Period;
use crate::rows::{Passage, is_beyond};

/// A limit is broken above this share of it (of 1 where it is smaller), in m and rad alike.
pub(crate) const TOLERANCE: f64 = 1e-8;

/// A value that is not what it should be, as the subject of a sentence.
#[derive(Clone, Debug)]
pub(crate) struct Breach {
    pub(crate) what: String,
    pub(crate) value: f64,
    pub(crate) limit: f64,
    pub(crate) unit: String,
}

/// Why something is neither confirmed nor refuted.
#[derive(Clone, Debug)]
pub(crate) enum Fault {
    Broken(Breach),
    Unknown(String),
}

pub(crate) fn broken<T>(
    what: impl Into<String>,
    value: f64,
    limit: f64,
    unit: impl Into<String>,
) -> Result<T, Fault> {
    Err(Fault::Broken(Breach { what: what.into(), value, limit, unit: unit.into() }))
}

/// Beyond a limit by more than rounding.
pub(crate) fn is_above(value: f64, limit: f64) -> bool {
    value.is_nan() || value > limit + TOLERANCE * limit.abs().max(1.0)
}

/// Within `by` of each other; what is no number is not.
pub(crate) fn are_near(a: f64, b: f64, by: f64) -> bool {
    (a - b).abs() <= by
}

/// The larger of two excesses; what is no number is beyond everything.
pub(crate) fn worst([low, high]: [f64; 2]) -> f64 {
    if low.is_nan() || high.is_nan() { f64::INFINITY } else { low.max(high) }
}

/// How a limit of a joint is kept from both sides.
struct Sided {
    /// From the position to the limit.
    room: f64,
    v: f64,
    v1: f64,
    limit: f64,
    sign: f64,
    profile: Option<crate::limits::Profile>,
}

fn sides(j: &Bounds, q: f64, v: f64, v1: f64) -> [Sided; 2] {
    [
        Sided { room: q - j.lower, v: -v, v1: -v1, limit: j.lower, sign: -1.0, profile: j.profile[0] },
        Sided { room: j.upper - q, v, v1, limit: j.upper, sign: 1.0, profile: j.profile[1] },
    ]
}

impl Bounds {
    /// The deceleration that braking in front of a position counts on: a whole period of it may not carry a slow joint beyond the other end.
    pub(crate) fn brake(&self, p: &Period) -> f64 {
        let half = p.dt - 0.5 * p.tau;
        let room = (self.upper - self.lower) / (p.kappa * p.dt * p.dt + 0.5 * half * half);
        self.braking.min(self.acceleration).min(self.velocity / p.dt).min(room)
    }

    /// The deceleration of a stop: where limits were moved that of the build, of hard jerk the largest.
    pub(crate) fn stops(&self, p: &Period) -> f64 {
        if self.jerk.is_finite() {
            return self.braking.min(self.acceleration);
        }
        self.built_brake.unwrap_or_else(|| self.brake(p))
    }

    /// How the joint brakes where its jerk is hard.
    pub(crate) fn smooth(&self, p: &Period) -> Option<Brake> {
        self.jerk.is_finite().then(|| Brake::new(self.braking_jerk, self.stops(p), p))
    }

    /// The acceleration before a tick: of what stands, none where it is not known.
    pub(crate) fn before(v: f64, known: Option<f64>) -> Option<f64> {
        known.or((v == 0.0).then_some(0.0))
    }

    /// The highest speed that a profile leaves `way` in front of where it ends.
    pub(crate) fn profile_speed(profile: &crate::limits::Profile, way: f64) -> f64 {
        ((2.0 * profile.deceleration * way.max(0.0)).sqrt() - profile.offset).max(0.0)
    }

    /// Whether the joint at `q`, `v` is beyond its limits, or cannot stop in front of one.
    pub(crate) fn is_outside(
        &self,
        p: &Period,
        q: Option<f64>,
        (v, before): (f64, Option<f64>),
        whole: bool,
    ) -> bool {
        if let Some(own) = self.smooth(p) {
            let a = Bounds::before(v, before);
            return sides(self, q.unwrap_or(0.0), v, v).iter().any(|s| {
                // Braking begins with the acceleration before, where that is known.
                let (far, fast) = match a {
                    Some(a) => own.highest(s.v, s.sign * a),
                    None => own.highest(s.v, own.step + own.next(s.v, own.step)),
                };
                let is_late = q.is_some() && s.room.is_finite() && (s.room < 0.0 || far > s.room);
                is_late || fast > self.velocity
            }) || a.is_some_and(|a| a.abs() > self.acceleration);
        }
        let b = self.brake(p);
        let is_late = q.is_some_and(|q| {
            sides(self, q, v, v).iter().any(|s| {
                let way = if whole {
                    p.stopping(s.v, b).max(p.stopping_whole(s.v.max(0.0), b))
                } else {
                    p.stopping(s.v, b)
                };
                s.room < 0.0 || (b.is_finite() && s.room.is_finite() && way > s.room)
            })
        });
        is_late || v.abs() > self.velocity
    }

    /// Whether going on from `v` to `v1` breaks a limit of this kind on the side of `sign`.
    pub(crate) fn breaks(
        &self,
        kind: &str,
        sign: f64,
        p: &Period,
        q: Option<f64>,
        (v, before): (f64, Option<f64>),
        v1: f64,
        whole: bool,
    ) -> bool {
        let [low, high] = sides(self, q.unwrap_or(0.0), v, v1);
        let s = if sign > 0.0 { high } else { low };
        let (gone, b) = (p.way(s.v, s.v1), self.brake(p));
        if let Some(own) = self.smooth(p) {
            let (a, known) = ((s.v1 - s.v) / p.dt, Bounds::before(v, before).map(|a| sign * a));
            match kind {
                "jerk" => return known.is_some_and(|known| a - known > self.jerk * p.dt),
                "velocity" => return s.v1.max(s.v + own.adds(a)) > self.velocity,
                "viability" => return p.farthest(s.v, a).max(gone + own.highest(s.v1, a).0) > s.room,
                "locked" => return known.is_some_and(|known| s.v1 > s.v + p.dt * own.next(s.v, known)),
                _ => {}
            }
        }
        match kind {
            "velocity" => s.v1 > self.velocity,
            "acceleration" => {
                let gains = if s.v > 0.0 { s.v1 - s.v } else { s.v1 };
                s.v1 - s.v > self.acceleration * p.dt || (s.v1 > 0.0 && gains > self.faster * p.dt)
            }
            "position" => p.farthest(s.v, (s.v1 - s.v) / p.dt) > s.room || (s.room < 0.0 && s.v1 > 0.0),
            "viability" => {
                let left = s.room - gone;
                p.stopping(s.v1, b) > left || (whole && p.stopping_whole(s.v1.max(0.0), b) > left)
            }
            "velocity_profile" => s.profile.is_some_and(|profile| {
                let way = sign * (profile.at - q.unwrap_or(0.0)) - gone;
                let least = crate::limits::Profile { deceleration: profile.deceleration.min(b), ..profile };
                s.v1 > 0.0 && (s.v1 + least.offset).powi(2) > 2.0 * least.deceleration * way
            }),
            "locked" => s.v1 > (s.v - b * p.dt).max(0.0),
            _ => false,
        }
    }
}

/// Names a limit of a joint in a sentence.
fn of(what: &str, joint: &str) -> String {
    format!("{what} of joint '{joint}'")
}

/// The limits of single joints, at a passage.
///
/// # Errors
/// The first that is broken. A joint that was outside at the start, where that is `excused`, may brake or come back.
pub(crate) fn joints(
    l: &Limits,
    machine: &Machine,
    dofs: &[usize],
    p: &Period,
    passage: &Passage<'_>,
    (stored, excused): (bool, bool),
) -> Result<(), Fault> {
    for &i in dofs {
        let j = &l.joints[i];
        let (v, v1, a, unit) = (passage.v[i], passage.v1[i], passage.a[i], j.length);
        let position = machine.single(i).map(|at| (passage.q[at], passage.q1[at]));
        if is_above(a.abs(), j.acceleration) {
            return broken(
                of("acceleration", &j.name),
                a,
                a.signum() * j.acceleration,
                format!("{unit}/s^2"),
            );
        }
        let (was, known) = (position.map(|(q, _)| q), passage.last.map(|last| last[i]));
        let before = Bounds::before(v, known);
        let known_before = before.filter(|before| j.jerk.is_finite() && before.abs() <= j.acceleration);
        if let Some(jerk) =
            known_before.map(|before| (a - before) / p.dt).filter(|x| is_above(x.abs(), j.jerk))
        {
            return broken(of("jerk", &j.name), jerk, jerk.signum() * j.jerk, format!("{unit}/s^3"));
        }
        if excused && j.is_outside(p, was, (v, known), true) {
            // Forces that motors do not have are cut of a stored brake: it holds to what it counts on.
            let least = if stored { j.brake(p) } else { j.braking.min(j.acceleration) };
            returns(j, p, was, (v, before), v1, least)?;
            continue;
        }
        let gains = if v * v1 > 0.0 { v1.abs() - v.abs() } else { v1.abs() };
        if is_above(gains / p.dt, j.faster) {
            return broken(of("gain of speed", &j.name), gains / p.dt, j.faster, format!("{unit}/s^2"));
        }
        if is_above(v1.abs(), j.velocity) {
            return broken(of("speed", &j.name), v1, v1.signum() * j.velocity, format!("{unit}/s"));
        }
        let slower = match (j.smooth(p), before) {
            (None, _) => (v.abs() - j.brake(p) * p.dt).max(0.0),
            (Some(own), Some(before)) => (v + p.dt * own.next(v, before)).abs(),
            (Some(_), None) => f64::INFINITY,
        };
        if j.is_locked && is_above(v1.abs(), slower) {
            return broken(of("speed", &j.name) + ", which is locked,", v1, 0.0, format!("{unit}/s"));
        }
        let Some((q, q1)) = position else { continue };
        for s in sides(j, q, v, v1) {
            let gone = s.sign * (q1 - q);
            let most = if passage.is_free { gone } else { p.farthest(s.v, (s.v1 - s.v) / p.dt).max(gone) };
            if s.room.is_finite() && is_above(most, s.room) {
                return broken(of("position", &j.name), q + s.sign * most, s.limit, unit);
            }
            if let Some(profile) = s.profile {
                let fast = Bounds::profile_speed(&profile, s.sign * (profile.at - q1));
                if is_above(s.v1, fast) {
                    return broken(
                        of("speed", &j.name) + " in its profile",
                        v1,
                        s.sign * fast,
                        format!("{unit}/s"),
                    );
                }
            }
        }
    }
    Ok(())
}

/// A joint outside its limits does not go further out than a brake of at least `brake` takes it.
fn returns(
    j: &Bounds,
    p: &Period,
    q: Option<f64>,
    (v, before): (f64, Option<f64>),
    v1: f64,
    brake: f64,
) -> Result<(), Fault> {
    if let Some(own) = j.smooth(p) {
        // Its brake, from the acceleration that it has, is the least that it may go on.
        let Some(before) = before.filter(|_| q.is_some()) else { return Ok(()) };
        for s in q.map(|q| sides(j, q, v, v1)).into_iter().flatten() {
            let least = (s.v + p.dt * own.next(s.v, s.sign * before)).max(0.0);
            if s.room < 0.0 && is_above(s.v1, least) {
                let named = of("speed", &j.name) + ", which is outside,";
                return broken(named, v1, s.sign * least, format!("{}/s", j.length));
            }
        }
        return Ok(());
    }
    let slower = (v.abs() - brake * p.dt).max(0.0);
    for s in q.map(|q| sides(j, q, v, v1)).into_iter().flatten() {
        // Beyond by rounding it may go on by as little.
        let is_beyond =
            s.room < 0.0 && is_above(p.way(s.v, s.v1) - s.room + s.sign * s.limit, s.sign * s.limit);
        if is_beyond && is_above(s.v1, (s.v - brake * p.dt).max(0.0)) {
            return broken(
                of("speed", &j.name) + ", which is outside,",
                v1,
                s.sign * slower,
                format!("{}/s", j.length),
            );
        }
    }
    if v.abs() > j.velocity && is_above(v1.abs(), v.abs().max(j.velocity)) {
        return broken(of("speed", &j.name) + ", which is too fast,", v1, v, format!("{}/s", j.length));
    }
    Ok(())
}

/// Hard rows, cones and distances: with a stored brake what they keep, else what they ask of the passage.
///
/// # Errors
/// The first that is broken. What the state at the start is beyond already, a recovering passage may still be beyond.
pub(crate) fn rows(
    l: &Limits,
    machine: &mut Machine,
    p: &Period,
    passage: &Passage<'_>,
    stored: bool,
    excused: bool,
) -> Result<(), Fault> {
    for row in l.rows.iter().filter(|row| row.soft.is_none()) {
        let asked = |m: &mut Machine| worst(row.excess(m, p, passage));
        let by = if stored {
            row.breach(machine, p, passage).unwrap_or_else(|| asked(machine))
        } else {
            asked(machine)
        };
        if machine.is_spent() {
            return Err(Fault::Unknown(SPENT.into()));
        }
        if is_above(by, if stored { row.allowed } else { 0.0 })
            && !(excused && row.is_of_state() && is_beyond(row, machine, passage.q, passage.v))
        {
            let (value, limit, unit) = row.value(machine, p, passage);
            return broken(row.subject(), value, limit, unit);
        }
    }
    let Some(collision) = l.collision.as_ref().filter(|c| c.is_hard) else { return Ok(()) };
    machine.go(passage.q, passage.v);
    if l.nearer.is_nan() {
        return Err(Fault::Unknown(
            "how near bodies come on the way to obstacles that were put elsewhere is not known".into(),
        ));
    }
    let is_near = excused && !matches!(collision.gap(machine, collision.margin), Gap::Kept);
    machine.go(passage.q1, passage.v1);
    match collision.gap(machine, collision.margin - l.nearer - TOLERANCE) {
        Gap::Near(pair, gap) if !is_near => broken(format!("distance of {pair}"), gap, collision.margin, "m"),
        Gap::Open(pair) => Err(Fault::Unknown(format!("the distance of {pair} could not be bounded"))),
        _ => Ok(()),
    }
}
