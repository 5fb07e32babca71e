//! Model inputs for measured frames: opens the volumes that a timing table names, one at a time, and computes what a
//! model's input groups ask for.

use crate::dataset::{Table, TimedFrame};
use crate::enlarge::{MAX_FACTOR, enlarge};
use crate::feature_table::{code_column, encoder_id, quantity_column};
use crate::volume::Volume;
use anyhow::{Context, Result, bail, ensure};
use entire_core::features::{
    Changes, FrameFeatures, PROBE_SIDE, SceneFeature, SceneQuantity, Setting, SummaryOptions,
    TransferSummary, VolumeSummary,
};
use entire_core::model::Model;
use entire_core::nn::{Executor, VolumeNet, VolumeNetParts};
use entire_core::predict::{
    COST_QUANTITIES, GroupKind, Inputs, UnitCosts, probe_side_of, sort_lobes, takes_sorted_lobes,
    write_estimate, write_group,
};
use entire_core::scene::Skipping;
use indicatif::ProgressBar;
use rayon::ThreadPool;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// A VolumeNet and the name of its weights in feature tables.
#[derive(Debug)]
pub struct Encoder {
    id: String,
    net: VolumeNet,
}

impl Encoder {
    /// From checked weights.
    ///
    /// # Errors
    /// As [`VolumeNet::new`].
    pub fn new(parts: &VolumeNetParts) -> Result<Self> {
        Ok(Self { id: encoder_id(parts), net: VolumeNet::new(parts)? })
    }
}

/// What a model takes: its input groups in order with their sizes, and what is needed to compute them.
#[derive(Debug)]
pub struct Layout {
    groups: Vec<(GroupKind, usize)>,
    scene_features: Vec<SceneFeature>,
    encoder: Option<Encoder>,
    unit_costs: Option<UnitCosts>,
    probe_side: usize,
    sorted_lobes: bool,
}

impl Layout {
    /// A layout for a new model. `lobes` is the number of Gaussian lobes of the transfer functions.
    ///
    /// # Errors
    /// When a group stands there twice or none does, volume features are asked for without an encoder, or there are no
    /// lobes to take.
    pub fn new(
        groups: &[GroupKind],
        scene_features: Vec<SceneFeature>,
        lobes: usize,
        encoder: Option<Encoder>,
    ) -> Result<Self> {
        ensure!(!groups.is_empty(), "a model needs at least one input group");
        let mut sized = Vec::new();
        for (i, &group) in groups.iter().enumerate() {
            ensure!(!groups[..i].contains(&group), "input group {} is named twice", group.name());
            let size = match group {
                GroupKind::VolumeFeatures => match &encoder {
                    Some(encoder) => encoder.net.feature_len(),
                    None => bail!(
                        "the input group volume_features needs an encoder; name a model file that holds a VolumeNet"
                    ),
                },
                GroupKind::Camera => 3,
                GroupKind::Resolution => 2,
                GroupKind::TransferFunction => {
                    ensure!(lobes > 0, "the input group transfer_function needs at least one Gaussian lobe");
                    3 * lobes
                }
                GroupKind::StepSize => 1,
                GroupKind::SceneFeatures => {
                    ensure!(!scene_features.is_empty(), "the input group scene_features names no feature");
                    scene_features.len()
                }
                other => bail!("the input group {} cannot be computed from a timing table", other.name()),
            };
            sized.push((group, size));
        }
        Ok(Self {
            groups: sized,
            scene_features,
            encoder,
            unit_costs: None,
            probe_side: PROBE_SIDE,
            sorted_lobes: false,
        })
    }

    /// The layout of a model file.
    ///
    /// # Errors
    /// When it holds no PredNet, an input group is unknown, or volume features are needed and the file has no VolumeNet.
    pub fn of_model(model: &Model) -> Result<Self> {
        ensure!(model.prednet().is_some(), "the model file holds no PredNet");
        let groups: Vec<(GroupKind, usize)> = model
            .inputs()
            .iter()
            .map(|g| Ok((GroupKind::from_name(&g.name)?, g.size)))
            .collect::<Result<_>>()?;
        let scene_features = model
            .scene_features()
            .iter()
            .map(|name| Ok(SceneFeature::from_name(name)?))
            .collect::<Result<_>>()?;
        let encoder = model.volumenet().map(Encoder::new).transpose()?;
        ensure!(
            encoder.is_some() || groups.iter().all(|(g, _)| *g != GroupKind::VolumeFeatures),
            "the model takes volume_features and its file holds no VolumeNet; write both into one file"
        );
        Ok(Self {
            groups,
            scene_features,
            encoder,
            unit_costs: UnitCosts::of(model)?,
            probe_side: probe_side_of(model)?,
            sorted_lobes: takes_sorted_lobes(model)?,
        })
    }

