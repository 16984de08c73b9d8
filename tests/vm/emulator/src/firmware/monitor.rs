//! Requests and replies of the hardware monitor, as the camera sees them (librealsense `src/hw-monitor.h`, Apache-2.0).

/// "Wrong command".
pub(crate) const WRONG_COMMAND: i32 = -1;
/// "Wrong parameter".
pub(crate) const WRONG_PARAMETER: i32 = -6;
/// "No data to return".
#[allow(dead_code)]
pub(crate) const NO_DATA: i32 = -21;
/// The length of the control that carries them.
pub(crate) const CONTROL: usize = 1024;

/// A request of the host.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Request<'a> {
    pub opcode: u32,
    pub params: [u32; 4],
    #[allow(dead_code)]
    pub data: &'a [u8],
}

impl<'a> Request<'a> {
    /// Reads it: u16 length of what follows the first 4 bytes, u16 0xCDAB, opcode, four parameters, data.
    pub fn parse(bytes: &'a [u8]) -> Option<Self> {
        let word = |at: usize| Some(u32::from_le_bytes(*bytes.get(at..)?.first_chunk()?));
        let head = word(0)?;
        if head >> 16 != 0xCDAB {
            return None;
        }
        let end = (head & 0xFFFF) as usize + 4;
        let data = bytes.get(24..end)?;
        Some(Self { opcode: word(4)?, params: [word(8)?, word(12)?, word(16)?, word(20)?], data })
    }
}

/// The reply to an opcode: its echo and the data, or an error code.
pub(crate) fn reply(opcode: u32, answer: Result<Vec<u8>, i32>) -> Vec<u8> {
    match answer {
        Ok(data) => [&opcode.to_le_bytes()[..], &data].concat(),
        Err(code) => error(code),
    }
}

/// A reply that is an error code alone.
pub(crate) fn error(code: i32) -> Vec<u8> {
    code.to_le_bytes().to_vec()
}

/// A reply as the extension unit hands it out: 1024 bytes, with the length of the data at 1020.
pub(crate) fn control(reply: &[u8]) -> Vec<u8> {
    let mut bytes = reply.to_vec();
    bytes.resize(CONTROL, 0);
    let length = reply.len().saturating_sub(4) as u32;
    bytes[CONTROL - 4..].copy_from_slice(&length.to_le_bytes());
    bytes
}
