//! Request, reply and what a reply can say.

use nearl_runtime::codes::codes;
use nearl_runtime::link_message as message;

/// Numbers in one chunk at most.
pub const MAX_CHUNK: usize = 4096;
/// Bytes in one request at most; a well-formed one has the size of [`RequestMessage`].
pub const MAX_REQUEST: usize = 1024;
/// Bytes that the sentence in a [`ReplyMessage`] has room for.
pub const MAX_REPLY_TEXT: usize = 256;

/// A request as it travels: any bytes, in a place of fixed size.
///
/// Not a slice: of a slice whose client has left, iceoryx2 0.10 never gives the buffer back.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub(super) struct Envelope {
    length: u64,
    bytes: [u8; MAX_REQUEST],
}

impl Envelope {
    /// `None` for more bytes than fit.
    pub(super) fn new(bytes: &[u8]) -> Option<Envelope> {
        let mut envelope = Envelope { length: bytes.len() as u64, bytes: [0; MAX_REQUEST] };
        envelope.bytes.get_mut(..bytes.len())?.copy_from_slice(bytes);
        Some(envelope)
    }

    /// The bytes; a peer may send any number as their length.
    pub(super) fn bytes(&self) -> &[u8] {
        let length = usize::try_from(self.length).unwrap_or(MAX_REQUEST).min(MAX_REQUEST);
        &self.bytes[..length]
    }
}

// SAFETY: `repr(C)`, self-contained, no pointers.
unsafe impl iceoryx2::prelude::ZeroCopySend for Envelope {
    unsafe fn type_name() -> &'static str {
        "nearl.rollout-envelope.v1"
    }
}

/// In `version` and `constraints`: what the server has.
pub(super) const OWN: u64 = u64::MAX;

message! {
    /// What a client asks for.
    RequestMessage, "rollout-request", version 2, buffer 4, history 0, subscribers 1 {
        /// Number of the request, chosen by the client.
        request: u64,
        /// Seed of the initial states and of the noise.
        seed: u64,
        /// Policy steps; of each environment in a training.
        n_steps: u64,
        /// Version of the policy; all ones for the server's.
        version: u64,
        /// Id of the constraint set; 0 for none, all ones for the server's.
        constraints: u64,
        /// Environments of a training; 0 for a rollout, and then zero in all that follows but `noise`.
        n_envs: u64,
        /// Number of the first environment's random stream.
        stream: u64,
        /// Discount of the returns that scale the reward.
        gamma: f64,
        /// What the reward is lowered by for each unit of distance moved.
        moved_penalty: f64,
        /// 1 with the policy's noise, 0 without.
        noise: u32,
        /// 1 if a training's environments begin anew, 0 if they go on.
        begins: u32,
    }
}

message! {
    /// Header of every answer; the numbers of a chunk follow it.
    ReplyMessage, "rollout-reply", version 3, buffer 4, history 0, subscribers 1 {
        /// Number of the request.
        request: u64,
        /// The client that asked, as the transport knows it; filled by [`Caller`](super::Caller).
        client: u64,
        /// Version of the policy.
        version: u64,
        /// Id of the server's constraint set.
        constraints: u64,
        /// Number of the chunk or part, from 0.
        chunk: u64,
        /// Policy step of the first row; for a part, its first number among all.
        first_step: u64,
        /// Policy steps asked for.
        n_steps: u64,
        /// [`Answer`] by its number.
        answer: u32,
        /// Rows in this chunk, or numbers in this part.
        rows: u32,
        /// Entries of an observation.
        n_obs: u32,
        /// Entries of a proposed state.
        n_state: u32,
        /// Entries of an action.
        n_act: u32,
        /// Bytes used in `text`.
        length: u32,
        /// One sentence for whoever asked.
        text: [u8; MAX_REPLY_TEXT],
    }
}

codes! {
    /// What a reply of the rollout server says.
    Answer, "rollout" {
        Accepted = "rollout-accepted", "The rollout server took the request; chunks follow.", "Nothing to do.";
        Chunk = "rollout-chunk", "A chunk of transitions.", "Nothing to do.";
        Part = "rollout-part", "A part of what a training collected.", "Nothing to do.";
        Done = "rollout-done", "All steps asked for were sent.", "Nothing to do.";
        Cancelled = "rollout-cancelled", "The client cancelled the request.", "Nothing to do.";
        Busy = "rollout-busy", "The rollout server has as many requests as it takes.",
            "Ask again later, or start the server with a higher --requests.";
        LimitExceeded = "limit-exceeded", "The request asks for more steps than the rollout server gives at once.",
            "Ask for fewer steps, or start the server with a higher --max-steps.";
        BadRequest = "bad-request", "The request has a wrong length, schema or value.",
            "Read the text of the reply; use the client of the same nearl build.";
        Failed = "rollout-failed", "The simulator failed in the middle of the rollout.",
            "Read the server's error output; ask with another seed.";
        Closing = "rollout-closing", "The rollout server was asked to end.", "Start it again and repeat the request.";
    }
}

impl ReplyMessage {
    /// The answer; `None` for a number this build does not know.
    pub fn answer(&self) -> Option<Answer> {
        Answer::ALL.get(self.answer as usize).copied()
    }

    /// The sentence.
    pub fn text(&self) -> String {
        let length = (self.length as usize).min(MAX_REPLY_TEXT);
        String::from_utf8_lossy(&self.text[..length]).into_owned()
    }

    /// Writes answer and sentence; a sentence beyond the capacity is cut at a character.
    pub fn set(&mut self, answer: Answer, text: &str) {
        let mut length = text.len().min(MAX_REPLY_TEXT);
        while !text.is_char_boundary(length) {
            length -= 1;
        }
        self.answer = answer.code();
        self.length = length as u32;
        self.text = [0; MAX_REPLY_TEXT];
        self.text[..length].copy_from_slice(&text.as_bytes()[..length]);
    }
}

impl Default for ReplyMessage {
    fn default() -> ReplyMessage {
        <ReplyMessage as nearl_runtime::link::Message>::zeroed()
    }
}
