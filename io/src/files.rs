//! Reading and writing of whole files, among them models; numbers as text, and notes on standard error.

use crate::quiet::is_quiet;
use anyhow::{Context, Result, anyhow, bail, ensure};
use entire_core::model::{Model, ModelFile};
use flate2::{Compression, read::MultiGzDecoder, write::GzEncoder};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::{File, Metadata, TryLockError};
use std::io::{BufWriter, Read, Write};
use std::path::{Component, Path, PathBuf};

/// Maximum size of a model file, in bytes.
const MAX_MODEL_BYTES: u64 = 4 << 30;

/// Maximum size of a file that is read whole, in bytes; for a compressed file, also after decompression.
const MAX_TABLE_BYTES: u64 = 4 << 30;

/// Returns the bytes of a model file.
///
/// # Errors
/// When the file cannot be read, or is larger than 4 GiB.
pub fn read_model_bytes(path: &Path) -> Result<Vec<u8>> {
    let shown = path.display();
    ensure!(
        path.exists(),
        "cannot read {shown}: no such file; check the path, or make a model with `entire calibrate`"
    );
    read_at_most(path, MAX_MODEL_BYTES).with_context(|| format!("{shown}"))
}

/// Returns the model in the bytes of a file.
///
/// # Errors
/// When the bytes are no valid model: one line that names the file and the wrong tensor or metadata key, if
/// any.
pub fn parse_model(path: &Path, bytes: &[u8]) -> Result<Model> {
    Model::from_bytes(bytes).map_err(|error| anyhow!("{}: {error}", path.display()))
}

/// Reads a model file.
///
/// # Errors
/// Those of [`read_model_bytes`] and [`parse_model`].
pub fn open_model(path: &Path) -> Result<Model> {
    parse_model(path, &read_model_bytes(path)?)
}

/// Reads a model file, and returns it both as stored and as a checked model.
///
/// # Errors
/// Those of [`open_model`].
pub fn read_model_file(path: &Path) -> Result<(ModelFile, Model)> {
    let bytes = read_model_bytes(path)?;
    let model = parse_model(path, &bytes)?;
    let file = ModelFile::from_bytes(&bytes).map_err(|error| anyhow!("{}: {error}", path.display()))?;
    Ok((file, model))
}

/// Checks the path of a model file to be written, and makes its folder.
///
/// # Errors
/// When its name does not end in `.safetensors`, or the folder cannot be made.
pub fn check_model_out(out: &Path) -> Result<()> {
    ensure!(
        out.extension().is_some_and(|e| e == "safetensors"),
        "--out is {}; the model file's name must end in .safetensors",
        out.display()
    );
    make_folder_of(out)
}

/// Makes the folder of a file if it does not exist.
///
/// # Errors
/// When the folder cannot be made.
pub fn make_folder_of(file: &Path) -> Result<()> {
    match file.parent().filter(|f| !f.as_os_str().is_empty()) {
        Some(folder) => make_folder(folder),
        None => Ok(()),
    }
}

/// Checks that an output would not replace one of the inputs.
///
/// # Errors
/// When the output is one of the inputs; the error names the file.
pub fn ensure_not_input<'a>(out: &Path, inputs: impl IntoIterator<Item = &'a Path>) -> Result<()> {
    let Ok(place) = out.canonicalize() else { return Ok(()) };
    for input in inputs {
        ensure!(
            !place.is_file() || input.canonicalize().ok().as_ref() != Some(&place),
            "{} is an input of this command and would be replaced; choose another name",
            out.display()
        );
    }
    Ok(())
}

/// Checks that an output is none of the files with the names `own`, which the command writes into `folder`.
/// The folder of the output must exist.
///
/// # Errors
/// When the output is one of these files; the error names it.
pub fn ensure_not_own(out: &Path, folder: &Path, own: &[&str]) -> Result<()> {
    let (Some(place), Ok(folder)) = (place_of(out), folder.canonicalize()) else { return Ok(()) };
    ensure!(
        own.iter().all(|name| folder.join(name) != place),
        "{} is written by this command itself; choose another name",
        out.display()
    );
    Ok(())
}

