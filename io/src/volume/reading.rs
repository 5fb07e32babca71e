//! Reading of volume files, with options: the array, the fill values, the range that maps to [0, 1].

use super::{
    Companions, Folder, Format, Stream, Volume, VolumeData, Watcher, metaimage, nifti, nrrd, openscivis,
    strip_ending, vti,
};
use crate::files::{note, numbers_in};
use anyhow::{Context, Result, bail, ensure};
use entire_core::scene::{Scalars, VolumeView};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fmt;
use std::path::Path;
use std::str::FromStr;
use std::sync::{Arc, Mutex, PoisonError};

/// Minimum width of the value range of unsigned bytes, in scalar values; for a narrower range, a note
/// suggests `--range data`.
const MIN_BYTE_RANGE: f32 = 64.0;

/// Options of reading a volume file, which commands share. By default, all are determined from the file.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, clap::Args)]
#[serde(default)]
pub struct Reading {
    /// Array to read from a VTK file with several arrays; default: its active scalars.
    #[arg(long, value_name = "NAME")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub array: Option<String>,
    /// Fill values, which mark voxels without data: numbers separated by commas; `none`; or `auto`: a
    /// minimum or maximum that is frequent and far from all other values. Such voxels are shown as the low
    /// end of the range.
    #[arg(long, default_value_t, value_name = "VALUE,…|auto|none", allow_hyphen_values = true)]
    pub fill: Fill,
    /// Scalar range that maps to [0, 1]: two numbers; `data`: the range of the voxel values; `auto`: 0 to
    /// 255 for unsigned bytes, the range of the voxel values for other types.
    #[arg(long, default_value_t, value_name = "LO,HI|data|auto", allow_hyphen_values = true)]
    pub range: Range,
}

impl Reading {
    /// Returns the range to set on a volume whose fill values are replaced; `None` for the default range.
    fn range_of(&self, view: &VolumeView<'_>) -> Option<(f32, f32)> {
        let bytes = matches!(view.scalars(), Scalars::U8(_));
        match self.range {
            Range::Given(low, high) => Some((low, high)),
            Range::Data => Some(view.own_range()),
            // The fill values are replaced already. The view's default range would look for fill values among
            // the voxels once more.
            Range::Default => (!bytes).then(|| view.own_range()),
        }
    }

    /// Returns the key of the options: equal options have equal keys.
    pub fn key(&self) -> String {
        format!("{:?} {} {}", self.array, self.fill, self.range)
    }
}

/// Fill values; voxels that hold one of them are shown as the low end of the range.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Fill {
    /// `auto`: the values that [`VolumeView::fill_values`] finds.
    #[default]
    Found,
    /// `none`: no fill values.
    None,
    /// Numbers separated by commas: these values.
    Values(Vec<f32>),
}

/// The scalar range that maps to [0, 1].
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Range {
    /// `auto`: 0 to 255 for unsigned bytes; for other types, the finite minimum to the finite maximum.
    #[default]
    Default,
    /// `data`: the finite minimum to the finite maximum, for unsigned bytes, too.
    Data,
    /// Two numbers separated by a comma: from the first to the second.
    Given(f32, f32),
}

impl FromStr for Fill {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.trim() {
            "auto" => Ok(Self::Found),
            "none" => Ok(Self::None),
            list => {
                numbers_in(list).map(Self::Values).map_err(|e| format!("{e}; give auto, none, or numbers"))
            }
        }
    }
}

impl FromStr for Range {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.trim() {
            "auto" => Ok(Self::Default),
            "data" => Ok(Self::Data),
            pair => match numbers_in(pair)?[..] {
                [low, high] => Ok(Self::Given(low, high)),
                _ => Err("data, auto, or two numbers separated by a comma are expected".to_owned()),
            },
        }
    }
}

impl fmt::Display for Fill {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Found => f.write_str("auto"),
            Self::None => f.write_str("none"),
            Self::Values(values) => {
                f.write_str(&values.iter().map(f32::to_string).collect::<Vec<_>>().join(","))
            }
        }
    }
}

impl fmt::Display for Range {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Default => f.write_str("auto"),
            Self::Data => f.write_str("data"),
            Self::Given(low, high) => write!(f, "{low},{high}"),
        }
    }
}

