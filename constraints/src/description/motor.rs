//! From a control to a joint's force and back.

use serde::{Deserialize, Serialize};

/// What a control means.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Command {
    /// The motor's force, up to gain and bias.
    Effort,
    /// A position that the motor pulls the joint to.
    Position,
    /// A velocity that the motor brings the joint to.
    Velocity,
    /// A position, with a damper of the motor's own.
    Pd,
}

/// A motor on a joint with one dof:
///
/// ```text
///     force  = gain u + bias_0 + bias_1 gear q + bias_2 gear v        within force_range, u within control_range
///     torque = gear force
/// ```
///
/// A drive with gains `kp`, `kd` and gear 1 has gain `kp` and bias `(0, -kp, -kd)`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Motor {
    /// Name.
    pub name: String,
    /// Name of the joint.
    pub joint: String,
    /// Which entry of the plant's controls it takes.
    pub order: usize,
    /// What the control means.
    pub command: Command,
    /// Torque per force; the motor moves `gear` times as far as the joint.
    pub gear: f64,
    /// Force per control.
    pub gain: f64,
    /// Force without control, per motor position and per motor velocity.
    pub bias: [f64; 3],
    /// Smallest and largest control; beyond them it has no further effect.
    pub control_range: Option<[f64; 2]>,
    /// Smallest and largest force.
    pub force_range: Option<[f64; 2]>,
    /// Why the law above is not all of it, e.g. dynamics of its own; then torques cannot be turned into controls.
    pub not_modelled: Option<String>,
}

impl Motor {
    /// A motor whose control is the torque of the joint, within `-effort..effort` if there is one.
    pub fn direct(joint: &str, order: usize, effort: Option<f64>) -> Motor {
        Motor {
            name: joint.to_string(),
            joint: joint.to_string(),
            order,
            command: Command::Effort,
            gear: 1.0,
            gain: 1.0,
            bias: [0.0; 3],
            control_range: effort.map(|effort| [-effort, effort]),
            force_range: None,
            not_modelled: None,
        }
    }

    /// Torque [N·m or N] on the joint at position `q` and velocity `v` for the control `u`, which is cut to its range as the force is.
    pub fn torque(&self, u: f64, q: f64, v: f64) -> f64 {
        let u = cut(u, self.control_range);
        self.gear * cut(self.gain * u + self.passive(q, v), self.force_range)
    }

    /// The control for `torque` [N·m or N] at position `q` and velocity `v`, whatever its range: the inverse of [`Motor::torque`].
    pub fn control(&self, torque: f64, q: f64, v: f64) -> f64 {
        (torque / self.gear - self.passive(q, v)) / self.gain
    }

    /// Whether it is a drive of positions, with any damping: it pushes with `gain (u - q)`.
    pub fn follows_positions(&self) -> bool {
        self.not_modelled.is_none() && self.gain > 0.0 && self.bias[1] == -self.gain
    }

    /// Whether it is a drive of speeds: it pushes with `gain (u - v)`.
    pub fn follows_speeds(&self) -> bool {
        self.not_modelled.is_none() && self.gain > 0.0 && self.bias[1] == 0.0 && self.bias[2] == -self.gain
    }

    /// Force for the control 0.
    fn passive(&self, q: f64, v: f64) -> f64 {
        let [constant, per_position, per_velocity] = self.bias;
        constant + per_position * self.gear * q + per_velocity * self.gear * v
    }

    /// The largest torque that it gives in both directions in every state [N·m or N]; infinite where no range bounds it.
    pub fn strength(&self) -> f64 {
        let [constant, per_position, per_velocity] = self.bias;
        let mut force = f64::INFINITY;
        if let Some(range) = self.control_range
            && self.not_modelled.is_none()
            && (per_position, per_velocity) == (0.0, 0.0)
        {
            let ends = range.map(|u| self.gain * u + constant);
            force = weaker([ends[0].min(ends[1]), ends[0].max(ends[1])]);
        }
        if let Some(range) = self.force_range {
            force = force.min(weaker(range));
        }
        self.gear.abs() * force
    }
}

fn cut(x: f64, range: Option<[f64; 2]>) -> f64 {
    range.map_or(x, |[low, high]| x.max(low).min(high))
}

/// What is there in both directions.
fn weaker([low, high]: [f64; 2]) -> f64 {
    (-low).min(high).max(0.0)
}
