//! Whether a target is the nearest allowed state: the Karush-Kuhn-Tucker conditions of
//!
//! ```text
//!     min sum_i (v'_i - goal_i)²    within the joints' limits and the rows,
//! ```
//!
//! with the multipliers of the log. The pull of the proposal on the target must equal the push of the active rows. Each of them must push
//! away from its bound, and be at it: a little more would break the limit. The problem is convex, so nothing else has to be shown.

use crate::collision::Told;
use crate::limit_check::{Fault, TOLERANCE, are_near, broken, worst};
use crate::motion::SPENT;
use crate::promise::Promise;
use crate::rows::{Passage, Row, Rule};
use crate::tick::{Active, Ledger};

/// A limit is active when this share of the largest velocity change of a period would break it.
const NEAR: f64 = 1e-4;
/// Share of its size by which a row may be away from its bound and still push.
const AT: f64 = 1e-6;
/// Pull that is rounding [rad/s or m/s, and as a share of the goal].
const ROUNDING: f64 = 1e-9;
/// The same for an answer of Clarabel, which leaves out multipliers of a millionth.
const CONIC: f64 = 2e-5;
/// A goal so many times its box away was brought nearer before it was solved for.
const FAR: f64 = 1e5;
/// What a ledger's slack may be off by, as a share.
const SLACK: f64 = 1e-5;
/// A proposal is the same as another up to this share: it is computed anew.
const SAME: f64 = 1e-12;
/// Why such a tick is not compared.
const TOO_FAR: &str = "the proposal is further away than numbers are exact";

/// Number of the rung without soft rows, and of Clarabel.
const RELAXED: u32 = 4;
const CLARABEL: u32 = 2;

/// What the active rows push the target back by (nv), and the sum of the magnitudes of its parts.
struct Push {
    sum: Vec<f64>,
    size: Vec<f64>,
}

impl Push {
    fn add(&mut self, dof: usize, by: f64) {
        self.sum[dof] += by;
        self.size[dof] += by.abs();
    }
}

/// The conditions of a tick; the largest pull that is left, as a share of what is rounding.
///
/// `goals` are the unconstrained optima of `v'` (nv): the two that differ by rounding.
pub(crate) fn confirm(
    promise: &mut Promise,
    passage: &Passage<'_>,
    goals: [&[f64]; 2],
    ledger: &Ledger,
    whole: bool,
) -> Result<f64, Fault> {
    if !ledger.is_whole() {
        return unknown("more rows were active than a record has room for");
    }
    let Promise { machine, limits, controllable, period, .. } = promise;
    let has_rows = !limits.rows.is_empty();
    if has_rows && controllable.iter().any(|&i| (goals[0][i] - passage.v1[i]).abs() > FAR) {
        return unknown(TOO_FAR);
    }
    if limits.rows.iter().any(Row::needs_before) && passage.before.is_none() {
        return unknown("the tick before is not known, of which jerk and torque rate speak");
    }
    let nv = passage.v.len();
    let is_of_force = ledger
        .active_rows
        .iter()
        .filter_map(|a| limits.rows.get(a.row.checked_sub(nv)?))
        .any(Row::is_of_force);
    let forces = if is_of_force { forces(machine, period, passage) } else { Vec::new() };
    let mut push = Push { sum: vec![0.0; nv], size: vec![0.0; nv] };
    for (n, active) in ledger.active_rows.iter().enumerate() {
        let side = side_of(active, n)?;
        match active.row < nv {
            true => push_of_joint(promise, passage, active, side, whole, &mut push)?,
            false => push_of_row(promise, passage, (n, active, side), ledger.rung, &forces, &mut push)?,
        }
    }
    let most = all_hold(promise, passage, ledger)?;
    slack(ledger, most)?;
    balance(promise, passage, goals, ledger.rung, &push)
}

/// Which way an active row pushes, -1 for its lower bound; its multiplier has to be a number that can push.
fn side_of(active: &Active, n: usize) -> Result<f64, Fault> {
    let multiplier = active.multiplier;
    let side = match active.side.as_str() {
        "lower" => -1.0,
        "upper" => 1.0,
        other => return broken(format!("side '{other}' of active row {n}"), f64::NAN, 0.0, ""),
    };
    if multiplier.is_nan() || multiplier < 0.0 || multiplier.is_infinite() {
        return broken(format!("multiplier of active row {n}"), multiplier, 0.0, "or more");
    }
    Ok(side)
}

