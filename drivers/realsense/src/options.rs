//! The settings of a rig, put into a camera: checked against its own ranges, read back, logged.

use super::config::RealsenseConfig;
use super::protocol::hwm::UNIT_ID;
use super::transport::ImageControls;
use core::time::Duration;
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::controls::{Control, ControlKind, ControlState, ControlValue};
use depthrig_usb::uvc::control::{ControlPort, Query};

/// A number in the extension unit of the stereo module (librealsense `src/ds/ds-private.h`).
#[derive(Debug, Clone, Copy)]
pub(super) struct UnitControl {
    selector: u8,
    key: &'static str,
    unit: &'static str,
    kind: ControlKind,
}

const EMITTER: UnitControl = UnitControl { selector: 2, key: "emitter", unit: "", kind: ControlKind::Menu };
const EXPOSURE: UnitControl =
    UnitControl { selector: 3, key: "exposure_us", unit: " µs", kind: ControlKind::Integer };
const LASER_POWER: UnitControl =
    UnitControl { selector: 4, key: "laser_power_mw", unit: " mW", kind: ControlKind::Integer };
const AUTO_EXPOSURE: UnitControl =
    UnitControl { selector: 0x0B, key: "auto_exposure", unit: "", kind: ControlKind::Boolean };
/// All of them.
pub(super) const UNIT_CONTROLS: [UnitControl; 4] = [AUTO_EXPOSURE, EXPOSURE, EMITTER, LASER_POWER];
/// The emitter's values in the order of their numbers, as rig files name them.
const EMITTERS: [&str; 4] = ["off", "laser", "auto", "led"];

/// Times that a camera which says "not now" is asked again.
const TRIES: u32 = 5;
const BETWEEN_TRIES: Duration = Duration::from_millis(20);

/// Applies the settings of `config` that concern exposure, projector and colour. `color` is `None` where nothing is
/// asked of the colour image.
///
/// # Errors
/// [`ErrorKind::BadInput`] naming the key and what the camera takes; [`ErrorKind::Unsupported`] when it has no such
/// control; [`ErrorKind::Protocol`] when it keeps another value than it was given; those of the ports.
pub(super) fn apply(
    config: &RealsenseConfig,
    label: &str,
    port: &mut dyn ControlPort,
    stereo: Option<&mut dyn ImageControls>,
    color: Option<&mut dyn ImageControls>,
) -> Result<()> {
    let manual = config.exposure_us.is_some() || config.gain.is_some();
    // By hand means by hand: the camera ignores a value while its automatic is on.
    let auto_exposure = config.auto_exposure.or(manual.then_some(false));
    for (control, value) in [
        (AUTO_EXPOSURE, auto_exposure.map(u32::from)),
        (EXPOSURE, config.exposure_us),
        (EMITTER, config.emitter.map(|e| e as u32)),
        (LASER_POWER, config.laser_power_mw.map(u32::from)),
    ] {
        if let Some(value) = value {
            control.set(port, value)?;
            tracing::info!(camera = %label, "{} set to {value}{}", control.key, control.unit);
        }
    }
    if let (Some(gain), Some(stereo)) = (config.gain, stereo) {
        let values = [("gain".to_owned(), ControlValue::Integer(gain.into()))];
        set_named(label, "gain", stereo, values.iter().map(|(n, v)| (n, v)))?;
    }
    if let Some(color) = color {
        // Automatics first: what they hold cannot be written.
        let (automatics, others): (Vec<_>, Vec<_>) =
            config.color_controls.iter().partition(|(name, _)| name.contains("auto"));
        set_named(label, "color_controls", color, automatics.into_iter().chain(others))?;
    }
    Ok(())
}

/// Changes a control of the extension unit. By hand means by hand: the camera ignores an exposure while its automatic is on.
///
/// # Errors
/// As [`apply`].
pub(super) fn set_unit(control: UnitControl, port: &mut dyn ControlPort, value: &ControlValue) -> Result<()> {
    let number = control.state(port)?.control.check(value)?;
    if control.selector == EXPOSURE.selector {
        AUTO_EXPOSURE.set(port, 0)?;
    }
    // The camera's range is below 2^32.
    control.set(port, number as u32)
}

