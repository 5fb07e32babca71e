//! Writing of timing tables, frame by frame.

use super::feature_table::beside;
use super::table::parse;
use super::{COLUMNS, Scene, Timing, format_lobes};
use crate::files::lock_alone;
use anyhow::{Context, Result, anyhow, ensure};
use entire_vk_raycaster::WorkCounts;
use std::collections::HashSet;
use std::fs::{File, OpenOptions};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Checks that a table may be written to a file.
fn check_name(path: &Path) -> Result<()> {
    ensure!(
        path.extension().is_none_or(|e| e != "gz"),
        "{}: tables are written without compression; leave .gz out of the name",
        path.display()
    );
    // Tables whose names differ only in .csv and .gz have one manifest.
    for ending in ["", ".csv", ".gz", ".csv.gz"] {
        let other = beside(path, ending);
        let taken = if ending.ends_with(".gz") { other.exists() } else { ensure_no_table(&other).is_err() };
        ensure!(
            other == path || !taken,
            "{} exists, and {} would share its manifest; choose another name",
            other.display(),
            path.display()
        );
    }
    Ok(())
}

const BUSY_MESSAGE: &str =
    "another process writes this table; wait until it has ended, or choose another name";

/// Appends frames to a timing table. Each frame is written in one piece and flushed to disk, so that a crash
/// loses at most the current frame. The table is locked as long as the writer exists, since two writers would
/// mix their rows.
#[derive(Debug)]
pub struct Writer {
    file: File,
    path: PathBuf,
    done: HashSet<u64>,
}

impl Writer {
    /// Starts a new table, also in a file that holds a table without frames.
    ///
    /// # Errors
    /// When the file exists with other content, is locked, or cannot be written; when its name ends in `.gz`,
    /// or another table would share its manifest.
    pub fn create(path: &Path) -> Result<Self> {
        check_name(path)?;
        if path.is_file() && Self::is_fresh(path)? {
            return Self::resume(path, 1);
        }
        let mut file = OpenOptions::new().write(true).create_new(true).open(path).map_err(|e| {
            if e.kind() == std::io::ErrorKind::AlreadyExists {
                anyhow!(
                    "{} exists already; choose another name, remove it, or, if it is an unfinished table of \
                     `entire collect`, resume it by the same command with --resume",
                    path.display()
                )
            } else {
                anyhow!("cannot write {}: {e}", path.display())
            }
        })?;
        lock_alone(&file, path, BUSY_MESSAGE)?;
        write_header(&mut file).with_context(|| format!("cannot write {}", path.display()))?;
        Ok(Self { file, path: path.to_owned(), done: HashSet::new() })
    }

