//! The physics steps of a period under the actions that a log has, made one after the other.

use crate::limit_check::{Fault, are_near, broken};
use crate::motion::Machine;
use crate::promise::{Action, Promise, Sent};
use crate::rows::{Passage, Rule};

/// Share by which the acceleration over a period may differ from the target's.
const LED: f64 = 1e-6;
/// A force or a position is at its limit up to this share.
const AT_LIMIT: f64 = 1e-6;
/// How much further than in this period the steps of the next ones may lead.
const FURTHER: f64 = 1.5;

/// Where the steps have led, the lowest and highest positions after one of them, and the largest force of each motor in one of them.
struct Walk {
    q: Vec<f64>,
    v: Vec<f64>,
    lowest: Vec<f64>,
    highest: Vec<f64>,
    hardest: Vec<f64>,
}

/// The actions, held, lead through the steps to the target's velocities. A joint may fall short of its own whose force is at its limit, or at the
/// end of its motor's line at the speeds of the period, or which slows down as it would come beyond its position limit or end too fast to stop in
/// front of it otherwise. Where joints rub, by no more than their dry friction does. `means` has the action of each joint for its mean force.
pub(crate) fn lead(
    promise: &mut Promise,
    passage: &Passage<'_>,
    found: &[f64],
    means: &[f64],
) -> Result<(), Fault> {
    let (nv, p) = (passage.v.len(), promise.period);
    let walk = walk(promise, passage, found, None);
    let has_targets = promise.actions.iter().any(|action| matches!(action.sent, Sent::Target { .. }));
    let reserve = if has_targets { 0.5 } else { ((p.dt - 0.005) / 0.03).clamp(0.0, 0.5) };
    let mut by_friction = vec![0.0; nv];
    for k in 0..promise.actions.len() {
        let action = &promise.actions[k];
        let (friction, dof) = (action.friction, action.dof);
        if friction > 0.0 {
            // Either way: what it does to another joint by way of Coriolis forces is not the same for both.
            let pushed = [friction, -friction].map(|f| self::walk(promise, passage, found, Some((dof, f))).v);
            let most = |i: usize| pushed.iter().fold(0.0f64, |most, v| most.max((v[i] - walk.v[i]).abs()));
            (0..nv).for_each(|i| by_friction[i] += 1.5 * most(i));
        }
    }
    for (action, mean) in promise.actions.iter().zip(means) {
        let (i, is) = (action.dof, found.get(action.place).copied().unwrap_or(f64::NAN));
        if matches!(action.sent, Sent::Position | Sent::Velocity) {
            continue;
        }
        let a = (walk.v[i] - passage.v[i]) / p.dt;
        let off = walk.v[i] - passage.v1[i];
        let near = |x: f64, y: f64| are_near(x, y, AT_LIMIT * (1.0 + y.abs()));
        let leads = off.abs() <= LED * p.dt * (1.0 + passage.a[i].abs()) + by_friction[i];
        let at_end = action.range.iter().any(|end| near(is, *end));
        // With margins and without: it is not known here which were kept to.
        let each = || {
            std::iter::once(&promise.limits).chain(promise.without_margins.iter().map(|(limits, _)| limits))
        };
        let has_no_room = each().flat_map(|limits| &limits.rows).any(|row| match row.rule {
            Rule::Torque { dof, most } => dof == i && near(walk.hardest[i], most),
            Rule::TorqueSpeed { dof, most, slope, at_start } if dof == i => {
                let (mean, v) = (force(action, *mean), if at_start { passage.v[i] } else { passage.v1[i] });
                let line = (most - slope * v * mean.signum()).max(mean.abs());
                matches!(action.sent, Sent::Force)
                    && [line, line + action.friction].into_iter().any(|most| near(walk.hardest[i], most))
            }
            _ => false,
        });
        // What is given up of the velocity leads it no farther inside than it is for.
        let retreats = promise.machine.single(i).is_some_and(|iq| {
            each().any(|limits| {
                let (joint, q, given_up) = (&limits.joints[i], passage.q[iq], off.abs());
                let (side, room) = match off < 0.0 {
                    true => (1.0, joint.upper.max(q) - walk.q[iq]),
                    false => (-1.0, walk.q[iq] - joint.lower.min(q)),
                };
                let farthest =
                    if off < 0.0 { walk.highest[iq] - walk.q[iq] } else { walk.q[iq] - walk.lowest[iq] };
                // Each period of a brake may lead further than constant accelerations do; with what is given up the joint could not stop.
                let further = (side * (walk.q[iq] - q - p.way(passage.v[i], walk.v[i])) / p.dt).max(0.0);
                let smooth = joint.smooth(&p);
                let brake = smooth.map_or_else(|| joint.brake(&p), |own| own.gentlest());
                let speed = side * walk.v[i] + given_up + FURTHER * further + reserve * brake * p.dt;
                let way = match smooth {
                    Some(own) => own.highest(speed, side * a + given_up / p.dt).0,
                    None => p.stopping(speed, brake),
                };
                let left = room - p.kappa * p.dt * given_up;
                let is_near = room - farthest <= given_up * p.dt + AT_LIMIT;
                let is_fast = way >= left - given_up * p.dt - AT_LIMIT;
                let is_sudden = smooth.is_some()
                    && passage.last.is_some_and(|last| {
                        let before = last[i].clamp(-joint.acceleration, joint.acceleration);
                        (a - before).abs() > joint.jerk * p.dt * (1.0 + LED)
                    });
                (is_near || is_fast) && a.abs() <= joint.acceleration * (1.0 + LED) && !is_sudden
            })
        });
        if !(leads || at_end || has_no_room || retreats) {
            return broken(
                format!("velocity that the action leads joint '{}' to", promise.limits.joints[i].name),
                walk.v[i],
                passage.v1[i],
                "rad/s or m/s",
            );
        }
    }
    Ok(())
}

