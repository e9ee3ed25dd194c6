//! The independent checker evaluates the limits themselves at a next state. It shares no code with the projector's
//! assembly: no boxes, no rows; the motor force comes from inverse dynamics. At which moment of the period that
//! force is taken ([`Period::lag`], [`Period::resistance`]), and by how much a drive's changes within it, is one definition for both, which tests compare
//! with MuJoCo.

use crate::ledger::Counts;
use crate::row::{Cone, Motion, Needs, Previous, Rows};
use crate::viability::{Kind, Period, whole_way};
use crate::{Consistency, Dynamics, Kinematics, Limit, LimitError, LimitSet, Model};

/// A violation counts above this share of its limit (of 1 where the limit is smaller).
pub const TOLERANCE: f64 = 1e-9;

/// What a next state violates.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Verdict {
    /// Number of violations by kind.
    pub counts: Counts,
    /// The largest, as a share of its limit.
    pub worst: f64,
    /// Row of the largest, as in [`ActiveRow`](crate::ActiveRow).
    pub worst_row: usize,
}

impl Verdict {
    /// True when every limit holds.
    pub fn accepts(&self) -> bool {
        self.counts.total() == 0
    }

    fn see(&mut self, kind: Kind, row: usize, value: f64, limit: f64) {
        if limit == f64::INFINITY && !value.is_nan() {
            return;
        }
        let excess = (value - limit) / limit.abs().max(1.0);
        if excess.is_nan() || excess > TOLERANCE {
            self.counts.add(kind);
            if excess.is_nan() || excess > self.worst {
                (self.worst, self.worst_row) = (excess, row);
            }
        }
    }
}

/// What rows and cones are checked for.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Meant {
    /// What they ask of a target, with the tick before.
    Asked,
    /// What they are there to keep.
    Kept,
}

/// What rows and cones read of a motion, reckoned anew for each.
struct Reckoned {
    dynamics: Dynamics,
    kinematics: Kinematics,
    period: Period,
    /// What of it some row or cone needs; the rest is left as it was.
    needs: Needs,
    /// Acceleration and motor forces (nv).
    a: Vec<f64>,
    tau: Vec<f64>,
    /// Mass matrix (nv x nv).
    mass: Vec<f64>,
}

/// Scratch and constants of the checker.
pub struct Checker {
    reckoned: Reckoned,
    limits: LimitSet,
    dofs: Vec<(usize, usize)>,
    period: Period,
    consistency: Consistency,
    /// Joints stop in whole periods ([`Checker::stop_in_whole_periods`]).
    whole: bool,
    rows: Vec<RowsOf>,
    cones: Vec<ConeOf>,
    excess: Vec<f64>,
    /// The same of what rows ask for, where no brake keeps them.
    asked: Vec<f64>,
    /// Largest speed [rad/s or m/s] and how fast a dof may speed up [rad/s² or m/s²] (nv), where limits were moved.
    speed: Vec<f64>,
    faster: Vec<f64>,
    moved: bool,
    /// By how much what each hard row keeps may be broken on the way to where it was moved ([`Checker::hard`]).
    allowed: Vec<f64>,
}

/// Rows of one limit: which one, whether they are hard and switched on, their first row's number.
struct RowsOf {
    rows: Box<dyn Rows>,
    limit: usize,
    hard: bool,
    enabled: bool,
    first: usize,
    count: usize,
    /// Where what may be put elsewhere was built, and whether it is elsewhere.
    built: Vec<[f64; 6]>,
    elsewhere: bool,
    /// How much further inside than it was built it lies.
    inset: f64,
}

struct ConeOf {
    cone: Box<dyn Cone>,
    limit: usize,
    hard: bool,
    enabled: bool,
    row: usize,
    /// Share of its size that is asked for, and that is in force on the way there.
    share: f64,
    in_force: f64,
}

impl ConeOf {
    /// [`Cone::excess`] of the share that is in force.
    fn excess(&mut self, motion: &mut Motion<'_>) -> f64 {
        self.cone.excess(motion) + (1.0 - self.in_force)
    }

    /// [`Cone::breach`] of the share that is asked for.
    fn breach(&mut self, motion: &mut Motion<'_>) -> f64 {
        self.cone.breach(motion) + (1.0 - self.share)
    }
}

