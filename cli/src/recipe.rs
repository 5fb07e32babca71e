//! How predictors are made from measured frames: one description for `train`, `chart` and `select`.
//!
//! | kind | what is fitted | stored as |
//! |---|---|---|
//! | `analytic` | unit costs of estimated work, non-negative least squares on relative errors | one dense layer on counts, seconds |
//! | `linear` | ln seconds as a linear function of scene features, robust least squares | one dense layer, log seconds |
//! | `network` | PredNet by gradient descent | dense layers |
//! | `residual` | analytic × exp(network): unit costs first, then a network on ln(measured / analytic) | dense layers that carry `log_estimated_seconds` past the network |
//! | `trees` | ln seconds by gradient-boosted trees of a library | nowhere: a yardstick of `chart` |

use crate::dataset::{Table, TimedFrame};
use crate::inputs::{Encoder, Layout};
use anyhow::{Context, Result, anyhow, bail, ensure};
use entire_core::features::{MAX_PROBE_SIDE, PROBE_SIDE, SceneFeature, SceneQuantity};
use entire_core::model::{Model, ModelFile};
use entire_core::nn::{DenseParts, Dtype, Normalization, PredNetParts, SELU_SCALE, Target};
use entire_core::predict::{
    AnalyticModel, COST_QUANTITIES, COSTS, GroupKind, InputLayout, LOBE_ORDER_KEY, Measurement,
    PROBE_SIDE_KEY, UNIT_COSTS_KEY, UnitCosts,
};
use entire_core::train::{
    EpochRecord, Loss, Network, Progress, Samples, Settings, Standardization, Stop, preset_widths, train,
};
use indicatif::ProgressBar;
use rayon::ThreadPool;
use serde::{Deserialize, Serialize};
use serde_json::json;
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// What is fitted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// A network, by gradient descent.
    #[default]
    #[value(alias = "network")]
    #[serde(alias = "network")]
    Prednet,
    /// Unit costs of estimated work, by non-negative least squares; stored as one dense layer.
    Analytic,
    /// ln seconds as a linear function of scene features, by robust least squares.
    Linear,
    /// The analytic model times a learned factor: a small network on ln(measured / analytic).
    Residual,
    /// Gradient-boosted trees of a library: a yardstick that no model file holds.
    #[value(skip)]
    Trees,
}

/// What the network gives.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[value(rename_all = "snake_case")]
#[serde(rename_all = "snake_case")]
pub enum TargetChoice {
    /// Seconds, as in the paper.
    Seconds,
    /// Natural logarithm of seconds.
    #[default]
    LogSeconds,
}

/// How weights are stored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DtypeChoice {
    /// Single precision.
    #[default]
    F32,
    /// Half precision.
    F16,
    /// bfloat16.
    Bf16,
}

impl DtypeChoice {
    /// The format.
    pub fn storage(self) -> Dtype {
        match self {
            Self::F32 => Dtype::F32,
            Self::F16 => Dtype::F16,
            Self::Bf16 => Dtype::Bf16,
        }
    }
}

/// How a predictor is made. What is left away has the value of [`Recipe::default`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Recipe {
    /// What is fitted.
    pub kind: Kind,
    /// Hidden layer widths of networks.
    pub layers: Vec<usize>,
    /// Layers of the paper, such as 12C256, instead of `layers`.
    pub preset: Option<String>,
    /// Input groups, in order.
    pub inputs: Vec<String>,
    /// Scene features, in order; the standard ones where there are none.
    pub scene_features: Vec<String>,
    /// Rays along each side of the probe behind scene features; the standard number unless given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub probe_side: Option<usize>,
    /// Whether an analytic model is solved for [`UnitCosts::CONVERTING`], too: what converting stored values and waiting for
    /// memory cost.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub converting: bool,
    /// Networks of other seeds whose mean is taken; stored as one network, each beside the others.
    pub ensemble: usize,
    /// What a network gives.
    pub target: TargetChoice,
    /// `mse`, `relative`, `huber:DELTA` or `pinball:QUANTILE`.
    pub loss: String,
    /// Passes over the training frames at most.
    pub epochs: usize,
    /// Frames per step.
    pub batch: usize,
    /// First learning rate; 1e-4 with a preset or when fine-tuning, else 1e-3.
    pub learning_rate: Option<f64>,
    /// Last learning rate; a hundredth of the first unless given.
    pub final_learning_rate: Option<f64>,
    /// Largest norm of the gradient.
    pub clip: f64,
    /// Epochs without a better validation loss after which training stops.
    pub patience: usize,
    /// Seed of weights and of the frames' order.
    pub seed: u64,
    /// Model file with the VolumeNet that encodes volumes.
    pub volumenet: Option<PathBuf>,
    /// Start from this model instead of random weights.
    pub fine_tune: Option<PathBuf>,
    /// Whether Gaussian lobes go in by ascending center.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub sorted_lobes: bool,
    /// A model file that is taken as it is; nothing else counts then.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub file: Option<PathBuf>,
    /// How weights are stored.
    pub dtype: DtypeChoice,
}

impl Default for Recipe {
    fn default() -> Self {
        Self {
            kind: Kind::Prednet,
            layers: vec![64, 64],
            preset: None,
            inputs: vec![GroupKind::SceneFeatures.name().into()],
            scene_features: Vec::new(),
            probe_side: None,
            converting: false,
            ensemble: 1,
            target: TargetChoice::LogSeconds,
            loss: "mse".into(),
            epochs: 200,
            batch: 256,
            learning_rate: None,
            final_learning_rate: None,
            clip: 1.0,
            patience: 50,
            seed: 1,
            volumenet: None,
            fine_tune: None,
            sorted_lobes: false,
            file: None,
            dtype: DtypeChoice::F32,
        }
    }
}

/// Frames with their seconds.
#[derive(Clone, Copy, Debug)]
pub struct Timed<'a> {
    /// The frames.
    pub frames: &'a [&'a TimedFrame],
    /// Seconds of each.
    pub seconds: &'a [f64],
}

/// What a recipe works with.
pub struct Kitchen<'a> {
    /// The tables that the frames are of.
    pub tables: &'a [Table],
    /// Threads.
    pub pool: &'a ThreadPool,
    /// Shows how far training is; its message and position are set.
    pub bar: &'a ProgressBar,
    /// Asked after every step.
    pub stop: &'a dyn Fn() -> bool,
}

/// A predictor that was made.
#[derive(Clone, Debug)]
pub struct Fitted {
    /// The model file.
    pub file: ModelFile,
    /// One line on what it is.
    pub what: String,
    /// What it was made with.
    pub settings: serde_json::Value,
    /// Every epoch of a network.
    pub history: Vec<EpochRecord>,
    /// One line on how it went.
    pub outcome: String,
}

