//! Opening the request-response service with the same settings on both ends.

use iceoryx2::service::builder::request_response::{
    RequestResponseCreateError as Create, RequestResponseOpenError as Open,
    RequestResponseOpenOrCreateError as Failure,
};
use iceoryx2::service::port_factory::request_response::PortFactory;

use super::messages::{Envelope, ReplyMessage};
use nearl_runtime::link::LinkError;
use nearl_runtime::link::service::{Bus, Ipc};

/// Clients at once, over all processes.
const CLIENTS: usize = 24;
/// Requests under way for one client.
const ACTIVE: usize = 2;
/// Requests under way over all clients.
pub(super) const AT_ONCE: usize = CLIENTS * ACTIVE;
/// Replies that wait for a client that is behind.
const BUFFER: usize = 4;

pub(super) type Factory = PortFactory<Ipc, Envelope, (), [f64], ReplyMessage>;

/// Request-response, not publish-subscribe: every request has its own stream of answers with its own buffer, the server sees
/// a client leave, and a full buffer is reported to the sender. Both were equally fast (1.0 and 0.7 us a round trip).
pub(super) fn open(bus: &Bus) -> Result<Factory, LinkError> {
    let topic = bus.topic("rollout")?;
    let build = || {
        bus.node()
            .service_builder(&topic)
            .request_response::<Envelope, [f64]>()
            .response_user_header::<ReplyMessage>()
            .max_servers(1)
            .max_clients(CLIENTS)
            .max_nodes(CLIENTS + 2)
            .max_active_requests_per_client(ACTIVE)
            .max_loaned_requests(1)
            .max_response_buffer_size(BUFFER)
            .max_borrowed_responses_per_pending_response(1)
            .enable_safe_overflow_for_requests(false)
            .enable_safe_overflow_for_responses(false)
            // Also hands out the requests of clients that left: only who takes them frees their buffers.
            .enable_fire_and_forget_requests(true)
            .open_or_create()
    };
    bus.open(build, is_passing).map_err(|e| match e {
        Failure::RequestResponseOpenError(
            Open::IncompatibleRequestOrResponseType | Open::VersionMismatch,
        ) => LinkError::Schema { name: bus.name().clone(), topic: "rollout" },
        Failure::RequestResponseOpenError(Open::ExceedsMaxNumberOfNodes) => full(bus),
        other => bus.name().transport("open `rollout`", format!("{other:?}")),
    })
}

/// A client in a reply: its identity in the transport, which no other client of any time has.
pub(super) fn client_number(id: u128) -> u64 {
    (id as u64) ^ ((id >> 64) as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)
}

pub(super) fn full(bus: &Bus) -> LinkError {
    LinkError::Full { name: bus.name().clone(), topic: "rollout" }
}

/// Failures that go away once another process has finished creating, removing or dying.
fn is_passing(error: &Failure) -> bool {
    use Failure::{RequestResponseCreateError as C, RequestResponseOpenError as O};
    matches!(
        error,
        Failure::SystemInFlux
            | O(Open::HangsInCreation | Open::IsMarkedForDestruction | Open::DoesNotExist)
            | O(Open::ServiceInCorruptedState | Open::InternalFailure)
            | C(Create::HangsInCreation | Create::IsBeingCreatedByAnotherInstance | Create::AlreadyExists)
            | C(Create::ServiceInCorruptedState | Create::InternalFailure)
    )
}