/// Adds the push of an active limit of a single joint, which a velocity a little further on would break.
fn push_of_joint(
    promise: &Promise,
    passage: &Passage<'_>,
    active: &Active,
    side: f64,
    whole: bool,
    push: &mut Push,
) -> Result<(), Fault> {
    let Promise { machine, limits, controllable, period, .. } = promise;
    let (i, joint) = (active.row, &limits.joints[active.row]);
    let named = format!("active {} row of joint '{}'", active.kind, joint.name);
    if !controllable.contains(&i) || active.slack != 0.0 {
        return broken(format!("slack of the {named}"), active.slack, 0.0, "");
    }
    push.add(i, side * active.multiplier);
    let q = machine.single(i).map(|at| passage.q[at]);
    let most = joint.acceleration.min(2.0 * joint.velocity / period.dt) * period.dt;
    let more = passage.v1[i] + side * NEAR * if most.is_finite() { most } else { 1.0 };
    let known = passage.last.map(|last| last[i]);
    let holds = || joint.breaks(&active.kind, side, period, q, (passage.v[i], known), more, whole);
    if active.multiplier > 0.0 && !holds() {
        let what = format!("velocity after the {named}, which holds nothing there,");
        return broken(what, passage.v1[i], more, "rad/s or m/s at least");
    }
    Ok(())
}

/// Adds the push of an active row over several joints.
fn push_of_row(
    promise: &mut Promise,
    passage: &Passage<'_>,
    (n, active, side): (usize, &Active, f64),
    rung: u32,
    forces: &[f64],
    push: &mut Push,
) -> Result<(), Fault> {
    let Promise { machine, limits, controllable, period, worth, .. } = promise;
    let nv = passage.v.len();
    let Some(row) = limits.rows.get(active.row - nv).filter(|row| row.kind == active.kind) else {
        let (what, all) = (format!("number of the active {} row {n}", active.kind), nv + limits.rows.len());
        return broken(what, active.row as f64, all as f64, "rows");
    };
    let (slope, excess) = match (&limits.collision, &row.rule) {
        (Some(bodies), Rule::Pair) => {
            match bodies.row(machine, period, passage, active.row - nv - first_pair(&limits.rows)) {
                Told::Row(excess, slope) => (slope, excess),
                Told::Unknown(why) => return unknown(&why),
                Told::None => {
                    let what = format!("distance of the active row {n} of bodies");
                    return broken(what, f64::INFINITY, bodies.influence(), "m at most");
                }
            }
        }
        _ => {
            let slope = row.slope(machine, period, passage, forces);
            (slope, row.excess(machine, period, passage)[usize::from(side > 0.0)])
        }
    };
    for &i in controllable.iter() {
        push.add(i, side * active.multiplier * slope[i]);
    }
    let steepest = slope.iter().fold(0.0, |most: f64, s| most.max(s.abs()));
    belongs(row, (active.multiplier, excess, active.slack), steepest, (*worth, rung))
}

/// Whether what pulls each joint to its goal is what the active rows push back; the largest remainder, as a share of what is rounding.
fn balance(
    promise: &Promise,
    passage: &Passage<'_>,
    goals: [&[f64]; 2],
    rung: u32,
    push: &Push,
) -> Result<f64, Fault> {
    let coarse = if matches!(rung, CLARABEL | RELAXED) { CONIC } else { ROUNDING };
    // The widest side of the box, at most: what a period may change of a velocity.
    let sides = promise.controllable.iter().map(|&i| {
        let joint = &promise.limits.joints[i];
        2.0 * promise.period.dt * joint.acceleration.min(joint.jerk * promise.period.dt)
    });
    let widest = sides.filter(|side| side.is_finite()).fold(1e-6, f64::max).min(1.0);
    // Clarabel's scaling bears less.
    let most = if coarse == CONIC { 1e-2 * FAR * widest } else { FAR * widest };
    let has_rows = !promise.limits.rows.is_empty();
    let is_far = has_rows && promise.controllable.iter().any(|&i| (goals[0][i] - passage.v1[i]).abs() > most);
    let mut largest = 0.0f64;
    for &i in &promise.controllable {
        let left = |goal: f64| (2.0 * (passage.v1[i] - goal) + push.sum[i]).abs();
        let least = left(goals[0][i]).min(left(goals[1][i]));
        let far = 1.0 + goals[0][i].abs() + passage.v[i].abs() + push.size[i];
        if least.is_nan() || least > 2.0 * coarse * far {
            if is_far {
                return unknown(TOO_FAR);
            }
            let joint = &promise.limits.joints[i];
            let what = format!("pull on joint '{}' that no active row balances", joint.name);
            return broken(what, 0.5 * least, coarse * far, format!("{}/s", joint.length));
        }
        largest = largest.max(least / (2.0 * coarse * far));
    }
    Ok(largest)
}

