//! Where the views of a board come from: options that several commands share.

use super::dataset::{self, DatasetOptions};
use super::images::{self, Folder};
use super::{Sightings, check};
use crate::context::Context;
use crate::exit::UsageError;
use crate::live::{self, Source};
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::{Result, bail};
use depthrig_bus::{RigName, StreamId};
use depthrig_calibrate::board::Board;
use std::path::PathBuf;

/// A dataset or folders of images.
#[derive(Debug, clap::Args)]
pub struct Input {
    /// Dataset that shows the board; for check also a running rig
    #[arg(value_name = "DATASET")]
    dataset: Option<PathBuf>,
    /// Images of one camera; repeatable
    #[arg(long, value_name = "NAME=FOLDER", value_parser = images::folder, conflicts_with = "dataset")]
    images: Vec<Folder>,
    /// Stream of a camera to look at; repeatable [default: color, else left or infrared]
    #[arg(long, value_name = "CAMERA/STREAM", conflicts_with = "images")]
    stream: Vec<StreamId>,
    /// Take every set of a dataset, those in which the board moves too
    #[arg(long, conflicts_with = "images")]
    moving: bool,
}

impl Input {
    /// The running rig, if that is what was named, or nothing was.
    ///
    /// # Errors
    /// As [`live::source`].
    pub fn rig(&self, context: &Context) -> Result<Option<RigName>> {
        if !self.images.is_empty() {
            return Ok(None);
        }
        Ok(match live::source(self.dataset.as_deref(), context)? {
            Source::Rig(rig) => Some(rig),
            Source::Dataset(_) => None,
        })
    }

    /// Streams that were named.
    pub fn streams(&self) -> &[StreamId] {
        &self.stream
    }

    /// Finds the board in all images.
    ///
    /// # Errors
    /// When nothing was named, cannot be read or shows no board, and when it was interrupted.
    pub fn read(&self, board: &Board, context: &Context) -> Result<Sightings> {
        let stop = Stop::on_signals()?;
        let mut bar = Progress::new(context.global.quiet > 0);
        let progress = |done, total| {
            bar.set("looking for the board", done, total);
            !stop.is_asked()
        };
        let found = match &self.dataset {
            Some(path) => {
                if !path.exists()
                    && let Ok(Source::Rig(rig)) = live::source(Some(path), context)
                {
                    let what = format!(
                        "{rig} is a running rig; take views of it first: depthrig calibrate capture {rig}"
                    );
                    return Err(UsageError(what).into());
                }
                let options = DatasetOptions { streams: self.stream.clone(), moving: self.moving };
                dataset::read(path, board, &options, progress)?
            }
            None if self.images.is_empty() => {
                return Err(
                    UsageError("give a dataset, or --images NAME=FOLDER for each camera".into()).into()
                );
            }
            None => images::read(&self.images, board, progress)?,
        };
        bar.clear();
        let Some(found) = found else { bail!("interrupted; nothing was written") };
        check(&found)?;
        Ok(found)
    }
}
