//! How fast bytes come from another computer and go there, as a tunnel carries them.

use crate::tunnel::{said, spawn, text};
use depthrig_bus::HostTime;
use std::io::{self, Read, Write};
use std::process::Child;

/// Bytes each way, in so many blocks: a tenth of a second at 0.4 Gbit/s, twenty seconds on the slowest Wi-Fi.
const BYTES: u64 = BLOCKS * AT_ONCE as u64;
const BLOCKS: u64 = 77;
/// Lines there and back, of which the quickest is the round trip.
const LINES: usize = 5;
/// Bytes of one write or read.
const AT_ONCE: usize = 64 << 10;

/// Rates of a way to another computer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rates {
    /// Bytes a second from there.
    pub from_there: f64,
    /// Bytes a second to there.
    pub to_there: f64,
    /// A line there and back, through `ssh` and a shell, microseconds.
    pub round_trip_us: f64,
}

/// Moves 5 MB each way between this computer and `destination`, as [`crate::Tunnel`] names it.
///
/// # Errors
/// The last line that `ssh` printed, when it does not come there.
pub fn measure(destination: &str) -> Result<Rates, String> {
    let there = format!(
        "sh -c 'n=0; while [ $n -lt {LINES} ]; do read line; echo; n=$((n+1)); done; dd if=/dev/zero bs={AT_ONCE} count={BLOCKS} 2>/dev/null; cat >/dev/null'"
    );
    // Zeros are quick to make, and images, which are compressed already, pass no quicker where `ssh` compresses.
    let mut child = spawn(destination, &["-o", "Compression=no"], &there)?;
    let measured = both(&mut child);
    // It ends with its input.
    drop(child.stdin.take());
    let status = child.wait();
    match measured {
        Ok(Times { round_trip_us, begun, received }) if status.is_ok_and(|status| status.success()) => {
            let rate = |from: HostTime, to: HostTime| BYTES as f64 * 1e9 / to.since_ns(from).max(1) as f64;
            let ended = HostTime::now();
            Ok(Rates { from_there: rate(begun, received), to_there: rate(received, ended), round_trip_us })
        }
        _ => Err(said(destination, &text(child.stderr.as_mut()))),
    }
}

/// Facts until the last byte was sent.
struct Times {
    round_trip_us: f64,
    /// When the first byte came.
    begun: HostTime,
    /// When the last one had come; then sending began.
    received: HostTime,
}

fn both(child: &mut Child) -> io::Result<Times> {
    let closed = || io::Error::from(io::ErrorKind::BrokenPipe);
    let stdout = child.stdout.as_mut().ok_or_else(closed)?;
    let mut stdin = child.stdin.take().ok_or_else(closed)?;
    let mut round_trip_us = f64::INFINITY;
    for _ in 0..LINES {
        let sent = HostTime::now();
        stdin.write_all(b"\n")?;
        stdout.read_exact(&mut [0])?;
        round_trip_us = round_trip_us.min(HostTime::now().since_ns(sent) as f64 / 1e3);
    }
    let mut buffer = vec![0; AT_ONCE];
    let mut begun = None;
    let mut received = 0;
    while received < BYTES {
        let n = stdout.read(&mut buffer)? as u64;
        if n == 0 {
            return Err(closed());
        }
        begun.get_or_insert_with(HostTime::now);
        received += n;
    }
    let all = HostTime::now();
    let mut left = BYTES as usize;
    while left > 0 {
        let n = left.min(AT_ONCE);
        stdin.write_all(&buffer[..n])?;
        left -= n;
    }
    Ok(Times { round_trip_us, begun: begun.unwrap_or(all), received: all })
}
