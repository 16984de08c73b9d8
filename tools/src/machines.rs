//! Arguments of commands that share their work between machines.

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

/// Parses a part such as `2/8`.
///
/// # Errors
/// A message when the text has another form.
pub fn part(text: &str) -> Result<[u64; 2], String> {
    let wrong = || format!("write a part such as 2/8 (0/8 to 7/8), not \"{text}\"");
    let (k, n) = text.split_once('/').ok_or_else(wrong)?;
    let [k, n] = [k.parse().map_err(|_| wrong())?, n.parse().map_err(|_| wrong())?];
    if k < n && n <= 1_000_000 { Ok([k, n]) } else { Err(wrong()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_checked() {
        assert_eq!(part("2/8"), Ok([2, 8]));
        for bad in ["8/8", "1", "-1/2", "a/b", "0/0", "1/2/3", "1/1000001"] {
            assert!(part(bad).unwrap_err().contains("2/8"), "{bad}");
        }
    }
}
