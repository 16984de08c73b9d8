//! A process killed while it records, on the real file system.

use crate::support::*;
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{Dataset, Recorder, RecorderOptions, SetRange};
use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::Arc;

/// Where the child records; without it the child's test does nothing.
const DIR: &str = "DEPTHRIG_TEST_KILL_DIR";

/// Not a test of its own: what the test below starts and kills. It says each set that is written.
#[test]
fn child() {
    let Some(dir) = std::env::var_os(DIR).map(PathBuf::from) else { return };
    let limits = RecorderOptions { segment_max_ns: 20 * PERIOD, sync_interval_ns: 20_000_000, ..options() };
    let r = Recorder::create(Arc::new(RealFs), &dir, session(), limits).unwrap();
    // Far more than it will live to see, and an end should nobody kill it.
    for n in 0..5_000 {
        r.push(set(&session(), n)).unwrap();
        settle(&r);
        println!("\nwritten {}", n + 1);
        std::io::stdout().flush().unwrap();
    }
}

#[test]
fn a_killed_process_loses_nothing_that_was_written() {
    for kill_after in [1, 7, 19, 20, 21, 45] {
        let parent = tempfile::tempdir().unwrap();
        let dir = parent.path().join("killed");
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "kill::child", "--nocapture"])
            .env(DIR, &dir)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut written = 0;
        for line in BufReader::new(child.stdout.take().unwrap()).lines() {
            let Ok(line) = line else { break };
            if let Some(n) = line.strip_prefix("written ") {
                written = n.parse().unwrap();
                if written == kill_after {
                    child.kill().unwrap();
                }
            }
        }
        child.wait().unwrap();
        assert!((kill_after..4_000).contains(&written), "it was killed at {written}");
        let mut ids = Vec::new();
        for s in Dataset::open(&dir).unwrap().sets(SetRange::ALL).filter_map(Result::ok) {
            let want = set(&session(), s.id - 1);
            assert_eq!(s.frames[1].pixels, want.frames[1].pixels.bytes());
            ids.push(s.id);
        }
        // One more may have been written and not yet said.
        assert_eq!(ids, (1..=ids.len() as u64).collect::<Vec<_>>());
        assert!(ids.len() as u64 >= written, "{} of {written} sets are there", ids.len());
    }
}