fn unknown<T>(why: &str) -> Result<T, Fault> {
    Err(Fault::Unknown(why.to_owned()))
}

/// The first row of a distance.
fn first_pair(rows: &[Row]) -> usize {
    rows.iter().position(|row| matches!(row.rule, Rule::Pair)).unwrap_or(0)
}

/// The conditions of a tick whose positions and velocities are clamped apart: each is the proposal's, or the end of what the joint can reach in a
/// period that is nearest to it, which an active row names with the distance as multiplier.
pub(crate) fn apart(
    promise: &Promise,
    passage: &Passage<'_>,
    (pq, pv): &(Vec<f64>, Vec<f64>),
    ledger: &Ledger,
    whole: bool,
) -> Result<(), Fault> {
    if !ledger.is_whole() {
        return Err(Fault::Unknown("more rows were active than a record has room for".into()));
    }
    let (p, mut named) = (&promise.period, 0);
    let weight = (p.kappa * p.dt).powi(-2);
    for &i in &promise.controllable {
        let joint = &promise.limits.joints[i];
        let at = promise.machine.single(i);
        let q = at.map(|at| passage.q[at]);
        let most = joint.acceleration.min(2.0 * joint.velocity / p.dt) * p.dt;
        let near = NEAR * if most.is_finite() { most } else { 1.0 };
        let mut rows = ledger.active_rows.iter().filter(|row| row.row == i).peekable();
        let place = at.map(|at| (pq[at], passage.q1[at], true));
        for (asked, got, is_place) in [Some((pv[i], passage.v1[i], false)), place].into_iter().flatten() {
            if are_near(asked, got, SAME * asked.abs().max(1.0)) {
                // The same but for rounding: a row may name it all the same.
                let weight = if is_place { weight } else { 1.0 };
                named += usize::from(
                    rows.next_if(|row| row.multiplier <= weight * SAME * asked.abs().max(1.0)).is_some(),
                );
                continue;
            }
            let what = if is_place { "position" } else { "velocity" };
            let Some(row) = rows.next() else {
                let what = format!("target {what} of joint '{}', which no active row holds,", joint.name);
                return broken(what, got, asked, "as proposed");
            };
            named += 1;
            let (sign, side) = if asked > got { (1.0, "upper") } else { (-1.0, "lower") };
            let force = (asked - got).abs() * if is_place { weight } else { 1.0 };
            if row.side != side || !are_near(row.multiplier, force, 1e-6 * (1e-9 + force)) {
                let what = format!("multiplier of the active {} row of joint '{}'", row.kind, joint.name);
                return broken(what, sign * row.multiplier, sign * force, "of its own unit");
            }
            // The velocity with which it would be reached, a little further.
            let from = q.unwrap_or(0.0);
            let reached =
                if is_place { passage.v[i] + ((got - from) / p.dt - passage.v[i]) / p.kappa } else { got };
            let is_end = match row.kind.as_str() {
                "position" if is_place => {
                    are_near(got, if sign > 0.0 { joint.upper } else { joint.lower }, TOLERANCE)
                }
                kind => joint.breaks(kind, sign, p, q, (passage.v[i], None), reached + sign * near, whole),
            };
            if !is_end {
                let what = format!(
                    "target {what} of joint '{}', which the {} row holds too early,",
                    joint.name, row.kind
                );
                return broken(what, got, asked, "as proposed");
            }
        }
    }
    slack(ledger, Some(0.0))?;
    match named == ledger.active_rows.len() {
        true => Ok(()),
        false => broken(
            "number of active rows",
            ledger.active_rows.len() as f64,
            named as f64,
            "that hold something",
        ),
    }
}

