//! Puts frames together from the payloads that arrive in bulk transfers (UVC 1.5 class specification, 2.4.3.2).
//!
//! A D400 sends one payload per frame and so one transfer: such a frame is handed on from the transfer's own memory.
//! Other devices split a frame over payloads, and a payload may span transfers; those frames are copied together.

use depthrig_usb::uvc::payload::{Flags, PayloadHeader};

/// A frame, whole or not.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Assembled<'a> {
    /// Its bytes as far as they came. Of a frame that is too long, one byte more than a frame has.
    pub bytes: &'a [u8],
    /// The header of its first payload; `None` when it had none.
    pub header: Option<&'a [u8]>,
    /// The device flagged it, or the bytes do not form a frame.
    pub damaged: bool,
    /// Counts the frames of the device, as far as their identifier bit shows.
    pub sequence: u64,
}

/// Layout of a stream's payloads.
#[derive(Debug, Clone, Copy)]
pub(super) struct Layout {
    /// The most bytes of a frame.
    pub frame_bytes: usize,
    /// Whether every frame has exactly that many.
    pub fixed: bool,
    /// The most bytes of a payload, header included.
    pub payload_bytes: usize,
}

/// The frames of one stream.
pub(super) struct Assembler {
    layout: Layout,
    /// A frame of which more is to come.
    open: Option<Open>,
    /// Bytes of a payload that went on past the end of a transfer, and whether they are to be kept.
    payload: Option<(usize, bool)>,
    frame: Vec<u8>,
    header: Vec<u8>,
    last_id: Option<bool>,
    /// The identifier was seen to change: not all devices have one.
    alternates: bool,
    /// Number of the next frame.
    next: u64,
    /// Bytes copied to put frames together.
    copied: u64,
}

#[derive(Debug, Clone, Copy)]
struct Open {
    id: bool,
    damaged: bool,
    ends_with_payload: bool,
    sequence: u64,
}

impl Assembler {
    pub(super) fn new(layout: Layout) -> Self {
        Self {
            layout,
            open: None,
            payload: None,
            frame: Vec::new(),
            header: Vec::new(),
            last_id: None,
            alternates: false,
            next: 0,
            copied: 0,
        }
    }

    /// Bytes copied so far to put frames together; 0 for a device that sends each in one payload.
    pub(super) const fn copied(&self) -> u64 {
        self.copied
    }

    /// Takes the bytes of one transfer. `short` says that the transfer had room for more: the device ended its payload.
    pub(super) fn take(&mut self, transfer: &[u8], short: bool, each: &mut dyn FnMut(&Assembled<'_>)) {
        let (before, keep) = self.payload.take().unwrap_or((0, true));
        let so_far = before + transfer.len();
        let ends = short || so_far >= self.layout.payload_bytes;
        if before > 0 {
            if keep {
                self.append(transfer);
            }
            self.settle(ends, so_far, keep, each);
            return;
        }
        if transfer.is_empty() {
            return; // a payload of nothing: some devices end a frame's last full packet with it
        }
        let Ok(header) = PayloadHeader::parse(transfer) else {
            self.broken(each);
            self.settle(ends, so_far, false, each);
            return;
        };
        let data = transfer.get(header.bytes.len()..).unwrap_or_default();
        let id = header.flags.frame_id();
        if self.open.is_some_and(|open| open.id != id) {
            self.finish(each);
        }
        let last = header.flags.has(Flags::END_OF_FRAME);
        let damaged = header.flags.has(Flags::ERROR);
        if self.open.is_none() {
            if data.is_empty() && self.last_id == Some(id) && !damaged {
                self.settle(ends, so_far, true, each);
                return; // the end of a frame that was handed on when its last byte had come
            }
            let sequence = self.number(id);
            if ends && (last || (self.layout.fixed && data.len() >= self.layout.frame_bytes)) {
                let bytes = data.get(..=self.layout.frame_bytes).unwrap_or(data);
                each(&Assembled { bytes, header: Some(header.bytes), damaged, sequence });
                return;
            }
            self.frame.clear();
            self.header.clear();
            self.header.extend_from_slice(header.bytes);
            self.open = Some(Open { id, damaged, ends_with_payload: last, sequence });
        } else if let Some(open) = &mut self.open {
            open.damaged |= damaged;
            open.ends_with_payload = last;
        }
        self.append(data);
        self.settle(ends, so_far, true, each);
    }

    /// A transfer that failed: a frame, or a part of one, is lost.
    pub(super) fn broken(&mut self, each: &mut dyn FnMut(&Assembled<'_>)) {
        if let Some(open) = &mut self.open {
            open.damaged = true;
            self.finish(each);
        } else {
            // Its identifier was not seen; it is taken for the next one.
            let sequence = self.number(self.last_id.is_none_or(|id| !id));
            each(&Assembled { bytes: &[], header: None, damaged: true, sequence });
        }
    }

    /// The stream was stopped and started again: what was under way is lost, and the identifier starts anew.
    pub(super) fn restart(&mut self, each: &mut dyn FnMut(&Assembled<'_>)) {
        if let Some(open) = &mut self.open {
            open.damaged = true;
            self.finish(each);
        }
        self.payload = None;
        self.last_id = None;
    }

    /// The number of a frame that begins with this identifier. The same identifier twice means that an odd number of
    /// frames between went missing; one is the best guess.
    fn number(&mut self, id: bool) -> u64 {
        self.alternates |= self.last_id.is_some_and(|last| last != id);
        if self.last_id == Some(id) && self.alternates {
            self.next += 1;
        }
        self.last_id = Some(id);
        self.next += 1;
        self.next - 1
    }

    fn append(&mut self, data: &[u8]) {
        if self.open.is_none() {
            return;
        }
        let room = (self.layout.frame_bytes + 1).saturating_sub(self.frame.len());
        let data = data.get(..room).unwrap_or(data);
        self.frame.extend_from_slice(data);
        self.copied += data.len() as u64;
    }

    /// After the bytes of a transfer: the payload goes on, or it ends, and perhaps the frame with it.
    fn settle(&mut self, ends: bool, so_far: usize, keep: bool, each: &mut dyn FnMut(&Assembled<'_>)) {
        if !ends {
            self.payload = Some((so_far, keep));
            return;
        }
        let full = self.layout.fixed && self.frame.len() >= self.layout.frame_bytes;
        if self.open.is_some_and(|open| open.ends_with_payload || full) {
            self.finish(each);
        }
    }

    fn finish(&mut self, each: &mut dyn FnMut(&Assembled<'_>)) {
        let Some(open) = self.open.take() else { return };
        let bytes = self.frame.as_slice();
        let header = Some(self.header.as_slice());
        each(&Assembled { bytes, header, damaged: open.damaged, sequence: open.sequence });
    }
}

#[cfg(test)]
mod tests;
