//! Semi-global matching: census, eight paths, the best sum, and what removes the doubtful.

use super::{Description, DisparityMap, Gray, Matcher, Parameters, StereoPair};
use crate::{Error, ErrorKind, Result};
use choose::{NONE, ONE};
use filter::Speckle;
use pass::{Costs, Form, Passes};
use planes::Penalties;
use rayon::prelude::*;

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
#[cfg(test)]
mod tests;
mod volume;

/// Largest side of a picture.
const MAX_SIDE: usize = 16_384;

/// Half of a pair, where half of it is matched.
#[derive(Debug)]
struct Half {
    pictures: [Vec<u8>; 2],
    map: Vec<u16>,
    confidence: Vec<u8>,
}

/// The engine for pairs of one size. Everything is allocated when it is made; a pair takes no more on one thread, and
/// handing it to several takes memory about every thirtieth time.
#[derive(Debug)]
pub struct SgmMatcher {
    parameters: Parameters,
    width: usize,
    height: usize,
    /// Size of what is matched.
    size: (usize, usize),
    passes: Passes,
    /// Disparities in 256ths of a pixel, and what the median makes of them.
    maps: [Vec<u16>; 2],
    half: Option<Half>,
    speckle: Speckle,
    columns: Vec<u32>,
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
                format!("pictures of {width}x{height} pixels cannot be matched: sides are 1 to {MAX_SIDE}"),
            ));
        }
        let (size, disparities) = if parameters.half_resolution {
            ((width.div_ceil(2), height.div_ceil(2)), parameters.max_disparity.div_ceil(2))
        } else {
            ((width, height), parameters.max_disparity)
        };
        let threads = threads.clamp(1, size.1.min(64));
        let pool =
            rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(|i| format!("stereo-{i}"));
        let pool = if threads > 1 { pool.build().ok() } else { None };
        let threads = if pool.is_some() { threads } else { 1 };
        let Parameters { p1: small, p2: most, p2_least: least, p2_slack: slack, .. } = *parameters;
        let costs = Costs { disparities, small, large: Penalties { most, least, slack } };
        let pixels = size.0 * size.1;
        let half = parameters.half_resolution.then(|| Half {
            pictures: [vec![0; pixels], vec![0; pixels]],
            map: vec![NONE; pixels],
            confidence: vec![0; pixels],
        });
        Ok(Self {
            parameters: parameters.clone(),
            width,
            height,
            size,
            passes: Passes::new(form, size, costs, threads),
            maps: [vec![NONE; width * height], vec![NONE; width * height]],
            half,
            speckle: Speckle::new(if parameters.speckle_px > 0 { pixels } else { 0 }),
            columns: vec![0; width],
            pool,
        })
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
        self.passes.form().name()
    }

    /// Matches pictures of [`SgmMatcher::size`]'s own, into the first of the maps.
    fn matched(&mut self, pair: &StereoPair<'_>, confidence: &mut [u8]) {
        let Self { parameters, passes, maps: [map, other], speckle, columns, pool, .. } = self;
        let (width, height) = self.size;
        let pixels = width * height;
        let (map, other) = (&mut map[..pixels], &mut other[..pixels]);
        let last = (passes.disparities() - 1) as u8;
        let (winners, mirrored) = passes.run(pair, pool.as_ref());
        let rows = height.div_ceil(pool.as_ref().map_or(1, rayon::ThreadPool::current_num_threads)) * width;
        let part = |(i, (out, sure)): (usize, (&mut [u16], &mut [u8]))| {
            let all = out.chunks_exact_mut(width).zip(sure.chunks_exact_mut(width));
            for (y, (out, sure)) in all.enumerate() {
                let of = i * rows + y * width..i * rows + (y + 1) * width;
                choose::choose(&winners[of.clone()], &mirrored[of], parameters, last, out, sure);
            }
        };
        match pool {
            Some(pool) => pool.install(|| {
                map.par_chunks_mut(rows).zip(confidence.par_chunks_mut(rows)).enumerate().for_each(part);
            }),
            None => part((0, (map, confidence))),
        }
        if parameters.median {
            filter::median(width, map, other);
            map.copy_from_slice(other);
        }
        if parameters.speckle_px > 0 {
            let step = (parameters.speckle_step_px * f32::from(ONE)).min(f32::from(u16::MAX)) as u16;
            speckle.remove(width, map, confidence, parameters.speckle_px, step);
        }
        if parameters.gap_px > 0 {
            let step = (parameters.gap_step_px * f32::from(ONE)).min(f32::from(u16::MAX)) as u16;
            filter::fill_gaps(width, map, confidence, parameters.gap_px as usize, step, columns);
        }
    }
}

impl Matcher for SgmMatcher {
    fn describe(&self) -> Description {
        let maps = self.maps.iter().map(|m| 2 * m.len()).sum::<usize>();
        let half = self.half.as_ref().map_or(0, |h| 5 * h.map.len());
        let bytes = self.passes.bytes() + maps + half + self.speckle.bytes() + 4 * self.columns.len();
        Description {
            producer: format!("depthrig-sgm {}", env!("CARGO_PKG_VERSION")),
            name: self.parameters.preset.name().to_owned(),
            parameters: self.parameters.describe(),
            memory_bytes: bytes as u64,
        }
    }

    fn run(&mut self, pair: &StereoPair<'_>, out: &mut DisparityMap) -> Result<()> {
        pair.left.check("left", self.width, self.height)?;
        pair.right.check("right", self.width, self.height)?;
        out.resize(self.width, self.height);
        if let Some(mut half) = self.half.take() {
            let (w, h) = self.size;
            filter::halve(&pair.left, &mut half.pictures[0]);
            filter::halve(&pair.right, &mut half.pictures[1]);
            let [left, right] = half.pictures.each_ref().map(|p| Gray::packed(p, w, h));
            self.matched(&StereoPair::new(left, right), &mut half.confidence);
            half.map.copy_from_slice(&self.maps[0][..w * h]);
            let full = (self.width, self.height);
            filter::double(
                self.size,
                (&half.map, &half.confidence),
                full,
                &mut self.maps[0],
                &mut out.confidence,
            );
            self.half = Some(half);
        } else {
            self.matched(pair, &mut out.confidence);
        }
        for (to, d) in out.disparity.iter_mut().zip(&self.maps[0]) {
            *to = if *d == NONE { f32::NAN } else { f32::from(*d) / f32::from(ONE) };
        }
        Ok(())
    }
}
