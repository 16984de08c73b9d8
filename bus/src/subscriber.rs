//! Subscribing: read frames where the driver wrote them.

use crate::channel::{Received, Receiver};
use crate::{Error, ErrorKind, FrameHeader, HostTime, MotionSample, PixelFormat, Result};
use core::time::Duration;

/// How often a blocked reader checks for a publisher.
const LIVENESS_INTERVAL: Duration = Duration::from_millis(500);

/// The reading end of a stream's channel.
///
/// Up to four unread frames wait for it; older ones are replaced by newer ones and show in
/// [`Self::missed`]. Up to sixteen frames may be held at once.
#[derive(Debug)]
pub struct Subscriber {
    receiver: Receiver<FrameHeader>,
    last_sequence: u64,
    missed: u64,
}

impl Subscriber {
    pub(crate) const fn new(receiver: Receiver<FrameHeader>) -> Self {
        Self { receiver, last_sequence: 0, missed: 0 }
    }

    /// The oldest unread frame, if there is one.
    ///
    /// # Errors
    /// [`ErrorKind::LimitReached`] when sixteen frames are held already (release one and go on),
    /// [`ErrorKind::VersionMismatch`] when the frame's header is of another version.
    pub fn try_next(&mut self) -> Result<Option<Frame>> {
        let Some(sample) = self.receiver.try_receive()? else { return Ok(None) };
        let header = sample.user_header();
        if !header.is_valid() {
            return Err(Error::new(
                ErrorKind::VersionMismatch,
                format!(
                    "{}: a frame has header version {}, this program reads version {}; run daemon and subscriber \
                     with the same version of depthrig",
                    self.receiver.what(),
                    header.version,
                    crate::HEADER_VERSION
                ),
            ));
        }
        let sequence = header.sequence;
        // The first frame sets the reference; a smaller number means that the publisher was restarted.
        if self.last_sequence > 0 && sequence > self.last_sequence {
            self.missed += sequence - self.last_sequence - 1;
        }
        self.last_sequence = sequence;
        Ok(Some(Frame { sample }))
    }

    /// The oldest unread frame, waiting up to `timeout` for one; `None` when none came.
    ///
    /// # Errors
    /// As [`Self::try_next`].
    pub fn next_timeout(&mut self, timeout: Duration) -> Result<Option<Frame>> {
        let deadline = HostTime::now().plus(timeout);
        loop {
            if let Some(frame) = self.try_next()? {
                return Ok(Some(frame));
            }
            let left = deadline.from_now();
            if left.is_zero() {
                return Ok(None);
            }
            self.receiver.wait(left)?;
        }
    }

    /// The oldest unread frame, waiting as long as the stream has a publisher.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] when its publisher has gone, else as [`Self::try_next`].
    #[allow(clippy::should_implement_trait)] // an iterator could not say why it ended
    pub fn next(&mut self) -> Result<Frame> {
        loop {
            if let Some(frame) = self.next_timeout(LIVENESS_INTERVAL)? {
                return Ok(frame);
            }
            if !self.is_live() {
                let what = self.receiver.what();
                return Err(Error::new(ErrorKind::NotFound, format!("{what}: nobody publishes it any more")));
            }
        }
    }

    /// The newest frame, skipping older unread ones (they count as neither missed nor read); `None` when
    /// nothing came since the last call.
    ///
    /// # Errors
    /// As [`Self::try_next`].
    pub fn latest(&mut self) -> Result<Option<Frame>> {
        let mut newest = None;
        while let Some(frame) = self.try_next()? {
            newest = Some(frame);
        }
        Ok(newest)
    }

    /// Frames that were published but replaced before this subscriber read them.
    pub const fn missed(&self) -> u64 {
        self.missed
    }

    /// Whether the stream has a publisher now. A killed publisher counts until a process cleans up after it
    /// ([`crate::Bus::clean_dead`]).
    pub fn is_live(&self) -> bool {
        self.receiver.has_publisher()
    }
}

/// A frame in shared memory. It keeps its slot until it is dropped.
#[derive(Debug)]
pub struct Frame {
    sample: Received<FrameHeader>,
}

impl Frame {
    /// The frame's header.
    pub fn header(&self) -> &FrameHeader {
        self.sample.user_header()
    }

    /// Its pixels, where the driver wrote them. They begin at a multiple of [`crate::PIXEL_ALIGN`].
    pub fn pixels(&self) -> &[u8] {
        self.sample.payload()
    }

    /// The samples of an IMU frame; none of any other frame.
    pub fn motion(&self) -> impl ExactSizeIterator<Item = MotionSample> + '_ {
        let is_imu = self.header().pixel_format() == Some(PixelFormat::Motion);
        MotionSample::all_in(if is_imu { self.pixels() } else { &[] })
    }
}
