//! Writes and reads saved state as bytes: little-endian numbers after a tag. Reading checks every number.

use alloc::vec::Vec;
use entire_core::Result;
use entire_core::bail;

/// Appends numbers to a byte vector.
pub(crate) struct Writer<'a>(pub(crate) &'a mut Vec<u8>);

impl Writer<'_> {
    pub(crate) fn tag(&mut self, tag: [u8; 4]) {
        self.0.extend_from_slice(&tag);
    }

    pub(crate) fn u64(&mut self, v: u64) {
        self.0.extend_from_slice(&v.to_le_bytes());
    }

    pub(crate) fn f64(&mut self, v: f64) {
        self.u64(v.to_bits());
    }

    pub(crate) fn f64s(&mut self, v: &[f64]) {
        v.iter().for_each(|&v| self.f64(v));
    }

    pub(crate) fn text(&mut self, text: &str) {
        self.u64(text.len() as u64);
        self.0.extend_from_slice(text.as_bytes());
    }
}

/// Appends a CRC-32 checksum of the bytes.
pub(crate) fn seal(bytes: &mut Vec<u8>) {
    let sum = crc32fast::hash(bytes);
    bytes.extend_from_slice(&sum.to_le_bytes());
}

/// Checks the checksum appended by [`seal`], and returns the bytes before it.
///
/// # Errors
/// [`crate::ErrorKind::InvalidArgument`] for bytes cut short or a wrong checksum.
pub(crate) fn unseal(bytes: &[u8]) -> Result<&[u8]> {
    let length = bytes.len();
    let Some((body, sum)) = bytes.split_last_chunk::<4>() else {
        bail!(InvalidArgument, "the saved state is cut short: it has {length} bytes; start without it");
    };
    let (stated, found) = (u32::from_le_bytes(*sum), crc32fast::hash(body));
    if stated != found {
        bail!(
            InvalidArgument,
            "the saved state is damaged or cut short: it states the checksum {stated:08x}, but its bytes \
             have {found:08x}; start without it"
        );
    }
    Ok(body)
}

/// Reads the numbers that a [`Writer`] wrote, in the same order.
pub(crate) struct Reader<'a>(pub(crate) &'a [u8]);

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N]> {
        let Some((head, rest)) = self.0.split_first_chunk::<N>() else {
            bail!(
                InvalidArgument,
                "the saved state is cut short: {N} more bytes were expected, {} are left; start without it",
                self.0.len()
            );
        };
        self.0 = rest;
        Ok(*head)
    }

    pub(crate) fn tag(&mut self, tag: [u8; 4]) -> Result<()> {
        let found: [u8; 4] = self.take()?;
        if found != tag {
            bail!(
                InvalidArgument,
                "the saved state holds {:?} where {:?} was expected; it was written by another controller or version; \
                 start without it",
                core::str::from_utf8(&found).unwrap_or("?"),
                core::str::from_utf8(&tag).unwrap_or("?")
            );
        }
        Ok(())
    }

    pub(crate) fn u64(&mut self) -> Result<u64> {
        Ok(u64::from_le_bytes(self.take()?))
    }

    /// Reads text of at most `limit` bytes.
    pub(crate) fn text(&mut self, limit: usize) -> Result<&str> {
        let length = self.u64()?;
        let split =
            usize::try_from(length).ok().filter(|&n| n <= limit).and_then(|n| self.0.split_at_checked(n));
        let Some((head, rest)) = split else {
            bail!(
                InvalidArgument,
                "the saved state holds a name of {length} bytes; it is damaged: start without it"
            );
        };
        self.0 = rest;
        match core::str::from_utf8(head) {
            Ok(text) => Ok(text),
            Err(_) => bail!(
                InvalidArgument,
                "the saved state holds a name that is not UTF-8; it is damaged: start without it"
            ),
        }
    }

    /// Reads a finite number within bounds.
    pub(crate) fn f64(&mut self, low: f64, high: f64) -> Result<f64> {
        let v = f64::from_bits(self.u64()?);
        if !(low..=high).contains(&v) {
            bail!(
                InvalidArgument,
                "the saved state holds {v} where a number from {low} to {high} is expected; it is damaged: start without it"
            );
        }
        Ok(v)
    }

    pub(crate) fn f64s(&mut self, out: &mut [f64], low: f64, high: f64) -> Result<()> {
        for v in out {
            *v = self.f64(low, high)?;
        }
        Ok(())
    }

    pub(crate) fn end(&self) -> Result<()> {
        match self.0.len() {
            0 => Ok(()),
            n => bail!(
                InvalidArgument,
                "the saved state has {n} bytes too many; it is damaged: start without it"
            ),
        }
    }
}
