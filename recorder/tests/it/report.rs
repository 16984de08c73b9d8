//! The quality report: its numbers against the recorded data, its words about failures, and its HTML.

use crate::recover::recover;
use crate::support::*;
use core::ops::ControlFlow;
use depthrig_bus::{DropCounts, PixelFormat};
use depthrig_recorder::fs::{Fs, MemFs};
use depthrig_recorder::report::{Report, ReportOptions};
use depthrig_recorder::{Dataset, Health, Recorder, RecorderOptions, Session, StreamAccount};
use std::sync::Arc;

fn report(fs: &MemFs) -> Report {
    Report::of(&open(fs), &ReportOptions::default(), &mut |_| ControlFlow::Continue(())).unwrap().unwrap()
}

/// Records the sets whose streams `streams` names, with these accounts.
fn record_with(
    session: &Session,
    sets: u64,
    streams: impl Fn(u64) -> Vec<usize>,
    accounts: &[StreamAccount],
) -> MemFs {
    let fs = MemFs::new();
    let options = RecorderOptions { segment_max_ns: 10 * PERIOD, ..options() };
    let r = Recorder::create(Arc::new(fs.clone()), &dir(), session.clone(), options).unwrap();
    r.update_accounts(accounts.to_vec());
    for n in 0..sets {
        r.push(set_of(session, n, &streams(n))).unwrap();
        settle(&r);
    }
    r.finish().unwrap();
    fs
}

fn account(stream: &str, captured: u64, delivered: u64, dropped: [u64; 8]) -> StreamAccount {
    StreamAccount { stream: stream.parse().unwrap(), captured, delivered, dropped: DropCounts(dropped) }
}

/// Depth is packed by zstd, JPEG is not; both as `info` shows them.
#[test]
fn sizes_are_those_of_the_file() {
    let fs = record_with(&session(), 25, |_| vec![0, 1, 2], &[]);
    let r = report(&fs);
    let info = open(&fs).info().unwrap();
    let page = r.to_html();
    assert_eq!(r.streams.iter().filter(|s| s.is_packed).count(), 2);
    for (s, listed) in r.streams.iter().zip(&info.streams) {
        assert_eq!(
            (s.packed_bytes, s.is_packed),
            (listed.packed_bytes, listed.is_packed),
            "{}",
            listed.stream
        );
        let packed = if s.is_packed { " + zstd" } else { "" };
        let share = (100.0 * listed.packed_bytes as f64 / listed.raw_bytes as f64).round();
        let row = page.split("<tr>").find(|row| row.contains(&format!(">{}</td>", listed.stream))).unwrap();
        assert!(row.contains(&format!("<td>{}{packed}</td>", listed.codec)), "{row}");
        assert!(row.contains(&format!(">{share} %</td>")), "{row}");
        // The size before packing is another number.
        assert!(s.packed_bytes < s.bytes || !s.is_packed);
    }
}

