//! The physics steps of a period, one after the other.

use crate::drive::{Drive, Held};
use crate::jerk::Brake;
use crate::period_dynamics::solve;
use crate::viability::{Dof, too_fast};
use crate::{Dynamics, LimitSet, Model, Period, PeriodDynamics};

/// What commands that are held for a period lead to where the plant makes several Euler steps of it, and which commands lead where.
///
/// [`PeriodDynamics`] reckons with the forces of a constant acceleration, on average over the period. A held motor force makes none:
/// weight, Coriolis forces and dampers change as the robot moves, and a strong damper passes that on to the velocity within a physics step.
/// The drive of a target pushes less the nearer it comes. Here the steps are made as the plant makes them (`tau_s` is the length of one):
///
/// ```text
///     v <- v + tau_s a(q, v, tau),   q <- q (+) tau_s v
/// ```
///
/// [`PhysicsSteps::drive`] looks for the commands by Newton's method over the whole period (single shooting; Stoer and Bulirsch,
/// *Numerical Analysis*, 7.3), whose slopes Broyden's rule keeps. One command decides velocity and position alike: the velocity is what is asked
/// for, unless a step would end beyond a position limit or the last one too fast to stop. Nothing allocates after [`PhysicsSteps::new`]. Units: rad
/// or m, s, N·m or N.
pub struct PhysicsSteps {
    /// Of one physics step.
    step: PeriodDynamics,
    /// The same by the articulated-body algorithm alone, where no joint rubs: of the robot whose joints have `tau_s D` more inertia, `D` that of
    /// joints and drives together.
    quick: Option<Dynamics>,
    period: Period,
    /// Configuration index of each dof that is a joint of its own.
    single: Vec<Option<usize>>,
    /// Dofs whose motion follows from forces, and where among them those are whose command is looked for: a force or the target of a drive.
    free: Vec<usize>,
    pushed: Vec<usize>,
    /// By dof (nv).
    drives: Vec<Drive>,
    ranges: Vec<[f64; 2]>,
    /// See [`reserve`].
    reserve: f64,
    held: Vec<Held>,
    /// Where the steps have led, one after the other, from where they began ((sub_steps + 1) x nq, row-major), with the first and the last velocity (nv).
    path: Vec<f64>,
    begun: Vec<f64>,
    v: Vec<f64>,
    a: Vec<f64>,
    moved: Vec<f64>,
    slopes: Slopes,
    /// Accelerations that are asked for (nv).
    wanted: Vec<f64>,
    /// Pushed dofs whose command has no more room.
    full: Vec<bool>,
    /// The commands found last are those that were given out.
    found: bool,
    /// What is missing of the velocity of each pushed dof, and by how much its command changes.
    missing: Vec<f64>,
    before: Vec<f64>,
    change: Vec<f64>,
    /// The command of each pushed dof, the largest force it may ask for, and the ends that this gives the command.
    command: Vec<f64>,
    most: Vec<f64>,
    ends: Vec<[f64; 2]>,
}

/// How the velocities at the end of a period grow with the commands that are held, and scratch for it.
#[derive(Default)]
struct Slopes {
    /// Pushed x pushed, row-major: velocity for a change of command.
    velocity: Vec<f64>,
    mass: Vec<f64>,
    inverse: Vec<f64>,
    /// Free x pushed.
    q: Vec<f64>,
    v: Vec<f64>,
    push: Vec<f64>,
    row: Vec<f64>,
}

