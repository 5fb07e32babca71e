//! `entire train`: train or fine-tune a predictor on collected frames.

use anyhow::{Context, Result, ensure};
use entire_core::model::{GroupKind, Key, Model};
use entire_io::clock::{ClockChoice, clock_parser};
use entire_io::dataset::{
    Clock, NoiseFloor, Table, Timed, TimedFrame, left_out, manifests_of, mixed, noise_floor, open_tables,
    shaded, timed,
};
use entire_io::files::{check_model_out, ensure_not_input, note, open_model, write_whole};
use entire_io::metrics::Metrics;
use entire_io::options::{names_software, thread_pool};
use entire_io::progress::{INPUTS_BAR, templated_bar};
use entire_io::{interrupt, machine};
use entire_report::{Card, CardFigures};
use entire_steer::predict::{UPPER_LEVEL, UpperBound};
use entire_train::bound;
use entire_train::fit::{DtypeChoice, FitContext, FittedModel, Kind, Recipe, predict_rows};
use entire_train::inputs::Layout;
use entire_train::split::{GroupBy, Part, Split};
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use rand::seq::SliceRandom;
use serde_json::json;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Display, PathBuf};
use std::time::Instant;

/// Train or fine-tune a predictor on collected frames.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  entire train --data frames.csv --out model.safetensors
        a small network on scene features, log seconds, split by ensemble member
  entire train --data frames.csv --out paper.safetensors --preset 12C256 \\
      --target seconds --volumenet models/volumenet-128f2.safetensors \\
      --inputs volume_features,camera,resolution,transfer_function
        the paper's configuration
  entire train --data new-machine.csv --out tuned.safetensors \\
      --fine-tune model.safetensors --learning-rate 1e-4
  entire train --data frames.csv --out residual.safetensors \\
      --model-kind residual --layers 32
        unit costs times a learned factor")]
pub(crate) struct Options {
    /// Timing tables of `entire collect` or of any program that writes the same format.
    #[arg(long, required = true, num_args = 1.., value_name = "CSV")]
    pub(crate) data: Vec<PathBuf>,
    /// Model file to write; its model card is written beside it as Markdown.
    #[arg(long, value_name = "SAFETENSORS")]
    pub(crate) out: PathBuf,
    /// The model, and its training.
    #[command(flatten)]
    pub(crate) recipe: Recipe,
    /// Start from this model: its layers, inputs, target and standardization stay, and training continues
    /// from its weights.
    #[arg(long, value_name = "SAFETENSORS")]
    pub(crate) fine_tune: Option<PathBuf>,
    /// Model file with the VolumeNet that computes volume features. The VolumeNet is copied into the new
    /// file.
    #[arg(long, value_name = "SAFETENSORS", conflicts_with = "fine_tune")]
    pub(crate) volumenet: Option<PathBuf>,
    /// Group of frames that stays together in the 80/10/10 split into training, validation and test frames.
    #[arg(long, value_enum, default_value_t = GroupBy::Member)]
    pub(crate) split: GroupBy,
    /// Members or volumes (see --split) for validation. With neither this option nor --test-groups, a random
    /// tenth of the groups is used for validation and another tenth for testing. With only one of the two
    /// options, the other part is empty.
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    pub(crate) validation_groups: Vec<String>,
    /// Members or volumes for testing; see --validation-groups.
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    pub(crate) test_groups: Vec<String>,
    /// Clock of the learned seconds. Default: the clock that the model of --fine-tune states; without such a
    /// model, auto for frames of a GPU and cpu (processor time) for other frames. If some frame has no time
    /// by the default clock, auto is used instead.
    #[arg(long, value_parser = clock_parser())]
    pub(crate) clock: Option<ClockChoice>,
    /// Only frames with this shading: none, local, scatter or local-scatter.
    #[arg(long)]
    pub(crate) shade: Option<entire_core::scene::Shading>,
    /// Use at most this many training frames, a random choice by --seed.
    #[arg(long, value_name = "FRAMES")]
    pub(crate) limit: Option<usize>,
    /// Storage format of weights.
    #[arg(long, value_enum, default_value_t = DtypeChoice::F32)]
    pub(crate) dtype: DtypeChoice,
    /// Folder of the tables' volumes, if it is neither the working folder nor the folder of the table.
    #[arg(long, value_name = "FOLDER")]
    pub(crate) root: Option<PathBuf>,
    /// Number of threads; default: one per logical processor.
    #[arg(long)]
    pub(crate) threads: Option<usize>,
}

