//! The control thread of a streaming camera: clock probes, its own error report, its temperature.
//!
//! A control request may take the kernel's time-out of 5 s, so none is made by the thread that captures. What is found
//! out reaches that thread through a bounded channel (probes) and a number that it reads (temperature).

use super::family::Family;
use super::protocol::hwm::{HardwareMonitor, UNIT_ID};
use core::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::uvc::control::{ControlPort, Query};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;

/// The first probes follow each other this fast, the others at [`SLOW`] (librealsense `global_timestamp_reader.cpp`).
const FAST: Duration = Duration::from_millis(100);
const FAST_PROBES: u32 = 15;
const SLOW: Duration = Duration::from_secs(1);
/// Probes that may wait for the capturing thread; it takes them with every frame.
const QUEUE: usize = 32;
/// After a request that failed the camera is left alone for this long.
const AFTER_FAILURE: Duration = Duration::from_secs(5);
/// How long the end of the thread is waited for. A pending request may take longer; the thread ends after it.
const FAREWELL: Duration = Duration::from_millis(200);

/// A reading of the device's clock between two of the host's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Probe {
    pub(super) before: HostTime,
    pub(super) ticks: u32,
    pub(super) after: HostTime,
}

/// Counts of what the thread has done so far.
#[derive(Debug, Default)]
struct Shared {
    /// Bits of the temperature in °C; NaN while it is unknown.
    temperature: AtomicU32,
    failed: AtomicU64,
    overrun: AtomicU64,
}

/// A running control thread. Dropping it ends it.
#[derive(Debug)]
pub(super) struct Control {
    shared: Arc<Shared>,
    probes: Receiver<Probe>,
    stop: Option<SyncSender<()>>,
    ended: Receiver<()>,
    thread: Option<JoinHandle<()>>,
}

impl Control {
    /// Starts the thread for the camera that messages call `label`.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when the system refuses a thread.
    pub(super) fn spawn(
        label: String,
        family: Family,
        monitor: Box<dyn HardwareMonitor>,
        port: Box<dyn ControlPort>,
    ) -> Result<Self> {
        let shared = Arc::new(Shared::default());
        shared.temperature.store(f32::NAN.to_bits(), Ordering::Relaxed);
        let (send, probes) = sync_channel(QUEUE);
        let (stop, stopped) = sync_channel(1);
        let (end, ended) = sync_channel(1);
        let name = label.clone();
        let theirs = Arc::clone(&shared);
        let thread = std::thread::Builder::new().name("realsense-ctl".to_owned()).spawn(move || {
            Worker {
                label,
                family,
                monitor,
                port,
                shared: theirs,
                send,
                fault: 0,
                polls: true,
                failing: false,
            }
            .run(&stopped);
            // The receiver is gone if the stream has ended already.
            let _ = end.send(());
        });
        let thread = thread.map_err(|e| {
            Error::new(ErrorKind::Io, format!("{name}: no thread for its controls could be started"))
                .with_source(e)
        })?;
        Ok(Self { shared, probes, stop: Some(stop), ended, thread: Some(thread) })
    }

    /// The probes since the last call.
    pub(super) fn probes(&self) -> impl Iterator<Item = Probe> + '_ {
        self.probes.try_iter()
    }

    /// Sensor temperature, °C; NaN while it is unknown.
    pub(super) fn temperature_c(&self) -> f32 {
        f32::from_bits(self.shared.temperature.load(Ordering::Relaxed))
    }

    /// Failed requests, and probes that were not taken.
    #[cfg(test)]
    fn failed_and_overrun(&self) -> (u64, u64) {
        (self.shared.failed.load(Ordering::Relaxed), self.shared.overrun.load(Ordering::Relaxed))
    }
}

impl Drop for Control {
    fn drop(&mut self) {
        self.stop = None;
        let in_time = !matches!(self.ended.recv_timeout(FAREWELL), Err(RecvTimeoutError::Timeout));
        if let Some(thread) = self.thread.take().filter(|_| in_time) {
            // It has said that it is at its end; a panic in it was logged by the runtime.
            let _ = thread.join();
        }
    }
}

