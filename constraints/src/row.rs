//! Coupled limits: rows and cones over the velocity change `y = v' - v` of all dofs.
//!
//! A limit that ties several dofs together hands the projector a [`Rows`] or a [`Cone`]. Both are asked twice a tick: `fill`
//! writes the constraint for the solver, and `excess` evaluates what was meant at the final target for the
//! [`checker`](crate::checker). The two must not share their formula: rows come from Jacobians and mass matrices, the checker from
//! forward kinematics and inverse dynamics.

use crate::{Kind, Kinematics, LimitError, LimitSet, Period};
use serde::{Deserialize, Serialize};

/// What is known at the start of a tick. Lengths nq and nv; units rad or m, s, N·m or N.
pub struct TickStart<'a> {
    /// Configuration (nq).
    pub q: &'a [f64],
    /// Velocity (nv).
    pub v: &'a [f64],
    /// The control period.
    pub period: &'a Period,
    /// Mass matrix (nv x nv, symmetric); zero unless some row has [`Needs::mass`].
    pub mass: &'a [f64],
    /// What an acceleration costs the motors (nv x nv, row-major), [`Dynamics::motor_rows`](crate::Dynamics::motor_rows); zero unless
    /// some row has [`Needs::motors`].
    pub motors: &'a [f64],
    /// What the motors supply without acceleration (nv), less the external forces; zero unless some row has [`Needs::motors`].
    pub bias: &'a [f64],
    /// Frames and Jacobians at `q`, `v` and zero acceleration; stale unless some row has [`Needs::kinematics`].
    pub kinematics: &'a mut Kinematics,
    /// The tick before, where it is known.
    pub previous: Option<Previous<'a>>,
}

impl TickStart<'_> {
    /// Writes `g` (nv), by which the force of motor `i` rises for a unit of velocity change: row `i` of `motors / T`.
    pub fn motor(&self, i: usize, g: &mut [f64]) {
        let (nv, t) = (self.v.len(), self.period.dt);
        for (g, row) in g.iter_mut().zip(&self.motors[i * nv..(i + 1) * nv]) {
            *g = row / t;
        }
    }
}

/// What the tick before asked of the robot.
#[derive(Debug, Clone, Copy)]
pub struct Previous<'a> {
    /// Acceleration (nv).
    pub acceleration: &'a [f64],
    /// Motor force (nv).
    pub torque: &'a [f64],
}

/// The step from measured state to target, for the checker.
pub struct Motion<'a> {
    /// Measured configuration (nq).
    pub q: &'a [f64],
    /// Measured velocity (nv).
    pub v: &'a [f64],
    /// Next configuration (nq).
    pub q_next: &'a [f64],
    /// Next velocity (nv).
    pub v_next: &'a [f64],
    /// `(v' - v) / T` (nv).
    pub acceleration: &'a [f64],
    /// Motor force for that acceleration by inverse dynamics (nv),
    /// [`Dynamics::motors_without_friction`](crate::Dynamics::motors_without_friction) less the external forces;
    /// zero unless some row has [`Needs::motors`].
    pub torque: &'a [f64],
    /// Mass matrix (nv x nv, symmetric) at `q`; zero unless some row has [`Needs::mass`].
    pub mass: &'a [f64],
    /// The control period.
    pub period: &'a Period,
    /// Frames at `q`, `v` and that acceleration; stale unless some row has [`Needs::kinematics`].
    pub kinematics: &'a mut Kinematics,
    /// The tick before, where it is known.
    pub previous: Option<Previous<'a>>,
}

/// What of a [`TickStart`] and a [`Motion`] a limit reads; the rest is not computed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Needs {
    /// Mass matrix.
    pub mass: bool,
    /// Motor forces.
    pub motors: bool,
    /// Frames and Jacobians.
    pub kinematics: bool,
    /// Acceleration and motor force of the tick before.
    pub previous: bool,
}

/// A plane or an obstacle that an operator may put elsewhere.
#[derive(Debug, Clone, PartialEq)]
pub struct Place {
    /// Name of an obstacle; `None` is the plane of the limit itself.
    pub name: Option<String>,
    /// Of an obstacle position \[m\], roll, pitch and yaw \[rad\]; of a plane the unit normal, its distance from the origin along that, without
    /// the margin \[m\], and two zeros.
    pub numbers: [f64; 6],
}

/// Memory of the rows of one limit; `lower <= G y <= upper`.
pub struct RowsMut<'a> {
    /// `G` (rows x nv, row-major), zero at the start of each tick.
    pub g: &'a mut [f64],
    /// Lower bounds; minus infinity at the start of each tick.
    pub lower: &'a mut [f64],
    /// Upper bounds; infinity at the start of each tick.
    pub upper: &'a mut [f64],
    /// The measured state is beyond the boundary that the row keeps; false at the start of each tick.
    pub outside: &'a mut [bool],
    /// nv.
    pub nv: usize,
}

impl RowsMut<'_> {
    /// Row `r` of `G` (nv).
    pub fn row(&mut self, r: usize) -> &mut [f64] {
        &mut self.g[r * self.nv..(r + 1) * self.nv]
    }
}

/// Linear rows of one limit.
pub trait Rows: Send {
    /// What an active row is reported as.
    fn kind(&self) -> Kind;

