//! Ships the models of a study: writes model files with their cards. The models are evaluated with the
//! weights as stored.

use crate::study::{
    Findings, Intervals, Runner, SELECTED, SENTENCE, STUDY_KEY, Set, SetTables, Ship, SplitResult, Study,
    judge as judge_split, shipped,
};
use anyhow::{Context, Result, ensure};
use entire_cli::calibrate::can_be_prior;
use entire_core::model::{GroupKind, Key, Model, ModelFile};
use entire_io::dataset::Table;
use entire_io::files::{make_folder, read_model_file, write_whole};
use entire_io::metrics::Metrics;
use entire_report::{Card, CardFigures};
use entire_steer::predict::AnalyticModel;
use entire_train::bound;
use entire_train::fit::{DtypeChoice, FitContext, predict};
use entire_train::inputs::prednet_of;
use serde_json::json;
use std::path::{Path, PathBuf};

/// A predictor to ship, with the errors of its stored weights.
struct Shipping<'a> {
    study: &'a Study,
    found: &'a Findings,
    set: &'a Set,
    predictor: &'a str,
    ship: &'a Ship,
    training: &'a [Table],
    figures: Vec<SplitResult>,
}

fn file_name(path: &Path) -> String {
    path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into_owned())
}

/// Writes every predictor that the study ships into a folder, each with its card; returns the files.
pub(crate) fn ship(
    folder: &Path,
    study: &Study,
    found: &Findings,
    runner: &Runner<'_>,
) -> Result<Vec<PathBuf>> {
    make_folder(folder)?;
    let mut out = Vec::new();
    for set in &study.sets {
        for ship in &study.ship {
            let predictor = shipped(study, found, &set.name, &ship.predictor)
                .with_context(|| format!("the rule selects nothing for {}", set.name))?;
            let Some(made) = found.files.iter().find(|f| f.0 == set.name && f.1 == predictor) else {
                // Only some sets have a distilled network.
                let elsewhere = found.files.iter().any(|f| f.1 == predictor);
                ensure!(ship.predictor != SELECTED && elsewhere, "{predictor} was not made for {}", set.name);
                continue;
            };
            let (mut file, model) = read_model_file(&made.2)?;
            // Models of a group's machines other than the first are only priors. Priors must be analytic.
            let is_first = study.group(set).next().is_some_and(|first| first.name == set.name);
            if !is_first && AnalyticModel::from_model(&model)?.is_none() {
                continue;
            }
            let judged_as =
                model.prednet.as_ref().and_then(|p| p.layers.first()).map_or("F32", |l| l.dtype.into());
            store_as(&mut file, ship.dtype)?;
            // This also reads the tables of `bounds` and `other_steps`, of which only the names are used
            // here.
            let tables = SetTables::read(set)?;
            let crossed = found.crossed(&set.name, predictor).is_some();
            let figures = judge(&file, study, set, &tables, runner, crossed)?;
            let training = tables.training();
            let shipping = Shipping { study, found, set, predictor, ship, training, figures };
            let name = format!("{}-{}", set.name.replace(' ', "-"), ship.predictor.replace(' ', "-"));
            provenance(&mut file, &shipping)?;
            let path = folder.join(format!("{name}.safetensors"));
            write_whole(&path, &file.to_bytes()?)?;
            let card = card(&name, &file, &shipping, judged_as)?.to_markdown();
            write_whole(&path.with_extension("md"), card.as_bytes())?;
            out.push(path);
        }
    }
    Ok(out)
}

/// Changes the storage format of the network's weights.
fn store_as(file: &mut ModelFile, dtype: DtypeChoice) -> Result<()> {
    let model = file.to_model()?;
    let mut parts = prednet_of(&model)?.clone();
    for layer in &mut parts.layers {
        layer.dtype = dtype.storage();
    }
    let inputs = model.inputs.to_vec();
    file.set_prednet(&parts, &inputs)?;
    Ok(())
}