/// Returns the path of a file, with the links in its folder's path resolved; `None` if there is no such
/// folder or the path names no file.
fn place_of(path: &Path) -> Option<PathBuf> {
    let folder = path.parent().filter(|f| !f.as_os_str().is_empty()).unwrap_or(Path::new("."));
    Some(folder.canonicalize().ok()?.join(path.file_name()?))
}

/// Checks that no file is given twice, even under different spellings of its path. The files need not exist.
///
/// # Errors
/// When two paths lead to the same file; the error names them.
pub fn ensure_distinct(paths: &[PathBuf]) -> Result<()> {
    let mut seen: BTreeMap<PathBuf, &Path> = BTreeMap::new();
    for path in paths {
        let place = path.canonicalize().ok().or_else(|| place_of(path)).unwrap_or_else(|| path.clone());
        if let Some(before) = seen.insert(place, path) {
            let (path, before) = (path.display(), before.display());
            bail!("{path} is given twice, first as {before}; give every file once");
        }
    }
    Ok(())
}

/// Returns a path without `.` and `..`: `a/b/../c` becomes `a/c`. Links are not followed. `..` at the
/// beginning of a relative path stays.
pub fn without_dots(path: &Path) -> PathBuf {
    let mut out = PathBuf::new();
    for part in path.components() {
        match (part, out.components().next_back()) {
            (Component::CurDir, _) | (Component::ParentDir, Some(Component::RootDir)) => {}
            (Component::ParentDir, Some(Component::Normal(_))) => {
                out.pop();
            }
            (part, _) => out.push(part),
        }
    }
    out
}

/// Makes a folder and its parents if they do not exist.
///
/// # Errors
/// When the folder cannot be made.
pub fn make_folder(folder: &Path) -> Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))
}

/// Writes a file, whole or not at all: the bytes go to a file with an unpredictable name beside `path`, which
/// is flushed to the disk and then renamed. A link at `path` is replaced, not followed; in `/dev`, no file is
/// made or replaced. If `path` is a device or a pipe, the bytes are written to it directly.
///
/// # Errors
/// When the file cannot be written; the error names it.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    write_whole_with(path, |file| Ok(file.write_all(bytes)?))
}

/// Writes a file as [`write_whole`] does; `fill` writes the file's content.
///
/// # Errors
/// Those of [`write_whole`] and of `fill`.
pub fn write_whole_with(path: &Path, fill: impl FnOnce(&mut dyn Write) -> Result<()>) -> Result<()> {
    let fail = || format!("cannot write {}", path.display());
    let fill = |file: &mut File| -> Result<()> {
        let mut buffered = BufWriter::new(&*file);
        fill(&mut buffered)?;
        Ok(buffered.flush()?)
    };
    if std::fs::metadata(path).is_ok_and(|there| !there.is_file()) {
        let mut there = File::options().write(true).open(path).with_context(fail)?;
        return fill(&mut there).map_err(|error| match error.downcast_ref::<std::io::Error>() {
            // The programs take an error of this kind for a closed standard output, and end with success.
            Some(e) if e.kind() == std::io::ErrorKind::BrokenPipe => anyhow!("{}: {error:#}", fail()),
            _ => error.context(fail()),
        });
    }
    let folder = path.parent().filter(|f| !f.as_os_str().is_empty()).unwrap_or(Path::new("."));
    // If standard output is a file, the link /dev/stdout leads to this file. The link must not be
    // replaced.
    ensure!(
        folder != Path::new("/dev"),
        "cannot write {}: no file in /dev is made or replaced; name a file elsewhere",
        path.display()
    );
    let mut builder = tempfile::Builder::new();
    builder.prefix(".").suffix(".part");
    // The file gets the permissions of any new file: read and write for all, less the user's umask.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let mut part = builder.tempfile_in(folder).with_context(fail)?;
    fill(part.as_file_mut()).with_context(fail)?;
    part.as_file().sync_all().with_context(fail)?;
    part.persist(path).map_err(|e| e.error).with_context(fail)?;
    Ok(())
}

/// Writes a value as indented JSON with a line break at its end, whole or not at all ([`write_whole`]).
///
/// # Errors
/// Those of [`write_whole`].
pub fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<()> {
    write_whole(path, (serde_json::to_string_pretty(value)? + "\n").as_bytes())
}

