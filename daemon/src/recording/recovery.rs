//! Recovers recordings that a crash left unfinished, when the rig starts and beside its work.

use crate::config::RigConfig;
use core::ops::ControlFlow;
use depthrig_recorder::fs::Fs;
use depthrig_recorder::{RecoverOptions, recover_with, unfinished_in};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Recovers this rig's unfinished datasets in its recording folder, one after the other, until `stop`. Errors
/// are logged and cost nothing; `depthrig recover` can be run by hand.
pub fn recover_left(config: &RigConfig, fs: &Arc<dyn Fs>, stop: &AtomicBool) {
    let folder = &config.recording.directory;
    let found = match unfinished_in(fs, folder, config.rig.as_str()) {
        Ok(found) => found,
        Err(e) => {
            tracing::warn!("unfinished datasets could not be looked for: {e}");
            return;
        }
    };
    // Datasets that were finished long ago are not read: that takes hours on a full disk.
    let options = RecoverOptions { unfinished_only: true, ..RecoverOptions::default() };
    for path in found {
        let dataset = path.display();
        tracing::info!(%dataset, "recovering a dataset that was left unfinished");
        let done = recover_with(fs, &path, &options, &mut |_| {
            if stop.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        match done {
            Ok(report) if report.lost.is_empty() => {
                tracing::info!(%dataset, sets = report.sets, "recovered; nothing was lost");
            }
            Ok(report) => {
                let lost = report.lost.join("; ");
                tracing::warn!(%dataset, sets = report.sets, "recovered; lost: {lost}");
            }
            Err(e) => tracing::warn!(%dataset, "not recovered: {e}"),
        }
        if stop.load(Ordering::Relaxed) {
            return;
        }
    }
}
