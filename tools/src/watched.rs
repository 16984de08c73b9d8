//! Work on datasets with a progress bar that a signal can interrupt, and the report at its end.

use crate::context::Context;
use crate::exit::{Exit, UsageError};
use crate::out;
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::Result;
use core::ops::ControlFlow;
use depthrig_recorder::ErrorKind;
use serde::Serialize;
use std::path::Path;

/// Receives step, amount done and total, and decides whether to continue.
pub type OnProgress<'a> = &'a mut dyn FnMut(&str, u64, u64) -> ControlFlow<()>;

/// Runs `work` with a progress bar until a signal interrupts it.
///
/// # Errors
/// Those of `work`; bad input is a usage error.
pub fn watched<T>(
    context: &Context,
    work: impl FnOnce(OnProgress<'_>) -> depthrig_recorder::Result<T>,
) -> Result<T> {
    let stop = Stop::on_signals()?;
    let mut bar = Progress::new(context.global.quiet > 0);
    let result = work(&mut |what, done, total| {
        bar.set(what, done, total);
        if stop.is_asked() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    bar.clear();
    result.map_err(usage)
}

/// An error of a dataset as one of the command: bad input is a usage error.
pub fn usage(e: depthrig_recorder::Error) -> anyhow::Error {
    match e.kind() {
        ErrorKind::BadInput => UsageError(e.to_string()).into(),
        _ => e.into(),
    }
}

/// Result of a resumable run that derives a dataset from another.
pub struct DerivedDataset<'a> {
    /// The new dataset.
    pub path: &'a Path,
    /// Number of sets.
    pub sets: u64,
    /// Size in bytes.
    pub bytes: u64,
    /// Whether the run was interrupted.
    pub ended: bool,
    /// Number of unreadable parts of the input.
    pub lost: u64,
    /// Descriptions of the first of them.
    pub problems: &'a [String],
    /// Whether anything else that was requested is missing.
    pub lacks: bool,
}

impl DerivedDataset<'_> {
    /// Prints the report as JSON if given, else a line and the output of `more`; losses go to stderr either way.
    /// Returns the exit code.
    ///
    /// # Errors
    /// When the standard output cannot be written.
    pub fn print(
        &self,
        context: &Context,
        json: Option<&impl Serialize>,
        more: impl FnOnce() -> Result<()>,
    ) -> Result<Exit> {
        let path = self.path.display();
        if let Some(report) = json {
            out::json(report)?;
        } else if context.global.quiet == 0 && self.ended {
            out::line(format_args!("{path}: interrupted; run it again to resume"))?;
        } else if context.global.quiet == 0 {
            let sets = out::count(self.sets, "set");
            let bytes = out::bytes(self.bytes);
            out::line(format_args!("{path}: {sets}, {bytes}"))?;
            more()?;
        }
        for problem in self.problems {
            out::note(format_args!("lost: {problem}"));
        }
        if self.lost > self.problems.len() as u64 {
            out::note(format_args!("lost: {} in all", self.lost));
        }
        Ok(match self {
            _ if self.ended => Exit::Failed,
            _ if self.lost > 0 || self.lacks => Exit::Lost,
            _ => Exit::Good,
        })
    }
}
