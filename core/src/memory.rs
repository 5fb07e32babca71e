//! Memory whose size a file or a caller decides: asked for in a way that can fail.

use crate::{Error, ErrorKind, Result};
use alloc::vec::Vec;

/// The error where the allocator has no such room. Its text stands in the program: there may be no memory for
/// another.
#[cold]
pub fn no_memory() -> Error {
    Error::new(
        ErrorKind::OutOfMemory,
        "there is no memory for what the model or the volume needs; give the process more, or use a smaller \
         one",
    )
}

/// An empty vector with room for `len` elements.
pub fn room<T>(len: usize) -> Result<Vec<T>> {
    let mut out = Vec::new();
    match out.try_reserve_exact(len) {
        Ok(()) => Ok(out),
        Err(_) => Err(no_memory()),
    }
}

/// `len` times a value.
pub fn filled<T: Clone>(len: usize, value: T) -> Result<Vec<T>> {
    let mut out = room(len)?;
    out.resize(len, value);
    Ok(out)
}

/// `len` zeros, as fresh memory has them: what is not touched costs nothing.
pub fn zeroed<T: bytemuck::Zeroable>(len: usize) -> Result<Vec<T>> {
    bytemuck::allocation::try_zeroed_vec(len).map_err(|()| no_memory())
}

/// A longer vector of zeros in place of one that has no room for `len` elements; what is not touched of it costs
/// nothing.
pub fn longer<T: bytemuck::Zeroable>(vector: &Vec<T>, len: usize) -> Result<Option<Vec<T>>> {
    if len <= vector.capacity() { Ok(None) } else { zeroed(len).map(Some) }
}

/// Takes the longer vector, if there is one, and makes it as long as asked for.
pub fn fit<T: bytemuck::Zeroable + Clone>(vector: &mut Vec<T>, longer: Option<Vec<T>>, len: usize) {
    match longer {
        Some(longer) => *vector = longer,
        None => vector.resize(len, T::zeroed()),
    }
}

/// Room for `len` elements in all, and for some more where the vector has grown before: what grows piece by
/// piece is moved a few times, not once per piece.
pub fn reserve<T>(vector: &mut Vec<T>, len: usize) -> Result<()> {
    match vector.try_reserve(len.saturating_sub(vector.len())) {
        Ok(()) => Ok(()),
        Err(_) => Err(no_memory()),
    }
}

/// Makes a vector as long as `len`; new elements are `value`.
pub fn resize<T: Clone>(vector: &mut Vec<T>, len: usize, value: T) -> Result<()> {
    reserve(vector, len)?;
    vector.resize(len, value);
    Ok(())
}

/// A copy of a slice.
pub fn copied<T: Copy>(slice: &[T]) -> Result<Vec<T>> {
    let mut out = room(slice.len())?;
    out.extend_from_slice(slice);
    Ok(out)
}

/// The elements of an iterator that knows how many they are.
pub fn collected<T>(elements: impl ExactSizeIterator<Item = T>) -> Result<Vec<T>> {
    let mut out = room(elements.len())?;
    out.extend(elements);
    Ok(out)
}

/// Whether so many bytes can be had: for work in many small pieces, none of which can fail by itself.
pub fn check_bytes(bytes: usize) -> Result<()> {
    room::<u8>(bytes).map(drop)
}

/// Takes another number into a fingerprint: different runs of numbers hardly ever give the same one.
pub fn mixed(fingerprint: u64, number: u64) -> u64 {
    let mut z = (fingerprint ^ number).wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;
    use alloc::vec;

    #[test]
    #[cfg_attr(miri, ignore = "Miri ends where an allocator says no")]
    fn what_cannot_be_had_is_an_error() {
        assert_eq!(room::<u64>(usize::MAX).unwrap_err().kind(), ErrorKind::OutOfMemory);
        assert_eq!(filled(isize::MAX as usize, 1u8).unwrap_err().kind(), ErrorKind::OutOfMemory);
        assert_eq!(check_bytes(isize::MAX as usize).unwrap_err().kind(), ErrorKind::OutOfMemory);
        let mut kept = vec![1u8, 2];
        assert_eq!(resize(&mut kept, isize::MAX as usize, 0).unwrap_err().kind(), ErrorKind::OutOfMemory);
        assert_eq!(kept, [1, 2]);
    }

    #[test]
    fn what_can_be_had_is_exact() {
        assert_eq!(filled(3, 7u8).unwrap(), [7, 7, 7]);
        assert_eq!(copied(&[1.5f32, 2.5]).unwrap(), [1.5, 2.5]);
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
