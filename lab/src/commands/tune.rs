//! `entire-lab tune`: search of the controller's constants on recorded paths.

use super::replay::Paths;
use crate::fitted::{Calibrated, samples_by_volume};
use crate::replay::tune::{Constants, Cost, Course, LAWS, Removed, TRIED, by_law, costs, removed, search};
use crate::replay::{Disturbance, Replayable, Three};
use anyhow::{Context, Result, ensure};
use entire_cli::steering::calibrate::Sample;
use entire_io::files::{make_folder_of, write_json};
use entire_io::progress::templated_bar;
use entire_report::Table;
use serde_json::json;
use std::path::PathBuf;
use std::sync::Arc;

/// A path with the frame times of each renderer of [`LAWS`], and a predictor fitted to other volumes.
type Played = ([Replayable; 3], Calibrated);

/// Search for better constants of the controller on recorded paths.
///
/// Every path is replayed with every target that an allowed step meets exactly in at least half of its
/// frames, by a predictor fitted to frames of other volumes and by sessions without a model that start at
/// several frames. The search takes a value when it lowers the cost of the paths by more than two standard
/// errors. It changes no file but --out: enter the found values in `steer/src/control/constants.rs` and
/// `steer/src/adapt/constants.rs`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire-lab tune data/steer/training/*.json.gz \\
      --calibration data/steer/training/calibration.csv.gz
  entire-lab tune nyx.json --calibration calibration.csv --rounds 0
  entire-lab tune nyx.json --calibration calibration.csv --only full,gain")]
pub(crate) struct Options {
    /// Paths to replay.
    #[command(flatten)]
    pub(crate) paths: Paths,
    /// Replay every path again with each of these recorded slowdowns (`entire-lab disturb`).
    #[arg(long, value_delimiter = ',', value_name = "FILE.csv,…")]
    pub(crate) disturbances: Vec<PathBuf>,
    /// Maximum number of rounds over all constants; 0 prints the cost of the present values.
    #[arg(long, default_value_t = 3, value_name = "N")]
    pub(crate) rounds: usize,
    /// Search for these constants only; default: all.
    #[arg(long, value_delimiter = ',', value_name = "NAME,…")]
    pub(crate) only: Vec<String>,
    /// Start from these values instead of the present ones.
    #[arg(long, value_delimiter = ',', value_name = "NAME=VALUE,…", allow_hyphen_values = true)]
    pub(crate) set: Vec<String>,
    /// File for all tried values and the result, as JSON.
    #[arg(long, value_name = "FILE.json")]
    pub(crate) out: Option<PathBuf>,
}

/// Returns a table with one row per constant: the increase of the paths' cost if this constant alone is set
/// to a value at which it has no effect.
fn worth_table(worth: &[Removed]) -> Table {
    let mut table =
        Table::headed("constant | #value | #value without effect | #cost increase | #standard error");
    for r in worth {
        table.row(vec![
            r.name.into(),
            format!("{:.3}", r.value).into(),
            format!("{:.3}", r.without).into(),
            format!("{:+.3}", r.more).into(),
            format!("{:.3}", r.standard_error).into(),
        ]);
    }
    table
}

