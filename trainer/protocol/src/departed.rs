//! Requests whose client has left. Each is kept until dropping it cannot end a request of another client.
//!
//! iceoryx2 0.10 knows a client by its place in a list, and numbers the requests of every client from 0. Dropping an `ActiveRequest`
//! closes the stream that has its place and its number. When a client leaves, a new one may take its place, and the stream that is
//! closed may then be the new client's. So a request is dropped only in two cases: its client is still listed, and has the place
//! itself; or no stream with that place and number is open.

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
