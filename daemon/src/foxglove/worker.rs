//! The thread that encodes.

use super::scene::Scene;
use super::{RATE_HZ, Shared, State, protocol};
use crate::rig::report;
use crate::viewers::{Newest, next_turn, work_until_done};
use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_bus::{Bus, Frame, FrameHeader, HostTime, StreamId};
use depthrig_recorder::{LiveEncoder, LiveFrame, LiveSource, LiveTopics};
use hyper::body::Bytes;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, PoisonError};

/// Pause between two looks at a stream whose next frame somebody waits for.
const POLL: Duration = Duration::from_millis(5);
/// The longest wait, when no client is sent anything.
const IDLE: Duration = Duration::from_secs(1);
/// Between two messages with the state of the rig.
const DIAGNOSTICS_PERIOD: Duration = Duration::from_secs(1);

/// Runs until nobody watches a channel.
pub(super) fn run(shared: &Shared) {
    let open = || Bus::open(&shared.runtime, &shared.rig);
    if let Err(e) = work_until_done("foxglove", open, |bus| Worker::new(bus).run(shared)) {
        let mut state = lock(&shared.state);
        for client in state.clients.values_mut() {
            client.put_problem(e.to_string());
        }
        state.is_running = false;
    }
}

struct Worker {
    newest: Newest,
    encoder: Option<Encoder>,
    /// When the state of the rig is sent next.
    diagnostics_due: HostTime,
    payload: Vec<u8>,
}

/// An encoder with the options that it was made for.
struct Encoder {
    scene: Arc<Scene>,
    encoder: LiveEncoder,
}

/// An image that is to be sent.
struct Job {
    channel: u32,
    stream: usize,
    due: HostTime,
}

/// The channels that are watched now.
type Watched = BTreeMap<u32, LiveSource>;

impl Worker {
    fn new(bus: Bus) -> Self {
        let diagnostics_due = HostTime::now();
        Self { newest: Newest::new(bus), encoder: None, diagnostics_due, payload: Vec::new() }
    }

    fn run(mut self, shared: &Shared) {
        loop {
            let Some((scene, watched)) = begin(shared) else { return };
            self.take_frames(shared, &scene, &watched);
            self.send_small(shared, &scene, &watched);
            self.send_diagnostics(shared, &watched);
            let has_sent = self.send_image(shared, &scene);
            let state = lock(&shared.state);
            let pause = if has_sent { Duration::ZERO } else { self.pause(&state, &scene) };
            if !pause.is_zero() {
                drop(shared.changed.wait_timeout(state, pause).unwrap_or_else(PoisonError::into_inner));
            }
        }
    }

    /// Takes the newest frames of the streams that are watched, and sends the samples of IMUs at once.
    fn take_frames(&mut self, shared: &Shared, scene: &Scene, watched: &Watched) {
        let streams: BTreeSet<StreamId> =
            watched.values().filter_map(|source| scene.stream(*source).cloned()).collect();
        self.newest.keep(&streams);
        let units: BTreeMap<&StreamId, (u32, usize)> = watched
            .iter()
            .filter_map(|(channel, source)| match source {
                LiveSource::Imu(unit) => Some((scene.stream(*source)?, (*channel, *unit))),
                _ => None,
            })
            .collect();
        for id in &streams {
            let problem = match units.get(id) {
                Some((channel, unit)) => match self.newest.take_all(id) {
                    Ok(batches) => {
                        self.send_samples(shared, scene, *channel, *unit, &batches);
                        None
                    }
                    Err(e) => Some(e),
                },
                None => self.newest.take(id).err(),
            };
            if let Some(e) = problem {
                tell(shared, scene, id, &e);
            }
        }
    }

