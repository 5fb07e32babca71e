//! Recipe of a predictor, which commands and studies share, and the fit that it describes.

use super::analytic::{estimates, fit_analytic};
use super::compose::{carry_past, side_by_side};
use super::training::{NOTHING_LEARNED, run_training};
use super::{FitContext, FittedModel};
use crate::gradient::{EpochRecord, Loss, Network, Samples, Settings, Standardization, preset_widths};
use crate::inputs::{Encoder, Layout, prednet_of, volumenet_of};
use anyhow::{Context, Result, anyhow, bail, ensure};
use clap::{Args as _, FromArgMatches as _};
use entire_core::model::{GroupKind, Key, ModelFile};
use entire_core::nn::{Dtype, PredNetParts, Target};
use entire_io::dataset::Timed;
use entire_io::files::read_model_file;
use entire_steer::features::{MAX_PROBE_SIDE, PROBE_SIDE, SceneFeature, SceneQuantity};
use entire_steer::predict::{AnalyticModel, InputLayout};
use indicatif::ProgressBar;
use serde::{Deserialize, Serialize};
use serde_json::json;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Maximum number of networks in an ensemble.
const MAX_ENSEMBLE: usize = 16;

/// Kind of the fitted model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// A network, by gradient descent.
    #[default]
    Prednet,
    /// Unit costs of estimated work, by robust regression with a prior; stored as one dense layer. Not an
    /// option of `entire train`: `entire calibrate` fits unit costs.
    #[value(skip)]
    Analytic,
    /// Unit costs times a factor from a small network, which is trained on ln(measured / expected).
    Residual,
}

/// Output quantity of the network.
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

/// Storage format of weights.
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
    /// Storage format in model files.
    pub fn storage(self) -> Dtype {
        match self {
            Self::F32 => Dtype::F32,
            Self::F16 => Dtype::F16,
            Self::Bf16 => Dtype::Bf16,
        }
    }
}

/// Recipe of a predictor. Omitted fields have the defaults of the options.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, clap::Args)]
#[serde(default, deny_unknown_fields)]
pub struct Recipe {
    /// Kind of the model.
    #[arg(
        long = "model-kind",
        value_enum,
        default_value_t = Kind::Prednet,
        value_name = "MODEL_KIND",
        conflicts_with = "fine_tune"
    )]
    pub kind: Kind,
    /// Hidden layer widths.
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "WIDTHS",
        conflicts_with_all = ["preset", "fine_tune"],
        default_value = "64,64"
    )]
    pub layers: Vec<usize>,
    /// Layers in the paper's notation, such as 0C256, 4C64 or 12C256. 12C256 is inputs → 256, 12 × (256 →
    /// 256), then widths halved down to 16, then 1.
    #[arg(long, conflicts_with = "fine_tune")]
    pub preset: Option<String>,
    /// Input groups of the network, in its order of inputs. Accepted are volume_features, camera, resolution,
    /// transfer_function, step_size and scene_features.
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "GROUPS",
        default_value = "scene_features",
        conflicts_with = "fine_tune"
    )]
    pub inputs: Vec<String>,
    /// Scene features, in order, if `--inputs` names the group scene_features; default: the standard
    /// features.
    #[arg(long, value_delimiter = ',', value_name = "NAMES", conflicts_with = "fine_tune")]
    pub scene_features: Vec<String>,
    /// Rays along each side of the probe that computes the scene features, 1 to 24; default: the standard 11.
    /// Fewer rays make every prediction faster.
    #[arg(long, value_name = "SIDE", conflicts_with = "fine_tune")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub probe_side: Option<usize>,
    /// Number of networks with different seeds; their mean is stored as one network.
    #[arg(long, default_value_t = 1, value_name = "N", conflicts_with = "fine_tune")]
    pub ensemble: usize,
    /// Output quantity of the network.
    #[arg(long, value_enum, default_value_t = TargetChoice::LogSeconds, conflicts_with = "fine_tune")]
    pub target: TargetChoice,
    /// Loss function: mse, huber or huber:delta.
    #[arg(long, default_value = "mse", value_parser = checked_loss)]
    pub loss: String,
    /// Maximum number of passes over the training frames.
    #[arg(long, default_value_t = 200)]
    pub epochs: usize,
    /// Frames per gradient step.
    #[arg(long, default_value_t = 256)]
    pub batch: usize,
    /// Initial learning rate; it falls along half a cosine. Default: 1e-4 with --preset (as in the paper) or
    /// --fine-tune, else 1e-3.
    #[arg(long)]
    pub learning_rate: Option<f64>,
    /// Last learning rate; default: a hundredth of the first.
    #[arg(skip)]
    pub final_learning_rate: Option<f64>,
    /// Largest norm of the gradient.
    #[arg(skip = 1.0)]
    pub clip: f64,
    /// Number of successive epochs without a lower validation loss after which training stops.
    #[arg(long, default_value_t = 50)]
    pub patience: usize,
    /// Seed of the split, the weights and the order of frames.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Model file with the VolumeNet that encodes volumes.
    #[arg(skip)]
    pub volumenet: Option<PathBuf>,
    /// Model file whose weights training starts from; default: random weights.
    #[arg(skip)]
    pub fine_tune: Option<PathBuf>,
    /// Sort the Gaussian lobes of the input group transfer_function by center. Their sum does not depend on
    /// their order, which the network then need not learn.
    #[arg(long, conflicts_with = "fine_tune")]
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub sorted_lobes: bool,
    /// An existing model file; all other fields are then ignored.
    #[arg(skip)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub file: Option<PathBuf>,
    /// Storage format of weights.
    #[arg(skip)]
    pub dtype: DtypeChoice,
}

