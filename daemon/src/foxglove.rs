//! Live channels for Foxglove, Lichtblick and whatever else speaks their WebSocket protocol: topics, schemas and bytes are those of a recording.
//!
//! A message is encoded only if a client has subscribed to its channel and may be sent one, once for all such clients. Of each channel the newest message
//! wins; small channels go before images; images follow the pace at which the client answers a ping behind each one ([`mailbox`]). One thread
//! encodes, below the priority of everything that captures; it exists while somebody watches. docs/viewers.md is for those who use it.

mod mailbox;
mod protocol;
mod scene;
mod services;
mod worker;

use crate::control::Control;
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_bus::{HostTime, RigName, RuntimeDir};
use depthrig_recorder::LiveSource;
use hyper::body::Bytes;
use mailbox::Mailbox;
pub(crate) use mailbox::{Content, Next};
pub(crate) use protocol::{FromClient, SUBPROTOCOLS, ServiceCall, Subscription, ToClient};
pub(crate) use scene::Scene;
pub(crate) use services::{SERVICE_ENCODINGS, advertise as advertise_services, call as call_service};
use std::collections::BTreeMap;
use std::sync::{Arc, Condvar, Mutex};
use tokio::sync::Notify;

/// Clients at once.
pub(crate) const MAX_CLIENTS: usize = 8;
/// Images a second of a stream, and messages of its other channels but those of IMUs.
const RATE_HZ: f64 = 15.0;
/// How often the rig is asked for its streams.
const REFRESH: Duration = Duration::from_millis(900);

/// The viewers of one rig that speak Foxglove's protocol.
#[derive(Clone)]
pub(crate) struct Foxglove {
    shared: Arc<Shared>,
}

struct Shared {
    runtime: RuntimeDir,
    rig: RigName,
    control: Arc<dyn Control>,
    state: Mutex<State>,
    /// Something in the state changed.
    changed: Condvar,
}

#[derive(Default)]
struct State {
    next: u64,
    clients: BTreeMap<u64, Client>,
    /// The channels that there are.
    scene: Option<Arc<Scene>>,
    /// When the rig was asked for them.
    asked: Option<HostTime>,
    /// Numbers of channels; a number always means the same channel.
    numbers: scene::Numbers,
    /// Whether the thread runs.
    is_running: bool,
}

struct Client {
    /// By the number of the channel.
    watched: BTreeMap<u32, Watched>,
    mailbox: Mailbox,
    /// Something is in the mailbox.
    wake: Arc<Notify>,
}

/// A channel that a client has subscribed to.
struct Watched {
    /// The client's number for it.
    subscription: u32,
    /// When the next message may be sent.
    due: HostTime,
    /// Frame of the last one.
    sent: Option<u64>,
}

/// A place among the clients; dropping it frees the place.
pub(crate) struct Place {
    foxglove: Foxglove,
    number: u64,
    wake: Arc<Notify>,
}

impl Foxglove {
    pub(crate) fn new(runtime: RuntimeDir, rig: RigName, control: Arc<dyn Control>) -> Self {
        let state = Mutex::default();
        Self { shared: Arc::new(Shared { runtime, rig, control, state, changed: Condvar::new() }) }
    }

    /// The rig that is looked at.
    pub(crate) fn rig(&self) -> &RigName {
        &self.shared.rig
    }

    /// A place; `None` if all are taken.
    pub(crate) fn enter(&self) -> Option<Place> {
        let mut state = lock(&self.shared.state);
        if state.clients.len() >= MAX_CLIENTS {
            return None;
        }
        let number = state.next;
        state.next += 1;
        let wake = Arc::<Notify>::default();
        let client =
            Client { watched: BTreeMap::new(), mailbox: Mailbox::default(), wake: Arc::clone(&wake) };
        state.clients.insert(number, client);
        Some(Place { foxglove: self.clone(), number, wake })
    }

    /// The channels that there are now. It may ask the rig, so it is not for an asynchronous thread.
    pub(crate) fn scene(&self) -> Option<Arc<Scene>> {
        let shared = &self.shared;
        let now = HostTime::now();
        {
            let mut state = lock(&shared.state);
            if state.asked.is_some_and(|asked| now.since_ns(asked) < REFRESH.as_nanos() as i64) {
                return state.scene.clone();
            }
            state.asked = Some(now);
        }
        let live = shared.control.live()?;
        let mut state = lock(&shared.state);
        if state.scene.as_ref().is_some_and(|scene| scene.is_of(&live)) {
            return state.scene.clone();
        }
        match Scene::new(live, &mut state.numbers) {
            Ok(scene) => state.scene = Some(Arc::new(scene)),
            Err(e) => tracing::warn!(error = %e, "live viewers do not see the streams of the rig"),
        }
        let scene = state.scene.clone();
        if let Some(scene) = &scene {
            // Those who have seen the old poses get the new ones.
            for client in state.clients.values_mut() {
                client.put_poses(scene);
            }
        }
        drop(state);
        shared.changed.notify_all();
        scene
    }
}

