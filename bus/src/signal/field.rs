//! One field of a signal: a name, an element type, how many elements, and a unit.

use serde::{Deserialize, Serialize};

/// The element type of a field. Elements are little-endian.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FieldType {
    /// A 64-bit float.
    F64,
    /// A 32-bit float.
    F32,
    /// A signed 64-bit integer.
    I64,
    /// A byte that is 0 or 1.
    Bool,
    /// UTF-8 behind its length in bytes, which is a `u32`. A signal has at most one such field, its last one.
    Text,
}

impl FieldType {
    /// Every type.
    pub const ALL: [Self; 5] = [Self::F64, Self::F32, Self::I64, Self::Bool, Self::Text];

    /// The name used in descriptions.
    pub const fn name(self) -> &'static str {
        match self {
            Self::F64 => "f64",
            Self::F32 => "f32",
            Self::I64 => "i64",
            Self::Bool => "bool",
            Self::Text => "text",
        }
    }

    /// Bytes of one element, and its alignment. Of a text those of its length.
    pub const fn bytes(self) -> usize {
        match self {
            Self::F64 | Self::I64 => 8,
            Self::F32 | Self::Text => 4,
            Self::Bool => 1,
        }
    }

    /// Whether values between two samples are interpolated; those of other types hold until the next sample.
    pub const fn is_float(self) -> bool {
        matches!(self, Self::F64 | Self::F32)
    }
}

/// One field of a signal.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SignalField {
    /// Its name, unique among the signal's.
    pub name: String,
    /// Its element type.
    #[serde(rename = "type")]
    pub kind: FieldType,
    /// Its elements, 1 or more.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub count: u32,
    /// The unit of its elements, such as `rad`; empty without one.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub unit: String,
}

impl SignalField {
    /// A field of one element.
    pub fn new(name: impl Into<String>, kind: FieldType, unit: impl Into<String>) -> Self {
        Self { name: name.into(), kind, count: 1, unit: unit.into() }
    }

    /// The same with `count` elements.
    #[must_use]
    pub fn with_count(mut self, count: u32) -> Self {
        self.count = count;
        self
    }
}

const fn one() -> u32 {
    1
}

#[allow(clippy::trivially_copy_pass_by_ref)] // as serde calls it
const fn is_one(count: &u32) -> bool {
    *count == 1
}
