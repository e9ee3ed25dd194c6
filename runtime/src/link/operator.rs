//! The end of an operator, a person or a program that watches the surroundings: it moves the limits of a running loop.

use std::time::Duration;

use nearl_constraints::Moved;

use super::owner::Owner;
use super::port::{Inbox, Outbox};
use super::runtime::poll_for;
use super::service::Bus;
use super::*;

/// Moves limits and reads the receipts. One process of a robot has it at a time.
pub struct OperatorLink {
    limits: Outbox<LimitsMessage>,
    receipt: Inbox<ReceiptMessage>,
    health: Inbox<HealthMessage>,
    message: Box<LimitsMessage>,
    _owner: Owner,
    bus: Bus,
}

impl OperatorLink {
    /// Takes the place of the robot's operator, and waits at most `patience` for its loop.
    ///
    /// # Errors
    /// [`LinkError::Taken`] by another operator, [`LinkError::NoRuntime`], or of the transport.
    pub fn open(name: &RobotName, patience: Duration) -> Result<OperatorLink, LinkError> {
        let bus = Bus::join(name)?;
        let owner = bus.own("operator")?;
        let mut link = OperatorLink {
            limits: bus.outbox()?,
            receipt: bus.inbox()?,
            health: bus.inbox()?,
            message: Box::new(LimitsMessage::zeroed()),
            bus,
            _owner: owner,
        };
        link.bus.reserve()?;
        let health = &mut link.health;
        match poll_for(patience, || health.newest()) {
            Some(_) => Ok(link),
            None => Err(LinkError::NoRuntime(name.clone())),
        }
    }

    /// Asks for the limits `moved`, and waits at most `patience` for the answer. They hold until others are asked for, whoever leaves.
    ///
    /// # Errors
    /// [`LinkError::NoRuntime`] where no answer came, or of the transport.
    pub fn move_limits(&mut self, moved: &Moved, patience: Duration) -> Result<ReceiptMessage, LinkError> {
        let text = serde_json::to_string(moved)
            .map_err(|e| self.bus.name().transport("write limits", e.to_string()))?;
        let message = &mut self.message;
        message.version += 1;
        if !message.set_text(text.as_bytes()) {
            let text =
                format!("{} bytes of names and numbers, more than the limit of {MAX_MOVED}", text.len());
            return Err(self.bus.name().transport("send limits", text));
        }
        self.limits.send(message);
        let (receipt, epoch, version) = (&mut self.receipt, self.bus.epoch(), self.message.version);
        let of_ours = |r: &ReceiptMessage| r.trainer_epoch == epoch && r.version == version;
        poll_for(patience, || std::iter::from_fn(|| receipt.next()).find(of_ours))
            .ok_or_else(|| LinkError::NoRuntime(self.bus.name().clone()))
    }

    /// The robot's name.
    pub fn name(&self) -> &RobotName {
        self.bus.name()
    }
}
