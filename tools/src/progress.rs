//! How long work shows that it goes on: a bar on a terminal, plain lines otherwise, both on stderr.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::IsTerminal;

/// Work with a known end.
#[derive(Debug)]
pub struct Progress {
    bar: Option<ProgressBar>,
    what: String,
    /// The last tenth that was told as a plain line.
    told: Option<u64>,
    quiet: bool,
}

impl Progress {
    /// Nothing shown yet. `quiet` keeps it so.
    pub fn new(quiet: bool) -> Self {
        Self { bar: None, what: String::new(), told: None, quiet }
    }

    /// Shows that `done` of `total` parts of `what` are done; another `what` begins another bar.
    pub fn set(&mut self, what: &str, done: u64, total: u64) {
        if self.quiet {
            return;
        }
        if self.what != what {
            self.clear();
            what.clone_into(&mut self.what);
            self.told = None;
            self.bar = std::io::stderr().is_terminal().then(|| bar(total));
        }
        match &self.bar {
            Some(bar) => {
                bar.set_length(total);
                bar.set_position(done);
                bar.set_message(what.to_owned());
            }
            None => self.tell(done, total),
        }
    }

    /// A plain line for each tenth, not for each part.
    fn tell(&mut self, done: u64, total: u64) {
        let tenth = (done * 10).checked_div(total).unwrap_or(10);
        if self.told.is_none_or(|told| tenth > told) {
            eprintln!("{}: {} %", self.what, tenth * 10);
            self.told = Some(tenth);
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
