//! Byte streams with a known upper bound on their length, from any source.

use crate::files::{BYTE_ORDER_MARK, open_regular};
use anyhow::{Context, Result, anyhow, bail, ensure};
use bzip2::bufread::MultiBzDecoder;
use flate2::bufread::{GzDecoder, ZlibDecoder};
use std::io::{self, BufRead, BufReader, Read};
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

/// Upper bound of decompressed bytes per compressed byte of a deflate stream (RFC 1951: 258 bytes from 2
/// bits, less the block's own cost).
const DEFLATE_GROWTH: u64 = 1032;

/// Upper bound of decompressed bytes per compressed byte of a bzip2 stream: a block takes more than 14 bytes
/// and holds 900 000 bytes, of which every five expand to at most 259.
const BZIP2_GROWTH: u64 = 1 << 22;

/// Maximum number of decompressed bytes of a bzip2 stream, unless [`DEFLATE_GROWTH`] allows more. Without
/// this limit, a file of a few kilobytes could fill any memory.
const BZIP2_MOST: u64 = 4 << 30;

/// Maximum length of a header's line, in bytes.
const MAX_LINE: usize = 1 << 16;

/// Number of bytes that a stream still holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Remaining {
    /// The stream holds exactly this number of bytes.
    Exact(u64),
    /// The stream is compressed or in hexadecimal digits; decoded, it holds at most this number of bytes.
    AtMost(u64),
}

/// Watches how far files are read, and may stop the reading.
pub trait Watcher: Send + Sync {
    /// Called before reading, when `bytes` more bytes are known to be needed.
    fn expect(&self, bytes: u64);

    /// Called after `bytes` more bytes were read.
    ///
    /// # Errors
    /// An implementation returns an error to stop the reading; the reader passes it on.
    fn advance(&self, bytes: u64) -> io::Result<()>;
}

struct Watched<R> {
    inner: R,
    watcher: Option<Arc<dyn Watcher>>,
}

impl<R: Read> Read for Watched<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let count = self.inner.read(out)?;
        if let Some(watcher) = &self.watcher {
            watcher.advance(count as u64)?;
        }
        Ok(count)
    }
}

/// A readable source of bytes with a name for messages and a bound on its length.
pub(crate) struct Stream<'a> {
    reader: Box<dyn BufRead + 'a>,
    remaining: Remaining,
    read: u64,
    /// Name of the stream in messages; empty for a file that the user named.
    label: String,
}

impl<'a> Stream<'a> {
    fn new(reader: impl BufRead + 'a, remaining: Remaining, label: String) -> Self {
        Self { reader: Box::new(reader), remaining, read: 0, label }
    }

