//! Snapshots that were pushed to the server. Each is validated on a thread of its own. The server waits until a small one is validated. While a
//! large one is validated, it serves all clients but those whose next request needs that snapshot.

use super::dispatcher::Dispatcher;
use super::policy::Validating;
use nearl_rollout_protocol::{Caller, RolloutServer, decode};
use nearl_runtime::link::SnapshotBytes;
use std::collections::VecDeque;
use std::thread::Scope;

/// A snapshot of at most so many bytes is validated in milliseconds.
const SMALL: usize = 4 << 20;

#[derive(Default)]
pub(super) struct Pushed<'scope> {
    /// A reading: what was pushed and not yet looked at, in the order in which it came. The next one begins once all of it is answered.
    queue: VecDeque<SnapshotBytes>,
    validating: Option<Validating<'scope>>,
    is_reading: bool,
    /// Readings that are over.
    over: u64,
    /// Requests that go by what was pushed before them, and the number of readings that have to be over.
    held: VecDeque<(u64, Caller)>,
}

impl<'scope> Pushed<'scope> {
    /// Admits who has been waiting for nothing but the policy, takes up what was pushed, and admits `callers`, who were received before:
    /// what was pushed before a request is in use with it.
    pub(super) fn attend(
        &mut self,
        scope: &'scope Scope<'scope, '_>,
        server: &mut RolloutServer,
        dispatcher: &mut Dispatcher,
        callers: Vec<Caller>,
    ) {
        // The reading that is under way may have begun before the push; the next one begins after it.
        let needed = self.over + 1 + u64::from(self.is_reading);
        for caller in callers {
            match goes_by_what_was_pushed(&caller) {
                true => self.held.push_back((needed, caller)),
                false => dispatcher.admit(caller),
            }
        }
        self.go_on(scope, server, dispatcher);
        if !self.is_reading {
            self.queue.extend(server.snapshots());
            self.is_reading = true;
            self.go_on(scope, server, dispatcher);
        }
        while self.held.front().is_some_and(|(needed, _)| *needed <= self.over) {
            self.held.pop_front().into_iter().for_each(|(_, caller)| dispatcher.admit(caller));
        }
        self.held.retain(|(_, caller)| caller.is_connected());
    }

    /// Answers what can be answered of the reading.
    fn go_on(
        &mut self,
        scope: &'scope Scope<'scope, '_>,
        server: &mut RolloutServer,
        dispatcher: &mut Dispatcher,
    ) {
        while self.is_reading {
            if let Some(validating) = self.validating.take_if(|v| v.is_finished()) {
                self.answer(validating, server, dispatcher);
            }
            if self.validating.is_some() {
                return;
            }
            let Some(bytes) = self.queue.pop_front() else {
                (self.is_reading, self.over) = (false, self.over + 1);
                return;
            };
            let is_small = bytes.bytes.len() <= SMALL;
            let validating = dispatcher.validation().start(scope, bytes);
            match is_small {
                true => self.answer(validating, server, dispatcher),
                false => self.validating = Some(validating),
            }
        }
    }

    fn answer(&self, validating: Validating<'_>, server: &mut RolloutServer, dispatcher: &mut Dispatcher) {
        let header = validating.header;
        let (verdict, text) = dispatcher.take_policy(header.version, validating.end());
        server.receipt(&header, verdict, &text);
    }

    /// The server ends: whoever still waits is told so with the others.
    pub(super) fn end(self, dispatcher: &mut Dispatcher) {
        self.held.into_iter().for_each(|(_, caller)| dispatcher.admit(caller));
        // A thread that nobody waited for would end the server with its panic.
        self.validating.into_iter().for_each(|validating| drop(validating.end()));
    }
}

/// Of a training, which acts by the policy that was pushed last.
fn goes_by_what_was_pushed(caller: &Caller) -> bool {
    decode(caller.bytes())
        .is_ok_and(|(_, _, request)| request.training.is_some() && request.version.is_some())
}
