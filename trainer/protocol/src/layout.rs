//! What each number of a row of transitions is.

use std::ops::Range;

use super::messages::ReplyMessage;

/// Ledger columns at the end of each row: sums over the control ticks of the policy step.
pub const LEDGER: [&str; 11] = [
    "ticks",
    "raw_violations",
    "recovering",
    "target_violations",
    "moved",
    "distance",
    "avoided",
    "active_rows",
    "reached_violations",
    "residual",
    "faults",
];

/// Sizes of a transition. One row holds, one after the other, the columns of [`Layout::columns`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Layout {
    /// Entries of an observation.
    pub n_obs: usize,
    /// Entries of a proposed state.
    pub n_state: usize,
    /// Entries of an action.
    pub n_act: usize,
}

impl Layout {
    /// The sizes in a reply.
    pub fn of(reply: &ReplyMessage) -> Layout {
        Layout { n_obs: reply.n_obs as usize, n_state: reply.n_state as usize, n_act: reply.n_act as usize }
    }

    /// Names and widths in order:
    /// the observation the policy saw; the one its step led to (before a reset, if the episode ended); the raw proposal
    /// and its projection (of the last tick) \[rad, rad/s\]; the action; both log probabilities; the task's own reward and
    /// cost; 1 or 0 for terminated and truncated; and the [`LEDGER`].
    pub fn columns(&self) -> [(&'static str, usize); 11] {
        [
            ("obs", self.n_obs),
            ("next_obs", self.n_obs),
            ("proposal", self.n_state),
            ("target", self.n_state),
            ("action", self.n_act),
            ("log_prob_proposal", 1),
            ("log_prob_action", 1),
            ("reward", 1),
            ("cost", 1),
            ("ended", 2),
            ("ledger", LEDGER.len()),
        ]
    }

    /// Numbers in a row; beyond every capacity for sizes no message could hold.
    pub fn width(&self) -> usize {
        self.columns().iter().fold(0, |sum, (_, width)| sum.saturating_add(*width))
    }

    /// Place of a column in the row; `None` for a name that does not exist.
    pub fn find(&self, name: &str) -> Option<Range<usize>> {
        let mut at = 0;
        for (column, width) in self.columns() {
            if column == name {
                return Some(at..at + width);
            }
            at += width;
        }
        None
    }
}
