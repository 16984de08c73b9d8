//! Presets of a D400: what a person wants in its advanced-mode groups, from a JSON file.
//!
//! ```json
//! {
//!   "name": "near, fine steps",
//!   "groups": {
//!     "depth_table": [100, 0, 65535, 0, 0],
//!     "census_radius": [9, 9],
//!     "amplitude_factor": [0.08]
//!   }
//! }
//! ```
//!
//! A group is listed with all of its 32-bit values in the order of librealsense's
//! `include/librealsense2/h/rs_advanced_mode_command.h`. A value with a point or an exponent is a float, another one an
//! integer; `tools` that know better may give the raw bits as an integer, which is what the camera gets in any case.
//! Groups that are not listed stay as they are.

use super::advanced::{self, Bound, Group};
use super::hwm::HardwareMonitor;
use depthrig_driver::{Error, ErrorKind, Result};
use serde::Deserialize;
use std::collections::BTreeMap;

/// Groups with the bytes that they are to have.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Preset {
    /// Its display name.
    pub name: String,
    /// The groups in the order of their numbers, each with all of its bytes.
    pub groups: Vec<(Group, Vec<u8>)>,
}

/// A group that was written to a camera, for the log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Written {
    /// Which.
    pub group: Group,
    /// The camera's value before.
    pub before: Vec<u8>,
    /// The value that the camera reports now: the one written, or the camera's own change.
    pub after: Vec<u8>,
}

/// A preset's file, as it is written.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default)]
    name: String,
    groups: BTreeMap<String, Vec<serde_json::Number>>,
}

/// Most bytes of a preset file; a whole one has less than a tenth of it.
pub const MAX_FILE: usize = 65_536;

impl Preset {
    /// Reads the text of a preset file.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] saying what is wrong with it and where.
    pub fn parse(json: &str) -> Result<Self> {
        let bad = |text: String| Error::new(ErrorKind::BadInput, text);
        if json.len() > MAX_FILE {
            return Err(bad(format!("the preset has {} bytes; at most {MAX_FILE} are read", json.len())));
        }
        let file: File = serde_json::from_str(json)
            .map_err(|e| bad(format!("the preset cannot be read: {e}")).with_source(e))?;
        let mut groups = Vec::with_capacity(file.groups.len());
        for (name, values) in file.groups {
            let group = Group::from_name(&name).ok_or_else(|| {
                let known = Group::ALL.map(Group::name).join(", ");
                bad(format!("the preset has a group \"{name}\"; there are: {known}"))
            })?;
            if values.len() != group.values() {
                let is = values.len();
                let must = group.values();
                return Err(bad(format!("the preset's group {name} has {is} values; the camera has {must}")));
            }
            let mut bytes = Vec::with_capacity(group.bytes());
            for value in &values {
                let four = four_bytes(value).ok_or_else(|| {
                    bad(format!("the preset's group {name}: {value} does not fit in 32 bits"))
                })?;
                bytes.extend(four);
            }
            groups.push((group, bytes));
        }
        groups.sort_by_key(|(group, _)| *group);
        Ok(Self { name: file.name, groups })
    }

    /// Writes the groups to a camera that does not stream, one after the other, and reads each back.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] when advanced mode is off, else those of [`advanced::get`] and [`advanced::set`],
    /// naming the group; the groups before it are written then.
    pub fn write(&self, monitor: &mut dyn HardwareMonitor) -> Result<Vec<Written>> {
        if self.groups.is_empty() {
            return Ok(Vec::new());
        }
        advanced::require_on(monitor, "no preset can be written")?;
        let mut written = Vec::with_capacity(self.groups.len());
        for (group, bytes) in &self.groups {
            let mut one = || {
                let before = advanced::get(monitor, *group, Bound::Current)?;
                advanced::set(monitor, *group, bytes)?;
                let after = advanced::get(monitor, *group, Bound::Current)?;
                Ok(Written { group: *group, before, after })
            };
            written.push(one().map_err(|e: Error| {
                let cure = match e.kind() {
                    ErrorKind::Unsupported | ErrorKind::Protocol => {
                        ". Correct it in the file, or leave it out"
                    }
                    _ => "",
                };
                let text = format!("preset \"{}\", group {}: {e}{cure}", self.name, group.name());
                Error::new(e.kind(), text).with_source(e)
            })?);
        }
        Ok(written)
    }
}

/// The 32 bits of a value in a preset.
fn four_bytes(value: &serde_json::Number) -> Option<[u8; 4]> {
    if let Some(v) = value.as_i64() {
        let unsigned = u32::try_from(v).ok().map(u32::to_le_bytes);
        return unsigned.or_else(|| i32::try_from(v).ok().map(i32::to_le_bytes));
    }
    if value.is_u64() {
        return None; // beyond 63 bits
    }
    value.as_f64().map(|v| v as f32).filter(|v| v.is_finite()).map(f32::to_le_bytes)
}

#[cfg(test)]
mod tests;