/// Reads a loss: `mse`, `relative`, `huber`, `huber:DELTA`, `pinball:QUANTILE`.
///
/// # Errors
/// For anything else.
pub fn parse_loss(text: &str) -> Result<Loss> {
    let (name, value) = match text.split_once(':') {
        Some((name, value)) => {
            let value: f64 = value.parse().map_err(|_| anyhow!("{value:?} after {name} is no number"))?;
            (name, Some(value))
        }
        None => (text, None),
    };
    match (name, value) {
        ("mse", None) => Ok(Loss::SquaredError),
        ("relative", None) => Ok(Loss::Relative),
        ("huber", delta) => Ok(Loss::Huber { delta: delta.unwrap_or(1.0) }),
        ("pinball", Some(quantile)) => Ok(Loss::Pinball { quantile }),
        _ => bail!("loss {text:?}; mse, relative, huber, huber:DELTA or pinball:QUANTILE is expected"),
    }
}

/// Reads a model file twice over: as bytes to keep, and checked.
///
/// # Errors
/// When it cannot be read or is no model.
pub fn read_model_file(path: &Path) -> Result<(ModelFile, Model)> {
    let bytes = std::fs::read(path).with_context(|| {
        let remedy = if path.exists() { "" } else { "; make one with `entire train`" };
        format!("cannot read {}{remedy}", path.display())
    })?;
    let name = || format!("{}", path.display());
    Ok((ModelFile::from_bytes(&bytes).with_context(name)?, Model::from_bytes(&bytes).with_context(name)?))
}

fn names(features: &[SceneFeature]) -> Vec<String> {
    features.iter().map(ToString::to_string).collect()
}

impl Recipe {
    /// The scene features that are asked for.
    ///
    /// # Errors
    /// For a name that is not known.
    pub fn features(&self) -> Result<Vec<SceneFeature>> {
        if self.scene_features.is_empty() {
            return Ok(SceneFeature::STANDARD.to_vec());
        }
        self.scene_features.iter().map(|n| Ok(SceneFeature::from_name(n.trim())?)).collect()
    }

    /// Makes the predictor. Validation frames decide when a network stops; the other kinds do not look at them.
    ///
    /// # Errors
    /// When the recipe does not fit the frames, a setting is out of range, inputs cannot be computed, or training fails.
    pub fn make(&self, kitchen: &Kitchen<'_>, training: Timed<'_>, validation: Timed<'_>) -> Result<Fitted> {
        if let Some(path) = &self.file {
            let (file, _) = read_model_file(path)?;
            return Ok(Fitted {
                file,
                what: "A model file as it is".into(),
                settings: json!({ "file": path.file_name().map(|n| n.to_string_lossy()) }),
                history: Vec::new(),
                outcome: "nothing was fitted".into(),
            });
        }
        ensure!(!training.frames.is_empty(), "there are no training frames");
        ensure!(
            (1..=MAX_ENSEMBLE).contains(&self.ensemble),
            "an ensemble of {}; 1 to {MAX_ENSEMBLE} is accepted",
            self.ensemble
        );
        if let Some(side) = self.probe_side {
            ensure!(
                (1..=MAX_PROBE_SIDE).contains(&side),
                "a probe of {side} rays a side; 1 to {MAX_PROBE_SIDE} is accepted"
            );
            ensure!(
                self.kind != Kind::Analytic || side == PROBE_SIDE,
                "the analytic model stands on the standard probe of {PROBE_SIDE} rays a side; leave the probe's side away"
            );
        }
        self.settings()?;
        ensure!(
            self.kind != Kind::Residual
                || self.fine_tune.is_some()
                || self.inputs.iter().map(|g| g.trim()).eq([GroupKind::SceneFeatures.name()]),
            "a residual model takes scene_features alone; leave other --inputs away"
        );
        ensure!(
            !self.converting || matches!(self.kind, Kind::Analytic | Kind::Residual),
            "--converting is about the costs of an analytic model; name --model-kind analytic or residual, or leave it away"
        );
        if let Some(path) = &self.fine_tune {
            return self.fine_tune(path, kitchen, training, validation);
        }
        match self.kind {
            Kind::Analytic => self.analytic(kitchen, training),
            Kind::Linear => self.linear(kitchen, training),
            Kind::Residual => self.residual(kitchen, training, validation),
            Kind::Prednet => self.network(kitchen, training, validation),
            Kind::Trees => bail!("boosted trees are a yardstick of `entire chart`; no model file holds them"),
        }
    }

    /// Whether the ray step is among what it is made from, by itself or in counts of samples.
    ///
    /// # Errors
    /// For a group or feature that is not known.
    pub fn knows_step(&self) -> Result<bool> {
        if matches!(self.kind, Kind::Analytic | Kind::Residual) {
            return Ok(true);
        }
        let groups =
            self.inputs.iter().map(|n| GroupKind::from_name(n.trim())).collect::<Result<Vec<_>, _>>()?;
        let features = if groups.contains(&GroupKind::SceneFeatures) { self.features()? } else { Vec::new() };
        // The sizes of other groups say nothing of the step.
        Ok(InputLayout::new(&groups, features, 1, 1)?.knows_step())
    }

    fn side(&self) -> usize {
        self.probe_side.unwrap_or(PROBE_SIDE)
    }

    /// Trees on the recipe's inputs.
    ///
    /// # Errors
    /// As [`Recipe::make`].
    pub fn trees(
        &self,
        kitchen: &Kitchen<'_>,
        training: Timed<'_>,
        validation: Timed<'_>,
    ) -> Result<crate::trees::Trees> {
        crate::trees::Trees::fit(self.layout(training)?.1, kitchen, training, validation)
    }

    fn layout(&self, training: Timed<'_>) -> Result<(ModelFile, Layout)> {
        let groups: Vec<GroupKind> =
            self.inputs.iter().map(|n| Ok(GroupKind::from_name(n.trim())?)).collect::<Result<_>>()?;
        let (file, encoder) = match &self.volumenet {
            Some(path) => {
                let (file, model) = read_model_file(path)?;
                let parts =
                    model.volumenet().with_context(|| format!("{} holds no VolumeNet", path.display()))?;
                (file, Some(Encoder::new(parts)?))
            }
            None => (ModelFile::new(), None),
        };
        let lobes = training.frames.first().map_or(0, |f| f.scene.lobes.len());
        let features = if groups.contains(&GroupKind::SceneFeatures) { self.features()? } else { Vec::new() };
        let layout = Layout::new(&groups, features, lobes, encoder)?
            .with_probe_side(self.side())
            .with_sorted_lobes(self.sorted_lobes);
        Ok((file, layout))
    }