impl Default for Recipe {
    /// The recipe of a command line without options. The recipe is parsed from an empty command line, so that
    /// the defaults are stated only where the options are defined.
    fn default() -> Self {
        // The option of the command with which the recipe's options conflict.
        let command = clap::Command::new("recipe").arg(clap::Arg::new("fine_tune"));
        let found = Self::augment_args(command).try_get_matches_from(["recipe"]);
        found.and_then(|found| Self::from_arg_matches(&found)).expect("every option has a default")
    }
}

/// Reads a loss: `mse`, `huber`, `huber:DELTA`.
fn parse_loss(text: &str) -> Result<Loss> {
    let (name, value) = match text.split_once(':') {
        Some((name, value)) => {
            let value: f64 = value.parse().map_err(|_| anyhow!("{value:?} after {name} is no number"))?;
            (name, Some(value))
        }
        None => (text, None),
    };
    match (name, value) {
        ("mse", None) => Ok(Loss::SquaredError),
        ("huber", delta) => Ok(Loss::Huber { delta: delta.unwrap_or(1.0) }),
        _ => bail!("loss {text:?}; mse, huber or huber:DELTA is expected"),
    }
}

fn checked_loss(text: &str) -> Result<String> {
    parse_loss(text).map(|_| text.to_owned())
}

