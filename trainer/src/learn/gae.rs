//! Generalised advantage estimation (Schulman et al. 2016). Truncation is not termination.

/// Advantages and returns of one segment.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Advantages {
    /// Advantage of each step.
    pub advantage: Vec<f32>,
    /// Advantage plus value: the target of the value network.
    pub returns: Vec<f32>,
}

/// `delta_t = r_t + gamma V(s_{t+1}) - V(s_t)`, `A_t = delta_t + gamma lambda A_{t+1}`.
///
/// A terminal state has no value; a cut step takes `V` of its true final observation (`final_value`, one for each cut
/// step in order), and no advantage flows across either.
pub fn advantages(
    reward: &[f32],
    value: &[f32],
    terminated: &[bool],
    truncated: &[bool],
    final_value: &[f32],
    gamma: f32,
    lambda: f32,
) -> Advantages {
    let n = reward.len();
    let mut out = Advantages { advantage: vec![0.0; n], returns: vec![0.0; n] };
    let (mut cut, mut next_advantage) = (final_value.len(), 0.0);
    for t in (0..n).rev() {
        let next_value = if terminated[t] {
            0.0
        } else if truncated[t] {
            cut -= 1;
            final_value[cut]
        } else {
            value[t + 1]
        };
        if terminated[t] || truncated[t] {
            next_advantage = 0.0;
        }
        let delta = reward[t] + gamma * next_value - value[t];
        next_advantage = delta + gamma * lambda * next_advantage;
        out.advantage[t] = next_advantage;
        out.returns[t] = next_advantage + value[t];
    }
    out
}

#[cfg(test)]
mod tests {
    use super::advantages;

    /// gamma = lambda = 1/2; rewards 1 2 3 4; values 10 20 30 40; step 1 is cut (final value 8), step 3 terminal.
    #[test]
    fn equals_hand_computed_numbers() {
        let a = advantages(
            &[1.0, 2.0, 3.0, 4.0],
            &[10.0, 20.0, 30.0, 40.0],
            &[false, false, false, true],
            &[false, true, false, false],
            &[8.0],
            0.5,
            0.5,
        );
        // step 3: 4 - 40 = -36; step 2: 3 + 20 - 30 = -7, + 1/4 * -36 = -16
        // step 1: 2 + 4 - 20 = -14;  step 0: 1 + 10 - 10 = 1, + 1/4 * -14 = -2.5
        assert_eq!(a.advantage, [-2.5, -14.0, -16.0, -36.0]);
        assert_eq!(a.returns, [7.5, 6.0, 14.0, 4.0]);
    }
}