    fn settings(&self) -> Result<Settings> {
        let mut settings = Settings::default();
        settings.epochs = self.epochs;
        settings.batch = self.batch;
        settings.learning_rate = self
            .learning_rate
            .unwrap_or(if self.preset.is_some() || self.fine_tune.is_some() { 1e-4 } else { 1e-3 });
        settings.final_learning_rate = self.final_learning_rate.unwrap_or(settings.learning_rate / 100.0);
        settings.clip_norm = self.clip;
        settings.patience = self.patience;
        settings.loss = parse_loss(&self.loss)?;
        settings.seed = self.seed;
        settings.target = match self.target {
            TargetChoice::Seconds => Target::Seconds,
            TargetChoice::LogSeconds => Target::LogSeconds,
        };
        Ok(settings)
    }

    /// The recipe as a model file tells it: of other files the names alone, since where they lie is of this machine.
    fn told(&self) -> Self {
        let name = |path: &Option<PathBuf>| path.as_ref().and_then(|p| p.file_name()).map(PathBuf::from);
        Self {
            volumenet: name(&self.volumenet),
            fine_tune: name(&self.fine_tune),
            file: name(&self.file),
            ..self.clone()
        }
    }

    /// The ratios that unit costs are drawn to; those that are 0 stay so.
    fn default_costs(&self) -> UnitCosts {
        if self.converting { UnitCosts::CONVERTING } else { UnitCosts::SOFTWARE }
    }

    fn analytic(&self, kitchen: &Kitchen<'_>, training: Timed<'_>) -> Result<Fitted> {
        let (model, report) = fit_analytic(kitchen, training, self.side(), &self.default_costs())?;
        let costs: BTreeMap<String, f64> = model.unit_costs().named().map(|(n, c)| (n.into(), c)).collect();
        Ok(Fitted {
            file: model.to_model_file()?,
            what: "Analytic cost model: unit costs of estimated work, non-negative least squares on relative errors"
                .into(),
            settings: json!({ "kind": self.kind, "unit_costs_seconds": costs }),
            history: Vec::new(),
            outcome: report,
        })
    }

    fn linear(&self, kitchen: &Kitchen<'_>, training: Timed<'_>) -> Result<Fitted> {
        let (mut file, layout) = self.layout(training)?;
        let rows = layout.rows(kitchen.tables, training.frames, kitchen.pool, &ProgressBar::hidden())?;
        let logs: Vec<f64> = training.seconds.iter().map(|t| t.ln()).collect();
        let samples = Samples { inputs: &rows, seconds: training.seconds };
        let scale = Standardization::fit(samples, layout.width(), Target::LogSeconds);
        let y: Vec<f64> =
            logs.iter().map(|l| (l - f64::from(scale.output_mean)) / f64::from(scale.output_std)).collect();
        let x = standardized(&rows, &scale);
        let solution = robust_least_squares(&x, layout.width(), &y, &vec![0.0; layout.width() + 1], RIDGE);
        let parts = PredNetParts {
            layers: vec![last_layer(&solution)],
            input: Some(Normalization { mean: scale.input_mean, std: scale.input_std }),
            output: Some(Normalization { mean: vec![scale.output_mean], std: vec![scale.output_std] }),
            target: Target::LogSeconds,
        };
        self.store(&mut file, parts, &layout)?;
        Ok(Fitted {
            file,
            what: "Log-linear model on scene features, robust least squares".into(),
            settings: json!({ "kind": self.kind, "inputs": self.inputs, "ridge": RIDGE }),
            history: Vec::new(),
            outcome: format!("fitted to {} frames", training.frames.len()),
        })
    }

