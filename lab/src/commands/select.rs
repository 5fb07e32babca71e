//! `entire-lab select`: no more than a scene needs: the cheapest predictor that is good enough, with the
//! inputs that it can do without left away.

use crate::latency::Bench;
use anyhow::{Context, Result, ensure};
use entire_cli::dataset::{Clock, noise_floor, read_tables};
use entire_cli::files::{check_model_out, write_whole};
use entire_cli::fit::{FitContext, FittedModel, Kind, Recipe, predict, standard_features};
use entire_cli::metrics::Metrics;
use entire_cli::options::thread_pool;
use entire_cli::progress::templated_bar;
use entire_cli::report::{Column, Table};
use entire_cli::split::TimedFrames;
use entire_cli::{bound, interrupt, machine};
use entire_core::model::Key;
use serde_json::json;
use std::path::PathBuf;

/// Find the cheapest predictor that is good enough for a data set, and the scene features that it can do
/// without.
///
/// A fifth of the ensemble members (of the volumes, where there are fewer than four members) is held out: one
/// half of it stops the training, the other one chooses, so that the errors shown are a little better than on
/// frames that had no say; judge what was chosen on other tables with `entire evaluate`. Candidates: the
/// analytic model, a log-linear one, networks that need no probe, networks on scene features and learned
/// factors on the analytic model, of growing size and on probes of growing fineness. The cheapest (cold
/// latency) within the tolerance of the best is taken; then features are dropped one after another, each time
/// the one that costs least, as long as the error stays within the tolerance.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  entire-lab select --data frames.csv --volume data/mr_banana.nrrd --out small.safetensors
  entire-lab select --data frames.csv --volume data/mr_banana.nrrd --tolerance 0.2 --out quick.safetensors")]
pub struct Options {
    /// Timing tables written by `entire collect`.
    #[arg(long, required = true, num_args = 1.., value_name = "CSV")]
    pub data: Vec<PathBuf>,
    /// A volume on which latencies are measured.
    #[arg(long, value_name = "VOLUME")]
    pub volume: PathBuf,
    /// Enlarge that volume by this factor.
    #[arg(long, default_value_t = 1, value_name = "FACTOR")]
    pub enlarge: usize,
    /// Model file to write.
    #[arg(long, value_name = "SAFETENSORS")]
    pub out: PathBuf,
    /// Share of the smallest error by which a predictor may be worse and still be good enough.
    #[arg(long, default_value_t = 0.05)]
    pub tolerance: f64,
    /// Rays along each side of the probes to try; what is not kept beside the tables is computed from the
    /// volumes.
    #[arg(long, value_delimiter = ',', value_name = "SIDES", default_value = "11")]
    pub probe_sides: Vec<usize>,
    /// Networks of other seeds whose mean is taken, for every candidate.
    #[arg(long, default_value_t = 1, value_name = "N")]
    pub ensemble: usize,
    /// The clock whose seconds are learned.
    #[arg(long, value_enum, default_value_t = Clock::Cpu)]
    pub clock: Clock,
    /// Passes over the training frames at most.
    #[arg(long, default_value_t = 150)]
    pub epochs: usize,
    /// Threads; all logical processors unless given.
    #[arg(long)]
    pub threads: Option<usize>,
}

struct Candidate {
    name: String,
    recipe: Recipe,
    fitted: FittedModel,
    metrics: Metrics,
    cold: f64,
}

