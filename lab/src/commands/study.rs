//! `entire-lab study`: runs a whole study, and writes one report that begins with accuracy against latency.

use crate::bars;
use crate::ship::ship;
use crate::study::report::{fits_table, main_table, write};
use crate::study::{self, Runner, by_rule, read};
use anyhow::{Result, ensure};
use entire_io::clock::fixed_parser;
use entire_io::dataset::Clock;
use entire_io::files::note;
use entire_io::interrupt;
use entire_io::options::thread_pool;
use entire_io::progress::templated_bar;
use std::path::PathBuf;

/// Train and test every predictor of a study; write one report of accuracy against latency.
///
/// Predictors that were already trained on the same data are taken from OUT/models, so a stopped study
/// continues where it was.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  entire-lab study --study data/timings/study.json --out out/study
  entire-lab study --study study.json --bars")]
pub(crate) struct Options {
    /// The study: data sets, splits and predictors as JSON.
    #[arg(long, value_name = "JSON")]
    pub(crate) study: PathBuf,
    /// Folder for report.html, study.json, the charts as SVG and the models.
    #[arg(long, value_name = "FOLDER", default_value = "out/study")]
    pub(crate) out: PathBuf,
    /// Clock of the predicted seconds, instead of the study's.
    #[arg(long, value_parser = fixed_parser())]
    pub(crate) clock: Option<Clock>,
    /// Print one line per goal, `bar NAME VALUE LIMIT ok|short`, and fail when one is missed (short).
    ///
    /// The value of a goal that could not be measured is -.
    #[arg(long)]
    pub(crate) bars: bool,
    /// Write the predictors that the study names for shipping, each with its model card, into this folder.
    #[arg(long, value_name = "FOLDER")]
    pub(crate) ship: Option<PathBuf>,
    /// Number of threads; default: one per logical processor.
    #[arg(long)]
    pub(crate) threads: Option<usize>,
}

pub(crate) fn run(options: &Options) -> Result<()> {
    let mut study = read(&options.study)?;
    if let Some(clock) = options.clock {
        study.clock = clock.name().into();
    }
    let pool = thread_pool(options.threads)?;
    let stop = interrupt::flag()?;
    let bar = templated_bar("study [{bar:30}] {pos}/{len} {msg}");
    let stopped = || interrupt::requested(&stop);
    let runner = Runner { pool: &pool, models: options.out.join("models"), bar: &bar, stop: &stopped };
    let found = runner.run(&study)?;
    bar.finish_and_clear();
    for (set, what, why) in &found.left_out {
        note(&format!("{set}, {what}: left out ({why})"));
    }
    write(&options.out, &study, &found)?;
    if let Some(folder) = &options.ship {
        ensure!(
            !study.ship.is_empty(),
            "--ship: {} names no predictor under the key `ship`",
            options.study.display()
        );
        for path in ship(folder, &study, &found, &runner)? {
            println!("wrote {}", path.display());
        }
    }
    for set in &study.sets {
        if let Some(split) = set.splits.iter().find(|s| s.main) {
            println!("{}: training frames, cross-validation, test", set.name);
            println!("{}", fits_table(&study, &found, &set.name, &split.name).to_text());
        }
        if let Some(selected) = by_rule(&study, &found, &set.name) {
            println!("{}: the rule selects {}\n", set.name, selected.name);
        }
        for split in &set.splits {
            println!("{}, split by {}", set.name, split.name);
            println!("{}", main_table(&found, &set.name, &split.name, None).to_text());
        }
    }
    println!("wrote {}", options.out.join("report.html").display());
    if options.bars { bars::print(&study::bars(&study, &found)) } else { Ok(()) }
}
