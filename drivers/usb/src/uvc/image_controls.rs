//! Image controls of USB video (exposure, gain, white balance, …) by the names and values that V4L2 gives them, over
//! any [`ControlPort`]: so that a rig file means the same with and without the kernel's driver.
//!
//! Selectors, lengths and bits: UVC 1.5 class specification, tables and sections 4.2.2.1 and 4.2.2.3.
//! Numbers and names: `linux/v4l2-controls.h` and the kernel's documentation of controls.

use super::control::{ControlPort, Query};
use super::descriptors::{ControlInterface, UnitKind};
use crate::controls::{Control, ControlKind};
use depthrig_driver::{Error, ErrorKind, Result};

/// A control as the table below has it.
struct Known {
    /// Of the processing unit; else of the camera terminal.
    processing: bool,
    selector: u8,
    /// Its bit in the unit's map of controls.
    bit: usize,
    bytes: usize,
    signed: bool,
    kind: ControlKind,
    id: u32,
    name: &'static str,
}

const USER: u32 = 0x0098_0900;
const CAMERA: u32 = 0x009A_0900;
const AUTO_EXPOSURE: u32 = CAMERA + 1;
const POWER_LINE: u32 = USER + 24;

/// V4L2's number, UVC's bit and V4L2's name of each exposure mode: V4L2 counts them, UVC has a bit for each.
const EXPOSURE_MODES: [(i64, i64, &str); 4] = [
    (0, 2, "Auto Mode"),
    (1, 1, "Manual Mode"),
    (2, 4, "Shutter Priority Mode"),
    (3, 8, "Aperture Priority Mode"),
];

const POWER_LINES: [&str; 4] = ["Disabled", "50 Hz", "60 Hz", "Auto"];

#[allow(clippy::too_many_arguments)] // a table reads best with a line for each control
#[rustfmt::skip]
const fn known(
    processing: bool, selector: u8, bit: usize, bytes: usize, signed: bool, kind: ControlKind, id: u32, name: &'static str,
) -> Known {
    Known { processing, selector, bit, bytes, signed, kind, id, name }
}

#[rustfmt::skip]
const TABLE: [Known; 14] = [
    known(false, 0x02, 1, 1, false, ControlKind::Menu, AUTO_EXPOSURE, "auto_exposure"),
    known(false, 0x03, 2, 1, false, ControlKind::Boolean, CAMERA + 3, "exposure_dynamic_framerate"),
    known(false, 0x04, 3, 4, false, ControlKind::Integer, CAMERA + 2, "exposure_time_absolute"),
    known(true, 0x02, 0, 2, true, ControlKind::Integer, USER, "brightness"),
    known(true, 0x03, 1, 2, false, ControlKind::Integer, USER + 1, "contrast"),
    known(true, 0x06, 2, 2, true, ControlKind::Integer, USER + 3, "hue"),
    known(true, 0x07, 3, 2, false, ControlKind::Integer, USER + 2, "saturation"),
    known(true, 0x08, 4, 2, false, ControlKind::Integer, USER + 27, "sharpness"),
    known(true, 0x09, 5, 2, false, ControlKind::Integer, USER + 16, "gamma"),
    known(true, 0x0A, 6, 2, false, ControlKind::Integer, USER + 26, "white_balance_temperature"),
    known(true, 0x01, 8, 2, false, ControlKind::Integer, USER + 28, "backlight_compensation"),
    known(true, 0x04, 9, 2, false, ControlKind::Integer, USER + 19, "gain"),
    known(true, 0x05, 10, 1, false, ControlKind::Menu, POWER_LINE, "power_line_frequency"),
    known(true, 0x0B, 12, 1, false, ControlKind::Boolean, USER + 12, "white_balance_automatic"),
];

/// The image controls of one function.
#[derive(Debug)]
pub struct ImageUnits<P> {
    port: P,
    /// Number and map of controls of the camera terminal and of the processing unit.
    camera: Option<(u8, Vec<u8>)>,
    processing: Option<(u8, Vec<u8>)>,
}

impl<P: ControlPort> ImageUnits<P> {
    /// Those of `function`, over `port`.
    pub fn new(port: P, function: &ControlInterface) -> Self {
        let unit = |kind| {
            let unit = function.units.iter().find(|u| u.kind == kind)?;
            Some((unit.id, unit.controls.clone()))
        };
        Self { port, camera: unit(UnitKind::Camera), processing: unit(UnitKind::Processing) }
    }