/// Force of an action [N m or N].
pub(crate) fn force(action: &Action, is: f64) -> f64 {
    action.gear * (action.gain * is + action.bias)
}

/// Makes the steps; `more` is a force on one dof besides.
fn walk(promise: &mut Promise, passage: &Passage<'_>, found: &[f64], more: Option<(usize, f64)>) -> Walk {
    let (nv, p) = (passage.v.len(), promise.period);
    let mut at = Walk {
        q: passage.q.to_vec(),
        v: passage.v.to_vec(),
        lowest: Vec::new(),
        highest: Vec::new(),
        hardest: vec![0.0; nv],
    };
    let mut next = Vec::new();
    let (mut force_of, mut a) = (vec![0.0; nv], passage.a.to_vec());
    let is_led = |action: &&Action| matches!(action.sent, Sent::Position | Sent::Velocity);
    let moves: Vec<&Action> = promise.actions.iter().filter(|action| !is_led(action)).collect();
    let is_free: Vec<bool> = (0..nv).map(|i| moves.iter().any(|action| action.dof == i)).collect();
    for _ in 0..p.sub_steps {
        for action in &moves {
            let (i, is) = (action.dof, found.get(action.place).copied().unwrap_or(f64::NAN));
            let push = match (action.sent, promise.machine.single(i)) {
                (Sent::Target { stiffness, damping }, Some(iq)) => {
                    stiffness * (is - at.q[iq]) - damping * at.v[i]
                }
                _ => force(action, is),
            };
            at.hardest[i] = at.hardest[i].max(push.abs());
            force_of[i] = push + more.filter(|(of, _)| *of == i).map_or(0.0, |(_, by)| by);
        }
        (0..nv).filter(|i| !is_free[*i]).for_each(|i| a[i] = passage.a[i]);
        accelerations(&mut promise.machine, p.tau, (&at.q, &at.v), &force_of, &is_free, &mut a);
        at.v.iter_mut().zip(&a).for_each(|(v, a)| *v += p.tau * a);
        promise.machine.moved(&at.q, &at.v, p.tau, &mut next);
        std::mem::swap(&mut at.q, &mut next);
        if at.lowest.is_empty() {
            (at.lowest, at.highest) = (at.q.clone(), at.q.clone());
        }
        at.lowest.iter_mut().zip(&at.q).for_each(|(low, q)| *low = low.min(*q));
        at.highest.iter_mut().zip(&at.q).for_each(|(high, q)| *high = high.max(*q));
    }
    at
}

/// The accelerations of the free dofs in a step that is implicit in the dampers: `(M + tau D) a = force - c - K (q - rest) - D v`; those of the
/// others are in `a`.
fn accelerations(
    machine: &mut Machine,
    tau: f64,
    (q, v): (&[f64], &[f64]),
    force: &[f64],
    is_free: &[bool],
    a: &mut [f64],
) {
    let nv = v.len();
    let free: Vec<usize> = (0..nv).filter(|i| is_free[*i]).collect();
    free.iter().for_each(|&i| a[i] = 0.0);
    let (mut need, mut unit, mut column) = (vec![0.0; nv], vec![0.0; nv], vec![0.0; nv]);
    // one step is explicit but for its dampers
    machine.motors(&crate::Period::new(tau, 1), q, v, a, &mut need);
    let n = free.len();
    let mut rows = vec![vec![0.0; n + 1]; n];
    for (c, &j) in free.iter().enumerate() {
        unit.fill(0.0);
        unit[j] = 1.0;
        machine.mass_times(q, &unit, &mut column);
        (0..n).for_each(|r| rows[r][c] = column[free[r]]);
        rows[c][c] += tau * machine.damping(j);
    }
    (0..n).for_each(|r| rows[r][n] = force[free[r]] - need[free[r]]);
    solve(rows).into_iter().zip(&free).for_each(|(x, &i)| a[i] = x);
}

/// Solves equations whose rows end with their right side. The matrix is nearly symmetric and positive definite: no pivoting.
pub(crate) fn solve(mut rows: Vec<Vec<f64>>) -> Vec<f64> {
    let n = rows.len();
    for k in 0..n {
        for r in k + 1..n {
            let share = rows[r][k] / rows[k][k];
            for c in k..=n {
                rows[r][c] -= share * rows[k][c];
            }
        }
    }
    let mut x = vec![0.0; n];
    for k in (0..n).rev() {
        let known: f64 = (k + 1..n).map(|j| rows[k][j] * x[j]).sum();
        x[k] = (rows[k][n] - known) / rows[k][k];
    }
    x
}
