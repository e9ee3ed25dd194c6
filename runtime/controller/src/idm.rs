//! Inverse dynamics: from the state and the projected state to the action.

use crate::net::Forward;
use crate::normaliser::CLIP;
use nearl_constraints::{Dynamics, Model, Period, StateLayout, Target};

/// A Gaussian network I(a | s_c, s'_c): the mean action from the observation entries of S_c and their
/// projected change, both in network space.
pub struct LearnedIdm {
    net: Forward,
    /// Observation index of each seen entry.
    observation: Vec<usize>,
    /// Index into the proposed state of each seen entry.
    state: Vec<usize>,
    input: Vec<f32>,
}

impl LearnedIdm {
    /// `seen`: indices into the proposed state; the same entries are read from the observation.
    pub fn new(net: Forward, layout: &StateLayout, seen: &[usize]) -> Self {
        let observation = seen.iter().map(|&k| layout.state()[k]).collect();
        Self { net, observation, state: seen.to_vec(), input: vec![0.0; 2 * seen.len()] }
    }

    /// Replaces the network by one of the same shape.
    pub fn set_net(&mut self, net: Forward) {
        self.net = net;
    }

    /// Mean action (n_act) for network input `x` (n_obs) and change `w` (n_state).
    pub fn mean(&mut self, x: &[f32], w: &[f32]) -> &[f32] {
        let n = self.state.len();
        for k in 0..n {
            self.input[k] = x[self.observation[k]];
            self.input[n + k] = w[self.state[k]].clamp(-CLIP as f32, CLIP as f32);
        }
        self.net.forward(&self.input)
    }
}

/// Recursive Newton-Euler on the robot model: `tau = M(q) a + nle(q, v) - tau_passive` with `a = (v' - v) / dt` (Featherstone 2008; through
/// Pinocchio), on average over the period ([`Dynamics::motors`]).
pub struct AnalyticIdm {
    dynamics: Dynamics,
    dofs: Vec<usize>,
    period: Period,
    tau: Vec<f64>,
}

impl AnalyticIdm {
    /// Actions are the torques of `dofs`, in that order, held over `period`.
    pub fn new(model: &Model, dofs: &[usize], period: Period) -> Self {
        Self { dynamics: Dynamics::new(model), dofs: dofs.to_vec(), period, tau: vec![0.0; model.nv()] }
    }

    /// Torque in [N m] or [N] that takes (q, v) to `target`, written to `action` (n_act).
    pub fn torque(&mut self, q: &[f64], v: &[f64], target: &Target, action: &mut [f64]) {
        self.dynamics.motors(&self.period, q, v, &target.acceleration, &mut self.tau);
        for (a, &d) in action.iter_mut().zip(&self.dofs) {
            *a = self.tau[d];
        }
    }
}
