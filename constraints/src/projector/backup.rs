//! A way to stop, verified for every hard limit before a new state is taken.
//!
//! A brake gives every controllable joint `i` a constant deceleration `b_i` until it stands. In the `k`-th tick of it, with
//! `N_i = floor(|v_i| / (b_i T))` full ticks before the last, shorter one,
//!
//! ```text
//!     v_k = v - k b T,   q_k = q + k T v - b T^2 (k (k - 1) / 2 + kappa k)     (k <= N_i, sign of v)
//! ```
//!
//! and in the last one the rest of the speed is taken off, so that no joint turns round. Joints of which a row holds a sum at a value slow down
//! in proportion, `b_i / |v_i|` the same for all of them, so that the sum stays. A joint of hard jerk has `b_i` as its largest deceleration
//! and brakes as in [`jerk`](crate::jerk). A brake is verified when each joint stands before its position limit in these very ticks, stays below its
//! speed profile, and every hard row and cone holds ([`Rows::breach`](crate::Rows::breach)) at the ticks looked at and, by the bound of
//! [`Backup::between`], at those between them. By induction there is always a way to stop: either the new state has a verified brake, or the old one
//! has, and the first tick of that brake leads to a state whose brake is the rest of it.

mod refusal;
mod stopping;

use super::Dofs;
use crate::checker::Checker;
use crate::jerk::{Brake, Stop};
use crate::viability::{Dof, Period};
use crate::{Dynamics, Limit, LimitError, LimitSet, Model};
pub(crate) use refusal::{Passage, Refusal};
use stopping::{least_deceleration, soonest};

/// A breach up to this is rounding.
const ROUNDING: f64 = 1e-10;

/// What is broken already may be broken by so much more: in 10,000 ticks it adds up to [`ROUNDING`].
const NOISE: f64 = 1e-14;

/// Ways of braking, tried from the one that passed last on.
const TRIED: [Plan; 10] = [
    Plan::Together(1.0),
    Plan::Together(2.0),
    Plan::Apart(1.0),
    Plan::Together(5.0),
    Plan::Apart(0.5),
    Plan::Apart(0.2),
    Plan::Apart(0.0),
    Plan::Together(25.0),
    Plan::Together(250.0),
    Plan::Together(10_000.0),
];

/// The last of them are for drives whose targets end, over one physics step, where nothing is off. One that holds a joint against its weight with its target
/// at that end has hardly more force than that away from there, `K T v` after a tick at `v`, and stops it within `m / (K T^2)` ticks at best.
const USUAL: usize = 7;

/// Ticks in which the slowest of them stop, or five times as many as the quickest stop takes.
const SLOWEST: f64 = 10_000.0;

/// Without a position limit near, a joint that brakes by itself takes at least this share of the largest deceleration.
const LEAST: f64 = 0.05;

/// A stretch of equal accelerations is looked at in this many ticks, one more for every [`FAR`] of way.
const FEWEST: u32 = 5;

/// Way of all joints together [rad or m].
const FAR: f64 = 0.4;

/// Ticks looked at in a stretch at most; a brake that is not settled then does not count.
const MOST: u32 = 65;

/// A brake that goes further than this beyond a moved limit is not over with it [m, or share of a size].
const FURTHER: f64 = 1e-6;

/// A joint of several that brake in proportion stands at this speed, which none of the others waits for [rad/s or m/s].
const STANDS: f64 = 1e-10;

/// A joint that is slower than this share of what a period of its braking takes off stands after one: its share of a longer brake would be next to
/// no deceleration, with which a plant that is off by a little would not stop it.
const AT_ONCE: f64 = 1e-4;

/// A joint that is outside, and needs up to this share more than it brakes by at most, is off by noise: it brakes by itself, and the others go
/// on. Where it needs more, all brake.
const LATE: f64 = 1e-2;

/// A brake of more ticks than this is as good as one without ticks.
const MANY: f64 = 1e5;

/// How the joints share a brake.
#[derive(Debug, Clone, Copy)]
enum Plan {
    /// All stand at the same time, this many times as late as the quickest stop; only those that must are quicker. The direction of
    /// the velocity stays, and with it whatever is a sum of them.
    Together(f64),
    /// Each by itself, between the least that stops in time (0) and the largest deceleration (1).
    Apart(f64),
}

