//! Signals: every sample is in the dataset bit by bit, with the set that it came with.

use crate::support::*;
use crate::verify::found;
use depthrig_bus::{SignalFlags, SignalHeader, SignalSample};
use depthrig_recorder::fs::MemFs;
use depthrig_recorder::{CompareOptions, Dataset, PixelMode, RecordSet, RecordSignal, SetDrop, compare};
use std::sync::Arc;

/// Compares bit by bit: values may be NaN.
fn same(a: &SignalSample, b: &SignalSample) -> bool {
    let numbers = |s: &SignalSample| {
        let h = *s.header();
        (h.sequence, h.session, h.time_ns, h.publish_time_ns, h.uncertainty_ns, h.flags)
    };
    numbers(a) == numbers(b) && a.bytes() == b.bytes() && a.description() == b.description()
}

fn all_same(a: &[RecordSignal], b: &[RecordSignal]) -> bool {
    let part = |(a, b): (&RecordSignal, &RecordSignal)| {
        a.signal == b.signal
            && a.samples.len() == b.samples.len()
            && a.samples.iter().zip(&b.samples).all(|(a, b)| same(a, b))
    };
    a.len() == b.len() && a.iter().zip(b).all(part)
}

fn with_header(sample: &SignalSample, change: impl FnOnce(&mut SignalHeader)) -> SignalSample {
    let mut header = *sample.header();
    change(&mut header);
    SignalSample::new(header, sample.description(), sample.bytes().to_vec()).unwrap()
}

#[test]
fn every_sample_comes_back_with_its_set() {
    let fs = MemFs::new();
    assert!(record(&fs, 5, options()).complete);
    let sets = read_all(&fs);
    for (n, set) in sets.iter().enumerate() {
        let want = signals(&session(), n as u64);
        assert!(all_same(&set.signals, &want), "set {n}: {:?}\n{want:?}", set.signals);
    }
    let dataset = open(&fs);
    assert_eq!(dataset.session().signals, session().signals);
    let mut by_number = dataset.set_reader().unwrap();
    for (mode, n) in [(PixelMode::None, 3), (PixelMode::Decoded, 0), (PixelMode::Stored, 4)] {
        assert!(all_same(&by_number.read(n, mode).unwrap().signals, &sets[n].signals), "{mode:?}");
    }
    let counts: Vec<_> = dataset
        .info()
        .unwrap()
        .signals
        .into_iter()
        .map(|s| (s.signal, s.samples, s.lost, s.restarts))
        .collect();
    let of = |name: &str| (name.parse().unwrap(), 5 * SIGNAL_SAMPLES, 0, 0);
    assert_eq!(counts, [of("arm/joints"), of("arm/gripper")]);
    assert_eq!(found(&fs), Vec::<String>::new());
}

#[test]
fn a_signal_that_appears_begins_a_segment() {
    let late = |at: u64| {
        let fs = MemFs::new();
        let r = recorder(&fs, options());
        let mut session = session();
        for n in 0..4 {
            if n == at {
                session.signals.push(joints("hand/fingers"));
                assert_eq!(r.add_signal(joints("hand/fingers")).unwrap(), 2);
            }
            r.push(set(&session, n)).unwrap();
            settle(&r);
        }
        assert!(r.finish().unwrap().complete);
        for (n, read) in read_all(&fs).iter().enumerate() {
            assert!(all_same(
                &read.signals,
                &set(&session, n as u64).signals[..if (n as u64) < at { 2 } else { 3 }]
            ));
        }
        assert_eq!(found(&fs), Vec::<String>::new());
        names(&fs).iter().filter(|n| n.starts_with("seg_")).count()
    };
    // That before the first set has no set at all.
    assert_eq!((late(0), late(1), late(3)), (2, 2, 2));
}

#[test]
fn a_name_that_is_taken_is_refused() {
    let r = recorder(&MemFs::new(), options());
    for (id, why) in [("arm/joints", "arm/joints"), ("front/depth", "front/depth"), ("side/imu", "side/imu")]
    {
        let refused = r.add_signal(joints(id)).unwrap_err().to_string();
        assert!(refused.contains(why), "{refused}");
    }
}

