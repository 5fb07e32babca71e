//! Allocates buffers before their owner is changed, hashes numbers, and spreads work over threads.

use alloc::vec::Vec;
use entire_core::Result;
use entire_core::kernels::Executor;
use entire_core::memory::try_vec;

/// Returns a new vector of `len` zeros if the capacity of `vector` is below `len`, otherwise `None`.
/// Untouched pages of the new vector take no memory.
pub(crate) fn try_grow<T: bytemuck::Zeroable + Clone>(vector: &Vec<T>, len: usize) -> Result<Option<Vec<T>>> {
    if len <= vector.capacity() { Ok(None) } else { zeroed(len).map(Some) }
}

/// Replaces `vector` by `longer` if `longer` is `Some`; otherwise resizes `vector` to `len`.
pub(crate) fn replace_or_resize<T: bytemuck::Zeroable + Clone>(
    vector: &mut Vec<T>,
    longer: Option<Vec<T>>,
    len: usize,
) {
    match longer {
        Some(longer) => *vector = longer,
        None => vector.resize(len, T::zeroed()),
    }
}

/// A vector of `len` zeros, from zeroed pages if the allocator has them.
fn zeroed<T: bytemuck::Zeroable + Clone>(len: usize) -> Result<Vec<T>> {
    bytemuck::allocation::try_zeroed_vec(len).or_else(|()| try_vec(len, T::zeroed()))
}

/// Splits a slice into arrays of `N` elements and the elements that remain: `slice::as_chunks_mut` for
/// compilers before 1.88.
#[inline(always)]
pub(crate) fn chunks_mut<const N: usize, T: bytemuck::Pod>(all: &mut [T]) -> (&mut [[T; N]], &mut [T]) {
    let (whole, rest) = all.split_at_mut(all.len() - all.len() % N);
    (bytemuck::cast_slice_mut(whole), rest)
}

/// Calls `f` with each item, spread over the executor's threads.
pub(crate) fn each<T: Send>(executor: Executor<'_>, items: &mut [T], f: &(impl Fn(&mut T) + Sync)) {
    match items {
        [] => {}
        [one] => f(one),
        _ => {
            let (a, b) = items.split_at_mut(items.len() / 2);
            executor.join(|| each(executor, a, f), || each(executor, b, f));
        }
    }
}

/// Returns `fingerprint` with `number` mixed in. Different sequences of numbers are very unlikely to give the
/// same fingerprint.
pub(crate) fn mixed(fingerprint: u64, number: u64) -> u64 {
    let mut z = (fingerprint ^ number).wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}
