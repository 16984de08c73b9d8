//! `depthrig scenes` from the command line.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/home.rs"]
mod support;

use support::Home;

#[test]
fn a_run_makes_its_shards_once_and_says_what_it_did() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("train");
    let sheet = folder.path().join("sheet.png");
    let [out, sheet] = [&out, &sheet].map(|p| p.to_str().unwrap());
    // A tetrahedron.
    let meshes = folder.path().join("meshes");
    std::fs::create_dir(&meshes).unwrap();
    let obj = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n";
    std::fs::write(meshes.join("a.obj"), obj).unwrap();
    let common = ["scenes", "--seed", "7", "--count", "5", "--per-shard", "2", "--camera", "d435,l515"];
    let rest = ["--size", "64x48", "--out", out, "--json", "--meshes", meshes.to_str().unwrap()];
    let run = |more: &[&str]| {
        let text = Home::new().run(&[&common[..], &rest, more].concat()).good();
        serde_json::from_str::<serde_json::Value>(&text).unwrap()
    };
    let report = run(&["--shard", "1/2", "--preview", sheet]);
    assert_eq!((report["shards"].as_u64(), report["samples"].as_u64()), (Some(1), Some(2)));
    assert!(image::open(sheet).unwrap().width() > 64);
    let report = run(&[]);
    assert_eq!((report["shards_found"].as_u64(), report["samples"].as_u64()), (Some(1), Some(3)));
    assert_eq!(run(&[])["samples"], 0);
    let record = std::fs::read_to_string(folder.path().join("train/scenes.json")).unwrap();
    let record: serde_json::Value = serde_json::from_str(&record).unwrap();
    assert_eq!((record["samples"].as_u64(), record["arguments"]["seed"].as_u64()), (Some(5), Some(7)));
}

#[test]
fn worlds_are_written_as_meshes_and_not_twice() {
    let folder = tempfile::tempdir().unwrap();
    let worlds = folder.path().join("worlds");
    let args = ["scenes", "--count", "1", "--size", "64x48", "--worlds", worlds.to_str().unwrap()];
    Home::new().run(&args).good();
    let world = worlds.join("0000000000");
    let record = std::fs::read_to_string(world.join("world.json")).unwrap();
    let record: serde_json::Value = serde_json::from_str(&record).unwrap();
    let parts = record["parts"].as_array().unwrap();
    for part in parts {
        let bytes = std::fs::read(world.join(part["file"].as_str().unwrap())).unwrap();
        let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        let head = core::str::from_utf8(&bytes[..end]).unwrap();
        let count = |what: &str| {
            let line = head.lines().find(|l| l.starts_with(what)).unwrap();
            line.rsplit(' ').next().unwrap().parse::<usize>().unwrap()
        };
        assert_eq!(bytes.len() - end, count("element vertex") * 36 + count("element face") * 13);
    }
    let shown = image::open(world.join("part.png")).unwrap().into_luma16();
    assert!(shown.pixels().all(|p| usize::from(p.0[0]) < parts.len()));
    let again = Home::new().run(&args);
    assert!(again.code != 0 && again.err.contains("exists"), "{}", again.err);
}

#[test]
fn wrong_arguments_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().to_str().unwrap();
    for (args, word) in [
        (&["--camera", "d9"][..], "d435"),
        (&["--families", "pot"], "bottle"),
        (&["--families", "mesh"], "OBJ"),
        (&["--meshes", out], "OBJ"),
        (&["--shard", "3/3"], "2/8"),
        (&["--size", "7x7"], "7x7"),
        (&["--name", "a/b"], "a/b"),
        (&["--families", "cup", "--without", "cup"], "family"),
    ] {
        let run = Home::new().run(&[&["scenes", "--count", "1", "--out", out], args].concat());
        assert_eq!(run.code, 2, "{args:?}: {}", run.err);
        assert!(run.err.contains(word), "{args:?}: {}", run.err);
    }
}