#[test]
fn the_numbers_are_those_of_the_recording() {
    let accounts = [account("front/color", 60, 60, [0; 8])];
    let fs = record_with(&session(), 25, |_| vec![0, 1, 2], &accounts);
    let r = report(&fs);
    assert_eq!(r.verdict.health, Health::Whole);
    assert_eq!((r.verdict.why.len(), r.verdict.remarks.len()), (0, 0), "{:?}", r.verdict);
    assert_eq!((r.sets.count, r.sets.incomplete, r.segments), (25, 0, 3));
    assert_eq!((r.sets.duration_ns, r.sets.counts.as_ref().unwrap().offered), (24 * PERIOD, 25));
    assert!((r.sets.interval_ns.p50 - PERIOD).abs() < PERIOD / 250 && r.sets.interval_ns.max == PERIOD);
    // Capture times differ by the length of the names: 11, 11 and 12 characters.
    assert_eq!(r.sets.spread_ns.max, 1);
    assert_eq!(r.sets.spread_histogram.counts.iter().sum::<u64>(), 25);
    assert!(r.sets.per_second.iter().flatten().all(|hz| (hz - 5.0).abs() < 1e-6), "{:?}", r.sets.per_second);
    for s in &r.streams {
        assert_eq!((s.frames, s.missing, s.clock.restarts, s.clock.domain), (25, 0, 0, "device"));
        assert!((s.live_hz - 30.0).abs() < 1e-6, "six frames a set: {}", s.live_hz);
        assert!(
            s.live_hz_series.iter().all(|hz| (hz.unwrap() - 30.0).abs() < 1e-6),
            "{:?}",
            s.live_hz_series
        );
        assert_eq!((s.clock.lag_ns.max, s.clock.uncertainty_ns.max), (8_000_000, 15_000));
        assert_eq!(s.dropped_series.iter().sum::<u64>(), 0, "those before the recording do not count");
    }
    // 0 where (x + y) % 17 == 0, in every set.
    let holes = (0..64 * 48).filter(|i| (i % 64 + i / 64) % 17 == 0).count() as f64;
    let fill = r.streams[1].fill.as_ref().unwrap();
    let truth = 1.0 - holes / (64.0 * 48.0);
    assert_eq!((fill.samples.len(), fill.min, fill.max), (25, truth, truth));
    assert!(r.streams[0].fill.is_none());
    assert_eq!((r.sampled.sets, r.host_clock.steps.len()), (25, 0));
    assert!(r.streams[0].account.as_ref().unwrap().balances() && r.streams[1].account.is_none());
    // The report shows what the IMUs measured.
    let u = &r.motion[0];
    assert_eq!((u.samples, u.lost_batches, u.never_given), (25 * BATCHES * SAMPLES, 0, 0));
    assert!((u.samples_hz - 40.0).abs() < 1e-9, "{}", u.samples_hz);
    let length = |v: [f32; 3]| v.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    let most = (0..u.samples).map(|k| length(sample(0, k).accel_m_s2)).fold(0.0, f64::max);
    let drawn = u.acceleration_series.iter().flatten().map(|v| v.max).fold(0.0, f64::max);
    assert!((most - drawn).abs() < 1e-9, "{most} {drawn}");
    assert!(u.rotation_series.iter().flatten().all(|v| v.min.is_finite()), "NaN is not drawn");
    let page = r.to_html();
    assert!(
        page.contains("<h2>Motion</h2>") && page.contains("acceleration, at most"),
        "no motion on the page"
    );
    check_page(&page);
    // JSON has no images and can be read.
    let json = serde_json::to_value(&r).unwrap();
    assert_eq!(json["verdict"]["health"], "whole");
    assert_eq!(json["streams"][1]["id"], "front/depth");
    assert!(json.get("images").is_none());
}

#[test]
fn the_sessions_own_limit_of_the_spread_is_used() {
    let beyond = |limit_ns: Option<i64>, options: &ReportOptions| {
        let session = Session { max_spread_ns: limit_ns, ..session() };
        let fs = record_with(&session, 4, |_| vec![0, 1, 2], &[]);
        let report = Report::of(&open(&fs), options, &mut |_| ControlFlow::Continue(()));
        let sets = report.unwrap().unwrap().sets;
        (sets.spread_limit_ns, sets.beyond_limit)
    };
    let usual = ReportOptions::default();
    // The frames of each set are 1 ns apart; half a period of the slowest camera is the bound without a limit.
    assert_eq!(beyond(None, &usual), (Some(16_666_666), 0));
    assert_eq!(beyond(Some(0), &usual), (Some(0), 4));
    assert_eq!(beyond(Some(0), &ReportOptions { max_spread_ns: Some(7), ..usual }), (Some(7), 0));
}

