//! Controls in rig files: read, written, and nothing else touched.

use super::*;

const FILE: &str = r#"# My rig.
rig = "lab"

[[camera]]
name = "left"   # the left one
backend = "v4l2"
[camera.controls]
brightness = 5 # by eye

[[camera]]
name = "right"
backend = "realsense"
exposure_us = 8000
[[camera.stream]]
name = "color"
"#;

fn written(changes: &[(&str, &str, ControlValue)]) -> String {
    let path = Path::new("rig.toml");
    let mut document = parse(path, FILE).unwrap();
    for (camera, key, value) in changes {
        write(&mut document, camera, key, value, path).unwrap();
        assert_eq!(in_file(&document, camera, key).as_ref(), Some(value));
    }
    document.to_string()
}

#[test]
fn values_are_those_of_the_camera_that_is_meant() {
    let document = parse(Path::new("rig.toml"), FILE).unwrap();
    assert_eq!(in_file(&document, "left", "controls.brightness"), Some(ControlValue::Integer(5)));
    assert_eq!(in_file(&document, "right", "controls.brightness"), None);
    assert_eq!(in_file(&document, "right", "exposure_us"), Some(ControlValue::Integer(8000)));
    assert_eq!(in_file(&document, "nobody", "exposure_us"), None);
    assert_eq!(in_file(&document, "left", "name.inner"), None);
}

#[test]
fn only_the_value_changes_and_comments_stay() {
    let after = written(&[("left", "controls.brightness", ControlValue::Integer(7))]);
    assert_eq!(after, FILE.replace("brightness = 5 # by eye", "brightness = 7 # by eye"));
    let changes = of_texts("rig.toml".into(), FILE, &after);
    let lines: Vec<_> = changes.diff.lines().filter(|l| l.starts_with(['+', '-'])).collect();
    assert_eq!(
        lines,
        ["--- rig.toml", "+++ rig.toml", "-brightness = 5 # by eye", "+brightness = 7 # by eye"]
    );
    assert_eq!(of_texts("rig.toml".into(), FILE, FILE).diff, "");
    assert_ne!(changes.fingerprint, of_texts("rig.toml".into(), FILE, FILE).fingerprint);
}

#[test]
fn what_the_file_does_not_have_is_added_to_its_camera() {
    let after = written(&[
        ("right", "emitter", ControlValue::Item("laser".into())),
        ("right", "color_controls.gain", ControlValue::Integer(32)),
        ("left", "controls.auto", ControlValue::Boolean(false)),
    ]);
    let document = parse(Path::new("rig.toml"), &after).unwrap();
    assert_eq!(in_file(&document, "right", "emitter"), Some(ControlValue::Item("laser".into())));
    assert_eq!(in_file(&document, "right", "color_controls.gain"), Some(ControlValue::Integer(32)));
    assert_eq!(in_file(&document, "left", "controls.auto"), Some(ControlValue::Boolean(false)));
    assert_eq!(in_file(&document, "left", "emitter"), None);
    // Nothing was lost on the way.
    for line in FILE.lines() {
        assert!(after.lines().any(|l| l == line), "{line}\n{after}");
    }
}

#[test]
fn a_file_that_cannot_be_edited_as_text_is_left_alone() {
    let inline = r#"camera = [{ name = "left", backend = "v4l2" }]"#;
    let path = Path::new("rig.toml");
    let mut document = parse(path, inline).unwrap();
    let e = write(&mut document, "left", "gain", &ControlValue::Integer(1), path).unwrap_err();
    assert!(e.to_string().contains("by hand"), "{e}");
    let mut document = parse(path, FILE).unwrap();
    assert!(write(&mut document, "nobody", "gain", &ControlValue::Integer(1), path).is_err());
    assert_eq!(document.to_string(), FILE);
    assert!(parse(path, "rig = ").unwrap_err().to_string().contains("rig.toml"));
}

#[test]
fn a_file_is_replaced_with_its_permissions_or_stays() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("rig.toml");
    std::fs::write(&path, "old").unwrap();
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o640)).unwrap();
    replace(&path, "new").unwrap();
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "new");
    assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o640);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    assert!(replace(&folder.path().join("none.toml"), "new").is_err());
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}