macro_rules! as_text {
    ($($kind:ty)*) => {$(
        impl TryFrom<String> for $kind {
            type Error = String;

            fn try_from(text: String) -> Result<Self, String> {
                text.parse()
            }
        }

        impl From<$kind> for String {
            fn from(value: $kind) -> Self {
                value.to_string()
            }
        }
    )*};
}
as_text!(Fill Range);

impl Volume {
    /// Reads a volume file. The format follows from the name's ending, else from the first bytes.
    ///
    /// # Errors
    /// One line that names the file, what was expected, what was found and what to do: a missing or
    /// unreadable file, an unknown format, a broken header, a zero size, fewer bytes of voxels than the
    /// header requires or at least twice as many, several components or time steps.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        Self::open_as(path, &Reading::default(), None)
    }

    /// Reads a volume file as [`Volume::open`] does, with the options `reading`. The watcher may observe the
    /// progress and stop the reading.
    ///
    /// # Errors
    /// Those of [`Volume::open`] and of the watcher; when `reading` names an array that the file lacks, or
    /// the format has no named arrays; when every finite voxel holds one of the given fill values.
    pub fn open_as(
        path: impl AsRef<Path>,
        reading: &Reading,
        watcher: Option<Arc<dyn Watcher>>,
    ) -> Result<Self> {
        let path = path.as_ref();
        let shown = path.display();
        let mut stream = Stream::open(path, watcher.as_ref())?;
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let format = match Format::of_name(&name) {
            None => Format::of_content(stream.peek().with_context(|| format!("{shown}"))?),
            known => known,
        };
        let format = format.with_context(|| {
            let known = Format::ENDINGS.map(|(_, all)| all.join(", ")).join(", ");
            format!("{shown}: not a volume format that is read here; accepted are {known}")
        })?;
        let folder = Folder::new(path.parent().unwrap_or(Path::new("")), watcher);
        let mut volume =
            Self::read(format, stream, &name, &folder, reading).with_context(|| format!("{shown}"))?;
        if volume.name.is_empty() {
            volume.name = stem(&name).to_owned();
        }
        volume.source = path.to_owned();
        Ok(volume)
    }

    /// Reads a volume of a known format from a stream. `file_name` is the file's name, from which the names
    /// of raw and JSON files that belong together are derived. Data files come from `companions`.
    pub(crate) fn read(
        format: Format,
        stream: Stream<'_>,
        file_name: &str,
        companions: &dyn Companions,
        reading: &Reading,
    ) -> Result<Self> {
        let array = reading.array.as_deref();
        if let Some(array) = array.filter(|_| format != Format::VtkImage) {
            bail!("array {array:?} was requested; a file of this format holds one volume without a name");
        }
        let mut parts = match format {
            Format::Nrrd => nrrd::read(stream, companions),
            Format::MetaImage => metaimage::read(stream, companions),
            Format::VtkImage => vti::read(stream, array),
            Format::Nifti => nifti::read(stream),
            Format::Json => openscivis::read_json(stream, file_name, companions),
            Format::Raw => openscivis::read_raw(stream, file_name, companions),
        }?;
        let spacing = parts.spacing.map(|s| s as f32);
        let mut notes = parts.notes;
        notes.extend(hide_fill(&mut parts.data, parts.dims, reading)?);
        let mut volume = Self::new(parts.data, parts.dims, spacing, parts.name.unwrap_or_default())?;
        notes.extend(non_finite(&volume.view()));
        notes.extend(narrow(&volume.view(), reading.range));
        let range = reading.range_of(&volume.view()).unwrap_or(volume.range);
        volume.set_range(range)?;
        volume.notes = notes;
        Ok(volume)
    }
}

/// Reads a volume file and prints its notes ([`Volume::notes`]) on standard error.
///
/// # Errors
/// Those of [`Volume::open_as`].
pub fn open_volume(path: &Path, reading: &Reading) -> Result<Volume> {
    open_watched_volume(path, reading, None)
}

/// Reads a volume file as [`open_volume`] does; the watcher may observe the progress and stop the reading.
///
/// # Errors
/// Those of [`Volume::open_as`].
pub fn open_watched_volume(
    path: &Path,
    reading: &Reading,
    watcher: Option<Arc<dyn Watcher>>,
) -> Result<Volume> {
    let volume = Volume::open_as(path, reading, watcher)?;
    say_notes(&volume);
    Ok(volume)
}

