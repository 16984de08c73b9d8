//! Memory of transfers against the kernel's limit, which all programs on the computer share.

use core::sync::atomic::{AtomicU64, Ordering};
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::{SysRoot, health};

/// Memory of the submitted transfers of all sources of this process, bytes.
static RESERVED: AtomicU64 = AtomicU64::new(0);

/// Bytes of one piece of a transfer in the kernel (`USB_SG_SIZE`, kernel `drivers/usb/core/devio.c`).
const PIECE: u64 = 16 * 1024;
/// Overhead that the kernel counts for a piece beside its bytes, and for a transfer; rounded up.
const PIECE_OVERHEAD: u64 = 64;
const TRANSFER_OVERHEAD: u64 = 1024;

/// Memory that the kernel counts for `transfers` transfers of `length` bytes.
pub(super) const fn needed(transfers: usize, length: usize) -> u64 {
    let length = length as u64;
    transfers as u64 * (length + length.div_ceil(PIECE) * PIECE_OVERHEAD + TRANSFER_OVERHEAD)
}

/// A part of the limit; given back on drop.
#[derive(Debug)]
pub(super) struct Reservation(u64);

impl Reservation {
    /// Takes `bytes` of the limit.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] with the cure, when this process would submit more than the kernel allows.
    pub(super) fn take(root: &SysRoot, label: &str, bytes: u64) -> Result<Self> {
        let total = RESERVED.fetch_add(bytes, Ordering::SeqCst) + bytes;
        let taken = Self(bytes);
        match health::usbfs_too_small(root, total) {
            None => Ok(taken),
            Some(cure) => Err(Error::new(
                ErrorKind::Io,
                format!(
                    "{label}: {cure}; of the memory that is needed its own transfers take {}",
                    megabytes(bytes)
                ),
            )),
        }
    }

    /// The error for a transfer that the kernel has no memory for although the sum was below the limit.
    pub(super) fn refused(root: &SysRoot, label: &str) -> Error {
        let mine = RESERVED.load(Ordering::SeqCst);
        let limit =
            health::usbfs_limit_mb(root).map_or_else(|| "unknown".to_owned(), |mb| format!("{mb} MB"));
        Error::new(
            ErrorKind::Io,
            format!(
                "{label}: the kernel has no memory for its transfers: the limit is {limit} for all programs, this one \
                 takes {} of it; end other programs that use cameras through libusb, or raise /{}",
                megabytes(mine),
                health::USBFS_LIMIT
            ),
        )
    }
}

impl Drop for Reservation {
    fn drop(&mut self) {
        RESERVED.fetch_sub(self.0, Ordering::SeqCst);
    }
}

fn megabytes(bytes: u64) -> String {
    format!("{:.1} MB", bytes as f64 / f64::from(1 << 20))
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_usb::fake::FakeTree;

    #[test]
    fn a_limit_that_is_too_low_is_reported_before_the_start_with_its_cure() {
        // One test alone uses the process-wide sum: parallel tests would count each other's bytes.
        let dir = tempfile::tempdir().unwrap();
        let tree = FakeTree::new(dir.path());
        let limit = |mb: &str| tree.file(health::USBFS_LIMIT, mb);
        limit("16");
        let stream = needed(4, 615_424);
        assert_eq!(stream, 4 * (615_424 + 38 * 64 + 1024));
        let six: Vec<_> = (0..6).map(|_| Reservation::take(tree.root(), "D435", stream).unwrap()).collect();
        let error = Reservation::take(tree.root(), "D435 at port 4-1", stream).unwrap_err();
        let text = error.to_string();
        assert!(
            text.contains("D435 at port 4-1") && text.contains("its own transfers take 2.4 MB"),
            "{text}"
        );
        assert!(text.contains("have 16 MB") && text.contains("17 MB are needed"), "{text}");
        assert!(text.contains("echo 64 > /sys/module/usbcore/parameters/usbfs_memory_mb"), "{text}");
        // Neither a refused reservation nor a returned one counts.
        drop(six);
        assert_eq!(RESERVED.load(Ordering::SeqCst), 0);
        limit("0");
        let all = Reservation::take(tree.root(), "D435", 1 << 40).unwrap();
        let text = Reservation::refused(tree.root(), "D435").to_string();
        assert!(text.contains("takes 1048576.0 MB of it") && text.contains("limit is 0 MB"), "{text}");
        drop(all);
    }
}
