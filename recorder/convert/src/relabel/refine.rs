//! Refines every image of a dataset into files, a few sets in each: a killed run goes on with them.

use super::{Camera, Engine, RelabelOptions, cannot};
use crate::{EpisodeUse, Exporter, Output, Part, PartOut, PartSets, Parts, Plan, Source};
use depthrig_bus::sync::lock;
use depthrig_bus::{FrameHeader, files};
use depthrig_cdm::stage::Refiners;
use depthrig_cdm::stage::View;
use depthrig_cdm::stage::pixels;
use depthrig_cdm::{Job, Output as Refined, RawDepth, Refiner, StepTimes};
use depthrig_recorder::codec::{DepthEncoder, DepthShape};
use depthrig_recorder::{DatasetFrame, DatasetSet, Error, ErrorKind, PixelMode, Result};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::Path;

/// Sets of a file: a killed run repeats at most these, for each thread.
const PART_SETS: usize = 10;
/// Bytes before each image: number of the set, index of the camera, length.
const HEAD: usize = 16;

pub(super) struct Refine<'a> {
    pub(super) refiners: &'a dyn Refiners,
    pub(super) cameras: &'a [Camera],
    pub(super) engines: &'a [Engine],
    pub(super) options: &'a RelabelOptions,
}

// Counters of the refined images, for each camera.
/// Sets that lack colour or depth.
pub(super) const UNPAIRED: &str = "sets without colour or depth";
/// Pixels without depth before.
pub(super) const HOLES_BEFORE: &str = "holes before";
/// Pixels without depth after.
pub(super) const HOLES: &str = "holes";
/// Pixels.
pub(super) const PIXELS: &str = "pixels";

/// The name of a camera's counter.
pub(super) fn counter(camera: &Camera, what: &str) -> String {
    format!("{}: {what}", camera.id)
}

/// Pixels without depth.
fn holes<'a>(depth: impl Iterator<Item = &'a u16>) -> u64 {
    depth.filter(|z| **z == 0).count() as u64
}

/// A refined image.
struct RefinedDepth {
    depth: Vec<u16>,
    /// Pixels of its input without depth.
    holes_before: u64,
}

/// The file of the part that begins with this set.
fn file_name(first: usize) -> String {
    format!("sets_{first:08}.refined")
}

impl Exporter for Refine<'_> {
    fn format(&self) -> &'static str {
        "refined depth"
    }

    /// The copy has the episodes, too.
    fn episodes(&self) -> EpisodeUse {
        EpisodeUse::All
    }

    fn options(&self) -> Value {
        let describe = |camera: &Camera| {
            let used = &self.engines[camera.engine].description;
            json!({ "stream": camera.id.to_string(), "engine": used.engine, "model": used.model })
        };
        let cameras: Vec<_> = self.cameras.iter().map(describe).collect();
        let refine = &self.options.refine;
        json!({ "cameras": cameras, "input_size": refine.input_size, "is_aligned": refine.is_aligned,
            "fill_reach": refine.fill_reach })
    }

    fn plan(&mut self, sources: &[Source]) -> Result<Plan> {
        let parts = sources.iter().enumerate().flat_map(|(i, s)| s.parts(i, PART_SETS)).collect();
        Ok(Plan { parts, ..Plan::default() })
    }

    fn part(&self, _: &Source, part: &Part, sets: &mut PartSets<'_>, out: &mut PartOut<'_>) -> Result<()> {
        let mut file = Vec::new();
        let mut encoder = DepthEncoder::new();
        let mut views: Vec<View> = self.cameras.iter().map(|_| View::default()).collect();
        let mut packed = Vec::new();
        while let Some((number, set)) = sets.next(PixelMode::Decoded, out)? {
            for (at, camera) in self.cameras.iter().enumerate() {
                let Some((color, depth)) = pair(&set, camera) else {
                    out.count(&counter(camera, UNPAIRED), 1);
                    continue;
                };
                let refined = self.refine(camera, color, depth, &mut views[at])?;
                out.count(&counter(camera, HOLES_BEFORE), refined.holes_before);
                out.count(&counter(camera, HOLES), holes(refined.depth.iter()));
                out.count(&counter(camera, PIXELS), refined.depth.len() as u64);
                let bytes: Vec<u8> = refined.depth.iter().flat_map(|v| v.to_le_bytes()).collect();
                let h = &color.header;
                let shape = DepthShape { width: h.width, height: h.height, step: h.width * 2 };
                packed.clear();
                encoder.encode(&bytes, shape, &mut packed)?;
                file.extend_from_slice(&(number as u64).to_le_bytes());
                file.extend_from_slice(&(at as u32).to_le_bytes());
                file.extend_from_slice(&(packed.len() as u32).to_le_bytes());
                file.extend_from_slice(&packed);
                out.frame(camera.depth);
            }
        }
        out.file(&file_name(part.sets.start), &file)
    }

    fn finish(&self, _: &[Source], _: &Parts<'_>, _: &Output<'_>) -> Result<()> {
        Ok(())
    }
}