    /// Opens a regular file; the watcher, if any, observes its reading. Bytes that are appended to the file
    /// later are not read.
    ///
    /// # Errors
    /// When the file is missing, unreadable or not a regular file; the error names the path.
    pub(crate) fn open(path: &Path, watcher: Option<&Arc<dyn Watcher>>) -> Result<Stream<'static>> {
        let (file, length) = open_regular(path)?;
        if let Some(watcher) = watcher {
            watcher.expect(length);
        }
        let watched = Watched { inner: file.take(length), watcher: watcher.cloned() };
        let reader = BufReader::with_capacity(1 << 16, watched);
        Ok(Stream::new(reader, Remaining::Exact(length), String::new()))
    }

    pub(crate) fn from_bytes(bytes: &'a [u8]) -> Self {
        Self::new(bytes, Remaining::Exact(bytes.len() as u64), String::new())
    }

    /// Leaves out a byte order mark, if the stream begins with one.
    pub(crate) fn skip_mark(&mut self) -> Result<()> {
        let prefix = self.prefix();
        if self.peek().with_context(|| format!("{prefix}reading"))?.starts_with(&BYTE_ORDER_MARK) {
            self.consume(BYTE_ORDER_MARK.len());
        }
        Ok(())
    }

    pub(crate) fn prefix(&self) -> String {
        if self.label.is_empty() { String::new() } else { format!("{}: ", self.label) }
    }

    pub(crate) fn remaining(&self) -> Remaining {
        self.remaining
    }

    pub(crate) fn position(&self) -> u64 {
        self.read
    }

    /// Returns the buffered bytes, without consuming them; empty only at the end of the stream.
    pub(crate) fn peek(&mut self) -> io::Result<&[u8]> {
        loop {
            match self.reader.fill_buf() {
                Ok(_) => break,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        self.reader.fill_buf()
    }

    /// Reads a line without its end (LF or CRLF); `None` at the end of the stream.
    ///
    /// # Errors
    /// When the line is longer than [`MAX_LINE`] bytes.
    pub(crate) fn line(&mut self) -> Result<Option<Vec<u8>>> {
        let mut line = Vec::new();
        self.take(MAX_LINE as u64 + 1).read_until(b'\n', &mut line)?;
        if line.is_empty() {
            return Ok(None);
        }
        if line.last() == Some(&b'\n') {
            line.pop();
            if line.last() == Some(&b'\r') {
                line.pop();
            }
        } else if line.len() > MAX_LINE {
            bail!(
                "{}header line at byte {} is longer than {MAX_LINE} bytes; this is not a text header; check \
                 the file",
                self.prefix(),
                self.read - line.len() as u64
            );
        }
        Ok(Some(line))
    }

    pub(crate) fn skip(&mut self, count: u64) -> Result<()> {
        let prefix = self.prefix();
        let left = match self.remaining {
            Remaining::Exact(left) if left < count => left,
            _ => io::copy(&mut self.take(count), &mut io::sink())
                .with_context(|| format!("{prefix}skipping {count} bytes"))?,
        };
        ensure!(
            left >= count,
            "{prefix}the header says to skip {count} bytes, but only {left} are left; is the file cut short?"
        );
        Ok(())
    }

    /// Reads the rest of the stream, which may have at most `limit` bytes.
    ///
    /// # Errors
    /// When more than `limit` bytes are left, when they do not fit into memory, or when reading fails.
    pub(crate) fn all(&mut self, limit: u64) -> Result<Vec<u8>> {
        let mut bytes = Vec::new();
        if let Remaining::Exact(left) = self.remaining
            && left <= limit
            && bytes.try_reserve_exact(left as usize).is_err()
        {
            bail!("{}{left} bytes do not fit into this machine's memory", self.prefix());
        }
        self.take(limit.saturating_add(1))
            .read_to_end(&mut bytes)
            .with_context(|| format!("{}reading", self.prefix()))?;
        if bytes.len() as u64 > limit {
            bail!("{}is longer than the {limit} bytes accepted here", self.prefix());
        }
        Ok(bytes)
    }

    /// Returns the rest of the stream, decompressed as gzip (one or several members). Bytes after the last
    /// member, such as the zeros with which some programs fill blocks, are ignored.
    pub(crate) fn gunzip(self) -> Stream<'a> {
        let most = |packed: u64| packed.saturating_mul(DEFLATE_GROWTH);
        self.decoded(most, |reader| Members { member: Some(GzDecoder::new(reader)) })
    }

    /// Returns the rest of the stream, decompressed as zlib, or as gzip if it starts with the magic bytes of
    /// gzip.
    pub(crate) fn inflate(mut self) -> Result<Stream<'a>> {
        if self.peek()?.starts_with(&[0x1f, 0x8b]) {
            return Ok(self.gunzip());
        }
        Ok(self.decoded(|packed| packed.saturating_mul(DEFLATE_GROWTH), ZlibDecoder::new))
    }

    /// Returns the rest of the stream, decompressed as bzip2 (one or several streams).
    pub(crate) fn bunzip(self) -> Stream<'a> {
        let most = |packed: u64| {
            let accepted = packed.saturating_mul(DEFLATE_GROWTH).max(BZIP2_MOST);
            packed.saturating_mul(BZIP2_GROWTH).min(accepted)
        };
        self.decoded(most, MultiBzDecoder::new)
    }

    /// Returns the rest of the stream, decoded from pairs of hexadecimal digits; blanks are skipped.
    pub(crate) fn unhex(self) -> Stream<'a> {
        self.decoded(|digits| digits / 2, |inner| Hexadecimal { inner })
    }

    /// Returns the `count` bytes before the last `behind` bytes of the stream; memory grows with the received
    /// bytes.
    ///
    /// # Errors
    /// When fewer than `count + behind` bytes are left.
    pub(crate) fn last(mut self, count: u64, behind: u64) -> Result<Stream<'a>> {
        let keep = count.saturating_add(behind);
        let short = |found: String, prefix: String| {
            anyhow!(
                "{prefix}the header states {count} bytes of voxels and {behind} bytes after them, but \
                 {found} bytes follow the header; the file is cut short or its header is wrong"
            )
        };
        if let Remaining::Exact(left) = self.remaining {
            if left < keep {
                return Err(short(left.to_string(), self.prefix()));
            }
            self.skip(left - keep)?;
            self.reader = Box::new(self.reader.take(count));
            self.remaining = Remaining::Exact(count);
            return Ok(self);
        }
        if let Remaining::AtMost(most) = self.remaining
            && most < keep
        {
            return Err(short(format!("at most {most}"), self.prefix()));
        }
        let mut held: Vec<u8> = Vec::new();
        let mut found = 0u64;
        loop {
            let prefix = self.prefix();
            let part = self.peek().with_context(|| format!("{prefix}cannot read to the end of the data"))?;
            let length = part.len();
            if length == 0 {
                break;
            }
            if held.try_reserve(length).is_err() {
                bail!("{prefix}{} bytes do not fit into this machine's memory", held.len() + length);
            }
            held.extend_from_slice(part);
            self.consume(length);
            found += length as u64;
            // More than half of the buffer is dropped, so moving the kept bytes costs less than reading did.
            if held.len() as u64 / 2 > keep.max(1 << 16) {
                held.drain(..held.len() - keep as usize);
            }
        }
        if found < keep {
            return Err(short(found.to_string(), self.prefix()));
        }
        held.drain(..held.len() - keep as usize);
        held.truncate(count as usize);
        Ok(Stream::new(io::Cursor::new(held), Remaining::Exact(count), self.label))
    }

    /// Returns the rest of the stream, decoded. `most` returns the maximum number of decoded bytes for a
    /// number of encoded ones.
    fn decoded<R: Read + 'a>(
        self,
        most: impl FnOnce(u64) -> u64,
        decode: impl FnOnce(Box<dyn BufRead + 'a>) -> R,
    ) -> Stream<'a> {
        let (Remaining::Exact(encoded) | Remaining::AtMost(encoded)) = self.remaining;
        let reader = BufReader::with_capacity(1 << 16, decode(self.reader));
        Stream::new(reader, Remaining::AtMost(most(encoded)), self.label)
    }
}

