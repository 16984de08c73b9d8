//! Where a new recording goes: its folder and its name.

use crate::config::{HostConfig, RecordingConfig};
use crate::control::RecordRequest;
use crate::{Error, ErrorKind, Result};
use depthrig_recorder::check_name;
use std::path::{Path, PathBuf};
use time::OffsetDateTime;

/// Bytes of a scene's label that go into a folder's name. With date and suffix a name stays far below the 255
/// that file systems allow.
const SCENE_MAX_BYTES: usize = 80;

/// Name and folder of a new dataset, of which `hosts` will have parts: what is left of an earlier one of that name must not be taken for its.
///
/// # Errors
/// `BadInput` for an invalid name, `InUse` for one that parts of an earlier recording have.
pub fn place(
    config: &RecordingConfig,
    hosts: &[HostConfig],
    request: &RecordRequest,
    utc_ns: i64,
) -> Result<(String, PathBuf)> {
    let directory = request.directory.as_ref().unwrap_or(&config.directory);
    if let Some(name) = &request.name {
        check_name(name).map_err(|e| Error::new(ErrorKind::BadInput, e.to_string()).with_source(e))?;
        if let Some(left) = left_of(name, hosts, directory) {
            let text = format!(
                "{} belongs to an earlier recording {name}; choose another --name, or move it away",
                directory.join(left).display()
            );
            return Err(Error::new(ErrorKind::InUse, text));
        }
        return Ok((name.clone(), directory.join(name)));
    }
    let plain = default_name(&request.scene, utc_ns);
    // Two recordings of a scene in one minute are no mistake.
    let mut name = plain.clone();
    let mut n = 2;
    while directory.join(&name).symlink_metadata().is_ok() || left_of(&name, hosts, directory).is_some() {
        name = format!("{plain}_{n}");
        n += 1;
    }
    let path = directory.join(&name);
    Ok((name, path))
}

/// A leftover in `directory` of an earlier recording `name`: the part of a host, or what the parts were joined into.
fn left_of(name: &str, hosts: &[HostConfig], directory: &Path) -> Option<String> {
    if hosts.is_empty() {
        return None;
    }
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
    let is_part = |rest: &str, host: &HostConfig| {
        let number = rest.strip_prefix(host.name.as_str());
        number.is_some_and(|n| n.is_empty() || n.strip_prefix('_').is_some_and(is_number))
    };
    let is_left = |entry: &str| {
        let rest = entry.strip_prefix(name).and_then(|rest| rest.strip_prefix('_'));
        rest.is_some_and(|rest| rest == "joined" || hosts.iter().any(|host| is_part(rest, host)))
    };
    let entries = std::fs::read_dir(directory).into_iter().flatten().filter_map(core::result::Result::ok);
    entries.filter_map(|entry| entry.file_name().into_string().ok()).find(|entry| is_left(entry))
}

