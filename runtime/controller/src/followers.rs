//! Joints that nothing drives, on the way to a target of the others.

use nearl_constraints::{Dynamics, Model, PeriodDynamics, Projector, Proposal, Status, Target};

/// Dofs that nothing drives or holds, as a guard takes them: a floating base, a pole, a link of a gripper. What they do under the motors that lead the
/// others to their target, they do to these motors too, so that the target is projected again with it:
///
/// ```text
///     a' -> tau' = R a' + b + F(a')      on the driven dofs, while the others follow: a'' of them
///        -> project with a'' -> a'       until a'' is what was reckoned with
/// ```
///
/// The lighter what follows is, the slower this alone would settle, as between a fluid and a light structure in it; each step is longer or shorter by what
/// the one before did (Aitken's relaxation; Küttler and Wall 2008).
pub(crate) struct Followers {
    loose: Vec<usize>,
    /// Entries of the configuration that are theirs.
    places: Vec<usize>,
    proposal: Proposal,
    a: Vec<f64>,
    tau: Vec<f64>,
    /// Tangent displacement of the period, that of the others none, and where it leads.
    step: Vec<f64>,
    q: Vec<f64>,
    /// By which the accelerations of the loose dofs differ from what was reckoned with, now and the time before.
    off: [Vec<f64>; 2],
    /// What was reckoned with when they differed least.
    best: Vec<f64>,
    on: Dynamics,
}

/// How often a tick is projected again.
const ROUNDS: usize = 40;
/// Largest difference of velocities [rad/s or m/s], or as a share of their change where that is above 1, at which the loose dofs do what was reckoned with.
const FOLLOWED: f64 = 1e-11;
/// The longest step, as a multiple of a plain one.
const LONGEST: f64 = 1e4;

impl Followers {
    /// Of the dofs that are none of `driven`; `None` where there are none.
    pub(crate) fn new(model: &Model, driven: &[usize]) -> Option<Followers> {
        let nv = model.nv();
        let loose: Vec<usize> = (0..nv).filter(|i| !driven.contains(i)).collect();
        let joints = model.joints().iter().filter(|joint| loose.contains(&joint.idx_v));
        let places = joints.flat_map(|joint| joint.idx_q..joint.idx_q + joint.nq).collect();
        (!loose.is_empty()).then(|| Followers {
            places,
            proposal: Proposal::new(model),
            a: vec![0.0; nv],
            tau: vec![0.0; nv],
            step: vec![0.0; nv],
            q: model.neutral(),
            off: [vec![0.0; loose.len()], vec![0.0; loose.len()]],
            best: vec![0.0; loose.len()],
            on: Dynamics::new(model),
            loose,
        })
    }

    /// Projects again from `q`, `v` with what the loose dofs do on the way to `target`, which `projector` has just found for `proposal`, until that is what
    /// was reckoned with. `dynamics` are those of this state, with motors on all but the loose dofs.
    pub(crate) fn follow(
        &mut self,
        dynamics: &mut PeriodDynamics,
        (q, v): (&[f64], &[f64]),
        proposal: &Proposal,
        projector: &mut Projector,
        target: &mut Target,
    ) {
        self.proposal.q.copy_from_slice(&proposal.q);
        self.proposal.v.copy_from_slice(&proposal.v);
        // What was asked for may throw them so far that its answer does the same: what they do while the others go on is another beginning.
        if matches!(target.ledger.status, Status::Braked(_) | Status::Slowed) {
            self.a.fill(0.0);
            dynamics.drive(&mut self.a, &mut self.tau);
            for k in 0..self.loose.len() {
                self.propose(dynamics, v, k, self.a[self.loose[k]]);
            }
            self.project((q, v), projector, None, target);
        }
        self.settle(dynamics, (q, v), projector, None, target);
    }

    /// The same for [`Projector::project_within`], from what [`Followers::follow`] has found.
    pub(crate) fn follow_within(
        &mut self,
        dynamics: &mut PeriodDynamics,
        state: (&[f64], &[f64]),
        within: &[[f64; 2]],
        projector: &mut Projector,
        target: &mut Target,
    ) {
        self.project(state, projector, Some(within), target);
        self.settle(dynamics, state, projector, Some(within), target);
    }

    fn settle(
        &mut self,
        dynamics: &mut PeriodDynamics,
        (q, v): (&[f64], &[f64]),
        projector: &mut Projector,
        within: Option<&[[f64; 2]]>,
        target: &mut Target,
    ) {
        let (mut relaxed, mut least) = (1.0, f64::INFINITY);
        for round in 0..ROUNDS {
            let off = self.differ(dynamics, target);
            if off <= FOLLOWED || !off.is_finite() {
                return; // a machine without an answer has none to go on from
            }
            if off < least {
                least = off;
                (0..self.loose.len()).for_each(|k| self.best[k] = target.acceleration[self.loose[k]]);
            }
            if round > 0 {
                relaxed = self.relax(relaxed);
            }
            for k in 0..self.loose.len() {
                self.propose(dynamics, v, k, target.acceleration[self.loose[k]] + relaxed * self.off[0][k]);
            }
            self.project((q, v), projector, within, target);
        }
        if self.differ(dynamics, target) > least {
            (0..self.loose.len()).for_each(|k| self.propose(dynamics, v, k, self.best[k]));
            self.project((q, v), projector, within, target);
        }
    }

    /// Writes by how much the loose dofs accelerate otherwise than `target` has it, and returns the largest difference of their velocities, of changes of
    /// more than 1 as a share.
    fn differ(&mut self, dynamics: &mut PeriodDynamics, target: &Target) -> f64 {
        self.a.copy_from_slice(&target.acceleration);
        dynamics.drive(&mut self.a, &mut self.tau);
        self.off.swap(0, 1);
        let dt = dynamics.period().dt;
        let mut most: f64 = 0.0;
        for (k, &i) in self.loose.iter().enumerate() {
            let off = self.a[i] - target.acceleration[i];
            self.off[0][k] = off;
            let share = dt * off.abs() / (dt * self.a[i].abs()).max(1.0);
            if share > most || share.is_nan() {
                most = share;
            }
        }
        most
    }

    /// The length of the next step after one of `last`.
    fn relax(&self, last: f64) -> f64 {
        let [off, before] = &self.off;
        let (mut along, mut all) = (0.0, 0.0);
        for (off, before) in off.iter().zip(before) {
            let change = off - before;
            along += before * change;
            all += change * change;
        }
        let next = -last * along / all;
        if next.is_finite() && next != 0.0 { next.clamp(-LONGEST, LONGEST) } else { 1.0 }
    }

    /// Proposes for the `k`-th loose dof what an acceleration leads to.
    fn propose(&mut self, dynamics: &PeriodDynamics, v: &[f64], k: usize, acceleration: f64) {
        let (t, kappa, i) = (dynamics.period().dt, dynamics.period().kappa, self.loose[k]);
        let y = t * acceleration;
        self.proposal.v[i] = v[i] + y;
        self.step[i] = t * v[i] + kappa * t * y;
    }

    fn project(
        &mut self,
        (q, v): (&[f64], &[f64]),
        projector: &mut Projector,
        within: Option<&[[f64; 2]]>,
        target: &mut Target,
    ) {
        self.on.integrate(q, &self.step, &mut self.q);
        for &at in &self.places {
            self.proposal.q[at] = self.q[at];
        }
        match within {
            Some(within) => projector.project_within((q, v), &self.proposal, within, target),
            None => projector.project_beside((q, v), &self.proposal, target),
        };
    }
}
