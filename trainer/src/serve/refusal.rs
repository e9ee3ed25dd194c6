//! An answer that ends a request at once, kept until its client has room for it.

use nearl_rollout_protocol::{Answer, Caller, Delivery};
use std::time::{Duration, Instant};

pub(super) struct Refusal {
    caller: Caller,
    number: u64,
    answer: Answer,
    text: String,
    since: Instant,
}

impl Refusal {
    /// `answer` to the request with that number.
    pub(super) fn new(caller: Caller, number: u64, answer: Answer, text: String) -> Refusal {
        Refusal { caller, number, answer, text, since: Instant::now() }
    }

    /// Tries to deliver it; true once the client has it, is gone, or has taken nothing for `patience`.
    pub(super) fn is_over(&mut self, patience: Duration) -> bool {
        match self.caller.answer(self.answer, &self.text, self.number) {
            Delivery::Sent | Delivery::Gone => true,
            Delivery::Full => self.since.elapsed() > patience,
        }
    }
}
