//! Another calibration of the streams of a session: intrinsics, poses, and where they come from.

use super::SessionText;
use crate::{Error, ErrorKind, Result, Session};
use depthrig_bus::{Intrinsics, Pose, StreamId};
use toml_edit::{Array, Item, TableLike, Value};

/// Another calibration of a stream.
#[derive(Debug, Clone, PartialEq)]
pub struct StreamCalibration {
    /// The stream.
    pub id: StreamId,
    /// Its intrinsics, at the size that was recorded.
    pub intrinsics: Intrinsics,
    /// The pose of its optical frame on the mount.
    pub pose: Pose,
    /// Where both come from, in words.
    pub calibration: String,
}

/// Another pose of an IMU.
#[derive(Debug, Clone, PartialEq)]
pub struct UnitCalibration {
    /// Its stream's name.
    pub id: StreamId,
    /// Its pose on the mount.
    pub pose: Pose,
    /// Where that comes from, in words.
    pub calibration: String,
}

impl SessionText<'_> {
    /// The session as edited so far.
    pub(crate) const fn session(&self) -> &Session {
        &self.session
    }

    /// Names the calibration that the next changes come from: the text of its file.
    pub(crate) fn set_calibration(&mut self, text: &str) -> Result<()> {
        if self.session.calibration == text {
            return Ok(());
        }
        let before = std::mem::replace(&mut self.session.calibration, text.to_owned());
        self.document.insert("calibration", toml_edit::value(text));
        self.log("calibration", before, text.to_owned())
    }

    /// Replaces intrinsics and pose of a stream.
    pub(crate) fn calibrate_stream(&mut self, new: &StreamCalibration) -> Result<()> {
        let Some(at) = self.session.streams.iter().position(|s| s.id == new.id) else {
            return Err(unknown(&new.id));
        };
        let record = &mut self.session.streams[at];
        let was = record.clone();
        record.intrinsics = new.intrinsics;
        record.pose = new.pose;
        record.calibration.clone_from(&new.calibration);
        if was.intrinsics != new.intrinsics {
            self.put("streams", at, "intrinsics", intrinsics_entries(&new.intrinsics))?;
            let before = intrinsics_text(&was.intrinsics);
            self.log(&format!("streams.{}.intrinsics", new.id), before, intrinsics_text(&new.intrinsics))?;
        }
        self.pose("streams", at, &new.id, &was.pose, &new.pose)?;
        self.origin("streams", at, &new.id, was.calibration, &new.calibration)
    }

    /// Replaces the pose of an IMU.
    pub(crate) fn calibrate_unit(&mut self, new: &UnitCalibration) -> Result<()> {
        let Some(at) = self.session.motion.iter().position(|u| u.id == new.id) else {
            return Err(unknown(&new.id));
        };
        let record = &mut self.session.motion[at];
        let was = record.clone();
        record.pose = new.pose;
        record.calibration.clone_from(&new.calibration);
        self.pose("motion", at, &new.id, &was.pose, &new.pose)?;
        self.origin("motion", at, &new.id, was.calibration, &new.calibration)
    }

    fn pose(&mut self, list: &str, at: usize, id: &StreamId, was: &Pose, now: &Pose) -> Result<()> {
        if was == now {
            return Ok(());
        }
        self.put(list, at, "pose", pose_entries(now))?;
        self.log(&format!("{list}.{id}.pose"), pose_text(was), pose_text(now))
    }

    fn origin(&mut self, list: &str, at: usize, id: &StreamId, was: String, now: &str) -> Result<()> {
        if was == now {
            return Ok(());
        }
        self.record(list, at)?.insert("calibration", toml_edit::value(now));
        self.log(&format!("{list}.{id}.calibration"), was, now.to_owned())
    }

    /// Sets keys of a table of a record; others of that table stay.
    fn put(&mut self, list: &str, at: usize, table: &str, entries: Vec<(&str, Value)>) -> Result<()> {
        let path = self.path.display().to_string();
        let record = self.record(list, at)?;
        let found = record.get_mut(table).and_then(Item::as_table_like_mut);
        let Some(found) = found else {
            return Err(Error::new(
                ErrorKind::Corrupt,
                format!("{path}: [[{list}]] number {} has no table {table}; nothing was changed", at + 1),
            ));
        };
        for (key, value) in entries {
            found.insert(key, Item::Value(value));
        }
        Ok(())
    }

    /// A record of a list, in the form that the list has.
    fn record(&mut self, list: &str, at: usize) -> Result<&mut dyn TableLike> {
        let path = self.path.display().to_string();
        let found = match self.document.get_mut(list) {
            Some(Item::ArrayOfTables(tables)) => tables.get_mut(at).map(|t| t as &mut dyn TableLike),
            Some(Item::Value(Value::Array(inline))) => {
                inline.get_mut(at).and_then(Value::as_inline_table_mut).map(|t| t as &mut dyn TableLike)
            }
            _ => None,
        };
        found.ok_or_else(|| {
            Error::new(
                ErrorKind::Corrupt,
                format!("{path}: [[{list}]] has no entry {}; nothing was changed", at + 1),
            )
        })
    }
}

fn unknown(id: &StreamId) -> Error {
    Error::new(ErrorKind::BadInput, format!("the dataset has no stream {id}; nothing was changed"))
}

fn floats(values: &[f64]) -> Value {
    Value::Array(values.iter().copied().collect::<Array>())
}

fn intrinsics_entries(k: &Intrinsics) -> Vec<(&'static str, Value)> {
    // The name that serde has for it.
    let model = toml::Value::try_from(k.distortion()).ok();
    let model = model.as_ref().and_then(toml::Value::as_str).unwrap_or("unknown");
    vec![
        ("fx", Value::from(k.fx)),
        ("fy", Value::from(k.fy)),
        ("cx", Value::from(k.cx)),
        ("cy", Value::from(k.cy)),
        ("model", Value::from(model)),
        ("coeffs", floats(&k.coeffs)),
    ]
}

fn pose_entries(pose: &Pose) -> Vec<(&'static str, Value)> {
    vec![("translation_m", floats(&pose.translation_m)), ("rotation_xyzw", floats(&pose.rotation_xyzw))]
}

/// Values as an inline table of TOML, for the history.
fn intrinsics_text(k: &Intrinsics) -> String {
    inline(intrinsics_entries(k))
}

fn pose_text(pose: &Pose) -> String {
    inline(pose_entries(pose))
}

fn inline(entries: Vec<(&'static str, Value)>) -> String {
    Value::InlineTable(entries.into_iter().collect()).to_string()
}
