//! Voxels in several files: the names of the files, and the number of voxels in each.

use super::VolumeData;
use super::stream::{Companions, Stream};
use anyhow::{Context, Result, bail, ensure};

/// Maximum number of files of a volume.
const MAX_FILES: usize = 1 << 16;

/// Maximum total length of the names of a volume's files, in bytes.
const MAX_NAME_BYTES: usize = 16 << 20;

/// The files that together hold a volume, in the order of the voxels.
#[derive(Debug, PartialEq)]
pub(super) struct Several {
    pub(super) names: Vec<String>,
    /// Number of axes of each file; default: one less than the volume has. A file with as many axes as the
    /// volume is a slab along the slowest axis.
    pub(super) axes: Option<i64>,
}

impl Several {
    /// Reads `LIST [axes]` and the names in the following lines of the header.
    pub(super) fn list(value: &str, stream: &mut Stream<'_>) -> Result<Self> {
        let axes = match value.split_whitespace().nth(1) {
            // MetaImage writes 2D where NRRD writes 2.
            Some(word) => Some(whole(word.trim_end_matches(['d', 'D']))?),
            None => None,
        };
        let (mut names, mut bytes) = (Vec::new(), 0);
        while let Some(line) = stream.line()? {
            let name = String::from_utf8_lossy(&line).trim().to_owned();
            if !name.is_empty() {
                ensure!(names.len() < MAX_FILES, "LIST names more than {MAX_FILES} files");
                add(&mut names, &mut bytes, name)?;
            }
        }
        ensure!(!names.is_empty(), "LIST is followed by no file name; write each name on a line of its own");
        Ok(Self { names, axes })
    }

    /// Expands `pattern first last step [axes]`; `None` if the text is the name of a single file.
    pub(super) fn pattern(value: &str) -> Result<Option<Self>> {
        let words: Vec<&str> = value.split_whitespace().collect();
        let numbers = words.get(1..).is_some_and(|n| !n.is_empty() && n.iter().all(|w| whole(w).is_ok()));
        if !numbers || !words[0].contains('%') {
            return Ok(None);
        }
        if !(4..=5).contains(&words.len()) {
            bail!("{value:?} is no pattern of file names; give one like \"name%03d.raw FIRST LAST STEP\"");
        }
        let (first, last, step) = (whole(words[1])?, whole(words[2])?, whole(words[3])?);
        let axes = words.get(4).map(|word| whole(word)).transpose()?;
        let span = last - first;
        ensure!(
            step != 0 && (span == 0 || (span > 0) == (step > 0)),
            "{value:?}: steps of {step} do not lead from {first} to {last}"
        );
        let steps = span / step;
        ensure!(steps < MAX_FILES as i64, "{value:?} names more than {MAX_FILES} files");
        let (mut names, mut bytes) = (Vec::new(), 0);
        for k in 0..=steps {
            add(&mut names, &mut bytes, numbered(words[0], first + k * step)?)?;
        }
        Ok(Some(Self { names, axes }))
    }

    /// Returns the number of voxels in each file; `sizes` are those of the volume.
    pub(super) fn voxels_each(&self, sizes: &[u64]) -> Result<usize> {
        let product = |sizes: &[u64]| sizes.iter().try_fold(1u64, |p, &n| p.checked_mul(n));
        let all = product(sizes).context("the sizes in the header multiply to more than can be addressed")?;
        let files = self.names.len() as u64;
        let axes = self.axes.unwrap_or(sizes.len() as i64 - 1);
        ensure!(
            (1..=sizes.len() as i64).contains(&axes),
            "the header says that each file has {axes} axes; 1 to {} are possible",
            sizes.len()
        );
        let axes = axes as usize;
        if axes == sizes.len() {
            let slowest = sizes[axes - 1];
            ensure!(
                slowest.is_multiple_of(files),
                "{files} files cannot hold equal slabs of the last axis, whose size is {slowest}"
            );
            return Ok((all / files) as usize);
        }
        let each = product(&sizes[..axes]).unwrap_or(0).max(1);
        ensure!(
            all / each == files,
            "the voxels are spread over {} files of {axes} axes each, but {files} are named; are some \
             missing?",
            all / each
        );
        Ok(each as usize)
    }