/// The state of the thread.
struct Worker {
    label: String,
    family: Family,
    monitor: Box<dyn HardwareMonitor>,
    port: Box<dyn ControlPort>,
    shared: Arc<Shared>,
    send: SyncSender<Probe>,
    /// The fault that was reported last.
    fault: u8,
    /// Whether the camera has the controls for faults and temperatures.
    polls: bool,
    /// Whether the last request failed.
    failing: bool,
}

impl Worker {
    fn run(mut self, stopped: &Receiver<()>) {
        let began = HostTime::now();
        let mut count = 0;
        let mut probe_at = began;
        let mut look_at = began.plus(SLOW);
        loop {
            let now = HostTime::now();
            let done = if now >= probe_at {
                count += 1;
                probe_at = now.plus(if count < FAST_PROBES { FAST } else { SLOW });
                self.probe()
            } else if now >= look_at {
                look_at = now.plus(SLOW);
                if self.polls { self.look() } else { Ok(()) }
            } else {
                Ok(())
            };
            match done {
                Ok(()) => {}
                Err(e) if e.kind() == ErrorKind::Disconnected => return,
                Err(e) => {
                    self.note_failure(&e);
                    let later = HostTime::now().plus(AFTER_FAILURE);
                    (probe_at, look_at) = (later, later);
                }
            }
            let wait = probe_at.min(look_at).from_now();
            if !matches!(stopped.recv_timeout(wait), Err(RecvTimeoutError::Timeout)) {
                return;
            }
        }
    }

    fn note_failure(&mut self, e: &Error) {
        self.shared.failed.fetch_add(1, Ordering::Relaxed);
        // A camera that answers nothing is said once, and again after it answered in between.
        if !self.failing {
            tracing::warn!(camera = %self.label, "its controls do not answer; capture goes on: {e}");
        }
        self.failing = true;
    }

    fn probe(&mut self) -> Result<()> {
        let before = HostTime::now();
        let data = self.monitor.command(&self.family.clock())?;
        let after = HostTime::now();
        self.failing = false;
        let ticks = depthrig_driver::bytes::u32_at(&data, 0).ok_or_else(|| {
            Error::new(
                ErrorKind::Protocol,
                format!("its clock register came with {} bytes, not 4", data.len()),
            )
        })?;
        if let Err(TrySendError::Full(_)) = self.send.try_send(Probe { before, ticks, after }) {
            self.shared.overrun.fetch_add(1, Ordering::Relaxed);
        }
        Ok(())
    }

    /// Looks at the error report and the temperature.
    fn look(&mut self) -> Result<()> {
        let mut code = [0];
        let asked = self.port.query(UNIT_ID, self.family.error_selector(), Query::GetCur, &mut code);
        if asked.as_ref().is_err_and(|e| e.kind() == ErrorKind::Unsupported) {
            tracing::debug!(camera = %self.label, "this firmware has no error report");
            self.polls = false;
            return Ok(());
        }
        asked?;
        let [code] = code;
        if code != self.fault {
            if let Some(text) = self.family.error_report(code) {
                tracing::warn!(camera = %self.label, code, "{text}");
            } else {
                tracing::info!(camera = %self.label, "it reports no error any more");
            }
            self.fault = code;
        }
        match self.family.temperature_c(self.monitor.as_mut(), self.port.as_mut()) {
            Ok(degrees) => self.shared.temperature.store(degrees.to_bits(), Ordering::Relaxed),
            // Models differ; the error report alone is worth asking for.
            Err(e) if matches!(e.kind(), ErrorKind::Unsupported | ErrorKind::Protocol) => {}
            Err(e) => return Err(e),
        }
        self.failing = false;
        Ok(())
    }
}

#[cfg(test)]
mod tests;
