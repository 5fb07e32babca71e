//! Predictors fitted to this machine, and the choice between them.

use super::calibrate::{HOLD_OUT_EVERY, Quality, Sample, fit_analytic};
use anyhow::{Context, Result, ensure};
use entire_core::adapt::Prior;
use entire_core::features::{Changes, SceneFeature};
use entire_core::nn::{PredNet, PredNetParts, PredScratch, Target};
use entire_core::predict::{AnalyticModel, Inputs, Prediction, Predictor, Source};
use entire_core::train::{Network, Samples, Settings, train};
use serde::Serialize;
use std::ops::ControlFlow;

/// Hidden widths of the small network.
pub const HIDDEN: [usize; 2] = [24, 24];

/// A network on scene features alone, as a predictor.
pub struct SceneNetwork {
    net: PredNet,
    scratch: PredScratch,
    features: Vec<SceneFeature>,
    inputs: Vec<f32>,
}

impl SceneNetwork {
    /// From weights and the names of their inputs.
    ///
    /// # Errors
    /// When the weights do not fit each other or the number of features.
    pub fn new(parts: &PredNetParts, features: &[SceneFeature]) -> Result<Self> {
        let net = PredNet::new(parts)?;
        ensure!(
            net.inputs() == features.len(),
            "the network takes {} inputs, {} features are named",
            net.inputs(),
            features.len()
        );
        let scratch = net.scratch();
        Ok(Self { net, scratch, features: features.to_vec(), inputs: vec![0.0; features.len()] })
    }
}

impl Predictor for SceneNetwork {
    fn predict(&mut self, inputs: &Inputs<'_>) -> entire_core::Result<Prediction> {
        inputs.features.write(&self.features, &inputs.setting, Changes::NONE, &mut self.inputs);
        let seconds = self.net.predict(&self.inputs, &mut self.scratch);
        let seconds = if seconds.is_finite() { seconds.clamp(1e-9, 1e9) } else { f32::NAN };
        Ok(Prediction { seconds, upper: f32::NAN, out_of_range: f32::NAN, source: Source::Network })
    }
}

/// A fitted predictor that any number of contenders can be given.
#[derive(Clone, Debug)]
pub enum Fitted {
    /// The linear cost model on estimated work.
    Analytic(AnalyticModel),
    /// A small network on scene features, trained on ln(seconds).
    Network(PredNetParts),
}

impl Fitted {
    /// A predictor of its own.
    ///
    /// # Errors
    /// When a network's parts do not fit.
    pub fn predictor(&self) -> Result<Box<dyn Predictor + Send>> {
        Ok(match self {
            Self::Analytic(model) => Box::new(model.clone()),
            Self::Network(parts) => Box::new(SceneNetwork::new(parts, SceneFeature::STANDARD)?),
        })
    }

    /// What it is, for people.
    pub fn title(&self) -> String {
        match self {
            Self::Analytic(_) => "analytic cost model (non-negative least squares on estimated work)".into(),
            Self::Network(parts) => {
                let widths: Vec<String> = parts.layers.iter().map(|l| l.inputs.to_string()).collect();
                format!("small network on scene features ({}-1, log time)", widths.join("-"))
            }
        }
    }

    /// Predicted seconds of a sample.
    fn seconds(&self, samples: &[Sample]) -> Result<Vec<f64>> {
        match self {
            Self::Analytic(model) => Ok(samples
                .iter()
                .map(|s| f64::from(model.parts(&s.features, &s.setting).seconds()))
                .collect()),
            Self::Network(parts) => {
                let net = PredNet::new(parts)?;
                let mut scratch = net.scratch();
                Ok(samples
                    .iter()
                    .map(|s| f64::from(net.predict(&s.inputs(SceneFeature::STANDARD), &mut scratch)))
                    .collect())
            }
        }
    }

