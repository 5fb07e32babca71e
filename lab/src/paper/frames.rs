//! The frames of a data set and mode: timing tables with their features, and the same frames at low
//! resolution.

use super::Work;
use super::collect::{Kind, table_path};
use super::description::{DataSet, Panel, Paper};
use super::encode::{ALL, Encoder};
use super::volumes::{Parts, Place, places};
use crate::study::{Low, twins};
use anyhow::Result;
use entire_cli::commands::features;
use entire_io::dataset::feature_table::{FeatureTable, code_column, encoder_id, quantity_column};
use entire_io::dataset::{Clock, Table};
use entire_io::files::{fnv1a_text, open_model, read_bytes};
use entire_steer::features::{PROBE_SIDE, SceneQuantity};
use entire_train::fit::Recipe;
use entire_train::inputs::volumenet_of;
use entire_train::split::TimedFrames;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Version of the results: raised whenever the same frames give other results.
const MADE_AS: u32 = 3;

pub(super) struct Loaded {
    /// All tables; a frame names its table by the index in this list.
    pub(super) tables: Vec<Table>,
    /// Index of the table of the experiments in which one parameter varies, if it was collected.
    pub(super) varied: Option<usize>,
    /// Tables of volumes of another kind: title and index.
    pub(super) modalities: Vec<(String, usize)>,
    pub(super) low: Low,
}

pub(super) struct SplitFrames<'a> {
    pub(super) training: TimedFrames<'a>,
    /// Frames that decide when training stops.
    pub(super) validation: TimedFrames<'a>,
    pub(super) test: TimedFrames<'a>,
}

impl Loaded {
    /// Reads the tables; `None` if the frames were not collected. Missing features are computed.
    pub(super) fn read(work: &Work<'_>, place: &Place, mode: &str, clock: Clock) -> Result<Option<Self>> {
        let main = table_path(work.out, &place.set.name, mode, Kind::Random, false);
        if !main.exists() {
            return Ok(None);
        }
        let mut out = Self { tables: Vec::new(), varied: None, modalities: Vec::new(), low: Low::new() };
        out.add(work, place, mode, Kind::Random, clock)?;
        if table_path(work.out, &place.set.name, mode, Kind::Varied, false).exists() {
            out.varied = Some(out.add(work, place, mode, Kind::Varied, clock)?);
        }
        for set in work.paper.data_sets.iter().filter(|d| d.only_tests) {
            let found = table_path(work.out, &set.name, mode, Kind::Random, false).exists();
            if let (true, Some(other)) = (found, Place::find(set, work.data)?) {
                let at = out.add(work, &other, mode, Kind::Random, clock)?;
                out.modalities.push((set.title.clone(), at));
            }
        }
        Ok(Some(out))
    }

    fn add(&mut self, work: &Work<'_>, place: &Place, mode: &str, kind: Kind, clock: Clock) -> Result<usize> {
        let path = table_path(work.out, &place.set.name, mode, kind, false);
        with_features(work, place, &path)?;
        let index = self.tables.len();
        let table = Table { root: Some(place.root.clone()), ..Table::read(&path, index)? };
        let low = table_path(work.out, &place.set.name, mode, kind, true);
        if low.exists() {
            twins((index, &table), &low, clock, &mut self.low)?;
        }
        self.tables.push(table);
        Ok(index)
    }

    /// Returns the frames of a split: of a validation volume, the number that the description specifies; of a
    /// training or test volume, all.
    pub(super) fn split(&self, work: &Work<'_>, parts: &Parts, clock: Clock) -> SplitFrames<'_> {
        let of = |names: &BTreeSet<String>, most: u32| {
            let each = u64::from(work.paper.frames.training);
            let wanted = self.tables[0]
                .frames
                .iter()
                .filter(|f| names.contains(&f.scene.volume) && f.number % each < u64::from(most));
            TimedFrames::of(wanted, clock)
        };
        let counts = work.paper.frames;
        SplitFrames {
            training: of(&parts.training, counts.training),
            validation: of(&parts.validation, counts.held_out),
            test: of(&parts.test, counts.training),
        }
    }

    pub(super) fn all(&self, table: usize, clock: Clock) -> TimedFrames<'_> {
        TimedFrames::of(&self.tables[table].frames, clock)
    }
}

/// The encoders for a data set's frames: those trained on the data set or on all data sets together, if there
/// are any, and the shipped ones. Test-only volumes are encoded by the encoders of every data set.
fn encoders_of(work: &Work<'_>, set: &DataSet) -> Result<Vec<PathBuf>> {
    let wanted = |e: &Encoder| set.only_tests || e.set == set.name || e.set == ALL;
    let all = trained(work, None)?.into_iter().filter(wanted).map(|e| e.path(work.out));
    Ok(all.chain(work.paper.encoders.shipped.iter().cloned()).collect())
}

/// The trained encoders, except those of the capacity sweep. With `set`, only the encoders of this data set.
pub(super) fn trained(work: &Work<'_>, set: Option<&str>) -> Result<Vec<Encoder>> {
    let mut out = Vec::new();
    let names = work.paper.data_sets.iter().map(|d| d.name.as_str()).chain([ALL]);
    for name in names.filter(|n| set.is_none_or(|s| s == *n)) {
        for encoder in Encoder::of_set(&work.paper.encoders, name) {
            if encoder.channels.is_empty() && encoder.is_trained(work.out)? {
                out.push(encoder);
            }
        }
    }
    Ok(out)
}

