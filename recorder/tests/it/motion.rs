//! IMUs: what they send is in the dataset bit by bit, with the set that it came with. Long because every way
//! through a dataset has motion.

use crate::support::*;
use crate::verify::{check, found, rewrite};
use depthrig_bus::{FrameFlags, FrameHeader, HostTime, MotionSample, PixelFormat};
use depthrig_recorder::fs::MemFs;
use depthrig_recorder::{
    CompareOptions, Dataset, ErrorKind, FrameChoice, MotionRecord, MotionRow, PixelMode, RecordMotion,
    RecordSet, Recorder, SET_MOTION_MAX_BYTES, SampleForm, SampleRow, Session, SetChoice, SetDrop, SetRange,
    Severity, SliceOptions, VerifyOptions, compare, export_samples, list_frames, list_samples, merge,
};
use std::ops::ControlFlow;
use std::sync::Arc;

/// Compares bit by bit: samples have NaN fields.
fn same(a: &RecordMotion, b: &RecordMotion) -> bool {
    let bytes = |m: &RecordMotion| m.samples.iter().flat_map(MotionSample::to_bytes).collect::<Vec<_>>();
    let clean = |h: &FrameHeader| FrameHeader { temperature_c: 0.0, ..*h };
    a.unit == b.unit && clean(&a.header) == clean(&b.header) && bytes(a) == bytes(b)
}

/// The batches of a set as they are read back.
fn with_id(batches: Vec<RecordMotion>, set_id: u64) -> Vec<RecordMotion> {
    let filled = |m: RecordMotion| RecordMotion { header: FrameHeader { set_id, ..m.header }, ..m };
    batches.into_iter().map(filled).collect()
}

fn all_same(a: &[RecordMotion], b: &[RecordMotion]) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| same(a, b))
}

#[test]
fn every_sample_comes_back_with_its_set() {
    let fs = MemFs::new();
    assert!(record(&fs, 5, options()).complete);
    let sets = read_all(&fs);
    for (n, set) in sets.iter().enumerate() {
        let want = with_id(motion(&session(), n as u64), set.id);
        assert_eq!(want.len() as u64, 2 * BATCHES);
        assert!(all_same(&set.motion, &want), "set {n}: {:?}\n{want:?}", set.motion);
    }
    let dataset = open(&fs);
    assert_eq!(dataset.session().motion, session().motion);
    let mut by_number = dataset.set_reader().unwrap();
    for (mode, n) in [(PixelMode::None, 3), (PixelMode::Decoded, 0), (PixelMode::Stored, 4)] {
        assert!(all_same(&by_number.read(n, mode).unwrap().motion, &sets[n].motion), "{mode:?}");
    }
    let info = dataset.info().unwrap();
    let units: Vec<_> =
        info.motion.iter().map(|u| (u.unit.as_str(), u.batches, u.lost_batches, u.samples)).collect();
    let batches = 5 * BATCHES;
    let samples = 5 * BATCHES * SAMPLES;
    assert_eq!(units, [("front/imu", batches, 0, samples), ("side/imu", batches, 0, samples)]);
    assert!((info.motion[0].rate_hz - 40.0).abs() < 1e-9, "{}", info.motion[0].rate_hz);
    assert!(info.streams.iter().all(|s| !s.stream.ends_with("imu")), "an IMU is not a stream of sets");
}

#[test]
fn any_number_of_batches_comes_with_a_set() {
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    let session = session();
    // None, one of one unit, and the longest there is; the set itself may have no frame.
    let mut longest = batch(&session, 1, 7);
    longest.samples.push(sample(1, 8 * SAMPLES));
    longest.header.set_image(PixelFormat::Motion, SAMPLES as u32 + 1, 1);
    let motions =
        [vec![], vec![batch(&session, 0, 3)], vec![longest, batch(&session, 0, 4), batch(&session, 1, 9)]];
    for (n, motion) in motions.iter().enumerate() {
        let set = set_of(&session, n as u64, if n == 1 { &[] } else { &[0, 1, 2] });
        r.push(RecordSet { motion: motion.clone(), ..set }).unwrap();
    }
    assert!(r.finish().unwrap().complete);
    for (n, (set, want)) in read_all(&fs).iter().zip(motions).enumerate() {
        assert!(all_same(&set.motion, &with_id(want, n as u64 + 1)), "set {n}");
    }
    assert_eq!(open(&fs).info().unwrap().motion[1].lost_batches, 1);
}

