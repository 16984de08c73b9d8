//! Buffers of chunks that were written, kept for chunks to come: in a fresh one every page is a fault of its own.

use core::ops::{Deref, DerefMut};
use depthrig_bus::sync::lock;
use std::sync::{Arc, Mutex, MutexGuard};

/// Buffers below this many bytes are the allocator's business.
const SMALL: usize = 64 << 10;

/// Buffers that nobody uses at present.
#[derive(Debug)]
pub(crate) struct Pool {
    /// In the order in which they came back: the last one is likeliest to be in a cache still.
    free: Mutex<Vec<Vec<u8>>>,
    most_bytes: usize,
}

impl Pool {
    /// A pool that keeps at most so many bytes that are not in use.
    pub(crate) fn new(most_bytes: usize) -> Arc<Self> {
        Arc::new(Self { free: Mutex::default(), most_bytes })
    }

    /// An empty buffer with room for `len` bytes, and for at most half as many more: what waits to be written is
    /// counted by what is in it.
    pub(crate) fn take(self: &Arc<Self>, len: usize) -> Buffer {
        let fits = |b: &Vec<u8>| (len..=len + len / 2).contains(&b.capacity());
        let kept = (len >= SMALL).then(|| {
            let mut free = self.lock();
            free.iter().rposition(fits).map(|i| free.remove(i))
        });
        let bytes = kept.flatten().unwrap_or_else(|| Vec::with_capacity(len.next_multiple_of(SMALL / 16)));
        Buffer { bytes, pool: Some(Arc::clone(self)) }
    }

    /// Keeps a buffer; those that lie unused for longest make room for it.
    fn give(&self, mut bytes: Vec<u8>) {
        if !(SMALL..=self.most_bytes).contains(&bytes.capacity()) {
            return;
        }
        bytes.clear();
        let mut free = self.lock();
        free.push(bytes);
        let mut left = free.iter().map(Vec::capacity).sum::<usize>();
        while left > self.most_bytes {
            left -= free.remove(0).capacity();
        }
    }

    fn lock(&self) -> MutexGuard<'_, Vec<Vec<u8>>> {
        lock(&self.free)
    }
}

/// Bytes in a buffer that goes back to its pool, if it has one, when they are no longer needed.
#[derive(Debug, Default)]
pub(crate) struct Buffer {
    bytes: Vec<u8>,
    pool: Option<Arc<Pool>>,
}

impl From<Vec<u8>> for Buffer {
    fn from(bytes: Vec<u8>) -> Self {
        Self { bytes, pool: None }
    }
}

impl Deref for Buffer {
    type Target = Vec<u8>;

    fn deref(&self) -> &Vec<u8> {
        &self.bytes
    }
}

impl DerefMut for Buffer {
    fn deref_mut(&mut self) -> &mut Vec<u8> {
        &mut self.bytes
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        if let Some(pool) = &self.pool {
            pool.give(std::mem::take(&mut self.bytes));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MB: usize = 1 << 20;

    fn kept(pool: &Pool) -> Vec<usize> {
        pool.lock().iter().map(Vec::capacity).collect()
    }

    #[test]
    fn the_last_buffer_that_fits_comes_back_and_no_more_is_kept_than_was_said() {
        let pool = Pool::new(5 * MB);
        let [a, b] = [pool.take(MB), pool.take(MB)];
        let at_a = a.as_ptr();
        let at_b = b.as_ptr();
        drop(b);
        drop(a);
        let mut again = pool.take(3 * MB / 4);
        assert_eq!(again.as_ptr(), at_a, "the one that came back last");
        again.extend_from_slice(&[1, 2, 3]);
        drop(again);
        let empty = pool.take(MB);
        assert!(empty.is_empty() && empty.as_ptr() == at_a);
        assert_ne!(pool.take(MB / 2).as_ptr(), at_b, "twice as large is too large");
        drop(empty);
        assert_eq!(kept(&pool), [MB, MB / 2, MB], "oldest first");
        drop(pool.take(3 * MB));
        assert_eq!(kept(&pool), [MB / 2, MB, 3 * MB], "the oldest made room");
        drop(pool.take(6 * MB));
        drop(pool.take(100));
        drop(Buffer::from(vec![0; MB]));
        assert_eq!(kept(&pool), [MB / 2, MB, 3 * MB], "too large, too small, not of the pool");
    }
}
