//! Model inputs of measured frames: opens the volumes that a timing table names, one at a time, and computes
//! the values of a model's input groups.

use anyhow::{Context, Result, bail, ensure};
use entire_core::kernels::Executor;
use entire_core::model::Model;
use entire_core::nn::{PredNetParts, VolumeNet, VolumeNetParts};
use entire_core::scene::VolumeView;
use entire_io::dataset::feature_table::{FeatureTable, code_column, encoder_id, quantity_column};
use entire_io::dataset::{Manifest, Scene, Table, TimedFrame};
use entire_io::volume::{MAX_FACTOR, Volume};
use entire_steer::features::{
    Changes, FrameFeatures, SceneFeature, SceneQuantity, Setting, TransferSummary, VolumeSummary,
};
use entire_steer::predict::{COST_QUANTITIES, COSTS, GroupKind, InputLayout, Inputs, UnitCosts};
use indicatif::ProgressBar;
use rayon::ThreadPool;
use rayon::prelude::*;
use std::collections::{BTreeMap, HashMap};
use std::ops::Deref;
use std::path::Path;

/// The network of a model that predicts.
///
/// # Errors
/// When the model holds no PredNet.
pub fn prednet_of(model: &Model) -> Result<&PredNetParts> {
    model.prednet.as_ref().context("the model file holds no PredNet; give a model that predicts")
}

/// The encoder of the model that was read from `path`.
///
/// # Errors
/// When the model holds no VolumeNet.
pub fn volumenet_of<'a>(model: &'a Model, path: &Path) -> Result<&'a VolumeNetParts> {
    let none = || format!("{} holds no VolumeNet; give a model that encodes volumes", path.display());
    model.volumenet.as_ref().with_context(none)
}

/// A VolumeNet, and the name by which feature tables identify its weights.
#[derive(Debug)]
pub struct Encoder {
    id: String,
    net: VolumeNet,
}

impl Encoder {
    /// Returns an encoder from checked weights.
    ///
    /// # Errors
    /// When the blocks of the network do not fit together, or it needs too much memory.
    pub fn new(parts: &VolumeNetParts) -> Result<Self> {
        Ok(Self { id: encoder_id(parts), net: VolumeNet::new(parts)? })
    }
}

/// Inputs of a model, and the encoder of its volume features.
#[derive(Debug)]
pub struct Layout {
    layout: InputLayout,
    encoder: Option<Encoder>,
}

impl Deref for Layout {
    type Target = InputLayout;

    fn deref(&self) -> &InputLayout {
        &self.layout
    }
}

impl Layout {
    /// Returns a layout for a new model. `lobes` is the number of Gaussian lobes of the transfer functions.
    ///
    /// # Errors
    /// When a group appears twice or none is given, volume features are requested without an encoder, lobes
    /// are requested and `lobes` is 0, or scene features are requested and none is named.
    pub fn new(
        groups: &[GroupKind],
        scene_features: Vec<SceneFeature>,
        lobes: usize,
        encoder: Option<Encoder>,
    ) -> Result<Self> {
        let volume_features = encoder.as_ref().map_or(0, |e| e.net.feature_len());
        Ok(Self { layout: InputLayout::new(groups, scene_features, lobes, volume_features)?, encoder })
    }

    /// Returns the layout of a model file.
    ///
    /// # Errors
    /// When the file contains no PredNet, an input group is unknown, or volume features are needed and the
    /// file has no VolumeNet.
    pub fn of_model(model: &Model) -> Result<Self> {
        prednet_of(model)?;
        let layout = InputLayout::of_model(model)?;
        let encoder = model.volumenet.as_ref().map(Encoder::new).transpose()?;
        ensure!(
            encoder.is_some() || layout.groups.iter().all(|g| g.0 != GroupKind::VolumeFeatures),
            "the model takes volume_features, but its file holds no VolumeNet; put both networks into one \
             file"
        );
        Ok(Self { layout, encoder })
    }

