use super::*;
use depthrig_sim::synthetic::scenes::{Settings, TRUTH_UNIT_M};
use std::collections::BTreeMap;
use std::fs::OpenOptions;

fn generator() -> Generator {
    Generator::new(Settings { seed: 3, width: 64, height: 48, ..Settings::default() }).unwrap()
}

fn plan(folder: &Path) -> Plan {
    Plan {
        folder: folder.to_owned(),
        remote: None,
        name: "t".into(),
        count: 7,
        per_shard: 3,
        part: RunPart::ALL,
        threads: 2,
    }
}

fn go(plan: &Plan) -> Report {
    write(&generator(), plan, &mut |_, _| true).unwrap()
}

/// Names and contents of every file of a folder.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap());
    entries.map(|e| (e.file_name().into_string().unwrap(), std::fs::read(e.path()).unwrap())).collect()
}

/// Members of a tar file, as the program `tar` of this computer lists and extracts them.
fn untar(path: &Path) -> Vec<(String, Vec<u8>)> {
    let tar = |args: &[&str]| {
        let out = std::process::Command::new("tar").args(args).arg("-f").arg(path).output().unwrap();
        assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
        out.stdout
    };
    let names = String::from_utf8(tar(&["-t"])).unwrap();
    names
        .lines()
        .map(|n| {
            let out = std::process::Command::new("tar").args(["-xOf"]).arg(path).arg(n).output().unwrap();
            (n.to_owned(), out.stdout)
        })
        .collect()
}

#[test]
fn a_shard_holds_its_samples_as_the_format_says() {
    let dir = tempfile::tempdir().unwrap();
    let report = go(&plan(dir.path()));
    assert_eq!((report.shards, report.shards_found, report.shards_missing, report.samples), (3, 0, 0, 7));
    let names: Vec<String> = files(dir.path()).into_keys().collect();
    assert_eq!(names, ["t-000000.tar", "t-000001.tar", "t-000002.tar", "t.json"]);
    let members = untar(&dir.path().join("t-000001.tar"));
    assert_eq!(members.len(), 18);
    for (i, (name, content)) in members.iter().enumerate() {
        let kind = ["color.png", "truth.png", "raw.png", "filled.png", "material.png", "json"][i % 6];
        let number = 3 + i as u64 / 6;
        assert_eq!(*name, format!("{number:010}.{kind}"));
        let made = generator().sample(number).unwrap();
        if kind == "json" {
            let v: serde_json::Value = serde_json::from_slice(content).unwrap();
            assert_eq!(v["truth_unit_m"], TRUTH_UNIT_M);
            assert_eq!(v["sensor"], "d435");
            assert_eq!(v["intrinsics"]["fx"], made.intrinsics.fx);
            assert_eq!(v["intrinsics"]["model"], "none");
            let keys: Vec<&str> = v.as_object().unwrap().keys().map(String::as_str).collect();
            let mut known = [
                "format",
                "sensor",
                "sensor_model",
                "seed",
                "families",
                "scene",
                "intrinsics",
                "truth_unit_m",
                "raw_unit_m",
                "hidden",
                "width",
                "height",
                "licence",
            ];
            known.sort_unstable();
            let mut keys = keys;
            keys.sort_unstable();
            assert_eq!(keys, known);
            continue;
        }
        let image = image::load_from_memory(content).unwrap();
        assert_eq!((image.width(), image.height()), (64, 48));
        match kind {
            "color.png" => assert_eq!(image.as_rgb8().unwrap().as_raw(), &made.color),
            "truth.png" => assert_eq!(image.as_luma16().unwrap().as_raw(), &made.truth),
            "raw.png" => assert_eq!(image.as_luma16().unwrap().as_raw(), &made.raw),
            "filled.png" => assert_eq!(image.as_luma16().unwrap().as_raw(), &by_fill(&made)),
            _ => assert_eq!(image.as_luma8().unwrap().as_raw(), &made.material),
        }
    }
}

#[test]
fn parts_made_anywhere_are_the_bytes_of_the_run() {
    let one = tempfile::tempdir().unwrap();
    let two = tempfile::tempdir().unwrap();
    go(&plan(one.path()));
    for k in [1, 0] {
        go(&Plan { part: [k, 2].try_into().unwrap(), threads: 1, ..plan(two.path()) });
    }
    assert_eq!(files(one.path()), files(two.path()));
}