fn judge(
    file: &ModelFile,
    study: &Study,
    set: &Set,
    tables: &SetTables,
    runner: &Runner<'_>,
    crossed: bool,
) -> Result<Vec<SplitResult>> {
    let model = file.to_model()?;
    let upper = bound::of(&model);
    let hidden = indicatif::ProgressBar::hidden();
    let context = FitContext { tables: &tables.tables, pool: runner.pool, bar: &hidden, stop: runner.stop };
    let mut out = Vec::new();
    for (split, part) in set.splits.iter().zip(tables.splits(study.clock.parse()?)) {
        let predicted = predict(&model, &context, &part.frames)?;
        // A bound is not tested on the frames that it was fitted to.
        let upper = upper.filter(|_| crossed || !set.bounds_are_of(split));
        let result = judge_split(&set.name, &split.name, "shipped", "", &part, &predicted, upper.as_ref());
        out.push(result.context("a split has no frames")?);
    }
    Ok(out)
}

fn provenance(file: &mut ModelFile, of: &Shipping<'_>) -> Result<()> {
    let Shipping { study, found, set, predictor, training, figures, .. } = of;
    // A model file that the study names as predictor keeps the training data that the file states.
    let as_it_is =
        study.predictors.iter().any(|p| p.name == *predictor && p.recipe_for(&set.name).file.is_some());
    let mut stored: serde_json::Value = match file.metadata.get(Key::Provenance.name()) {
        Some(text) => serde_json::from_str(text)?,
        None => json!({}),
    };
    stored["paper"] = json!("ENTIRE: Learning-based Volume Rendering Time Prediction");
    stored["clock"] = json!(study.clock);
    stored["shading"] =
        json!(training.iter().flat_map(|t| &t.frames).next().map(|f| f.scene.shading.to_string()));
    if !as_it_is || stored.get("data").is_none() {
        stored["data"] = training
            .iter()
            .map(|t| {
                let hash = format!("{:016x}", t.hash);
                json!({ "file": file_name(&t.path), "fnv1a": hash, "frames": t.frames.len() })
            })
            .collect();
    }
    let crossed = found.crossed(&set.name, predictor);
    stored["bounds_from"] = match crossed {
        Some(_) => json!("cross-validation"),
        None => set.bounds.iter().map(|p| json!(file_name(p))).collect(),
    };
    stored["cross_validated"] =
        json!(crossed.map(|(m, _)| json!({ "rmse_over_sd": m.rmse_over_sd, "mdape": m.mdape })));
    stored["figures"] = figures
        .iter()
        .zip(&set.splits)
        .map(|(f, split)| {
            let tables: Vec<String> = split.tables.iter().map(|t| file_name(t)).collect();
            json!({ "split": f.split, "tables": tables, "frames": f.metrics.frames,
                "rmse_over_sd": f.metrics.rmse_over_sd, "mdape": f.metrics.mdape, "r2_log": f.metrics.r2_log,
                "coverage": f.bound.map(|b| b.coverage) })
        })
        .collect();
    file.metadata.insert(Key::Provenance.into(), stored.to_string());
    entire_io::clock::set(file, study.clock.parse()?);
    file.metadata.remove(STUDY_KEY);
    if let Some(manifest) = training.iter().find_map(|t| t.manifest.as_ref()) {
        file.metadata.insert(Key::Renderer.into(), manifest.renderer.clone());
        file.metadata.insert(Key::Device.into(), manifest.device.clone());
        file.metadata.insert(Key::StepReference.into(), manifest.step_reference.clone());
    }
    Ok(())
}

