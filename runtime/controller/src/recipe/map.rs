//! From a policy's outputs to what the motors are sent.

use super::PolicySection;
use super::source::one_dof;
use crate::motors::Motors;
use nearl_constraints::{Drive, Model, StateLayout};

/// `command_j = offset_i + scale_i clip(output_i)`, where joint `j` of the controller is joint `i` of the policy, and what its motor is sent for that
/// command, in the order of the motors.
#[derive(Clone, Debug)]
pub struct ActionMap {
    /// By joint of the policy: which controllable joint it is.
    to: Vec<usize>,
    motors: Motors,
    scale: Vec<f32>,
    offset: Vec<f32>,
    clip: Vec<[f32; 2]>,
    sent: Vec<f32>,
}

impl ActionMap {
    /// `drives` (nv) says what the joints are commanded.
    ///
    /// # Errors
    /// One sentence naming the joint or the key.
    pub fn new(
        policy: &PolicySection,
        model: &Model,
        layout: &StateLayout,
        drives: &[Drive],
        motors: Motors,
    ) -> Result<Self, String> {
        let n = policy.joints.len();
        let driven = layout.controllable();
        let place = |name: &String| -> Result<usize, String> {
            let joint = one_dof(model, name).map_err(|e| format!("policy.joints: {e}"))?;
            driven.iter().position(|&dof| dof == joint.idx_v).ok_or_else(|| {
                format!(
                    "policy.joints names '{name}', which is not controllable; add it to state.controllable"
                )
            })
        };
        let to = policy.joints.iter().map(place).collect::<Result<Vec<_>, _>>()?;
        if let Some(k) = (0..driven.len()).find(|k| to.iter().filter(|t| *t == k).count() != 1) {
            let name = model.dof_name(driven[k]);
            return Err(format!("policy.joints must name the controllable joint '{name}' once"));
        }
        let a = &policy.action;
        let f32s = |values: Vec<f64>| values.into_iter().map(|x| x as f32).collect::<Vec<f32>>();
        let clip = match &a.clip {
            None => vec![[f32::NEG_INFINITY, f32::INFINITY]; n],
            Some([lower, upper]) => {
                let lower = f32s(lower.spread("policy.action.clip", n)?);
                let upper = f32s(upper.spread("policy.action.clip", n)?);
                if let Some((l, u)) = lower.iter().zip(&upper).find(|(l, u)| l > u) {
                    return Err(format!("policy.action.clip goes from {l} to {u}; give the lower first"));
                }
                lower.into_iter().zip(upper).map(|(l, u)| [l, u]).collect()
            }
        };
        let positions: Vec<bool> = to.iter().map(|&k| drives[driven[k]].takes_position()).collect();
        let offset = policy.offset(&positions)?;
        Ok(Self {
            scale: f32s(a.scale.spread("policy.action.scale", n)?),
            offset: f32s(offset),
            sent: vec![0.0; n],
            clip,
            to,
            motors,
        })
    }

    /// Number of joints.
    pub fn len(&self) -> usize {
        self.to.len()
    }

    /// Whether there are no joints.
    pub fn is_empty(&self) -> bool {
        self.to.is_empty()
    }

    /// Clips `outputs` (n_act) as the policy sees its last action.
    pub fn clip(&self, outputs: &mut [f32]) {
        for (x, [lower, upper]) in outputs.iter_mut().zip(&self.clip) {
            *x = x.clamp(*lower, *upper);
        }
    }

    /// Replaces clipped outputs (n_act) by what the motors are sent, in their order.
    pub fn command(&mut self, outputs: &mut [f32]) {
        for (i, &k) in self.to.iter().enumerate() {
            let command = self.scale[i].mul_add(outputs[i], self.offset[i]);
            self.sent[self.motors.place(k)] = self.motors.action(k, f64::from(command)) as f32;
        }
        outputs.copy_from_slice(&self.sent);
    }
}
