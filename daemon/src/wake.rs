//! A bell between threads: ringing it many times wakes the sleeper once.

use core::time::Duration;
use crossbeam::channel::{Receiver, Sender, bounded};

/// A bell; `raise` never blocks.
#[derive(Debug)]
pub struct Wake {
    ring: Sender<()>,
    heard: Receiver<()>,
}

impl Default for Wake {
    fn default() -> Self {
        let (ring, heard) = bounded(1);
        Self { ring, heard }
    }
}

impl Wake {
    /// Wakes the sleeper, now or when it next lies down.
    pub fn raise(&self) {
        // A full queue means that it was rung already and nothing is lost.
        let _ = self.ring.try_send(());
    }

    /// Sleeps until the bell rings or `timeout` has passed.
    pub fn wait(&self, timeout: Duration) {
        let _ = self.heard.recv_timeout(timeout);
    }
}
