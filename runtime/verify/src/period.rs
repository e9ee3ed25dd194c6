//! A control period as the plant makes it, and how far a motion goes in it.

/// One control period: `n` semi-implicit Euler sub-steps, or none and constant acceleration.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Period {
    /// T [s].
    pub(crate) dt: f64,
    pub(crate) sub_steps: u32,
    /// Length of a sub-step [s]; 0 without.
    pub(crate) tau: f64,
    /// An acceleration `a` moves the position by `kappa T² a`.
    pub(crate) kappa: f64,
}

impl Period {
    pub(crate) fn new(dt: f64, sub_steps: u32) -> Period {
        let n = f64::from(sub_steps);
        match sub_steps {
            0 => Period { dt, sub_steps, tau: 0.0, kappa: 0.5 },
            _ => Period { dt, sub_steps, tau: dt / n, kappa: (n + 1.0) / (2.0 * n) },
        }
    }

    /// Way of a period from speed `v` to `v1`.
    pub(crate) fn way(&self, v: f64, v1: f64) -> f64 {
        self.dt * (v + self.kappa * (v1 - v))
    }

    /// The farthest that a motion with constant acceleration `a` from speed `v` comes within the period, at the plant's sub-steps.
    pub(crate) fn farthest(&self, v: f64, a: f64) -> f64 {
        if self.sub_steps == 0 {
            let end = self.dt * (v + 0.5 * self.dt * a);
            let turns = a < 0.0 && v > 0.0 && v < -a * self.dt;
            return if turns { end.max(-0.5 * v * v / a) } else { end };
        }
        let (mut speed, mut at, mut most) = (v, 0.0, f64::NEG_INFINITY);
        for _ in 0..self.sub_steps {
            speed += self.tau * a;
            at += self.tau * speed;
            most = f64::max(most, at);
        }
        most
    }

    /// Way to standstill from `speed` with deceleration `b`, where the last sub-step may turn the motion round: `(speed - b tau / 2)² / 2 b`.
    pub(crate) fn stopping(&self, speed: f64, b: f64) -> f64 {
        (speed - 0.5 * b * self.tau).max(0.0).powi(2) / (2.0 * b)
    }

    /// The same in whole periods and a shorter last one, which turns nothing round.
    pub(crate) fn stopping_whole(&self, speed: f64, b: f64) -> f64 {
        let whole = (speed / (b * self.dt)).floor().max(0.0);
        let left = speed - whole * b * self.dt;
        let full = whole * self.dt * (speed - b * self.dt * (0.5 * (whole - 1.0) + self.kappa));
        full + (self.dt * left * (1.0 - self.kappa)).max(0.0)
    }

    /// The largest closing acceleration towards something at distance `d`, approached with speed `w`, after which it is not passed within the
    /// period and `b` stops in front of it: searched for by halving.
    pub(crate) fn approach(&self, d: f64, w: f64, b: f64) -> f64 {
        let fits = |a: f64| {
            let gone = self.dt * w + self.kappa * self.dt * self.dt * a;
            self.farthest(w, a) <= d && gone + self.stopping(w + self.dt * a, b) <= d
        };
        let far = 4.0 * (b + (w.abs() + d.abs() / self.dt) / self.dt);
        let (mut low, mut high) = (-far, far);
        if fits(high) {
            return f64::INFINITY;
        }
        for _ in 0..100 {
            let middle = 0.5 * (low + high);
            *(if fits(middle) { &mut low } else { &mut high }) = middle;
        }
        low
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Step by step as a plant moves, the last period just long enough to stand.
    #[test]
    fn the_way_of_a_brake_is_the_sum_of_its_periods() {
        for sub_steps in [0, 1, 5] {
            let p = Period::new(0.01, sub_steps);
            for (speed, b) in [(1.0, 7.0), (0.05, 7.0), (0.7, 10.0), (0.0, 3.0)] {
                let (mut v, mut way) = (speed, 0.0);
                while v > 0.0 {
                    let next = f64::max(0.0, v - b * p.dt);
                    (way, v) = (way + p.way(v, next), next);
                }
                assert!((way - p.stopping_whole(speed, b)).abs() < 1e-12, "{sub_steps} {speed} {b} {way}");
            }
        }
    }

    /// Sub-step by sub-step: a motion that is as fast as [`Period::approach`] allows stops in front of the boundary, a faster one does not.
    #[test]
    fn an_approach_is_the_fastest_that_stops() {
        for sub_steps in [1, 5] {
            let p = Period::new(0.01, sub_steps);
            let (d, b) = (0.1, 4.0);
            let a = p.approach(d, 0.6, b);
            let rest = |a: f64| {
                let (mut v, mut q) = (0.6, 0.0);
                (0..sub_steps).for_each(|_| (v, q) = (v + p.tau * a, q + p.tau * (v + p.tau * a)));
                let mut most = q;
                while v > 0.0 {
                    v -= p.tau * b;
                    q += p.tau * v;
                    most = f64::max(most, q);
                }
                most
            };
            assert!(
                rest(a) <= d + 1e-12 && rest(a) > d - 0.25 * b * p.tau * p.tau,
                "{sub_steps} {a} {}",
                rest(a)
            );
        }
    }
}
