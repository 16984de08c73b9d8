//! Locks that a panic of another thread does not take away.
//!
//! A panicking thread is a defect that is logged and ends its camera or command. Whatever a lock guards here is valid after each
//! statement, so a lock that such a thread held is used on: one broken camera must not stop the others.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Locks `mutex`, also after a thread panicked while it held it.
pub fn lock<T: ?Sized>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Waits for `condvar` with the lock released, also after a panic; it may wake without a reason.
pub fn wait<'a, T>(condvar: &Condvar, guard: MutexGuard<'a, T>) -> MutexGuard<'a, T> {
    condvar.wait(guard).unwrap_or_else(PoisonError::into_inner)
}

/// As [`wait`], for `timeout` at most.
pub fn wait_timeout<'a, T>(
    condvar: &Condvar,
    guard: MutexGuard<'a, T>,
    timeout: Duration,
) -> MutexGuard<'a, T> {
    condvar.wait_timeout(guard, timeout).unwrap_or_else(PoisonError::into_inner).0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lock_works_after_its_holder_panicked() {
        let mutex = Mutex::new(1);
        let panicked = std::thread::scope(|s| {
            s.spawn(|| {
                let _held = lock(&mutex);
                panic!("on purpose");
            })
            .join()
        });
        assert!(panicked.is_err() && mutex.is_poisoned());
        *lock(&mutex) += 1;
        let condvar = Condvar::new();
        assert_eq!(*wait_timeout(&condvar, lock(&mutex), Duration::from_millis(1)), 2);
    }
}
