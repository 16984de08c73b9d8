//! Exit codes, the printing of errors, and the end of the process.
#![allow(unsafe_code)] // `_exit`, which the standard library does not have

use crate::printable;
use core::fmt;

/// How a command ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Exit {
    /// Everything as asked: 0.
    Good,
    /// It did not work: 1. A dataset, recording or calibration that is missing, unreadable, empty,
    /// damaged or not one fails.
    Failed,
    /// Wrong usage or configuration: 2. Readable inputs that do not fit the request are wrong usage.
    Usage,
    /// It worked, but something was lost on the way: 3.
    Lost,
}

impl Exit {
    /// The number that the shell sees.
    pub const fn code(self) -> u8 {
        match self {
            Self::Good => 0,
            Self::Failed => 1,
            Self::Usage => 2,
            Self::Lost => 3,
        }
    }
}

/// Flushes stdout and ends the process with the code of `exit`.
///
/// Skips the exit handlers of libraries: a hung refiner is left behind in its thread, and ONNX Runtime under it must
/// not be destroyed while it runs.
pub fn leave(exit: Exit) -> ! {
    // A closed pipe has no reader.
    let _ = std::io::Write::flush(&mut std::io::stdout());
    // SAFETY: `_exit` takes any number and does not return; what must not be left undone was dropped before.
    unsafe { libc::_exit(exit.code().into()) }
}

/// A usage error: exit code 2.
#[derive(Debug)]
pub struct UsageError(pub String);

impl fmt::Display for UsageError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for UsageError {}

/// Prints `error` to stderr, and returns its exit code.
pub fn report(error: &anyhow::Error) -> Exit {
    if is_broken_pipe(error) {
        return Exit::Good; // `depthrig tap … | head` has seen enough
    }
    let mut out = std::io::stderr().lock();
    // If stderr is closed too, only the exit code remains.
    let _ = std::io::Write::write_all(&mut out, printable::lines(&text(error)).as_bytes());
    of(error)
}

/// Exit code of `error`: 2 if the user has to change the command or a file, else 1.
fn of(error: &anyhow::Error) -> Exit {
    let usage = error.chain().any(|cause| {
        cause.is::<UsageError>()
            || cause
                .downcast_ref::<depthrig_daemon::Error>()
                .is_some_and(|e| e.kind() == depthrig_daemon::ErrorKind::BadInput)
            || cause
                .downcast_ref::<depthrig_bus::Error>()
                .is_some_and(|e| e.kind() == depthrig_bus::ErrorKind::BadName)
    });
    if usage { Exit::Usage } else { Exit::Failed }
}

/// The error in one line, then each cause that adds something.
fn text(error: &anyhow::Error) -> String {
    let mut message = format!("depthrig: error: {error}");
    for cause in error.chain().skip(1).map(ToString::to_string) {
        // Errors of TOML end with a line break, which a message that quotes them leaves out.
        let cause = cause.trim_end();
        if !message.contains(cause) {
            message.push_str("\n  cause: ");
            message.push_str(cause);
        }
    }
    message.push('\n');
    message
}

fn is_broken_pipe(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| {
        cause.downcast_ref::<std::io::Error>().is_some_and(|e| e.kind() == std::io::ErrorKind::BrokenPipe)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use anyhow::Context as _;

    #[test]
    fn causes_are_told_once() {
        let inner = std::io::Error::other("the disk is on fire");
        let error =
            anyhow::Error::new(inner).context("d435 was lost: the disk is on fire").context("no luck");
        assert_eq!(text(&error), "depthrig: error: no luck\n  cause: d435 was lost: the disk is on fire\n");
    }

    #[test]
    fn a_cause_that_ends_with_a_line_break_is_printed_once() {
        let inner = std::io::Error::other("TOML parse error at line 2\n  expected a value\n");
        let outer = "camera.toml: TOML parse error at line 2\n  expected a value";
        let message = text(&anyhow::Error::new(inner).context(outer));
        assert_eq!(message, format!("depthrig: error: {outer}\n"));
    }

    #[test]
    fn bad_input_is_2_and_the_rest_is_1() {
        use depthrig_daemon::{Error, ErrorKind};
        let bad = || anyhow::Error::new(Error::new(ErrorKind::BadInput, "line 3"));
        assert_eq!(of(&bad()), Exit::Usage);
        assert_eq!(of(&Err::<(), _>(bad()).context("rig.toml").unwrap_err()), Exit::Usage);
        assert_eq!(of(&anyhow::Error::new(Error::new(ErrorKind::NoSpace, "full"))), Exit::Failed);
        assert_eq!(of(&anyhow::Error::new(UsageError("no".into()))), Exit::Usage);
        assert_eq!([Exit::Good, Exit::Failed, Exit::Usage, Exit::Lost].map(Exit::code), [0, 1, 2, 3]);
    }
}