/// What may be missing of an acceleration [rad/s² or m/s²].
const MISSING: f64 = 1e-9;
/// How far beyond its limit a step may end without more being asked for [rad or m], and how often more is asked for in a period.
const BEYOND: f64 = 1e-12;
const RETREATS: usize = 3;
/// How much further than in this period the steps of the next ones may lead.
const FURTHER: f64 = 1.5;
/// By which share of it a drive may push beyond its largest force.
const TOO_HARD: f64 = 1e-9;
/// Rounds before the best commands found are taken; three are the rule, and some ten where joints rub.
const ROUNDS: usize = 80;
/// Choices of the commands that go to their ends, for each command.
const CHOICES: usize = 4;
/// How often slopes are measured, and how often a change by them is halved.
const MEASURED: usize = 6;
const HALVINGS: usize = 10;
/// A joint is held back where this is missing of its acceleration, as a share of it, or in [rad/s² or m/s²].
const HELD_BACK: f64 = 1e-7;
/// By which share of a command slopes are measured.
const NEAR: f64 = 1e-5;

impl PhysicsSteps {
    /// For motors on the dofs `driven` of `model`, whose commands `drives` (nv) names; targets stay within `ranges` (nv). The dofs `follow` have
    /// the accelerations that they are given, whatever it takes, and none where no command gives one; all others follow from the forces. `None` where a
    /// period has a single physics step or none: [`PeriodDynamics`] is exact for the former.
    pub fn new(
        model: &Model,
        (drives, ranges): (&[Drive], &[[f64; 2]]),
        driven: &[usize],
        follow: &[usize],
        period: Period,
    ) -> Option<PhysicsSteps> {
        if period.sub_steps < 2 {
            return None;
        }
        let nv = model.nv();
        let free: Vec<usize> = (0..nv).filter(|i| !follow.contains(i)).collect();
        let pushed: Vec<usize> = (0..free.len()).filter(|r| driven.contains(&free[*r])).collect();
        let (n, m) = (free.len(), pushed.len());
        let single = (0..nv).map(|i| {
            let joint = model.joint_of_dof(i);
            (joint.nq == 1 && joint.nv == 1).then_some(joint.idx_q)
        });
        let zero = |len: usize| vec![0.0; len];
        let slopes = Slopes {
            velocity: zero(m * m),
            mass: zero(n * n),
            inverse: zero(n * n),
            q: zero(n * m),
            v: zero(n * m),
            push: zero(n * m),
            row: zero(m),
        };
        Some(PhysicsSteps {
            step: PeriodDynamics::new(model, driven, Period::new(period.tau, 1)),
            quick: quick(model, period.tau),
            period,
            single: single.collect(),
            free,
            pushed,
            drives: drives.to_vec(),
            ranges: ranges.to_vec(),
            reserve: reserve(drives, &period),
            held: vec![Held::Force(0.0); nv],
            path: model.neutral().repeat(period.sub_steps as usize + 1),
            begun: zero(nv),
            v: zero(nv),
            a: zero(nv),
            moved: zero(nv),
            wanted: zero(nv),
            full: vec![false; m],
            found: false,
            slopes,
            missing: zero(m),
            before: zero(m),
            change: zero(m),
            command: zero(m),
            most: zero(m),
            ends: vec![[0.0; 2]; m],
        })
    }

    /// The mean acceleration (nv) over a period that begins at `q` (nq), `v` (nv) with these `commands` (nv; nothing is read where no motor is) under
    /// the generalised forces `external` (nv). `most` (nv) are the largest forces. NaN where the equations have no solution.
    pub fn accelerate(
        &mut self,
        (q, v): (&[f64], &[f64]),
        external: &[f64],
        (commands, most): (&[f64], &[f64]),
        a: &mut [f64],
    ) {
        for (i, held) in self.held.iter_mut().enumerate() {
            let at = self.single[i].map_or(0.0, |iq| q[iq]);
            *held = match self.drives[i] {
                Drive::Effort => Held::Acceleration(0.0), // followed: of those that are free the force is set below
                drive => drive.held(&self.period, at, v[i], commands[i]),
            };
        }
        self.free.iter().for_each(|&i| self.held[i] = Held::Force(0.0));
        for (k, &r) in self.pushed.iter().enumerate() {
            let i = self.free[r];
            (self.command[k], self.most[k]) = (commands[i], most[i]);
        }
        self.walk(q, v, external);
        a.iter_mut().zip(self.v.iter().zip(v)).for_each(|(a, (end, v))| *a = (end - v) / self.period.dt);
    }