    fn residual(&self, kitchen: &Kitchen<'_>, training: Timed<'_>, validation: Timed<'_>) -> Result<Fitted> {
        let (mut file, layout) = self.layout(training)?;
        let (model, report) = fit_analytic(kitchen, training, self.side(), &self.default_costs())?;
        let costs = model.unit_costs();
        let seconds = |part: Timed<'_>| -> Result<Vec<f64>> {
            let estimates = estimates(kitchen, part, &costs, self.side())?;
            Ok(part.seconds.iter().zip(&estimates).map(|(t, e)| t / e).collect())
        };
        let (ratios, judged) = (seconds(training)?, seconds(validation)?);
        let mut settings = self.settings()?;
        settings.target = Target::LogSeconds;
        let mut widths = vec![layout.width()];
        widths.extend(&self.layers);
        widths.push(1);
        let hidden = ProgressBar::hidden();
        let x = layout.rows(kitchen.tables, training.frames, kitchen.pool, &hidden)?;
        let vx = layout.rows(kitchen.tables, validation.frames, kitchen.pool, &hidden)?;
        let (parts, history, outcome) = self.ensemble(
            kitchen,
            &widths,
            (Samples { inputs: &x, seconds: &ratios }, Samples { inputs: &vx, seconds: &judged }),
            &settings,
        )?;
        let mut features = layout.scene_features().to_vec();
        features.push(SceneFeature::log(SceneQuantity::EstimatedSeconds));
        let estimates: Vec<f64> =
            estimates(kitchen, training, &costs, self.side())?.iter().map(|e| e.ln()).collect();
        let n = estimates.len() as f64;
        let mean = estimates.iter().sum::<f64>() / n;
        let sd = (estimates.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / n).sqrt().max(0.1);
        let parts = carry_past(parts, mean as f32, sd as f32);
        file.set_metadata(UNIT_COSTS_KEY, costs.to_json()?);
        let wide = Layout::new(&[GroupKind::SceneFeatures], features, 0, None)?.with_probe_side(self.side());
        self.store(&mut file, parts, &wide)?;
        let costs: BTreeMap<String, f64> = costs.named().map(|(n, c)| (n.into(), c)).collect();
        Ok(Fitted {
            file,
            what: format!(
                "Analytic cost model times a learned factor, {} hidden units{}",
                self.layers.iter().map(ToString::to_string).collect::<Vec<_>>().join("-"),
                if self.ensemble > 1 {
                    format!(", mean of {} networks stored as one", self.ensemble)
                } else {
                    String::new()
                }
            ),
            settings: json!({ "recipe": self.told(), "unit_costs_seconds": costs }),
            history,
            outcome: format!("analytic part {report}; factor: {outcome}"),
        })
    }

    fn network(&self, kitchen: &Kitchen<'_>, training: Timed<'_>, validation: Timed<'_>) -> Result<Fitted> {
        let (mut file, layout) = self.layout(training)?;
        let widths = match &self.preset {
            Some(preset) => preset_widths(preset, layout.width())?,
            None => {
                let mut widths = vec![layout.width()];
                widths.extend(&self.layers);
                widths.push(1);
                widths
            }
        };
        let bar = ProgressBar::hidden();
        let x = layout.rows(kitchen.tables, training.frames, kitchen.pool, &bar)?;
        let vx = layout.rows(kitchen.tables, validation.frames, kitchen.pool, &bar)?;
        let (parts, history, outcome) = self.ensemble(
            kitchen,
            &widths,
            (
                Samples { inputs: &x, seconds: training.seconds },
                Samples { inputs: &vx, seconds: validation.seconds },
            ),
            &self.settings()?,
        )?;
        self.store(&mut file, parts, &layout)?;
        Ok(Fitted {
            file,
            what: format!(
                "PredNet, widths {}",
                widths.iter().map(ToString::to_string).collect::<Vec<_>>().join("-")
            ),
            settings: json!({ "recipe": self.told(), "widths": widths, "optimizer": "Adam(0.9, 0.999)", "schedule": "cosine, per step" }),
            history,
            outcome,
        })
    }

    /// Trains as many networks as the recipe asks for, from one seed after another, and puts them beside each other.
    fn ensemble(
        &self,
        kitchen: &Kitchen<'_>,
        widths: &[usize],
        samples: (Samples<'_>, Samples<'_>),
        settings: &Settings,
    ) -> Result<(PredNetParts, Vec<EpochRecord>, String)> {
        let mut members = Vec::with_capacity(self.ensemble);
        let mut first = None;
        for seed in (self.seed..).take(self.ensemble) {
            let network = Network::random(widths, seed)?;
            let mut settings = *settings;
            settings.seed = seed;
            let (parts, history, outcome) = run_training(kitchen, network, None, samples, &settings)?;
            members.push(parts);
            first.get_or_insert((history, outcome));
        }
        let (history, outcome) = first.context("an ensemble of no network")?;
        Ok((side_by_side(members)?, history, outcome))
    }

    fn fine_tune(
        &self,
        path: &Path,
        kitchen: &Kitchen<'_>,
        training: Timed<'_>,
        validation: Timed<'_>,
    ) -> Result<Fitted> {
        ensure!(self.kind != Kind::Analytic, "an analytic model is fitted anew; leave --fine-tune away");
        let (mut file, model) = read_model_file(path)?;
        let layout = Layout::of_model(&model).with_context(|| format!("{}", path.display()))?;
        let parts = model.prednet().context("the model file holds no PredNet")?;
        let mut settings = self.settings()?;
        settings.target = parts.target;
        let bar = ProgressBar::hidden();
        let x = layout.rows(kitchen.tables, training.frames, kitchen.pool, &bar)?;
        let vx = layout.rows(kitchen.tables, validation.frames, kitchen.pool, &bar)?;
        let (parts, history, outcome) = run_training(
            kitchen,
            Network::from_parts(parts)?,
            Some(Standardization::of(parts)),
            (
                Samples { inputs: &x, seconds: training.seconds },
                Samples { inputs: &vx, seconds: validation.seconds },
            ),
            &settings,
        )?;
        self.store(&mut file, parts, &layout)?;
        Ok(Fitted {
            file,
            what: "PredNet, fine-tuned".into(),
            settings: json!({
                "fine_tuned_from": path.file_name().map(|n| n.to_string_lossy()), "recipe": self.told(),
            }),
            history,
            outcome,
        })
    }

    fn store(&self, file: &mut ModelFile, mut parts: PredNetParts, layout: &Layout) -> Result<()> {
        for layer in &mut parts.layers {
            layer.dtype = self.dtype.storage();
        }
        file.set_prednet(&parts, &layout.to_model_groups())?;
        if layout.sorted_lobes() {
            file.set_metadata(LOBE_ORDER_KEY, "center");
        }
        if !layout.scene_features().is_empty() {
            file.set_scene_features(&names(layout.scene_features()))?;
            if ![0, PROBE_SIDE].contains(&layout.probe_side()) {
                file.set_metadata(PROBE_SIDE_KEY, layout.probe_side().to_string());
            }
        }
        Ok(())
    }
}

/// Adapts a model to a few frames of another machine, renderer or kind of volume in closed form: the last layer is fitted
/// anew by least squares drawn towards its present weights. Works from a handful of frames on.
///
/// # Errors
/// When the file holds no PredNet, or inputs cannot be computed.
pub fn calibrate(file: &ModelFile, kitchen: &Kitchen<'_>, frames: Timed<'_>) -> Result<ModelFile> {
    let layout = Layout::of_model(&file.to_model()?)?;
    let rows = layout.rows(kitchen.tables, frames.frames, kitchen.pool, &ProgressBar::hidden())?;
    calibrate_to_rows(file, &rows, frames.seconds)
}

/// As [`calibrate`], to input rows in the model's order with the seconds that each took.
///
/// # Errors
/// When the file holds no PredNet, or rows and seconds do not go together.
pub fn calibrate_to_rows(file: &ModelFile, rows: &[f32], seconds: &[f64]) -> Result<ModelFile> {
    let model = file.to_model()?;
    let width: usize = model.inputs().iter().map(|g| g.size).sum();
    ensure!(
        rows.len() == width * seconds.len(),
        "{} inputs for {} frames; the model takes {width} for each",
        rows.len(),
        seconds.len()
    );
    let parts = model.prednet().context("the model file holds no PredNet")?;
    let scale = Standardization::of(parts);
    let mut parts = parts.clone();
    let last = parts.layers.last().context("the PredNet has no layer")?.clone();
    if parts.target == Target::Seconds {
        // Costs in seconds stay what they are, but for a common factor.
        let predicted = super::commands::train::predict_rows(&model, rows, width)?;
        let mut logs: Vec<f64> = predicted.iter().zip(seconds).map(|(p, t)| (t / p.max(1e-6)).ln()).collect();
        let factor = crate::dataset::median(&mut logs).unwrap_or(0.0).exp() as f32;
        let layer = parts.layers.last_mut().context("the PredNet has no layer")?;
        if parts.output.is_some() {
            if let Some(norm) = &mut parts.output {
                norm.mean.iter_mut().chain(&mut norm.std).for_each(|v| *v *= factor);
            }
        } else {
            layer.weight.iter_mut().chain(&mut layer.bias).for_each(|v| *v *= factor);
        }
    } else {
        let hidden = hidden_activations(&parts, &standardized(rows, &scale));
        let y: Vec<f64> = seconds
            .iter()
            .map(|t| (t.ln() - f64::from(scale.output_mean)) / f64::from(scale.output_std))
            .collect();
        let prior: Vec<f64> = last.weight.iter().chain(&last.bias).map(|&w| f64::from(w)).collect();
        let solution = robust_least_squares(&hidden, last.inputs, &y, &prior, PRIOR_FRAMES);
        if let Some(layer) = parts.layers.last_mut() {
            let fitted = last_layer(&solution);
            layer.weight = fitted.weight;
            layer.bias = fitted.bias;
        }
    }
    let mut out = file.clone();
    out.set_prednet(&parts, model.inputs())?;
    Ok(out)
}

