//! `[constraints] reached = 0.01`: the share of control ticks whose reached state may be outside a position limit.
//!
//! A learned inverse model does not lead where its target is, and a margin in the target moves the robot no further than the inverse model
//! answers to it. What a margin has to act on is what the motor may do as the limit comes near (`results/reached`). Every side of the range of
//! a joint is a row, with a margin `m` from 0 to 1. Where the row is near, its motor pushes towards the limit by no more than `1 - 2 m` of its
//! range: everything at 0, nothing at a half, and away from it at 1. After each tick
//!
//! ```text
//!     m <- m + eta (outside - wanted),       eta = GAIN max((1 + n / SETTLES)^(-3/4), LEAST),       0 <= m <= 1
//! ```
//!
//! with `outside` 1 where the reached position is beyond the limit of the row and 0 elsewhere, and `n` the ticks so far: adaptive conformal
//! inference (Gibbs and Candes 2021) with a step that decays (Angelopoulos, Barber and Bates 2024), though not to nothing, as a policy may change.
//! `wanted` is the row's part of what was asked for, by how often each row was outside lately. As several may be outside in one tick, an
//! integral `s` of the error of the whole scales it:
//!
//! ```text
//!     f <- f + RECENT (outside - f),     s <- s + BALANCE eta / GAIN (1 - any / asked),     wanted = s asked f / sum f
//! ```
//!
//! Nothing but sums, products, quotients and roots, so that every machine has the same bits.

use super::Parts;
use super::parts::unusable;
use crate::motors::Motors;
use crate::snapshot::{Manifest, PolicyKind, SnapshotError};
use crate::task::IdmKind;
use nearl_constraints::{Drive, LimitSet, Model};

const GAIN: f64 = 0.04;
const SETTLES: f64 = 2000.0;
const LEAST: f64 = 0.1;
const RECENT: f64 = 0.002;
const BALANCE: f64 = 0.01;
/// Ends of `s`.
const SCALES: (f64, f64) = (0.2, 5.0);
/// Ticks that are counted at most: the step has come to its least before.
const MOST_TICKS: f64 = 1e5;
/// A row is near where the proposal is within this share of the range of its limit.
const NEAR: f64 = 0.1;
/// A state further outside than this [rad or m] is outside, as for [`Controller::excess`](super::Controller::excess).
const TOLERANCE: f64 = 1e-9;
/// A margin from here on is at its end.
const END: f64 = 0.99;

/// One side of the range of a joint, and its margin.
#[derive(Clone, Debug, PartialEq)]
pub struct Margin {
    /// Degree of freedom.
    pub dof: usize,
    /// The upper limit, else the lower.
    pub is_upper: bool,
    /// Share of the way from a motor that may do all to one that pushes away from the limit, 0 to 1.
    pub share: f64,
    /// It cannot grow any more: should the row still be outside too often, what was asked for is not to be had of it.
    pub at_end: bool,
}

/// One side of the range of a joint.
struct Row {
    dof: usize,
    idx_q: usize,
    /// 1 for the upper limit, -1 for the lower.
    side: f64,
    /// The limit [rad or m]; infinite where there is none.
    limit: f64,
    /// What is near the limit [rad or m].
    near: f64,
    /// Place in the action.
    at: usize,
    /// The action that pushes hardest towards the limit, and the one that pushes hardest away from it.
    towards: f64,
    away: f64,
}

impl Row {
    fn is_beyond(&self, q: f64, by: f64) -> bool {
        self.side * (q - self.limit) > by
    }
}

/// Margins that bring the share of ticks that end outside to what was asked for.
pub(super) struct Dial {
    asked: f64,
    dt: f64,
    rows: Vec<Row>,
    /// `m` of each row.
    margins: Vec<f64>,
    /// `f` of each row: how often it was outside lately.
    often: Vec<f64>,
    /// `s`.
    scale: f64,
    /// `n`.
    ticks: f64,
    /// The state to come is one that an action of this controller led to.
    acted: bool,
    /// What the snapshot brought.
    first: Vec<f64>,
}

