//! Requests whose client has left, kept until letting go of them harms nobody.
//!
//! iceoryx2 0.10 finds the way back to a client by the client's place in the list of clients, and numbers the requests of
//! every client from 0. Dropping an `ActiveRequest` closes the stream of that place with that number: once another client has
//! the place, it may be the other's stream. So a request is dropped while its client is listed, and thus has the place, or
//! once no stream with its number is open there.

use std::collections::HashSet;
use std::sync::{Mutex, PoisonError};

use iceoryx2::active_request::ActiveRequest;
use iceoryx2::prelude::CallbackProgression;
use iceoryx2::service::port_factory::PortFactory;

use super::messages::{Envelope, ReplyMessage};
use super::service::Factory;
use nearl_runtime::link::service::Ipc;

pub(super) type Active = ActiveRequest<Ipc, Envelope, (), [f64], ReplyMessage>;

pub(super) struct Departed {
    factory: Factory,
    requests: Mutex<Vec<Active>>,
}

impl Departed {
    pub(super) fn new(factory: Factory) -> Departed {
        Departed { factory, requests: Mutex::new(Vec::new()) }
    }

    /// The clients that are there now.
    pub(super) fn listed(&self) -> HashSet<u128> {
        let mut clients = HashSet::new();
        self.factory.dynamic_config().list_clients(|client| {
            clients.insert(client.client_id.value());
            CallbackProgression::Continue
        });
        clients
    }

    /// Ends a request now, or later if its place may be another client's.
    pub(super) fn let_go(&self, request: Active) {
        // The server's own table of places never runs ahead of the list, and only this thread brings it up to date.
        if request.is_connected() && !self.listed().contains(&request.origin().value()) {
            self.requests.lock().unwrap_or_else(PoisonError::into_inner).push(request);
        }
    }

    /// Ends what can be ended by now.
    pub(super) fn sweep(&self) {
        self.requests.lock().unwrap_or_else(PoisonError::into_inner).retain(Active::is_connected);
    }
}
