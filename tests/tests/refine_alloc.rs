//! The threads of refined depth allocate nothing per frame once they run: pacing and pairing on that of the stage;
//! registration, refining, publishing and accounts on that of the refiner. iceoryx2 itself makes one small shared counter
//! for each slot that it lends, which is all that is allowed here.
//!
//! A test binary of its own, because its allocator counts.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]
#![allow(unsafe_code)] // an allocator is unsafe by its nature

use core::alloc::{GlobalAlloc, Layout};
use core::cell::Cell;
use depthrig_cdm::{Description, EngineKind, Job, Output, Precision, Refiner, Result};
use depthrig_daemon::config::RefineConfig;
use depthrig_daemon::stage::{Opened, Plan, Refiners};
use depthrig_tests::{Home, RigText, wait_until};
use std::alloc::System;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
    /// This is the stage's thread.
    static IS_STAGE: Cell<bool> = const { Cell::new(false) };
}

/// Allocations of the stage's thread since it began to be counted.
static OF_STAGE: AtomicU64 = AtomicU64::new(0);

struct Counting;

fn count() {
    // A thread that is being torn down has no counter any more.
    let _ = ALLOCATIONS.try_with(|n| n.set(n.get() + 1));
    if IS_STAGE.try_with(Cell::get) == Ok(true) {
        OF_STAGE.fetch_add(1, Ordering::Relaxed);
    }
}

// SAFETY: everything is handed to the system's allocator as it came.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, ptr: *mut u8, layout: Layout) {
        // SAFETY: likewise.
        unsafe { System.dealloc(ptr, layout) }
    }

    unsafe fn realloc(&self, ptr: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: likewise.
        unsafe { System.realloc(ptr, layout, size) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

/// Allocations so far of the refiner's thread and of the stage's, and how many pairs there were at once.
type Seen = (u64, u64, usize);

/// Notes how many allocations there have been whenever it is called.
struct Noting(Arc<Mutex<Vec<Seen>>>, Description);

impl Refiner for Noting {
    fn describe(&self) -> &Description {
        &self.1
    }

    fn best_batch(&self) -> usize {
        2
    }

    fn refine(&mut self, jobs: &mut [Job<'_>]) -> Result<()> {
        let pairs = jobs.len();
        for job in jobs {
            if let Output::Units { pixels, .. } = &mut job.out {
                pixels.copy_from_slice(job.depth.pixels);
            }
        }
        let so_far = (ALLOCATIONS.with(Cell::get), OF_STAGE.load(Ordering::Relaxed), pairs);
        let mut list = self.0.lock().unwrap();
        if list.len() < list.capacity() {
            list.push(so_far);
        }
        Ok(())
    }
}

struct Source(Arc<Mutex<Vec<Seen>>>);

impl Refiners for Source {
    fn plan(&self, config: &RefineConfig, _: &str) -> Plan {
        // It is the stage that asks.
        IS_STAGE.set(true);
        Plan {
            engine: EngineKind::Fill,
            model: None,
            input_size: None,
            precision: Precision::Fp32,
            device: config.device.clone(),
            may_fill: false,
            note: None,
        }
    }

    fn open(&self, _: &Plan, _: usize) -> Result<Opened> {
        let what = Description { engine: "noting".into(), model: String::new() };
        Ok(Opened { refiner: Box::new(Noting(Arc::clone(&self.0), what)), note: None })
    }
}

#[test]
fn nothing_is_allocated_per_frame() {
    let home = Home::default();
    let seen = Arc::new(Mutex::new(Vec::with_capacity(700)));
    let refine = "[camera.refine]\nrate_hz = 0\nalign = true";
    let text = RigText::default().camera("a", refine).camera("b", refine);
    let source = Arc::new(Source(Arc::clone(&seen)));
    let rig = home.start_with(text.text(), |o| o.refiners = Some(source)).unwrap();
    let frames = |s: &depthrig_daemon::status::RigStatus| -> u64 {
        s.cameras.iter().flat_map(|c| &c.streams).filter(|s| s.derived).map(|s| s.delivered).sum()
    };
    // Windows of statistics fill up at first: 256 frames of a stream.
    wait_until(&rig, "enough", |s| frames(s) > 4 * 330);
    rig.stop();
    let seen = seen.lock().unwrap();
    let last = &seen[seen.len() - 40..];
    assert!(last[0].0 > 0 && last[0].1 > 0, "nothing was counted: {last:?}");
    assert!(last.iter().any(|s| s.2 == 2), "no batch of two: {last:?}");
    for two in last.windows(2) {
        // Each pair takes two slots, one for aligned and one for refined depth, before it is refined.
        let slots = 2 * two[1].2 as u64;
        assert_eq!(two[1].0 - two[0].0, slots, "allocations beside those of slots: {last:?}");
        assert_eq!(two[1].1, two[0].1, "allocations on the stage's thread: {last:?}");
    }
}