/// The last verified brake and the scratch to verify another.
pub(crate) struct Backup {
    /// A brake is stored.
    pub(crate) stored: bool,
    /// It was verified within what is asked for, and does not depend on what moved limits allow on the way to them.
    within: bool,
    /// Its decelerations (nv).
    deceleration: Vec<f64>,
    /// What was remembered as the tick began.
    begun: Vec<f64>,
    /// The index into [`TRIED`] that passed last, and how many are tried.
    favourite: usize,
    tried: usize,
    checker: Checker,
    dynamics: Dynamics,
    /// By how much each row may be broken (hard rows): what the measured state breaks already.
    allowed: Vec<f64>,
    /// By how much the stored brake breaks each row that was moved (hard rows), and by how much the state does.
    on_the_way: Vec<f64>,
    here: Vec<f64>,
    /// Rows of which a state, not a motion, is beyond the limit.
    of_state: Vec<bool>,
    /// By how much less than it keeps each row is verified for in a brake (hard rows).
    less: Vec<f64>,
    trial: Vec<f64>,
    /// The planned motion of each dof of hard jerk (nv).
    stops: Vec<Option<Stop>>,
    /// Full ticks of the planned brake of each other dof, and the speed left after them (nv).
    full: Vec<(f64, f64)>,
    /// The largest deceleration of each dof (nv).
    most: Vec<f64>,
    /// The least deceleration of each dof that stops in time (nv).
    least: Vec<f64>,
    /// Dofs that slow down in proportion, because a sum of them is held at a value.
    groups: Vec<Vec<usize>>,
    now: State,
    next: State,
    way: Vec<f64>,
    /// Ticks at which some acceleration of the brake changes.
    cuts: Vec<u32>,
    /// Ticks looked at in a stretch, and the breach of each row there.
    ticks: Vec<u32>,
    breach: Vec<f64>,
    /// Breach of each row where a target was refused, and by how much it might be broken there.
    found: Vec<f64>,
    spared: Vec<f64>,
    /// What the state breaks of a cone is excused in a brake, and not in the passage to it.
    strict: bool,
    /// Hard rows before the hard cones.
    cones_from: usize,
    /// A state next to it.
    near: State,
}

#[derive(Default)]
struct State {
    q: Vec<f64>,
    v: Vec<f64>,
    /// Acceleration of the tick before, where it is asked for.
    a: Vec<f64>,
}

impl Backup {
    pub(crate) fn new(
        model: &Model,
        limits: &[Box<dyn Limit>],
        controllable: &[usize],
        settings: &crate::Settings,
    ) -> Result<Backup, LimitError> {
        let zero = || vec![0.0; model.nv()];
        let state = || State { q: model.neutral(), v: zero(), a: zero() };
        let period = Period::new(settings.dt, settings.sub_steps);
        let checker = Checker::new(model, limits, controllable, period, settings.consistency)?;
        Ok(Backup {
            stored: false,
            within: false,
            deceleration: zero(),
            begun: vec![0.0; model.nv() + 2],
            favourite: 0,
            tried: if checker.needs_a_brake() && settings.sub_steps == 1 { TRIED.len() } else { USUAL },
            dynamics: Dynamics::new(model),
            allowed: vec![0.0; checker.hard()],
            on_the_way: vec![0.0; checker.hard()],
            here: vec![0.0; checker.hard()],
            of_state: checker.hard_of_state(),
            less: checker.hard_reserves(),
            trial: zero(),
            stops: vec![None; model.nv()],
            full: vec![(0.0, 0.0); model.nv()],
            most: zero(),
            least: zero(),
            groups: groups(checker.in_proportion().map(|(_, dofs)| dofs)),
            now: state(),
            next: state(),
            way: zero(),
            cuts: Vec::with_capacity(3 * model.nv() + 1),
            ticks: Vec::with_capacity(MOST as usize),
            breach: vec![0.0; checker.hard() * MOST as usize],
            found: vec![0.0; checker.hard()],
            spared: vec![0.0; checker.hard()],
            strict: false,
            cones_from: checker.hard_rows(),
            near: state(),
            checker,
        })
    }