#[test]
fn samples_that_contradict_the_session_are_refused() {
    type Break = fn(&mut Vec<RecordSignal>);
    let breaks: [(&str, Break); 4] = [
        ("signal number 2 is not in the session", |s| s[0].signal = 2),
        ("sample 6 of signal arm/joints", |s| {
            let again = s[0].samples[0].clone();
            s[0].samples.push(again);
        }),
        ("sample 1 of signal arm/gripper", |s| {
            s[1].samples[0] = with_header(&s[1].samples[0], |h| h.sequence = 1);
        }),
        ("signal arm/joints", |s| s[0].samples = s[1].samples.clone()),
    ];
    for (why, spoil) in breaks {
        let fs = MemFs::new();
        let r = recorder(&fs, options());
        r.push(set(&session(), 0)).unwrap();
        let mut bad = set(&session(), 1);
        spoil(&mut bad.signals);
        let refused = r.push(bad).unwrap_err();
        assert_eq!(refused.reason, SetDrop::BadSet);
        assert!(refused.message.contains(why), "{} is not {why}", refused.message);
        // A set that was refused leaves no trace: the same samples are taken when they are good.
        r.push(set(&session(), 1)).unwrap();
        let done = r.finish().unwrap();
        assert_eq!((done.sets.recorded, done.sets.dropped[SetDrop::BadSet as usize]), (2, 1), "{why}");
        assert!(all_same(&read_all(&fs)[1].signals, &signals(&session(), 1)));
    }
}

#[test]
fn gaps_and_other_publishers_are_stated() {
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    let session = session();
    for n in 0..4 {
        let mut set = set(&session, n);
        for part in &mut set.signals {
            if n == 1 {
                part.samples.remove(2);
            }
            if n == 3 {
                let later = |s: &SignalSample| {
                    with_header(s, |h| (h.session, h.sequence) = (78, h.sequence - 3 * SIGNAL_SAMPLES + 2))
                };
                part.samples = part.samples.iter().map(later).collect();
            }
        }
        r.push(set).unwrap();
    }
    assert!(r.finish().unwrap().complete);
    let period_s = PERIOD as f64 / 1e9 / SIGNAL_SAMPLES as f64;
    let want: Vec<_> = ["arm/gripper", "arm/joints"]
        .iter()
        .flat_map(|id| {
            [
                format!("3 samples of {id} were not recorded"),
                format!("{id} was published anew 1 times; it had no samples for {period_s:.3} s meanwhile"),
            ]
        })
        .collect();
    let mut notes = found(&fs);
    notes.sort();
    let mut want = want;
    want.sort();
    assert_eq!(notes, want);
}

/// A recording of `sets` with a replayed flag on every sample differs in passage alone.
#[test]
fn compare_finds_a_bit() {
    let changed = |change: fn(&mut RecordSet)| {
        let fs = MemFs::new();
        let r = recorder(&fs, options());
        for n in 0..3 {
            let mut set = set(&session(), n);
            if n == 1 {
                change(&mut set);
            }
            r.push(set).unwrap();
        }
        r.finish().unwrap();
        Dataset::open_with(Arc::new(fs), &dir()).unwrap()
    };
    let whole = changed(|_| ());
    let differ = |change, strict| {
        let options = CompareOptions { strict, ..CompareOptions::default() };
        let c = compare(&whole, &changed(change), &options).unwrap();
        (c.equal, c.signal_samples)
    };
    let all = 3 * 2 * SIGNAL_SAMPLES;
    assert_eq!(differ(|_| (), true), (true, all));
    let flag = |set: &mut RecordSet| {
        let replayed = |s: &SignalSample| with_header(s, |h| h.flags |= SignalFlags::REPLAYED.0);
        set.signals[0].samples = set.signals[0].samples.iter().map(replayed).collect();
    };
    assert!(differ(flag, false).0 && !differ(flag, true).0);
    let bit = |set: &mut RecordSet| {
        let s = &mut set.signals[0].samples[3];
        let mut bytes = s.bytes().to_vec();
        bytes[7] ^= 0x80;
        *s = SignalSample::new(*s.header(), s.description(), bytes).unwrap();
    };
    assert!(!differ(bit, false).0, "the sign of one value");
    assert!(!differ(|set| set.signals[1].samples.truncate(2), false).0, "samples are missing");
}
