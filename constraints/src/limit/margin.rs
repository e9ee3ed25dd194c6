//! Margins make a limit tighter by the distance that is to be kept from it. This file also refuses soft limits of kinds that can only be hard.

use super::PerJoint;
use crate::{LimitError, Model};
use serde::de::Error;
use serde::{Deserialize, Deserializer};

/// `limit - margin`; `what` is what messages call the margin.
pub(super) fn less(what: &str, limit: f64, margin: f64) -> Result<f64, LimitError> {
    match margin >= 0.0 && margin < limit {
        true => Ok(limit - margin),
        false => Err(LimitError::BadValue { what: what.to_string(), value: margin, domain: BELOW }),
    }
}

/// Limits of joints less their margins, for the dofs of `controllable`; `what` is what messages call it.
pub(super) fn less_each(
    model: &Model,
    what: &'static str,
    limits: &mut [Option<f64>],
    margin: Option<&PerJoint>,
    controllable: &[usize],
) -> Result<(), LimitError> {
    let Some(margin) = margin else { return Ok(()) };
    let margins = margin.values(model, what, |x| x >= 0.0, "at least 0, in the unit of the limit")?;
    for &i in controllable {
        if let (Some(limit), Some(margin)) = (limits[i], margins[i]) {
            let joint = format!("{what} of joint '{}'", model.dof_name(i));
            limits[i] = Some(less(&joint, limit, margin)?);
        }
    }
    Ok(())
}

/// What is left of the largest force of the motor of dof `i` where the joint's dry friction may take its share either way.
pub(super) fn less_friction(model: &Model, i: usize, effort: f64) -> Result<f64, LimitError> {
    let friction = model.friction()[i];
    if friction < effort {
        return Ok(effort - friction);
    }
    let joint = model.dof_name(i);
    let what = format!(
        "the motor of '{joint}' may give {effort} N·m or N, no more than the joint's dry friction of {friction} N·m or N"
    );
    Err(LimitError::Unusable { what, next: "allow it more force, or mend the friction in the robot file" })
}

/// What a margin must be.
const BELOW: &str = "at least 0 and below the limit it is kept from";

pub(super) fn is_zero(x: &f64) -> bool {
    *x == 0.0
}

/// In place of `soft` in limits that have no soft form: anything written there is refused.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct AlwaysHard;

impl<'de> Deserialize<'de> for AlwaysHard {
    fn deserialize<D: Deserializer<'de>>(_: D) -> Result<AlwaysHard, D::Error> {
        Err(D::Error::custom(
            "position, velocity and acceleration are always hard, because braking counts on them; drop soft, or write a soft row \
             over q.<joint>, v.<joint> or a.<joint> under rows",
        ))
    }
}