/// Returns the encoder for the parts of the study that do not compare encoders, and its description in words.
/// If `own` names a data set, the function returns an encoder that was trained on this data set and has as
/// many features as the main encoder; encoders with the main encoder's input size are preferred. Without
/// `own`, or if there is no such encoder, the function returns the shipped encoder, which was trained without
/// the test members.
pub(super) fn main_encoder(work: &Work<'_>, own: Option<&str>) -> Result<(PathBuf, String)> {
    let (size, features) = work.paper.encoders.main;
    if let Some(set) = own {
        let mut own = trained(work, Some(set))?;
        own.retain(|e| e.features == features);
        own.sort_by_key(|e| e.size != size);
        if let Some(found) = own.first() {
            let what = format!(
                "VolumeNet with {0}³ input voxels and {1} features ({0}³F{1}), trained on this data set's \
                 training volumes",
                found.size, found.features
            );
            return Ok((found.path(work.out), what));
        }
    }
    let path = work.paper.encoders.shipped[0].clone();
    let name = path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    Ok((path, format!("{name} as shipped, trained on members of three data sets together")))
}

/// Computes the features of a table unless they exist.
fn with_features(work: &Work<'_>, place: &Place, path: &Path) -> Result<()> {
    let table = Table::read_without_features(path, 0)?;
    let encoders = encoders_of(work, &place.set)?;
    let mut sides: Vec<usize> = work.paper.ours.values().filter_map(|r| r.probe_side).collect();
    sides.retain(|s| *s != PROBE_SIDE);
    sides.sort_unstable();
    sides.dedup();
    // Features of a table that has grown since they were computed are refused, and computed again.
    let there = FeatureTable::beside(path, &table.frames, table.hash).ok().flatten();
    let mut wanted: Vec<String> =
        sides.iter().map(|&s| quantity_column(SceneQuantity::SamplesPerPixel, s)).collect();
    for encoder in &encoders {
        let model = open_model(encoder)?;
        let parts = volumenet_of(&model, encoder)?;
        wanted.push(code_column(&encoder_id(parts), 0));
    }
    if there.is_some_and(|t| wanted.iter().all(|w| t.column(w).is_some())) {
        return Ok(());
    }
    features::run(&features::Options {
        data: vec![path.to_owned()],
        volumenet: encoders,
        probe_sides: sides,
        root: Some(place.root.clone()),
        threads: Some(work.pool.current_num_threads()),
    })
}

/// The data sets and modes of a part of the study, as far as they are selected and available.
pub(super) fn of_panel(work: &Work<'_>, panel: Panel) -> Result<Vec<(Place, String)>> {
    let all = places(work.paper, work.selection, work.data)?;
    let named = work.paper.panels.get(&panel);
    let mut out = Vec::new();
    for place in all.into_iter().filter(|p| !p.set.only_tests) {
        for mode in place.set.modes.clone() {
            let wanted = named.is_none_or(|n| n.iter().any(|(s, m)| *s == place.set.name && *m == mode));
            if wanted && work.selection.has_mode(&mode) {
                out.push((place.clone(), mode));
            }
        }
    }
    Ok(out)
}

/// Times of the proxy as text, for a hash of inputs.
pub(super) fn low_as_text(low: &Low) -> String {
    low.iter().map(|((table, number), s)| format!(" {table} {number} {:016x}", s.to_bits())).collect()
}

/// Hash of the inputs of a part of the study.
pub(super) fn identity(
    work: &Work<'_>,
    panel: Panel,
    set: &str,
    tables: &[Table],
    low: &Low,
) -> Result<String> {
    let p: &Paper = work.paper;
    let bare = |r: &Recipe| Recipe { volumenet: None, ..r.clone() };
    let ours: BTreeMap<&String, Recipe> = p.ours.iter().map(|(m, r)| (m, bare(r))).collect();
    let mut text = format!(
        "{MADE_AS} {} {set} {} {} {} {}",
        env!("CARGO_PKG_VERSION"),
        panel.name(),
        p.clock,
        p.runs,
        serde_json::to_string(&(p.frames, bare(&p.network), ours, &p.shares, &p.depths, &p.encoder_depth))?,
    );
    text += &serde_json::to_string(&(&p.finalists, &p.tuning.frames, p.tuning.epochs, p.orbit.poses))?;
    text += &format!(" proxy {}", p.proxy);
    for d in &p.data_sets {
        text += &format!(" {} {:?} {:?}", d.name, d.rule, d.members);
    }
    text += &low_as_text(low);
    for table in tables {
        text +=
            &format!(" {:016x} {:016x}", table.hash, table.features.as_ref().map_or(0, FeatureTable::hash));
    }
    for own in [Some(set), None] {
        let bytes = read_bytes(&main_encoder(work, own)?.0)?;
        text += &format!(" {}", fnv1a_text(&bytes));
    }
    Ok(fnv1a_text(text.as_bytes()))
}