/// Prints the notes of a volume's reader on standard error, each only once.
fn say_notes(volume: &Volume) {
    static SAID: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());
    for text in volume.notes() {
        let text = format!("{}: {text}", volume.source().display());
        if SAID.lock().unwrap_or_else(PoisonError::into_inner).insert(text.clone()) {
            note(&text);
        }
    }
}

/// Returns a file name without its ending; `.nii.gz` and the like count as one ending.
fn stem(name: &str) -> &str {
    let name = strip_ending(name, ".gz").filter(|rest| !rest.is_empty()).unwrap_or(name);
    Path::new(name).file_stem().and_then(|stem| stem.to_str()).unwrap_or(name)
}

/// Replaces fill values by the low end of the range, or by the minimum of all other voxels if that is lower.
/// Returns the note for the user, if any.
///
/// # Errors
/// When every finite voxel holds one of the given values.
fn hide_fill(data: &mut VolumeData, dims: [usize; 3], reading: &Reading) -> Result<Option<String>> {
    let fill = &reading.fill;
    let (values, found) = match fill {
        Fill::Found => (VolumeView::new(data.scalars(), dims)?.fill_values(), true),
        Fill::None => return Ok(None),
        Fill::Values(values) => (values.clone(), false),
    };
    if values.is_empty() {
        return Ok(None);
    }
    let same = |f: f32, v: f32| f == v || f.is_nan() && v.is_nan();
    let is_fill = |v: f32| values.iter().any(|&f| same(f, v));
    let (mut low, mut high, mut hidden) = (f32::INFINITY, f32::NEG_INFINITY, 0usize);
    for v in data.scalars().iter() {
        if is_fill(v) {
            hidden += 1;
        } else if v.is_finite() {
            (low, high) = (low.min(v), high.max(v));
        }
    }
    ensure!(low <= high, "every finite voxel holds a fill value ({fill}); give --fill other values, or none");
    let shown = match reading.range {
        Range::Given(from, _) => low.min(from.floor()),
        Range::Default if matches!(data, VolumeData::U8(_)) => 0.0,
        Range::Default | Range::Data => low,
    };
    let list = |values: &[f32]| values.iter().map(f32::to_string).collect::<Vec<_>>().join(", ");
    let missing = |f: &f32| !data.scalars().iter().any(|v| same(*f, v));
    let missing: Vec<f32> = if found { Vec::new() } else { values.iter().copied().filter(missing).collect() };
    let mut changed = false;
    macro_rules! replace {
        ($($kind:ident $number:ty),*) => {
            match data {
                $(VolumeData::$kind(voxels) => {
                    for v in voxels.iter_mut().filter(|v| is_fill(f32::from(**v))) {
                        changed |= *v != shown as $number;
                        *v = shown as $number;
                    }
                })*
            }
        };
    }
    replace!(U8 u8, U16 u16, I16 i16, F32 f32);
    let (share, all) = (100.0 * hidden as f64 / data.len() as f64, data.len());
    Ok(if found {
        let are = if values.len() == 1 { "is taken as a fill value" } else { "are taken as fill values" };
        let list = list(&values);
        Some(format!(
            "{hidden} of {all} voxels ({share:.1} %) hold {list}, which {are}, far from all other values \
             ({low} to {high}). These voxels are shown as the low end of the range. With `--fill none`, they \
             are shown as data"
        ))
    } else if !missing.is_empty() {
        Some(format!("no voxel holds the fill value {}", list(&missing)))
    } else {
        let values = list(&values);
        (!changed).then(|| {
            format!("the fill value {values} is the low end of the range already, so --fill changes no voxel")
        })
    })
}

/// Returns a note if the voxels are unsigned bytes that are not all equal and fill only a small part of the
/// range that maps to [0, 1].
fn narrow(view: &VolumeView<'_>, range: Range) -> Option<String> {
    let (low, high) = view.own_range();
    let bytes = matches!(view.scalars(), Scalars::U8(_));
    let spans = low < high && high - low < MIN_BYTE_RANGE;
    let narrow = bytes && range == Range::Default && view.range() != (low, high) && spans;
    narrow.then(|| {
        format!(
            "its bytes hold {low} to {high}, a small part of the range 0 to 255 that the transfer function \
             covers; with `--range data`, the transfer function covers only the range of the voxel values"
        )
    })
}

