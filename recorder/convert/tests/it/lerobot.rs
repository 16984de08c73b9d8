//! LeRobot exports that leave sets out. The content of an export is checked in `tests/python/test_lerobot.py`.

use crate::support::*;
use core::ops::ControlFlow;
use depthrig_convert::lerobot::{Incomplete, Lerobot, LerobotOptions};
use depthrig_convert::{ExportOptions, export};
use depthrig_recorder::fs::MemFs;
use std::path::Path;

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
    let mut lerobot = Lerobot::new(LerobotOptions { incomplete, ..LerobotOptions::default() });
    let out = Path::new("/export");
    let on = &mut |_| ControlFlow::Continue(());
    let report = export(&fs, &mut lerobot, vec![open(&fs)], out, ExportOptions::default(), on).unwrap();
    assert_eq!((report.sets, report.frames, report.lost), (4, 12, 0));
    assert_eq!(report.counters["sets that were left out"], 1);
    assert_eq!((report.streams[1].frames, report.streams[1].missing), (4, 1));
}
