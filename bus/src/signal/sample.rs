//! A sample as a reader has it: a copy of the header and the values, with the description.

use super::MAX_DESCRIPTION_BYTES;
use super::description::SignalDescription;
use super::header::{SIGNAL_VERSION, SignalFlags, SignalHeader};
use super::value::{self, Value};
use crate::{Error, ErrorKind, HostTime, Result};
use std::sync::Arc;

/// One sample of a signal, in memory of its own.
#[derive(Debug, Clone, PartialEq)]
pub struct SignalSample {
    header: SignalHeader,
    description: Arc<SignalDescription>,
    values: Vec<u8>,
}

impl SignalSample {
    /// A sample of these parts, which are checked.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`] when the values are not those that the description names.
    pub fn new(header: SignalHeader, description: &Arc<SignalDescription>, values: Vec<u8>) -> Result<Self> {
        value::check(description, &values)?;
        Ok(Self { header, description: Arc::clone(description), values })
    }

    /// Reads a header and a payload with arbitrary content. The description is parsed only if its hash is not that of
    /// `known`, which then becomes this one.
    ///
    /// # Errors
    /// [`ErrorKind::VersionMismatch`] for a header or a description of another version, [`ErrorKind::Invalid`] naming
    /// what is wrong. `what` names the signal.
    pub fn decode(
        header: &SignalHeader,
        payload: &[u8],
        known: &mut Option<Arc<SignalDescription>>,
        what: &str,
    ) -> Result<Self> {
        let header = *header;
        if !header.is_valid() {
            return Err(Error::new(
                ErrorKind::VersionMismatch,
                format!(
                    "{what}: a sample has header version {}, this program reads version {SIGNAL_VERSION}; run publisher and \
                     reader with the same version of depthrig",
                    header.version
                ),
            ));
        }
        let invalid = |why: &str| Error::new(ErrorKind::Invalid, format!("{what}: invalid sample: {why}"));
        let len = header.description_len as usize;
        if len > MAX_DESCRIPTION_BYTES || payload.len() != header.payload_len as usize {
            return Err(invalid("its description or its payload has not the length that the header states"));
        }
        let start = len.next_multiple_of(8);
        let text = payload.get(..len).ok_or_else(|| invalid("its description is cut off"))?;
        let values = payload.get(start..).ok_or_else(|| invalid("its values are cut off"))?;
        let description = match known {
            Some(known) if known.hash() == header.description_hash => Arc::clone(known),
            _ => {
                let parsed = Arc::new(SignalDescription::parse(text)?);
                if parsed.hash() != header.description_hash {
                    return Err(invalid("its description has another hash than the header states"));
                }
                *known = Some(Arc::clone(&parsed));
                parsed
            }
        };
        Self::new(header, &description, values.to_vec())
    }

    /// The header, as it was published.
    pub const fn header(&self) -> &SignalHeader {
        &self.header
    }

    /// The description of the signal.
    pub const fn description(&self) -> &Arc<SignalDescription> {
        &self.description
    }

    /// When the values were measured.
    pub const fn time(&self) -> HostTime {
        HostTime::from_ns(self.header.time_ns)
    }

    /// Whether all bits of `flag` are set.
    pub const fn has(&self, flag: SignalFlags) -> bool {
        self.header.has(flag)
    }

    /// The values as they were published: each aligned to its size, little-endian, a text last behind its length.
    pub fn bytes(&self) -> &[u8] {
        &self.values
    }

    /// All values, element by element in the order of the fields.
    pub fn values(&self) -> impl Iterator<Item = Value<'_>> {
        (0..self.description.all_fields().len())
            .flat_map(|index| value::elements(&self.description, &self.values, index))
    }

    /// The elements of the field `name`; none if there is no such field.
    pub fn field(&self, name: &str) -> impl Iterator<Item = Value<'_>> {
        let index = self.description.field(name).map_or(usize::MAX, |(index, _)| index);
        value::elements(&self.description, &self.values, index)
    }

    /// All numbers as floats, in the order of the fields; a text is left out.
    pub fn numbers(&self) -> Vec<f64> {
        self.values().filter_map(Value::number).collect()
    }
}
