//! The predictor that steers a replay: the analytic model, fitted to recorded frames, or a model file's.

use anyhow::{Context, Result};
use entire_cli::steering::calibrate::{Quality, Sample};
use entire_cli::steering::model::SteeringModel;
use entire_core::scene::{Scalars, VolumeView};
use entire_io::files::open_volume;
use entire_io::volume::Reading;
use entire_steer::control::Prior;
use entire_steer::predict::{AnalyticModel, UnitCosts};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;

/// Number of scenes of which one is held out for testing.
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
pub(crate) struct Calibrated {
    pub(crate) title: String,
    pub(crate) held_out: Quality,
    #[serde(skip)]
    pub(crate) model: SteeringModel,
}

impl Calibrated {
    /// Fits the analytic model to the samples that are not held out.
    pub(crate) fn fit(samples: &[Sample]) -> Result<Self> {
        let (judged, learned): (Vec<&Sample>, Vec<&Sample>) = samples.iter().partition(|s| held_out(s));
        let measured: Vec<_> =
            learned.iter().map(|s| (s.features.cost_work(&s.setting), s.seconds)).collect();
        let mut fitted = AnalyticModel::default();
        fitted.fit(&UnitCosts::SOFTWARE, &measured)?;
        let title = "unit costs, fitted to the calibration frames".to_owned();
        let model = SteeringModel::new(title, fitted.to_model_file()?.to_model()?, &no_volume()?)?;
        Self::judged(model.quality(judged), model)
    }

    /// Measures the errors of a given model, which may use features of each sample's volume (its path).
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

    /// Prior of the predictor's errors, for a controller that uses the predictor.
    pub(crate) fn prior(&self) -> Prior {
        Prior::Fitted { log_sd: self.held_out.log_sd as f32 }
    }
}
