//! Requests and replies of the hardware monitor, as the camera sees them (librealsense `src/hw-monitor.h`, Apache-2.0).

/// "Wrong command".
pub(crate) const WRONG_COMMAND: i32 = -1;
/// "Wrong parameter".
pub(crate) const WRONG_PARAMETER: i32 = -6;
/// "Hardware not ready".
pub(crate) const NOT_READY: i32 = -7;
/// "No data to return".
pub(crate) const NO_DATA: i32 = -21;
/// "Table is empty".
pub(crate) const EMPTY_TABLE: i32 = -25;
/// "Not supported".
pub(crate) const UNSUPPORTED: i32 = -58;
/// The length of the control that carries them.
const CONTROL: usize = 1024;
/// No reply has more data.
const DATA: usize = 1000;

/// A request of the host.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Request<'a> {
    pub opcode: u32,
    pub params: [u32; 4],
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
        Ok(data) => [&opcode.to_le_bytes()[..], data.get(..DATA).unwrap_or(&data)].concat(),
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_is_read_from_its_bytes() {
        let mut bytes = vec![0x18, 0, 0xAB, 0xCD, 0x2B, 0, 0, 0, 9, 0, 0, 0];
        bytes.resize(24, 0);
        bytes.extend([1, 2, 3, 4]);
        let request = Request::parse(&bytes).unwrap();
        assert_eq!((request.opcode, request.params, request.data), (0x2B, [9, 0, 0, 0], &[1, 2, 3, 4][..]));
        bytes[2] = 0;
        assert!(Request::parse(&bytes).is_none());
        assert!(Request::parse(&[0x18, 0, 0xAB, 0xCD]).is_none());
    }

    #[test]
    fn the_extension_unit_has_the_length_at_its_end() {
        let bytes = control(&reply(0x10, Ok(vec![7; 256])));
        assert_eq!(
            (bytes.len(), &bytes[..5], &bytes[1020..]),
            (1024, &[0x10, 0, 0, 0, 7][..], &[0, 1, 0, 0][..])
        );
        assert_eq!(reply(0x10, Err(-7)), [0xF9, 0xFF, 0xFF, 0xFF]);
    }
}
