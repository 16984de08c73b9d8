//! The terminal as `top` and `calibrate capture` use it: a page that is redrawn in place, and keys without Enter.

use anyhow::{Context, Result};
use core::time::Duration;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::termios::{self, LocalModes, OptionalActions, Termios};
use std::io::{IsTerminal, Read, Stdout, Write};

/// Columns and rows of a terminal that does not say.
pub const USUAL: (usize, usize) = (80, 24);
const ENTER: &str = "\x1b[?1049h\x1b[?25l";
const LEAVE: &str = "\x1b[?25h\x1b[?1049l";
const HOME: &str = "\x1b[H";
const CLEAR_LINE: &str = "\x1b[K";
const CLEAR_BELOW: &str = "\x1b[J";

/// The page. Dropping it gives the terminal back as it was.
pub struct Screen {
    out: Stdout,
    before: Option<Termios>,
}

impl Screen {
    /// Takes the terminal.
    ///
    /// # Errors
    /// When the output is not a terminal.
    pub fn enter() -> Result<Self> {
        let out = std::io::stdout();
        if !out.is_terminal() {
            return Err(crate::exit::UsageError(
                "top needs a terminal; use `depthrig status --watch` to follow a rig in a file or pipe"
                    .into(),
            )
            .into());
        }
        // Keys come at once and unseen; Ctrl-C still is a signal. Without a keyboard there are no keys.
        let before = termios::tcgetattr(std::io::stdin()).ok();
        if let Some(before) = &before {
            let mut raw = before.clone();
            raw.local_modes.remove(LocalModes::ICANON | LocalModes::ECHO);
            termios::tcsetattr(std::io::stdin(), OptionalActions::Now, &raw)
                .context("the terminal cannot be set up")?;
        }
        let screen = Self { out, before };
        screen.write(ENTER)?;
        Ok(screen)
    }

    /// Draws `text` from the top; what does not fit is left out.
    ///
    /// # Errors
    /// When the terminal is gone.
    pub fn draw(&self, text: &str) -> Result<()> {
        let (width, height) = size().unwrap_or(USUAL);
        let mut page = HOME.to_owned();
        let text = crate::printable::styled(text);
        for (i, line) in text.lines().take(height).enumerate() {
            page.push_str(if i == 0 { "" } else { "\r\n" });
            page.push_str(&crate::view::clip(line, width));
            page.push_str(CLEAR_LINE);
        }
        page.push_str(CLEAR_BELOW);
        self.write(&page)
    }

    fn write(&self, text: &str) -> Result<()> {
        let mut out = self.out.lock();
        out.write_all(text.as_bytes())?;
        out.flush()?;
        Ok(())
    }

    /// Waits up to `length` for a key.
    pub fn key(&self, length: Duration) -> Option<u8> {
        let stdin = std::io::stdin();
        let timeout = Timespec { tv_sec: length.as_secs() as i64, tv_nsec: i64::from(length.subsec_nanos()) };
        let mut fds = [PollFd::new(&stdin, PollFlags::IN)];
        // A signal interrupts the wait; the caller looks for it.
        let ready = self.before.is_some() && poll(&mut fds, Some(&timeout)).is_ok_and(|n| n > 0);
        if !ready {
            if self.before.is_none() {
                std::thread::sleep(length);
            }
            return None;
        }
        let mut key = [0];
        (stdin.lock().read(&mut key).ok()? == 1).then_some(key[0])
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        // A terminal that is gone needs no restoring.
        let _ = self.write(LEAVE);
        if let Some(before) = &self.before {
            let _ = termios::tcsetattr(std::io::stdin(), OptionalActions::Now, before);
        }
    }
}

/// Columns and rows of the terminal behind the standard output, if it is one.
pub fn size() -> Option<(usize, usize)> {
    let size = termios::tcgetwinsize(std::io::stdout()).ok()?;
    (size.ws_col > 0 && size.ws_row > 0).then(|| (size.ws_col.into(), size.ws_row.into()))
}
