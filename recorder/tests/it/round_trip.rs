//! Reading returns exactly the data that was written.

use crate::support::*;
use depthrig_bus::{FrameHeader, PixelFormat};
use depthrig_recorder::fs::MemFs;
use depthrig_recorder::{
    ColorCodec, Compression, Dataset, Diagnostic, Level, PixelMode, Recorder, RecorderOptions, SetRange,
    StreamAccount,
};
use std::sync::Arc;

/// Peak signal-to-noise ratio of 8-bit samples, dB.
fn psnr(a: &[u8], b: &[u8]) -> f64 {
    assert_eq!(a.len(), b.len());
    let sum: f64 = a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    10.0 * (255.0 * 255.0 * a.len() as f64 / sum.max(1e-9)).log10()
}

/// `FrameHeader` compares floats, and its temperature is not a number here.
fn same_header(a: &FrameHeader, b: &FrameHeader) -> bool {
    let clean = |h: &FrameHeader| FrameHeader { temperature_c: 0.0, ..*h };
    clean(a) == clean(b) && a.temperature_c.to_bits() == b.temperature_c.to_bits()
}

#[test]
fn every_header_and_pixel_comes_back() {
    for (color, compression) in [
        (ColorCodec::Jpeg, Compression::Zstd1),
        (ColorCodec::Raw, Compression::Zstd1),
        (ColorCodec::Raw, Compression::None),
    ] {
        let fs = MemFs::new();
        let summary = record(&fs, 5, RecorderOptions { color, compression, ..options() });
        assert!(summary.complete, "{:?}", summary.lost);
        assert_eq!((summary.sets.recorded, summary.frames, summary.duration_ns), (5, 15, 4 * PERIOD));
        let sets = read_all(&fs);
        assert_eq!(sets.len(), 5);
        for (n, got) in sets.iter().enumerate() {
            let want = set(&session(), n as u64);
            assert_eq!((got.id, got.tick, got.spread_ns), (want.id, want.tick, want.spread_ns));
            assert_eq!(got.utc_ns, T0 + n as i64 * PERIOD);
            assert_eq!(got.missing, Vec::<usize>::new());
            for (got, want) in got.frames.iter().zip(&want.frames) {
                let want_header = FrameHeader { set_id: n as u64 + 1, ..want.header };
                assert!(same_header(&got.header, &want_header), "{:?}\n{:?}", got.header, want_header);
                if got.codec == "jpeg" {
                    assert!(psnr(&got.pixels, want.pixels.bytes()) > 40.0);
                } else {
                    assert_eq!(got.pixels, want.pixels.bytes(), "set {n} stream {}", got.stream);
                }
            }
        }
        assert_eq!(names(&fs), ["seg_0000.mcap", "session.toml"]);
    }
}

#[test]
fn every_pixel_format_comes_back() {
    for format in PixelFormat::ALL.into_iter().filter(|f| !f.is_motion()) {
        let fs = MemFs::new();
        let mut session = session();
        session.streams = vec![stream("cam/any", format, 32, 24)];
        let r = Recorder::create(
            Arc::new(fs.clone()),
            &dir(),
            session.clone(),
            RecorderOptions { color: ColorCodec::Raw, ..options() },
        )
        .unwrap();
        let mut pushed = set(&session, 3);
        let mut expected = pushed.frames[0].pixels.bytes().to_vec();
        if format == PixelFormat::Mjpeg {
            // A camera's JPEG is shorter than the most that is reserved for one; it is stored as it came.
            expected.truncate(777);
            pushed.frames[0].header.payload_len = 777;
            pushed.frames[0].header.stride = 0;
        }
        r.push(pushed).unwrap();
        assert!(r.finish().unwrap().complete, "{}", format.name());
        assert_eq!(read_all(&fs)[0].frames[0].pixels, expected, "{}", format.name());
    }
}