    /// The same with another number of rays along each side of the probe.
    pub fn with_probe_side(self, probe_side: usize) -> Self {
        Self { probe_side, ..self }
    }

    /// The same, its Gaussian lobes by ascending center or as they are given.
    pub fn with_sorted_lobes(self, sorted_lobes: bool) -> Self {
        Self { sorted_lobes, ..self }
    }

    /// Whether Gaussian lobes go in by ascending center.
    pub fn sorted_lobes(&self) -> bool {
        self.sorted_lobes
    }

    /// Rays along each side of the probe.
    pub fn probe_side(&self) -> usize {
        self.probe_side
    }

    /// Numbers per frame.
    pub fn width(&self) -> usize {
        self.groups.iter().map(|(_, size)| size).sum()
    }

    /// The groups as a model file states them.
    pub fn to_model_groups(&self) -> Vec<entire_core::model::InputGroup> {
        self.groups
            .iter()
            .map(|(g, size)| entire_core::model::InputGroup { name: g.name().into(), size: *size })
            .collect()
    }

    /// The groups, in order.
    pub fn groups(&self) -> impl Iterator<Item = GroupKind> {
        self.groups.iter().map(|(g, _)| *g)
    }

    /// The scene features, in order.
    pub fn scene_features(&self) -> &[SceneFeature] {
        &self.scene_features
    }

    fn encoder(&self) -> Option<&Encoder> {
        self.encoder.as_ref().filter(|_| self.groups().any(|g| g == GroupKind::VolumeFeatures))
    }

    fn needs_summary(&self) -> bool {
        self.groups().any(|g| g == GroupKind::SceneFeatures)
    }

    /// Writes one frame's inputs.
    ///
    /// # Errors
    /// When a group's size is not the model's (another number of lobes, for example).
    pub fn write(&self, inputs: &Inputs<'_>, row: &mut [f32]) -> Result<()> {
        let mut rest = row;
        for (group, size) in &self.groups {
            let (here, after) = std::mem::take(&mut rest).split_at_mut(*size);
            write_group(*group, &self.scene_features, inputs, here)?;
            if *group == GroupKind::TransferFunction && self.sorted_lobes {
                sort_lobes(here);
            }
            if *group == GroupKind::SceneFeatures
                && let Some(costs) = &self.unit_costs
            {
                write_estimate(costs, &self.scene_features, inputs, here);
            }
            rest = after;
        }
        Ok(())
    }

    /// Inputs of frames, one row each, in their order.
    ///
    /// # Errors
    /// As [`measure`]; also when a frame lacks what a group needs.
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
            self.needs_summary().then_some(self.probe_side),
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
}