fn non_finite(view: &VolumeView<'_>) -> Option<String> {
    let (broken, all) = (view.non_finite(), view.shape().voxels);
    (broken > 0).then(|| {
        format!(
            "{broken} of {all} voxels are NaN or infinite as 32-bit floats; they count as the ends of the \
             range (NaN as the low end)"
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_lose_their_endings() {
        for (name, expected) in [
            ("a.nrrd", "a"),
            ("a.b.nii.gz", "a.b"),
            ("a.GZ", "a"),
            (".gz", ".gz"),
            ("plain", "plain"),
            (".hidden", ".hidden"),
            ("ü.gz", "ü"),
        ] {
            assert_eq!(stem(name), expected, "{name}");
        }
    }

    #[test]
    fn words_and_numbers_are_read_and_written() {
        for text in ["auto", "none", "-9999", "1,-2.5"] {
            assert_eq!(text.parse::<Fill>().unwrap().to_string(), text);
        }
        assert!("-9999;".parse::<Fill>().unwrap_err().contains("auto, none"));
        for text in ["auto", "data", "-1024,3071"] {
            assert_eq!(text.parse::<Range>().unwrap().to_string(), text);
        }
        for wrong in ["1", "0,1,2", "date"] {
            assert!(wrong.parse::<Range>().is_err(), "{wrong}");
        }
        let reading = Reading { fill: Fill::None, range: Range::Given(0.0, 2.0), ..Reading::default() };
        let text = serde_json::to_string(&reading).unwrap();
        assert_eq!(text, r#"{"fill":"none","range":"0,2"}"#);
        assert_eq!(serde_json::from_str::<Reading>(&text).unwrap(), reading);
        assert_eq!(serde_json::from_str::<Reading>("{}").unwrap(), Reading::default());
    }

    #[test]
    fn fill_values_become_the_low_end() {
        let mut data = VolumeData::U16((0..100).map(|i| if i < 40 { 65535 } else { i }).collect());
        let with = |fill: Fill, range: Range| Reading { fill, range, ..Reading::default() };
        let note = hide_fill(&mut data, [10, 10, 1], &Reading::default()).unwrap().unwrap();
        assert!(note.contains("40 of 100 voxels (40.0 %) hold 65535") && note.contains("40 to 99"), "{note}");
        assert_eq!(data, VolumeData::U16((0..100).map(|i| i.max(40)).collect()));
        let mut data = VolumeData::F32(vec![f32::NAN, 7.0, 1.0, 2.0]);
        let values = with(Fill::Values(vec![7.0, f32::NAN]), Range::Default);
        let note = hide_fill(&mut data, [4, 1, 1], &values).unwrap();
        assert_eq!((note, data), (None, VolumeData::F32(vec![1.0, 1.0, 1.0, 2.0])));
        let mut all = VolumeData::U8(vec![3; 8]);
        let values = |v: f32, range: Range| with(Fill::Values(vec![v]), range);
        assert!(hide_fill(&mut all, [8, 1, 1], &values(3.0, Range::Default)).is_err());
        let note = hide_fill(&mut all, [8, 1, 1], &values(4.0, Range::Default)).unwrap().unwrap();
        assert!(note.contains("no voxel"));
        // The low end of bytes is 0; a byte is never below 0.
        for (fill, expected) in [
            (vec![0.0], Some("the fill value 0 is the low end")),
            (vec![0.0, -9999.0], Some("no voxel holds the fill value -9999")),
            (vec![0.0, 7.0], None),
        ] {
            let mut bytes = VolumeData::U8(vec![0, 5, 7, 9]);
            let note = hide_fill(&mut bytes, [4, 1, 1], &with(Fill::Values(fill), Range::Default)).unwrap();
            assert_eq!(note.is_some(), expected.is_some(), "{note:?}");
            assert!(note.unwrap_or_default().contains(expected.unwrap_or_default()), "{expected:?}");
        }
        // The low end of the range is 0 for bytes, the minimum of the data, or the given number.
        for (range, low) in [(Range::Default, 0), (Range::Data, 50), (Range::Given(20.0, 90.0), 20)] {
            let mut bytes = VolumeData::U8(vec![50, 200, 255, 60]);
            hide_fill(&mut bytes, [4, 1, 1], &values(255.0, range)).unwrap();
            assert_eq!(bytes, VolumeData::U8(vec![50, 200, low, 60]));
        }
    }
}