/// Takes an analytic model times a learned factor to another renderer, from a few frames: unit costs are solved anew, those of
/// [`UnitCosts::CONVERTING`] among them, and the factor's last layer is fitted towards a part of its weights, since what the
/// model had wrong there is in part wrong here too. Frames that are expected to be long weigh more, and of the factor that
/// so few frames give a part is taken.
///
/// # Errors
/// For a model that is no analytic one times a learned factor, or when inputs cannot be computed.
pub fn transfer(file: &ModelFile, kitchen: &Kitchen<'_>, frames: Timed<'_>) -> Result<ModelFile> {
    let model = file.to_model()?;
    let layout = Layout::of_model(&model)?;
    let carried = layout.scene_features().last() == Some(&SceneFeature::log(SceneQuantity::EstimatedSeconds));
    let parts = model.prednet().context("the model file holds no PredNet")?;
    ensure!(
        carried && parts.target == Target::LogSeconds && model.metadata().contains_key(UNIT_COSTS_KEY),
        "only an analytic model times a learned factor (--model-kind residual) can be transferred; calibrate or fine-tune this one"
    );
    let (analytic, _) = fit_analytic(kitchen, frames, layout.probe_side(), &UnitCosts::CONVERTING)?;
    let mut out = file.clone();
    out.set_metadata(UNIT_COSTS_KEY, analytic.unit_costs().to_json()?);
    let layout = Layout::of_model(&out.to_model()?)?;
    let rows = layout.rows(kitchen.tables, frames.frames, kitchen.pool, &ProgressBar::hidden())?;
    let scale = Standardization::of(parts);
    let mut parts = parts.clone();
    let last = parts.layers.last().context("the PredNet has no layer")?.clone();
    // The last unit holds the estimate, which stays as it is; the others hold the factor.
    let width = last.inputs - 1;
    let (estimate, factor) = (f64::from(last.weight[width]), &last.weight[..width]);
    let (mut hidden, mut y) = (Vec::new(), Vec::new());
    let activations = hidden_activations(&parts, &standardized(&rows, &scale));
    let inputs = scale.input_mean.len();
    let (mut importance, mut neutral) = (Vec::new(), 0.0);
    let standard = |log: f64| (log - f64::from(scale.output_mean)) / f64::from(scale.output_std);
    for ((row, seconds), input) in
        activations.chunks_exact(last.inputs).zip(frames.seconds).zip(rows.chunks_exact(inputs))
    {
        let expected = f64::from(input[inputs - 1]);
        hidden.extend_from_slice(&row[..width]);
        y.push(standard(seconds.ln()) - estimate * row[width]);
        importance.push((0.5 * expected).exp());
        // With this bias and no factor, the estimate is what comes out.
        neutral += (standard(expected) - estimate * row[width]) / frames.seconds.len() as f64;
    }
    let mean = importance.iter().sum::<f64>() / importance.len() as f64;
    importance.iter_mut().for_each(|w| *w /= mean);
    let mut prior: Vec<f64> = factor.iter().map(|&w| TRANSFERRED * f64::from(w)).collect();
    prior.push(neutral);
    let mut solution = weighted_least_squares(&hidden, width, &y, &importance, &prior, TRANSFER_RIDGE);
    solution[..width].iter_mut().for_each(|w| *w *= BELIEVED);
    solution[width] = neutral + BELIEVED * (solution[width] - neutral);
    if let Some(layer) = parts.layers.last_mut() {
        let fitted = last_layer(&solution);
        layer.weight[..width].copy_from_slice(&fitted.weight);
        layer.bias = fitted.bias;
    }
    out.set_prednet(&parts, model.inputs())?;
    Ok(out)
}

/// Share of a learned factor's weights that is expected to hold for another renderer, and what that weighs per frame. These
/// and [`BELIEVED`] were chosen by cross-validation over the training volumes of four renderers.
const TRANSFERRED: f64 = 0.25;
const TRANSFER_RIDGE: f64 = 0.3;

/// Share of the logarithm of a factor fitted to a few frames that is taken.
const BELIEVED: f64 = 0.85;

/// Ridge of the log-linear fit, relative to the number of frames, on standardized inputs.
const RIDGE: f64 = 1e-4;

/// What a model's weights weigh against new frames, per frame.
const PRIOR_FRAMES: f64 = 3e-2;

fn standardized(rows: &[f32], scale: &Standardization) -> Vec<f64> {
    let width = scale.input_mean.len();
    rows.iter()
        .enumerate()
        .map(|(i, &x)| {
            let k = i % width;
            (f64::from(x) - f64::from(scale.input_mean[k])) / f64::from(scale.input_std[k])
        })
        .collect()
}

/// What enters the last layer.
fn hidden_activations(parts: &PredNetParts, x: &[f64]) -> Vec<f64> {
    let mut rows = x.to_vec();
    for layer in &parts.layers[..parts.layers.len() - 1] {
        let mut next = Vec::with_capacity(rows.len() / layer.inputs * layer.outputs);
        for row in rows.chunks_exact(layer.inputs) {
            for (weights, &bias) in layer.weight.chunks_exact(layer.inputs).zip(&layer.bias) {
                let sum: f64 =
                    weights.iter().zip(row).map(|(w, x)| f64::from(*w) * x).sum::<f64>() + f64::from(bias);
                let alpha = entire_core::nn::SELU_ALPHA;
                next.push(SELU_SCALE * if sum > 0.0 { sum } else { alpha * sum.exp_m1() });
            }
        }
        rows = next;
    }
    rows
}

fn last_layer(solution: &[f64]) -> DenseParts {
    let n = solution.len() - 1;
    DenseParts {
        inputs: n,
        outputs: 1,
        weight: solution[..n].iter().map(|&w| w as f32).collect(),
        bias: vec![solution[n] as f32],
        dtype: Dtype::F32,
    }
}

/// Minimizes Σ huber(y − w·x − b) + n·ridge·‖(w, b) − prior‖², the bias free of the ridge; returns w then b. Errors beyond
/// two robust standard deviations count linearly.
fn robust_least_squares(x: &[f64], width: usize, y: &[f64], prior: &[f64], ridge: f64) -> Vec<f64> {
    weighted_least_squares(x, width, y, &vec![1.0; y.len()], prior, ridge)
}

