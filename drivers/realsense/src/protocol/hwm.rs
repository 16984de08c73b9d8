//! The hardware monitor: requests and replies of at most 1024 bytes, by which a RealSense camera reports its
//! serial number and calibration and receives its settings.
//!
//! Source of the layout: librealsense `src/hw-monitor.cpp`, `src/ds/ds-private.h`, `src/l500/l500-private.h`
//! (Apache-2.0), and section 1.7 of the project's notes on camera protocols.

use super::protocol_error;
use depthrig_bus::sync::lock;
use depthrig_driver::bytes::{array, u16_at, u32_at};
use depthrig_driver::{Error, ErrorKind, Result};
use std::sync::{Arc, Mutex};

mod opcode;
mod request;
mod response;
mod unit;

pub use opcode::{D4xxOpcode, L515Opcode};
pub use request::Request;
pub use response::Code;
pub use unit::{Retry, UNIT_GUID, UNIT_ID, UNIT_SELECTOR, UnitMonitor};

/// Size of a request or a reply at the extension unit, padded with zeros.
pub const UNIT_BYTES: usize = 1024;
/// Most data bytes of a request.
pub const MAX_DATA: usize = 1000;
/// Where a reply at the extension unit says how many data bytes it has.
const UNIT_LENGTH_AT: usize = 1020;
/// Bytes of a request before its data.
const HEADER: usize = 24;
/// Bytes of a reply before its data: the echo of the opcode.
const ECHO: usize = 4;
/// Third and fourth byte of every request.
const MAGIC: u16 = 0xCDAB;

/// The way to a camera's hardware monitor.
///
/// Every call may take as long as the kernel's control time-out (5 s): it belongs on a camera's control thread.
pub trait HardwareMonitor: Send {
    /// Sends one request and waits for its reply; gives the reply's data, without the echo of the opcode. A request
    /// that has no reply ([`Request::is_answered`]) gives nothing.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] when the camera does not know the request, [`ErrorKind::NotFound`] when it has no
    /// such data, [`ErrorKind::Busy`] when it is not ready, [`ErrorKind::Protocol`] when it refuses or answers
    /// something else, [`ErrorKind::Disconnected`], [`ErrorKind::Io`].
    fn command(&mut self, request: &Request) -> Result<Vec<u8>>;
}

impl<M: HardwareMonitor + ?Sized> HardwareMonitor for &mut M {
    fn command(&mut self, request: &Request) -> Result<Vec<u8>> {
        (**self).command(request)
    }
}

impl<M: HardwareMonitor + ?Sized> HardwareMonitor for Box<M> {
    fn command(&mut self, request: &Request) -> Result<Vec<u8>> {
        (**self).command(request)
    }
}

/// Several threads may share a monitor: the lock is held from the request to its reply.
impl<M: HardwareMonitor + ?Sized> HardwareMonitor for Arc<Mutex<M>> {
    fn command(&mut self, request: &Request) -> Result<Vec<u8>> {
        // A thread that panicked inside left no half request behind that the next one would not overwrite.
        lock(self).command(request)
    }
}

/// The data of a reply to `request`: 4 bytes of echo, then the data, as it comes from the vendor's bulk endpoint or
/// from [`unit_reply`].
///
/// # Errors
/// [`ErrorKind::Protocol`] when the reply is shorter than its echo or belongs to another request; else as the code
/// says that the camera gave ([`Code`]).
pub fn reply_data<'a>(request: &Request, reply: &'a [u8]) -> Result<&'a [u8]> {
    let (Some(echo), Some(data)) = (array::<ECHO>(reply, 0), reply.get(ECHO..)) else {
        return Err(protocol_error(format!(
            "the reply to {request} has {} bytes; the echo of the opcode alone has 4",
            reply.len()
        )));
    };
    if u32::from_le_bytes(echo) == request.opcode() {
        return Ok(data);
    }
    match i32::from_le_bytes(echo) {
        code @ ..0 => Err(Code(code).into_error(request)),
        other => Err(protocol_error(format!("the reply to {request} is for opcode {other:#04x}"))),
    }
}

