//! Fallible allocation, for sizes that a file or a caller decides.

use crate::{Error, ErrorKind, Result};
use alloc::vec::Vec;

/// Returns the error of a failed allocation. Its message is static, because formatting needs memory.
#[cold]
pub(crate) fn no_memory() -> Error {
    Error::new(
        ErrorKind::OutOfMemory,
        "there is not enough memory for this call; free some memory, or pass less data",
    )
}

/// Returns an empty vector with capacity for `len` elements.
pub fn room<T>(len: usize) -> Result<Vec<T>> {
    let mut out = Vec::new();
    out.try_reserve_exact(len).map_err(|_| no_memory())?;
    Ok(out)
}

/// A vector of `len` copies of `value`.
pub fn try_vec<T: Clone>(len: usize, value: T) -> Result<Vec<T>> {
    let mut out = room(len)?;
    out.resize(len, value);
    Ok(out)
}

/// Splits a slice into arrays of `N` elements and the elements that remain: `slice::as_chunks` for compilers
/// before 1.88.
#[inline(always)]
pub fn chunks<const N: usize, T: bytemuck::Pod>(all: &[T]) -> (&[[T; N]], &[T]) {
    let (whole, rest) = all.split_at(all.len() - all.len() % N);
    (bytemuck::cast_slice(whole), rest)
}

/// Reserves capacity for `len` elements in total. May reserve more, so that a vector that grows step by step
/// is reallocated only a few times.
pub fn reserve<T>(vector: &mut Vec<T>, len: usize) -> Result<()> {
    vector.try_reserve(len.saturating_sub(vector.len())).map_err(|_| no_memory())
}

/// Resizes a vector to `len`; new elements are `value`.
pub(crate) fn resize<T: Clone>(vector: &mut Vec<T>, len: usize, value: T) -> Result<()> {
    reserve(vector, len)?;
    vector.resize(len, value);
    Ok(())
}

/// Collects the elements of an iterator of known length.
pub fn collected<T>(elements: impl ExactSizeIterator<Item = T>) -> Result<Vec<T>> {
    let mut out = room(elements.len())?;
    out.extend(elements);
    Ok(out)
}

/// Checks that `bytes` bytes can be allocated. Called before work with many small allocations, because a
/// failure of one of them would abort the process.
pub(crate) fn check_bytes(bytes: usize) -> Result<()> {
    room::<u8>(bytes).map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;
    use alloc::vec;

    #[test]
    #[cfg_attr(miri, ignore = "Miri aborts where an allocation fails")]
    fn what_cannot_be_had_is_an_error() {
        assert_eq!(room::<u64>(usize::MAX).unwrap_err().kind(), ErrorKind::OutOfMemory);
        assert_eq!(try_vec(isize::MAX as usize, 1u8).unwrap_err().kind(), ErrorKind::OutOfMemory);
        assert_eq!(check_bytes(isize::MAX as usize).unwrap_err().kind(), ErrorKind::OutOfMemory);
        let mut kept = vec![1u8, 2];
        assert_eq!(resize(&mut kept, isize::MAX as usize, 0).unwrap_err().kind(), ErrorKind::OutOfMemory);
        assert_eq!(kept, [1, 2]);
    }

    #[test]
    fn what_can_be_had_is_exact() {
        assert_eq!(try_vec(3, 7u8).unwrap(), [7, 7, 7]);
        assert_eq!(collected([3u8, 4].into_iter()).unwrap(), [3, 4]);
        let mut kept = vec![1u8, 2, 3];
        resize(&mut kept, 5, 9).unwrap();
        assert_eq!(kept, [1, 2, 3, 9, 9]);
        resize(&mut kept, 1, 9).unwrap();
        assert_eq!(kept, [1]);
        check_bytes(1 << 10).unwrap();
    }

    #[test]
    fn what_grows_piece_by_piece_is_moved_a_few_times() {
        let (mut grown, mut moves, mut room) = (Vec::new(), 0, 0);
        for len in 1..=1000 {
            resize(&mut grown, len, 1u8).unwrap();
            moves += u32::from(grown.capacity() != room);
            room = grown.capacity();
        }
        assert!(moves <= 10, "{moves} moves");
    }
}