impl Layout {
    /// Rows from the features that are kept beside the tables; `None` where any is missing.
    fn rows_beside(&self, tables: &[Table], frames: &[&TimedFrame]) -> Option<Vec<f32>> {
        let code_id = self.encoder().map(|e| &e.id);
        let mut out = Vec::with_capacity(frames.len() * self.width());
        let mut plan: Vec<usize> = Vec::new();
        let mut planned = None;
        for frame in frames {
            let features = tables.get(frame.table)?.features.as_ref()?;
            if planned != Some(frame.table) {
                plan.clear();
                for (group, size) in &self.groups {
                    match group {
                        GroupKind::SceneFeatures => {
                            for f in &self.scene_features {
                                plan.push(features.column(&quantity_column(f.quantity, self.probe_side))?);
                            }
                        }
                        GroupKind::VolumeFeatures => {
                            for i in 0..*size {
                                plan.push(features.column(&code_column(code_id?, i))?);
                            }
                        }
                        _ => {}
                    }
                }
                planned = Some(frame.table);
            }
            let row = features.row(frame.number)?;
            let mut columns = plan.iter();
            let scene = &frame.scene;
            for (group, size) in &self.groups {
                let start = out.len();
                match group {
                    GroupKind::SceneFeatures => {
                        for f in &self.scene_features {
                            let column = *columns.next()?;
                            let value = match &self.unit_costs {
                                Some(costs) if f.quantity == SceneQuantity::EstimatedSeconds => {
                                    // What costs nothing need not be kept.
                                    let work: Option<Vec<f32>> = COST_QUANTITIES
                                        .iter()
                                        .zip(&costs.0[1..])
                                        .map(|(q, &cost)| {
                                            let name = quantity_column(*q, self.probe_side);
                                            if cost == 0.0 {
                                                Some(0.0)
                                            } else {
                                                Some(row[features.column(&name)?])
                                            }
                                        })
                                        .collect();
                                    costs.seconds_of_quantities(&work?) as f32
                                }
                                _ => row[column],
                            };
                            out.push(if f.log { f.quantity.log(f64::from(value)) } else { value });
                        }
                    }
                    GroupKind::VolumeFeatures => {
                        for _ in 0..*size {
                            out.push(row[*columns.next()?]);
                        }
                    }
                    GroupKind::Camera => out.extend([scene.camera.rx, scene.camera.ry, scene.camera.dz]),
                    GroupKind::Resolution => out.extend([scene.width as f32, scene.height as f32]),
                    GroupKind::TransferFunction => {
                        out.extend(scene.lobes.iter().flat_map(|l| [l.center, l.width, l.height]));
                        if self.sorted_lobes {
                            sort_lobes(&mut out[start..]);
                        }
                    }
                    GroupKind::StepSize => out.push(scene.step),
                    _ => return None,
                }
                if out.len() - start != *size {
                    return None;
                }
            }
        }
        Some(out)
    }
}

