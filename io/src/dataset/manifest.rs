//! Manifest of a table: machine, renderer and settings of its measurement.

use super::feature_table::beside;
use crate::files::{read_text, write_json};
use crate::identity::{self, Identity};
use crate::volume::Reading;
use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The manifest's `format` value.
pub const MANIFEST_FORMAT: &str = "entire-timings-1";

/// Definition of the reference step, in words.
pub const STEP_REFERENCE: &str = "smallest voxel spacing";

/// Maximum size of a manifest, in bytes.
const MAX_MANIFEST_BYTES: u64 = 64 << 20;

/// Machine, renderer and settings of a measurement. Written beside the table as `NAME.manifest.json`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// [`MANIFEST_FORMAT`].
    pub format: String,
    /// Date and time of the start of the collection, UTC, ISO 8601.
    pub created: String,
    /// Description of the machine ([`machine`](crate::machine::machine)), without its host name.
    pub machine: String,
    /// Kind of the renderer: `vulkan` or `cpu` (the raycaster), `teacher`, or another renderer's name.
    pub renderer: String,
    /// The device that rendered.
    pub device: String,
    /// The device's driver with its version; empty if the device has no driver.
    #[serde(default)]
    pub driver: String,
    /// The program's version and, where known, commit.
    pub commit: String,
    /// The seed of every random choice.
    pub seed: u64,
    /// Repeats per frame; 0 if the number differs between frames.
    pub repeats: u32,
    /// [`STEP_REFERENCE`].
    pub step_reference: String,
    /// All other settings of the program that measured, free form.
    #[serde(default)]
    pub settings: serde_json::Value,
    /// Identities of the volumes' files, by the volumes' names in the table; empty if none were recorded.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub files: BTreeMap<String, Vec<Identity>>,
    /// Entries whose keys this version does not know, kept unchanged.
    #[serde(flatten)]
    pub other: BTreeMap<String, serde_json::Value>,
}

impl Manifest {
    /// Returns the manifest's path beside a table: `NAME.csv` or `NAME.csv.gz` → `NAME.manifest.json`.
    pub fn path_for(table: &Path) -> PathBuf {
        beside(table, ".manifest.json")
    }

    /// Writes the manifest beside `table`, whole or not at all.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(&self, table: &Path) -> Result<()> {
        write_json(&Self::path_for(table), self)
    }

    /// Describes the change of a volume's files since its frames were measured; `None` if nothing changed or
    /// the manifest holds no identities of these files.
    ///
    /// # Errors
    /// When a file cannot be read.
    pub fn changed(&self, name: &str, path: &Path) -> Result<Option<String>> {
        match self.files.get(name) {
            Some(then) => Ok(identity::difference(then, &identity::of_volume(path)?)),
            None => Ok(None),
        }
    }

    /// Returns the options with which the table's volumes are read.
    ///
    /// # Errors
    /// When the stored options are unknown to this version.
    pub fn reading(&self) -> Result<Reading> {
        match self.settings.get("reading") {
            Some(reading) => serde_json::from_value(reading.clone()).context("settings.reading"),
            None => Ok(Reading::default()),
        }
    }

    /// Returns the number of voxels per side to which the table's volumes were resampled; `None` for the
    /// volumes as read.
    pub fn resampled_to_edge(&self) -> Option<usize> {
        self.settings.get("resampled_to_edge")?.as_u64().and_then(|edge| usize::try_from(edge).ok())
    }

    /// Reads the manifest beside `table`; `None` if there is no manifest.
    ///
    /// # Errors
    /// When the manifest exists but this version cannot read it.
    pub fn read(table: &Path) -> Result<Option<Self>> {
        let path = Self::path_for(table);
        if !path.try_exists().with_context(|| format!("cannot read {}", path.display()))? {
            return Ok(None);
        }
        let text = read_text(&path, MAX_MANIFEST_BYTES)
            .with_context(|| format!("cannot read {}", path.display()))?;
        Self::parse(&text).map(Some).with_context(|| format!("{} is no manifest", path.display()))
    }

    /// Reads a manifest's text.
    ///
    /// # Errors
    /// When this version cannot read the text.
    pub fn parse(text: &str) -> Result<Self> {
        let manifest: Self = serde_json::from_str(text)?;
        ensure!(
            manifest.format == MANIFEST_FORMAT,
            "format is {:?}; this version reads {MANIFEST_FORMAT:?}",
            manifest.format
        );
        Ok(manifest)
    }
}
