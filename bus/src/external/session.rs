//! The process's side: frames of one session.

use super::camera::no_such_mode;
use super::{ExternalCamera, ExternalFrame, ExternalReason, ExternalState, FRAME_SLOTS, Mode};
use crate::channel::{self, Loan, Outlet};
use crate::{Error, ErrorKind, HostTime, Result};
use core::time::Duration;
use std::sync::PoisonError;

/// From when the daemon wanted frames until it wants none: see [`ExternalCamera::next_session`].
#[derive(Debug)]
pub struct Session<'a> {
    camera: &'a mut ExternalCamera,
    number: u64,
    modes: Vec<usize>,
    ports: Vec<Port>,
    running: bool,
    refused: bool,
}

/// One stream's channel to the daemon.
#[derive(Debug)]
struct Port {
    mode: usize,
    out: Outlet<ExternalFrame>,
    sequence: u64,
}

impl ExternalCamera {
    /// Waits until the daemon wants frames; `None` when it wanted none within `timeout`.
    ///
    /// # Errors
    /// [`ErrorKind::Refused`] with the daemon's reason when it cannot use the offer; it stays refused. Else as
    /// [`Bus::publisher`].
    pub fn next_session(&mut self, timeout: Duration) -> Result<Option<Session<'_>>> {
        let deadline = HostTime::now().plus(timeout);
        let mut wanted = self.shared.wanted();
        let (number, modes) = loop {
            if let (0, Some(why)) = (wanted.session, &wanted.refusal) {
                let why = format!("the daemon refuses camera \"{}\": {why}", self.place.camera);
                return Err(Error::new(ErrorKind::Refused, why));
            }
            if wanted.session > self.taken && !wanted.modes.is_empty() {
                break (wanted.session, wanted.modes.clone());
            }
            let left = deadline.from_now();
            if left.is_zero() {
                return Ok(None);
            }
            let waited = self.shared.changed.wait_timeout(wanted, left);
            wanted = waited.unwrap_or_else(PoisonError::into_inner).0;
        };
        drop(wanted);
        self.taken = number;
        self.shared.stand(number, ExternalState::Starting, ExternalReason::None, "")?;
        Session::new(self, number, modes).map(Some)
    }
}

impl<'a> Session<'a> {
    pub(super) fn new(camera: &'a mut ExternalCamera, number: u64, modes: Vec<usize>) -> Result<Self> {
        let mut session =
            Self { camera, number, modes: modes.clone(), ports: Vec::new(), running: false, refused: false };
        for mode in modes {
            let camera = &session.camera;
            let Some(wish) = camera.shared.modes.get(mode) else { continue };
            let channel = camera.place.frames(&wish.stream);
            let out = channel.outlet(camera.bus.node(), wish.frame_bytes(), FRAME_SLOTS)?;
            session.ports.push(Port { mode, out, sequence: 0 });
        }
        Ok(session)
    }

    /// Its number.
    pub const fn number(&self) -> u64 {
        self.number
    }

    /// The modes that are to run, by their index in the offer, and what they are.
    pub fn modes(&self) -> impl Iterator<Item = (usize, &Mode)> {
        self.modes.iter().filter_map(|i| Some((*i, self.camera.shared.modes.get(*i)?)))
    }

    /// Reports that the device streams. Sending a frame implies it.
    pub fn started(&mut self) {
        if !self.running && !self.refused {
            self.running = true;
            self.stand(ExternalState::Running, ExternalReason::None, "");
        }
    }

    /// Reports that the device cannot stream, and why; `why` is shown to the user unchanged.
    pub fn refuse(mut self, reason: ExternalReason, why: &str) {
        self.refused = true;
        self.stand(ExternalState::Refused, reason, why);
    }

    /// Reports that there are no more frames, such as at the end of a file, and waits up to `timeout` until the daemon
    /// confirms that it has taken those that were sent; returns whether it did. `why` is shown to the user.
    pub fn finish(mut self, why: &str, timeout: Duration) -> bool {
        self.refused = true;
        self.stand(ExternalState::Refused, ExternalReason::Finished, why);
        // The channels stay until then, for a daemon that has not read them yet.
        self.camera.shared.wait_for_stop(self.number, timeout)
    }

    /// Whether the daemon still wants frames.
    pub fn is_wanted(&self) -> bool {
        !self.refused && self.camera.shared.wants(self.number)
    }

    /// Why the daemon refused the frames of this session, if it did.
    pub fn refusal(&self) -> Option<String> {
        self.camera.shared.refusal(self.number)
    }

