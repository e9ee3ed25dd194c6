//! Measures by how much a passage exceeds a limit, from what the limit says. It uses kinematics, inverse dynamics and arithmetic, and nothing of
//! the projector.

use nearl_constraints::*;

/// Rounding of positions [rad or m] and shares that is no excess.
pub const ROUNDING: f64 = 1e-9;

/// A part of the robot that is a ball around the origin of a frame.
pub struct Ball {
    pub frame: FrameId,
    pub radius: f64,
}

/// Largest speed of a joint in front of its ends, as in [`limit::JointProfile`].
#[derive(Clone, Copy)]
pub struct Curve {
    pub limit: f64,
    pub offset: f64,
    pub squared: f64,
    pub lower: f64,
    pub upper: f64,
}

/// What is measured; every result is a share of the limit or, of positions, rad or m.
pub enum Meter {
    /// Position, velocity and acceleration of each joint.
    Joints { acceleration: f64 },
    /// Motor forces as share of the robot file's.
    Torque { share: f64 },
    /// Force at standstill and speed without load of each motor.
    TorqueSpeed { line: Vec<(f64, f64)> },
    /// Speed that falls in front of a position.
    Profile { curves: Vec<Curve> },
    /// A joint that stands where it stood.
    Locked { joint: usize, at: f64 },
    /// A point in a box.
    Frame { frame: FrameId, lower: [f64; 3], upper: [f64; 3] },
    /// Speed of a point.
    FrameSpeed { frame: FrameId, limit: f64 },
    /// Kinetic energy.
    Energy { limit: f64 },
    /// Two balls of the robot, one that stands still, and a floor.
    Collision { tool: Ball, elbow: Ball, post: [f64; 3], radius: f64, floor: f64 },
    /// Change of acceleration from tick to tick; a soft limit says nothing of the first tick.
    Jerk { limit: f64, soft: bool },
    /// Change of motor force from tick to tick.
    TorqueRate { limits: Vec<f64> },
    /// `q_a + 0.7 q_b` between two bounds, `|v_a + v_b|` below one.
    Rows { joints: [usize; 2], lower: f64, upper: f64, most: f64 },
    /// The speed of one joint and `share` of the acceleration of another.
    MixedRow { joints: [usize; 2], share: f64, most: f64 },
}

/// What the measures need.
pub struct Gauge {
    pub model: Model,
    pub period: Period,
    /// Accelerations and motor forces of the tick before (nv), and whether there was one.
    before: (Vec<f64>, Vec<f64>),
    known: bool,
    dynamics: Dynamics,
    kinematics: Kinematics,
    a: Vec<f64>,
    tau: Vec<f64>,
}

/// What lies between one state and the next, one control period later.
#[derive(Clone, Copy)]
pub struct Passage<'a> {
    pub q: &'a [f64],
    pub v: &'a [f64],
    pub q_next: &'a [f64],
    pub v_next: &'a [f64],
}

impl Gauge {
    pub fn new(model: &Model, period: Period) -> Gauge {
        let zero = vec![0.0; model.nv()];
        Gauge {
            dynamics: Dynamics::new(model),
            kinematics: Kinematics::new(model),
            a: zero.clone(),
            before: (zero.clone(), zero.clone()),
            known: false,
            tau: zero,
            model: model.clone(),
            period,
        }
    }

    /// The robot stands, and there is no tick before.
    pub fn begin(&mut self) {
        self.before.0.fill(0.0);
        self.known = false;
    }

    /// The passage was taken: it becomes the tick before.
    pub fn take(&mut self, passage: Passage<'_>) {
        self.accelerate(passage);
        self.motors(passage);
        self.before.0.copy_from_slice(&self.a);
        self.before.1.copy_from_slice(&self.tau);
        self.known = true;
    }

    fn accelerate(&mut self, passage: Passage<'_>) {
        for (a, (to, from)) in self.a.iter_mut().zip(passage.v_next.iter().zip(passage.v)) {
            *a = (to - from) / self.period.dt;
        }
    }

    /// The largest excess of all measures; negative inside.
    pub fn worst(&mut self, meters: &[Meter], passage: Passage<'_>) -> f64 {
        self.accelerate(passage);
        meters.iter().fold(f64::NEG_INFINITY, |worst, meter| worst.max(self.excess(meter, passage)))
    }