#[test]
fn a_batch_that_contradicts_itself_or_the_session_is_refused() {
    type Break = fn(&mut RecordMotion);
    let breaks: [(&str, Break); 9] = [
        ("IMU number 2 is not in the session", |m| m.unit = 2),
        ("batch 3 of front/imu: its header says 4 x 1 samples, 3 are there", |m| m.samples.truncate(3)),
        ("its header says 4 x 2 samples", |m| m.header.height = 2),
        ("its header says 0 x 1 samples, 0 are there", |m| {
            m.samples.clear();
            m.header.set_image(PixelFormat::Motion, 0, 1);
        }),
        ("at most 5", |m| {
            m.samples = (8..14).map(|k| sample(0, k)).collect();
            m.header.set_image(PixelFormat::Motion, 6, 1);
        }),
        ("4 samples are 256 bytes, its header says 192", |m| m.header.payload_len = 192),
        ("in rows of 250", |m| m.header.stride = 250),
        ("its format is 5, motion is 13", |m| m.header.format = PixelFormat::Z16 as u32),
        ("batch 2 of front/imu follows batch 2", |m| m.header.sequence = 2),
    ];
    for (why, spoil) in breaks {
        let fs = MemFs::new();
        let r = recorder(&fs, options());
        r.push(set(&session(), 0)).unwrap();
        let mut bad = set(&session(), 1);
        spoil(&mut bad.motion[0]);
        let refused = r.push(bad).unwrap_err();
        assert_eq!(refused.reason, SetDrop::BadSet);
        assert!(refused.message.contains(why), "{} is not {why}", refused.message);
        // A set that was refused leaves no trace: the same batches are taken when they are good.
        r.push(set(&session(), 1)).unwrap();
        let done = r.finish().unwrap();
        assert_eq!((done.sets.recorded, done.sets.dropped[SetDrop::BadSet as usize]), (2, 1), "{why}");
        assert!(all_same(&read_all(&fs)[1].motion, &with_id(motion(&session(), 1), 2)));
    }
    let within = |change: fn(&mut RecordSet)| {
        let r = recorder(&MemFs::new(), options());
        let mut bad = set(&session(), 0);
        change(&mut bad);
        r.push(bad).unwrap_err().message
    };
    let twice = within(|set| set.motion.push(set.motion[0].clone()));
    assert!(twice.contains("batch 1 of front/imu follows batch 2"), "{twice}");
    let as_image = within(|set| set.frames[2].header.set_image(PixelFormat::Motion, 40, 1));
    assert!(as_image.contains("side/ir_left"), "{as_image}");
}

#[test]
fn the_motion_of_a_set_has_a_bound() {
    let create = |batch: u32| {
        let mut session = session();
        session.motion[0].batch = batch;
        let r = Recorder::create(Arc::new(MemFs::new()), &dir(), session.clone(), options()).unwrap();
        (session, r)
    };
    let most = (SET_MOTION_MAX_BYTES / 512) as u32 - 2;
    let (session, r) = create(most);
    let mut long = set(&session, 0);
    let samples = (0..u64::from(most)).map(|k| sample(0, k)).collect();
    let mut header = long.motion[0].header;
    header.set_image(PixelFormat::Motion, most, 1);
    let whole = RecordMotion { unit: 0, header, samples };
    long.motion = vec![whole, batch(&session, 1, 0)];
    let refused = r.push(long).unwrap_err();
    assert!(refused.message.contains("is the limit"), "{}", refused.message);
}

