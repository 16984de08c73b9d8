//! The disk guard: free space and stalls, checked each second by a thread that no write can block.

use super::{Shared, drops};
use crate::{Diagnostic, Error, ErrorKind, Level};
use crossbeam::channel::{Receiver, RecvTimeoutError};
use depthrig_bus::HostTime;
use serde::Serialize;
use std::collections::VecDeque;
use std::sync::atomic::Ordering;
use std::time::Duration;

/// Levels of a warning, once each: minutes that the disk lasts at the present rate.
const LEVELS_MIN: [f64; 5] = [30.0, 10.0, 5.0, 2.0, 1.0];
/// The present rate is measured over this time.
const WINDOW_NS: i64 = 10_000_000_000;
/// A rate measured over less than this does not trigger a warning.
const KNOWN_NS: i64 = 3_000_000_000;
/// A write that takes this long is reported.
const STALL_S: f64 = 2.0;

/// State of the disk.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
#[non_exhaustive]
pub struct DiskStatus {
    /// Bytes that may still be written, the reserve included.
    pub free_bytes: u64,
    /// Bytes written and waiting to be written, per second, over the last ten.
    pub bytes_per_s: f64,
    /// How long the space above the reserve lasts at that rate, seconds; `None` before there is a rate.
    pub seconds_left: Option<f64>,
    /// How long the disk has not answered, seconds; 0 when it does.
    pub stalled_s: f64,
    /// A warning for the operator.
    pub warning: Option<String>,
}

impl DiskStatus {
    /// The same for `/diagnostics`.
    pub(super) fn diagnostic(&self, rig: &str) -> Diagnostic {
        Diagnostic {
            level: if self.warning.is_some() { Level::Warn } else { Level::Ok },
            name: format!("{rig}/disk"),
            message: self.warning.clone().unwrap_or_else(|| "room enough".to_owned()),
            hardware_id: String::new(),
            values: vec![
                ("free_bytes".to_owned(), self.free_bytes.to_string()),
                ("bytes_per_s".to_owned(), format!("{:.0}", self.bytes_per_s)),
                ("seconds_left".to_owned(), self.seconds_left.map_or(String::new(), |s| format!("{s:.0}"))),
                ("stalled_s".to_owned(), format!("{:.1}", self.stalled_s)),
            ],
        }
    }
}

/// State kept between checks.
#[derive(Debug, Default)]
struct Watch {
    /// Bytes produced, by time.
    window: VecDeque<(HostTime, u64)>,
    /// Levels already warned about.
    warned: usize,
}

impl Watch {
    /// The rate, the seconds left, and a warning when a level was passed just now.
    fn look(&mut self, now: HostTime, bytes: u64, usable: u64) -> (f64, Option<f64>, Option<String>) {
        self.window.push_back((now, bytes));
        while self.window.len() > 2 && self.window.get(1).is_some_and(|(t, _)| now.since_ns(*t) >= WINDOW_NS)
        {
            self.window.pop_front();
        }
        let (since, before) = self.window.front().copied().unwrap_or((now, bytes));
        let passed_ns = now.since_ns(since);
        let rate = bytes.saturating_sub(before) as f64 / (passed_ns.max(1) as f64 * 1e-9);
        if passed_ns <= 0 || rate <= 0.0 {
            return (0.0, None, None);
        }
        let left = usable as f64 / rate;
        if passed_ns < KNOWN_NS {
            return (rate, Some(left), None);
        }
        let passed = LEVELS_MIN.iter().filter(|m| left < *m * 60.0).count();
        // A second warning needs clearly more room in between.
        let back = LEVELS_MIN.iter().filter(|m| left < *m * 72.0).count();
        let warning = (passed > self.warned).then(|| {
            let free = usable / 1_000_000;
            let minutes = if left < 60.0 {
                "less than a minute".to_owned()
            } else {
                format!("{:.0} minutes", left / 60.0)
            };
            format!("the disk lasts {minutes} more: {free} MB above the reserve at {:.1} MB/s", rate * 1e-6)
        });
        self.warned = self.warned.max(passed).min(back);
        (rate, Some(left), warning)
    }
}

/// The thread. It ends when the sender of `stop` is gone.
pub(super) fn run(shared: &Shared, stop: &Receiver<()>) {
    let mut watch = Watch::default();
    let mut stalled = false;
    let mut hurried = Hurried::default();
    let every = shared.options.sync_interval_ns.clamp(1_000_000, 1_000_000_000);
    while stop.recv_timeout(Duration::from_nanos(every as u64)) == Err(RecvTimeoutError::Timeout) {
        let now = HostTime::now();
        let waits = [&shared.io_since_ns, &shared.sync_since_ns].map(|ns| ns.load(Ordering::Relaxed));
        let since = waits.into_iter().filter(|ns| *ns > 0).min().unwrap_or(0);
        let stalled_s = if since > 0 { now.since_ns(HostTime::from_ns(since)) as f64 * 1e-9 } else { 0.0 };
        let backlog = shared.load.backlog_bytes.load(Ordering::Relaxed);
        let stalls = stalled_s >= STALL_S;
        if stalls != stalled {
            stalled = stalls;
            let dataset = shared.dir.display();
            if stalls {
                let mb = backlog / 1_000_000;
                tracing::warn!(%dataset, "the disk has not answered for {stalled_s:.0} s, {mb} MB wait; the live feed goes on");
            } else {
                tracing::info!(%dataset, "the disk answers again");
            }
        }
        // In the status even if the query for free space never returns.
        {
            let mut state = shared.lock();
            state.disk.stalled_s = if stalls { stalled_s } else { 0.0 };
            state.disk.warning = stalls.then(|| format!("the disk has not answered for {stalled_s:.0} s"));
        }
        if let Some(frames) = hurried.look(shared.load.hurried.load(Ordering::Relaxed), now) {
            let dataset = shared.dir.display();
            tracing::warn!(
                %dataset,
                frames,
                "the encoders are behind: {frames} frames were stored unpacked, which takes several times the space"
            );
        }
        let counts = shared.lock().drops.due(now);
        for drops::Counted { reason, sets } in counts {
            let dataset = shared.dir.display();
            let reason = reason.name();
            tracing::error!(%dataset, reason, sets, "{sets} more sets were not recorded since the last line about this");
        }
        look(shared, &mut watch, backlog);
    }
}

