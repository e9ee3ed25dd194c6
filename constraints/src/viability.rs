//! The box of accelerations from which a joint can always still stop in front of its position limits.
//!
//! With `d = q_max - q` and sub-steps of length `tau`, the set
//!
//! ```text
//!     d >= 0   and   (v - A tau / 2)_+^2 <= 2 A d
//! ```
//!
//! is invariant: one braking sub-step `v' = v - A tau`, `d' = d - tau v'` keeps
//! `d' - (v' - A tau / 2)^2 / (2 A) = d - (v - A tau / 2)^2 / (2 A)`.
//! (`A` here is [`Dof::braking`].) With `tau = 0` it is the set of Del Prete, "Joint Position and Velocity Bounds in Discrete-Time Acceleration/Torque
//! Control of Robot Manipulators", RA-L 2018. The familiar `v' <= sqrt(2 A d)` is the same parabola at the wrong end
//! of the step; near the position limit it conflicts with the acceleration limit.

pub use crate::limit::Kind;
use crate::{LimitSet, Model};

/// A speed limit that falls in front of a position, as robot makers state it:
///
/// ```text
///     v <= max(0, -offset + sqrt(2 deceleration (at - q)))
/// ```
///
/// and its mirror image in front of a lowest position. Braking with `deceleration` never crosses it, sampled at any period; for a
/// joint that brakes less, the lower curve of its own braking takes its place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Profile {
    /// Position at which the speed must be zero [rad or m].
    pub at: f64,
    /// Deceleration of the curve [rad/s² or m/s²].
    pub deceleration: f64,
    /// Speed taken off the curve, at least 0 [rad/s or m/s].
    pub offset: f64,
}

/// How the plant moves during one control period.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Period {
    /// Control period T \[s\].
    pub dt: f64,
    /// Number n of semi-implicit Euler sub-steps; 0 for a plant that moves with constant acceleration (or Runge-Kutta).
    pub sub_steps: u32,
    /// Sub-step length `tau = T / n` \[s\]; 0 when there are none.
    pub tau: f64,
    /// `q' = q + T v + kappa T y`: `(n + 1) / (2 n)`, or 1/2.
    pub kappa: f64,
}

impl Period {
    /// A period of `dt` seconds in `sub_steps` sub-steps.
    pub fn new(dt: f64, sub_steps: u32) -> Period {
        let n = f64::from(sub_steps);
        let (tau, kappa) = if sub_steps == 0 { (0.0, 0.5) } else { (dt / n, (n + 1.0) / (2.0 * n)) };
        Period { dt, sub_steps, tau, kappa }
    }

    /// Share of a limit that braking counts on, `1 - clamp(4 T, 0.02, 0.2)`. With several physics steps in a period, or none, its motion is not that
    /// of a constant acceleration, the less so the longer it is: a joint comes a little further than foreseen, and brakes harder than it counted on
    /// until that is made up for. With one step it is all of the limit.
    pub fn counted(&self) -> f64 {
        if self.sub_steps == 1 { 1.0 } else { 1.0 - (4.0 * self.dt).clamp(0.02, 0.2) }
    }

    /// How long after the start of the period the plant evaluates its forces, on average: `(T - tau) / 2` \[s\].
    pub fn lag(&self) -> f64 {
        0.5 * (self.dt - self.tau)
    }

    /// How far an acceleration `a` has moved the configuration at which the plant evaluates its forces, on average:
    /// `(T^2 - tau^2) / 6 a` \[s²\].
    pub fn sag(&self) -> f64 {
        (self.dt * self.dt - self.tau * self.tau) / 6.0
    }

    /// What the damper and the spring of dof `i` add to the mass matrix's diagonal when the acceleration is constant over the period:
    /// `kappa T D + (T^2 - tau^2) / 6 K`, for they meet the velocity `v + kappa T a` and the configuration
    /// `q + (T - tau) / 2 v + (T^2 - tau^2) / 6 a` on average. With one sub-step it is `T D`: MuJoCo's Euler step, which is implicit in the
    /// damping. Drives whose damping a step takes implicitly add `tau` times that.
    pub fn resistance(&self, model: &Model, i: usize) -> f64 {
        self.kappa * self.dt * model.damping()[i]
            + self.sag() * model.stiffness()[i]
            + self.tau * model.drive_damping()[i]
    }

