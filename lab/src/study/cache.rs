//! Cache of a study's models: a stored model is used again if all inputs of its training are the same.

use anyhow::{Context, Result};
use entire_core::model::ModelFile;
use entire_io::dataset::Table;
use entire_io::dataset::feature_table::FeatureTable;
use entire_io::files::{fnv1a_text, read_bytes, read_model_file, write_whole};
use entire_steer::predict::UpperBound;
use entire_train::bound;
use entire_train::fit::Recipe;
use entire_train::split::TimedFrames;
use std::path::{Path, PathBuf};

/// The metadata key under which a stored model holds the hash of the inputs of its training.
pub(crate) const STUDY_KEY: &str = "entire.study_key";

/// Version of the fits: raised whenever the same recipe gives another model for the same frames.
const MADE_AS: u32 = 2;

/// Identity of a model: a hash of the program's version, the recipe, the bytes of the model files that it
/// starts from, the frames of each part with their seconds (which depend on the clock) and the bytes of
/// their tables and feature tables, and `residuals`, from which the upper bound follows (empty without a
/// cross-validation). Paths of files are not part of the hash.
pub(super) fn identity(
    recipe: &Recipe,
    tables: &[Table],
    parts: [&TimedFrames<'_>; 3],
    residuals: &[f64],
) -> Result<String> {
    let from = |path: &Option<PathBuf>| -> Result<String> {
        let Some(path) = path else { return Ok("none".into()) };
        let bytes = read_bytes(path).with_context(|| format!("cannot read {}", path.display()))?;
        Ok(fnv1a_text(&bytes))
    };
    let bare = Recipe { volumenet: None, fine_tune: None, file: None, ..recipe.clone() };
    let mut text = format!(
        "{} {MADE_AS} {} {} {}",
        env!("CARGO_PKG_VERSION"),
        serde_json::to_string(&bare)?,
        from(&recipe.volumenet)?,
        from(&recipe.fine_tune)?
    );
    if recipe.file.is_some() {
        text += &format!(" {}", from(&recipe.file)?);
    }
    for part in parts {
        let mut bytes = Vec::with_capacity(32 * part.frames.len());
        for (f, seconds) in part.frames.iter().zip(&part.seconds) {
            let table = tables.get(f.table).context("a frame of no table")?;
            let features = table.features.as_ref().map_or(0, FeatureTable::hash);
            for v in [table.hash, features, f.number, seconds.to_bits()] {
                bytes.extend(v.to_le_bytes());
            }
        }
        text += &format!(" {}", fnv1a_text(&bytes));
    }
    if !residuals.is_empty() {
        let bytes: Vec<u8> = residuals.iter().flat_map(|r| r.to_le_bytes()).collect();
        text += &format!(" {}", fnv1a_text(&bytes));
    }
    Ok(fnv1a_text(text.as_bytes()))
}

/// Path of the model file of a predictor with this key and identity.
pub(super) fn path_of(models: &Path, key: &str, identity: &str) -> PathBuf {
    let plain = |c: char| if c.is_ascii_alphanumeric() || c == '-' { c } else { '_' };
    let name: String = key.chars().map(plain).collect();
    models.join(format!("{name}-{}.safetensors", &identity[..8]))
}

/// Returns the stored model if it has this identity, with `upper`, if given, as its upper bound.
pub(super) fn kept(path: &Path, identity: &str, upper: Option<UpperBound>) -> Result<Option<ModelFile>> {
    if !path.exists() {
        return Ok(None);
    }
    let (mut file, model) = read_model_file(path)?;
    if file.metadata.get(STUDY_KEY).is_none_or(|key| key != identity) {
        return Ok(None);
    }
    if let Some(upper) = upper.filter(|u| bound::of(&model) != Some(*u)) {
        upper.store(&mut file)?;
        write_whole(path, &file.to_bytes()?)?;
    }
    Ok(Some(file))
}
