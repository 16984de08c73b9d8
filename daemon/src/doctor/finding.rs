//! One problem, or fact worth knowing.

use serde::Serialize;

/// How bad it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// Nothing to do.
    Good,
    /// Worth knowing.
    Info,
    /// The session runs, but something of it may be lost.
    Warning,
    /// The session does not run as the rig file has it.
    Error,
}

impl Severity {
    /// The name used in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Info => "info",
            Self::Warning => "warning",
            Self::Error => "error",
        }
    }
}

/// A finding.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// Its kind, for programs: `usb2`, `mode_missing`, …
    pub id: &'static str,
    /// How bad it is.
    pub severity: Severity,
    /// The camera of the rig that it concerns, if it is one.
    pub camera: Option<String>,
    /// The finding itself.
    pub what: String,
    /// Why it matters.
    pub why: String,
    /// How to correct it.
    pub cure: String,
}

impl Finding {
    /// A finding about no camera in particular.
    pub fn new(
        severity: Severity,
        id: &'static str,
        what: impl Into<String>,
        why: impl Into<String>,
        cure: impl Into<String>,
    ) -> Self {
        Self { id, severity, camera: None, what: what.into(), why: why.into(), cure: cure.into() }
    }

    /// The same about a camera of the rig.
    pub fn of(self, camera: &str) -> Self {
        Self { camera: Some(camera.to_owned()), ..self }
    }
}
