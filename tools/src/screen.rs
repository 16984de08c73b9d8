//! The terminal as `top`, `collect` and `calibrate capture` use it: a page that is redrawn in place, and keys without Enter.

mod keys;

use crate::printable;
use crate::view::clip;
use anyhow::{Context, Result};
use core::cell::Cell;
use core::time::Duration;
use depthrig_bus::HostTime;
pub use keys::Key;
use keys::Keys;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::termios::{self, LocalModes, OptionalActions, Termios};
use std::io::IsTerminal;
use std::os::fd::BorrowedFd;
use std::sync::{Mutex, PoisonError};

/// Columns and rows of a terminal that does not say.
pub const USUAL: (usize, usize) = (80, 24);
const ENTER: &str = "\x1b[?1049h\x1b[?25l";
const LEAVE: &str = "\x1b[0m\x1b[?25h\x1b[?1049l";
const HOME: &str = "\x1b[H";
const CLEAR: &str = "\x1b[2J";
const CLEAR_LINE: &str = "\x1b[K";
const CLEAR_BELOW: &str = "\x1b[J";
/// A terminal that takes no byte for this long is not given back.
const STALLED: Timespec = Timespec { tv_sec: 2, tv_nsec: 0 };

/// Time within which the rest of a sequence follows its ESC, also over a slow connection.
const ESCAPE: Duration = Duration::from_millis(250);

/// State to give back with a terminal that is taken: the settings of its keyboard, and the messages of panics, which
/// would be lost with the page.
static TAKEN: Mutex<Option<Taken>> = Mutex::new(None);

struct Taken {
    output: BorrowedFd<'static>,
    keyboard: Option<Termios>,
    panics: Vec<String>,
}

/// The page. Dropping it gives the terminal back as it was.
pub struct Screen {
    out: BorrowedFd<'static>,
    has_keys: bool,
    keys: Cell<Keys>,
}

impl Screen {
    /// Takes the terminal.
    ///
    /// # Errors
    /// When the output is not a terminal.
    pub fn enter() -> Result<Self> {
        if !std::io::stdout().is_terminal() {
            return Err(crate::exit::UsageError(
                "top needs a terminal; use `depthrig status --watch` to follow a rig in a file or pipe"
                    .into(),
            )
            .into());
        }
        Self::on(rustix::stdio::stdout())
    }

    /// Takes the terminal that the standard output or the standard error output is, if there is one.
    ///
    /// # Errors
    /// When it cannot be set up.
    pub fn of_either_output() -> Result<Option<Self>> {
        let outputs = [rustix::stdio::stdout(), rustix::stdio::stderr()];
        outputs.into_iter().find(IsTerminal::is_terminal).map(Self::on).transpose()
    }

    fn on(out: BorrowedFd<'static>) -> Result<Self> {
        // Keys come at once and unseen; Ctrl-C still is a signal. Without a keyboard there are no keys.
        let keyboard = termios::tcgetattr(std::io::stdin()).ok();
        let has_keys = keyboard.is_some();
        if let Some(before) = &keyboard {
            let mut raw = before.clone();
            raw.local_modes.remove(LocalModes::ICANON | LocalModes::ECHO);
            termios::tcsetattr(std::io::stdin(), OptionalActions::Now, &raw)
                .context("the terminal cannot be set up")?;
        }
        *TAKEN.lock().unwrap_or_else(PoisonError::into_inner) =
            Some(Taken { output: out, keyboard, panics: Vec::new() });
        let screen = Self { out, has_keys, keys: Cell::default() };
        keep_panics();
        screen.put(ENTER)?;
        Ok(screen)
    }

    /// Its columns and rows.
    pub fn size(&self) -> (usize, usize) {
        size_of(self.out).unwrap_or(USUAL)
    }

    /// Draws `text` from the top; what does not fit is left out.
    ///
    /// # Errors
    /// When the terminal is gone.
    pub fn draw(&self, text: &str) -> Result<()> {
        let (width, height) = self.size();
        self.put(&format!("{}{CLEAR_BELOW}", page(text, width, height)))
    }

    /// Draws the first `rows` lines of `text` and leaves what is below as it is.
    ///
    /// # Errors
    /// When the terminal is gone.
    pub fn draw_top(&self, text: &str, rows: usize) -> Result<()> {
        let (width, _) = self.size();
        self.put(&page(text, width, rows))
    }

    /// Clears the page.
    ///
    /// # Errors
    /// When the terminal is gone.
    pub fn clear(&self) -> Result<()> {
        self.put(CLEAR)
    }

    /// Writes bytes of depthrig's own, such as an image, as they are.
    ///
    /// # Errors
    /// When the terminal is gone.
    pub fn put(&self, text: &str) -> Result<()> {
        let mut rest = text.as_bytes();
        while !rest.is_empty() {
            match rustix::io::write(self.out, rest) {
                Ok(n) => rest = rest.get(n..).unwrap_or_default(),
                Err(rustix::io::Errno::INTR) => {}
                Err(e) => return Err(std::io::Error::from(e).into()),
            }
        }
        Ok(())
    }

