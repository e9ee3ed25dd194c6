//! What a controller remembers from tick to tick, and how another controller takes it over.

use super::dial::{Dial, Margin};
use super::drive_box::DriveBox;
use super::{Controller, SnapshotError};
use nearl_constraints::{ActionLimit, Projector};

/// Parts of a memory: the projector's, the drives', the limit's on actions, the margins, and what the policy saw. Their lengths come first.
const PARTS: usize = 5;

/// The lengths of these parts.
pub(super) type Lengths = [usize; PARTS];

/// The parts of what [`Controller::memory`] gave; `None` where it is no such thing.
fn parts(memory: &[f64]) -> Option<[&[f64]; PARTS]> {
    let (lengths, mut rest) = memory.split_at_checked(PARTS)?;
    let mut parts = [rest; PARTS];
    for (part, &length) in parts.iter_mut().zip(lengths) {
        (*part, rest) = rest.split_at_checked(length as usize)?;
    }
    rest.is_empty().then_some(parts)
}

impl Controller {
    /// Starts a new episode: the next tick is a policy tick. The margins of `[constraints] reached` stay.
    pub fn reset(&mut self) {
        (self.tick, self.begun, self.earlier) = (0, 0, 0);
        self.given.forget();
        self.foreign.reset();
        self.projector().forget();
        if let Some(drives) = &mut self.drive_box {
            drives.forget();
        }
        if let Some(limit) = &mut self.action_limit {
            limit.forget();
        }
        if let Some(dial) = &mut self.dial {
            dial.interrupt();
        }
    }

    /// What was given in the tick before came too late and was never sent: limits on a change, and joints that go on from what they were sent, go on
    /// from the tick before it.
    pub fn recall(&mut self) {
        self.projector().recall();
        self.drive_box.iter_mut().for_each(DriveBox::recall);
        self.action_limit.iter_mut().for_each(ActionLimit::recall);
    }

    /// What was given in the tick before is not what the robot does: the next tick begins where it is measured, and limits on a change do not hold in it.
    pub fn lose(&mut self) {
        self.projector().lose();
        self.drive_box.iter_mut().for_each(DriveBox::forget);
        self.action_limit.iter_mut().for_each(ActionLimit::forget);
    }

    /// Whether the policy runs in the next tick.
    pub fn begins_period(&self) -> bool {
        (self.tick - self.begun).is_multiple_of(self.policy_every)
    }

    /// What the next policy tick depends on beside its arguments, as plain numbers; see [`Projector::memory`].
    pub fn memory(&self) -> Vec<f64> {
        let mut memory = Vec::new();
        self.write_memory(&mut memory);
        memory
    }

    /// Appends [`Controller::memory`] to `memory`; allocates only where that has no room.
    pub fn write_memory(&self, memory: &mut Vec<f64>) {
        let begin = memory.len();
        memory.extend([0.0; PARTS]);
        let mut from = memory.len();
        for part in 0..PARTS {
            match part {
                0 => self.last_word().write_memory(memory),
                1 => self.drive_box.iter().for_each(|drives| drives.write_memory(memory)),
                2 => self.action_limit.iter().for_each(|limit| limit.write_memory(memory)),
                3 => self.dial.iter().for_each(|dial| dial.write_memory(memory)),
                _ => self.foreign.write_memory(self.earlier + self.tick, memory),
            }
            memory[begin + part] = (memory.len() - from) as f64;
            from = memory.len();
        }
    }

    /// The way to stop that was verified last (nv), see [`Projector::stored_brake`].
    pub fn stored_brake(&self) -> Option<&[f64]> {
        self.last_word().stored_brake()
    }

    /// Whether the next tick depends on [`Controller::memory`] and its arguments alone: a policy period begins, and no observation of
    /// earlier ticks is kept.
    pub fn is_memory_whole(&self) -> bool {
        self.begins_period() && !self.foreign.remembers()
    }

    /// The projector that decides what happens: the guard's where there is one.
    pub(super) fn last_word(&self) -> &Projector {
        self.guard.as_ref().map_or(&self.projector, |guard| &guard.projector)
    }

    /// The same: what it knows of the tick before moves between those of one robot.
    pub fn projector(&mut self) -> &mut Projector {
        self.guard.as_mut().map_or(&mut self.projector, |guard| &mut guard.projector)
    }

    /// Begins in the middle of an episode, at a policy tick, with what [`Controller::memory`] gave. False as for [`Controller::take_memory`].
    pub fn set_memory(&mut self, memory: &[f64]) -> bool {
        self.reset();
        self.take_memory(memory)
    }

    /// How long each part of [`Controller::memory`] is.
    pub(super) fn lengths(&self) -> Lengths {
        let memory = self.memory();
        std::array::from_fn(|part| memory[part] as usize)
    }

    /// Takes what [`Controller::memory`] gave, in the middle of a policy period too: a controller that takes over from another. Of one with
    /// other parts, such as margins where this one learns none, what both know; what the other did not know begins anew.
    /// False where something was left.
    pub fn take_memory(&mut self, memory: &[f64]) -> bool {
        let Some(parts) = parts(memory) else { return false };
        let mut whole = true;
        for (k, (part, need)) in parts.into_iter().zip(self.remembered).enumerate() {
            if part.len() != need {
                whole = false;
                continue;
            }
            match k {
                0 => self.projector().set_memory(part),
                1 => self.drive_box.iter_mut().for_each(|drives| drives.set_memory(part)),
                2 => self.action_limit.iter_mut().for_each(|limit| limit.set_memory(part)),
                3 => self.dial.iter_mut().for_each(|dial| dial.set_memory(part)),
                _ => self.earlier = self.foreign.set_memory(part).saturating_sub(self.tick),
            }
        }
        whole
    }

    /// Whether what comes out of a tick depends on the ticks before: the policy proposes every few ticks, a limit speaks of the tick before, or
    /// a brake is stored.
    pub fn remembers(&self) -> bool {
        let last = self.last_word();
        self.drive_box.is_some()
            || self.dial.is_some()
            || self.action_limit.as_ref().is_some_and(ActionLimit::remembers)
            || self.policy_every > 1
            || self.foreign.remembers()
            || last.needs_previous()
            || last.stores_a_brake()
    }

    /// The margins of `[constraints] reached`, two rows a controllable joint, lower before upper; none without it.
    pub fn margins(&self) -> Vec<Margin> {
        self.dial.as_ref().map_or(Vec::new(), Dial::margins)
    }

    /// What these margins and their steps are, as plain numbers: what [`Networks::margins`](crate::Networks::margins) holds.
    pub fn learned_margins(&self) -> Vec<f64> {
        self.dial.as_ref().map_or(Vec::new(), Dial::learned)
    }

    /// Forgets what was learned since the snapshot: its margins again.
    pub fn forget_margins(&mut self) {
        if let Some(dial) = &mut self.dial {
            dial.begin_anew();
        }
    }

    /// Begins with the margins of a snapshot.
    pub(super) fn bring_margins(&mut self, learned: &[f64]) -> Result<(), SnapshotError> {
        let need = self.dial.as_ref().map_or(0, Dial::learned_len);
        match &mut self.dial {
            _ if learned.is_empty() => {}
            Some(dial) if learned.len() == need => dial.bring(learned),
            _ => {
                return Err(SnapshotError::Shape {
                    name: "reached.margins".into(),
                    expected: format!("{need} wide"),
                    actual: format!("{} wide", learned.len()),
                });
            }
        }
        Ok(())
    }
}
