//! A process's place on the bus: opens the channels of one rig.

use crate::channel::{Channel, IoxService, RIG};
use crate::runtime::RuntimeDir;
use crate::{
    Error, ErrorKind, FrameHeader, HostTime, Publisher, Result, RigName, SetHeader, SetPublisher,
    SetSubscriber, StreamId, Subscriber, limits, shm,
};
use core::sync::atomic::{AtomicBool, Ordering};
use core::time::Duration;
use iceoryx2::node::{DeadNodeView, NodeDetails, NodeState, NodeView};
use iceoryx2::prelude::*;
use std::sync::Arc;

/// The folder below the runtime folder that holds the files of iceoryx2.
pub const IOX_FOLDER: &str = "iox2";

/// A process's place on the bus of one rig.
#[derive(Debug)]
pub struct Bus {
    node: Node<IoxService>,
    rig: RigName,
    runtime: RuntimeDir,
    /// Set by a publisher that found no free slot.
    starved: Arc<AtomicBool>,
}

impl Bus {
    /// Joins the bus of `rig` below `runtime`. It creates no channel and needs no running daemon.
    ///
    /// # Errors
    /// [`ErrorKind::PermissionDenied`] when the folder is another user's, [`ErrorKind::Other`] when iceoryx2
    /// cannot make its files.
    pub fn open(runtime: &RuntimeDir, rig: &RigName) -> Result<Self> {
        let node = join(runtime)?;
        Ok(Self { node, rig: rig.clone(), runtime: runtime.clone(), starved: Arc::default() })
    }

    /// The rig's name.
    pub const fn rig(&self) -> &RigName {
        &self.rig
    }

    /// The folder that the rig lives in.
    pub const fn runtime(&self) -> &RuntimeDir {
        &self.runtime
    }

    /// Opens the channel of `id` for writing frames of at most `max_bytes` bytes, with `slots` slots of
    /// shared memory, or as many as still fit ([`Publisher::slots`]) if that is at least [`shm::MIN_SLOTS`].
    ///
    /// # Errors
    /// [`ErrorKind::VersionMismatch`] or [`ErrorKind::InUse`] when another process holds the channel in
    /// another form (it is named), [`ErrorKind::LimitReached`] when it has its publishers already,
    /// [`ErrorKind::NoSpace`] or [`ErrorKind::Other`] when the memory cannot be made.
    pub fn publisher(&self, id: &StreamId, max_bytes: usize, slots: usize) -> Result<Publisher> {
        let channel = self.stream_channel(id);
        Ok(Publisher::new(channel.sender(&self.node, max_bytes, slots, &self.starved)?))
    }

    /// Opens the channel of `id` for reading.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] when it does not exist (listing the streams that do),
    /// [`ErrorKind::VersionMismatch`], [`ErrorKind::LimitReached`] when it has all its subscribers.
    pub fn subscriber(&self, id: &StreamId) -> Result<Subscriber> {
        let channel = self.stream_channel(id);
        let receiver = channel.receiver(&self.node).map_err(|e| self.name_streams(e))?;
        Ok(Subscriber::new(receiver))
    }

    /// Like [`Self::subscriber`], waiting up to `timeout` for the channel to appear.
    ///
    /// # Errors
    /// As [`Self::subscriber`], [`ErrorKind::NotFound`] after `timeout`.
    pub fn subscriber_within(&self, id: &StreamId, timeout: Duration) -> Result<Subscriber> {
        let deadline = HostTime::now().plus(timeout);
        loop {
            match self.subscriber(id) {
                Err(e) if e.kind() == ErrorKind::NotFound && !deadline.from_now().is_zero() => {
                    std::thread::sleep(Duration::from_millis(10));
                }
                other => return other,
            }
        }
    }

    /// Opens the rig's channel of frame sets for writing.
    ///
    /// # Errors
    /// As [`Self::publisher`].
    pub fn set_publisher(&self) -> Result<SetPublisher> {
        self.set_publisher_with(SetPublisher::SLOTS)
    }

    /// The same with `slots` slots of shared memory. With as few as wait unread for a subscriber at most
    /// ([`crate::SUBSCRIBER_BUFFER`]) no set is ever replaced: sending fails until one was read.
    ///
    /// # Errors
    /// As [`Self::publisher`].
    pub fn set_publisher_with(&self, slots: usize) -> Result<SetPublisher> {
        let channel = self.set_channel();
        Ok(SetPublisher::new(channel.sender(&self.node, SetPublisher::MAX_BYTES, slots, &self.starved)?))
    }

    /// Opens the rig's channel of frame sets for reading.
    ///
    /// # Errors
    /// As [`Self::subscriber`].
    pub fn set_subscriber(&self) -> Result<SetSubscriber> {
        Ok(SetSubscriber::new(self.set_channel().receiver(&self.node)?))
    }

    /// The streams of this rig that have a publisher or a subscriber now, sorted.
    ///
    /// # Errors
    /// [`ErrorKind::Other`] when the channels cannot be listed.
    pub fn streams(&self) -> Result<Vec<StreamId>> {
        let prefix = format!("depthrig/{}/", self.rig);
        let mut found = Vec::new();
        IoxService::list(self.node.config(), |service| {
            let details = &service.static_details;
            if let (
                iceoryx2::service::static_config::messaging_pattern::MessagingPattern::PublishSubscribe(_),
                Some(rest),
            ) = (details.messaging_pattern(), details.name().as_str().strip_prefix(&prefix))
            {
                found.extend(rest.parse::<StreamId>());
            }
            CallbackProgression::Continue
        })
        .map_err(|e| {
            Error::new(ErrorKind::Other, "the channels of the bus could not be listed").with_source(e)
        })?;
        found.sort();
        Ok(found)
    }

