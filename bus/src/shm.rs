//! How much shared memory there is: running out of it is a SIGBUS, not an error, so it is checked before.

use crate::{Error, ErrorKind, Result};
use std::path::Path;

/// Where POSIX shared memory lives on Linux.
pub const SHM_DIR: &str = "/dev/shm";
/// Slots that a stream gets when memory is plenty.
pub const DEFAULT_SLOTS: usize = 48;
/// Fewer slots than this cannot carry the set assembler, a recorder and a subscriber at once.
pub const MIN_SLOTS: usize = 16;

/// Bytes that can still be written below `path`.
///
/// # Errors
/// [`ErrorKind::Other`] when the file system cannot be asked.
pub fn free_bytes(path: &Path) -> Result<u64> {
    let stat = rustix::fs::statvfs(path).map_err(|e| {
        Error::new(ErrorKind::Other, format!("{}: cannot tell how much space is free", path.display()))
            .with_source(e)
    })?;
    Ok(stat.f_bavail * stat.f_frsize)
}

/// How many slots every stream can have, so that even with all of them in use `set_bytes` (one frame of every
/// stream together) times the slots fit into 80 % of `free` bytes; at most `wanted`.
///
/// # Errors
/// [`ErrorKind::NoSpace`] when that is fewer than [`MIN_SLOTS`], with the size that `/dev/shm` must have.
pub fn slots_that_fit(wanted: usize, set_bytes: u64, free: u64) -> Result<usize> {
    let fit = (free / 10 * 8).checked_div(set_bytes).unwrap_or(u64::MAX);
    let slots = wanted.min(usize::try_from(fit).unwrap_or(usize::MAX));
    if slots >= MIN_SLOTS.min(wanted) {
        return Ok(slots);
    }
    let mib = |bytes: u64| bytes.div_ceil(1 << 20);
    Err(Error::new(
        ErrorKind::NoSpace,
        format!(
            "{SHM_DIR} is too small: {} MiB are free, the streams of this rig need at least {} MiB ({} MiB a frame set, \
             {MIN_SLOTS} slots); enlarge it (mount -o remount,size=4G {SHM_DIR}; with Docker --ipc=host or --shm-size=4g), \
             or use smaller images or fewer cameras",
            mib(free),
            mib(set_bytes * MIN_SLOTS as u64 / 8 * 10),
            mib(set_bytes),
        ),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slots_shrink_with_the_memory_and_then_it_is_an_error() {
        let set = 32 << 20;
        assert_eq!(slots_that_fit(48, set, 24 << 30).unwrap(), 48);
        assert_eq!(slots_that_fit(48, set, 1 << 30).unwrap(), 25);
        let e = slots_that_fit(48, set, 64 << 20).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::NoSpace);
        assert!(e.to_string().contains("64 MiB are free") && e.to_string().contains("640 MiB"), "{e}");
    }

    #[test]
    fn what_the_message_asks_for_is_enough() {
        for set in [1u64 << 10, 3_000_001, 77 << 20] {
            let need = (set * MIN_SLOTS as u64 / 8 * 10).div_ceil(1 << 20) << 20;
            assert!(slots_that_fit(48, set, need).is_ok(), "{set}");
        }
    }
}
