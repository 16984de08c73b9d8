//! The sets there should be, worked out slowly with every frame kept for ever.

use crate::sets::AssemblerConfig;

/// One call on the assembler.
#[derive(Debug, Clone, Copy)]
pub enum Event {
    Push { stream: usize, stamp: i64 },
    Active { stream: usize, active: bool },
    Poll { now: i64 },
}

/// Fate of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fate {
    Used,
    Decimated,
    Late,
    OutOfOrder,
    Pending,
}

struct Frame {
    stamp: i64,
    fate: Fate,
    /// Nearer to the tick of a set that was out when it came than the frame in that set.
    late: bool,
}

#[derive(Default)]
struct Stream {
    inactive: bool,
    frames: Vec<Frame>,
    /// Stamp of the last frame used.
    cursor: Option<i64>,
    /// (tick, distance of the frame it got) of sets out before the stream had reached their tick.
    undecided: Vec<(i64, i64)>,
}

impl Stream {
    fn newest(&self) -> Option<i64> {
        self.frames.iter().filter(|f| f.fate != Fate::OutOfOrder).map(|f| f.stamp).max()
    }

    /// The frame for a tick, of all that may still be used.
    fn nearest(&self, tick: i64, tolerance: i64) -> Option<usize> {
        (0..self.frames.len())
            .filter(|&i| {
                let f = &self.frames[i];
                f.fate == Fate::Pending
                    && self.cursor.is_none_or(|c| f.stamp > c)
                    && (f.stamp - tick).abs() <= tolerance
            })
            .min_by_key(|&i| ((self.frames[i].stamp - tick).abs(), self.frames[i].stamp))
    }
}

pub type Sets = Vec<(i64, Vec<Option<i64>>)>;

/// The sets, and the fate of every frame with its stream.
pub fn model(config: &AssemblerConfig, events: &[Event]) -> (Sets, Vec<(usize, Fate)>) {
    let period = config.period_ns;
    let tolerances: Vec<i64> = (0..config.stream_period_ns.len())
        .map(|i| config.tolerance_ns.get(i).copied().unwrap_or(config.stream_period_ns[i] / 2 + 1_000_000))
        .collect();
    let mut streams: Vec<Stream> = tolerances.iter().map(|_| Stream::default()).collect();
    let mut sets = Vec::new();
    let mut tick = None;
    for event in events {
        match *event {
            Event::Active { stream, active } => streams[stream].inactive = !active,
            Event::Push { stream, stamp } => {
                tick.get_or_insert((stamp as f64 / period as f64).ceil() as i64 * period);
                let s = &mut streams[stream];
                let fate =
                    if s.newest().is_some_and(|n| stamp <= n) { Fate::OutOfOrder } else { Fate::Pending };
                let remembered = s.undecided.iter().rev().take(8);
                let late = remembered.clone().any(|(tick, distance)| (stamp - tick).abs() < *distance);
                s.frames.push(Frame { stamp, fate, late });
            }
            Event::Poll { now } => {
                while let Some(at) = tick
                    && ripe(&streams, at, now - config.max_wait_ns)
                {
                    let picks: Vec<Option<usize>> =
                        streams.iter().zip(&tolerances).map(|(s, tol)| s.nearest(at, *tol)).collect();
                    let stamps =
                        streams.iter().zip(&picks).map(|(s, p)| p.map(|p| s.frames[p].stamp)).collect();
                    for ((s, pick), tol) in streams.iter_mut().zip(&picks).zip(&tolerances) {
                        let used = pick.map(|p| s.frames[p].stamp);
                        if s.newest().is_none_or(|n| n < at) {
                            s.undecided.push((at, used.map_or(tol + 1, |u| (u - at).abs())));
                        }
                        if let Some(p) = *pick {
                            s.frames[p].fate = Fate::Used;
                            s.cursor = used;
                        }
                    }
                    if picks.iter().any(Option::is_some) {
                        sets.push((at, stamps));
                    }
                    tick = Some(at + period);
                }
            }
        }
    }
    let fates = streams.iter().zip(&tolerances).enumerate().flat_map(|(i, (s, tol))| {
        let best = tick.and_then(|t| s.nearest(t, *tol));
        s.frames.iter().enumerate().map(move |(j, f)| {
            let usable = s.cursor.is_none_or(|c| f.stamp > c)
                && (best == Some(j)
                    || tick.is_some_and(|t| f.stamp >= t + period - tol && later(s, best, f.stamp)));
            let fate = match f.fate {
                Fate::Pending if usable => Fate::Pending,
                Fate::Pending if f.late => Fate::Late,
                Fate::Pending => Fate::Decimated,
                fate => fate,
            };
            (i, fate)
        })
    });
    (sets, fates.collect())
}

/// A frame before the one that the tick in hand will take would cross it.
fn later(s: &Stream, best: Option<usize>, stamp: i64) -> bool {
    best.is_none_or(|b| stamp > s.frames[b].stamp)
}

/// Whether every active stream has reached the tick, or the wait is over.
fn ripe(streams: &[Stream], tick: i64, deadline: i64) -> bool {
    let mut active = streams.iter().filter(|s| !s.inactive).peekable();
    tick <= deadline || (active.peek().is_some() && active.all(|s| s.newest().is_some_and(|n| n >= tick)))
}
