//! When which set is published: play, pause, seek, step, rate and loop as arithmetic on times, without a clock, a
//! thread or a dataset.
//!
//! Playing is a straight line: at the time `anchor.0` the replay was at `anchor.1` on its axis, and it moves on by
//! `rate` seconds a second. Every command that bends the line begins a new one where the old one was, so that nothing
//! is skipped and nothing is caught up afterwards.

use super::timeline::Timeline;
use crate::{Error, ErrorKind, Result};
use depthrig_bus::HostTime;
use std::ops::RangeInclusive;
use std::sync::Arc;

/// Speeds that a replay can have.
pub const RATES: RangeInclusive<f64> = 0.1..=10.0;
/// A set that comes later than this, because the disk or a decoder was slow, moves all later ones: a short delay is
/// made up for, a long one must not end in a burst.
const SLACK_NS: i64 = 100_000_000;
/// Time from one round of a single set to the next.
const LONE_PERIOD_NS: i64 = 200_000_000;

/// The player's next action.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// Publish the moment of this number when it is due. `turn` goes back to [`Transport::published`].
    Publish {
        /// Which.
        moment: usize,
        /// When; at once when this is past.
        due: HostTime,
        /// Between which two seeks this is.
        turn: u64,
    },
    /// Nothing until the next command.
    Idle,
    /// Everything was published.
    End,
}

/// The state of a replay's controls.
#[derive(Debug)]
#[allow(clippy::struct_excessive_bools)] // independent switches, not a state machine in disguise
pub struct Transport {
    timeline: Arc<Timeline>,
    by_clock: bool,
    rate: f64,
    looped: bool,
    hold: bool,
    paused: bool,
    /// Moments to play until it pauses again.
    steps: Option<u64>,
    /// The next moment is published at once, whatever the line says.
    show: bool,
    next: usize,
    anchor: (HostTime, i64),
    turn: u64,
    rounds: u64,
}

/// How a replay begins.
#[derive(Debug, Clone, Copy)]
#[allow(clippy::struct_excessive_bools)] // each is a choice of its own
pub struct Begin {
    /// Whether the clock paces it, and not its subscribers.
    pub by_clock: bool,
    /// Speed against the original.
    pub rate: f64,
    /// Begin again at the end.
    pub looped: bool,
    /// Pause at the end, and do not end.
    pub hold: bool,
    /// Begin paused.
    pub paused: bool,
}

/// Refuses a speed that a replay cannot have.
///
/// # Errors
/// [`ErrorKind::BadInput`].
pub fn check_rate(rate: f64) -> Result<()> {
    if RATES.contains(&rate) {
        return Ok(());
    }
    let least = RATES.start();
    let most = RATES.end();
    Err(Error::new(
        ErrorKind::BadInput,
        format!("a replay cannot run at {rate} times its speed; choose a rate from {least} to {most}"),
    ))
}

impl Transport {
    /// Controls that are at the beginning of `timeline`.
    pub const fn new(timeline: Arc<Timeline>, begin: Begin, now: HostTime) -> Self {
        let Begin { by_clock, rate, looped, hold, paused } = begin;
        Self {
            timeline,
            by_clock,
            rate,
            looped,
            hold,
            paused,
            steps: None,
            show: false,
            next: 0,
            anchor: (now, 0),
            turn: 0,
            rounds: 1,
        }
    }

    /// The next action at `now`.
    pub fn order(&mut self, now: HostTime) -> Order {
        if self.paused && !self.show {
            return Order::Idle;
        }
        let Some((moment, due)) = self.upcoming() else {
            self.show = false;
            if self.paused || self.hold || self.steps.is_some() {
                self.pause_at(now, self.timeline.length_ns());
                return Order::Idle;
            }
            return Order::End;
        };
        let due = if self.show || !self.by_clock { now } else { due };
        Order::Publish { moment, due, turn: self.turn }
    }

    /// The next moment, and when the line is there.
    fn upcoming(&self) -> Option<(usize, HostTime)> {
        if !self.at_end() {
            return Some((self.next, self.due_at(self.time(self.next))));
        }
        if !self.looped || self.timeline.len() == 0 {
            return None;
        }
        // The pause between rounds is as long as sets usually are apart.
        let length = self.timeline.length_ns();
        let gap = length.checked_div(self.timeline.len() as i64 - 1).unwrap_or(LONE_PERIOD_NS);
        Some((0, self.due_at(length.saturating_add(gap))))
    }

    /// Notes that `moment` of `turn` was published at `now`, or could not be.
    pub fn published(&mut self, moment: usize, turn: u64, now: HostTime) {
        if turn != self.turn {
            return; // somebody sought while it was being published
        }
        let at = self.time(moment);
        let due = self.upcoming().map_or(now, |(_, due)| due);
        if self.at_end() {
            self.rounds += 1;
            self.anchor = (due, at);
        }
        if self.show || now.since_ns(due) > SLACK_NS {
            self.anchor = (now, at);
        }
        self.show = false;
        self.next = moment + 1;
        if let Some(left) = &mut self.steps {
            *left = left.saturating_sub(1);
            if *left == 0 {
                self.pause_at(now, at);
            }
        }
    }

