//! Bodies of requests.

use serde::{Deserialize, Serialize};

/// A timed note for the recording.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoteRequest {
    /// The text to note.
    pub text: String,
}

/// How far to step in a replay.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StepRequest {
    /// Sets to play; negative: back.
    pub sets: i64,
}

impl Default for StepRequest {
    fn default() -> Self {
        Self { sets: 1 }
    }
}

/// A speed for a replay.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RateRequest {
    /// Against the original.
    pub rate: f64,
}

/// Whether a replay begins again at its end.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LoopRequest {
    /// Whether.
    pub on: bool,
}

/// A camera by its name.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraRequest {
    /// Its name.
    pub camera: String,
}

/// A change by its fingerprint.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FingerprintRequest {
    /// That of the changes of controls.
    pub fingerprint: String,
}
