//! Installation into a temporary root, and the contents of the files.

use super::*;

fn service() -> Service {
    Service {
        user: "robot".into(),
        binary: "/usr/local/bin/depthrig".into(),
        rig_file: "/etc/depthrig/rig.toml".into(),
        data: "/data".into(),
    }
}

#[test]
fn installing_twice_changes_nothing_and_removing_leaves_nothing() {
    let root = tempfile::tempdir().unwrap();
    let all = |f: &dyn Fn(&SystemFile) -> Done| files(&service()).iter().map(f).collect::<Vec<_>>();
    assert_eq!(all(&|f| f.install(root.path(), false).unwrap()), [Done::Written; 3]);
    assert_eq!(all(&|f| f.install(root.path(), false).unwrap()), [Done::Unchanged; 3]);
    for f in files(&service()) {
        let mode =
            std::os::unix::fs::PermissionsExt::mode(&f.below(root.path()).metadata().unwrap().permissions());
        assert_eq!(mode & 0o777, 0o644);
    }
    assert_eq!(all(&|f| f.remove(root.path(), false).unwrap()), [Done::Removed; 3]);
    assert_eq!(all(&|f| f.remove(root.path(), false).unwrap()), [Done::Absent; 3]);
}

#[test]
fn what_somebody_changed_is_left_alone_unless_forced() {
    let root = tempfile::tempdir().unwrap();
    let rules = &files(&service())[0];
    rules.install(root.path(), false).unwrap();
    let path = rules.below(root.path());
    let mine = std::fs::read_to_string(&path).unwrap().replace("0660", "0600");
    std::fs::write(&path, &mine).unwrap();
    assert_eq!(rules.state(root.path()).unwrap(), State::Changed);
    assert_eq!(rules.install(root.path(), false).unwrap(), Done::Refused);
    assert_eq!(rules.remove(root.path(), false).unwrap(), Done::Refused);
    assert_eq!(std::fs::read_to_string(&path).unwrap(), mine);
    assert_eq!(rules.install(root.path(), true).unwrap(), Done::Written);
    assert_eq!(rules.state(root.path()).unwrap(), State::Current);
}

#[test]
fn what_an_earlier_version_wrote_is_replaced() {
    let root = tempfile::tempdir().unwrap();
    let rules = &files(&service())[0];
    std::fs::create_dir_all(rules.below(root.path()).parent().unwrap()).unwrap();
    std::fs::write(rules.below(root.path()), marked("# fewer cameras\n")).unwrap();
    assert_eq!(rules.state(root.path()).unwrap(), State::Older);
    assert_eq!(rules.install(root.path(), false).unwrap(), Done::Written);
}

#[test]
fn another_user_or_folder_is_another_service_file_that_may_be_replaced() {
    let root = tempfile::tempdir().unwrap();
    let unit = |s: &Service| files(s).pop().unwrap();
    unit(&service()).install(root.path(), false).unwrap();
    let other = unit(&Service {
        user: "ada".into(),
        data: "/home/ada/my data/100%$".into(),
        rig_file: "/etc/$x".into(),
        ..service()
    });
    assert_eq!(other.state(root.path()).unwrap(), State::Older);
    assert!(other.text.contains("User=ada\n"));
    assert!(other.text.contains("ReadWritePaths=/dev/shm \"/home/ada/my data/100%%$\"\n"), "{}", other.text);
    assert!(other.text.contains("run \"/etc/$$x\"\n"));
    assert!(
        !other.text.contains('@') || other.text.matches('@').count() == 1,
        "only @system-service is left"
    );
}

/// The Debian package's files are not written a second time, and are not removed; a file in /etc takes their place.
#[test]
fn what_the_package_brings_is_seen_and_left_to_it() {
    let root = tempfile::tempdir().unwrap();
    let rules = &files(&service())[0];
    let packaged = root.path().join("usr/lib/udev/rules.d/70-depthrig.rules");
    std::fs::create_dir_all(packaged.parent().unwrap()).unwrap();
    std::fs::copy("udev/70-depthrig.rules", &packaged).unwrap();
    assert_eq!(rules.state(root.path()).unwrap(), State::Packaged);
    assert_eq!(rules.install(root.path(), true).unwrap(), Done::Packaged);
    assert!(!rules.below(root.path()).exists(), "a copy in /etc would outlive the package's next version");
    assert_eq!(rules.remove(root.path(), true).unwrap(), Done::Packaged);
    assert!(packaged.exists());

    std::fs::write(&packaged, "# of another version\n").unwrap();
    assert_eq!(rules.state(root.path()).unwrap(), State::PackagedOther);
    assert_eq!(rules.install(root.path(), false).unwrap(), Done::Written);
    assert_eq!(rules.state(root.path()).unwrap(), State::Current);
    assert_eq!(rules.remove(root.path(), false).unwrap(), Done::Removed);
    assert!(packaged.exists());
}

/// A camera that depthrig drives must be in the rules, or it works for root alone.
#[test]
fn the_rules_name_every_camera_that_has_a_driver() {
    let rules = &files(&service())[0].text;
    for id in ["0ad1", "0ad2", "0ad3", "0ad4", "0b07", "0b3a", "0b4b", "0b5b", "0b5c", "1155", "1156", "0b64"]
    {
        assert!(rules.contains(id), "RealSense {id}");
    }
    for id in ["f880", "f881"] {
        assert!(rules.contains(id), "ZED {id}");
    }
    for id in ["097c", "097d"] {
        assert!(rules.contains(id), "Azure Kinect {id}");
    }
    for id in ["2485", "f63b", "f63c", "f63d"] {
        assert!(rules.contains(id), "OAK {id}");
    }
    // Every line except comments, labels and jumps matches a subsystem first.
    let mut continued = false;
    for line in rules.lines().filter(|l| !l.starts_with('#') && !l.is_empty()) {
        let starts = ["SUBSYSTEM==", "ACTION==", "LABEL="].iter().any(|s| line.starts_with(s));
        assert!(starts || continued, "{line}");
        continued = line.ends_with('\\');
    }
}
