//! `diagnostic_msgs/msg/DiagnosticArray`, and the operator's notes as `rcl_interfaces/msg/Log`.

use crate::Result;
use crate::cdr::{Reader, Writer};
use serde::Serialize;

/// How well something is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Level {
    /// As it should be.
    Ok = 0,
    /// Working, but somebody should look.
    Warn = 1,
    /// Not working.
    Error = 2,
    /// Nothing heard of it for too long.
    Stale = 3,
}

/// The state of one part of the rig, such as a camera.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Diagnostic {
    /// How well it is.
    pub level: Level,
    /// Name of the part: `rig/camera`, `rig/clock`, …
    pub name: String,
    /// Its state in a few words.
    pub message: String,
    /// Serial number or other identity of the hardware.
    pub hardware_id: String,
    /// Numbers, as text with the unit in the key: `residual_ns`, `drift_ppm`, …
    pub values: Vec<(String, String)>,
}

pub(crate) fn write(buf: &mut Vec<u8>, stamp_utc_ns: i64, statuses: &[Diagnostic]) {
    let mut w = Writer::new(buf);
    w.header(stamp_utc_ns, "").u32(statuses.len() as u32);
    for s in statuses {
        w.u8(s.level as u8).str(&s.name).str(&s.message).str(&s.hardware_id).u32(s.values.len() as u32);
        for (key, value) in &s.values {
            w.str(key).str(value);
        }
    }
}

/// A note of the operator, at level INFO.
pub(crate) fn write_note(buf: &mut Vec<u8>, utc_ns: i64, text: &str) {
    Writer::new(buf).time(utc_ns).u8(20).str("operator").str(text).str("").str("").u32(0);
}

/// Time (UTC nanoseconds) and text of a note.
pub(crate) fn read_note(message: &[u8]) -> Result<(i64, &str)> {
    let mut r = Reader::new(message)?;
    let utc_ns = r.time()?;
    r.u8()?;
    r.str()?;
    Ok((utc_ns, r.str()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_note_is_read_as_it_was_written() {
        let mut buf = Vec::new();
        write_note(&mut buf, 1_700_000_000_000_000_007, "lamp on");
        assert_eq!(read_note(&buf).unwrap(), (1_700_000_000_000_000_007, "lamp on"));
    }
}