#[test]
fn padded_rows_come_back_with_their_length() {
    for (color, format) in [(ColorCodec::Jpeg, PixelFormat::Bgr8), (ColorCodec::Raw, PixelFormat::Rgb8)] {
        let fs = MemFs::new();
        let mut session = session();
        session.streams = vec![stream("cam/color", format, 20, 8)];
        let r = Recorder::create(
            Arc::new(fs.clone()),
            &dir(),
            session.clone(),
            RecorderOptions { color, ..options() },
        )
        .unwrap();
        let mut pushed = set(&session, 0);
        let padded: Vec<u8> =
            (0..8).flat_map(|y| (0..64).map(move |x| if x < 60 { 3 * x + y } else { 0 })).collect();
        let header = &mut pushed.frames[0].header;
        header.stride = 64;
        header.payload_len = 512;
        pushed.frames[0].pixels = Box::new(padded.clone());
        r.push(pushed).unwrap();
        assert!(r.finish().unwrap().complete);
        let got = &read_all(&fs)[0].frames[0].pixels;
        if color == ColorCodec::Raw {
            assert_eq!(*got, padded);
        } else {
            assert!(psnr(got, &padded) > 35.0, "blue and red are in their places: {}", psnr(got, &padded));
        }
    }
}

#[test]
fn missing_frames_stay_missing() {
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    r.push(set_of(&session(), 0, &[0, 2])).unwrap();
    r.push(set_of(&session(), 1, &[])).unwrap();
    assert!(r.finish().unwrap().complete);
    let sets = read_all(&fs);
    assert_eq!(sets[0].missing, [1]);
    assert_eq!(sets[0].frames.iter().map(|f| f.stream).collect::<Vec<_>>(), [0, 2]);
    assert_eq!(sets[1].missing, [0, 1, 2]);
    let info = open(&fs).info().unwrap();
    // JPEG is stored as it is, and grey pixels are packed by zstd.
    let sizes: Vec<_> = info.streams.iter().map(|s| (s.is_packed, s.packed_bytes < s.bytes)).collect();
    assert_eq!(sizes, [(false, false), (false, false), (true, true)], "{:?}", info.streams);
    assert_eq!((info.sets, info.incomplete_sets), (2, 2));
    assert_eq!(
        info.streams.iter().map(|s| (s.frames, s.missing)).collect::<Vec<_>>(),
        [(1, 1), (0, 2), (1, 1)]
    );
}

#[test]
fn segments_roll_at_set_boundaries_and_each_stands_alone() {
    let fs = MemFs::new();
    let summary = record(&fs, 7, RecorderOptions { segment_max_ns: 3 * PERIOD, ..options() });
    assert_eq!(summary.segments, 3);
    assert_eq!(names(&fs), ["seg_0000.mcap", "seg_0001.mcap", "seg_0002.mcap", "session.toml"]);
    let ids: Vec<_> = read_all(&fs).iter().map(|s| s.id).collect();
    assert_eq!(ids, [1, 2, 3, 4, 5, 6, 7]);
    let alone = Dataset::open_with(Arc::new(fs.clone()), &segment(1)).unwrap();
    let ids: Vec<_> = alone.sets(SetRange::ALL).map(|s| s.unwrap().id).collect();
    assert_eq!(ids, [4, 5, 6]);
    assert_eq!(alone.session().streams, session().streams);

    let fs = MemFs::new();
    let by_size = RecorderOptions { segment_max_bytes: 1, ..options() };
    assert_eq!(record(&fs, 3, by_size).segments, 3, "one set at least goes into each segment");
}

#[test]
fn sets_are_found_by_time() {
    let fs = MemFs::new();
    record(&fs, 10, RecorderOptions { segment_max_ns: 4 * PERIOD, ..options() });
    let ids = |range: SetRange| -> Vec<u64> {
        open(&fs).sets_with(range, PixelMode::None).map(|s| s.unwrap().id).collect()
    };
    assert_eq!(ids((T0 + 3 * PERIOD..T0 + 6 * PERIOD).into()), [4, 5, 6]);
    assert_eq!(ids((T0 + 3 * PERIOD..=T0 + 6 * PERIOD).into()), [4, 5, 6, 7]);
    assert_eq!(ids((T0 + 8 * PERIOD + 1..).into()), [10]);
    assert!(ids((..T0).into()).is_empty());
    assert!(
        open(&fs).sets_with(SetRange::ALL, PixelMode::None).all(|s| s.unwrap().frames[0].pixels.is_empty())
    );
}