/// Locks a file for this process only; the system releases the lock when the process ends, even by a crash. A
/// child process that another thread is starting holds a copy of the lock between fork and exec, so locking
/// is retried for 0.3 seconds. On a file system without locks the file stays unlocked, and other processes
/// cannot be excluded.
///
/// # Errors
/// When another process holds the lock (the error then ends with `busy`), or the system cannot lock the file.
pub fn lock_alone(file: &File, path: &Path, busy: &str) -> Result<()> {
    let mut locked = file.try_lock();
    for _ in 0..10 {
        if !matches!(locked, Err(TryLockError::WouldBlock)) {
            break;
        }
        std::thread::sleep(std::time::Duration::from_millis(30));
        locked = file.try_lock();
    }
    match locked {
        Ok(()) => Ok(()),
        Err(TryLockError::WouldBlock) => bail!("{} is locked: {busy}", path.display()),
        Err(TryLockError::Error(e)) if e.kind() == std::io::ErrorKind::Unsupported => Ok(()),
        Err(TryLockError::Error(e)) => Err(e).with_context(|| format!("cannot lock {}", path.display())),
    }
}

/// Returns the content of a file, decompressed if the name ends in `.gz`.
///
/// # Errors
/// When the file cannot be read, is damaged, or decompresses to more than 4 GiB.
pub fn read_decompressed(path: &Path) -> Result<Vec<u8>> {
    let bytes = read_bytes(path)?;
    if path.extension().is_none_or(|e| e != "gz") {
        return Ok(bytes);
    }
    let mut out = Vec::new();
    MultiGzDecoder::new(&bytes[..])
        .take(MAX_TABLE_BYTES + 1)
        .read_to_end(&mut out)
        .map_err(|e| anyhow!("the gzip stream is damaged: {e}"))?;
    ensure!(
        out.len() as u64 <= MAX_TABLE_BYTES,
        "the file decompresses to more than {} GiB",
        MAX_TABLE_BYTES >> 30
    );
    Ok(out)
}

/// Opens a regular file, and returns its length too.
///
/// # Errors
/// When the file is missing, unreadable or not a regular file; the error names the path.
pub(crate) fn open_regular(path: &Path) -> Result<(File, u64)> {
    let shown = path.display();
    let refused = |error: std::io::Error| match error.kind() {
        std::io::ErrorKind::NotFound => anyhow!("{shown}: no such file; check the path"),
        _ => anyhow!("{shown}: cannot be opened: {error}"),
    };
    // Opening a FIFO waits for its writer, so the kind of the file is checked first.
    check_regular(path, &std::fs::metadata(path).map_err(refused)?)?;
    let file = File::open(path).map_err(refused)?;
    let metadata = file.metadata().with_context(|| format!("{shown}"))?;
    check_regular(path, &metadata)?;
    Ok((file, metadata.len()))
}

/// Refuses folders, and files that may have no end or wait for a writer: FIFOs, sockets, devices.
fn check_regular(path: &Path, metadata: &Metadata) -> Result<()> {
    let shown = path.display();
    ensure!(!metadata.is_dir(), "{shown}: is a folder; name a file in it");
    if metadata.is_file() {
        return Ok(());
    }
    let kind = kind_of(metadata);
    bail!("{shown}: is {kind}, not a regular file; save its content to a file and name that file")
}

#[cfg(unix)]
fn kind_of(metadata: &Metadata) -> &'static str {
    use std::os::unix::fs::FileTypeExt;
    let kind = metadata.file_type();
    if kind.is_fifo() {
        "a FIFO"
    } else if kind.is_socket() {
        "a socket"
    } else if kind.is_char_device() || kind.is_block_device() {
        "a device"
    } else {
        "something else"
    }
}

#[cfg(not(unix))]
fn kind_of(_: &Metadata) -> &'static str {
    "something else"
}

/// Returns the bytes of a regular file of at most `most` bytes. Bytes that are appended to the file later are
/// not read.
fn read_at_most(path: &Path, most: u64) -> Result<Vec<u8>> {
    let (file, length) = open_regular(path)?;
    ensure!(length <= most, "is longer than the {most} bytes accepted here");
    let mut bytes = Vec::new();
    ensure!(
        bytes.try_reserve_exact(length as usize).is_ok(),
        "{length} bytes do not fit into this machine's memory"
    );
    file.take(length).read_to_end(&mut bytes).context("reading")?;
    Ok(bytes)
}

