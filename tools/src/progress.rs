//! Progress of long work: a bar on a terminal, plain lines otherwise, both on stderr.

use core::time::Duration;
use depthrig_bus::HostTime;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::IsTerminal;

/// Time between plain lines.
const PLAIN_INTERVAL: Duration = Duration::from_secs(5);

/// Work with a known end.
#[derive(Debug)]
pub struct Progress {
    bar: Option<ProgressBar>,
    what: String,
    /// When the last plain line was written.
    printed_at: Option<HostTime>,
    quiet: bool,
}

impl Progress {
    /// Nothing shown yet. `quiet` keeps it so.
    pub fn new(quiet: bool) -> Self {
        Self { bar: None, what: String::new(), printed_at: None, quiet }
    }

    /// Shows that `done` of `total` parts of `what` are done; another `what` begins another bar.
    pub fn set(&mut self, what: &str, done: u64, total: u64) {
        if self.quiet {
            return;
        }
        if self.what != what {
            self.clear();
            what.clone_into(&mut self.what);
            self.printed_at = None;
            self.bar = std::io::stderr().is_terminal().then(|| bar(total));
        }
        match &self.bar {
            Some(bar) => {
                bar.set_length(total);
                bar.set_position(done);
                bar.set_message(what.to_owned());
            }
            None => self.print_line(done, total),
        }
    }

    /// A plain line at the start, every few seconds, and at the end.
    fn print_line(&mut self, done: u64, total: u64) {
        if done == total || self.printed_at.is_none_or(|at| at.elapsed() >= PLAIN_INTERVAL) {
            let percent = (done * 100).checked_div(total).unwrap_or(100);
            eprintln!("{}: {percent} %", self.what);
            self.printed_at = Some(HostTime::now());
        }
    }

    /// Takes the bar away.
    pub fn clear(&mut self) {
        if let Some(bar) = self.bar.take() {
            bar.finish_and_clear();
        }
        self.what.clear();
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.clear();
    }
}

fn bar(total: u64) -> ProgressBar {
    let bar = ProgressBar::with_draw_target(Some(total), ProgressDrawTarget::stderr());
    // The template is a constant; the default style stands in for it if indicatif ever changes its language.
    if let Ok(style) = ProgressStyle::with_template("{msg:30} [{bar:30}] {percent:>3} % {eta:>5}") {
        bar.set_style(style.progress_chars("=> "));
    }
    bar
}