/// As [`robust_least_squares`], each row times its importance; their mean is 1.
fn weighted_least_squares(
    x: &[f64],
    width: usize,
    y: &[f64],
    importance: &[f64],
    prior: &[f64],
    ridge: f64,
) -> Vec<f64> {
    let m = width + 1;
    let mut solution = prior.to_vec();
    let mut weights = vec![1.0; y.len()];
    for _ in 0..6 {
        let mut gram = vec![0.0; m * m];
        let mut rhs = vec![0.0; m];
        for (((row, &t), &weight), &times) in x.chunks_exact(width).zip(y).zip(&weights).zip(importance) {
            let weight = weight * times;
            let at = |i: usize| if i < width { row[i] } else { 1.0 };
            for i in 0..m {
                let wi = weight * at(i);
                rhs[i] += wi * t;
                for j in 0..=i {
                    gram[i * m + j] += wi * at(j);
                }
            }
        }
        let pull = ridge * y.len() as f64;
        for i in 0..m {
            let pull = if i < width { pull } else { 1e-9 * pull };
            gram[i * m + i] += pull;
            rhs[i] += pull * prior[i];
        }
        let Some(next) = solve(&mut gram, rhs) else { break };
        solution = next;
        let residuals: Vec<f64> = x
            .chunks_exact(width)
            .zip(y)
            .map(|(row, t)| {
                (t - row.iter().zip(&solution).map(|(a, b)| a * b).sum::<f64>() - solution[width]).abs()
            })
            .collect();
        let limit = 2.0 * 1.4826 * crate::dataset::median(&mut residuals.clone()).unwrap_or(0.0);
        for (w, r) in weights.iter_mut().zip(&residuals) {
            *w = if *r <= limit { 1.0 } else { limit / r };
        }
    }
    solution
}

/// Cholesky of a symmetric positive matrix given by its lower half; `None` where it is not.
pub(crate) fn solve(a: &mut [f64], mut b: Vec<f64>) -> Option<Vec<f64>> {
    let n = b.len();
    for j in 0..n {
        for k in 0..j {
            let f = a[j * n + k];
            for i in j..n {
                a[i * n + j] -= a[i * n + k] * f;
            }
        }
        let d = a[j * n + j];
        if !(d.is_finite() && d > 0.0) {
            return None;
        }
        let root = d.sqrt();
        for i in j..n {
            a[i * n + j] /= root;
        }
    }
    for i in 0..n {
        let sum: f64 = (0..i).map(|k| a[i * n + k] * b[k]).sum();
        b[i] = (b[i] - sum) / a[i * n + i];
    }
    for i in (0..n).rev() {
        let sum: f64 = (i + 1..n).map(|k| a[k * n + i] * b[k]).sum();
        b[i] = (b[i] - sum) / a[i * n + i];
    }
    Some(b)
}

fn fit_analytic(
    kitchen: &Kitchen<'_>,
    training: Timed<'_>,
    probe_side: usize,
    default: &UnitCosts,
) -> Result<(AnalyticModel, String)> {
    let measurements: Vec<Measurement> = counts(kitchen, training, default, probe_side)?
        .iter()
        .zip(training.seconds)
        .map(|(row, &seconds)| Measurement::from_work(row, seconds))
        .collect();
    let mut model = AnalyticModel::new();
    let report = model.fit_towards(default, &measurements)?;
    let text = format!(
        "fitted to {} frames, {} refused, median error {:.2} %",
        report.used,
        report.refused,
        100.0 * report.median_error
    );
    Ok((model, text))
}

/// The counts that unit costs stand for, one row per frame; 0 for those that cost nothing.
fn counts(
    kitchen: &Kitchen<'_>,
    part: Timed<'_>,
    costs: &UnitCosts,
    probe_side: usize,
) -> Result<Vec<[f32; COSTS - 1]>> {
    let asked: Vec<usize> = (0..COSTS - 1).filter(|i| costs.0[i + 1] > 0.0).collect();
    if asked.is_empty() {
        return Ok(vec![[0.0; COSTS - 1]; part.frames.len()]);
    }
    let features: Vec<SceneFeature> =
        asked.iter().map(|&i| SceneFeature::linear(COST_QUANTITIES[i])).collect();
    let layout = Layout::new(&[GroupKind::SceneFeatures], features, 0, None)?.with_probe_side(probe_side);
    let rows = layout.rows(kitchen.tables, part.frames, kitchen.pool, &ProgressBar::hidden())?;
    Ok(rows
        .chunks_exact(asked.len())
        .map(|row| {
            let mut out = [0.0; COSTS - 1];
            for (&i, &value) in asked.iter().zip(row) {
                out[i] = value;
            }
            out
        })
        .collect())
}

fn estimates(
    kitchen: &Kitchen<'_>,
    part: Timed<'_>,
    costs: &UnitCosts,
    probe_side: usize,
) -> Result<Vec<f64>> {
    Ok(counts(kitchen, part, costs, probe_side)?.iter().map(|row| costs.seconds_of_quantities(row)).collect())
}

/// Most networks whose mean is taken.
const MAX_ENSEMBLE: usize = 16;

/// One network that gives the mean of what several give that are alike in widths and standardization: hidden layers
/// beside each other, the last one over all of them.
fn side_by_side(members: Vec<PredNetParts>) -> Result<PredNetParts> {
    let count = members.len();
    let mut members = members.into_iter();
    let mut out = members.next().context("an ensemble of no network")?;
    let rest: Vec<PredNetParts> = members.collect();
    let depth = out.layers.len();
    for (i, layer) in out.layers.iter_mut().enumerate() {
        let (first, last) = (i == 0, i + 1 == depth);
        let parts: Vec<&DenseParts> = rest.iter().map(|m| &m.layers[i]).collect();
        let (width, height) = (layer.inputs, layer.outputs);
        ensure!(
            parts.iter().all(|p| p.inputs == width && p.outputs == height),
            "networks of different widths cannot stand beside each other"
        );
        let blocks: Vec<&DenseParts> = std::iter::once(&*layer).chain(parts).collect();
        let (inputs, outputs) =
            (if first { width } else { width * count }, if last { height } else { height * count });
        let share = if last { 1.0 / count as f32 } else { 1.0 };
        let mut weight = vec![0.0; inputs * outputs];
        let mut bias = vec![0.0; outputs];
        for (b, block) in blocks.iter().enumerate() {
            for (r, row) in block.weight.chunks_exact(width).enumerate() {
                let at = (if last { r } else { b * height + r }) * inputs + if first { 0 } else { b * width };
                // Where first and last are one, members share their columns too.
                for (w, v) in weight[at..at + width].iter_mut().zip(row) {
                    *w += share * v;
                }
                bias[if last { r } else { b * height + r }] += share * block.bias[r];
            }
        }
        *layer = DenseParts { inputs, outputs, weight, bias, dtype: layer.dtype };
    }
    Ok(out)
}

/// How many standard deviations below its mean the carried estimate stays exact.
const CARRY_RANGE: f32 = 12.0;

