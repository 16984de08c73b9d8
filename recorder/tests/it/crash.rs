//! The whole computer crashes, at any operation of a recording or of its recovery, on a disk that keeps an arbitrary
//! part of the unsynced data.

use crate::recover::{ids, recover};
use crate::support::*;
use depthrig_recorder::fs::{Fault, Fs, MemFs};
use depthrig_recorder::{ErrorKind, Recorder, RecorderOptions};
use proptest::prelude::*;
use std::io;
use std::sync::Arc;

/// Numbers that follow from a seed (xorshift64*, Vigna 2016).
struct Random(u64);

impl Random {
    fn below(&mut self, n: usize) -> usize {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 33) as usize % n.max(1)
    }
}

fn crash(fs: &MemFs, random: &mut Random) -> MemFs {
    fs.crash(&mut |n| random.below(n))
}

/// Records until operation `at` and those after it fail; each set with its segment and the length of that when
/// the set was in it.
fn record_until(fs: &MemFs, at: u64, sets: u64) -> Vec<(u64, u32, usize)> {
    let failing = fs.clone().with_fault(Fault::FailFrom(at, io::ErrorKind::Other));
    let limits = RecorderOptions {
        segment_max_ns: 2 * PERIOD,
        sync_interval_ns: 1_000_000,
        reserve_bytes: 1000,
        ..options()
    };
    let mut written = Vec::new();
    let Ok(r) = Recorder::create(Arc::new(failing), &dir(), session(), limits) else { return written };
    for n in 0..sets {
        if r.push(set(&session(), n)).is_err() {
            break;
        }
        settle(&r);
        let p = r.progress();
        if p.sets.recorded == n + 1 {
            let number = p.segments - 1;
            let part = segment(number).with_extension("mcap.part");
            let bytes = fs.contents(&part).or_else(|| fs.contents(&segment(number)));
            written.push((n + 1, number, bytes.map_or(usize::MAX, |b| b.len())));
        }
        // Now and then long enough for a sync.
        if n % 2 == 1 {
            std::thread::sleep(std::time::Duration::from_millis(2));
        }
    }
    drop(r.finish());
    written
}

/// The sets that no crash may lose now.
fn durable(fs: &MemFs, written: &[(u64, u32, usize)]) -> Vec<u64> {
    let synced = |number: u32| {
        let name = segment(number);
        fs.synced(&name).max(fs.synced(&name.with_extension("mcap.part")))
    };
    // A segment is closed, name and all, before a set is written into the next one.
    let last = written.last().map_or(0, |(_, number, _)| *number);
    let durable = |(_, number, end): &&(u64, u32, usize)| *number < last || synced(*number) >= *end;
    written.iter().filter(durable).map(|(id, ..)| *id).collect()
}

/// Recovers; all of `durable` must be there then, and a second time nothing is changed.
fn check(fs: &MemFs, durable: &[u64]) -> Result<(), TestCaseError> {
    match recover(fs) {
        Err(e) => {
            prop_assert!(e.kind() == ErrorKind::NotADataset || e.kind() == ErrorKind::NotFound, "{e}");
            prop_assert!(durable.is_empty(), "{e}, and {durable:?} were durable");
            return Ok(());
        }
        Ok(report) => {
            let left = ids(fs);
            prop_assert!(durable.iter().all(|id| left.contains(id)), "{left:?} of {durable:?}: {report:?}");
            prop_assert!(left.is_sorted() && report.sets == left.len() as u64, "{left:?}: {report:?}");
        }
    }
    let changes = fs.changes();
    let again = recover(fs).unwrap();
    prop_assert!(!again.changed && fs.changes() == changes, "{again:?}");
    Ok(())
}

fn cases() -> u32 {
    if std::env::var_os("DEPTHRIG_LONG").is_some() { 5000 } else { 150 }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(cases()))]
    #[test]
    fn what_was_synced_outlives_a_crash_of_the_computer(
        seed in 1u64..u64::MAX,
        at in 4u64..170,
        sets in 1u64..9,
        recovery in 0u64..160,
    ) {
        let fs = MemFs::new();
        fs.create_dir_all(dir().parent().unwrap()).unwrap();
        let written = record_until(&fs, at, sets);
        let mut random = Random(seed);
        let durable = durable(&fs, &written);
        let crashed = crash(&fs, &mut random);
        if crashed.read_dir(&dir()).is_err() {
            prop_assert!(durable.is_empty());
            return Ok(());
        }
        // Without another crash, and with one in the middle of the recovery.
        check(&copy(&crashed), &durable)?;
        let failing = copy(&crashed);
        drop(recover(&failing.clone().with_fault(Fault::FailFrom(recovery, io::ErrorKind::Other))));
        check(&crash(&failing, &mut random), &durable)?;
    }
}