/// Frames that were encoded with the least effort, as far as the log has them.
#[derive(Default)]
struct Hurried {
    logged: u64,
    at: Option<HostTime>,
}

impl Hurried {
    /// Frames since the last line; at once for the first ones, then once a minute.
    fn look(&mut self, frames: u64, now: HostTime) -> Option<u64> {
        const EVERY_NS: i64 = 60_000_000_000;
        let more = frames - self.logged;
        if more == 0 || self.at.is_some_and(|at| now.since_ns(at) < EVERY_NS) {
            return None;
        }
        self.logged = frames;
        self.at = Some(now);
        Some(more)
    }
}

fn look(shared: &Shared, watch: &mut Watch, backlog: u64) {
    let least = shared.options.min_free_bytes;
    let dir = shared.dir.display();
    let free = match shared.fs.available_space(&shared.dir) {
        Ok(free) => free,
        // The file can still be written, but never get its final name: end now rather than record an hour in vain.
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
            let what =
                format!("the folder {dir} was removed while it was recorded into; what was in it is lost");
            return end(shared, Error::new(ErrorKind::NotFound, what));
        }
        Err(e) => {
            shared.lock().disk.warning = Some(format!("the free space of {dir} is not known: {e}"));
            return;
        }
    };
    let mut state = shared.lock();
    let (rate, left, warning) =
        watch.look(HostTime::now(), state.bytes + backlog, free.saturating_sub(least));
    state.disk.free_bytes = free;
    state.disk.bytes_per_s = rate;
    state.disk.seconds_left = left;
    if let Some(left) = left.filter(|_| watch.warned > 0 && state.disk.warning.is_none()) {
        state.disk.warning = Some(format!("the disk lasts {:.1} more minutes", left / 60.0));
    }
    drop(state);
    if let Some(warning) = warning {
        tracing::warn!(dataset = %dir, "{warning}");
    }
    if free < least {
        let what = format!(
            "the recording {dir} was ended with {} MB left on the disk (the limit is {} MB); the sets recorded \
             so far are complete; free some space and start a new one",
            free / 1_000_000,
            least / 1_000_000
        );
        end(shared, Error::new(ErrorKind::DiskFull, what));
    }
}

/// Asks the writer to end the recording; only the first reason counts.
fn end(shared: &Shared, why: Error) {
    let mut state = shared.lock();
    if state.ended.is_none() {
        state.end_because.get_or_insert(why);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A recording of 1 MB/s on a disk with room for 32 minutes warns at each level, once, and again only after
    /// there was clearly more room in between.
    #[test]
    fn each_level_is_warned_of_once() {
        let mut watch = Watch::default();
        let mut warned = Vec::new();
        let mut free: u64 = 32 * 60 * 1_000_000;
        for s in 0..32 * 60_u64 {
            let (_, left, warning) =
                watch.look(HostTime::from_ns(s as i64 * 1_000_000_000), s * 1_000_000, free);
            if let (Some(_), Some(left)) = (warning, left) {
                warned.push((left / 60.0).round());
            }
            free -= 1_000_000;
        }
        assert_eq!(warned, [30.0, 10.0, 5.0, 2.0, 1.0]);
        let at = |s: u64| HostTime::from_ns(s as i64 * 1_000_000_000);
        let mut look = |s: u64, free: u64| watch.look(at(s), s * 1_000_000, free).2.is_some();
        assert!(!look(1920, 61_000_000), "hardly more room is no news");
        assert!(!look(1921, 59_000_000));
        assert!(!look(1922, 600_000_000 * 13 / 10), "there is room again");
        assert!(look(1923, 59_000_000));
    }

    #[test]
    fn the_rate_is_the_present_one_and_unknown_at_first() {
        let mut watch = Watch::default();
        let at = |s: i64| HostTime::from_ns(s * 1_000_000_000);
        assert_eq!(watch.look(at(0), 0, 1000), (0.0, None, None));
        for s in 1..100 {
            watch.look(at(s), s as u64 * 10, u64::MAX);
        }
        let (rate, left, _) = watch.look(at(100), 1000, 5000);
        assert_eq!((rate, left), (10.0, Some(500.0)));
        for s in 101..120 {
            watch.look(at(s), 1000, 5000);
        }
        assert_eq!(watch.look(at(120), 1000, 5000), (0.0, None, None), "nothing is written any more");
    }
}
