//! Commands of a joint for one period (force, position, velocity or target of a drive), and the force that its drive makes of them.

use crate::Period;

/// By which share of it a drive's force stays below its end where physics steps take its damping implicitly: at the end MuJoCo's do not, and the
/// joint is thrown.
pub const SHORT: f64 = 1e-7;

/// The command interface of one joint.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Drive {
    /// A motor force [N·m or N], held over the period.
    #[default]
    Effort,
    /// The position at the end of the period [rad or m]: the robot follows by itself.
    Position,
    /// The velocity at the end of the period [rad/s or m/s]: the robot follows by itself.
    Velocity,
    /// The target position `q*` [rad or m] of a drive that gives `tau = K (q* - q) - D v`.
    Pd {
        /// K [N·m/rad or N/m], above 0.
        stiffness: f64,
        /// D [N·m s/rad or N s/m], at least 0.
        damping: f64,
    },
}

impl std::fmt::Display for Drive {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Drive::Effort => write!(f, "effort [N m or N]"),
            Drive::Position => write!(f, "position [rad or m]"),
            Drive::Velocity => write!(f, "velocity [rad/s or m/s]"),
            Drive::Pd { stiffness, damping } => {
                write!(
                    f,
                    "pd target [rad or m], stiffness {stiffness} N m/rad or N/m, damping {damping} N m s/rad or N s/m"
                )
            }
        }
    }
}

/// What a command means for the equations of motion of a period.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Held {
    /// This motor force, whatever happens.
    Force(f64),
    /// `force - resistance a` on average over the period.
    Servo {
        /// Force that falls away for a unit of acceleration.
        resistance: f64,
        /// Force without acceleration.
        force: f64,
    },
    /// This acceleration, whatever it takes.
    Acceleration(f64),
}

/// Where a joint is at the end of a period, and what it takes to come there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Arrival {
    /// Position [rad or m].
    pub q: f64,
    /// Velocity [rad/s or m/s].
    pub v: f64,
    /// Constant acceleration [rad/s² or m/s²].
    pub a: f64,
    /// Motor force on average over the period [N·m or N].
    pub tau: f64,
}

impl Drive {
    /// Whether commands are positions [rad or m].
    pub fn takes_position(&self) -> bool {
        matches!(self, Drive::Position | Drive::Pd { .. })
    }

    /// What `command` does to a joint at `q`, `v`. With `h` and `c` of [`Period::lag`] and [`Period::sag`], a drive gives on average
    ///
    /// ```text
    ///     K (q* - q - h v - c a) - D (v + h a)
    /// ```
    pub fn held(&self, period: &Period, q: f64, v: f64, command: f64) -> Held {
        let (t, lag, sag) = (period.dt, period.lag(), period.sag());
        match *self {
            Drive::Effort => Held::Force(command),
            Drive::Position => Held::Acceleration((command - q - t * v) / (period.kappa * t * t)),
            Drive::Velocity => Held::Acceleration((command - v) / t),
            Drive::Pd { stiffness, damping } => Held::Servo {
                resistance: stiffness * sag + damping * lag,
                force: stiffness * (command - q - lag * v) - damping * v,
            },
        }
    }

    /// The command that takes a joint from `q`, `v` to `to`: the inverse of [`Drive::held`],
    ///
    /// ```text
    ///     q* = q + h v + c a + (tau + D (v + h a)) / K
    /// ```
    pub fn command(&self, period: &Period, q: f64, v: f64, to: &Arrival) -> f64 {
        let (lag, sag) = (period.lag(), period.sag());
        match *self {
            Drive::Effort => to.tau,
            Drive::Position => to.q,
            Drive::Velocity => to.v,
            Drive::Pd { stiffness, damping } => {
                q + lag * v + sag * to.a + (to.tau + damping * (v + lag * to.a)) / stiffness
            }
        }
    }

    /// How far from where its joint is a command may have to be \[rad or m\] for all of `effort` at any speed up to `speed`; 0 for what is no
    /// target. A brake that is gentler than the drive's own damping asks for the most:
    ///
    /// ```text
    ///     (effort + D speed) / K + T speed
    /// ```
    pub fn reach(&self, period: &Period, effort: f64, speed: f64) -> f64 {
        match *self {
            Drive::Pd { stiffness, damping } => (effort + damping * speed) / stiffness + period.dt * speed,
            _ => 0.0,
        }
    }

    /// Its name in the task file.
    pub fn name(&self) -> &'static str {
        match self {
            Drive::Effort => "effort",
            Drive::Position => "position",
            Drive::Velocity => "velocity",
            Drive::Pd { .. } => "pd",
        }
    }
}
