//! A reader of arbitrary bytes, for the fuzz targets and for the tests that replay their findings.

use super::stream::{Companions, Stream};
use super::{Format, Reading, Volume};
use anyhow::Result;

/// Separator between a header and the content of its data file, in one input.
const SEPARATOR: &[u8] = b"\n--data--\n";

struct AnyName<'a>(&'a [u8]);

impl Companions for AnyName<'_> {
    fn open(&self, _name: &str) -> Result<Stream<'_>> {
        Ok(Stream::from_bytes(self.0))
    }

    fn exists(&self, _name: &str) -> bool {
        true
    }

    fn ending_in(&self, _suffix: &str) -> Vec<String> {
        Vec::new()
    }
}

/// Reads a volume from arbitrary bytes. Bytes after the first line `--data--`, if there is such a line, are
/// the content of every data file that the header names.
///
/// # Errors
/// Those of [`Volume::open`], without the file's name.
pub fn read_any(format: Format, input: &[u8]) -> Result<Volume> {
    let at = input.windows(SEPARATOR.len()).position(|window| window == SEPARATOR);
    let (head, data) = match at {
        Some(at) => (&input[..at], &input[at + SEPARATOR.len()..]),
        None => (input, &[][..]),
    };
    Volume::read(format, Stream::from_bytes(head), "input", &AnyName(data), &Reading::default())
}