    /// What is implicit of the dampers of dof `i` in a physics step, as an inertia: `tau (D + D_drive)` [kg·m² or kg].
    pub(crate) fn implicit(&self, model: &Model, i: usize) -> f64 {
        self.tau * (model.damping()[i] + model.drive_damping()[i])
    }
}

/// Limits of one dof; infinite is none. A position limit needs a finite `acceleration`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dof {
    /// Lowest position [rad or m].
    pub lower: f64,
    /// Highest position [rad or m].
    pub upper: f64,
    /// Largest speed V [rad/s or m/s].
    pub velocity: f64,
    /// Largest acceleration A [rad/s² or m/s²].
    pub acceleration: f64,
    /// Deceleration that braking may count on, at most A [rad/s² or m/s²].
    pub deceleration: f64,
    /// Largest jerk J that is hard [rad/s³ or m/s³]: [`jerk::interval`](crate::jerk::interval) keeps it, [`interval`] knows nothing of it.
    pub jerk: f64,
    /// Jerk that braking may count on, at most J [rad/s³ or m/s³].
    pub braking_jerk: f64,
    /// Speed limits in front of a lowest and a highest position.
    pub profile: [Option<Profile>; 2],
    /// The dof stops and stays.
    pub locked: bool,
    /// Room to brake is left for whole periods of one acceleration each, the last one just long enough to stand. Without it the last
    /// may turn the dof round, which stops it up to `A T^2 / 8` earlier.
    pub whole: bool,
}

impl Profile {
    /// The curve that braking with `braking` never crosses.
    fn within(&self, braking: f64) -> Profile {
        Profile { deceleration: self.deceleration.min(braking), ..*self }
    }
}

impl Dof {
    /// No limits.
    pub const FREE: Dof = Dof {
        lower: f64::NEG_INFINITY,
        upper: f64::INFINITY,
        velocity: f64::INFINITY,
        acceleration: f64::INFINITY,
        deceleration: f64::INFINITY,
        jerk: f64::INFINITY,
        braking_jerk: f64::INFINITY,
        profile: [None, None],
        locked: false,
        whole: false,
    };

    /// The limits of dof `i` of a set.
    pub fn of(limits: &LimitSet, i: usize) -> Dof {
        let (lower, upper) = (limits.q_lower[i], limits.q_upper[i]);
        let (acceleration, deceleration) = (limits.acceleration[i], limits.braking[i]);
        let (velocity, profile, locked) = (limits.velocity[i], limits.profile[i], limits.locked[i]);
        let (jerk, braking_jerk) = (limits.jerk[i], limits.braking_jerk[i]);
        let whole = false;
        Dof { lower, upper, velocity, acceleration, deceleration, jerk, braking_jerk, profile, locked, whole }
    }

    /// The deceleration that braking counts on: the one stated, or less where a whole period of it would turn the dof round and
    /// carry it beyond a limit on the other side,
    ///
    /// ```text
    ///     A_b = min(deceleration, V / T, (q_max - q_min) / (kappa T^2 + (T - tau / 2)^2 / 2))
    /// ```
    ///
    /// The set of the module's head is invariant for `A_b`; with `A T > V` it is not for `A`.
    pub fn braking(&self, period: &Period) -> f64 {
        let (t, half) = (period.dt, period.dt - 0.5 * period.tau);
        let room = (self.upper - self.lower) / (period.kappa * t * t + 0.5 * half * half);
        self.deceleration.min(self.acceleration).min(self.velocity / t).min(room)
    }
}

/// Accelerations allowed to one dof for one period [rad/s² or m/s²]; never empty.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Interval {
    /// Lower bound.
    pub lower: f64,
    /// Upper bound.
    pub upper: f64,
    /// What set the lower bound.
    pub lower_kind: Kind,
    /// What set the upper bound.
    pub upper_kind: Kind,
    /// `Some` when the state is outside the viable set: beyond the limit named. The interval then holds what returns
    /// or brakes.
    pub outside: Option<Kind>,
}

/// Positions this far beyond a limit are rounding [rad or m].
pub const POSITION_TOLERANCE: f64 = 1e-9;

