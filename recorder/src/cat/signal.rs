//! A sample of a signal as a row.

use crate::dataset::DatasetSet;
use crate::{Error, ErrorKind, Result};
use depthrig_bus::{FieldType, SignalDescription, SignalSample, Value};
use serde::Serialize;
use serde_json::{Map, Value as Json};
use std::borrow::Cow;
use std::fmt::Write;

/// The columns before the values.
const COLUMNS: [&str; 8] =
    ["set", "utc_ns", "time_ns", "publish_time_ns", "session", "sequence", "uncertainty_ns", "flags"];

/// One sample of a signal.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[non_exhaustive]
pub struct SignalRow {
    /// Id of the set that it came with.
    pub set: u64,
    /// When the values were measured, UTC nanoseconds since 1970.
    pub utc_ns: i64,
    /// The same, nanoseconds on the host's monotonic clock.
    pub time_ns: i64,
    /// When the sample was published, on the same clock.
    pub publish_time_ns: i64,
    /// Its publisher: when it began.
    pub session: u64,
    /// Number of the sample of its publisher.
    pub sequence: u64,
    /// `time_ns` is right within this much, nanoseconds; 0 when the publisher states none.
    pub uncertainty_ns: u64,
    /// [`SignalFlags`](depthrig_bus::SignalFlags) bits.
    pub flags: u32,
    /// The values by the names of their fields; a list where a field has several. NaN and infinities are null.
    pub values: Map<String, Json>,
    /// The values as CSV, a cell each.
    #[serde(skip)]
    cells: Vec<String>,
}

impl SignalRow {
    pub(super) fn new(set: &DatasetSet, sample: &SignalSample) -> Self {
        let h = sample.header();
        let fields = sample.description().all_fields();
        let json = |field: &depthrig_bus::SignalField| {
            let mut elements: Vec<_> = sample.field(&field.name).map(to_json).collect();
            let one = field.count == 1 && elements.len() == 1;
            let value = if one { elements.remove(0) } else { Json::Array(elements) };
            (field.name.clone(), value)
        };
        Self {
            set: set.id,
            utc_ns: h.time_ns.saturating_add(set.utc_offset_ns),
            time_ns: h.time_ns,
            publish_time_ns: h.publish_time_ns,
            session: h.session,
            sequence: h.sequence,
            uncertainty_ns: h.uncertainty_ns,
            flags: h.flags,
            values: fields.iter().map(json).collect(),
            cells: sample.values().map(cell).collect(),
        }
    }

    /// The row as a line. Floats have as many digits as give their bits back; texts are quoted where CSV demands it.
    pub fn csv(&self) -> String {
        let mut line = format!(
            "{},{},{},{},{},{},{},{}",
            self.set,
            self.utc_ns,
            self.time_ns,
            self.publish_time_ns,
            self.session,
            self.sequence,
            self.uncertainty_ns,
            self.flags
        );
        for value in &self.cells {
            let _ = write!(line, ",{value}");
        }
        line
    }
}

/// The names of the columns as a line: an element of a field of several is `name[0]`.
pub(super) fn head(description: &SignalDescription) -> String {
    let mut line = COLUMNS.join(",");
    for field in description.all_fields() {
        for element in 0..field.count {
            let name = if field.count == 1 {
                Cow::Borrowed(field.name.as_str())
            } else {
                Cow::Owned(format!("{}[{element}]", field.name))
            };
            let _ = write!(line, ",{}", quoted(&name));
        }
    }
    line
}

fn cell(value: Value<'_>) -> String {
    match value {
        Value::F64(x) => x.to_string(),
        Value::F32(x) => x.to_string(),
        Value::I64(x) => x.to_string(),
        Value::Bool(x) => u8::from(x).to_string(),
        Value::Text(x) => quoted(x).into_owned(),
    }
}

fn to_json(value: Value<'_>) -> Json {
    match value {
        Value::F64(x) => x.into(),
        Value::F32(x) => x.into(),
        Value::I64(x) => x.into(),
        Value::Bool(x) => x.into(),
        Value::Text(x) => x.into(),
    }
}

/// A cell of RFC 4180.
fn quoted(text: &str) -> Cow<'_, str> {
    if text.contains([',', '"', '\n', '\r']) {
        Cow::Owned(format!("\"{}\"", text.replace('"', "\"\"")))
    } else {
        Cow::Borrowed(text)
    }
}

/// The columns of the NPY file with NumPy's names of their kinds.
pub(super) fn columns(description: &SignalDescription) -> Result<Vec<(&str, &'static str, usize)>> {
    let kinds = ["<u8", "<i8", "<i8", "<i8", "<u8", "<u8", "<u8", "<u4"];
    let mut columns: Vec<_> = COLUMNS.into_iter().zip(kinds).map(|(name, kind)| (name, kind, 1)).collect();
    for field in description.all_fields() {
        let kind = match field.kind {
            FieldType::F64 => "<f8",
            FieldType::F32 => "<f4",
            FieldType::I64 => "<i8",
            FieldType::Bool => "|b1",
            FieldType::Text => {
                let name = description.name();
                let what = format!("signal {name} has a text, which NPY cannot hold; write it as CSV");
                return Err(Error::new(ErrorKind::BadInput, what));
            }
        };
        let name = &field.name;
        if COLUMNS.contains(&name.as_str()) || name.contains(['\'', '\\']) {
            let what = format!("NPY cannot hold a field of the name {name:?} beside the others; write CSV");
            return Err(Error::new(ErrorKind::BadInput, what));
        }
        columns.push((name.as_str(), kind, field.count as usize));
    }
    Ok(columns)
}

/// A sample as a record of these columns.
pub(super) fn record(set: &DatasetSet, sample: &SignalSample) -> Vec<u8> {
    let h = sample.header();
    let mut record = set.id.to_le_bytes().to_vec();
    record.extend(h.time_ns.saturating_add(set.utc_offset_ns).to_le_bytes());
    record.extend(h.time_ns.to_le_bytes());
    record.extend(h.publish_time_ns.to_le_bytes());
    record.extend(h.session.to_le_bytes());
    record.extend(h.sequence.to_le_bytes());
    record.extend(h.uncertainty_ns.to_le_bytes());
    record.extend(h.flags.to_le_bytes());
    for value in sample.values() {
        match value {
            Value::F64(x) => record.extend(x.to_le_bytes()),
            Value::F32(x) => record.extend(x.to_le_bytes()),
            Value::I64(x) => record.extend(x.to_le_bytes()),
            Value::Bool(x) => record.push(u8::from(x)),
            Value::Text(_) => {}
        }
    }
    record
}
