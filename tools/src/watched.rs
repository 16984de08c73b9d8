//! Work on datasets that is told of while it runs and that a signal ends, and what is told when it has.

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

/// Is told what is being done, how far it is and of how much, and says whether to go on.
pub type Tell<'a> = &'a mut dyn FnMut(&str, u64, u64) -> ControlFlow<()>;

/// Runs work that shows how far it is and that a signal ends.
///
/// # Errors
/// What `work` says; bad input is an error of usage.
pub fn watched<T>(
    context: &Context,
    work: impl FnOnce(Tell<'_>) -> depthrig_recorder::Result<T>,
) -> Result<T> {
    let stop = Stop::on_signals()?;
    let mut bar = Progress::new(context.global.quiet > 0);
    let result = work(&mut |what, done, total| {
        bar.set(what, done, total);
        if stop.is_asked() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    bar.clear();
    result.map_err(|e| match e.kind() {
        ErrorKind::BadInput => UsageError(e.to_string()).into(),
        _ => e.into(),
    })
}

/// What is left of a run that made a dataset out of another, and that goes on where it was ended.
pub struct Remade<'a> {
    /// The new dataset.
    pub path: &'a Path,
    /// Its sets.
    pub sets: u64,
    /// Its bytes.
    pub bytes: u64,
    /// It was ended before all was done.
    pub ended: bool,
    /// What could not be read.
    pub lost: u64,
    /// The first of it, in words.
    pub problems: &'a [String],
    /// Something else that was asked for is not there.
    pub lacks: bool,
}

impl Remade<'_> {
    /// Prints `report` as JSON if that is asked for, else a line and what `more` prints; what was lost goes to the standard
    /// error output either way. Which exit code it is.
    ///
    /// # Errors
    /// When the standard output cannot be written.
    pub fn told(
        &self,
        context: &Context,
        json: Option<&impl Serialize>,
        more: impl FnOnce() -> Result<()>,
    ) -> Result<Exit> {
        let path = self.path.display();
        if let Some(report) = json {
            out::json(report)?;
        } else if context.global.quiet == 0 && self.ended {
            out::line(format_args!("{path}: ended; run it again to go on"))?;
        } else if context.global.quiet == 0 {
            let (sets, bytes) = (out::count(self.sets, "set"), out::bytes(self.bytes));
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
