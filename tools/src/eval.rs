//! The parts of `depthrig eval`: sources of images, refiners, the measurement, and its reports.
//!
//! A [`Source`] gives jobs that read images; [`run`] refines and measures them and makes a [`records::Record`] of each. Every
//! number of a report comes from these records in the order of the images, whether they were made just now or are in files of
//! parts: so parts together give the same report.

pub mod csv;
pub mod dataset;
pub mod files;
pub mod filled;
pub mod hammer;
pub mod merge;
pub mod page;
pub mod paired;
pub mod read;
pub mod records;
pub mod refine;
pub mod run;
pub mod scenes;
pub mod shards;
pub mod summary;
pub mod text;
pub mod units;

use anyhow::{Result, bail};
use depthrig_bus::Intrinsics;
use image::RgbImage;
use read::{Metres, Raw};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Depth that evaluations of HAMMER and shards count, metres.
pub const USUAL_RANGE_M: (f64, f64) = (0.1, 6.0);

/// Where an image comes from.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Place {
    /// Name of the image.
    pub name: String,
    /// Scene that it shows: errors are also given by scene.
    pub scene: String,
    /// The recording that it belongs to. Images of one sequence resemble each other; those of two do not.
    pub sequence: String,
}

/// One reference with its predictions.
pub struct Loaded {
    /// Rows of the table are by group and prediction: a camera or sensor, or nothing.
    pub group: String,
    /// Where it comes from.
    pub place: Place,
    /// The reference.
    pub truth: Arc<Metres>,
    /// Predictions by their row; missing ones are left out.
    pub predictions: Vec<(usize, Metres)>,
    /// Input of refiners, and its row.
    pub raw: Option<(usize, Raw)>,
    /// Colour in the view of the reference.
    pub color: Option<Arc<RgbImage>>,
    /// Number of the material of each pixel.
    pub material: Option<Arc<Vec<u8>>>,
    /// Lens of that view.
    pub lens: Option<Intrinsics>,
}

/// Images that a job read.
#[derive(Default)]
pub struct Images {
    /// The images.
    pub loaded: Vec<Loaded>,
    /// How many images were left out, by reason.
    pub omitted: BTreeMap<String, u64>,
}

/// Reads the images of one job; runs on any thread.
pub type Job = Box<dyn FnOnce() -> Result<Images> + Send>;

/// A source of images.
pub trait Source {
    /// Names of the predictions: the first rows.
    fn names(&self) -> &[String];
    /// Number of jobs.
    fn total(&self) -> u64;
    /// Returns the next job; an error does not end the iteration. The order is always the same.
    fn next(&mut self) -> Option<Result<Job>>;
    /// Describes references without a prediction and other omissions that are known from the start.
    fn left_out(&self) -> Vec<String>;
}

/// Names of the materials of `depthrig scenes` (docs/depth-lab.md), by number.
pub const MATERIALS: [&str; 6] = ["nothing", "diffuse", "glossy", "metal", "glass", "dark"];

/// Name of a material.
pub fn material_name(number: u8) -> String {
    MATERIALS.get(usize::from(number)).map_or_else(|| format!("material {number}"), |n| (*n).to_owned())
}

/// Checks that two images of one view have one size.
///
/// # Errors
/// Names both.
pub fn same_size(what: &str, (w, h): (usize, usize), truth: &Metres) -> Result<()> {
    if (w, h) != (truth.width, truth.height) {
        bail!(
            "{what}: it has {w}x{h} pixels and its reference {}x{}; compare images of one view and size",
            truth.width,
            truth.height
        );
    }
    Ok(())
}
