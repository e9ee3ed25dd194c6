//! What was projected in a tick, found from what the log has of it.

use crate::promise::{Entry, Projects, Promise};
use crate::rows::Passage;
use crate::tick::Tick;

/// A proposal's position and velocity belong together up to this [rad or m].
const BELONGS: f64 = 1e-11;
/// Velocities of proposals count up to this [rad/s or m/s].
const HUGE: f64 = 1e12;

/// A state of the robot (nq, nv).
pub(crate) type State = (Vec<f64>, Vec<f64>);

/// The state in which a policy period began, and what was proposed then.
pub(crate) struct Begun {
    start: State,
    goal: State,
}

impl Begun {
    /// With the policy tick `tick`, at `q`, `v`.
    pub(crate) fn at(own: &Promise, tick: &Tick, q: &[f64], v: &[f64]) -> Self {
        Self { goal: goal(own, tick, q, v), start: (q.to_vec(), v.to_vec()) }
    }
}

/// A tick, the state that it went on from, and the acceleration that was asked for before it.
#[derive(Clone, Copy)]
pub(crate) struct Moment<'a> {
    pub(crate) tick: &'a Tick,
    pub(crate) q: &'a [f64],
    pub(crate) v: &'a [f64],
    pub(crate) by_policy: bool,
    pub(crate) last: Option<&'a [f64]>,
}

/// What was projected in a tick: what was proposed, or rest for `waiting`, the dofs whose set points wait for their joints.
///
/// # Errors
/// Why it is not known.
pub(crate) fn projected(
    own: &Promise,
    moment: &Moment<'_>,
    begun: Option<&Begun>,
    waiting: &[usize],
) -> Result<State, String> {
    let (mut pq, mut pv) = proposed(own, moment, begun)?;
    for &i in waiting {
        rest(own, moment, i, (&mut pq, &mut pv))?;
    }
    Ok((pq, pv))
}

/// Proposes rest for dof `i` at `q`, `v`, of hard jerk what leads there.
fn rest(
    own: &Promise,
    moment: &Moment<'_>,
    i: usize,
    (pq, pv): (&mut [f64], &mut [f64]),
) -> Result<(), String> {
    let (p, Moment { q, v, .. }) = (&own.period, *moment);
    pv[i] = match (own.built().joints[i].smooth(p), moment.last) {
        (None, _) => 0.0,
        (Some(smooth), Some(a)) => v[i] + p.dt * smooth.next(v[i], a[i]),
        (Some(_), None) => {
            return Err("the tick before their brake is not known, of which jerk speaks".to_owned());
        }
    };
    if let Some(at) = own.machine.single(i) {
        pq[at] = q[at] + p.way(v[i], pv[i]);
    }
    Ok(())
}

/// What was proposed in this tick, where it is known.
fn proposed(own: &Promise, moment: &Moment<'_>, begun: Option<&Begun>) -> Result<State, String> {
    let no = |why: &str| Err(why.to_owned());
    let (p, Moment { tick, q, v, by_policy, .. }) = (&own.period, *moment);
    let (mut pq, mut pv) = (q.to_vec(), v.to_vec());
    if !by_policy {
        for &i in &own.controllable {
            rest(own, moment, i, (&mut pq, &mut pv))?; // the loop's own brake
        }
        return Ok((pq, pv));
    }
    if tick.ramp < 1.0 {
        return no("the first motion was let in, by a share of a target that is not in the log");
    }
    if own.projects == Projects::Unlogged {
        return no("where a learned inverse model's action leads is not in the log");
    }
    if own.projects == Projects::Actions {
        let all = own.controllable.iter().all(|&i| own.halves(i) == (true, true));
        return if all {
            Ok((tick.proposal_q.clone(), tick.proposal_v.clone()))
        } else {
            no("not every joint's position and velocity is proposed")
        };
    }
    let Some(Begun { start, goal }) = begun else {
        return no("the tick in which their policy ran is not in the log");
    };
    let is_held = tick.proposal_age_ns.is_some() && tick.proposed.is_none();
    if is_held && own.controllable.iter().any(|&i| own.halves(i) != (true, true)) {
        return no("a proposal of another process was held, of which the log has one half");
    }
    let (j, k) = (tick.period_tick.saturating_add(1), own.policy_every);
    if j >= k {
        return Ok(goal.clone());
    }
    let (s, length) = (f64::from(j) / f64::from(k), f64::from(k) * p.dt);
    for &i in &own.controllable {
        let Some(at) = own.machine.single(i) else { return no("a continuous joint follows no cubic") };
        (pq[at], pv[i]) = cubic(s, length, (start.0[at], start.1[i]), (goal.0[at], goal.1[i]));
    }
    Ok((pq, pv))
}