    fn send_samples(&mut self, shared: &Shared, scene: &Scene, channel: u32, unit: usize, batches: &[Frame]) {
        if batches.is_empty() {
            return;
        }
        let offset = scene.utc_offset_ns();
        let mut samples = Vec::new();
        for sample in batches.iter().flat_map(Frame::motion) {
            self.payload.clear();
            let time_ns = scene.topics().imu(&mut self.payload, unit, &sample, offset);
            samples.push((time_ns, self.payload.clone()));
        }
        for client in lock(&shared.state).clients.values_mut() {
            let Some(watched) = client.watched.get(&channel) else { continue };
            let subscription = watched.subscription;
            let messages =
                samples.iter().map(|(time, payload)| protocol::message(subscription, *time, payload).into());
            client.put_small(channel, messages.collect());
        }
    }

    /// Sends what is small and new of each stream.
    fn send_small(&mut self, shared: &Shared, scene: &Scene, watched: &Watched) {
        let offset = scene.utc_offset_ns();
        let now = HostTime::now();
        for (channel, source) in watched {
            let (LiveSource::CameraInfo(stream) | LiveSource::FrameInfo(stream)) = *source else { continue };
            let Some(id) = scene.stream(*source) else { continue };
            let Some(header) = self.newest.frames().get(id).map(Frame::header) else { continue };
            let mut state = lock(&shared.state);
            let due = state.clients.values_mut().filter(|client| {
                let watched = client.watched.get(channel);
                watched.is_some_and(|w| w.due <= now && w.sent != Some(header.sequence))
            });
            let due: Vec<_> = due.collect();
            if due.is_empty() {
                continue;
            }
            self.payload.clear();
            match source {
                LiveSource::CameraInfo(_) => {
                    scene.topics().camera_info(&mut self.payload, stream, header, offset);
                }
                _ => scene.topics().frame_info(&mut self.payload, stream, header, offset),
            }
            for client in due {
                let Some(watched) = client.watched.get_mut(channel) else { continue };
                let message = protocol::message(watched.subscription, utc_ns(header, offset), &self.payload);
                watched.sent = Some(header.sequence);
                watched.due = next_turn(id, period());
                client.put_small(*channel, vec![message.into()]);
            }
        }
    }

    /// Sends the state of the rig once a second.
    fn send_diagnostics(&mut self, shared: &Shared, watched: &Watched) {
        let channel = watched.iter().find(|(_, source)| **source == LiveSource::Diagnostics);
        let Some((channel, _)) = channel else { return };
        let now = HostTime::now();
        if self.diagnostics_due > now {
            return;
        }
        self.diagnostics_due = now.plus(DIAGNOSTICS_PERIOD);
        let status = shared.control.status();
        let utc_ns = status.utc_ns;
        self.payload.clear();
        LiveTopics::diagnostics(&mut self.payload, utc_ns, &report::diagnostics(&status));
        for client in lock(&shared.state).clients.values_mut() {
            let Some(watched) = client.watched.get(channel) else { continue };
            let message = protocol::message(watched.subscription, utc_ns, &self.payload);
            client.put_small(*channel, vec![message.into()]);
        }
    }

    /// Encodes the image that somebody has waited for longest, and sends it to all who may be sent it. Whether there was one.
    fn send_image(&mut self, shared: &Shared, scene: &Arc<Scene>) -> bool {
        let Some(job) = self.due(&lock(&shared.state), scene) else { return false };
        let source = LiveSource::Image(job.stream);
        let Some(id) = scene.stream(source) else { return false };
        let Some(frame) = self.newest.frames().get(id) else { return false };
        let header = frame.header();
        let offset = scene.utc_offset_ns();
        if self.encoder.as_ref().is_none_or(|e| !Arc::ptr_eq(&e.scene, scene)) {
            let encoder = LiveEncoder::new(scene.options());
            self.encoder = Some(Encoder { scene: Arc::clone(scene), encoder });
        }
        let Some(Encoder { encoder, .. }) = &mut self.encoder else { return false };
        self.payload.clear();
        let live = LiveFrame { header, pixels: frame.pixels() };
        let encoded = encoder.image(&mut self.payload, scene.topics(), job.stream, live, offset);
        let now = HostTime::now();
        let mut state = lock(&shared.state);
        for client in state.clients.values_mut() {
            let takes = client.mailbox.takes_image(job.channel, header.payload_len as usize);
            let Some(watched) = client.watched.get_mut(&job.channel) else { continue };
            if watched.due > now || watched.sent == Some(header.sequence) || !(takes || encoded.is_err()) {
                continue;
            }
            watched.sent = Some(header.sequence);
            watched.due = next_turn(id, period());
            match &encoded {
                Ok(()) => {
                    let time = utc_ns(header, offset);
                    let message: Bytes = protocol::message(watched.subscription, time, &self.payload).into();
                    client.put_image(job.channel, message);
                }
                Err(e) => client.put_problem(e.to_string()),
            }
        }
        true
    }

