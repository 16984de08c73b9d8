//! The description of a signal, which every sample carries as JSON: its name, its kind and its fields.

use super::field::{FieldType, SignalField};
use super::{MAX_DESCRIPTION_BYTES, MAX_VALUES_BYTES, SignalName};
use crate::{Error, ErrorKind, Result};
use core::ops::Range;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// The version of the description's JSON.
pub const DESCRIPTION_VERSION: u32 = 1;
const MAX_FIELD_NAME: usize = 64;
const MAX_UNIT: usize = 32;
const MAX_FRAME: usize = 64;

/// The meaning of a signal's fields.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SignalKind {
    /// Fields whose names say what they are.
    Fields,
    /// One float for each joint, by the joint's name.
    Joints,
    /// A pose: `translation_m` (x, y, z) and `rotation_xyzw` (a unit quaternion), `p_frame = R p_body + t`.
    Pose,
}

impl SignalKind {
    /// Every kind.
    pub const ALL: [Self; 3] = [Self::Fields, Self::Joints, Self::Pose];

    /// The name used in descriptions.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Fields => "fields",
            Self::Joints => "joints",
            Self::Pose => "pose",
        }
    }
}

/// The JSON.
#[derive(Debug, Serialize, Deserialize)]
struct Json {
    version: u32,
    name: SignalName,
    kind: SignalKind,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    frame: String,
    fields: Vec<SignalField>,
}

/// Name, kind and fields of a signal. They stay the same for as long as a publisher lives.
#[derive(Debug, Clone)]
pub struct SignalDescription {
    name: SignalName,
    kind: SignalKind,
    frame: String,
    fields: Vec<SignalField>,
    text: String,
    hash: u64,
    offsets: Vec<usize>,
    fixed: usize,
}

/// Two descriptions are equal when they say the same, in whatever words.
impl PartialEq for SignalDescription {
    fn eq(&self, other: &Self) -> bool {
        (&self.name, self.kind, &self.frame, &self.fields)
            == (&other.name, other.kind, &other.frame, &other.fields)
    }
}

impl SignalDescription {
    /// A signal of any fields.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`] naming the field and the rule that it breaks: names are unique and have 1 to 64 bytes; a
    /// text is the last field and has one element; values and description have at most 4096 bytes each.
    pub fn fields(name: SignalName, fields: Vec<SignalField>) -> Result<Self> {
        Self::new(name, SignalKind::Fields, String::new(), fields)
    }

    /// A signal of one float (`f64`) for each joint.
    ///
    /// # Errors
    /// As [`Self::fields`].
    pub fn joints(name: SignalName, joints: &[&str], unit: &str) -> Result<Self> {
        let fields = joints.iter().map(|joint| SignalField::new(*joint, FieldType::F64, unit)).collect();
        Self::new(name, SignalKind::Joints, String::new(), fields)
    }

    /// A signal of a pose in `frame`: seven `f64`, the translation in metres and the rotation as a quaternion x, y, z, w.
    ///
    /// # Errors
    /// As [`Self::fields`], also when `frame` is empty or longer than 64 bytes.
    pub fn pose(name: SignalName, frame: &str) -> Result<Self> {
        Self::new(name, SignalKind::Pose, frame.to_owned(), pose_fields())
    }

    fn new(name: SignalName, kind: SignalKind, frame: String, fields: Vec<SignalField>) -> Result<Self> {
        let json = Json { version: DESCRIPTION_VERSION, name, kind, frame, fields };
        let text = serde_json::to_string(&json).map_err(|e| {
            Error::new(ErrorKind::Invalid, "the description cannot be written as JSON").with_source(e)
        })?;
        Self::checked(json, text)
    }