/// The proposed state at a policy tick; of a joint with one half proposed the other follows at constant acceleration.
fn goal(own: &Promise, tick: &Tick, q: &[f64], v: &[f64]) -> State {
    let (mut gq, mut gv) = (q.to_vec(), v.to_vec());
    for entry in &own.proposed {
        match *entry {
            Entry::Position { at, .. } => gq[at] = tick.proposal_q[at],
            Entry::Velocity { dof } => gv[dof] = tick.proposal_v[dof],
        }
    }
    let length = f64::from(own.policy_every) * own.period.dt;
    for &i in &own.controllable {
        let Some(at) = own.machine.single(i) else { continue };
        match own.halves(i) {
            (false, true) => gq[at] = q[at] + 0.5 * length * (v[i] + gv[i]),
            (true, false) => gv[i] = 2.0 * (gq[at] - q[at]) / length - v[i],
            _ => {}
        }
    }
    (gq, gv)
}

/// Position and velocity at share `s` of the cubic from one state to another that takes `length` [s].
fn cubic(s: f64, length: f64, (q0, v0): (f64, f64), (q1, v1): (f64, f64)) -> (f64, f64) {
    let (stay, go) = (1.0 - s, s);
    let q = stay * stay * ((1.0 + 2.0 * s) * q0 + s * length * v0)
        + go * go * ((3.0 - 2.0 * s) * q1 - stay * length * v1);
    let v = 6.0 * s * stay * (q1 - q0) / length + stay * (1.0 - 3.0 * s) * v0 + go * (3.0 * s - 2.0) * v1;
    (q, v)
}

/// The next velocities nearest to a proposal without limits: where its position would lead and where its velocity does count alike. Twice: where the
/// two are one but for rounding, the second is the velocity.
pub(crate) fn unconstrained(own: &Promise, passage: &Passage<'_>, (pq, pv): &State) -> State {
    let (p, q, v) = (&own.period, passage.q, passage.v);
    let (mut one, mut other) = (v.to_vec(), v.to_vec());
    for &i in &own.controllable {
        let by_velocity = (pv[i] - v[i]).clamp(-HUGE, HUGE);
        let Some(at) = own.machine.single(i) else {
            (one[i], other[i]) = (pv[i], pv[i]);
            continue;
        };
        let by_position = ((pq[at] - q[at] - p.dt * v[i]) / (p.kappa * p.dt)).clamp(-HUGE, HUGE);
        one[i] = v[i] + 0.5 * (by_position + by_velocity);
        let belong =
            (p.kappa * p.dt * (by_position - by_velocity)).abs() <= 2.0 * BELONGS * q[at].abs().max(1.0);
        other[i] = if belong { pv[i] } else { one[i] };
    }
    (one, other)
}

/// The distance from proposal to target: positions divided by a period, so that both are velocities. Of a joint that has what it was asked for
/// it is rounding.
pub(crate) fn distance(own: &Promise, passage: &Passage<'_>, (pq, pv): &State, goal: &[f64]) -> f64 {
    let p = &own.period;
    let each = own.controllable.iter().map(|&i| {
        let dv = passage.v1[i] - pv[i];
        let Some(at) = own.machine.single(i).filter(|_| !(goal[i] == pv[i] && dv == 0.0)) else { return 0.0 };
        let dq = (passage.q[at] + p.way(passage.v[i], passage.v1[i]) - pq[at]) / (p.kappa * p.dt);
        dq * dq + dv * dv
    });
    each.sum::<f64>().sqrt()
}