/// Standard deviation of ln(median time of a frame's repeats) above which a note says that the data are
/// noisy.
const NOISE_LIMIT: f64 = 0.2;

pub(crate) fn run(options: &Options) -> Result<()> {
    let started = Instant::now();
    check_model_out(&options.out)?;
    let bases = options.fine_tune.iter().chain(&options.volumenet);
    ensure_not_input(&options.out, bases.map(PathBuf::as_path)).context("--out")?;
    let recipe = Recipe {
        volumenet: options.volumenet.clone(),
        fine_tune: options.fine_tune.clone(),
        dtype: options.dtype,
        ..options.recipe.clone()
    };
    check_used(&recipe)?;
    let pool = thread_pool(options.threads)?;
    let tables = open_tables(&options.data, options.root.as_deref())?;
    let base = options.fine_tune.as_deref().map(|path| anyhow::Ok((path.display(), open_model(path)?)));
    let base = base.transpose()?;
    let clock = learned_clock(options, &tables, base.as_ref())?;
    let frames = timed(&tables, clock, options.shade)?;
    if let Some(text) = left_out(&tables, clock, options.shade) {
        note(&text);
    }
    let (validation, test, seed) = (&options.validation_groups, &options.test_groups, options.recipe.seed);
    let split = Split::new(frames.iter().map(|f| f.0), options.split, validation, test, seed)?;
    let seconds: BTreeMap<(usize, u64), f64> =
        frames.iter().map(|(f, t)| ((f.table, f.number), *t)).collect();
    let refs: Vec<&TimedFrame> = frames.iter().map(|f| f.0).collect();
    let manifests = manifests_of(&tables, &refs);
    if let Some(text) = mixed(&manifests) {
        note(&text);
    }
    let mut parts = split.divide(&refs);
    if let Some(limit) = options.limit {
        ensure!(limit > 0, "--limit is 0; at least 1 training frame is needed");
        if let Some(training) = parts.get_mut(&Part::Training) {
            training.shuffle(&mut ChaCha8Rng::seed_from_u64(options.recipe.seed));
            training.truncate(limit);
        }
    }
    let part = |p: Part| parts.get(&p).map_or(&[][..], Vec::as_slice);
    note(&format!(
        "{} frames, split by {}: {} for training, {} for validation, {} for testing",
        refs.len(),
        split.by.name(),
        part(Part::Training).len(),
        part(Part::Validation).len(),
        part(Part::Test).len()
    ));
    if split.validation.is_empty() {
        note(&match split.test.is_empty() {
            true => format!(
                "fewer than three {}s, so all frames are used for training and none is held out; test on \
                 other data",
                split.by.name()
            ),
            false => "no --validation-groups: the training frames decide when training stops, and the upper \
                      bound is fitted to them. More than 5 % of other frames may exceed this bound"
                .to_owned(),
        });
    }
    let mut earlier = base.as_ref().map_or(Vec::new(), |(_, model)| Split::all_of(model));
    // Models that this model learns from, without a statement of their training data.
    let mut unknown: Vec<String> = Vec::new();
    if let (Some((name, _)), true) = (&base, earlier.is_empty()) {
        unknown.push(name.to_string());
    }
    let tested = refs.iter().filter(|f| split.part(&f.scene) == Part::Test);
    let seen: BTreeSet<String> = tested
        .filter(|f| earlier.iter().any(|split| split.has_seen(&f.scene)))
        .map(|f| split.by.group(&f.scene))
        .collect();
    let leak = (!seen.is_empty()).then(|| {
        let names = seen.into_iter().collect::<Vec<_>>().join(", ");
        format!("the model to fine-tune was trained or validated on test groups: {names}")
    });
    if let Some(text) = &leak {
        note(&format!("{text}; their errors are not those of unseen data"));
    }
    // The times that a teacher gave contain what it learned from its own training frames.
    for teacher in manifests.iter().map(|m| &m.settings["teacher"]).filter(|t| !t.is_null()) {
        let splits: Vec<Split> = serde_json::from_value(teacher["splits"].clone()).unwrap_or_default();
        if splits.is_empty() {
            unknown.push(teacher["file"].as_str().unwrap_or("the teacher").to_owned());
        }
        for split in splits {
            if !earlier.contains(&split) {
                earlier.push(split);
            }
        }
    }
    unknown.sort();
    unknown.dedup();
    for name in &unknown {
        note(&format!(
            "{name} does not state its training data, so it may have been trained on the test frames"
        ));
    }
    let part_seconds =
        |p: Part| -> Vec<f64> { part(p).iter().map(|f| seconds[&(f.table, f.number)]).collect() };

    // Ctrl-C stops the training of networks, which keep what they learned. Before this training, there is
    // nothing to keep: Ctrl-C ends the program at once, and no file is written.
    let stop = || interrupt::flag().is_ok_and(|flag| interrupt::requested(&flag));
    let bar = templated_bar("epoch {msg} [{bar:30}] {eta} left");
    let context = FitContext { tables: &tables, pool: &pool, bar: &bar, stop: &stop };
    let (training, validation) = (part_seconds(Part::Training), part_seconds(Part::Validation));
    let training = Timed { frames: part(Part::Training), seconds: &training };
    let validation = Timed { frames: part(Part::Validation), seconds: &validation };
    let mut fitted = recipe.make(&context, training, validation)?;
    bar.finish_and_clear();
    // The metrics are those of the stored model, with its weights in their storage format.
    let model = fitted.file.to_model()?;
    let layout = Layout::of_model(&model)?;
    let mut results = Vec::new();
    let mut upper = UpperBound::default();
    let mut covered = BTreeMap::new();
    for p in [Part::Validation, Part::Training, Part::Test] {
        let bar = templated_bar(INPUTS_BAR);
        let rows = layout.rows(&tables, part(p), &pool, &bar)?;
        bar.finish_and_clear();
        let predicted = predict_rows(&model, &layout, &rows, None)?;
        let measured = part_seconds(p);
        if let Some(metrics) = Metrics::new(&predicted, &measured) {
            results.push((p, metrics));
            // The bound is fitted to the validation frames, to which the weights were not fitted; if there
            // are none, it is fitted to the training frames.
            if upper.log_factor.is_nan() {
                upper = bound::from_predictions(&predicted, &measured);
            }
            covered.insert(p.name(), bound::judge(&upper, &predicted, &measured).map(|b| b.coverage));
        }
    }
    results.sort_by_key(|r| r.0);
    upper.store(&mut fitted.file)?;
    let noise = noise_floor(refs.iter().copied(), clock, |f| tables[f.table].passes());
    if let Some(n) = noise.filter(|n| n.log_sd_of_median > NOISE_LIMIT) {
        let other = if clock == Clock::Cpu { "" } else { ", or try --clock cpu" };
        note(&format!(
            "repeats of one frame differ by {:.0} %; collect on a quieter machine, with more \
             --repeats{other}",
            100.0 * (n.log_sd.exp() - 1.0)
        ));
    }
    let provenance = json!({
        "what": fitted.what,
        "paper": "ENTIRE: Learning-based Volume Rendering Time Prediction",
        "data": tables.iter().map(|t| json!({
            "file": t.path.file_name().map(|n| n.to_string_lossy()),
            "fnv1a": format!("{:016x}", t.hash),
            "frames": t.frames.len(),
            "renderer": t.manifest.as_ref().map(|m| &m.renderer),
            "device": t.manifest.as_ref().map(|m| &m.device),
            "measured_on": t.manifest.as_ref().map(|m| &m.machine),
            "created": t.manifest.as_ref().map(|m| &m.created),
            "seed": t.manifest.as_ref().map(|m| m.seed),
        })).collect::<Vec<_>>(),
        "clock": clock.name(),
        "shading": options.shade.map(|s| s.to_string()),
        "split": split,
        "earlier_splits": earlier,
        "training_frames": part(Part::Training).len(),
        "settings": fitted.settings,
        "outcome": fitted.outcome,
        "metrics": results.iter().map(|(p, m)| (p.name(), m)).collect::<BTreeMap<_, _>>(),
        "upper_bound": {
            "level": UPPER_LEVEL, "log_factor": f64::from(upper.log_factor), "coverage": covered,
        },
        "noise_floor": noise,
        "trained_on": machine::machine(),
        "program": format!("entire {}", machine::version()),
        "date": machine::now(),
    });
    fitted.file.metadata.insert(Key::Provenance.into(), provenance.to_string());
    entire_io::clock::set(&mut fitted.file, clock);
    // A fine-tuned model still has the quality law and the renderer's names from its earlier training.
    for key in [Key::Quality, Key::Renderer, Key::Device, Key::StepReference] {
        fitted.file.metadata.remove(key.name());
    }
    // Test frames may be of another renderer.
    if let Some(manifest) = manifests_of(&tables, part(Part::Training)).first() {
        fitted.file.metadata.insert(Key::Renderer.into(), manifest.renderer.clone());
        fitted.file.metadata.insert(Key::Device.into(), manifest.device.clone());
        fitted.file.metadata.insert(Key::StepReference.into(), manifest.step_reference.clone());
    }
    write_whole(&options.out, &fitted.file.to_bytes()?)?;
    let held = covered.get(Part::Test.name()).copied().flatten();
    let tested = match (split.test.is_empty(), leak) {
        (true, _) => {
            "Nothing was held out for testing, so the errors above are not those of unseen data.".into()
        }
        (false, Some(text)) => format!("The errors above are not those of unseen data: {text}."),
        (false, None) if !unknown.is_empty() => format!(
            "{} does not state its training data, so it may have been trained on the test groups.",
            unknown.join(", ")
        ),
        (false, None) => "Test groups were not used in training.".into(),
    };
    let made = (&fitted, &layout, clock);
    let card = card(options, made, (&split, &tested), &tables, &results, (upper, held), noise.as_ref());
    write_whole(&options.out.with_extension("md"), card.to_markdown().as_bytes())?;
    for (p, m) in &results {
        let [rmse, over_sd, mae, median, p95, r2_log] = figures(m);
        println!(
            "{:<10} {:>6} frames  RMSE {rmse} s ({over_sd} SD)  MAE {mae} s  median error {median} %  p95 \
             {p95} %  R2(log) {r2_log}",
            p.name(),
            m.frames
        );
    }
    if let Some(n) = noise {
        println!("noise floor: {}", n.describe());
    }
    println!(
        "{}; wrote {} in {:.1} s",
        fitted.outcome,
        options.out.display(),
        started.elapsed().as_secs_f64()
    );
    Ok(())
}

