//! Predictors fitted to this machine, and the choice between them.

use super::calibrate::{HOLD_OUT_EVERY, Quality, Sample, fit_analytic};
use crate::dataset::Clock;
use crate::fit::{calibrate_to_rows, standard_features};
use crate::train::{Network, Samples, Settings, train};
use anyhow::{Context, Result};
use entire_core::control::Prior;
use entire_core::model::{Model, ModelFile};
use entire_core::nn::{Executor, Target, VolumeNet};
use entire_core::predict::{GroupKind, InputLayout, ModelPredictor, Predictor, load};
use entire_core::scene::VolumeView;
use serde::Serialize;
use std::ops::ControlFlow;
use std::sync::Arc;

/// Hidden widths of the small network.
pub const HIDDEN: [usize; 2] = [24, 24];

/// A fitted predictor that any number of contenders can be given.
#[derive(Clone, Debug)]
pub struct SteeringModel {
    title: String,
    model: Arc<Model>,
    volume_features: Option<Vec<f32>>,
    file: Option<Vec<u8>>,
}

impl SteeringModel {
    /// A model that was made or read. A VolumeNet in it encodes `volume` at once where its inputs call for
    /// that.
    ///
    /// # Errors
    /// When the model holds no predictor, or the volume cannot be encoded.
    pub fn new(title: String, model: Model, volume: &VolumeView<'_>) -> Result<Self> {
        let mut volume_features = None;
        if model.input_size(GroupKind::VolumeFeatures).is_some()
            && let Some(parts) = model.volumenet()
        {
            let net = VolumeNet::new(parts)?;
            let mut out = vec![0.0; net.feature_len()];
            net.encode(volume, &mut net.scratch(), Executor::Serial, &mut out)?;
            volume_features = Some(out);
        }
        load(&model)?;
        Ok(Self { title, model: Arc::new(model), volume_features, file: None })
    }

    /// A model that was made here; its bytes are kept.
    ///
    /// # Errors
    /// As [`SteeringModel::new`].
    pub fn made(title: String, file: &ModelFile, volume: &VolumeView<'_>) -> Result<Self> {
        let bytes = file.to_bytes()?;
        Ok(Self { file: Some(bytes), ..Self::new(title, file.to_model()?, volume)? })
    }

    /// The bytes of its model file, where it was made here.
    pub fn file(&self) -> Option<&[u8]> {
        self.file.as_deref()
    }

    /// A predictor of its own.
    ///
    /// # Errors
    /// When the model holds none.
    pub fn predictor(&self) -> Result<Box<dyn Predictor + Send>> {
        Ok(load(&self.model)?)
    }

    /// What it is, for people.
    pub fn title(&self) -> &str {
        &self.title
    }

    /// VolumeNet's output for the volume, where the model takes it.
    pub fn volume_features(&self) -> Option<&[f32]> {
        self.volume_features.as_deref()
    }

    /// How well it does on the held-out samples. Models that do not know the step are judged at the reference
    /// step.
    ///
    /// # Errors
    /// When none is held out, or the model needs an input that calibration frames do not have.
    pub fn quality(&self, samples: &[Sample]) -> Result<Quality> {
        let mut predictor = self.predictor()?;
        let every_step = predictor.knows_step();
        let mut pairs = Vec::new();
        for s in samples.iter().filter(|s| s.held_out() && (every_step || s.setting.step == 1.0)) {
            pairs.push((
                f64::from(predictor.predict(&s.predictor_inputs(self.volume_features()))?.seconds),
                s.seconds,
            ));
        }
        Quality::of(&pairs).with_context(|| {
            format!("no calibration frame is held out; calibrate with at least {HOLD_OUT_EVERY} scenes")
        })
    }
}

