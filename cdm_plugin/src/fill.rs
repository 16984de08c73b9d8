//! Refined depth without a model: wrong pixels taken out, holes filled along the colour image, noise smoothed.
//!
//! Everything works on inverse depth (1/m), in which a plane is a linear function of the pixel, so that means and
//! interpolation keep planes. The steps:
//! 1. colour and depth are brought into one form ([`load`]); 0, 65535 and what lies beyond the range are holes;
//! 2. pixels without support by their neighbours, small islands, and larger ones that hang in the air become holes
//!    ([`clean`]), and so does what a mirror or glass shows ([`behind`]);
//! 3. the image is halved until one cell is left ([`pyramid`]); where a cell lies on two surfaces, the farther wins;
//! 4. from the coarsest on, holes take the depth of those coarse cells around them that look like them, and are smoothed
//!    within their surface ([`pull`]). What was measured and kept stays as it was measured;
//! 5. what lies further from measured depth than the reach is unknown: 0 ([`reach`]).
//!
//! An image without any depth stays without: its result is 0 everywhere, and no error.
// The steps of a pixel must end up inside the loops that are compiled for AVX2, whatever their size.
#![allow(clippy::inline_always)]

use crate::workers::Workers;
use crate::{
    Color, ColorFormat, Description, Error, ErrorKind, Job, Output, RawDepth, Refiner, Result, StepTimes,
};
use behind::Behind;
use clean::Islands;
use depthrig_bus::HostTime;
use pyramid::Level;
use reach::Reach;

mod behind;
mod clean;
mod load;
mod pull;
mod pyramid;
mod reach;

/// Islands below this part of the image are taken out: 60 pixels of 1280x720.
const ISLAND: f64 = 65e-6;
/// Islands below this are taken out of small images too, pixels.
const LEAST_ISLAND: u32 = 8;

/// An island below this part of the image that hangs in the air, at another depth than all around it, is taken out: 922
/// pixels of 1280x720.
const BODY: f64 = 1e-3;
/// So far they are filled in small images too, pixels.
const LEAST_REACH: usize = 48;

/// The refiner that needs no model.
///
/// Its results are the same bits with any number of threads and on every processor.
#[derive(Debug)]
pub struct FillRefiner {
    description: Description,
    workers: Workers,
    /// Those in use first, from the whole image to one cell; kept when a smaller image needs fewer.
    levels: Vec<Level>,
    in_use: usize,
    cleaned: Vec<f32>,
    islands: Islands,
    behind: Behind,
    reach: Reach,
    /// A part of the image's width; 1 is without a limit.
    limit: f64,
}

impl FillRefiner {
    /// So far from measured depth holes are filled by default, as a part of the image's width: 160 pixels of 1280.
    pub const REACH: f64 = 0.125;

    /// A refiner that uses `threads` threads; 0 and 1 mean the caller's own, and then nothing is allocated for an image
    /// that is not larger than those before it. (With more, rayon's queue allocates a block now and then.)
    ///
    /// # Errors
    /// [`ErrorKind::Engine`] when the threads cannot be made.
    pub fn new(threads: usize) -> Result<Self> {
        let workers = Workers::new(threads)?;
        let description = Description { engine: "fill".into(), model: String::new() };
        Ok(Self {
            description,
            workers,
            levels: Vec::new(),
            in_use: 0,
            cleaned: Vec::new(),
            islands: Islands::default(),
            behind: Behind::default(),
            reach: Reach::default(),
            limit: Self::REACH,
        })
    }

    /// The same refiner with another reach: holes are filled up to `part` of the image's width from measured depth (48 pixels
    /// at least), depth further away is unknown. 0 to 1; with 1 every hole is filled.
    pub fn with_reach(self, part: f64) -> Self {
        Self { limit: part, ..self }
    }

    fn run(&mut self, job: &mut Job<'_>) -> Result<()> {
        check(job)?;
        let began = HostTime::now();
        let (loaded, _) = self.fill_every_hole(&job.color, &job.depth);
        self.forget_far();
        let filled = HostTime::now();
        self.store(&mut job.out);
        job.steps = StepTimes {
            prepare_ns: loaded.since_ns(began).unsigned_abs(),
            infer_ns: filled.since_ns(loaded).unsigned_abs(),
            finish_ns: HostTime::now().since_ns(filled).unsigned_abs(),
        };
        Ok(())
    }

    /// Steps 1 to 4 for images that [`check`] has passed: [`Self::inverse_depth`] is above 0 everywhere, or 0 everywhere without
    /// any depth. Returns when the first two were done, and whether there is depth.
    pub(crate) fn fill_every_hole(&mut self, color: &Color<'_>, depth: &RawDepth<'_>) -> (HostTime, bool) {
        let w = color.width;
        let h = color.height;
        self.resize(w, h);
        let Self { workers, levels, in_use, cleaned, islands, behind, reach, limit, .. } = self;
        let levels = &mut levels[..*in_use];
        let Some((full, _)) = levels.split_first_mut() else { return (HostTime::now(), false) };
        load::load(workers, color, depth, cleaned, &mut full.color);
        workers.rows(&mut full.q, w, |y, row| clean::keep_supported(workers.wide, cleaned, w, y, row));
        let part = |of: f64| (of * (w * h) as f64).round() as u32;
        islands.remove(&mut full.q, w, LEAST_ISLAND.max(part(ISLAND)), part(BODY));
        behind.remove(&mut full.q, w);
        let loaded = HostTime::now();

        workers.rows2(&mut full.share, cleaned, w, |y, share, _| {
            load::share(workers.wide, &full.q[y * w..(y + 1) * w], share);
        });
        for i in 1..levels.len() {
            if let [fine, coarse] = &mut levels[i - 1..=i] {
                pyramid::shrink(workers, fine, coarse);
            }
        }
        // Filling writes into the cells' depth, but not into how much of them had some.
        if let Some(cells) = levels.get(2).filter(|_| *limit < 1.0) {
            reach.measure(cells);
        }
        let has_depth = levels.last().is_some_and(|l| l.q.iter().all(|q| *q > 0.0));
        if has_depth {
            for i in (1..levels.len()).rev() {
                if let [fine, coarse] = &mut levels[i - 1..=i] {
                    pull::fill(workers, coarse, fine);
                    if i > 1 {
                        pull::smooth(workers, fine, cleaned);
                    }
                }
            }
        }
        (loaded, has_depth)
    }

