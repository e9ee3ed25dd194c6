//! Where the numbers of a term come from.

use super::{PolicySection, Term, TermKind};
use crate::controller::State;
use nearl_constraints::convention::to_body;
use nearl_constraints::{Joint, Model, StateLayout};

/// A term's values before clip and scale.
#[derive(Clone, Debug)]
pub(super) enum Source {
    /// Configuration indices, and what is taken from each.
    Position(Vec<(usize, f64)>),
    /// Degrees of freedom.
    Velocity(Vec<usize>),
    /// Configuration index of the base, and the unit vector of gravity in the world.
    Gravity(usize, [f64; 3]),
    /// Degree of freedom of the base, and the point in its axes [m].
    Linear(usize, [f64; 3]),
    /// Degree of freedom of the base.
    Angular(usize),
    /// Entries of the plant's observation.
    Observed(Vec<usize>),
    Constant(Vec<f64>),
    /// So many outputs.
    LastAction(usize),
    /// Cycles in a second, shifts in cycles.
    Phase(f64, Vec<f64>),
}

impl Source {
    /// # Errors
    /// One sentence naming what the robot or the plant does not have.
    pub(super) fn new(
        term: &Term,
        policy: &PolicySection,
        model: &Model,
        layout: &StateLayout,
    ) -> Result<Self, String> {
        if let Some(key) = unread(term) {
            return Err(format!("it has {key}, which '{}' does not read; take it out", term.term.name()));
        }
        let joints = term.joints.as_ref().unwrap_or(&policy.joints);
        let single = || joints.iter().map(|name| one_dof(model, name)).collect::<Result<Vec<_>, _>>();
        Ok(match term.term {
            TermKind::JointPos => {
                let from = |j: &Joint| pose(policy, &j.name);
                Self::Position(single()?.into_iter().map(|j| (j.idx_q, from(j))).collect())
            }
            TermKind::JointVel => Self::Velocity(single()?.into_iter().map(|j| j.idx_v).collect()),
            TermKind::ProjectedGravity => Self::Gravity(base(model)?.idx_q, model.description().down()),
            TermKind::BaseLinVel => Self::Linear(base(model)?.idx_v, term.point.unwrap_or_default()),
            TermKind::BaseAngVel => Self::Angular(base(model)?.idx_v),
            TermKind::Command if !term.value.is_empty() => Self::Constant(term.value.clone()),
            TermKind::Command | TermKind::Observed => Self::Observed(observed(term, layout)?),
            TermKind::Constant if term.value.is_empty() => {
                return Err("it has no value; give a list of numbers".into());
            }
            TermKind::Constant => Self::Constant(term.value.clone()),
            TermKind::LastAction => Self::LastAction(policy.joints.len()),
            TermKind::Phase => {
                let period = term.period.filter(|p| p.is_finite() && *p > 0.0);
                let period = period.ok_or("it has no period; give the duration of a cycle in seconds")?;
                Self::Phase(
                    1.0 / period,
                    if term.shifts.is_empty() { vec![0.0] } else { term.shifts.clone() },
                )
            }
        })
    }

    /// Number of values.
    pub(super) fn width(&self) -> usize {
        match self {
            Self::Position(list) => list.len(),
            Self::Velocity(list) | Self::Observed(list) => list.len(),
            Self::Gravity(..) | Self::Linear(..) | Self::Angular(_) => 3,
            Self::Constant(values) => values.len(),
            Self::LastAction(n) => *n,
            Self::Phase(_, shifts) => 2 * shifts.len(),
        }
    }

