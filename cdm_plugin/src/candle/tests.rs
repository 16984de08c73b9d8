//! `tests/it/candle.rs` compares with the official code's numbers; here is what needs none.

use super::*;

#[test]
fn the_version_that_is_named_is_the_one_that_runs() {
    let lock = concat!(env!("CARGO_MANIFEST_DIR"), "/../Cargo.lock");
    let lock = std::fs::read_to_string(lock).unwrap();
    let (_, rest) = lock.split_once("name = \"candle-core\"\nversion = \"").unwrap();
    let version = rest.split('"').next().unwrap();
    assert_eq!(DESCRIPTION, format!("candle {version} cpu fp32"));
    assert!(DESCRIPTION.len() <= 31);
}