    /// As new: what is tried first next depends on nothing that was.
    pub(crate) fn forget(&mut self) {
        (self.stored, self.within, self.favourite) = (false, false, 0);
    }

    /// Not stored (0), stored (1) or stored on the way to moved limits (2), what passed last, and the decelerations.
    pub(crate) fn write_memory(&self, memory: &mut Vec<f64>) {
        let stored = if self.within { 1 } else { 2 };
        memory.extend_from_slice(&[f64::from(stored * u8::from(self.stored)), self.favourite as f64]);
        memory.extend_from_slice(&self.deceleration);
    }

    pub(crate) fn set_memory(&mut self, memory: &[f64]) {
        (self.stored, self.within) = (memory[0] != 0.0, memory[0] == 1.0);
        self.favourite = memory[1] as usize % self.tried;
        self.deceleration.copy_from_slice(&memory[2..]);
    }

    /// What is remembered now is what [`Backup::go_back`] comes back to.
    pub(crate) fn mark(&mut self) {
        let mut begun = std::mem::take(&mut self.begun);
        begun.clear();
        self.write_memory(&mut begun);
        self.begun = begun;
    }

    pub(crate) fn go_back(&mut self) {
        let begun = std::mem::take(&mut self.begun);
        self.set_memory(&begun);
        self.begun = begun;
    }

    /// Switches the rows and cones of a limit.
    pub(crate) fn enable(&mut self, limit: usize, on: bool, left: &LimitSet) {
        self.checker.enable(limit, on, left);
    }

    /// A tick begins: nothing is beyond its limit but what the brake in force is, where limits were moved.
    pub(crate) fn begin(&mut self) {
        self.allowed.copy_from_slice(&self.on_the_way);
        self.strict = false;
    }

    /// Whether the passage to a target may break nothing of cones that the state breaks already: they are of speeds, which are less within a period.
    pub(crate) fn be_strict(&mut self, strict: bool) {
        self.strict = strict;
    }

    /// Whether something of a cone is excused.
    pub(crate) fn excuses_a_cone(&self) -> bool {
        let from = self.cones_from;
        self.allowed[from..].iter().zip(&self.on_the_way[from..]).any(|(allowed, most)| allowed > most)
    }

    /// By how much hard row `r` may be broken in a passage.
    fn allowed_in_a_passage(&self, r: usize) -> f64 {
        if self.strict && r >= self.cones_from { self.on_the_way[r] } else { self.allowed[r] }
    }

    /// Asks for `share` of the size of a limit's cones, and for its rows to lie `inset` [m] further inside.
    pub(crate) fn ask(&mut self, limit: usize, share: f64, inset: f64) {
        self.checker.ask(limit, share, inset);
        self.within = false;
        self.on_the_way.fill(0.0);
    }

    /// Puts planes and obstacles elsewhere, in the order of the limits.
    pub(crate) fn put(&mut self, numbers: &[[f64; 6]]) {
        self.checker.put(numbers);
    }

    /// Finds by how much the stored brake, verified for limits that were moved since, breaks each hard row at most, which is what the way to
    /// the new ones may break from here on ([`Backup::on_the_way`]); true when that is anything.
    pub(crate) fn measure_the_way(
        &mut self,
        with: &With<'_>,
        (q, v): (&[f64], &[f64]),
        before: &[f64],
    ) -> bool {
        self.on_the_way.fill(0.0);
        if self.within || !self.stored {
            return false;
        }
        let rows = self.allowed.len();
        self.trial.copy_from_slice(&self.deceleration);
        for &i in &with.dofs.controllable {
            let dof = Dof::of(with.limits, i);
            let brake = Brake::new(&dof, self.trial[i], with.period);
            self.stops[i] = dof.jerk.is_finite().then(|| brake.stop(v[i], before[i]));
        }
        self.count(with, v);
        self.find_cuts(with);
        let mut first = 0;
        for k in 0..=self.cuts.len() {
            let last = match self.cuts.get(k) {
                Some(end) if *end <= first => continue,
                Some(end) => end - 1,
                None => first, // at rest
            };
            self.look_over(with, q, v, (first, last), FEWEST + MOST / 4);
            for r in 0..rows {
                let most = self.highest(r);
                if self.of_state[r] && most > ROUNDING {
                    self.on_the_way[r] = self.on_the_way[r].max(most);
                }
            }
            first = last + 1;
        }
        // What lies between the ticks looked at is a bound, and would add up from tick to tick: what was built holds all the same.
        self.on_the_way
            .iter_mut()
            .zip(self.checker.slack_to_the_build())
            .for_each(|(most, slack)| *most = most.min(slack));
        self.checker.breaches((q, v), (q, v), with.external, &mut self.here);
        self.on_the_way.iter().any(|most| *most > 0.0)
    }