    /// Whether the steps that were made last took a joint beyond its position limit, further beyond it than it was, or to where it may not be able
    /// to stop in front of it, or asked a drive for more than its largest force on the way.
    pub fn went_beyond(&self, limits: &LimitSet) -> bool {
        self.pushed.iter().any(|&r| self.beyond(self.free[r], limits).is_some()) || self.asks_too_much()
    }

    /// Whether a drive was asked for more than its largest force in one of the steps.
    fn asks_too_much(&self) -> bool {
        (0..self.pushed.len()).any(|k| {
            let Drive::Pd { stiffness, .. } = self.drives[self.free[self.pushed[k]]] else { return false };
            let (at, [low, high]) = (self.command[k], self.ends[k]);
            stiffness * (low - at).max(at - high) > TOO_HARD * self.most[k]
        })
    }

    /// By how much less the joint of dof `i` would have had to accelerate [rad/s² or m/s²] where a step ended beyond its limit or further beyond it
    /// than it began, or the last one too fast to stop, and the sign of the way back.
    ///
    /// A constant acceleration moves the joint by `tau_s^2 j (j + 1) / 2` of itself in `j` steps. Where the steps led further than a constant acceleration
    /// to the same velocity leads, by `T f`, each period of a brake may too, and by more as the robot moves. A joint that turns round within a period
    /// is led further than where it ends. So the joint ends in the set
    ///
    /// ```text
    ///     (v + e)^2 <= 2 A_b d,    e = 1.5 f + r A_b T
    /// ```
    ///
    /// or, of hard jerk, in that from which its own brake stops, with no more of `r` than the jerk changes in a period.
    fn beyond(&self, i: usize, limits: &LimitSet) -> Option<[f64; 2]> {
        let (iq, nq, p) = (self.single[i]?, self.nq(), &self.period);
        let (begun, v) = (self.path[iq], self.v[i]);
        let (high, low) = (limits.q_upper[i].max(begun), limits.q_lower[i].min(begun));
        if high.is_infinite() && low.is_infinite() || limits.acceleration[i].is_infinite() {
            return None;
        }
        let mut most = [0.0, 0.0];
        for (j, q) in self.path.iter().skip(iq).step_by(nq).enumerate().skip(1) {
            let (by, sign) = if q - high > low - q { (q - high, -1.0) } else { (low - q, 1.0) };
            let less = by / (0.5 * p.tau * p.tau * (j * (j + 1)) as f64);
            if by > BEYOND && less > most[0] {
                most = [less, sign];
            }
        }
        let dof = Dof::of(limits, i);
        let smooth = dof.jerk.is_finite().then(|| Brake::of(&dof, p));
        let braking = smooth.map_or_else(|| dof.braking(p), |brake| brake.gentlest());
        let q = self.path[self.path.len() - nq + iq];
        let a = (v - self.begun[i]) / p.dt;
        let further = (q - begun) / p.dt - self.begun[i] - p.kappa * (v - self.begun[i]);
        for (d, v, further, sign) in [(high - q, v, further, -1.0), (q - low, -v, -further, 1.0)] {
            let e = FURTHER * further.max(0.0) + self.reserve * braking * p.dt;
            let less = match smooth {
                Some(brake) => brake.too_fast(d, v + e, -sign * a),
                None => too_fast(d, v + e, braking, p),
            };
            if less > most[0] {
                most = [less, sign];
            }
        }
        (most[0] > 0.0).then_some(most)
    }

    fn nq(&self) -> usize {
        self.path.len() / (self.period.sub_steps as usize + 1)
    }