/// Adds the logarithm of an estimate, as a last input with the given mean and deviation, to what a network on log ratios
/// gives. In every hidden layer one unit of its own holds the estimate, kept so far above zero that SELU is a plain
/// factor there; the last layer takes factor and offset out again.
fn carry_past(parts: PredNetParts, mean: f32, sd: f32) -> PredNetParts {
    let (out_mean, out_std) = match &parts.output {
        Some(n) => (n.mean[0], n.std[0]),
        None => (0.0, 1.0),
    };
    let depth = parts.layers.len();
    let mut layers = Vec::with_capacity(depth);
    for (i, layer) in parts.layers.iter().enumerate() {
        let (first, last) = (i == 0, i + 1 == depth);
        let (inputs, outputs) = (layer.inputs + 1, layer.outputs + usize::from(!last));
        let mut weight = Vec::with_capacity(inputs * outputs);
        let mut bias = layer.bias.clone();
        for row in layer.weight.chunks_exact(layer.inputs) {
            weight.extend_from_slice(row);
            weight.push(0.0);
        }
        // The unit's value is gain · (z + shift) with z the standardized estimate.
        let gain = SELU_SCALE.powi(i as i32);
        let shift = if first { 0.0 } else { f64::from(CARRY_RANGE) };
        if last {
            let scale = f64::from(sd) / f64::from(out_std);
            if let Some(w) = weight.last_mut() {
                *w = (scale / gain) as f32;
            }
            bias[0] = (f64::from(bias[0]) - shift * scale + f64::from(mean) / f64::from(out_std)) as f32;
        } else {
            weight.extend(std::iter::repeat_n(0.0, layer.inputs));
            weight.push(1.0);
            bias.push(if first { CARRY_RANGE } else { 0.0 });
        }
        layers.push(DenseParts { inputs, outputs, weight, bias, dtype: layer.dtype });
    }
    let width = layers[0].inputs - 1;
    let mut input = parts.input.unwrap_or(Normalization { mean: vec![0.0; width], std: vec![1.0; width] });
    input.mean.push(mean);
    input.std.push(sd);
    PredNetParts {
        layers,
        input: Some(input),
        output: Some(Normalization { mean: vec![out_mean], std: vec![out_std] }),
        target: Target::LogSeconds,
    }
}

