//! Semi-global matching: census, eight paths, the best sum, and the filters that remove doubtful disparities.

use super::{Description, DisparityMap, Gray, Matcher, Parameters, Resolution, StereoPair};
use crate::{Error, ErrorKind, Result};
use choose::{NONE, ONE};
use filter::Speckle;
use pass::{Costs, Form, Passes};
use planes::Penalties;
use rayon::prelude::*;
use texture::Texture;

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod choose;
mod filter;
mod kernel;
mod lanes;
#[cfg(test)]
mod model;
mod pass;
mod planes;
mod presets;
#[cfg(test)]
mod tests;
mod texture;
mod volume;

pub(super) use filter::halve;
pub use presets::SgmPresets;

/// Largest side of an image.
const MAX_SIDE: usize = 16_384;

/// Matches images of one size, and removes doubtful disparities.
#[derive(Debug)]
struct Engine {
    size: (usize, usize),
    passes: Passes,
    texture: Texture,
    /// Disparities in 256ths of a pixel, before and after the median.
    maps: [Vec<u16>; 2],
    speckle: Speckle,
    columns: Vec<u32>,
}

impl Engine {
    fn new(
        form: Form,
        size: (usize, usize),
        disparities: usize,
        parameters: &Parameters,
        threads: usize,
    ) -> Self {
        let Parameters { p1: small, p2: most, p2_least: least, p2_slack: slack, .. } = *parameters;
        let costs = Costs { disparities, small, large: Penalties { most, least, slack } };
        let pixels = size.0 * size.1;
        Self {
            size,
            passes: Passes::new(form, size, costs, threads),
            texture: Texture::new(size.0),
            maps: [vec![NONE; pixels], vec![NONE; pixels]],
            speckle: Speckle::new(if parameters.speckle_px > 0 { pixels } else { 0 }),
            columns: vec![0; size.0],
        }
    }

    fn bytes(&self) -> usize {
        self.passes.bytes()
            + self.texture.bytes()
            + 4 * self.maps[0].len()
            + self.speckle.bytes()
            + 4 * self.columns.len()
    }

    /// Disparities of a pair in 256ths of a pixel, or [`NONE`]; and how sure each is.
    fn run(
        &mut self,
        pair: &StereoPair<'_>,
        parameters: &Parameters,
        pool: Option<&rayon::ThreadPool>,
        confidence: &mut [u8],
    ) -> &mut [u16] {
        let Self { size: (width, height), passes, texture, maps: [map, other], speckle, columns } = self;
        let width = *width;
        let height = *height;
        let last = (passes.disparities() - 1) as u8;
        let (winners, mirrored) = passes.run(pair, pool);
        let rows = height.div_ceil(pool.map_or(1, rayon::ThreadPool::current_num_threads)) * width;
        let part = |(i, (out, sure)): (usize, (&mut [u16], &mut [u8]))| {
            let all = out.chunks_exact_mut(width).zip(sure.chunks_exact_mut(width));
            for (y, (out, sure)) in all.enumerate() {
                let of = i * rows + y * width..i * rows + (y + 1) * width;
                let winners = &winners[of.clone()];
                let mirrored = &mirrored[of];
                choose::choose(winners, mirrored, parameters, last, out, sure);
                if parameters.rematch {
                    choose::rematch(winners, mirrored, parameters.left_right_px, out, sure);
                }
            }
        };
        match pool {
            Some(pool) => pool.install(|| {
                map.par_chunks_mut(rows).zip(confidence.par_chunks_mut(rows)).enumerate().for_each(part);
            }),
            None => part((0, (map.as_mut_slice(), &mut *confidence))),
        }
        if parameters.texture_margin > 0 {
            texture.remove(winners, width, parameters.texture_margin, map, confidence);
        }
        if parameters.median_rounds > 0 {
            for _ in 0..parameters.median_rounds {
                filter::median(width, map, other);
                core::mem::swap(map, other);
            }
            // Those that it filled.
            for (sure, d) in confidence.iter_mut().zip(map.iter()) {
                *sure = (*sure).max(u8::from(*d != NONE));
            }
        }
        let step = |pixels: f32| (pixels * f32::from(ONE)).min(f32::from(u16::MAX)) as u16;
        if parameters.speckle_px > 0 {
            let step = step(parameters.speckle_step_px);
            speckle.remove(width, map, confidence, parameters.speckle_px, step);
        }
        if parameters.gap_px > 0 {
            let step = step(parameters.gap_step_px);
            filter::fill_gaps(width, map, confidence, parameters.gap_px as usize, step, columns);
        }
        map
    }
}

