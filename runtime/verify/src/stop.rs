//! Whether a way to stop leads from a target: period by period, as the plant would make it.

use crate::collision::Gap;
use crate::jerk::Brake;
use crate::limit_check::{Fault, TOLERANCE, broken, is_above};
use crate::limits::{Bounds, Limits};
use crate::motion::{Machine, SPENT};
use crate::period::Period;
use crate::promise::Promise;
use crate::rows::Passage;

/// Periods that a brake may take.
const LONGEST: u32 = 100_000;
/// What is left of a speed after the last whole period is rounding below this share of a period's change.
const REST: f64 = 1e-9;
/// A joint so slow stands: a measured standstill is one to rounding, and its stored deceleration may be as small [rad/s or m/s].
const STANDS: f64 = 1e-12;

/// A motion to rest, period by period.
pub(crate) struct Coast {
    q: Vec<f64>,
    v: Vec<f64>,
    /// Acceleration of the period before, then of this one.
    a: Vec<f64>,
    q1: Vec<f64>,
    v1: Vec<f64>,
    way: Vec<f64>,
    tau: Vec<f64>,
    periods: u32,
}

impl Coast {
    /// From `q`, `v` after a period at the accelerations `a`.
    pub(crate) fn new(q: &[f64], v: &[f64], a: &[f64]) -> Coast {
        let (q, v, zero) = (q.to_vec(), v.to_vec(), vec![0.0; v.len()]);
        let (q1, v1) = (q.clone(), v.clone());
        Coast { q, v, a: a.to_vec(), q1, v1, way: zero.clone(), tau: zero, periods: 0 }
    }

    /// Goes a period on, each joint with its deceleration `brake`, or as its hard jerk lets it; false when all stood at its start. Joints that are
    /// not controllable keep their velocity and place.
    pub(crate) fn period(
        &mut self,
        machine: &Machine,
        limits: &Limits,
        (p, dofs): (&Period, &[usize]),
        brake: &[f64],
    ) -> bool {
        let mut moves = false;
        self.periods += 1;
        machine.spend(dofs.len());
        for &i in dofs {
            let (v, joint) = (self.v[i], &limits.joints[i]);
            if joint.jerk.is_finite() {
                let own = Brake::new(joint.braking_jerk, brake[i], p);
                let rests = own.rests(v, self.a[i]);
                self.a[i] = if rests { 0.0 } else { own.next(v, self.a[i]) };
                self.v1[i] = own.velocity(v, self.a[i]);
                moves |= !rests;
            } else {
                let change = brake[i] * p.dt;
                let left = v.abs() - change;
                self.v1[i] = if left > (REST * change).max(STANDS) { v.signum() * left } else { 0.0 };
                self.a[i] = (self.v1[i] - v) / p.dt;
                moves |= v != 0.0;
            }
            self.way[i] = p.way(v, self.v1[i]);
        }
        machine.moved(&self.q, &self.way, 1.0, &mut self.q1);
        moves
    }

    /// The period just gone; without motor forces.
    pub(crate) fn passage(&self) -> Passage<'_> {
        let Coast { q, v, a, q1, v1, tau, .. } = self;
        Passage { q, v, q1, v1, a, tau, before: None, last: None, is_free: false }
    }

    /// The next period begins where this one ended.
    pub(crate) fn go_on(&mut self) {
        std::mem::swap(&mut self.q, &mut self.q1);
        self.v.copy_from_slice(&self.v1);
    }

    /// It has taken more periods, or more steps of the machine, than are looked at.
    pub(crate) fn is_too_long(&self, machine: &Machine) -> bool {
        self.periods >= LONGEST || machine.is_spent()
    }
}

/// The way to rest from a speed with deceleration `b` in whole periods and a shorter last one, never less than without periods.
pub(crate) fn rest(speed: f64, b: f64, p: &Period) -> f64 {
    if speed <= STANDS {
        return 0.0;
    }
    if b <= 0.0 {
        return f64::INFINITY;
    }
    p.stopping_whole(speed, b).max(p.stopping(speed, b))
}

/// The brake that is stored in the log: a constant deceleration of each controllable joint until it stands, of hard jerk a largest one, and every
/// hard limit in every period of it. `a` are the accelerations that led to `q`, `v`.
pub(crate) fn stored(
    promise: &mut Promise,
    q: &[f64],
    v: &[f64],
    a: &[f64],
    brake: &[f64],
) -> Result<(), Fault> {
    if brake.len() != v.len() {
        return broken("number of stored decelerations", brake.len() as f64, v.len() as f64, "");
    }
    let p = promise.period;
    for &i in &promise.controllable {
        let j = &promise.limits.joints[i];
        let stands = v[i].abs() <= STANDS && (j.jerk.is_infinite() || a[i] == 0.0);
        if is_above(brake[i], j.stops(&p)) || (!stands && brake[i] <= 0.0) {
            return broken(
                format!("stored deceleration of joint '{}'", j.name),
                brake[i],
                j.stops(&p),
                format!("{}/s^2", j.length),
            );
        }
        if j.jerk.is_infinite() && v[i].abs() > STANDS && v[i].abs() / (brake[i] * p.dt) > f64::from(LONGEST)
        {
            return broken(
                format!("time in which joint '{}' comes to rest", j.name),
                v[i].abs() / brake[i],
                f64::from(LONGEST) * p.dt,
                "s",
            );
        }
    }
    run(promise, q, v, a, brake, true)
}

