//! Inverse dynamics: from the state and the projected state to the action.

use crate::arrival::{Arrivals, ROUNDS, Within};
use crate::controller::{Parts, held_dofs};
use crate::followers::Followers;
use crate::motors::Motors;
use crate::net::Forward;
use crate::normaliser::CLIP;
use crate::snapshot::{Manifest, SnapshotError};
use nearl_constraints::{Dynamics, Model, Period, PeriodDynamics, Projector, Proposal, StateLayout, Target};

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
/// Pinocchio), on average over the period ([`Dynamics::motors`]); then what the [`Drive`](nearl_constraints::Drive) of each joint is to be sent
/// for it, and with several physics steps in a period what these take ([`PhysicsSteps`](nearl_constraints::PhysicsSteps)).
pub struct AnalyticIdm {
    dynamics: Dynamics,
    dofs: Vec<usize>,
    motors: Motors,
    period: Period,
    pub(crate) arrivals: Arrivals,
    /// What nothing drives, and where the motors and these lead.
    followers: Option<(Followers, PeriodDynamics)>,
    tau: Vec<f64>,
    external: Vec<f64>,
}

impl AnalyticIdm {
    /// Actions are what the task's motors of the joints of `dofs` are sent, held over its period.
    ///
    /// # Errors
    /// [`SnapshotError::Unusable`] for joints whose motors are not known.
    pub fn new(m: &Manifest, model: &Model, dofs: &[usize]) -> Result<Self, SnapshotError> {
        let drives = Parts::drives(m, model, dofs)?;
        let motors = Parts::motors(model, dofs, &drives)?;
        let others = (0..model.nv()).filter(|i| !dofs.contains(i));
        // What a guard does not command follows, unless it is held; for the rest a driver has means of its own that keep it as it is.
        let led: Vec<usize> = match m.guards() {
            true => held_dofs(model, dofs),
            false => others.collect(),
        };
        let driven: Vec<usize> = (0..model.nv()).filter(|i| dofs.contains(i) || led.contains(i)).collect();
        Ok(Self {
            dynamics: Dynamics::new(model),
            arrivals: Arrivals::new(m, model, dofs, (&drives, &motors), &led),
            followers: Followers::new(model, &driven)
                .map(|followers| (followers, PeriodDynamics::new(model, &driven, m.task.period()))),
            motors,
            dofs: dofs.to_vec(),
            period: m.task.period(),
            tau: vec![0.0; model.nv()],
            external: vec![0.0; model.nv()],
        })
    }

    /// What each motor is sent (n_act) to take (q, v) to `target`; of a plain motor it is the force [N m or N], `within` the limits with several
    /// physics steps.
    pub fn action(&mut self, q: &[f64], v: &[f64], target: &Target, within: Within<'_>, action: &mut [f64]) {
        let a = &target.acceleration;
        self.dynamics.motors(&self.period, q, v, a, &mut self.tau);
        let commands = self.arrivals.commands((q, v), target, (a, &self.tau), &self.external, within);
        for (k, &i) in self.dofs.iter().enumerate() {
            action[self.motors.place(k)] = self.motors.action(k, commands[i]);
        }
    }

    /// The same for the `target` that `projector` has just found for `proposal`. Where physics steps lead elsewhere and that matters
    /// ([`Projector::needs_what_is_reached`]) it becomes the nearest one that they lead to.
    pub fn lead(
        &mut self,
        (q, v): (&[f64], &[f64]),
        proposal: &Proposal,
        projector: &mut Projector,
        target: &mut Target,
        action: &mut [f64],
    ) {
        if let Some((followers, dynamics)) = &mut self.followers {
            dynamics.update(q, v, projector.external_forces());
            followers.follow(dynamics, (q, v), proposal, projector, target);
        }
        self.action(q, v, target, projector.limits_of_tick(), action);
        self.arrivals.begin();
        for _ in 0..if projector.needs_what_is_reached() { ROUNDS } else { 0 } {
            let Some(within) = self.arrivals.held_back(v, target) else { break };
            match &mut self.followers {
                Some((followers, dynamics)) => {
                    followers.follow_within(dynamics, (q, v), within, projector, target);
                }
                None => _ = projector.project_within((q, v), proposal, within, target),
            }
            self.action(q, v, target, projector.limits_of_tick(), action);
        }
    }
}
