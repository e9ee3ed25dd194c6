//! Where commands lead that end at the range of what their joints can be sent: not to the target.

use crate::limit_check::{Fault, broken, is_above};
use crate::motion::SPENT;
use crate::promise::{Promise, Sent};
use crate::rows::Passage;
use crate::steps::{force, solve};

/// Follows the commands `found`, of which that for dof `cut` ends at its range, by the mean force of each drive over the period
///
/// ```text
///     K (q* - q - h v - c a) - D (v + h a)        h = (T - tau) / 2,  c = (T² - tau²) / 6
/// ```
///
/// # Errors
/// The limit of a joint that is broken where they lead; elsewhere that the target is not reached, so that nothing of it is confirmed. What dry friction
/// may change is allowed for.
pub(crate) fn lead(
    promise: &mut Promise,
    passage: &Passage<'_>,
    found: &[f64],
    cut: usize,
) -> Result<(), Fault> {
    let (a, slack) = accelerations(promise, passage, found);
    if promise.machine.is_spent() {
        return Err(Fault::Unknown(SPENT.into()));
    }
    let p = &promise.period;
    let of = |dof: usize| &promise.limits.joints[dof];
    let named = |what: &str, dof: usize| {
        format!(
            "{what} of joint '{}', which follows where the command for joint '{}' is cut at its range,",
            of(dof).name,
            of(cut).name
        )
    };
    for &i in &promise.controllable {
        let (joint, v, rubs) = (of(i), passage.v[i], slack[i]);
        let (v1, unit) = (v + p.dt * a[i], joint.length);
        if is_above(a[i].abs(), joint.acceleration + rubs) {
            let most = a[i].signum() * joint.acceleration;
            return broken(named("acceleration", i), a[i], most, format!("{unit}/s^2"));
        }
        if is_above(v1.abs(), joint.velocity.max(v.abs()) + p.dt * rubs) {
            return broken(named("speed", i), v1, v1.signum() * joint.velocity, format!("{unit}/s"));
        }
        let Some(q) = promise.machine.single(i).map(|at| passage.q[at]) else { continue };
        let (q1, near) = (q + p.way(v, v1), p.dt * p.dt * rubs);
        for (end, beyond, was) in [
            (joint.upper, q1 - joint.upper, q - joint.upper),
            (joint.lower, joint.lower - q1, joint.lower - q),
        ] {
            if end.is_finite() && is_above(beyond, was.max(0.0) + near) {
                return broken(named("position", i), q1, end, unit);
            }
        }
    }
    Err(Fault::Unknown(format!(
        "the command for joint '{}' is cut at its range, and does not lead to their target",
        of(cut).name
    )))
}

/// The accelerations (nv) under the commands, and by how much dry friction may change each.
fn accelerations(promise: &mut Promise, passage: &Passage<'_>, found: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let Promise { machine, actions, period: p, .. } = promise;
    let (lag, sag) = (0.5 * (p.dt - p.tau), (p.dt * p.dt - p.tau * p.tau) / 6.0);
    let (mut a, mut free) = (passage.a.to_vec(), Vec::new());
    for action in actions.iter() {
        let (i, is) = (action.dof, found.get(action.place).copied().unwrap_or(f64::NAN));
        let Some(q) = machine.single(i).map(|at| passage.q[at]) else { continue };
        let v = passage.v[i];
        match action.sent {
            Sent::Position => a[i] = (is - q - p.dt * v) / (p.kappa * p.dt * p.dt),
            Sent::Velocity => a[i] = (is - v) / p.dt,
            // Force and what falls away of it for a unit of acceleration.
            Sent::Force => free.push((i, force(action, is), 0.0, action.friction)),
            Sent::Target { stiffness, damping } => free.push((
                i,
                stiffness * (is - q - lag * v) - damping * v,
                stiffness * sag + damping * lag,
                action.friction,
            )),
        }
    }
    free.iter().for_each(|(i, ..)| a[*i] = 0.0);
    let (n, nv) = (free.len(), a.len());
    let (mut still, mut pushed) = (vec![0.0; nv], vec![0.0; nv]);
    machine.motors(p, passage.q, passage.v, &a, &mut still);
    let mut rows = vec![vec![0.0; n]; n];
    for (c, (j, ..)) in free.iter().enumerate() {
        a[*j] = 1.0;
        machine.motors(p, passage.q, passage.v, &a, &mut pushed);
        a[*j] = 0.0;
        (0..n).for_each(|r| rows[r][c] = pushed[free[r].0] - still[free[r].0]);
    }
    (0..n).for_each(|r| rows[r][r] += free[r].2);
    let with = |right: &dyn Fn(usize) -> f64| {
        let mut system: Vec<Vec<f64>> = rows.clone();
        system.iter_mut().enumerate().for_each(|(r, row)| row.push(right(r)));
        solve(system)
    };
    for (k, x) in with(&|r| free[r].1 - still[free[r].0]).into_iter().enumerate() {
        a[free[k].0] = x;
    }
    let mut slack = vec![0.0; nv];
    for (k, (.., friction)) in free.iter().enumerate().filter(|(_, (.., friction))| *friction > 0.0) {
        for (to, x) in with(&|r| if r == k { *friction } else { 0.0 }).into_iter().enumerate() {
            slack[free[to].0] += x.abs();
        }
    }
    (a, slack)
}
