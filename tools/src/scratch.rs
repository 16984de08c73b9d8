//! The folder for copies of what lies in a bucket.

use anyhow::Result;
use depthrig_convert::store::Place;
use std::path::{Path, PathBuf};

/// Folder for copies of what lies in a bucket.
#[derive(Debug, Clone, clap::Args)]
pub struct Scratch {
    /// Folder for copies of what lies in a bucket [default: $TMPDIR]
    #[arg(long, value_name = "DIR")]
    scratch: Option<PathBuf>,
}

impl Scratch {
    /// Creates a folder below, removed when the value is dropped; `None` when no place is in a bucket.
    ///
    /// # Errors
    /// When it cannot be made.
    pub fn folder(&self, places: &[&Place]) -> Result<Option<tempfile::TempDir>> {
        if !places.iter().any(|place| matches!(place, Place::Remote(_))) {
            return Ok(None);
        }
        let mut folder = tempfile::Builder::new();
        folder.prefix("depthrig-");
        let made = match &self.scratch {
            Some(parent) => folder.tempdir_in(parent),
            None => folder.tempdir(),
        };
        let default = std::env::temp_dir();
        let parent = self.scratch.as_deref().unwrap_or(&default);
        made.map(Some).map_err(|e| depthrig_recorder::Error::io("create a folder in", parent, e).into())
    }
}

/// Path of a scratch folder; unused without one.
pub fn path_of(scratch: Option<&tempfile::TempDir>) -> PathBuf {
    scratch.map_or(Path::new(""), tempfile::TempDir::path).to_owned()
}