    /// By how much each hard row may be broken on the way to moved limits, and whether the brake in force goes further beyond it than
    /// the state is.
    pub(crate) fn on_the_way(&self) -> impl Iterator<Item = (f64, bool)> {
        self.on_the_way.iter().zip(&self.here).map(|(most, here)| (*most, *most > here.max(0.0) + FURTHER))
    }

    /// The same alone.
    pub(crate) fn allowed_on_the_way(&self) -> &[f64] {
        &self.on_the_way
    }

    /// Allows what the state breaks already, so that it may come back; true when that is anything.
    pub(crate) fn excuse(&mut self, with: &With<'_>, q: &[f64], v: &[f64]) -> bool {
        self.checker.breaches((q, v), (q, v), with.external, &mut self.allowed);
        for (allowed, of_state) in self.allowed.iter_mut().zip(&self.of_state) {
            *allowed = if *of_state && *allowed > ROUNDING { *allowed } else { 0.0 };
        }
        let mut more = false;
        for (allowed, on_the_way) in self.allowed.iter_mut().zip(&self.on_the_way) {
            more |= *allowed > *on_the_way;
            *allowed = allowed.max(*on_the_way);
        }
        more
    }

    /// The motion breaks no hard row or cone. `torque`: what a checker of the same limits has found its motor forces to be, if one has.
    pub(crate) fn allows(
        &mut self,
        with: &With<'_>,
        from: (&[f64], &[f64]),
        to: (&[f64], &[f64]),
        torque: Option<&[f64]>,
    ) -> bool {
        let rows = self.allowed.len();
        self.checker.breaches_with(from, to, with.external, torque, &mut self.breach[..rows]);
        (0..rows).all(|r| holds((&self.breach[r], &self.allowed_in_a_passage(r))))
    }

    /// Looks for a brake from the state after a tick at acceleration `a` and stores it; the old one stays when there is none.
    pub(crate) fn verify(&mut self, with: &With<'_>, (q, v): (&[f64], &[f64]), a: &[f64]) -> bool {
        for k in 0..self.tried {
            let index = (self.favourite + k) % self.tried;
            if self.plan(with, (q, v), a, TRIED[index]) && self.within_reach(with, q, v) {
                (self.favourite, self.stored) = (index, true);
                self.within = self.allowed.iter().all(|allowed| *allowed <= 0.0);
                self.deceleration.copy_from_slice(&self.trial);
                return true;
            }
        }
        false
    }

    /// The decelerations of the stored brake (nv), if one is stored.
    pub(crate) fn decelerations(&self) -> Option<&[f64]> {
        self.stored.then_some(&self.deceleration)
    }

    /// Velocity of dof `i`, whose jerk is free, after one tick of the stored brake.
    pub(crate) fn next_velocity(&self, i: usize, v: f64, period: &Period) -> f64 {
        v - v.signum() * (self.deceleration[i] * period.dt).min(v.abs())
    }

    /// Deceleration of dof `i` in the stored brake.
    pub(crate) fn deceleration(&self, i: usize) -> f64 {
        self.deceleration[i]
    }