    /// What each row is of: a joint, a frame, a pair of bodies.
    fn names(&self) -> Vec<String>;

    /// The size of each row's limit, in the unit of the row: what tolerances and scaling are shares of; above 0.
    fn sizes(&self) -> Vec<f64>;

    /// What `fill` and `excess` read.
    fn needs(&self) -> Needs;

    /// True when `lower` and `upper` are equal wherever the state is not [`outside`](RowsMut::outside).
    fn equality(&self) -> bool {
        false
    }

    /// Takes what single joints may do, before the rows are asked anything.
    ///
    /// # Errors
    /// The joints cannot do what the rows ask for.
    fn fit(&mut self, limits: &LimitSet) -> Result<(), LimitError> {
        let _ = limits;
        Ok(())
    }

    /// Dofs that a brake slows down in proportion, so that sums of them that the rows hold at a value stay there.
    fn in_proportion(&self) -> Vec<usize> {
        Vec::new()
    }

    /// True when the rows ask for more than [`breach`](Rows::breach) keeps, so that a way to stop is left: where a stored brake is
    /// verified for that, a tick may do without them.
    fn asks_more(&self) -> bool {
        false
    }

    /// True when joints that brake as they may can break the rows, whatever their motors give: a brake has to be stored for them.
    fn needs_a_brake(&self) -> bool {
        false
    }

    /// By how much less than it keeps each row is verified for in a brake, as a share of its size: what a plant makes of the periods of a brake may differ
    /// from what it was verified as.
    fn reserves(&self) -> Vec<f64> {
        vec![0.0; self.sizes().len()]
    }

    /// True when what the rows keep is of the state that a motion ends in, so that a measured state may be beyond it already and come back.
    /// False when it is of the motion: no state is beyond it then.
    fn of_state(&self) -> bool {
        matches!(self.kind(), Kind::Frame | Kind::Collision | Kind::User)
    }

    /// Moves what the rows keep this far \[m\] further inside than it was built, for the ticks to come; false, and nothing is done, where that
    /// means nothing. Must not allocate.
    fn inset(&mut self, by: f64) -> bool {
        let _ = by;
        false
    }

    /// The largest [`Rows::inset`] that leaves anything \[m\]; 0 where that means nothing.
    fn most_inset(&self) -> f64 {
        0.0
    }

    /// What of it may be put elsewhere while the robot runs, and where it is.
    fn places(&self) -> Vec<Place> {
        Vec::new()
    }

    /// Puts each of [`Rows::places`], in their order, where these numbers say. Must not allocate.
    fn put(&mut self, numbers: &[[f64; 6]]) {
        let _ = numbers;
    }

    /// Writes the rows of the tick. Must not allocate.
    fn fill(&mut self, tick: &mut TickStart<'_>, rows: &mut RowsMut<'_>);

    /// Writes by how much the motion exceeds the limit of each row, as a share of its size; negative inside. Must not allocate.
    fn excess(&mut self, motion: &mut Motion<'_>, excess: &mut [f64]);

    /// Writes by how much the motion or the state it ends in breaks what each row is there to keep, above 0 where it does, in any unit
    /// that is continuous along a motion, and no larger one of two curves: each is a row of its own. A brake is verified for this, by its bends between
    /// the ticks looked at: [`excess`](Rows::excess) may ask for more, so that a way to stop is left. Minus infinity is a row that no brake can keep. Must
    /// not allocate.
    fn breach(&mut self, motion: &mut Motion<'_>, breach: &mut [f64]) {
        self.excess(motion, breach);
    }
}

/// One second-order cone `|G y + c| <= radius`.
pub trait Cone: Send {
    /// What the active cone is reported as.
    fn kind(&self) -> Kind;

    /// What it is of: a frame, the robot.
    fn name(&self) -> String;

    /// Rows of `G`.
    fn dimension(&self) -> usize;

    /// Radius, in the unit of the cone: what tolerances are shares of; above 0.
    fn size(&self) -> f64;

    /// What `fill` and `excess` read.
    fn needs(&self) -> Needs;

    /// Writes `G` (dimension x nv, row-major, zero before) and `c` (dimension), and returns the radius. Must not allocate.
    fn fill(&mut self, tick: &mut TickStart<'_>, g: &mut [f64], c: &mut [f64]) -> f64;

    /// By how much the motion exceeds the cone, as a share of its size; negative inside. Must not allocate.
    fn excess(&mut self, motion: &mut Motion<'_>) -> f64;

    /// By how much the state that the motion ends in is beyond the cone, see [`Rows::breach`]. Must not allocate.
    fn breach(&mut self, motion: &mut Motion<'_>) -> f64 {
        self.excess(motion)
    }
}

/// How much a soft limit resists: the projector minimises `linear s + 1/2 quadratic s^2` beside the distance, with the slack `s` as a
/// share of the limit's size, in units of the distance that the largest velocity change of one period makes.
///
/// With a `linear` part the limit holds exactly until the proposal pulls harder than that.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Soft {
    /// Linear weight, at least 0.
    pub linear: f64,
    /// Quadratic weight, above 0.
    pub quadratic: f64,
}

impl Default for Soft {
    fn default() -> Soft {
        Soft { linear: 1.0, quadratic: 100.0 }
    }
}