/// A file whose motion no set ever ends must not fill the memory of whoever reads it.
#[test]
fn motion_without_an_end_is_not_kept() {
    let fs = MemFs::new();
    record(&fs, 2, options());
    let mut again = None;
    rewrite(&fs, |m| {
        if m.channel.topic == "/rig/front/imu/samples" && again.is_none() {
            // The longest batch that a file says it has, and the set that it belongs to never ends.
            let mut long = m.clone();
            let n = SET_MOTION_MAX_BYTES as usize / 64;
            long.data.to_mut()[4 + 16..4 + 20].copy_from_slice(&(n as u32).to_le_bytes());
            long.data.to_mut().resize(28 + 64 * n, 0);
            again = Some(());
            *m = long;
        }
        true
    });
    let limit = format!("a set has more than {SET_MOTION_MAX_BYTES} bytes of motion before its mark");
    assert_eq!(found(&fs).iter().filter(|f| **f == limit).count(), 1, "{:?}", found(&fs));
    let sets: Vec<_> = open(&fs).sets(SetRange::ALL).collect();
    assert!(sets.iter().any(|s| s.as_ref().is_err_and(|e| e.to_string().contains(&limit))));
    assert!(sets.last().unwrap().is_ok(), "what follows is read");
}

#[test]
fn a_session_with_a_unit_in_the_wrong_place_is_refused() {
    let create = |change: fn(&mut Session)| {
        let mut session = session();
        change(&mut session);
        Recorder::create(Arc::new(MemFs::new()), &dir(), session, options()).err().unwrap().to_string()
    };
    let twice = create(|s| s.motion.push(unit("front/imu")));
    assert!(twice.contains("IMU front/imu is there twice"), "{twice}");
    let both = create(|s| s.motion.push(unit("front/depth")));
    assert!(both.contains("IMU front/depth is there twice"), "{both}");
    let among_images = create(|s| s.streams.push(stream("top/imu", PixelFormat::Motion, 8, 1)));
    assert!(among_images.contains("top/imu is an IMU"), "{among_images}");
    let empty = create(|s| s.motion[0].batch = 0);
    assert!(empty.contains("batches of no samples"), "{empty}");
    let long = create(|s| s.motion[1].batch = u32::MAX / 64 + 1);
    assert!(long.contains("side/imu has batches of 67108864 samples, no set can hold one"), "{long}");
    let many = create(|s| s.motion = (0..4_100).map(|i| unit(&format!("c{i}/imu"))).collect());
    assert!(many.contains("4105 streams, IMUs and signals, 4000 is the limit"), "{many}");
    // The output of another program is read as far as a dataset can hold it.
    let fs = MemFs::new();
    record(&fs, 1, options());
    let path = dir().join("session.toml");
    let text = String::from_utf8(contents(&fs, &path)).unwrap();
    fs.put(&path, text.replacen("batch = 5", "batch = 67108864", 1).into_bytes());
    let refused = Dataset::open_with(Arc::new(fs), &dir()).err().unwrap();
    assert!(
        refused.kind() == ErrorKind::Corrupt && refused.to_string().contains("no set can hold one"),
        "{refused}"
    );
}

