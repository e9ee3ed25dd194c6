//! The rows and cones of all limits, filled tick by tick into the problem of the controllable dofs.

use super::Dofs;
use super::coupled::Coupled;
use crate::row::{Cone, Needs, Place, Previous, Rows, RowsMut, TickStart};
use crate::{Dynamics, Kind, Kinematics, Limit, LimitError, LimitSet, Model, Period, Soft};

/// Where rows come from, and the memory they are written to.
pub(crate) struct Sources {
    blocks: Vec<Block>,
    cones: Vec<ConeBlock>,
    needs: Needs,
    scratch: Scratch,
    kinematics: Kinematics,
    /// `G` over all dofs of the largest block.
    g: Vec<f64>,
    /// Rows beyond whose boundary the measured state is.
    outside: Vec<bool>,
}

/// What the dynamics say about the tick.
struct Scratch {
    mass: Vec<f64>,
    motors: Vec<f64>,
    bias: Vec<f64>,
    still: Vec<f64>,
}

struct Block {
    rows: Box<dyn Rows>,
    limit: usize,
    first: usize,
    sizes: Vec<f64>,
    soft: Option<Soft>,
    enabled: bool,
    /// It was moved.
    moved: bool,
    /// How much of it may be put elsewhere.
    places: usize,
}

struct ConeBlock {
    cone: Box<dyn Cone>,
    limit: usize,
    size: f64,
    soft: Option<Soft>,
    enabled: bool,
    /// Share of the radius that is in force.
    share: f64,
}

/// The measured state and what acts on the robot beside its motors.
pub(crate) struct Measured<'a> {
    pub(crate) q: &'a [f64],
    pub(crate) v: &'a [f64],
    /// Generalised forces from outside (nv).
    pub(crate) external: &'a [f64],
    pub(crate) previous: Option<Previous<'a>>,
}

/// What a row or cone is reported as.
#[derive(Debug, Clone)]
pub(crate) struct Label {
    pub(crate) kind: Kind,
    pub(crate) name: String,
}

impl Sources {
    pub(crate) fn new(
        model: &Model,
        (limits, set): (&[Box<dyn Limit>], &LimitSet),
        controllable: &[usize],
    ) -> Result<Sources, LimitError> {
        let (mut blocks, mut cones, mut first) = (Vec::new(), Vec::new(), 0);
        for (limit, l) in limits.iter().enumerate() {
            if let Some(mut rows) = l.rows(model, controllable)? {
                rows.fit(set)?;
                let (sizes, soft) = (rows.sizes(), l.soft());
                check_sizes(&sizes, rows.names().len(), soft, l.label())?;
                let places = rows.places().len();
                let block = Block { first, limit, soft, enabled: true, moved: false, places, rows, sizes };
                first += block.sizes.len();
                blocks.push(block);
            }
            if let Some(cone) = l.cone(model, controllable)? {
                let (size, soft) = (cone.size(), l.soft());
                check_sizes(&[size], 1, soft, l.label())?;
                cones.push(ConeBlock { limit, size, soft, enabled: true, share: 1.0, cone });
            }
        }
        let needs = blocks.iter().map(|b| b.rows.needs()).chain(cones.iter().map(|c| c.cone.needs()));
        let needs = needs.fold(Needs::default(), Needs::and);
        let (nv, zero) = (model.nv(), || vec![0.0; model.nv()]);
        let largest = blocks.iter().map(|b| b.sizes.len()).chain(cones.iter().map(|c| c.cone.dimension()));
        let g = vec![0.0; nv * largest.max().unwrap_or(0)];
        let scratch =
            Scratch { mass: vec![0.0; nv * nv], motors: vec![0.0; nv * nv], bias: zero(), still: zero() };
        let outside = vec![false; first];
        Ok(Sources { blocks, cones, needs, scratch, kinematics: Kinematics::new(model), g, outside })
    }

    /// No rows and no cones.
    pub(crate) fn is_empty(&self) -> bool {
        self.blocks.iter().all(|b| b.sizes.is_empty()) && self.cones.is_empty()
    }

