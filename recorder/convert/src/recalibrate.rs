//! A calibration of the mount for a dataset that is recorded: which of its streams and IMUs it concerns, and how.
//!
//! As in a rig that names the calibration: the calibrated stream has the intrinsics and the pose of the file, the device moves with
//! it as a whole. Streams that show the very view of the calibrated one, such as refined depth, have its intrinsics too.

use depthrig_bus::Pose;
use depthrig_calib::PoseExt;
use depthrig_calibrate::file::{CalibratedCamera, Calibration, Conditions, lens_position};
use depthrig_calibrate::mount::Source;
use depthrig_recorder::{
    Error, ErrorKind, Recalibration, Result, Session, StreamCalibration, StreamRecord, UnitCalibration,
};
use std::path::Path;

/// A calibration as it applies to a dataset.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibrationPlan {
    /// Changes to the dataset.
    pub change: Recalibration,
    /// Cameras of the dataset that the calibration does not have: their poses stay in the frame of the old one.
    pub left: Vec<String>,
    /// Why it may not hold for this dataset, with the cure.
    pub doubts: Vec<String>,
}

/// Applies `calibration`, of the text `text` in the file `path`, to a session.
///
/// # Errors
/// [`ErrorKind::BadInput`] for a calibration of another device or another size of image, and for one that has none of the
/// dataset's streams, neither their cameras nor their depth.
pub fn plan(
    session: &Session,
    calibration: &Calibration,
    text: &str,
    path: &Path,
) -> Result<CalibrationPlan> {
    let mut plan = CalibrationPlan {
        change: Recalibration { text: text.to_owned(), ..Default::default() },
        left: Vec::new(),
        doubts: Vec::new(),
    };
    let mut cameras: Vec<&str> = session.streams.iter().map(|s| s.id.camera.as_str()).collect();
    cameras.sort_unstable();
    cameras.dedup();
    for camera in &cameras {
        let entries: Vec<Entry<'_>> = calibration
            .of_camera(camera)
            .filter_map(|entry| Some(Entry { entry, record: record(session, entry)? }))
            .collect();
        for entry in &entries {
            let now = Conditions {
                firmware: session.firmware.get(*camera).cloned().unwrap_or_default(),
                temperature_c: None,
                lens_position: lens_position(&session.rig_config, camera),
            };
            entry.check(path, &now)?;
            let doubts = entry.entry.conditions.doubts(&now);
            plan.doubts.extend(doubts.into_iter().map(|d| format!("{camera}: {d}")));
        }
        if !entries.is_empty() {
            apply(session, camera, &entries, &calibration.created, &mut plan.change);
        } else if !calibration.cameras.is_empty() {
            plan.left.push((*camera).to_owned());
        }
    }
    let corrects_depth = corrects_depth(session, calibration, path)?;
    if plan.change.streams.is_empty() && !corrects_depth {
        let cameras = calibration.cameras.iter().map(|c| format!("{}/{}", c.name, c.stream));
        let has = cameras.chain(calibration.depth.iter().map(|d| format!("{}/{}", d.camera, d.stream)));
        let streams = session.streams.iter().map(|s| s.id.to_string());
        return Err(Error::new(
            ErrorKind::BadInput,
            format!(
                "{} has none of the dataset's streams: it has {}, the dataset has {}; give both the same names",
                path.display(),
                has.collect::<Vec<_>>().join(", "),
                streams.collect::<Vec<_>>().join(", ")
            ),
        ));
    }
    Ok(plan)
}

/// Whether the calibration corrects depth of the dataset; refuses corrections of another device or another size of image.
fn corrects_depth(session: &Session, calibration: &Calibration, path: &Path) -> Result<bool> {
    let mut corrects = false;
    for record in &session.streams {
        let Some(entry) = calibration.depth_of(record.id.camera.as_str(), record.id.stream.as_str()) else {
            continue;
        };
        entry.check_fits(&record.serial, record.width, record.height).map_err(|e| {
            Error::new(ErrorKind::BadInput, format!("{}: {e}", path.display())).with_source(e)
        })?;
        corrects = true;
    }
    Ok(corrects)
}

fn record<'a>(session: &'a Session, entry: &CalibratedCamera) -> Option<&'a StreamRecord> {
    session
        .streams
        .iter()
        .find(|s| s.id.camera.as_str() == entry.name && s.id.stream.as_str() == entry.stream)
}

