//! Opening iceoryx2 services with the same settings on every end.
//!
//! Only publish-subscribe is used; state and action need no service (`super::board`). Whoever starts first creates the service, the others open it, so start
//! order does not matter. Who may publish is decided by [`Owner`]; a topic has a second publisher's place for a tunnel to another host. What a killed process
//! left is removed when the next node joins.

use std::time::Duration;

use iceoryx2::node::NodeCreationFailure;
use iceoryx2::port::publisher::PublisherCreateError;
use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::prelude::*;
use iceoryx2::service::builder::publish_subscribe::{
    Builder, PublishSubscribeCreateError as Create, PublishSubscribeOpenError as Open,
    PublishSubscribeOpenOrCreateError as Failure,
};
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::home::Home;
use super::owner::Owner;
use super::port::{BytesOutbox, Inbox, Outbox, SnapshotReader};
use super::schema::{Message, Queued};
use super::{LinkError, RobotName, SnapshotHeader, debris, memory, torn};
use crate::clock;

/// How nodes find each other and wait: shared memory of this machine, usable from any thread.
pub type Ipc = ipc_threadsafe::Service;

/// Waits between attempts at a service that another process may be creating, or died creating [ms].
const BACK_OFF: [u64; 5] = [20, 60, 180, 540, 1000];
/// Those who may publish a topic at once: the owner, and a tunnel.
pub const PUBLISHERS: usize = 2;
/// What the links of one robot may occupy in shared memory [bytes].
pub(crate) const SHARED_MEMORY: u64 = 24 << 20;

/// One process's membership in the links of a robot.
pub struct Bus {
    node: Node<Ipc>,
    name: RobotName,
    epoch: u64,
    /// What was unfinished when this process came.
    unfinished: debris::Unfinished,
    /// Last: what the others remove when they go lies in it.
    _home: Home,
}

impl Bus {
    /// Checks shared memory and the folders, joins, and removes what dead processes left.
    ///
    /// # Errors
    /// [`LinkError`] for shared memory that is missing or too small, or what the transport said.
    pub fn join(name: &RobotName) -> Result<Bus, LinkError> {
        torn::watch();
        set_log_level_from_env_or(LogLevel::Fatal);
        memory::check(name, SHARED_MEMORY)?;
        let home = Home::enter(name)?;
        let unfinished = debris::Unfinished::of(name);
        debris::sweep_segments(name);
        let config = name.config()?;
        let node = retry(
            || {
                NodeBuilder::new()
                    .config(&config)
                    .signal_handling_mode(SignalHandlingMode::Disabled)
                    .create::<Ipc>()
            },
            |e| matches!(e, NodeCreationFailure::InternalError | NodeCreationFailure::SystemCorrupted),
        )
        .map_err(|e| name.transport("start", format!("{e:?}")))?;
        let epoch = clock::now() ^ (u64::from(std::process::id()) << 40);
        memory::close_to_others(name);
        let bus = Bus { node, name: name.clone(), epoch, unfinished, _home: home };
        bus.clean();
        Ok(bus)
    }

    /// Removes what dead processes left.
    pub fn clean(&self) {
        self.node.try_cleanup_dead_nodes();
        debris::sweep(&self.name);
    }

    /// The node of the transport.
    pub fn node(&self) -> &Node<Ipc> {
        &self.node
    }

    /// Robot, or server.
    pub fn name(&self) -> &RobotName {
        &self.name
    }

    /// Start of this process at the links, see [`Header::epoch`](super::Header::epoch).
    pub fn epoch(&self) -> u64 {
        self.epoch
    }

    /// Reserves the memory of all segments opened so far.
    ///
    /// # Errors
    /// [`LinkError`] where there is too little.
    pub fn reserve(&self) -> Result<(), LinkError> {
        memory::reserve(&self.name)
    }

