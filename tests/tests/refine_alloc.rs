//! The threads of refined depth allocate nothing per frame once they run: pacing and pairing on that of the stage;
//! registration, refining, publishing and accounts on that of the refiner. iceoryx2 itself makes one small shared counter
//! for each slot that it lends, which is all that is allowed here.
//!
//! A test binary of its own, because its allocator counts.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_cdm::stage::RefineConfig;
use depthrig_cdm::stage::{Opened, Plan, Refiners};
use depthrig_cdm::{Description, EngineKind, Job, Output, Precision, Refiner, Result};
use depthrig_counting::{Counting, of_thread, of_watched, watch_thread};
use depthrig_tests::{Home, RigText, wait_until};
use std::sync::{Arc, Mutex};

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
        let so_far = (of_thread(), of_watched(), pairs);
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
        watch_thread();
        Plan {
            engine: EngineKind::Fill,
            model: None,
            input_size: None,
            precision: Precision::Fp32,
            device: config.device.clone(),
            fill_reach: 1.0,
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
