//! Tasks of a recorded path, predicted by a model that was fitted to other volumes.

use super::factor::Factor;
use crate::trace::{Curve, Trace};
use anyhow::{Context, Result, ensure};
use entire_cli::steering::calibrate::{Quality, Sample};
use entire_farm::Task;
use entire_io::metrics::median;
use entire_steer::features::{Changes, FrameFeatures, MAX_PROBE_SIDE, Setting, TransferSummary};
use entire_steer::predict::{AnalyticModel, Inputs, Measurement, Predictor, UnitCosts};
use std::path::PathBuf;

/// Frames of recorded paths as samples, one scene per frame, and the volume's index of each sample.
#[derive(Default)]
struct Recorded {
    samples: Vec<Sample>,
    volumes: Vec<usize>,
    scenes: usize,
}

impl Recorded {
    /// Adds a sample for every frame of a trace and every recorded ray step at full image size.
    fn add(&mut self, trace: &Trace, probe_side: usize) -> Result<()> {
        let (path, summaries) = (trace.path.resolve()?, trace.summaries()?);
        let mut features = FrameFeatures::with_probe_side(probe_side);
        let before = self.volumes.iter().max().map_or(0, |v| v + 1);
        for (index, at) in path.frames.iter().enumerate() {
            let volume = trace.volume_at(index);
            let table = at.transfer.function().to_table()?;
            let mut transfer = TransferSummary::new(&summaries[volume], &table)?;
            let frame = trace.frame(&path, index)?;
            features.measure(&summaries[volume], &mut transfer, &frame)?;
            for p in trace.frames[index].iter().filter(|p| p.scale == 1.0) {
                self.samples.push(Sample {
                    scene: self.scenes,
                    features: features.clone(),
                    setting: Setting { step: p.step, ..Setting::from(&frame) },
                    camera: at.camera,
                    lobes: at.transfer.lobes().unwrap_or_default(),
                    seconds: median(&mut p.seconds.clone()).context("a point without a time")?,
                });
                self.volumes.push(before + volume);
            }
            self.scenes += 1;
        }
        Ok(())
    }

    /// Fits the analytic model and the factor on its times to the samples of the volumes that `keep` accepts.
    fn fit(&self, keep: impl Fn(usize) -> bool) -> Result<(AnalyticModel, Factor)> {
        let kept: Vec<&Sample> =
            self.samples.iter().zip(&self.volumes).filter(|(_, v)| keep(**v)).map(|(s, _)| s).collect();
        let measured: Vec<Measurement> =
            kept.iter().map(|s| Measurement::new(&s.features, &s.setting, s.seconds)).collect();
        let mut model = AnalyticModel::default();
        model.fit(&UnitCosts::SOFTWARE, &measured)?;
        let pairs = kept.iter().map(|s| Ok((*s, predicted(&mut model, s)?))).collect::<Result<Vec<_>>>()?;
        Ok((model, Factor::fit(&pairs)))
    }

    /// Returns the errors without and with the factor. The model that predicts a volume is fitted to the
    /// other volumes. `None` with fewer than two volumes.
    fn leave_one_out(&self) -> Result<Option<[Quality; 2]>> {
        let volumes: std::collections::BTreeSet<usize> = self.volumes.iter().copied().collect();
        if volumes.len() < 2 {
            return Ok(None);
        }
        let (mut plain, mut with) = (Vec::new(), Vec::new());
        for &out in &volumes {
            let (mut model, factor) = self.fit(|v| v != out)?;
            for (s, _) in self.samples.iter().zip(&self.volumes).filter(|(_, v)| **v == out) {
                let t = predicted(&mut model, s)?;
                plain.push((t, s.seconds));
                with.push((t * factor.of(&s.features, &s.setting, s.camera), s.seconds));
            }
        }
        Ok(Quality::of(&plain).zip(Quality::of(&with)).map(|(a, b)| [a, b]))
    }
}

fn predicted(model: &mut AnalyticModel, s: &Sample) -> Result<f64> {
    Ok(f64::from(model.predict(&s.predictor_inputs(None))?.seconds))
}

/// Fits the predictor of tasks to recorded frames of other volumes, with a probe of `side` rays along each
/// side. Returns the analytic model, and the factor on its times, which is 1 if it does not reduce the error
/// on left-out volumes. Prints the errors.
fn task_predictor(training: &[PathBuf], side: usize) -> Result<(AnalyticModel, Factor)> {
    ensure!(
        (1..=MAX_PROBE_SIDE).contains(&side),
        "--probe-side is {side}; it must lie in 1 to {MAX_PROBE_SIDE}"
    );
    ensure!(
        !training.is_empty(),
        "the frames of --trace cannot be predicted without --training (recorded frames of other volumes)"
    );
    let mut recorded = Recorded::default();
    for file in training {
        recorded.add(&Trace::open(file)?, side)?;
    }
    let (model, mut factor) = recorded.fit(|_| true)?;
    if let Some([plain, with]) = recorded.leave_one_out()? {
        for (title, q) in [("analytic cost model", &plain), ("… times a factor learned from the view", &with)]
        {
            println!(
                "predictor  {title} ({side} x {side} rays; each volume left out in turn, {} frames: median \
                 error {:.1} %, scatter of ln t {:.3})",
                q.frames,
                100.0 * q.median_error,
                q.log_sd
            );
        }
        if with.log_sd > plain.log_sd {
            factor = Factor::none();
        }
    }
    Ok((model, factor))
}

/// Returns the frames of a recorded path at the reference step as tasks. Their predictor is fitted to
/// `training`, recordings of other volumes with the same transfer function, and uses a probe of `probe_side`
/// rays along each side.
pub(crate) fn tasks_of_trace(trace: &Trace, training: &[PathBuf], probe_side: usize) -> Result<Vec<Task>> {
    let (mut predictor, factor) = task_predictor(training, probe_side)?;
    let (path, summaries) = (trace.path.resolve()?, trace.summaries()?);
    let mut features = FrameFeatures::with_probe_side(probe_side);
    let mut tasks = Vec::with_capacity(trace.frames.len());
    let mut took = std::time::Duration::ZERO;
    for (index, at) in path.frames.iter().enumerate() {
        let volume = trace.volume_at(index);
        let table = at.transfer.function().to_table()?;
        let mut transfer = TransferSummary::new(&summaries[volume], &table)?;
        let frame = trace.frame(&path, index)?;
        let begin = std::time::Instant::now();
        features.measure(&summaries[volume], &mut transfer, &frame)?;
        let lobes = at.transfer.lobes();
        let setting = Setting::from(&frame);
        let predicted = predictor.predict(&Inputs {
            features: &features,
            setting,
            changes: Changes::default(),
            camera: at.parallel_scale.map_or(at.camera, |_| features.pose()),
            volume_features: None,
            lobes: lobes.as_deref(),
        })?;
        let seconds = f64::from(predicted.seconds) * factor.of(&features, &setting, at.camera);
        took += begin.elapsed();
        tasks.push(Task {
            task: format!("frame {index}"),
            predicted_s: Some(seconds),
            measured_s: Some(Curve::of(&trace.frames[index]).seconds(1.0)),
            volume: trace.volumes[volume].file.display().to_string(),
            load_s: 0.0,
        });
    }
    println!("prediction {:.3} ms per task", 1e3 * took.as_secs_f64() / tasks.len().max(1) as f64);
    Ok(tasks)
}
