//! The forward and backward pass of an image: memory, threads, and the choice of the vectors.
//!
//! Rows are given to the threads in turn. A row may go on as far as the row before it has come, less one pixel; so every
//! number of threads computes the same, and no row is computed twice.
#![allow(unsafe_code)] // loops for one processor, and rows that follow each other on several threads
#![allow(clippy::inline_always)] // what is not inlined is compiled for the oldest processor

use super::kernel::{self, Carry, PLANES, Row, Winner};
use super::lanes::{Lanes, Plain};
use super::planes::{Padded, Penalties, mirror, together};
use super::volume::Aligned;
use crate::stereo::{Gray, StereoPair};
use core::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use rayon::prelude::*;

/// Steps after which a row reports its progress.
const CHUNK: usize = 64;

/// Which vectors a matcher uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Form {
    /// Those of every processor.
    Plain,
    /// Those of AVX2.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// Those of AVX-512 with VBMI and BITALG.
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl Form {
    /// The widest that the processor has.
    pub fn best() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            use std::arch::is_x86_feature_detected as has;
            if has!("avx512f")
                && has!("avx512bw")
                && has!("avx512vl")
                && has!("avx512vbmi")
                && has!("avx512bitalg")
            {
                return Self::Avx512;
            }
            if has!("avx2") {
                return Self::Avx2;
            }
        }
        Self::Plain
    }

    /// Its name.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Plain => "plain",
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => "avx2",
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => "avx512",
        }
    }

    const fn lanes(self) -> usize {
        match self {
            Self::Plain => Plain::LANES,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => 32,
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => 64,
        }
    }
}

/// Parameters of a pass.
#[derive(Debug, Clone, Copy)]
pub struct Costs {
    /// Number of disparities, 1 to 256.
    pub disparities: usize,
    /// Penalty of a step of one disparity.
    pub small: u8,
    /// Penalties of larger steps.
    pub large: Penalties,
}

/// Buffers of both passes, for images of one size.
#[derive(Debug)]
pub struct Passes {
    form: Form,
    costs: Costs,
    width: usize,
    height: usize,
    vectors: usize,
    phases: usize,
    reach: usize,
    ring: usize,
    padded: [Padded; 2],
    left: Vec<u8>,
    right: Vec<u8>,
    cells: Aligned,
    sums: Aligned,
    lanes: Vec<u8>,
    winners: Vec<Winner>,
    mirrored: Vec<u8>,
    bands: Vec<Band>,
    done: Vec<AtomicUsize>,
}

/// Buffers of one thread.
#[derive(Debug)]
struct Band {
    planes: Vec<u8>,
    penalties: Vec<u8>,
}

/// Memory that the rows of a pass write. Rows write their own part; of what they share, [`Order`] keeps them apart.
struct Targets {
    cells: *mut u8,
    sums: *mut u8,
    winners: *mut Winner,
    mirrored: *mut u8,
}
// SAFETY: the pointers are to memory that `Passes::run` borrows mutably for as long as the threads run. Of the sums, winners and
// mirrored each row writes its own part, and a row is one thread's; of the cells `Order::wait` lets a row have only what the
// row before it has left for good.
unsafe impl Sync for Targets {}

/// Dropped by a thread that does not come to its end, so that the others do not wait for it.
struct Unfinished<'a>(&'a AtomicBool);

impl Drop for Unfinished<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

