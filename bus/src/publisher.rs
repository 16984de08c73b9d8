//! Publishing: write a frame once, into the slot that subscribers will read.

use crate::channel::{self, Loan, Sender};
use crate::{FrameHeader, HostTime, Result};

/// The writing end of a stream's channel.
///
/// It never blocks on a subscriber: a slow one loses its oldest unread frames, one that holds frames keeps
/// their slots and no others, a dead one is cleaned up by [`crate::Bus::clean_dead`].
#[derive(Debug)]
pub struct Publisher {
    sender: Sender<FrameHeader>,
}

impl Publisher {
    pub(crate) const fn new(sender: Sender<FrameHeader>) -> Self {
        Self { sender }
    }

    /// Slots of shared memory that the channel has; fewer than were asked for when memory was short.
    pub const fn slots(&self) -> usize {
        self.sender.slots()
    }

    /// A free slot for a frame of `len` bytes with arbitrary contents, and a default header.
    ///
    /// # Errors
    /// [`crate::ErrorKind::NoSpace`] when subscribers hold every slot: drop the frame and count it.
    /// [`crate::ErrorKind::LimitReached`] when `len` is larger than the channel's frames, or one more than
    /// [`crate::MAX_LENT`] frames are on loan already.
    pub fn loan(&self, len: usize) -> Result<FrameMut> {
        let mut loan = self.sender.loan(len)?;
        *loan.user_header_mut() = FrameHeader { payload_len: len as u32, ..FrameHeader::default() };
        Ok(FrameMut { loan })
    }

    /// Delivers the last frame to late joiners. Sending does it as well, so only a pausing publisher needs it.
    pub fn welcome(&self) {
        self.sender.welcome();
    }

    /// Subscribers of the stream, those included that have read nothing yet. One that was killed counts until its remains are removed.
    pub fn subscribers(&self) -> usize {
        self.sender.subscribers()
    }

    /// Publishes `frame`, stamping its publish time; returns how many subscribers it went to.
    ///
    /// # Errors
    /// [`crate::ErrorKind::Other`] when iceoryx2 cannot deliver it.
    pub fn send(&self, mut frame: FrameMut) -> Result<usize> {
        frame.header_mut().publish_time_ns = HostTime::now().ns();
        self.sender.send(frame.loan)
    }

    /// Publishes `frame` with the publish time that its header has: a replay keeps the recorded times.
    ///
    /// # Errors
    /// As [`Self::send`].
    pub fn send_unstamped(&self, frame: FrameMut) -> Result<usize> {
        self.sender.send(frame.loan)
    }
}

/// A slot on loan: the frame being written. Dropping it gives the slot back unpublished.
pub struct FrameMut {
    loan: Loan<FrameHeader>,
}

impl FrameMut {
    /// The header, for reading.
    pub fn header(&self) -> &FrameHeader {
        self.loan.user_header()
    }

    /// The header, for writing.
    pub fn header_mut(&mut self) -> &mut FrameHeader {
        self.loan.user_header_mut()
    }

    /// The pixels, for writing. They begin at a multiple of [`crate::PIXEL_ALIGN`].
    pub fn pixels_mut(&mut self) -> &mut [u8] {
        channel::bytes_mut(&mut self.loan)
    }
}

impl core::fmt::Debug for FrameMut {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_tuple("FrameMut").field(self.header()).finish()
    }
}
