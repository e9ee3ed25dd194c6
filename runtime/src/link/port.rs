//! The two ends of a topic: numbering, stamping and checking what passes.

use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::service::port_factory::PortFactory as _;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::schema::Queued;
use super::service::Ipc;
use super::{LinkError, Message, RobotName, SnapshotHeader, memory};
use crate::clock;
use crate::snapshot::MAX_BYTES;

/// Sending end of a topic. One heap allocation per message inside iceoryx2: not for the real-time thread.
pub struct Outbox<M: Queued> {
    port: Publisher<Ipc, M, ()>,
    service: PortFactory<Ipc, M, ()>,
    epoch: u64,
    seq: u64,
}

impl<M: Queued> Outbox<M> {
    pub(crate) fn new(
        port: Publisher<Ipc, M, ()>,
        service: PortFactory<Ipc, M, ()>,
        epoch: u64,
    ) -> Outbox<M> {
        Outbox { port, service, epoch, seq: 0 }
    }

    /// Those who read the topic.
    pub fn readers(&self) -> usize {
        self.service.dynamic_config().number_of_subscribers()
    }

    /// Lets go of readers that are gone. Sending does the same; one who has nothing more to send would keep their segments.
    pub fn update_readers(&mut self) {
        // A failure leaves the connections as they are until the next call.
        let _ = self.port.update_connections();
    }

    /// Numbers, stamps and sends `message`; false if it could not be sent.
    pub fn send(&mut self, message: &mut M) -> bool {
        self.seq += 1;
        *message.header_mut() =
            super::Header { schema: M::SCHEMA, epoch: self.epoch, seq: self.seq, stamp: clock::now() };
        match self.port.loan_uninit() {
            Ok(sample) => sample.write_payload(*message).send().is_ok(),
            Err(_) => false,
        }
    }
}

/// The order of what one sender numbers: what came twice or late is left out, what never came is counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sequence {
    last: (u64, u64),
    /// Messages that were numbered but never arrived.
    pub lost: u64,
    /// Messages left out because a newer one, or the same, came before.
    pub old: u64,
}

impl Sequence {
    /// True if the message with this header is the next to be used.
    pub fn accept(&mut self, header: &super::Header) -> bool {
        let (epoch, seq) = self.last;
        if header.epoch == epoch {
            if header.seq <= seq {
                self.old += 1;
                return false;
            }
            self.lost += header.seq - seq - 1;
        }
        self.last = (header.epoch, header.seq);
        true
    }
}

/// Receiving end of a topic.
pub(crate) struct Inbox<M: Queued> {
    port: Subscriber<Ipc, M, ()>,
    /// Order of the messages, and what was lost.
    pub(crate) sequence: Sequence,
    /// Messages with another schema hash.
    pub(crate) refused: u64,
}

impl<M: Queued> Inbox<M> {
    pub(crate) fn new(port: Subscriber<Ipc, M, ()>) -> Inbox<M> {
        Inbox { port, sequence: Sequence::default(), refused: 0 }
    }

    /// The next message in order; duplicates and foreign schemas are left out.
    pub(crate) fn next(&mut self) -> Option<M> {
        while let Ok(Some(sample)) = self.port.receive() {
            let header = *sample.payload().header();
            if header.schema != M::SCHEMA {
                self.refused += 1;
                continue;
            }
            if self.sequence.accept(&header) {
                return Some(*sample.payload());
            }
        }
        None
    }

    /// The newest message; older unread ones are left out.
    pub(crate) fn newest(&mut self) -> Option<M> {
        std::iter::from_fn(|| self.next()).last()
    }
}

/// Bytes of one snapshot as received.
#[derive(Clone, Debug)]
pub struct SnapshotBytes {
    /// Version and sender.
    pub header: SnapshotHeader,
    /// The file's content.
    pub bytes: Vec<u8>,
}

/// Sending end of the snapshot topic.
pub(crate) struct BytesOutbox {
    port: Publisher<Ipc, [u8], SnapshotHeader>,
    name: RobotName,
    epoch: u64,
    seq: u64,
}

impl BytesOutbox {
    pub(crate) fn new(
        port: Publisher<Ipc, [u8], SnapshotHeader>,
        name: RobotName,
        epoch: u64,
    ) -> BytesOutbox {
        BytesOutbox { port, name, epoch, seq: 0 }
    }

    pub(crate) fn send(&mut self, version: u64, bytes: &[u8]) -> Result<(), LinkError> {
        if bytes.len() as u64 > MAX_BYTES {
            return Err(self.name.transport(
                "send a snapshot",
                format!("it has {} bytes, more than the limit of {MAX_BYTES}", bytes.len()),
            ));
        }
        // The segment may grow to the next power of two and is written at once: check before the first write.
        memory::check(&self.name, 4 * bytes.len().next_power_of_two() as u64)?;
        let failed = |e: String| self.name.transport("send a snapshot", e);
        let mut sample = self.port.loan_slice_uninit(bytes.len()).map_err(|e| failed(format!("{e:?}")))?;
        self.seq += 1;
        let header = sample.user_header_mut();
        header.header = super::Header {
            schema: SnapshotHeader::SCHEMA,
            epoch: self.epoch,
            seq: self.seq,
            stamp: clock::now(),
        };
        header.version = version;
        header.length = bytes.len() as u64;
        sample.write_from_slice(bytes).send().map_err(|e| failed(format!("{e:?}")))?;
        Ok(())
    }

    /// Delivers the last snapshot to runtimes that came later.
    pub(crate) fn attend(&self) {
        let _ = self.port.update_connections();
    }
}

/// Receiving end of the snapshot topic.
pub struct SnapshotReader {
    port: Subscriber<Ipc, [u8], SnapshotHeader>,
    refused: u64,
}

impl SnapshotReader {
    pub(crate) fn new(port: Subscriber<Ipc, [u8], SnapshotHeader>) -> SnapshotReader {
        SnapshotReader { port, refused: 0 }
    }

    /// Snapshots whose header did not fit their bytes.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// The next snapshot. Copies it, which takes a millisecond for a few megabytes.
    #[allow(clippy::should_implement_trait)]
    pub fn next(&mut self) -> Option<SnapshotBytes> {
        while let Ok(Some(sample)) = self.port.receive() {
            let header = *sample.user_header();
            // A push has the limit of a file, and is refused before it is copied.
            if header.header.schema != SnapshotHeader::SCHEMA
                || header.length != sample.payload().len() as u64
                || header.length > MAX_BYTES
            {
                self.refused += 1;
                continue;
            }
            return Some(SnapshotBytes { header, bytes: sample.payload().to_vec() });
        }
        None
    }
}
