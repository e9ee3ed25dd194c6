//! Motor force limits of the robot file.

use super::margin::{less_each, less_friction};
use super::{About, Argument, Form, Limit, LimitSet, PerJoint, Takes, quoted};
use crate::drive::SHORT;
use crate::row::{Motion, Needs, Rows, RowsMut, TickStart};
use crate::{Kind, LimitError, Model, Soft};
use serde::{Deserialize, Serialize};

/// What it says of itself.
pub(super) const ABOUT: About = About {
    class: "TorqueLimit",
    promise: "Motor forces by Pinocchio, on average over the period, stay below `scale`, a share in (0, 1] of the robot \
        file's limits. What is soft is nothing that a certified or stored brake may count on.",
    example: "torque = { scale = 0.9 }",
    form: Form::Either,
    margin: "[N·m, N]",
    stricter: Some([
        "torque = { scale = 0.55, margin = { panda_joint1 = 8.7, panda_joint2 = 8.7, panda_joint3 = 8.7, panda_joint4 \
        = 8.7, panda_joint5 = 1.2, panda_joint6 = 1.2, panda_joint7 = 1.2 } }",
        "torque = { scale = 0.45 }",
    ]),
    arguments: &[Argument::or("scale", Takes::Number, "1.0"), Argument::MARGINS, Argument::SOFT],
};

/// `torque = { scale }`, also with `margin` and `soft`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TorqueSettings {
    /// Share of the robot file's effort limit, in (0, 1].
    pub scale: f64,
    /// Force kept below that share [N·m or N].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub margin: Option<PerJoint>,
    /// How much it resists; hard when absent. A soft one is no promise that braking may count on.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub soft: Option<Soft>,
}

impl Default for TorqueSettings {
    fn default() -> Self {
        TorqueSettings { scale: 1.0, margin: None, soft: None }
    }
}

/// `|tau| <= scale * effort - margin - friction`, with the motor forces of a whole period,
/// [`Dynamics::motors_without_friction`](crate::Dynamics::motors_without_friction): whichever way a joint rubs, its motor can make up for it.
/// Where physics steps take the damping of a drive implicitly, its force stays below the end by a share of 1e-7: at the end MuJoCo's steps do
/// not.
#[derive(Debug, Clone, Default)]
pub struct TorqueLimit {
    settings: TorqueSettings,
}

impl TorqueLimit {
    /// From the task file's settings.
    pub fn new(settings: TorqueSettings) -> TorqueLimit {
        TorqueLimit { settings }
    }

    /// A share in (0, 1] of the robot file's effort limits.
    pub fn scaled(scale: f64) -> TorqueLimit {
        TorqueLimit { settings: TorqueSettings { scale, ..TorqueSettings::default() } }
    }
}

impl Limit for TorqueLimit {
    fn name(&self) -> &'static str {
        "torque"
    }

    fn restrict(&self, model: &Model, controllable: &[usize], set: &mut LimitSet) -> Result<(), LimitError> {
        let efforts = self.efforts(model, controllable)?;
        for (i, effort) in efforts.into_iter().filter(|_| self.settings.soft.is_none()) {
            set.effort[i] = set.effort[i].min(effort);
        }
        Ok(())
    }

    fn rows(&self, model: &Model, controllable: &[usize]) -> Result<Option<Box<dyn Rows>>, LimitError> {
        let efforts = self.efforts(model, controllable)?;
        let motors = efforts.into_iter().map(|(i, effort)| (i, effort, model.dof_name(i))).collect();
        Ok(Some(Box::new(TorqueRows { motors })))
    }

    fn soft(&self) -> Option<Soft> {
        self.settings.soft
    }
}

