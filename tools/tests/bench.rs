//! `depthrig bench bus --quick`: it measures, it says so in JSON, and one copy is one copy.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use std::process::Command;

#[test]
fn the_bus_bench_measures_and_counts_one_copy() {
    let ran = Command::new(env!("CARGO_BIN_EXE_depthrig"))
        .args(["bench", "bus", "--quick", "--json", "-q"])
        .output()
        .unwrap();
    assert!(ran.status.success(), "{}", String::from_utf8_lossy(&ran.stderr));
    let report: serde_json::Value = serde_json::from_slice(&ran.stdout).unwrap();
    // Times mean nothing in a debug build on a loaded machine; these do.
    let copies = &report["copies"];
    assert_eq!(copies["in_place"], copies["frames"], "a frame was read elsewhere than where it was written");
    assert!(copies["frames"].as_u64().unwrap() >= 10);
    assert_eq!(copies["writes_per_byte"].as_f64().unwrap(), 1.0);
    assert!(report["latency"]["ours"]["n"].as_u64().unwrap() > 20);
    assert!(report["latency"]["bare"]["n"].as_u64().unwrap() > 20);
    assert!(report["load"]["sent"].as_u64().unwrap() > 200);
    assert!(report["load"]["kills"].as_u64().unwrap() >= 1);
    assert_eq!(report["conditions"]["build"], if cfg!(debug_assertions) { "debug" } else { "release" });
}

/// The short form of the ten-minute recording in docs/performance.md: five minutes of small images.
#[test]
fn memory_stays_where_it_is_in_a_long_recording() {
    let dir = tempfile::tempdir().unwrap();
    let ran = Command::new(env!("CARGO_BIN_EXE_depthrig"))
        .args(["bench", "soak", "--quick", "--json", "-q", "--dir"])
        .arg(dir.path())
        .output()
        .unwrap();
    let report: serde_json::Value = serde_json::from_slice(&ran.stdout).unwrap();
    let slope = report["slope_mb_per_min"].as_f64().unwrap();
    // Pages that the allocator keeps are up to 0.6 of this; a set that is forgotten each minute would not be seen, one
    // frame header of every set is 3.2.
    assert!(slope < 2.0, "{slope} MB per minute: {}", report["samples"]);
    assert_eq!((report["unexplained"].as_i64(), report["findings"].as_array().unwrap().len()), (Some(0), 0));
    assert_eq!((report["pushed"].as_u64(), report["recorded"].as_u64()), (Some(1500), Some(1500)));
    assert_eq!(report["samples"].as_array().unwrap().len(), 300);
    assert!(report["segments"].as_u64().unwrap() >= 5 && report["rss_mb"][0].as_f64().unwrap() > 1.0);
    assert!(std::fs::read_dir(dir.path()).unwrap().next().is_none(), "the dataset is still there");
}