/// Readers that know ROS alone find the samples, and where the unit sits.
#[test]
fn other_readers_find_the_samples_one_by_one() {
    let fs = MemFs::new();
    record(&fs, 3, options());
    let bytes = contents(&fs, &segment(0));
    let messages: Vec<_> = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap).collect();
    let of = |topic: &str| messages.iter().filter(|m| m.channel.topic == topic).collect::<Vec<_>>();
    let imu = of("/rig/front/imu/data_raw");
    assert_eq!(imu.len() as u64, 3 * BATCHES * SAMPLES);
    for (k, m) in imu.iter().enumerate() {
        let want = sample(0, k as u64);
        assert_eq!(m.publish_time as i64 - T0, want.time_ns - M0);
        assert_eq!(m.log_time as i64 - T0, k as i64 / (BATCHES * SAMPLES) as i64 * PERIOD);
        // Header of 12 + 16 bytes, quaternion, nine covariances; then the angular velocity.
        let gyro = f64::from_le_bytes(m.data[4 + 32 + 13 * 8..][..8].try_into().unwrap());
        assert!(gyro == f64::from(want.gyro_rad_s[0]) || (gyro.is_nan() && want.gyro_rad_s[0].is_nan()));
    }
    assert_eq!(imu[0].channel.schema.as_ref().unwrap().name, "sensor_msgs/msg/Imu");
    assert_eq!(imu[0].channel.metadata["frame_id"], "front_imu_frame");
    let samples = of("/rig/side/imu/samples");
    let want: Vec<u8> = (0..SAMPLES).flat_map(|k| sample(1, k).to_bytes()).collect();
    assert_eq!(&samples[0].data[28..], want, "the array is the bytes of the batch");
    let tf = of("/tf_static")[0];
    let has = |name: &str| tf.data.windows(name.len()).any(|w| w == name.as_bytes());
    assert!(has("front_imu_frame") && has("side_imu_frame"));
}

#[test]
fn a_dataset_without_units_and_signals_is_as_it_always_was() {
    let fs = MemFs::new();
    let plain = Session { motion: Vec::new(), signals: Vec::new(), ..session() };
    let r = Recorder::create(Arc::new(fs.clone()), &dir(), plain.clone(), options()).unwrap();
    r.push(set(&plain, 0)).unwrap();
    assert!(r.finish().unwrap().complete);
    let bytes = contents(&fs, &segment(0));
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    assert_eq!(summary.schemas.len(), 12);
    assert!(summary.channels.values().all(|c| !c.topic.contains("imu") && !c.topic.contains("arm")));
    assert!(!String::from_utf8(contents(&fs, &dir().join("session.toml"))).unwrap().contains("motion"));
    let set = open(&fs).sets_with(SetRange::ALL, PixelMode::None).next().unwrap().unwrap();
    assert!(set.motion.is_empty() && set.tick == HostTime::from_ns(M0));
}

/// Records three sets whose motion `change` has spoiled, but so that it is recorded.
fn spoiled(change: impl Fn(u64, &mut Vec<RecordMotion>)) -> MemFs {
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    for n in 0..3 {
        let mut set = set(&session(), n);
        change(n, &mut set.motion);
        r.push(set).unwrap();
        settle(&r);
    }
    assert!(r.finish().unwrap().complete);
    fs
}

fn verify_findings(fs: &MemFs) -> Vec<(Severity, String)> {
    let report = check(fs, &VerifyOptions::default());
    report.findings.into_iter().map(|f| (f.severity, f.message)).collect()
}

#[test]
fn faults_of_batches_and_samples_are_found() {
    assert_eq!(verify_findings(&spoiled(|_, _| {})), []);
    let broken = |change: fn(&mut RecordMotion)| {
        let fs = spoiled(|n, motion| {
            if n == 1 {
                change(&mut motion[2]);
            }
        });
        let findings = verify_findings(&fs);
        let broken = findings.into_iter().filter(|(s, _)| *s == Severity::Broken);
        broken.map(|(_, what)| what).collect::<Vec<_>>()
    };
    let batch = "set 2: batch 4 of front/imu";
    assert_eq!(broken(|m| m.samples[1].sequence = 13), [format!("{batch}: sample 13 follows sample 13")]);
    let back = broken(|m| m.samples[0].time_ns -= SAMPLE_PERIOD);
    assert_eq!(back, [format!("{batch}: the time of sample 13 is not later than that before it")]);
    let of_another = broken(|m| m.header.capture_time_ns += 5);
    assert_eq!(of_another, [format!("{batch}: its time is not that of its newest sample")]);
    let unbalanced = broken(|m| m.header.captured += 1);
    assert!(unbalanced[0].starts_with(&format!("{batch}: its header does not balance")), "{unbalanced:?}");
    // Another clock epoch begins times and, where the unit was started anew, numbers anew.
    let restarted = |numbers: bool| {
        spoiled(move |n, motion| {
            for m in motion.iter_mut().filter(|m| n == 2 && m.unit == 0) {
                m.header.clock_epoch = 4;
                for s in &mut m.samples {
                    s.time_ns -= 10 * PERIOD;
                    s.sequence -= if numbers { 9 } else { 0 };
                }
                m.header.capture_time_ns = m.samples[3].time_ns;
            }
        })
    };
    assert_eq!(verify_findings(&restarted(false)), []);
    assert_eq!(verify_findings(&restarted(true)), []);
}