/// `YYYYMMDD_HHMM_<scene>` in UTC. Letters and digits of every script stay, as do `-`, `_` and `.`; each run of
/// anything else becomes one `_`.
fn default_name(scene: &str, utc_ns: i64) -> String {
    let t =
        OffsetDateTime::from_unix_timestamp_nanos(i128::from(utc_ns)).unwrap_or(OffsetDateTime::UNIX_EPOCH);
    let date = t.date();
    let clock = t.time();
    let mut name = format!(
        "{:04}{:02}{:02}_{:02}{:02}",
        date.year(),
        u8::from(date.month()),
        date.day(),
        clock.hour(),
        clock.minute()
    );
    let words = scene.split(|c: char| !(c.is_alphanumeric() || "-_.".contains(c))).filter(|w| !w.is_empty());
    let clean = words.collect::<Vec<_>>().join("_");
    let cut = clean[..clean.floor_char_boundary(SCENE_MAX_BYTES)].trim_end_matches(['_', '.', '-']);
    if !cut.is_empty() {
        name.push('_');
        name.push_str(cut);
    }
    name
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Reach;
    use depthrig_bus::Name;
    use proptest::prelude::*;

    const UTC_NS: i64 = 1_795_000_000_000_000_000;

    #[test]
    fn default_names_sort_by_time_and_are_file_names() {
        let long = "x".repeat(300);
        let cut = format!("20261118_1106_{}", "x".repeat(80));
        for (scene, name) in [
            ("", "20261118_1106"),
            ("  \t", "20261118_1106"),
            ("/../..", "20261118_1106"),
            (" kitchen/sink 2 ", "20261118_1106_kitchen_sink_2"),
            ("Küche: 日本 №5", "20261118_1106_Küche_日本_5"),
            ("a\nb\0c\"d'e", "20261118_1106_a_b_c_d_e"),
            ("<script>alert(1)</script>", "20261118_1106_script_alert_1_script"),
            ("v1.2-rc_3", "20261118_1106_v1.2-rc_3"),
            (&long, &cut),
        ] {
            assert_eq!(default_name(scene, UTC_NS), name, "{scene:?}");
        }
    }

    proptest! {
        /// Whatever a scene is called, there is a folder for it, even for the hundredth of one minute.
        #[test]
        fn every_scene_gets_a_folder_of_its_own(scene in any::<String>()) {
            let home = tempfile::tempdir().unwrap();
            let config = RecordingConfig { directory: home.path().to_owned(), ..RecordingConfig::default() };
            let request = RecordRequest { scene, ..RecordRequest::default() };
            let plain = default_name(&request.scene, UTC_NS);
            for n in 1..4 {
                let (name, path) = place(&config, &[], &request, UTC_NS).unwrap();
                let expected = if n == 1 { plain.clone() } else { format!("{plain}_{n}") };
                prop_assert_eq!(&name, &expected);
                prop_assert_eq!(path.parent().unwrap(), home.path());
                prop_assert!(check_name(&name).is_ok());
                std::fs::create_dir(&path).unwrap(); // fails when somebody has it
            }
        }
    }

    #[test]
    fn a_name_that_was_asked_for_is_taken_as_it_is() {
        let home = tempfile::tempdir().unwrap();
        let config = RecordingConfig { directory: home.path().to_owned(), ..RecordingConfig::default() };
        let asked = |name: &str| {
            let request = RecordRequest { name: Some(name.into()), ..RecordRequest::default() };
            place(&config, &[], &request, UTC_NS)
        };
        std::fs::create_dir(home.path().join("mine")).unwrap();
        // The recorder refuses a folder that holds anything; another name would not be the requested one.
        assert_eq!(asked("mine").unwrap().1, home.path().join("mine"));
        for bad in ["../up", "", ".hidden", &"x".repeat(300)] {
            assert_eq!(asked(bad).unwrap_err().kind(), ErrorKind::BadInput, "{bad}");
        }
    }

    #[test]
    fn what_an_earlier_session_left_is_not_the_new_ones() {
        let home = tempfile::tempdir().unwrap();
        let config = RecordingConfig { directory: home.path().to_owned(), ..RecordingConfig::default() };
        let hosts = [HostConfig {
            name: Name::new("left").unwrap(),
            reach: Reach::Socket("/nowhere".into()),
            mirror: Vec::new(),
            refine: None,
        }];
        let asked = |hosts: &[HostConfig]| {
            let request = RecordRequest { name: Some("test".into()), ..RecordRequest::default() };
            place(&config, hosts, &request, UTC_NS)
        };
        let free = || asked(&hosts).unwrap();
        for (folder, is_of_it) in [
            ("test_joined", true),
            ("test_left", true),
            ("test_left_2", true),
            ("test_left_side", false),
            ("test_leftover", false),
            ("test_left_", false),
            ("test2_left", false),
            ("test_right", false),
        ] {
            free();
            std::fs::create_dir(home.path().join(folder)).unwrap();
            if is_of_it {
                let error = asked(&hosts).unwrap_err();
                assert_eq!(error.kind(), ErrorKind::InUse, "{folder}");
                assert!(error.to_string().contains(&format!("/{folder} belongs to")), "{error}");
            } else {
                free();
            }
            asked(&[]).unwrap();
            std::fs::remove_dir(home.path().join(folder)).unwrap();
        }
        std::fs::create_dir(home.path().join("20261118_1106_joined")).unwrap();
        let default = || RecordRequest::default();
        assert_eq!(place(&config, &hosts, &default(), UTC_NS).unwrap().0, "20261118_1106_2");
        assert_eq!(place(&config, &[], &default(), UTC_NS).unwrap().0, "20261118_1106");
    }

    #[test]
    fn a_dangling_link_is_somebodys() {
        let home = tempfile::tempdir().unwrap();
        let config = RecordingConfig { directory: home.path().to_owned(), ..RecordingConfig::default() };
        std::os::unix::fs::symlink("/nowhere/at/all", home.path().join("20261118_1106")).unwrap();
        let (name, _) = place(&config, &[], &RecordRequest::default(), UTC_NS).unwrap();
        assert_eq!(name, "20261118_1106_2");
    }
}