/// What is certified: each joint may brake by itself with what its limits count on. Positions are kept by the set that it never leaves; forces are
/// looked at in every period.
pub(crate) fn certified(promise: &mut Promise, q: &[f64], v: &[f64], a: &[f64]) -> Result<(), Fault> {
    let p = promise.period;
    let mut brake = vec![0.0; v.len()];
    for &i in &promise.controllable {
        let j = &promise.limits.joints[i];
        brake[i] = j.stops(&p);
        if brake[i].is_infinite() {
            return Err(Fault::Unknown(format!(
                "joint '{}' has no acceleration limit to brake with",
                j.name
            )));
        }
        let Some(at) = promise.machine.single(i).filter(|_| j.jerk.is_infinite()) else { continue };
        for (speed, room, limit, sign) in
            [(v[i], j.upper - q[at], j.upper, 1.0), (-v[i], q[at] - j.lower, j.lower, -1.0)]
        {
            let way = p.stopping(speed, brake[i]);
            if room.is_finite() && is_above(way, room) {
                return broken(
                    format!("position of joint '{}' where it can stop", j.name),
                    q[at] + sign * way,
                    limit,
                    j.length,
                );
            }
        }
    }
    run(promise, q, v, a, &brake, false)
}

/// Runs a brake to rest.
fn run(
    promise: &mut Promise,
    q: &[f64],
    v: &[f64],
    a: &[f64],
    brake: &[f64],
    positions: bool,
) -> Result<(), Fault> {
    let p = promise.period;
    let is_of_force = promise.limits.rows.iter().any(crate::rows::Row::is_of_force);
    let mut coast = Coast::new(q, v, a);
    for period in 0.. {
        let moves = coast.period(&promise.machine, &promise.limits, (&p, &promise.controllable), brake);
        if is_of_force {
            promise.machine.motors(&p, &coast.q, &coast.v, &coast.a, &mut coast.tau);
        }
        joints(promise, &coast.passage(), period, positions)?;
        rows(promise, &coast.passage(), period)?;
        if !moves {
            return Ok(());
        }
        if promise.machine.is_spent() {
            return Err(Fault::Unknown(SPENT.into()));
        }
        if coast.is_too_long(&promise.machine) {
            break;
        }
        coast.go_on();
    }
    broken("length of a brake that has not come to rest", f64::from(LONGEST), 0.0, "periods")
}

/// Positions and speeds after a period of a brake; of hard jerk also within it, and the acceleration.
fn joints(promise: &Promise, passage: &Passage<'_>, period: u32, positions: bool) -> Result<(), Fault> {
    for &i in &promise.controllable {
        let (j, v) = (&promise.limits.joints[i], passage.v1[i]);
        let is_smooth = j.jerk.is_finite();
        if !(positions || is_smooth) {
            continue;
        }
        let of =
            |what: &str| format!("{what} of joint '{}' in period {} of its way to stop", j.name, period + 1);
        if is_above(v.abs(), j.velocity) {
            return broken(of("speed"), v, v.signum() * j.velocity, format!("{}/s", j.length));
        }
        if is_smooth && is_above(passage.a[i].abs(), j.acceleration) {
            return broken(of("acceleration"), passage.a[i], j.acceleration, format!("{}/s^2", j.length));
        }
        let Some(at) = promise.machine.single(i) else { continue };
        let (from, to) = (passage.q[at], passage.q1[at]);
        for (sign, limit, profile) in [(1.0, j.upper, j.profile[1]), (-1.0, j.lower, j.profile[0])] {
            let within = || from + sign * promise.period.farthest(sign * passage.v[i], sign * passage.a[i]);
            let far = if is_smooth { sign * (sign * to).max(sign * within()) } else { to };
            if limit.is_finite() && is_above(sign * far, sign * limit) {
                return broken(of("position"), far, limit, j.length);
            }
            let fast = profile.map(|profile| Bounds::profile_speed(&profile, sign * (profile.at - to)));
            if let Some(fast) = fast.filter(|fast| is_above(sign * v, *fast)) {
                return broken(of("speed in the profile"), v, sign * fast, format!("{}/s", j.length));
            }
        }
    }
    Ok(())
}

/// What hard rows, cones and distances keep in a period of a brake.
fn rows(promise: &mut Promise, passage: &Passage<'_>, period: u32) -> Result<(), Fault> {
    let Promise { machine, limits, period: p, .. } = promise;
    for row in limits.rows.iter().filter(|row| row.soft.is_none()) {
        if row.breach(machine, p, passage).is_some_and(|by| is_above(by, row.allowed)) {
            let (value, limit, unit) = row.value(machine, p, passage);
            return broken(
                format!("{} in period {} of the way to stop", row.subject(), period + 1),
                value,
                limit,
                unit,
            );
        }
    }
    let Some(collision) = limits.collision.as_ref().filter(|c| c.is_hard) else { return Ok(()) };
    machine.go(passage.q1, passage.v1);
    match collision.gap(machine, collision.margin - limits.nearer - TOLERANCE) {
        Gap::Near(pair, gap) => broken(
            format!("distance of {pair} in period {} of the way to stop", period + 1),
            gap,
            collision.margin,
            "m",
        ),
        Gap::Open(pair) => Err(Fault::Unknown(format!("the distance of {pair} could not be bounded"))),
        Gap::Kept => Ok(()),
    }
}
