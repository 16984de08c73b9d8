//! LeRobot exports that leave sets out. The content of an export is checked in `tests/python/test_lerobot.py`.

use crate::support::*;
use core::ops::ControlFlow;
use depthrig_convert::lerobot::Lerobot;
use depthrig_convert::{
    ByteCameraExport, CameraNames, ExportOptions, Exporter, Incomplete, RowOptions, export,
};
use depthrig_recorder::fs::{Fs, MemFs, write_all};
use depthrig_recorder::{Episode, Recorder, SESSION_FILE};
use std::path::Path;
use std::sync::Arc;

#[test]
fn sets_that_are_left_out_are_not_counted_as_exported() {
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    for n in 0..5 {
        let streams: &[usize] = if n == 2 { &[0, 2] } else { &[0, 1, 2] };
        r.push(set_of(&session(), n, streams)).unwrap();
        settle(&r);
    }
    r.finish().unwrap();
    let incomplete = Incomplete::LeaveOut;
    let mut lerobot = Lerobot::new(RowOptions { incomplete, ..RowOptions::default() });
    let out = Path::new("/export");
    let on = &mut |_| ControlFlow::Continue(());
    let report = export(&fs, &mut lerobot, vec![open(&fs)], out, ExportOptions::default(), on).unwrap();
    assert_eq!((report.sets, report.frames, report.lost), (4, 12, 0));
    assert_eq!(report.counters["sets that were left out"], 1);
    assert_eq!((report.streams[1].frames, report.streams[1].missing), (4, 1));
}

#[test]
fn each_used_episode_is_one_of_the_export_and_nothing_else_is() {
    let fs = MemFs::new();
    let mut session = session();
    let episode = |number: u32, from: i64, to: Option<i64>, more: &str| -> Episode {
        let end = to.map(|n| format!("end_utc_ns = {}\n", T0 + n * PERIOD)).unwrap_or_default();
        let start = T0 + from * PERIOD - 1;
        toml::from_str(&format!(
            "number = {number}\ntask = \"t{number}\"\nstart_utc_ns = {start}\n{end}{more}"
        ))
        .unwrap()
    };
    session.episodes = vec![
        episode(1, 1, Some(3), ""),
        episode(2, 4, Some(5), "discarded = true"),
        episode(3, 6, Some(6), "outcome = \"failure\""),
        episode(4, 8, None, ""),
    ];
    let r = Recorder::create(Arc::new(fs.clone()), &dir(), session.clone(), options()).unwrap();
    for n in 0..10 {
        r.push(set_of(&session, n, &[0, 1, 2])).unwrap();
        settle(&r);
    }
    r.finish().unwrap();
    // As after a kill: the last one has no end.
    let path = dir().join(SESSION_FILE);
    let text = String::from_utf8(contents(&fs, &path)).unwrap();
    let mut table: toml::Table = text.parse().unwrap();
    table["episodes"][3].as_table_mut().unwrap().remove("end_utc_ns");
    fs.remove_file(&path).unwrap();
    write_all(&mut *fs.create_new(&path).unwrap(), table.to_string().as_bytes()).unwrap();

    let export_to = |out: &str, exporter: &mut dyn Exporter| {
        let on = &mut |_| ControlFlow::Continue(());
        export(&fs, exporter, vec![open(&fs)], Path::new(out), ExportOptions::default(), on)
    };
    let report = export_to("/export", &mut Lerobot::new(RowOptions::default())).unwrap();
    // Sets 1 to 3, and 6.
    assert_eq!((report.sets, report.frames, report.lost), (4, 12, 0));
    assert_eq!(report.datasets.len(), 1);
    assert_eq!((report.streams.len(), report.streams[1].frames), (3, 4));
    let said = report.losses.join("\n");
    assert!(said.contains("episode 2 (discarded), episode 4 (running or cut off)"), "{said}");
    let text = contents(&fs, Path::new("/export/calibration.json"));
    let calibration: serde_json::Value = serde_json::from_slice(&text).unwrap();
    let numbers: Vec<_> =
        (0..2).map(|i| calibration["episodes"][i]["episode"]["number"].as_u64().unwrap()).collect();
    assert_eq!(numbers, [1, 3]);
    // Whole recordings lack the discarded one alone.
    let report =
        export_to("/folders", &mut ByteCameraExport::new(CameraNames::default(), None).unwrap()).unwrap();
    assert_eq!(report.sets, 8);
}
