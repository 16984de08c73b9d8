//! Runs rows of images on one or several threads, and selects the processor's SIMD instructions.

use rayon::prelude::*;

/// Rows per task, so that scheduling costs little.
const ROWS: usize = 8;

/// SIMD support of this processor, as detected.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wide {
    has_avx2: bool,
}

impl Wide {
    pub(super) fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        let has_avx2 = std::arch::is_x86_feature_detected!("avx2");
        #[cfg(not(target_arch = "x86_64"))]
        let has_avx2 = false;
        Self { has_avx2 }
    }

    /// Assumes the baseline instructions only.
    #[cfg(test)]
    pub(super) const fn none() -> Self {
        Self { has_avx2: false }
    }

    pub(super) const fn has_avx2(self) -> bool {
        self.has_avx2
    }
}

/// Makes a function of one that is compiled twice: as it is, and for processors with AVX2. Without fused multiplication,
/// which Rust never makes of a product and a sum by itself, the results are the same bits.
macro_rules! wide {
    ($(#[$meta:meta])* $vis:vis fn $name:ident($($arg:ident: $type:ty),* $(,)?) $body:block) => {
        $(#[$meta])*
        #[allow(unsafe_code, clippy::too_many_arguments)] // called only after detection
        $vis fn $name(wide: $crate::fill::workers::Wide, $($arg: $type),*) {
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
pub(super) use wide;

/// Worker threads. A row's result does not depend on the thread or on the other rows.
#[derive(Debug)]
pub(super) struct Workers {
    pool: Option<rayon::ThreadPool>,
    pub(super) wide: Wide,
}

impl Workers {
    /// Starts `threads` threads; 0 and 1 use the caller's thread.
    pub(super) fn new(threads: usize) -> Result<Self, rayon::ThreadPoolBuildError> {
        let build = || {
            let name = |i| format!("fill-{i}");
            rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(name).build()
        };
        Ok(Self { pool: (threads > 1).then(build).transpose()?, wide: Wide::detect() })
    }

    /// Calls `work` with the number of every row of `width` elements and the row.
    pub(super) fn rows<T: Send>(&self, out: &mut [T], width: usize, work: impl Fn(usize, &mut [T]) + Sync) {
        match &self.pool {
            None => out.chunks_mut(width).enumerate().for_each(|(y, row)| work(y, row)),
            Some(pool) => pool.install(|| {
                let rows = out.par_chunks_mut(width).with_min_len(ROWS).enumerate();
                rows.for_each(|(y, row)| work(y, row));
            }),
        }
    }

    /// Like [`Self::rows`], for two images of one size at once.
    pub(super) fn rows2<A: Send, B: Send>(
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
    pub(super) fn rows3<A: Send, B: Send, C: Send>(
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
