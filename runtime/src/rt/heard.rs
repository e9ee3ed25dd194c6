//! Proposals of another process: which of them may be used, and how old they are.

use crate::link::{Header, Message, ProposalMessage};
use crate::rt::tick::{LoopController, Record};

/// The loop's memory of its proposer.
pub(crate) struct Heard {
    last: Header,
    /// The proposal in use.
    used: ProposalMessage,
    /// When the state was measured that the proposal in use answers [ns].
    born: Option<u64>,
    /// Number of the state that began the episode.
    first: u64,
}

impl Heard {
    pub(crate) fn new() -> Heard {
        Heard { last: Header::default(), used: ProposalMessage::zeroed(), born: None, first: 0 }
    }

    /// Another controller has come: the proposal in use is given to it, where it is one that it takes.
    pub(crate) fn repeat<T: LoopController>(&mut self, controller: &mut T) {
        let used = &self.used;
        if self.born.is_some() && controller.takes(used.kind, used.names, used.values().len()) {
            controller.give(used.values());
        } else {
            self.born = None;
        }
    }

    /// State number `first` begins an episode: what was computed from the states before does not count.
    pub(crate) fn begin(&mut self, first: u64) {
        (self.first, self.born) = (first, None);
    }

    /// Age of the proposal in use at `now` [ns].
    pub(crate) fn age(&self, now: u64) -> Option<u64> {
        self.born.map(|born| now.saturating_sub(born))
    }

    /// Gives `proposal` to the controller, or refuses it; `record` is the tick's, with its state.
    pub(crate) fn take<T: LoopController>(
        &mut self,
        proposal: &ProposalMessage,
        record: &mut Record,
        controller: &mut T,
    ) {
        let header = proposal.header;
        if header.epoch == self.last.epoch {
            let overtaken = header.seq.saturating_sub(self.last.seq.saturating_add(1));
            record.counters.overtaken_proposals =
                record.counters.overtaken_proposals.saturating_add(overtaken);
        }
        self.last = header;
        let state = record.state.header;
        let of_episode = proposal.state_epoch == state.epoch
            && (self.first..=state.seq).contains(&proposal.state_seq)
            && state.seq > 0;
        let values = proposal.values();
        let is_usable = of_episode
            && values.len() == proposal.n as usize
            && values.iter().all(|x| x.is_finite())
            && controller.takes(proposal.kind, proposal.names, values.len());
        if !is_usable {
            record.counters.refused_proposals += 1;
            return;
        }
        controller.give(values);
        self.used = *proposal;
        // A time stamp that has not come yet makes nothing younger.
        self.born = Some(proposal.state_stamp.min(record.begin));
        record.counters.proposals += 1;
    }
}