    /// Changes the `commands` (nv), which lead to the accelerations `a` (nv) about, into those that lead to them, within `limits`. `most` (nv)
    /// are the largest forces. What is given up for a position leaves the dofs between `accelerations` (nv). Commands that are no numbers stay, and so do
    /// those that nothing nearer was found for.
    pub fn drive(
        &mut self,
        (q, v): (&[f64], &[f64]),
        external: &[f64],
        a: &[f64],
        (commands, most): (&mut [f64], &[f64]),
        (limits, accelerations): (&LimitSet, &[[f64; 2]]),
    ) {
        self.found = false;
        if commands.iter().any(|command| !command.is_finite()) {
            return;
        }
        self.full.fill(false);
        self.wanted.copy_from_slice(a);
        self.held.iter_mut().zip(a).for_each(|(held, a)| *held = Held::Acceleration(*a));
        self.free.iter().for_each(|&i| self.held[i] = Held::Force(0.0));
        for (k, &r) in self.pushed.iter().enumerate() {
            let i = self.free[r];
            (self.command[k], self.most[k]) = (commands[i], most[i]);
            self.ends[k] = [-most[i], most[i]];
        }
        if self.pushed.iter().any(|&r| matches!(self.drives[self.free[r]], Drive::Pd { .. })) {
            self.walk(q, v, external);
        }
        self.command
            .iter_mut()
            .zip(&self.ends)
            .for_each(|(command, [low, high])| *command = command.clamp(*low, *high));
        self.try_commands(q, v, external);
        let begun = self.missing.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
        if !amiss(&self.missing, &self.full).is_finite() {
            return;
        }
        let (mut has_slopes, mut retreats, mut failed, mut measured, mut halves) = (false, 0, 0, 0, false);
        for _ in 0..ROUNDS {
            if self.left() <= MISSING && !self.asks_too_much() {
                if retreats == RETREATS || !self.retreat(limits, accelerations) {
                    break;
                }
                retreats += 1;
                self.miss(v);
            }
            if !has_slopes {
                self.find_slopes(q, v, external);
                has_slopes = true;
            }
            if halves && failed > 0 {
                self.change.iter_mut().for_each(|change| *change *= 0.5);
            } else {
                self.choose_change();
            }
            self.before.copy_from_slice(&self.missing);
            self.command.iter_mut().zip(&self.change).for_each(|(command, change)| *command += change);
            self.try_commands(q, v, external);
            // At its end, but not because more was needed.
            for (k, full) in self.full.iter_mut().enumerate() {
                *full &= side(self.command[k], self.ends[k]) * self.missing[k] >= 0.0;
            }
            let (was, is) = (amiss(&self.before, &self.full), amiss(&self.missing, &self.full));
            if is < was || !halves {
                self.turn_slopes();
            }
            if is < was || is.sqrt() <= MISSING * self.period.dt {
                (failed, halves) = (0, false);
                continue;
            }
            // No nearer: from where it was, once by what this has shown of the slopes, then a part of the way that measured ones show.
            self.command.iter_mut().zip(&self.change).for_each(|(command, change)| *command -= change);
            self.missing.copy_from_slice(&self.before);
            failed += 1;
            if failed > if halves { HALVINGS } else { 1 } {
                if measured == MEASURED {
                    break;
                }
                self.measure_slopes(q, v, external, measured % 2 == 1);
                (measured, failed, halves) = (measured + 1, 0, true);
            }
        }
        // A command that has come to its end is missed by as much, whatever the others do.
        let is_near = |x: f64| x.abs() <= begun.max(MISSING * self.period.dt);
        self.found = with_room(&self.missing, &self.full).all(is_near) || retreats > 0;
        if self.found {
            for (k, &r) in self.pushed.iter().enumerate() {
                commands[self.free[r]] = self.command[k];
            }
        }
    }

