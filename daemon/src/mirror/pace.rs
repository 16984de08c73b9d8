//! The choice of each stream: frames as they are while the way has room for that, or in a smaller coding.

use super::Ask;
use core::time::Duration;
use depthrig_bus::HostTime;

/// Share of the time between two frames that an image may travel as it is.
const FULL: f64 = 0.6;
/// So many frames above it more than below, and they come small.
const SLOW_FRAMES: u32 = 3;
/// Share of that time which an image would have to travel as it is, by what small ones take, for coming as it is again.
const ROOM: f64 = 0.3;
/// A frame that has no room says nothing while another had some so shortly before: what held it up was this computer, or a burst of others.
const HELD_UP: Duration = Duration::from_secs(1);
/// There must be room for so long; twice as long after each time that it was not true, at most the second.
const WAITS: [Duration; 2] = [Duration::from_secs(5), Duration::from_mins(1)];

/// A frame's way from the other computer.
#[derive(Debug, Clone, Copy)]
pub(super) struct Journey {
    /// When it was here.
    pub(super) at: HostTime,
    /// Bytes of its image on the way.
    pub(super) bytes: usize,
    /// Bytes of its image as it is.
    pub(super) raw_bytes: usize,
    /// From its first byte to its last.
    pub(super) took: Duration,
    /// From one frame of the stream to the next.
    pub(super) period: Duration,
}

/// The choice for one stream.
#[derive(Debug)]
pub(super) struct Pace {
    ask: Ask,
    slow: u32,
    /// Since when there has been room, and when a frame last had it.
    room: Option<(HostTime, HostTime)>,
    wait: Duration,
}

impl Default for Pace {
    fn default() -> Self {
        Self { ask: Ask::Raw, slow: 0, room: None, wait: WAITS[0] }
    }
}

impl Pace {
    /// The question for the next frame.
    pub(super) const fn ask(&self) -> Ask {
        self.ask
    }

    /// Learns from a frame.
    pub(super) fn learn(&mut self, journey: &Journey) {
        let per_byte = journey.took.as_secs_f64() / journey.bytes.max(1) as f64;
        let share = per_byte * journey.raw_bytes as f64 / journey.period.as_secs_f64().max(1e-9);
        match self.ask {
            Ask::Raw => {
                self.slow = if share > FULL { self.slow + 1 } else { self.slow.saturating_sub(1) };
                if self.slow >= SLOW_FRAMES {
                    *self = Self { ask: Ask::Small, slow: 0, room: None, wait: self.wait };
                }
            }
            Ask::Small => {
                self.room = if share > ROOM {
                    self.room.filter(|(_, last)| journey.at <= last.plus(HELD_UP))
                } else {
                    Some((self.room.map_or(journey.at, |(since, _)| since), journey.at))
                };
                if self.room.is_some_and(|(since, _)| since.plus(self.wait) <= journey.at) {
                    let wait = (self.wait * 2).min(WAITS[1]);
                    *self = Self { ask: Ask::Raw, slow: 0, room: None, wait };
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RAW_BYTES: usize = 1_843_200;

    /// The next frame of a stream of such a period over a way of so many bytes a second.
    fn journey(pace: &Pace, at_s: f64, period_s: f64, rate: f64) -> Journey {
        let bytes = if pace.ask() == Ask::Raw { RAW_BYTES } else { RAW_BYTES / 5 };
        Journey {
            at: HostTime::from_ns((at_s * 1e9) as i64),
            bytes,
            raw_bytes: RAW_BYTES,
            took: Duration::from_secs_f64(bytes as f64 / rate),
            period: Duration::from_secs_f64(period_s),
        }
    }

    /// Frames at 30 Hz over a way of so many bytes a second, for so many seconds; how they came.
    fn travel(pace: &mut Pace, from_s: f64, seconds: f64, rate: f64) -> Vec<Ask> {
        let frames = (seconds * 30.0) as usize;
        (0..frames)
            .map(|i| {
                pace.learn(&journey(pace, from_s + i as f64 / 30.0, 1.0 / 30.0, rate));
                pace.ask()
            })
            .collect()
    }

    #[test]
    fn a_way_with_room_carries_them_as_they_are() {
        let mut pace = Pace::default();
        assert!(travel(&mut pace, 0.0, 10.0, 1.2e9).iter().all(|a| *a == Ask::Raw));
    }

    #[test]
    fn a_slow_way_is_noticed_at_once_and_a_fast_one_after_some_time() {
        let mut pace = Pace::default();
        let asks = travel(&mut pace, 0.0, 10.0, 12e6);
        assert_eq!(asks.iter().position(|a| *a == Ask::Small), Some(2));
        assert!(asks[2..].iter().all(|a| *a == Ask::Small), "and it stays");
        let asks = travel(&mut pace, 10.0, 10.0, 1.2e9);
        let back = asks.iter().position(|a| *a == Ask::Raw).unwrap();
        assert!((145..160).contains(&back), "{back}");
    }

    #[test]
    fn frames_that_a_busy_computer_holds_up_do_not_keep_them_small() {
        let mut pace = Pace::default();
        travel(&mut pace, 0.0, 1.0, 12e6);
        assert_eq!(pace.ask(), Ask::Small);
        // Of each second a tenth passes at the way's own speed.
        let seconds = (1..8).take_while(|s| {
            travel(&mut pace, f64::from(*s), 0.9, 12e6);
            travel(&mut pace, f64::from(*s) + 0.9, 0.1, 1.2e9);
            pace.ask() == Ask::Small
        });
        assert_eq!(seconds.count(), 5);
        // A tenth in each two seconds is less than there must be.
        travel(&mut pace, 9.0, 1.0, 12e6);
        for s in (10..40).step_by(2) {
            travel(&mut pace, f64::from(s), 1.9, 12e6);
            travel(&mut pace, f64::from(s) + 1.9, 0.1, 1.2e9);
            assert_eq!(pace.ask(), Ask::Small);
        }
    }

    #[test]
    fn a_stream_whose_frames_are_seconds_apart_comes_as_it_is_again() {
        let mut pace = Pace::default();
        for i in 0..3 {
            pace.learn(&journey(&pace, f64::from(i) * 2.0, 2.0, 0.5e6));
        }
        assert_eq!(pace.ask(), Ask::Small);
        let asks = [6.0, 8.0, 10.0, 12.0].map(|at_s| {
            pace.learn(&journey(&pace, at_s, 2.0, 12e6));
            pace.ask()
        });
        assert_eq!(asks, [Ask::Small, Ask::Small, Ask::Small, Ask::Raw]);
    }

    #[test]
    fn a_way_that_seems_to_have_room_is_tried_less_and_less_often() {
        let mut pace = Pace::default();
        let mut tries = 0;
        // Small frames pass at once, raw ones do not.
        for i in 0..30 * 300 {
            let at = HostTime::from_ns(i * 33_333_333);
            let took = if pace.ask() == Ask::Raw { 33.0 } else { 0.5 };
            let bytes = if pace.ask() == Ask::Raw { 1000 } else { 200 };
            let before = pace.ask();
            let period = Duration::from_millis(33);
            pace.learn(&Journey {
                at,
                bytes,
                raw_bytes: 1000,
                took: Duration::from_secs_f64(took * 1e-3),
                period,
            });
            tries += u32::from(before == Ask::Small && pace.ask() == Ask::Raw);
        }
        assert!((5..=9).contains(&tries), "{tries} tries in five minutes");
    }
}
