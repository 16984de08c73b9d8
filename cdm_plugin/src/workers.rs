//! Runs rows of images on one or several threads, and selects the processor's SIMD instructions.
//!
//! The body of a function made with [`wide`] calls functions that are `#[inline(always)]` alone, else those are compiled for
//! the oldest processor.

use crate::{Error, ErrorKind, Result};
use rayon::prelude::*;

/// Rows per task, so that scheduling costs little.
const ROWS: usize = 8;

/// SIMD support of this processor, as detected.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Wide {
    has_avx2: bool,
}

impl Wide {
    pub(crate) fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        let has_avx2 = std::arch::is_x86_feature_detected!("avx2");
        #[cfg(not(target_arch = "x86_64"))]
        let has_avx2 = false;
        Self { has_avx2 }
    }

    /// Assumes the baseline instructions only.
    #[cfg(test)]
    pub(crate) const fn none() -> Self {
        Self { has_avx2: false }
    }

    pub(crate) const fn has_avx2(self) -> bool {
        self.has_avx2
    }
}

/// Makes a function of one that is compiled twice: as it is, and for processors with AVX2. Without fused multiplication,
/// which Rust never makes of a product and a sum by itself, the results are the same bits.
macro_rules! wide {
    ($(#[$meta:meta])* $vis:vis fn $name:ident($($arg:ident: $type:ty),* $(,)?) $body:block) => {
        $(#[$meta])*
        #[allow(unsafe_code, clippy::too_many_arguments)] // called only after detection
        $vis fn $name(wide: $crate::workers::Wide, $($arg: $type),*) {
            #[inline(always)]
            #[allow(clippy::too_many_arguments, clippy::inline_always)]
            fn body($($arg: $type),*) $body

            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2")]
                #[allow(clippy::too_many_arguments)]
                fn with_avx2($($arg: $type),*) {
                    body($($arg),*);
                }
                if wide.has_avx2() {
                    // SAFETY: a `Wide` with AVX2 is only created by detecting it.
                    unsafe { with_avx2($($arg),*) };
                    return;
                }
            }
            let _ = wide;
            body($($arg),*);
        }
    };
}
pub(crate) use wide;

/// Worker threads. A row's result does not depend on the thread or on the other rows.
#[derive(Debug)]
pub(crate) struct Workers {
    pool: Option<rayon::ThreadPool>,
    pub(crate) wide: Wide,
}

impl Workers {
    /// Starts `threads` threads; 0 and 1 use the caller's thread.
    ///
    /// # Errors
    /// [`ErrorKind::Engine`] when the system starts no more threads.
    pub(crate) fn new(threads: usize) -> Result<Self> {
        let build = || {
            let name = |i| format!("refine-{i}");
            rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(name).build()
        };
        let pool = (threads > 1).then(build).transpose().map_err(|e| {
            let message =
                format!("the system does not start {threads} threads to refine depth ({e}); use fewer");
            Error::new(ErrorKind::Engine, message).with_source(e)
        })?;
        Ok(Self { pool, wide: Wide::detect() })
    }

    /// Number of threads, and so of bands of rows that are worth making.
    pub(crate) fn threads(&self) -> usize {
        self.pool.as_ref().map_or(1, rayon::ThreadPool::current_num_threads)
    }

    /// Calls `work` with the first row of every band, its part of `scratch` and its rows of each plane. The planes have rows of
    /// `width` elements and the same number of them; there are as many bands as `scratch` is long, or fewer of few rows.
    pub(crate) fn bands<S: Send, T: Send, const N: usize>(
        &self,
        scratch: &mut [S],
        planes: [&mut [T]; N],
        width: usize,
        work: impl Fn(usize, &mut S, [&mut [T]; N]) + Sync,
    ) {
        let rows = planes.first().map_or(0, |plane| plane.len() / width.max(1));
        let band = rows.div_ceil(scratch.len().max(1)).max(ROWS);
        let mut rest = planes.map(|plane| plane.chunks_mut((band * width).max(1)));
        let bands = scratch.iter_mut().zip((0..rows).step_by(band)).map(|(scratch, first)| {
            (first, scratch, rest.each_mut().map(|chunks| chunks.next().unwrap_or_default()))
        });
        match &self.pool {
            None => bands.for_each(|(first, scratch, rows)| work(first, scratch, rows)),
            Some(pool) => pool.in_place_scope(|scope| {
                let work = &work;
                bands.for_each(|(first, scratch, rows)| scope.spawn(move |_| work(first, scratch, rows)));
            }),
        }
    }

    /// Calls `work` with the number of every row of `width` elements and the row.
    pub(crate) fn rows<T: Send>(&self, out: &mut [T], width: usize, work: impl Fn(usize, &mut [T]) + Sync) {
        match &self.pool {
            None => out.chunks_mut(width).enumerate().for_each(|(y, row)| work(y, row)),
            Some(pool) => pool.install(|| {
                let rows = out.par_chunks_mut(width).with_min_len(ROWS).enumerate();
                rows.for_each(|(y, row)| work(y, row));
            }),
        }
    }

    /// Like [`Self::rows`], for two images of one size at once.
    pub(crate) fn rows2<A: Send, B: Send>(
        &self,
        a: &mut [A],
        b: &mut [B],
        width: usize,
        work: impl Fn(usize, &mut [A], &mut [B]) + Sync,
    ) {
        match &self.pool {
            None => {
                let rows = a.chunks_mut(width).zip(b.chunks_mut(width)).enumerate();
                rows.for_each(|(y, (a, b))| work(y, a, b));
            }
            Some(pool) => pool.install(|| {
                let rows = a.par_chunks_mut(width).zip(b.par_chunks_mut(width)).with_min_len(ROWS);
                rows.enumerate().for_each(|(y, (a, b))| work(y, a, b));
            }),
        }
    }

    /// Like [`Self::rows`], for three images.
    pub(crate) fn rows3<A: Send, B: Send, C: Send>(
        &self,
        a: &mut [A],
        b: &mut [B],
        c: &mut [C],
        width: usize,
        work: impl Fn(usize, &mut [A], &mut [B], &mut [C]) + Sync,
    ) {
        match &self.pool {
            None => {
                let rows = a.chunks_mut(width).zip(b.chunks_mut(width)).zip(c.chunks_mut(width)).enumerate();
                rows.for_each(|(y, ((a, b), c))| work(y, a, b, c));
            }
            Some(pool) => pool.install(|| {
                let rows = a.par_chunks_mut(width).zip(b.par_chunks_mut(width)).zip(c.par_chunks_mut(width));
                rows.with_min_len(ROWS).enumerate().for_each(|(y, ((a, b), c))| work(y, a, b, c));
            }),
        }
    }
}
