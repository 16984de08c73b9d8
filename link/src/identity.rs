//! Which clock a time was read from, so that times of two datasets are only compared if that makes sense.

use std::fs;
use std::io::{Error, ErrorKind, Result};

/// A number for this process's `CLOCK_MONOTONIC`: another one after each boot, and in each time namespace with offsets of its own. Never 0.
///
/// It is the 64-bit FNV-1a hash of the kernel's boot id and the namespace's offsets (`time_namespaces(7)`).
///
/// # Errors
/// When `/proc` is not there.
pub fn of_this_clock() -> Result<u64> {
    let boot = fs::read("/proc/sys/kernel/random/boot_id")?;
    // A kernel without time namespaces has no such file.
    let offsets = match fs::read("/proc/self/timens_offsets") {
        Err(e) if e.kind() == ErrorKind::NotFound => Vec::new(),
        read => read?,
    };
    if boot.is_empty() {
        return Err(Error::other("the kernel has no boot id"));
    }
    let step = |hash: u64, byte: &u8| (hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3);
    Ok(boot.iter().chain(&offsets).fold(0xcbf2_9ce4_8422_2325, step).max(1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_has_one_number() {
        let clock = of_this_clock().unwrap();
        assert_ne!(clock, 0);
        assert_eq!(of_this_clock().unwrap(), clock);
    }
}
