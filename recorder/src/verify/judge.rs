//! Judges segments one at a time with the rules of [`verify`](super::verify), for their writers: a recovery keeps only
//! segments that pass here.

use super::sets::Walk;
use super::{Finding, Findings, Severity, VerifyOptions, Watch, check_session, segment};
use crate::fs::Fs;
use crate::{Result, Session};
use core::ops::ControlFlow;
use std::path::Path;

/// The state after some segments of a dataset.
#[derive(Clone)]
pub(crate) struct Judge {
    walk: Walk,
}

/// The verdict on a segment.
pub(crate) struct Verdict {
    /// Findings of broken data.
    pub(crate) broken: Vec<Finding>,
    /// The state after it.
    pub(crate) after: Judge,
}

impl Judge {
    /// Before the first segment of a dataset.
    pub(crate) fn new(session: &Session) -> Self {
        let mut walk = Walk::new(session, VerifyOptions { threads: 1, ..VerifyOptions::default() });
        // They are few beside the images, and what is copied is copied for good.
        walk.compares_singles = true;
        Self { walk }
    }

    /// Before a segment whose predecessors are not checked.
    pub(crate) fn lone(session: &Session) -> Self {
        let mut judge = Self::new(session);
        judge.walk.lone = true;
        judge
    }

    /// Reads the segment `path` after those before; `on_progress` gets the bytes of it done so far.
    ///
    /// # Errors
    /// When the operating system cannot read it, and the error of `on_progress`. Damage is a verdict.
    pub(crate) fn look(
        &self,
        fs: &dyn Fs,
        path: &Path,
        on_progress: &mut dyn FnMut(u64) -> Result<()>,
    ) -> Result<Verdict> {
        let mut after = self.clone();
        let mut findings = Findings::default();
        let mut ended = Ok(());
        let mut forward = |progress: super::VerifyProgress| {
            ended = on_progress(progress.bytes);
            if ended.is_ok() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
        };
        let mut watch =
            Watch { on_progress: &mut forward, done: 0, reported: 0, total: u64::MAX, stopped: false };
        segment::try_segment(&mut after.walk, fs, path, &mut findings, &mut watch)?;
        ended?;
        Ok(Verdict { broken: broken(findings), after })
    }
}

/// Findings of broken data in `session.toml`, whatever the segments hold.
pub(crate) fn broken_session(session: &Session) -> Vec<Finding> {
    let mut findings = Findings::default();
    check_session(session, &mut findings);
    broken(findings)
}

fn broken(findings: Findings) -> Vec<Finding> {
    let mut found = findings.sorted();
    found.retain(|f| f.severity == Severity::Broken);
    found
}