/// Calls `f` with everything that is known about each frame before it is drawn, in parallel over the frames of a
/// volume, one volume after another; returns what it gave in the frames' order. `probe_side` goes to
/// [`FrameFeatures::with_probe_side`]; without it the scene features are those of nothing, and volumes are opened only
/// where there is an encoder.
///
/// # Errors
/// When a volume is not found or has another size than the table says, or `f` fails.
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
                volume_summary = Some(
                    VolumeSummary::new(&view, SummaryOptions::default())
                        .with_context(|| format!("volume {name}"))?,
                );
            }
            if let (Some(encoder), Some(scratch)) = (encoder, &mut scratch) {
                code = vec![0.0; encoder.feature_len()];
                encoder
                    .encode(&view, scratch, Executor::rayon(pool), &mut code)
                    .with_context(|| format!("volume {name}"))?;
            }
        }
        let computed: Vec<Result<(usize, T)>> = pool.install(|| {
            members
                .par_iter()
                .map(|&i| {
                    let scene = &frames[i].scene;
                    let frame = scene.to_frame()?;
                    let mut features = FrameFeatures::with_probe_side(probe_side.unwrap_or(0));
                    if let Some(summary) = &volume_summary {
                        let mut transfer = TransferSummary::new(summary, &scene.to_table()?);
                        if scene.skipping == Skipping::Distance {
                            transfer.prepare_distance();
                        }
                        features.measure(summary, &transfer, &frame);
                    }
                    let inputs = Inputs {
                        features: &features,
                        setting: Setting::of(&frame),
                        changes: Changes::NONE,
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

/// Opens the volume that a frame names, enlarged where the table's size is a whole multiple of the file's.
///
/// # Errors
/// When it is not found, cannot be read, or has another size than the table says.
pub fn open_volume(table: &Table, name: &str, dims: [u32; 3]) -> Result<Volume> {
    let path = table.resolve_volume(name).with_context(|| {
        format!(
            "volume {name} of {} is not there, neither from the working folder nor beside the table; run where it was collected, put it there, or keep the features beside the table with `entire features`",
            table.path.display()
        )
    })?;
    let volume = Volume::open(&path)?;
    let want = dims.map(|n| n as usize);
    let have = volume.dims();
    if have == want {
        return Ok(volume);
    }
    let factor = want[0] / have[0].max(1);
    if (2..=MAX_FACTOR).contains(&factor) && have.map(|n| n * factor) == want {
        return enlarge(&volume, factor);
    }
    bail!(
        "volume {name} has {have:?} voxels and {} says {want:?}; is it another file of the same name?",
        table.path.display()
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::commands::features;
    use crate::options::thread_pool;
    use crate::dataset::{Timing, Scene, Writer, parse_lobes, read_tables};
    use entire_core::scene::{Arcball, Shading};

    #[test]
    fn kept_features_give_what_the_volumes_give() {
        let folder = tempfile::tempdir().unwrap();
        let mut bytes = b"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 14 12 10\nencoding: raw\n\n".to_vec();
        bytes.extend((0..14 * 12 * 10).map(|i| (i * 13 % 241) as u8));
        std::fs::write(folder.path().join("v.nrrd"), bytes).unwrap();
        let csv = folder.path().join("t.csv");
        let mut writer = Writer::create(&csv).unwrap();
        let skipping = [Skipping::None, Skipping::Blocks, Skipping::Distance];
        let shading = [Shading::None, Shading::Local, Shading::Scatter];
        for i in 0..12u16 {
            let f = f32::from(i);
            let scene = Scene {
                volume: "v.nrrd".into(),
                member: String::new(),
                time_step: None,
                // The last frames are of the same file enlarged.
                dims: if i < 8 { [14, 12, 10] } else { [28, 24, 20] },
                camera: Arcball { rx: 7.0 * f - 40.0, ry: 31.0 * f, dz: 0.8 + 0.2 * f },
                fov_y_degrees: 45.0,
                width: 20 + 11 * u32::from(i),
                height: 30 + 7 * u32::from(i),
                step: 0.5 + 0.25 * f,
                shading: shading[usize::from(i % 3)],
                skipping: skipping[usize::from(i / 3 % 3)],
                termination: 0.95,
                lobes: parse_lobes("0.8 0.01 0.9;0.3 0.05 0.4").unwrap(),
            };
            let repeat = Timing { wall: Some(0.1), ..Timing::default() };
            writer.append(u64::from(i), &scene, &[repeat]).unwrap();
        }
        drop(writer);
        features::run(&features::Options {
            data: vec![csv.clone()],
            volumenet: Vec::new(),
            probe_sides: vec![5],
            root: None,
            threads: Some(1),
            quiet: true,
        })
        .unwrap();
        let tables = read_tables(std::slice::from_ref(&csv)).unwrap();
        let frames: Vec<&TimedFrame> = tables[0].frames.iter().collect();
        let without = [Table { features: None, ..tables[0].clone() }];
        let pool = thread_pool(Some(1)).unwrap();
        let groups =
            [GroupKind::Camera, GroupKind::SceneFeatures, GroupKind::Resolution, GroupKind::TransferFunction];
        for side in [PROBE_SIDE, 5] {
            for log in [false, true] {
                let features: Vec<SceneFeature> =
                    SceneQuantity::ALL.iter().map(|&quantity| SceneFeature { quantity, log }).collect();
                let layout = Layout::new(&groups, features, 2, None)
                    .unwrap()
                    .with_probe_side(side)
                    .with_sorted_lobes(log);
                let kept = layout.rows_beside(&tables, &frames).unwrap();
                assert_eq!(layout.rows_beside(&without, &frames), None);
                let measured = layout.rows(&without, &frames, &pool, &ProgressBar::hidden()).unwrap();
                assert_eq!((kept.len(), measured.len()), (12 * layout.width(), 12 * layout.width()));
                let lobes = &kept[layout.width() - 6..layout.width()];
                let ascending = [0.3, 0.05, 0.4, 0.8, 0.01, 0.9];
                assert_eq!(lobes, if log { ascending } else { [0.8, 0.01, 0.9, 0.3, 0.05, 0.4] });
                for (i, (a, b)) in kept.iter().zip(&measured).enumerate() {
                    // Quantities are kept in single precision, bit for bit; a logarithm is taken of the rounded one.
                    let close = (a - b).abs() <= f32::EPSILON * b.abs().max(1.0);
                    assert!(
                        if log { close } else { a.to_bits() == b.to_bits() },
                        "{side} {log} {i}: {a} {b}"
                    );
                }
            }
        }
    }
}