impl Passes {
    pub fn new(form: Form, (width, height): (usize, usize), costs: Costs, threads: usize) -> Self {
        let lanes = form.lanes();
        // Counts of vectors for which there is a loop.
        let needed = costs.disparities.div_ceil(lanes);
        let vectors = [1, 2, 3, 4, 6, 8].into_iter().find(|n| *n >= needed).unwrap_or(8);
        let reach = width / vectors + lanes + 2;
        let cell = vectors * lanes;
        let phases = 2 * vectors - 1;
        let ring = width + threads;
        let place = |at: usize| at / lanes + (at % lanes) * vectors;
        let number = (0..cell).map(|at| place(at) as u8);
        let beyond = (0..cell).map(|at| if place(at) < costs.disparities { 0 } else { u8::MAX });
        let band = || Band { planes: vec![0; PLANES * width], penalties: vec![0; PLANES * width] };
        Self {
            form,
            costs,
            width,
            height,
            vectors,
            phases,
            reach,
            ring,
            padded: [Padded::new(width, height), Padded::new(width, height)],
            left: vec![0; PLANES * width * height],
            right: vec![0; PLANES * phases * reach * height],
            cells: Aligned::new(3 * ring * cell),
            sums: Aligned::new(width * height * cell),
            lanes: number.chain(beyond).collect(),
            winners: vec![Winner::default(); width * height],
            mirrored: vec![0; width * height],
            bands: (0..threads).map(|_| band()).collect(),
            done: (0..height).map(|_| AtomicUsize::new(0)).collect(),
        }
    }

    /// Number of disparities.
    pub const fn disparities(&self) -> usize {
        self.costs.disparities
    }

    /// Bytes that it keeps.
    pub fn bytes(&self) -> usize {
        let bands = self.bands.len() * self.width * 2 * PLANES;
        let found = self.winners.len() * size_of::<Winner>() + self.mirrored.len();
        let rings = self.cells.bytes();
        let images =
            self.padded.iter().map(Padded::bytes).sum::<usize>() + self.left.len() + self.right.len();
        self.sums.bytes()
            + rings
            + images
            + bands
            + found
            + self.lanes.len()
            + self.done.len() * size_of::<AtomicUsize>()
    }

    /// Computes both passes: for each pixel the best disparity of the left view, and that of the right view.
    pub fn run(&mut self, pair: &StereoPair<'_>, pool: Option<&rayon::ThreadPool>) -> (&[Winner], &[u8]) {
        self.look(&pair.left, &pair.right, pool);
        for back in [false, true] {
            self.cells.zero();
            for d in &self.done {
                d.store(0, Ordering::Relaxed);
            }
            let mut bands = core::mem::take(&mut self.bands);
            let count = bands.len();
            let to = Targets {
                cells: self.cells.as_mut_ptr(),
                sums: self.sums.as_mut_ptr(),
                winners: self.winners.as_mut_ptr(),
                mirrored: self.mirrored.as_mut_ptr(),
            };
            let failed = AtomicBool::new(false);
            let this = &*self;
            let work = |(t, band): (usize, &mut Band)| {
                let unfinished = Unfinished(&failed);
                for r in (t..this.height).step_by(count) {
                    this.row(r, back, band, &to, &failed);
                }
                core::mem::forget(unfinished);
            };
            match pool {
                // As many jobs as the pool has threads, which wait for each other.
                Some(pool) => pool.install(|| {
                    bands.par_iter_mut().enumerate().with_max_len(1).for_each(work);
                }),
                None => bands.iter_mut().enumerate().for_each(work),
            }
            self.bands = bands;
        }
        (&self.winners, &self.mirrored)
    }

    /// Prepares the images.
    fn look(&mut self, left: &Gray<'_>, right: &Gray<'_>, pool: Option<&rayon::ThreadPool>) {
        self.padded[0].fill(left);
        self.padded[1].fill(right);
        let [left, right] = &self.padded;
        let w = self.width;
        let vectors = self.vectors;
        let reach = self.reach;
        let part = (PLANES * w, PLANES * self.phases * reach);
        let bands = self.bands.len();
        let rows = self.height.div_ceil(bands);
        let work = |i: usize, (l, r, band): (&mut [u8], &mut [u8], &mut Band)| {
            for (y, (l, r)) in l.chunks_exact_mut(part.0).zip(r.chunks_exact_mut(part.1)).enumerate() {
                left.planes(i * rows + y, &mut band.planes);
                together(&band.planes, w, l);
                right.planes(i * rows + y, &mut band.planes);
                mirror(&band.planes, w, vectors, reach, r);
            }
        };
        match pool {
            Some(pool) => pool.install(|| {
                let l = self.left.par_chunks_mut(part.0 * rows);
                let r = self.right.par_chunks_mut(part.1 * rows);
                let all = l.zip(r).zip(&mut self.bands).enumerate();
                all.for_each(|(i, ((l, r), band))| work(i, (l, r, band)));
            }),
            None => work(0, (&mut self.left, &mut self.right, &mut self.bands[0])),
        }
    }