    /// Narrows the ends `within` (nv) of the velocities at the end of the period [rad/s or m/s] to where the commands that [`PhysicsSteps::drive`] found
    /// for `a` (nv) lead from `v` (nv): of joints that were held back in front of a position limit, and of those whose command came to its end.
    /// Whether there are any.
    pub fn hold_back(&self, v: &[f64], a: &[f64], within: &mut [[f64; 2]]) -> bool {
        let (mut any, dt) = (false, self.period.dt);
        for (k, &r) in self.pushed.iter().enumerate().filter(|_| self.found) {
            let i = self.free[r];
            let by = dt * (self.wanted[i] - a[i]) - self.missing[k];
            let is_held = self.full[k] || self.wanted[i] != a[i];
            if !is_held || by.is_nan() || by.abs() <= HELD_BACK * dt * (1.0 + a[i].abs()) {
                continue;
            }
            let (to, [least, most]) = (v[i] + dt * a[i] + by, &mut within[i]);
            match by < 0.0 {
                true => *most = most.min(to),
                false => *least = least.max(to),
            }
            any = true;
        }
        any
    }

    /// Makes the steps with the commands, and writes what is missing.
    fn try_commands(&mut self, q: &[f64], v: &[f64], external: &[f64]) {
        self.walk(q, v, external);
        self.miss(v);
    }

    /// Asks for less acceleration where a joint went too far or ended too fast; whether it asks anywhere.
    fn retreat(&mut self, limits: &LimitSet, accelerations: &[[f64; 2]]) -> bool {
        let mut asks = false;
        for r in 0..self.pushed.len() {
            let i = self.free[self.pushed[r]];
            if let Some([less, sign]) = self.beyond(i, limits) {
                let [least, most] = accelerations[i];
                let to = (self.wanted[i] + sign * less).clamp(least, most);
                asks |= (to - self.wanted[i]) * sign > 0.0;
                self.wanted[i] = to;
            }
        }
        asks
    }

    /// Makes the steps with the commands and what is held beside them.
    fn walk(&mut self, q: &[f64], v: &[f64], external: &[f64]) {
        let (tau, nq) = (self.period.tau, self.nq());
        self.path[..nq].copy_from_slice(q);
        self.v.copy_from_slice(v);
        self.begun.copy_from_slice(v);
        let are_forces = self.free.len() == v.len();
        for j in 0..self.period.sub_steps as usize {
            self.push(j);
            let (from, to) = self.path[j * nq..(j + 2) * nq].split_at_mut(nq);
            if let (Some(quick), true) = (&mut self.quick, are_forces) {
                quick.passive(from, &self.v, &mut self.moved);
                for (i, force) in self.moved.iter_mut().enumerate() {
                    *force += external[i] + if let Held::Force(tau) = self.held[i] { tau } else { 0.0 };
                }
                quick.aba(from, &self.v, &self.moved, &mut self.a);
            } else {
                self.step.update(from, &self.v, external);
                self.step.accelerate(&self.held, &mut self.a);
            }
            for (i, a) in self.a.iter().enumerate() {
                self.v[i] += tau * a;
                self.moved[i] = tau * self.v[i];
            }
            if self.single.iter().any(Option::is_none) {
                self.step.integrate(from, &self.moved, to);
            }
            for (iq, moved) in self.single.iter().zip(&self.moved) {
                if let Some(iq) = *iq {
                    to[iq] = from[iq] + moved;
                }
            }
        }
    }

    /// The forces of the commands in physics step `j`. The ends of a target are such that its drive can push as hard in all steps so far, where
    /// there are such targets.
    fn push(&mut self, j: usize) {
        let nq = self.nq();
        for (k, &r) in self.pushed.iter().enumerate() {
            let i = self.free[r];
            let (command, most) = (self.command[k], self.most[k]);
            let force = match (self.drives[i], self.single[i]) {
                (Drive::Pd { stiffness, damping }, Some(iq)) => {
                    let (q, damper) = (self.path[j * nq + iq], damping * self.v[i]);
                    let [low, high] = [-most, most].map(|most| q + (most + damper) / stiffness);
                    let [least, largest] = if j == 0 { self.ranges[i] } else { self.ends[k] };
                    let both = [low.clamp(least, largest), high.clamp(least, largest)];
                    if j == 0 || both[0] < both[1] {
                        self.ends[k] = both;
                    }
                    stiffness * (command - q) - damper
                }
                _ => {
                    self.ends[k] = [-most, most];
                    command
                }
            };
            self.held[i] = Held::Force(force);
        }
    }