    /// Reads the voxels of all files, each file by `read`.
    pub(super) fn read(
        &self,
        sizes: &[u64],
        companions: &dyn Companions,
        mut read: impl FnMut(Stream<'_>, [usize; 3]) -> Result<VolumeData>,
    ) -> Result<VolumeData> {
        companions.announce(&self.names);
        let each = [self.voxels_each(sizes)?, 1, 1];
        let mut all = None;
        for name in &self.names {
            append(&mut all, read(companions.open(name)?, each)?)?;
        }
        all.context("the header names no file of voxels")
    }
}

/// Appends a name to `names`; `bytes` is the length of all names.
fn add(names: &mut Vec<String>, bytes: &mut usize, name: String) -> Result<()> {
    *bytes += name.len();
    ensure!(
        *bytes <= MAX_NAME_BYTES,
        "the names of the data files have more than {} MiB in all; give the files shorter names",
        MAX_NAME_BYTES >> 20
    );
    names.push(name);
    Ok(())
}

fn whole(word: &str) -> Result<i64> {
    let number = word.parse::<i32>().ok().map(i64::from);
    number.with_context(|| format!("{word:?} stands where a whole number is expected"))
}

/// Returns the pattern with a number in place of `%d`, `%03d` and the like.
fn numbered(pattern: &str, number: i64) -> Result<String> {
    let mut name = String::new();
    let mut rest = pattern;
    let mut put = false;
    while let Some(at) = rest.find('%') {
        name.push_str(&rest[..at]);
        rest = &rest[at + 1..];
        if let Some(after) = rest.strip_prefix('%') {
            name.push('%');
            rest = after;
            continue;
        }
        let end = rest.find(|c: char| !c.is_ascii_digit()).unwrap_or(rest.len());
        let (width, after) = rest.split_at(end);
        let places: usize = if width.is_empty() { 0 } else { width.parse().unwrap_or(usize::MAX) };
        if put || places > 64 || !after.starts_with(['d', 'i', 'u']) {
            bail!(
                "{pattern:?} is no pattern of file names; it must have one %d, or one with a width, such \
                 as %03d"
            );
        }
        if width.starts_with('0') {
            name.push_str(&format!("{number:0places$}"));
        } else {
            name.push_str(&format!("{number:places$}"));
        }
        put = true;
        rest = &after[1..];
    }
    ensure!(put, "{pattern:?} would name the same file again and again; a pattern of file names has one %d");
    name.push_str(rest);
    Ok(name)
}

/// Appends the voxels `part` to `all`, which must have the same type.
fn append(all: &mut Option<VolumeData>, part: VolumeData) -> Result<()> {
    fn push<T>(all: &mut Vec<T>, mut part: Vec<T>) -> Result<()> {
        if all.try_reserve(part.len()).is_err() {
            bail!("the voxels of all files together do not fit into this machine's memory");
        }
        all.append(&mut part);
        Ok(())
    }
    match (all, part) {
        (all @ None, part) => {
            *all = Some(part);
            Ok(())
        }
        (Some(VolumeData::U8(all)), VolumeData::U8(part)) => push(all, part),
        (Some(VolumeData::U16(all)), VolumeData::U16(part)) => push(all, part),
        (Some(VolumeData::I16(all)), VolumeData::I16(part)) => push(all, part),
        (Some(VolumeData::F32(all)), VolumeData::F32(part)) => push(all, part),
        _ => bail!("the files hold voxels of different types"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_count_in_both_directions_and_fill_with_zeros() {
        let names = |value: &str| Several::pattern(value).map(|s| s.map(|s| s.names));
        assert_eq!(names("a%02d.raw 8 10 1").unwrap().unwrap(), ["a08.raw", "a09.raw", "a10.raw"]);
        assert_eq!(names("%d_%% 5 1 -2 3").unwrap().unwrap(), ["5_%", "3_%", "1_%"]);
        assert_eq!(names("plain.raw").unwrap(), None);
        assert_eq!(names("100%.raw").unwrap(), None);
        assert_eq!(names("100% of it.raw").unwrap(), None);
        for wrong in [
            "a%d.raw 1 5 0",
            "a%d.raw 5 1 1",
            "a%d.raw 5 4 2",
            "a%d.raw 1 2",
            "a%s.raw 1 2 1",
            "a%d%d.raw 1 2 1",
            "a%%.raw 1 2 1",
            "a%999999d 1 2 1",
            "a%d 0 2000000000 1",
        ] {
            assert!(names(wrong).is_err(), "{wrong}");
        }
        assert_eq!(names("v%05d.raw 0 65535 1").unwrap().unwrap().len(), MAX_FILES);
        let long = format!("{}%d.raw 0 65535 1", "a".repeat(65_000));
        assert!(names(&long).unwrap_err().to_string().contains("more than 16 MiB"));
    }

    #[test]
    fn every_file_holds_the_same_part_of_the_axes() {
        let each = |files: usize, axes: Option<i64>| {
            Several { names: vec![String::new(); files], axes }.voxels_each(&[12, 10, 8])
        };
        assert_eq!(each(8, None).unwrap(), 120);
        assert_eq!(each(80, Some(1)).unwrap(), 12);
        assert_eq!(each(4, Some(3)).unwrap(), 240);
        assert!(
            each(7, None).unwrap_err().to_string().contains("over 8 files of 2 axes each, but 7 are named")
        );
        assert!(each(3, Some(3)).unwrap_err().to_string().contains("equal slabs"));
        assert!(each(3, Some(4)).is_err() && each(3, Some(0)).is_err());
        assert!(each(3, Some(-1)).unwrap_err().to_string().contains("each file has -1 axes"));
    }
}