/// An entry of the calibration with the stream that it is of.
struct Entry<'a> {
    entry: &'a CalibratedCamera,
    record: &'a StreamRecord,
}

impl Entry<'_> {
    fn check(&self, path: &Path, now: &Conditions) -> Result<()> {
        let Self { entry, record } = self;
        let refused = |why: String| {
            let what =
                format!("{}: the calibration of {}/{} {why}", path.display(), entry.name, entry.stream);
            Err(Error::new(ErrorKind::BadInput, what))
        };
        if !entry.serial.is_empty() && !record.serial.is_empty() && entry.serial != record.serial {
            return refused(format!(
                "is of serial number {}, the dataset was recorded with {}; use a calibration of that camera, or take the entry \
                 out of the file",
                entry.serial, record.serial
            ));
        }
        if (entry.width, entry.height) != (record.width, record.height) {
            return refused(format!(
                "is for {}x{}, the dataset has {}x{}; calibrate at the size that was recorded, or take the entry out of the file",
                entry.width, entry.height, record.width, record.height
            ));
        }
        match entry.conditions.refused(now) {
            Some(why) => refused(why),
            None => Ok(()),
        }
    }

    /// Where the intrinsics and the pose now come from, in words.
    fn origin(&self, created: &str) -> String {
        match self.entry.source {
            Source::Calibrated => calibrated(&self.record.calibration, created),
            Source::Factory => moved(&self.record.calibration, created),
        }
    }

    /// Whether a stream shows the view of this one: every pixel has the same ray.
    fn is_view_of(&self, other: &StreamRecord) -> bool {
        let own = self.record;
        (own.width, own.height, own.intrinsics, own.pose)
            == (other.width, other.height, other.intrinsics, other.pose)
    }
}

/// As [`calibrated`] for a stream whose pose alone is new.
fn moved(before: &str, created: &str) -> String {
    format!("{}, pose calibrated {created}", delivered(before))
}

/// As a rig with this calibration says it, with what the camera itself said in brackets.
fn calibrated(before: &str, created: &str) -> String {
    format!("calibrated {created} ({})", delivered(before))
}

/// The camera's own word on its calibration, before any other.
fn delivered(text: &str) -> &str {
    let text = text.split(", pose calibrated ").next().unwrap_or(text);
    let inner = text.strip_prefix("calibrated ").and_then(|t| t.split_once('(')).map(|(_, inner)| inner);
    inner.and_then(|t| t.strip_suffix(')')).unwrap_or(text)
}

/// The streams and IMUs of one camera.
fn apply(session: &Session, camera: &str, entries: &[Entry<'_>], created: &str, change: &mut Recalibration) {
    let Some(first) = entries.first() else { return };
    let now = first.entry.pose();
    let then = first.record.pose;
    // The device as a whole moves with the stream that was calibrated.
    let place = |pose: &Pose| {
        if then == now { *pose } else { now.compose(&then.inverse().compose(pose)) }
    };
    for record in session.streams.iter().filter(|s| s.id.camera.as_str() == camera) {
        let own = entries.iter().find(|e| e.record.id == record.id);
        let view = own.or_else(|| entries.iter().find(|e| e.is_view_of(record)));
        let pose = if record.id == first.record.id { now } else { place(&record.pose) };
        change.streams.push(StreamCalibration {
            id: record.id.clone(),
            intrinsics: view.map_or(record.intrinsics, |e| e.entry.intrinsics()),
            pose,
            calibration: match view {
                Some(entry) => entry.origin(created),
                None => moved(&record.calibration, created),
            },
        });
    }
    for unit in session.motion.iter().filter(|u| u.id.camera.as_str() == camera) {
        change.motion.push(UnitCalibration {
            id: unit.id.clone(),
            pose: place(&unit.pose),
            calibration: moved(&unit.calibration, created),
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_origin_is_named_once_however_often_a_dataset_is_calibrated() {
        let once = calibrated("factory (2019)", "2026-11-25");
        assert_eq!(once, "calibrated 2026-11-25 (factory (2019))");
        assert_eq!(calibrated(&once, "2026-11-26"), "calibrated 2026-11-26 (factory (2019))");
        assert_eq!(moved(&once, "2026-11-27"), "factory (2019), pose calibrated 2026-11-27");
        assert_eq!(delivered(&moved(&once, "2026-11-27")), "factory (2019)");
        assert_eq!(delivered(""), "");
    }
}
