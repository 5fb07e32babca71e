//! Identity of a file: size, modification time and a hash of its content. Stored results (pictures, timing
//! tables) contain the identities of their inputs, so that a stored result is never used for changed files.

use crate::files::{fnv1a, fnv1a_after};
use crate::volume::{Companions, Folder, Format, Reading, Stream, Volume};
use anyhow::{Context, Result, bail};
use serde::{Deserialize, Serialize};
use std::cell::RefCell;
use std::collections::HashSet;
use std::fs::{File, Metadata};
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::time::UNIX_EPOCH;

/// Size of the largest file that is hashed whole, bytes.
const MAX_WHOLE_BYTES: u64 = 16 << 20;

/// Number of bytes that are hashed at each of three places of a larger file: beginning, middle and end.
const PART: u64 = 1 << 20;

/// Number of bytes at the beginning of a volume file in which names of data files are looked for.
const HEADER: u64 = 1 << 20;

const SECOND: u64 = 1_000_000_000;

/// Identity of a file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Identity {
    /// Name of the file; for a data file, the name in the header.
    pub name: String,
    /// Size of the file, bytes.
    pub bytes: u64,
    /// Time of the file's last change, nanoseconds since 1970. A new time counts as a change only for a file
    /// that was hashed in parts, and only in whole seconds, since copies may have no finer times.
    pub modified_ns: u64,
    /// FNV-1a (64 bits) and CRC-32 of the hashed bytes, hexadecimal.
    pub hash: String,
    /// True if the hash covers the whole content.
    pub whole: bool,
}

impl Identity {
    /// Reads the identity of a file.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn of(path: &Path, name: &str) -> Result<Self> {
        Self::read(path, name).with_context(|| format!("cannot read {}", path.display()))
    }

    fn read(path: &Path, name: &str) -> Result<Self> {
        let mut file = File::open(path)?;
        let metadata = file.metadata()?;
        let bytes = metadata.len();
        let whole = bytes <= MAX_WHOLE_BYTES;
        let (mut fnv, mut crc) = (fnv1a(&[]), crc32fast::Hasher::new());
        let last = bytes.saturating_sub(PART);
        let places = [0, last / 2, last];
        let (places, length) = if whole { (&places[..1], bytes) } else { (&places[..], PART) };
        for &at in places {
            file.seek(SeekFrom::Start(at))?;
            let mut part = Vec::new();
            file.by_ref().take(length).read_to_end(&mut part)?;
            crc.update(&part);
            fnv = fnv1a_after(fnv, &part);
        }
        Ok(Self {
            name: name.to_owned(),
            bytes,
            modified_ns: modified_ns(&metadata),
            hash: format!("{fnv:016x}{:08x}", crc.finalize()),
            whole,
        })
    }

    /// Returns the key of the identity: files with equal keys are treated as the same file.
    pub fn key(&self) -> String {
        let Self { name, bytes, hash, .. } = self;
        let modified = if self.whole { 0 } else { self.modified_ns / SECOND };
        format!("{name}\n{bytes}\n{hash}\n{modified}\n")
    }

    /// Returns the difference between two identities of a file, in words; `None` for the same file.
    fn difference(&self, now: &Self) -> Option<String> {
        let Self { name, .. } = self;
        if now.name != *name {
            return Some(format!("the file name changed from {name} to {}", now.name));
        }
        if now.bytes != self.bytes {
            return Some(format!("the size of {name} changed from {} to {} bytes", self.bytes, now.bytes));
        }
        if now.hash != self.hash {
            return Some(format!("the content of {name} changed (hash {}, was {})", now.hash, self.hash));
        }
        (now.key() != self.key()).then(|| format!("{name} has a new modification time"))
    }
}

fn modified_ns(metadata: &Metadata) -> u64 {
    let since = metadata.modified().ok().and_then(|t| t.duration_since(UNIX_EPOCH).ok());
    since.map_or(0, |d| u64::try_from(d.as_nanos()).unwrap_or(u64::MAX))
}

/// Returns the identities of a volume file and of the data files that its header names, the volume file
/// first.
///
/// # Errors
/// When one of the files cannot be read. Data files that do not exist are left out. A header that names no
/// data file, or cannot be understood, counts as an ordinary file.
pub fn of_volume(path: &Path) -> Result<Vec<Identity>> {
    let name = name_of(path);
    let mut out = vec![Identity::of(path, &name)?];
    let folder = path.parent().unwrap_or(Path::new(""));
    for name in data_files(path, &name) {
        let data = folder.join(&name);
        if data.is_file() {
            out.push(Identity::of(&data, &name)?);
        }
    }
    Ok(out)
}

/// True if a file is a volume by the ending of its name, or a JSON description whose voxels are beside it. A
/// file of raw voxels does not count as a volume; its JSON description does.
pub fn is_volume(path: &Path) -> bool {
    let name = name_of(path);
    match Format::of_name(&name) {
        None | Some(Format::Raw) => false,
        Some(Format::Json) => !data_files(path, &name).is_empty(),
        Some(_) => true,
    }
}