/// Runs the command.
///
/// # Errors
/// When tables or the volume cannot be read, there are too few volumes to hold some out, or nothing fits the
/// budget.
pub fn run(options: &Options) -> Result<()> {
    check_model_out(&options.out)?;
    ensure!(
        options.tolerance.is_finite() && options.tolerance >= 0.0,
        "--tolerance is {}; it must be 0 or more",
        options.tolerance
    );
    let pool = thread_pool(options.threads)?;
    let tables = read_tables(&options.data)?;
    let all = TimedFrames::of(tables.iter().flat_map(|t| &t.frames), options.clock);
    ensure!(
        !all.frames.is_empty(),
        "no frame has a time by the clock {:?}; choose another --clock",
        options.clock.name()
    );
    // Twice a group is held out, and the second time three must be left to choose from.
    let by = all.groups_at_least(4);
    let (validation, rest) = all.hold_out(by, 1);
    let (judged, training) = rest.hold_out(by, 2);
    ensure!(
        !validation.frames.is_empty() && !judged.frames.is_empty(),
        "there are frames of too few volumes to hold some out; collect at least four"
    );
    let stop = interrupt::flag()?;
    let stopped = || interrupt::requested(&stop);
    let bar = templated_bar("select [{bar:30}] {pos}/{len} {msg}");
    let hidden = indicatif::ProgressBar::hidden();
    let context = FitContext { tables: &tables, pool: &pool, bar: &hidden, stop: &stopped };
    let volume = entire_cli::volume::Volume::open(&options.volume)?;
    let volume = entire_cli::enlarge::enlarge(&volume, options.enlarge)?;
    let mut bench = Bench::new(&volume, all.frames[0].scene.shading)?;
    let mut make = |name: &str, recipe: Recipe| -> Result<Candidate> {
        let fitted = recipe.make(&context, training.timed(), validation.timed())?;
        ensure!(!stopped(), "stopped; nothing was written");
        let model = fitted.file.to_model()?;
        let predicted = predict(&model, &context, &judged.frames)?;
        let metrics = Metrics::new(&predicted, &judged.seconds).context("there are no frames to compare")?;
        let cold = bench.latency(&model)?.cold;
        Ok(Candidate { name: name.into(), recipe, fitted, metrics, cold })
    };
    let base = Recipe {
        epochs: options.epochs,
        batch: 128,
        learning_rate: Some(3e-3),
        ensemble: options.ensemble,
        ..Recipe::default()
    };
    let mut recipes = vec![
        ("analytic".to_owned(), Recipe { kind: Kind::Analytic, ..base.clone() }),
        ("log-linear".to_owned(), Recipe { kind: Kind::Linear, ..base.clone() }),
    ];
    let bare: Vec<String> =
        standard_features().iter().filter(|f| !f.quantity.needs_probe()).map(ToString::to_string).collect();
    for width in [8, 16, 32] {
        for layers in [vec![width], vec![width, width]] {
            let widths = layers.iter().map(ToString::to_string).collect::<Vec<_>>().join("-");
            let recipe = Recipe { layers, ..base.clone() };
            let name = format!("network {widths}, no probe");
            recipes.push((name, Recipe { scene_features: bare.clone(), ..recipe.clone() }));
            for &side in &options.probe_sides {
                let recipe = Recipe { probe_side: Some(side), ..recipe.clone() };
                for (kind, what) in [(Kind::Prednet, "network"), (Kind::Residual, "analytic times factor")] {
                    let name = format!("{what} {widths}, probe {side}");
                    recipes.push((name, Recipe { kind, ..recipe.clone() }));
                }
            }
        }
    }
    bar.set_length(recipes.len() as u64);
    let mut candidates = Vec::new();
    for (name, recipe) in recipes {
        bar.set_message(name.clone());
        candidates.push(make(&name, recipe)?);
        bar.inc(1);
    }
    let mut table = Table::new(vec![
        Column::text("candidate"),
        Column::number("RMSE/SD"),
        Column::number("MdAPE, %"),
        Column::number("R² in log"),
        Column::number("cold µs"),
    ]);
    for c in &candidates {
        table.row(vec![
            c.name.clone().into(),
            format!("{:.3}", c.metrics.rmse_over_sd).into(),
            format!("{:.2}", 100.0 * c.metrics.mdape).into(),
            format!("{:.4}", c.metrics.r2_log).into(),
            format!("{:.2}", 1e6 * c.cold).into(),
        ]);
    }
    println!("{}", table.to_text());
    let floor = noise_floor(judged.frames.iter().copied(), options.clock, |f| tables[f.table].passes())
        .map_or(0.0, |n| n.mdape());
    let best = candidates.iter().map(|c| c.metrics.rmse).fold(f64::INFINITY, f64::min);
    let chosen = candidates
        .into_iter()
        .filter(|c| c.metrics.rmse <= best * (1.0 + options.tolerance) || c.metrics.mdape <= floor)
        .min_by(|a, b| a.cold.total_cmp(&b.cold))
        .context("there is no candidate")?;
    println!("chosen: {}", chosen.name);
    let limit = (best * (1.0 + options.tolerance)).max(chosen.metrics.rmse);
    let name = chosen.name.clone();
    let mut current = chosen;
    let mut dropped = Vec::new();
    // Backward elimination; the analytic model has no features to drop.
    while current.recipe.kind != Kind::Analytic {
        let features: Vec<String> = current.recipe.features()?.iter().map(ToString::to_string).collect();
        if features.len() < 2 {
            break;
        }
        // Candidates by closed-form cost: how much a log-linear fit loses without the feature.
        let mut losses = Vec::new();
        for f in &features {
            let rest: Vec<String> = features.iter().filter(|g| *g != f).cloned().collect();
            let quick = Recipe { kind: Kind::Linear, scene_features: rest.clone(), ..base.clone() };
            losses.push((make("", quick)?.metrics.rmse, f.clone(), rest));
        }
        losses.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut next = None;
        for (_, feature, rest) in losses.into_iter().take(2) {
            bar.set_message(format!("without {feature}"));
            let tried = make(&name, Recipe { scene_features: rest, ..current.recipe.clone() })?;
            if tried.metrics.rmse <= limit {
                next = Some((feature, tried));
                break;
            }
        }
        let Some((feature, tried)) = next else { break };
        println!("without {feature}: RMSE/SD {:.3}, {:.2} µs", tried.metrics.rmse_over_sd, 1e6 * tried.cold);
        dropped.push(feature);
        current = tried;
    }
    bar.finish_and_clear();
    let mut file = current.fitted.file;
    let predicted = predict(&file.to_model()?, &context, &judged.frames)?;
    bound::from_predictions(&predicted, &judged.seconds).store(&mut file)?;
    file.metadata.insert(
        Key::Provenance.into(),
        json!({ "what": current.fitted.what, "chosen": name, "dropped": dropped, "recipe": current.recipe,
            "metrics_on_groups_it_was_chosen_by": current.metrics, "groups": by.name(),
            "cold_seconds": current.cold,
            "tolerance": options.tolerance, "clock": options.clock.name(),
            "program": format!("entire {}", machine::version()), "machine": machine::machine(),
            "date": machine::now() })
        .to_string(),
    );
    let bytes = file.to_bytes()?;
    write_whole(&options.out, &bytes)?;
    println!(
        "{name} on {} inputs: RMSE/SD {:.3}, MdAPE {:.2} % on the {}s it was chosen by, {:.2} µs cold; wrote \
         {}",
        file.to_model()?.inputs().iter().map(|g| g.size).sum::<usize>(),
        current.metrics.rmse_over_sd,
        100.0 * current.metrics.mdape,
        by.name(),
        1e6 * current.cold,
        options.out.display()
    );
    Ok(())
}