    /// Decelerations of a brake from the state after a tick at acceleration `a`; false when some joint cannot stand before its limit.
    fn plan(&mut self, with: &With<'_>, (q, v): (&[f64], &[f64]), a: &[f64], plan: Plan) -> bool {
        let dt = with.period.dt;
        let mut quickest: f64 = 0.0;
        for &i in &with.dofs.controllable {
            let dof = Dof::of(with.limits, i);
            self.most[i] = if dof.jerk.is_finite() { Brake::most(&dof) } else { dof.braking(with.period) };
            quickest = quickest.max(v[i].abs() / (self.most[i] * dt));
        }
        for &i in &with.dofs.controllable {
            let dof = Dof::of(with.limits, i);
            let (most, speed) = (self.most[i], v[i].abs());
            self.stops[i] = None;
            if dof.jerk.is_finite() {
                let wanted = match plan {
                    _ if dof.locked => most,
                    Plan::Together(late) => speed / (late_by(late, quickest) * dt),
                    Plan::Apart(share) => (LEAST + share * (1.0 - LEAST)) * most,
                };
                let at = with.dofs.single[i].map(|iq| q[iq]);
                let wanted = wanted.clamp(LEAST * most, most);
                let Some(b) =
                    soonest(&dof, at, (v[i], a[i]), wanted, with.period).or(with.outside[i].then_some(most))
                else {
                    return false;
                };
                self.trial[i] = b;
                self.stops[i] = Some(Brake::new(&dof, b, with.period).stop(v[i], a[i]));
                continue;
            }
            let least = match with.dofs.single[i] {
                _ if dof.locked => most,
                Some(iq) if speed > 0.0 => least_deceleration(&dof, q[iq], v[i], with.period),
                _ => 0.0,
            };
            if least > most * (1.0 + if with.outside[i] { LATE } else { 1e-9 }) {
                return false;
            }
            let least = least.min(most);
            self.least[i] = least;
            self.trial[i] = match plan {
                _ if speed <= AT_ONCE * most * dt => most,
                Plan::Together(late) => (speed / (late_by(late, quickest) * dt)).max(least).min(most),
                Plan::Apart(share) => {
                    let least = least.max(LEAST * most);
                    least + share * (most - least)
                }
            };
        }
        if !self.slow_in_proportion(v, plan) {
            return false;
        }
        self.count(with, v);
        true
    }

    /// Gives the dofs of each group decelerations in proportion to their velocities; false where one of them would have to stop sooner than
    /// another can.
    fn slow_in_proportion(&mut self, v: &[f64], plan: Plan) -> bool {
        for group in &self.groups {
            let (mut low, mut high, mut wanted) = (0.0f64, f64::INFINITY, 0.0f64);
            for &i in group.iter().filter(|i| v[**i].abs() > STANDS) {
                let speed = v[i].abs();
                (low, high) = (low.max(self.least[i] / speed), high.min(self.most[i] / speed));
                wanted = wanted.max(self.trial[i] / speed);
            }
            if low > high * (1.0 + 1e-9) {
                return false;
            }
            if let Plan::Apart(share) = plan {
                let low = low.max(LEAST * high);
                wanted = low + share * (high - low);
            }
            for &i in group {
                let stands = v[i].abs() <= STANDS;
                self.trial[i] = if stands { self.most[i] } else { wanted.min(high) * v[i].abs() };
            }
        }
        true
    }

    /// Counts the full ticks of the planned brake of each dof, once for all that is looked at of it.
    fn count(&mut self, with: &With<'_>, v: &[f64]) {
        for &i in &with.dofs.controllable {
            let step = self.trial[i] * with.period.dt;
            let ticks = (v[i].abs() / step + 1e-9).floor();
            let left = v[i].abs() - ticks * step;
            self.full[i] = (ticks, if left > 1e-9 * step { left } else { 0.0 });
        }
    }

    /// Every hard row and cone holds in every tick of the planned brake.
    fn within_reach(&mut self, with: &With<'_>, q: &[f64], v: &[f64]) -> bool {
        self.find_cuts(with);
        let mut first = 0;
        for k in 0..self.cuts.len() {
            let end = self.cuts[k];
            if end > first && !self.stretch(with, q, v, (first, end - 1)) {
                return false;
            }
            first = end;
        }
        self.stretch(with, q, v, (first, first)) // at rest
    }

