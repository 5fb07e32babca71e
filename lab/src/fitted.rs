//! Predictors fitted to recorded calibration frames, and the choice of the one that steers a replay.

use anyhow::{Context, Result};
use entire_cli::steering::calibrate::{Quality, Sample};
use entire_cli::steering::model::SteeringModel;
use entire_core::model::ModelFile;
use entire_core::nn::Target;
use entire_core::scene::{Scalars, VolumeView};
use entire_io::files::open_volume;
use entire_io::options::thread_pool;
use entire_io::volume::Reading;
use entire_report::Table;
use entire_steer::control::Prior;
use entire_steer::predict::{AnalyticModel, GroupKind, InputLayout, Measurement, UnitCosts};
use entire_train::fit::standard_features;
use entire_train::gradient::{Network, Samples, Settings, train};
use serde::Serialize;
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::Path;

/// Widths of the small network's hidden layers.
const HIDDEN: [usize; 2] = [24, 24];

/// Seed of the small network's weights and of the order of its samples.
const SEED: u64 = 1;

/// Number of scenes of which one is held out for testing.
const HOLD_OUT_EVERY: usize = 4;

/// True for a held-out sample.
fn held_out(sample: &Sample) -> bool {
    sample.scene % HOLD_OUT_EVERY == HOLD_OUT_EVERY - 1
}

/// The analytic cost model fitted to the samples that are not held out.
fn fit_analytic(samples: &[Sample]) -> Result<AnalyticModel> {
    let measurements: Vec<Measurement> = samples
        .iter()
        .filter(|s| !held_out(s))
        .map(|s| Measurement::new(&s.features, &s.setting, s.seconds))
        .collect();
    let mut model = AnalyticModel::default();
    model.fit(&UnitCosts::SOFTWARE, &measurements)?;
    Ok(model)
}

/// A small network on [`standard_features`], trained on ln(seconds) of the samples that are not held
/// out; a fifth of these samples decides when training stops. One thread trains, since the frames are few.
///
/// # Errors
/// When there are too few samples.
pub fn fit_network(samples: &[Sample]) -> Result<ModelFile> {
    let layout = InputLayout::new(&[GroupKind::SceneFeatures], standard_features(), 0, 0)?;
    let collect = |judge: bool| -> Result<(Vec<f32>, Vec<f64>)> {
        let mut inputs = Vec::new();
        let mut seconds = Vec::new();
        for s in samples.iter().filter(|s| !held_out(s) && (s.scene % 5 == 4) == judge) {
            inputs.extend(s.inputs(&layout)?);
            seconds.push(s.seconds);
        }
        Ok((inputs, seconds))
    };
    let ((inputs, seconds), (judge_inputs, judge_seconds)) = (collect(false)?, collect(true)?);
    let (target, seed) = (Target::LogSeconds, SEED);
    let (learning_rate, final_learning_rate) = (3e-3, 3e-5);
    let rest = Settings { learning_rate, final_learning_rate, target, seed, ..Settings::default() };
    let settings = Settings { epochs: 600, batch: 32, patience: 120, ..rest };
    let pool = thread_pool(Some(1))?;
    let widths = [layout.width(), HIDDEN[0], HIDDEN[1], 1];
    let trained = train(
        &pool,
        Network::<f32>::random(&widths, SEED)?,
        None,
        Samples { inputs: &inputs, seconds: &seconds },
        Samples { inputs: &judge_inputs, seconds: &judge_seconds },
        &settings,
        |_| ControlFlow::Continue(()),
    )?;
    let mut file = ModelFile::default();
    layout.store(&trained.to_parts(), &mut file)?;
    Ok(file)
}

/// A predictor with its errors, for reports.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Candidate {
    /// Name of the predictor.
    pub(crate) title: String,
    /// Errors of the predictor on the held-out calibration frames.
    pub(crate) held_out: Quality,
    /// True for the candidate that steers.
    pub(crate) chosen: bool,
    /// The predictor.
    #[serde(skip)]
    pub(crate) fitted: SteeringModel,
}