/// Returns the card of a model. `judged_as`: storage format of the weights whose latency was measured.
fn card(name: &str, file: &ModelFile, of: &Shipping<'_>, judged_as: &str) -> Result<Card> {
    let Shipping { study, found, set, predictor, ship, training, figures } = of;
    let model = file.to_model()?;
    let stored: serde_json::Value =
        serde_json::from_str(model.metadata.get(Key::Provenance.name()).map_or("{}", String::as_str))
            .unwrap_or_default();
    let text = |key: &str| stored.get(key).and_then(|v| v.as_str()).unwrap_or("not known").to_owned();
    let shading = text("shading");
    let adapt = if can_be_prior(file) {
        format!("calibrate --data FRAMES.csv --shade {shading} --prior models/{name}.safetensors")
    } else {
        format!("train --data FRAMES.csv --fine-tune models/{name}.safetensors")
    };
    let distilled: Vec<_> =
        stored["data"].as_array().into_iter().flatten().filter(|d| d["renderer"] == "teacher").collect();
    let crossed = found.crossed(&set.name, predictor);
    let judged = judged(of, !distilled.is_empty(), judged_as, name);
    Ok(Card {
        name: name.into(),
        what: text("what"),
        dtype: ship.dtype.storage().to_string(),
        adapt: (
            vec![format!(
                "`entire calibrate --shade {shading}` makes a model of your machine in a minute and a half. To \
                 measure frames first and adapt this model to them:"
            )],
            vec![
                format!("entire collect VOLUMES --shade {shading} --frames 10 --repeats 3 --out FRAMES.csv"),
                format!("entire {adapt} --out here.safetensors"),
                "entire evaluate --data OTHER.csv --model here.safetensors".into(),
            ],
        ),
        shading: Some(shading),
        inputs: model.inputs.iter().map(|group| (group.name.to_string(), group.size)).collect(),
        scene_features: model.scene_features.iter().map(ToString::to_string).collect(),
        probe_side: entire_steer::predict::InputLayout::of_model(&model)?.probe_side,
        data: data_of(set, training, &distilled, &model, crossed.map(|(_, folds)| folds)),
        volumes: vec![VOLUMES.into()],
        split: vec![SPLITS.into()],
        outcome: text("outcome"),
        clock: study.clock.clone(),
        settings: serde_json::to_string_pretty(&stored["settings"]).unwrap_or_default(),
        training: Vec::new(),
        figures: figures.iter().map(|f| row(f, found.noise_mdape(&set.name, &f.split))).collect(),
        notes: judged,
        limits: if model.scene_features.is_empty() {
            "The network describes a volume by the two features of its VolumeNet. Predictions for volumes \
             unlike the training volumes may have large errors."
        } else {
            "Predictions for scenes unlike the training data (far larger images, other steps) may have large \
             errors."
        }
        .into(),
    })
}

/// Origin and license of the training volumes.
const VOLUMES: &str = "Volumes: the castro_blast, nyx_cosmology and maestroex_bubbles ensembles, enlarged \
    trilinearly by a factor of two per axis. They were computed for this project and are under its licenses (MIT \
    or Apache-2.0, see data/README.md). Scans and other codes were used for evaluation alone. The weights are \
    under the project's licenses.";

/// Parts of the data.
const SPLITS: &str = "The training volumes are the even time steps of castro_blast m01 and m02, nyx_cosmology \
    m01 and m02, and maestroex_bubbles m01. The error on a tenth of these volumes decides when the training of a \
    network stops (of a distilled network: the error on one volume). The split *member* has other members, with \
    other seeds and physical parameters. *Time step* has odd time steps of the training members, *ray step* \
    other ray steps, *modality* scans, *other codes* simulations by other codes, *camera inside* cameras inside \
    the volume, and *renderer changed* frames of an earlier raycaster. The renderer's Vulkan driver is a software \
    driver.";

