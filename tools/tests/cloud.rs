//! `depthrig cloud` of a dataset in which streams are missing now and then.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/home.rs"]
mod support;

use depthrig_tests::fixture::Fixture;
use serde_json::{Value, json};
use support::Home;

const COLOR: [&str; 2] = ["left/color", "right/color"];

/// The fixture's number of its set `n`.
const fn id(n: u64) -> u64 {
    3 * n + 5
}

/// The report of `cloud` on nine sets, of which these lack colour.
fn cloud(without_color: &[u64], options: &[&str]) -> Value {
    let home = Home::new();
    let path = |name: &str| home.path().join(name).to_str().unwrap().to_owned();
    let (dataset, ply) = (path("made"), path("cloud.ply"));
    Fixture { sets: 9, without_color: without_color.to_vec(), ..Fixture::default() }.record(dataset.as_ref());
    let run = |form: &[&str]| {
        home.run(&[&["cloud", &dataset, "--out", &ply, "--overwrite"], options, form].concat()).good()
    };
    let text = run(&[]);
    let value: Value = serde_json::from_str(&run(&["--json"])).unwrap();
    let is_named = text.contains("; no image of left/color, right/color\n");
    assert_eq!(is_named, value["missing"] != json!([]), "{text}");
    value
}

#[test]
fn the_fullest_set_near_the_middle_is_shown_and_what_is_missing_is_named() {
    assert_eq!(cloud(&[], &[])["set"], id(4));
    assert_eq!(cloud(&[4], &[])["set"], id(5));
    assert_eq!(cloud(&[4, 5], &[])["set"], id(3));
    let last = cloud(&[0, 1, 2, 3, 4, 5, 6, 7], &[]);
    assert_eq!((&last["set"], &last["missing"]), (&json!(id(8)), &json!([])));
    // Where none is better, or one is asked for, it is said.
    let none = cloud(&[0, 1, 2, 3, 4, 5, 6, 7, 8], &[]);
    assert_eq!((&none["set"], &none["missing"]), (&json!(id(4)), &json!(COLOR)));
    let asked = cloud(&[4], &["--set", "17"]);
    assert_eq!((&asked["set"], &asked["missing"]), (&json!(id(4)), &json!(COLOR)));
}
