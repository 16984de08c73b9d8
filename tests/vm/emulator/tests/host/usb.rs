//! A host that speaks USB/IP: enough of it to ask a device things and to take its frames.

use depthrig_emulator::usbip::{HEADER, Submit, submit, unlink};
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::os::unix::net::UnixStream;

/// How a transfer ended, and its bytes.
type Ended = (i32, Vec<u8>);

pub struct Host {
    line: UnixStream,
    seq: u32,
    ended: BTreeMap<u32, Ended>,
    /// Transfers to the device, whose end has no bytes behind it.
    out: Vec<u32>,
}

impl Host {
    /// A host, and the device's end of its line.
    pub fn new() -> (Self, UnixStream) {
        let (line, device) = UnixStream::pair().unwrap();
        line.set_read_timeout(Some(std::time::Duration::from_secs(20))).unwrap();
        (Self { line, seq: 0, ended: BTreeMap::new(), out: Vec::new() }, device)
    }

    pub fn submit(&mut self, endpoint: u8, input: bool, length: usize, setup: [u8; 8], data: &[u8]) -> u32 {
        self.seq += 1;
        let transfer = Submit { seq: self.seq, endpoint, input, length, setup };
        self.line.write_all(&submit(1, &transfer)).unwrap();
        self.line.write_all(data).unwrap();
        if !input {
            self.out.push(self.seq);
        }
        self.seq
    }

    /// Reads the next message. Returns whether it was the end of a transfer or the status of an unlink.
    fn read(&mut self) -> (u32, u32, i32) {
        let mut head = [0; HEADER];
        self.line.read_exact(&mut head).unwrap();
        let word = |at: usize| u32::from_be_bytes(head[at..at + 4].try_into().unwrap());
        let kind = word(0);
        let seq = word(4);
        let status = word(20) as i32;
        if kind == 3 {
            let mut data = vec![0; if self.out.contains(&seq) { 0 } else { word(24) as usize }];
            self.line.read_exact(&mut data).unwrap();
            assert!(self.ended.insert(seq, (status, data)).is_none(), "transfer {seq} ended twice");
        }
        (kind, seq, status)
    }

    pub fn wait(&mut self, seq: u32) -> Ended {
        while !self.ended.contains_key(&seq) {
            self.read();
        }
        self.ended.remove(&seq).unwrap()
    }

    /// Whether a transfer has ended, as far as is known.
    pub fn has_ended(&mut self, seq: u32) -> bool {
        // A round trip: what was sent before its answer has been read then.
        self.control_in([0x80, 0, 0, 0, 0, 0, 2, 0]).unwrap();
        self.ended.contains_key(&seq)
    }

    pub fn unlink(&mut self, victim: u32) -> i32 {
        self.seq += 1;
        self.line.write_all(&unlink(1, self.seq, victim)).unwrap();
        loop {
            let (kind, seq, status) = self.read();
            if kind == 4 && seq == self.seq {
                return status;
            }
        }
    }

    /// `None` is STALL.
    pub fn control_in(&mut self, setup: [u8; 8]) -> Option<Vec<u8>> {
        let length = usize::from(u16::from_le_bytes([setup[6], setup[7]]));
        let seq = self.submit(0, true, length, setup, &[]);
        let (status, data) = self.wait(seq);
        (status == 0).then_some(data)
    }

    pub fn control_out(&mut self, setup: [u8; 8], data: &[u8]) -> Option<()> {
        let seq = self.submit(0, false, data.len(), setup, data);
        (self.wait(seq).0 == 0).then_some(())
    }

    pub fn bulk_out(&mut self, endpoint: u8, data: &[u8]) {
        let seq = self.submit(endpoint, false, data.len(), [0; 8], data);
        assert_eq!(self.wait(seq).0, 0);
    }

    pub fn bulk_in(&mut self, endpoint: u8, length: usize) -> (u32, Vec<u8>) {
        let seq = self.submit(endpoint, true, length, [0; 8], &[]);
        let (status, data) = self.wait(seq);
        assert_eq!(status, 0);
        (seq, data)
    }

    /// The hardware monitor through the extension unit.
    pub fn monitor(&mut self, request: &[u8]) -> Option<Vec<u8>> {
        let mut block = request.to_vec();
        block.resize(1024, 0);
        self.control_out([0x21, 1, 0, 1, 0, 3, 0, 4], &block)?;
        let reply = self.control_in([0xA1, 0x81, 0, 1, 0, 3, 0, 4])?;
        let length = u32::from_le_bytes(reply[1020..].try_into().unwrap()) as usize;
        Some(reply[..4 + length].to_vec())
    }

    /// Probe and commit.
    pub fn commit(&mut self, interface: u8, format: u8, frame: u8, interval: u32) {
        let mut block = vec![0; 48];
        block[0] = 1;
        block[2] = format;
        block[3] = frame;
        block[4..8].copy_from_slice(&interval.to_le_bytes());
        self.control_out([0x21, 1, 0, 1, interface, 0, 48, 0], &block).unwrap();
        let agreed = self.control_in([0xA1, 0x81, 0, 1, interface, 0, 48, 0]).unwrap();
        assert_eq!(agreed[2..8], block[2..8], "the mode that was proposed");
        self.control_out([0x21, 1, 0, 2, interface, 0, 48, 0], &agreed).unwrap();
    }

    /// One frame: the header of its payload, and its bytes. Takes it in transfers of 64 KiB.
    pub fn frame(&mut self, endpoint: u8) -> (Vec<u8>, Vec<u8>) {
        const CHUNK: usize = 64 << 10;
        let mut all = Vec::new();
        loop {
            let (_, part) = self.bulk_in(endpoint, CHUNK);
            let short = part.len() < CHUNK;
            all.extend(part);
            if short {
                break;
            }
        }
        let body = all.split_off(usize::from(all[0]));
        (all, body)
    }
}
