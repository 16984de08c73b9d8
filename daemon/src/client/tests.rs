//! Versions; the conversation itself is tested against a live server in `tests/api.rs`.

use super::compatible;

#[test]
fn versions_follow_semantic_versioning() {
    for (a, b) in [("0.1.0", "0.1.7"), ("1.0.0", "1.9.2"), ("0.1.0", "0.1.0-rc.1")] {
        assert!(compatible(a, b) && compatible(b, a), "{a} {b}");
    }
    for (a, b) in [("0.1.0", "0.2.0"), ("1.0.0", "2.0.0"), ("0.1.0", "?"), ("0.1.0", ""), ("?", "?")] {
        assert!(!compatible(a, b), "{a} {b}");
    }
}