    /// The image that is due for longest, of those that a client may be sent.
    fn due(&self, state: &State, scene: &Scene) -> Option<Job> {
        let now = HostTime::now();
        let mut first: Option<Job> = None;
        for client in state.clients.values() {
            for (channel, watched) in &client.watched {
                let Some(source @ LiveSource::Image(stream)) = scene.source(*channel) else { continue };
                let Some(id) = scene.stream(source) else { continue };
                let Some(header) = self.newest.frames().get(id).map(Frame::header) else { continue };
                let is_due = watched.due <= now && watched.sent != Some(header.sequence);
                let is_first = first.as_ref().is_none_or(|job| watched.due < job.due);
                // An encoded image is smaller than its pixels, or little larger.
                if is_due && is_first && client.mailbox.takes_image(*channel, header.payload_len as usize) {
                    first = Some(Job { channel: *channel, stream, due: watched.due });
                }
            }
        }
        first
    }

    /// Until the next message is due, or a frame may have come for one that is.
    fn pause(&self, state: &State, scene: &Scene) -> Duration {
        let mut pause = IDLE;
        for client in state.clients.values() {
            for (channel, watched) in &client.watched {
                let until = match scene.source(*channel) {
                    None | Some(LiveSource::TfStatic) => continue,
                    Some(LiveSource::Diagnostics) => self.diagnostics_due.from_now(),
                    // Batches come as they come, and four wait.
                    Some(LiveSource::Imu(_)) => Duration::ZERO,
                    Some(LiveSource::Image(_)) if !client.mailbox.takes_image(*channel, 0) => continue,
                    Some(_) => watched.due.from_now(),
                };
                pause = pause.min(until.max(POLL));
            }
        }
        pause
    }
}

/// The watched channels; `None`, and the thread ends, when nobody watches any.
fn begin(shared: &Shared) -> Option<(Arc<Scene>, Watched)> {
    let mut state = lock(&shared.state);
    let scene = state.scene.clone();
    if !state.is_watched() {
        state.is_running = false;
        return None;
    }
    let Some(scene) = scene else {
        state.is_running = false;
        return None;
    };
    let channels = state.clients.values().flat_map(|client| client.watched.keys());
    let watched = channels.filter_map(|channel| Some((*channel, scene.source(*channel)?))).collect();
    Some((scene, watched))
}

fn period() -> Duration {
    Duration::from_secs_f64(1.0 / RATE_HZ)
}

fn utc_ns(header: &FrameHeader, offset_ns: i64) -> i64 {
    header.capture_time_ns.saturating_add(offset_ns)
}

/// Says to all who watch a stream why it is not shown.
fn tell(shared: &Shared, scene: &Scene, id: &StreamId, why: &impl core::fmt::Display) {
    for client in lock(&shared.state).clients.values_mut() {
        let watches = |channel: &u32| scene.source(*channel).and_then(|s| scene.stream(s)) == Some(id);
        if client.watched.keys().any(watches) {
            client.put_problem(format!("{id}: {why}"));
        }
    }
}