    /// Some hard row or cone is of what several joints do together. One of what motors give is of the forces that a plant is sent.
    pub(crate) fn couples_joints(&self) -> bool {
        let of_motion =
            |kind: Kind| !matches!(kind, Kind::Torque | Kind::TorqueSpeed | Kind::TorqueRate | Kind::Jerk);
        self.blocks.iter().any(|b| b.soft.is_none() && !b.sizes.is_empty() && of_motion(b.rows.kind()))
            || self.cones.iter().any(|c| c.soft.is_none() && of_motion(c.cone.kind()))
    }

    /// Reports of all rows, then of all cones.
    pub(crate) fn labels(&self) -> Vec<Label> {
        let rows = self.blocks.iter().flat_map(|b| {
            let kind = b.rows.kind();
            b.rows.names().into_iter().map(move |name| Label { kind, name })
        });
        rows.chain(self.cones.iter().map(|c| Label { kind: c.cone.kind(), name: c.cone.name() })).collect()
    }

    /// Softness of each row.
    pub(crate) fn softness(&self) -> Vec<Option<Soft>> {
        self.blocks.iter().flat_map(|b| vec![b.soft; b.sizes.len()]).collect()
    }

    /// Which rows are equalities without softness; a soft one is a row of no width.
    pub(crate) fn equalities(&self) -> Vec<bool> {
        self.blocks.iter().flat_map(|b| vec![b.rows.equality() && b.soft.is_none(); b.sizes.len()]).collect()
    }

    /// Which rows ask for more than they keep.
    pub(crate) fn asks_more(&self) -> Vec<bool> {
        self.blocks.iter().flat_map(|b| vec![b.rows.asks_more(); b.sizes.len()]).collect()
    }

    /// Rows of the matrix of each cone, and its softness.
    pub(crate) fn cones(&self) -> Vec<(usize, Option<Soft>)> {
        self.cones.iter().map(|c| (c.cone.dimension(), c.soft)).collect()
    }

    /// Hard rows beyond whose boundary the state last filled in is, ascending.
    pub(crate) fn outside(&self) -> impl Iterator<Item = usize> {
        let hard = self.blocks.iter().filter(|b| b.soft.is_none());
        hard.flat_map(|b| b.first..b.first + b.sizes.len()).filter(|r| self.outside[*r])
    }

    /// Switches the rows and cones of a limit.
    pub(crate) fn enable(&mut self, limit: usize, on: bool) {
        self.blocks.iter_mut().filter(|b| b.limit == limit).for_each(|b| b.enabled = on);
        self.cones.iter_mut().filter(|c| c.limit == limit).for_each(|c| c.enabled = on);
    }

    /// Moves the rows of a limit inside by `inset` [m].
    pub(crate) fn inset(&mut self, limit: usize, inset: f64) {
        for block in self.blocks.iter_mut().filter(|b| b.limit == limit) {
            block.moved = block.rows.inset(inset) && inset > 0.0;
        }
    }

    /// What may be put elsewhere: of which limit, whether that is hard, and where it is.
    pub(crate) fn places(&self) -> impl Iterator<Item = (usize, bool, Place)> {
        let of = |b: &Block| {
            let (limit, hard) = (b.limit, b.soft.is_none());
            b.rows.places().into_iter().map(move |place| (limit, hard, place))
        };
        self.blocks.iter().flat_map(of)
    }

    /// Puts [`Sources::places`] where the numbers say; `built` are those of the build.
    pub(crate) fn put(&mut self, numbers: &[[f64; 6]], built: &[[f64; 6]]) {
        let mut first = 0;
        for block in &mut self.blocks {
            let own = first..first + block.places;
            block.rows.put(&numbers[own.clone()]);
            block.moved |= numbers[own.clone()] != built[own.clone()];
            first = own.end;
        }
    }

    /// The largest inset of the rows of a limit [m], and whether they are hard; `None` where it has no rows that move.
    pub(crate) fn most_inset(&self, limit: usize) -> Option<(f64, bool)> {
        let block = self.blocks.iter().find(|b| b.limit == limit)?;
        let most = block.rows.most_inset();
        (most > 0.0).then_some((most, block.soft.is_none()))
    }

    /// The row is of a limit that was moved.
    pub(crate) fn is_moved(&self, row: usize) -> bool {
        self.blocks.iter().any(|b| b.moved && (b.first..b.first + b.sizes.len()).contains(&row))
    }

    /// Which limit each cone is of, its size, and whether it is hard.
    pub(crate) fn cone_limits(&self) -> impl Iterator<Item = (usize, f64, bool)> {
        self.cones.iter().map(|c| (c.limit, c.size, c.soft.is_none()))
    }

