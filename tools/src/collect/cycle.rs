//! The cycle of `collect`: a pause to put the scene back, an episode, the next pause, until there are enough episodes.
//!
//! It knows neither terminal nor rig: [`Cycle::step`] takes a key or the time and returns what is to be done, in this order.

#[cfg(test)]
mod tests;

use depthrig_bus::HostTime;
use depthrig_recorder::EpisodeOutcome;

/// Request of a person.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Key {
    /// Ends the episode or the pause now.
    Next,
    /// Discards the episode that runs, or in the pause the last one, which is then done again.
    Again,
    /// Judges the episode that runs, or in the pause the last one.
    Judge(EpisodeOutcome),
    /// Ends the session; the episode that runs is discarded.
    Stop,
}

/// Something that happens to the cycle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Input {
    /// Time passes.
    Tick,
    /// A key was pressed.
    Key(Key),
    /// The episode that [`Action::Begin`] asked for has begun.
    Begun,
    /// The episode that runs was ended by somebody else, such as on the live page.
    EndedElsewhere {
        /// And is not to be used.
        is_discarded: bool,
    },
}

/// Something to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Action {
    /// Begin an episode, then give [`Input::Begun`].
    Begin,
    /// End the episode that runs, and keep it.
    Keep(Option<EpisodeOutcome>),
    /// Discard the episode that runs.
    Discard,
    /// Discard the last episode, which was kept.
    DiscardLast,
    /// Judge the last episode, which was kept.
    JudgeLast(EpisodeOutcome),
    /// Sound the bell.
    Bell,
    /// End the session.
    Finish,
}

/// Where the cycle is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// The scene is put back.
    Reset {
        /// The next episode begins then.
        until: HostTime,
        /// The episode before was kept, and can still be judged or discarded.
        has_last: bool,
    },
    /// An episode was asked for and has not begun yet.
    Beginning,
    /// An episode runs.
    Episode {
        /// It ends then.
        until: HostTime,
        /// Its judgement so far.
        outcome: Option<EpisodeOutcome>,
    },
    /// The session has ended.
    Done,
}

/// Lengths and number of the episodes.
#[derive(Debug, Clone, Copy)]
pub struct Plan {
    /// Episodes to keep.
    pub episodes: u32,
    /// Length of each, nanoseconds.
    pub length_ns: i64,
    /// Length of the pause before each, nanoseconds.
    pub reset_ns: i64,
}

/// The cycle. An episode that is discarded does not count.
#[derive(Debug, Clone)]
pub struct Cycle {
    plan: Plan,
    kept: u32,
    phase: Phase,
}

impl Cycle {
    /// Begins with a pause.
    pub const fn new(plan: Plan, now: HostTime) -> Self {
        let phase = Phase::Reset { until: now.plus_ns(plan.reset_ns), has_last: false };
        Self { plan, kept: 0, phase }
    }

    /// Lengths and number of the episodes.
    pub const fn plan(&self) -> Plan {
        self.plan
    }

    /// Episodes that were kept so far.
    pub const fn kept(&self) -> u32 {
        self.kept
    }

    /// Where it is.
    pub const fn phase(&self) -> Phase {
        self.phase
    }

    /// When time alone changes something.
    pub const fn due(&self) -> Option<HostTime> {
        match self.phase {
            Phase::Reset { until, .. } | Phase::Episode { until, .. } => Some(until),
            Phase::Beginning | Phase::Done => None,
        }
    }

    /// Takes what happened at `now` and returns what is to be done.
    pub fn step(&mut self, now: HostTime, input: Input) -> Vec<Action> {
        match (self.phase, input) {
            (Phase::Done, _) => Vec::new(),
            (phase, Input::Key(Key::Stop)) => {
                self.phase = Phase::Done;
                let is_running = matches!(phase, Phase::Episode { .. } | Phase::Beginning);
                is_running.then_some(Action::Discard).into_iter().chain([Action::Finish]).collect()
            }
            (Phase::Reset { until, has_last }, input) => self.step_reset(now, input, until, has_last),
            (Phase::Beginning, Input::Begun) => {
                self.phase = Phase::Episode { until: now.plus_ns(self.plan.length_ns), outcome: None };
                Vec::new()
            }
            (Phase::Beginning, _) => Vec::new(),
            (Phase::Episode { until, outcome }, input) => self.step_episode(now, input, until, outcome),
        }
    }

    fn step_reset(&mut self, now: HostTime, input: Input, until: HostTime, has_last: bool) -> Vec<Action> {
        match input {
            Input::Tick if now < until => Vec::new(),
            Input::Tick | Input::Key(Key::Next) => {
                self.phase = Phase::Beginning;
                vec![Action::Begin, Action::Bell]
            }
            Input::Key(Key::Again) if has_last => {
                self.kept -= 1;
                self.phase = Phase::Reset { until, has_last: false };
                vec![Action::DiscardLast]
            }
            Input::Key(Key::Judge(outcome)) if has_last => vec![Action::JudgeLast(outcome)],
            Input::Key(_) | Input::Begun | Input::EndedElsewhere { .. } => Vec::new(),
        }
    }

    fn step_episode(
        &mut self,
        now: HostTime,
        input: Input,
        until: HostTime,
        outcome: Option<EpisodeOutcome>,
    ) -> Vec<Action> {
        match input {
            Input::Tick if now < until => Vec::new(),
            Input::Tick | Input::Key(Key::Next) => self.end(now, Some(Action::Keep(outcome)), true),
            Input::Key(Key::Again) => self.end(now, Some(Action::Discard), false),
            Input::EndedElsewhere { is_discarded } => self.end(now, None, !is_discarded),
            Input::Key(Key::Judge(outcome)) => {
                self.phase = Phase::Episode { until, outcome: Some(outcome) };
                Vec::new()
            }
            Input::Key(Key::Stop) | Input::Begun => Vec::new(),
        }
    }

    fn end(&mut self, now: HostTime, action: Option<Action>, is_kept: bool) -> Vec<Action> {
        self.kept += u32::from(is_kept);
        let is_last = self.kept >= self.plan.episodes;
        self.phase = if is_last {
            Phase::Done
        } else {
            Phase::Reset { until: now.plus_ns(self.plan.reset_ns), has_last: is_kept }
        };
        let after = [Action::Bell].into_iter().chain(is_last.then_some(Action::Finish));
        action.into_iter().chain(after).collect()
    }
}
