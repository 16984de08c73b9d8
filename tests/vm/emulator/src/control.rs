//! The values of a camera's control units, and how requests to them are answered.

use crate::descriptors::control_length;
use crate::model::{Control, Model, UnitKind};
use crate::{Result, Speed, model};

/// Request codes of the class (UVC 1.5, table A-8).
pub(crate) mod query {
    pub const SET_CUR: u8 = 0x01;
    pub const GET_CUR: u8 = 0x81;
    pub const GET_MIN: u8 = 0x82;
    pub const GET_MAX: u8 = 0x83;
    pub const GET_RES: u8 = 0x84;
    pub const GET_LEN: u8 = 0x85;
    pub const GET_INFO: u8 = 0x86;
    pub const GET_DEF: u8 = 0x87;
}

/// Why a request was refused: the value of the Request Error Code control (UVC 1.5, table 4-7).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Refusal {
    OutOfRange = 4,
    InvalidUnit = 5,
    InvalidControl = 6,
    InvalidRequest = 7,
}

/// A control of a unit, and its value.
struct Entry {
    interface: u8,
    unit: u8,
    control: Control,
    length: usize,
    value: Vec<u8>,
}

/// Every control of a camera.
pub(crate) struct Units {
    entries: Vec<Entry>,
}

fn encode(value: i64, length: usize) -> Vec<u8> {
    let mut bytes = value.to_le_bytes().to_vec();
    bytes.resize(length, 0);
    bytes
}

fn decode(bytes: &[u8], signed: bool) -> i64 {
    let negative = signed && bytes.last().is_some_and(|b| b & 0x80 != 0);
    let mut all = [if negative { 0xFF } else { 0 }; 8];
    for (to, from) in all.iter_mut().zip(bytes) {
        *to = *from;
    }
    i64::from_le_bytes(all)
}

impl Units {
    /// The controls of a model with the values of power-on.
    pub fn new(model: &Model, speed: Speed) -> Self {
        let mut entries = Vec::new();
        for function in &model.functions {
            for unit in function.units.iter().filter(|u| u.kind != UnitKind::Output) {
                for control in &unit.controls {
                    let length = control_length(control, speed);
                    let value = encode(control.default, length);
                    let interface = function.interface;
                    entries.push(Entry { interface, unit: unit.id, control: control.clone(), length, value });
                }
            }
        }
        Self { entries }
    }

    /// Whether there is such a control, and why not.
    fn find(&mut self, interface: u8, unit: u8, selector: u8) -> core::result::Result<&mut Entry, Refusal> {
        if !self.entries.iter().any(|e| e.interface == interface && e.unit == unit) {
            return Err(Refusal::InvalidUnit);
        }
        let wanted =
            |e: &&mut Entry| e.interface == interface && e.unit == unit && e.control.selector == selector;
        self.entries.iter_mut().find(wanted).ok_or(Refusal::InvalidControl)
    }

    /// The value of a control as a number, if there is one.
    pub fn number(&self, unit: u8, selector: u8) -> Option<i64> {
        let entry = self.entries.iter().find(|e| e.unit == unit && e.control.selector == selector)?;
        Some(decode(&entry.value, entry.control.min < 0))
    }

    /// Sets the bytes of a control, as the firmware does by itself.
    pub fn put(&mut self, unit: u8, selector: u8, value: &[u8]) {
        if let Some(entry) =
            self.entries.iter_mut().find(|e| e.unit == unit && e.control.selector == selector)
        {
            entry.value = value.to_vec();
            entry.value.resize(entry.length, 0);
        }
    }

    /// The host writes a control.
    pub fn set(
        &mut self,
        interface: u8,
        unit: u8,
        selector: u8,
        data: &[u8],
    ) -> core::result::Result<(), Refusal> {
        let entry = self.find(interface, unit, selector)?;
        if entry.control.read_only || data.len() != entry.length {
            return Err(Refusal::InvalidRequest);
        }
        if entry.length <= 4 && entry.control.max > entry.control.min {
            let value = decode(data, entry.control.min < 0);
            if !(entry.control.min..=entry.control.max).contains(&value) {
                return Err(Refusal::OutOfRange);
            }
        }
        entry.value.copy_from_slice(data);
        Ok(())
    }

    /// The host asks something of a control.
    pub fn get(
        &mut self,
        interface: u8,
        unit: u8,
        selector: u8,
        request: u8,
    ) -> core::result::Result<Vec<u8>, Refusal> {
        let entry = self.find(interface, unit, selector)?;
        let control = &entry.control;
        Ok(match request {
            query::GET_CUR => entry.value.clone(),
            query::GET_MIN => encode(control.min, entry.length),
            query::GET_MAX => encode(control.max, entry.length),
            query::GET_RES => encode(control.step, entry.length),
            query::GET_LEN => (entry.length as u16).to_le_bytes().to_vec(),
            query::GET_INFO => vec![if control.read_only { 1 } else { 3 }],
            query::GET_DEF => encode(control.default, entry.length),
            _ => return Err(Refusal::InvalidRequest),
        })
    }
}

/// A probe or commit block: the host's proposal and the answer (UVC 1.5, table 4-75).
pub(crate) mod probe {
    use super::{Result, Speed, model};
    use crate::Error;
    use crate::descriptors::offered;
    use model::{Mode, Size, Stream};

    fn block(length: usize, format: u8, frame: u8, mode: &Mode, clock_hz: u32) -> Vec<u8> {
        let mut bytes = vec![0; length.max(34)];
        bytes[0] = 1;
        bytes[2] = format;
        bytes[3] = frame;
        bytes[4..8].copy_from_slice(&mode.interval.to_le_bytes());
        let size = mode.bytes() as u32;
        bytes[18..22].copy_from_slice(&size.to_le_bytes());
        // One payload a frame: the frame, a header, and room for a frame that is too long.
        bytes[22..26].copy_from_slice(&(size + 1024).to_le_bytes());
        bytes[26..30].copy_from_slice(&clock_hz.to_le_bytes());
        bytes[30] = 3;
        bytes[31..34].copy_from_slice(&[1, 1, 1]);
        bytes.resize(length, 0);
        bytes
    }

    /// The block and the mode that a stream answers to the host's proposal: the nearest that it has.
    pub(crate) fn negotiate(
        stream: &Stream,
        speed: Speed,
        length: usize,
        clock_hz: u32,
        proposal: &[u8],
    ) -> Result<(Vec<u8>, Mode)> {
        let formats = offered(stream, speed);
        let number = |at: usize| usize::from(proposal.get(at).copied().unwrap_or(1)).max(1);
        let format_index = number(2).min(formats.len());
        let format = formats
            .get(format_index.saturating_sub(1))
            .ok_or_else(|| Error::new(format!("{} has no mode at this speed", stream.name)))?;
        let sizes: Vec<Size> = format.sizes(speed);
        let frame_index = number(3).min(sizes.len());
        let size = sizes
            .get(frame_index.saturating_sub(1))
            .ok_or_else(|| Error::new(format!("{} has no size at this speed", stream.name)))?;
        let asked = proposal.get(4..8).and_then(|b| b.first_chunk()).map_or(0, |b| u32::from_le_bytes(*b));
        let interval = size.intervals().min_by_key(|have| have.abs_diff(asked)).filter(|_| asked != 0);
        let interval = interval.or_else(|| size.intervals().next()).unwrap_or(333_333);
        let mode = Mode::new(format, size.width, size.height, interval);
        Ok((block(length, format_index as u8, frame_index as u8, &mode, clock_hz), mode))
    }
}
