//! An allocator that counts allocations and bytes, for tests of code that must allocate nothing or a limited amount.
//!
//! It has no dependencies, so that tests of every layer can use it. A test binary of its own declares
//! `#[global_allocator] static COUNTING: depthrig_counting::Counting = depthrig_counting::Counting;`
#![allow(unsafe_code)] // a global allocator is unsafe to write

use core::cell::Cell;
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicU64, Ordering};

/// The system's allocator, which counts.
#[derive(Debug, Clone, Copy)]
pub struct Counting;

static ALL: AtomicU64 = AtomicU64::new(0);
static WATCHED: AtomicU64 = AtomicU64::new(0);
static LIVE: AtomicU64 = AtomicU64::new(0);
static PEAK: AtomicU64 = AtomicU64::new(0);

thread_local! {
    static OWN: Cell<u64> = const { Cell::new(0) };
    static IS_WATCHED: Cell<bool> = const { Cell::new(false) };
}

fn count() {
    ALL.fetch_add(1, Ordering::Relaxed);
    // A thread that is being destroyed has no counter any more.
    let _ = OWN.try_with(|n| n.set(n.get() + 1));
    if IS_WATCHED.try_with(Cell::get) == Ok(true) {
        WATCHED.fetch_add(1, Ordering::Relaxed);
    }
}

fn take(bytes: usize) {
    let live = LIVE.fetch_add(bytes as u64, Ordering::Relaxed) + bytes as u64;
    PEAK.fetch_max(live, Ordering::Relaxed);
}

fn give_back(bytes: usize) {
    LIVE.fetch_sub(bytes as u64, Ordering::Relaxed);
}

// SAFETY: everything is handed on to the system's allocator as it came.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        take(layout.size());
        // SAFETY: as the caller promises.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, ptr: *mut u8, layout: Layout) {
        give_back(layout.size());
        // SAFETY: as the caller promises; all memory comes from `System`.
        unsafe { System.dealloc(ptr, layout) }
    }

    unsafe fn realloc(&self, ptr: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        take(size);
        give_back(layout.size());
        // SAFETY: as the caller promises; all memory comes from `System`.
        unsafe { System.realloc(ptr, layout, size) }
    }
}

/// Peak bytes allocated in the process while `work` ran, beyond those allocated before.
pub fn peak_of<R>(work: impl FnOnce() -> R) -> (R, u64) {
    let before = LIVE.load(Ordering::Relaxed);
    PEAK.store(before, Ordering::Relaxed);
    let result = work();
    (result, PEAK.load(Ordering::Relaxed).saturating_sub(before))
}

/// Allocations of this thread so far.
pub fn of_thread() -> u64 {
    OWN.with(Cell::get)
}

/// Allocations of all threads of the process so far.
pub fn of_process() -> u64 {
    ALL.load(Ordering::Relaxed)
}

/// Adds this thread to those that [`of_watched`] counts.
pub fn watch_thread() {
    IS_WATCHED.set(true);
}

/// Allocations of the watched threads since they were added.
pub fn of_watched() -> u64 {
    WATCHED.load(Ordering::Relaxed)
}

/// Allocations of `work` on this thread.
pub fn during(work: impl FnOnce()) -> u64 {
    let before = of_thread();
    work();
    of_thread() - before
}

/// Allocations of the process while `work` runs.
pub fn in_process_during(work: impl FnOnce()) -> u64 {
    let before = of_process();
    work();
    of_process() - before
}

#[cfg(test)]
mod tests {
    use super::*;

    #[global_allocator]
    static COUNTING: Counting = Counting;

    /// One test alone: others would be counted too.
    #[test]
    fn what_is_taken_is_counted_where_it_is_taken() {
        let take = || drop(std::hint::black_box(Vec::<u8>::with_capacity(100)));
        assert_eq!((during(|| ()), during(take)), (0, 1));
        let grown = during(|| {
            let mut v = std::hint::black_box(vec![0_u8; 10]);
            v.reserve_exact(10_000);
        });
        assert_eq!(grown, 2, "what grows is taken anew");
        let own = of_thread();
        let watched = of_watched();
        let thread = std::thread::spawn(move || {
            take();
            watch_thread();
            let before = (of_thread(), of_watched());
            take();
            (of_thread() - before.0, of_watched() - before.1)
        });
        assert_eq!(thread.join().ok(), Some((1, 1)));
        assert!(of_watched() > watched && of_thread() - own < 100);
        assert!(in_process_during(|| std::thread::scope(|s| drop(s.spawn(take)))) > 0);
    }
}