    /// Writes what is missing of the velocities.
    fn miss(&mut self, v: &[f64]) {
        for (k, &r) in self.pushed.iter().enumerate() {
            let i = self.free[r];
            self.missing[k] = v[i] + self.period.dt * self.wanted[i] - self.v[i];
        }
    }

    /// The largest of it where a command has room, as an acceleration.
    fn left(&self) -> f64 {
        with_room(&self.missing, &self.full).fold(0.0, |most: f64, x| most.max(x.abs())) / self.period.dt
    }

    /// The slopes for a robot whose mass and dampers stay what they are at `q`, `v`, and whose joints do not rub.
    fn find_slopes(&mut self, q: &[f64], v: &[f64], external: &[f64]) {
        let (n, m, nv, tau) = (self.free.len(), self.pushed.len(), v.len(), self.period.tau);
        self.step.update(q, v, external);
        let (s, model) = (&mut self.slopes, self.step.model());
        s.inverse.fill(0.0);
        for r in 0..n {
            s.inverse[r * n + r] = 1.0;
            for c in 0..n {
                s.mass[r * n + c] = self.step.rows()[self.free[r] * nv + self.free[c]];
            }
        }
        solve(n, n, &mut s.mass, &mut s.inverse);
        s.q.fill(0.0);
        s.v.fill(0.0);
        for _ in 0..self.period.sub_steps {
            for (r, &i) in self.free.iter().enumerate() {
                let (mut k, mut d, mut of_command) = (model.stiffness()[i], model.damping()[i], 1.0);
                if let (Drive::Pd { stiffness, damping }, true) = (self.drives[i], self.pushed.contains(&r)) {
                    (k, d, of_command) = (k + stiffness, d + damping, stiffness);
                }
                for c in 0..m {
                    let of_command = if self.pushed[c] == r { of_command } else { 0.0 };
                    s.push[r * m + c] = of_command - k * s.q[r * m + c] - d * s.v[r * m + c];
                }
            }
            for r in 0..n {
                for c in 0..m {
                    let a: f64 = (0..n).map(|j| s.inverse[r * n + j] * s.push[j * m + c]).sum();
                    s.v[r * m + c] += tau * a;
                    s.q[r * m + c] += tau * s.v[r * m + c];
                }
            }
        }
        for (k, &r) in self.pushed.iter().enumerate() {
            s.velocity[k * m..(k + 1) * m].copy_from_slice(&s.v[r * m..(r + 1) * m]);
        }
    }

    /// The slopes where the commands are, by differences to smaller or to `larger` ones: joints that rub have others while they stick.
    fn measure_slopes(&mut self, q: &[f64], v: &[f64], external: &[f64], larger: bool) {
        let m = self.pushed.len();
        for c in 0..m {
            let at = self.command[c];
            let by = (1.0 + at.abs()) * if (at > 0.0) == larger { NEAR } else { -NEAR };
            self.command[c] = at + by;
            self.try_commands(q, v, external);
            for r in 0..m {
                let slope = (self.before[r] - self.missing[r]) / by;
                if slope.is_finite() {
                    self.slopes.velocity[r * m + c] = slope;
                }
            }
            self.command[c] = at;
        }
        self.missing.copy_from_slice(&self.before);
    }

