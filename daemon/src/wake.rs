//! A bell between threads: ringing it many times wakes the sleeper once.
//!
//! A mutex and not a lock-free queue, because camera threads ring it at real-time priority: one that met a queue
//! operation of a preempted ordinary thread would spin until the kernel's real-time throttling ended it, which costs
//! a second of frames. On a mutex it sleeps, and the other thread runs.

use core::time::Duration;
use std::sync::{Arc, Condvar, Mutex, PoisonError};

/// A bell.
#[derive(Debug, Default)]
pub struct Wake {
    rung: Mutex<bool>,
    bell: Condvar,
    next: Option<Arc<Wake>>,
}

impl Wake {
    /// A bell that rings `next` as well.
    pub fn with(next: Arc<Self>) -> Self {
        Self { next: Some(next), ..Self::default() }
    }

    /// Wakes the sleeper, now or when it next lies down.
    pub fn raise(&self) {
        *self.rung.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.bell.notify_one();
        if let Some(next) = &self.next {
            next.raise();
        }
    }

    /// Sleeps until the bell rings or `timeout` has passed.
    pub fn wait(&self, timeout: Duration) {
        let rung = self.rung.lock().unwrap_or_else(PoisonError::into_inner);
        let (mut rung, _) = self
            .bell
            .wait_timeout_while(rung, timeout, |rung| !*rung)
            .unwrap_or_else(PoisonError::into_inner);
        *rung = false;
    }
}
