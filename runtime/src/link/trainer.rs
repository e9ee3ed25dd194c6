//! The trainer's ends of the links; also for viewers, which only read.

use std::time::Duration;

use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::board::BoardReader;
use super::owner::Owner;
use super::port::{BytesOutbox, Inbox};
use super::runtime::poll_for;
use super::service::{Bus, Ipc};
use super::*;

/// Topics of others.
type Held = (
    PortFactory<Ipc, TickMessage, ()>,
    PortFactory<Ipc, RowsMessage, ()>,
    PortFactory<Ipc, LimitsMessage, ()>,
);

/// Reads states, transitions, receipts and health of one robot, and pushes snapshots.
pub struct TrainerLink {
    state: BoardReader<StateMessage>,
    transition: Inbox<TransitionMessage>,
    receipt: Inbox<ReceiptMessage>,
    health: Inbox<HealthMessage>,
    robot: Inbox<RobotMessage>,
    tally: Inbox<TallyMessage>,
    snapshot: Option<(BytesOutbox, Owner)>,
    /// Not read, but held: a topic of a runtime that is killed while it goes stays whole beside one who stays.
    _held: Held,
    bus: Bus,
}

impl TrainerLink {
    /// Opens all topics for reading. The right to push is taken with the first [`TrainerLink::push`].
    pub fn open(name: &RobotName) -> Result<TrainerLink, LinkError> {
        let bus = Bus::join(name)?;
        let link = TrainerLink {
            state: BoardReader::open(name),
            transition: bus.inbox()?,
            receipt: bus.inbox()?,
            health: bus.inbox()?,
            robot: bus.inbox()?,
            tally: bus.inbox()?,
            snapshot: None,
            _held: (bus.service()?, bus.service()?, bus.service()?),
            bus,
        };
        link.bus.reserve()?;
        Ok(link)
    }

    /// Waits for the plant to say what it is.
    pub fn wait_for_plant(&mut self, patience: Duration) -> Result<RobotMessage, LinkError> {
        let robot = &mut self.robot;
        poll_for(patience, || robot.newest()).ok_or_else(|| LinkError::NoPlant(self.bus.name().clone()))
    }

    /// Waits for the runtime's first sign of health.
    pub fn wait_for_runtime(&mut self, patience: Duration) -> Result<HealthMessage, LinkError> {
        let health = &mut self.health;
        poll_for(patience, || health.newest()).ok_or_else(|| LinkError::NoRuntime(self.bus.name().clone()))
    }

    /// Sends the bytes of a snapshot file as `version`; a second trainer of the same robot is refused.
    pub fn push(&mut self, version: u64, bytes: &[u8]) -> Result<(), LinkError> {
        if self.snapshot.is_none() {
            let owner = self.bus.own("trainer")?;
            self.snapshot = Some((self.bus.bytes_outbox()?, owner));
        }
        match &mut self.snapshot {
            Some((outbox, _)) => outbox.send(version, bytes),
            None => Ok(()),
        }
    }

    /// Waits for the receipt of `version`; calls in between keep late runtimes served.
    pub fn wait_for_receipt(
        &mut self,
        version: u64,
        patience: Duration,
    ) -> Result<ReceiptMessage, LinkError> {
        let (receipt, snapshot, epoch) = (&mut self.receipt, &self.snapshot, self.bus.epoch());
        poll_for(patience, || {
            snapshot.iter().for_each(|(outbox, _)| outbox.attend());
            std::iter::from_fn(|| receipt.next()).find(|r| r.trainer_epoch == epoch && r.version == version)
        })
        .ok_or_else(|| LinkError::NoRuntime(self.bus.name().clone()))
    }

    /// Keeps late runtimes served with the last snapshot; call now and then while not pushing.
    pub fn attend(&self) {
        self.snapshot.iter().for_each(|(outbox, _)| outbox.attend());
    }

    /// The next transition in order.
    pub fn transition(&mut self) -> Option<TransitionMessage> {
        self.transition.next()
    }

    /// Transitions lost because they were not read in time.
    pub fn lost_transitions(&self) -> u64 {
        self.transition.sequence.lost
    }

    /// The next receipt in order.
    pub fn receipt(&mut self) -> Option<ReceiptMessage> {
        self.receipt.next()
    }

    /// The newest state, if it was not read before; of a plant on this host.
    pub fn state(&mut self) -> Option<StateMessage> {
        self.state.attend();
        self.state.newest().copied()
    }

    /// The newest health message not yet read.
    pub fn health(&mut self) -> Option<HealthMessage> {
        self.health.newest()
    }

    /// The plant's description, if it was sent since the last call.
    pub fn robot(&mut self) -> Option<RobotMessage> {
        self.robot.newest()
    }

    /// What the plant counted, if it said so since the last call; of a plant on this host.
    pub fn tally(&mut self) -> Option<TallyMessage> {
        self.tally.newest()
    }

    /// The robot's name.
    pub fn name(&self) -> &RobotName {
        self.bus.name()
    }
}
