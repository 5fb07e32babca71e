//! Ships the models of a study: writes model files with their cards. The models are evaluated with the
//! weights as stored.

use crate::study::{
    Findings, Intervals, Runner, SELECTED, SENTENCE, STUDY_KEY, Set, SetTables, Ship, SplitResult, Study,
    judge as judge_split, shipped,
};
use anyhow::{Context, Result, ensure};
use entire_cli::calibrate::can_be_prior;
use entire_core::model::{GroupKind, Key, ModelFile};
use entire_io::dataset::Table;
use entire_io::files::{make_folder, read_model_file, write_whole};
use entire_io::metrics::{BoundMetrics, Metrics};
use entire_steer::predict::AnalyticModel;
use entire_train::bound;
use entire_train::fit::{DtypeChoice, FitContext, predict};
use serde_json::json;
use std::fmt::Write as _;
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
            write_whole(&path.with_extension("md"), card(&name, &file, &shipping, judged_as)?.as_bytes())?;
            out.push(path);
        }
    }
    Ok(out)
}

/// Changes the storage format of the network's weights.
fn store_as(file: &mut ModelFile, dtype: DtypeChoice) -> Result<()> {
    let model = file.to_model()?;
    let mut parts = model.prednet.as_ref().context("the model file holds no PredNet")?.clone();
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
fn card(name: &str, file: &ModelFile, of: &Shipping<'_>, judged_as: &str) -> Result<String> {
    let Shipping { study, found, set, predictor, ship, training, figures } = of;
    let model = file.to_model()?;
    let stored: serde_json::Value =
        serde_json::from_str(model.metadata.get(Key::Provenance.name()).map_or("{}", String::as_str))
            .unwrap_or_default();
    let text = |key: &str| stored.get(key).and_then(|v| v.as_str()).unwrap_or("not known").to_owned();
    let shading = text("shading");
    let calibrate = if can_be_prior(file) {
        format!("calibrate --data FRAMES.csv --shade {shading} --prior models/{name}.safetensors")
    } else {
        format!("train --data FRAMES.csv --fine-tune models/{name}.safetensors")
    };
    let mut md = format!(
        "# {name}\n\n{}; weights stored as {}. Predicts the seconds of one frame with shading `{shading}` \
         before it is drawn.\n\n\
         ## Use\n\nThe model predicts the seconds of one machine and one renderer. `entire calibrate --shade \
         {shading}` makes a model of your machine in a minute and a half. To measure frames first and adapt \
         this model to them:\n\n\
         ```\nentire collect VOLUMES --shade {shading} --frames 10 --repeats 3 --out FRAMES.csv\n\
         entire {calibrate} --out here.safetensors\n\
         entire evaluate --data OTHER.csv --model here.safetensors\n```\n\n\
         `entire steer --model here.safetensors` uses the new model.\n\n## Inputs\n\n",
        text("what"),
        ship.dtype.storage()
    );
    for group in &model.inputs {
        let _ = writeln!(md, "- `{}`, {}", group.name, group.size);
    }
    if !model.scene_features.is_empty() {
        let _ = writeln!(
            md,
            "\nScene features, in order: {}. Rays along each side of the probe: {}.",
            model.scene_features.join(", "),
            entire_steer::predict::InputLayout::of_model(&model)?.probe_side
        );
    }
    let _ = writeln!(md, "\n## Data\n");
    let distilled: Vec<_> =
        stored["data"].as_array().into_iter().flatten().filter(|d| d["renderer"] == "teacher").collect();
    for d in &distilled {
        let word = |key: &str| d[key].as_str().unwrap_or("not known");
        let [device, file, hash] = ["device", "file", "fnv1a"].map(word);
        let _ = writeln!(
            md,
            "- distilled: {} random frames of the training volumes (seed {}), which were not rendered: \
             their seconds are predictions of {device} \
             (`{file}`, FNV-1a {hash}; `make distill` makes this file)",
            d["frames"], d["seed"]
        );
    }
    for t in training.iter().filter(|_| distilled.is_empty()) {
        let _ = writeln!(
            md,
            "- training: `data/timings/{}`, {} frames, FNV-1a {:016x}{}",
            file_name(&t.path),
            t.frames.len(),
            t.hash,
            t.manifest.as_ref().map_or(String::new(), |m| format!(
                "; {} on {}; {}; {}",
                m.renderer, m.device, m.machine, m.created
            ))
        );
    }
    if model.input_size(GroupKind::SceneFeatures).is_some() {
        for path in &set.other_steps {
            let _ = writeln!(md, "- training, other ray steps: `data/timings/{}`", file_name(path));
        }
    }
    let crossed = found.crossed(&set.name, predictor);
    if let Some((_, folds)) = crossed {
        let _ = writeln!(
            md,
            "- upper bound: fitted to cross-validated predictions of the training frames ({folds} folds, \
             ensemble members held out)"
        );
    }
    for path in set.bounds.iter().filter(|_| crossed.is_none()) {
        let _ = writeln!(
            md,
            "- only for the upper bound: `data/timings/{}`; weights were not fitted to these frames",
            file_name(path)
        );
    }
    let _ = writeln!(
        md,
        "\nVolumes: the castro_blast, nyx_cosmology and maestroex_bubbles ensembles, enlarged trilinearly by \
         a factor of two per axis. They were computed for this project and are under its licenses (MIT or \
         Apache-2.0, see data/README.md). Scans and other codes were used for evaluation alone. The weights \
         are under the project's licenses.\n\n\
         ## Splits\n\nThe training volumes are the even time steps of castro_blast m01 and m02, \
         nyx_cosmology m01 and m02, and maestroex_bubbles m01. The error on a tenth of these volumes decides \
         when the training of a network stops (of a distilled network: the error on one volume). The split \
         *member* has other members, with other seeds and physical parameters. *Time step* has odd time \
         steps of the training members, *ray step* other ray steps, *modality* scans, *other codes* \
         simulations by other codes, *camera inside* cameras inside the volume, and *renderer changed* \
         frames of an earlier raycaster.\n\n\
         ## Training\n\n{}. Clock: {}; a frame's time is the median of its repeats.\n\n```json\n{}\n```\n\n\
         ## Figures\n\nAn interval in parentheses contains 90 % of the values of 200 random draws of the \
         volumes, with replacement.\n\n\
         | split | frames | RMSE, ms | RMSE/SD | median error, % | p95, % | R² in log | below the upper bound, % | \
         … slowest tenth | median noise, % |\n\
         |---|---|---|---|---|---|---|---|---|---|",
        text("outcome"),
        study.clock,
        serde_json::to_string_pretty(&stored["settings"]).unwrap_or_default()
    );
    for f in figures {
        let m = &f.metrics;
        let held = |v: fn(&BoundMetrics) -> f64| {
            f.bound.as_ref().map_or("-".into(), |b| format!("{:.1}", 100.0 * v(b)))
        };
        let _ = writeln!(
            md,
            "| {} | {} | {:.2} | {} | {} | {:.1} | {:.4} | {} | {} | {:.1} |",
            f.split,
            m.frames,
            1e3 * m.rmse,
            Intervals::beside_rmse(f.intervals.as_ref(), m),
            Intervals::beside_mdape(f.intervals.as_ref(), m),
            100.0 * m.p95,
            m.r2_log,
            held(|b| b.coverage),
            held(|b| b.slowest_coverage),
            100.0 * found.noise_mdape(&set.name, &f.split)
        );
    }
    let fit = found.fit(&set.name, predictor);
    if let Some(f) = fit {
        let of = |m: &Metrics, i: Option<&Intervals>| {
            let (rmse, mdape) = (Intervals::beside_rmse(i, m), Intervals::beside_mdape(i, m));
            format!("RMSE/SD {rmse}, median error {mdape} %")
        };
        let what = if distilled.is_empty() {
            "its training frames"
        } else {
            "measured frames of its training volumes"
        };
        let _ = write!(md, "\nOn {what}: {}", of(&f.seen, f.seen_intervals.as_ref()));
        if let Some((m, _)) = crossed {
            let text = "in cross-validation on these frames, with ensemble members held out";
            let _ = write!(md, "; {text}: {}", of(m, f.crossed_intervals.as_ref()));
        }
        md += ".\n";
    }
    if ship.predictor == SELECTED {
        let numbers = fit.map_or(0, |f| f.numbers);
        let _ = writeln!(md, "\nThe rule selects `{predictor}` ({numbers} fitted parameters). {SENTENCE}");
    }
    if let Some(l) = found.latency(&set.name, predictor) {
        let (machine, cold, warm) = (entire_io::machine::machine(), 1e6 * l.cold, 1e6 * l.warm);
        let _ = write!(
            md,
            "\nTime of one prediction, scene features included, weights as {judged_as}, on {machine}: {cold:.1} µs \
             with cold caches, {warm:.1} µs with warm caches"
        );
        if l.transfer > 0.0 {
            let _ = write!(md, "; {:.0} µs more for a new transfer function", 1e6 * l.transfer);
        }
        md += ".\n";
    }
    let tables = set.splits.iter().flat_map(|s| &s.tables);
    let tables: Vec<String> = tables.map(|t| format!("data/timings/{}", file_name(t))).collect();
    let _ = writeln!(
        md,
        "\n`make models` makes this file and its figures again. For one split: `entire evaluate --clock {} \
         --model models/{name}.safetensors \
         --data {}` (or with another table: {}).",
        study.clock,
        tables.first().map_or("", String::as_str),
        tables.join(", ")
    );
    let _ = writeln!(
        md,
        "\n## Limits\n\nThe times are those of one renderer on one machine with a software Vulkan driver. On \
         another machine, calibrate first. {}",
        if model.scene_features.is_empty() {
            "The network describes a volume by the two features of its VolumeNet. Predictions for volumes unlike \
             the training volumes may have large errors."
        } else {
            "Predictions for scenes unlike the training data (far larger images, other steps) may have large \
             errors. The out-of-range score is above 0 if a scene feature lies outside the range of the training data."
        }
    );
    Ok(md)
}