    /// Writes the values (width); `last` are the policy's outputs before, `time` is that since the reset [s].
    pub(super) fn write(&self, state: &State, last: &[f32], time: f64, to: &mut [f64]) {
        match self {
            Self::Position(list) => {
                to.iter_mut().zip(list).for_each(|(x, &(iq, from))| *x = state.q[iq] - from)
            }
            Self::Velocity(list) => to.iter_mut().zip(list).for_each(|(x, &dof)| *x = state.v[dof]),
            Self::Gravity(iq, down) => to.copy_from_slice(&to_body(&state.q[iq + 3..iq + 7], *down)),
            Self::Linear(dof, [x, y, z]) => {
                let (v, w) = (&state.v[*dof..dof + 3], &state.v[dof + 3..dof + 6]);
                let turned = [w[1] * z - w[2] * y, w[2] * x - w[0] * z, w[0] * y - w[1] * x];
                (0..3).for_each(|k| to[k] = v[k] + turned[k]);
            }
            Self::Angular(dof) => to.copy_from_slice(&state.v[dof + 3..dof + 6]),
            Self::Observed(list) => to.iter_mut().zip(list).for_each(|(x, &i)| *x = state.obs[i]),
            Self::Constant(values) => to.copy_from_slice(values),
            Self::LastAction(_) => to.iter_mut().zip(last).for_each(|(x, &a)| *x = f64::from(a)),
            Self::Phase(rate, shifts) => {
                let (cos, sin) = to.split_at_mut(shifts.len());
                for (k, shift) in shifts.iter().enumerate() {
                    let angle = std::f64::consts::TAU * (rate * time + shift);
                    (cos[k], sin[k]) = (angle.cos(), angle.sin());
                }
            }
        }
    }
}

/// A key of a term that its kind does not read.
fn unread(term: &Term) -> Option<&'static str> {
    let reads: &[&str] = match term.term {
        TermKind::JointPos | TermKind::JointVel => &["joints"],
        TermKind::BaseLinVel => &["point"],
        TermKind::Command => &["entries", "value"],
        TermKind::Observed => &["entries"],
        TermKind::Constant => &["value"],
        TermKind::Phase => &["period", "shifts"],
        TermKind::ProjectedGravity | TermKind::BaseAngVel | TermKind::LastAction => &[],
    };
    let has = [
        ("joints", term.joints.is_some()),
        ("entries", !term.entries.is_empty()),
        ("value", !term.value.is_empty()),
        ("period", term.period.is_some()),
        ("shifts", !term.shifts.is_empty()),
        ("point", term.point.is_some()),
    ];
    has.into_iter().find(|(key, there)| *there && !reads.contains(key)).map(|(key, _)| key)
}

/// A joint with one degree of freedom and one position.
pub(super) fn one_dof<'m>(model: &'m Model, name: &str) -> Result<&'m Joint, String> {
    let joint = model.joint(name).map_err(|e| e.to_string())?;
    if joint.nq != 1 || joint.nv != 1 {
        return Err(format!(
            "joint '{name}' has {} positions, where a policy's joint has one; take it out",
            joint.nq
        ));
    }
    Ok(joint)
}

/// The pose's position of a joint, 0 where it does not say.
pub(super) fn pose(policy: &PolicySection, joint: &str) -> f64 {
    let at = policy.joints.iter().position(|name| name == joint);
    at.and_then(|at| policy.pose.get(at)).copied().unwrap_or(0.0)
}

fn base(model: &Model) -> Result<&Joint, String> {
    let free = model.joints().iter().find(|j| j.nq == 7 && j.nv == 6);
    free.ok_or_else(|| "the robot's base is fixed, so its state has none; give a robot with a free base (model.free_flyer = true)".into())
}

fn observed(term: &Term, layout: &StateLayout) -> Result<Vec<usize>, String> {
    if term.entries.is_empty() {
        return Err(
            "it names no entries; say which entries of the plant's observation it reads, or give a value"
                .into(),
        );
    }
    let find = |name: &String| {
        let at = layout.names().iter().position(|n| n == name);
        at.ok_or_else(|| format!("the plant does not observe '{name}'; add it to state.observation"))
    };
    term.entries.iter().map(find).collect()
}