pub(crate) fn run(options: &Options) -> Result<()> {
    let mut first = Constants::default();
    for given in &options.set {
        set(&mut first, given)?;
    }
    let tried: Vec<usize> = if options.only.is_empty() {
        (0..first.values().count()).collect()
    } else {
        options.only.iter().map(|name| place(name)).collect::<Result<_>>()?
    };
    let targets = options.paths.targets()?;
    let samples = samples_by_volume(&options.paths.calibration)?;
    let mut played = options
        .paths
        .open()?
        .into_iter()
        .map(|recorded| {
            let shown = |volume: &str| recorded.trace.volumes.iter().any(|v| v.file.as_os_str() == volume);
            let others: Vec<Sample> =
                samples.iter().filter(|(v, _)| !shown(v)).map(|(_, s)| s.clone()).collect();
            let calibrated = Calibrated::fit(&others)?;
            Ok((LAWS.map(|law| by_law(&recorded, law)), calibrated))
        })
        .collect::<Result<Vec<Played>>>()?;
    let undisturbed = played.len();
    for file in &options.disturbances {
        let disturbance = Arc::new(Disturbance::open(file)?);
        for path in 0..undisturbed {
            let (recorded, calibrated) = played[path].clone();
            played.push((recorded.map(|r| r.disturbed(&disturbance)), calibrated));
        }
    }
    let courses: Vec<Course<'_>> =
        played.iter().map(|(recorded, c)| Course::new(recorded, c, &targets)).collect();
    ensure!(undisturbed >= 2, "a standard error needs several paths; name more than one");
    for (course, (recorded, _)) in courses.iter().zip(&played) {
        ensure!(
            !course.is_empty(),
            "{} has no target that some allowed step meets exactly in at least half of the frames; name \
             other --targets",
            recorded[0].trace.name
        );
    }
    let before = costs(&courses, first)?;
    let bar = templated_bar("tune [{bar:30}] {pos}/{len} values tried, {eta} left");
    bar.set_length((options.rounds * tried.len() * TRIED) as u64);
    let (mut found, after, taken) =
        search(&courses, undisturbed, first, before.clone(), &tried, options.rounds, &|| bar.inc(1))?;
    bar.finish_and_clear();
    println!("{}", table(&played, &before, &after).to_text());
    let mean = |costs: &[Cost]| costs.iter().map(Cost::value).sum::<f64>() / costs.len() as f64;
    println!("mean cost {:.4} -> {:.4}", mean(&before), mean(&after));
    let worth = removed(&courses, undisturbed, found, &after)?;
    println!("\n{}", worth_table(&worth).to_text());
    for t in &taken {
        println!(
            "{}: {:.4} -> {:.4}, mean cost {:.4} -> {:.4} (standard error of the difference {:.4})",
            t.name, t.from, t.to, t.cost[0], t.cost[1], t.standard_error
        );
    }
    if taken.is_empty() {
        println!("no other value of any constant lowers the cost by more than two standard errors");
    }
    if let Some(out) = &options.out {
        make_folder_of(out)?;
        let names: Vec<&str> = played.iter().map(|(r, _)| r[0].trace.name.as_str()).collect();
        let constants: serde_json::Map<String, serde_json::Value> =
            found.values().map(|(name, value)| (name.to_owned(), json!(*value))).collect();
        let all = json!({
            "paths": names, "constants": constants, "taken": taken, "without": worth, "before": before, "after": after
        });
        write_json(out, &all).with_context(|| format!("cannot write {}", out.display()))?;
    }
    Ok(())
}

/// The index of a constant.
fn place(name: &str) -> Result<usize> {
    let mut constants = Constants::default();
    let known: Vec<&str> = constants.values().map(|(name, _)| name).collect();
    let place = known.iter().position(|n| *n == name);
    place.with_context(|| format!("no constant is named {name}; there are {}", known.join(", ")))
}

/// Sets a constant from `NAME=VALUE`.
fn set(constants: &mut Constants, given: &str) -> Result<()> {
    let (name, value) = given.split_once('=').with_context(|| format!("{given} is no NAME=VALUE"))?;
    let at = place(name)?;
    let value: f64 = value
        .parse()
        .ok()
        .filter(|v: &f64| v.is_finite() && *v >= 0.0)
        .with_context(|| format!("{name} is {value}; it must be a finite number and not negative"))?;
    if let Some((_, constant)) = constants.values().nth(at) {
        *constant = value;
    }
    Ok(())
}

/// Returns a table with the costs of every path before and after the search.
fn table(played: &[Played], before: &[Cost], after: &[Cost]) -> Table {
    let mut table = Table::headed(
        "path | #cost before | #cost after | #fitted: |t-T|/T | #> 1.1 T | #quality | #too coarse | #jumps | \
         #cold: |t-T|/T | #> 1.1 T | #quality | #too coarse | #second frame in bound",
    );
    for (i, (recorded, _)) in played.iter().enumerate() {
        let mut row = vec![
            recorded[0].trace.name.clone().into(),
            format!("{:.4}", before[i].value()).into(),
            format!("{:.4}", after[i].value()).into(),
        ];
        let wrong = |t: Three| [t.deviation, t.missed, t.quality];
        let Cost { fitted, fitted_coarse, jumps, cold, cold_coarse, second_in_bound } = after[i];
        let rest = [cold_coarse, second_in_bound];
        for value in [&wrong(fitted)[..], &[fitted_coarse, jumps], &wrong(cold), &rest].concat() {
            row.push(format!("{:.1} %", 100.0 * value).into());
        }
        table.row(row);
    }
    table
}
