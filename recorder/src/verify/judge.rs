//! Judges segments one at a time with the rules of [`verify`](super::verify), for what writes them: a recovery keeps
//! only what passes here.

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
    /// What is not what it says it is; empty when nothing is.
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

    /// Before a segment of which the ones before are not looked at.
    pub(crate) fn lone(session: &Session) -> Self {
        let mut judge = Self::new(session);
        judge.walk.lone = true;
        judge
    }

    /// Reads the segment `path` after those before; `tell` hears how many bytes of it are done.
    ///
    /// # Errors
    /// When the operating system cannot read it, and what `tell` returns. Damage is a verdict.
    pub(crate) fn look(
        &self,
        fs: &dyn Fs,
        path: &Path,
        tell: &mut dyn FnMut(u64) -> Result<()>,
    ) -> Result<Verdict> {
        let mut after = self.clone();
        let mut findings = Findings::default();
        let mut ended = Ok(());
        let mut hear = |progress: super::VerifyProgress| {
            ended = tell(progress.bytes);
            if ended.is_ok() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
        };
        let mut watch = Watch { tell: &mut hear, done: 0, told: 0, total: u64::MAX, stopped: false };
        segment::try_segment(&mut after.walk, fs, path, &mut findings, &mut watch)?;
        ended?;
        Ok(Verdict { broken: broken(findings), after })
    }
}

/// What `session.toml` says that is broken, whatever the segments hold.
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
