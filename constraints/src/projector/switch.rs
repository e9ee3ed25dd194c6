//! What may be changed between ticks: limits on and off, forces from outside, the tick before.

use super::Projector;
use super::build::check_combination;
use crate::jerk::Brake;
use crate::row::Previous;
use crate::viability::Dof;
use crate::{Kind, LimitError, LimitSet, Proposal, Target};

impl Projector {
    /// Switches every limit with that label (see [`Limit::label`](crate::Limit::label)) on or off, for the ticks to come.
    ///
    /// # Errors
    /// An unknown label, or limits that make no sense without it; nothing is changed then. An error allocates.
    pub fn set_enabled(&mut self, label: &str, on: bool) -> Result<(), LimitError> {
        if !self.switches.iter().any(|s| s.label == label) {
            let known = self.switches.iter().map(|s| s.label.as_str());
            let near = crate::error::near_names(label, known);
            return Err(LimitError::Unusable {
                what: format!("no limit is called '{label}'{near}"),
                next: "name one of the projector's limits",
            });
        }
        if self.switches.iter().all(|s| s.label != label || s.enabled == on) {
            return Ok(());
        }
        self.collect_enabled(label, on);
        let sound = self.limits.check(&self.model, &self.dofs.controllable).and_then(|()| {
            check_combination(
                &self.model,
                &self.limits,
                &self.dofs,
                (self.settings.consistency, self.settings.braking),
            )
        });
        let sound = match self.moving.on && self.limits.has_jerk() {
            true => Err(LimitError::Unusable {
                what: "jerk would become hard while limits are moved, from which no way is declared with it"
                    .into(),
                next: "move the limits back first",
            }),
            false => sound,
        };
        if let Err(error) = sound {
            self.collect_enabled(label, !on); // limits of one label are always alike
            return Err(error);
        }
        for (limit, switch) in self.switches.iter().enumerate() {
            if let Some(stages) = &mut self.coupled {
                stages.sources.enable(limit, switch.enabled);
            }
            self.checker.enable(limit, switch.enabled, &self.limits);
            self.backup.enable(limit, switch.enabled, &self.limits);
        }
        self.take_moved();
        Ok(())
    }

    /// Labels of all limits and whether they hold.
    pub fn enabled(&self) -> impl Iterator<Item = (&str, bool)> {
        self.switches.iter().map(|s| (s.label.as_str(), s.enabled))
    }

    fn collect_enabled(&mut self, label: &str, on: bool) {
        self.switches.iter_mut().filter(|s| s.label == label).for_each(|s| s.enabled = on);
        self.limits.clear();
        for switch in self.switches.iter().filter(|s| s.enabled) {
            self.limits.tighten(&switch.set);
        }
        for i in 0..self.braking.len() {
            self.braking[i] = Dof::of(&self.limits, i).braking(&self.period);
        }
    }

    /// Forces on the robot beside its motors, as generalised forces `J'f` (nv) [N·m or N], for the ticks to come: contact
    /// forces of a walking robot, measured or estimated, are held constant over a period.
    ///
    /// # Errors
    /// A force that is NaN or infinite, by the joint it acts on; those before stay.
    ///
    /// # Panics
    /// When there are not nv of them.
    pub fn set_external_forces(&mut self, forces: &[f64]) -> Result<(), LimitError> {
        if let Some(i) = forces.iter().position(|force| !force.is_finite()) {
            let what = format!("external force on '{}'", self.model.dof_name(i.min(self.model.nv() - 1)));
            return Err(LimitError::BadValue { what, value: forces[i], domain: "finite, in N·m or N" });
        }
        self.external.copy_from_slice(forces);
        Ok(())
    }

    /// The forces last set (nv).
    pub fn external_forces(&self) -> &[f64] {
        &self.external
    }

    /// True when some limit speaks of the tick before, or some joint goes on from it.
    pub fn needs_previous(&self) -> bool {
        self.checker.needs().previous || self.previous.sent.is_any()
    }

    /// True when a brake is stored from tick to tick ([`Braking::Stored`](crate::Braking)).
    pub fn stores_a_brake(&self) -> bool {
        self.settings.braking == crate::Braking::Stored
    }

    /// The way to stop that was verified last (nv): the deceleration of each controllable dof until it stands [rad/s² or m/s²]. `None`
    /// where none is stored.
    pub fn stored_brake(&self) -> Option<&[f64]> {
        self.backup.decelerations().filter(|_| self.stores_a_brake())
    }

