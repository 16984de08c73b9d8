//! The disk of the recordings: room, and whether it is fast enough for the rig.

use super::finding::{Finding, Severity};
use super::plan::CameraPlan;
use crate::config::RigConfig;
use crate::recording::{budget, reserve_bytes};
use core::time::Duration;
use depthrig_bus::HostTime;
use rustix::fs::{Mode, OFlags};
use serde::Serialize;
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// A measurement writes at most this much, bytes, …
const MEASURE_BYTES: u64 = 256 << 20;
/// … for at most about this long.
const MEASURE_TIME: Duration = Duration::from_millis(1500);
const CHUNK: usize = 4 << 20;
/// A disk that is measured at less than so many times the rig's rate gets slower than it when it is busy or full.
const RATE_MARGIN: f64 = 2.0;
/// Less than this much time left is worth a warning, minutes.
const SHORT_MIN: f64 = 30.0;

/// Measured facts about the disk.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DiskFacts {
    /// The folder that is there: the recordings' own, or the nearest above it.
    pub folder: PathBuf,
    /// Bytes that may still be written; `None` when the disk does not say.
    pub free_bytes: Option<u64>,
    /// Bytes a second that it took; `None` when it was not measured.
    pub bytes_per_s: Option<f64>,
    /// Why nothing can be written there.
    pub refusal: Option<String>,
}

/// The disk against the rate that the rig writes at.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DiskPlan {
    /// The folder of the recordings.
    pub directory: String,
    /// The rate that a recording of the rig is expected to write at, bytes a second.
    pub needed_bytes_per_s: f64,
    /// The rate that the disk took, bytes a second.
    pub measured_bytes_per_s: Option<f64>,
    /// Bytes free.
    pub free_bytes: Option<u64>,
    /// Minutes of recording that fit above the reserve.
    pub minutes_left: Option<f64>,
}

impl DiskFacts {
    /// Looks at the disk of `directory`, which need not be there yet. With `measure` it is written to for a moment,
    /// unless less than the reserve would be left.
    pub fn gather(directory: &Path, reserve: u64, measure: bool) -> Self {
        let there = |dir: &&Path| dir.is_dir();
        let folder = directory.ancestors().find(there).unwrap_or(Path::new("/")).to_owned();
        let mut facts = Self {
            free_bytes: budget::free_above(&depthrig_recorder::fs::RealFs, directory),
            folder,
            ..Self::default()
        };
        match scratch(&facts.folder) {
            Err(e) => facts.refusal = Some(e.to_string()),
            Ok(file) => {
                let room = facts.free_bytes.is_none_or(|free| free > reserve + MEASURE_BYTES);
                if measure && room {
                    facts.bytes_per_s = write_rate(file).ok();
                }
            }
        }
        facts
    }
}

/// A file that has no name, so that nothing of it stays, however this ends.
fn scratch(folder: &Path) -> io::Result<File> {
    let mode = Mode::RUSR | Mode::WUSR;
    match rustix::fs::open(folder, OFlags::TMPFILE | OFlags::WRONLY | OFlags::CLOEXEC, mode) {
        Ok(fd) => return Ok(File::from(fd)),
        // File systems without nameless files.
        Err(rustix::io::Errno::OPNOTSUPP | rustix::io::Errno::ISDIR) => {}
        Err(e) => return Err(e.into()),
    }
    let path = folder.join(format!(".depthrig-doctor-{}", std::process::id()));
    let file = File::options().write(true).create_new(true).open(&path)?;
    std::fs::remove_file(&path)?;
    Ok(file)
}

/// Bytes a second that reach the disk, not its cache.
fn write_rate(mut file: File) -> io::Result<f64> {
    // Not zeros, which some disks do not store.
    let mut seed = 0x9E37_79B9_7F4A_7C15_u64;
    let chunk: Vec<u8> = (0..CHUNK / 8)
        .flat_map(|_| {
            seed ^= seed << 13;
            seed ^= seed >> 7;
            seed ^= seed << 17;
            seed.to_le_bytes()
        })
        .collect();
    let start = HostTime::now();
    let mut written = 0;
    while written < MEASURE_BYTES && start.elapsed() < MEASURE_TIME {
        file.write_all(&chunk)?;
        file.sync_data()?;
        written += chunk.len() as u64;
    }
    Ok(written as f64 / start.elapsed().as_secs_f64())
}

