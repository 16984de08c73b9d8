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