impl TorqueLimit {
    /// Dofs and their largest forces.
    pub(super) fn efforts(
        &self,
        model: &Model,
        controllable: &[usize],
    ) -> Result<Vec<(usize, f64)>, LimitError> {
        let scale = self.settings.scale;
        if !(scale > 0.0 && scale <= 1.0) {
            let domain = "above 0 and at most 1";
            return Err(LimitError::BadValue { what: "torque scale".to_string(), value: scale, domain });
        }
        let stated = model.effort_limit();
        let without = |i: &usize| stated[*i].is_infinite() || stated[*i] <= 0.0;
        let missing: Vec<usize> = controllable.iter().copied().filter(without).collect();
        if let Some(error) = missing.iter().find_map(|i| powerless(model, *i)) {
            return Err(error);
        }
        if !missing.is_empty() {
            let next = "write effort (URDF), or ctrlrange of a motor (without <flag clampctrl=\"disable\"/>) or forcerange of a drive (MJCF) into it, or do \
                        not control the joint";
            return Err(LimitError::Missing { limit: "torque", joints: quoted(model, &missing), next });
        }
        let share = |damping: &f64| if *damping > 0.0 { scale * (1.0 - SHORT) } else { scale };
        let shares = model.drive_damping().iter().map(share);
        let mut efforts: Vec<_> =
            stated.iter().zip(shares).map(|(effort, share)| Some(share * effort)).collect();
        less_each(model, "torque margin", &mut efforts, self.settings.margin.as_ref(), controllable)?;
        controllable
            .iter()
            .filter_map(|&i| Some((i, efforts[i]?)))
            .map(|(i, effort)| Ok((i, less_friction(model, i, effort)?)))
            .collect()
    }
}

/// The refusal of a joint whose motor turns no control into torque, or none one way.
fn powerless(model: &Model, dof: usize) -> Option<LimitError> {
    let joint = model.dof_name(dof);
    model.motors().iter().filter(|motor| motor.joint == joint).find_map(|motor| {
        let name = &motor.name;
        let factors = [("gear", motor.gear), ("gain", motor.gain)];
        if let Some((key, _)) = factors.into_iter().find(|(_, factor)| *factor == 0.0) {
            let what = format!("torque is asked for, but motor '{name}' on joint '{joint}' has {key} 0 and gives none");
            let next = "write another number into the robot file, or do not control the joint";
            return Some(LimitError::Unusable { what, next });
        }
        // of a drive they are targets
        let controls = motor.control_range.filter(|_| motor.bias[1] == 0.0 && motor.bias[2] == 0.0);
        let ranges = [("ctrlrange", controls), ("forcerange", motor.force_range)];
        let one_way = |range: Option<[f64; 2]>| range.filter(|[low, high]| *low >= 0.0 || *high <= 0.0);
        let (key, [low, high]) = ranges.into_iter().find_map(|(key, range)| Some((key, one_way(range)?)))?;
        let what = format!(
            "torque is asked for, but the {key} of motor '{name}' on joint '{joint}' is {low} to {high}, which gives no torque one way"
        );
        let next = "write a range that begins below 0 and ends above 0, or do not control the joint";
        Some(LimitError::Unusable { what, next })
    })
}

struct TorqueRows {
    /// Dof, largest force, joint.
    motors: Vec<(usize, f64, String)>,
}

impl Rows for TorqueRows {
    fn kind(&self) -> Kind {
        Kind::Torque
    }

    fn names(&self) -> Vec<String> {
        self.motors.iter().map(|(_, _, joint)| joint.clone()).collect()
    }

    fn sizes(&self) -> Vec<f64> {
        self.motors.iter().map(|(_, effort, _)| *effort).collect()
    }

    fn needs(&self) -> Needs {
        Needs { motors: true, ..Needs::default() }
    }

    fn fill(&mut self, tick: &mut TickStart<'_>, rows: &mut RowsMut<'_>) {
        for (r, &(i, effort, _)) in self.motors.iter().enumerate() {
            tick.motor(i, rows.row(r));
            (rows.lower[r], rows.upper[r]) = (-effort - tick.bias[i], effort - tick.bias[i]);
        }
    }

    fn excess(&mut self, motion: &mut Motion<'_>, excess: &mut [f64]) {
        for (x, &(i, effort, _)) in excess.iter_mut().zip(&self.motors) {
            *x = motion.torque[i].abs() / effort - 1.0;
        }
    }
}