#[test]
fn a_camera_that_is_lost_in_the_middle_is_told() {
    let streams = |n| if (10..18).contains(&n) { vec![2] } else { vec![0, 1, 2] };
    let fs = record_with(&session(), 25, streams, &[]);
    let r = report(&fs);
    assert_eq!((r.verdict.health, r.sets.incomplete), (Health::Whole, 8));
    assert_eq!(
        r.verdict.remarks,
        ["front/color, front/depth: missing in 8 of 25 sets, between 2.0 s and 3.4 s."]
    );
    assert_eq!(r.streams[0].missing_series.iter().sum::<u64>(), 8);
    assert_eq!(r.streams[2].missing, 0);

    let gone = report(&record_with(&session(), 25, |n| if n < 10 { vec![0, 1, 2] } else { vec![2] }, &[]));
    assert_eq!(
        gone.verdict.remarks,
        ["front/color, front/depth: missing in 15 of 25 sets, from 2.0 s to the end."]
    );
    let rates = &gone.streams[0].live_hz_series;
    assert_eq!(rates.last().unwrap().unwrap(), 0.0, "{rates:?}");
    assert!((rates[1].unwrap() - 30.0).abs() < 1e-6, "{rates:?}");
    let never = report(&record_with(&session(), 5, |_| vec![2], &[]));
    assert!(
        never.verdict.remarks[0].ends_with("missing in 5 of 5 sets: no frame at all."),
        "{:?}",
        never.verdict
    );
    check_page(&never.to_html());
}

#[test]
fn every_loss_has_its_reason_and_the_sums_are_checked() {
    let good =
        [account("front/color", 63, 60, [1, 0, 0, 0, 0, 2, 0, 0]), account("front/depth", 60, 60, [0; 8])];
    let r = report(&record_with(&session(), 5, |_| vec![0, 1, 2], &good));
    assert_eq!(r.verdict.health, Health::Whole);
    assert_eq!(
        r.verdict.remarks,
        ["front/color: 3 of 63 captured frames were lost before their channel: 1 device_gap, 2 no_slot."]
    );
    let page = r.to_html();
    assert!(page.contains("63 captured = 60 delivered + 1 device_gap + 2 no_slot"));
    assert!(page.contains("front/color · no_slot") && !page.contains("NOT exact"));

    let bad = [account("front/color", 64, 60, [1, 0, 0, 0, 0, 2, 0, 0])];
    let r = report(&record_with(&session(), 5, |_| vec![0, 1, 2], &bad));
    assert_eq!(r.verdict.health, Health::Damaged);
    assert!(r.verdict.why[0].contains("does not balance"), "{:?}", r.verdict);
    assert!(r.to_html().contains("NOT exact"));
}

/// The last account in the file lacks these losses, because nothing more could be written.
#[test]
fn sets_lost_to_a_full_disk_are_reported() {
    let fs = MemFs::new().with_capacity(130_000);
    let recorder = recorder(&fs, RecorderOptions { reserve_bytes: 45_000, ..options() });
    for n in 0..40 {
        drop(recorder.push(set(&session(), n)));
        settle(&recorder);
    }
    let summary = recorder.finish().unwrap();
    let recorded = summary.sets.recorded;
    let lost = summary.sets.dropped_total();
    assert!(recorded > 0 && lost > 1 && recorded + lost == 40, "{summary:?}");

    let r = report(&fs);
    let c = r.sets.counts.as_ref().unwrap();
    assert_eq!((c.offered, c.recorded, c.dropped_total(), c.balances()), (40, recorded, lost, true));
    assert_eq!(c.dropped["write_failed"], lost);
    assert_eq!(r.verdict.health, Health::Lost, "{:?}", r.verdict);
    assert_eq!(r.verdict.headline, format!("Something was lost: {lost} of 40 sets were not recorded."));
    let page = r.to_html();
    for part in [
        format!("<dd>{lost} of 40</dd>"),
        format!("40 offered = {recorded} recorded + {lost} write_failed"),
        "sets · write_failed".to_owned(),
    ] {
        assert!(page.contains(&part), "the page lacks {part}");
    }
    assert!(!page.contains("Nothing was lost"));
    check_page(&page);

    // The outcome of the recording does not apply to a single segment.
    let one = Dataset::open_with(Arc::new(fs.clone()), &segment(0)).unwrap();
    let r = Report::of(&one, &ReportOptions::default(), &mut |_| ControlFlow::Continue(())).unwrap().unwrap();
    assert!(r.sets.counts.is_none_or(|c| c.offered < 40));
}