#[test]
fn missing_batches_and_samples_are_reported() {
    let lost = spoiled(|n, motion| motion.retain(|m| n != 1 || m.unit == 0));
    assert_eq!(
        verify_findings(&lost),
        [(Severity::Note, "2 batches of side/imu were not recorded".to_owned())]
    );
    // The device never gave these; those lost before the channel are in its account.
    let gap = spoiled(|n, motion| {
        let mine = motion.iter_mut().filter(|m| n == 2 && m.unit == 0);
        mine.flat_map(|m| &mut m.samples).for_each(|s| s.sequence += 5);
    });
    let never = "5 samples of front/imu are missing: the device never gave them";
    assert_eq!(verify_findings(&gap), [(Severity::Note, never.to_owned())]);
    let before_channel = spoiled(|n, motion| {
        for m in motion.iter_mut().filter(|m| n == 2 && m.unit == 0) {
            m.samples.iter_mut().for_each(|s| s.sequence += 5);
            m.header.dropped[1] = 2;
            m.header.captured += 2;
        }
    });
    assert_eq!(verify_findings(&before_channel), []);
}

#[test]
fn messages_that_lack_or_contradict_are_found() {
    let of = |topic: &str, change: &mut dyn FnMut(u64, &mut mcap::Message) -> bool| {
        let fs = MemFs::new();
        record(&fs, 2, options());
        let mut n = 0;
        rewrite(&fs, |m| {
            if m.channel.topic != topic {
                return true;
            }
            n += 1;
            change(n, m)
        });
        fs
    };
    let fs = of("/rig/front/imu/samples", &mut |n, _| n != 3);
    assert_eq!(
        found(&fs),
        [
            "set 2: batch 3 of front/imu: it has no samples",
            "set 2: front/imu has 4 samples in its batches, 8 single ones",
            "1 batches of front/imu were not recorded"
        ]
    );
    let error = open(&fs).sets(SetRange::ALL).find_map(Result::err).unwrap().to_string();
    assert!(error.contains("set 2: batch 3 of front/imu has no samples"), "{error}");
    let fs = of("/rig/front/imu/frame_info", &mut |n, _| n != 1);
    assert_eq!(
        found(&fs),
        [
            "set 1: 1 batches of front/imu have no frame_info",
            "set 1: front/imu has 4 samples in its batches, 8 single ones"
        ]
    );
    let fs = of("/rig/front/imu/frame_info", &mut |n, m| {
        if n == 2 {
            m.data.to_mut()[4 + 24] ^= 1; // set_id
        }
        true
    });
    assert_eq!(found(&fs), ["set 1: batch 2 of front/imu: its frame_info is of another set"]);
    let fs = of("/rig/front/imu/samples", &mut |n, m| {
        if n == 2 {
            m.data.to_mut()[4 + 8] = 9; // sequence
        }
        true
    });
    assert_eq!(found(&fs), ["set 1: batch 2 of front/imu: its samples are those of batch 9"]);
    let fs = of("/rig/front/imu/samples", &mut |n, m| {
        if n == 2 {
            m.data.to_mut()[4] ^= 1; // stamp
        }
        true
    });
    assert_eq!(found(&fs), ["set 1: batch 2 of front/imu: its stamp is not its time"]);
    let fs = of("/rig/front/imu/frame_info", &mut |n, m| {
        if n == 2 {
            let last = m.data.len() - 2; // of its codec
            m.data.to_mut()[last] ^= 1;
        }
        true
    });
    let named = "set 1: batch 2 of front/imu: its frame_info names another frame or codec than an IMU's";
    assert_eq!(found(&fs), [named]);
    let fs = of("/rig/front/imu/frame_info", &mut |n, m| {
        m.log_time += u64::from(n == 2);
        true
    });
    let late = "set 1: batch 2 of front/imu: it has another log time than its set";
    assert!(found(&fs).iter().any(|f| f == late), "{:?}", found(&fs));
    let fs = of("/rig/side/imu/data_raw", &mut |n, _| n != 9);
    assert_eq!(found(&fs), ["set 2: side/imu has 8 samples in its batches, 7 single ones"]);
    // Only decoding finds a single sample that differs from its batch.
    let decoded = VerifyOptions { decode: true, ..VerifyOptions::default() };
    for (at, what) in [
        (4 + 32 + 13 * 8 + 6, "single sample 2 of front/imu differs from its batch"),
        (4, "single sample 2 of front/imu differs from its batch"),
        (4 + 12, "a single sample of front/imu is of another frame than front_imu_frame"),
    ] {
        let fs = of("/rig/front/imu/data_raw", &mut |n, m| {
            if n == 2 {
                m.data.to_mut()[at] ^= 1;
            }
            true
        });
        assert_eq!(found(&fs), Vec::<String>::new());
        let messages: Vec<_> = check(&fs, &decoded).findings.into_iter().map(|f| f.message).collect();
        assert_eq!(messages, [format!("set 1: {what}")], "byte {at}");
    }
}

