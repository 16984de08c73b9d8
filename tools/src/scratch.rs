//! The folder for copies of what lies in a bucket.

use crate::context::Context;
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::{Result, bail};
use depthrig_bus::shm;
use depthrig_convert::store::{Place, Remote};
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
        let is_needed = places.iter().any(|place| matches!(place, Place::Remote(_)));
        is_needed.then(|| self.create()).transpose()
    }

    /// Copies all objects directly below a prefix into a folder of its name; also returns the folder around it, with which it goes.
    ///
    /// # Errors
    /// When no object is there, this computer has no room for them, on a signal, and as the server says.
    pub fn copy(&self, remote: &Remote, context: &Context) -> Result<(PathBuf, tempfile::TempDir)> {
        let objects = remote.list()?.files;
        if objects.is_empty() {
            bail!("{remote}: no object is there; name the prefix of shards or of one dataset");
        }
        let around = self.create()?;
        let bytes: u64 = objects.iter().map(|(_, bytes)| bytes).sum();
        let free = shm::free_bytes(around.path())?;
        if free < bytes {
            let has = free / 1_000_000;
            let needed = bytes.div_ceil(1_000_000);
            bail!(
                "{remote} has {needed} MB, and {} has {has} MB free; name another --scratch",
                around.path().display()
            );
        }
        let folder = around.path().join(remote.name());
        std::fs::create_dir(&folder).map_err(|e| depthrig_recorder::Error::io("create", &folder, e))?;
        let stop = Stop::on_signals()?;
        let mut bar = Progress::new(context.global.quiet > 0);
        let mut done = 0;
        for (name, size) in &objects {
            if stop.is_asked() {
                bail!("interrupted; nothing was written");
            }
            bar.set("copying", done, bytes);
            remote.fetch(name, &folder.join(name))?;
            done += size;
        }
        bar.clear();
        Ok((folder, around))
    }

    fn create(&self) -> Result<tempfile::TempDir> {
        let mut folder = tempfile::Builder::new();
        folder.prefix("depthrig-");
        let made = match &self.scratch {
            Some(parent) => folder.tempdir_in(parent),
            None => folder.tempdir(),
        };
        let default = std::env::temp_dir();
        let parent = self.scratch.as_deref().unwrap_or(&default);
        made.map_err(|e| depthrig_recorder::Error::io("create a folder in", parent, e).into())
    }
}

/// Path of a scratch folder; unused without one.
pub fn path_of(scratch: Option<&tempfile::TempDir>) -> PathBuf {
    scratch.map_or(Path::new(""), tempfile::TempDir::path).to_owned()
}