    pub(super) fn service<M: Queued>(&self) -> Result<PortFactory<Ipc, M, ()>, LinkError> {
        let topic = self.topic(M::TOPIC)?;
        let build = || {
            settings(self.node.service_builder(&topic).publish_subscribe::<M>(), M::BUFFER, M::HISTORY)
                .max_subscribers(M::SUBSCRIBERS)
                .open_or_create()
        };
        self.open(build, is_passing).map_err(|e| self.open_error(M::TOPIC, &e))
    }

    /// Whether somebody has a role of the robot, or had it and was killed.
    pub(super) fn has(&self, role: &str) -> bool {
        Owner::is_taken(&self.name, role)
    }

    /// Takes a role of the robot; its owner publishes the role's topics.
    ///
    /// # Errors
    /// [`LinkError::Taken`].
    pub fn own(&self, role: &'static str) -> Result<Owner, LinkError> {
        Owner::take(&self.name, role)
    }

    /// A publisher of `M`, for the owner of its role.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn outbox<M: Queued>(&self) -> Result<Outbox<M>, LinkError> {
        let service = self.service::<M>()?;
        let port = service
            .publisher_builder()
            .max_loaned_samples(1)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(|e| self.publisher_error(M::TOPIC, &e))?;
        Ok(Outbox::new(port, service, self.epoch))
    }

    /// A subscriber of `M`.
    pub(crate) fn inbox<M: Queued>(&self) -> Result<Inbox<M>, LinkError> {
        let service = self.service::<M>()?;
        let port = service.subscriber_builder().create().map_err(|e| self.subscriber_error(M::TOPIC, e))?;
        Ok(Inbox::new(port))
    }

    pub(super) fn bytes(&self) -> Result<PortFactory<Ipc, [u8], SnapshotHeader>, LinkError> {
        let topic = self.topic(SnapshotHeader::TOPIC)?;
        let build = || {
            let service = self.node.service_builder(&topic).publish_subscribe::<[u8]>();
            settings(service.user_header::<SnapshotHeader>(), SnapshotHeader::BUFFER, SnapshotHeader::HISTORY)
                .max_subscribers(SnapshotHeader::SUBSCRIBERS)
                .open_or_create()
        };
        self.open(build, is_passing).map_err(|e| self.open_error(SnapshotHeader::TOPIC, &e))
    }

    /// A publisher of snapshots, for the trainer.
    pub(crate) fn bytes_outbox(&self) -> Result<BytesOutbox, LinkError> {
        let port = self
            .bytes()?
            .publisher_builder()
            .max_loaned_samples(1)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .initial_max_slice_len(1 << 16)
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            .create()
            .map_err(|e| self.publisher_error(SnapshotHeader::TOPIC, &e))?;
        Ok(BytesOutbox::new(port, self.name.clone(), self.epoch))
    }

    /// A subscriber of snapshots.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn bytes_inbox(&self) -> Result<SnapshotReader, LinkError> {
        let port = self
            .bytes()?
            .subscriber_builder()
            .create()
            .map_err(|e| self.subscriber_error(SnapshotHeader::TOPIC, e))?;
        Ok(SnapshotReader::new(port))
    }

    /// Opens a service, or creates it. What hangs in its creation for a second, or did so before this process joined, was left by a killed
    /// one and is removed between two attempts.
    ///
    /// # Errors
    /// What the last attempt said.
    pub fn open<T, E>(
        &self,
        mut attempt: impl FnMut() -> Result<T, E>,
        is_passing: impl Fn(&E) -> bool,
    ) -> Result<T, E> {
        let unfinished = debris::Unfinished::of(&self.name);
        retry(&mut attempt, |error| {
            let passes = is_passing(error);
            if passes {
                self.unfinished.remove_left(&self.name);
                unfinished.remove_left(&self.name);
            }
            passes
        })
    }

    /// The name of one of this robot's services.
    ///
    /// # Errors
    /// [`LinkError`] for a name the transport refuses.
    pub fn topic(&self, topic: &str) -> Result<ServiceName, LinkError> {
        let name = format!("nearl/{}/{topic}", self.name);
        ServiceName::new(&name).map_err(|e| self.name.transport(format!("name `{topic}`"), format!("{e:?}")))
    }

    fn open_error(&self, topic: &'static str, error: &Failure) -> LinkError {
        match error {
            Failure::PublishSubscribeOpenError(Open::IncompatibleTypes | Open::VersionMismatch) => {
                LinkError::Schema { name: self.name.clone(), topic }
            }
            other => self.name.transport(format!("open `{topic}`"), format!("{other:?}")),
        }
    }

    fn publisher_error(&self, topic: &str, error: &PublisherCreateError) -> LinkError {
        self.name.transport(format!("publish `{topic}`"), format!("{error:?}"))
    }

    fn subscriber_error(&self, topic: &'static str, error: SubscriberCreateError) -> LinkError {
        match error {
            SubscriberCreateError::ExceedsMaxSupportedSubscribers => {
                LinkError::Full { name: self.name.clone(), topic }
            }
            other => self.name.transport(format!("read `{topic}`"), format!("{other:?}")),
        }
    }
}

