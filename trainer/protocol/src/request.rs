//! A request as a client means it, and as it arrives.

use super::messages::{OWN, RequestMessage};
use nearl_runtime::Manifest;
use nearl_runtime::link::{Header, Message, hash_names};

/// Which constraints a rollout is projected onto.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Constraints {
    /// The server's.
    #[default]
    Own,
    /// None: the raw proposal is the target.
    Off,
    /// Those with this id ([`constraint_set`]); refused by a server with others.
    Id(u64),
}

/// Experience for a learner instead of a rollout: environments that go on from one request of a client to its next. The answer is
/// not a stream of transitions but, in parts, what [`Rollouts::next_part`](super::Rollouts::next_part) gives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Training {
    /// Environments; each takes the steps of the request.
    pub n_envs: u64,
    /// They begin anew; else they go on where the client's last request left them.
    pub begins: bool,
    /// Environment `i` draws from the seed's random stream `stream + i`.
    pub stream: u64,
    /// Discount of the returns that scale the reward, in \[0, 1\].
    pub gamma: f64,
    /// What the reward is lowered by for each unit of distance the projection moved a target, at least 0.
    pub moved_penalty: f64,
}

/// What a client asks for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Request {
    /// Seed of the initial states and of the noise; the same seed gives the same bits.
    pub seed: u64,
    /// Policy steps.
    pub n_steps: u64,
    /// Version of the policy; the server's if `None`. A training may also name the one that was pushed to the server last.
    pub version: Option<u64>,
    /// Sample as the policy does; without, its mean.
    pub noise: bool,
    /// What the proposals are projected onto.
    pub constraints: Constraints,
    /// Collects for a learner.
    pub training: Option<Training>,
}

impl Request {
    /// `n_steps` policy steps from `seed`, with noise, by the server's policy and constraints.
    pub fn new(seed: u64, n_steps: u64) -> Request {
        Request { seed, n_steps, version: None, noise: true, constraints: Constraints::Own, training: None }
    }

    /// The message number `request`; the sender fills the header.
    pub fn message(&self, request: u64) -> RequestMessage {
        RequestMessage {
            request,
            seed: self.seed,
            n_steps: self.n_steps,
            version: self.version.unwrap_or(OWN),
            constraints: match self.constraints {
                Constraints::Own => OWN,
                Constraints::Off => 0,
                Constraints::Id(id) => id,
            },
            noise: u32::from(self.noise),
            n_envs: self.training.map_or(0, |t| t.n_envs),
            begins: self.training.map_or(0, |t| u32::from(t.begins)),
            stream: self.training.map_or(0, |t| t.stream),
            gamma: self.training.map_or(0.0, |t| t.gamma),
            moved_penalty: self.training.map_or(0.0, |t| t.moved_penalty),
            ..RequestMessage::zeroed()
        }
    }
}

/// Why bytes are no request: one sentence, and the request's number and client as far as they can be believed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{reason}")]
pub struct Malformed {
    /// Number of the request; 0 if the bytes do not hold one.
    pub request: u64,
    /// Epoch of the client; 0 if the bytes do not hold one.
    pub client: u64,
    /// One sentence.
    pub reason: String,
}

/// Reads a request; returns its number, the client's epoch and what is asked for.
///
/// # Errors
/// [`Malformed`] for a wrong length, schema or value. Any bytes are allowed.
pub fn decode(bytes: &[u8]) -> Result<(u64, u64, Request), Malformed> {
    let size = size_of::<RequestMessage>();
    if bytes.len() != size {
        let reason =
            format!("a request has {size} bytes, this one {}: use the client of this build", bytes.len());
        return Err(Malformed { request: 0, client: 0, reason });
    }
    // SAFETY: the length is the struct's, every bit pattern is a value, and the read does not need alignment.
    let m = unsafe { bytes.as_ptr().cast::<RequestMessage>().read_unaligned() };
    let Header { schema, epoch, .. } = m.header;
    let refuse = |request, client, reason| Err(Malformed { request, client, reason });
    if schema != RequestMessage::SCHEMA {
        let ours = RequestMessage::SCHEMA;
        return refuse(
            0,
            0,
            format!(
                "the request's schema is {schema:016x}, the server's {ours:016x}: run both from the same nearl build"
            ),
        );
    }
    if m.n_steps == 0 {
        return refuse(m.request, epoch, "n_steps is 0: ask for at least 1 step".into());
    }
    if m.noise > 1 || m.begins > 1 {
        let (noise, begins) = (m.noise, m.begins);
        return refuse(m.request, epoch, format!("noise is {noise} and begins {begins}: each is 0 or 1"));
    }
    let training = match training(&m) {
        Ok(training) => training,
        Err(reason) => return refuse(m.request, epoch, reason),
    };
    let constraints = match m.constraints {
        OWN => Constraints::Own,
        0 => Constraints::Off,
        id => Constraints::Id(id),
    };
    let version = (m.version != OWN).then_some(m.version);
    let (seed, n_steps, noise) = (m.seed, m.n_steps, m.noise == 1);
    Ok((m.request, epoch, Request { seed, n_steps, version, noise, constraints, training }))
}

