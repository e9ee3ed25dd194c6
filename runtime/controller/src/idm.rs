//! Inverse dynamics: from the state and the projected state to the action.

use crate::motors::Motors;
use crate::net::Forward;
use crate::normaliser::CLIP;
use nearl_constraints::drive::Arrival;
use nearl_constraints::{Drive, Dynamics, Model, Period, StateLayout, Target};

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
/// Pinocchio), on average over the period ([`Dynamics::motors`]); then what the [`Drive`] of each joint is to be sent for it.
pub struct AnalyticIdm {
    dynamics: Dynamics,
    joints: Vec<Joint>,
    motors: Motors,
    period: Period,
    tau: Vec<f64>,
}

struct Joint {
    dof: usize,
    idx_q: usize,
    drive: Drive,
}

impl AnalyticIdm {
    /// Actions are what the `motors` of the joints of `dofs` are sent, held over `period`; `drives` (nv) says what the joints are commanded.
    pub fn new(model: &Model, dofs: &[usize], drives: &[Drive], motors: Motors, period: Period) -> Self {
        let joint = |&dof: &usize| Joint { dof, idx_q: model.joint_of_dof(dof).idx_q, drive: drives[dof] };
        let joints = dofs.iter().map(joint).collect();
        Self { dynamics: Dynamics::new(model), joints, motors, period, tau: vec![0.0; model.nv()] }
    }

    /// What each motor is sent (n_act) to take (q, v) to `target`; of a plain motor it is the force [N m or N].
    pub fn action(&mut self, q: &[f64], v: &[f64], target: &Target, action: &mut [f64]) {
        self.dynamics.motors(&self.period, q, v, &target.acceleration, &mut self.tau);
        for (k, joint) in self.joints.iter().enumerate() {
            let &Joint { dof, idx_q, drive } = joint;
            let to = Arrival {
                q: target.q[idx_q],
                v: target.v[dof],
                a: target.acceleration[dof],
                tau: self.tau[dof],
            };
            let command = drive.command(&self.period, q[idx_q], v[dof], &to);
            action[self.motors.place(k)] = self.motors.action(k, command);
        }
    }
}