/// A state this far outside the set is inside [rad or m].
const ROUNDING: f64 = 1e-10;

/// Bounds that cross by less than this share of A are rounding: a target beyond A by more would not pass the checker.
const CROSSING: f64 = 5e-10;

/// The box of one dof at position `q` [rad or m] and velocity `v` [rad/s or m/s].
pub fn interval(dof: &Dof, q: f64, v: f64, period: &Period) -> Interval {
    let a = dof.braking(period);
    if dof.locked {
        let stop = brake(dof, v, period);
        let (lower_kind, upper_kind) = (Kind::Locked, Kind::Locked);
        return Interval { lower: stop, upper: stop, lower_kind, upper_kind, outside: None };
    }
    let (above, below) = (q > dof.upper + POSITION_TOLERANCE, q < dof.lower - POSITION_TOLERANCE);
    let (mut upper, mut upper_kind) = match above {
        true => returning(dof, v, period),
        false => upper_bound(dof, a, dof.upper - q, v, period),
    };
    if let Some(p) = &dof.profile[1] {
        (upper, upper_kind) = smaller(
            (upper, upper_kind),
            (profile_bound(&p.within(a), p.at - q, v, period), Kind::VelocityProfile),
        );
    }
    let (mut lower, mut lower_kind) = match below {
        true => returning(dof, -v, period),
        false => upper_bound(dof, a, q - dof.lower, -v, period),
    };
    if let Some(p) = &dof.profile[0] {
        (lower, lower_kind) = smaller(
            (lower, lower_kind),
            (profile_bound(&p.within(a), q - p.at, -v, period), Kind::VelocityProfile),
        );
    }
    lower = -lower;
    let mut outside = (above || below).then_some(Kind::Position);
    if lower > upper {
        if lower - upper > CROSSING * a {
            let beyond = if v.abs() > dof.velocity { Kind::Velocity } else { Kind::Viability };
            outside = outside.or(Some(beyond));
            let stop = full_brake(dof, v, period);
            (lower, upper) = (stop, stop);
        } else {
            lower = upper;
        }
    }
    Interval { lower, upper, lower_kind, upper_kind, outside }
}

/// The deceleration that stops the dof: `-sgn(v) min(A_b, |v| / T)`.
pub fn brake(dof: &Dof, v: f64, period: &Period) -> f64 {
    -v.signum() * dof.braking(period).min(v.abs() / period.dt)
}

/// The deceleration outside the set, `-sgn(v) min(A, |v| / T)` of the deceleration that is stated: it turns nothing round, so that neither a slow
/// limit nor a narrow range ([`Dof::braking`]) asks for less.
fn full_brake(dof: &Dof, v: f64, period: &Period) -> f64 {
    -v.signum() * dof.deceleration.min(dof.acceleration).min(v.abs() / period.dt)
}

/// Beyond the upper limit only `v' <= 0` is allowed.
fn returning(dof: &Dof, v: f64, period: &Period) -> (f64, Kind) {
    smaller((dof.acceleration, Kind::Acceleration), (-v / period.dt, Kind::Position))
}

/// A joint beyond a position limit is to come back in so many periods, as points and bodies do, or sooner where periods are long [s].
const RETURN_PERIODS: f64 = 20.0;
const RETURN_TIME: f64 = 0.5;

/// Share of the speed limit with which it is to come back.
const RETURN_SPEED: f64 = 0.1;

/// The highest and the lowest velocity that is aimed at: of a dof the distance `d` beyond its upper limit
///
/// ```text
///     -min(d / max(min(20 T, 0.5 s), 2 T), V / 10)
/// ```
///
/// Not to go further is what the box asks for. To stand still would not do: where a plant moves otherwise than foreseen by a little in each period,
/// that adds up.
pub fn coming_back(dof: &Dof, q: f64, period: &Period) -> (f64, f64) {
    let time = (RETURN_PERIODS * period.dt).min(RETURN_TIME).max(2.0 * period.dt);
    let back = |d: f64| match d > POSITION_TOLERANCE {
        true => -(d / time).min(RETURN_SPEED * dof.velocity),
        false => f64::INFINITY,
    };
    (back(q - dof.upper), -back(dof.lower - q))
}

