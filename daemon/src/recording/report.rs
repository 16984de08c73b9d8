//! The quality reports of finished recordings, written in the background.

use core::ops::ControlFlow;
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_bus::sync::lock;
use depthrig_recorder::report::{REPORT_FILE, Report, ReportOptions};
use depthrig_recorder::{Dataset, fs};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

/// Reports that may be in work at once; a further one is left to `depthrig report`.
const MAX: usize = 4;
/// How long the end of the daemon waits for reports; one not written then is left to `depthrig report`.
const TIMEOUT: Duration = Duration::from_secs(10);
/// Niceness of such a thread: it runs when no other wants to.
const NICE: i32 = 19;

/// The reports in work.
#[derive(Debug, Default)]
pub struct Reports {
    stop: Arc<AtomicBool>,
    threads: Mutex<Vec<JoinHandle<()>>>,
}

impl Reports {
    /// Begins the report of the finished dataset `path` and returns at once. A report that fails is a
    /// line in the log; the recording is the same without it.
    pub fn begin(&self, path: PathBuf) {
        let mut threads = lock(&self.threads);
        threads.retain(|t| !t.is_finished());
        if threads.len() >= MAX {
            tracing::warn!(
                "no time for the report of {0}; make it with: depthrig report {0}",
                path.display()
            );
            return;
        }
        let stop = Arc::clone(&self.stop);
        match std::thread::Builder::new().name("report".into()).spawn(move || write(&path, &stop)) {
            Ok(thread) => threads.push(thread),
            Err(e) => tracing::warn!(error = %e, "the thread for a report could not be started"),
        }
    }

    /// Waits for the reports in work, for some seconds at most; reports not done then are left out.
    pub fn finish(&self) {
        let deadline = HostTime::now().plus(TIMEOUT);
        let threads = std::mem::take(&mut *lock(&self.threads));
        for thread in threads {
            while !thread.is_finished() && !deadline.from_now().is_zero() {
                std::thread::sleep(Duration::from_millis(10));
            }
            self.stop.store(!thread.is_finished(), Ordering::Relaxed);
            if thread.join().is_err() {
                tracing::error!("the thread of a report panicked");
            }
        }
    }
}

fn write(path: &Path, stop: &AtomicBool) {
    // Of this thread alone on Linux; refused it is merely as urgent as others.
    let _ = rustix::process::nice(NICE);
    let mut go_on =
        |_| if stop.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
    let written = Dataset::open(path).and_then(|dataset| {
        let report = Report::of(&dataset, &ReportOptions::default(), &mut go_on)?;
        let page = path.join(REPORT_FILE);
        report.map(|report| report.write(&fs::RealFs, &page).map(|()| page)).transpose()
    });
    match written {
        Ok(Some(page)) => tracing::info!(report = %page.display(), "the report is written"),
        Ok(None) => tracing::info!(
            "stopped before the report was written; write it with: depthrig report {}",
            path.display()
        ),
        Err(e) => tracing::warn!("the report of {} could not be written: {e}", path.display()),
    }
}