    /// Reads the description of a sample.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`] for bytes that are not a valid description, [`ErrorKind::VersionMismatch`] for one of a
    /// later version.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        let broken = |e: &dyn core::fmt::Display| {
            Error::new(ErrorKind::Invalid, format!("invalid description of a signal: {e}"))
        };
        let text = core::str::from_utf8(bytes).map_err(|e| broken(&e))?;
        let json: Json = serde_json::from_str(text).map_err(|e| broken(&e))?;
        if json.version != DESCRIPTION_VERSION {
            let version = json.version;
            return Err(Error::new(
                ErrorKind::VersionMismatch,
                format!(
                    "the description of signal {} has version {version}, this program reads version {DESCRIPTION_VERSION}; \
                     run publisher and reader with the same version of depthrig",
                    json.name
                ),
            ));
        }
        Self::checked(json, text.to_owned())
    }

    fn checked(json: Json, text: String) -> Result<Self> {
        let Json { name, kind, frame, fields, .. } = json;
        let invalid = |why: String| Err(Error::new(ErrorKind::Invalid, format!("signal {name}: {why}")));
        if let Some(why) = problem(kind, &frame, &fields) {
            return invalid(why);
        }
        if text.len() > MAX_DESCRIPTION_BYTES {
            let bytes = text.len();
            return invalid(format!(
                "its description has {bytes} bytes, {MAX_DESCRIPTION_BYTES} is the most; use fewer or shorter names, \
                 or one field of several elements"
            ));
        }
        let mut offsets = Vec::with_capacity(fields.len());
        let mut fixed = 0usize;
        for field in &fields {
            fixed = fixed.next_multiple_of(field.kind.bytes());
            offsets.push(fixed);
            fixed = fixed.saturating_add(field.kind.bytes().saturating_mul(field.count as usize));
            if fixed > MAX_VALUES_BYTES {
                return invalid(format!("its values have more than {MAX_VALUES_BYTES} bytes"));
            }
        }
        let hash = hash(text.as_bytes());
        Ok(Self { name, kind, frame, fields, text, hash, offsets, fixed })
    }

    /// The signal's name.
    pub const fn name(&self) -> &SignalName {
        &self.name
    }

    /// The meaning of its fields.
    pub const fn kind(&self) -> SignalKind {
        self.kind
    }

    /// The frame that a pose is in; empty for other kinds.
    pub fn frame(&self) -> &str {
        &self.frame
    }

    /// Its fields, in the order of the values.
    pub fn all_fields(&self) -> &[SignalField] {
        &self.fields
    }

    /// The field `name` and its index.
    pub fn field(&self, name: &str) -> Option<(usize, &SignalField)> {
        self.fields.iter().enumerate().find(|(_, field)| field.name == name)
    }

    /// The description as JSON, as samples carry it.
    pub fn json(&self) -> &str {
        &self.text
    }

    /// FNV-1a (64 bits) of the JSON.
    pub const fn hash(&self) -> u64 {
        self.hash
    }

    /// Byte at which field `index` begins among the values, if there is one.
    pub fn offset(&self, index: usize) -> Option<usize> {
        self.offsets.get(index).copied()
    }

    /// Bytes of the values of a sample at least, and at most: they differ if there is a text.
    pub fn value_bytes(&self) -> Range<usize> {
        let end = if self.has_text() { MAX_VALUES_BYTES } else { self.fixed };
        self.fixed..end + 1
    }

    /// Whether the last field is a text.
    pub fn has_text(&self) -> bool {
        self.fields.last().is_some_and(|field| field.kind == FieldType::Text)
    }
}

fn pose_fields() -> Vec<SignalField> {
    vec![
        SignalField::new("translation_m", FieldType::F64, "m").with_count(3),
        SignalField::new("rotation_xyzw", FieldType::F64, "").with_count(4),
    ]
}

/// The rule that the fields break, if they do.
fn problem(kind: SignalKind, frame: &str, fields: &[SignalField]) -> Option<String> {
    let is_plain = |text: &str, most: usize| text.len() <= most && !text.chars().any(char::is_control);
    if !is_plain(frame, MAX_FRAME) {
        return Some(format!("its frame has more than {MAX_FRAME} bytes or control characters"));
    }
    let mut names = BTreeSet::new();
    for (index, field) in fields.iter().enumerate() {
        let name = &field.name;
        if name.is_empty() || !is_plain(name, MAX_FIELD_NAME) {
            return Some(format!(
                "the name of field {index} has not 1 to {MAX_FIELD_NAME} bytes without control characters"
            ));
        }
        if !names.insert(name) {
            return Some(format!("two fields are named \"{name}\""));
        }
        if !is_plain(&field.unit, MAX_UNIT) {
            return Some(format!(
                "the unit of field \"{name}\" has more than {MAX_UNIT} bytes or control characters"
            ));
        }
        if field.count == 0 {
            return Some(format!("field \"{name}\" has no elements"));
        }
        if field.kind == FieldType::Text && (field.count != 1 || index + 1 != fields.len()) {
            return Some(format!("text field \"{name}\" is not one text at the end of the fields"));
        }
        if kind == SignalKind::Joints && !(field.kind.is_float() && field.count == 1) {
            return Some(format!("joint \"{name}\" is not one float (f64 or f32)"));
        }
    }
    match kind {
        _ if fields.is_empty() => Some("it has no fields".to_owned()),
        SignalKind::Pose if fields != pose_fields() => Some(
            "a pose has the fields translation_m (3 f64, m) and rotation_xyzw (4 f64) and no others"
                .to_owned(),
        ),
        SignalKind::Pose if frame.is_empty() => Some("the frame of its pose is not named".to_owned()),
        SignalKind::Fields | SignalKind::Joints if !frame.is_empty() => {
            Some("it is not a pose, and has a frame".to_owned())
        }
        _ => None,
    }
}

/// FNV-1a with 64 bits (Fowler, Noll, Vo: draft-eastlake-fnv).
fn hash(bytes: &[u8]) -> u64 {
    bytes
        .iter()
        .fold(0xCBF2_9CE4_8422_2325, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01B3))
}

#[cfg(test)]
mod tests;