#[test]
fn a_session_and_channels_that_disagree_are_found() {
    let fs = MemFs::new();
    record(&fs, 1, options());
    let text = String::from_utf8(contents(&fs, &dir().join("session.toml"))).unwrap();
    let write = |text: String| {
        let fs = copy(&fs);
        fs.put(&dir().join("session.toml"), text.into_bytes());
        fs
    };
    let renamed = write(text.replace("side/imu", "top/imu"));
    let findings = found(&renamed);
    for what in [
        "side/imu/frame_info is of an IMU that is not in the session",
        "side/imu/data_raw is of an IMU that is not in the session",
        "the IMU top/imu has no channel samples",
    ] {
        assert!(findings.iter().any(|f| f == what), "{what} is not in {findings:?}");
    }
    let error = open(&renamed).sets(SetRange::ALL).find_map(Result::err).unwrap().to_string();
    assert!(error.contains("side/imu is not an IMU of the session"), "{error}");
}

#[test]
fn motion_is_compared_bit_by_bit() {
    let a = MemFs::new();
    record(&a, 3, options());
    let strict = CompareOptions { strict: true, ..CompareOptions::default() };
    let differing = |b: &MemFs, options: &CompareOptions| {
        let c = compare(&open(&a), &open(b), options).unwrap();
        let counts =
            c.counts.iter().map(|c| (c.stream.clone(), c.field.clone(), c.count)).collect::<Vec<_>>();
        (c.batches, counts)
    };
    let one = |stream: &str, field: &str, n| (stream.to_owned(), field.to_owned(), n);
    let batches = 3 * 2 * BATCHES;
    assert_eq!(differing(&spoiled(|_, _| {}), &strict), (batches, vec![]));
    // The sign of a zero, which no comparison of numbers would see.
    let zero = |sign: f32| {
        spoiled(move |n, m| {
            if n == 1 {
                m[1].samples[2].gyro_rad_s[1] = sign * 0.0;
            }
        })
    };
    let counts = compare(&open(&zero(1.0)), &open(&zero(-1.0)), &strict).unwrap().counts;
    assert_eq!((counts.len(), counts[0].field.as_str(), counts[0].count), (1, "samples", 1));
    let short = spoiled(|n, m| {
        if n == 2 {
            m[0].samples.truncate(3);
            m[0].header.set_image(PixelFormat::Motion, 3, 1);
            m[0].header.capture_time_ns = m[0].samples[2].time_ns;
        }
    });
    let (_, counts) = differing(&short, &strict);
    assert!(counts.contains(&one("front/imu", "samples", 1)), "{counts:?}");
    assert!(counts.contains(&one("front/imu", "width", 1)), "{counts:?}");
    let lone = spoiled(|n, m| {
        if n == 2 {
            m.truncate(3);
        }
    });
    assert_eq!(differing(&lone, &strict), (batches - 1, vec![one("side/imu", "batch", 1)]));
    // Fields that a recording of a replay assigns anew.
    let replayed = spoiled(|_, m| {
        for m in m {
            m.header.sequence += 7;
            m.header.captured += 7;
            m.header.flags |= FrameFlags::REPLAYED.0;
        }
    });
    assert_eq!(differing(&replayed, &CompareOptions::default()), (batches, vec![]));
    assert_eq!(differing(&replayed, &strict).1.len(), 6);
    let fs = MemFs::new();
    let mut other = session();
    other.motion.pop();
    other.motion[0].pose.translation_m[2] = 0.0;
    let r = Recorder::create(Arc::new(fs.clone()), &dir(), other.clone(), options()).unwrap();
    for n in 0..3 {
        r.push(RecordSet { motion: motion(&other, n), ..set(&session(), n) }).unwrap();
        settle(&r);
    }
    assert!(r.finish().unwrap().complete);
    let (_, counts) = differing(&fs, &CompareOptions::default());
    assert!(counts.contains(&one("side/imu", "unit", 1)), "{counts:?}");
    assert!(counts.contains(&one("front/imu", "description.pose", 1)), "{counts:?}");
}