    /// The velocity to propose for dof `i` at `v` that is to stand [rad/s or m/s]: 0, or where its jerk is hard that of its brake after the next
    /// period, since to come nearest to standing in each tick would swing about it.
    pub fn rest(&self, i: usize, v: f64) -> f64 {
        let dof = Dof::of(&self.limits, i);
        if dof.jerk.is_infinite() {
            return 0.0;
        }
        let brake = Brake::of(&dof, &self.period);
        let known = self.previous.get().map_or(brake.curve(v), |previous| previous.acceleration[i]);
        v + self.period.dt * brake.next(v, known)
    }

    /// Acceleration (nv) and motor force (nv) of the tick before, for limits on their change; `None`: not known, and
    /// those limits do not hold in the next tick.
    ///
    /// # Panics
    /// When there are not nv of them.
    pub fn set_previous(&mut self, previous: Option<Previous<'_>>) {
        self.previous.asked.forget();
        if let Some(previous) = previous {
            assert_eq!(
                (previous.acceleration.len(), previous.torque.len()),
                (self.previous.nv, self.previous.nv)
            );
            self.previous.asked.push(previous.acceleration.iter().chain(previous.torque));
        }
    }

    /// Forgets the tick before and the stored brake: a new episode begins.
    pub fn forget(&mut self) {
        self.lose();
        self.backup.forget();
    }

    /// Forgets the stored brake alone: it was verified within other limits.
    pub fn forget_brake(&mut self) {
        self.backup.forget();
    }

    /// What the next projection depends on beside its arguments, as plain numbers: the tick before and the stored brake.
    /// For a checkpoint in the middle of an episode.
    pub fn memory(&self) -> Vec<f64> {
        let mut memory = Vec::new();
        self.write_memory(&mut memory);
        memory
    }

    /// Appends [`Projector::memory`] to `memory`; allocates only where that has no room.
    pub fn write_memory(&self, memory: &mut Vec<f64>) {
        self.previous.asked.write(memory);
        self.previous.sent.write(memory);
        self.backup.write_memory(memory);
    }

    /// Takes what [`Projector::memory`] gave.
    ///
    /// # Panics
    /// When it has another length.
    pub fn set_memory(&mut self, memory: &[f64]) {
        let rest = self.previous.asked.read(memory);
        let rest = self.previous.sent.set(rest);
        self.backup.set_memory(rest);
    }

    /// Makes the last tick, which ended with `target`, the tick before.
    pub fn remember(&mut self, target: &Target) {
        self.previous.push(Previous { acceleration: &target.acceleration, torque: self.checker.torque() });
        self.previous.sent.remember(target, &self.period);
    }

    /// Takes `proposal` as the target of the tick just projected, whatever it breaks: `target_violations` and what is remembered are the
    /// proposal's; status and rung stay the projection's. For comparisons with what [`Projector::project`] does; `q`, `v` as there.
    pub fn pass(&mut self, q: &[f64], v: &[f64], proposal: &Proposal, target: &mut Target) {
        target.q.copy_from_slice(&proposal.q);
        target.v.copy_from_slice(&proposal.v);
        for (a, (to, from)) in target.acceleration.iter_mut().zip(proposal.v.iter().zip(v)) {
            *a = (to - from) / self.period.dt;
        }
        let rung = std::mem::replace(&mut target.ledger.rung, crate::Rung::ClosedForm);
        self.report_unsolved(q, v, target);
        target.ledger.rung = rung;
        target.ledger.moved = 0.0;
    }

    /// Names of all rows an [`ActiveRow`](crate::ActiveRow) may speak of: the dofs (nv), then the coupled rows and cones.
    pub fn row_names(&self) -> Vec<String> {
        let dofs = (0..self.model.nv()).map(|i| self.model.dof_name(i));
        let labels = self.coupled.iter().flat_map(|stages| stages.labels.iter().map(|l| l.name.clone()));
        dofs.chain(labels).collect()
    }

    /// Kind of each row by its number; none for those of single joints, which several limits share.
    pub fn row_kinds(&self) -> Vec<Option<Kind>> {
        let dofs = (0..self.model.nv()).map(|_| None);
        let labels = self.coupled.iter().flat_map(|stages| stages.labels.iter().map(|l| Some(l.kind)));
        dofs.chain(labels).collect()
    }

    /// All limits of single joints, as they were built; [`Projector::moved`] says which are tighter for now.
    pub fn limits(&self) -> &LimitSet {
        &self.limits
    }

    /// The same, and between which accelerations each dof may be in the last tick, by its limit and its hard jerk [rad/s² or m/s²] (nv).
    pub fn limits_of_tick(&self) -> (&LimitSet, &[[f64; 2]]) {
        (&self.limits, &self.accelerations)
    }
}
