//! The viewers' ends of the links: they read topics and send nothing.

use std::time::Duration;

use super::port::Inbox;
use super::runtime::poll_for;
use super::service::Bus;
use super::*;

/// Reads what every tick of one robot's loop did.
pub struct ViewLink {
    tick: Inbox<TickMessage>,
    rows: Inbox<RowsMessage>,
    health: Inbox<HealthMessage>,
    robot: Inbox<RobotMessage>,
    bus: Bus,
}

impl ViewLink {
    /// Opens the topics for reading.
    ///
    /// # Errors
    /// [`LinkError`]; [`LinkError::Full`] beside too many other viewers.
    pub fn open(name: &RobotName) -> Result<ViewLink, LinkError> {
        let bus = Bus::join(name)?;
        let link = ViewLink {
            tick: bus.inbox()?,
            rows: bus.inbox()?,
            health: bus.inbox()?,
            robot: bus.inbox()?,
            bus,
        };
        link.bus.reserve()?;
        Ok(link)
    }

    /// Waits for the names of the loop's rows.
    ///
    /// # Errors
    /// [`LinkError::NoRuntime`] after `patience`.
    pub fn wait_for_rows(&mut self, patience: Duration) -> Result<RowsMessage, LinkError> {
        let rows = &mut self.rows;
        poll_for(patience, || rows.newest()).ok_or_else(|| LinkError::NoRuntime(self.bus.name().clone()))
    }

    /// Waits for the plant to say what it is.
    ///
    /// # Errors
    /// [`LinkError::NoPlant`] after `patience`.
    pub fn wait_for_plant(&mut self, patience: Duration) -> Result<RobotMessage, LinkError> {
        let robot = &mut self.robot;
        poll_for(patience, || robot.newest()).ok_or_else(|| LinkError::NoPlant(self.bus.name().clone()))
    }

    /// The next tick in order.
    pub fn tick(&mut self) -> Option<TickMessage> {
        self.tick.next()
    }

    /// Ticks lost because they were not read in time.
    pub fn lost(&self) -> u64 {
        self.tick.sequence.lost
    }

    /// The names of the rows, if they were sent since the last call.
    pub fn rows(&mut self) -> Option<RowsMessage> {
        self.rows.newest()
    }

    /// The newest health message not yet read.
    pub fn health(&mut self) -> Option<HealthMessage> {
        self.health.newest()
    }
}
