//! Shared memory: how much is free, and that a channel's memory is really allocated.
//!
//! A file in `/dev/shm` has the size it was given, but gets memory only where it is written, and a write for which none is
//! left kills the process (SIGBUS). So every slot gets its memory when the channel is created, and so do iceoryx2's
//! records of the channel's clients. Its other files (connections, events: some KiB each, written when created) are
//! only begun when there is room.

use crate::{Error, ErrorKind, Result, limits};
use rustix::fs::{FallocateFlags, Mode, OFlags, fallocate, fstat, open};
use rustix::io::{Errno, retry_on_intr};
use std::path::{Path, PathBuf};

/// Prefix of shared-memory names, which identifies their owner; Python uses the same.
pub const SHM_PREFIX: &str = "depthrig_";
/// Where POSIX shared memory lives on Linux.
pub const SHM_DIR: &str = "/dev/shm";
/// Slots that a stream gets when memory is plenty.
pub const DEFAULT_SLOTS: usize = 48;
/// Fewer slots than this cannot carry the set assembler, a recorder and a subscriber at once.
pub const MIN_SLOTS: usize = 16;

const HOW_TO_ENLARGE: &str = "enlarge it (mount -o remount,size=4G /dev/shm; with Docker --ipc=host or --shm-size=4g), end \
     another rig, or use smaller images or fewer cameras";
/// Free bytes without which depthrig creates nothing.
const ROOM: u64 = 1 << 20;
/// Free bytes that a channel's slots leave for everything else.
const LEFT_OVER: u64 = 4 * ROOM;

/// Bytes that can still be written below `path`.
///
/// # Errors
/// [`ErrorKind::Other`] when the file system gives no answer.
pub fn free_bytes(path: &Path) -> Result<u64> {
    let stat = rustix::fs::statvfs(path).map_err(|e| {
        Error::new(ErrorKind::Other, format!("{}: cannot read its free space", path.display())).with_source(e)
    })?;
    Ok(stat.f_bavail * stat.f_frsize)
}

/// How many slots every stream can have, so that even with all of them in use `set_bytes` (one frame of every
/// stream together) times the slots fit into 80 % of `free` bytes; at most `wanted`.
///
/// # Errors
/// [`ErrorKind::NoSpace`] when that is fewer than [`MIN_SLOTS`], with the size that `/dev/shm` must have.
pub fn slots_that_fit(wanted: usize, set_bytes: u64, free: u64) -> Result<usize> {
    let fit = usable(free).checked_div(set_bytes).unwrap_or(u64::MAX);
    let slots = wanted.min(usize::try_from(fit).unwrap_or(usize::MAX));
    if slots >= MIN_SLOTS.min(wanted) {
        return Ok(slots);
    }
    Err(Error::new(
        ErrorKind::NoSpace,
        format!(
            "{SHM_DIR} is too small: {} MiB are free, the streams of this rig need at least {} MiB ({} MiB a frame set, \
             {MIN_SLOTS} slots); {HOW_TO_ENLARGE}",
            mib(free),
            mib(set_bytes * MIN_SLOTS as u64 / 8 * 10),
            mib(set_bytes),
        ),
    ))
}

/// Bytes that slots may take of `free` bytes.
const fn usable(free: u64) -> u64 {
    free / 10 * 8
}

const fn mib(bytes: u64) -> u64 {
    bytes.div_ceil(1 << 20)
}

/// Checks that there is room for what iceoryx2 creates besides the slots; without it, creating that could kill the
/// process.
pub(crate) fn check_room() -> Result<()> {
    match free_bytes(SHM_DIR.as_ref()) {
        Ok(free) if free < ROOM => Err(Error::new(
            ErrorKind::NoSpace,
            format!(
                "{SHM_DIR} is full ({} KiB are free); delete what fills it, or enlarge it (mount -o remount,size=4G {SHM_DIR})",
                free >> 10
            ),
        )),
        _ => Ok(()),
    }
}