impl Client {
    /// Puts the poses on the mount into the mailbox if they are watched.
    fn put_poses(&mut self, scene: &Scene) {
        for (channel, watched) in &self.watched {
            if scene.source(*channel) == Some(LiveSource::TfStatic) {
                let message = scene.tf_static(watched.subscription);
                self.mailbox.put_small(*channel, vec![message]);
                self.wake.notify_one();
            }
        }
    }
}

impl Place {
    /// Resolves when [`Self::next`] may have something.
    pub(crate) async fn woken(&self) {
        self.wake.notified().await;
    }

    /// The next thing to send.
    pub(crate) fn next(&self) -> Option<Next> {
        let mut state = lock(&self.foxglove.shared.state);
        let next = state.clients.get_mut(&self.number)?.mailbox.next();
        if next.is_some() {
            // There may be more.
            self.wake.notify_one();
        }
        next
    }

    /// The client has answered a ping.
    pub(crate) fn answered(&self, number: u64) {
        self.change(|client, _| {
            client.mailbox.answered(number);
            // Small messages may have waited for this.
            client.wake.notify_one();
        });
    }

    /// Subscribes; lines about what cannot be subscribed to go to the client.
    ///
    /// # Errors
    /// `Other` when the thread cannot be started.
    pub(crate) fn subscribe(&self, subscriptions: &[Subscription]) -> Result<()> {
        self.change(|client, scene| {
            let Some(scene) = scene else { return };
            let mut wants_poses = false;
            for Subscription { id, channel_id } in subscriptions {
                let source = scene.source(*channel_id);
                if source.is_none() {
                    client.put_problem(format!("channel {channel_id} does not exist"));
                } else if client.watched.contains_key(channel_id) {
                    client.put_problem(format!("there is a subscription to channel {channel_id} already"));
                } else if client.watched.values().any(|w| w.subscription == *id) {
                    client.put_problem(format!("there is a subscription {id} already"));
                } else {
                    let watched = Watched { subscription: *id, due: HostTime::now(), sent: None };
                    client.watched.insert(*channel_id, watched);
                    wants_poses |= source == Some(LiveSource::TfStatic);
                }
            }
            if wants_poses {
                client.put_poses(scene);
            }
        });
        self.start()
    }

    /// Ends subscriptions.
    pub(crate) fn unsubscribe(&self, subscriptions: &[u32]) {
        self.change(|client, _| {
            let ended = client.watched.extract_if(.., |_, w| subscriptions.contains(&w.subscription));
            let channels: Vec<u32> = ended.map(|(channel, _)| channel).collect();
            for channel in channels {
                client.mailbox.forget(channel);
            }
        });
    }

    /// Ends what is watched of channels that do not exist any more.
    pub(crate) fn withdraw(&self, channels: &[u32]) {
        self.change(|client, _| {
            for channel in channels {
                client.watched.remove(channel);
                client.mailbox.forget(*channel);
            }
        });
    }

    fn change(&self, what: impl FnOnce(&mut Client, Option<&Scene>)) {
        let shared = &self.foxglove.shared;
        let mut state = lock(&shared.state);
        let scene = state.scene.clone();
        if let Some(client) = state.clients.get_mut(&self.number) {
            what(client, scene.as_deref());
        }
        drop(state);
        shared.changed.notify_all();
    }

    /// Starts the thread if it does not run and somebody watches what it encodes.
    fn start(&self) -> Result<()> {
        let shared = &self.foxglove.shared;
        let mut state = lock(&shared.state);
        if state.is_running || !state.is_watched() {
            return Ok(());
        }
        let of_thread = Arc::clone(shared);
        let run = move || worker::run(&of_thread);
        std::thread::Builder::new().name("foxglove".into()).spawn(run).map_err(|e| {
            Error::new(ErrorKind::Other, "the thread for Foxglove cannot be started").with_source(e)
        })?;
        state.is_running = true;
        Ok(())
    }
}

impl Client {
    fn put_problem(&mut self, problem: String) {
        self.mailbox.put_problem(problem);
        self.wake.notify_one();
    }

    fn put_small(&mut self, channel: u32, messages: Vec<Bytes>) {
        self.mailbox.put_small(channel, messages);
        self.wake.notify_one();
    }

    fn put_image(&mut self, channel: u32, message: Bytes) {
        self.mailbox.put_image(channel, message);
        self.wake.notify_one();
    }
}

impl State {
    /// Whether somebody watches a channel whose messages are encoded all the time.
    fn is_watched(&self) -> bool {
        let Some(scene) = &self.scene else { return false };
        let is_encoded = |channel: &u32| scene.source(*channel).is_some_and(|s| s != LiveSource::TfStatic);
        self.clients.values().any(|client| client.watched.keys().any(is_encoded))
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let shared = &self.foxglove.shared;
        lock(&shared.state).clients.remove(&self.number);
        shared.changed.notify_all();
    }
}
