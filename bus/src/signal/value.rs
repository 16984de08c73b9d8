//! The values of a sample as bytes: in declared order, little-endian, each aligned to its size.

use super::MAX_VALUES_BYTES;
use super::description::SignalDescription;
use super::field::{FieldType, SignalField};
use crate::{Error, ErrorKind, Result};
use core::fmt;

/// One element of a field.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Value<'a> {
    /// An element of an `f64` field.
    F64(f64),
    /// An element of an `f32` field.
    F32(f32),
    /// An element of an `i64` field.
    I64(i64),
    /// An element of a `bool` field.
    Bool(bool),
    /// A text.
    Text(&'a str),
}

macro_rules! from {
    ($($variant:ident $kind:ty;)*) => {
        $(impl<'a> From<$kind> for Value<'a> {
            fn from(value: $kind) -> Self {
                Self::$variant(value)
            }
        })*
    };
}

from! {
    F64 f64;
    F32 f32;
    I64 i64;
    Bool bool;
    Text &'a str;
}

impl Value<'_> {
    /// The type of the field that it belongs to.
    pub const fn kind(self) -> FieldType {
        match self {
            Self::F64(_) => FieldType::F64,
            Self::F32(_) => FieldType::F32,
            Self::I64(_) => FieldType::I64,
            Self::Bool(_) => FieldType::Bool,
            Self::Text(_) => FieldType::Text,
        }
    }

    /// The value as a float: 0 or 1 of a `bool`, `None` of a text.
    pub const fn number(self) -> Option<f64> {
        match self {
            Self::F64(x) => Some(x),
            Self::F32(x) => Some(x as f64),
            Self::I64(x) => Some(x as f64),
            Self::Bool(x) => Some(x as u8 as f64),
            Self::Text(_) => None,
        }
    }

    fn write(self, out: &mut Vec<u8>) {
        out.resize(out.len().next_multiple_of(self.kind().bytes()), 0);
        match self {
            Self::F64(x) => out.extend(x.to_le_bytes()),
            Self::F32(x) => out.extend(x.to_le_bytes()),
            Self::I64(x) => out.extend(x.to_le_bytes()),
            Self::Bool(x) => out.push(u8::from(x)),
            Self::Text(x) => {
                out.extend((x.len() as u32).to_le_bytes());
                out.extend(x.as_bytes());
            }
        }
    }
}

impl fmt::Display for Value<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::F64(x) => write!(f, "{x}"),
            Self::F32(x) => write!(f, "{x}"),
            Self::I64(x) => write!(f, "{x}"),
            Self::Bool(x) => write!(f, "{x}"),
            Self::Text(x) => write!(f, "{x:?}"),
        }
    }
}

/// Writes the values of a sample into `out`, which it empties first.
///
/// # Errors
/// [`ErrorKind::Invalid`] when their number or their types are not those of the description, or they have more than
/// [`MAX_VALUES_BYTES`].
pub(super) fn encode<'v>(
    description: &SignalDescription,
    values: impl Iterator<Item = Value<'v>>,
    out: &mut Vec<u8>,
) -> Result<()> {
    let invalid =
        |why: String| Err(Error::new(ErrorKind::Invalid, format!("signal {}: {why}", description.name())));
    out.clear();
    let mut values = values;
    for field in description.all_fields() {
        let SignalField { name, kind, count, .. } = field;
        for element in 0..*count {
            let Some(value) = values.next() else {
                return invalid(format!("the values end before element {element} of field \"{name}\""));
            };
            if value.kind() != *kind {
                let wanted = kind.name();
                let got = value.kind().name();
                return invalid(format!("field \"{name}\" is {wanted}, and the value {value} is {got}"));
            }
            value.write(out);
        }
    }
    if values.next().is_some() {
        return invalid("there are more values than its fields have elements".to_owned());
    }
    if out.len() > MAX_VALUES_BYTES {
        let bytes = out.len();
        return invalid(format!("its values have {bytes} bytes, {MAX_VALUES_BYTES} is the most"));
    }
    Ok(())
}

/// The length of the values, checked against the description.
///
/// # Errors
/// [`ErrorKind::Invalid`] when they are not as long as the description says, or their text is not UTF-8.
pub(super) fn check(description: &SignalDescription, bytes: &[u8]) -> Result<()> {
    let invalid = |why: String| {
        Error::new(ErrorKind::Invalid, format!("signal {}: invalid sample: {why}", description.name()))
    };
    let lengths = description.value_bytes();
    if !lengths.contains(&bytes.len()) {
        return Err(invalid(format!("its values have {} bytes, not {}", bytes.len(), lengths.start)));
    }
    if description.has_text() {
        let text = &bytes[lengths.start..];
        let stated = bytes[lengths.start - FieldType::Text.bytes()..]
            .first_chunk()
            .map_or(0, |n| u32::from_le_bytes(*n) as usize);
        if stated != text.len() {
            return Err(invalid(format!("its text has {} bytes and says {stated}", text.len())));
        }
        core::str::from_utf8(text).map_err(|e| invalid("its text is not UTF-8".to_owned()).with_source(e))?;
    }
    Ok(())
}

/// The elements of field `index` of values that [`check`] has passed.
pub(super) fn elements<'b>(
    description: &SignalDescription,
    bytes: &'b [u8],
    index: usize,
) -> impl Iterator<Item = Value<'b>> + use<'b> {
    let field = description.all_fields().get(index);
    let start = description.offset(index).unwrap_or_default();
    let kind = field.map_or(FieldType::Bool, |f| f.kind);
    let count = field.map_or(0, |f| f.count as usize);
    let bytes = bytes.get(start..).unwrap_or_default();
    bytes.chunks(kind.bytes()).take(count).map(move |at| {
        let eight = || at.first_chunk().copied().unwrap_or_default();
        let four = || at.first_chunk().copied().unwrap_or_default();
        match kind {
            FieldType::F64 => Value::F64(f64::from_le_bytes(eight())),
            FieldType::I64 => Value::I64(i64::from_le_bytes(eight())),
            FieldType::F32 => Value::F32(f32::from_le_bytes(four())),
            FieldType::Bool => Value::Bool(at.first().is_some_and(|b| *b != 0)),
            FieldType::Text => Value::Text(
                bytes
                    .get(kind.bytes()..)
                    .and_then(|text| core::str::from_utf8(text).ok())
                    .unwrap_or_default(),
            ),
        }
    })
}