/// Decoder of the members of a gzip stream, one after another. It stops at bytes that do not begin a member.
struct Members<R> {
    /// The member that is being decompressed; `None` after the last one.
    member: Option<GzDecoder<R>>,
}

impl<R: BufRead> Read for Members<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        while let Some(member) = &mut self.member {
            let count = member.read(out)?;
            if count > 0 || out.is_empty() {
                return Ok(count);
            }
            let mut rest = self.member.take().map(GzDecoder::into_inner);
            if let Some(reader) = &mut rest
                && reader.fill_buf()?.starts_with(&[0x1f])
            {
                self.member = rest.map(GzDecoder::new);
            }
        }
        Ok(0)
    }
}

struct Hexadecimal<R> {
    inner: R,
}

impl<R: BufRead> Hexadecimal<R> {
    /// Returns the next digit; `None` at the end of the text.
    fn digit(&mut self) -> io::Result<Option<u32>> {
        let is_blank = |byte: &io::Result<u8>| byte.as_ref().is_ok_and(u8::is_ascii_whitespace);
        let next = self.inner.by_ref().bytes().find(|byte| !is_blank(byte)).transpose()?;
        let Some(byte) = next.map(char::from) else { return Ok(None) };
        let fail = || io::Error::new(io::ErrorKind::InvalidData, format!("{byte:?} is no hexadecimal digit"));
        byte.to_digit(16).map(Some).ok_or_else(fail)
    }
}

