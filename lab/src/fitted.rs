//! Calibration samples of recorded timing tables, and the predictor that steers a replay: the analytic model,
//! fitted to such samples, or the predictor in a model file.

use anyhow::{Context, Result};
use entire_cli::steering::model::{Quality, Sample, SteeringModel};
use entire_cli::steering::rivals::{StepResponse, response};
use entire_core::scene::{Scalars, VolumeView};
use entire_io::dataset::{Clock, TimedFrame, read_tables};
use entire_io::options::thread_pool;
use entire_io::volume::{Reading, open_volume};
use entire_steer::features::PROBE_SIDE;
use entire_steer::predict::{AnalyticModel, UnitCosts};
use entire_train::inputs;
use indicatif::ProgressBar;
use serde::Serialize;
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

/// Number n: one of every n scenes is held out for testing.
const HOLD_OUT_EVERY: usize = 4;

fn held_out(sample: &Sample) -> bool {
    sample.scene % HOLD_OUT_EVERY == HOLD_OUT_EVERY - 1
}

/// A volume of a single voxel, for predictors that use no volume.
pub(crate) fn no_volume() -> Result<VolumeView<'static>> {
    Ok(VolumeView::new(Scalars::U8(&[0]), [1, 1, 1])?)
}

/// A predictor with its errors on held-out calibration frames.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct FittedPredictor {
    pub(crate) title: String,
    pub(crate) held_out: Quality,
    #[serde(skip)]
    pub(crate) model: SteeringModel,
}

impl FittedPredictor {
    /// Fits the analytic model to the samples that are not held out.
    pub(crate) fn fit(samples: &[Sample]) -> Result<Self> {
        let (judged, learned): (Vec<&Sample>, Vec<&Sample>) = samples.iter().partition(|s| held_out(s));
        let measured: Vec<_> =
            learned.iter().map(|s| (s.features.cost_work(&s.setting), s.seconds)).collect();
        let (fitted, _) = AnalyticModel::fit(&UnitCosts::SOFTWARE, &measured, PROBE_SIDE)?;
        let title = "unit costs, fitted to the calibration frames".to_owned();
        let model = SteeringModel::new(title, fitted.to_model_file()?.to_model()?, &no_volume()?)?;
        Self::judged(model.quality(judged), model)
    }

    /// Measures the errors of a given model, which may use features of volumes. `samples` holds each sample
    /// with the path of its volume.
    pub(crate) fn given(model: SteeringModel, samples: &[(String, Sample)]) -> Result<Self> {
        let mut codes: BTreeMap<&str, Option<Vec<f32>>> = BTreeMap::new();
        for (volume, _) in samples.iter().filter(|_| model.volume_features().is_some()) {
            if !codes.contains_key(volume.as_str()) {
                let opened = open_volume(Path::new(volume), &Reading::default())?;
                codes.insert(volume, model.encode(&opened.view())?);
            }
        }
        let code = |volume: &str| codes.get(volume).and_then(|c| c.as_deref());
        let judged = samples.iter().filter(|(_, s)| held_out(s)).map(|(volume, s)| (s, code(volume)));
        Self::judged(model.quality_with(judged), model)
    }

    fn judged(held_out: Result<Quality>, model: SteeringModel) -> Result<Self> {
        let held_out =
            held_out.with_context(|| format!("calibrate with at least {HOLD_OUT_EVERY} scenes"))?;
        Ok(Self { title: model.title().to_owned(), held_out, model })
    }

    /// Root mean square of the predictor's errors in ln(seconds), for a controller that uses the predictor.
    pub(crate) fn log_sd(&self) -> Option<f32> {
        Some(self.held_out.log_sd as f32)
    }
}

/// Returns one calibration sample for each frame of the timing tables, with the name of its volume. Frames
/// with the same volume, camera, image size and transfer function have the same scene number. Scene features
/// come from the default probe.
pub(crate) fn samples_by_volume(tables: &[PathBuf]) -> Result<Vec<(String, Sample)>> {
    let tables = read_tables(tables)?;
    let frames: Vec<&TimedFrame> = tables.iter().flat_map(|t| &t.frames).collect();
    let clock = [Clock::Cpu, Clock::Device, Clock::Wall]
        .into_iter()
        .find(|c| frames.iter().all(|f| f.seconds(*c).is_some()))
        .context(
            "the calibration tables share no clock: every frame needs seconds_cpu, or every frame needs the \
             time of one other clock",
        )?;
    let pool = thread_pool(None)?;
    let mut numbers: HashMap<String, usize> = HashMap::new();
    let scenes: HashMap<(usize, u64), usize> = frames
        .iter()
        .map(|f| {
            let s = &f.scene;
            let key = format!("{} {:?} {} {} {:?}", s.volume, s.camera, s.width, s.height, s.lobes);
            let next = numbers.len();
            ((f.table, f.number), *numbers.entry(key).or_insert(next))
        })
        .collect();
    let side = Some(PROBE_SIDE);
    inputs::measure(&tables, &frames, side, None, &pool, &ProgressBar::hidden(), |frame, inputs| {
        let sample = Sample {
            scene: scenes[&(frame.table, frame.number)],
            features: inputs.features.clone(),
            setting: inputs.setting,
            camera: inputs.camera,
            lobes: frame.scene.lobes.clone(),
            seconds: frame.seconds(clock).context("a frame without a time")?,
        };
        Ok((frame.scene.volume.clone(), sample))
    })
}

/// Returns the response curve G, fitted to samples.
pub(crate) fn response_of(samples: &[Sample]) -> Result<StepResponse> {
    response(samples)
        .context("G, the curve of frame time over step, needs scenes that were timed at several steps")
}
