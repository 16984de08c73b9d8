//! Invalid or unreadable datasets and recordings: every command that takes one fails with 1, names it, and writes
//! nothing.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/home.rs"]
mod support;

use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt as _;
use support::{Home, Ran};

/// The commands, with IN for their input and OUT for their output.
const COMMANDS: [&str; 21] = [
    "info IN",
    "verify IN",
    "report IN --out OUT",
    "sessions IN",
    "edit IN --scene new",
    "recover IN",
    "recover IN --dry-run",
    "compare IN IN",
    "cat IN",
    "trim IN OUT",
    "merge OUT IN",
    "replay IN",
    "export bytecameradepth IN OUT",
    "export lerobot IN OUT",
    "export hdf5 IN OUT",
    "export zarr IN OUT",
    "eval IN --out OUT",
    "cdm relabel IN OUT --engine fill",
    "zed replay IN --out OUT --modes quality",
    "import kinect IN OUT",
    "import rosbag IN OUT",
];

fn run(home: &Home, command: &str, input: &str) -> Ran {
    let out = home.path().join("out");
    let of = |word: &str| match word {
        "IN" => input.to_owned(),
        "OUT" => out.to_str().unwrap().to_owned(),
        word => word.to_owned(),
    };
    let words: Vec<_> = command.split(' ').map(of).collect();
    home.run(&words.iter().map(String::as_str).collect::<Vec<_>>())
}

/// Asserts this for every command with this input.
#[track_caller]
fn refused(home: &Home, input: &str, said: &[&str], commands: impl IntoIterator<Item = &'static str>) {
    for command in commands {
        let ran = run(home, command, input);
        assert_eq!(ran.code, 1, "{command}, {input}: {}{}", ran.out, ran.err);
        assert!(ran.err.starts_with("depthrig: error: "), "{command}, {input}: {}", ran.err);
        for said in [&[input][..], said].concat() {
            assert!(ran.err.contains(said), "{command}, {input} does not say \"{said}\": {}", ran.err);
        }
        let left: Vec<_> = std::fs::read_dir(home.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        assert!(!left.iter().any(|n| n.to_string_lossy().starts_with("out")), "{command}, {input}: {left:?}");
    }
}

#[test]
fn what_is_no_dataset_or_recording_is_a_failure_of_every_command() {
    let home = Home::new();
    let files = ["seg_0000.mcap", "a.svo2", "a.mkv", "a.bag", "notes.txt"];
    for name in files {
        let empty = home.write(name, "");
        refused(&home, &empty, &[], COMMANDS);
        let text = home.write(name, "no dataset\n");
        refused(&home, &text, &[], COMMANDS);
    }
    refused(&home, home.path().join("nowhere").to_str().unwrap(), &[], COMMANDS);
    // A folder without a dataset is a list of none, and for the others no dataset.
    let folder = home.path().join("folder");
    std::fs::create_dir(&folder).unwrap();
    let input = folder.to_str().unwrap();
    let commands = || COMMANDS.into_iter().filter(|c| *c != "sessions IN");
    refused(&home, input, &[], commands().chain(["import bytecameradepth IN OUT"]));
    assert_eq!(run(&home, "sessions IN", input).code, 0);
    // One whose session is not one; `sessions` lists it as damaged.
    std::fs::write(folder.join("session.toml"), "hello").unwrap();
    refused(&home, input, &[], commands());
    assert_eq!(run(&home, "sessions IN", input).code, 3);
}

#[test]
fn what_may_not_be_read_is_a_failure_that_says_how_it_can_be() {
    if rustix::process::geteuid().is_root() {
        println!("skipped: root may read every file");
        return;
    }
    let home = Home::new();
    let cure = ["ermission denied", "chmod -R a+rX"];
    let locked = |path: &str| std::fs::set_permissions(path, Permissions::from_mode(0o000)).unwrap();
    let of_dataset =
        || COMMANDS.into_iter().filter(|c| !c.starts_with("import") && !c.starts_with("sessions"));
    let file = home.write("seg_0000.mcap", "no dataset\n");
    locked(&file);
    // These take folders.
    let folders = ["edit", "recover", "zed"];
    refused(&home, &file, &cure, of_dataset().filter(|c| !folders.iter().any(|f| c.starts_with(f))));
    refused(&home, &file, &cure[..1], ["import kinect IN OUT", "import rosbag IN OUT"]);
    let folder = home.path().join("data");
    std::fs::create_dir(&folder).unwrap();
    let session = folder.join("session.toml");
    std::fs::write(&session, "format = \"depthrig\"").unwrap();
    locked(session.to_str().unwrap());
    refused(&home, folder.to_str().unwrap(), &cure, of_dataset());
    locked(folder.to_str().unwrap());
    refused(&home, folder.to_str().unwrap(), &cure, of_dataset().chain(["sessions IN"]));
    std::fs::set_permissions(&folder, Permissions::from_mode(0o755)).unwrap();
}
