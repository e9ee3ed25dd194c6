//! The way of one joint of hard jerk to limits that were moved.

use super::{Projector, ROUNDING};
use crate::jerk::{self, Brake};
use crate::target::Braking;
use crate::viability::{Dof, Interval, Kind, POSITION_TOLERANCE};

impl Projector {
    /// The brake in force of a joint of hard jerk: the stored one, or with all that the joint may count on.
    pub(super) fn smooth_brake(&self, i: usize) -> Brake {
        let dof = Dof::of(&self.limits, i);
        let stored =
            (self.settings.braking == Braking::Stored).then(|| self.backup.decelerations()).flatten();
        Brake::new(&dof, stored.map_or(Brake::most(&dof), |d| d[i]), &self.period)
    }

    /// [`Projector::move_dof`] of a joint of hard jerk, `dof` as it was built and as it is `wanted`. With the next acceleration `a` of the brake in
    /// force, the fastest `s` that it becomes in either direction and the furthest `r` that it goes, in force are `max(V, s)` and
    /// `max(q_max, q + r)`; the accelerations after which a brake keeps these are an interval with `a` in it, as those of any limits are.
    pub(super) fn move_smooth(
        &mut self,
        (q, v): (f64, f64),
        i: usize,
        (dof, wanted): (&Dof, &Dof),
        built: Interval,
    ) -> (Interval, [f64; 2], bool) {
        let (t, p) = (self.period.dt, &self.period);
        let known = self.previous.get().map(|previous| previous.acceleration[i]);
        let known = known.or((v == 0.0).then_some(0.0));
        let before = self.before[i];
        // The quickest brake leads the way, the one in force says how far it may go.
        let slower = Brake::of(dof, p).next(v, before).clamp(built.lower, built.upper);
        let brake = self.smooth_brake(i);
        let stop = brake.next(v, before).clamp(built.lower, built.upper);
        let [up, down] = brake.fastest(v, stop);
        let (above, below) = (brake.reach(v, stop), brake.reach(-v, -stop));
        let m = &mut self.moving;
        m.speed[i] = wanted.velocity.max(up).max(down);
        m.speeding[i] = m.faster[i];
        let f = &mut self.in_force;
        f.q_upper[i] = wanted.upper.max((q + above.max(0.0)).min(dof.upper));
        f.q_lower[i] = wanted.lower.min((q - below.max(0.0)).max(dof.lower));
        let force = Dof { velocity: m.speed[i], upper: f.q_upper[i], lower: f.q_lower[i], ..*dof };
        let beyond = |x: f64, limit: f64| x > limit + POSITION_TOLERANCE;
        let late_up = beyond(f.q_upper[i], wanted.upper) || up > wanted.velocity * (1.0 + ROUNDING);
        let late_down = beyond(-f.q_lower[i], -wanted.lower) || down > wanted.velocity * (1.0 + ROUNDING);
        let new = jerk::interval(wanted, q, v, known, p);
        let behind = late_up || late_down || new.outside.is_some();
        let mut aim = if behind { jerk::interval(&force, q, v, known, p) } else { new };
        if built.outside.is_some() {
            aim = built;
        }
        // Never empty: both brakes are in it.
        let (lower, upper) = (aim.lower.max(built.lower), aim.upper.min(built.upper));
        (aim.lower, aim.upper) = (lower.min(slower).min(stop), upper.max(slower).max(stop));
        if late_up && slower < aim.upper {
            (aim.upper, aim.upper_kind) = (slower, Kind::Velocity);
        }
        if late_down && slower > aim.lower {
            (aim.lower, aim.lower_kind) = (slower, Kind::Velocity);
        }
        let m = &mut self.moving;
        (m.lower[i], m.upper[i]) = (v + t * aim.lower, v + t * aim.upper);
        let hard = [v + t * aim.lower.min(stop), v + t * aim.upper.max(stop)];
        (aim, hard, behind)
    }
}
