//! A foot pedal: a keyboard of few keys, read from its event device.
//!
//! The crate `evdev` would read it, too, and brings four crates for what is a struct of 24 bytes and one ioctl here.
#![allow(unsafe_code)] // the ioctl that keeps a pedal's keys from other programs

#[cfg(test)]
mod tests;

use anyhow::{Result, bail};
use core::ffi::c_int;
use core::time::Duration;
use depthrig_bus::HostTime;
use rustix::fs::{FileType, Mode, OFlags};
use rustix::io::Errno;
use rustix::ioctl::{self, opcode};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};

/// A key that is held for this long asks to repeat the episode.
const LONG: Duration = Duration::from_secs(1);
/// Size of `struct input_event` (linux/input.h) on 64-bit computers: seconds and microseconds of 8 bytes each, type and code of 2, value of 4.
const EVENT_BYTES: usize = 24;
/// `EV_KEY`: a key's value is 1 when pressed, 0 when released, 2 when repeated.
const EV_KEY: u16 = 1;
/// Request `EVIOCGRAB`: events go to this reader only, until it closes the device.
const GRAB: ioctl::Opcode = opcode::write::<c_int>(b'E', 0x90);

/// A step on the pedal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Press {
    /// The first key, shortly.
    Next,
    /// The first key for a second, or another key.
    Again,
}

/// An open pedal.
#[derive(Debug)]
pub struct Pedal {
    path: PathBuf,
    device: Option<OwnedFd>,
    bytes: Vec<u8>,
    keys: Keys,
}

impl Pedal {
    /// Opens an event device such as those in `/dev/input/by-id`, or a pipe that carries its events, and keeps its keys from
    /// other programs.
    ///
    /// # Errors
    /// When it cannot be opened, is of another kind, or another program has taken it.
    pub fn open(path: &Path) -> Result<Self> {
        let shown = path.display();
        let device = match rustix::fs::open(
            path,
            OFlags::RDONLY | OFlags::NONBLOCK | OFlags::CLOEXEC,
            Mode::empty(),
        ) {
            Ok(device) => device,
            Err(Errno::ACCESS | Errno::PERM) => bail!(
                "pedal {shown} cannot be opened: permission denied; join the group of input devices and log in again: sudo \
                 usermod -aG input $USER"
            ),
            Err(Errno::NOENT) => {
                bail!(
                    "pedal {shown} does not exist; attached pedals and keyboards are listed by: ls /dev/input/by-id"
                )
            }
            Err(e) => bail!("pedal {shown} cannot be opened: {e}"),
        };
        let kind = FileType::from_raw_mode(rustix::fs::fstat(&device)?.st_mode);
        // SAFETY: EVIOCGRAB takes a number, not a pointer, and changes nothing in this process.
        let grabbed = unsafe { ioctl::ioctl(&device, ioctl::IntegerSetter::<GRAB>::new_usize(1)) };
        match grabbed {
            Ok(()) => {}
            Err(Errno::BUSY) => bail!("pedal {shown} is in use: another program has taken its keys"),
            Err(_) if kind == FileType::Fifo => {}
            Err(e) => {
                bail!("{shown} is not an input device ({e}); pedals are listed by: ls /dev/input/by-id")
            }
        }
        Ok(Self { path: path.to_owned(), device: Some(device), bytes: Vec::new(), keys: Keys::default() })
    }

    /// The steps since the last call. Returns at once.
    ///
    /// # Errors
    /// Once, when the pedal is gone; after that there are no steps.
    pub fn presses(&mut self) -> Result<Vec<Press>> {
        let Some(device) = &self.device else { return Ok(Vec::new()) };
        let now = HostTime::now();
        let mut presses = Vec::new();
        let mut buffer = [0; EVENT_BYTES * 64];
        loop {
            match rustix::io::read(device, &mut buffer) {
                Ok(0) => break self.gone("its end was closed")?,
                Ok(n) => {
                    self.bytes.extend_from_slice(buffer.get(..n).unwrap_or_default());
                    let events = self.bytes.chunks_exact(EVENT_BYTES);
                    presses.extend(events.filter_map(Event::read).filter_map(|e| self.keys.take(e, now)));
                    // A pipe may cut an event in two.
                    self.bytes.drain(..self.bytes.len() / EVENT_BYTES * EVENT_BYTES);
                }
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => break,
                Err(e) => break self.gone(&e.to_string())?,
            }
        }
        presses.extend(self.keys.hold(now));
        Ok(presses)
    }

    fn gone(&mut self, why: &str) -> Result<()> {
        self.device = None;
        bail!("pedal {} is gone ({why})", self.path.display())
    }
}

/// A change of a key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Event {
    /// When it happened, by the clock of the device's driver, microseconds.
    time_us: i64,
    code: u16,
    is_down: bool,
}

impl Event {
    /// That of a `struct input_event`; none of a repetition or of something other than a key.
    fn read(bytes: &[u8]) -> Option<Self> {
        let (seconds, rest) = bytes.split_first_chunk::<8>()?;
        let (micros, rest) = rest.split_first_chunk::<8>()?;
        let (kind, rest) = rest.split_first_chunk::<2>()?;
        let (code, rest) = rest.split_first_chunk::<2>()?;
        let value = i32::from_ne_bytes(*rest.first_chunk::<4>()?);
        let is_key = u16::from_ne_bytes(*kind) == EV_KEY && matches!(value, 0 | 1);
        let time_us = i64::from_ne_bytes(*seconds).saturating_mul(1_000_000);
        is_key.then(|| Self {
            time_us: time_us.saturating_add(i64::from_ne_bytes(*micros)),
            code: u16::from_ne_bytes(*code),
            is_down: value == 1,
        })
    }
}

/// Keys that are held, and which was the first.
#[derive(Debug, Default)]
struct Keys {
    /// The key that was the first to be pressed: any pedal may be of any code, often a letter or a mouse button.
    first: Option<u16>,
    held: Option<Held>,
}

#[derive(Debug, Clone, Copy)]
struct Held {
    down: Event,
    seen: HostTime,
}

impl Keys {
    /// A step counts at its end, which says how long it was.
    fn take(&mut self, event: Event, now: HostTime) -> Option<Press> {
        if event.is_down {
            self.first.get_or_insert(event.code);
            self.held = Some(Held { down: event, seen: now });
            return None;
        }
        let held = self.held.take_if(|held| held.down.code == event.code)?;
        let is_long = event.time_us.saturating_sub(held.down.time_us) >= LONG.as_micros() as i64;
        let is_first = self.first == Some(event.code);
        Some(if is_first && !is_long { Press::Next } else { Press::Again })
    }

    /// A key that is held long counts before it is released.
    fn hold(&mut self, now: HostTime) -> Option<Press> {
        let held = self.held.take_if(|held| now.since_ns(held.seen) >= LONG.as_nanos() as i64);
        held.map(|_| Press::Again)
    }
}
