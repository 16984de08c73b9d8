//! A raw HID node (`/dev/hidrawN`): feature reports to the device, input reports from it.
#![allow(unsafe_code)] // ioctl(2) takes a pointer whose type its number implies.

use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_driver::{Error, ErrorKind, Result};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::ioctl::{Updater, ioctl, opcode};
use std::fs::{File, OpenOptions};
use std::io::Read as _;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};

/// A transport of a HID device's reports.
pub trait Reports: Send {
    /// Sends a feature report of two bytes, its number first.
    ///
    /// # Errors
    /// [`ErrorKind::Disconnected`], [`ErrorKind::Io`].
    fn send_feature(&mut self, report: [u8; 2]) -> Result<()>;

    /// Waits at most `timeout` for an input report, its number first; how many bytes of `into` it takes.
    ///
    /// # Errors
    /// [`ErrorKind::Disconnected`], [`ErrorKind::Io`].
    fn read(&mut self, into: &mut [u8], timeout: Duration) -> Result<Option<usize>>;
}

/// An open node.
#[derive(Debug)]
pub struct HidNode {
    file: File,
    path: PathBuf,
}

impl HidNode {
    /// Opens the node at `path`.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`], [`ErrorKind::PermissionDenied`] with the cure, [`ErrorKind::Io`].
    pub fn open(path: &Path) -> Result<Self> {
        let open = OpenOptions::new().read(true).write(true).custom_flags(NONBLOCK).open(path);
        let file = open.map_err(|e| {
            let (kind, cure) = match e.kind() {
                std::io::ErrorKind::NotFound => (ErrorKind::NotFound, "is the camera plugged in?"),
                std::io::ErrorKind::PermissionDenied => (
                    ErrorKind::PermissionDenied,
                    "`depthrig install --print` shows the udev rule that lets this user open it",
                ),
                _ => (ErrorKind::Io, "plug the camera in anew"),
            };
            Error::new(kind, format!("{} cannot be opened: {e}; {cure}", path.display())).with_source(e)
        })?;
        Ok(Self { file, path: path.to_owned() })
    }

    fn error(&self, what: &str, e: std::io::Error) -> Error {
        let gone = [Errno::NODEV, Errno::IO, Errno::NXIO, Errno::SHUTDOWN];
        let is_gone = e.raw_os_error().is_some_and(|n| gone.contains(&Errno::from_raw_os_error(n)));
        let kind = if is_gone { ErrorKind::Disconnected } else { ErrorKind::Io };
        Error::new(kind, format!("{}: {what}: {e}", self.path.display())).with_source(e)
    }
}

/// `O_NONBLOCK`, so that a read never waits longer than was asked.
const NONBLOCK: i32 = rustix::fs::OFlags::NONBLOCK.bits() as i32;
/// `HIDIOCSFEATURE` for reports of two bytes (`linux/hidraw.h`).
const SET_FEATURE: rustix::ioctl::Opcode = opcode::read_write::<[u8; 2]>(b'H', 0x06);

impl Reports for HidNode {
    fn send_feature(&mut self, mut report: [u8; 2]) -> Result<()> {
        // SAFETY: the request's number says that its argument is a buffer of two bytes, which this is; the kernel
        // reads it and may write into it.
        let sent = unsafe { ioctl(&self.file, Updater::<SET_FEATURE, [u8; 2]>::new(&mut report)) };
        sent.map_err(|e| self.error(&format!("feature report {:#04x} was not taken", report[0]), e.into()))
    }

    fn read(&mut self, into: &mut [u8], timeout: Duration) -> Result<Option<usize>> {
        let until = HostTime::now().plus(timeout);
        loop {
            let left = until.from_now();
            let left = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: left.subsec_nanos().into() };
            let mut fds = [PollFd::new(&self.file, PollFlags::IN)];
            match poll(&mut fds, Some(&left)) {
                Ok(0) => return Ok(None),
                Ok(_) => {}
                Err(Errno::INTR) => continue,
                Err(e) => return Err(self.error("waiting for a report failed", e.into())),
            }
            match self.file.read(into) {
                Ok(0) => return Err(self.error("no report", Errno::NODEV.into())),
                Ok(n) => return Ok(Some(n)),
                Err(e)
                    if matches!(
                        e.kind(),
                        std::io::ErrorKind::WouldBlock | std::io::ErrorKind::Interrupted
                    ) => {}
                Err(e) => return Err(self.error("no report", e)),
            }
        }
    }
}