    /// Returns the layout with another number of rays along each side of the probe; unchanged if no input
    /// needs a probe.
    pub fn with_probe_side(mut self, probe_side: usize) -> Self {
        self.layout.probe_side = if self.layout.probe_side > 0 { probe_side } else { 0 };
        self
    }

    /// Returns the layout with Gaussian lobes sorted by center if `sorted_lobes` is true, else in their given
    /// order.
    pub fn with_sorted_lobes(mut self, sorted_lobes: bool) -> Self {
        self.layout.sorted_lobes = sorted_lobes;
        self
    }

    /// Number of rays along each side of the probe; 0 if no input needs a probe.
    pub fn probe_side(&self) -> usize {
        self.layout.probe_side
    }

    /// Widens the range of the training data ([`InputLayout::widen`]).
    pub(crate) fn widen(&mut self, rows: &[f32], width: usize) {
        self.layout.widen(rows, width);
    }

    /// Returns the layout with these unit costs for the quantity `estimated_seconds`.
    pub(crate) fn with_unit_costs(mut self, costs: UnitCosts) -> Self {
        (self.layout.unit_costs, self.layout.cached_voxels) = (Some(costs), costs.cached_voxels);
        self
    }

    fn encoder(&self) -> Option<&Encoder> {
        self.encoder.as_ref().filter(|_| self.groups.iter().any(|g| g.0 == GroupKind::VolumeFeatures))
    }

    pub(crate) fn needs_summary(&self) -> bool {
        self.groups.iter().any(|g| g.0 == GroupKind::SceneFeatures)
    }

    /// Returns the inputs of frames, one row each, in the order of the frames.
    ///
    /// # Errors
    /// When a volume is not found or has another size than the table states, or a frame lacks what a group
    /// needs.
    pub fn rows(
        &self,
        tables: &[Table],
        frames: &[&TimedFrame],
        pool: &ThreadPool,
        bar: &ProgressBar,
    ) -> Result<Vec<f32>> {
        if let Some(rows) = self.rows_beside(tables, frames) {
            return Ok(rows);
        }
        let rows = measure(
            tables,
            frames,
            self.needs_summary().then_some(self.probe_side()),
            self.encoder().map(|e| &e.net),
            pool,
            bar,
            |frame, inputs| {
                let mut row = vec![0.0; self.width()];
                self.write(inputs, &mut row).with_context(|| format!("frame {}", frame.number))?;
                Ok(row)
            },
        )?;
        Ok(rows.concat())
    }

    /// Returns rows from the feature tables; `None` if any value is missing.
    pub fn rows_beside(&self, tables: &[Table], frames: &[&TimedFrame]) -> Option<Vec<f32>> {
        let mut out = vec![0.0; frames.len() * self.width()];
        let unknown = FrameFeatures::default();
        let mut current: Option<(usize, KeptColumns<'_>)> = None;
        for (frame, row) in frames.iter().zip(out.chunks_exact_mut(self.width())) {
            if current.as_ref().is_none_or(|(table, _)| *table != frame.table) {
                current = Some((frame.table, self.kept_columns(tables.get(frame.table)?)?));
            }
            let (_, columns) = current.as_ref()?;
            let kept = columns.features.row(frame.number)?;
            let code: Vec<f32> = columns.code.iter().map(|&column| kept[column]).collect();
            let scene = &frame.scene;
            let Scene { step, width, height, shading, skipping, .. } = *scene;
            let inputs = Inputs {
                features: &unknown,
                setting: Setting { step, width, height, shading, skipping },
                changes: Changes::default(),
                camera: scene.camera,
                volume_features: Some(&code),
                lobes: Some(&scene.lobes),
            };
            self.layout.write_from(&inputs, |q, costs| columns.value(kept, q, costs), row).ok()?;
        }
        Some(out)
    }

    /// Returns the columns of a table's feature table; `None` if a column is missing.
    fn kept_columns<'a>(&self, table: &'a Table) -> Option<KeptColumns<'a>> {
        let features = table.features.as_ref()?;
        let column = |q: SceneQuantity| features.column(&quantity_column(q, self.probe_side()));
        let mut quantities = HashMap::new();
        for feature in &self.scene_features {
            quantities.insert(feature.quantity, column(feature.quantity)?);
        }
        // Cost quantities may be missing: seconds need only those whose unit cost is not 0.
        quantities.extend(COST_QUANTITIES.iter().filter_map(|&q| Some((q, column(q)?))));
        let code = match self.encoder() {
            Some(e) => (0..e.net.feature_len())
                .map(|i| features.column(&code_column(&e.id, i)))
                .collect::<Option<_>>()?,
            None => Vec::new(),
        };
        Some(KeptColumns { features, quantities, code })
    }
}

