//! Inputs of the report, and the file that holds all of them.

use super::description::Paper;
use super::encode::{ALL, Encoder, Provenance, Record, SHIPPED};
use super::results::{Results, read_all};
use anyhow::{Context, Result};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use entire_core::model::Key;
use entire_io::files::{gzip, make_folder_of, read_bytes, read_decompressed, read_model_file, write_whole};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// An encoder, with its quality of reconstruction.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Reconstruction {
    pub(crate) encoder: Encoder,
    pub(crate) record: Record,
}

impl Reconstruction {
    /// Mean peak signal-to-noise ratio over the test volumes of the encoder's data set, dB.
    pub(crate) fn psnr(&self) -> Option<f64> {
        self.record.psnr("test", &self.encoder.set)
    }
}

#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Material {
    pub(crate) all: Vec<Results>,
    pub(crate) reconstructions: Vec<Reconstruction>,
    /// PNG files by name, as base64 text.
    pub(crate) pictures: BTreeMap<String, String>,
}

/// Reads the results of every step from a folder, and missing ones from a file written by [`keep`].
pub(crate) fn material(paper: &Paper, out: &Path, kept: Option<&Path>) -> Result<Material> {
    let kept = kept.map(read).transpose()?.unwrap_or_default();
    let all = read_all(out, kept.all)?;
    let asked = &paper.encoders;
    let mut reconstructions = Vec::new();
    let names = paper.data_sets.iter().map(|d| d.name.as_str()).chain([ALL]);
    for set in names {
        for encoder in Encoder::of_set(asked, set) {
            let before = || kept.reconstructions.iter().find(|r| r.encoder == encoder);
            match encoder.record(out)?.filter(Record::complete) {
                Some(record) => reconstructions.push(Reconstruction { encoder, record }),
                None => reconstructions.extend(before().cloned()),
            }
        }
    }
    for path in &asked.shipped {
        reconstructions.extend(shipped(path)?);
    }
    let mut pictures = kept.pictures;
    for name in all.iter().flat_map(|r| &r.pictures).map(|(name, _)| name) {
        let path = out.join("pictures").join(name);
        if path.exists() {
            pictures.insert(name.clone(), STANDARD.encode(read_bytes(&path)?));
        }
    }
    Ok(Material { all, reconstructions, pictures })
}

/// Reads the training record in the file of a shipped encoder; `None` if there is none.
fn shipped(path: &Path) -> Result<Option<Reconstruction>> {
    let (file, model) = read_model_file(path)?;
    let net = model.volumenet.as_ref().with_context(|| format!("{} holds no VolumeNet", path.display()))?;
    let Some(text) = file.metadata.get(Key::Provenance.name()) else { return Ok(None) };
    let provenance: Provenance = serde_json::from_str(text)
        .with_context(|| format!("{} does not say how it was trained", path.display()))?;
    let (size, features) = (net.input, net.fc.outputs);
    let encoder = Encoder { set: SHIPPED.into(), size, features, channels: Vec::new() };
    // The duration of the training is not in the file.
    Ok(Some(Reconstruction { encoder, record: Record { provenance, seconds: 0.0 } }))
}

fn read(path: &Path) -> Result<Material> {
    let bytes = read_decompressed(path).with_context(|| format!("cannot read {}", path.display()))?;
    serde_json::from_slice(&bytes)
        .with_context(|| format!("{} holds no results of this version", path.display()))
}

/// Writes all inputs of the report into one compressed file, which [`material`] can read.
pub(crate) fn keep(material: &Material, path: &Path) -> Result<()> {
    make_folder_of(path)?;
    write_whole(path, &gzip(&serde_json::to_vec(material)?)?)
}