/// Reads a regular file of at most 4 GiB.
///
/// # Errors
/// When the file is no regular file, is larger than 4 GiB, or cannot be read.
pub fn read_bytes(path: &Path) -> Result<Vec<u8>> {
    read_at_most(path, MAX_TABLE_BYTES)
}

/// Returns the text of a regular file of at most `most` bytes, without a byte order mark.
///
/// # Errors
/// When the file is no regular file, is larger, cannot be read, or is neither UTF-8 nor UTF-16 with a byte
/// order mark.
pub fn read_text(path: &Path, most: u64) -> Result<String> {
    Ok(decode_text(&read_at_most(path, most)?)?.into_owned())
}

/// Byte order mark that some editors put before UTF-8 text.
pub(crate) const BYTE_ORDER_MARK: [u8; 3] = [0xef, 0xbb, 0xbf];

/// Returns text without its byte order mark, if it has one.
pub(crate) fn without_mark(text: &[u8]) -> &[u8] {
    text.strip_prefix(&BYTE_ORDER_MARK).unwrap_or(text)
}

/// Decodes text: UTF-8 with or without a byte order mark, or UTF-16 with a byte order mark, which some
/// spreadsheets write.
///
/// # Errors
/// When the bytes are not such text; for UTF-8, the error names the position of the first invalid byte.
pub fn decode_text(bytes: &[u8]) -> Result<Cow<'_, str>> {
    let unit: fn([u8; 2]) -> u16 = match bytes {
        [0xff, 0xfe, ..] => u16::from_le_bytes,
        [0xfe, 0xff, ..] => u16::from_be_bytes,
        _ => {
            return match std::str::from_utf8(without_mark(bytes)) {
                Ok(text) => Ok(Cow::Borrowed(text)),
                Err(e) => {
                    let at = e.valid_up_to() + bytes.len() - without_mark(bytes).len();
                    bail!("byte {at} is not UTF-8; save the file as UTF-8")
                }
            };
        }
    };
    let (units, rest) = bytes[2..].as_chunks::<2>();
    ensure!(rest.is_empty(), "the text begins as UTF-16 and ends in half a character; save it as UTF-8");
    match char::decode_utf16(units.iter().map(|&b| unit(b))).collect::<Result<String, _>>() {
        Ok(text) => Ok(Cow::Owned(text)),
        Err(_) => bail!("the text begins as UTF-16 but is not valid UTF-16; save the file as UTF-8"),
    }
}

/// Compresses bytes as gzip; the same bytes give the same file.
///
/// # Errors
/// Never in practice, since the encoder writes to memory.
pub fn gzip(bytes: &[u8]) -> Result<Vec<u8>> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
    encoder.write_all(bytes)?;
    Ok(encoder.finish()?)
}

/// Returns the 64-bit FNV-1a hash of bytes.
pub fn fnv1a(bytes: &[u8]) -> u64 {
    fnv1a_after(0xcbf2_9ce4_8422_2325, bytes)
}

/// Continues the hash [`fnv1a`]: `before` is the hash of all preceding bytes.
pub(crate) fn fnv1a_after(before: u64, bytes: &[u8]) -> u64 {
    bytes.iter().fold(before, |h, &b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3))
}

/// Returns the hash [`fnv1a`] as 16 hexadecimal digits.
pub fn fnv1a_text(bytes: &[u8]) -> String {
    format!("{:016x}", fnv1a(bytes))
}

/// Prints a note on standard error, unless the program [is quiet](is_quiet).
pub fn note(text: &str) {
    if is_quiet() {
        return;
    }
    // A closed standard error is no reason to fail.
    let _ = writeln!(std::io::stderr().lock(), "note: {text}");
}

/// Parses numbers separated by commas.
///
/// # Errors
/// When an entry is not a number.
pub fn numbers_in(text: &str) -> Result<Vec<f32>, String> {
    text.split(',')
        .map(|word| word.trim().parse().map_err(|_| format!("{:?} is not a number", word.trim())))
        .collect()
}

/// Reads exactly `N` comma-separated numbers.
///
/// # Errors
/// When there are more or fewer numbers, or an entry is not a number.
pub fn parse_numbers<const N: usize>(text: &str) -> Result<[f32; N], String> {
    let found = numbers_in(text)?;
    let count = found.len();
    found.try_into().map_err(|_| format!("{N} numbers separated by commas are expected, there are {count}"))
}

