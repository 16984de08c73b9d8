//! State in an export against the truth: the simulated arm's joints, published at random rates with random gaps, at random times of sets.

use crate::support::*;
use core::ops::{ControlFlow, Range};
use depthrig_bus::{HostTime, SignalDescription, SignalHeader, SignalName, SignalSample};
use depthrig_convert::{ExportOptions, Gaps, RowOptions, VectorOptions, Zarr, export};
use depthrig_recorder::fs::MemFs;
use depthrig_recorder::{RecordSignal, Recorder, Session, SignalRecord};
use depthrig_sim::synthetic::arm::{Arm, JOINTS};
use proptest::prelude::*;
use std::path::Path;
use std::sync::Arc;

/// The arm goes from end to end in so long, and turns there: its joints have a kink.
const WAY_NS: i64 = 11_000_000_000 / 6;
/// The truth is computed in 32-bit floats, as the export is.
const ROUNDING: f64 = 3e-6;

fn joints_at(ns: i64) -> [f64; 4] {
    Arm::at(HostTime::from_ns(ns)).joints_rad
}

/// The largest second derivative of each joint within `span`, which the arm passes without a turn, rad/s².
fn curvature(span: &Range<i64>) -> [f64; 4] {
    // Wide enough for 32-bit floats: the joints change slowly.
    let step_ns = 20_000_000;
    let [first, last] = [span.start, span.end].map(|t| t / WAY_NS * WAY_NS);
    let mut most = [0.0_f64; 4];
    for i in 0..=50 {
        let middle = span.start + (span.end - span.start) * i / 50;
        let middle = middle.clamp(first + step_ns, last + WAY_NS - step_ns);
        let around = [middle - step_ns, middle, middle + step_ns].map(joints_at);
        for (joint, most) in most.iter_mut().enumerate() {
            let [a, b, c] = around.map(|joints| joints[joint]);
            let step_s = step_ns as f64 / 1e9;
            *most = most.max((a - 2.0 * b + c).abs() / (step_s * step_s));
        }
    }
    most
}

fn sample(record: &SignalRecord, number: usize, ns: i64) -> SignalSample {
    let header = SignalHeader {
        sequence: number as u64 + 1,
        session: 77,
        time_ns: ns,
        publish_time_ns: ns,
        description_hash: record.description.hash(),
        ..SignalHeader::default()
    };
    let bytes = joints_at(ns).iter().flat_map(|x| x.to_le_bytes()).collect();
    SignalSample::new(header, &record.description, bytes).unwrap()
}

fn session_of(record: &SignalRecord) -> Session {
    let mut session = session();
    session.streams.truncate(1);
    session.motion.clear();
    session.signals = vec![record.clone()];
    session
}

/// Records sets at `ticks`, with the samples at `samples`, each with the first set that is later.
fn recorded(record: &SignalRecord, ticks: &[i64], samples: &[i64]) -> MemFs {
    let fs = MemFs::new();
    let session = session_of(record);
    let r = Recorder::create(Arc::new(fs.clone()), &dir(), session.clone(), options()).unwrap();
    let mut from = 0;
    for (n, tick) in ticks.iter().enumerate() {
        let mut bare = session.clone();
        bare.signals.clear();
        let mut set = set(&bare, n as u64);
        set.tick = HostTime::from_ns(*tick);
        set.frames[0].header.capture_time_ns = *tick;
        let until = if n + 1 == ticks.len() { samples.len() } else { samples.partition_point(|t| t <= tick) };
        let numbered = samples[from..until].iter().enumerate();
        let samples: Vec<_> = numbered.map(|(i, t)| sample(record, from + i, *t)).collect();
        from = until;
        set.signals = if samples.is_empty() { Vec::new() } else { vec![RecordSignal { signal: 0, samples }] };
        r.push(set).unwrap();
        settle(&r);
    }
    assert!(r.finish().unwrap().complete);
    fs
}

/// A chunk of the exported array `name`.
fn chunk(fs: &MemFs, name: &str) -> Vec<u8> {
    let packed = contents(fs, Path::new(&format!("/export/data/{name}")));
    zstd::bulk::decompress(&packed, 1 << 20).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]
    #[test]
    fn state_is_the_truth_within_the_stated_bound(
        period_ns in 2_000_000_i64..120_000_000,
        phase_ns in 0_i64..4_000_000_000,
        lost in proptest::collection::vec(any::<prop::sample::Index>(), 0..12),
        steps in proptest::collection::vec(1_000_000_i64..300_000_000, 2..25),
        max_gap_ns in 20_000_000_u64..400_000_000,
    ) {
        let ticks: Vec<_> = steps.iter().scan(M0 + phase_ns, |t, step| { *t += step; Some(*t) }).collect();
        let span = ticks[ticks.len() - 1] - ticks[0];
        let count = (span / period_ns + 2) as usize;
        // Sets at either end may lie outside of the samples.
        let mut samples: Vec<_> = (0..count).map(|i| ticks[0] - period_ns / 3 + i as i64 * period_ns).collect();
        for lost in &lost {
            if samples.len() > 2 {
                samples.remove(lost.index(samples.len()));
            }
        }
        let name = SignalName::new("arm", "joint_position").unwrap();
        let record = SignalRecord::new(&Arc::new(SignalDescription::joints(name, &JOINTS, "rad").unwrap()));
        let fs = recorded(&record, &ticks, &samples);
        let signals = VectorOptions { max_gap_ns, gaps: Gaps::Mask, ..VectorOptions::default() };
        let mut zarr = Zarr::new(RowOptions { fps: Some(5.0), signals, ..RowOptions::default() });
        let on = &mut |_| ControlFlow::Continue(());
        let out = Path::new("/export");
        if export(&fs, &mut zarr, vec![open(&fs)], out, ExportOptions { workers: 1 }, on).is_err() {
            // All sets are left out as ends without a value.
            return Ok(());
        }
        let values = chunk(&fs, "state/0.0");
        let values: Vec<_> = values.as_chunks().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect();
        let missing = chunk(&fs, "missing_state/0");
        let times: Vec<_> = chunk(&fs, "utc_ns/0").as_chunks().0.iter().map(|b| i64::from_le_bytes(*b) - T0 + M0).collect();
        for time in &ticks {
            let after = samples.partition_point(|t| t < time);
            let exact = samples.get(after) == Some(time);
            let before = if exact { Some(after) } else { after.checked_sub(1) };
            let around = before.and_then(|b| Some(samples[b]..*samples.get(after)?));
            let gap = around.filter(|span| (span.end - span.start) as u64 <= max_gap_ns);
            let Ok(row) = times.binary_search(time) else {
                prop_assert!(gap.is_none(), "{} is left out", time);
                continue;
            };
            prop_assert_eq!(missing[row] != 0, gap.is_none(), "row {} at {}", row, time);
            let Some(span) = gap else { continue };
            if span.start / WAY_NS != span.end / WAY_NS {
                continue;
            }
            let gap_s = (span.end - span.start) as f64 / 1e9;
            let most = curvature(&span);
            for (joint, truth) in joints_at(*time).into_iter().enumerate() {
                let error = (values[4 * row + joint] - truth).abs();
                let bound = gap_s * gap_s / 8.0 * most[joint] * 1.02 + ROUNDING;
                prop_assert!(error <= bound, "joint {} at {}: {} > {}, gap {} s", joint, time, error, bound, gap_s);
            }
        }
    }
}