#[test]
fn what_a_crash_cost_is_told() {
    // As a failing disk leaves it.
    let fs = MemFs::new();
    record(&fs, 9, RecorderOptions { segment_max_ns: 100 * PERIOD, ..options() });
    let mut bytes = contents(&fs, &segment(0));
    let at = bytes.len() * 2 / 5;
    bytes[at..at + 512].fill(0xA5);
    fs.put(&segment(0), bytes);
    recover(&fs).unwrap();
    let r = report(&fs);
    let lost = 9 - r.sets.count;
    assert!(lost > 0);
    let c = r.sets.counts.as_ref().unwrap();
    assert_eq!((c.offered, c.dropped["lost_in_crash"], c.balances()), (9, lost, true));
    assert_eq!(r.verdict.health, Health::Lost, "{:?}", r.verdict);
    assert_eq!(r.verdict.headline, format!("Something was lost: {lost} of 9 sets were not recorded."));
    let page = r.to_html();
    assert!(page.contains("sets · lost_in_crash") && !page.contains("Nothing was lost"));
    check_page(&page);

    // The recorder died; the number of sets that it still had in memory is unknown.
    let fs = MemFs::new();
    let recorder = recorder(&fs, options());
    for n in 0..6 {
        recorder.push(set(&session(), n)).unwrap();
        settle(&recorder);
    }
    drop(recorder);
    recover(&fs).unwrap();
    let r = report(&fs);
    assert_eq!(r.verdict.health, Health::Lost, "{:?}", r.verdict);
    assert!(r.verdict.headline.contains("6 sets are here"), "{}", r.verdict.headline);
    assert!(r.verdict.why[0].contains("was cut off"), "{:?}", r.verdict.why);
    let page = r.to_html();
    assert!(page.contains("none counted") && !page.contains("Nothing was lost"));
    check_page(&page);
}

#[test]
fn damage_and_what_is_unfinished_end_no_report() {
    // As a crash leaves it.
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    for n in 0..6 {
        r.push(set(&session(), n)).unwrap();
        settle(&r);
    }
    drop(r);
    let crashed = report(&fs);
    assert_eq!(
        (crashed.verdict.health, crashed.sets.count),
        (Health::Unfinished, 6),
        "{:?}",
        crashed.verdict
    );
    assert!(crashed.verdict.headline.contains("depthrig recover"), "{}", crashed.verdict.headline);
    assert_eq!(crashed.unfinished, ["seg_0000.mcap.part"]);
    check_page(&crashed.to_html());

    // A flipped byte in every part of a finished file, and the file cut everywhere.
    let fs = MemFs::new();
    record(&fs, 6, options());
    let bytes = contents(&fs, &segment(0));
    for k in 0..60 {
        let at = bytes.len() * k / 60;
        let flipped = copy(&fs);
        let cut = copy(&fs);
        let mut damaged = bytes.clone();
        damaged[at] ^= 0x5a;
        flipped.put(&segment(0), damaged);
        cut.put(&segment(0), bytes[..at].to_vec());
        for (fs, what) in [(flipped, "flipped"), (cut, "cut")] {
            // A file that is not MCAP at all is not a dataset either.
            let Ok(dataset) = Dataset::open_with(Arc::new(fs.clone()), &dir()) else { continue };
            let report = Report::of(&dataset, &ReportOptions::default(), &mut |_| ControlFlow::Continue(()));
            let r = report.unwrap_or_else(|e| panic!("{what} at {at}: {e}")).unwrap();
            assert!(r.sets.count <= 6);
            if what == "cut" || r.sets.count < 6 {
                assert!(r.verdict.health.is_bad(), "{what} at {at}: {:?}", r.verdict);
                assert!(!r.verdict.why.is_empty(), "{what} at {at}");
            }
            check_page(&r.to_html());
        }
    }
}