fn training(m: &RequestMessage) -> Result<Option<Training>, String> {
    let RequestMessage { n_envs, stream, gamma, moved_penalty, .. } = *m;
    if n_envs == 0 {
        let is_empty = (stream, m.begins) == (0, 0) && (gamma, moved_penalty) == (0.0, 0.0);
        return match is_empty {
            true => Ok(None),
            false => Err("n_envs is 0, but something is said of a training: give its environments".into()),
        };
    }
    if !(0.0..=1.0).contains(&gamma) || !(0.0..f64::INFINITY).contains(&moved_penalty) {
        return Err(format!(
            "gamma is {gamma} and moved_penalty {moved_penalty}: gamma lies in [0, 1], moved_penalty is at least 0"
        ));
    }
    if m.noise == 0 {
        return Err("noise is 0: a training needs the policy's noise".into());
    }
    Ok(Some(Training { n_envs, begins: m.begins == 1, stream, gamma, moved_penalty }))
}

/// Id of a snapshot's constraint set: a hash of its effective `[constraints]` and robot, never 0 or all ones.
pub fn constraint_set(manifest: &Manifest) -> u64 {
    let constraints = serde_json::to_string(&manifest.task.constraints).unwrap_or_default();
    let robot = serde_json::to_string(&manifest.robot).unwrap_or_default();
    hash_names([constraints, robot]).clamp(1, OWN - 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(message: &RequestMessage) -> Vec<u8> {
        crate::client::bytes_of(message).to_vec()
    }

    const TRAINING: Training =
        Training { n_envs: 8, begins: true, stream: 16, gamma: 0.99, moved_penalty: 0.5 };

    fn sent(request: &Request) -> RequestMessage {
        let mut message = request.message(7);
        message.header = Header { schema: RequestMessage::SCHEMA, epoch: 3, seq: 1, stamp: 0 };
        message
    }

    #[test]
    fn what_is_asked_arrives() {
        let asked = [
            Request::new(u64::MAX, 1),
            Request { version: Some(9), noise: false, constraints: Constraints::Off, ..Request::new(0, 5) },
            Request { constraints: Constraints::Id(12), ..Request::new(1, 2) },
            Request { training: Some(TRAINING), ..Request::new(3, 256) },
        ];
        for request in asked {
            assert_eq!(decode(&bytes(&sent(&request))), Ok((7, 3, request)));
        }
    }

    #[test]
    fn wrong_length_schema_and_values_are_refused_by_name() {
        let good = sent(&Request::new(1, 2));
        let refused = |message: RequestMessage| decode(&bytes(&message)).unwrap_err();
        assert!(decode(&[]).unwrap_err().reason.contains("this one 0"));
        assert!(decode(&[255; 1024]).unwrap_err().reason.contains("this one 1024"));
        let mut foreign = good;
        foreign.header.schema ^= 1;
        assert!(refused(foreign).reason.contains("schema"));
        assert!(refused(RequestMessage { n_steps: 0, ..good }).reason.contains("n_steps"));
        let noisy = refused(RequestMessage { noise: 2, ..good });
        assert!(noisy.reason.contains("noise is 2"));
        assert_eq!((noisy.request, noisy.client), (7, 3));
        let training = sent(&Request { training: Some(TRAINING), ..Request::new(1, 2) });
        for (broken, what) in [
            (RequestMessage { n_envs: 0, ..training }, "n_envs is 0"),
            (RequestMessage { gamma: f64::NAN, ..training }, "gamma is NaN"),
            (RequestMessage { gamma: 1.5, ..training }, "gamma is 1.5"),
            (RequestMessage { moved_penalty: -1.0, ..training }, "moved_penalty -1"),
            (RequestMessage { moved_penalty: f64::INFINITY, ..training }, "moved_penalty inf"),
            (RequestMessage { begins: 7, ..training }, "begins 7"),
            (RequestMessage { noise: 0, ..training }, "noise is 0"),
        ] {
            assert!(refused(broken).reason.contains(what), "{what}");
        }
    }
}
