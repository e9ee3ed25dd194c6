//! Whether a way to stop leads from a target: period by period, as the plant would make it.

use crate::collision::Gap;
use crate::limit_check::{Fault, TOLERANCE, broken, is_above};
use crate::limits::Bounds;
use crate::promise::Promise;
use crate::rows::Step;

/// Periods that a brake may take.
const LONGEST: u32 = 100_000;
/// What is left of a speed after the last whole period is rounding below this share of a period's change.
const REST: f64 = 1e-9;
/// A joint so slow stands: a measured standstill is one to rounding, and its stored deceleration may be as small [rad/s or m/s].
const STANDS: f64 = 1e-12;

/// The brake that is stored in the log: a constant deceleration of each controllable joint until it stands, and every hard limit in every period
/// of it.
pub(crate) fn stored(promise: &mut Promise, q: &[f64], v: &[f64], brake: &[f64]) -> Result<(), Fault> {
    if brake.len() != v.len() {
        return broken("number of stored decelerations", brake.len() as f64, v.len() as f64, "");
    }
    let p = promise.period;
    for &i in &promise.controllable {
        let j = &promise.limits.joints[i];
        if is_above(brake[i], j.brake(&p)) || (v[i].abs() > STANDS && brake[i] <= 0.0) {
            return broken(
                format!("stored deceleration of joint '{}'", j.name),
                brake[i],
                j.brake(&p),
                format!("{}/s^2", j.length),
            );
        }
    }
    run(promise, q, v, brake, true)
}

/// What is certified: each joint may brake by itself with what its limits count on. Positions are kept by the set that it never leaves; forces are
/// looked at in every period.
pub(crate) fn certified(promise: &mut Promise, q: &[f64], v: &[f64]) -> Result<(), Fault> {
    let p = promise.period;
    let mut brake = vec![0.0; v.len()];
    for &i in &promise.controllable {
        let j = &promise.limits.joints[i];
        brake[i] = j.brake(&p);
        if brake[i].is_infinite() {
            return Err(Fault::Unknown(format!(
                "joint '{}' has no acceleration limit to brake with",
                j.name
            )));
        }
        let Some(at) = promise.machine.single(i) else { continue };
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
    run(promise, q, v, &brake, false)
}

/// Runs a brake to rest. Joints that are not controllable are taken to keep their velocity and place.
fn run(promise: &mut Promise, q: &[f64], v: &[f64], brake: &[f64], positions: bool) -> Result<(), Fault> {
    let (p, nv) = (promise.period, v.len());
    let (mut q, mut v) = (q.to_vec(), v.to_vec());
    let (mut v1, mut way, mut a, mut tau) = (v.clone(), vec![0.0; nv], vec![0.0; nv], vec![0.0; nv]);
    let mut q1 = q.clone();
    for period in 0..LONGEST {
        let mut moves = false;
        for &i in &promise.controllable {
            let change = brake[i] * p.dt;
            let left = v[i].abs() - change;
            v1[i] = if left > (REST * change).max(STANDS) { v[i].signum() * left } else { 0.0 };
            a[i] = (v1[i] - v[i]) / p.dt;
            way[i] = p.way(v[i], v1[i]);
            moves |= v[i] != 0.0;
        }
        promise.machine.moved(&q, &way, 1.0, &mut q1);
        if promise.limits.rows.iter().any(crate::rows::Row::is_of_force) {
            promise.machine.motors(&p, &q, &v, &a, &mut tau);
        }
        if positions {
            joints(promise, &q1, &v1, period)?;
        }
        rows(promise, &Step { q: &q, v: &v, q1: &q1, v1: &v1, a: &a, tau: &tau, before: None }, period)?;
        if !moves {
            return Ok(());
        }
        std::mem::swap(&mut q, &mut q1);
        v.copy_from_slice(&v1);
    }
    broken("length of a brake that has not come to rest", f64::from(LONGEST), 0.0, "periods")
}

/// Positions and speeds after a period of a brake.
fn joints(promise: &Promise, q: &[f64], v: &[f64], period: u32) -> Result<(), Fault> {
    for &i in &promise.controllable {
        let j = &promise.limits.joints[i];
        let of =
            |what: &str| format!("{what} of joint '{}' in period {} of its way to stop", j.name, period + 1);
        if is_above(v[i].abs(), j.velocity) {
            return broken(of("speed"), v[i], v[i].signum() * j.velocity, format!("{}/s", j.length));
        }
        let Some(at) = promise.machine.single(i) else { continue };
        for (sign, limit, profile) in [(1.0, j.upper, j.profile[1]), (-1.0, j.lower, j.profile[0])] {
            if limit.is_finite() && is_above(sign * q[at], sign * limit) {
                return broken(of("position"), q[at], limit, j.length);
            }
            let fast = profile.map(|profile| Bounds::profile_speed(&profile, sign * (profile.at - q[at])));
            if let Some(fast) = fast.filter(|fast| is_above(sign * v[i], *fast)) {
                return broken(of("speed in the profile"), v[i], sign * fast, format!("{}/s", j.length));
            }
        }
    }
    Ok(())
}

/// What hard rows, cones and distances keep in a period of a brake.
fn rows(promise: &mut Promise, step: &Step<'_>, period: u32) -> Result<(), Fault> {
    let Promise { machine, limits, period: p, .. } = promise;
    for row in limits.rows.iter().filter(|row| row.soft.is_none()) {
        if row.breach(machine, p, step).is_some_and(|by| is_above(by, 0.0)) {
            let (value, limit, unit) = row.value(machine, p, step);
            return broken(
                format!("{} of '{}' in period {} of the way to stop", row.kind, row.name, period + 1),
                value,
                limit,
                unit,
            );
        }
    }
    let Some(collision) = limits.collision.as_ref().filter(|c| c.is_hard) else { return Ok(()) };
    machine.go(step.q1, step.v1);
    match collision.gap(machine, collision.margin - TOLERANCE) {
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
