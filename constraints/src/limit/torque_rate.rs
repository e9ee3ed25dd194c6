//! Limits on how fast motor forces change.

use super::margin::less_each;
use super::{About, Argument, Form, Limit, PerJoint, Takes};
use crate::row::{Motion, Needs, Rows, RowsMut, TickStart};
use crate::{Kind, LimitError, Model, Soft};
use serde::{Deserialize, Serialize};

/// What it says of itself.
pub(super) const ABOUT: About = About {
    class: "TorqueRateLimit",
    promise: "Change of motor forces in a second. Always soft: braking comes first. It needs the tick before.",
    example: "torque_rate = { limit = 1000.0 }",
    form: Form::Soft,
    margin: "[N·m/s, N/s]",
    stricter: Some(["torque_rate = { limit = 1500.0, margin = 500.0 }", "torque_rate = { limit = 1000.0 }"]),
    arguments: &[
        Argument::needed("limit", Takes::PerJoint),
        Argument::or("soft", Takes::Soft, "None"),
        Argument::MARGINS,
    ],
};

/// `torque_rate = { limit }` or `torque_rate = { limit, soft = { linear, quadratic } }`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TorqueRateSettings {
    /// Largest change R [N·m/s or N/s].
    pub limit: PerJoint,
    /// Change kept below the limit [N·m/s or N/s].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub margin: Option<PerJoint>,
    /// How much it resists.
    #[serde(default)]
    pub soft: Soft,
}

/// `|tau - tau_previous| / T <= R`, always soft.
///
/// Braking in front of a position limit may need the force at once, and comes first; what a tick exceeds is reported as
/// slack. Without a tick before it does not hold (see [`Projector::set_previous`](crate::Projector::set_previous)).
#[derive(Debug, Clone)]
pub struct TorqueRateLimit {
    settings: TorqueRateSettings,
}

impl TorqueRateLimit {
    /// From the task file's settings.
    pub fn new(settings: TorqueRateSettings) -> TorqueRateLimit {
        TorqueRateLimit { settings }
    }
}

impl Limit for TorqueRateLimit {
    fn name(&self) -> &'static str {
        "torque_rate"
    }

    fn named_joints(&self) -> Vec<&str> {
        self.settings.limit.names()
    }

    fn rows(&self, model: &Model, controllable: &[usize]) -> Result<Option<Box<dyn Rows>>, LimitError> {
        self.settings.limit.names_some("torque_rate limit")?;
        let domain = "above 0 N·m/s or N/s";
        let mut values = self.settings.limit.values(model, "torque_rate limit", |x| x > 0.0, domain)?;
        less_each(model, "torque_rate margin", &mut values, self.settings.margin.as_ref(), controllable)?;
        let rows = controllable.iter().filter_map(|i| values[*i].map(|rate| (*i, rate, model.dof_name(*i))));
        Ok(Some(Box::new(TorqueRateRows { dofs: rows.collect() })))
    }

    fn soft(&self) -> Option<Soft> {
        Some(self.settings.soft)
    }
}

struct TorqueRateRows {
    /// Dof, limit, joint.
    dofs: Vec<(usize, f64, String)>,
}

impl Rows for TorqueRateRows {
    fn kind(&self) -> Kind {
        Kind::TorqueRate
    }

    fn names(&self) -> Vec<String> {
        self.dofs.iter().map(|(_, _, name)| name.clone()).collect()
    }

    fn sizes(&self) -> Vec<f64> {
        self.dofs.iter().map(|(_, limit, _)| *limit).collect()
    }

    fn needs(&self) -> Needs {
        Needs { motors: true, previous: true, ..Needs::default() }
    }

    fn fill(&mut self, tick: &mut TickStart<'_>, rows: &mut RowsMut<'_>) {
        let Some(previous) = tick.previous else { return };
        let t = tick.period.dt;
        for (r, &(i, limit, _)) in self.dofs.iter().enumerate() {
            tick.motor(i, rows.row(r));
            rows.row(r).iter_mut().for_each(|g| *g /= t);
            let still = (tick.bias[i] - previous.torque[i]) / t;
            (rows.lower[r], rows.upper[r]) = (-limit - still, limit - still);
        }
    }

    fn excess(&mut self, motion: &mut Motion<'_>, excess: &mut [f64]) {
        for (x, &(i, limit, _)) in excess.iter_mut().zip(&self.dofs) {
            let before = motion.previous.map_or(motion.torque[i], |p| p.torque[i]);
            *x = (motion.torque[i] - before).abs() / motion.period.dt / limit - 1.0;
        }
    }
}