/// Returns the requested clock, else the clock of the model that training starts from, else `auto` for
/// frames of a GPU and processor time for others, as [`entire_io::clock::for_training`] chooses.
fn learned_clock(options: &Options, tables: &[Table], base: Option<&(Display<'_>, Model)>) -> Result<Clock> {
    let base = base.and_then(|(name, model)| Some((name.to_string(), entire_io::clock::of(model)?)));
    let base = base.as_ref().map(|(name, clock)| (name.as_str(), *clock));
    // On a GPU, processor time is only that of the thread that waits.
    let frames: Vec<&TimedFrame> = shaded(tables, options.shade).collect();
    let on_gpu = manifests_of(tables, &frames)
        .iter()
        .any(|m| m.renderer == "vulkan" && !names_software(&m.renderer, &m.device));
    let asked = options.clock.or((base.is_none() && on_gpu).then_some(None));
    entire_io::clock::for_training(asked, base, shaded(tables, options.shade))
}

/// Refuses options without effect: --target for residual networks, and options of input groups that the
/// model does not take.
fn check_used(recipe: &Recipe) -> Result<()> {
    ensure!(
        recipe.kind != Kind::Residual || recipe.target == Recipe::default().target,
        "--target is only for --model-kind prednet, since a residual network learns ratios of times; leave \
         --target out"
    );
    for (option, given, group) in [
        ("--scene-features", !recipe.scene_features.is_empty(), GroupKind::SceneFeatures),
        ("--probe-side", recipe.probe_side.is_some(), GroupKind::SceneFeatures),
        ("--sorted-lobes", recipe.sorted_lobes, GroupKind::TransferFunction),
        ("--volumenet", recipe.volumenet.is_some(), GroupKind::VolumeFeatures),
    ] {
        ensure!(
            !given || recipe.inputs.iter().any(|name| name.trim() == group.name()),
            "{option} has no effect without the input group {group}; leave {option} out, or name the group \
             in --inputs"
        );
    }
    Ok(())
}

/// Returns RMSE, RMSE/SD, mean absolute error, median error and 95th percentile in %, R² of the logarithms.
fn figures(m: &Metrics) -> [String; 6] {
    let [rmse, mae] = [m.rmse, m.mae].map(|seconds| format!("{seconds:.3e}"));
    let [median, p95] = [format!("{:.2}", 100.0 * m.mdape), format!("{:.1}", 100.0 * m.p95)];
    [rmse, format!("{:.3}", m.rmse_over_sd), mae, median, p95, format!("{:.4}", m.r2_log)]
}

/// Returns the model card.
fn card(
    options: &Options,
    (fitted, layout, clock): (&FittedModel, &Layout, Clock),
    (split, tested): (&Split, &str),
    tables: &[Table],
    results: &[(Part, Metrics)],
    (upper, covered): (UpperBound, Option<f64>),
    noise: Option<&NoiseFloor>,
) -> Card {
    let name = options.out.file_stem().map_or("model".into(), |n| n.to_string_lossy());
    let table = |t: &Table| {
        let file = t.path.file_name().map_or("?".into(), |n| n.to_string_lossy());
        let origin = match &t.manifest {
            Some(m) => format!(
                ": {} on {}; {}; {}; seed {}, {} repeats each",
                m.renderer, m.device, m.machine, m.created, m.seed, m.repeats
            ),
            None => "; machine and renderer are not known, since there is no manifest".to_owned(),
        };
        format!("`{file}` ({} frames, FNV-1a {:016x}){origin}", t.frames.len(), t.hash)
    };
    let groups = [("training", &split.training), ("validation", &split.validation), ("test", &split.test)];
    let groups = groups.map(|(part, groups)| {
        let list = groups.iter().map(String::as_str).collect::<Vec<_>>().join(", ");
        format!("- {part}: {}", if list.is_empty() { "none" } else { &list })
    });
    let limited = options.limit.map(|l| format!("Of the training frames, at most {l} were used."));
    let loss = fitted.history.first().zip(fitted.history.last()).map(|(first, last)| {
        format!(
            "Loss{} (training, validation): {:.4e}, {:.4e} after epoch 1; {:.4e}, {:.4e} after epoch {}.",
            if options.recipe.ensemble > 1 { " of network 1" } else { "" },
            first.training_loss,
            first.validation_loss,
            last.training_loss,
            last.validation_loss,
            last.epoch
        )
    });
    let bound = upper.log_factor.is_finite().then(|| {
        format!(
            "Upper bound of level {UPPER_LEVEL}: {:.2} times the prediction, computed from the validation \
             frames (from the training frames if there are no validation frames){}.",
            upper.factor().max(1.0),
            covered.map_or(String::new(), |c| format!(
                "; {:.1} % of the test frames took less than this bound",
                100.0 * c
            ))
        )
    });
    let floor = match noise {
        Some(n) => format!(
            "Noise floor: {}. Due to this noise, a perfect predictor would have a median error of {:.1} %.",
            n.describe(),
            100.0 * n.mdape()
        ),
        None => "Noise floor: unknown, since no frame was repeated.".to_owned(),
    };
    let row = |(part, m): &(Part, Metrics)| {
        let [_, over_sd, _, median, ..] = figures(m);
        CardFigures {
            part: part.name().into(),
            metrics: m.clone(),
            with_intervals: [over_sd, median],
            below_bound: None,
            noise: None,
        }
    };
    Card {
        what: fitted.what.clone(),
        dtype: options.recipe.dtype.storage().to_string(),
        shading: options.shade.map(|s| s.to_string()),
        adapt: (
            vec!["To adapt the model to another machine, driver or renderer:".into()],
            vec![
                format!(
                    "entire train --data FRAMES.csv --fine-tune {name}.safetensors --out here.safetensors"
                ),
                "entire evaluate --data OTHER.csv --model here.safetensors".into(),
            ],
        ),
        inputs: layout.groups.iter().map(|(group, size)| (group.to_string(), *size)).collect(),
        scene_features: layout.scene_features.iter().map(ToString::to_string).collect(),
        probe_side: layout.probe_side(),
        data: tables.iter().map(table).collect(),
        volumes: options.shade.map(|s| format!("Only frames with shading {s}.")).into_iter().collect(),
        split: [
            format!("By {}, never by frame; seed {}.", split.by.name(), options.recipe.seed),
            groups.join("\n"),
        ]
        .into_iter()
        .chain(limited)
        .collect(),
        outcome: fitted.outcome.clone(),
        clock: clock.name().into(),
        settings: serde_json::to_string_pretty(&fitted.settings).unwrap_or_default(),
        training: loss.into_iter().collect(),
        figures: results.iter().map(row).collect(),
        notes: bound.into_iter().chain([floor]).collect(),
        limits: format!(
            "Predictions for scenes unlike the training data (other modalities, sizes, shading modes, steps) \
             may have large errors. {tested}"
        ),
        name: name.into(),
    }
}
