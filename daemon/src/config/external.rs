//! The keys of an `external` camera. The streams of the process are checked when it offers them.

use super::ExternalSettings;
use super::read::Section;
use super::value::{not_empty, resolve, shown};
use core::time::Duration;
use std::path::{Path, PathBuf};

/// The longest that a process may be waited for, seconds: one that boots longer is better started before the rig.
const LONGEST_START_S: f64 = 120.0;
/// The longest silence, seconds: a process that hangs keeps its camera from the rig for so long.
const LONGEST_SILENCE_S: f64 = 14.0;

/// Reads the settings of a camera that another process serves; relative paths are taken from `base`.
pub(super) fn read(s: &Section<'_, '_>, base: &Path) -> ExternalSettings {
    let d = ExternalSettings::default();
    let command = s.or("command", Vec::<String>::new(), |c| match c.first() {
        Some(program) if program.trim().is_empty() => Err("names no program".to_owned()),
        None => Err("is empty; write [\"program\", \"argument\", …], or leave it out".to_owned()),
        _ => Ok(()),
    });
    let directory = s.or("directory", None, |p: &Option<PathBuf>| p.as_deref().map_or(Ok(()), not_empty));
    if directory.is_some() && !s.has("command") {
        let why = "is where `command` runs, which is not given";
        s.problem(s.at_key("directory"), format!("{} {why}", s.key_of("directory")));
    }
    let seconds = |key, default: Duration, least: f64, most: f64| {
        let check = |v: &f64| {
            let good = (least..=most).contains(v);
            if good {
                Ok(())
            } else {
                Err(format!("is {} s; it must be within {least} and {most}", shown(v)))
            }
        };
        Duration::from_secs_f64(s.or(key, default.as_secs_f64(), check))
    };
    ExternalSettings {
        command,
        directory: resolve(base, directory.as_deref().unwrap_or(Path::new("."))),
        start_timeout: seconds("start_timeout_s", d.start_timeout, 0.1, LONGEST_START_S),
        heartbeat_timeout: seconds("heartbeat_timeout_s", d.heartbeat_timeout, 0.5, LONGEST_SILENCE_S),
    }
}
