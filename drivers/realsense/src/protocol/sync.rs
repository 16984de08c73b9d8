//! Synchronisation of D400 cameras by cable: which modes there are, from which firmware on, and their codes.
//!
//! Sources: librealsense `src/ds/ds-options.cpp` (`external_sync_mode`) and `src/ds/d400/d400-device.cpp` (the
//! firmware that each needs), Apache-2.0.

use super::firmware::Firmware;
use super::gvd::Shutter;
use super::hwm::{HardwareMonitor, Request};
use super::protocol_error;
use core::fmt;
use depthrig_driver::{Error, ErrorKind, Result};

/// How a camera keeps time with others.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum SyncMode {
    /// Every camera for itself.
    #[default]
    Free,
    /// Gives the pulse.
    Master,
    /// Depth follows the pulse.
    Slave,
    /// Depth and colour follow the pulse.
    FullSlave,
    /// Each pulse triggers this many frames, at least one.
    Genlock(u8),
    /// Each pulse triggers two frames, the first with laser, the second without.
    GenlockLaserOnOff,
    /// Each pulse triggers two frames, the first without laser, the second with it.
    GenlockLaserOffOn,
}

/// Product id of the D405, which has no connector for it.
const D405: u16 = 0x0B5B;

impl SyncMode {
    /// Parameter 1 of SET_CAM_SYNC.
    pub const fn code(self) -> u32 {
        match self {
            Self::Free => 0,
            Self::Master => 1,
            Self::Slave => 2,
            Self::FullSlave => 3,
            Self::Genlock(frames) => 4 | (frames as u32) << 8,
            Self::GenlockLaserOnOff => 0x0001_0204,
            Self::GenlockLaserOffOn => 0x0003_0204,
        }
    }

    /// The mode of a reply to GET_CAM_SYNC; `None` when it is not known.
    pub fn from_reply(data: &[u8]) -> Option<Self> {
        match (data.first()?, data.get(1).copied().unwrap_or(0), data.get(2).copied().unwrap_or(0)) {
            (0, ..) => Some(Self::Free),
            (1, ..) => Some(Self::Master),
            (2, ..) => Some(Self::Slave),
            (3, ..) => Some(Self::FullSlave),
            (4, _, 1) => Some(Self::GenlockLaserOnOff),
            (4, _, 3) => Some(Self::GenlockLaserOffOn),
            (4, frames @ 1.., 0) => Some(Self::Genlock(frames)),
            _ => None,
        }
    }

    /// The oldest firmware that has it.
    pub const fn since(self) -> Firmware {
        match self {
            Self::Free | Self::Master | Self::Slave => Firmware::new(5, 9, 15, 1),
            Self::FullSlave | Self::Genlock(_) => Firmware::new(5, 12, 4, 0),
            Self::GenlockLaserOnOff | Self::GenlockLaserOffOn => Firmware::new(5, 12, 12, 100),
        }
    }

    /// Whether only cameras with a global shutter have it.
    pub const fn needs_global_shutter(self) -> bool {
        !matches!(self, Self::Free | Self::Master | Self::Slave)
    }

    /// Checks that a camera has it.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] saying what the camera lacks; [`ErrorKind::BadInput`] for no frames per pulse.
    pub fn check(self, product_id: u16, firmware: Firmware, shutter: Shutter) -> Result<()> {
        let lacks = |why: String| Err(Error::new(ErrorKind::Unsupported, format!("sync mode {self}: {why}")));
        if self == Self::Genlock(0) {
            return Err(Error::new(ErrorKind::BadInput, "genlock needs 1 to 255 frames per pulse"));
        }
        if product_id == D405 {
            return lacks("this model has no connector for it".into());
        }
        if self.needs_global_shutter() && shutter != Shutter::Global {
            return lacks(
                "only models with a global shutter (D435, D455) have it; use master or slave".into(),
            );
        }
        if firmware < self.since() {
            return lacks(format!("needs firmware {} or later; the camera has {firmware}", self.since()));
        }
        Ok(())
    }

    /// The mode that a camera has now.
    ///
    /// # Errors
    /// Those of [`HardwareMonitor::command`]; [`ErrorKind::Protocol`] when it is not known.
    pub fn read(monitor: &mut dyn HardwareMonitor) -> Result<Self> {
        let data = monitor.command(&Request::sync())?;
        Self::from_reply(&data).ok_or_else(|| {
            let shown = data.get(..4).unwrap_or(&data);
            protocol_error(format!("the camera's sync mode {shown:02x?} is not known"))
        })
    }

    /// Sets it on a camera that does not stream; [`Self::check`] first. It holds until the camera restarts.
    ///
    /// # Errors
    /// Those of [`HardwareMonitor::command`]; [`ErrorKind::Protocol`] when the camera says another mode afterwards.
    pub fn write(self, monitor: &mut dyn HardwareMonitor) -> Result<()> {
        let mut set_and_read = || {
            monitor.command(&Request::set_sync(self.code()))?;
            Self::read(monitor)
        };
        let now = set_and_read().map_err(|e| {
            let cure = match e.kind() {
                ErrorKind::Unsupported | ErrorKind::Protocol => ". Choose another mode, or leave it out",
                ErrorKind::Busy => ". It takes none while it streams; plug it in anew if that stays so",
                _ => "",
            };
            Error::new(e.kind(), format!("sync mode {self}: {e}{cure}")).with_source(e)
        })?;
        if now == self {
            return Ok(());
        }
        Err(protocol_error(format!(
            "sync mode {self} was set and the camera reports {now}; stop its streams first"
        )))
    }
}

impl fmt::Display for SyncMode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Free => "free",
            Self::Master => "master",
            Self::Slave => "slave",
            Self::FullSlave => "full_slave",
            Self::Genlock(frames) => return write!(f, "genlock {frames}"),
            Self::GenlockLaserOnOff => "genlock laser on-off",
            Self::GenlockLaserOffOn => "genlock laser off-on",
        })
    }
}

#[cfg(test)]
mod tests;
