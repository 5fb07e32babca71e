//! `entire-lab tune`: search of the controller's constants, and of PID's gains, on recorded paths.

use super::replay::Paths;
use crate::bars::{self, Bar};
use crate::fitted::{FittedPredictor, samples_by_volume};
use crate::replay::tune::{
    Constants, Cost, Course, Gains, LAWS, Ours, Removed, TRIED_VALUES, Taken, by_law, costs, mean_cost,
    removed, search,
};
use crate::replay::{Disturbance, Replayable, Three};
use anyhow::{Context, Result, ensure};
use entire_cli::steering::model::Sample;
use entire_io::files::{make_folder_of, write_json};
use entire_io::progress::templated_bar;
use entire_report::Table;
use serde_json::json;
use std::path::PathBuf;
use std::sync::Arc;

/// A path with the frame times of each renderer of [`LAWS`], and a predictor fitted to other volumes.
type Played = ([Replayable; 3], FittedPredictor);

/// Search for better constants of the controller on recorded paths.
///
/// Every path is replayed with each target of --targets that some allowed step meets exactly in at least half
/// of the path's frames, and with a series of these targets if there are several. Each replay runs twice with
/// a predictor that was fitted to frames of other volumes. Short sessions without a model also play parts of
/// the path, each from another first frame. The search accepts a value only if the value lowers the mean cost
/// of the paths by more than two standard errors. The command changes no file but --out: enter the found
/// values in `steer/src/control/constants.rs` and `steer/src/adapt/constants.rs`. The gains of the controller
/// PID are searched in the same way; enter them in `cli/src/steering/rivals/algorithm1.rs`.
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

/// Limit of the bar on the number of constants of our controller that a search can change.
const MOST_SEARCHED: usize = 12;

/// A search of one controller's constants.
struct Search<C> {
    start: C,
    /// Indices of the constants to search.
    tried: Vec<usize>,
}

struct Found<C> {
    constants: C,
    before: Vec<Cost>,
    after: Vec<Cost>,
    taken: Vec<Taken>,
}

impl<C: Constants + Default> Search<C> {
    /// Returns a search of the constants named in `only`; of all constants if `only` is empty. It starts from
    /// the defaults with the values in `given`.
    fn new(only: &[String], given: &[(&str, f64)]) -> Self {
        let mut start = C::default();
        let mut tried = Vec::new();
        for (i, (name, value)) in C::names().into_iter().zip(start.values()).enumerate() {
            if let Some((_, given)) = given.iter().rev().find(|(n, _)| *n == name) {
                *value = *given;
            }
            if only.is_empty() || only.iter().any(|n| n == name) {
                tried.push(i);
            }
        }
        Self { start, tried }
    }

    fn run(&self, courses: &[Course<'_>], paths: usize, rounds: usize) -> Result<Found<C>> {
        let before = costs(courses, self.start)?;
        let bar = templated_bar("tune [{bar:30}] {pos}/{len} values tried, {eta} left");
        bar.set_length((rounds * self.tried.len() * TRIED_VALUES) as u64);
        let (constants, after, taken) =
            search(courses, paths, self.start, before.clone(), &self.tried, rounds, &|| bar.inc(1))?;
        bar.finish_and_clear();
        Ok(Found { constants, before, after, taken })
    }
}

impl<C: Constants> Found<C> {
    fn print_mean(&self) {
        let [before, after] = [&self.before, &self.after].map(|costs| mean_cost(costs));
        println!("{}: mean cost {before:.4} -> {after:.4}", C::CONTROLLER);
    }

    fn print_taken(&self) {
        for t in &self.taken {
            println!(
                "{}: {:.4} -> {:.4}, mean cost {:.4} -> {:.4} (standard error of the difference {:.4})",
                t.name, t.from, t.to, t.cost[0], t.cost[1], t.standard_error
            );
        }
        if self.taken.is_empty() {
            println!("no other value of any constant lowers the cost by more than two standard errors");
        }
    }

    fn named(&mut self) -> impl Iterator<Item = (String, serde_json::Value)> {
        let values = self.constants.values().into_iter();
        C::names().into_iter().zip(values).map(|(name, value)| (name.to_owned(), json!(*value)))
    }
}

pub(crate) fn run(options: &Options) -> Result<()> {
    let given = options.set.iter().map(|given| parsed(given)).collect::<Result<Vec<_>>>()?;
    options.only.iter().try_for_each(|name| known(name))?;
    let ours = Search::<Ours>::new(&options.only, &given);
    let gains = Search::<Gains>::new(&options.only, &given);
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
            let calibrated = FittedPredictor::fit(&others)?;
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
    let mut ours = ours.run(&courses, undisturbed, options.rounds)?;
    let mut gains = gains.run(&courses, undisturbed, options.rounds)?;
    println!("{}", table(&played, &ours.before, &ours.after).to_text());
    ours.print_mean();
    let worth = removed(&courses, undisturbed, ours.constants, &ours.after)?;
    println!("\n{}", worth_table(&worth).to_text());
    ours.print_taken();
    gains.print_mean();
    gains.print_taken();
    if let Some(out) = &options.out {
        make_folder_of(out)?;
        let names: Vec<&str> = played.iter().map(|(r, _)| r[0].trace.name.as_str()).collect();
        let constants: serde_json::Map<_, _> = ours.named().chain(gains.named()).collect();
        let all = json!({
            "paths": names, "constants": constants, "taken": ours.taken, "without": worth,
            "before": ours.before, "after": ours.after,
            "pid": { "taken": gains.taken, "before": gains.before, "after": gains.after },
        });
        write_json(out, &all).with_context(|| format!("cannot write {}", out.display()))?;
    }
    let searched = Ours::names().len() as f64;
    bars::print(&[Bar::at_most("searched-constants", Some(searched), MOST_SEARCHED as f64)])
}

/// Fails for a name that is not that of a constant.
fn known(name: &str) -> Result<()> {
    let known = [Ours::names(), Gains::names()].concat();
    ensure!(known.contains(&name), "no constant is named {name}; there are {}", known.join(", "));
    Ok(())
}

/// Returns name and value from `NAME=VALUE`.
fn parsed(given: &str) -> Result<(&str, f64)> {
    let (name, value) = given.split_once('=').with_context(|| format!("{given} is no NAME=VALUE"))?;
    known(name)?;
    let value = value
        .parse()
        .ok()
        .filter(|v: &f64| v.is_finite() && *v >= 0.0)
        .with_context(|| format!("{name} is {value}; it must be a finite number and not negative"))?;
    Ok((name, value))
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