/// A small network on [`standard_features`], trained on ln(seconds) of the samples that are not held
/// out; a fifth of those decides when to stop. Single-threaded: the frames are few.
///
/// # Errors
/// When there are too few samples.
pub fn fit_network(samples: &[Sample], seed: u64) -> Result<ModelFile> {
    let layout = InputLayout::new(&[GroupKind::SceneFeatures], standard_features(), 0, 0)?;
    let collect = |judge: bool| -> Result<(Vec<f32>, Vec<f64>)> {
        let mut inputs = Vec::new();
        let mut seconds = Vec::new();
        for s in samples.iter().filter(|s| !s.held_out() && (s.scene % 5 == 4) == judge) {
            inputs.extend(s.inputs(&layout)?);
            seconds.push(s.seconds);
        }
        Ok((inputs, seconds))
    };
    let ((inputs, seconds), (judge_inputs, judge_seconds)) = (collect(false)?, collect(true)?);
    let settings = Settings {
        epochs: 600,
        batch: 32,
        learning_rate: 3e-3,
        final_learning_rate: 3e-5,
        patience: 120,
        target: Target::LogSeconds,
        seed,
        ..Settings::default()
    };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().context("cannot start a thread")?;
    let widths = [layout.width(), HIDDEN[0], HIDDEN[1], 1];
    let trained = train(
        &pool,
        Network::<f32>::random(&widths, seed)?,
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
    pub fitted: SteeringModel,
}

impl Candidate {
    /// Judges a predictor; it is not chosen yet.
    ///
    /// # Errors
    /// As [`SteeringModel::quality`].
    pub fn of(fitted: SteeringModel, samples: &[Sample]) -> Result<Self> {
        let held_out = fitted.quality(samples)?;
        Ok(Self { title: fitted.title().to_owned(), held_out, chosen: false, fitted })
    }
}

/// What calibration found.
#[derive(Clone, Debug)]
pub struct Calibrated {
    /// Every predictor that was fitted; one is chosen.
    pub candidates: Vec<Candidate>,
}

impl Calibrated {
    /// Fits the analytic model and the small network and chooses the one with the smaller scatter of
    /// ln(seconds) on the held-out frames.
    ///
    /// # Errors
    /// When there are too few usable samples.
    pub fn fit(samples: &[Sample], volume: &VolumeView<'_>, seed: u64) -> Result<Self> {
        let analytic = fit_analytic(samples)?.0.to_model_file()?;
        let network = fit_network(samples, seed)?;
        let hidden = HIDDEN.map(|n| n.to_string()).join("-");
        let mut candidates = Vec::new();
        for (title, model) in [
            ("analytic cost model (non-negative least squares on estimated work)".to_owned(), analytic),
            (format!("small network on scene features ({hidden} neurons, log time)"), network),
        ] {
            let fitted = SteeringModel::made(title, &model, volume)?;
            candidates.push(Candidate::of(fitted, samples)?);
        }
        let mut out = Self { candidates };
        out.choose();
        Ok(out)
    }

    /// Adds a model that was made on another machine, its last layer calibrated to the samples that are not
    /// held out, whose seconds are of `clock`, and chooses anew.
    ///
    /// # Errors
    /// When the model needs an input that calibration frames do not have.
    pub fn with_shipped(
        mut self,
        (title, file): (&str, &ModelFile),
        clock: Clock,
        samples: &[Sample],
        volume: &VolumeView<'_>,
    ) -> Result<Self> {
        let mut predictor = ModelPredictor::new(&file.to_model()?)?;
        let (mut rows, mut seconds) = (Vec::new(), Vec::new());
        for s in samples.iter().filter(|s| !s.held_out()) {
            rows.extend_from_slice(predictor.row(&s.predictor_inputs(None))?);
            seconds.push(s.seconds);
        }
        let mut file = calibrate_to_rows(file, &rows, &seconds)?;
        crate::clock::set(&mut file, clock);
        self.candidates.push(Candidate::of(SteeringModel::made(title.to_owned(), &file, volume)?, samples)?);
        self.choose();
        Ok(self)
    }

    /// Adds the machine's own model as it is, and chooses anew.
    ///
    /// # Errors
    /// When the model needs an input that calibration frames do not have.
    pub fn with_machine(
        mut self,
        title: &str,
        file: &ModelFile,
        samples: &[Sample],
        volume: &VolumeView<'_>,
    ) -> Result<Self> {
        self.candidates.push(Candidate::of(SteeringModel::made(title.to_owned(), file, volume)?, samples)?);
        self.choose();
        Ok(self)
    }

    /// Chooses the candidate with the smallest scatter on held-out frames.
    fn choose(&mut self) {
        let sd = |c: &Candidate| c.held_out.log_sd;
        let best = self.candidates.iter().map(sd).fold(f64::INFINITY, f64::min);
        let mut found = false;
        for c in &mut self.candidates {
            c.chosen = !found && sd(c) <= best;
            found |= c.chosen;
        }
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