impl Checker {
    /// A checker of `limits` on the `controllable` dofs.
    ///
    /// # Errors
    /// Those of the limits.
    pub fn new(
        model: &Model,
        limits: &[Box<dyn Limit>],
        controllable: &[usize],
        period: Period,
        consistency: Consistency,
    ) -> Result<Checker, LimitError> {
        let zero = || vec![0.0; model.nv()];
        let (mut rows, mut cones, mut first) = (Vec::new(), Vec::new(), model.nv());
        for (limit, l) in limits.iter().enumerate() {
            if let Some(r) = l.rows(model, controllable)? {
                let (hard, count) = (l.soft().is_none(), r.sizes().len());
                let built: Vec<_> = r.places().iter().map(|place| place.numbers).collect();
                let (elsewhere, inset) = (false, 0.0);
                let block =
                    RowsOf { rows: r, limit, hard, enabled: true, first, count, built, elsewhere, inset };
                rows.push(block);
                first += count;
            }
        }
        for (limit, l) in limits.iter().enumerate() {
            if let Some(cone) = l.cone(model, controllable)? {
                let (hard, enabled, share, in_force) = (l.soft().is_none(), true, 1.0, 1.0);
                cones.push(ConeOf { cone, limit, hard, enabled, row: first, share, in_force });
                first += 1;
            }
        }
        let needs = rows.iter().map(|r| r.rows.needs()).chain(cones.iter().map(|c| c.cone.needs()));
        let reckoned = Reckoned {
            dynamics: Dynamics::new(model),
            kinematics: Kinematics::new(model),
            period,
            needs: needs.fold(Needs::default(), Needs::and),
            a: zero(),
            tau: zero(),
            mass: vec![0.0; model.nv() * model.nv()],
        };
        let limits = LimitSet::collect(model, limits, controllable)?;
        rows.iter_mut().try_for_each(|r| r.rows.fit(&limits))?;
        let hard_rows = rows.iter().filter(|r| r.hard).map(|r| r.count).sum::<usize>();
        Ok(Checker {
            speed: vec![f64::INFINITY; model.nv()],
            faster: vec![f64::INFINITY; model.nv()],
            moved: false,
            allowed: vec![0.0; hard_rows + cones.iter().filter(|c| c.hard).count()],
            excess: vec![0.0; rows.iter().map(|r| r.count).max().unwrap_or(0)],
            asked: vec![0.0; rows.iter().map(|r| r.count).max().unwrap_or(0)],
            rows,
            cones,
            reckoned,
            limits,
            dofs: controllable.iter().map(|i| (*i, model.joint_of_dof(*i).idx_q)).collect(),
            period,
            consistency,
            whole: false,
        })
    }

    /// Joints stop as a stored brake has them stop: by whole periods of one deceleration and a shorter last one.
    pub(crate) fn stop_in_whole_periods(&mut self) {
        self.whole = true;
    }

    /// Checks going from (`q`, `v`) to (`q_next`, `v_next`) in one period; configurations nq, velocities nv. `external`:
    /// generalised forces on the robot beside its motors (nv).
    pub fn check(
        &mut self,
        q: &[f64],
        v: &[f64],
        q_next: &[f64],
        v_next: &[f64],
        external: &[f64],
        previous: Option<Previous<'_>>,
    ) -> Verdict {
        self.examine((q, v), (q_next, v_next), external, previous, Meant::Asked)
    }