    /// Stops where it is.
    pub fn pause(&mut self, now: HostTime) {
        let at = self.position(now);
        self.pause_at(now, at);
    }

    /// Plays on from where it stopped.
    ///
    /// # Errors
    /// [`ErrorKind::WrongState`] at the end.
    pub fn resume(&mut self, now: HostTime) -> Result<()> {
        if self.paused {
            self.must_have_more()?;
            self.anchor = (now, self.anchor.1);
        }
        (self.paused, self.steps) = (false, None);
        Ok(())
    }

    /// Goes to `moment`, publishes it at once, and plays on from there unless it is paused.
    pub fn seek(&mut self, moment: usize) {
        self.next = moment.min(self.timeline.len());
        self.show = true;
        self.turn += 1;
        if self.steps.take().is_some() {
            self.paused = true;
        }
    }

    /// Plays so many moments, the first one at once, and pauses; backwards it goes to the moment so far before the
    /// present one, publishes it and pauses.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for 0, [`ErrorKind::WrongState`] when there is nothing to step to.
    pub fn step(&mut self, by: i64) -> Result<()> {
        match u64::try_from(by) {
            Ok(0) => Err(Error::new(ErrorKind::BadInput, "a step of 0 sets goes nowhere")),
            Ok(forward) => {
                self.must_have_more()?;
                (self.paused, self.steps, self.show) = (false, Some(forward), true);
                Ok(())
            }
            Err(_) => {
                let back = usize::try_from(by.unsigned_abs()).unwrap_or(usize::MAX);
                let target =
                    self.next.checked_sub(1).filter(|now| *now > 0).map(|now| now.saturating_sub(back));
                let target = target
                    .ok_or_else(|| Error::new(ErrorKind::WrongState, "the replay is at its first set"))?;
                self.seek(target);
                self.paused = true;
                Ok(())
            }
        }
    }

    /// Changes the speed from now on.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] outside of [`RATES`], [`ErrorKind::WrongState`] when subscribers pace it.
    pub fn set_rate(&mut self, rate: f64, now: HostTime) -> Result<()> {
        check_rate(rate)?;
        if !self.by_clock {
            return Err(Error::new(
                ErrorKind::WrongState,
                "this replay runs as fast as its subscribers read; start it without --as-fast-as-possible to give it \
                 a rate",
            ));
        }
        if !self.paused {
            self.anchor = (now, self.position(now));
        }
        self.rate = rate;
        Ok(())
    }

    /// Whether to begin again at the end.
    pub const fn set_loop(&mut self, on: bool) {
        self.looped = on;
    }

    /// The number of the moment that comes next.
    pub const fn next(&self) -> usize {
        self.next
    }

    /// Whether a command's own moment is still to be published.
    pub const fn is_showing(&self) -> bool {
        self.show
    }

    /// Whether it is paused, or will be after the requested steps.
    pub const fn is_paused(&self) -> bool {
        self.paused || self.steps.is_some()
    }

    /// Whether everything was published.
    pub fn at_end(&self) -> bool {
        self.next >= self.timeline.len()
    }

    /// Speed against the original.
    pub const fn rate(&self) -> f64 {
        self.rate
    }

    /// Whether it begins again at the end.
    pub const fn is_looped(&self) -> bool {
        self.looped
    }

    /// Rounds begun.
    pub const fn rounds(&self) -> u64 {
        self.rounds
    }

    fn must_have_more(&self) -> Result<()> {
        if self.at_end() && !self.looped {
            return Err(Error::new(ErrorKind::WrongState, "the replay is at its end; seek back first"));
        }
        Ok(())
    }

    fn pause_at(&mut self, now: HostTime, at: i64) {
        (self.paused, self.steps) = (true, None);
        self.anchor = (now, at);
    }

    fn time(&self, moment: usize) -> i64 {
        self.timeline.times().get(moment).copied().unwrap_or_else(|| self.timeline.length_ns())
    }

    /// When the line is at `at`.
    fn due_at(&self, at: i64) -> HostTime {
        self.anchor.0.plus_ns(self.scaled(at.saturating_sub(self.anchor.1)))
    }

    /// Nanoseconds of the axis as nanoseconds of the clock.
    fn scaled(&self, ns: i64) -> i64 {
        (ns as f64 / self.rate).round() as i64
    }

    /// Where the line is at `now`; never beyond the next moment to publish, or it would be skipped.
    fn position(&self, now: HostTime) -> i64 {
        if self.paused {
            return self.anchor.1;
        }
        let moved = (now.since_ns(self.anchor.0) as f64 * self.rate).round() as i64;
        self.anchor.1.saturating_add(moved).min(self.time(self.next))
    }
}

#[cfg(test)]
mod tests;