#[test]
fn an_interrupted_run_goes_on_and_ends_with_the_same_bytes() {
    let whole = tempfile::tempdir().unwrap();
    go(&plan(whole.path()));
    let dir = tempfile::tempdir().unwrap();
    // Ended within the second shard.
    let report = write(&generator(), &plan(dir.path()), &mut |done, _| done < 6).unwrap();
    assert_eq!((report.shards, report.shards_missing), (3, 2));
    let names: Vec<String> = files(dir.path()).into_keys().collect();
    assert_eq!(names, ["t-000000.tar", "t.json"], "no half shard is left");
    // What a kill leaves behind, and a shard that a copy cut.
    std::fs::write(dir.path().join("t-000001.tar.part"), b"half").unwrap();
    let cut = dir.path().join("t-000000.tar");
    let bytes = std::fs::read(&cut).unwrap();
    std::fs::write(&cut, &bytes[..bytes.len() - 512]).unwrap();
    let report = go(&plan(dir.path()));
    assert_eq!((report.shards_found, report.samples), (0, 7));
    assert_eq!(files(dir.path()), files(whole.path()));
    let report = go(&plan(dir.path()));
    assert_eq!((report.shards_found, report.samples, report.bytes), (3, 0, 0));
}

#[test]
fn a_damaged_shard_is_not_whole() {
    let dir = tempfile::tempdir().unwrap();
    let p = plan(dir.path());
    go(&p);
    let path = p.path(0);
    assert!(tar::is_whole(&path, 0..3) && !tar::is_whole(&path, 0..4) && !tar::is_whole(&path, 1..3));
    let good = std::fs::read(&path).unwrap();
    for keep in [0, 511, 1024, good.len() - 1024, good.len() - 1] {
        std::fs::write(&path, &good[..keep]).unwrap();
        assert!(!tar::is_whole(&path, 0..3), "{keep} bytes of {}", good.len());
    }
    std::fs::write(&path, [good.as_slice(), &[0]].concat()).unwrap();
    assert!(!tar::is_whole(&path, 0..3), "something follows");
}

#[test]
fn another_run_another_process_and_impossible_plans_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    go(&plan(dir.path()));
    let refused = |plan: &Plan| write(&generator(), plan, &mut |_, _| true).unwrap_err();
    let e = refused(&Plan { count: 8, ..plan(dir.path()) });
    assert!(e.to_string().contains("t.json") && e.to_string().contains("--name"), "{e}");
    std::fs::remove_file(plan(dir.path()).path(1)).unwrap();
    let part = File::create(dir.path().join("t-000001.tar.part")).unwrap();
    part.lock().unwrap();
    let e = refused(&plan(dir.path()));
    assert_eq!(e.kind(), ErrorKind::InUse, "{e}");
    for bad in [Plan { name: "../t".into(), ..plan(dir.path()) }, Plan { per_shard: 0, ..plan(dir.path()) }] {
        assert_eq!(refused(&bad).kind(), ErrorKind::BadInput);
    }
}

#[test]
fn a_shard_that_was_made_meanwhile_is_left_alone() {
    let dir = tempfile::tempdir().unwrap();
    let p = plan(dir.path());
    let mut is_first = true;
    let report = write(&generator(), &p, &mut |_, _| {
        // Another process makes all of them between the list of what is missing and the first shard.
        if std::mem::take(&mut is_first) {
            go(&p);
        }
        true
    });
    let report = report.unwrap();
    assert_eq!((report.shards_found, report.samples, report.shards_missing), (3, 0, 0));
    assert_eq!(files(dir.path()).len(), 4, "three shards and their arguments");
}

#[test]
fn a_full_disk_is_an_error_and_leaves_no_shard() {
    let e = Tar::full();
    assert_eq!(e.kind(), ErrorKind::DiskFull, "{e}");
    assert!(e.to_string().contains("the disk is full"), "{e}");
}

struct Tar;

impl Tar {
    /// The error of writing a member to a disk that is full.
    fn full() -> Error {
        let full = OpenOptions::new().write(true).open("/dev/full").unwrap();
        let mut out = tar::Tar::new(full);
        Error::io("write", Path::new("x.tar"), out.append("a", &[1; 4096]).unwrap_err())
    }
}