    /// The limits of single joints.
    fn boxes(
        &mut self,
        verdict: &mut Verdict,
        (q, v): (&[f64], &[f64]),
        (q_next, v_next): (&[f64], &[f64]),
        previous: Option<Previous<'_>>,
    ) {
        for k in 0..self.dofs.len() {
            let (i, iq) = self.dofs[k];
            let a = (v_next[i] - v[i]) / self.period.dt;
            verdict.see(Kind::Velocity, i, v_next[i].abs(), self.limits.velocity[i]);
            if self.moved {
                let faster = speeding_up(v[i], v_next[i]) / self.period.dt;
                verdict.see(Kind::Velocity, i, v_next[i].abs(), self.speed[i]);
                verdict.see(Kind::Acceleration, i, faster, self.faster[i]);
            }
            verdict.see(Kind::Acceleration, i, a.abs(), self.limits.acceleration[i]);
            if self.limits.jerk[i].is_finite() {
                let unknown = if v[i] == 0.0 { 0.0 } else { a };
                let most = self.limits.acceleration[i]; // what is beyond it counts as it
                let before = previous.map_or(unknown, |previous| previous.acceleration[i].clamp(-most, most));
                verdict.see(Kind::Jerk, i, (a - before).abs() / self.period.dt, self.limits.jerk[i]);
            }
            if self.limits.has_position(i) {
                self.positions(i, (q[iq], v[i]), (q_next[iq], v_next[i]), verdict);
            }
            self.profile(i, q_next[iq], v_next[i], verdict);
            if self.limits.locked[i] && self.limits.jerk[i].is_infinite() {
                let slower = v[i].abs() - self.limits.braking[i] * self.period.dt;
                verdict.see(Kind::Locked, i, v_next[i].abs(), slower.max(0.0));
            }
        }
    }

    /// Checks the step of a brake like [`Checker::check`], its rows and cones for what they keep ([`Rows::breach`]) and no more.
    pub fn check_brake(
        &mut self,
        q: &[f64],
        v: &[f64],
        q_next: &[f64],
        v_next: &[f64],
        external: &[f64],
        previous: Option<Previous<'_>>,
    ) -> Verdict {
        self.examine((q, v), (q_next, v_next), external, previous, Meant::Kept)
    }

    /// Number of hard rows and cones.
    pub(crate) fn hard(&self) -> usize {
        self.hard_rows() + self.cones.iter().filter(|c| c.hard).count()
    }

    /// Number of hard rows, which come first.
    pub(crate) fn hard_rows(&self) -> usize {
        self.rows.iter().filter(|r| r.hard).map(|r| r.count).sum()
    }

    /// Writes the breach of each hard row, then of each hard cone ([`Checker::hard`]); minus infinity where it is switched off.
    pub(crate) fn breaches(
        &mut self,
        now: (&[f64], &[f64]),
        next: (&[f64], &[f64]),
        external: &[f64],
        out: &mut [f64],
    ) {
        self.breaches_with(now, next, external, None, out);
    }

    /// The same with the motor forces of the motion (nv), where another checker of the same limits has found them already.
    pub(crate) fn breaches_with(
        &mut self,
        now: (&[f64], &[f64]),
        next: (&[f64], &[f64]),
        external: &[f64],
        torque: Option<&[f64]>,
        out: &mut [f64],
    ) {
        let mut motion = self.reckoned.motion(now, next, external, (None, torque));
        out.fill(f64::NEG_INFINITY);
        let mut first = 0;
        for block in self.rows.iter_mut().filter(|r| r.hard) {
            if block.enabled {
                block.rows.breach(&mut motion, &mut out[first..first + block.count]);
            }
            first += block.count;
        }
        for block in self.cones.iter_mut().filter(|c| c.hard) {
            if block.enabled {
                out[first] = block.breach(&mut motion);
            }
            first += 1;
        }
    }

    /// Kinds of the hard rows, then of the hard cones.
    pub(crate) fn hard_kinds(&self) -> Vec<Kind> {
        let rows = self.rows.iter().filter(|r| r.hard).flat_map(|r| vec![r.rows.kind(); r.count]);
        rows.chain(self.cones.iter().filter(|c| c.hard).map(|c| c.cone.kind())).collect()
    }

    /// By how much less than they keep the hard rows, then the hard cones, are verified for in a brake ([`Rows::reserves`]).
    pub(crate) fn hard_reserves(&self) -> Vec<f64> {
        let rows = self.rows.iter().filter(|r| r.hard).flat_map(|r| r.rows.reserves());
        rows.chain(self.cones.iter().filter(|c| c.hard).map(|_| 0.0)).collect()
    }

    /// Whether hard rows can be broken by joints that brake as they may ([`Rows::needs_a_brake`]).
    pub(crate) fn needs_a_brake(&self) -> bool {
        self.rows.iter().any(|r| r.hard && r.rows.needs_a_brake())
    }

