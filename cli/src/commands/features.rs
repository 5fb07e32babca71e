//! `entire features`: scene features of the frames of timing tables, stored beside them.

use crate::dataset::feature_table::{FeatureTable, code_column, encoder_id, quantity_column};
use crate::dataset::{Table, TimedFrame};
use crate::files::open_model;
use crate::inputs::measure;
use crate::options::thread_pool;
use crate::progress::{INPUTS_BAR, templated_bar};
use anyhow::{Context, Result, ensure};
use entire_core::features::{MAX_PROBE_SIDE, PROBE_SIDE, SceneQuantity};
use entire_core::nn::VolumeNet;
use std::path::PathBuf;

/// Compute the scene features of collected frames and keep them beside the tables.
///
/// `NAME.csv` gets `NAME.features.csv.gz`; training and evaluation then no longer need the volumes. Run it
/// again after every version that changes the features.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire features --data frames.csv
  entire features --data frames.csv --volumenet models/volumenet-128f2.safetensors --root ../volumes")]
pub struct Options {
    /// Timing tables written by `entire collect`.
    #[arg(long, required = true, num_args = 1.., value_name = "CSV")]
    pub data: Vec<PathBuf>,
    /// Model files whose VolumeNet encodes the volumes, for models with volume features.
    #[arg(long, num_args = 1.., value_name = "SAFETENSORS")]
    pub volumenet: Vec<PathBuf>,
    /// Rays along each side of additional probes, 1 to 24, for models with cheaper or finer probes than the
    /// standard 11, which is always computed.
    #[arg(long, value_delimiter = ',', value_name = "SIDES")]
    pub probe_sides: Vec<usize>,
    /// Folder of the tables' volumes, if it is neither the working folder nor the table's.
    #[arg(long, value_name = "FOLDER")]
    pub root: Option<PathBuf>,
    /// Threads; default: all logical processors.
    #[arg(long)]
    pub threads: Option<usize>,
}

/// Runs the command.
///
/// # Errors
/// When a table, volume or encoder cannot be read, or a file cannot be written.
pub fn run(options: &Options) -> Result<()> {
    let mut further = Vec::new();
    for &side in &options.probe_sides {
        ensure!(
            (1..=MAX_PROBE_SIDE).contains(&side),
            "--probe-sides names {side}; accepted are 1 to {MAX_PROBE_SIDE}"
        );
        if side != PROBE_SIDE && !further.contains(&side) {
            further.push(side);
        }
    }
    let pool = thread_pool(options.threads)?;
    let mut encoders = Vec::new();
    for path in &options.volumenet {
        let model = open_model(path)?;
        let parts = model.volumenet().with_context(|| format!("{} holds no VolumeNet", path.display()))?;
        encoders.push((encoder_id(parts), VolumeNet::new(parts)?));
    }
    for path in &options.data {
        let mut table = Table::read_without_features(path, 0)?;
        table.root.clone_from(&options.root);
        let tables = [table];
        let frames: Vec<&TimedFrame> = tables[0].frames.iter().collect();
        ensure!(!frames.is_empty(), "{} has no frames; collect some with `entire collect`", path.display());
        let mut columns: Vec<String> = SceneQuantity::ALL.iter().map(|q| q.to_string()).collect();
        let bar = templated_bar(INPUTS_BAR);
        let mut rows = measure(&tables, &frames, Some(PROBE_SIDE), None, &pool, &bar, |_, inputs| {
            let work = inputs.features.work(&inputs.setting);
            Ok(SceneQuantity::ALL
                .iter()
                .map(|&q| inputs.features.quantity(q, &inputs.setting, &work) as f32)
                .collect::<Vec<f32>>())
        })?;
        for &side in &further {
            let probed: Vec<SceneQuantity> =
                SceneQuantity::ALL.iter().copied().filter(|q| q.needs_probe()).collect();
            bar.reset();
            let more = measure(&tables, &frames, Some(side), None, &pool, &bar, |_, inputs| {
                let work = inputs.features.work(&inputs.setting);
                Ok(probed
                    .iter()
                    .map(|&q| inputs.features.quantity(q, &inputs.setting, &work) as f32)
                    .collect::<Vec<f32>>())
            })?;
            columns.extend(probed.iter().map(|&q| quantity_column(q, side)));
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
        println!("{} frames, {columns_count} columns in {}", numbers.len(), out.display());
    }
    Ok(())
}