/// Returns the list of training data on a card. `distilled`: random frames with a teacher's predictions;
/// `folds`: number of folds if the upper bound is that of cross-validated predictions.
fn data_of(
    set: &Set,
    training: &[Table],
    distilled: &[&serde_json::Value],
    model: &Model,
    folds: Option<usize>,
) -> Vec<String> {
    let teacher = |d: &&serde_json::Value| {
        let word = |key: &str| d[key].as_str().unwrap_or("not known");
        let [device, file, hash] = ["device", "file", "fnv1a"].map(word);
        format!(
            "distilled: {} random frames of the training volumes (seed {}), which were not rendered: their \
             seconds are predictions of {device} (`{file}`, FNV-1a {hash}; `make distill` makes this file)",
            d["frames"], d["seed"]
        )
    };
    let measured = |t: &Table| {
        let made = t.manifest.as_ref().map_or(String::new(), |m| {
            format!("; {} on {}; {}; {}", m.renderer, m.device, m.machine, m.created)
        });
        let (name, hash) = (file_name(&t.path), t.hash);
        format!("training: `data/timings/{name}`, {} frames, FNV-1a {hash:016x}{made}", t.frames.len())
    };
    let mut out: Vec<String> = distilled.iter().map(teacher).collect();
    if distilled.is_empty() {
        out.extend(training.iter().map(measured));
    }
    if model.input_size(GroupKind::SceneFeatures).is_some() {
        let other = |path: &PathBuf| format!("training, other ray steps: `data/timings/{}`", file_name(path));
        out.extend(set.other_steps.iter().map(other));
    }
    match folds {
        Some(folds) => out.push(format!(
            "upper bound: fitted to cross-validated predictions of the training frames ({folds} folds, ensemble \
             members held out)"
        )),
        None => out.extend(set.bounds.iter().map(|path| {
            let name = file_name(path);
            format!("only for the upper bound: `data/timings/{name}`; weights were not fitted to these frames")
        })),
    }
    out
}

/// Returns a row of a card's table of errors.
fn row(f: &SplitResult, noise: f64) -> CardFigures {
    let (i, m) = (f.intervals.as_ref(), &f.metrics);
    CardFigures {
        part: f.split.clone(),
        metrics: m.clone(),
        with_intervals: [Intervals::beside_rmse(i, m), Intervals::beside_mdape(i, m)],
        below_bound: f.bound.as_ref().map(|b| [b.coverage, b.slowest_coverage]),
        noise: Some(noise),
    }
}

/// Returns the paragraphs after a card's table of errors.
fn judged(of: &Shipping<'_>, distilled: bool, judged_as: &str, name: &str) -> Vec<String> {
    let Shipping { study, found, set, predictor, ship, .. } = of;
    let mut out = vec![
        "An interval in parentheses contains 90 % of the values of 200 random draws of the volumes, with \
         replacement."
            .to_owned(),
    ];
    let fit = found.fit(&set.name, predictor);
    if let Some(f) = fit {
        let of = |m: &Metrics, i: Option<&Intervals>| {
            let (rmse, mdape) = (Intervals::beside_rmse(i, m), Intervals::beside_mdape(i, m));
            format!("RMSE/SD {rmse}, median error {mdape} %")
        };
        let what = if distilled { "measured frames of its training volumes" } else { "its training frames" };
        let text = "in cross-validation on these frames, with ensemble members held out";
        let crossed = found
            .crossed(&set.name, predictor)
            .map_or(String::new(), |(m, _)| format!("; {text}: {}", of(m, f.crossed_intervals.as_ref())));
        out.push(format!("On {what}: {}{crossed}.", of(&f.seen, f.seen_intervals.as_ref())));
    }
    if ship.predictor == SELECTED {
        let numbers = fit.map_or(0, |f| f.numbers);
        out.push(format!("The rule selects `{predictor}` ({numbers} fitted parameters). {SENTENCE}"));
    }
    if let Some(l) = found.latency(&set.name, predictor) {
        let (machine, cold, warm) = (entire_io::machine::machine(), 1e6 * l.cold, 1e6 * l.warm);
        let more = if l.transfer > 0.0 {
            format!("; {:.0} µs more for a new transfer function", 1e6 * l.transfer)
        } else {
            String::new()
        };
        out.push(format!(
            "Time of one prediction, scene features included, weights as {judged_as}, on {machine}: {cold:.1} µs \
             with cold caches, {warm:.1} µs with warm caches{more}."
        ));
    }
    let tables = set.splits.iter().flat_map(|s| &s.tables);
    let tables: Vec<String> = tables.map(|t| format!("data/timings/{}", file_name(t))).collect();
    out.push(format!(
        "`make models` makes this file and its figures again. For one split: `entire evaluate --clock {} \
         --model models/{name}.safetensors --data {}` (or with another table: {}).",
        study.clock,
        tables.first().map_or("", String::as_str),
        tables.join(", ")
    ));
    out
}
