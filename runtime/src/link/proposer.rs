//! The ends of a process that proposes in place of a policy: a large network, a GPU, another framework. Any rate, any language.

use std::time::Duration;

use super::board::{Board, BoardReader};
use super::owner::Owner;
use super::port::Inbox;
use super::runtime::poll_for;
use super::service::Bus;
use super::*;
use crate::clock;

/// Time between looks for a loop or a plant that was started again [ns].
const ATTEND: u64 = 20_000_000;

/// What the loop asks for.
#[derive(Clone, Debug, PartialEq)]
pub struct Asked {
    /// Commands of joints, else entries of the state.
    pub is_action: bool,
    /// Names of the entries, in the order of a proposal.
    pub entries: Vec<String>,
    /// Control period \[s\].
    pub dt: f64,
    /// Control ticks in which a proposed state is to be reached.
    pub policy_every: usize,
    /// Age of a proposal from which on it is held \[s\].
    pub age_limit: f64,
    /// So long is it held before the loop brakes \[s\].
    pub hold: f64,
}

/// Reads states, sends proposals. One process of a robot has it at a time.
pub struct ProposerLink {
    state: BoardReader<StateMessage>,
    /// Header of the state that was read last.
    seen: Header,
    proposal: Board<ProposalMessage>,
    message: Box<ProposalMessage>,
    asked: Inbox<AskedMessage>,
    account: Box<AskedMessage>,
    next_attend: u64,
    _owner: Owner,
    bus: Bus,
}

impl ProposerLink {
    /// Takes the place of the robot's proposer, and waits at most `patience` for a loop that asks.
    ///
    /// # Errors
    /// [`LinkError::Taken`] by another proposer, [`LinkError::NoQuestion`], or of the transport.
    pub fn open(name: &RobotName, patience: Duration) -> Result<ProposerLink, LinkError> {
        let bus = Bus::join(name)?;
        let owner = bus.own("proposer")?;
        let mut asked = bus.inbox::<AskedMessage>()?;
        bus.reserve()?;
        let found = poll_for(patience, || asked.newest());
        let account = Box::new(found.ok_or_else(|| LinkError::NoQuestion(name.clone()))?);
        Ok(ProposerLink {
            state: BoardReader::open(name),
            seen: Header::default(),
            proposal: Board::create(name, bus.epoch())?,
            message: Box::new(ProposalMessage::zeroed()),
            asked,
            account,
            next_attend: 0,
            _owner: owner,
            bus,
        })
    }

    /// What is asked for.
    pub fn asked(&self) -> Asked {
        let a = &self.account;
        Asked {
            is_action: a.kind == PROPOSES_ACTIONS,
            entries: a.entries(),
            dt: a.dt,
            policy_every: a.policy_every as usize,
            age_limit: a.age_limit,
            hold: a.hold,
        }
    }

    /// What the loop said last of itself and of the proposals so far.
    pub fn account(&mut self) -> &AskedMessage {
        self.attend();
        &self.account
    }

    /// The newest state, if it was not read before. The proposals that follow are answers to it.
    pub fn state(&mut self) -> Option<&StateMessage> {
        self.attend();
        let state = self.state.newest()?;
        self.seen = state.header;
        Some(state)
    }

    /// The same, waiting at most `patience` for it.
    pub fn wait_for_state(&mut self, patience: Duration) -> Option<&StateMessage> {
        let until = clock::now() + u64::try_from(patience.as_nanos()).unwrap_or(u64::MAX / 2);
        // Looked at twice, as the borrow of a state that is found lasts.
        loop {
            self.attend();
            if let Some(header) = self.state.newest().map(|state| state.header) {
                self.seen = header;
                return Some(self.state.last());
            }
            if clock::now() >= until {
                return None;
            }
            clock::sleep_until(clock::now() + 100_000);
        }
    }

    /// Proposes `values`, which were computed from the state read last, in the order of [`Asked::entries`]; false where their number is another one.
    pub fn propose(&mut self, values: &[f64]) -> bool {
        if values.len() != self.account.n as usize || values.len() > MAX_OBS {
            return false;
        }
        let message = &mut self.message;
        (message.state_epoch, message.state_seq) = (self.seen.epoch, self.seen.seq);
        message.state_stamp = self.seen.stamp;
        (message.kind, message.n, message.names) = (self.account.kind, self.account.n, self.account.hash);
        message.values_mut().copy_from_slice(values);
        self.proposal.send(message);
        true
    }

    fn attend(&mut self) {
        let now = clock::now();
        if now < self.next_attend {
            return;
        }
        self.next_attend = now + ATTEND;
        self.state.attend();
        if let Some(asked) = self.asked.newest() {
            *self.account = asked;
        }
    }

    /// The robot's name.
    pub fn name(&self) -> &RobotName {
        self.bus.name()
    }
}