fn settings<P, H>(builder: Builder<P, H, Ipc>, buffer: usize, history: usize) -> Builder<P, H, Ipc>
where
    P: std::fmt::Debug + ?Sized + IceoryxSend,
    H: std::fmt::Debug + ZeroCopySend,
{
    builder
        .max_publishers(PUBLISHERS)
        .max_nodes(24)
        .subscriber_max_buffer_size(buffer)
        .subscriber_max_borrowed_samples(1)
        .history_size(history)
        .enable_safe_overflow(true)
}

/// Failures that go away once another process has finished creating, removing or dying.
fn is_passing(error: &Failure) -> bool {
    use Failure::{PublishSubscribeCreateError as C, PublishSubscribeOpenError as O};
    matches!(
        error,
        Failure::SystemInFlux
            | O(Open::HangsInCreation | Open::IsMarkedForDestruction | Open::DoesNotExist)
            | O(Open::ServiceInCorruptedState | Open::InternalFailure)
            | C(Create::HangsInCreation | Create::IsBeingCreatedByAnotherInstance | Create::AlreadyExists)
            | C(Create::ServiceInCorruptedState | Create::InternalFailure)
    )
}

/// Tries again while what is said may pass.
fn retry<T, E>(mut attempt: impl FnMut() -> Result<T, E>, may_pass: impl Fn(&E) -> bool) -> Result<T, E> {
    for wait in BACK_OFF {
        match attempt() {
            Err(error) if may_pass(&error) => std::thread::sleep(Duration::from_millis(wait)),
            other => return other,
        }
    }
    attempt()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whoever was killed while it created services stands in the way for a second, however many of them were left.
    #[test]
    fn unfinished_services_are_removed_after_a_second_all_of_them() {
        let name = RobotName::new(&format!("t{}-unfinished", std::process::id())).unwrap();
        let first = Bus::join(&name).unwrap();
        let folder = name.folder().join("services");
        std::fs::create_dir_all(&folder).unwrap();
        let files = ["first.service", "second.service"].map(|file| folder.join(file));
        files.iter().for_each(|file| std::fs::write(file, "").unwrap());
        let mode = |mode| std::os::unix::fs::PermissionsExt::from_mode(mode);
        files.iter().for_each(|file| std::fs::set_permissions(file, mode(0o600)).unwrap());
        let second = Bus::join(&name).unwrap();
        for (file, most) in files.iter().zip([3, 2]) {
            let mut attempts = 0;
            let attempt = || {
                attempts += 1;
                if file.exists() {
                    // As iceoryx2 waits for another process to finish.
                    std::thread::sleep(Duration::from_millis(500));
                    return Err(());
                }
                Ok(())
            };
            second.open(attempt, |_| true).unwrap();
            assert!(attempts <= most, "{attempts} attempts at {}", file.display());
        }
        drop((first, second));
        super::super::remove_files(&name);
    }
}