/// Colour and depth of a camera in a set.
pub(super) fn pair<'a>(set: &'a DatasetSet, camera: &Camera) -> Option<(&'a DatasetFrame, &'a DatasetFrame)> {
    let of = |stream| set.frames.iter().find(|f| f.stream == stream);
    Some((of(camera.color)?, of(camera.depth)?))
}

/// The unit of depth that is refined from depth of this header, metres.
pub(super) fn unit_of(depth: &FrameHeader) -> f64 {
    if depth.format == depthrig_bus::PixelFormat::DepthF32 as u32 {
        pixels::UNIT_OF_METRES
    } else {
        depth.depth_unit_m
    }
}

impl Refine<'_> {
    /// Refined depth of one pair.
    fn refine(
        &self,
        camera: &Camera,
        color: &DatasetFrame,
        depth: &DatasetFrame,
        view: &mut View,
    ) -> Result<RefinedDepth> {
        let bad = |why: String| {
            let id = &camera.id;
            Error::new(
                ErrorKind::BadInput,
                format!("{id} cannot be computed from frame {}: {why}", depth.header.sequence),
            )
        };
        let (registered, unit_m) =
            view.depth(&self.options.refine, &color.header, &depth.header, &depth.pixels).map_err(bad)?;
        let holes_before = holes(registered.iter());
        let image = pixels::color(&color.header, &color.pixels).map_err(|e| bad(e.to_string()))?;
        let mut out = vec![0; image.width * image.height];
        let engine = &self.engines[camera.engine];
        let mut refiner = self.take(engine)?;
        let mut job = [Job {
            color: image,
            depth: RawDepth { pixels: registered, unit_m },
            out: Refined::Units { pixels: &mut out, unit_m },
            steps: StepTimes::default(),
        }];
        refiner.refine(&mut job).map_err(|e| bad(e.to_string()))?;
        lock(&engine.free).push(refiner);
        Ok(RefinedDepth { depth: out, holes_before })
    }

    /// A refiner that nobody uses.
    fn take(&self, engine: &Engine) -> Result<Box<dyn Refiner>> {
        if let Some(refiner) = lock(&engine.free).pop() {
            return Ok(refiner);
        }
        let opened = self.refiners.open(&engine.plan, self.options.threads.max(1));
        Ok(opened.map_err(|e| cannot(&engine.plan, &e))?.refiner)
    }
}

/// Refined images, by number of the set and index of the camera; read a file at a time, in order.
pub(super) struct Store {
    dir: std::path::PathBuf,
    images: BTreeMap<(usize, usize), Vec<u8>>,
}

impl Store {
    pub(super) fn new(dir: &Path) -> Self {
        Self { dir: dir.to_owned(), images: BTreeMap::new() }
    }

    /// The packed image of a set and a camera; `None` when there is no such image.
    pub(super) fn take(&mut self, number: usize, camera: usize) -> Option<Vec<u8>> {
        self.images.remove(&(number, camera))
    }

    /// Reads the file that begins with this set, if one does. To be called for each set, also for one that lacks an image.
    ///
    /// # Errors
    /// As the disk says, and when the file is damaged.
    pub(super) fn begin(&mut self, number: usize) -> Result<()> {
        let path = self.dir.join(file_name(number));
        if self.images.keys().next().is_some_and(|(first, _)| *first >= number) {
            return Ok(());
        }
        let bytes = match files::read(&path, files::IMAGE_MAX_BYTES) {
            Ok(bytes) => bytes,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(()),
            Err(e) => {
                return Err(
                    Error::new(ErrorKind::Io, format!("cannot read {}: {e}", path.display())).with_source(e)
                );
            }
        };
        self.images.clear();
        let mut rest = bytes.as_slice();
        while !rest.is_empty() {
            let image = record(rest).ok_or_else(|| {
                let what = format!(
                    "{} is not as it was written; remove {} and begin anew",
                    path.display(),
                    self.dir.display()
                );
                Error::new(ErrorKind::Corrupt, what)
            })?;
            rest = &rest[HEAD + image.1.len()..];
            self.images.insert(image.0, image.1.to_vec());
        }
        Ok(())
    }
}

/// The first image in `bytes` with its number and camera.
fn record(bytes: &[u8]) -> Option<((usize, usize), &[u8])> {
    let (head, rest) = bytes.split_first_chunk::<HEAD>()?;
    let number = u64::from_le_bytes(*head.first_chunk()?);
    let camera = u32::from_le_bytes(*head[8..].first_chunk()?);
    let len = u32::from_le_bytes(*head[12..].first_chunk()?);
    let image = rest.get(..len as usize)?;
    Some(((usize::try_from(number).ok()?, camera as usize), image))
}