impl UnitControl {
    pub(super) const fn key(self) -> &'static str {
        self.key
    }

    /// Its range and its value.
    pub(super) fn state(self, port: &mut dyn ControlPort) -> Result<ControlState> {
        let length = patiently(|| port.length(UNIT_ID, self.selector))?;
        let mut read = |query: Query| -> Result<i64> {
            let mut bytes = [0; 4];
            let value = bytes.get_mut(..length.min(4)).unwrap_or_default();
            patiently(|| port.query(UNIT_ID, self.selector, query, value))?;
            Ok(u32::from_le_bytes(bytes).into())
        };
        let minimum = read(Query::GetMin)?;
        let maximum = read(Query::GetMax)?;
        let step = read(Query::GetRes)?;
        let default = read(Query::GetDef)?;
        let value = read(Query::GetCur)?;
        let items = match self.kind {
            ControlKind::Menu => {
                let named = EMITTERS.iter().zip(0..).filter(|(_, n)| (minimum..=maximum).contains(n));
                named.map(|(name, n)| (n, (*name).to_owned())).collect()
            }
            _ => Vec::new(),
        };
        let control = Control {
            id: self.selector.into(),
            name: self.key.to_owned(),
            kind: self.kind,
            minimum,
            maximum,
            step: step.max(1) as u64,
            default,
            read_only: false,
            write_only: false,
            inactive: false,
            items,
        };
        Ok(ControlState { key: self.key.to_owned(), control, value: Some(value) })
    }

    fn set(self, port: &mut dyn ControlPort, value: u32) -> Result<()> {
        let key = self.key;
        let no_such = |e: Error| match e.kind() {
            ErrorKind::Unsupported => Error::new(
                ErrorKind::Unsupported,
                format!("{key}: this camera has no such control; remove the key ({e})"),
            )
            .with_source(e),
            _ => e,
        };
        let length = patiently(|| port.length(UNIT_ID, self.selector)).map_err(no_such)?;
        if !(1..=4).contains(&length) {
            return Err(Error::new(
                ErrorKind::Protocol,
                format!("{key}: the camera reports a value of {length} bytes"),
            ));
        }
        let mut read = |query: Query| -> Result<u32> {
            let mut bytes = [0; 4];
            let value = bytes.get_mut(..length).unwrap_or_default();
            patiently(|| port.query(UNIT_ID, self.selector, query, value))?;
            Ok(u32::from_le_bytes(bytes))
        };
        let least = read(Query::GetMin)?;
        let most = read(Query::GetMax)?;
        let step = read(Query::GetRes)?.max(1);
        if !(least..=most).contains(&value) || !(value - least).is_multiple_of(step) {
            let steps = if step > 1 { format!(" in steps of {step}") } else { String::new() };
            let unit = self.unit;
            return Err(Error::new(
                ErrorKind::BadInput,
                format!("{key} = {value}: the camera takes {least} to {most}{unit}{steps}"),
            ));
        }
        let mut bytes = value.to_le_bytes();
        let sent = bytes.get_mut(..length).unwrap_or_default();
        patiently(|| port.query(UNIT_ID, self.selector, Query::SetCur, sent))?;
        let mut bytes = [0; 4];
        let got = bytes.get_mut(..length).unwrap_or_default();
        patiently(|| port.query(UNIT_ID, self.selector, Query::GetCur, got))?;
        kept(key, value.into(), u32::from_le_bytes(bytes).into())
    }
}

/// Sets image controls by name.
///
/// # Errors
/// As [`apply`].
pub(super) fn set_named<'a>(
    label: &str,
    key: &str,
    controls: &mut dyn ImageControls,
    values: impl Iterator<Item = (&'a String, &'a ControlValue)>,
) -> Result<()> {
    let mut values = values.peekable();
    if values.peek().is_none() {
        return Ok(());
    }
    let there: Vec<Control> = controls.list()?;
    for (name, value) in values {
        let in_key = |e: Error| Error::new(e.kind(), format!("{key}: {e}")).with_source(e);
        let control = depthrig_usb::controls::find(&there, name).map_err(in_key)?;
        let number = control.check(value).map_err(in_key)?;
        controls.set(control, number).map_err(in_key)?;
        if !control.write_only && control.kind != ControlKind::Button {
            let now = controls.get(control).map_err(in_key)?;
            kept(&format!("{key}, {name}"), number, now)?;
        }
        tracing::info!(camera = %label, "{name} set to {value}");
    }
    Ok(())
}

fn kept(key: &str, asked: i64, now: i64) -> Result<()> {
    if asked == now {
        return Ok(());
    }
    let text = format!("{key}: set to {asked} and the camera reports {now}; choose another value");
    Err(Error::new(ErrorKind::Protocol, text))
}

/// Asks again when the camera is not ready.
fn patiently<T>(mut ask: impl FnMut() -> Result<T>) -> Result<T> {
    let mut tries = 1;
    loop {
        match ask() {
            Err(e) if e.kind() == ErrorKind::Busy && tries < TRIES => {
                tries += 1;
                std::thread::sleep(BETWEEN_TRIES);
            }
            done => return done,
        }
    }
}

#[cfg(test)]
mod tests;
