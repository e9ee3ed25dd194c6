//! Limits of single joints as plain numbers: range, speed, acceleration and braking of each.

use super::{Limit, listed};
use crate::viability::Profile;
use crate::{LimitError, Model};

/// The numbers all limits boil down to, one per dof (nv); infinite is none.
#[derive(Debug, Clone, PartialEq)]
pub struct LimitSet {
    /// Lowest position [rad or m].
    pub q_lower: Vec<f64>,
    /// Highest position [rad or m].
    pub q_upper: Vec<f64>,
    /// Largest speed V [rad/s or m/s].
    pub velocity: Vec<f64>,
    /// Largest acceleration A [rad/s² or m/s²].
    pub acceleration: Vec<f64>,
    /// Deceleration braking may count on, at most A [rad/s² or m/s²].
    pub braking: Vec<f64>,
    /// Largest jerk that is hard [rad/s³ or m/s³].
    pub jerk: Vec<f64>,
    /// Jerk braking may count on, at most the one that is hard [rad/s³ or m/s³].
    pub braking_jerk: Vec<f64>,
    /// Largest motor force [N·m or N].
    pub effort: Vec<f64>,
    /// Speed limits in front of a lowest and a highest position.
    pub profile: Vec<[Option<Profile>; 2]>,
    /// Dofs that must stop and stay.
    pub locked: Vec<bool>,
}

impl LimitSet {
    /// No limits on `nv` dofs.
    pub fn unlimited(nv: usize) -> LimitSet {
        let none = vec![f64::INFINITY; nv];
        LimitSet {
            q_lower: vec![f64::NEG_INFINITY; nv],
            q_upper: none.clone(),
            velocity: none.clone(),
            acceleration: none.clone(),
            braking: none.clone(),
            jerk: none.clone(),
            braking_jerk: none.clone(),
            effort: none,
            profile: vec![[None, None]; nv],
            locked: vec![false; nv],
        }
    }

    /// All `limits` together.
    ///
    /// # Errors
    /// Those of the limits; limits without any state between them.
    pub fn collect(
        model: &Model,
        limits: &[Box<dyn Limit>],
        controllable: &[usize],
    ) -> Result<LimitSet, LimitError> {
        let mut set = LimitSet::unlimited(model.nv());
        for limit in limits {
            limit.restrict(model, controllable, &mut set)?;
        }
        set.check(model, controllable)?;
        Ok(set)
    }

    /// Refuses limits that leave no state.
    pub(crate) fn check(&self, model: &Model, controllable: &[usize]) -> Result<(), LimitError> {
        let empty = |i: &&usize| self.q_lower[**i] >= self.q_upper[**i];
        let list = listed(controllable.iter().filter(empty), |i| {
            let (low, high) = (self.q_lower[i], self.q_upper[i]);
            format!("joint '{}' would have to stay above {low} and below {high} rad or m", model.dof_name(i))
        });
        if list.is_empty() { Ok(()) } else { Err(LimitError::Contradictory { list }) }
    }

    /// Removes all limits, keeping the memory.
    pub(crate) fn clear(&mut self) {
        self.q_lower.fill(f64::NEG_INFINITY);
        for x in [
            &mut self.q_upper,
            &mut self.velocity,
            &mut self.acceleration,
            &mut self.braking,
            &mut self.jerk,
            &mut self.braking_jerk,
            &mut self.effort,
        ] {
            x.fill(f64::INFINITY);
        }
        self.profile.fill([None, None]);
        self.locked.fill(false);
    }

    /// Both this and `other`.
    pub(crate) fn tighten(&mut self, other: &LimitSet) {
        let least =
            |own: &mut [f64], other: &[f64]| own.iter_mut().zip(other).for_each(|(x, y)| *x = x.min(*y));
        self.q_lower.iter_mut().zip(&other.q_lower).for_each(|(x, y)| *x = x.max(*y));
        least(&mut self.q_upper, &other.q_upper);
        least(&mut self.velocity, &other.velocity);
        least(&mut self.acceleration, &other.acceleration);
        least(&mut self.braking, &other.braking);
        least(&mut self.jerk, &other.jerk);
        least(&mut self.braking_jerk, &other.braking_jerk);
        least(&mut self.effort, &other.effort);
        for (own, other) in self.profile.iter_mut().zip(&other.profile) {
            *own = [own[0].or(other[0]), own[1].or(other[1])];
        }
        self.locked.iter_mut().zip(&other.locked).for_each(|(x, y)| *x |= y);
    }

    /// True when the jerk of some dof is hard.
    pub fn has_jerk(&self) -> bool {
        self.jerk.iter().any(|jerk| jerk.is_finite())
    }

    /// True when the dof has a lower or an upper position limit.
    pub fn has_position(&self, dof: usize) -> bool {
        self.q_lower[dof].is_finite() || self.q_upper[dof].is_finite()
    }
}
