//! One accepted request: how far it is, and what is still to be sent.

use super::pool::{Order, Start, Task};
use super::training::{Load, Session};
use crate::rollout::Worker;
use nearl_rollout_protocol::{Answer, Caller, Constraints, Delivery, MAX_CHUNK, ReplyMessage, Request};
use std::collections::VecDeque;
use std::ops::Range;
use std::rc::Rc;
use std::time::Instant;

/// Where a request is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stage {
    /// Something is still to be simulated or sent.
    Running,
    /// Nothing more is simulated; what is left is sent.
    Ending(Answer),
}

/// What a request is about.
pub(super) enum Subject {
    /// Transitions from a seed.
    Rollout(Rollout),
    /// Segments of a client's environments.
    Training(Session),
}

/// Numbers to be sent, all or a part of those that belong together.
type Part = (Rc<Vec<f64>>, Range<usize>);

/// One environment, its chunks one after the other.
#[derive(Default)]
pub(super) struct Rollout {
    worker: Option<Box<Worker>>,
    simulated: u64,
    at_work: bool,
}

pub(super) struct Job {
    pub(super) caller: Caller,
    pub(super) client: u128,
    pub(super) stage: Stage,
    subject: Subject,
    request: Request,
    reply: ReplyMessage,
    /// What one environment gave, and the end, with `Accepted` before the first.
    outbox: VecDeque<(ReplyMessage, Part)>,
    /// Since when the client's buffer is full.
    stuck: Option<Instant>,
    queued: bool,
    sent: u64,
    chunks: u64,
}

impl Job {
    /// An accepted request; `reply` holds what all its replies have in common.
    pub(super) fn new(caller: Caller, request: Request, subject: Subject, reply: ReplyMessage) -> Job {
        let mut job = Job {
            client: caller.client(),
            caller,
            stage: Stage::Running,
            subject,
            request,
            reply,
            outbox: VecDeque::with_capacity(3),
            stuck: None,
            queued: false,
            sent: 0,
            chunks: 0,
        };
        job.push(Answer::Accepted, "", Part::default());
        job
    }

    /// The next chunk or portion to simulate, of at most `rows` steps.
    pub(super) fn task(&mut self, slot: u64, rows: usize) -> Option<Task> {
        self.queued = false;
        let request = &self.request;
        match &mut self.subject {
            Subject::Training(session) => session.task(slot, rows),
            Subject::Rollout(r) => {
                r.at_work = true;
                let left = request.n_steps - r.simulated;
                let projection = request.constraints != Constraints::Off;
                let start =
                    Start { seed: request.seed, stream: 0, projection, gamma: 1.0, moved_penalty: 0.0 };
                let order = Order::Chunk { start: (r.simulated == 0).then_some(start), noise: request.noise };
                let rows = rows.min(usize::try_from(left).unwrap_or(rows));
                Some(Task { slot, place: None, worker: r.worker.take(), rows, order })
            }
        }
    }

    /// What was simulated, to be sent.
    pub(super) fn take_back(
        &mut self,
        place: Option<usize>,
        worker: Box<Worker>,
        rows: usize,
        numbers: Vec<f64>,
    ) {
        match &mut self.subject {
            Subject::Training(session) => session.take_back(place.unwrap_or_default(), worker),
            Subject::Rollout(r) => {
                (r.worker, r.at_work) = (Some(worker), false);
                r.simulated += rows as u64;
                let is_last = r.simulated == self.request.n_steps;
                let all = 0..numbers.len();
                self.push_numbers(Answer::Chunk, rows, (Rc::new(numbers), all));
                if is_last {
                    self.end(Answer::Done, "");
                }
            }
        }
    }

    /// Puts what an environment of a training collected where it is sent from, once that is empty; true if there was something.
    fn refill(&mut self) -> bool {
        let Subject::Training(session) = &mut self.subject else { return false };
        if self.stage != Stage::Running {
            return false;
        }
        if let Some(numbers) = session.carry() {
            let (length, numbers) = (numbers.len(), Rc::new(numbers));
            for begin in (0..length).step_by(MAX_CHUNK) {
                let end = length.min(begin + MAX_CHUNK);
                self.push_numbers(Answer::Part, end - begin, (Rc::clone(&numbers), begin..end));
            }
            return true;
        }
        let is_over = session.is_over();
        if is_over {
            self.end(Answer::Done, "");
        }
        is_over
    }

    /// Ends with `answer` after what is still to be sent.
    pub(super) fn end(&mut self, answer: Answer, text: &str) {
        self.push(answer, text, Part::default());
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
        loop {
            while let Some((reply, (numbers, range))) = self.outbox.front_mut() {
                match self.caller.send(reply, &numbers[range.clone()]) {
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
            if !self.refill() {
                return true;
            }
        }
    }

    /// True once everything was sent.
    pub(super) fn is_flushed(&self) -> bool {
        self.outbox.is_empty()
    }

    /// True once, each time the request can go on: it is then to be queued. A rollout waits for its client to read; what a
    /// training collects stays in its environments.
    pub(super) fn wants_turn(&mut self) -> bool {
        let can = match &self.subject {
            Subject::Training(session) => session.wants(),
            Subject::Rollout(r) => !r.at_work && self.is_flushed(),
        };
        let wants = can && self.stage == Stage::Running && !self.queued;
        self.queued |= wants;
        wants
    }

    /// Since when the client's buffer is full, if it is.
    pub(super) fn stuck(&self) -> Option<Instant> {
        self.stuck
    }

    /// What a training keeps.
    pub(super) fn load(&self) -> Load {
        match &self.subject {
            Subject::Training(session) => session.load(),
            Subject::Rollout(_) => Load::default(),
        }
    }

    /// What is left once the request is over.
    pub(super) fn into_subject(self) -> Subject {
        self.subject
    }

    fn push_numbers(&mut self, answer: Answer, rows: usize, numbers: Part) {
        (self.reply.chunk, self.reply.first_step, self.reply.rows) = (self.chunks, self.sent, rows as u32);
        self.push(answer, "", numbers);
        self.reply.rows = 0;
        self.chunks += 1;
        self.sent += rows as u64;
    }

    fn push(&mut self, answer: Answer, text: &str, numbers: Part) {
        self.reply.set(answer, text);
        self.outbox.push_back((self.reply, numbers));
    }
}

impl Rollout {
    /// The worker, for the next rollout.
    pub(super) fn into_worker(self) -> Option<Box<Worker>> {
        self.worker
    }
}
