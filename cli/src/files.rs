//! What several commands read and print.

use crate::volume::{Stream, Volume};
use anyhow::{Context, Result, bail};
use entire_core::model::Model;
use std::io::Write;
use std::path::Path;

/// Largest model file that is read, in bytes.
const MAX_MODEL_BYTES: u64 = 4 << 30;

/// Reads a model file.
///
/// # Errors
/// One line that names the file, and the tensor or metadata key where one is wrong.
pub fn open_model(path: &Path) -> Result<Model> {
    let bytes = Stream::open(path)?.all(MAX_MODEL_BYTES).with_context(|| format!("{}", path.display()))?;
    match Model::from_bytes(&bytes) {
        Ok(model) => Ok(model),
        Err(error) => bail!("{}: {error}", path.display()),
    }
}

/// Reads a volume and sets the range that maps to [0, 1], where one is given. Voxels that are not finite are noted on
/// standard error.
///
/// # Errors
/// As [`Volume::open`], and for a range whose low end is above its high one.
pub fn open_volume(path: &Path, range: Option<(f32, f32)>) -> Result<Volume> {
    let mut volume = Volume::open(path)?;
    volume.set_range(range).with_context(|| format!("{}", path.display()))?;
    let broken = volume.data().non_finite();
    if broken > 0 {
        note(&format!(
            "{}: {broken} of {} voxels are NaN or infinite; they count as the ends of the range (NaN as the low end)",
            path.display(),
            volume.data().len()
        ));
    }
    Ok(volume)
}

/// Says something on standard error that is not an error.
pub fn note(text: &str) {
    // Nobody may be listening there, which is no reason to fail.
    let _ = writeln!(std::io::stderr().lock(), "note: {text}");
}

/// Reads a scalar range `LO,HI`, as an option's value.
///
/// # Errors
/// When it is not two numbers.
pub fn parse_range(text: &str) -> Result<(f32, f32), String> {
    let [low, high] = parse_numbers(text)?;
    Ok((low, high))
}

/// Reads exactly `N` comma-separated numbers.
///
/// # Errors
/// When there are more or fewer, or one is not a number.
pub fn parse_numbers<const N: usize>(text: &str) -> Result<[f32; N], String> {
    let found = parse_list(text)?;
    let count = found.len();
    found.try_into().map_err(|_| format!("{N} numbers separated by commas are expected, there are {count}"))
}

/// Reads comma-separated numbers.
///
/// # Errors
/// When one is not a number.
pub fn parse_list(text: &str) -> Result<Vec<f32>, String> {
    text.split(',')
        .map(|word| word.trim().parse().map_err(|_| format!("{:?} is not a number", word.trim())))
        .collect()
}

/// A number with 9 significant digits, which say which `f32` it is: `1.23456789e-3`.
pub fn digits(value: f32) -> String {
    format!("{value:.8e}")
}
