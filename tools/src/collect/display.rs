//! Display of `collect`: a page on a terminal, else lines.

use super::cycle::{Cycle, Phase};
use super::rig::Rig;
use crate::out;
use crate::printable;
use crate::screen::{Key, Screen};
use crate::signals::Stop;
use anyhow::Result;
use core::time::Duration;
use depthrig_bus::HostTime;

/// Widest bar, characters.
const BAR: usize = 60;
const KEYS: &str =
    "right arrow, n, space: next    left arrow, r: again    s: success    f: failure    Esc, q: end";

/// Where a session is shown, and where its keys come from.
pub enum Display {
    /// A terminal.
    Page(Screen),
    /// Lines on the standard error output, each when it changes.
    Lines {
        /// The last state and troubles.
        last: (String, Vec<String>),
    },
}

/// How a session stands.
pub struct View<'a> {
    /// Its cycle.
    pub cycle: &'a Cycle,
    /// Its recording.
    pub rig: &'a Rig,
    /// Troubles that need attention.
    pub troubles: &'a [String],
    /// Events that are reported once.
    pub notes: &'a [String],
}

impl Display {
    /// The terminal, if there is one.
    ///
    /// # Errors
    /// When the terminal cannot be set up.
    pub fn open() -> Result<Self> {
        let lines = Self::Lines { last: (String::new(), Vec::new()) };
        Ok(Screen::of_either_output()?.map_or(lines, Self::Page))
    }

    /// Whether there is a keyboard.
    pub fn has_keys(&self) -> bool {
        matches!(self, Self::Page(screen) if screen.has_keys())
    }

    /// Waits up to `length` for a key, or until the end is asked for.
    pub fn key(&self, length: Duration, stop: &Stop) -> Option<Key> {
        match self {
            Self::Page(screen) => screen.key(length),
            Self::Lines { .. } => {
                stop.wait(length);
                None
            }
        }
    }

    /// Sounds the terminal's bell.
    ///
    /// # Errors
    /// When the terminal is gone.
    pub fn bell(&self) -> Result<()> {
        match self {
            Self::Page(screen) => screen.put("\x07"),
            Self::Lines { .. } => Ok(()),
        }
    }

    /// Shows how the session stands.
    ///
    /// # Errors
    /// When the terminal is gone.
    pub fn show(&mut self, view: &View<'_>) -> Result<()> {
        match self {
            Self::Page(screen) => screen.draw(&view.page(screen.size().0, screen.has_keys())),
            Self::Lines { last } => {
                let (state, troubles) = last;
                let now = view.line();
                if *state != now {
                    out::note(&now);
                    *state = now;
                }
                for trouble in view.troubles.iter().filter(|t| !troubles.contains(t)) {
                    out::note(trouble);
                }
                *troubles = view.troubles.to_vec();
                Ok(())
            }
        }
    }
}

impl View<'_> {
    fn page(&self, width: usize, has_keys: bool) -> String {
        let plan = self.cycle.plan();
        let next = (self.cycle.kept() + 1).min(plan.episodes);
        let (title, length_ns, until) = match self.cycle.phase() {
            Phase::Reset { until, .. } => ("RESET: put the scene back", plan.reset_ns, Some(until)),
            Phase::Episode { until, .. } => ("EPISODE", plan.length_ns, Some(until)),
            Phase::Beginning => ("EPISODE", plan.length_ns, None),
            Phase::Done => ("DONE", 0, None),
        };
        let rest = until.map_or(Duration::ZERO, HostTime::from_now);
        let mark = match self.cycle.phase() {
            Phase::Episode { outcome: Some(outcome), .. } => format!(", {}", outcome.name()),
            _ => String::new(),
        };
        let mut lines = vec![
            format!("{next} of {}: {}", out::count(plan.episodes, "episode"), self.task()),
            String::new(),
            format!("{title}{mark}, {:.0} s left", rest.as_secs_f64().ceil()),
            bar(rest, length_ns, width),
            String::new(),
            format!("{} kept, {} discarded", self.cycle.kept(), self.rig.discarded()),
        ];
        lines.extend(self.rig.last().filter(|e| !e.is_open()).map(|e| format!("last: episode {}", e.text())));
        lines.push(format!("recording {}", self.rig.path()));
        lines.extend(self.troubles.iter().flat_map(|trouble| out::item("!", trouble, width)));
        lines.extend(self.notes.iter().flat_map(|note| out::item("-", note, width)));
        lines.push(String::new());
        lines.push(if has_keys { KEYS } else { "no keyboard; Ctrl-C ends" }.to_owned());
        lines.iter().map(|line| printable::line(line)).collect::<Vec<_>>().join("\n")
    }

    /// The state in one line, which changes when something has happened.
    fn line(&self) -> String {
        let last = self.rig.last();
        match self.cycle.phase() {
            Phase::Reset { .. } | Phase::Done => match last.filter(|e| !e.is_open()) {
                Some(episode) => format!("episode {}", printable::line(&episode.text())),
                None => format!("recording {}", self.rig.path()),
            },
            Phase::Beginning | Phase::Episode { .. } => {
                let number = last.map_or(0, |e| e.number);
                let plan = self.cycle.plan();
                format!("episode {number} begins: {} of {}", self.cycle.kept() + 1, plan.episodes)
            }
        }
    }

    fn task(&self) -> String {
        let task = self.rig.task();
        if task.is_empty() { "no task".to_owned() } else { task.to_owned() }
    }
}

/// A bar that fills while time passes.
fn bar(rest: Duration, length_ns: i64, width: usize) -> String {
    let room = width.saturating_sub(2).min(BAR);
    let left = (rest.as_nanos() as f64 / length_ns.max(1) as f64).clamp(0.0, 1.0);
    let full = ((1.0 - left) * room as f64) as usize;
    format!("[{}{}]", "=".repeat(full), " ".repeat(room - full))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bar_is_full_at_the_end() {
        assert_eq!(bar(Duration::from_secs(4), 4_000_000_000, 10), "[        ]");
        assert_eq!(bar(Duration::from_secs(1), 4_000_000_000, 10), "[======  ]");
        assert_eq!(bar(Duration::ZERO, 4_000_000_000, 10), "[========]");
        assert_eq!(bar(Duration::ZERO, 0, 1), "[]");
        assert_eq!(bar(Duration::ZERO, 1, 500).len(), 62);
    }
}
