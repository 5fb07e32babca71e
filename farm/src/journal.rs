//! The journal: results line by line, appended and flushed to the disk before anything relies on them. The
//! only writer of the journal holds a lock on a file beside it.

use super::record::Entry;
use anyhow::{Context, Result};
use entire_io::files::lock_alone;
use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, ErrorKind, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

#[derive(Debug)]
pub(crate) struct Journal {
    file: File,
    path: PathBuf,
    waiting: Vec<u8>,
    _lock: File,
}

impl Journal {
    /// Opens a state folder's journal, calls `each` for its entries, and cuts off a partial last line.
    ///
    /// # Errors
    /// When another driver holds the lock, a line is damaged, or a file cannot be read.
    pub(crate) fn open(state: &Path, mut each: impl FnMut(Entry) -> Result<()>) -> Result<Self> {
        let lock_path = state.join("lock");
        let lock = OpenOptions::new().create(true).write(true).truncate(false).open(&lock_path);
        let lock = lock.with_context(|| format!("cannot open {}", lock_path.display()))?;
        lock_alone(&lock, &lock_path, "another `entire farm` works on this database; wait for it or end it")?;
        let path = state.join("journal.jsonl");
        let fail = || format!("the journal {}", path.display());
        let mut file =
            OpenOptions::new().create(true).read(true).append(true).open(&path).with_context(fail)?;
        let good = read(&file, &mut each).with_context(fail)?;
        if file.metadata().with_context(fail)?.len() > good {
            file.set_len(good).with_context(fail)?;
        }
        file.seek(SeekFrom::End(0)).with_context(fail)?;
        Ok(Self { file, path, waiting: Vec::new(), _lock: lock })
    }

    /// Adds an entry. It is on the disk after [`Journal::flush`].
    pub(crate) fn add(&mut self, entry: &Entry) {
        serde_json::to_writer(&mut self.waiting, entry)
            .expect("every entry is valid JSON, written to memory");
        self.waiting.push(b'\n');
    }

    /// Flushes added entries to the disk.
    ///
    /// # Errors
    /// When the disk is full or fails; the entries are kept for the next flush.
    pub(crate) fn flush(&mut self) -> Result<()> {
        if self.waiting.is_empty() {
            return Ok(());
        }
        let before = self.file.metadata()?.len();
        let written = self.file.write_all(&self.waiting).and_then(|()| self.file.sync_data());
        if let Err(error) = written {
            // Removes a partly written line.
            let _ = self.file.set_len(before);
            return Err(error).with_context(|| {
                format!(
                    "cannot write the journal {}; free disk space and continue with --resume",
                    self.path.display()
                )
            });
        }
        self.waiting.clear();
        Ok(())
    }
}

/// Calls `each` for every complete line; returns the length of these lines, bytes.
fn read(file: &File, each: &mut dyn FnMut(Entry) -> Result<()>) -> Result<u64> {
    let mut reader = BufReader::new(file);
    let (mut line, mut good, mut number) = (Vec::new(), 0u64, 0usize);
    loop {
        line.clear();
        let count = reader.read_until(b'\n', &mut line)?;
        number += 1;
        if count == 0 || line.last() != Some(&b'\n') {
            return Ok(good);
        }
        let mut entry: Entry = serde_json::from_slice(&line).with_context(|| {
            format!(
                "line {number} is damaged; restore the journal from a copy, or set another `output` in the job \
                 file"
            )
        })?;
        // The answer may lack the expected seconds; the entry has them.
        if let Entry::Done { answer, predicted_s } = &mut entry {
            answer.predicted_s = *predicted_s;
        }
        each(entry)?;
        good += count as u64;
    }
}

/// Reads the journal of a state folder without locking it; no entries if there is no journal yet.
pub(crate) fn entries(state: &Path) -> Result<Vec<Entry>> {
    let path = state.join("journal.jsonl");
    let mut out = Vec::new();
    let file = match File::open(&path) {
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(out),
        opened => opened.with_context(|| format!("cannot read the journal {}", path.display()))?,
    };
    read(&file, &mut |e| {
        out.push(e);
        Ok(())
    })
    .with_context(|| format!("the journal {}", path.display()))?;
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lost(task: &str) -> Entry {
        Entry::Lost { task: task.into(), why: "x".into() }
    }

    #[test]
    fn whole_lines_are_read_back_and_a_torn_one_is_cut_off() {
        let dir = tempfile::tempdir().unwrap();
        let mut journal = Journal::open(dir.path(), |_| panic!("it is new")).unwrap();
        journal.add(&lost("a"));
        journal.flush().unwrap();
        journal.add(&lost("b"));
        journal.flush().unwrap();
        // A second writer is refused while the first is there.
        let said = format!("{:#}", Journal::open(dir.path(), |_| Ok(())).unwrap_err());
        assert!(said.contains("another `entire farm`"), "{said}");
        drop(journal);
        let path = dir.path().join("journal.jsonl");
        let whole = std::fs::read(&path).unwrap();
        for cut in 1..whole.len() / 2 {
            std::fs::write(&path, &whole[..whole.len() - cut]).unwrap();
            let mut found = Vec::new();
            let mut journal = Journal::open(dir.path(), |e| {
                found.push(e);
                Ok(())
            })
            .unwrap();
            assert_eq!(found, [lost("a")]);
            journal.add(&lost("c"));
            journal.flush().unwrap();
            drop(journal);
            assert_eq!(entries(dir.path()).unwrap(), [lost("a"), lost("c")]);
        }
        std::fs::write(&path, [b"{}\n".as_slice(), &whole].concat()).unwrap();
        let said = format!("{:#}", Journal::open(dir.path(), |_| Ok(())).unwrap_err());
        assert!(said.contains("line 1"), "{said}");
    }
}
