//! The thread that refines depth allocates nothing per frame once it runs: registration, refining, publishing, accounts.
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
use std::sync::{Arc, Mutex};

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

struct Counting;

// SAFETY: everything is handed to the system's allocator as it came.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // A thread that is being torn down has no counter any more.
        let _ = ALLOCATIONS.try_with(|n| n.set(n.get() + 1));
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, ptr: *mut u8, layout: Layout) {
        // SAFETY: likewise.
        unsafe { System.dealloc(ptr, layout) }
    }

    unsafe fn realloc(&self, ptr: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        let _ = ALLOCATIONS.try_with(|n| n.set(n.get() + 1));
        // SAFETY: likewise.
        unsafe { System.realloc(ptr, layout, size) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

/// Notes how many allocations its thread has made whenever it is called.
struct Noting(Arc<Mutex<Vec<u64>>>, Description);

impl Refiner for Noting {
    fn describe(&self) -> &Description {
        &self.1
    }

    fn best_batch(&self) -> usize {
        2
    }

    fn refine(&mut self, jobs: &mut [Job<'_>]) -> Result<()> {
        for job in jobs {
            if let Output::Units { pixels, .. } = &mut job.out {
                pixels.copy_from_slice(job.depth.pixels);
            }
        }
        let so_far = ALLOCATIONS.with(Cell::get);
        let mut list = self.0.lock().unwrap();
        if list.len() < list.capacity() {
            list.push(so_far);
        }
        Ok(())
    }
}

struct Source(Arc<Mutex<Vec<u64>>>);

impl Refiners for Source {
    fn plan(&self, config: &RefineConfig, _: &str) -> Plan {
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
    assert_eq!(last.first(), last.last(), "allocations per frame: {last:?}");
}
