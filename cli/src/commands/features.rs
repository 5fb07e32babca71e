//! `entire features`: scene features of the frames of timing tables, stored beside them.

use crate::program::print_line;
use anyhow::{Result, ensure};
use entire_core::nn::VolumeNet;
use entire_io::dataset::feature_table::{FeatureTable, code_column, encoder_id, quantity_column};
use entire_io::dataset::{Table, TimedFrame};
use entire_io::files::open_model;
use entire_io::options::thread_pool;
use entire_io::progress::{INPUTS_BAR, templated_bar};
use entire_steer::features::{MAX_PROBE_SIDE, PROBE_SIDE, SceneQuantity};
use entire_train::inputs::{measure, volumenet_of};
use std::path::PathBuf;

/// Compute the scene features of collected frames and keep them beside the tables.
///
/// Scene features are numbers, such as estimated counts of samples, from which models predict frame times.
/// The features of `NAME.csv` are written to `NAME.features.csv.gz`; training and evaluation then do not need
/// the volumes. Run this command again after an update of the program that changes the features.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire features --data frames.csv
  entire features --data frames.csv --root ../volumes \\
      --volumenet models/volumenet-128f2.safetensors")]
pub struct Options {
    /// Timing tables of `entire collect` or of any program that writes the same format.
    #[arg(long, required = true, num_args = 1.., value_name = "CSV")]
    pub data: Vec<PathBuf>,
    /// Model files with a VolumeNet, the network that computes volume features; only models with volume
    /// features need them.
    #[arg(long, num_args = 1.., value_name = "SAFETENSORS")]
    pub volumenet: Vec<PathBuf>,
    /// Rays along each side of additional probes, comma-separated, 1 to 24 each. A probe is a grid of rays
    /// that estimates a frame's work. The standard probe of 11 x 11 rays is always computed; a model that
    /// uses another probe also needs that probe.
    #[arg(long, value_delimiter = ',', value_name = "SIDES")]
    pub probe_sides: Vec<usize>,
    /// Folder of the tables' volumes, if it is neither the working folder nor the folder of the table.
    #[arg(long, value_name = "FOLDER")]
    pub root: Option<PathBuf>,
    /// Number of threads; default: one per logical processor.
    #[arg(long)]
    pub threads: Option<usize>,
}

/// Runs the command.
///
/// # Errors
/// When a table, volume or encoder cannot be read, or a file cannot be written.
pub fn run(options: &Options) -> Result<()> {
    let mut sides = vec![PROBE_SIDE];
    for &side in &options.probe_sides {
        ensure!(
            (1..=MAX_PROBE_SIDE).contains(&side),
            "--probe-sides names {side}; accepted are 1 to {MAX_PROBE_SIDE}"
        );
        if !sides.contains(&side) {
            sides.push(side);
        }
    }
    let pool = thread_pool(options.threads)?;
    let mut encoders = Vec::new();
    for path in &options.volumenet {
        let model = open_model(path)?;
        let parts = volumenet_of(&model, path)?;
        encoders.push((encoder_id(parts), VolumeNet::new(parts)?));
    }
    for path in &options.data {
        let mut table = Table::read_without_features(path, 0)?;
        table.root.clone_from(&options.root);
        let tables = [table];
        let frames: Vec<&TimedFrame> = tables[0].frames.iter().collect();
        ensure!(!frames.is_empty(), "{} has no frames; collect some with `entire collect`", path.display());
        let mut columns: Vec<String> = Vec::new();
        let bar = templated_bar(INPUTS_BAR);
        let mut rows: Vec<Vec<f32>> = vec![Vec::new(); frames.len()];
        for &side in &sides {
            let quantities = SceneQuantity::ALL.iter().copied();
            let quantities: Vec<SceneQuantity> =
                quantities.filter(|q| side == PROBE_SIDE || q.needs_probe()).collect();
            bar.reset();
            let more = measure(&tables, &frames, Some(side), None, &pool, &bar, |_, inputs| {
                let of = inputs.features.quantities(inputs.setting);
                Ok(quantities.iter().map(|&q| of(q) as f32).collect::<Vec<f32>>())
            })?;
            columns.extend(quantities.iter().map(|&q| quantity_column(q, side)));
            for (row, more) in rows.iter_mut().zip(more) {
                row.extend(more);
            }
        }
        for (id, encoder) in &encoders {
            bar.reset();
            let codes = measure(&tables, &frames, None, Some(encoder), &pool, &bar, |_, inputs| {
                Ok(inputs.volume_features.unwrap_or_default().to_vec())
            })?;
            columns.extend((0..encoder.feature_len()).map(|i| code_column(id, i)));
            for (row, code) in rows.iter_mut().zip(codes) {
                row.extend(code);
            }
        }
        bar.finish_and_clear();
        let numbers: Vec<u64> = frames.iter().map(|f| f.number).collect();
        let out = FeatureTable::path_for(path);
        let columns_count = columns.len();
        FeatureTable::new(columns, &numbers, rows.concat(), tables[0].hash)?.write(&out)?;
        print_line(format!("{} frames, {columns_count} columns in {}", numbers.len(), out.display()))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::{Options, run};
    use entire_core::model::GroupKind;
    use entire_core::scene::{Arcball, Shading, Skipping};
    use entire_io::dataset::{Scene, Table, TimedFrame, Timing, Writer, parse_lobes, read_tables};
    use entire_io::options::thread_pool;
    use entire_steer::features::{PROBE_SIDE, SceneFeature, SceneQuantity};
    use entire_train::inputs::Layout;
    use indicatif::ProgressBar;

    #[test]
    fn kept_features_give_what_the_volumes_give() {
        let folder = tempfile::tempdir().unwrap();
        let mut bytes = b"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 14 12 10\nencoding: raw\n\n".to_vec();
        bytes.extend((0..14 * 12 * 10).map(|i| (i * 13 % 241) as u8));
        std::fs::write(folder.path().join("v.nrrd"), bytes).unwrap();
        let csv = folder.path().join("t.csv");
        let mut writer = Writer::create(&csv).unwrap();
        let skipping = [Skipping::None, Skipping::Blocks, Skipping::Distance];
        let shading = [Shading::None, Shading::LocalScatter, Shading::Scatter];
        for i in 0..12u16 {
            let f = f32::from(i);
            let scene = Scene {
                // The last four frames are of the same file, enlarged by 2.
                dims: if i < 8 { [14, 12, 10] } else { [28, 24, 20] },
                camera: Arcball { rx: 7.0 * f - 40.0, ry: 31.0 * f, dz: 0.8 + 0.2 * f },
                width: 20 + 11 * u32::from(i),
                height: 30 + 7 * u32::from(i),
                step: 0.5 + 0.25 * f,
                shading: shading[usize::from(i % 3)],
                skipping: skipping[usize::from(i / 3 % 3)],
                termination: 0.95,
                lobes: parse_lobes("0.8 0.01 0.9;0.3 0.05 0.4").unwrap(),
                ..TimedFrame::of_no_volume("v.nrrd", "").scene
            };
            let repeat = Timing { wall: Some(0.1), ..Timing::default() };
            writer.append(u64::from(i), &scene, &[repeat]).unwrap();
        }
        drop(writer);
        let (data, probe_sides) = (vec![csv.clone()], vec![5, PROBE_SIDE, 5]);
        run(&Options { data, volumenet: Vec::new(), probe_sides, root: None, threads: Some(1) }).unwrap();
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
                    // Quantities are stored in single precision, so stored and computed values are equal bit
                    // for bit. A logarithm of a stored quantity may differ by rounding.
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