    /// Inverse depth of the last image, 1/m, row by row.
    pub(crate) fn inverse_depth(&self) -> &[f32] {
        self.levels.first().map_or(&[], |l| &l.q)
    }

    /// [`Self::inverse_depth`], for a better estimate in its place.
    pub(crate) fn inverse_depth_mut(&mut self) -> &mut [f32] {
        self.levels.first_mut().map_or(&mut [], |l| &mut l.q)
    }

    /// Step 5: empties the inverse depth beyond the reach from what was measured in the last image.
    pub(crate) fn forget_far(&mut self) {
        let Self { levels, in_use, reach, limit, .. } = self;
        // A smaller image has fewer levels in use, and older ones behind them.
        if *limit < 1.0
            && *in_use > 2
            && let Some(full) = levels.first_mut()
        {
            let w = full.w;
            reach.forget(&mut full.q, w, LEAST_REACH.max((*limit * w as f64) as usize));
        }
    }

    /// Writes the inverse depth as it was asked for.
    pub(crate) fn store(&self, out: &mut Output<'_>) {
        if let Some(full) = self.levels.first() {
            load::store(&self.workers, &full.q, full.w, out);
        }
    }

    /// A row of raw depth as step 1 reads it: inverse depth, 1/m, 0 in holes.
    pub(crate) fn raw_row(&self, depth: &[u16], unit_m: f64, q: &mut [f32]) {
        load::inverse_row(self.workers.wide, depth, (1.0 / unit_m) as f32, q);
    }

    /// Allocates buffers for images of this size; does nothing if the size is unchanged.
    fn resize(&mut self, w: usize, h: usize) {
        if self.levels.first().is_some_and(|l| (l.w, l.h) == (w, h)) {
            return;
        }
        self.cleaned.resize(w * h, 0.0);
        self.islands.reserve(w * h);
        self.behind.resize(w, h);
        self.reach.resize(w.div_ceil(reach::CELL), h.div_ceil(reach::CELL));
        let mut size = (w, h);
        let mut count = 1;
        while size != (1, 1) {
            size = (size.0.div_ceil(2), size.1.div_ceil(2));
            count += 1;
        }
        self.in_use = count;
        if self.levels.len() < count {
            self.levels.resize_with(count, Level::default);
        }
        let mut size = (w, h);
        for level in &mut self.levels[..count] {
            level.resize(size.0, size.1);
            size = (size.0.div_ceil(2), size.1.div_ceil(2));
        }
    }
}

impl Refiner for FillRefiner {
    fn describe(&self) -> &Description {
        &self.description
    }

    fn refine(&mut self, jobs: &mut [Job<'_>]) -> Result<()> {
        jobs.iter_mut().try_for_each(|job| self.run(job))
    }
}

#[cfg(test)]
mod tests;

/// Whether sizes and units go together.
pub(crate) fn check(job: &Job<'_>) -> Result<()> {
    let Color { pixels, width, height, stride, format: ColorFormat::Rgb8 | ColorFormat::Bgr8 } = job.color;
    let bad = |message: String| Err(Error::new(ErrorKind::BadInput, message));
    if width == 0 || height == 0 {
        return bad(format!("a colour image of {width}x{height} has no pixels; give one that has"));
    }
    let needed = width.checked_mul(3).and_then(|row| stride.checked_mul(height - 1)?.checked_add(row));
    if stride < width.saturating_mul(3) || needed.is_none_or(|n| n > pixels.len()) {
        return bad(format!(
            "a colour image of {width}x{height} with {stride} bytes a row does not fit its {} bytes",
            pixels.len()
        ));
    }
    let (count, out, out_unit_m) = match &job.out {
        Output::Units { pixels, unit_m } => (width * height, pixels.len(), *unit_m),
        Output::Metres(pixels) | Output::Inverse(pixels) => (width * height, pixels.len(), 1.0),
    };
    if job.depth.pixels.len() != count || out != count {
        return Err(Error::new(
            ErrorKind::SizeMismatch,
            format!(
                "colour has {width}x{height} pixels, depth {} and the output {out}; depth must be registered to colour \
                 first",
                job.depth.pixels.len()
            ),
        ));
    }
    for (what, unit_m) in [("raw depth", job.depth.unit_m), ("the output", out_unit_m)] {
        if !(unit_m.is_finite() && unit_m > 0.0) {
            return bad(format!("{what}: invalid depth unit {unit_m} m; it must be above 0, such as 0.001"));
        }
    }
    Ok(())
}
