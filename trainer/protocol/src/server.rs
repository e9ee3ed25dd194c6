//! The server's end: requests in, replies out. Nothing here knows what a rollout is.

use std::collections::HashSet;
use std::mem::ManuallyDrop;
use std::sync::Arc;

use iceoryx2::port::server::Server;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::port::{BackpressureAction, SendError};
use iceoryx2::prelude::{AllocationStrategy, BackpressureStrategy};
use iceoryx2::service::port_factory::server::ServerCreateError;

use super::departed::{Active, Departed};
use super::messages::{Answer, Envelope, MAX_CHUNK, ReplyMessage};
use super::service;
use nearl_runtime::clock;
use nearl_runtime::link::service::{Bus, Ipc, PUBLISHERS};
use nearl_runtime::link::{
    Header, LinkError, Message, Outbox, Owner, ReceiptMessage, RobotName, SnapshotBytes, SnapshotHeader,
    SnapshotReader, Verdict,
};

/// The only server of a name. It also takes the snapshots that a trainer pushes to the name.
pub struct RolloutServer {
    snapshots: SnapshotReader,
    receipts: Outbox<ReceiptMessage>,
    _owner: Owner,
    port: Server<Ipc, Envelope, (), [f64], ReplyMessage>,
    departed: Arc<Departed>,
    bus: Bus,
}

/// What became of a reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Delivery {
    /// It is in the client's buffer.
    Sent,
    /// The client's buffer is full: try again later.
    Full,
    /// The client is gone.
    Gone,
}

impl RolloutServer {
    /// Takes the name; a second server of the same name is refused.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn open(name: &RobotName) -> Result<RolloutServer, LinkError> {
        let bus = Bus::join(name)?;
        let factory = service::open(&bus)?;
        let port = factory
            .server_builder()
            .initial_max_slice_len(MAX_CHUNK)
            .allocation_strategy(AllocationStrategy::Static)
            .max_loaned_responses_per_request(1)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            // A full buffer is told to the sender, who keeps the chunk: nothing is lost and nobody waits.
            .set_backpressure_handler(|_| BackpressureAction::DiscardDataAndFail)
            .create()
            .map_err(|e| match e {
                ServerCreateError::ExceedsMaxSupportedServers => {
                    LinkError::Taken { name: name.clone(), role: "rollout server" }
                }
                other => name.transport("serve rollouts", format!("{other:?}")),
            })?;
        let owner = bus.own("runtime")?;
        let (snapshots, receipts) = (bus.bytes_inbox()?, bus.outbox()?);
        bus.reserve()?;
        let departed = Arc::new(Departed::new(factory));
        Ok(RolloutServer { snapshots, receipts, _owner: owner, port, departed, bus })
    }

    /// The snapshots that were pushed to the name and not yet taken, one of each sender at most. One that was pushed before a request was
    /// sent is here once the request is.
    pub fn snapshots(&mut self) -> Vec<SnapshotBytes> {
        (0..PUBLISHERS).map_while(|_| self.snapshots.next()).collect()
    }

    /// Answers a snapshot.
    pub fn receipt(&mut self, header: &SnapshotHeader, verdict: Verdict, text: &str) {
        self.receipts.send(&mut ReceiptMessage::answer(header, verdict, text));
    }

    /// The next requests, whatever their bytes are; those whose client no longer waits are left out. Looks at no more than may be under way
    /// at once: clients that ask and leave without end do not keep the server from everything else.
    pub fn receive(&mut self) -> Vec<Caller> {
        let mut callers = Vec::new();
        for _ in 0..service::AT_ONCE {
            let Some(active) = self.port.receive().ok().flatten() else { break };
            let (departed, epoch) = (Arc::clone(&self.departed), self.bus.epoch());
            let caller = Caller { active: ManuallyDrop::new(active), departed, epoch, seq: 0 };
            if caller.is_connected() {
                callers.push(caller);
            }
        }
        callers
    }

    /// Removes what killed processes left, and returns the clients that are still there; costs some file accesses.
    pub fn survivors(&mut self) -> HashSet<u128> {
        self.bus.clean();
        // A failure leaves the connections as they are until the next call.
        let _ = self.port.update_connections();
        self.receipts.update_readers();
        self.departed.sweep();
        self.departed.listed()
    }
}

/// One request and the way back to whoever sent it. Dropping it ends the client's stream.
pub struct Caller {
    active: ManuallyDrop<Active>,
    departed: Arc<Departed>,
    epoch: u64,
    seq: u64,
}

impl Drop for Caller {
    fn drop(&mut self) {
        // SAFETY: taken once, and nothing looks at it afterwards.
        self.departed.let_go(unsafe { ManuallyDrop::take(&mut self.active) });
    }
}

impl Caller {
    /// The request as it came.
    pub fn bytes(&self) -> &[u8] {
        self.active.payload().bytes()
    }

    /// The client; given by the transport, so that no client can pass for another.
    pub fn client(&self) -> u128 {
        self.active.origin().value()
    }

    /// False once the client dropped the request or ended.
    pub fn is_connected(&self) -> bool {
        self.active.is_connected()
    }

    /// True once the client asked to cancel; it waits for the answer.
    pub fn wants_cancel(&self) -> bool {
        self.active.has_disconnect_hint()
    }

    /// Sends a reply with the numbers of its chunk (none for other answers).
    pub fn send(&mut self, reply: &mut ReplyMessage, numbers: &[f64]) -> Delivery {
        reply.header = Header {
            schema: ReplyMessage::SCHEMA,
            epoch: self.epoch,
            seq: self.seq + 1,
            stamp: clock::now(),
        };
        reply.client = service::client_number(self.client());
        if !self.active.is_connected() {
            return Delivery::Gone;
        }
        let Ok(mut sample) = self.active.loan_slice_uninit(numbers.len()) else { return Delivery::Full };
        *sample.user_header_mut() = *reply;
        match sample.write_from_slice(numbers).send() {
            Ok(()) => {
                self.seq += 1;
                Delivery::Sent
            }
            Err(SendError::UnableToDeliver) => Delivery::Full,
            Err(_) => Delivery::Gone,
        }
    }

    /// Sends a reply without numbers to request number `request`; 0 if its bytes do not hold one. A new request may meet a full
    /// buffer, too: what the client left unread of an earlier one.
    pub fn answer(&mut self, answer: Answer, text: &str, request: u64) -> Delivery {
        let mut reply = ReplyMessage { request, ..ReplyMessage::default() };
        reply.set(answer, text);
        self.send(&mut reply, &[])
    }
}
