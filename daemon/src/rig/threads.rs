//! The rig's threads.

use super::{Inner, StopFlag, report};
use crate::camera::{Camera, Supervisor};
use crate::housekeeping::Housekeeping;
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use depthrig_bus::HostTime;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

/// Pause between two looks of the supervisors at their cameras.
const STEP: Duration = Duration::from_millis(20);
/// Time for one camera thread to end; with it the whole stop stays below a second.
const STOP_TIMEOUT: Duration = Duration::from_millis(500);

/// Starts a thread that ends when its flag is set.
pub(super) fn start_thread(
    name: &str,
    run: impl FnOnce(&AtomicBool) + Send + 'static,
) -> Result<(JoinHandle<()>, StopFlag)> {
    let stop = StopFlag::default();
    let theirs = Arc::clone(&stop);
    let thread = std::thread::Builder::new().name(name.to_owned()).spawn(move || run(&theirs));
    let thread = thread.map_err(|e| {
        Error::new(ErrorKind::Other, format!("the {name} thread could not be started")).with_source(e)
    })?;
    Ok((thread, stop))
}

/// The supervisor thread.
pub(super) fn supervise(inner: &Arc<Inner>, stop: &AtomicBool) {
    let supervisor = |c: &Arc<Camera>| Supervisor::new(Arc::clone(c), Arc::clone(&inner.shared));
    let mut supervisors: Vec<_> = inner.cameras.iter().map(supervisor).collect();
    while !stop.load(Ordering::Relaxed) {
        let now = HostTime::now();
        for s in &mut supervisors {
            s.step(now);
        }
        std::thread::sleep(STEP);
    }
    for s in &supervisors {
        s.request_stop();
    }
    let deadline = HostTime::now().plus(STOP_TIMEOUT);
    for s in &mut supervisors {
        s.stop(deadline.from_now());
    }
}

/// Periodic housekeeping, on a thread of its own.
pub(super) fn housekeeping(inner: &Inner, stop: &AtomicBool) {
    let housekeeping = Housekeeping {
        recording: &inner.recording,
        reports: &inner.reports,
        bus: &inner.shared.bus,
        cpu_millicores: &inner.cpu_millicores,
    };
    housekeeping.run(|| stop.load(Ordering::Relaxed), || report::diagnostics(&report::status(inner)));
}