/// Upper bound of the acceleration at distance `d` below the upper limit, with braking deceleration `a`: the smallest of
///
/// 1. `A`
/// 2. `(V - v) / T`
/// 3. positions within the period
/// 4. braking after it.
fn upper_bound(dof: &Dof, a: f64, d: f64, v: f64, p: &Period) -> (f64, Kind) {
    let a_max = dof.acceleration;
    let mut bound = smaller((a_max, Kind::Acceleration), ((dof.velocity - v) / p.dt, Kind::Velocity));
    if d == f64::INFINITY || a_max == f64::INFINITY {
        return bound;
    }
    let least = |x: f64| if dof.whole { whole_floor(x, d, v, a, p) } else { floor(x, d, v, a, p) };
    if d < p.dt * v.max(0.0) + a_max * p.dt * p.dt {
        bound = smaller(bound, (least(position_bound(d, v, a, p)), Kind::Position));
    }
    // Where even full acceleration leaves room to brake, the parabola does not bind.
    let (v_next, d_next) = (v + a_max * p.dt - 0.5 * a * p.tau, d - p.dt * v - p.kappa * p.dt * p.dt * a_max);
    let more = if dof.whole { 0.125 * a * p.dt * p.dt } else { 0.0 };
    if (v_next > 0.0 && v_next * v_next > 2.0 * a * (d_next - more)) || d_next < 0.0 {
        let smooth = braking_bound(d, v, a, p);
        let braking = if dof.whole { smooth.min(whole_bound(d, v, a, p)) } else { smooth };
        bound = smaller(bound, (least(braking), Kind::Viability));
    }
    bound
}

/// The largest `x` after which braking by whole periods of `a` stops in time: the way `W` from speed `s` is the largest of the lines
///
/// ```text
///     W_k(s) = s T (k + 1 - kappa) - a T^2 k (k + 1) / 2,   k = 0, 1, ...
/// ```
///
/// so that `d - T v - kappa T^2 x >= W_k(v + T x)` for all of them; below `x = -v / T` there is no way left to go.
fn whole_bound(d: f64, v: f64, a: f64, p: &Period) -> f64 {
    let t = p.dt;
    let line = |k: f64| {
        let room = d - v * t * (k + 2.0 - p.kappa) + 0.5 * a * t * t * k * (k + 1.0);
        room / (t * t * (k + 1.0))
    };
    // The lines touch the parabola of a brake without periods, next to whose bound the least of them is.
    let near = ((v + t * braking_bound(d, v, a, p)).max(0.0) / (a * t)).floor();
    let least = (-2..=2).map(|step| line((near + f64::from(step)).max(0.0)));
    least.fold(f64::INFINITY, f64::min).max(-v / t)
}

/// From inside the set, braking with `A` is always allowed. Close to the limit the formulas lose that to rounding: with
/// `d = 1e-11` the last bits of `q` are 1e-5 of `-v^2 / 2 d`.
fn floor(bound: f64, d: f64, v: f64, a: f64, p: &Period) -> f64 {
    if is_inside(d, v, a, p) { bound.max(-a) } else { bound }
}

/// The state is in the set.
fn is_inside(d: f64, v: f64, a: f64, p: &Period) -> bool {
    let w = (v - 0.5 * a * p.tau).max(0.0);
    w * w <= 2.0 * a * (d + ROUNDING)
}

/// The same for whole periods: where those of `a` and a shorter one stop in time, the next of them is always allowed, and turns nothing
/// round.
fn whole_floor(bound: f64, d: f64, v: f64, a: f64, p: &Period) -> f64 {
    if whole_way(v, a, p) <= d + ROUNDING {
        bound.max(-a.min(v.max(0.0) / p.dt))
    } else {
        floor(bound, d, v, a, p)
    }
}

/// The way to standstill from speed `v` in whole periods of deceleration `a` and a shorter last one [rad or m].
pub(crate) fn whole_way(v: f64, a: f64, p: &Period) -> f64 {
    let (t, k) = (p.dt, (v / (a * p.dt)).floor().max(0.0));
    (v * t * (k + 1.0 - p.kappa) - 0.5 * a * t * t * k * (k + 1.0)).max(0.0)
}

