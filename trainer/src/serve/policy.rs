//! The policies a server acts by: its own, and for those who learn the one that was pushed last.

use nearl_rollout_protocol::Request;
use nearl_runtime::link::{SnapshotBytes, SnapshotHeader, Verdict};
use nearl_runtime::net::Dense;
use nearl_runtime::{Controller, Manifest, Networks, Snapshot, SnapshotError};
use serde_json::Value;
use std::sync::Arc;
use std::thread::{Builder, Scope, ScopedJoinHandle};

/// Room of the thread that validates a pushed snapshot: parsers recurse as deep as its robot is nested [bytes].
const STACK: usize = 16 << 20;

pub(super) struct Policies {
    own: Arc<Snapshot>,
    pushed: Option<(u64, Arc<Snapshot>)>,
    /// What a pushed snapshot must share with the server's own.
    task: Arc<Value>,
}

/// What becomes of a pushed snapshot; a refusal is a verdict with a sentence.
pub(super) type Validated = Result<Snapshot, (Verdict, String)>;

impl Policies {
    pub(super) fn new(own: &Snapshot) -> Policies {
        Policies { task: Arc::new(shared(&own.manifest)), own: Arc::new(own.clone()), pushed: None }
    }

    /// The policy of a request; one sentence if the server does not have it.
    pub(super) fn find(&self, request: &Request) -> Result<Arc<Snapshot>, String> {
        let own = self.own.manifest.version;
        let Some(version) = request.version else { return Ok(Arc::clone(&self.own)) };
        match &self.pushed {
            Some((pushed, snapshot)) if request.training.is_some() && *pushed == version => {
                Ok(Arc::clone(snapshot))
            }
            Some((pushed, _)) if request.training.is_some() => {
                Err(format!("version {pushed} was pushed last, not {version}: push before each request"))
            }
            None if request.training.is_some() => {
                Err(format!("no version was pushed to the server, but {version} is asked for: push it first"))
            }
            _ if version == own => Ok(Arc::clone(&self.own)),
            _ => Err(format!(
                "the server has version {own} of the policy, not {version}: ask for that or for the current one"
            )),
        }
    }

    /// The version that [`Policies::find`] gives.
    pub(super) fn version(&self, request: &Request) -> u64 {
        request.version.unwrap_or(self.own.manifest.version)
    }

    /// Takes over what was validated.
    pub(super) fn take(&mut self, snapshot: Snapshot, version: u64) {
        self.pushed = Some((version, Arc::new(snapshot)));
    }

    /// What the next pushed snapshot is held to, for whatever thread validates it.
    pub(super) fn validation(&self) -> Validation {
        Validation {
            task: Arc::clone(&self.task),
            name: self.own.manifest.task.name.clone(),
            known: self.pushed.as_ref().map(|(_, snapshot)| Arc::clone(snapshot)),
        }
    }
}

/// Whether a pushed snapshot is whole and of the server's own task.
pub(super) struct Validation {
    task: Arc<Value>,
    name: String,
    /// The last good one: of the same shape no controller has to be made to see that one can be.
    known: Option<Arc<Snapshot>>,
}

impl Validation {
    fn run(&self, bytes: &[u8]) -> Validated {
        let snapshot = Snapshot::from_bytes(bytes).map_err(refused)?;
        if let Some(section) = difference(&self.task, &shared(&snapshot.manifest)) {
            let task = &self.name;
            return Err((
                Verdict::ForeignRobot,
                format!(
                    "it differs from the server's task '{task}' in {section}: train with the task that is served, or serve the other"
                ),
            ));
        }
        if !self.known.as_ref().is_some_and(|known| has_shape(known, &snapshot)) {
            Controller::new(&snapshot).map_err(refused)?;
        }
        Ok(snapshot)
    }

    /// Validates on a thread with room for what a hostile snapshot might break; a panic there is a refusal, not the end of the server.
    pub(super) fn start<'scope>(
        self,
        scope: &'scope Scope<'scope, '_>,
        pushed: SnapshotBytes,
    ) -> Validating<'scope> {
        let header = pushed.header;
        let thread = Builder::new().stack_size(STACK).spawn_scoped(scope, move || self.run(&pushed.bytes));
        Validating { header, thread: thread.ok() }
    }
}

/// A pushed snapshot that a thread validates.
pub(super) struct Validating<'scope> {
    pub(super) header: SnapshotHeader,
    /// None where no thread was to be had.
    thread: Option<ScopedJoinHandle<'scope, Validated>>,
}

impl Validating<'_> {
    pub(super) fn is_finished(&self) -> bool {
        self.thread.as_ref().is_none_or(ScopedJoinHandle::is_finished)
    }

    /// What was found; waits for it.
    pub(super) fn end(self) -> Validated {
        let found = self.thread.and_then(|thread| thread.join().ok());
        found.unwrap_or_else(|| {
            let text =
                format!("snapshot version {} broke its validation: export it again", self.header.version);
            Err((Verdict::Other, text))
        })
    }
}

fn refused(e: SnapshotError) -> (Verdict, String) {
    (Verdict::of(&e), e.to_string())
}

/// The task without the learner's settings, the robot, and the range of its motors.
fn shared(manifest: &Manifest) -> Value {
    let mut task = serde_json::to_value(&manifest.task).unwrap_or_default();
    if let Value::Object(sections) = &mut task {
        sections.remove("train");
        sections.insert("robot file".into(), serde_json::to_value(&manifest.robot).unwrap_or_default());
        let range = (&manifest.action_lower, &manifest.action_upper);
        sections.insert("range of its actuators".into(), serde_json::to_value(range).unwrap_or_default());
        sections.insert("moved limits".into(), serde_json::to_value(&manifest.moved).unwrap_or_default());
    }
    task
}

/// The first section in which two tasks differ.
fn difference(a: &Value, b: &Value) -> Option<String> {
    let (Value::Object(a), Value::Object(b)) = (a, b) else { return Some("its form".into()) };
    let all = a.keys().chain(b.keys());
    let section = all.into_iter().find(|key| a.get(*key) != b.get(*key))?;
    Some(if section.contains(' ') { format!("the {section}") } else { format!("[{section}]") })
}

/// True if a controller of `known` can take the networks of `new`.
pub(super) fn has_shape(known: &Snapshot, new: &Snapshot) -> bool {
    let layers =
        |net: &Dense| (net.layers.iter().map(|l| (l.n_in, l.n_out)).collect::<Vec<_>>(), net.skip.is_some());
    let shape = |n: &Networks| {
        let lists = [
            n.normaliser.mean.len(),
            n.normaliser.std.len(),
            n.normaliser.scale.len(),
            n.policy_log_std.len(),
        ];
        (lists, layers(&n.policy), n.idm.as_ref().map(|(net, log_std)| (layers(net), log_std.len())))
    };
    let (a, b) = (&known.manifest, &new.manifest);
    (a.policy, a.activation, &a.functions) == (b.policy, b.activation, &b.functions)
        && shape(&known.networks) == shape(&new.networks)
}
