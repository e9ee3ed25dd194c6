//! The client's end: a request out, transitions in.

use std::sync::Arc;
use std::time::{Duration, Instant};

use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::client::{Client, RequestSendError};
use iceoryx2::prelude::BackpressureStrategy;
use iceoryx2::service::port_factory::PortFactory;
use iceoryx2::service::port_factory::client::ClientCreateError;

use super::messages::{Answer, Envelope, MAX_REQUEST, ReplyMessage, RequestMessage};
use super::service::{self, Factory};
use super::{Layout, Request, RequestError};
use nearl_runtime::clock;
use nearl_runtime::link::service::{Bus, Ipc};
use nearl_runtime::link::{Header, LinkError, Message, RobotName};

/// Waits between two looks at an empty buffer: they double from the first to the longest, far below the time the server needs
/// to fill a buffer.
const NAP: (Duration, Duration) = (Duration::from_micros(50), Duration::from_millis(1));
/// Silence after which the client looks whether the server still lives.
const SUSPICION: Duration = Duration::from_millis(250);
/// Time for a server to take one of this client's requests, so that there is room for the next.
const ROOM: Duration = Duration::from_secs(10);

/// Looking for something again and again, at first often.
struct Waiting {
    start: Instant,
    suspicion: Duration,
    nap: Duration,
}

impl Waiting {
    fn new() -> Waiting {
        Waiting { start: Instant::now(), suspicion: SUSPICION, nap: NAP.0 }
    }

    fn silent(&self) -> Duration {
        self.start.elapsed()
    }

    /// True once in [`SUSPICION`].
    fn is_suspicious(&mut self) -> bool {
        let due = self.silent() >= self.suspicion;
        if due {
            self.suspicion += SUSPICION;
        }
        due
    }

    fn nap(&mut self) {
        std::thread::sleep(self.nap);
        self.nap = NAP.1.min(2 * self.nap);
    }
}

/// Asks a rollout server of this machine. Requests may overlap, two at a time.
pub struct RolloutClient {
    port: Client<Ipc, Envelope, (), [f64], ReplyMessage>,
    factory: Arc<Factory>,
    bus: Arc<Bus>,
    requests: u64,
}

/// One chunk of transitions.
#[derive(Clone, Debug, PartialEq)]
pub struct Chunk {
    /// Sizes of a row.
    pub layout: Layout,
    /// Number of the chunk, from 0.
    pub sequence: u64,
    /// Policy step of the first row.
    pub first_step: u64,
    /// Version of the policy.
    pub version: u64,
    /// Id of the server's constraint set.
    pub constraints: u64,
    /// Transitions in the chunk.
    pub rows: usize,
    /// The rows one after the other (rows x [`Layout::width`]).
    pub numbers: Vec<f64>,
}

impl Chunk {
    /// The entries of a column, row by row; empty for a name that does not exist.
    pub fn column<'a>(&'a self, name: &str) -> impl Iterator<Item = &'a [f64]> + use<'a> {
        let place = self.layout.find(name);
        let rows = self.numbers.chunks_exact(self.layout.width().max(1));
        place.into_iter().flat_map(move |p| rows.clone().map(move |row| &row[p.clone()]))
    }
}

/// What a reply brings.
enum Piece {
    Chunk(Chunk),
    Part(Vec<f64>),
}