/// Positions at the end of each sub-step, `d - j tau v - tau^2 j (j + 1) / 2 a >= 0`:
///
/// ```text
///     a <= 2 (d - j tau v) / (tau^2 j (j + 1)),   j = 1..n
/// ```
///
/// Without sub-steps, the end of the period or the turning point inside it:
/// `a3 = 2 (d - T v) / T^2` if `v <= 0` or `a3 > -v / T`, else `min(-v^2 / 2 d, -v / T)`; minus infinity where no `a` is enough.
fn position_bound(d: f64, v: f64, a: f64, p: &Period) -> f64 {
    if p.sub_steps == 0 {
        let a3 = 2.0 * (d - p.dt * v) / (p.dt * p.dt);
        return match v <= 0.0 || a3 > -v / p.dt {
            true => a3,
            false if d > 0.0 => (-v * v / (2.0 * d)).min(-v / p.dt),
            // At the limit and moving on: turned round within the tolerance, or outside.
            false if v * v <= 2.0 * a * (d + POSITION_TOLERANCE) => -a,
            false => f64::NEG_INFINITY,
        };
    }
    let mut bound = f64::INFINITY;
    for j in 1..=p.sub_steps {
        let j = f64::from(j);
        bound = bound.min(2.0 * (d - j * p.tau * v) / (p.tau * p.tau * j * (j + 1.0)));
    }
    bound
}

/// The largest `a` after which the state is in the set. With `w = v - A tau / 2`, `v' = v + T a` and
/// `d' = d - T v - kappa T^2 a`, `(w + T a)^2 = 2 A d'` is
///
/// ```text
///     T^2 a^2 + b a + c = 0,   b = 2 w T + 2 A kappa T^2,   c = w^2 - 2 A (d - T v)
/// ```
///
/// and below `a = -w / T` the velocity term is zero.
fn braking_bound(d: f64, v: f64, a: f64, p: &Period) -> f64 {
    let t = p.dt;
    let w = v - 0.5 * a * p.tau;
    let b = 2.0 * w * t + 2.0 * a * p.kappa * t * t;
    let c = w * w - 2.0 * a * (d - t * v);
    let discriminant = b * b - 4.0 * t * t * c;
    if discriminant < 0.0 {
        return -w / t;
    }
    ((-b + discriminant.sqrt()) / (2.0 * t * t)).max(-w / t)
}

/// By how much less a dof would have had to accelerate in a period [rad/s² or m/s²] for the state at its end, at distance `d` below the upper limit and
/// with velocity `v`, to be in the set of braking deceleration `a`; 0 inside.
pub(crate) fn too_fast(d: f64, v: f64, a: f64, p: &Period) -> f64 {
    if is_inside(d, v, a, p) { 0.0 } else { -braking_bound(d + p.dt * v, v, a, p) }
}

/// The largest acceleration towards a boundary at distance `d`, approached with speed `w`, from which a deceleration of
/// `braking` still stops in front of it: the position and viability bounds of a joint, for any other distance.
///
/// Never below `-braking` from inside the set; beyond the boundary whatever turns round in one period, at most `braking`.
pub fn approach(d: f64, w: f64, braking: f64, period: &Period) -> f64 {
    if d <= 0.0 {
        return (-w / period.dt).clamp(-braking, braking);
    }
    let bound = position_bound(d, w, braking, period).min(braking_bound(d, w, braking, period));
    floor(bound, d, w, braking, period)
}

/// The largest `a` after which the speed is below the profile. With `w = v + offset`, `(w + T a)^2 = 2 A d'` as in
/// [`braking_bound`]; `v' <= 0` is always allowed. Braking by `A` for `T` changes `(v + offset)^2 - 2 A d` by
/// `-2 A T offset` and no more, so from below the profile `-A` is always allowed.
fn profile_bound(profile: &Profile, d: f64, v: f64, p: &Period) -> f64 {
    let (t, a, w) = (p.dt, profile.deceleration, v + profile.offset);
    let b = 2.0 * w * t + 2.0 * a * p.kappa * t * t;
    let c = w * w - 2.0 * a * (d - t * v);
    let discriminant = b * b - 4.0 * t * t * c;
    let root =
        if discriminant < 0.0 { f64::NEG_INFINITY } else { (-b + discriminant.sqrt()) / (2.0 * t * t) };
    let below = v <= 0.0 || w * w <= 2.0 * a * (d + ROUNDING);
    root.max(-v / t).max(if below { -a } else { f64::NEG_INFINITY })
}