/// Measured depth as the refiner of the daemon fills it, every hole.
fn by_fill(s: &depthrig_sim::synthetic::scenes::Triplet) -> Vec<u16> {
    use depthrig_cdm::{Color, ColorFormat, FillRefiner, Job, Output, RawDepth, Refiner, StepTimes};
    let mut out = vec![0; s.raw.len()];
    let mut jobs = [Job {
        color: Color { pixels: &s.color, format: ColorFormat::Rgb8, width: 64, height: 48, stride: 192 },
        depth: RawDepth { pixels: &s.raw, unit_m: s.raw_unit_m },
        out: Output::Units { pixels: &mut out, unit_m: s.raw_unit_m },
        steps: StepTimes::default(),
    }];
    FillRefiner::new(1).unwrap().with_reach(1.0).refine(&mut jobs).unwrap();
    assert!(out.iter().all(|z| *z > 0), "every hole is filled");
    out
}

#[test]
fn hidden_regions_are_holes_before_they_are_filled_and_the_record_has_their_share() {
    let settings = |hide| Settings { seed: 3, width: 64, height: 48, hide, ..Settings::default() };
    let plain = Generator::new(settings(0.0)).unwrap();
    let hiding = Generator::new(settings(0.6)).unwrap();
    let mut fill = sample::fill().unwrap();
    let mut hidden = 0;
    for number in 0..40 {
        let before = plain.sample(number).unwrap();
        let s = hiding.sample(number).unwrap();
        let members = sample::members(&s, hiding.settings(), &mut fill).unwrap();
        let member = |kind: &str| &members.iter().find(|(name, _)| name.ends_with(kind)).unwrap().1;
        let v: serde_json::Value = serde_json::from_slice(member("json")).unwrap();
        let count = |raw: &[u16]| raw.iter().filter(|z| **z > 0).count() as f64;
        let share = 1.0 - count(&s.raw) / count(&before.raw);
        assert!((v["hidden"].as_f64().unwrap() - share).abs() < 1e-4, "sample {number}: {share}");
        let filled = image::load_from_memory(member("filled.png")).unwrap();
        assert_eq!(filled.as_luma16().unwrap().as_raw(), &by_fill(&s));
        assert!((&before.color, &before.truth) == (&s.color, &s.truth));
        hidden += u32::from(share > 0.0);
    }
    assert!((15..=33).contains(&hidden), "{hidden} of 40");
    assert!(Generator::new(settings(1.5)).unwrap_err().to_string().contains("0..=1"));
}

#[test]
fn a_dataset_has_a_world_each_set_and_one_lens() {
    use depthrig_recorder::fs::RealFs;
    use depthrig_recorder::{ColorCodec, Dataset, RecorderOptions, SetRange};
    use std::ops::ControlFlow;
    use std::sync::Arc;

    let settings = Settings { nominal_lens: true, ..generator().settings().clone() };
    let made = Generator::new(settings.clone()).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("random");
    let mut sets = SceneSets::new(Generator::new(settings).unwrap(), 3, "random".into()).unwrap();
    let options = RecorderOptions { color: ColorCodec::Raw, ..RecorderOptions::default() };
    let report =
        crate::import(&mut sets, Arc::new(RealFs), &out, options, &mut |_| ControlFlow::Continue(()));
    assert_eq!(report.unwrap().facts.lost, 0);

    let dataset = Dataset::open(&out).unwrap();
    let names: Vec<String> = dataset.session().streams.iter().map(|s| s.id.to_string()).collect();
    assert_eq!(names, ["d435/color", "d435/depth", "d435/depth_true_color"]);
    let mut number = 0;
    for set in dataset.sets(SetRange::default()) {
        let set = set.unwrap();
        let sample = made.sample(number).unwrap();
        let units = |v: &[u16]| v.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
        let expected = [sample.color, units(&sample.raw), units(&sample.truth)];
        for (frame, pixels) in set.frames.iter().zip(&expected) {
            assert_eq!(frame.pixels, *pixels, "set {number}, {}", names[frame.stream]);
            assert_eq!(frame.header.intrinsics, sample.intrinsics);
            assert_eq!(frame.header.capture_time_ns, number as i64 * 200_000_000);
        }
        assert_eq!(set.frames.len(), 3);
        number += 1;
    }
    assert_eq!(number, 3);
    // The default lens differs from one sample to the next.
    assert_ne!(generator().sample(0).unwrap().intrinsics, generator().sample(1).unwrap().intrinsics);
    let refused = |settings: Settings| {
        let sets = SceneSets::new(Generator::new(settings).unwrap(), 3, "random".into());
        sets.err().map(|e| e.to_string()).unwrap_or_default()
    };
    assert!(refused(generator().settings().clone()).contains("nominal"));
    let two = vec!["d435".to_owned(), "l515".to_owned()];
    assert!(
        refused(Settings { cameras: two, nominal_lens: true, ..Settings::default() }).contains("d435,l515")
    );
}
