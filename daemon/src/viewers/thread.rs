//! The life of a thread that encodes for those who look.

use crate::priority;
use core::time::Duration;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Between a panic and a new beginning.
const PAUSE: Duration = Duration::from_secs(1);

/// Opens what the work needs and works on this thread, below the priority of everything that captures, until the work is done. After a
/// panic both begin anew: those who look see a pause instead of images that never come again.
///
/// # Errors
/// That of `open`.
pub(crate) fn work_until_done<O, E>(
    name: &str,
    open: impl Fn() -> Result<O, E>,
    work: impl Fn(O),
) -> Result<(), E> {
    priority::lower_current_thread();
    loop {
        let opened = open()?;
        // What it has changed lies behind locks, and no change there is left half done.
        if catch_unwind(AssertUnwindSafe(|| work(opened))).is_ok() {
            return Ok(());
        }
        tracing::error!("the thread `{name}` panicked and begins anew; the lines above say where");
        std::thread::sleep(PAUSE);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::Cell;

    #[test]
    fn work_that_panics_begins_anew_with_what_it_needs() {
        let opened = Cell::new(0);
        let open = || {
            opened.set(opened.get() + 1);
            if opened.get() < 4 { Ok(opened.get()) } else { Err("no more") }
        };
        let result = work_until_done("test", open, |n| assert_eq!(n, 2));
        assert_eq!((result, opened.get()), (Ok(()), 2));
        let result = work_until_done("test", open, |_| panic!("always"));
        assert_eq!((result, opened.get()), (Err("no more"), 4));
    }
}