fn run_training(
    kitchen: &Kitchen<'_>,
    network: Network<f32>,
    standardization: Option<Standardization>,
    (training, validation): (Samples<'_>, Samples<'_>),
    settings: &Settings,
) -> Result<(PredNetParts, Vec<EpochRecord>, String)> {
    let started = Instant::now();
    let show = |p: &Progress| {
        kitchen.bar.set_length(p.total_steps);
        if let Some(e) = p.ended
            && (e.epoch == 1 || e.epoch % 5 == 0)
        {
            kitchen.bar.set_message(format!(
                "{}/{} training {:.3e} validation {:.3e} best {:.3e}",
                e.epoch, p.epochs, e.training_loss, e.validation_loss, p.best
            ));
            kitchen.bar.set_position(p.steps);
        }
        if (kitchen.stop)() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let trained = train(kitchen.pool, network, standardization, training, validation, settings, show)?;
    let taken = started.elapsed().as_secs_f64();
    if trained.best_epoch == 0 {
        match trained.stop {
            Stop::Diverged => bail!(
                "training diverged in its first epoch; lower --learning-rate (it was {})",
                settings.learning_rate
            ),
            _ => bail!("stopped before anything was learned; nothing was written"),
        }
    }
    let ran = trained.history.len();
    let why = match trained.stop {
        Stop::Finished => format!("all {ran} epochs done"),
        Stop::Early => format!("stopped early after {ran} epochs"),
        Stop::Interrupted => format!("interrupted after {ran} whole epochs"),
        Stop::Diverged => format!("diverged after {ran} epochs (the weights before are kept)"),
        _ => format!("ended after {ran} epochs"),
    };
    let frames = training.seconds.len() as f64 * ran as f64;
    let outcome = format!(
        "{why}, best epoch {} with loss {:.4e}, {:.0} frames/s",
        trained.best_epoch,
        trained.best_loss,
        frames / taken
    );
    Ok((trained.to_parts(), trained.history, outcome))
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_core::nn::PredNet;

    fn network(widths: &[usize], seed: u64) -> PredNetParts {
        let net = Network::<f32>::random(widths, seed).unwrap();
        let layers = (0..net.layers())
            .map(|i| {
                let (weight, bias) = net.layer(i);
                let bias = bias.iter().enumerate().map(|(k, b)| b + 0.1 * (k as f32 + seed as f32)).collect();
                DenseParts {
                    inputs: widths[i],
                    outputs: widths[i + 1],
                    weight: weight.to_vec(),
                    bias,
                    dtype: Dtype::F32,
                }
            })
            .collect();
        PredNetParts {
            layers,
            input: Some(Normalization { mean: vec![0.5; widths[0]], std: vec![2.0; widths[0]] }),
            output: Some(Normalization { mean: vec![-3.0], std: vec![0.7] }),
            target: Target::LogSeconds,
        }
    }

    #[test]
    fn networks_side_by_side_give_the_mean_of_their_logarithms() {
        for widths in [&[3, 1][..], &[3, 5, 1], &[3, 5, 4, 1]] {
            let members: Vec<PredNetParts> = (1..=3).map(|seed| network(widths, seed)).collect();
            let one = PredNet::new(&side_by_side(members.clone()).unwrap()).unwrap();
            let each: Vec<PredNet> = members.iter().map(|m| PredNet::new(m).unwrap()).collect();
            for x in [[0.0f32, 0.0, 0.0], [1.0, -2.0, 3.0], [9.0, 9.0, -9.0]] {
                let mean: f64 =
                    each.iter().map(|n| f64::from(n.predict(&x, &mut n.scratch())).ln()).sum::<f64>() / 3.0;
                let found = f64::from(one.predict(&x, &mut one.scratch())).ln();
                assert!((found - mean).abs() < 1e-5, "{widths:?} {x:?}: {found} {mean}");
            }
        }
        let unlike = vec![network(&[3, 5, 1], 1), network(&[3, 4, 1], 2)];
        assert!(side_by_side(unlike).unwrap_err().to_string().contains("different widths"));
    }

    fn tables_of_no_volume(count: u64) -> Vec<TimedFrame> {
        use entire_core::scene::{Arcball, Skipping};
        (0..count)
            .map(|number| {
                let mut frame = TimedFrame::of_no_volume("nowhere.nrrd", "");
                frame.number = number;
                frame.scene.skipping = Skipping::None;
                frame.scene.termination = 1.0;
                frame.scene.camera = Arcball {
                    rx: (number * 37 % 17) as f32 * 0.2 - 1.5,
                    ry: (number * 11 % 23) as f32 * 0.2 - 2.0,
                    dz: 1.0 + (number * 5 % 13) as f32 * 0.2,
                };
                frame
            })
            .collect()
    }

    fn with_kitchen<T>(run: impl FnOnce(&Kitchen<'_>) -> T) -> T {
        let pool = crate::commands::train::thread_pool(Some(1)).unwrap();
        let tables = [Table {
            path: "t.csv".into(),
            manifest: None,
            frames: Vec::new(),
            hash: 0,
            features: None,
            root: None,
        }];
        run(&Kitchen { tables: &tables, pool: &pool, bar: &ProgressBar::hidden(), stop: &|| false })
    }

    #[test]
    fn an_estimate_carried_past_a_network_is_multiplied_by_what_the_network_gives() {
        use entire_core::features::{
            Changes, FrameFeatures, Setting, SummaryOptions, TransferSummary, VolumeSummary,
        };
        use entire_core::predict::{Inputs, ModelPredictor, Predictor};
        use entire_core::scene::{Camera, Frame, TransferFunction};

        let values: Vec<u8> = (0..16 * 12 * 10).map(|i| (i * 7 % 251) as u8).collect();
        let data = crate::volume::VolumeData::U8(values);
        let volume = crate::volume::Volume::new(data, [16, 12, 10], [1.0; 3], "v").unwrap();
        let summary = VolumeSummary::new(&volume.view(), SummaryOptions::default()).unwrap();
        let analytic = AnalyticModel::from_costs(std::array::from_fn(|i| 1e-6 * (1.0 + i as f64))).unwrap();
        let costs = analytic.unit_costs();
        let inputs =
            [SceneFeature::log(SceneQuantity::Pixels), SceneFeature::linear(SceneQuantity::MeanChord)];
        for widths in [&[2, 1][..], &[2, 4, 1], &[2, 6, 5, 1], &[2, 4, 4, 3, 1]] {
            let mut ratio = network(widths, 3);
            ratio.output = Some(Normalization { mean: vec![0.2], std: vec![0.3] });
            let carried = carry_past(ratio.clone(), -3.0, 1.5);
            let mut features = inputs.to_vec();
            features.push(SceneFeature::log(SceneQuantity::EstimatedSeconds));
            let wide =
                Layout::new(&[GroupKind::SceneFeatures], features, 0, None).unwrap().with_probe_side(5);
            let mut file = ModelFile::new();
            file.set_metadata(UNIT_COSTS_KEY, costs.to_json().unwrap());
            Recipe::default().store(&mut file, carried, &wide).unwrap();
            let model = file.to_model().unwrap();
            let layout = Layout::of_model(&model).unwrap();
            assert_eq!(layout.probe_side(), 5);
            let mut predictor = ModelPredictor::new(&model).unwrap();
            let factor = PredNet::new(&ratio).unwrap();
            for (lobes, distance, size) in
                [("0.5 0.1 0.3", 2.0, 40), ("0.2 0.01 0.9", 3.5, 300), ("0.9 0.3 1", 1.2, 8)]
            {
                let camera = entire_core::scene::Arcball { rx: 20.0, ry: 70.0, dz: distance };
                let frame = Frame::new(Camera::from_arcball(camera).unwrap(), size, size).unwrap();
                let lobes = crate::dataset::parse_lobes(lobes).unwrap();
                let table = TransferFunction::Gaussian(lobes.clone()).to_table().unwrap();
                let mut measured = FrameFeatures::with_probe_side(5);
                measured.measure(&summary, &TransferSummary::new(&summary, &table), &frame);
                let setting = Setting::of(&frame);
                let asked = Inputs {
                    features: &measured,
                    setting,
                    changes: Changes::NONE,
                    camera,
                    volume_features: None,
                    lobes: Some(&lobes),
                };
                let work = measured.work(&setting);
                let quantity = |q| measured.quantity(q, &setting, &work, Changes::NONE);
                let x = [
                    SceneQuantity::Pixels.log(quantity(SceneQuantity::Pixels)),
                    quantity(SceneQuantity::MeanChord) as f32,
                ];
                let counts = COST_QUANTITIES.map(|q| quantity(q) as f32);
                let expected = costs.seconds_of_quantities(&counts)
                    * f64::from(factor.predict(&x, &mut factor.scratch()));
                // Far from the shortest time that a network gives, where nothing could be told apart.
                assert!((1e-4..1e4).contains(&expected), "{expected}");
                let predicted = f64::from(predictor.predict(&asked).unwrap().seconds);
                let mut row = vec![0.0; layout.width()];
                layout.write(&asked, &mut row).unwrap();
                let by_row = crate::commands::train::predict_rows(&model, &row, row.len()).unwrap()[0];
                for found in [predicted, by_row] {
                    assert!((found / expected - 1.0).abs() < 1e-4, "{widths:?}: {found} {expected}");
                }
            }
        }
    }

    #[test]
    fn calibration_recovers_the_factor_of_another_machine() {
        let frames = tables_of_no_volume(200);
        let frames: Vec<&TimedFrame> = frames.iter().collect();
        for (target, tolerance) in [(Target::LogSeconds, 0.02), (Target::Seconds, 1e-5)] {
            let mut parts = network(&[3, 6, 1], 2);
            parts.target = target;
            if target == Target::Seconds {
                // Seconds far from zero, as they are of real models.
                parts.output = Some(Normalization { mean: vec![9.0], std: vec![0.2] });
            }
            let layout = Layout::new(&[GroupKind::Camera], Vec::new(), 0, None).unwrap();
            let mut file = ModelFile::new();
            Recipe::default().store(&mut file, parts, &layout).unwrap();
            with_kitchen(|kitchen| {
                let predict = |file: &ModelFile| {
                    crate::study::predict(&file.to_model().unwrap(), kitchen, &frames).unwrap()
                };
                let there: Vec<f64> = predict(&file).iter().map(|t| 2.5 * t).collect();
                let few = Timed { frames: &frames[..100], seconds: &there[..100] };
                let tuned = predict(&calibrate(&file, kitchen, few).unwrap());
                for (found, expected) in tuned.iter().zip(&there).skip(100) {
                    assert!((found / expected - 1.0).abs() < tolerance, "{target:?}: {found} {expected}");
                }
            });
        }
    }

    #[test]
    fn what_a_recipe_cannot_take_is_said_before_anything_is_computed() {
        let frames = tables_of_no_volume(3);
        let frames: Vec<&TimedFrame> = frames.iter().collect();
        let part = Timed { frames: &frames, seconds: &[1.0, 2.0, 3.0] };
        // The volume is nowhere, so that any work at all fails in another way.
        let says = |recipe: Recipe| {
            with_kitchen(|kitchen| format!("{:#}", recipe.make(kitchen, part, part).unwrap_err()))
        };
        let residual = Recipe { kind: Kind::Residual, ..Recipe::default() };
        let inputs = vec!["scene_features".into(), "camera".into()];
        assert!(says(Recipe { inputs, ..residual.clone() }).contains("takes scene_features alone"));
        assert!(says(Recipe { loss: "cosine".into(), ..residual.clone() }).contains("pinball"));
        assert!(says(Recipe { scene_features: vec!["warp".into()], ..residual.clone() }).contains("warp"));
        assert!(says(residual).contains("nowhere.nrrd"));
    }
}