/// The reply inside of what the extension unit gave: the echo and the data, without the padding.
///
/// # Errors
/// [`ErrorKind::Protocol`] when `frame` has not [`UNIT_BYTES`] bytes, or says that it holds more than fits.
pub fn unit_reply(frame: &[u8]) -> Result<&[u8]> {
    let length = u32_at(frame, UNIT_LENGTH_AT).filter(|_| frame.len() == UNIT_BYTES).ok_or_else(|| {
        protocol_error(format!("the hardware monitor gave {} bytes instead of {UNIT_BYTES}", frame.len()))
    })?;
    let end = ECHO.saturating_add(length as usize);
    frame.get(..end).filter(|_| end <= UNIT_LENGTH_AT).ok_or_else(|| {
        protocol_error(format!(
            "the hardware monitor reports {length} bytes of data; at most {} fit",
            UNIT_LENGTH_AT - ECHO
        ))
    })
}

/// A request as a camera receives it: what the emulator answers to. Nothing here can be sent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Received<'a> {
    /// The opcode, known or not.
    pub opcode: u32,
    /// The four parameters.
    pub params: [u32; 4],
    /// The data behind them.
    pub data: &'a [u8],
}

impl<'a> Received<'a> {
    /// Reads a request; what follows its stated length (the padding of the extension unit) is ignored.
    ///
    /// # Errors
    /// [`ErrorKind::Protocol`] when the header is short, the magic number is another, or the length does not fit.
    pub fn parse(bytes: &'a [u8]) -> Result<Self> {
        let header = (|| {
            let params = [u32_at(bytes, 8)?, u32_at(bytes, 12)?, u32_at(bytes, 16)?, u32_at(bytes, 20)?];
            Some((u16_at(bytes, 0)?, u16_at(bytes, 2)?, u32_at(bytes, 4)?, params))
        })();
        let Some((length, magic, opcode, params)) = header else {
            return Err(protocol_error(format!(
                "a request of {} bytes; its header alone has 24",
                bytes.len()
            )));
        };
        if magic != MAGIC {
            return Err(protocol_error(format!("a request with the magic number {magic:#06x}, not 0xcdab")));
        }
        let data = bytes.get(HEADER..usize::from(length) + ECHO).filter(|d| d.len() <= MAX_DATA);
        let data =
            data.ok_or_else(|| protocol_error(format!("a request whose length field says {length}")))?;
        Ok(Self { opcode, params, data })
    }
}

/// Builds the reply to `opcode` with `data`, as the vendor's bulk endpoint sends it.
pub fn build_reply(opcode: u32, data: &[u8]) -> Vec<u8> {
    [&opcode.to_le_bytes(), data].concat()
}

/// Builds a reply that refuses with `code`.
pub fn build_refusal(code: Code) -> Vec<u8> {
    code.0.to_le_bytes().to_vec()
}

/// Pads a reply of [`build_reply`] or [`build_refusal`] as the extension unit gives it.
///
/// # Errors
/// [`ErrorKind::BadInput`] when `reply` has no echo or its data does not fit.
pub fn build_unit_frame(reply: &[u8]) -> Result<[u8; UNIT_BYTES]> {
    if !(ECHO..=UNIT_LENGTH_AT).contains(&reply.len()) {
        let text = format!("a reply of {} bytes; it has 4 to {UNIT_LENGTH_AT}", reply.len());
        return Err(Error::new(ErrorKind::BadInput, text));
    }
    let mut frame = [0; UNIT_BYTES];
    depthrig_driver::bytes::put(&mut frame, 0, reply);
    depthrig_driver::bytes::put(&mut frame, UNIT_LENGTH_AT, &((reply.len() - ECHO) as u32).to_le_bytes());
    Ok(frame)
}

#[cfg(test)]
mod tests;