    /// Row `r` of a pass, as far as the row before it lets it go.
    fn row(&self, r: usize, back: bool, band: &mut Band, to: &Targets, failed: &AtomicBool) {
        let w = self.width;
        let cell = self.vectors * self.form.lanes();
        let ring = self.ring;
        let y = if back { self.height - 1 - r } else { r };
        self.costs.large.row(&self.padded[0], y, back, &mut band.planes);
        together(&band.planes, w, &mut band.penalties);
        let base = [(ring - r % ring) % ring, 0, r % ring];
        let right = &self.right[PLANES * self.phases * self.reach * y..];
        // SAFETY: three rings of `ring * cell` bytes are what `cells` has, so `(base + s) % ring * cell` begins a cell of one. The
        // offsets of row `y < height` are inside `left`, `sums`, `winners` and `mirrored`, which have `height` rows; `right` was
        // cut at row `y` by a slice, and has PLANES planes of `phases * reach` from there. `penalties` has PLANES bytes a
        // pixel, and `lanes` two cells. Nobody else writes the row's part (see `Targets`).
        unsafe {
            let rings = [0, 1, 2].map(|p| to.cells.add(p * ring * cell));
            // Paths that begin here: the one that comes from the side behind at the first step, and the one that comes
            // from the side ahead at the last. No row in work has these cells: a ring has as many more than a row as
            // there are threads.
            for (p, s) in [(0, 0), (2, w - 1)] {
                rings[p].add((base[p] + s) % ring * cell).write_bytes(0, cell);
            }
            let row = Row {
                width: w,
                left: self.left.as_ptr().add(PLANES * w * y),
                large: band.penalties.as_ptr(),
                right: [0, 1, 2, 3].map(|p| right.as_ptr().add(p * self.phases * self.reach)),
                reach: self.reach,
                small: self.costs.small,
                sums: to.sums.add(w * y * cell),
                lanes: self.lanes.as_ptr(),
                full: self.costs.disparities == cell,
                winners: to.winners.add(w * y),
                mirrored: to.mirrored.add(w * y),
            };
            let chunk = if self.bands.len() > 1 { CHUNK } else { w };
            let order = Order { done: &self.done, r, width: w, chunk, rings, base, ring, failed };
            self.dispatch(&row, back, &order);
        }
    }

    /// The loop for the form and the number of vectors.
    ///
    /// # Safety
    /// As [`kernel::run`], for every step of the row.
    unsafe fn dispatch(&self, row: &Row, back: bool, order: &Order<'_>) {
        // SAFETY: `Form::best` said that the processor has the form, to `SgmMatcher::new` or to the test that chose it; the
        // row reaches as `row` above argues. The number of vectors is one that `Passes::new` took, so a cell is N LANES.
        unsafe {
            match self.form {
                Form::Plain => match self.vectors {
                    1 => plain::<1>(row, back, order),
                    2 => plain::<2>(row, back, order),
                    3 => plain::<3>(row, back, order),
                    4 => plain::<4>(row, back, order),
                    6 => plain::<6>(row, back, order),
                    _ => plain::<8>(row, back, order),
                },
                #[cfg(target_arch = "x86_64")]
                Form::Avx2 => match self.vectors {
                    1 => avx2::<1>(row, back, order),
                    2 => avx2::<2>(row, back, order),
                    3 => avx2::<3>(row, back, order),
                    4 => avx2::<4>(row, back, order),
                    6 => avx2::<6>(row, back, order),
                    _ => avx2::<8>(row, back, order),
                },
                #[cfg(target_arch = "x86_64")]
                Form::Avx512 => match self.vectors {
                    1 => avx512::<1>(row, back, order),
                    2 => avx512::<2>(row, back, order),
                    3 => avx512::<3>(row, back, order),
                    _ => avx512::<4>(row, back, order),
                },
            }
        }
    }
}