    /// All that there are and can be read. A control that the device lists and refuses is left out.
    ///
    /// # Errors
    /// [`ErrorKind::Disconnected`], [`ErrorKind::Io`].
    pub fn list(&mut self) -> Result<Vec<Control>> {
        let mut all = Vec::new();
        for entry in &TABLE {
            match self.describe(entry) {
                Ok(Some(control)) => all.push(control),
                Ok(None) => {}
                Err(e) if matches!(e.kind(), ErrorKind::Disconnected | ErrorKind::Io) => return Err(e),
                Err(e) => tracing::debug!("{} is listed and refused: {e}", entry.name),
            }
        }
        Ok(all)
    }

    /// The present value.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] when the control does not exist, and those of [`ControlPort::query`].
    pub fn get(&mut self, control: &Control) -> Result<i64> {
        let (entry, unit) = self.find(control)?;
        let value = self.number(entry, unit, Query::GetCur)?;
        Ok(from_wire(entry, value))
    }

    /// Sets it to a value that was checked.
    ///
    /// # Errors
    /// Those of [`Self::get`].
    pub fn set(&mut self, control: &Control, value: i64) -> Result<()> {
        let (entry, unit) = self.find(control)?;
        let mut bytes = to_wire(entry, value).to_le_bytes();
        let data = bytes.get_mut(..entry.bytes).unwrap_or_default();
        self.port.query(unit, entry.selector, Query::SetCur, data)
    }

    fn find(&self, control: &Control) -> Result<(&'static Known, u8)> {
        let entry = TABLE.iter().find(|k| k.id == control.id);
        entry.and_then(|k| Some((k, self.unit(k)?))).ok_or_else(|| {
            let text = format!("the camera has no control \"{}\"", control.name);
            Error::new(ErrorKind::Unsupported, text)
        })
    }

    /// The number of the unit that has a control, if it has.
    fn unit(&self, entry: &Known) -> Option<u8> {
        let (id, map) = if entry.processing { self.processing.as_ref() } else { self.camera.as_ref() }?;
        (map.get(entry.bit / 8)? >> (entry.bit % 8) & 1 == 1).then_some(*id)
    }

    fn describe(&mut self, entry: &'static Known) -> Result<Option<Control>> {
        let Some(unit) = self.unit(entry) else { return Ok(None) };
        let mut info = [0];
        self.port.query(unit, entry.selector, Query::GetInfo, &mut info)?;
        let [info] = info;
        if info & 1 == 0 {
            return Ok(None); // it cannot be read
        }
        let default = from_wire(entry, self.number(entry, unit, Query::GetDef)?);
        let mut minimum = 0;
        let mut maximum = 1;
        let mut step = 1;
        let mut items = Vec::new();
        match entry.id {
            AUTO_EXPOSURE => {
                // The step is the map of the modes that there are.
                let modes = self.number(entry, unit, Query::GetRes)?;
                let there = EXPOSURE_MODES.iter().filter(|(_, bit, _)| modes & bit != 0);
                items = there.map(|(number, _, name)| (*number, (*name).to_owned())).collect();
                maximum = 3;
            }
            POWER_LINE => {
                maximum = self.number(entry, unit, Query::GetMax).map_or(2, |m| m.clamp(0, 3));
                items = (0..=maximum).zip(POWER_LINES.map(str::to_owned)).collect();
            }
            _ if entry.kind == ControlKind::Integer => {
                minimum = self.number(entry, unit, Query::GetMin)?;
                maximum = self.number(entry, unit, Query::GetMax)?;
                step = self.number(entry, unit, Query::GetRes)?.max(1);
            }
            _ => {}
        }
        Ok(Some(Control {
            id: entry.id,
            name: entry.name.to_owned(),
            kind: entry.kind,
            minimum,
            maximum,
            step: step.unsigned_abs(),
            default,
            read_only: info & 2 == 0,
            write_only: false,
            inactive: info & 4 != 0,
            items,
        }))
    }

    fn number(&mut self, entry: &Known, unit: u8, query: Query) -> Result<i64> {
        let mut bytes = [0; 8];
        let data = bytes.get_mut(..entry.bytes).unwrap_or_default();
        self.port.query(unit, entry.selector, query, data)?;
        let shift = 64 - 8 * entry.bytes as u32;
        let raw = i64::from_le_bytes(bytes);
        Ok(if entry.signed { (raw << shift) >> shift } else { raw })
    }
}

/// The number that V4L2 has for what the device says.
fn from_wire(entry: &Known, value: i64) -> i64 {
    if entry.id != AUTO_EXPOSURE {
        return value;
    }
    EXPOSURE_MODES.iter().find(|(_, bit, _)| *bit == value).map_or(value, |(number, ..)| *number)
}

