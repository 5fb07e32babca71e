//! `entire-lab study`: a whole study in one report, accuracy against latency first.

use crate::ship::ship;
use crate::study::nested_report::{book_table, choices, grid_lines, nested_table, outer_table};
use crate::study::report::{fits_table, main_table, write};
use crate::study::{Runner, bars, read};
use anyhow::{Result, ensure};
use entire_cli::interrupt;
use entire_cli::options::thread_pool;
use entire_cli::progress::templated_bar;
use std::path::PathBuf;

/// Make and judge every predictor of a study; write one report: accuracy against latency, tables, curves.
///
/// Predictors that were made before of the same data are taken from OUT/models, so that a study that was
/// stopped goes on where it was.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  entire-lab study --study data/timings/study.json --out out/study
  entire-lab study --study data/timings/study.json --out out/study --nested
  entire-lab study --study study.json --only selected,paper --bars")]
pub struct Options {
    /// The study: data sets, splits and predictors as JSON.
    #[arg(long, value_name = "JSON")]
    pub study: PathBuf,
    /// Folder for report.html, study.json, the charts as SVG and the models.
    #[arg(long, value_name = "FOLDER", default_value = "out/study")]
    pub out: PathBuf,
    /// Only these predictors, and no candidates of the grid.
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    pub only: Vec<String>,
    /// Only these data sets.
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    pub sets: Vec<String>,
    /// Judge the choice of a predictor, too, by nested cross-validation on the training members: among the
    /// study's predictors and among the candidates of its grid.
    ///
    /// Some minutes when nothing was made before; models are kept like all others.
    #[arg(long)]
    pub nested: bool,
    /// Print one line per bar, `bar NAME VALUE LIMIT ok|short`, and fail when one is short.
    ///
    /// The value is - where what the bar is about is missing.
    #[arg(long)]
    pub bars: bool,
    /// Write the predictors that the study ships, each with its card, into this folder.
    #[arg(long, value_name = "FOLDER", conflicts_with = "only")]
    pub ship: Option<PathBuf>,
    /// Threads; all logical processors unless given.
    #[arg(long)]
    pub threads: Option<usize>,
}

/// Runs the command.
///
/// # Errors
/// When the study or its tables cannot be read, a file cannot be written, or, with `--bars`, one is short.
pub fn run(options: &Options) -> Result<()> {
    let mut study = read(&options.study)?;
    if !options.only.is_empty() {
        study.predictors.retain(|p| options.only.contains(&p.name));
        let kept: Vec<String> = study.predictors.iter().map(|p| p.name.clone()).collect();
        study.curves.retain(|c| kept.contains(c));
        study.grid.clear();
        ensure!(!kept.is_empty(), "--only names no predictor of {}", options.study.display());
    }
    if !options.sets.is_empty() {
        study.sets.retain(|s| options.sets.contains(&s.name));
        ensure!(!study.sets.is_empty(), "--sets names no data set of {}", options.study.display());
    }
    let pool = thread_pool(options.threads)?;
    let stop = interrupt::flag()?;
    let bar = templated_bar("study [{bar:30}] {pos}/{len} {msg}");
    let stopped = || interrupt::requested(&stop);
    let runner = Runner { pool: &pool, models: options.out.join("models"), bar: &bar, stop: &stopped };
    let found = runner.run(&study, options.nested)?;
    bar.finish_and_clear();
    for (set, what, why) in &found.left_out {
        entire_cli::files::note(&format!("{set}, {what}: left out ({why})"));
    }
    write(&options.out, &study, &found)?;
    if let Some(folder) = &options.ship {
        ensure!(!study.ship.is_empty(), "{} ships nothing", options.study.display());
        for path in ship(folder, &study, &found, &runner)? {
            println!("wrote {}", path.display());
        }
    }
    for set in &study.sets {
        if let Some(split) = set.splits.iter().find(|s| s.main) {
            println!("{}: frames learned from, cross-validation, test", set.name);
            println!("{}", fits_table(&study, &found, &set.name, &split.name).to_text());
        }
        for text in choices(&found, &set.name) {
            println!("{}: {text}\n", set.name);
        }
        if found.nested.iter().any(|n| n.set == set.name) {
            println!("{}: nested cross-validation", set.name);
            println!("{}", nested_table(&found, &set.name).to_text());
            println!("{}: nested cross-validation, by member left out", set.name);
            println!("{}", outer_table(&found, &set.name).to_text());
        }
        for split in &set.splits {
            println!("{}, split by {}", set.name, split.name);
            println!("{}", main_table(&found, &set.name, &split.name, None).to_text());
        }
    }
    if !found.nested.is_empty() {
        println!("nested cross-validation, all sets\n\n{}", book_table(&study, &found).to_markdown());
        for line in grid_lines(&study) {
            println!("grid: {line}");
        }
        println!();
    }
    let mut short = 0;
    if options.bars {
        let bars = bars(&study, &found);
        bars.iter().for_each(|b| println!("{b}"));
        short = bars.iter().filter(|b| !b.ok).count();
    }
    println!("wrote {}", options.out.join("report.html").display());
    ensure!(short == 0, "{short} of the bars above are short");
    Ok(())
}
