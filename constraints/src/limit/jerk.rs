//! Jerk limits.

use super::margin::less_each;
use super::{About, Argument, Form, Limit, LimitSet, PerJoint, Takes};
use crate::row::{Motion, Needs, Rows, RowsMut, TickStart};
use crate::{Kind, LimitError, Model, Period, Soft};
use serde::{Deserialize, Serialize};

/// What it says of itself.
pub(super) const ABOUT: About = About {
    class: "JerkLimit",
    promise: "Change of acceleration in a second [rad/s³, m/s³]. Soft, braking comes first. With `hard`, position, \
        velocity, acceleration and jerk of a joint hold at once. It needs the tick before.",
    example: "jerk = { limit = 500.0 }",
    form: Form::Soft,
    margin: "[rad/s³, m/s³]; hard with `hard = true`",
    stricter: Some(["jerk = { limit = 600.0, margin = 100.0 }", "jerk = { limit = 500.0 }"]),
    arguments: &[
        Argument::needed("limit", Takes::PerJoint),
        Argument::or("soft", Takes::Soft, "None"),
        Argument::MARGINS,
        Argument::named("hard", Takes::Flag, "False"),
    ],
};

/// `jerk = { limit }`, `jerk = { limit, soft = { linear, quadratic } }` or `jerk = { limit, hard = true }`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Written", into = "Written")]
pub struct JerkSettings {
    /// Largest jerk J [rad/s³ or m/s³].
    pub limit: PerJoint,
    /// Jerk kept below the limit [rad/s³ or m/s³].
    pub margin: Option<PerJoint>,
    /// How much it resists; `None` is hard.
    pub soft: Option<Soft>,
}

/// As in the task file, where it is soft unless something else is said.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Written {
    limit: PerJoint,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    margin: Option<PerJoint>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    soft: Option<Soft>,
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    hard: bool,
}

impl TryFrom<Written> for JerkSettings {
    type Error = &'static str;

    fn try_from(w: Written) -> Result<JerkSettings, &'static str> {
        let soft = match (w.hard, w.soft) {
            (true, Some(_)) => return Err("jerk is hard and has weights of a soft one; drop hard or soft"),
            (true, None) => None,
            (false, soft) => Some(soft.unwrap_or_default()),
        };
        Ok(JerkSettings { limit: w.limit, margin: w.margin, soft })
    }
}

impl From<JerkSettings> for Written {
    fn from(s: JerkSettings) -> Written {
        Written { limit: s.limit, margin: s.margin, soft: s.soft, hard: s.soft.is_none() }
    }
}

/// `|y / T - a_previous| / T <= J`, soft or hard.
///
/// Soft, braking in front of a position limit comes first: it may need the acceleration at once. What a tick exceeds is reported as slack.
/// Hard, the joint has a viable set of its own ([`jerk`](crate::jerk)) and brakes in front of everything with its jerk. Without a
/// tick before, a soft one does not hold, and a hard one not for joints that move (see
/// [`Projector::set_previous`](crate::Projector::set_previous)).
#[derive(Debug, Clone)]
pub struct JerkLimit {
    settings: JerkSettings,
    /// Share of J that braking counts on.
    share: f64,
}

impl JerkLimit {
    /// From the task file's settings.
    pub fn new(settings: JerkSettings) -> JerkLimit {
        JerkLimit { settings, share: 1.0 }
    }

    /// The same for a plant that moves through a period in such a way ([`Period::counted`]).
    pub fn over_steps(settings: JerkSettings, period: &Period) -> JerkLimit {
        JerkLimit { settings, share: period.counted() }
    }

    /// A hard limit [rad/s³ or m/s³] for every joint.
    pub fn hard(limit: f64) -> JerkLimit {
        JerkLimit::new(JerkSettings { limit: PerJoint::All(limit), margin: None, soft: None })
    }

    /// Limits less margins of the dofs that have one.
    fn values(&self, model: &Model, controllable: &[usize]) -> Result<Vec<Option<f64>>, LimitError> {
        self.settings.limit.names_some("jerk limit")?;
        let mut values =
            self.settings.limit.values(model, "jerk limit", |x| x > 0.0, "above 0 rad/s³ or m/s³")?;
        less_each(model, "jerk margin", &mut values, self.settings.margin.as_ref(), controllable)?;
        Ok(values)
    }
}

impl Limit for JerkLimit {
    fn name(&self) -> &'static str {
        "jerk"
    }

    fn named_joints(&self) -> Vec<&str> {
        self.settings.limit.names()
    }

    fn restrict(&self, model: &Model, controllable: &[usize], set: &mut LimitSet) -> Result<(), LimitError> {
        if self.settings.soft.is_some() {
            return Ok(());
        }
        let values = self.values(model, controllable)?;
        for &i in controllable {
            let jerk = values[i].unwrap_or(f64::INFINITY);
            set.jerk[i] = set.jerk[i].min(jerk);
            set.braking_jerk[i] = set.braking_jerk[i].min(self.share * jerk);
        }
        Ok(())
    }

    fn rows(&self, model: &Model, controllable: &[usize]) -> Result<Option<Box<dyn Rows>>, LimitError> {
        if self.settings.soft.is_none() {
            return Ok(None);
        }
        let values = self.values(model, controllable)?;
        let rows = controllable.iter().filter_map(|i| values[*i].map(|j| (*i, j, model.dof_name(*i))));
        Ok(Some(Box::new(JerkRows { dofs: rows.collect() })))
    }

    fn soft(&self) -> Option<Soft> {
        self.settings.soft
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
