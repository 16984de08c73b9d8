//! Requests to the control units of a USB video camera, whichever way they travel.

use depthrig_driver::Result;

/// A request code (UVC 1.5 class specification, table A-8).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Query {
    /// Sets the value.
    SetCur = 0x01,
    /// Reads the value.
    GetCur = 0x81,
    /// Reads the least value.
    GetMin = 0x82,
    /// Reads the greatest value.
    GetMax = 0x83,
    /// Reads the step between values.
    GetRes = 0x84,
    /// Reads the number of bytes of the value, as 16 bits.
    GetLen = 0x85,
    /// Reads what can be done with it, as 8 bits.
    GetInfo = 0x86,
    /// Reads the value it has after power-on.
    GetDef = 0x87,
}

/// The control units of one camera function. Every call may take as long as the kernel's control time-out (5 s), so
/// none belongs on a capture thread.
pub trait ControlPort: Send {
    /// One request to `selector` of `unit`. `data` is sent, or filled; its length must be the value's own
    /// ([`Query::GetLen`]).
    ///
    /// # Errors
    /// [`depthrig_driver::ErrorKind::Unsupported`] when the unit or the selector is not there, [`depthrig_driver::ErrorKind::Busy`] when
    /// the device asks to be asked again, [`depthrig_driver::ErrorKind::Disconnected`], [`depthrig_driver::ErrorKind::Protocol`] when the
    /// length is wrong or the device refuses, [`depthrig_driver::ErrorKind::Io`].
    fn query(&mut self, unit: u8, selector: u8, query: Query, data: &mut [u8]) -> Result<()>;

    /// The number of bytes of a value.
    ///
    /// # Errors
    /// Those of [`Self::query`].
    fn length(&mut self, unit: u8, selector: u8) -> Result<usize> {
        let mut bytes = [0; 2];
        self.query(unit, selector, Query::GetLen, &mut bytes)?;
        Ok(u16::from_le_bytes(bytes).into())
    }
}
