//! The runtime's ends of the links. All calls belong to the I/O thread.

use std::time::Duration;

use super::board::{Board, BoardReader};
use super::owner::Owner;
use super::port::{Inbox, Outbox, SnapshotReader};
use super::service::Bus;
use super::*;

/// Everything the runtime sends and receives for one robot.
pub struct RuntimeLink {
    state: BoardReader<StateMessage>,
    robot: Inbox<RobotMessage>,
    tally: Inbox<TallyMessage>,
    snapshots: Option<SnapshotReader>,
    limits: Inbox<LimitsMessage>,
    action: Board<ActionMessage>,
    transition: Outbox<TransitionMessage>,
    receipt: Outbox<ReceiptMessage>,
    health: Outbox<HealthMessage>,
    proposal: BoardReader<ProposalMessage>,
    /// Made where proposals are asked for.
    asked: Option<Outbox<AskedMessage>>,
    tick: Outbox<TickMessage>,
    rows: Outbox<RowsMessage>,
    _owner: Owner,
    bus: Bus,
}

impl RuntimeLink {
    /// False once the plant has left: it closed its link, and no other one has come.
    pub(crate) fn has_plant(&self) -> bool {
        self.bus.has("plant")
    }

    /// Opens all topics; a second runtime of the same robot is refused.
    pub fn open(name: &RobotName) -> Result<RuntimeLink, LinkError> {
        let bus = Bus::join(name)?;
        let owner = bus.own("runtime")?;
        let link = RuntimeLink {
            action: Board::create(name, bus.epoch())?,
            transition: bus.outbox()?,
            receipt: bus.outbox()?,
            health: bus.outbox()?,
            tick: bus.outbox()?,
            rows: bus.outbox()?,
            state: BoardReader::open(name),
            proposal: BoardReader::open(name),
            asked: None,
            robot: bus.inbox()?,
            tally: bus.inbox()?,
            snapshots: Some(bus.bytes_inbox()?),
            limits: bus.inbox()?,
            bus,
            _owner: owner,
        };
        link.bus.reserve()?;
        Ok(link)
    }

    /// Waits for the plant to say what it is.
    pub fn wait_for_plant(&mut self, patience: Duration) -> Result<RobotMessage, LinkError> {
        poll_for(patience, || self.robot()).ok_or_else(|| LinkError::NoPlant(self.bus.name().clone()))
    }

    /// The robot's name.
    pub fn name(&self) -> &RobotName {
        self.bus.name()
    }

    /// Epoch in the headers of what this runtime sends.
    pub fn epoch(&self) -> u64 {
        self.bus.epoch()
    }

    /// The plant's description if it was sent again; the states of a plant that restarted are read from then on.
    pub fn robot(&mut self) -> Option<RobotMessage> {
        let robot = self.robot.newest();
        if robot.is_some() {
            self.state.attend();
        }
        robot
    }

    /// What the plant counted, if it said so since the last call.
    pub fn tally(&mut self) -> Option<TallyMessage> {
        self.tally.newest()
    }

    /// The newest state, if it was not read before.
    pub fn newest_state(&mut self) -> Option<&StateMessage> {
        self.state.newest()
    }

    /// States of another schema.
    pub fn refused_states(&self) -> u64 {
        self.state.refused
    }

    /// The snapshots, for a thread of its own; `None` if they were taken before.
    pub fn take_snapshots(&mut self) -> Option<SnapshotReader> {
        self.snapshots.take()
    }

    /// The next limits that an operator asks for.
    pub fn limits(&mut self) -> Option<LimitsMessage> {
        self.limits.next()
    }

    /// Opens the topic on which proposals are asked for.
    ///
    /// # Errors
    /// [`LinkError`] of the transport.
    pub fn ask(&mut self) -> Result<(), LinkError> {
        self.asked = Some(self.bus.outbox()?);
        self.bus.reserve()
    }

    /// Says what is asked for, and looks for a proposer that came; false where [`RuntimeLink::ask`] was not called or nothing was sent.
    pub fn send_asked(&mut self, message: &mut AskedMessage) -> bool {
        self.proposal.attend();
        self.asked.as_mut().is_some_and(|asked| asked.send(message))
    }

    /// The newest proposal, if it was not read before.
    pub fn newest_proposal(&mut self) -> Option<&ProposalMessage> {
        self.proposal.newest()
    }

    /// Sends the action of a tick.
    pub fn send_action(&mut self, message: &mut ActionMessage) {
        self.action.send(message);
    }

    /// Sends a transition.
    pub fn send_transition(&mut self, message: &mut TransitionMessage) -> bool {
        self.transition.send(message)
    }

    /// Answers a snapshot.
    pub fn send_receipt(&mut self, message: &mut ReceiptMessage) -> bool {
        self.receipt.send(message)
    }

    /// Whether somebody reads what ticks do.
    pub fn is_watched(&self) -> bool {
        self.tick.readers() > 0
    }

    /// Sends what a tick did.
    pub fn send_tick(&mut self, message: &mut TickMessage) -> bool {
        self.tick.send(message)
    }

    /// Sends what the rows of the snapshot in use are of.
    pub fn send_rows(&mut self, message: &mut RowsMessage) -> bool {
        self.rows.send(message)
    }

    /// Sends the health of the loop.
    pub fn send_health(&mut self, message: &mut HealthMessage) -> bool {
        self.health.send(message)
    }
}

/// Polls every 2 ms until `take` answers or `patience` is over.
pub(crate) fn poll_for<T>(patience: Duration, mut take: impl FnMut() -> Option<T>) -> Option<T> {
    let end = std::time::Instant::now() + patience;
    loop {
        match take() {
            Some(value) => return Some(value),
            None if std::time::Instant::now() >= end => return None,
            None => std::thread::sleep(Duration::from_millis(2)),
        }
    }
}
