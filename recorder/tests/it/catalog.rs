//! The list of a folder's datasets: its entries for good and for damaged ones, and how little it reads.

use crate::support::*;
use depthrig_recorder::fs::{MemFs, RealFs};
use depthrig_recorder::{
    CatalogEntry, Health, Recorder, RecorderOptions, SESSION_FILE, VerifyOptions, catalog, verify,
};
use std::path::Path;
use std::sync::Arc;

/// Records `sets` sets in segments of two.
fn write(dir: &Path, scene: &str, sets: u64) {
    let mut session = session();
    session.scene = scene.into();
    session.name = dir.file_name().unwrap().to_string_lossy().into_owned();
    let options = RecorderOptions { segment_max_ns: 2 * PERIOD, ..options() };
    let r = Recorder::create(Arc::new(RealFs), dir, session.clone(), options).unwrap();
    for n in 0..sets {
        r.push(set(&session, n)).unwrap();
        settle(&r);
    }
    r.finish().unwrap();
}

fn entry<'a>(list: &'a [CatalogEntry], name: &str) -> &'a CatalogEntry {
    list.iter().find(|e| e.path.ends_with(name)).unwrap_or_else(|| panic!("{name} is not in the list"))
}

#[test]
fn good_and_bad_ones_are_listed_with_the_reason() {
    let home = tempfile::tempdir().unwrap();
    let at = |name: &str| home.path().join(name);
    for name in ["whole", "cut", "full", "gap", "no_session", "bad_session", "less", "lost", "open", "part"] {
        write(&at(name), "a <b>", 5);
    }
    std::fs::create_dir_all(at("more")).unwrap();
    write(&at("more/inner"), "deeper", 1);
    std::fs::create_dir_all(at("more/still/deeper")).unwrap();
    std::fs::create_dir_all(at("nothing")).unwrap();
    std::fs::write(at("file.txt"), "no folder").unwrap();

    let segment = |name: &str, i: u32| at(name).join(format!("seg_{i:04}.mcap"));
    let bytes = std::fs::read(segment("cut", 1)).unwrap();
    std::fs::write(segment("cut", 1), &bytes[..bytes.len() - 9]).unwrap();
    std::fs::remove_file(segment("gap", 1)).unwrap();
    std::fs::remove_file(at("no_session").join(SESSION_FILE)).unwrap();
    std::fs::write(at("bad_session").join(SESSION_FILE), "= =").unwrap();
    std::fs::remove_file(segment("less", 2)).unwrap();
    let edit = |name: &str, from: &str, to: &str| {
        let path = at(name).join(SESSION_FILE);
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.contains(from), "{text}");
        std::fs::write(path, text.replace(from, to)).unwrap();
    };
    edit(
        "lost",
        "complete = true",
        "complete = false\nlost = [\"2 of 7 sets were not recorded: disk_slow\"]",
    );
    edit("lost", "[outcome]", "[outcome.sets_dropped]\ndisk_slow = 2\n\n[outcome]");
    edit("full", "complete = true", "complete = false\nlost = [\"the disk was full\"]");
    edit("open", "[outcome]", "[was_outcome]");
    edit("part", "[outcome]", "[was_outcome]");
    std::fs::rename(segment("part", 2), at("part").join("seg_0002.mcap.part")).unwrap();

    let list = catalog(&RealFs, home.path()).unwrap();
    let names: Vec<_> =
        list.iter().map(|e| e.path.strip_prefix(home.path()).unwrap().to_str().unwrap()).collect();
    let expected = [
        "bad_session",
        "cut",
        "full",
        "gap",
        "less",
        "lost",
        "more/inner",
        "no_session",
        "open",
        "part",
        "whole",
    ];
    assert_eq!(names, expected);
    for (name, health, sets, why) in [
        ("whole", Health::Whole, 5, ""),
        ("inner", Health::Whole, 1, ""),
        ("cut", Health::Damaged, 3, "seg_0001.mcap has no footer"),
        ("gap", Health::Damaged, 2, "seg_0001.mcap is missing"),
        ("less", Health::Damaged, 4, "says 5 sets, the segments hold 4"),
        ("no_session", Health::Damaged, 5, "session.toml is missing"),
        ("bad_session", Health::Damaged, 5, "session.toml cannot be read"),
        ("full", Health::Lost, 5, "the disk was full"),
        ("lost", Health::Lost, 5, "2 of 7 sets were not recorded: disk_slow"),
        ("open", Health::Unfinished, 5, "depthrig recover"),
        ("part", Health::Unfinished, 4, "seg_0002.mcap.part was not finished: run depthrig recover"),
    ] {
        let e = entry(&list, name);
        assert_eq!((e.health, e.sets), (health, sets), "{name}: {:?}", e.why);
        assert!(e.why.iter().any(|w| w.contains(why)) || why.is_empty(), "{name}: {:?}", e.why);
        assert_eq!(e.health == Health::Whole, e.why.is_empty(), "{name}: {:?}", e.why);
        let on_disk = std::fs::read_dir(&e.path).unwrap().map(|f| f.unwrap());
        let mcap = on_disk.filter(|f| f.file_name().to_string_lossy().starts_with("seg_"));
        assert_eq!(e.bytes, mcap.map(|f| f.metadata().unwrap().len()).sum::<u64>(), "{name}");
    }
    let whole = entry(&list, "whole");
    assert_eq!((whole.scene.as_str(), whole.operator.as_str(), whole.streams), ("a <b>", "nobody", 3));
    assert_eq!((whole.started_utc_ns, whole.duration_ns, whole.segments), (Some(T0), 4 * PERIOD, 3));
    assert_eq!(entry(&list, "lost").sets_lost, 2);
    assert_eq!(entry(&list, "full").why, ["the disk was full"], "no set is counted as lost");
    // The path may be a dataset itself.
    assert_eq!(&catalog(&RealFs, &at("whole")).unwrap()[..], std::slice::from_ref(whole));
    // `verify` agrees that it is complete.
    assert!(verify(&at("whole"), &VerifyOptions::default()).unwrap().is_whole());
    assert!(catalog(&RealFs, &at("not there")).is_err());
    assert!(catalog(&RealFs, &at("file.txt")).is_err());
}

/// However many bytes of a segment are damaged, the list goes on and the numbers stay sane.
#[test]
fn damaged_ends_of_segments_end_nothing() {
    let fs = MemFs::new();
    record(&fs, 2, options());
    let bytes = contents(&fs, &segment(0));
    for back in 1..600.min(bytes.len()) {
        for value in [0, 0xff] {
            let mut bytes = bytes.clone();
            let at = bytes.len() - back;
            bytes[at] = value;
            let fs = copy(&fs);
            fs.put(&segment(0), bytes);
            let e = depthrig_recorder::look_at(&fs, &dir());
            assert!(e.health == Health::Damaged || e.sets == 2, "byte -{back} = {value}: {e:?}");
        }
    }
}

/// The number of file operations does not grow with the dataset: only its end is read.
#[test]
fn only_the_end_of_a_segment_is_read() {
    let ops = |sets| {
        let fs = MemFs::new();
        record(&fs, sets, options());
        let fs = copy(&fs);
        let e = depthrig_recorder::look_at(&fs, &dir());
        assert_eq!((e.health, e.sets), (Health::Whole, sets));
        fs.ops()
    };
    let one = ops(1);
    assert!(one >= 6, "reads are not counted");
    assert_eq!(one, ops(40));
}