#[test]
fn a_tick_that_does_not_advance_still_gets_a_log_time_of_its_own() {
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    for n in 0..3 {
        let mut s = set(&session(), n);
        s.tick = depthrig_bus::HostTime::from_ns(M0 - n as i64);
        // The wall clock was set back an hour: recorded times are not affected.
        s.utc.utc_ns -= n as i64 * 3_600_000_000_000;
        r.push(s).unwrap();
    }
    assert!(r.finish().unwrap().complete);
    let times: Vec<_> = read_all(&fs).iter().map(|s| (s.utc_ns - T0, s.tick.ns() - M0)).collect();
    assert_eq!(times, [(0, 0), (1, -1), (2, -2)]);
}

#[test]
fn notes_accounts_and_the_outcome_are_in_the_dataset() {
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    r.add_note("the lamp was moved").unwrap();
    let account = StreamAccount {
        stream: "front/depth".parse().unwrap(),
        captured: 30,
        delivered: 29,
        dropped: depthrig_bus::DropCounts([0, 1, 0, 0, 0, 0, 0, 0]),
    };
    r.update_accounts(vec![account.clone()]);
    r.diagnostics(vec![Diagnostic {
        level: Level::Warn,
        name: "rig/front".into(),
        message: "hot".into(),
        hardware_id: "0042".into(),
        values: vec![("temperature_c".into(), "61".into())],
    }]);
    r.push(set(&session(), 0)).unwrap();
    assert!(r.finish().unwrap().complete);
    let dataset = open(&fs);
    assert_eq!(dataset.session().notes[0].text, "the lamp was moved");
    let outcome = dataset.session().outcome.clone().unwrap();
    assert!(outcome.complete && outcome.sets_recorded == 1 && outcome.ended_utc_ns == T0);
    let info = dataset.info().unwrap();
    assert_eq!(info.accounts, [account]);
    assert_eq!(info.set_counts.unwrap().recorded, 1);

    let bytes = contents(&fs, &segment(0));
    let topics: Vec<_> =
        mcap::MessageStream::new(&bytes).unwrap().map(|m| m.unwrap().channel.topic.clone()).collect();
    for topic in ["/rig/notes", "/diagnostics", "/tf_static", "/rig/clock", "/rig/frame_set", "/rig/accounts"]
    {
        assert!(topics.iter().any(|t| t == topic), "{topic} is not among {topics:?}");
    }
}

/// The `mcap` crate reads what we write, with all its checks, from the index and from the data.
#[test]
fn the_mcap_crate_agrees() {
    let fs = MemFs::new();
    record(&fs, 4, options());
    let bytes = contents(&fs, &segment(0));
    let messages: Vec<_> = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap).collect();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let stats = summary.stats.as_ref().unwrap();
    assert_eq!(stats.message_count, messages.len() as u64);
    assert_eq!(stats.chunk_count as usize, summary.chunk_indexes.len());
    assert_eq!(stats.message_start_time, T0 as u64);
    let mut through_index = 0;
    for chunk in &summary.chunk_indexes {
        let by_channel = summary.read_message_indexes(&bytes, chunk).unwrap();
        for (channel, entries) in by_channel {
            for e in entries {
                let m = summary.seek_message(&bytes, chunk, &e).unwrap();
                assert_eq!((m.channel.id, m.log_time), (channel.id, e.log_time));
                through_index += 1;
            }
        }
    }
    assert_eq!(through_index, messages.len());
    let depth = messages.iter().find(|m| m.channel.topic == "/rig/front/depth/image_raw").unwrap();
    assert_eq!(depth.channel.schema.as_ref().unwrap().name, "sensor_msgs/msg/Image");
    assert_eq!(depth.channel.metadata["depth_unit_m"], "0.0001");
    assert_eq!(depth.publish_time as i64 - T0, "front/depth".len() as i64);
    let rig = summary.attachment_indexes.iter().find(|a| a.name == "rig.toml").unwrap();
    assert_eq!(mcap::read::attachment(&bytes, rig).unwrap().data.as_ref(), session().rig_config.as_bytes());
}
