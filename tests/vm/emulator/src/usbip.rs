//! The messages of USB/IP between the kernel's virtual host controller and a device, without I/O.
//!
//! Every message is a header of 48 bytes, big endian, and the data of a transfer behind it. Layout: the kernel's
//! document `Documentation/usb/usbip_protocol.rst`, facts only.

/// The length of a header.
pub const HEADER: usize = 48;
/// `-EPIPE`: the endpoint answered STALL.
pub const STALL: i32 = -32;
/// `-ECONNRESET`: the transfer was taken back before it ended.
pub const UNLINKED: i32 = -104;

/// A message from the kernel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command {
    /// A transfer to be done. For an OUT transfer its `length` bytes follow.
    Submit(Submit),
    /// A transfer is taken back.
    Unlink {
        /// The number of this message.
        seq: u32,
        /// The number of the transfer that is taken back.
        victim: u32,
    },
}

/// A transfer ("USB request block").
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Submit {
    /// Its number, which the answer carries.
    pub seq: u32,
    /// The number of the endpoint, without its direction.
    pub endpoint: u8,
    /// From the device to the host.
    pub input: bool,
    /// How many bytes at most.
    pub length: usize,
    /// The setup packet, on endpoint 0.
    pub setup: [u8; 8],
}

fn word(bytes: &[u8; HEADER], at: usize) -> u32 {
    u32::from_be_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

/// Parses a message from the kernel; `None` when it is invalid.
pub fn parse(bytes: &[u8; HEADER]) -> Option<Command> {
    match word(bytes, 0) {
        1 => Some(Command::Submit(Submit {
            seq: word(bytes, 4),
            endpoint: (word(bytes, 16) & 15) as u8,
            input: word(bytes, 12) == 1,
            length: word(bytes, 24) as usize,
            setup: [bytes[40], bytes[41], bytes[42], bytes[43], bytes[44], bytes[45], bytes[46], bytes[47]],
        })),
        2 => Some(Command::Unlink { seq: word(bytes, 4), victim: word(bytes, 20) }),
        _ => None,
    }
}

fn put(bytes: &mut [u8; HEADER], at: usize, value: u32) {
    bytes[at..at + 4].copy_from_slice(&value.to_be_bytes());
}

/// The end of a transfer of which `actual` bytes were done; for an IN transfer they follow.
pub fn submit_done(seq: u32, status: i32, actual: usize) -> [u8; HEADER] {
    let mut bytes = [0; HEADER];
    put(&mut bytes, 0, 3);
    put(&mut bytes, 4, seq);
    put(&mut bytes, 20, status as u32);
    put(&mut bytes, 24, actual as u32);
    bytes
}

/// The answer to [`Command::Unlink`]: [`UNLINKED`], or 0 when the transfer had ended before.
pub fn unlink_done(seq: u32, status: i32) -> [u8; HEADER] {
    let mut bytes = [0; HEADER];
    put(&mut bytes, 0, 4);
    put(&mut bytes, 4, seq);
    put(&mut bytes, 20, status as u32);
    bytes
}

/// [`Command::Submit`] as the kernel writes it: for tests that play the host.
pub fn submit(device: u32, transfer: &Submit) -> [u8; HEADER] {
    let mut bytes = [0; HEADER];
    put(&mut bytes, 0, 1);
    put(&mut bytes, 4, transfer.seq);
    put(&mut bytes, 8, device);
    put(&mut bytes, 12, transfer.input.into());
    put(&mut bytes, 16, transfer.endpoint.into());
    put(&mut bytes, 24, transfer.length as u32);
    bytes[40..48].copy_from_slice(&transfer.setup);
    bytes
}

/// [`Command::Unlink`] as the kernel writes it: for tests that play the host.
pub fn unlink(device: u32, seq: u32, victim: u32) -> [u8; HEADER] {
    let mut bytes = [0; HEADER];
    put(&mut bytes, 0, 2);
    put(&mut bytes, 4, seq);
    put(&mut bytes, 8, device);
    put(&mut bytes, 20, victim);
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_transfer_reads_back_as_it_was_written() {
        let transfer =
            Submit { seq: 7, endpoint: 2, input: true, length: 32_768, setup: [1, 2, 3, 4, 5, 6, 7, 8] };
        assert_eq!(parse(&submit(0x1_0001, &transfer)), Some(Command::Submit(transfer)));
        assert_eq!(parse(&unlink(1, 9, 7)), Some(Command::Unlink { seq: 9, victim: 7 }));
        assert_eq!(parse(&[0; HEADER]), None);
    }

    /// The bytes of an answer, as the protocol's document has them.
    #[test]
    fn an_answer_has_its_fields_where_the_kernel_looks() {
        let bytes = submit_done(0x0102_0304, STALL, 0x10);
        assert_eq!(bytes[..8], [0, 0, 0, 3, 1, 2, 3, 4]);
        assert_eq!(bytes[20..28], [0xFF, 0xFF, 0xFF, 0xE0, 0, 0, 0, 0x10]);
        assert_eq!(unlink_done(5, UNLINKED)[20..24], [0xFF, 0xFF, 0xFF, 0x98]);
    }
}
