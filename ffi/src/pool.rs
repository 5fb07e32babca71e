//! Working memory for calls that may run on several threads at once with one shared, immutable handle.

use std::cell::UnsafeCell;
use std::sync::atomic::{AtomicU32, Ordering};

/// Maximum number of calls of entire_model_predict that run on one model at the same time without allocating;
/// each further call allocates its own working memory.
pub const ENTIRE_CONCURRENT_PREDICTIONS: usize = 16;

const SLOTS: usize = ENTIRE_CONCURRENT_PREDICTIONS;
const ALL_FREE: u32 = ((1u64 << SLOTS) - 1) as u32;

/// A fixed number of slots with a piece of working memory each. A bit mask shows the free slots. Taking a
/// slot is lock-free, and succeeds as long as fewer than [`SLOTS`] calls hold a slot.
pub(crate) struct Pool<T> {
    /// Bit mask: bit `i` is set while slot `i` is free.
    free: AtomicU32,
    slots: [UnsafeCell<Option<T>>; SLOTS],
}

// SAFETY: only the thread that has cleared a slot's bit in `free` accesses the slot, until this thread sets
// the bit again. Clearing the bit acquires the writes that setting the bit released. A piece may move between
// threads, so it must be `Send`.
unsafe impl<T: Send> Sync for Pool<T> {}

impl<T> Pool<T> {
    /// A pool whose pieces are made at their first use.
    pub(crate) fn lazy() -> Self {
        Self { free: AtomicU32::new(ALL_FREE), slots: [const { UnsafeCell::new(None) }; SLOTS] }
    }

    /// A pool whose pieces are all made now: calls that get a slot allocate nothing.
    ///
    /// # Errors
    /// The first error of `make`.
    pub(crate) fn filled<E>(mut make: impl FnMut() -> Result<T, E>) -> Result<Self, E> {
        let mut pool = Self::lazy();
        for slot in &mut pool.slots {
            *slot.get_mut() = Some(make()?);
        }
        Ok(pool)
    }

    /// Runs `body` with a piece for exclusive use; `make` makes a piece if the slot has none yet. If all
    /// slots are held, `make` makes a piece for this call alone.
    ///
    /// # Errors
    /// The error of `make`.
    pub(crate) fn with<R, E>(
        &self,
        make: impl FnOnce() -> Result<T, E>,
        body: impl FnOnce(&mut T) -> R,
    ) -> Result<R, E> {
        match self.take() {
            Some(held) => {
                // SAFETY: this thread has cleared the slot's bit, so no other thread uses the slot until
                // `held` is dropped.
                let piece = unsafe { &mut *self.slots[held.slot].get() };
                match piece {
                    Some(piece) => Ok(body(piece)),
                    None => Ok(body(piece.insert(make()?))),
                }
            }
            None => Ok(body(&mut make()?)),
        }
    }

    fn take(&self) -> Option<Held<'_>> {
        let mut free = self.free.load(Ordering::Relaxed);
        while free != 0 {
            let slot = free.trailing_zeros();
            let rest = free & !(1 << slot);
            match self.free.compare_exchange_weak(free, rest, Ordering::Acquire, Ordering::Relaxed) {
                Ok(_) => return Some(Held { free: &self.free, slot: slot as usize }),
                Err(now) => free = now,
            }
        }
        None
    }
}

/// A slot of this thread; released when dropped, also by a panic.
struct Held<'a> {
    free: &'a AtomicU32,
    slot: usize,
}

