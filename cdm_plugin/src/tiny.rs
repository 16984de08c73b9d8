//! `tiny`: a small network of this repository that improves what `fill` gives, quick enough for CPUs.
//!
//! The steps, on inverse depth (1/m):
//! 1. [`FillRefiner`] fills every hole, and knows which of them lie beyond the reach;
//! 2. colour, filled and raw depth become the planes of the network's input ([`planes`]), padded to multiples of 16;
//! 3. the network multiplies the filled depth in holes, within a factor of e²; what was measured and kept stays;
//! 4. the padding goes, and where `fill` with its reach knows nothing, nothing is known.
//!
//! An image without any depth stays without, and the network does not run for it.

use crate::fill::check;
use crate::network::ImageNetwork;
use crate::onnxruntime::TinyNetwork;
use crate::{Description, Error, ErrorKind, FillRefiner, Job, Refiner, RefinerOptions, Result, StepTimes};
use depthrig_bus::HostTime;

mod model;
mod planes;

pub use model::{RECORD, TinyFile, TinyModel, is_tiny_file, model};

/// The refiner that is the network `tiny` with `fill` before it.
///
/// A second image of a size costs no allocation as long as [`crate::RefinerOptions::threads`] is 1; eight sizes are kept.
pub struct TinyRefiner {
    description: Description,
    fill: FillRefiner,
    network: Box<dyn ImageNetwork>,
}

impl TinyRefiner {
    /// The refiner with the network of `options`, else the one that is part of the program; `options` give threads, library and
    /// reach too.
    ///
    /// # Errors
    /// [`crate::ErrorKind::NoEngine`] when ONNX Runtime is not found, [`crate::ErrorKind::Unsupported`] for another device
    /// than `cpu` or another precision than `fp32`, and those of the library.
    pub fn open(options: &RefinerOptions) -> Result<Self> {
        let bytes = options.tiny.as_ref().map_or(model::BYTES, |own| &own.bytes);
        let network = TinyNetwork::open(bytes, options).map_err(|e| match (&options.tiny, e.kind()) {
            (Some(own), ErrorKind::Engine) => {
                let what = format!("{}: not a network of the form of tiny: {e}", own.id);
                Error::new(ErrorKind::BadModel, what).with_source(e)
            }
            _ => e,
        })?;
        let engine = network.describe().to_owned();
        Self::new(Box::new(network), engine, options)
    }

    fn new(network: Box<dyn ImageNetwork>, engine: String, options: &RefinerOptions) -> Result<Self> {
        let fill = FillRefiner::new(options.thread_count())?.with_reach(options.fill_reach);
        let model = options.tiny.as_ref().map_or_else(|| model().id.clone(), |own| own.id.clone());
        Ok(Self { description: Description { engine, model }, fill, network })
    }

    fn run(&mut self, job: &mut Job<'_>) -> Result<()> {
        check(job)?;
        job.steps = StepTimes::default();
        let began = HostTime::now();
        let (_, has_depth) = self.fill.fill_every_hole(&job.color, &job.depth);
        if !has_depth {
            job.out.clear();
            return Ok(());
        }
        let size = (job.color.width, job.color.height);
        let padded = (planes::padded(size.0), planes::padded(size.1));
        let (x, filled) = self.network.inputs(padded.0, padded.1)?;
        planes::write(&job.color, &job.depth, &self.fill, x, filled);
        let prepared = HostTime::now();
        let refined = self.network.run()?;
        let inferred = HostTime::now();
        planes::read(refined, padded.0, self.fill.inverse_depth_mut(), size.0);
        self.fill.forget_far();
        self.fill.store(&mut job.out);
        job.steps = StepTimes {
            prepare_ns: prepared.since_ns(began).unsigned_abs(),
            infer_ns: inferred.since_ns(prepared).unsigned_abs(),
            finish_ns: HostTime::now().since_ns(inferred).unsigned_abs(),
        };
        Ok(())
    }
}

impl Refiner for TinyRefiner {
    fn describe(&self) -> &Description {
        &self.description
    }

    fn warms_up(&self) -> bool {
        true
    }

    fn refine(&mut self, jobs: &mut [Job<'_>]) -> Result<()> {
        jobs.iter_mut().try_for_each(|job| self.run(job))
    }
}

#[cfg(test)]
mod tests;