impl Candidate {
    /// Measures the errors of a predictor. The new candidate is not chosen.
    pub(crate) fn of(fitted: SteeringModel, samples: &[Sample]) -> Result<Self> {
        Self::judged(fitted.quality(samples.iter().filter(|s| held_out(s))), fitted)
    }

    /// As [`Candidate::of`], for a model that may use features of the volume; each sample has the path of its volume.
    pub(crate) fn of_volumes(fitted: SteeringModel, samples: &[(String, Sample)]) -> Result<Self> {
        let mut codes: BTreeMap<&str, Option<Vec<f32>>> = BTreeMap::new();
        for (volume, _) in samples.iter().filter(|_| fitted.volume_features().is_some()) {
            if !codes.contains_key(volume.as_str()) {
                codes.insert(
                    volume,
                    fitted.encode(&open_volume(Path::new(volume), &Reading::default())?.view())?,
                );
            }
        }
        let code = |volume: &str| codes.get(volume).and_then(|c| c.as_deref());
        let judged = samples.iter().filter(|(_, s)| held_out(s)).map(|(volume, s)| (s, code(volume)));
        Self::judged(fitted.quality_with(judged), fitted)
    }

    fn judged(held_out: Result<Quality>, fitted: SteeringModel) -> Result<Self> {
        let held_out =
            held_out.with_context(|| format!("calibrate with at least {HOLD_OUT_EVERY} scenes"))?;
        Ok(Self { title: fitted.title().to_owned(), held_out, chosen: false, fitted })
    }
}

/// A volume of a single voxel, for predictors that use no volume.
pub(crate) fn no_volume() -> Result<VolumeView<'static>> {
    Ok(VolumeView::new(Scalars::U8(&[0]), [1, 1, 1])?)
}

/// Fitted predictors.
#[derive(Clone, Debug)]
pub(crate) struct Calibrated {
    /// Every predictor that was fitted; one is chosen.
    pub(crate) candidates: Vec<Candidate>,
}

impl Calibrated {
    /// Fits the analytic model and the small network and chooses the one with the smaller scatter of
    /// ln(seconds) on the held-out frames.
    pub(crate) fn fit(samples: &[Sample]) -> Result<Self> {
        let volume = no_volume()?;
        let analytic = fit_analytic(samples)?.to_model_file()?;
        let network = fit_network(samples)?;
        let hidden = HIDDEN.map(|n| n.to_string()).join("-");
        let mut candidates = Vec::new();
        for (title, model) in [
            ("analytic cost model (non-negative least squares on estimated work)".to_owned(), analytic),
            (format!("small network on scene features ({hidden} neurons, log time)"), network),
        ] {
            let fitted = SteeringModel::new(title, model.to_model()?, &volume)?;
            candidates.push(Candidate::of(fitted, samples)?);
        }
        let sd = |c: &Candidate| c.held_out.log_sd;
        if let Some(best) = candidates.iter_mut().min_by(|a, b| sd(a).total_cmp(&sd(b))) {
            best.chosen = true;
        }
        Ok(Self { candidates })
    }

    /// The chosen candidate.
    pub(crate) fn chosen(&self) -> &Candidate {
        self.candidates.iter().find(|c| c.chosen).unwrap_or(&self.candidates[0])
    }

    /// Prior of a controller that uses the chosen predictor.
    pub(crate) fn prior(&self) -> Prior {
        Prior::Fitted { log_sd: self.chosen().held_out.log_sd as f32 }
    }
}

/// Returns a table of predictors and their errors on held-out frames.
pub(crate) fn candidates_table(candidates: &[Candidate]) -> Table {
    let mut table = Table::headed(
        "predictor | #held-out frames | #median error / % | #p95 error / % | #scatter of ln t | steers",
    );
    for c in candidates {
        table.row(vec![
            c.title.clone().into(),
            c.held_out.frames.to_string().into(),
            percent(c.held_out.median_error).into(),
            percent(c.held_out.p95_error).into(),
            format!("{:.3}", c.held_out.log_sd).into(),
            if c.chosen { "yes" } else { "" }.into(),
        ]);
    }
    table
}

fn percent(v: f64) -> String {
    format!("{:.1}", 100.0 * v)
}