impl Drop for Held<'_> {
    fn drop(&mut self) {
        self.free.fetch_or(1 << self.slot, Ordering::Release);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::convert::Infallible;
    use std::sync::Barrier;
    use std::sync::atomic::AtomicUsize;

    const ROUNDS: usize = if cfg!(miri) { 5 } else { 500 };

    /// Numbers of pieces: made in total, present now, and the largest number present at one time.
    #[derive(Default)]
    struct Count {
        made: AtomicUsize,
        live: AtomicUsize,
        most: AtomicUsize,
    }

    struct Piece<'a> {
        count: &'a Count,
        value: u64,
    }

    /// Returns `Ok(piece)`: the result of a maker that cannot fail.
    fn made<T>(piece: T) -> Result<T, Infallible> {
        Ok(piece)
    }

    impl Count {
        fn piece(&self) -> Piece<'_> {
            self.made.fetch_add(1, Ordering::SeqCst);
            let live = self.live.fetch_add(1, Ordering::SeqCst) + 1;
            self.most.fetch_max(live, Ordering::SeqCst);
            Piece { count: self, value: 0 }
        }
    }

    impl Drop for Piece<'_> {
        fn drop(&mut self) {
            self.count.live.fetch_sub(1, Ordering::SeqCst);
        }
    }

    /// Calls the pool from `callers` threads at once, and checks that no two calls use the same piece at the
    /// same time.
    fn hammer(pool: &Pool<Piece<'_>>, callers: usize) {
        let start = Barrier::new(callers);
        std::thread::scope(|scope| {
            for _ in 0..callers {
                scope.spawn(|| {
                    start.wait();
                    for _ in 0..ROUNDS {
                        let worked = pool.with(
                            || -> Result<_, Infallible> { panic!("a slot has no piece") },
                            |piece| {
                                let before = piece.value;
                                std::hint::spin_loop();
                                piece.value = before + 1;
                                assert_eq!(piece.value, before + 1);
                            },
                        );
                        assert_eq!(worked, Ok(()));
                    }
                });
            }
        });
    }

    #[test]
    fn as_many_callers_as_slots_make_no_piece() {
        let count = Count::default();
        let pool = Pool::filled(|| made(count.piece())).unwrap();
        assert_eq!(count.made.load(Ordering::SeqCst), SLOTS);
        hammer(&pool, SLOTS);
        assert_eq!(count.made.load(Ordering::SeqCst), SLOTS);
        drop(pool);
        assert_eq!(count.live.load(Ordering::SeqCst), 0);
    }

    #[test]
    fn more_callers_than_slots_make_one_piece_each_at_most() {
        const CALLERS: usize = SLOTS + 8;
        let count = Count::default();
        let pool = Pool::filled(|| made(count.piece())).unwrap();
        // All callers are inside at once: the first ones get slots, the others new pieces.
        let inside = Barrier::new(CALLERS);
        std::thread::scope(|scope| {
            for _ in 0..CALLERS {
                scope.spawn(|| {
                    let waited = pool.with(
                        || made(count.piece()),
                        |_| {
                            inside.wait();
                        },
                    );
                    assert_eq!(waited, Ok(()));
                    for _ in 0..ROUNDS {
                        assert_eq!(pool.with(|| made(count.piece()), |piece| piece.value += 1), Ok(()));
                    }
                });
            }
        });
        assert_eq!(count.most.load(Ordering::SeqCst), CALLERS);
        assert_eq!(count.live.load(Ordering::SeqCst), SLOTS);
    }

    #[test]
    fn pieces_are_made_at_first_use_and_reused() {
        let count = Count::default();
        let pool = Pool::lazy();
        for round in 0..20 {
            assert_eq!(
                pool.with(|| made(count.piece()), |piece| std::mem::replace(&mut piece.value, round + 1)),
                Ok(round)
            );
        }
        assert_eq!(count.made.load(Ordering::SeqCst), 1);
        let depth =
            pool.with(|| made(count.piece()), |a| pool.with(|| made(count.piece()), |b| a.value + b.value));
        assert_eq!((depth, count.made.load(Ordering::SeqCst)), (Ok(Ok(20)), 2));
    }

    #[test]
    fn a_piece_that_cannot_be_made_is_an_error_and_gives_the_slot_back() {
        assert_eq!(Pool::<i32>::filled(|| Err("none")).map(drop), Err("none"));
        let pool = Pool::<i32>::lazy();
        for _ in 0..2 * SLOTS {
            assert_eq!(pool.with(|| Err("none"), |_| ()), Err("none"));
        }
        assert_eq!(pool.with(|| made(3), |piece| *piece), Ok(3));
    }

    #[test]
    fn a_panic_gives_the_slot_back() {
        let pool = Pool::filled(|| made(0)).unwrap();
        for _ in 0..2 * SLOTS {
            let caught = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
                let lost = || -> Result<i32, Infallible> { panic!("a slot was lost") };
                pool.with(lost, |_| -> () { std::panic::resume_unwind(Box::new(7)) })
            }));
            assert_eq!(*caught.unwrap_err().downcast::<i32>().unwrap(), 7);
        }
    }
}
