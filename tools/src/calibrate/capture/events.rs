//! Events of a capture: to the daemon of the rig, for pages that follow it, and as lines of JSON.

use crossbeam::channel::{Receiver, Sender, TrySendError, bounded};
use depthrig_bus::UtcPair;
use depthrig_calibrate::capture::Progress;
use depthrig_daemon::api::CaptureEvent;
use depthrig_daemon::client::Client;
use std::thread::JoinHandle;

/// The event of this moment.
pub fn event(out: &str, progress: Progress, is_finished: bool, refused: &[String]) -> CaptureEvent {
    CaptureEvent {
        utc_ns: UtcPair::sample().utc_ns,
        out: out.to_owned(),
        is_finished,
        refused: refused.to_vec(),
        progress,
    }
}

/// Sends events to the daemon on a thread of its own, so that a slow daemon holds up no capture. An event that finds the last one still
/// waiting is left out; the next one follows within a tenth of a second.
pub struct Reporter {
    events: Option<Sender<CaptureEvent>>,
    thread: Option<JoinHandle<()>>,
}

impl Reporter {
    /// Reports to the daemon behind `client`.
    pub fn new(client: Client) -> Self {
        let (events, queue) = bounded(1);
        let thread =
            std::thread::Builder::new().name("events".into()).spawn(move || report(&client, &queue)).ok();
        Self { events: Some(events), thread }
    }

    /// Reports to nobody.
    pub const fn none() -> Self {
        Self { events: None, thread: None }
    }

    /// Sends an event, unless the last one is still waiting.
    pub fn send(&mut self, event: CaptureEvent) {
        let Some(events) = &self.events else { return };
        if let Err(TrySendError::Disconnected(_)) = events.try_send(event) {
            self.events = None;
        }
    }

    /// Sends the last event, after those that wait.
    pub fn finish(mut self, event: CaptureEvent) {
        if let Some(events) = self.events.take() {
            // Fails only when the thread has given up.
            let _ = events.send(event);
        }
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn report(client: &Client, queue: &Receiver<CaptureEvent>) {
    for event in queue {
        if let Err(e) = client.calibration_event(&event) {
            tracing::warn!(error = %e, "the daemon takes no events; pages that follow the capture show nothing new");
            return;
        }
    }
}