impl<R: BufRead> Read for Hexadecimal<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        for (filled, place) in out.iter_mut().enumerate() {
            let Some(high) = self.digit()? else { return Ok(filled) };
            let Some(low) = self.digit()? else {
                return Err(io::Error::new(io::ErrorKind::InvalidData, "a hexadecimal digit is missing"));
            };
            *place = (high * 16 + low) as u8;
        }
        Ok(out.len())
    }
}

impl Read for Stream<'_> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let count = self.reader.read(out)?;
        self.count(count);
        Ok(count)
    }
}

impl BufRead for Stream<'_> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        self.reader.fill_buf()
    }

    fn consume(&mut self, count: usize) {
        self.reader.consume(count);
        self.count(count);
    }
}

impl Stream<'_> {
    fn count(&mut self, count: usize) {
        self.read += count as u64;
        let (Remaining::Exact(left) | Remaining::AtMost(left)) = &mut self.remaining;
        *left = left.saturating_sub(count as u64);
    }
}

/// Access to the data files that a header names.
pub(crate) trait Companions {
    /// Opens a file by its name in the header.
    ///
    /// # Errors
    /// When there is no such file, or its name is not accepted.
    fn open(&self, name: &str) -> Result<Stream<'_>>;

    /// True if there is a file of that name, and the name is accepted.
    fn exists(&self, name: &str) -> bool;

    /// Called before the first data file is opened, if a header names several data files.
    fn announce(&self, _names: &[String]) {}

    /// Returns the names of all files whose names end in `suffix`, in upper or lower case, sorted; for
    /// formats whose header does not name its data files.
    fn ending_in(&self, suffix: &str) -> Vec<String>;
}

pub(crate) struct Folder {
    path: PathBuf,
    watcher: Option<Arc<dyn Watcher>>,
}

impl Folder {
    /// Returns access to the files in the folder `path`; the watcher, if any, observes their reading.
    pub(crate) fn new(path: impl Into<PathBuf>, watcher: Option<Arc<dyn Watcher>>) -> Self {
        Self { path: path.into(), watcher }
    }

    /// Returns the path of the file that a header names.
    ///
    /// # Errors
    /// When the name is an absolute path: with such a path, a header could name any file of this machine.
    pub(crate) fn path_of(&self, name: &str) -> Result<PathBuf> {
        let start = Path::new(name).components().next();
        ensure!(
            !matches!(start, Some(Component::RootDir | Component::Prefix(_))),
            "the header names the data file {name:?} by an absolute path; put the file beside the header, \
             and name it relative to the header"
        );
        Ok(self.path.join(name))
    }
}

impl Companions for Folder {
    fn open(&self, name: &str) -> Result<Stream<'_>> {
        let path = self.path_of(name)?;
        let mut stream =
            Stream::open(&path, self.watcher.as_ref()).context("the data file that the header names")?;
        stream.label = path.display().to_string();
        Ok(stream)
    }

    fn exists(&self, name: &str) -> bool {
        self.path_of(name).is_ok_and(|path| path.is_file())
    }

    fn ending_in(&self, suffix: &str) -> Vec<String> {
        let folder = if self.path.as_os_str().is_empty() { Path::new(".") } else { &self.path };
        let mut names: Vec<String> = std::fs::read_dir(folder)
            .into_iter()
            .flatten()
            .flatten()
            .filter_map(|entry| entry.file_name().into_string().ok())
            .filter(|name| super::strip_ending(name, suffix).is_some())
            .collect();
        names.sort();
        names
    }
}