/// The engine at half the resolution, with what is around it.
#[derive(Debug)]
struct Half {
    engine: Engine,
    /// With the lengths and steps of gaps in its own pixels.
    parameters: Parameters,
    images: [Vec<u8>; 2],
    confidence: Vec<u8>,
    /// At full resolution again.
    map: Vec<u16>,
    sure: Vec<u8>,
}

impl Half {
    fn new(form: Form, (width, height): (usize, usize), parameters: &Parameters, threads: usize) -> Self {
        let size = (width.div_ceil(2), height.div_ceil(2));
        let pixels = size.0 * size.1;
        let parameters = Parameters {
            gap_px: parameters.gap_px / 2,
            gap_step_px: parameters.gap_step_px / 2.0,
            texture_margin: parameters.half_texture_margin,
            ..parameters.clone()
        };
        Self {
            engine: Engine::new(form, size, parameters.max_disparity.div_ceil(2), &parameters, threads),
            parameters,
            images: [vec![0; pixels], vec![0; pixels]],
            confidence: vec![0; pixels],
            map: vec![NONE; width * height],
            sure: vec![0; width * height],
        }
    }

    fn bytes(&self) -> usize {
        self.engine.bytes() + 3 * self.confidence.len() + 3 * self.map.len()
    }

    fn run(&mut self, pair: &StereoPair<'_>, pool: Option<&rayon::ThreadPool>) {
        let (w, h) = self.engine.size;
        filter::halve(&pair.left, &mut self.images[0]);
        filter::halve(&pair.right, &mut self.images[1]);
        let [left, right] = self.images.each_ref().map(|p| Gray::packed(p, w, h));
        let Self { engine, parameters, confidence, .. } = self;
        let map = engine.run(&StereoPair::new(left, right), parameters, pool, confidence);
        let full = (pair.left.width, pair.left.height);
        filter::double((w, h), (map, &self.confidence), full, &mut self.map, &mut self.sure);
    }
}

/// The engine for pairs of one size. Everything is allocated when it is made; a pair takes no more on one thread, and
/// handing it to several takes memory about every thirtieth time.
#[derive(Debug)]
pub struct SgmMatcher {
    parameters: Parameters,
    width: usize,
    height: usize,
    full: Option<Engine>,
    half: Option<Half>,
    form: Form,
    pool: Option<rayon::ThreadPool>,
}

impl SgmMatcher {
    /// Prepares for pairs of `width` x `height` pixels. `threads` of its own share the work of a pair, 1 is the caller's;
    /// the result is the same for every number, and when the system gives no more threads the caller's does it all.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for parameters or a size that are not possible.
    pub fn new(width: usize, height: usize, parameters: &Parameters, threads: usize) -> Result<Self> {
        Self::with_form(width, height, parameters, threads, Form::best())
    }