#[test]
fn a_dataset_without_sets_has_a_report() {
    let fs = MemFs::new();
    recorder(&fs, options()).finish().unwrap();
    let r = report(&fs);
    assert_eq!(r.sets.count, 0);
    check_page(&r.to_html());
    let one = MemFs::new();
    record(&one, 1, options());
    check_page(&report(&one).to_html());
}

#[test]
fn it_can_be_stopped_anywhere_and_progress_grows() {
    let fs = MemFs::new();
    record(&fs, 8, options());
    let mut steps = Vec::new();
    let all = |done| {
        steps.push(done);
        ControlFlow::Continue(())
    };
    let mut all = all;
    Report::of(&open(&fs), &ReportOptions::default(), &mut all).unwrap().unwrap();
    assert!(steps.is_sorted() && steps.iter().all(|s| *s <= 1000), "{steps:?}");
    for stop_at in 0..steps.len() {
        let mut n = 0;
        let mut until = |_| {
            n += 1;
            if n > stop_at { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        assert!(Report::of(&open(&fs), &ReportOptions::default(), &mut until).unwrap().is_none());
    }
}

#[test]
fn chosen_text_is_only_ever_text() {
    const EVIL: &str = "</title><script>alert(1)</script><img src=x onerror='x'> & \"quotes\" \u{1}\u{202e}";
    let mut session = session();
    session.scene = EVIL.into();
    session.operator = EVIL.into();
    session.host = EVIL.into();
    session.name = EVIL.into();
    session.depthrig_version = EVIL.into();
    for s in &mut session.streams {
        s.model = EVIL.into();
        s.serial = EVIL.into();
        s.calibration = EVIL.into();
    }
    let fs = MemFs::new();
    let r = Recorder::create(Arc::new(fs.clone()), &dir(), session.clone(), options()).unwrap();
    r.add_note(EVIL).unwrap();
    r.push(set(&session, 0)).unwrap();
    r.finish().unwrap();
    let changes =
        depthrig_recorder::SessionChanges { scene: Some(format!("new {EVIL}")), ..Default::default() };
    depthrig_recorder::edit(&fs, &dir(), &changes).unwrap();
    let page = report(&fs).to_html();
    check_page(&page);
    assert!(!page.contains("<script") && !page.contains("<img src=x") && !page.contains('\u{1}'));
    assert!(page.matches("&lt;script&gt;").count() >= 12, "{}", page.matches("&lt;script&gt;").count());
}

#[test]
fn the_page_is_written_in_one_step_and_needs_nothing_but_itself() {
    let fs = MemFs::new();
    record(&fs, 3, options());
    let path = dir().join("report.html");
    let r = report(&fs);
    r.write(&fs, &path).unwrap();
    r.write(&fs, &path).unwrap(); // again is fine
    assert_eq!(contents(&fs, &path), r.to_html().into_bytes());
    assert!(names(&fs).contains(&"report.html".to_owned()) && !names(&fs).iter().any(|n| n.contains("tmp")));
    let page = r.to_html();
    // Three sets of three streams.
    assert_eq!(page.matches("src=\"data:image/jpeg;base64,").count(), 9);
    assert_eq!(page.matches("src=").count(), 9);
    for outside in ["http:", "https:", "//", "url(", "@import", "<script", "<link", "<iframe"] {
        let without: String = page.split('"').filter(|part| !part.starts_with("data:")).collect();
        assert!(!without.contains(outside), "the page has {outside}");
    }
    // It does not disturb the dataset.
    let fs: Arc<dyn Fs> = Arc::new(fs);
    let verified =
        depthrig_recorder::verify_with(&fs, &dir(), &depthrig_recorder::VerifyOptions::default()).unwrap();
    assert_eq!(verified.findings, []);
}

#[test]
fn what_lies_beside_the_page_is_left_alone() {
    let fs = MemFs::new();
    record(&fs, 1, options());
    let beside = |name: &str| dir().join(name);
    fs.put(&beside("kitchen.tmp"), b"somebody's".to_vec());
    fs.put(&beside(".kitchen.html.tmp"), b"what a killed report left".to_vec());
    let r = report(&fs);
    r.write(&fs, &beside("kitchen.html")).unwrap();
    assert_eq!(contents(&fs, &beside("kitchen.html")), r.to_html().into_bytes());
    assert_eq!(names(&fs), ["kitchen.html", "kitchen.tmp", "seg_0000.mcap", "session.toml"]);
    assert_eq!(contents(&fs, &beside("kitchen.tmp")), b"somebody's");
    // Without room on the disk the old report stays as it was, and no temporary file is left.
    let full = copy(&fs).with_capacity(1);
    r.write(&full, &beside("kitchen.html")).unwrap_err();
    assert_eq!(names(&full), names(&fs));
}

/// Every pixel format gives an image in the report.
#[test]
fn images_of_every_format_are_shown() {
    let mut session = session();
    session.streams = PixelFormat::ALL
        .into_iter()
        .filter(|f| *f != PixelFormat::Mjpeg && !f.is_motion())
        .enumerate()
        .map(|(i, f)| stream(&format!("cam{i}/x"), f, 32, 24))
        .collect();
    let n = session.streams.len();
    let fs = record_with(&session, 3, |_| (0..n).collect(), &[]);
    let r = report(&fs);
    assert_eq!(r.problem_count, 0, "{:?}", r.problems);
    let page = r.to_html();
    assert_eq!(page.matches("data:image/jpeg").count(), 3 * n);
    check_page(&page);
}

/// Well-formed: tags are balanced, attributes quoted, `&` begins a known entity, text has no control characters.
#[track_caller]
fn check_page(page: &str) {
    let body = page.strip_prefix("<!DOCTYPE html>\n").expect("it begins with the doctype");
    let mut open: Vec<&str> = Vec::new();
    let mut rest = body;
    while let Some(at) = rest.find('<') {
        check_text(&rest[..at]);
        let end = at + rest[at..].find('>').expect("a tag ends");
        let tag = &rest[at + 1..end];
        rest = &rest[end + 1..];
        assert!(!tag.contains('<'), "{tag}");
        if let Some(name) = tag.strip_prefix('/') {
            assert_eq!(open.pop(), Some(name), "</{name}> closes another tag");
            continue;
        }
        let inner = tag.strip_suffix('/').unwrap_or(tag);
        let name = inner.split_whitespace().next().unwrap();
        assert!(name.bytes().all(|b| b.is_ascii_alphanumeric()), "{name}");
        let mut attributes = inner[name.len()..].trim_start();
        while !attributes.is_empty() {
            let (key, value) =
                attributes.split_once("=\"").unwrap_or_else(|| panic!("in <{tag}>: {attributes}"));
            assert!(key.bytes().all(|b| b.is_ascii_alphanumeric() || b"-:".contains(&b)), "<{tag}>: {key}");
            let (value, after) = value.split_once('"').expect("a value ends");
            check_text(value);
            attributes = after.trim_start();
        }
        if !tag.ends_with('/') {
            open.push(name);
        }
    }
    check_text(rest);
    assert_eq!(open, Vec::<&str>::new());
    assert!(!page.contains("NaN") && !page.contains("inf\""), "not a number");
}

#[track_caller]
fn check_text(text: &str) {
    assert!(text.chars().all(|c| !c.is_control() || c == '\n' || c == '\t'), "{text:?}");
    for part in text.split('&').skip(1) {
        let known = ["amp;", "lt;", "gt;", "quot;", "#39;"].iter().any(|e| part.starts_with(e));
        assert!(known, "&{}", part.chars().take(12).collect::<String>());
    }
}
