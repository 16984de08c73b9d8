//! Where a new recording goes: its folder and its name.

use crate::config::RecordingConfig;
use crate::control::RecordRequest;
use crate::{Error, ErrorKind, Result};
use depthrig_recorder::check_name;
use std::path::PathBuf;
use time::OffsetDateTime;

/// Bytes of a scene's label that go into a folder's name. With date and suffix a name stays far below the 255
/// that file systems allow.
const SCENE_MAX_BYTES: usize = 80;

/// Name and folder of a new dataset.
pub fn place(config: &RecordingConfig, request: &RecordRequest, utc_ns: i64) -> Result<(String, PathBuf)> {
    let directory = request.directory.as_ref().unwrap_or(&config.directory);
    if let Some(name) = &request.name {
        check_name(name).map_err(|e| Error::new(ErrorKind::BadInput, e.to_string()).with_source(e))?;
        return Ok((name.clone(), directory.join(name)));
    }
    let plain = default_name(&request.scene, utc_ns);
    // Two recordings of a scene in one minute are no mistake.
    let mut name = plain.clone();
    let mut n = 2;
    while directory.join(&name).symlink_metadata().is_ok() {
        name = format!("{plain}_{n}");
        n += 1;
    }
    let path = directory.join(&name);
    Ok((name, path))
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
                let (name, path) = place(&config, &request, UTC_NS).unwrap();
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
            place(&config, &request, UTC_NS)
        };
        std::fs::create_dir(home.path().join("mine")).unwrap();
        // The recorder refuses a folder that holds anything; another name would not be the requested one.
        assert_eq!(asked("mine").unwrap().1, home.path().join("mine"));
        for bad in ["../up", "", ".hidden", &"x".repeat(300)] {
            assert_eq!(asked(bad).unwrap_err().kind(), ErrorKind::BadInput, "{bad}");
        }
    }

    #[test]
    fn a_dangling_link_is_somebodys() {
        let home = tempfile::tempdir().unwrap();
        let config = RecordingConfig { directory: home.path().to_owned(), ..RecordingConfig::default() };
        std::os::unix::fs::symlink("/nowhere/at/all", home.path().join("20261118_1106")).unwrap();
        let (name, _) = place(&config, &RecordRequest::default(), UTC_NS).unwrap();
        assert_eq!(name, "20261118_1106_2");
    }
}
