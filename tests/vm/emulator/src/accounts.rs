//! Frame counts of a stream of an emulated camera.

use serde::Serialize;

/// The frames of one stream since the camera was created. A stop, an unplugging or a reset keeps them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Accounts {
    /// Frames whose last byte the host took. `good`, `error_bit`, `short`, `long` and `repeated` add up to it.
    pub sent: u64,
    /// Sent and undamaged.
    pub good: u64,
    /// Sent with the ERR bit of the payload header.
    pub error_bit: u64,
    /// Sent with bytes missing.
    pub short: u64,
    /// Sent with bytes too many.
    pub long: u64,
    /// Sent a second time in place of the next one.
    pub repeated: u64,
    /// Not sent, because of a fault.
    pub skipped: u64,
    /// Not sent, because the host did not read.
    pub unread: u64,
    /// Not sent, because the emulator itself came too late. Above 0 the machine is too slow for the test.
    pub late: u64,
    /// Begun, and cut off by a stop or an unplugging.
    pub cut: u64,
    /// How often the stream was started.
    pub starts: u64,
}