    /// Names and dofs of the hard limits whose joints a brake slows down in proportion.
    pub(crate) fn in_proportion(&self) -> impl Iterator<Item = (Vec<String>, Vec<usize>)> {
        let hard = self.rows.iter().filter(|r| r.hard);
        hard.map(|r| (r.rows.names(), r.rows.in_proportion())).filter(|(_, dofs)| !dofs.is_empty())
    }

    /// Of which of the hard rows, then of the hard cones, a state may be beyond what they keep.
    pub(crate) fn hard_of_state(&self) -> Vec<bool> {
        let rows = self.rows.iter().filter(|r| r.hard).flat_map(|r| vec![r.rows.of_state(); r.count]);
        rows.chain(self.cones.iter().filter(|c| c.hard).map(|_| true)).collect()
    }

    /// Motor forces of the last motion checked, by inverse dynamics (nv); zero when no limit needs them.
    pub fn torque(&self) -> &[f64] {
        &self.reckoned.tau
    }

    /// What the rows and cones need beside the state.
    pub(crate) fn needs(&self) -> Needs {
        Needs { previous: self.reckoned.needs.previous || self.limits.has_jerk(), ..self.reckoned.needs }
    }

    /// Asks for `share` of the size of cone `c`, and for rows of that limit to lie `inset` [m] further inside.
    pub(crate) fn ask(&mut self, limit: usize, share: f64, inset: f64) {
        for block in self.cones.iter_mut().filter(|c| c.limit == limit) {
            (block.share, block.in_force) = (share, share);
        }
        self.rows.iter_mut().filter(|r| r.limit == limit).for_each(|r| {
            if r.rows.inset(inset) {
                r.inset = inset;
            }
        });
    }

    /// By how much each hard row and cone may be broken as it is asked for and still be kept as it was built; infinite for what was put elsewhere.
    pub(crate) fn slack_to_the_build(&self) -> impl Iterator<Item = f64> {
        let rows =
            self.rows.iter().filter(|r| r.hard).flat_map(|r| {
                std::iter::repeat_n(if r.elsewhere { f64::INFINITY } else { r.inset }, r.count)
            });
        rows.chain(self.cones.iter().filter(|c| c.hard).map(|c| 1.0 - c.share))
    }

    /// Puts what may be elsewhere where the numbers say, in the order of the limits.
    pub(crate) fn put(&mut self, numbers: &[[f64; 6]]) {
        let mut first = 0;
        for block in &mut self.rows {
            let numbers = &numbers[first..first + block.built.len()];
            block.elsewhere = numbers != block.built;
            block.rows.put(numbers);
            first += block.built.len();
        }
    }

    /// What is in force on the way to moved limits: positions, speeds and how fast a dof may speed up (nv).
    pub(crate) fn hold(&mut self, limits: &LimitSet, speed: &[f64], faster: &[f64]) {
        self.limits.q_lower.copy_from_slice(&limits.q_lower);
        self.limits.q_upper.copy_from_slice(&limits.q_upper);
        self.speed.copy_from_slice(speed);
        self.faster.copy_from_slice(faster);
    }

    /// Begins or ends to hold moved limits; those of the build come back in full.
    pub(crate) fn move_limits(&mut self, on: bool, limits: &LimitSet) {
        self.limits.clear();
        self.limits.tighten(limits);
        self.moved = on;
        self.allowed.fill(0.0);
    }

    /// By how much what hard rows keep may be broken ([`Checker::hard`]).
    pub(crate) fn allow(&mut self, allowed: &[f64]) {
        self.allowed.copy_from_slice(allowed);
    }

    /// The share of its size that cone `c` has in force.
    pub(crate) fn set_in_force(&mut self, c: usize, share: f64) {
        self.cones[c].in_force = share;
    }

    /// The row of cone `c` in reports.
    pub(crate) fn cone_row(&self, c: usize) -> usize {
        self.cones[c].row
    }

    /// The share of its size that the state (`q`, `v`) makes of each hard cone that is switched on; 0 for others.
    pub(crate) fn shares_of(&mut self, (q, v): (&[f64], &[f64]), external: &[f64], out: &mut [f64]) {
        let mut motion = self.reckoned.motion((q, v), (q, v), external, (None, None));
        for (out, block) in out.iter_mut().zip(&mut self.cones) {
            *out = if block.hard && block.enabled { 1.0 + block.cone.breach(&mut motion) } else { 0.0 };
        }
    }

