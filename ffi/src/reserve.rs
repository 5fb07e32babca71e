//! Reserve memory for when the system has none, so that small allocations (handles, texts, tables of a model)
//! do not end the host's process.
//!
//! This library's allocator is the system's. If the system refuses a piece of at most [`LARGEST_PIECE`]
//! bytes, the piece comes from a reserve in the library's static memory. Code that requests larger pieces
//! returns ENTIRE_OUT_OF_MEMORY if the system refuses them. Calls that make a handle or a file, or that keep
//! further memory, first check that half of the reserve is free ([`check`]), so that an admitted call can
//! finish.
//!
//! The reserve is cut into blocks. A lock-free flag per block marks it as held; a piece is a run of blocks.

use crate::result::Failure;
use crate::result::entire_result::ENTIRE_OUT_OF_MEMORY;
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::UnsafeCell;
use std::ptr::null_mut;
use std::sync::atomic::{AtomicU8, AtomicUsize, Ordering};

/// Size in bytes of the largest piece that the reserve provides. (Under Miri, which is about a thousand times
/// slower than native code, this size and the reserve are smaller.)
const LARGEST_PIECE: usize = if cfg!(miri) { 1 << 12 } else { 1 << 16 };
/// Size of a block in bytes, and largest alignment that the reserve provides.
const BLOCK: usize = 256;
/// Number of blocks in the reserve, which has 1 MiB.
const BLOCKS: usize = if cfg!(miri) { 1 << 7 } else { 1 << 12 };

#[repr(C, align(256))]
struct Memory(UnsafeCell<[u8; BLOCK * BLOCKS]>);

// SAFETY: only the thread that holds a block's flag accesses the block.
unsafe impl Sync for Memory {}

/// Blocks of memory, and a flag for each.
struct Reserve {
    memory: Memory,
    /// One flag per block: 1 if the block is held.
    held: [AtomicU8; BLOCKS],
    /// Number of held blocks.
    count: AtomicUsize,
}

static RESERVE: Reserve = Reserve::new();

impl Reserve {
    const fn new() -> Self {
        Self {
            memory: Memory(UnsafeCell::new([0; BLOCK * BLOCKS])),
            held: [const { AtomicU8::new(0) }; BLOCKS],
            count: AtomicUsize::new(0),
        }
    }

    fn start(&self) -> *mut u8 {
        self.memory.0.get().cast()
    }

    fn owns(&self, piece: *const u8) -> bool {
        (piece as usize).wrapping_sub(self.start() as usize) < BLOCK * BLOCKS
    }

    /// A piece for `layout`; NULL if its size or alignment is too large, or if no run of free blocks is long
    /// enough.
    #[cold]
    fn take(&self, layout: Layout) -> *mut u8 {
        if layout.size() > LARGEST_PIECE || layout.align() > BLOCK {
            return null_mut();
        }
        let wanted = layout.size().div_ceil(BLOCK).max(1);
        let mut first = 0;
        while first + wanted <= BLOCKS {
            let run = &self.held[first..first + wanted];
            let taken = run
                .iter()
                .position(|flag| flag.compare_exchange(0, 1, Ordering::Acquire, Ordering::Relaxed).is_err());
            match taken {
                None => {
                    self.count.fetch_add(wanted, Ordering::Relaxed);
                    // SAFETY: the `wanted` blocks from `first` on lie inside the reserve's memory.
                    return unsafe { self.start().add(first * BLOCK) };
                }
                Some(at) => {
                    run[..at].iter().for_each(|flag| flag.store(0, Ordering::Release));
                    first += at + 1;
                }
            }
        }
        null_mut()
    }

    /// Gives a piece back.
    ///
    /// # Safety
    /// The piece comes from `take` with this size and is given back once.
    #[cold]
    unsafe fn give(&self, piece: *mut u8, size: usize) {
        let first = (piece as usize - self.start() as usize) / BLOCK;
        let blocks = size.div_ceil(BLOCK).max(1);
        self.held[first..first + blocks].iter().for_each(|flag| flag.store(0, Ordering::Release));
        self.count.fetch_sub(blocks, Ordering::Relaxed);
    }
}

/// The system's allocator, with the reserve as fallback.
struct Allocator;

#[global_allocator]
static ALLOCATOR: Allocator = Allocator;

