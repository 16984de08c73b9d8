//! Periodic housekeeping of a rig or a replay, once a second.

use crate::recording::{self, Recording, Reports};
use core::cell::Cell;
use core::time::Duration;
use depthrig_bus::{Bus, HostTime, clock, umask};
use depthrig_recorder::Diagnostic;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard};

/// How often it looks whether a recording is due to end, or whether it shall stop itself.
const LOOK: Duration = Duration::from_millis(50);
const SECOND_NS: i64 = 1_000_000_000;
/// How soon after the last time killed processes are looked for again when a stream has no free slot.
const CLEAN_AGAIN_NS: i64 = SECOND_NS / 5;

/// State that the housekeeping thread looks after.
pub struct Housekeeping<'a> {
    /// Ended when it has lasted as long as it was to.
    pub recording: &'a Mutex<Recording>,
    /// Where the report of such a recording is begun.
    pub reports: &'a Reports,
    /// Cleaned up after killed processes.
    pub bus: &'a Bus,
    /// Gets the CPU of this process over the last second, thousandths of a core.
    pub cpu_millicores: &'a AtomicU64,
}

impl Housekeeping<'_> {
    /// Runs until `stopping`; `diagnose` returns the diagnostics for a recording that is going on.
    pub fn run(&self, stopping: impl Fn() -> bool, diagnose: impl Fn() -> Vec<Diagnostic>) {
        let mut last = HostTime::now();
        let mut last_cpu = clock::process_cpu_ns();
        let cleaned = Cell::new(last);
        let due = || recording::is_due(self.recording);
        let close = || {
            // Errors are logged and in the status.
            if let Some(Ok(status)) = recording::stop_when_due(self.recording) {
                self.reports.begin(PathBuf::from(&status.path));
            }
        };
        let starved = || {
            // Subscribers that are alive may hold every slot for long, so not each time.
            if HostTime::now().since_ns(cleaned.get()) >= CLEAN_AGAIN_NS && self.bus.starved() {
                self.clean(&cleaned);
            }
        };
        schedule(stopping, due, close, starved, || {
            let now = HostTime::now();
            let cpu = clock::process_cpu_ns();
            let passed_ns = now.since_ns(last).max(1);
            self.cpu_millicores.store(((cpu - last_cpu) * 1000 / passed_ns) as u64, Ordering::Relaxed);
            (last, last_cpu) = (now, cpu);
            self.clean(&cleaned);
            umask::check();
            if lock(self.recording).is_active() {
                // Before the recording is locked again: the rig's status asks it, too.
                let diagnostics = diagnose();
                lock(self.recording).housekeeping(diagnostics);
            }
        });
    }

    /// Frees slots that killed processes held; publishers get them back when they next need one.
    fn clean(&self, cleaned: &Cell<HostTime>) {
        let processes = self.bus.clean_dead();
        if processes > 0 {
            tracing::info!(processes, "cleaned up after processes that were killed");
        }
        cleaned.set(HostTime::now());
    }
}

fn lock(recording: &Mutex<Recording>) -> MutexGuard<'_, Recording> {
    depthrig_bus::sync::lock(recording)
}

/// Closing takes as long as the disk does, so it has a thread of its own, which is waited for at the end: meanwhile
/// housekeeping goes on.
fn schedule(
    stopping: impl Fn() -> bool,
    due: impl Fn() -> bool,
    close: impl Fn() + Sync,
    mut each_look: impl FnMut(),
    mut each_second: impl FnMut(),
) {
    std::thread::scope(|scope| {
        let mut last = HostTime::now();
        while !stopping() {
            std::thread::sleep(LOOK);
            if due() {
                let thread = std::thread::Builder::new().name("rec-close".into());
                if let Err(e) = thread.spawn_scoped(scope, &close) {
                    tracing::error!(error = %e, "no thread to end the recording, which is tried again");
                }
            }
            each_look();
            let now = HostTime::now();
            if now.since_ns(last) >= SECOND_NS {
                last = now;
                each_second();
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicBool, AtomicUsize};

    /// A disk that does not answer keeps a recording from being closed, and nothing else.
    #[test]
    fn housekeeping_goes_on_while_a_recording_is_closed() {
        let due = AtomicBool::new(true);
        let closed = AtomicBool::new(false);
        let seconds = AtomicUsize::new(0);
        let seen_open = AtomicUsize::new(0);
        schedule(
            || seconds.load(Ordering::SeqCst) >= 2,
            || due.swap(false, Ordering::SeqCst),
            || {
                // Until housekeeping has run twice, or ten seconds where it never does.
                let began = HostTime::now();
                while seconds.load(Ordering::SeqCst) < 2 && began.elapsed() < Duration::from_secs(10) {
                    std::thread::sleep(Duration::from_millis(10));
                }
                closed.store(true, Ordering::SeqCst);
            },
            || {},
            || {
                seen_open.fetch_add(usize::from(!closed.load(Ordering::SeqCst)), Ordering::SeqCst);
                seconds.fetch_add(1, Ordering::SeqCst);
            },
        );
        assert!(closed.into_inner(), "its end is waited for");
        assert_eq!(seen_open.into_inner(), 2, "housekeeping waited for the disk");
    }
}