/// The plan for the disk; notes its problems.
pub(super) fn check(
    config: &RigConfig,
    plans: &[CameraPlan],
    disk: &DiskFacts,
    findings: &mut Vec<Finding>,
) -> DiskPlan {
    let recorded = plans.iter().flat_map(|p| &p.profiles).filter(|(_, recorded)| *recorded).map(|(p, _)| p);
    let (units, images): (Vec<_>, Vec<_>) = recorded.partition(|p| p.format.is_motion());
    let streams = images.iter().map(|p| (p.format, p.frame_bytes()));
    let needed = budget::bytes_per_s(streams, config.sets.rate_hz, &config.recording)
        + budget::motion_bytes_per_s(units.iter().map(|p| p.samples_hz()).sum());
    let directory = config.recording.directory.display();
    let reserve = reserve_bytes(&config.recording);
    let room = disk.free_bytes.map(|free| free.saturating_sub(reserve));
    let minutes_left = room.filter(|_| needed > 0.0).map(|room| room as f64 / needed / 60.0);
    let warn =
        |severity, id, what: String, why: &str, cure: &str| Finding::new(severity, id, what, why, cure);
    if let Some(why) = &disk.refusal {
        findings.push(warn(
            Severity::Error,
            "disk_denied",
            format!("{directory}: nothing can be written in {}: {why}", disk.folder.display()),
            "a recording cannot begin",
            "set recording.directory to a folder of this user, or give the user this one",
        ));
    }
    if let Some(minutes) = minutes_left {
        let least = config.recording.min_minutes as f64;
        let what = format!(
            "{directory}: {:.1} GB are free above the reserve of {:.1} GB, about {minutes:.0} minutes of recording at {:.0} MB/s",
            room.unwrap_or(0) as f64 / 1e9,
            reserve as f64 / 1e9,
            needed / 1e6
        );
        let cure = "free some space, or record to another disk (recording.directory)";
        if minutes < least {
            let why = "a recording is refused when the disk is expected to take less (min_minutes)";
            findings.push(warn(Severity::Error, "disk_full", what, why, cure));
        } else if minutes < SHORT_MIN {
            let why = "the recording ends by itself when only the reserve is left";
            findings.push(warn(Severity::Warning, "disk_short", what, why, cure));
        }
    }
    if let Some(rate) = disk.bytes_per_s.filter(|rate| *rate < needed * RATE_MARGIN) {
        let severity = if rate < needed { Severity::Error } else { Severity::Warning };
        findings.push(warn(
            severity,
            "disk_slow",
            format!(
                "{directory}: the disk took {:.0} MB/s for a moment, a recording needs about {:.0} MB/s",
                rate / 1e6,
                needed / 1e6
            ),
            "sets for which the disk is too slow are dropped, counted and noted in the dataset",
            "record to a faster disk, with fewer streams (`record`), or with smaller modes",
        ));
    }
    DiskPlan {
        directory: directory.to_string(),
        needed_bytes_per_s: needed,
        measured_bytes_per_s: disk.bytes_per_s,
        free_bytes: disk.free_bytes,
        minutes_left,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn measuring_leaves_nothing_behind() {
        let home = tempfile::tempdir().unwrap();
        let facts = DiskFacts::gather(&home.path().join("not/there/yet"), 0, true);
        assert_eq!(facts.folder, home.path());
        assert_eq!(facts.refusal, None);
        assert!(facts.free_bytes.is_some_and(|b| b > 0));
        assert!(facts.bytes_per_s.is_none_or(|r| r > 0.0));
        assert_eq!(std::fs::read_dir(home.path()).unwrap().count(), 0);
    }

    #[test]
    fn a_nearly_full_disk_is_not_written_to() {
        let home = tempfile::tempdir().unwrap();
        let facts = DiskFacts::gather(home.path(), u64::MAX / 2, true);
        assert_eq!(facts.bytes_per_s, None);
    }
}
