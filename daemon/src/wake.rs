//! A wake-up signal between threads: raised many times, it wakes the waiter once.
//!
//! A mutex and not a lock-free queue, because camera threads raise it at real-time priority: one that met a queue
//! operation of a preempted ordinary thread would spin until the kernel's real-time throttling ended it, which costs
//! a second of frames. On a mutex it sleeps, and the other thread runs.

use core::time::Duration;
use depthrig_bus::sync::lock;
use std::sync::{Arc, Condvar, Mutex, PoisonError};

/// A wake-up signal.
#[derive(Debug, Default)]
pub struct Wake {
    raised: Mutex<bool>,
    condvar: Condvar,
    next: Option<Arc<Wake>>,
}

impl Wake {
    /// A signal that raises `next` as well.
    pub fn with(next: Arc<Self>) -> Self {
        Self { next: Some(next), ..Self::default() }
    }

    /// Wakes the waiter; without one, the next `wait` returns at once.
    pub fn raise(&self) {
        *lock(&self.raised) = true;
        self.condvar.notify_one();
        if let Some(next) = &self.next {
            next.raise();
        }
    }

    /// Waits until the signal is raised or `timeout` has passed.
    pub fn wait(&self, timeout: Duration) {
        let raised = lock(&self.raised);
        let (mut raised, _) = self
            .condvar
            .wait_timeout_while(raised, timeout, |raised| !*raised)
            .unwrap_or_else(PoisonError::into_inner);
        *raised = false;
    }
}
