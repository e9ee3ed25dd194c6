//! What the loop remembers from tick to tick, as plain numbers: after a gap in a flight log, replay goes on from there.

use crate::rt::way::Way;

/// Numbers that a controller may remember: for 64 joints the limits, the lengths of its parts, the two ticks before with their set points and a stored brake.
pub const MAX_MEMORY: usize = 714;

/// The memory of a [`Core`](super::Core) after a tick, beside the tick's record. Only where the state was measured and the controller begins
/// a policy period; elsewhere `is_set` is false and the rest says nothing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Resume {
    /// There is something to go on from.
    pub is_set: bool,
    /// Good, unusable and late ticks in a row.
    pub modes: [u32; 3],
    /// Start \[ns\], slot, overruns and skipped slots of the loop's own clock.
    pub grid: [u64; 4],
    /// Ticks in a row in which the projector braked.
    pub braked: u32,
    /// Ticks of the first motion so far.
    pub ramped: u32,
    /// The tick ended late.
    pub overran: bool,
    /// The brake has panicked.
    pub brake_broken: bool,
    /// Where the joints went since the sums began.
    pub way: Way,
    /// Entries used in `memory`.
    pub length: u32,
    /// What the controller saved.
    pub memory: [f64; MAX_MEMORY],
}

impl Resume {
    /// Nothing to go on from.
    pub fn none() -> Resume {
        Resume {
            is_set: false,
            modes: [0; 3],
            grid: [0; 4],
            braked: 0,
            ramped: 0,
            overran: false,
            brake_broken: false,
            way: Way::new(),
            length: 0,
            memory: [0.0; MAX_MEMORY],
        }
    }

    /// What the controller saved.
    pub fn memory(&self) -> &[f64] {
        &self.memory[..(self.length as usize).min(MAX_MEMORY)]
    }

    /// Takes what the controller saved; false where it does not fit.
    pub fn set_memory(&mut self, memory: &[f64]) -> bool {
        let Some(room) = self.memory.get_mut(..memory.len()) else { return false };
        room.copy_from_slice(memory);
        self.length = memory.len() as u32;
        true
    }
}