    /// Broyden's rule: afterwards what the last change of command did would have been foreseen.
    fn turn_slopes(&mut self) {
        let (m, s) = (self.pushed.len(), &mut self.slopes);
        let size: f64 = self.change.iter().map(|x| x * x).sum();
        let is_known = size > 0.0 && self.missing.iter().all(|x| x.is_finite());
        for r in 0..m {
            let row = &mut s.velocity[r * m..(r + 1) * m];
            let foreseen: f64 = row.iter().zip(&self.change).map(|(s, x)| s * x).sum();
            // the velocities grew by what is missing no more
            let by = (self.before[r] - self.missing[r] - foreseen) / size;
            for (slope, change) in row.iter_mut().zip(&self.change) {
                // where it led nowhere the next change is to be smaller
                *slope = if is_known { *slope + by * change } else { 4.0 * *slope };
            }
        }
    }

    /// The change of command that makes up for what is missing. A command that would go beyond its end goes there, as long as more is missing of its
    /// velocity in that direction, and the others make up for what that does to them.
    fn choose_change(&mut self) {
        let (m, s) = (self.pushed.len(), &mut self.slopes);
        self.full.fill(false);
        self.change.fill(0.0);
        for _ in 0..CHOICES * m {
            for r in 0..m {
                let by_full =
                    (0..m).filter(|c| self.full[*c]).map(|c| s.velocity[r * m + c] * self.change[c]);
                s.row[r] = if self.full[r] { self.change[r] } else { self.missing[r] - by_full.sum::<f64>() };
                for c in 0..m {
                    let of_one = f64::from(u8::from(r == c));
                    let stays = self.full[r] || self.full[c];
                    s.push[r * m + c] = if stays { of_one } else { s.velocity[r * m + c] };
                }
            }
            solve(m, 1, &mut s.push[..m * m], &mut s.row);
            let mut is_other = false;
            for k in 0..m {
                let (to, [low, high]) = (self.command[k] + s.row[k], self.ends[k]);
                if !self.full[k] && (to > high || to < low) {
                    (self.full[k], is_other) = (true, true);
                    s.row[k] = to.clamp(low, high) - self.command[k];
                }
                self.change[k] = if s.row[k].is_finite() { s.row[k] } else { 0.0 };
            }
            if is_other {
                continue;
            }
            let too_far = |k: &usize| {
                let slopes = &s.velocity[k * m..(k + 1) * m];
                let grows: f64 = slopes.iter().zip(&self.change).map(|(slope, change)| slope * change).sum();
                (self.missing[*k] - grows) * side(self.command[*k] + self.change[*k], self.ends[*k]) < 0.0
            };
            let Some(k) = (0..m).find(|k| self.full[*k] && too_far(k)) else { return };
            self.full[k] = false;
        }
    }
}

/// By how much further than in a period a brake may lead in the next ones, as a share of the velocity that a period of braking takes away. Forces
/// change with the motion over a long period, and those of a drive that is held on its target over any.
fn reserve(drives: &[Drive], period: &Period) -> f64 {
    let has_targets = drives.iter().any(|drive| matches!(drive, Drive::Pd { .. }));
    if has_targets { 0.5 } else { ((period.dt - 0.005) / 0.03).clamp(0.0, 0.5) }
}

/// Above 0 in the upper half between two ends, below in the lower one.
fn side(command: f64, [low, high]: [f64; 2]) -> f64 {
    command - 0.5 * (low + high)
}

/// What is missing of the dofs whose command has room.
fn with_room<'a>(missing: &'a [f64], full: &'a [bool]) -> impl Iterator<Item = f64> + 'a {
    missing.iter().zip(full).map(|(missing, full)| if *full { 0.0 } else { *missing })
}

/// The sum of its squares; NaN where a velocity is.
fn amiss(missing: &[f64], full: &[bool]) -> f64 {
    with_room(missing, full).map(|x| x * x).sum()
}

fn quick(model: &Model, tau: f64) -> Option<Dynamics> {
    if model.friction().iter().any(|f| *f > 0.0) {
        return None;
    }
    let mut description = model.description().clone();
    for joint in description.bodies.iter_mut().flat_map(|body| &mut body.joints) {
        joint.armature += tau * (joint.damping + joint.drive_damping);
    }
    Model::from_description(description).ok().map(|model| Dynamics::new(&model))
}