#[test]
fn parts_with_other_units_are_not_merged() {
    let record = |fs: &MemFs, name: &str, motion: Vec<MotionRecord>, n: u64| {
        let session = Session { motion, ..session() };
        let path = std::path::PathBuf::from("/data").join(name);
        let r = Recorder::create(Arc::new(fs.clone()), &path, session.clone(), options()).unwrap();
        r.push(set(&session, n)).unwrap();
        assert!(r.finish().unwrap().complete);
        Dataset::open_with(Arc::new(fs.clone()), &path).unwrap()
    };
    let fs = MemFs::new();
    let units = session().motion;
    let mut moved = units.clone();
    moved[1].pose.translation_m[0] += 0.5;
    let a = record(&fs, "a", units.clone(), 0);
    let join = |inputs: &[Dataset], out: &str| {
        let out = std::path::PathBuf::from("/data").join(out);
        let mut go = |_, _| std::ops::ControlFlow::Continue(());
        merge(&fs, inputs, &out, &SliceOptions::default(), &mut go).map(|_| out)
    };
    let e = join(&[a.clone(), record(&fs, "b", units[..1].to_vec(), 1)], "x").unwrap_err().to_string();
    assert!(e.contains("the IMUs are [front/imu, side/imu] and [front/imu]"), "{e}");
    let e = join(&[a.clone(), record(&fs, "c", moved, 2)], "x").unwrap_err().to_string();
    assert!(e.contains("the IMU side/imu has another pose"), "{e}");
    let whole = join(&[a, record(&fs, "d", units, 1)], "whole").unwrap();
    let sets = Dataset::open_with(Arc::new(fs.clone()), &whole).unwrap().sets(SetRange::ALL);
    let motions: Vec<_> = sets.map(|s| s.unwrap().motion).collect();
    let wanted = [with_id(motion(&session(), 0), 1), with_id(motion(&session(), 1), 2)];
    assert!(motions.iter().zip(&wanted).all(|(a, b)| all_same(a, b)) && motions.len() == 2);
}