fn smaller(x: (f64, Kind), y: (f64, Kind)) -> (f64, Kind) {
    if y.0 < x.0 { y } else { x }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn far_from_everything_the_box_is_the_acceleration_limit() {
        let dof = Dof {
            lower: -1.0,
            upper: 1.0,
            velocity: 5.0,
            acceleration: 20.0,
            deceleration: 20.0,
            ..Dof::FREE
        };
        let i = interval(&dof, 0.0, 0.0, &Period::new(0.01, 5));
        assert_eq!((i.lower, i.upper, i.outside), (-20.0, 20.0, None));
    }

    #[test]
    fn hand_computed_parabola() {
        // tau = 0, T = 0.1, A = 2, v = 1, d = 0.3: 0.01 a^2 + 0.22 a + 0.2 = 0 with c = 1 - 4 * 0.2
        let dof = Dof {
            lower: f64::NEG_INFINITY,
            upper: 0.3,
            velocity: 10.0,
            acceleration: 2.0,
            deceleration: 2.0,
            ..Dof::FREE
        };
        let i = interval(&dof, 0.0, 1.0, &Period::new(0.1, 0));
        let root = (-0.22 + (0.22f64 * 0.22 - 4.0 * 0.01 * 0.2).sqrt()) / 0.02;
        assert!((i.upper - root).abs() < 1e-12 && i.upper_kind == Kind::Viability, "{i:?} {root}");
        let (v, d) = (1.0 + 0.1 * i.upper, 0.3 - 0.1 - 0.005 * i.upper);
        assert!((v * v - 4.0 * d).abs() < 1e-12);
    }

    #[test]
    fn beyond_the_limit_it_may_only_return() {
        let dof = Dof {
            lower: -1.0,
            upper: 1.0,
            velocity: 5.0,
            acceleration: 20.0,
            deceleration: 20.0,
            ..Dof::FREE
        };
        let p = Period::new(0.01, 1);
        let still = interval(&dof, 1.2, 0.0, &p);
        assert_eq!((still.lower, still.upper, still.outside), (-20.0, 0.0, Some(Kind::Position)));
        let leaving = interval(&dof, 1.2, 3.0, &p);
        assert_eq!((leaving.lower, leaving.upper), (-20.0, -20.0));
        // A narrow range and a slow limit let a brake in front of a limit count on 2 / (T^2 + T^2 / 8) and on V / T: outside it takes what there is.
        let narrow = Dof { lower: 0.0, upper: 1e-3, velocity: 0.1, ..dof };
        for (q, v) in [(1.2, 3.0), (-0.2, -3.0), (5e-4, 3.0)] {
            let i = interval(&narrow, q, v, &p);
            assert!(narrow.braking(&p) < 10.0 && i.outside.is_some(), "{i:?}");
            assert_eq!((i.lower, i.upper), (-20.0 * v.signum(), -20.0 * v.signum()), "at {q}, {v}");
        }
        let fast = interval(&dof, 0.0, 9.0, &p);
        assert_eq!((fast.lower, fast.upper, fast.outside), (-20.0, -20.0, Some(Kind::Velocity)));
    }

    #[test]
    fn what_is_beyond_a_limit_is_to_come_back() {
        let dof = Dof { lower: -1.0, upper: 1.0, velocity: 5.0, ..Dof::FREE };
        let (none, p) = (f64::INFINITY, Period::new(0.01, 1));
        assert_eq!(coming_back(&dof, 0.5, &p), (none, -none));
        // 0.002 rad in 20 periods of 0.01 s, and never faster than 0.1 * 5 rad/s
        assert!((coming_back(&dof, 1.002, &p).0 + 0.01).abs() < 1e-9);
        assert!((coming_back(&dof, -3.0, &p).1 - 0.5).abs() < 1e-9);
        // 20 periods of 0.2 s are too long: 0.01 rad in half a second
        assert!((coming_back(&dof, 1.01, &Period::new(0.2, 1)).0 + 0.02).abs() < 1e-9);
    }
}
