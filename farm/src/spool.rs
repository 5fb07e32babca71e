//! The spool: files to which workers append their answers. The driver reads them while they grow.

use super::engine::Event;
use super::record::Line;
use anyhow::{Context, Result};
use std::collections::HashMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// The file to which a bundle's worker appends its answers.
pub(crate) fn path(state: &Path, bundle: u64) -> PathBuf {
    state.join("spool").join(format!("{bundle}.jsonl"))
}

/// Returns the complete lines of a spool file; no lines if there is no file. Skips lines that a killed worker
/// left incomplete.
pub(crate) fn lines(path: &Path) -> Result<Vec<Line>> {
    Follow::default().read(path)
}

#[derive(Debug, Default)]
struct Follow {
    at: u64,
    rest: Vec<u8>,
}

impl Follow {
    fn read(&mut self, path: &Path) -> Result<Vec<Line>> {
        let mut file = match File::open(path) {
            Ok(file) => file,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(e) => return Err(e).with_context(|| format!("cannot read {}", path.display())),
        };
        let fail = || format!("cannot read {}", path.display());
        file.seek(SeekFrom::Start(self.at)).with_context(fail)?;
        self.at += file.read_to_end(&mut self.rest).with_context(fail)? as u64;
        let mut out = Vec::new();
        let mut begin = 0;
        while let Some(length) = self.rest[begin..].iter().position(|b| *b == b'\n') {
            out.extend(serde_json::from_slice(&self.rest[begin..begin + length]).ok());
            begin += length + 1;
        }
        self.rest.drain(..begin);
        Ok(out)
    }
}

/// Reader of the answers that workers append to the files of running bundles.
#[derive(Debug)]
pub(crate) struct Spool {
    state: PathBuf,
    open: HashMap<u64, Follow>,
}

impl Spool {
    pub(crate) fn new(state: &Path) -> Self {
        Self { state: state.to_owned(), open: HashMap::new() }
    }

    /// Starts to read a bundle's file, from its beginning.
    pub(crate) fn follow(&mut self, bundle: u64) {
        self.open.entry(bundle).or_default();
    }

    pub(crate) fn bundles(&self) -> impl Iterator<Item = u64> + '_ {
        self.open.keys().copied()
    }

    /// Returns the lines that were added since the last call. Once a bundle has ended, its file is not read
    /// again.
    pub(crate) fn poll(&mut self) -> Result<Vec<Event>> {
        let mut out = Vec::new();
        let mut ended = Vec::new();
        for (&bundle, follow) in &mut self.open {
            for line in follow.read(&path(&self.state, bundle))? {
                if matches!(line, Line::End { .. }) {
                    ended.push(bundle);
                }
                out.push(Event::Line(bundle, line));
            }
        }
        for bundle in ended {
            self.open.remove(&bundle);
        }
        Ok(out)
    }

    /// Stops reading a bundle's file. Returns false if the file was not read.
    pub(crate) fn forget(&mut self, bundle: u64) -> bool {
        self.open.remove(&bundle).is_some()
    }
}

/// Returns the last MiB of a log as text; an empty text if the log cannot be read.
pub(crate) fn end_of(log: &Path) -> String {
    const BYTES: u64 = 1 << 20;
    let mut bytes = Vec::new();
    if let Ok(mut file) = File::open(log) {
        let length = file.metadata().map_or(0, |m| m.len());
        if file.seek(SeekFrom::Start(length.saturating_sub(BYTES))).is_ok() {
            let _ = file.take(BYTES).read_to_end(&mut bytes);
        }
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

/// Returns the last line that is not blank in the last MiB of a log, without sequences that set a terminal's
/// colors, cut to 300 characters. A carriage return ends a line, since progress bars are printed with it.
pub(crate) fn tail(log: &Path) -> String {
    let text = end_of(log);
    let line = text.rsplit(['\n', '\r']).map(without_colors).find(|l| !l.trim().is_empty());
    line.map_or_else(|| "it printed nothing".into(), |l| l.chars().take(300).collect())
}

fn without_colors(line: &str) -> String {
    let mut parts = line.split("\u{1b}[");
    let first = parts.next().unwrap_or_default().to_owned();
    // A sequence ends with its first letter.
    let rest = parts.map(|part| part.split_once(|c: char| c.is_ascii_alphabetic()).map_or("", |ends| ends.1));
    first + &rest.collect::<String>()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_line_of_a_long_log_is_found() {
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("log");
        std::fs::write(&log, "a line\n".repeat(300_000) + "no space left\n\n").unwrap();
        assert_eq!(tail(&log), "no space left");
        let end = end_of(&log);
        assert!(end.len() == 1 << 20 && end.ends_with("a line\nno space left\n\n"), "{}", end.len());
        assert_eq!(tail(&folder.path().join("none")), "it printed nothing");
        std::fs::write(&log, "\u{1b}[0m\u{1b}[31mFATL| Signal: SIGABRT\u{1b}[0m\n\u{1b}[0m\n").unwrap();
        assert_eq!(tail(&log), "FATL| Signal: SIGABRT");
        std::fs::write(&log, "10 %\r20 %\rout of memory\r\n").unwrap();
        assert_eq!(tail(&log), "out of memory");
    }
}
