//! Working memory for calls that may run on several threads at once with one shared, immutable handle.

use std::ptr;
use std::sync::atomic::{AtomicPtr, Ordering};

/// How many pieces are kept; further concurrent callers allocate theirs.
const SLOTS: usize = 16;

/// A few pieces of working memory that callers take and put back; no lock, and no allocation once as many exist as calls
/// run at the same time.
pub(crate) struct Pool<T> {
    slots: [AtomicPtr<T>; SLOTS],
}

impl<T> Pool<T> {
    /// A pool that holds nothing yet.
    pub(crate) fn new() -> Self {
        Self { slots: [const { AtomicPtr::new(ptr::null_mut()) }; SLOTS] }
    }

    /// A pool that holds `first` alone.
    pub(crate) fn with_first(first: T) -> Self {
        let pool = Self::new();
        pool.put(Box::new(first));
        pool
    }

    /// Runs `body` with a piece that nobody else is using; `make` makes one where all are taken.
    pub(crate) fn with<R>(&self, make: impl FnOnce() -> T, body: impl FnOnce(&mut T) -> R) -> R {
        let mut piece = self.take().unwrap_or_else(|| Box::new(make()));
        let result = body(&mut piece);
        self.put(piece);
        result
    }

    fn take(&self) -> Option<Box<T>> {
        self.slots.iter().find_map(|slot| {
            if slot.load(Ordering::Relaxed).is_null() {
                return None;
            }
            let taken = slot.swap(ptr::null_mut(), Ordering::Acquire);
            // SAFETY: every pointer in a slot comes from Box::into_raw in `new` or `put`, and the swap gave it to this
            // thread alone.
            (!taken.is_null()).then(|| unsafe { Box::from_raw(taken) })
        })
    }

    fn put(&self, piece: Box<T>) {
        let raw = Box::into_raw(piece);
        for slot in &self.slots {
            if slot.compare_exchange(ptr::null_mut(), raw, Ordering::Release, Ordering::Relaxed).is_ok() {
                return;
            }
        }
        // SAFETY: just made from a box, and no slot took it.
        drop(unsafe { Box::from_raw(raw) });
    }
}

impl<T> Drop for Pool<T> {
    fn drop(&mut self) {
        while self.take().is_some() {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::AtomicUsize;

    #[test]
    fn pieces_are_reused_and_never_shared() {
        let made = AtomicUsize::new(1);
        let pool = Pool::with_first(0u64);
        let make = || {
            made.fetch_add(1, Ordering::Relaxed);
            0u64
        };
        for _ in 0..100 {
            pool.with(make, |piece| *piece += 1);
        }
        assert_eq!(made.load(Ordering::Relaxed), 1);
        assert_eq!(pool.with(make, |piece| *piece), 100);

        std::thread::scope(|scope| {
            for _ in 0..24 {
                scope.spawn(|| {
                    for _ in 0..500 {
                        pool.with(make, |piece| {
                            let before = *piece;
                            std::hint::spin_loop();
                            *piece = before + 1;
                            assert_eq!(*piece, before + 1);
                        });
                    }
                });
            }
        });
        assert!(made.load(Ordering::Relaxed) <= 25);
    }

    #[test]
    fn nested_use_makes_further_pieces() {
        let pool = Pool::with_first(1);
        let depth = pool.with(|| 2, |a| pool.with(|| 2, |b| *a + *b));
        assert_eq!(depth, 3);
    }
}