    /// The share of its size that a motion makes of each hard cone that is switched on, at its end and as it is asked for; 0 for others.
    pub(crate) fn shares(
        &mut self,
        now: (&[f64], &[f64]),
        next: (&[f64], &[f64]),
        external: &[f64],
        out: &mut [f64],
    ) {
        let mut motion = self.reckoned.motion(now, next, external, (None, None));
        for (out, block) in out.iter_mut().zip(&mut self.cones) {
            *out = match block.hard && block.enabled {
                true => 1.0 + block.cone.excess(&mut motion).max(block.cone.breach(&mut motion)),
                false => 0.0,
            };
        }
    }

    /// Rows of reports of the hard rows, then of the hard cones ([`Checker::hard`]).
    pub(crate) fn hard_row(&self, hard: usize) -> usize {
        let rows = self.rows.iter().filter(|r| r.hard).flat_map(|r| r.first..r.first + r.count);
        rows.chain(self.cones.iter().filter(|c| c.hard).map(|c| c.row)).nth(hard).unwrap_or(usize::MAX)
    }

    /// Switches the rows and cones of a limit, and takes over what is left of the limits of single joints.
    pub(crate) fn enable(&mut self, limit: usize, on: bool, left: &LimitSet) {
        self.rows.iter_mut().filter(|r| r.limit == limit).for_each(|r| r.enabled = on);
        self.cones.iter_mut().filter(|c| c.limit == limit).for_each(|c| c.enabled = on);
        self.limits.clear();
        self.limits.tighten(left);
    }

    fn examine(
        &mut self,
        now: (&[f64], &[f64]),
        next: (&[f64], &[f64]),
        external: &[f64],
        previous: Option<Previous<'_>>,
        meant: Meant,
    ) -> Verdict {
        let mut verdict = Verdict::default();
        self.boxes(&mut verdict, now, next, previous);
        let kept = meant == Meant::Kept;
        let mut motion = self.reckoned.motion(now, next, external, (previous.filter(|_| !kept), None));
        let mut allowed = self.allowed.iter();
        for block in self.rows.iter_mut().filter(|r| r.hard) {
            let (excess, allowed) = (&mut self.excess[..block.count], allowed.by_ref().take(block.count));
            match kept {
                _ if !block.enabled => excess.fill(f64::NEG_INFINITY),
                true => block.rows.breach(&mut motion, excess),
                false => block.rows.excess(&mut motion, excess),
            }
            if kept && block.enabled && excess.contains(&f64::NEG_INFINITY) {
                // No brake keeps them, and they are broken all the same.
                let asked = &mut self.asked[..block.count];
                block.rows.excess(&mut motion, asked);
                let unkept = excess.iter_mut().zip(asked).filter(|(x, _)| **x == f64::NEG_INFINITY);
                unkept.for_each(|(x, asked)| *x = *asked);
            }
            for (r, (excess, allowed)) in excess.iter().zip(allowed).enumerate() {
                let excess = if kept { excess - allowed } else { *excess };
                verdict.see(block.rows.kind(), block.first + r, excess, 0.0);
            }
        }
        for (block, allowed) in self.cones.iter_mut().filter(|c| c.hard).zip(allowed) {
            let excess = match kept {
                _ if !block.enabled => continue,
                true => block.breach(&mut motion) - allowed,
                false => block.excess(&mut motion),
            };
            verdict.see(block.cone.kind(), block.row, excess, 0.0);
        }
        verdict
    }

    /// The next speed is below the curves at the next position.
    fn profile(&self, i: usize, q: f64, v: f64, verdict: &mut Verdict) {
        let [lower, upper] = &self.limits.profile[i];
        for (curve, d, speed) in [(upper, 1.0, v), (lower, -1.0, -v)] {
            if let Some(p) = curve {
                let room = (2.0 * p.deceleration * (d * (p.at - q)).max(0.0)).sqrt();
                verdict.see(Kind::VelocityProfile, i, speed, (room - p.offset).max(0.0));
            }
        }
    }

