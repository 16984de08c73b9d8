//! Frame sets: for every tick of the recording rate, the frame of each stream that lies nearest to it.
//!
//! The cameras of a mount run free, so no two frames are of one moment. A set is the closest match:
//! 1. Of each stream the frame nearest to the tick (of two equally near ones the earlier), if it lies within the
//!    stream's tolerance: half its period and a millisecond, so that a running stream always has one.
//! 2. A frame is in one set at most, and sets never cross: a later set never has an earlier frame of any stream.
//! 3. A set is sent as soon as no frame still to come could change it, which is when every active stream has shown
//!    a frame stamped at the tick or after it; or when `max_wait_ns` have passed since the tick, with the frames it has.
//!    A tick for which no stream has a frame makes no set.
//! 4. Ticks are a period apart. With [`PhasePolicy::MinimiseSpread`] they move, never by more than half a period,
//!    to where the frames of all streams lie closest together (for seven free cameras at 30 Hz this brings the mean
//!    spread from 25 ms to 21 ms, and no choice of frames can do better).
//!
//! The result depends on the stamps, the order of the calls and the `now` that is passed in, on nothing else. A
//! frame that can be in no set any more is dropped at once: it pins a slot of shared memory. While the deadline
//! falls before the next tick, at most two frames of a stream are held (one for this tick, one for the next), three
//! until the phase is chosen; [`AssemblerConfig::max_pending`] bounds every other case. Per stream and at any time
//! `pushed = used + decimated + late + out_of_order + overflow + pending`.

mod assembler;
mod grid;
mod phase;
mod stats;
mod stream;

pub use assembler::Assembler;
pub use grid::Grid;
pub use phase::Rhythm;
pub use stats::SpreadStats;

use depthrig_bus::HostTime;

/// Where the ticks lie.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PhasePolicy {
    /// On multiples of the period on the host's clock.
    Fixed,
    /// Where the frames of one tick lie closest together; followed slowly as the cameras drift.
    #[default]
    MinimiseSpread,
    /// On multiples of the period on another host's clock ([`Assembler::align`]); until it is known, of the host's own.
    Aligned,
}

/// Rules for building sets. Times are nanoseconds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AssemblerConfig {
    /// Time between ticks, 1 ns to 1 h; [`Assembler::new`] clamps it.
    pub period_ns: i64,
    /// How long after its tick a set waits for frames, 0 to 1 h, likewise.
    pub max_wait_ns: i64,
    /// Nominal time between frames, per stream; its length is the number of streams.
    pub stream_period_ns: Vec<i64>,
    /// How far from the tick a frame may lie, per stream; a stream without an entry gets half its period and 1 ms.
    pub tolerance_ns: Vec<i64>,
    /// Frames that one stream may hold; the oldest goes when there are more. Values under 1 count as 1.
    pub max_pending: usize,
    /// Where the ticks lie.
    pub phase: PhasePolicy,
}

impl AssemblerConfig {
    /// Waits one and a half periods of the slowest stream, holds eight frames, minimises the spread.
    pub fn new(period_ns: i64, stream_period_ns: Vec<i64>) -> Self {
        let slowest = stream_period_ns.iter().copied().max().unwrap_or(period_ns);
        Self {
            period_ns,
            max_wait_ns: slowest.saturating_add(slowest / 2),
            stream_period_ns,
            tolerance_ns: Vec::new(),
            max_pending: 8,
            phase: PhasePolicy::default(),
        }
    }
}

/// The frames of one tick.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FrameSet<T> {
    /// 1, 2, 3, …
    pub id: u64,
    /// The moment the set is for.
    pub tick: HostTime,
    /// One entry per stream; none where the stream is missing.
    pub members: Vec<Option<Member<T>>>,
    /// Bit `i` is set when stream `i` is missing, for the first 64 streams; `members` shows it for any number.
    pub missing: u64,
    /// Latest minus earliest capture time of the members, nanoseconds.
    pub spread_ns: i64,
}

impl<T> FrameSet<T> {
    /// Whether no stream is missing.
    pub fn is_complete(&self) -> bool {
        self.members.iter().all(Option::is_some)
    }
}

/// One stream's frame in a set.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Member<T> {
    /// The frame.
    pub item: T,
    /// When it was captured.
    pub capture: HostTime,
    /// Capture time minus tick, nanoseconds.
    pub skew_ns: i64,
}

/// Accounts of the frames of one stream: `pushed` is the sum of all the others.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Account {
    /// Frames taken in.
    pub pushed: u64,
    /// Became part of a set.
    pub used: u64,
    /// Lay between two ticks or beside a nearer frame, as most do.
    pub decimated: u64,
    /// Would have been in a set (or nearer to its tick than the frame that is), but came after it had been sent.
    pub late: u64,
    /// Stamped not later than the stream's frame before.
    pub out_of_order: u64,
    /// Pushed out by newer ones while waiting.
    pub overflow: u64,
    /// Held now.
    pub pending: u64,
}

#[cfg(test)]
mod tests;