fn name_of(path: &Path) -> String {
    path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Returns the key of a volume's files: the keys of their identities, joined.
pub fn key(files: &[Identity]) -> String {
    files.iter().map(Identity::key).collect()
}

/// Returns the first difference between two lists of identities of a volume's files, in words; `None` for the
/// same files.
pub fn difference(then: &[Identity], now: &[Identity]) -> Option<String> {
    let missing = |of: &[Identity], than: &[Identity]| {
        let lone = of.iter().skip(1).find(|f| than.iter().all(|g| g.name != f.name));
        lone.map(|f| f.name.clone())
    };
    if let Some(name) = missing(then, now) {
        return Some(format!("the data file {name} is gone"));
    }
    if let Some(name) = missing(now, then) {
        return Some(format!("{name} is a new data file of the volume"));
    }
    then.iter().zip(now).find_map(|(a, b)| a.difference(b))
}

/// True if `known` has every file of a volume, by size and content: names and modification times of copies
/// differ.
pub fn contained(files: &[Identity], known: &[Identity]) -> bool {
    files.iter().all(|f| known.iter().any(|k| (k.bytes, &k.hash) == (f.bytes, &f.hash)))
}

/// Returns the difference between a volume's files and earlier identities, which may come from another
/// machine; `None` for the same files. Files are read only if a size or a modification time differs.
///
/// # Errors
/// When a file cannot be read.
pub fn changed(path: &Path, then: &[Identity]) -> Result<Option<String>> {
    let folder = path.parent().unwrap_or(Path::new(""));
    let untouched = then.iter().enumerate().all(|(i, file)| {
        let place = if i == 0 { path.to_owned() } else { folder.join(&file.name) };
        std::fs::metadata(place).is_ok_and(|m| m.len() == file.bytes && modified_ns(&m) == file.modified_ns)
    });
    if untouched {
        return Ok(None);
    }
    Ok(difference(then, &of_volume(path)?))
}

/// Returns the names of the data files that a volume's header names.
fn data_files(path: &Path, name: &str) -> Vec<String> {
    let mut head = Vec::new();
    let read = File::open(path).and_then(|f| f.take(HEADER).read_to_end(&mut head));
    let format = Format::of_name(name).or_else(|| Format::of_content(&head));
    let (Ok(_), Some(format)) = (read, format) else { return Vec::new() };
    let folder = Folder::new(path.parent().unwrap_or(Path::new("")), None);
    let noted = Noted { folder, names: RefCell::default(), known: RefCell::default() };
    // The reader stops at the latest when it opens a data file; its error does not matter here.
    let _ = Volume::read(format, Stream::from_bytes(&head), name, &noted, &Reading::default());
    noted.names.into_inner()
}

/// Records the names of the data files that a volume's reader requests, and opens none of them. Names that
/// [`Folder`] refuses are not recorded.
struct Noted {
    folder: Folder,
    names: RefCell<Vec<String>>,
    /// The set of `names`, to find a name fast.
    known: RefCell<HashSet<String>>,
}

impl Noted {
    fn note(&self, name: &str) {
        if self.folder.path_of(name).is_ok() && self.known.borrow_mut().insert(name.to_owned()) {
            self.names.borrow_mut().push(name.to_owned());
        }
    }
}

impl Companions for Noted {
    fn open(&self, name: &str) -> Result<Stream<'_>> {
        self.note(name);
        bail!("{name} is noted")
    }

    fn announce(&self, names: &[String]) {
        names.iter().for_each(|name| self.note(name));
    }

    fn exists(&self, name: &str) -> bool {
        self.folder.exists(name)
    }

    fn ending_in(&self, suffix: &str) -> Vec<String> {
        self.folder.ending_in(suffix)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 2 2 2\nencoding: raw\n";

    #[test]
    fn a_file_is_its_content_and_a_copy_is_the_same() {
        let dir = tempfile::tempdir().unwrap();
        let (a, b) = (dir.path().join("a.nrrd"), dir.path().join("b").join("a.nrrd"));
        std::fs::create_dir(dir.path().join("b")).unwrap();
        std::fs::write(&a, format!("{HEADER}\nabcdefgh")).unwrap();
        std::fs::write(&b, format!("{HEADER}\nabcdefgh")).unwrap();
        let was = of_volume(&a).unwrap();
        assert_eq!((was.len(), key(&was)), (1, key(&of_volume(&b).unwrap())));
        // A new modification time does not change the identity of a small file. New content does, even of the
        // same size.
        File::options()
            .write(true)
            .open(&a)
            .unwrap()
            .set_modified(UNIX_EPOCH + std::time::Duration::from_secs(9))
            .unwrap();
        assert_eq!(difference(&was, &of_volume(&a).unwrap()), None);
        let copy = dir.path().join("copy.nrrd");
        std::fs::copy(&a, &copy).unwrap();
        assert!(contained(&of_volume(&copy).unwrap(), &was) && !contained(&was, &[]));
        std::fs::write(&a, format!("{HEADER}\nabcdefgX")).unwrap();
        assert!(!contained(&of_volume(&a).unwrap(), &was));
        assert!(difference(&was, &of_volume(&a).unwrap()).unwrap().contains("content of a.nrrd"));
        assert!(changed(&a, &was).unwrap().is_some());
        std::fs::write(&a, format!("{HEADER}\nabcdefghi")).unwrap();
        assert!(difference(&was, &of_volume(&a).unwrap()).unwrap().contains("bytes"));
        assert_eq!(changed(&b, &was).unwrap(), None);
    }

    #[test]
    fn data_beside_a_header_belongs_to_it() {
        let dir = tempfile::tempdir().unwrap();
        let header = dir.path().join("a.nhdr");
        std::fs::write(&header, format!("{HEADER}data file: voxels.raw\n\n")).unwrap();
        std::fs::write(dir.path().join("voxels.raw"), "abcdefgh").unwrap();
        let was = of_volume(&header).unwrap();
        assert_eq!(was.iter().map(|f| f.name.as_str()).collect::<Vec<_>>(), ["a.nhdr", "voxels.raw"]);
        assert_eq!(changed(&header, &was).unwrap(), None);
        std::fs::write(dir.path().join("voxels.raw"), "abcdXfgh").unwrap();
        assert!(difference(&was, &of_volume(&header).unwrap()).unwrap().contains("voxels.raw"));
        assert!(changed(&header, &was).unwrap().is_some());
        std::fs::remove_file(dir.path().join("voxels.raw")).unwrap();
        assert!(difference(&was, &of_volume(&header).unwrap()).unwrap().contains("is gone"));
    }

    #[test]
    fn a_file_that_a_header_names_by_an_absolute_path_is_not_read() {
        let dir = tempfile::tempdir().unwrap();
        let (header, voxels) = (dir.path().join("a.nhdr"), dir.path().join("voxels.raw"));
        std::fs::write(&voxels, "abcdefgh").unwrap();
        for list in ["", "LIST 3\n"] {
            std::fs::write(&header, format!("{HEADER}data file: {list}{}\n", voxels.display())).unwrap();
            let files = of_volume(&header).unwrap();
            assert_eq!(files.iter().map(|f| f.name.as_str()).collect::<Vec<_>>(), ["a.nhdr"], "{list}");
        }
    }

    #[test]
    fn all_of_several_data_files_belong_to_their_header() {
        let dir = tempfile::tempdir().unwrap();
        let header = dir.path().join("a.nhdr");
        std::fs::write(&header, format!("{HEADER}data file: LIST\none.raw\ntwo.raw\n")).unwrap();
        std::fs::write(dir.path().join("one.raw"), "abcd").unwrap();
        std::fs::write(dir.path().join("two.raw"), "efgh").unwrap();
        let was = of_volume(&header).unwrap();
        assert_eq!(was.iter().map(|f| f.name.as_str()).collect::<Vec<_>>(), ["a.nhdr", "one.raw", "two.raw"]);
        std::fs::write(dir.path().join("two.raw"), "efgX").unwrap();
        assert!(difference(&was, &of_volume(&header).unwrap()).unwrap().contains("two.raw"));
        // The list is read to its end. Its names count even if the volume's size does not fit their number.
        let list = "one.raw\n".repeat(9000) + "two.raw\n";
        std::fs::write(&header, format!("{HEADER}data file: LIST\n{list}")).unwrap();
        assert!(of_volume(&header).unwrap().iter().any(|f| f.name == "two.raw"));
    }

    #[test]
    fn a_large_file_is_its_ends_its_middle_and_its_time() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("large.raw");
        let mut bytes = vec![7u8; MAX_WHOLE_BYTES as usize + 8];
        let write = |bytes: &[u8], milliseconds: u64| {
            std::fs::write(&path, bytes).unwrap();
            let time = UNIX_EPOCH + std::time::Duration::from_millis(milliseconds);
            File::options().write(true).open(&path).unwrap().set_modified(time).unwrap();
            of_volume(&path).unwrap()
        };
        let was = write(&bytes, 1_000_750);
        assert!(!was[0].whole);
        // The copy of a file may have a time in whole seconds.
        for milliseconds in [1_000_750, 1_000_000] {
            let copy = write(&bytes, milliseconds);
            assert_eq!((key(&copy), difference(&was, &copy)), (key(&was), None));
            assert_eq!(changed(&path, &was).unwrap(), None);
        }
        assert!(difference(&was, &write(&bytes, 1_001_000)).unwrap().contains("time"));
        assert!(changed(&path, &was).unwrap().unwrap().contains("time"));
        let middle = bytes.len() / 2;
        for at in [0, middle, bytes.len() - 1] {
            bytes[at] = 8;
            assert!(difference(&was, &write(&bytes, 1_000_750)).unwrap().contains("content"), "{at}");
            bytes[at] = 7;
        }
    }
}
