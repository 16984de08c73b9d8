//! SIGINT and SIGTERM: the first one asks for a clean end, the second one ends at once. SIGXFSZ ends nothing.

use anyhow::{Context, Result};
use core::sync::atomic::{AtomicBool, Ordering};
use core::time::Duration;
use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, bounded};
use std::sync::Arc;
use tokio::signal::unix::{SignalKind, signal};

/// Exit code after the second signal: 128 + SIGINT, as in shells.
const AT_ONCE: i32 = 130;

/// A request to end, from a signal or from within.
#[derive(Debug, Clone)]
pub struct Stop {
    asked: Arc<AtomicBool>,
    /// Nothing is ever sent on it: it is closed when the end is asked for, which wakes every waiter.
    closed: Receiver<()>,
}

impl Stop {
    /// Set when the end is asked for.
    pub fn flag(&self) -> &AtomicBool {
        &self.asked
    }

    /// Takes over SIGINT, SIGTERM and SIGXFSZ for the rest of the process's life.
    ///
    /// # Errors
    /// When the handlers cannot be installed.
    pub fn on_signals() -> Result<Self> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_io()
            .build()
            .context("signals cannot be handled")?;
        let (stop, closer) = Self::new();
        let asked = stop.asked.clone();
        let (installed, is_installed) = bounded(1);
        let listen = async move {
            // A write beyond the limit of a file's size (ulimit -f) is then an error and does not end the process. A handler stays
            // when its stream is dropped.
            let too_large = SignalKind::from_raw(rustix::process::Signal::XFSZ.as_raw());
            let all = || {
                drop(signal(too_large)?);
                Ok((signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?))
            };
            let (mut interrupt, mut terminate) = match all() {
                Ok(both) => both,
                Err(e) => {
                    // The receiver waits for exactly this message.
                    let _ = installed.send(Err::<(), std::io::Error>(e));
                    return;
                }
            };
            let _ = installed.send(Ok(()));
            let mut wakes_waiters = Some(closer);
            loop {
                tokio::select! {
                    _ = interrupt.recv() => {}
                    _ = terminate.recv() => {}
                }
                if asked.swap(true, Ordering::Relaxed) {
                    crate::screen::restore();
                    std::process::exit(AT_ONCE);
                }
                drop(wakes_waiters.take());
                tracing::info!("ending; a second signal ends at once");
            }
        };
        std::thread::Builder::new().name("signals".into()).spawn(move || runtime.block_on(listen))?;
        is_installed.recv()?.context("signals cannot be handled")?;
        Ok(stop)
    }

    fn new() -> (Self, Sender<()>) {
        let (closer, closed) = bounded(1);
        (Self { asked: Arc::default(), closed }, closer)
    }

    /// Whether the end was asked for.
    pub fn is_asked(&self) -> bool {
        self.asked.load(Ordering::Relaxed)
    }

    /// Sleeps for `length`, or until the end is asked for; says whether it was.
    pub fn wait(&self, length: Duration) -> bool {
        matches!(self.closed.recv_timeout(length), Err(RecvTimeoutError::Disconnected)) || self.is_asked()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_closed_channel_wakes_and_an_open_one_times_out() {
        let (stop, closer) = Stop::new();
        assert!(!stop.wait(Duration::from_millis(1)) && !stop.is_asked());
        let waiter = std::thread::spawn({
            let stop = stop.clone();
            move || stop.wait(Duration::from_mins(1))
        });
        drop(closer);
        assert!(waiter.join().unwrap());
    }
}