/// Columns of a feature table that hold a model's inputs.
struct KeptColumns<'a> {
    features: &'a FeatureTable,
    quantities: HashMap<SceneQuantity, usize>,
    code: Vec<usize>,
}

impl KeptColumns<'_> {
    /// Returns the value of a quantity in a row of the feature table; with unit costs, the seconds by these
    /// costs instead. `None` if a needed column is missing.
    fn value(&self, row: &[f32], quantity: SceneQuantity, costs: Option<&UnitCosts>) -> Option<f64> {
        let kept = |quantity: SceneQuantity| self.quantities.get(&quantity).map(|&column| row[column]);
        let Some(costs) = costs else { return kept(quantity).map(f64::from) };
        let mut counts = [0.0; COSTS - 1];
        for (i, (slot, &quantity)) in counts.iter_mut().zip(&COST_QUANTITIES).enumerate() {
            if depends_on(costs, i) {
                *slot = kept(quantity)?;
            }
        }
        // Rounded to single precision, in which feature tables store the quantity `estimated_seconds`.
        Some(f64::from(costs.time(&work_of(counts)) as f32))
    }
}

/// Calls `f` with the inputs of each frame, as known before the frame is drawn. Returns the results in the
/// order of the frames. Volumes are processed one after another, the frames of a volume in parallel.
/// `probe_side` goes to [`FrameFeatures::of`]. If it is `None`, the scene features are empty,
/// and volumes are opened only for an encoder.
///
/// # Errors
/// When a volume is not found or has another size than the table states, or `f` fails.
pub fn measure<T: Send>(
    tables: &[Table],
    frames: &[&TimedFrame],
    probe_side: Option<usize>,
    encoder: Option<&VolumeNet>,
    pool: &ThreadPool,
    bar: &ProgressBar,
    f: impl Fn(&TimedFrame, &Inputs<'_>) -> Result<T> + Sync,
) -> Result<Vec<T>> {
    let mut by_volume: BTreeMap<(usize, &str, [u32; 3]), Vec<usize>> = BTreeMap::new();
    for (i, frame) in frames.iter().enumerate() {
        by_volume.entry((frame.table, frame.scene.volume.as_str(), frame.scene.dims)).or_default().push(i);
    }
    let mut results: Vec<Option<T>> = frames.iter().map(|_| None).collect();
    let mut scratch = encoder.map(VolumeNet::scratch);
    bar.set_length(frames.len() as u64);
    for ((table, name, dims), members) in by_volume {
        let mut code = Vec::new();
        let mut volume_summary = None;
        if probe_side.is_some() || encoder.is_some() {
            let volume = open_volume(&tables[table], name, dims)?;
            let view = volume.view();
            if probe_side.is_some() {
                volume_summary = Some(VolumeSummary::new(&view).with_context(|| format!("volume {name}"))?);
            }
            if let (Some(encoder), Some(scratch)) = (encoder, &mut scratch) {
                code = vec![0.0; encoder.feature_len()];
                encoder
                    .encode(&view, scratch, Executor::Rayon(pool), &mut code)
                    .with_context(|| format!("volume {name}"))?;
            }
        }
        let computed: Vec<Result<(usize, T)>> = pool.install(|| {
            members
                .par_iter()
                .map(|&i| {
                    let scene = &frames[i].scene;
                    let frame = scene.to_frame()?;
                    let features = match (&volume_summary, probe_side) {
                        (Some(summary), Some(side)) => {
                            let mut transfer = TransferSummary::new(summary, &scene.to_table()?)?;
                            FrameFeatures::of(summary, &mut transfer, &frame, side)?
                        }
                        _ => FrameFeatures::default(),
                    };
                    let inputs = Inputs {
                        features: &features,
                        setting: Setting::from(&frame),
                        changes: Changes::default(),
                        camera: scene.camera,
                        volume_features: encoder.map(|_| &code[..]),
                        lobes: Some(&scene.lobes),
                    };
                    let result = f(frames[i], &inputs)?;
                    bar.inc(1);
                    Ok((i, result))
                })
                .collect()
        });
        for one in computed {
            let (i, result) = one?;
            results[i] = Some(result);
        }
    }
    results.into_iter().map(|r| r.context("a frame was left out")).collect()
}

/// Returns VolumeNet's output for a volume; `None` if the model does not use it.
///
/// # Errors
/// When the volume cannot be encoded.
pub fn volume_features(model: &Model, volume: &VolumeView<'_>) -> Result<Option<Vec<f32>>> {
    let parts = model.input_size(GroupKind::VolumeFeatures).and(model.volumenet.as_ref());
    let Some(parts) = parts else { return Ok(None) };
    let net = VolumeNet::new(parts)?;
    let mut out = vec![0.0; net.feature_len()];
    net.encode(volume, &mut net.scratch(), Executor::Serial, &mut out)?;
    Ok(Some(out))
}

/// Opens the volume that a frame names. The volume is resampled if the manifest says so, and enlarged if its
/// size in the table is a whole multiple of its size in the file.
///
/// # Errors
/// When the volume is not found, cannot be read, has another size than the table states, or has changed since
/// its frames were measured.
pub fn open_volume(table: &Table, name: &str, dims: [u32; 3]) -> Result<Volume> {
    let path = table.resolve_volume(name).with_context(|| {
        format!(
            "volume {name} of {} was not found, neither in the working folder nor beside the table; give \
             its folder with --root, run the command in the folder where the table was collected, copy the \
             volume beside the table, or run `entire features` where the volume is",
            table.path.display()
        )
    })?;
    let reading = table.manifest.as_ref().map(Manifest::reading).transpose()?.unwrap_or_default();
    let volume = entire_io::volume::open_volume(&path, &reading)?;
    if let Some(manifest) = &table.manifest
        && let Some(what) = manifest.changed(name, &path)?
    {
        bail!(
            "{} changed after the frames of {} were measured: {what}; restore the file, or collect its \
             frames again into another table",
            path.display(),
            table.path.display()
        );
    }
    let want = dims.map(|n| n as usize);
    let have = volume.dims();
    if have == want {
        return Ok(volume);
    }
    let edge = table.manifest.as_ref().and_then(Manifest::resampled_to_edge);
    if let Some(edge) = edge.filter(|&edge| want == [edge; 3]) {
        return volume.resampled(edge);
    }
    let factor = want[0] / have[0].max(1);
    if (2..=MAX_FACTOR).contains(&factor) && have.map(|n| n * factor) == want {
        return volume.enlarged(factor);
    }
    bail!(
        "volume {name} has {have:?} voxels, but {} says {want:?}; is it another file of the same name?",
        table.path.display()
    );
}

/// True if the time by these unit costs depends on the quantity at this index of [`COST_QUANTITIES`]. If the
/// unit costs have another number of cached voxels than the quantities, the conversion needs the number of
/// touched voxels.
pub(crate) fn depends_on(costs: &UnitCosts, index: usize) -> bool {
    let converted = costs.cached_voxels != UnitCosts::SOFTWARE.cached_voxels;
    costs.seconds[index + 1] != 0.0 || (converted && COST_QUANTITIES[index] == SceneQuantity::TouchedVoxels)
}

/// Returns the numbers that are multiplied by unit costs: 1 for the frame, then the values of
/// [`COST_QUANTITIES`] in their order.
pub fn work_of(counts: [f32; COSTS - 1]) -> [f64; COSTS] {
    let mut work = [1.0; COSTS];
    for (slot, count) in work[1..].iter_mut().zip(counts) {
        *slot = f64::from(count);
    }
    work
}
