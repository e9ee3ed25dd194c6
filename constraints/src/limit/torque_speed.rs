//! Motors whose force falls with speed.

use super::margin::{less_each, less_friction};
use super::{About, Argument, Form, Limit, PerJoint, Takes};
use crate::row::{Motion, Needs, Rows, RowsMut, TickStart};
use crate::{Kind, LimitError, Model, Soft};
use serde::{Deserialize, Serialize};

/// What it says of itself.
pub(super) const ABOUT: About = About {
    class: "TorqueSpeedLimit",
    promise: "The line of a direct-current motor: `|tau + stall / no_load v| <= stall - margin` in [N·m, N] and [rad/s, \
        m/s], at the speeds with which a period begins and ends.",
    example: "torque_speed = { stall = 80.0, no_load = 3.0 }",
    form: Form::Either,
    margin: "of force, at every speed [N·m, N]",
    stricter: Some([
        "torque_speed = { stall = 80.0, no_load = 3.0, margin = 40.0 }",
        "torque_speed = { stall = 40.0, no_load = 1.5 }",
    ]),
    arguments: &[
        Argument::needed("stall", Takes::PerJoint),
        Argument::needed("no_load", Takes::PerJoint),
        Argument::or("soft", Takes::Soft, "None"),
        Argument::MARGINS,
    ],
};

/// `torque_speed = { stall, no_load }`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TorqueSpeedSettings {
    /// Force at standstill [N·m or N].
    pub stall: PerJoint,
    /// Speed at which no force is left [rad/s or m/s].
    pub no_load: PerJoint,
    /// Force kept below the line [N·m or N].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub margin: Option<PerJoint>,
    /// How much it resists; hard when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub soft: Option<Soft>,
}

/// The line of a direct-current motor, in both directions:
///
/// ```text
///     |tau + (stall / no_load) v'| <= stall - margin,   |tau + (stall / no_load) v| <= stall - margin
/// ```
///
/// at the speed `v'` that the tick ends with and the speed `v` that it begins with: the force acts all the while, and the speed is between the
/// two. The gearbox's own limit, flat in speed, is [`TorqueLimit`](super::TorqueLimit).
#[derive(Debug, Clone)]
pub struct TorqueSpeedLimit {
    settings: TorqueSpeedSettings,
}

impl TorqueSpeedLimit {
    /// From the task file's settings.
    pub fn new(settings: TorqueSpeedSettings) -> TorqueSpeedLimit {
        TorqueSpeedLimit { settings }
    }
}

impl Limit for TorqueSpeedLimit {
    fn name(&self) -> &'static str {
        "torque_speed"
    }

    fn named_joints(&self) -> Vec<&str> {
        self.settings.stall.names()
    }

    fn rows(&self, model: &Model, controllable: &[usize]) -> Result<Option<Box<dyn Rows>>, LimitError> {
        let positive = |x: f64| x > 0.0;
        let stall = self.settings.stall.values(model, "torque_speed stall", positive, "above 0 N·m or N")?;
        let no_load =
            self.settings.no_load.values(model, "torque_speed no_load", positive, "above 0 rad/s or m/s")?;
        self.settings.stall.names_some("torque_speed stall")?;
        self.settings.no_load.names_some("torque_speed no_load")?;
        let halves =
            stall.iter().zip(&no_load).position(|(stall, no_load)| stall.is_some() != no_load.is_some());
        if let Some(i) = halves {
            let (has, lacks) = if stall[i].is_some() { ("stall", "no_load") } else { ("no_load", "stall") };
            return Err(LimitError::Unusable {
                what: format!("torque_speed names joint '{}' in {has} and not in {lacks}", model.dof_name(i)),
                next: "name the same joints in both, or give one number for all",
            });
        }
        let mut most = stall.clone();
        less_each(model, "torque_speed margin", &mut most, self.settings.margin.as_ref(), controllable)?;
        for (i, most) in most.iter_mut().enumerate() {
            *most = most.map(|most| less_friction(model, i, most)).transpose()?;
        }
        let motor = |i: &usize| {
            let (most, slope) = (most[*i]?, stall[*i]? / no_load[*i]?);
            Some(Motor { dof: *i, most, slope, joint: model.dof_name(*i) })
        };
        Ok(Some(Box::new(TorqueSpeedRows { motors: controllable.iter().filter_map(motor).collect() })))
    }

    fn soft(&self) -> Option<Soft> {
        self.settings.soft
    }
}

struct Motor {
    dof: usize,
    /// Stall force less the margin.
    most: f64,
    slope: f64,
    joint: String,
}

struct TorqueSpeedRows {
    motors: Vec<Motor>,
}

impl Rows for TorqueSpeedRows {
    fn kind(&self) -> Kind {
        Kind::TorqueSpeed
    }

    fn names(&self) -> Vec<String> {
        let ends = self.motors.iter().map(|m| m.joint.clone());
        ends.chain(self.motors.iter().map(|m| format!("{} at the start", m.joint))).collect()
    }

    fn sizes(&self) -> Vec<f64> {
        self.motors.iter().chain(&self.motors).map(|m| m.most).collect()
    }

    fn needs(&self) -> Needs {
        Needs { motors: true, ..Needs::default() }
    }

    fn fill(&mut self, tick: &mut TickStart<'_>, rows: &mut RowsMut<'_>) {
        let starts = self.motors.len();
        for (r, m) in self.motors.iter().enumerate() {
            let i = m.dof;
            tick.motor(i, rows.row(r));
            rows.row(r)[i] += m.slope;
            tick.motor(i, rows.row(starts + r));
            let still = tick.bias[i] + m.slope * tick.v[i];
            for r in [r, starts + r] {
                (rows.lower[r], rows.upper[r]) = (-m.most - still, m.most - still);
            }
        }
    }

    fn excess(&mut self, motion: &mut Motion<'_>, excess: &mut [f64]) {
        let (ends, starts) = excess.split_at_mut(self.motors.len());
        for (x, v) in [(ends, motion.v_next), (starts, motion.v)] {
            for (x, m) in x.iter_mut().zip(&self.motors) {
                *x = ((motion.torque[m.dof] + m.slope * v[m.dof]) / m.most).abs() - 1.0;
            }
        }
    }
}