    /// Sends a question to the terminal and returns the bytes of its answer, until `is_complete` or for `length`.
    ///
    /// # Errors
    /// When the terminal is gone.
    pub fn ask(
        &self,
        question: &str,
        length: Duration,
        is_complete: impl Fn(&[u8]) -> bool,
    ) -> Result<Vec<u8>> {
        let mut answer = Vec::new();
        if !self.has_keys {
            return Ok(answer);
        }
        self.put(question)?;
        let until = HostTime::now().plus(length);
        while !until.from_now().is_zero() && !is_complete(&answer) {
            answer.extend(self.byte(until.from_now()));
        }
        Ok(answer)
    }

    /// Whether there is a keyboard.
    pub const fn has_keys(&self) -> bool {
        self.has_keys
    }

    /// Waits up to `length` for a key, and a moment longer for what follows ESC. Late answers of the terminal are skipped.
    pub fn key(&self, length: Duration) -> Option<Key> {
        let until = HostTime::now().plus(length);
        loop {
            let mut keys = self.keys.get();
            let wait = if keys.is_at_escape() { ESCAPE } else { until.from_now() };
            let byte = self.byte(wait);
            let key = match byte {
                Some(byte) => keys.next(byte),
                None => keys.end_of_escape(),
            };
            self.keys.set(keys);
            if key.is_some() || byte.is_none() {
                return key;
            }
        }
    }

    /// Waits up to `length` for a byte from the terminal.
    fn byte(&self, length: Duration) -> Option<u8> {
        let stdin = std::io::stdin();
        let timeout = Timespec { tv_sec: length.as_secs() as i64, tv_nsec: i64::from(length.subsec_nanos()) };
        let mut fds = [PollFd::new(&stdin, PollFlags::IN)];
        // A signal interrupts the wait; the caller looks for it.
        let ready = self.has_keys && poll(&mut fds, Some(&timeout)).is_ok_and(|n| n > 0);
        if !ready {
            if !self.has_keys {
                std::thread::sleep(length);
            }
            return None;
        }
        // Not through the standard library's buffer, in which `poll` sees nothing.
        let mut byte = [0];
        (rustix::io::read(&stdin, &mut byte).ok()? == 1).then_some(byte[0])
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        restore();
    }
}

/// Gives a terminal back that a [`Screen`] has taken, also where it cannot be dropped: before the process is ended.
pub fn restore() {
    let Some(taken) = TAKEN.lock().unwrap_or_else(PoisonError::into_inner).take() else { return };
    // A terminal that is gone needs no restoring.
    if let Some(keyboard) = &taken.keyboard {
        let _ = termios::tcsetattr(std::io::stdin(), OptionalActions::Now, keyboard);
    }
    // Not for one that takes no bytes any more: it would keep the process from ending.
    let mut fds = [PollFd::new(&taken.output, PollFlags::OUT)];
    if poll(&mut fds, Some(&STALLED)).is_ok_and(|n| n > 0) {
        let _ = rustix::io::write(taken.output, LEAVE.as_bytes());
    }
    for message in taken.panics {
        crate::out::note(message);
    }
}

/// Keeps the messages of panics until the terminal is given back; printed on the page they would vanish with it.
fn keep_panics() {
    let before = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| match TAKEN.try_lock().ok().as_deref_mut() {
        Some(Some(taken)) => taken.panics.push(panic.to_string()),
        _ => before(panic),
    }));
}

/// The first lines of a text, drawn from the top of the terminal.
fn page(text: &str, width: usize, height: usize) -> String {
    let mut page = HOME.to_owned();
    for (i, line) in printable::styled(text).lines().take(height).enumerate() {
        page.push_str(if i == 0 { "" } else { "\r\n" });
        page.push_str(&clip(line, width));
        page.push_str(CLEAR_LINE);
    }
    page
}

/// Columns and rows of the terminal behind the standard output, if it is one.
pub fn size() -> Option<(usize, usize)> {
    size_of(rustix::stdio::stdout())
}

fn size_of(terminal: BorrowedFd<'_>) -> Option<(usize, usize)> {
    let size = termios::tcgetwinsize(terminal).ok()?;
    (size.ws_col > 0 && size.ws_row > 0).then(|| (size.ws_col.into(), size.ws_row.into()))
}

/// Width and height of a character in pixels, if the terminal says.
pub fn cell() -> Option<(usize, usize)> {
    let size = termios::tcgetwinsize(std::io::stdout()).ok()?;
    let width = size.ws_xpixel.checked_div(size.ws_col)?;
    let height = size.ws_ypixel.checked_div(size.ws_row)?;
    (width > 0 && height > 0).then(|| (width.into(), height.into()))
}

#[cfg(test)]
mod tests;
