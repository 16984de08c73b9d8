//! Rows of pictures on one thread or several, and the instructions that the processor has.

use rayon::prelude::*;

/// Rows that a thread takes at a time, so that handing them over costs nothing beside them.
const ROWS: usize = 8;

/// Proof that the processor was asked for its instructions.
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

    /// Without any but those that every processor has.
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
        #[allow(unsafe_code, clippy::too_many_arguments)] // a call after asking the processor
        $vis fn $name(wide: $crate::fill::lanes::Wide, $($arg: $type),*) {
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
                    // SAFETY: a `Wide` that says so is made only by asking the processor.
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

/// Who does the work. A row's result never depends on who does it, or beside which others.
#[derive(Debug)]
pub(super) struct Crew {
    pool: Option<rayon::ThreadPool>,
    pub(super) wide: Wide,
}

impl Crew {
    /// `threads` of them; 0 and 1 mean the caller's own.
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

    /// The same for two pictures of one size at once.
    pub(super) fn rows2<A: Send, B: Send>(
        &self,
        (a, b): (&mut [A], &mut [B]),
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

    /// The same for three.
    pub(super) fn rows3<A: Send, B: Send, C: Send>(
        &self,
        (a, b, c): (&mut [A], &mut [B], &mut [C]),
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