// SAFETY: every piece comes from the system or from the reserve and is given back to where it came from. The
// system never hands out the reserve's memory. Neither allocator unwinds.
unsafe impl GlobalAlloc for Allocator {
    #[inline]
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller guarantees a valid layout of more than zero bytes, which is all that `System`
        // requires.
        let piece = unsafe { System.alloc(layout) };
        if piece.is_null() { RESERVE.take(layout) } else { piece }
    }

    #[inline]
    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller guarantees a valid layout of more than zero bytes, which is all that `System`
        // requires.
        let piece = unsafe { System.alloc_zeroed(layout) };
        if !piece.is_null() {
            return piece;
        }
        let piece = RESERVE.take(layout);
        if !piece.is_null() {
            // Blocks are reused, so they must be cleared.
            // SAFETY: the piece has `layout.size()` bytes.
            unsafe { piece.write_bytes(0, layout.size()) };
        }
        piece
    }

    #[inline]
    unsafe fn dealloc(&self, piece: *mut u8, layout: Layout) {
        // SAFETY: the caller guarantees that this allocator returned the piece for this layout.
        unsafe {
            if RESERVE.owns(piece) {
                RESERVE.give(piece, layout.size())
            } else {
                System.dealloc(piece, layout)
            }
        }
    }

    #[inline]
    unsafe fn realloc(&self, piece: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        if !RESERVE.owns(piece) {
            // SAFETY: the caller guarantees that this allocator returned the piece for this layout; `RESERVE`
            // does not own it, so `System` does.
            let moved = unsafe { System.realloc(piece, layout, size) };
            if !moved.is_null() {
                return moved;
            }
        }
        // SAFETY: the caller guarantees that the size is not zero and does not overflow with this alignment.
        let wanted = unsafe { Layout::from_size_align_unchecked(size, layout.align()) };
        // SAFETY: `wanted` is a valid layout of more than zero bytes.
        let moved = if RESERVE.owns(piece) { unsafe { self.alloc(wanted) } } else { RESERVE.take(wanted) };
        if !moved.is_null() {
            // SAFETY: both pieces have at least the number of copied bytes, and the caller gives up the old
            // piece.
            unsafe {
                moved.copy_from_nonoverlapping(piece, layout.size().min(size));
                self.dealloc(piece, layout);
            }
        }
        moved
    }
}

/// Checks that a call that makes a handle or a file, or that keeps further memory, may begin.
///
/// # Errors
/// ENTIRE_OUT_OF_MEMORY if more than half of the reserve is held.
pub(crate) fn check() -> Result<(), Failure> {
    if RESERVE.count.load(Ordering::Relaxed) <= BLOCKS / 2 {
        return Ok(());
    }
    Err(no_memory())
}

#[cold]
fn no_memory() -> Failure {
    Failure::new(
        ENTIRE_OUT_OF_MEMORY,
        "the system has no memory left for the library; free some memory, then try again",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout(size: usize, align: usize) -> Layout {
        Layout::from_size_align(size, align).unwrap()
    }

    #[test]
    fn pieces_are_apart_aligned_and_given_back() {
        static RESERVE: Reserve = Reserve::new();
        let reserve = &RESERVE;
        let sizes = [1, 255, 256, 257, 4096, LARGEST_PIECE];
        let mut pieces: Vec<(*mut u8, usize)> = Vec::new();
        for size in sizes {
            let piece = reserve.take(layout(size, 64));
            assert!(!piece.is_null() && reserve.owns(piece) && piece as usize % BLOCK == 0);
            // SAFETY: `take` returned a piece of `size` bytes.
            unsafe { piece.write_bytes(size as u8, size) };
            pieces.push((piece, size));
        }
        for &(piece, size) in &pieces {
            // SAFETY: the piece has `size` bytes, all of which were written above.
            let bytes = unsafe { std::slice::from_raw_parts(piece, size) };
            assert!(bytes.iter().all(|&b| b == size as u8), "another piece has written into this one");
        }
        for (piece, size) in pieces {
            // SAFETY: `take` returned the piece for this size, and it is given back once.
            unsafe { reserve.give(piece, size) };
        }
        assert_eq!(reserve.count.load(Ordering::SeqCst), 0);
        assert!(reserve.held.iter().all(|flag| flag.load(Ordering::SeqCst) == 0));
    }

    #[test]
    fn what_is_too_large_or_not_there_is_refused() {
        static RESERVE: Reserve = Reserve::new();
        let reserve = &RESERVE;
        assert!(reserve.take(layout(LARGEST_PIECE + 1, 1)).is_null());
        assert!(reserve.take(layout(1, 2 * BLOCK)).is_null());
        let full = BLOCKS * BLOCK / LARGEST_PIECE;
        let pieces: Vec<*mut u8> = (0..full).map(|_| reserve.take(layout(LARGEST_PIECE, 1))).collect();
        assert!(pieces.iter().all(|piece| !piece.is_null()));
        assert!(reserve.take(layout(1, 1)).is_null());
        // SAFETY: `take` returned the piece for this size, and it is given back once.
        unsafe { reserve.give(pieces[3], LARGEST_PIECE) };
        assert_eq!(reserve.take(layout(LARGEST_PIECE, 1)), pieces[3]);
        let other = 1u8;
        assert!(!reserve.owns(&raw const other));
    }

    #[test]
    fn threads_take_pieces_of_their_own() {
        static RESERVE: Reserve = Reserve::new();
        let reserve = &RESERVE;
        std::thread::scope(|scope| {
            for thread in 0..4u8 {
                scope.spawn(move || {
                    for round in 0..if cfg!(miri) { 4 } else { 400 } {
                        let size = 100 + 700 * (round % 7);
                        let piece = reserve.take(layout(size, 1));
                        if piece.is_null() {
                            continue;
                        }
                        // SAFETY: the piece has `size` bytes, and only this thread uses it.
                        unsafe {
                            piece.write_bytes(thread, size);
                            std::thread::yield_now();
                            assert!(std::slice::from_raw_parts(piece, size).iter().all(|&b| b == thread));
                            reserve.give(piece, size);
                        }
                    }
                });
            }
        });
        assert_eq!(reserve.count.load(Ordering::SeqCst), 0);
    }

    #[test]
    fn half_a_reserve_lets_calls_in() {
        assert!(check().is_ok());
        assert_eq!(no_memory().code, ENTIRE_OUT_OF_MEMORY);
    }
}
