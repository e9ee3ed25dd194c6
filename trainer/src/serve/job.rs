//! One accepted request: how far it is, and what is still to be sent.

use super::pool::{Start, Task};
use crate::rollout::Worker;
use nearl_runtime::rollout_protocol::{Answer, Caller, Constraints, Delivery, Layout, ReplyMessage, Request};
use std::collections::VecDeque;
use std::time::Instant;

/// Where a request is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stage {
    /// Waits for its turn, or for its client to read.
    Waiting,
    /// A chunk is being simulated.
    AtWork,
    /// Nothing more is simulated; what is left is sent.
    Ending(Answer),
}

pub(super) struct Job {
    pub(super) caller: Caller,
    pub(super) client: u128,
    pub(super) stage: Stage,
    pub(super) worker: Option<Box<Worker>>,
    request: Request,
    reply: ReplyMessage,
    /// At most a chunk and the end, with `Accepted` before the first.
    outbox: VecDeque<(ReplyMessage, Vec<f64>)>,
    /// Since when the client's buffer is full.
    stuck: Option<Instant>,
    queued: bool,
    simulated: u64,
    chunks: u64,
}

impl Job {
    /// An accepted request; `reply` holds what all its replies have in common.
    pub(super) fn new(caller: Caller, request: Request, reply: ReplyMessage) -> Job {
        let mut job = Job {
            client: caller.client(),
            caller,
            stage: Stage::Waiting,
            worker: None,
            request,
            reply,
            outbox: VecDeque::with_capacity(3),
            stuck: None,
            queued: false,
            simulated: 0,
            chunks: 0,
        };
        job.push(Answer::Accepted, "", Vec::new());
        job
    }

    /// The next chunk to simulate, of at most `rows` steps.
    pub(super) fn task(&mut self, slot: u64, rows: usize) -> Task {
        (self.stage, self.queued) = (Stage::AtWork, false);
        let left = self.request.n_steps - self.simulated;
        let projection = self.request.constraints != Constraints::Off;
        Task {
            slot,
            worker: self.worker.take(),
            start: (self.simulated == 0).then_some(Start { seed: self.request.seed, projection }),
            rows: rows.min(usize::try_from(left).unwrap_or(rows)),
            noise: self.request.noise,
        }
    }

    /// A simulated chunk, to be sent.
    pub(super) fn chunk(&mut self, rows: usize, numbers: Vec<f64>, layout: Layout) {
        debug_assert_eq!(numbers.len(), rows * layout.width());
        (self.reply.chunk, self.reply.first_step, self.reply.rows) =
            (self.chunks, self.simulated, rows as u32);
        self.push(Answer::Chunk, "", numbers);
        self.reply.rows = 0;
        self.chunks += 1;
        self.simulated += rows as u64;
        self.stage = Stage::Waiting;
        if self.simulated == self.request.n_steps {
            self.end(Answer::Done, "");
        }
    }

    /// Ends with `answer` after what is still to be sent.
    pub(super) fn end(&mut self, answer: Answer, text: &str) {
        self.push(answer, text, Vec::new());
        self.stage = Stage::Ending(answer);
    }

    /// Forgets what is still to be sent, and ends with `answer`.
    pub(super) fn stop(&mut self, answer: Answer, text: &str) {
        // A chunk left out here is the last: the numbering of what was sent has no gap.
        self.outbox.clear();
        self.end(answer, text);
    }

    /// Sends what the client has room for; false once it is gone.
    pub(super) fn flush(&mut self) -> bool {
        while let Some((reply, numbers)) = self.outbox.front_mut() {
            match self.caller.send(reply, numbers) {
                Delivery::Sent => {
                    self.outbox.pop_front();
                    self.stuck = None;
                }
                Delivery::Full => {
                    self.stuck.get_or_insert_with(Instant::now);
                    return true;
                }
                Delivery::Gone => return false,
            }
        }
        true
    }

    /// True once everything was sent.
    pub(super) fn is_flushed(&self) -> bool {
        self.outbox.is_empty()
    }

    /// True once, each time the request can go on: it is then to be queued.
    pub(super) fn wants_turn(&mut self) -> bool {
        let wants = self.stage == Stage::Waiting && self.is_flushed() && !self.queued;
        self.queued |= wants;
        wants
    }

    /// When the client's buffer became full, if it is.
    pub(super) fn stuck(&self) -> Option<Instant> {
        self.stuck
    }

    fn push(&mut self, answer: Answer, text: &str, numbers: Vec<f64>) {
        self.reply.set(answer, text);
        self.outbox.push_back((self.reply, numbers));
    }
}