/// Inputs of the training frames and of the validation frames.
fn rows(
    layout: &Layout,
    context: &FitContext<'_>,
    [training, validation]: [Timed<'_>; 2],
) -> Result<[Vec<f32>; 2]> {
    let of = |part: Timed<'_>| layout.rows(context.tables, part.frames, context.pool, &ProgressBar::hidden());
    Ok([of(training)?, of(validation)?])
}

/// Samples for training and for validation.
fn samples<'a>(inputs: &'a [Vec<f32>; 2], seconds: [&'a [f64]; 2]) -> (Samples<'a>, Samples<'a>) {
    let of = |i: usize| Samples { inputs: &inputs[i], seconds: seconds[i] };
    (of(0), of(1))
}

fn joined(widths: &[usize]) -> String {
    widths.iter().map(ToString::to_string).collect::<Vec<_>>().join("-")
}

/// Measured seconds divided by estimated seconds, for each frame.
fn ratios_of(seconds: &[f64], estimates: &[f64]) -> Vec<f64> {
    seconds.iter().zip(estimates).map(|(t, e)| t / e).collect()
}

/// Default scene features of a model; `true` selects the logarithm of the quantity.
fn standard_features() -> Vec<SceneFeature> {
    use SceneQuantity as Q;
    [
        (Q::Pixels, true),
        (Q::SamplesPerPixel, true),
        (Q::ShadowPerPixel, true),
        (Q::SegmentsPerRay, true),
        (Q::RaySpacing, true),
        (Q::FootprintShare, false),
        (Q::TerminatedShare, false),
        (Q::Divergence, true),
        (Q::OccupiedShare, false),
        (Q::VisibleShare, true),
        (Q::MeanExtinction, true),
        (Q::MeanChord, true),
        (Q::Step, true),
        (Q::Voxels, true),
    ]
    .map(|(quantity, log)| SceneFeature { quantity, log })
    .to_vec()
}

impl Recipe {
    /// The scene features of the recipe.
    ///
    /// # Errors
    /// When the name of a scene feature is not known.
    pub fn features(&self) -> Result<Vec<SceneFeature>> {
        if self.scene_features.is_empty() {
            return Ok(standard_features());
        }
        self.scene_features.iter().map(|n| Ok(n.trim().parse()?)).collect()
    }

    /// Fits the predictor. Validation frames decide when the training of a network stops; the analytic model
    /// does not use them.
    ///
    /// # Errors
    /// When the recipe does not fit the frames, a setting is out of range, inputs cannot be computed,
    /// training fails, or the fit is stopped before a network's training or before the end of an analytic
    /// model's fit.
    pub fn make(
        &self,
        context: &FitContext<'_>,
        training: Timed<'_>,
        validation: Timed<'_>,
    ) -> Result<FittedModel> {
        if let Some(path) = &self.file {
            let (file, _) = read_model_file(path)?;
            return Ok(FittedModel {
                file,
                what: "An existing model file, unchanged".into(),
                settings: json!({ "file": path.file_name().map(|n| n.to_string_lossy()) }),
                history: Vec::new(),
                outcome: "nothing was fitted".into(),
            });
        }
        ensure!(!training.frames.is_empty(), "there are no training frames");
        ensure!(
            (1..=MAX_ENSEMBLE).contains(&self.ensemble),
            "the ensemble has {} networks; 1 to {MAX_ENSEMBLE} are accepted",
            self.ensemble
        );
        if let Some(side) = self.probe_side {
            ensure!(
                (1..=MAX_PROBE_SIDE).contains(&side),
                "the probe has {side} rays along each side; 1 to {MAX_PROBE_SIDE} are accepted"
            );
        }
        self.settings()?.check()?;
        ensure!(
            self.kind != Kind::Residual
                || self.fine_tune.is_some()
                || self.inputs.iter().map(|g| g.trim()).eq([<&str>::from(GroupKind::SceneFeatures)]),
            "a residual model takes scene_features alone; leave out other --inputs"
        );
        ensure!(
            self.kind != Kind::Residual || self.preset.is_none(),
            "--preset is for --model-kind prednet; give the widths of a residual model's network by --layers"
        );
        if let Some(path) = &self.fine_tune {
            return self.fine_tune(path, context, [training, validation]);
        }
        match self.kind {
            Kind::Analytic => self.analytic(context, training),
            Kind::Residual => self.residual(context, [training, validation]),
            Kind::Prednet => self.network(context, [training, validation]),
        }
    }

    /// True if the ray step is an input, by itself or in counts of samples.
    ///
    /// # Errors
    /// When a group or feature is not known.
    pub fn knows_step(&self) -> Result<bool> {
        if matches!(self.kind, Kind::Analytic | Kind::Residual) {
            return Ok(true);
        }
        let (groups, features) = self.groups()?;
        // The numbers of lobes and volume features do not affect the result; both are set to 1.
        Ok(InputLayout::new(&groups, features, 1, 1)?.knows_step())
    }

    /// The input groups, and the scene features if they are one of the groups.
    fn groups(&self) -> Result<(Vec<GroupKind>, Vec<SceneFeature>)> {
        let groups: Vec<GroupKind> =
            self.inputs.iter().map(|n| Ok(n.trim().parse::<GroupKind>()?)).collect::<Result<_>>()?;
        let features = if groups.contains(&GroupKind::SceneFeatures) { self.features()? } else { Vec::new() };
        Ok((groups, features))
    }

    fn side(&self) -> usize {
        self.probe_side.unwrap_or(PROBE_SIDE)
    }

    /// Returns a new model file, with the VolumeNet if the recipe names one, and the layout of the inputs.
    ///
    /// # Errors
    /// When the name of a group or feature is not known, or the VolumeNet's file cannot be read.
    pub fn layout(&self, training: Timed<'_>) -> Result<(ModelFile, Layout)> {
        let (groups, features) = self.groups()?;
        let (file, encoder) = match &self.volumenet {
            Some(path) => {
                let (mut file, model) = read_model_file(path)?;
                // All entries except these two describe the file's own predictor, which is replaced.
                let taken = [Key::Format.name(), Key::VolumeNet.name()];
                file.metadata.retain(|key, _| taken.contains(&key.as_str()));
                (file, Some(Encoder::new(volumenet_of(&model, path)?)?))
            }
            None => (ModelFile::default(), None),
        };
        let lobes = training.frames.iter().map(|f| f.scene.lobes.len()).max().unwrap_or(0);
        let layout = Layout::new(&groups, features, lobes, encoder)?
            .with_probe_side(self.side())
            .with_sorted_lobes(self.sorted_lobes);
        Ok((file, layout))
    }

    fn settings(&self) -> Result<Settings> {
        let usual = if self.preset.is_some() || self.fine_tune.is_some() { 1e-4 } else { 1e-3 };
        let learning_rate = self.learning_rate.unwrap_or(usual);
        Ok(Settings {
            epochs: self.epochs,
            batch: self.batch,
            learning_rate,
            final_learning_rate: self.final_learning_rate.unwrap_or(learning_rate / 100.0),
            clip_norm: self.clip,
            patience: self.patience,
            loss: parse_loss(&self.loss)?,
            seed: self.seed,
            target: match self.target {
                TargetChoice::Seconds => Target::Seconds,
                TargetChoice::LogSeconds => Target::LogSeconds,
            },
        })
    }

    /// Returns the recipe for a model file. It refers to other files by name only, since folders differ
    /// between machines.
    fn portable(&self) -> Self {
        let name = |path: &Option<PathBuf>| path.as_ref().and_then(|p| p.file_name()).map(PathBuf::from);
        Self {
            volumenet: name(&self.volumenet),
            fine_tune: name(&self.fine_tune),
            file: name(&self.file),
            ..self.clone()
        }
    }

    fn analytic(&self, context: &FitContext<'_>, training: Timed<'_>) -> Result<FittedModel> {
        let (model, report) = fit_analytic(context, training, self.side())?;
        ensure!(!(context.stop)(), NOTHING_LEARNED);
        let costs: BTreeMap<String, f64> = model.costs().named().map(|(n, c)| (n.into(), c)).collect();
        Ok(FittedModel {
            file: model.to_model_file()?,
            what: "Unit costs of estimated work".into(),
            settings: json!({ "kind": self.kind, "probe_side": self.side(), "unit_costs_seconds": costs }),
            history: Vec::new(),
            outcome: report,
        })
    }

    fn residual(&self, context: &FitContext<'_>, parts: [Timed<'_>; 2]) -> Result<FittedModel> {
        let (mut file, layout) = self.layout(parts[0])?;
        let (model, report) = fit_analytic(context, parts[0], self.side())?;
        let costs = model.costs();
        let estimated = estimates(context, parts[0], &costs, self.side())?;
        let ratios = ratios_of(parts[0].seconds, &estimated);
        let judged = ratios_of(parts[1].seconds, &estimates(context, parts[1], &costs, self.side())?);
        let settings = Settings { target: Target::LogSeconds, ..self.settings()? };
        let widths = self.widths(layout.width());
        let inputs = rows(&layout, context, parts)?;
        let samples = samples(&inputs, [&ratios, &judged]);
        let (network, history, outcome) = self.ensemble(context, &widths, samples, &settings)?;
        let mut features = layout.scene_features.clone();
        features.push(SceneFeature { quantity: SceneQuantity::EstimatedSeconds, log: true });
        let logs: Vec<f64> = estimated.iter().map(|e| e.ln()).collect();
        let n = logs.len() as f64;
        let mean = logs.iter().sum::<f64>() / n;
        let sd = (logs.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / n).sqrt().max(0.1);
        let network = carry_past(network, mean as f32, sd as f32);
        let mut wide = Layout::new(&[GroupKind::SceneFeatures], features, 0, None)?
            .with_probe_side(self.side())
            .with_unit_costs(costs);
        // The estimate is not clamped, unlike the factor's inputs.
        wide.widen(&inputs[0], layout.width());
        self.store(&mut file, network, &wide)?;
        let costs: BTreeMap<String, f64> = costs.named().map(|(n, c)| (n.into(), c)).collect();
        let units = joined(&self.layers);
        let mean = match self.ensemble {
            1 => String::new(),
            count => format!(", mean of {count} networks stored as one"),
        };
        Ok(FittedModel {
            file,
            what: format!("Analytic cost model times a learned factor, {units} hidden units{mean}"),
            settings: json!({ "recipe": self.portable(), "unit_costs_seconds": costs }),
            history,
            outcome: format!("analytic part {report}; factor: {outcome}"),
        })
    }

    /// Layer widths of a network: inputs, hidden units, one output.
    fn widths(&self, inputs: usize) -> Vec<usize> {
        [&[inputs], &self.layers[..], &[1]].concat()
    }

    fn network(&self, context: &FitContext<'_>, parts: [Timed<'_>; 2]) -> Result<FittedModel> {
        let (mut file, layout) = self.layout(parts[0])?;
        let widths = match &self.preset {
            Some(preset) => preset_widths(preset, layout.width())?,
            None => self.widths(layout.width()),
        };
        let inputs = rows(&layout, context, parts)?;
        let samples = samples(&inputs, parts.map(|part| part.seconds));
        let (network, history, outcome) = self.ensemble(context, &widths, samples, &self.settings()?)?;
        self.store(&mut file, network, &layout)?;
        Ok(FittedModel {
            file,
            what: format!("PredNet, widths {}", joined(&widths)),
            settings: json!({ "recipe": self.portable(), "widths": widths, "optimizer": "Adam(0.9, \
                0.999)", "schedule": "cosine, per step" }),
            history,
            outcome,
        })
    }

    /// Trains the ensemble's networks, with consecutive seeds, and combines them. Also returns the epochs of
    /// the first network and the outcomes of all networks.
    fn ensemble(
        &self,
        context: &FitContext<'_>,
        widths: &[usize],
        samples: (Samples<'_>, Samples<'_>),
        settings: &Settings,
    ) -> Result<(PredNetParts, Vec<EpochRecord>, String)> {
        let mut members = Vec::with_capacity(self.ensemble);
        let mut outcomes = Vec::with_capacity(self.ensemble);
        let mut first = None;
        for member in 0..self.ensemble as u64 {
            if (context.stop)() {
                break;
            }
            let seed = self.seed.wrapping_add(member);
            let network = Network::random(widths, seed)?;
            let settings = Settings { seed, ..*settings };
            let (parts, history, outcome) = run_training(context, network, None, samples, &settings)?;
            // An interrupted network would worsen the mean of those that are trained to the end.
            if (context.stop)() && !members.is_empty() {
                break;
            }
            members.push(parts);
            outcomes.push(outcome);
            first.get_or_insert(history);
        }
        ensure!(!members.is_empty(), NOTHING_LEARNED);
        if members.len() < self.ensemble {
            outcomes.push(format!("interrupted; the mean of {} networks is kept", members.len()));
        }
        let history = first.context("the ensemble has no network")?;
        if outcomes.len() > 1 {
            outcomes.iter_mut().enumerate().for_each(|(i, o)| *o = format!("network {}: {o}", i + 1));
        }
        Ok((side_by_side(members)?, history, outcomes.join("; ")))
    }

    fn fine_tune(&self, path: &Path, context: &FitContext<'_>, parts: [Timed<'_>; 2]) -> Result<FittedModel> {
        ensure!(self.kind != Kind::Analytic, "an analytic model cannot be fine-tuned; leave out --fine-tune");
        let (mut file, model) = read_model_file(path)?;
        ensure!(
            AnalyticModel::from_model(&model)?.is_none(),
            "{0} is an analytic model, which has no network to train; to fit its unit costs to the frames, \
             run `entire calibrate --data TABLE.csv --prior {0} --out FILE.safetensors`",
            path.display()
        );
        let mut layout = Layout::of_model(&model).with_context(|| format!("{}", path.display()))?;
        let net = prednet_of(&model)?;
        let settings = Settings { target: net.target, ..self.settings()? };
        let inputs = rows(&layout, context, parts)?;
        ensure!(!(context.stop)(), NOTHING_LEARNED);
        let samples = samples(&inputs, parts.map(|part| part.seconds));
        let (network, standardization) = (Network::from_parts(net)?, Some(Standardization::of(net)));
        let (tuned, history, outcome) = run_training(context, network, standardization, samples, &settings)?;
        if layout.range.is_some() {
            layout.widen(&inputs[0], layout.width());
        }
        self.store(&mut file, tuned, &layout)?;
        Ok(FittedModel {
            file,
            what: "PredNet, fine-tuned".into(),
            settings: json!({
                "fine_tuned_from": path.file_name().map(|n| n.to_string_lossy()), "recipe": self.portable(),
            }),
            history,
            outcome,
        })
    }

    pub(super) fn store(&self, file: &mut ModelFile, mut parts: PredNetParts, layout: &Layout) -> Result<()> {
        for layer in &mut parts.layers {
            layer.dtype = self.dtype.storage();
        }
        Ok(layout.store(&parts, file)?)
    }
}