    fn excess(&mut self, meter: &Meter, passage: Passage<'_>) -> f64 {
        let each = |of: &dyn Fn(usize) -> f64| (0..passage.v.len()).map(of).fold(f64::NEG_INFINITY, f64::max);
        match meter {
            Meter::Joints { acceleration } => each(&|i| self.joint(i, *acceleration, passage)),
            Meter::Torque { share } => {
                self.motors(passage);
                each(&|i| self.tau[i].abs() / (share * self.model.effort_limit()[i]) - 1.0)
            }
            Meter::TorqueSpeed { line } => {
                self.motors(passage);
                each(&|i| {
                    let (stall, no_load) = line[i];
                    let at = |v: f64| (self.tau[i] / stall + v / no_load).abs() - 1.0;
                    at(passage.v[i]).max(at(passage.v_next[i]))
                })
            }
            Meter::Profile { curves } => each(&|i| {
                let (c, q, v) = (&curves[i], passage.q_next[i], passage.v_next[i]);
                let most = |room: f64| ((c.squared * room.max(0.0)).sqrt() - c.offset).max(0.0).min(c.limit);
                (v - most(c.upper - q)).max(-v - most(q - c.lower))
            }),
            Meter::Locked { joint, at } => (passage.q_next[*joint] - at).abs(),
            Meter::Frame { frame, lower, upper } => {
                let p = self.point(*frame, passage).position;
                (0..3).map(|k| (p[k] - upper[k]).max(lower[k] - p[k])).fold(f64::NEG_INFINITY, f64::max)
            }
            Meter::FrameSpeed { frame, limit } => norm(self.point(*frame, passage).velocity) / limit - 1.0,
            Meter::Energy { limit } => {
                self.kinematics.kinetic_energy(passage.q_next, passage.v_next) / limit - 1.0
            }
            Meter::Collision { tool, elbow, post, radius, floor } => {
                let at = |ball: &Ball, gauge: &mut Gauge| gauge.point(ball.frame, passage).position;
                let (p, e) = (at(tool, self), at(elbow, self));
                let apart = |x: [f64; 3]| norm([x[0] - post[0], x[1] - post[1], x[2] - post[2]]);
                let post = (tool.radius + radius - apart(p)).max(elbow.radius + radius - apart(e));
                post.max(floor + tool.radius - p[2])
            }
            Meter::Jerk { soft: true, .. } | Meter::TorqueRate { .. } if !self.known => f64::NEG_INFINITY,
            Meter::Jerk { limit, .. } => {
                each(&|i| (self.a[i] - self.before.0[i]).abs() / self.period.dt / limit - 1.0)
            }
            Meter::TorqueRate { limits } => {
                self.motors(passage);
                each(&|i| (self.tau[i] - self.before.1[i]).abs() / self.period.dt / limits[i] - 1.0)
            }
            Meter::Rows { joints: [a, b], lower, upper, most } => {
                let sum = passage.q_next[*a] + 0.7 * passage.q_next[*b];
                let speed = (passage.v_next[*a] + passage.v_next[*b]).abs();
                (sum - upper).max(lower - sum).max(speed / most - 1.0)
            }
            Meter::MixedRow { joints: [a, b], share, most } => {
                (passage.v_next[*a] + share * self.a[*b]).abs() / most - 1.0
            }
        }
    }

    /// Of one joint: position at the end of every physics step or, without them, at the turning point; speed; acceleration.
    fn joint(&self, i: usize, acceleration: f64, passage: Passage<'_>) -> f64 {
        let (low, high) = (self.model.lower_position_limit()[i], self.model.upper_position_limit()[i]);
        let a = self.a[i];
        let mut beyond = (passage.q_next[i] - high).max(low - passage.q_next[i]);
        let (mut q, mut v) = (passage.q[i], passage.v[i]);
        for _ in 1..self.period.sub_steps {
            v += a * self.period.tau;
            q += v * self.period.tau;
            beyond = beyond.max(q - high).max(low - q);
        }
        let turn = -v / a;
        if self.period.sub_steps == 0 && turn > 0.0 && turn < self.period.dt {
            let extreme = passage.q[i] + 0.5 * passage.v[i] * turn;
            beyond = beyond.max(extreme - high).max(low - extreme);
        }
        let speed = passage.v_next[i].abs() / self.model.velocity_limit()[i] - 1.0;
        beyond.max(speed).max(a.abs() / acceleration - 1.0)
    }

    fn motors(&mut self, passage: Passage<'_>) {
        self.dynamics.motors(&self.period, passage.q, passage.v, &self.a, &mut self.tau);
    }

    fn point(&mut self, frame: FrameId, passage: Passage<'_>) -> PointMotion {
        self.kinematics.update_frames(passage.q_next, passage.v_next, &self.a);
        self.kinematics.point(frame, [0.0; 3])
    }
}

fn norm(x: [f64; 3]) -> f64 {
    x.iter().map(|x| x * x).sum::<f64>().sqrt()
}