/// Motor forces for a unit of each acceleration (nv x nv, by rows): they are linear in it.
fn forces(
    machine: &mut crate::motion::Machine,
    period: &crate::period::Period,
    passage: &Passage<'_>,
) -> Vec<f64> {
    let nv = passage.v.len();
    let (mut a, mut still, mut with) = (vec![0.0; nv], vec![0.0; nv], vec![0.0; nv]);
    machine.motors(period, passage.q, passage.v, &a, &mut still);
    let mut all = vec![0.0; nv * nv];
    for j in 0..nv {
        a.fill(0.0);
        a[j] = 1.0;
        machine.motors(period, passage.q, passage.v, &a, &mut with);
        (0..nv).for_each(|i| all[i * nv + j] = with[i] - still[i]);
    }
    all
}

/// A row pushes only at its bound; a soft one beyond it as hard as it gives way.
fn belongs(
    row: &Row,
    (multiplier, excess, slack): (f64, f64, f64),
    steepest: f64,
    (worth, rung): (f64, u32),
) -> Result<(), Fault> {
    let of = |what: &str| format!("{what} of the active {} row of '{}'", row.kind, row.name);
    let coarse = if rung == CLARABEL || rung == RELAXED { 1e-4 } else { AT };
    // What the row is away from its bound by, as a velocity.
    let away = excess.abs() * row.size / steepest.max(f64::MIN_POSITIVE);
    let is_at = excess.abs() <= coarse || away <= 1e-9;
    let Some(soft) = row.soft else {
        return match is_at || multiplier * steepest <= ROUNDING {
            true if slack == 0.0 => Ok(()),
            true => broken(of("slack"), slack, 0.0, "of its size"),
            false => broken(of("distance from the bound"), excess, 0.0, "of its size"),
        };
    };
    if (slack - excess.max(0.0)).abs() > coarse * (1.0 + excess.abs()) {
        return broken(of("slack"), slack, excess.max(0.0), "of its size");
    }
    if rung == RELAXED {
        return Ok(()); // soft rows were left out
    }
    let force = multiplier * row.size / worth;
    let wanted = soft.linear + soft.quadratic * excess.max(0.0);
    let near = 1e-5 * (1.0 + wanted) + soft.quadratic * coarse;
    let is_right =
        if excess > coarse { (force - wanted).abs() <= near } else { is_at && force <= wanted + near };
    if is_right || multiplier * steepest <= CONIC {
        Ok(())
    } else {
        broken(of("multiplier"), force, wanted, "of its weights")
    }
}

/// The slack of a nearest state is no more than the worst of its rows gives way, where that is known.
fn slack(ledger: &Ledger, most: Option<f64>) -> Result<(), Fault> {
    let (said, Some(most)) = (ledger.slack, most) else { return Ok(()) };
    if said.is_nan() || said > most + SLACK * (1.0 + most) {
        return broken("ledger.slack", said, most, "of a limit's size at most");
    }
    Ok(())
}

/// Every hard row is kept as the projection has to keep it, and a soft one that gives way is named. By how much the worst of them is exceeded, as
/// a share of its size; none where that of some row is not known.
fn all_hold(promise: &mut Promise, passage: &Passage<'_>, ledger: &Ledger) -> Result<Option<f64>, Fault> {
    let nv = passage.v.len();
    let Promise { machine, limits, period, .. } = promise;
    let mut highest = Some(0.0f64);
    for (r, row) in limits.rows.iter().enumerate() {
        let excess = match (&limits.collision, &row.rule) {
            (Some(bodies), Rule::Pair) => {
                match bodies.row(machine, period, passage, r - first_pair(&limits.rows)) {
                    Told::Row(excess, _) => excess,
                    Told::None => f64::NEG_INFINITY,
                    // That bodies keep apart is looked at by itself. A row that is not known and holds nothing back is no matter here.
                    Told::Unknown(_) => {
                        highest = None;
                        f64::NEG_INFINITY
                    }
                }
            }
            _ => worst(row.excess(machine, period, passage)),
        };
        if machine.is_spent() {
            return Err(Fault::Unknown(SPENT.into()));
        }
        let is_named = || ledger.active_rows.iter().any(|active| active.row == nv + r);
        highest = highest.map(|most| most.max(excess));
        let most = if row.soft.is_some() { 10.0 * TOLERANCE } else { AT.max(TOLERANCE) };
        if excess > most && (row.soft.is_none() || !is_named()) {
            return broken(
                format!("{} row of '{}', which is not named as active,", row.kind, row.name),
                excess,
                0.0,
                "of its size beyond its bound",
            );
        }
    }
    Ok(highest)
}