    /// Finds the ticks at which some acceleration of the planned brake changes.
    fn find_cuts(&mut self, with: &With<'_>) {
        self.cuts.clear();
        for &i in &with.dofs.controllable {
            if let Some(stop) = &self.stops[i] {
                self.cuts.extend(stop.cuts().map(|tick| tick.min(1e6) as u32));
                continue;
            }
            let (full, left) = self.full[i];
            let full = full.min(1e6) as u32;
            self.cuts.push(full);
            if left > 0.0 {
                self.cuts.push(full + 1);
            }
        }
        self.cuts.sort_unstable();
        self.cuts.dedup();
    }

    /// Looks at the planned brake in at most `looks` ticks of `first` to `last`.
    fn look_over(&mut self, with: &With<'_>, q: &[f64], v: &[f64], (first, last): (u32, u32), looks: u32) {
        let length = last - first;
        let count = looks.min(length + 1);
        self.ticks.clear();
        for n in 0..count {
            let at = if count > length { n } else { (length * n + (count - 1) / 2) / (count - 1) };
            self.ticks.push(first + at);
            self.look(with, q, v, first + at, n as usize);
        }
    }

    /// The most that row `r` is broken by in the ticks last looked over and, by the bound of [`Backup::between`], between them.
    fn highest(&self, r: usize) -> f64 {
        let (rows, count) = (self.allowed.len(), self.ticks.len());
        let at = |n: usize| self.breach[n * rows + r];
        let apart = |n: usize| f64::from(self.ticks[n + 1] - self.ticks[n]);
        let bend = |n: usize| {
            let slopes = (at(n + 1) - at(n)) / apart(n) - (at(n) - at(n - 1)) / apart(n - 1);
            slopes.abs() * apart(n).max(apart(n - 1))
        };
        let most = (0..count).fold(f64::NEG_INFINITY, |most, n| most.max(at(n)));
        let bends = (1..count.saturating_sub(1)).fold(0.0, |most: f64, n| most.max(bend(n)));
        let all = (1..count).all(|n| self.ticks[n] - self.ticks[n - 1] == 1);
        if all || !most.is_finite() { most } else { most + 0.5 * bends }
    }

    /// Every hard row and cone holds from tick `first` to tick `last`, between which no acceleration changes but evenly: looked at in ever more
    /// ticks until the bound on those between them settles it.
    fn stretch(&mut self, with: &With<'_>, q: &[f64], v: &[f64], (first, last): (u32, u32)) -> bool {
        let rows = self.allowed.len();
        let length = last - first;
        let speed: f64 = with.dofs.controllable.iter().map(|&i| v[i].abs()).sum();
        let way = 0.5 * speed * f64::from(length) * with.period.dt;
        let mut looks = FEWEST + (way / FAR).min(f64::from(MOST)) as u32;
        loop {
            looks = looks.min(MOST);
            let all = looks > length;
            let count = if all { length + 1 } else { looks };
            self.ticks.clear();
            for n in 0..count {
                let at = if all { n } else { (length * n + (count - 1) / 2) / (count - 1) };
                self.ticks.push(first + at);
                self.look(with, q, v, first + at, n as usize);
                let seen = &self.breach[n as usize * rows..(n as usize + 1) * rows];
                if !seen
                    .iter()
                    .zip(&self.less)
                    .zip(&self.allowed)
                    .all(|((seen, less), allowed)| holds((&(seen + less), allowed)))
                {
                    return false;
                }
            }
            if all || self.between() {
                return true;
            }
            if looks == MOST {
                return false;
            }
            looks = 2 * looks - 1;
        }
    }

    /// No row is broken between the ticks looked at: by a parabola through three of them a row rises above the higher of two ends by an
    /// eighth of its second difference, past a corner by a half, which is what is allowed for.
    fn between(&self) -> bool {
        let rows = self.allowed.len();
        let count = self.ticks.len();
        let at = |n: usize, r: usize| self.breach[n * rows + r];
        let apart = |n: usize| f64::from(self.ticks[n + 1] - self.ticks[n]);
        let bend = |n: usize, r: usize| {
            let slopes = (at(n + 1, r) - at(n, r)) / apart(n) - (at(n, r) - at(n - 1, r)) / apart(n - 1);
            slopes.abs() * apart(n).max(apart(n - 1))
        };
        (0..rows).filter(|r| at(0, *r) > f64::NEG_INFINITY).all(|r| {
            let mut before = bend(1, r);
            (0..count - 1).all(|n| {
                let after = if n + 2 < count { bend(n + 1, r) } else { before };
                let most = at(n, r).max(at(n + 1, r)) + 0.5 * before.max(after);
                before = after;
                most + self.less[r] <= self.allowed[r] || self.ticks[n + 1] - self.ticks[n] == 1
            })
        })
    }