impl RolloutClient {
    /// Opens the service of `name` and waits up to `patience` for its server.
    ///
    /// # Errors
    /// [`RequestError::NoServer`], or [`RequestError::Link`].
    pub fn open(name: &RobotName, patience: Duration) -> Result<RolloutClient, RequestError> {
        let bus = Bus::join(name)?;
        let factory = Arc::new(service::open(&bus)?);
        let port = factory
            .client_builder()
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(|e| match e {
                ClientCreateError::ExceedsMaxSupportedClients => service::full(&bus),
                other => name.transport("ask for rollouts", format!("{other:?}")),
            })?;
        let end = Instant::now() + patience;
        while factory.dynamic_config().number_of_servers() == 0 {
            if Instant::now() >= end {
                return Err(RequestError::NoServer(name.clone()));
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        Ok(RolloutClient { port, factory, bus: Arc::new(bus), requests: 0 })
    }

    /// Sends a request; its transitions come from what is returned. Waits, 10 s at most, while the server has not yet taken this
    /// client's last ones.
    ///
    /// # Errors
    /// [`RequestError`]. The server's own refusals come with the first [`Rollouts::next`].
    pub fn request(&mut self, request: &Request) -> Result<Rollouts, RequestError> {
        self.requests += 1;
        let mut message = request.message(self.requests);
        message.header = Header {
            schema: RequestMessage::SCHEMA,
            epoch: self.bus.epoch(),
            seq: self.requests,
            stamp: clock::now(),
        };
        self.send(bytes_of(&message), self.requests)
    }

    /// Sends any bytes as a request, as a broken client would. An answer to bytes the server cannot read has number 0.
    ///
    /// # Errors
    /// [`RequestError`].
    pub fn request_bytes(&mut self, bytes: &[u8]) -> Result<Rollouts, RequestError> {
        self.send(bytes, 0)
    }

    fn send(&self, bytes: &[u8], request: u64) -> Result<Rollouts, RequestError> {
        let envelope =
            Envelope::new(bytes).ok_or(RequestError::TooLong { bytes: bytes.len(), limit: MAX_REQUEST })?;
        let mut waiting = Waiting::new();
        loop {
            if let Some(pending) = self.deliver(envelope)? {
                let (bus, client) = (Arc::clone(&self.bus), service::client_number(self.port.id().value()));
                let (pending, factory) = (Some(pending), Arc::clone(&self.factory));
                let (chunks, steps, cancelled, looked) = (0, 0, false, Instant::now());
                return Ok(Rollouts {
                    pending,
                    factory,
                    bus,
                    client,
                    request,
                    chunks,
                    steps,
                    cancelled,
                    looked,
                });
            }
            if waiting.is_suspicious() {
                self.bus.node().try_cleanup_dead_nodes();
            }
            let name = || self.bus.name().clone();
            if self.factory.dynamic_config().number_of_servers() == 0 {
                return Err(RequestError::NoServer(name()));
            }
            if waiting.silent() >= ROOM {
                return Err(RequestError::Behind { name: name(), seconds: ROOM.as_secs_f64() });
            }
            waiting.nap();
        }
    }

    /// `None` if the server has no room for another request of this client now.
    fn deliver(&self, envelope: Envelope) -> Result<Option<Pending>, RequestError> {
        let name = self.bus.name();
        let failed = |e: String| RequestError::from(name.transport("send a request", e));
        let sample = self.port.loan_uninit().map_err(|e| failed(format!("{e:?}")))?;
        let pending = sample.write_payload(envelope).send().map_err(|e| match e {
            RequestSendError::ExceedsMaxActiveRequests => RequestError::TooMany(name.clone()),
            other => failed(format!("{other:?}")),
        })?;
        Ok((pending.number_of_server_connections() > 0).then_some(pending))
    }
}

/// The bytes of a message.
pub(super) fn bytes_of(message: &RequestMessage) -> &[u8] {
    // SAFETY: `repr(C)` numbers without padding between them; only read while `message` is borrowed.
    unsafe { std::slice::from_raw_parts(std::ptr::from_ref(message).cast(), size_of::<RequestMessage>()) }
}

type Pending = PendingResponse<Ipc, Envelope, (), [f64], ReplyMessage>;

/// The answers to one request. Dropping it frees the server's place.
pub struct Rollouts {
    /// `None` once the stream is over: the client may then ask for another.
    pending: Option<Pending>,
    factory: Arc<Factory>,
    bus: Arc<Bus>,
    /// This client, as the server's replies name it.
    client: u64,
    /// Number of the request; 0 for bytes that hold none.
    request: u64,
    chunks: u64,
    steps: u64,
    cancelled: bool,
    /// When the server was last seen to live: whoever waits a little at a time sees it die too.
    looked: Instant,
}

impl Rollouts {
    /// The next chunk; `None` after the last one, or after [`Rollouts::cancel`] once the server agreed.
    ///
    /// # Errors
    /// [`RequestError::Refused`] with the server's answer, [`RequestError::ServerGone`], [`RequestError::GivenUp`], or
    /// [`RequestError::Silent`] after `patience` without a reply. Every error but the last ends the stream.
    pub fn next(&mut self, patience: Duration) -> Result<Option<Chunk>, RequestError> {
        match self.next_piece(patience)? {
            None => Ok(None),
            Some(Piece::Chunk(chunk)) => Ok(Some(chunk)),
            Some(Piece::Part(_)) => Err(self.broken("a part of a training instead of a chunk".into())),
        }
    }

    /// The next part of what a [`Training`](super::Training) collected: numbers that go on where the last part ended. Otherwise
    /// as [`Rollouts::next`].
    ///
    /// # Errors
    /// As [`Rollouts::next`].
    pub fn next_part(&mut self, patience: Duration) -> Result<Option<Vec<f64>>, RequestError> {
        match self.next_piece(patience)? {
            None => Ok(None),
            Some(Piece::Part(numbers)) => Ok(Some(numbers)),
            Some(Piece::Chunk(_)) => Err(self.broken("a chunk instead of a part of a training".into())),
        }
    }

    fn next_piece(&mut self, patience: Duration) -> Result<Option<Piece>, RequestError> {
        let Some(pending) = self.pending.take() else { return Ok(None) };
        let result = self.wait(&pending, patience);
        if matches!(result, Ok(Some(_)) | Err(RequestError::Silent { .. })) {
            self.pending = Some(pending);
        }
        result
    }

    /// Asks the server to stop. Chunks under way still come; then [`Rollouts::next`] gives `None`.
    pub fn cancel(&mut self) {
        self.cancelled = true;
        self.pending.iter().for_each(PendingResponse::set_disconnect_hint);
    }

    /// Why nothing more comes.
    fn lost(&self) -> RequestError {
        let name = self.bus.name().clone();
        match self.factory.dynamic_config().number_of_servers() {
            0 => RequestError::ServerGone(name),
            _ => RequestError::GivenUp(name),
        }
    }

    fn broken(&self, what: String) -> RequestError {
        RequestError::Broken { name: self.bus.name().clone(), what }
    }

    /// Transitions received so far, or numbers of a training.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    fn wait(&mut self, pending: &Pending, patience: Duration) -> Result<Option<Piece>, RequestError> {
        let mut waiting = Waiting::new();
        loop {
            if let Some((reply, numbers)) = self.receive(pending)? {
                self.looked = Instant::now();
                match self.read(&reply, numbers)? {
                    Some(end) => return Ok(end),
                    None => continue,
                }
            }
            if waiting.silent() >= patience {
                let name = self.bus.name().clone();
                return Err(RequestError::Silent { name, seconds: patience.as_secs_f64() });
            }
            if self.looked.elapsed() >= SUSPICION {
                self.looked = Instant::now();
                self.bus.node().try_cleanup_dead_nodes();
                // One that was killed is no longer listed, and has closed nothing. Its last reply may have come between the look into the buffer and here.
                let is_over =
                    !pending.is_connected() || self.factory.dynamic_config().number_of_servers() == 0;
                if is_over && !pending.has_response() {
                    return Err(self.lost());
                }
            }
            waiting.nap();
        }
    }

    /// The next reply to this request; those to a request of a client that had this place before are left out.
    fn receive(&self, pending: &Pending) -> Result<Option<(ReplyMessage, Vec<f64>)>, LinkError> {
        loop {
            let failed = |e| self.bus.name().transport("receive a reply", format!("{e:?}"));
            let Some(sample) = pending.receive().map_err(failed)? else { return Ok(None) };
            let reply = *sample.user_header();
            if reply.header.schema == ReplyMessage::SCHEMA && self.is_ours(&reply) {
                return Ok(Some((reply, sample.payload().to_vec())));
            }
        }
    }

    /// A reply to bytes that hold no number has number 0.
    fn is_ours(&self, reply: &ReplyMessage) -> bool {
        let numbered = self.request != 0 && reply.request != 0;
        reply.client == self.client && (!numbered || reply.request == self.request)
    }

    /// `None` to go on waiting, else what is returned.
    fn read(
        &mut self,
        reply: &ReplyMessage,
        numbers: Vec<f64>,
    ) -> Result<Option<Option<Piece>>, RequestError> {
        let broken = |what: String| self.broken(what);
        match reply.answer() {
            Some(Answer::Accepted) => Ok(None),
            Some(answer @ (Answer::Chunk | Answer::Part)) => {
                let (layout, rows) = (Layout::of(reply), reply.rows as usize);
                if (reply.chunk, reply.first_step) != (self.chunks, self.steps) {
                    let (got, wanted) = (reply.chunk, self.chunks);
                    return Err(broken(format!("chunk {got} instead of {wanted}")));
                }
                let width = if answer == Answer::Chunk { layout.width() } else { 1 };
                if width.checked_mul(rows) != Some(numbers.len()) {
                    return Err(broken(format!("{} numbers for {rows} rows", numbers.len())));
                }
                self.chunks += 1;
                self.steps += u64::from(reply.rows);
                if answer == Answer::Part {
                    return Ok(Some(Some(Piece::Part(numbers))));
                }
                Ok(Some(Some(Piece::Chunk(Chunk {
                    layout,
                    sequence: reply.chunk,
                    first_step: reply.first_step,
                    version: reply.version,
                    constraints: reply.constraints,
                    rows,
                    numbers,
                }))))
            }
            Some(Answer::Done) => Ok(Some(None)),
            Some(Answer::Cancelled) if self.cancelled => Ok(Some(None)),
            Some(answer) => Err(RequestError::Refused { answer, text: reply.text() }),
            None => Err(broken(format!("the unknown answer {}", reply.answer))),
        }
    }
}