impl Dial {
    /// Of a task that asks for one; `idx_q` is the configuration index by dof, `limits` are those that the state is measured by.
    ///
    /// # Errors
    /// [`SnapshotError::Unusable`] where it could mean nothing.
    pub(super) fn new(
        m: &Manifest,
        model: &Model,
        controllable: &[usize],
        idx_q: &[usize],
        limits: &LimitSet,
    ) -> Result<Option<Dial>, SnapshotError> {
        let Some(asked) = m.task.constraints.reached else { return Ok(None) };
        check(m, asked)?;
        let drives = Parts::drives(m, model, controllable)?;
        if let Some(dof) = controllable.iter().find(|dof| drives[**dof] != Drive::Effort) {
            return Err(unusable(&format!(
                "[constraints] reached bounds the forces of motors, but joint '{}' is commanded {}; leave reached out, or write [command] \
                 interface = \"effort\"",
                model.dof_name(*dof),
                drives[*dof]
            )));
        }
        let motors = Motors::new(model, controllable, &drives);
        let motors = motors.map_err(|reason| unusable(&format!("[constraints] reached: {reason}")))?;
        if m.action_lower.len() != controllable.len() {
            return Err(unusable(&format!(
                "[constraints] reached needs one motor for each controllable joint, but there are {} actions for {} joints; name the driven \
                 joints in state.controllable",
                m.action_lower.len(),
                controllable.len()
            )));
        }
        let rows: Vec<Row> = (controllable.iter().enumerate())
            .flat_map(|(k, &dof)| [-1.0, 1.0].map(|side| row(m, &motors, (k, dof), idx_q[dof], side, limits)))
            .collect();
        let bounded = rows.iter().filter(|row| row.limit.is_finite()).count();
        if bounded == 0 {
            return Err(unusable(
                &"[constraints] reached is a share of ticks outside a position limit, and no controllable joint has one; add position = {}, \
                  or leave reached out",
            ));
        }
        let often =
            rows.iter().map(|row| if row.limit.is_finite() { 1.0 / bounded as f64 } else { 0.0 }).collect();
        let margins = vec![0.0; rows.len()];
        let mut dial = Dial {
            asked,
            dt: m.task.time.dt,
            rows,
            margins,
            often,
            scale: 1.0,
            ticks: 0.0,
            acted: false,
            first: Vec::new(),
        };
        dial.first = dial.learned();
        Ok(Some(dial))
    }

    /// What was asked for.
    pub(super) fn asked(&self) -> f64 {
        self.asked
    }

    /// Which rows `q` is outside of, by their place in [`Dial::margins`].
    pub(super) fn outside<'a>(&'a self, q: &'a [f64]) -> impl Iterator<Item = bool> + 'a {
        self.rows.iter().map(|row| row.is_beyond(q[row.idx_q], TOLERANCE))
    }

    /// Takes in the state that the last action led to.
    pub(super) fn learn(&mut self, q: &[f64]) {
        if !std::mem::replace(&mut self.acted, false) {
            return;
        }
        self.ticks = (self.ticks + 1.0).min(MOST_TICKS);
        let root = (1.0 + self.ticks / SETTLES).sqrt();
        let step = (1.0 / (root * root.sqrt())).max(LEAST);
        let mut any = 0.0;
        for (row, often) in self.rows.iter().zip(&mut self.often) {
            let outside = f64::from(u8::from(row.is_beyond(q[row.idx_q], TOLERANCE)));
            *often += RECENT * (outside - *often);
            any = f64::max(any, outside);
        }
        self.scale = (self.scale + BALANCE * step * (1.0 - any / self.asked)).clamp(SCALES.0, SCALES.1);
        let all = self.often.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        for ((row, often), margin) in self.rows.iter().zip(&self.often).zip(&mut self.margins) {
            let outside = f64::from(u8::from(row.is_beyond(q[row.idx_q], TOLERANCE)));
            let wanted = self.scale * self.asked * often / all;
            *margin = (*margin + GAIN * step * (outside - wanted)).clamp(0.0, 1.0);
        }
    }

    /// Bounds `action` (n_act) where a row is near: the proposed position, or where a period at the present velocity leads. A direct policy
    /// proposes none.
    pub(super) fn bound(&mut self, q: &[f64], v: &[f64], proposed: Option<&[f64]>, action: &mut [f64]) {
        for (row, margin) in self.rows.iter().zip(&self.margins) {
            let ahead = q[row.idx_q] + self.dt * v[row.dof];
            let proposal = proposed.map_or(ahead, |proposed| proposed[row.idx_q]);
            if row.is_beyond(proposal, -row.near) || row.is_beyond(ahead, 0.0) {
                let most = row.towards + margin * (row.away - row.towards);
                let a = &mut action[row.at];
                *a = if row.towards > row.away { a.min(most) } else { a.max(most) };
            }
        }
        self.acted = true;
    }

    /// The state to come is none that an action of this controller led to; the margins stay.
    pub(super) fn interrupt(&mut self) {
        self.acted = false;
    }

    /// The margins that the snapshot brought.
    pub(super) fn begin_anew(&mut self) {
        let first = std::mem::take(&mut self.first);
        self.take_learned(&first);
        self.first = first;
        self.acted = false;
    }

