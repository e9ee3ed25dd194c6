//! Jerk limits.

use super::margin::less_each;
use super::{Limit, PerJoint};
use crate::row::{Motion, Needs, Rows, RowsMut, TickStart};
use crate::{Kind, LimitError, Model, Soft};
use serde::{Deserialize, Serialize};

/// `jerk = { limit }` or `jerk = { limit, soft = { linear, quadratic } }`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JerkSettings {
    /// Largest jerk J [rad/s³ or m/s³].
    pub limit: PerJoint,
    /// Jerk kept below the limit [rad/s³ or m/s³].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub margin: Option<PerJoint>,
    /// How much it resists.
    #[serde(default)]
    pub soft: Soft,
}

/// `|y / T - a_previous| / T <= J`, always soft.
///
/// It has no viable set of its own: braking in front of a position limit may need the acceleration at once, and comes
/// first. What a tick exceeds is reported as slack. Without a tick before it does not hold (see
/// [`Projector::set_previous`](crate::Projector::set_previous)).
#[derive(Debug, Clone)]
pub struct JerkLimit {
    settings: JerkSettings,
}

impl JerkLimit {
    /// From the task file's settings.
    pub fn new(settings: JerkSettings) -> JerkLimit {
        JerkLimit { settings }
    }
}

impl Limit for JerkLimit {
    fn name(&self) -> &'static str {
        "jerk"
    }

    fn rows(&self, model: &Model, controllable: &[usize]) -> Result<Option<Box<dyn Rows>>, LimitError> {
        let mut values =
            self.settings.limit.values(model, "jerk limit", |x| x > 0.0, "above 0 rad/s³ or m/s³")?;
        less_each(model, "jerk margin", &mut values, self.settings.margin.as_ref(), controllable)?;
        let rows = controllable.iter().filter_map(|i| values[*i].map(|j| (*i, j, model.dof_name(*i))));
        Ok(Some(Box::new(JerkRows { dofs: rows.collect() })))
    }

    fn soft(&self) -> Option<Soft> {
        Some(self.settings.soft)
    }
}

struct JerkRows {
    /// Dof, limit, joint.
    dofs: Vec<(usize, f64, String)>,
}

impl Rows for JerkRows {
    fn kind(&self) -> Kind {
        Kind::Jerk
    }

    fn names(&self) -> Vec<String> {
        self.dofs.iter().map(|(_, _, name)| name.clone()).collect()
    }

    fn sizes(&self) -> Vec<f64> {
        self.dofs.iter().map(|(_, limit, _)| *limit).collect()
    }

    fn needs(&self) -> Needs {
        Needs { previous: true, ..Needs::default() }
    }

    fn fill(&mut self, tick: &mut TickStart<'_>, rows: &mut RowsMut<'_>) {
        let Some(previous) = tick.previous else { return };
        let t = tick.period.dt;
        for (r, &(i, limit, _)) in self.dofs.iter().enumerate() {
            rows.row(r)[i] = 1.0 / (t * t);
            let before = previous.acceleration[i] / t;
            (rows.lower[r], rows.upper[r]) = (before - limit, before + limit);
        }
    }

    fn excess(&mut self, motion: &mut Motion<'_>, excess: &mut [f64]) {
        for (x, &(i, limit, _)) in excess.iter_mut().zip(&self.dofs) {
            let before = motion.previous.map_or(motion.acceleration[i], |p| p.acceleration[i]);
            *x = (motion.acceleration[i] - before).abs() / motion.period.dt / limit - 1.0;
        }
    }
}