/// How far the rows of a pass are.
struct Order<'a> {
    done: &'a [AtomicUsize],
    r: usize,
    width: usize,
    chunk: usize,
    /// Where the rings of cells begin.
    rings: [*mut u8; 3],
    /// Place of step 0 in each ring.
    base: [usize; 3],
    /// Cells of a ring.
    ring: usize,
    failed: &'a AtomicBool,
}

impl Order<'_> {
    /// Where cell 0 of each ring would lie for step `s` to lie where it does, and the first step after `s` for which it
    /// lies elsewhere: a ring ends and goes on at its beginning.
    fn cells(&self, s: usize, cell: usize) -> ([*mut u8; 3], usize) {
        let mut end = self.width;
        let cells = [0, 1, 2].map(|p| {
            let ring = self.ring;
            let base = self.base[p];
            let around = base + s >= ring;
            if !around {
                end = end.min(ring - base);
            }
            let first = self.rings[p].wrapping_add(base * cell);
            if around { first.wrapping_sub(ring * cell) } else { first }
        });
        (cells, end)
    }

    /// Waits until the row before has passed what step `end - 1` needs of it.
    #[inline(always)]
    fn wait(&self, end: usize) {
        let Some(before) = self.r.checked_sub(1) else { return };
        let need = (end + 1).min(self.width);
        let mut turns = 0_u32;
        while self.done[before].load(Ordering::Acquire) < need && !self.failed.load(Ordering::Relaxed) {
            turns += 1;
            if turns < 200 {
                core::hint::spin_loop();
            } else {
                std::thread::yield_now();
            }
        }
    }
}

#[inline(always)]
unsafe fn steps<S: Lanes, const N: usize>(row: &Row, back: bool, order: &Order<'_>) {
    // SAFETY: processor and row by the caller. `s..until` is below the width, and `Order::cells` gives cells that lie in their
    // rings for all of it; `wait` has seen the row before go beyond them.
    unsafe {
        let mut carry = Carry::<S, N>::new();
        let mut start = 0;
        while start < order.width {
            let end = (start + order.chunk).min(order.width);
            order.wait(end);
            let mut s = start;
            while s < end {
                let (cells, until) = order.cells(s, N * S::LANES);
                let until = until.min(end);
                if back {
                    kernel::run::<S, N, true>(row, &mut carry, cells, s..until);
                } else {
                    kernel::run::<S, N, false>(row, &mut carry, cells, s..until);
                }
                s = until;
            }
            if end == order.width && !back {
                S::fence();
            }
            order.done[order.r].store(end, Ordering::Release);
            start = end;
        }
    }
}

unsafe fn plain<const N: usize>(row: &Row, back: bool, order: &Order<'_>) {
    // SAFETY: every processor has this form; the row by the caller.
    unsafe { steps::<Plain, N>(row, back, order) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
unsafe fn avx2<const N: usize>(row: &Row, back: bool, order: &Order<'_>) {
    // SAFETY: AVX2 and the row by the caller.
    unsafe { steps::<super::avx2::Avx2, N>(row, back, order) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,avx512f,avx512bw,avx512vl,avx512vbmi,avx512bitalg")]
unsafe fn avx512<const N: usize>(row: &Row, back: bool, order: &Order<'_>) {
    // SAFETY: the features above and the row by the caller.
    unsafe { steps::<super::avx512::Avx512, N>(row, back, order) }
}