    /// Writes the breach of each row in tick `k` of the planned brake to place `n`.
    fn look(&mut self, with: &With<'_>, q: &[f64], v: &[f64], k: u32, n: usize) {
        self.reach(with, q, v, k + 1);
        std::mem::swap(&mut self.now, &mut self.next);
        self.reach(with, q, v, k);
        std::mem::swap(&mut self.now, &mut self.next);
        let rows = self.allowed.len();
        let (now, next) = (&self.now, &self.next);
        let breach = &mut self.breach[n * rows..(n + 1) * rows];
        self.checker.breaches((&now.q, &now.v), (&next.q, &next.v), with.external, breach);
    }

    /// Writes the state after `k` ticks of the planned brake to `next`.
    fn reach(&mut self, with: &With<'_>, q: &[f64], v: &[f64], k: u32) {
        let (dt, kappa) = (with.period.dt, with.period.kappa);
        self.way.fill(0.0);
        self.next.v.copy_from_slice(v);
        for &i in &with.dofs.controllable {
            if let Some(stop) = &self.stops[i] {
                (self.way[i], self.next.v[i]) = stop.at(f64::from(k));
                continue;
            }
            let (b, speed) = (self.trial[i], v[i].abs());
            let (full, rest) = self.full[i];
            let ticks = f64::from(k).min(full);
            let mut left = if ticks == full { rest } else { speed - ticks * b * dt };
            let mut way = ticks * dt * speed - b * dt * dt * (0.5 * ticks * (ticks - 1.0) + kappa * ticks);
            if f64::from(k) > full {
                (way, left) = (way + dt * left * (1.0 - kappa), 0.0); // the last, shorter tick
            }
            (self.way[i], self.next.v[i]) = (v[i].signum() * way, v[i].signum() * left);
        }
        if with.dofs.curved {
            self.dynamics.integrate(q, &self.way, &mut self.next.q);
            return;
        }
        self.next.q.copy_from_slice(q);
        for &i in &with.dofs.controllable {
            if let Some(iq) = with.dofs.single[i] {
                self.next.q[iq] += self.way[i];
            }
        }
    }
}

/// Ticks of a brake that is so many times as late as the quickest.
fn late_by(late: f64, quickest: f64) -> f64 {
    ((late * quickest).min(SLOWEST.max(5.0 * quickest)) - 1e-9).ceil().max(1.0)
}

/// Sets of dofs, joined where they share one.
fn groups(sets: impl Iterator<Item = Vec<usize>>) -> Vec<Vec<usize>> {
    let mut groups: Vec<Vec<usize>> = Vec::new();
    for mut set in sets {
        let (joined, apart): (Vec<_>, Vec<_>) =
            groups.into_iter().partition(|group: &Vec<usize>| group.iter().any(|i| set.contains(i)));
        set.extend(joined.into_iter().flatten());
        set.sort_unstable();
        set.dedup();
        groups = apart;
        groups.push(set);
    }
    groups
}

/// A row is broken by no more than is allowed, or by rounding: not by both, or what rests at its limit would creep beyond it tick by tick.
fn holds((breach, allowed): (&f64, &f64)) -> bool {
    *breach <= ROUNDING.max(allowed * (1.0 + NOISE) + NOISE)
}

/// What a brake is planned with.
pub(crate) struct With<'a> {
    pub(crate) limits: &'a LimitSet,
    pub(crate) dofs: &'a Dofs,
    pub(crate) period: &'a Period,
    pub(crate) external: &'a [f64],
    /// Dofs that may not be able to stop before their limit: then they brake as hard as they may (nv).
    pub(crate) outside: &'a [bool],
}
