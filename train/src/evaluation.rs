//! Evaluation of predictors: errors by kind of frame, the constant baseline, warm latency.

use crate::inputs::{Layout, open_volume, volume_features};
use anyhow::{Context, Result};
use entire_core::model::Model;
use entire_io::dataset::{Clock, NoiseFloor, Table, TimedFrame, noise_floor};
use entire_io::metrics::{Metrics, median};
use entire_steer::control::{HybridOptions, ObserveFlags, Session};
use entire_steer::features::{Changes, FrameFeatures, Setting, TransferSummary, VolumeSummary};
use entire_steer::predict::{Inputs, load};
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use rand::seq::SliceRandom;
use serde::Serialize;
use std::collections::BTreeMap;
use std::time::Instant;

/// Share of a volume's frames whose mean time is the constant baseline's prediction for all frames of the
/// volume (Bruder et al. 2022).
pub const PROBE_SHARE: f64 = 0.15;

/// Warm latency of one prediction, in one thread.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct WarmLatency {
    /// Median seconds of one prediction: from the frame's camera to the checked prediction, without the work
    /// per volume and per transfer function.
    pub seconds: f64,
    /// Median seconds of the work per transfer function; 0 if the model uses no scene features.
    pub transfer_seconds: f64,
}

/// A kind of frame: its name, and the test for it.
type Kind = (&'static str, fn(&TimedFrame) -> bool);

const KINDS: [Kind; 6] = [
    ("under 128² pixels", |f| f.scene.pixels() < 128 * 128),
    ("128² to 512² pixels", |f| (128 * 128..512 * 512).contains(&f.scene.pixels())),
    ("512² pixels and more", |f| f.scene.pixels() >= 512 * 512),
    ("eye within 1 radius", |f| f.scene.camera.dz <= 1.0),
    ("finer than the reference step", |f| f.scene.step < 1.0),
    ("coarser than the reference step", |f| f.scene.step > 1.0),
];

/// Returns the errors by image size, distance of the eye (near or inside the volume), and ray step. Kinds
/// without frames are left out.
pub fn by_kind(frames: &[&TimedFrame], predicted: &[f64], measured: &[f64]) -> Vec<(&'static str, Metrics)> {
    let errors = |(name, test): Kind| {
        let (p, t): (Vec<f64>, Vec<f64>) = frames
            .iter()
            .zip(predicted.iter().zip(measured))
            .filter(|(f, _)| test(f))
            .map(|(_, (p, t))| (*p, *t))
            .unzip();
        Some((name, Metrics::new(&p, &t)?))
    };
    KINDS.into_iter().filter_map(errors).collect()
}

/// Returns the noise floor of the frames of each kind; kinds without repeated frames are left out. `passes`:
/// as in [`noise_floor`].
pub fn noise_by_kind(
    frames: &[&TimedFrame],
    clock: Clock,
    passes: impl Fn(&TimedFrame) -> usize,
) -> Vec<(&'static str, NoiseFloor)> {
    let floor = |(name, test): Kind| {
        let of_kind = frames.iter().copied().filter(|f| test(f));
        Some((name, noise_floor(of_kind, clock, &passes)?))
    };
    KINDS.into_iter().filter_map(floor).collect()
}

/// Returns for each frame the mean time of a random share of its volume's frames. The share may include the
/// frame itself.
pub fn probe_means(frames: &[&TimedFrame], measured: &[f64], seed: u64) -> Vec<f64> {
    let mut by_volume: BTreeMap<(usize, &str), Vec<usize>> = BTreeMap::new();
    for (i, f) in frames.iter().enumerate() {
        by_volume.entry((f.table, &f.scene.volume)).or_default().push(i);
    }
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut means = vec![0.0; frames.len()];
    for members in by_volume.into_values() {
        let mut order = members.clone();
        order.shuffle(&mut rng);
        order.truncate(((PROBE_SHARE * members.len() as f64).ceil() as usize).max(1));
        let mean = order.iter().map(|&i| measured[i]).sum::<f64>() / order.len() as f64;
        for i in members {
            means[i] = mean;
        }
    }
    means
}

/// Measures the warm latency on frames of the first volume: the median over many calls.
///
/// # Errors
/// When the model uses scene features and the volume's file is missing: stored features cannot be timed.
pub fn warm_latency(
    model: &Model,
    layout: &Layout,
    tables: &[Table],
    frames: &[&TimedFrame],
) -> Result<WarmLatency> {
    const FRAMES: usize = 64;
    const ROUNDS: usize = 40;
    let first = frames.first().context("there are no frames to compare")?;
    let of_volume: Vec<&TimedFrame> = frames
        .iter()
        .filter(|f| f.table == first.table && f.scene.volume == first.scene.volume)
        .take(FRAMES)
        .copied()
        .collect();
    let mut predictor = load(model)?;
    let code = vec![0.0; model.volumenet.as_ref().map_or(0, |v| v.fc.outputs)];
    let mut summary = None;
    if layout.needs_summary() {
        let volume = open_volume(&tables[first.table], &first.scene.volume, first.scene.dims)?;
        summary = Some(VolumeSummary::new(&volume.view())?);
    }
    let mut features = FrameFeatures::default();
    let (mut all, mut transfer_times) = (Vec::new(), Vec::new());
    for f in of_volume {
        let (frame, table) = (f.scene.to_frame()?, f.scene.to_table()?);
        let mut scene = None;
        if let Some(summary) = &summary {
            let mut transfer = TransferSummary::new(summary, &table)?;
            let start = Instant::now();
            transfer.update(summary, std::hint::black_box(&table))?;
            // Without rays, the call computes only the distance map, and only for a frame that skips by
            // distance.
            FrameFeatures::of(summary, &mut transfer, &frame, 0)?;
            transfer_times.push(start.elapsed().as_secs_f64());
            scene = Some((summary, transfer));
        }
        let setting = Setting::from(&frame);
        for _ in 0..ROUNDS {
            let start = Instant::now();
            if let Some((summary, transfer)) = &mut scene {
                let frame = std::hint::black_box(&frame);
                features = FrameFeatures::of(summary, transfer, frame, layout.probe_side())?;
            }
            let inputs = Inputs {
                features: &features,
                setting,
                changes: Changes::default(),
                camera: f.scene.camera,
                volume_features: Some(&code),
                lobes: Some(&f.scene.lobes),
            };
            std::hint::black_box(predictor.predict(std::hint::black_box(&inputs))?);
            all.push(start.elapsed().as_secs_f64());
        }
    }
    let seconds = median(&mut all).unwrap_or(f64::NAN);
    Ok(WarmLatency { seconds, transfer_seconds: median(&mut transfer_times).unwrap_or(0.0) })
}

/// Returns the seconds that a session predicts. The session plans and observes the frames in their order, as
/// in a render loop, so later predictions use the observations of earlier frames.
///
/// # Errors
/// When a volume is not found or the model predicts no times.
pub fn in_session(
    model: &Model,
    tables: &[Table],
    frames: &[&TimedFrame],
    measured: &[f64],
) -> Result<Vec<f64>> {
    let mut session = Session::new(load(model)?, HybridOptions::default())?;
    let mut shown: Option<(usize, &str, [u32; 3])> = None;
    let mut out = Vec::with_capacity(frames.len());
    for (f, &seconds) in frames.iter().zip(measured) {
        let key = (f.table, f.scene.volume.as_str(), f.scene.dims);
        if shown != Some(key) {
            let volume = open_volume(&tables[f.table], key.1, key.2)?;
            let summary = VolumeSummary::new(&volume.view())?;
            session.set_volume(summary, volume_features(model, &volume.view())?);
            shown = Some(key);
        }
        session.set_transfer(&f.scene.to_table()?, Some(&f.scene.lobes))?;
        let frame = f.scene.to_frame()?;
        let (_, plan) = session.choose(&frame, &[Setting::from(&frame)], NO_TARGET)?;
        out.push(f64::from(plan.seconds));
        session.observe(plan.id, seconds as f32, ObserveFlags::default())?;
    }
    Ok(out)
}

/// Target frame time, seconds. Each frame has a single setting, so the target does not affect the choice.
const NO_TARGET: f32 = 1e3;