    /// Every row with its margin.
    pub(super) fn margins(&self) -> Vec<Margin> {
        let margin = |(row, &share): (&Row, &f64)| Margin {
            dof: row.dof,
            is_upper: row.side > 0.0,
            share,
            at_end: share >= END,
        };
        self.rows.iter().zip(&self.margins).map(margin).collect()
    }

    /// Number of entries of [`Dial::learned`].
    pub(super) fn learned_len(&self) -> usize {
        2 + 2 * self.rows.len()
    }

    /// What was learned, as plain numbers: what a snapshot brings.
    pub(super) fn learned(&self) -> Vec<f64> {
        let mut numbers = Vec::with_capacity(self.learned_len());
        self.write(&mut numbers);
        numbers
    }

    fn write(&self, numbers: &mut Vec<f64>) {
        numbers.extend([self.scale, self.ticks]);
        numbers.extend(&self.often);
        numbers.extend(&self.margins);
    }

    /// Takes what [`Dial::learned`] gave; whatever it is, the margins are some.
    pub(super) fn take_learned(&mut self, numbers: &[f64]) {
        let n = self.rows.len();
        // `max` first: it makes a number of what is none.
        let within = |x: f64, low: f64, high: f64| x.max(low).min(high);
        self.scale = within(numbers[0], SCALES.0, SCALES.1);
        self.ticks = within(numbers[1], 0.0, MOST_TICKS);
        for k in 0..n {
            self.often[k] = within(numbers[2 + k], 0.0, 1.0);
            self.margins[k] = within(numbers[2 + n + k], 0.0, 1.0);
        }
    }

    /// The margins that the snapshot brings, from now on.
    pub(super) fn bring(&mut self, learned: &[f64]) {
        self.take_learned(learned);
        self.first = self.learned();
    }

    /// Appends what the next tick depends on.
    pub(super) fn write_memory(&self, memory: &mut Vec<f64>) {
        memory.push(f64::from(u8::from(self.acted)));
        self.write(memory);
    }

    /// Takes what [`Dial::write_memory`] wrote.
    pub(super) fn set_memory(&mut self, memory: &[f64]) {
        self.acted = memory[0] == 1.0;
        self.take_learned(&memory[1..]);
    }
}

/// What several environments learned from the same beginning, as one: the mean, entry by entry. `None` where nothing was learned, or by other
/// rows.
pub fn merge_margins<'a>(learned: impl Iterator<Item = &'a [f64]>) -> Option<Vec<f64>> {
    let (mut sum, mut count) = (Vec::new(), 0.0);
    for numbers in learned {
        if count == 0.0 {
            sum = vec![0.0; numbers.len()];
        }
        if numbers.is_empty() || numbers.len() != sum.len() {
            return None;
        }
        sum.iter_mut().zip(numbers).for_each(|(sum, x)| *sum += x);
        count += 1.0;
    }
    sum.iter_mut().for_each(|sum| *sum /= count);
    (count > 0.0).then_some(sum)
}

fn row(
    m: &Manifest,
    motors: &Motors,
    (k, dof): (usize, usize),
    idx_q: usize,
    side: f64,
    limits: &LimitSet,
) -> Row {
    let (at, [lower, upper]) = (motors.place(k), [limits.q_lower[dof], limits.q_upper[dof]]);
    let ends = [m.action_lower[at], m.action_upper[at]];
    let pushes_up = motors.command(k, ends[1]) >= motors.command(k, ends[0]);
    let (towards, away) = if pushes_up == (side > 0.0) { (ends[1], ends[0]) } else { (ends[0], ends[1]) };
    let width = upper - lower;
    Row {
        dof,
        idx_q,
        side,
        limit: if side > 0.0 { upper } else { lower },
        near: if width.is_finite() { NEAR * width } else { 0.0 },
        at,
        towards,
        away,
    }
}

/// Refuses what could mean nothing.
fn check(m: &Manifest, asked: f64) -> Result<(), SnapshotError> {
    if !(asked > 0.0 && asked < 1.0) {
        return Err(unusable(&format!(
            "[constraints] reached = {asked} is no share of control ticks above 0 and below 1; 0.01 is one in a hundred"
        )));
    }
    let kept = match (m.policy, m.task.idm.kind) {
        _ if !m.task.constraints.guard.is_off() => {
            "[constraints] guard gives the one action that leads to an allowed state"
        }
        (kind, IdmKind::Pinocchio) if kind != PolicyKind::Direct => {
            "idm.kind = \"pinocchio\" gives the one torque that leads to the target"
        }
        _ => return Ok(()),
    };
    Err(unusable(&format!(
        "[constraints] reached would change an action that is already decided: {kept}; leave one of the two out"
    )))
}

#[cfg(test)]
mod tests;