    /// How well it does on the held-out samples.
    ///
    /// # Errors
    /// When none is held out.
    pub fn quality(&self, samples: &[Sample]) -> Result<Quality> {
        let held: Vec<Sample> = samples.iter().filter(|s| s.held_out()).cloned().collect();
        let pairs: Vec<(f64, f64)> =
            self.seconds(&held)?.into_iter().zip(&held).map(|(p, s)| (p, s.seconds)).collect();
        Quality::of(&pairs).with_context(|| {
            format!("no calibration frame is held out; calibrate with at least {HOLD_OUT_EVERY} scenes")
        })
    }
}

/// A small network on [`SceneFeature::STANDARD`], trained on ln(seconds) of the samples that are not held out; a fifth
/// of those decides when to stop. Single-threaded: the frames are few.
///
/// # Errors
/// When there are too few samples.
pub fn fit_network(samples: &[Sample], seed: u64) -> Result<PredNetParts> {
    let features = SceneFeature::STANDARD;
    let collect = |judge: bool| {
        let mut inputs = Vec::new();
        let mut seconds = Vec::new();
        for s in samples.iter().filter(|s| !s.held_out() && (s.scene % 5 == 4) == judge) {
            inputs.extend(s.inputs(features));
            seconds.push(s.seconds);
        }
        (inputs, seconds)
    };
    let ((inputs, seconds), (judge_inputs, judge_seconds)) = (collect(false), collect(true));
    let mut settings = Settings::default();
    settings.epochs = 600;
    settings.batch = 32;
    settings.learning_rate = 3e-3;
    settings.final_learning_rate = 3e-5;
    settings.patience = 120;
    settings.target = Target::LogSeconds;
    settings.seed = seed;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().context("cannot start a thread")?;
    let widths = [features.len(), HIDDEN[0], HIDDEN[1], 1];
    let trained = train(
        &pool,
        Network::<f32>::random(&widths, seed)?,
        None,
        Samples { inputs: &inputs, seconds: &seconds },
        Samples { inputs: &judge_inputs, seconds: &judge_seconds },
        &settings,
        |_| ControlFlow::Continue(()),
    )?;
    Ok(trained.to_parts())
}

/// A predictor with what is known of it, for reports.
#[derive(Clone, Debug, Serialize)]
pub struct Candidate {
    /// What it is.
    pub title: String,
    /// How it does on calibration frames that it was not fitted to.
    pub held_out: Quality,
    /// Whether it steers.
    pub chosen: bool,
    /// The predictor.
    #[serde(skip)]
    pub fitted: Fitted,
}

/// What calibration found.
#[derive(Clone, Debug)]
pub struct Calibrated {
    /// Every predictor that was fitted; one is chosen.
    pub candidates: Vec<Candidate>,
}

impl Calibrated {
    /// Fits the analytic model and the small network and chooses the one with the smaller scatter of ln(seconds) on the
    /// held-out frames.
    ///
    /// # Errors
    /// When there are too few usable samples.
    pub fn fit(samples: &[Sample], seed: u64) -> Result<Self> {
        let fitted =
            vec![Fitted::Analytic(fit_analytic(samples)?.0), Fitted::Network(fit_network(samples, seed)?)];
        let mut candidates = Vec::new();
        for fitted in fitted {
            let held_out = fitted.quality(samples)?;
            candidates.push(Candidate { title: fitted.title(), held_out, chosen: false, fitted });
        }
        let best = (0..candidates.len())
            .min_by(|a, b| candidates[*a].held_out.log_sd.total_cmp(&candidates[*b].held_out.log_sd))
            .unwrap_or(0);
        candidates[best].chosen = true;
        Ok(Self { candidates })
    }

    /// The chosen one.
    pub fn chosen(&self) -> &Candidate {
        self.candidates.iter().find(|c| c.chosen).unwrap_or(&self.candidates[0])
    }

    /// What a controller may take as known of it.
    pub fn prior(&self) -> Prior {
        Prior::Fitted { log_sd: self.chosen().held_out.log_sd as f32 }
    }
}