    /// Next position inside both limits, sub-step positions inside, room to brake.
    fn positions(&self, i: usize, now: (f64, f64), next: (f64, f64), verdict: &mut Verdict) {
        let (low, high) = (self.limits.q_lower[i], self.limits.q_upper[i]);
        let kinematic = self.consistency == Consistency::Kinematic;
        let (t, tau) = (self.period.dt, self.period.tau);
        // A whole period of braking from standstill must not carry the dof beyond the limits on the other side.
        let room = (high - low) / (self.period.kappa * t * t + 0.5 * (t - 0.5 * tau).powi(2));
        let a_max = match self.limits.jerk[i].is_finite() {
            true => self.limits.acceleration[i], // what no brake of bounded jerk stops sooner than
            false => self.limits.braking[i].min(self.limits.velocity[i] / t).min(room),
        };
        let (mut highest, mut lowest) = (next.0, next.0);
        if kinematic {
            let (mut q, mut v) = now;
            let a = (next.1 - v) / self.period.dt;
            for _ in 0..self.period.sub_steps {
                v += a * self.period.tau;
                q += v * self.period.tau;
                (highest, lowest) = (highest.max(q), lowest.min(q));
            }
            let turn = -v / a; // constant acceleration: the extreme is where the velocity is zero
            if self.period.sub_steps == 0 && turn > 0.0 && turn < self.period.dt {
                let extreme = q + v * turn + 0.5 * a * turn * turn;
                (highest, lowest) = (highest.max(extreme), lowest.min(extreme));
            }
        }
        verdict.see(Kind::Position, i, highest, high);
        verdict.see(Kind::Position, i, -lowest, -low);
        if kinematic && a_max.is_finite() {
            let half = 0.5 * a_max * tau;
            // A brake in whole steps needs up to this much less than the smooth one, and what hard jerk promises is reckoned in steps.
            let less = if self.limits.jerk[i].is_finite() { 0.125 * a_max * tau * tau } else { 0.0 };
            // A brake that is stored is of whole periods, and may stop where the smooth one does not.
            let whole = self.whole && self.limits.jerk[i].is_infinite();
            let stop = |speed: f64| {
                let smooth = ((speed - half).max(0.0).powi(2) / (2.0 * a_max) - less).max(0.0); // braking distance
                if whole { smooth.min(whole_way(speed, a_max, &self.period)) } else { smooth }
            };
            verdict.see(Kind::Viability, i, next.0 + stop(next.1), high.max(next.0));
            verdict.see(Kind::Viability, i, stop(-next.1) - next.0, (-low).max(-next.0));
        }
    }
}

impl Reckoned {
    /// The motion from `now` to `next`, configurations (nq) and velocities (nv), with its acceleration, motor forces and frames, as far as a row or a cone
    /// needs them; `torque` where its motor forces are known.
    fn motion<'m>(
        &'m mut self,
        now: (&'m [f64], &'m [f64]),
        next: (&'m [f64], &'m [f64]),
        external: &[f64],
        (previous, torque): (Option<Previous<'m>>, Option<&[f64]>),
    ) -> Motion<'m> {
        let ((q, v), (q_next, v_next)) = (now, next);
        for i in 0..v.len() {
            self.a[i] = (v_next[i] - v[i]) / self.period.dt;
        }
        if let Some(torque) = torque {
            self.tau.copy_from_slice(torque);
        } else if self.needs.motors {
            self.dynamics.motors_without_friction(&self.period, q, v, &self.a, &mut self.tau);
            self.tau.iter_mut().zip(external).for_each(|(tau, external)| *tau -= external);
        }
        if self.needs.mass {
            self.dynamics.mass(q, &mut self.mass);
        }
        if self.needs.kinematics {
            self.kinematics.update(q, v, &self.a);
        }
        let (acceleration, torque, mass) = (&self.a[..], &self.tau[..], &self.mass[..]);
        let (period, kinematics) = (&self.period, &mut self.kinematics);
        Motion { q, v, q_next, v_next, acceleration, torque, mass, period, kinematics, previous }
    }
}

/// By how much a dof gains speed, away from standstill where it turns round.
fn speeding_up(v: f64, v_next: f64) -> f64 {
    if v * v_next > 0.0 { v_next.abs() - v.abs() } else { v_next.abs() }
}
