//! Samples of signals: `depthrig_msgs/msg/SignalSamples`, with every bit that the channel carried, and each of them
//! once more as a message that viewers know, see [`SignalForm`].

use crate::cdr::{Reader, Writer};
use crate::msgs::schemas::Schema;
use crate::{Error, ErrorKind, Result};
use depthrig_bus::{FieldType, SignalDescription, SignalHeader, SignalKind, SignalSample, Value};
use std::sync::Arc;

/// The message type of the single samples of a signal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SignalForm {
    /// `sensor_msgs/msg/JointState`, with the values in one of its three arrays.
    Joints(JointArray),
    /// `geometry_msgs/msg/PoseStamped`.
    Pose,
    /// `depthrig_msgs/msg/SignalValues`.
    Values,
}

/// The array of a `JointState`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum JointArray {
    Position,
    Velocity,
    Effort,
}

impl JointArray {
    /// The array for this unit: `JointState` has SI units. Others are not converted, which would change bits.
    fn of(unit: &str) -> Option<Self> {
        match unit {
            "rad" | "m" => Some(Self::Position),
            "rad/s" | "m/s" => Some(Self::Velocity),
            "N" | "Nm" | "N m" | "N*m" | "N·m" => Some(Self::Effort),
            _ => None,
        }
    }
}

impl SignalForm {
    /// The form of a signal: `joints` in one SI unit are a `JointState`.
    pub(crate) fn of(description: &SignalDescription) -> Self {
        match description.kind() {
            SignalKind::Pose => Self::Pose,
            SignalKind::Joints => {
                let mut arrays = description.all_fields().iter().map(|f| JointArray::of(&f.unit));
                let first = arrays.next().flatten();
                match first.filter(|first| arrays.all(|other| other == Some(*first))) {
                    Some(array) => Self::Joints(array),
                    None => Self::Values,
                }
            }
            SignalKind::Fields => Self::Values,
        }
    }

    /// The last part of its topic.
    pub(crate) const fn topic(self) -> &'static str {
        match self {
            Self::Joints(_) => "joint_states",
            Self::Pose => "pose",
            Self::Values => "values",
        }
    }

    pub(crate) const fn schema(self) -> Schema {
        match self {
            Self::Joints(_) => Schema::JointState,
            Self::Pose => Schema::PoseStamped,
            Self::Values => Schema::SignalValues,
        }
    }

    /// Appends the message of one sample.
    pub(crate) fn write(self, buf: &mut Vec<u8>, sample: &SignalSample, utc_offset_ns: i64) {
        let description = sample.description();
        let stamp_utc_ns = sample.header().time_ns.saturating_add(utc_offset_ns);
        let mut w = Writer::new(buf);
        w.header(stamp_utc_ns, description.frame());
        match self {
            Self::Joints(array) => {
                w.u32(description.all_fields().len() as u32);
                for field in description.all_fields() {
                    w.str(&field.name);
                }
                for which in [JointArray::Position, JointArray::Velocity, JointArray::Effort] {
                    if which == array {
                        let numbers = sample.values().filter_map(Value::number);
                        floats(&mut w, description.all_fields().len(), numbers);
                    } else {
                        w.u32(0);
                    }
                }
            }
            Self::Pose => sample.values().filter_map(Value::number).for_each(|x| {
                w.f64(x);
            }),
            Self::Values => {
                w.u32(description.all_fields().len() as u32);
                for field in description.all_fields() {
                    w.str(&field.name).str(field.kind.name()).str(&field.unit);
                    let count = field.count as usize;
                    let [mut n_floats, mut n_integers] = [0; 2];
                    match field.kind {
                        FieldType::F64 | FieldType::F32 => n_floats = count,
                        FieldType::I64 | FieldType::Bool => n_integers = count,
                        FieldType::Text => {}
                    }
                    floats(&mut w, n_floats, sample.field(&field.name).filter_map(float));
                    w.u32(n_integers as u32);
                    sample.field(&field.name).filter_map(integer).for_each(|x| {
                        w.i64(x);
                    });
                    let text = sample.field(&field.name).find_map(|value| match value {
                        Value::Text(text) => Some(text),
                        _ => None,
                    });
                    w.str(text.unwrap_or_default());
                }
            }
        }
    }
}

/// Appends a `float64[]` of `count` numbers.
fn floats(w: &mut Writer<'_>, count: usize, numbers: impl Iterator<Item = f64>) {
    w.u32(count as u32);
    for x in numbers {
        w.f64(x);
    }
}

fn float(value: Value<'_>) -> Option<f64> {
    if value.kind().is_float() { value.number() } else { None }
}

fn integer(value: Value<'_>) -> Option<i64> {
    match value {
        Value::I64(x) => Some(x),
        Value::Bool(x) => Some(i64::from(x)),
        _ => None,
    }
}

/// Samples of one publisher as they are stored.
pub(crate) struct Samples {
    /// Time of the newest sample, UTC nanoseconds since 1970.
    pub(crate) stamp_utc_ns: i64,
    pub(crate) samples: Vec<SignalSample>,
}

/// Appends samples of one publisher; those of another session are not written.
pub(crate) fn write_samples(buf: &mut Vec<u8>, stamp_utc_ns: i64, samples: &[SignalSample]) {
    let session = samples.first().map_or(0, |s| s.header().session);
    let mut w = Writer::new(buf);
    w.time(stamp_utc_ns).u64(session).u32(samples.len() as u32);
    for s in samples {
        let h = s.header();
        w.u64(h.sequence).i64(h.time_ns).i64(h.publish_time_ns).u64(h.uncertainty_ns).u32(h.flags);
        w.u32(s.bytes().len() as u32).raw(s.bytes());
    }
}

/// Reads samples of the signal of this description.
pub(crate) fn read_samples(message: &[u8], description: &Arc<SignalDescription>) -> Result<Samples> {
    let mut r = Reader::new(message)?;
    let stamp_utc_ns = r.time()?;
    let session = r.u64()?;
    let samples = r.seq(|r| {
        let mut header = SignalHeader {
            sequence: r.u64()?,
            session,
            time_ns: r.i64()?,
            publish_time_ns: r.i64()?,
            uncertainty_ns: r.u64()?,
            flags: r.u32()?,
            description_hash: description.hash(),
            description_len: description.json().len() as u32,
            ..SignalHeader::default()
        };
        let len = r.u32()? as usize;
        let values = r.raw(len)?;
        header.payload_len = (description.json().len().next_multiple_of(8) + len) as u32;
        SignalSample::new(header, description, values.to_vec())
            .map_err(|e| Error::new(ErrorKind::Corrupt, e.to_string()).with_source(e))
    })?;
    Ok(Samples { stamp_utc_ns, samples })
}