/// The reverse.
fn to_wire(entry: &Known, value: i64) -> i64 {
    if entry.id != AUTO_EXPOSURE {
        return value;
    }
    EXPOSURE_MODES.iter().find(|(number, ..)| *number == value).map_or(value, |(_, bit, _)| *bit)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::uvc::descriptors::Unit;
    use std::collections::BTreeMap;

    /// A port whose values are in memory, by unit, selector and request.
    #[derive(Default)]
    struct FakePort(BTreeMap<(u8, u8, u8), Vec<u8>>);

    impl ControlPort for FakePort {
        fn query(&mut self, unit: u8, selector: u8, query: Query, data: &mut [u8]) -> Result<()> {
            let key = (unit, selector, query as u8);
            if query == Query::SetCur {
                self.0.insert((unit, selector, Query::GetCur as u8), data.to_vec());
                return Ok(());
            }
            let value =
                self.0.get(&key).ok_or_else(|| Error::new(ErrorKind::Protocol, format!("{key:?}")))?;
            assert_eq!(value.len(), data.len(), "{key:?}");
            data.copy_from_slice(value);
            Ok(())
        }
    }

    fn units() -> ImageUnits<FakePort> {
        let unit = |id, kind, controls: &[u8]| Unit { id, kind, controls: controls.to_vec() };
        let function = ControlInterface {
            units: vec![
                unit(1, UnitKind::Camera, &[0x0A, 0, 0]),
                unit(2, UnitKind::Processing, &[0x01, 0x06, 0]),
            ],
            ..ControlInterface::default()
        };
        let mut fake = FakePort::default();
        let mut put = |unit, selector, values: [&[u8]; 5]| {
            let queries = [Query::GetInfo, Query::GetMin, Query::GetMax, Query::GetRes, Query::GetDef];
            for (query, value) in queries.into_iter().zip(values) {
                if !value.is_empty() {
                    fake.0.insert((unit, selector, query as u8), value.to_vec());
                }
            }
        };
        put(1, 0x02, [&[3], &[], &[], &[0x09], &[8]]);
        put(1, 0x04, [&[7], &[1, 0, 0, 0], &[0x10, 0x27, 0, 0], &[1, 0, 0, 0], &[0x9C, 0, 0, 0]]);
        put(2, 0x02, [&[3], &[0xC0, 0xFF], &[0x40, 0], &[1, 0], &[0, 0]]);
        put(2, 0x05, [&[3], &[], &[2], &[], &[1]]);
        // Gain (bit 9) is listed and refused.
        ImageUnits::new(fake, &function)
    }

    #[test]
    fn the_controls_that_there_are_have_the_kernels_names_and_values() {
        let list = units().list().unwrap();
        let shown: Vec<_> = list.iter().map(|c| (c.name.as_str(), c.minimum, c.maximum, c.default)).collect();
        assert_eq!(
            shown,
            [
                ("auto_exposure", 0, 3, 3),
                ("exposure_time_absolute", 1, 10_000, 156),
                ("brightness", -64, 64, 0),
                ("power_line_frequency", 0, 2, 1),
            ]
        );
        let names = |i: usize| list[i].items.iter().map(|(n, s)| (*n, s.as_str())).collect::<Vec<_>>();
        assert_eq!(names(0), [(1, "Manual Mode"), (3, "Aperture Priority Mode")]);
        assert_eq!(names(3), [(0, "Disabled"), (1, "50 Hz"), (2, "60 Hz")]);
        assert_eq!((list[1].inactive, list[0].inactive, list[0].read_only), (true, false, false));
    }

    #[test]
    fn what_is_set_is_on_the_wire_as_the_class_has_it() {
        let mut units = units();
        let list = units.list().unwrap();
        for (at, value, unit, selector, wire) in
            [(0, 1, 1, 0x02, vec![1]), (0, 3, 1, 0x02, vec![8]), (2, -3, 2, 0x02, vec![0xFD, 0xFF])]
        {
            units.set(&list[at], value).unwrap();
            assert_eq!(units.port.0[&(unit, selector, Query::GetCur as u8)], wire);
            assert_eq!(units.get(&list[at]).unwrap(), value);
        }
        let gone = Control { id: USER + 1, name: "contrast".to_owned(), ..list[2].clone() };
        assert_eq!(units.set(&gone, 0).unwrap_err().kind(), ErrorKind::Unsupported);
    }
}
