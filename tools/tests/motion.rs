//! An IMU from the command line: in `tap`, in the status, in a dataset.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/home.rs"]
mod support;

use support::Home;

#[test]
fn an_imu_is_tapped_shown_and_recorded() {
    let home = Home::new();
    let rig = home.path().join("rig.toml");
    let text = "rig = \"moved\"\n[recording]\nallow = [\"data\"]\nreserve_mb = 0\nmin_minutes = 0\n[[camera]]\nname = \"cam\"\n\
                backend = \"synthetic\"\ncheap = true\n[[camera.stream]]\nname = \"color\"\nwidth = 64\nheight = 48\n\
                [[camera.stream]]\nname = \"imu\"\n";
    std::fs::write(&rig, text).unwrap();
    let planned = home.run(&["doctor", rig.to_str().unwrap()]).out;
    assert!(planned.contains("imu motion@200"), "{planned}");
    let running = home.start(&["run", rig.to_str().unwrap(), "-q"]);
    home.wait_for_rig("moved");

    let lines = home.run(&["tap", "cam/imu", "--count", "3"]).good();
    assert_eq!(
        lines.lines().filter(|l| l.starts_with("cam/imu #") && l.contains(" 8 samples ")).count(),
        3,
        "{lines}"
    );
    let json = home.run(&["tap", "cam/imu", "--count", "2", "--json"]).good();
    let batches: Vec<serde_json::Value> = json.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    assert_eq!(batches.len(), 2);
    let numbers: Vec<u64> = batches
        .iter()
        .flat_map(|b| b["samples"].as_array().unwrap())
        .map(|s| s["sequence"].as_u64().unwrap())
        .collect();
    let in_order = |batch: &[u64]| batch.windows(2).all(|w| w[1] == w[0] + 1);
    assert!(numbers.len() == 16 && numbers.chunks(8).all(in_order), "{numbers:?}");
    // A busy computer may be too late for batches between the two.
    assert!(numbers[8] > numbers[7] && (numbers[8] - numbers[7]) % 8 == 1, "{numbers:?}");
    let images = home.path().join("images");
    for (wrong, why) in [
        (
            &["tap", "cam/imu", "--count", "1", "--png", images.to_str().unwrap()][..],
            "cam/imu is an IMU and has no images",
        ),
        (&["tap", "cam/color", "--count", "1", "--json"], "cam/color is an image stream"),
    ] {
        let refused = home.run(wrong);
        assert!(refused.code == 1 && refused.err.contains(why), "{}", refused.err);
    }
    assert!(!images.exists(), "what is refused leaves nothing");
    let status = home.run(&["status"]).good();
    let row = status.lines().find(|l| l.starts_with("cam/imu")).unwrap();
    assert!(row.contains("motion") && !row.contains("8x1"), "{row}");

    let out = home.path().join("data");
    home.run(&["record", "start", "--out", out.to_str().unwrap(), "--name", "moving"]).good();
    home.wait_for_sets(5);
    home.run(&["record", "stop"]).good();
    let data = out.join("moving");
    let info = home.run(&["info", data.to_str().unwrap()]).good();
    let row = info.lines().find(|l| l.starts_with("cam/imu")).unwrap();
    let lost = row.split_whitespace().last().unwrap().parse::<u64>().unwrap();
    let status: serde_json::Value = serde_json::from_str(&home.run(&["status", "--json"]).done()).unwrap();
    let streams = status["cameras"][0]["streams"].as_array().unwrap();
    let missed = streams.iter().find(|s| s["id"] == "cam/imu").unwrap()["in_sets"]["missed"].as_u64();
    assert!(Some(lost) <= missed, "no batch is lost but those that the rig missed, {missed:?}: {info}");
    home.run(&["verify", data.to_str().unwrap(), "--decode"]).good();
    // 3: on a busy machine an image is lost now and then.
    assert!(matches!(running.signal("TERM").code, 0 | 3));
}