    /// True if a table has no frame: its file does not exist, or ends within its first line or right after
    /// that line.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn is_fresh(path: &Path) -> Result<bool> {
        let header = header();
        let mut start = Vec::new();
        match File::open(path) {
            Ok(file) => file.take(header.len() as u64 + 1).read_to_end(&mut start),
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(true),
            Err(e) => Err(e),
        }
        .with_context(|| format!("cannot read {}", path.display()))?;
        Ok(header.as_bytes().starts_with(&start))
    }

    /// Continues a table (or starts it if it does not exist). A last line that was cut off, and a last frame
    /// with fewer than `repeats` repeats, are removed.
    ///
    /// # Errors
    /// When the file is no timing table, has its columns in another order, is locked, or cannot be written;
    /// when its name ends in `.gz`, or another table would share its manifest.
    pub fn resume(path: &Path, repeats: u32) -> Result<Self> {
        if !path.exists() {
            return Self::create(path);
        }
        check_name(path)?;
        let fail = || format!("cannot resume {}", path.display());
        let mut file = OpenOptions::new().read(true).write(true).open(path).with_context(fail)?;
        lock_alone(&file, path, BUSY_MESSAGE)?;
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes).with_context(fail)?;
        let header = header();
        if header.as_bytes().starts_with(&bytes) && bytes.len() < header.len() {
            // The file ends within its header line, so no frame is lost.
            file.set_len(0).and_then(|()| file.rewind()).with_context(fail)?;
            write_header(&mut file).with_context(fail)?;
            return Ok(Self { file, path: path.to_owned(), done: HashSet::new() });
        }
        ensure!(
            bytes.starts_with(header.as_bytes()),
            "cannot resume {}: its first line is not {}; is it a timing table?",
            path.display(),
            header.trim_end()
        );
        let mut end = bytes.iter().rposition(|&b| b == b'\n').map_or(0, |i| i + 1);
        let mut frames = parse(&bytes[..end], 0).with_context(fail)?;
        if frames.last().is_some_and(|f| f.repeats.len() < repeats as usize) {
            let partial = frames.pop().map_or(0, |f| f.repeats.len());
            for _ in 0..partial {
                end = bytes[..end - 1].iter().rposition(|&b| b == b'\n').map_or(0, |i| i + 1);
            }
        }
        file.set_len(end as u64).and_then(|()| file.seek(SeekFrom::End(0))).with_context(fail)?;
        Ok(Self { file, path: path.to_owned(), done: frames.iter().map(|f| f.number).collect() })
    }

    /// Numbers of the frames that are in the table.
    pub fn done(&self) -> &HashSet<u64> {
        &self.done
    }

    /// Appends the frame `number` with all its repeats; the repeats are numbered from 0.
    ///
    /// # Errors
    /// When the scene or a measurement is not valid, there is no repeat, the frame is in the table already,
    /// or the file cannot be written.
    pub fn append(&mut self, number: u64, scene: &Scene, repeats: &[Timing]) -> Result<()> {
        scene.check().with_context(|| format!("frame {number}"))?;
        ensure!(!repeats.is_empty(), "frame {number} has no measured time");
        ensure!(!self.done.contains(&number), "frame {number} is in {} already", self.path.display());
        let lobes = format_lobes(&scene.lobes);
        let mut out = csv::WriterBuilder::new().from_writer(Vec::new());
        for (repeat, m) in repeats.iter().enumerate() {
            m.check().with_context(|| format!("frame {number}, repeat {repeat}"))?;
            let seconds = |t: Option<f64>| t.map_or(String::new(), |t| t.to_string());
            let count =
                |f: fn(&WorkCounts) -> u64| m.counts.as_ref().map_or(String::new(), |c| f(c).to_string());
            let fields: [String; COLUMNS.len()] = [
                number.to_string(),
                repeat.to_string(),
                scene.volume.clone(),
                scene.member.clone(),
                scene.time_step.map_or(String::new(), |t| t.to_string()),
                scene.dims[0].to_string(),
                scene.dims[1].to_string(),
                scene.dims[2].to_string(),
                scene.camera.rx.to_string(),
                scene.camera.ry.to_string(),
                scene.camera.dz.to_string(),
                scene.fov_y_degrees.to_string(),
                scene.width.to_string(),
                scene.height.to_string(),
                scene.step.to_string(),
                scene.shading.to_string(),
                scene.skipping.to_string(),
                scene.termination.to_string(),
                lobes.clone(),
                seconds(m.device),
                seconds(m.wall),
                seconds(m.cpu),
                count(|c| c.samples),
                count(|c| c.skips),
                count(|c| c.rays),
                count(|c| c.shaded),
            ];
            out.write_record(&fields)?;
        }
        let bytes = out.into_inner().map_err(|e| anyhow!("{e}"))?;
        self.file
            .write_all(&bytes)
            .and_then(|()| self.file.sync_data())
            .with_context(|| format!("cannot write {}", self.path.display()))?;
        self.done.insert(number);
        Ok(())
    }
}

/// Checks that a file, which is to be replaced by another kind of output, is no timing table.
///
/// # Errors
/// When the file begins with the columns of a timing table, or cannot be read.
pub fn ensure_no_table(path: &Path) -> Result<()> {
    if !path.is_file() {
        return Ok(());
    }
    let columns = COLUMNS.join(",");
    let mut start = Vec::new();
    File::open(path)
        .and_then(|file| file.take(columns.len() as u64).read_to_end(&mut start))
        .with_context(|| format!("cannot read {}", path.display()))?;
    ensure!(start != columns.as_bytes(), "{} is a timing table; choose another name", path.display());
    Ok(())
}

fn header() -> String {
    COLUMNS.join(",") + "\n"
}

fn write_header(file: &mut File) -> std::io::Result<()> {
    file.write_all(header().as_bytes())?;
    file.sync_data()
}