    /// The same with the vectors of `form`, which the processor must have.
    fn with_form(
        width: usize,
        height: usize,
        parameters: &Parameters,
        threads: usize,
        form: Form,
    ) -> Result<Self> {
        parameters.check()?;
        if !(1..=MAX_SIDE).contains(&width) || !(1..=MAX_SIDE).contains(&height) {
            return Err(Error::new(
                ErrorKind::BadInput,
                format!("images of {width}x{height} pixels cannot be matched: sides are 1 to {MAX_SIDE}"),
            ));
        }
        let threads = threads.clamp(1, height.div_ceil(2).min(64));
        let pool =
            rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(|i| format!("stereo-{i}"));
        let pool = if threads > 1 { pool.build().ok() } else { None };
        let threads = if pool.is_some() { threads } else { 1 };
        let size = (width, height);
        let wants = parameters.resolution;
        let full = (wants != Resolution::Half)
            .then(|| Engine::new(form, size, parameters.max_disparity, parameters, threads));
        let half = (wants != Resolution::Full).then(|| Half::new(form, size, parameters, threads));
        Ok(Self { parameters: parameters.clone(), width, height, full, half, form, pool })
    }

    /// Width and height of the pairs.
    pub const fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// The numbers that it was made with.
    pub const fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// The vectors that it uses: `plain`, `avx2` or `avx512`. The result is the same with all.
    pub const fn form(&self) -> &'static str {
        self.form.name()
    }
}

/// Where the results of each resolution go that somebody wants.
#[derive(Default)]
struct Outs<'a> {
    full: Option<&'a mut DisparityMap>,
    half: Option<&'a mut DisparityMap>,
    both: Option<&'a mut DisparityMap>,
}

impl<'a> Outs<'a> {
    fn of(&mut self, resolution: Resolution) -> &mut Option<&'a mut DisparityMap> {
        match resolution {
            Resolution::Full => &mut self.full,
            Resolution::Half => &mut self.half,
            Resolution::Both => &mut self.both,
        }
    }
}

/// Disparities in pixels from those in 256ths.
fn to_pixels(map: &[u16], out: &mut [f32]) {
    for (to, d) in out.iter_mut().zip(map) {
        *to = if *d == NONE { f32::NAN } else { f32::from(*d) / f32::from(ONE) };
    }
}

impl SgmMatcher {
    /// Fills what of `outs` is wanted; the engines that it takes are there.
    fn run_into(&mut self, pair: &StereoPair<'_>, outs: Outs<'_>) -> Result<()> {
        pair.left.check("left", self.width, self.height)?;
        pair.right.check("right", self.width, self.height)?;
        let parameters = &self.parameters;
        let pool = self.pool.as_ref();
        let Outs { mut full, mut half, mut both } = outs;
        for out in [&mut full, &mut half, &mut both].into_iter().flatten() {
            out.resize(self.width, self.height);
        }
        if let Some(engine) = &mut self.half {
            engine.run(pair, pool);
            if let Some(out) = half {
                out.confidence.copy_from_slice(&engine.sure);
                to_pixels(&engine.map, &mut out.disparity);
            }
        }
        let Some(engine) = &mut self.full else { return Ok(()) };
        let Some(first) = full.as_mut().or(both.as_mut()) else { return Ok(()) };
        let map = engine.run(pair, parameters, pool, &mut first.confidence);
        if let Some(out) = &mut full {
            to_pixels(map, &mut out.disparity);
        }
        if let (Some(out), Some(half)) = (both, &self.half) {
            if let Some(full) = full {
                out.confidence.copy_from_slice(&full.confidence);
            }
            filter::fill_from((map, &mut out.confidence), (&half.map, &half.sure));
            to_pixels(map, &mut out.disparity);
        }
        Ok(())
    }
}

impl Matcher for SgmMatcher {
    fn describe(&self) -> Description {
        let bytes = self.full.as_ref().map_or(0, Engine::bytes) + self.half.as_ref().map_or(0, Half::bytes);
        Description {
            producer: format!("depthrig-sgm {}", env!("CARGO_PKG_VERSION")),
            name: self.parameters.preset.name().to_owned(),
            parameters: self.parameters.describe(),
            memory_bytes: bytes as u64,
        }
    }

    fn run(&mut self, pair: &StereoPair<'_>, out: &mut DisparityMap) -> Result<()> {
        let mut outs = Outs::default();
        *outs.of(self.parameters.resolution) = Some(out);
        self.run_into(pair, outs)
    }
}
