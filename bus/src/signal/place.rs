//! A process's place among the signals of a user: opens their channels.

use super::description::SignalDescription;
use super::header::SignalHeader;
use super::name::SignalName;
use super::publisher::SignalPublisher;
use super::subscriber::SignalSubscriber;
use super::{
    BUFFER, LOCK_SUFFIX, MAX_HELD, MAX_NODES, MAX_PUBLISHERS, MAX_SUBSCRIBERS, PREFIX, SCHEMA, SLOTS,
};
use crate::channel::{Channel, Form, IoxService};
use crate::runtime::{self, RuntimeDir};
use crate::{Error, ErrorKind, HostTime, Name, Result, node};
use core::time::Duration;
use iceoryx2::prelude::Node;
use std::path::PathBuf;

const FORM: Form = Form {
    schema: SCHEMA,
    publishers: MAX_PUBLISHERS,
    subscribers: MAX_SUBSCRIBERS,
    buffer: BUFFER,
    held: MAX_HELD,
    history: 1,
    nodes: MAX_NODES,
    notifiers: MAX_PUBLISHERS,
    listeners: MAX_SUBSCRIBERS,
    loans: 1,
    // With fewer slots than a subscriber may have unread, one that does not read would stop the publisher.
    fewest_slots: SLOTS,
};

/// A process's place among the signals below one runtime folder.
#[derive(Debug)]
pub struct Signals {
    node: Node<IoxService>,
    runtime: RuntimeDir,
}

impl Signals {
    /// Joins the signals below `runtime`. It needs no rig and no daemon.
    ///
    /// # Errors
    /// As [`crate::Bus::open`].
    pub fn open(runtime: &RuntimeDir) -> Result<Self> {
        Ok(Self { node: node::join(runtime)?, runtime: runtime.clone() })
    }

    /// Takes the signal that `description` names, and opens its channel for writing.
    ///
    /// # Errors
    /// [`ErrorKind::InUse`] naming the process that publishes it, [`ErrorKind::NoSpace`] when shared memory has no room
    /// for its slots, [`ErrorKind::VersionMismatch`] when a process of another version has the channel open.
    pub fn publisher(&self, description: &SignalDescription) -> Result<SignalPublisher> {
        let name = description.name();
        let lock = self.lock(name)?;
        // What killed publishers left counts against the limits of the channel.
        self.clean_dead();
        let most = description.json().len().next_multiple_of(8) + description.value_bytes().end - 1;
        let sender = channel(name).sender(&self.node, most, SLOTS, &std::sync::Arc::default())?;
        Ok(SignalPublisher::new(sender, description, lock))
    }

    /// Opens the channel of the signal `name` for reading.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] when nobody publishes it (listing those that are published),
    /// [`ErrorKind::LimitReached`] when it has all its subscribers, [`ErrorKind::VersionMismatch`].
    pub fn subscriber(&self, name: &SignalName) -> Result<SignalSubscriber> {
        self.clean_dead();
        let receiver = channel(name).receiver(&self.node).map_err(|e| self.name_signals(e))?;
        Ok(SignalSubscriber::new(receiver))
    }

    /// Like [`Self::subscriber`], waiting up to `timeout` for the signal to appear.
    ///
    /// # Errors
    /// As [`Self::subscriber`], [`ErrorKind::NotFound`] after `timeout`.
    pub fn subscriber_within(&self, name: &SignalName, timeout: Duration) -> Result<SignalSubscriber> {
        let deadline = HostTime::now().plus(timeout);
        loop {
            match self.subscriber(name) {
                Err(e) if e.kind() == ErrorKind::NotFound && !deadline.from_now().is_zero() => {
                    std::thread::sleep(Duration::from_millis(10));
                }
                other => return other,
            }
        }
    }

    /// The signals that a process publishes now, each with that process in its own words; sorted.
    pub fn published(&self) -> Vec<(SignalName, String)> {
        let Ok(entries) = std::fs::read_dir(self.runtime.path()) else { return Vec::new() };
        let name = |file: &str| {
            let (device, signal) = file.strip_suffix(LOCK_SUFFIX)?.split_once('.')?;
            SignalName::new(device, signal).ok()
        };
        let mut found: Vec<_> = entries
            .filter_map(|e| {
                let name = name(e.ok()?.file_name().to_str()?)?;
                let holder = runtime::holder_of(&self.lock_path(&name))?;
                Some((name, holder))
            })
            .collect();
        found.sort();
        found
    }

    /// Frees what killed processes left behind. Returns how many were cleaned up.
    pub fn clean_dead(&self) -> u64 {
        node::clean_dead(&self.node)
    }

    /// The folder that the signals live in.
    pub const fn runtime(&self) -> &RuntimeDir {
        &self.runtime
    }

    fn lock_path(&self, name: &SignalName) -> PathBuf {
        let device: &Name = name.device();
        self.runtime.path().join(format!("{device}.{}{LOCK_SUFFIX}", name.signal()))
    }

    fn lock(&self, name: &SignalName) -> Result<std::fs::File> {
        let path = self.lock_path(name);
        let program = std::env::args_os().next().map(PathBuf::from);
        let program = program.as_deref().and_then(|p| p.file_name()).unwrap_or_default().to_string_lossy();
        let who = format!("process {} ({program})", std::process::id());
        runtime::take(&path, &who)?.ok_or_else(|| {
            let holder = runtime::holder_of(&path).unwrap_or_else(|| "another process".to_owned());
            let why = format!(
                "signal {name} is published already, by {holder}; end that first, or publish another signal"
            );
            Error::new(ErrorKind::InUse, why)
        })
    }

    /// Adds the published signals to a "not found" error.
    fn name_signals(&self, e: Error) -> Error {
        if e.kind() != ErrorKind::NotFound {
            return e;
        }
        let names: Vec<_> = self.published().iter().map(|(name, _)| name.to_string()).collect();
        let names = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
        let folder = self.runtime.path().display();
        Error::new(ErrorKind::NotFound, format!("{e}; published in {folder}: {names}"))
    }
}

fn channel(name: &SignalName) -> Channel<SignalHeader> {
    Channel::new(FORM, format!("{PREFIX}/{name}"), format!("signal {name}"))
}