#[test]
fn samples_are_listed_and_written() {
    let fs = MemFs::new();
    record(&fs, 3, options());
    let dataset = open(&fs);
    let side = "side/imu".parse().unwrap();
    let mut rows = Vec::new();
    let mut head = String::new();
    let listed = list_samples(&dataset, &side, SetChoice::Id(2), &mut |line| head = line, &mut |row| {
        let SampleRow::Motion(row) = row else { panic!("{row:?}") };
        rows.push(row);
        ControlFlow::Continue(())
    })
    .unwrap();
    assert_eq!(head, MotionRow::COLUMNS.join(","));
    let per_set = BATCHES * SAMPLES;
    assert_eq!((listed.sets, listed.frames, rows.len() as u64), (1, per_set, per_set));
    let want = sample(1, per_set);
    assert_eq!((rows[0].set, rows[0].sequence, rows[0].time_ns), (2, want.sequence, want.time_ns));
    assert_eq!(rows[0].utc_ns, T0 + PERIOD);
    assert_eq!((rows[0].gyro_y_rad_s, rows[0].temperature_c), (Some(want.gyro_rad_s[1]), None));
    let line = rows[0].csv();
    assert_eq!(
        line,
        format!("2,{},{},8000,9,20000,-7,2,-2,0.1,0.3,11.81,-0.6666667,,1", T0 + PERIOD, M0 + PERIOD)
    );
    assert_eq!(line.split(',').count(), MotionRow::COLUMNS.len());
    let json = serde_json::to_value(rows[0]).unwrap();
    assert!(MotionRow::COLUMNS.iter().all(|name| json.get(name).is_some()), "{json}");

    let all = SetChoice::default();
    let units = ["front/imu".parse().unwrap(), side];
    let mut go = |_| ControlFlow::Continue(());
    let out = std::path::Path::new("/data/csv");
    let done = export_samples(&fs, &dataset, &units, all, SampleForm::Csv, out, &mut go).unwrap();
    assert_eq!((done.sets, done.frames, done.lost), (3, 2 * 3 * per_set, 0));
    let text = String::from_utf8(contents(&fs, &out.join("side/imu.csv"))).unwrap();
    assert_eq!(text.lines().count() as u64, 1 + 3 * per_set);
    assert_eq!(text.lines().nth(1 + per_set as usize), Some(line.as_str()));
    let e = export_samples(&fs, &dataset, &units, all, SampleForm::Csv, out, &mut go).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::AlreadyExists);

    let out = std::path::Path::new("/data/npy");
    export_samples(&fs, &dataset, &units, all, SampleForm::Npy, out, &mut go).unwrap();
    let file = contents(&fs, &out.join("front/imu.npy"));
    let head = 10 + u16::from_le_bytes([file[8], file[9]]) as usize;
    assert_eq!((head % 64, file.len() - head), (0, 3 * per_set as usize * 80));
    let text = String::from_utf8_lossy(&file[10..head]).into_owned();
    assert!(text.contains("('accel_m_s2', '<f4', (3,))") && text.contains("'shape': (24,)"), "{text}");
    assert_eq!(file[head + 80..head + 88], 1u64.to_le_bytes());
    assert_eq!(file[head + 96..head + 160], sample(0, 1).to_bytes());

    let none = "top/imu".parse().unwrap();
    let e = list_samples(&dataset, &none, all, &mut |_| {}, &mut |_| ControlFlow::Continue(()))
        .unwrap_err()
        .to_string();
    assert_eq!(
        e,
        "there is no IMU or signal top/imu; the dataset has front/imu, side/imu, arm/joints, arm/gripper"
    );
    let images = FrameChoice { streams: units.to_vec(), ..FrameChoice::default() };
    let e = list_frames(&dataset, &images, &mut |_| ControlFlow::Continue(())).unwrap_err().to_string();
    assert!(e.contains("front/imu is an IMU"), "{e}");
}