    /// Memory in which to write a frame of `len` bytes of `mode`, which counts as captured from now on. `None` when
    /// none is free, because the daemon is behind; the frame is lost then, and counted by the daemon.
    ///
    /// # Errors
    /// [`ErrorKind::Other`] when the session does not run `mode`, [`ErrorKind::LimitReached`] when `len` is more than
    /// a frame of the mode has, or four frames are being written.
    pub fn frame(&mut self, mode: usize, len: usize) -> Result<Option<FrameSlot>> {
        let Some(wish) = self.camera.shared.modes.get(mode) else { return Err(no_such_mode(mode)) };
        let Some(port) = self.ports.iter_mut().find(|p| p.mode == mode) else {
            return Err(no_such_mode(mode));
        };
        let mut loan = match port.out.loan(len) {
            Ok(loan) => loan,
            Err(e) if e.kind() == ErrorKind::NoSpace => {
                port.sequence += 1;
                return Ok(None);
            }
            Err(e) => return Err(e),
        };
        port.sequence += 1;
        *loan.user_header_mut() = ExternalFrame {
            instance: self.camera.shared.instance,
            session: self.number,
            sequence: port.sequence,
            device_sequence: port.sequence,
            format: wish.format as u32,
            width: wish.width,
            height: wish.height,
            payload_len: len as u32,
            ..ExternalFrame::default()
        };
        Ok(Some(FrameSlot { loan, mode }))
    }

    /// Sends a frame whose every byte was written.
    ///
    /// # Errors
    /// [`ErrorKind::Other`] when iceoryx2 cannot deliver it.
    pub fn send(&mut self, slot: FrameSlot) -> Result<()> {
        self.started();
        let port = self.ports.iter().find(|p| p.mode == slot.mode).ok_or_else(|| no_such_mode(slot.mode))?;
        port.out.send(slot.loan)?;
        channel::ring(&self.camera.shared.bell, port.out.what());
        Ok(())
    }

    /// Sends a copy of `pixels`. Of `facts` the device's own numbers are taken (counter, time, arrival, exposure, gain,
    /// temperature, flags). Returns whether it was sent; see [`Self::frame`].
    ///
    /// # Errors
    /// As [`Self::frame`] and [`Self::send`].
    pub fn send_copy(&mut self, mode: usize, facts: &ExternalFrame, pixels: &[u8]) -> Result<bool> {
        let Some(mut slot) = self.frame(mode, pixels.len())? else { return Ok(false) };
        slot.set_facts(facts);
        slot.pixels_mut().copy_from_slice(pixels);
        self.send(slot)?;
        Ok(true)
    }

    /// Reports that `n` frames of `mode` were lost before they could be sent.
    pub fn lost(&mut self, mode: usize, n: u64) {
        if let Some(port) = self.ports.iter_mut().find(|p| p.mode == mode) {
            port.sequence = port.sequence.saturating_add(n);
        }
    }

    fn stand(&self, state: ExternalState, reason: ExternalReason, why: &str) {
        if let Err(e) = self.camera.shared.stand(self.number, state, reason, why) {
            tracing::warn!(error = %e, "cannot send the camera's state to the daemon");
        }
    }
}

impl Drop for Session<'_> {
    fn drop(&mut self) {
        if !self.refused {
            self.stand(ExternalState::Idle, ExternalReason::None, "");
        }
    }
}

/// Memory for one frame. Dropping it gives it back; the frame counts as lost then.
pub struct FrameSlot {
    loan: Loan<ExternalFrame>,
    mode: usize,
}

impl FrameSlot {
    /// Takes the device's own numbers from `facts`.
    pub fn set_facts(&mut self, facts: &ExternalFrame) {
        let header = self.loan.user_header_mut();
        *header = ExternalFrame {
            device_sequence: facts.device_sequence,
            device_time: facts.device_time,
            arrival_time_ns: facts.arrival_time_ns,
            exposure_ns: facts.exposure_ns,
            gain: facts.gain,
            temperature_c: facts.temperature_c,
            flags: facts.flags,
            ..*header
        };
    }

    /// The header, for writing: also what should not be touched, so that tests can lie.
    pub fn header_mut(&mut self) -> &mut ExternalFrame {
        self.loan.user_header_mut()
    }

    /// The pixels, for writing; rows without padding.
    pub fn pixels_mut(&mut self) -> &mut [u8] {
        channel::bytes_mut(&mut self.loan)
    }
}

impl core::fmt::Debug for FrameSlot {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_tuple("FrameSlot").field(self.loan.user_header()).finish()
    }
}