    /// The share of its radius that cone `c` has in the ticks to come.
    pub(crate) fn set_share(&mut self, c: usize, share: f64) {
        self.cones[c].share = share;
    }

    /// Writes the rows and cones of the tick, as shares of their sizes; `y` (nv) holds the velocity change of the dofs
    /// that are not controllable.
    pub(crate) fn fill(
        &mut self,
        problem: &mut Coupled,
        dynamics: &mut Dynamics,
        measured: &Measured<'_>,
        dofs: &Dofs,
        y: &[f64],
        period: &Period,
    ) {
        let (q, v, s) = (measured.q, measured.v, &mut self.scratch);
        if self.needs.mass {
            dynamics.mass(q, &mut s.mass);
        }
        if self.needs.motors {
            dynamics.motor_rows(period, q, v, &mut s.motors, &mut s.bias);
            s.bias.iter_mut().zip(measured.external).for_each(|(bias, external)| *bias -= external);
        }
        if self.needs.kinematics {
            self.kinematics.update(q, v, &s.still);
        }
        let (mass, motors, bias) = (&s.mass[..], &s.motors[..], &s.bias[..]);
        let previous = measured.previous;
        let mut tick =
            TickStart { q, v, period, mass, motors, bias, kinematics: &mut self.kinematics, previous };
        let nv = v.len();
        self.outside.fill(false);
        for block in &mut self.blocks {
            let rows = block.first..block.first + block.sizes.len();
            problem.row_lower[rows.clone()].fill(f64::NEG_INFINITY);
            problem.row_upper[rows.clone()].fill(f64::INFINITY);
            let g = &mut self.g[..nv * block.sizes.len()];
            g.fill(0.0);
            if block.enabled {
                let (lower, upper) =
                    (&mut problem.row_lower[rows.clone()], &mut problem.row_upper[rows.clone()]);
                let outside = &mut self.outside[rows];
                block.rows.fill(&mut tick, &mut RowsMut { g, lower, upper, outside, nv });
            }
            let equal = block.soft.is_none() && block.rows.equality();
            for (r, size) in block.sizes.iter().enumerate() {
                let row = block.first + r;
                problem.take_row(row, &self.g[r * nv..(r + 1) * nv], *size, dofs, y);
                if equal && self.outside[row] {
                    problem.bring_nearer(row);
                }
                problem.equality[row] = equal && !self.outside[row];
            }
        }
        for (c, block) in self.cones.iter_mut().enumerate() {
            let cone = &mut problem.cones[c];
            let g = &mut self.g[..nv * cone.c.len()];
            g.fill(0.0);
            cone.c.fill(0.0);
            cone.radius = f64::INFINITY;
            if block.enabled {
                cone.radius = block.share * block.cone.fill(&mut tick, g, &mut cone.c) / block.size;
            }
            cone.take(g, nv, block.size, dofs, y);
        }
    }
}

impl Needs {
    /// What either needs.
    pub(crate) fn and(self, other: Needs) -> Needs {
        Needs {
            mass: self.mass || other.mass,
            motors: self.motors || other.motors,
            kinematics: self.kinematics || other.kinematics,
            previous: self.previous || other.previous,
        }
    }
}

/// Weights beyond this leave the range of the solver; what is to hold so is hard.
const HEAVIEST: f64 = 1e12;

fn check_sizes(sizes: &[f64], names: usize, soft: Option<Soft>, label: &str) -> Result<(), LimitError> {
    let bad = |what: &str, value, domain| {
        Err(LimitError::BadValue { what: format!("{what} of limit '{label}'"), value, domain })
    };
    if let Some(size) = sizes.iter().find(|x| !(**x > 0.0 && x.is_finite())) {
        return bad("size of a row", *size, "above 0");
    }
    if names != sizes.len() {
        return bad("number of row names", names as f64, "the number of rows");
    }
    match soft {
        Some(s) if !(s.linear >= 0.0 && s.linear <= HEAVIEST) => {
            bad("soft.linear", s.linear, "at least 0 and at most 1e12")
        }
        Some(s) if !(s.quadratic > 0.0 && s.quadratic <= HEAVIEST) => {
            bad("soft.quadratic", s.quadratic, "above 0 and at most 1e12")
        }
        _ => Ok(()),
    }
}
