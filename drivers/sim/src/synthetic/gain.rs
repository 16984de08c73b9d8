//! The gain of a simulated colour camera, its one control that can be changed while it streams.

use super::config::GAINS;
use super::unit::Unit;
use core::sync::atomic::Ordering;
use depthrig_driver::controls::{Control, ControlKind, ControlPanel, ControlState, ControlValue};
use depthrig_driver::{Error, ErrorKind, Result};
use std::sync::Arc;

/// Its key in a rig file.
const KEY: &str = "gain";

/// Brightens an image.
pub(super) fn amplify(image: &mut [u8], gain: u32) {
    let least = *GAINS.start();
    if gain == least {
        return;
    }
    for value in image {
        *value = (u32::from(*value) * gain / least).min(255) as u8;
    }
}

/// The controls of a unit.
#[derive(Debug)]
pub(super) struct Panel(pub(super) Arc<Unit>);

fn control() -> Control {
    Control {
        id: 0,
        name: KEY.to_owned(),
        kind: ControlKind::Integer,
        minimum: (*GAINS.start()).into(),
        maximum: (*GAINS.end()).into(),
        step: 1,
        default: (*GAINS.start()).into(),
        read_only: false,
        write_only: false,
        inactive: false,
        items: Vec::new(),
    }
}

impl ControlPanel for Panel {
    fn list(&self) -> Result<Vec<ControlState>> {
        let value = self.0.gain.load(Ordering::Relaxed).into();
        Ok(vec![ControlState { key: KEY.to_owned(), control: control(), value: Some(value) }])
    }

    fn set(&self, key: &str, value: &ControlValue) -> Result<()> {
        if key != KEY {
            let what = format!("unknown control \"{key}\"; it has: {KEY}");
            return Err(Error::new(ErrorKind::BadInput, what));
        }
        // Within the range, so it fits.
        self.0.gain.store(control().check(value)? as u32, Ordering::Relaxed);
        Ok(())
    }
}