/// Returns a number as text with 9 significant digits, such as `1.23456789e-3`. Reading the text gives the
/// same `f32`.
pub fn digits(value: f32) -> String {
    format!("{value:.8e}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hashes_are_those_of_the_published_test_vectors() {
        assert_eq!([fnv1a(b""), fnv1a(b"a")], [0xcbf2_9ce4_8422_2325, 0xaf63_dc4c_8601_ec8c]);
        assert_eq!(fnv1a_after(fnv1a(b"foo"), b"bar"), fnv1a(b"foobar"));
        assert_eq!(fnv1a_text(b"foobar"), "85944171f73967e8");
    }

    #[test]
    fn dots_are_taken_out_of_paths() {
        for (path, expected) in [
            ("a/b/../c", "a/c"),
            ("./a/./b", "a/b"),
            ("a/b/../../c", "c"),
            ("../a/../../b", "../../b"),
            ("/../a/..", "/"),
            ("a/..", ""),
        ] {
            assert_eq!(without_dots(Path::new(path)), Path::new(expected), "{path}");
        }
    }

    #[test]
    fn text_is_utf8_or_marked_utf16() {
        for bytes in [&b"\xef\xbb\xbfa\xc3\xbc"[..], b"a\xc3\xbc", b"\xff\xfea\0\xfc\0", b"\xfe\xff\0a\0\xfc"]
        {
            assert_eq!(decode_text(bytes).unwrap(), "aü", "{bytes:?}");
        }
        for (bytes, expected) in [
            (&b"a\xff"[..], "byte 1 is not UTF-8"),
            (b"\xef\xbb\xbfa\xff", "byte 4 is not UTF-8"),
            (b"\xff\xfea", "half a character"),
            (b"\xff\xfe\0\xd8", "begins as UTF-16"),
        ] {
            let message = decode_text(bytes).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn a_file_is_written_whole_and_nothing_is_left_beside_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("f.txt");
        write_whole(&path, b"first, and longer").unwrap();
        write_whole(&path, b"second").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"second");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
        // A missing folder, or a file in place of a folder, is an error; the file stays unchanged.
        for nowhere in [folder.path().join("none").join("f.txt"), path.join("f.txt")] {
            let said = format!("{:#}", write_whole(&nowhere, b"x").unwrap_err());
            assert!(said.contains(&format!("cannot write {}", nowhere.display())), "{said}");
        }
        assert_eq!(std::fs::read(&path).unwrap(), b"second");
    }

    #[cfg(unix)]
    #[test]
    fn a_link_is_replaced_and_what_it_led_to_stays() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let (target, link) = (folder.path().join("target"), folder.path().join("link"));
        std::fs::write(&target, "kept").unwrap();
        std::os::unix::fs::symlink(&target, &link).unwrap();
        write_whole(&link, b"new").unwrap();
        assert_eq!(std::fs::read_to_string(&target).unwrap(), "kept");
        assert_eq!(std::fs::read_to_string(&link).unwrap(), "new");
        assert!(std::fs::symlink_metadata(&link).unwrap().is_file());
        // The new file has the permissions of any file that this user makes.
        let mode = |path: &Path| std::fs::metadata(path).unwrap().permissions().mode();
        assert_eq!(mode(&link), mode(&target));
        // Writing into a pipe that its reader has closed is an error, but without the kind `BrokenPipe`,
        // which stands for a closed standard output.
        let (reader, writer) = std::io::pipe().unwrap();
        let pipe = format!("/proc/self/fd/{}", std::os::fd::AsRawFd::as_raw_fd(&writer));
        drop(reader);
        if cfg!(target_os = "linux") {
            let error = write_whole(Path::new(&pipe), b"x").unwrap_err();
            assert!(error.to_string().contains("cannot write") && error.chain().count() == 1, "{error:#}");
        }
        // A device is written to, not replaced.
        write_whole(Path::new("/dev/null"), b"gone").unwrap();
        assert!(!std::fs::metadata("/dev/null").unwrap().is_file());
        let said = write_whole(Path::new("/dev/entire-test"), b"x").unwrap_err().to_string();
        assert!(said.contains("name a file elsewhere"), "{said}");
    }
}
