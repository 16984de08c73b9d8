//! Damage to each kind of record in each way, with stale and with corrected checksums: after `recover`, `verify` finds
//! no damage, and losses are stated; or the dataset is refused with a reason.

use crate::recover::{findings, ids, outcome, planned_and_recovered, recover};
use crate::support::*;
use depthrig_recorder::RecorderOptions;
use depthrig_recorder::fs::{Fs, MemFs};
use depthrig_recorder::fuzzing::mcap::File;

/// Sets of the dataset, and of each of its segments.
const SETS: u64 = 9;
const PER_SEGMENT: i64 = 3;

/// Opcodes as the MCAP specification numbers them.
const CHUNK: u8 = 6;

/// Records to damage: name, opcode, and which one of that opcode in the file.
const PARTS: [(&str, u8, usize); 22] = [
    ("header", 1, 0),
    ("schema of images", 3, 0),
    ("schema of camera_info", 3, 2),
    ("schema of frame_set", 3, 7),
    ("schema of checkpoints", 3, 10),
    ("channel of sets", 4, 0),
    ("channel of checkpoints", 4, 6),
    ("channel of images", 4, 7),
    ("channel of frame_info", 4, 9),
    ("channel of motion samples", 4, 17),
    ("session in the head", 12, 0),
    ("attachment", 9, 0),
    ("chunk of /tf_static", CHUNK, 0),
    ("first image", CHUNK, 1),
    ("first set", CHUNK, 4),
    ("second image of the second set", CHUNK, usize::MAX),
    ("message index", 7, 3),
    ("segment's metadata", 12, 1),
    ("data end", 15, 0),
    ("chunk index", 8, 2),
    ("statistics", 11, 0),
    ("footer", 2, 0),
];

#[derive(Debug, Clone, Copy)]
enum Damage {
    FlipFront,
    FlipMiddle,
    FlipEnd,
    Shorten,
    Zero,
    Duplicate,
    Swap,
    Remove,
}

const DAMAGES: [Damage; 8] = [
    Damage::FlipFront,
    Damage::FlipMiddle,
    Damage::FlipEnd,
    Damage::Shorten,
    Damage::Zero,
    Damage::Duplicate,
    Damage::Swap,
    Damage::Remove,
];

fn apply(file: &mut File, at: usize, damage: Damage) {
    let next = (at + 1) % file.records.len();
    let body = &mut file.records[at].1;
    let len = body.len();
    match damage {
        Damage::FlipFront => body[0] ^= 0x02,
        Damage::FlipMiddle => body[len / 2] ^= 0x04,
        Damage::FlipEnd => body[len - 1] ^= 0x10,
        Damage::Shorten => body.truncate(len / 2),
        Damage::Zero => body.fill(0),
        Damage::Duplicate => {
            let twin = file.records[at].clone();
            file.records.insert(next, twin);
        }
        Damage::Swap => file.records.swap(at, next),
        Damage::Remove => drop(file.records.remove(at)),
    }
}

/// A dataset of three segments with an account and a checkpoint after nearly each set.
fn recorded() -> MemFs {
    let fs = MemFs::new();
    let limits = RecorderOptions { segment_max_ns: PER_SEGMENT * PERIOD, sync_interval_ns: 1, ..options() };
    let r = recorder(&fs, limits);
    for k in 0..SETS {
        r.push(set(&session(), k)).unwrap();
        accounted(&r);
    }
    assert!(r.finish().unwrap().complete);
    fs
}

/// How a case ended.
#[derive(Debug, PartialEq, Eq)]
enum Ended {
    Complete,
    Refused,
}

/// Recovers and checks the guarantees of a recovery.
fn check(case: &str, fs: &MemFs) -> Ended {
    let report = match planned_and_recovered(fs) {
        Ok(report) => report,
        Err(e) => {
            let reason = e.to_string();
            assert!(reason.len() > 40, "{case}: {reason}");
            assert!(!names(fs).iter().any(|n| n.contains("recovering")), "{case}: {:?}", names(fs));
            return Ended::Refused;
        }
    };
    assert_eq!(findings(fs), [""; 0], "{case}: {:?}", report.lost);
    let left = ids(fs);
    let o = outcome(fs);
    assert_eq!((o.sets_recorded, report.sets), (left.len() as u64, left.len() as u64), "{case}: {o:?}");
    if (left.len() as u64) < SETS {
        assert!(!report.lost.is_empty() && !o.complete, "{case}: {report:?}");
        let stated: u64 = report.segments.iter().map(|s| s.sets_lost).sum();
        let worded = report.lost.iter().any(|l| l.contains("are in no segment"));
        assert!(stated >= SETS - left.len() as u64 || worded, "{case}: {report:?}");
    }
    let again = recover(fs).unwrap_or_else(|e| panic!("{case}, again: {e}"));
    assert!(!again.changed, "{case}, again: {again:?}");
    Ended::Complete
}