/// Allocates the memory of the port `id`, which has `slots` slots. Returns what is missing for it, if anything.
pub(crate) fn back(id: u128, slots: usize) -> Result<Option<Lack>> {
    let path = segment(id)?;
    let failed = |what: &str, e: Errno| {
        let why = format!("{}: its memory cannot be {what}", path.display());
        Error::new(ErrorKind::Other, why).with_source(e)
    };
    let flags = OFlags::RDWR | OFlags::CLOEXEC | OFlags::NOFOLLOW;
    let file = open(&path, flags, Mode::empty()).map_err(|e| failed("opened", e))?;
    let bytes = fstat(&file).map_err(|e| failed("measured", e))?.st_size as u64;
    let lack = Some(Lack { bytes, slots });
    // The kernel would take all free memory before it gives up.
    if bytes > free_bytes(SHM_DIR.as_ref())? {
        return Ok(lack);
    }
    match retry_on_intr(|| fallocate(&file, FallocateFlags::empty(), 0, bytes)) {
        Ok(()) if free_bytes(SHM_DIR.as_ref())? < LEFT_OVER => Ok(lack),
        Ok(()) => Ok(None),
        Err(Errno::NOSPC | Errno::NOMEM) => Ok(lack),
        Err(e) => Err(failed("reserved", e)),
    }
}

/// Allocates the memory of iceoryx2's records of the channels' clients: their end is written by the last of many
/// clients, long after they were created.
pub(crate) fn back_registers() -> Result<()> {
    let failed = |e: Errno| {
        let why = limits::why("it has no room for what is kept of a channel");
        Error::new(ErrorKind::NoSpace, format!("{SHM_DIR}: {why}; {HOW_TO_ENLARGE}")).with_source(e)
    };
    let no_list = |e: std::io::Error| failed(Errno::from_io_error(&e).unwrap_or(Errno::IO));
    for entry in std::fs::read_dir(SHM_DIR).map_err(no_list)?.flatten() {
        let name = entry.file_name();
        let name = name.to_string_lossy();
        if name.starts_with(SHM_PREFIX) && name.ends_with(".dynamic") {
            back_register(&entry.path()).map_err(failed)?;
        }
    }
    Ok(())
}

fn back_register(path: &Path) -> rustix::io::Result<()> {
    let file = match open(path, OFlags::RDWR | OFlags::CLOEXEC | OFlags::NOFOLLOW, Mode::empty()) {
        // It was just removed, or is another user's.
        Err(Errno::NOENT | Errno::ACCESS) => return Ok(()),
        file => file?,
    };
    let stat = fstat(&file)?;
    if stat.st_blocks as u64 * 512 >= stat.st_size as u64 {
        return Ok(());
    }
    retry_on_intr(|| fallocate(&file, FallocateFlags::empty(), 0, stat.st_size as u64))
}

/// The file of the data of the port `id`.
fn segment(id: u128) -> Result<PathBuf> {
    let end = format!("_{id}.data");
    let is_it = |name: &str| name.starts_with(SHM_PREFIX) && name.ends_with(&end);
    let missing = || {
        let why = limits::why("the memory of a newly created port is missing");
        Error::new(ErrorKind::Other, format!("{SHM_DIR}: {why}"))
    };
    let entries = std::fs::read_dir(SHM_DIR).map_err(|e| missing().with_source(e))?;
    let mut files = entries.filter_map(|e| Some(e.ok()?.path()));
    files.find(|path| path.file_name().and_then(|n| n.to_str()).is_some_and(is_it)).ok_or_else(missing)
}

/// Slots for which memory is missing.
#[derive(Debug)]
pub(crate) struct Lack {
    bytes: u64,
    slots: usize,
}

impl Lack {
    /// How many of the slots would fit now; memory that they already had must have been freed.
    pub(crate) fn slots_that_fit(&self) -> Result<usize> {
        let free = free_bytes(SHM_DIR.as_ref())?.saturating_sub(LEFT_OVER);
        let slot = self.bytes.div_ceil(self.slots.max(1) as u64).max(1);
        Ok((usable(free) / slot) as usize)
    }

    /// The error of a channel that cannot have enough slots.
    pub(crate) fn refusal(&self, what: &str, fit: usize) -> Error {
        let Self { bytes, slots } = self;
        Error::new(
            ErrorKind::NoSpace,
            format!(
                "{what}: {SHM_DIR} has no room for its {slots} slots ({} MiB), {fit} would fit; {HOW_TO_ENLARGE}",
                mib(*bytes)
            ),
        )
    }
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
