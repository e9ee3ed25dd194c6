//! The topics a tunnel carries to a trainer on another host. A tunnel makes a topic that is missing on its side with sizes of its
//! own, which no link can use: so they are made here, as the links would, and held while the tunnel runs.

use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::service::{Bus, Ipc};
use super::{
    HealthMessage, LinkError, Message, ReceiptMessage, RobotMessage, RobotName, SnapshotHeader,
    TransitionMessage,
};

/// What a trainer reads and writes. States and actions never leave the robot's host.
pub(crate) const CROSSING: [&str; 5] = [
    RobotMessage::TOPIC,
    TransitionMessage::TOPIC,
    HealthMessage::TOPIC,
    ReceiptMessage::TOPIC,
    SnapshotHeader::TOPIC,
];

/// The topics of [`CROSSING`], until it is dropped.
pub(crate) struct Crossing {
    _robot: PortFactory<Ipc, RobotMessage, ()>,
    _transition: PortFactory<Ipc, TransitionMessage, ()>,
    _health: PortFactory<Ipc, HealthMessage, ()>,
    _receipt: PortFactory<Ipc, ReceiptMessage, ()>,
    _snapshot: PortFactory<Ipc, [u8], SnapshotHeader>,
    _bus: Bus,
}

impl Crossing {
    /// Opens or makes them.
    pub(crate) fn open(name: &RobotName) -> Result<Crossing, LinkError> {
        let bus = Bus::join(name)?;
        Ok(Crossing {
            _robot: bus.service()?,
            _transition: bus.service()?,
            _health: bus.service()?,
            _receipt: bus.service()?,
            _snapshot: bus.bytes()?,
            _bus: bus,
        })
    }
}
