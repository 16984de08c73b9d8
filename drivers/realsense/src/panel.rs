//! The controls of a D400 that streams, by the keys of rig files.

use super::options::{self, UNIT_CONTROLS, set_named};
use super::transport::{Function, ImageControls, Transport};
use depthrig_bus::sync::lock;
use depthrig_driver::controls::{Control, ControlKind, ControlPanel, ControlState, ControlValue};
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::uvc::control::ControlPort;
use std::sync::Mutex;

/// The key of the stereo module's gain, the only image control of its that rig files have.
const GAIN: &str = "gain";
/// The table of a rig file that the colour module's controls are in.
const COLOR: &str = "color_controls";

/// The controls of a running camera.
pub(super) struct Panel {
    label: String,
    ways: Mutex<Ways>,
}

struct Ways {
    unit: Box<dyn ControlPort>,
    stereo: Box<dyn ImageControls>,
    /// `None` where colour is not streamed.
    color: Option<Box<dyn ImageControls>>,
}

impl Panel {
    /// The controls behind `transport`. `color` is the function that has the colour image, if that is streamed.
    ///
    /// # Errors
    /// Those of the transport.
    pub(super) fn new(label: String, transport: &mut dyn Transport, color: Option<Function>) -> Result<Self> {
        let unit = transport.control(Function::Stereo)?;
        let stereo = transport.image_controls(Function::Stereo)?;
        let color = color.map(|function| transport.image_controls(function)).transpose()?;
        Ok(Self { label, ways: Mutex::new(Ways { unit, stereo, color }) })
    }
}

impl ControlPanel for Panel {
    fn list(&self) -> Result<Vec<ControlState>> {
        let mut ways = lock(&self.ways);
        let Ways { unit, stereo, color } = &mut *ways;
        let mut all = Vec::new();
        for control in UNIT_CONTROLS {
            match control.state(unit.as_mut()) {
                Ok(state) => all.push(state),
                // A model without it.
                Err(e) if e.kind() == ErrorKind::Unsupported => {}
                Err(e) => return Err(e),
            }
        }
        for control in stereo.list()?.into_iter().filter(|c| c.name == GAIN) {
            all.push(state_of(stereo.as_mut(), GAIN.to_owned(), control)?);
        }
        if let Some(color) = color {
            for control in color.list()? {
                let is_shown = !matches!(control.kind, ControlKind::Button | ControlKind::Other);
                if is_shown {
                    let key = format!("{COLOR}.{}", control.name);
                    all.push(state_of(color.as_mut(), key, control)?);
                }
            }
        }
        Ok(all)
    }

    fn set(&self, key: &str, value: &ControlValue) -> Result<()> {
        let mut ways = lock(&self.ways);
        let Ways { unit, stereo, color } = &mut *ways;
        if let Some(control) = UNIT_CONTROLS.iter().find(|c| c.key() == key) {
            return options::set_unit(*control, unit.as_mut(), value);
        }
        let name = key.strip_prefix(COLOR).and_then(|k| k.strip_prefix('.'));
        let unknown = || {
            let what = format!("unknown control \"{key}\"; the list of controls has those there are");
            Error::new(ErrorKind::BadInput, what)
        };
        let (controls, name) = match name {
            Some(name) => (color.as_mut().ok_or_else(unknown)?, name),
            None if key == GAIN => (stereo, GAIN),
            None => return Err(unknown()),
        };
        set_named(&self.label, key, controls.as_mut(), core::iter::once((&name.to_owned(), value)))
    }
}

fn state_of(controls: &mut dyn ImageControls, key: String, control: Control) -> Result<ControlState> {
    let value = if control.write_only { None } else { Some(controls.get(&control)?) };
    Ok(ControlState { key, control, value })
}