#[test]
fn whatever_record_is_damaged_the_dataset_is_complete_again_or_refused() {
    let whole = recorded();
    let mut cases = 0;
    let mut refused = Vec::new();
    let mut lossless = 0;
    for number in [0, 2] {
        let bytes = contents(&whole, &segment(number));
        let file = File::parse(&bytes).unwrap();
        for (part, opcode, nth) in PARTS {
            let places: Vec<_> = (0..file.records.len()).filter(|i| file.records[*i].0 == opcode).collect();
            let nth = if nth == usize::MAX { places.len() - 4 } else { nth };
            let at = places[nth];
            for damage in DAMAGES {
                for forged in [false, true] {
                    let mut damaged = file.clone();
                    apply(&mut damaged, at, damage);
                    if forged && damaged.records.len() == file.records.len() {
                        damaged = damaged.with_lengths_of(&file);
                    } else if forged {
                        damaged.mend_checksums();
                    }
                    let case = format!("segment {number}, {part}, {damage:?}, forged {forged}");
                    let fs = copy(&whole);
                    fs.put(&segment(number), damaged.to_bytes());
                    match check(&case, &fs) {
                        Ended::Refused => refused.push(case),
                        Ended::Complete => lossless += usize::from(ids(&fs).len() as u64 == SETS),
                    }
                    cases += 1;
                }
            }
        }
    }
    println!("{cases} cases, {} refused: {refused:#?}, {lossless} without a loss", refused.len());
    // Most damage is to data that is stored twice or can be rebuilt; how much depends on where the accounts fall.
    assert!(cases >= 352 && refused.is_empty() && lossless * 100 > cases * 80);
}

#[test]
fn a_segment_that_is_empty_or_gone_is_a_stated_loss() {
    let whole = recorded();
    for number in 0..3 {
        for gone in [false, true] {
            let fs = copy(&whole);
            fs.remove_file(&segment(number)).unwrap();
            if !gone {
                fs.put(&segment(number), Vec::new());
            }
            let case = format!("segment {number}, gone {gone}");
            assert_eq!(check(&case, &fs), Ended::Complete, "{case}");
            let o = outcome(&fs);
            assert_eq!((o.sets_offered, o.sets_recorded), (SETS, SETS - PER_SEGMENT as u64), "{case}: {o:?}");
            assert_eq!(o.sets_dropped["lost_in_crash"], PER_SEGMENT as u64, "{case}");
        }
    }
    // The only one, as the session alone knows that it held something.
    let fs = MemFs::new();
    record(&fs, 4, options());
    fs.put(&segment(0), Vec::new());
    let report = planned_and_recovered(&fs).unwrap();
    assert_eq!((report.sets, report.segments[0].sets_lost), (0, 4), "{report:?}");
    assert_eq!(findings(&fs), [""; 0]);
}

#[test]
fn whatever_is_damaged_in_the_session_the_dataset_is_complete_again_or_refused() {
    let whole = recorded();
    let path = dir().join("session.toml");
    let text = contents(&whole, &path);
    let mut refused = 0;
    let mut cases = 0;
    let mut run = |case: String, bytes: Vec<u8>| {
        let fs = copy(&whole);
        fs.put(&path, bytes);
        cases += 1;
        if check(&case, &fs) == Ended::Refused {
            refused += 1;
        } else {
            assert_eq!(ids(&fs).len() as u64, SETS, "{case}");
        }
    };
    for at in (0..text.len()).step_by(11) {
        let mut flipped = text.clone();
        flipped[at] ^= 1 << (at % 7);
        run(
            format!(
                "byte {at}: {:?}",
                String::from_utf8_lossy(&flipped[at.saturating_sub(20)..(at + 20).min(text.len())])
            ),
            flipped,
        );
    }
    for (a, b) in [
        ("sets_recorded = 9", "sets_recorded = 20"),
        ("sets_recorded = 9", "sets_recorded = 3"),
        ("front/color", "front/colour"),
        ("depth_unit_m = 0.0001", "depth_unit_m = 0.0"),
        ("rig = \"rig\"", "rig = \"other\""),
    ] {
        let changed = String::from_utf8(text.clone()).unwrap().replace(a, b);
        assert_ne!(changed.as_bytes(), text, "{a}");
        run(format!("{a} to {b}"), changed.into_bytes());
    }
    for cut in [0, 1, text.len() / 2, text.len() - 1] {
        run(format!("cut at {cut}"), text[..cut].to_vec());
    }
    println!("{cases} cases, {refused} refused");
    assert!(refused * 20 < cases, "{refused} of {cases} refused");
}