    /// Frees what killed processes left behind; the daemon calls this once a second. Returns how many dead
    /// processes were cleaned up.
    pub fn clean_dead(&self) -> u64 {
        clean_dead(&self.node)
    }

    /// Whether a publisher found no free slot since the last call: a dead subscriber may hold them.
    pub fn starved(&self) -> bool {
        self.starved.swap(false, Ordering::Relaxed)
    }

    /// The node, for channels of other forms.
    pub(crate) const fn node(&self) -> &Node<IoxService> {
        &self.node
    }

    fn stream_channel(&self, id: &StreamId) -> Channel<FrameHeader> {
        Channel::new(
            RIG,
            format!("depthrig/{}/{id}", self.rig),
            format!("stream {id} of rig \"{}\"", self.rig),
        )
    }

    fn set_channel(&self) -> Channel<SetHeader> {
        Channel::new(
            RIG,
            format!("depthrig/{}/sets", self.rig),
            format!("the frame sets of rig \"{}\"", self.rig),
        )
    }

    /// Adds the existing streams to a "not found" error.
    fn name_streams(&self, e: Error) -> Error {
        if e.kind() != ErrorKind::NotFound {
            return e;
        }
        let streams = self.streams().unwrap_or_default();
        let rig = &self.rig;
        let hint = if !streams.is_empty() {
            let names: Vec<_> = streams.iter().map(ToString::to_string).collect();
            format!("the rig has: {}", names.join(", "))
        } else if self.runtime.holder(rig).is_some() {
            "the rig is running but has no stream yet".to_owned()
        } else {
            let others: Vec<_> = self.runtime.running_rigs().iter().map(ToString::to_string).collect();
            let others = if others.is_empty() { "none".to_owned() } else { others.join(", ") };
            format!("no rig \"{rig}\" runs in {}; running: {others}", self.runtime.path().display())
        };
        Error::new(ErrorKind::NotFound, format!("{e}; {hint}"))
    }
}

/// Joins the bus below `runtime`. It creates no channel.
///
/// # Errors
/// As [`Bus::open`].
pub(crate) fn join(runtime: &RuntimeDir) -> Result<Node<IoxService>> {
    // iceoryx2 writes its own log to stderr; its errors come back as errors and are logged once, by us.
    set_log_level(LogLevel::Fatal);
    let config = config(runtime)?;
    shm::check_room()?;
    let builder = NodeBuilder::new()
        .signal_handling_mode(SignalHandlingMode::Disabled) // signals belong to the process, not to a library
        .config(&config);
    builder.create::<IoxService>().map_err(|e| {
        let path = runtime.path().display();
        let kind = match e {
            iceoryx2::node::NodeCreationFailure::InsufficientPermissions => ErrorKind::PermissionDenied,
            _ => ErrorKind::Other,
        };
        let why = limits::descriptors().map_or_else(String::new, |why| format!(": {why}"));
        Error::new(kind, format!("the bus in {path} could not be joined{why}")).with_source(e)
    })
}

/// Frees what killed processes left behind; returns how many of them were cleaned up.
pub(crate) fn clean_dead(node: &Node<IoxService>) -> u64 {
    let config = node.config();
    let mut cleaned = 0;
    let listed = Node::<IoxService>::list(config, |state| {
        if let NodeState::Dead(dead) = state {
            // One that was killed while it was being removed has lost its own description. iceoryx2 would then look
            // for it below its default folder, find nothing, and call that cleaned up, again and again.
            let removed = match dead.details() {
                Some(_) => dead.try_remove_stale_resources(),
                None => DeadNodeView::<IoxService>::__internal_try_remove_stale_resources(
                    *dead.id(),
                    NodeDetails::__internal_new(&None, config),
                ),
            };
            match removed {
                Ok(()) => cleaned += 1,
                Err(e) => tracing::debug!(error = ?e, "a dead process cannot be cleaned up yet"),
            }
        }
        CallbackProgression::Continue
    });
    if let Err(e) = listed {
        tracing::debug!(error = ?e, "dead processes cannot be looked for");
    }
    cleaned
}

/// The configuration that every process of a user's rigs shares. It is set in code, because iceoryx2 would
/// otherwise read `config/iceoryx2.toml` from the process's working folder.
fn config(runtime: &RuntimeDir) -> Result<Config> {
    let unusable = |e: &dyn core::fmt::Debug| {
        let path = runtime.path().display();
        Error::new(ErrorKind::Other, format!("{path} cannot be the runtime folder: {e:?}"))
    };
    let text = runtime.path().join(IOX_FOLDER).to_string_lossy().into_owned();
    let root = Path::new(text.as_bytes()).map_err(|e| unusable(&e))?;
    let mut config = Config::default();
    config.global.set_root_path(&root);
    config.global.prefix = FileName::new(shm::SHM_PREFIX.as_bytes()).map_err(|e| unusable(&e))?;
    // How long an opener waits for an unfinished creator; a publisher may wait as long for a broken reader.
    config.global.creation_timeout = Duration::from_millis(500);
    Ok(config)
}
