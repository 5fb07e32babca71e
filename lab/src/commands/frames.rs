//! `entire-lab frames`: error of models calibrated to few and many frames of one type of machine, with priors
//! of other makes of machine.

use crate::bars::Bar;
use anyhow::{Context, Result, ensure};
use entire_cli::calibrate::{NamedPrior, calibrate_to_frames, calibrate_to_tables};
use entire_io::clock::fixed_parser;
use entire_io::dataset::{Clock, Manifest, Table as TimingTable, read_tables};
use entire_io::files::{make_folder, read_model_file, write_whole};
use entire_io::interrupt;
use entire_io::metrics::Metrics;
use entire_io::options::thread_pool;
use entire_io::progress::templated_bar;
use entire_report::{Axis, Chart, Mark, Series, Table};
use entire_steer::calibrate::FEWEST_FRAMES;
use entire_train::fit::{FitContext, predict};
use entire_train::split::{GroupBy, TimedFrames};
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use rand::seq::SliceRandom;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Maximum number of volumes of a calibration: the number of volumes in `data/`.
const VOLUMES: usize = 9;

/// Number of random draws of calibration frames for each entry of [`FRAMES`].
const DRAWS: u64 = 8;

/// Numbers of calibration frames.
const FRAMES: [usize; 6] = [3, 10, 20, 40, 160, 500];

/// Bars: number of calibration frames, and upper limit of the median error, as a fraction (geometric mean
/// over draws and types of machine).
const BARS: [(usize, f64); 5] = [(3, 0.14), (10, 0.09), (20, 0.075), (160, 0.06), (500, 0.055)];

/// Measure the error of calibrations to few and many frames, with priors from machines of another make.
///
/// Each table and each prior is of one type of machine. A model is calibrated to frames of one type; its
/// priors are the models of all types of another make. The make is the first word of the processor's name in
/// the table's manifest, such as AMD. Each random draw takes one member of each ensemble, at most nine of
/// their volumes, and 3, 10, 20, 40, 160 or 500 frames, spread over the volumes. The model is tested on a
/// table of members that no prior was trained on. Prints the geometric mean and the maximum of the error over
/// the draws, and a goal (bar) for each number of frames except 40. Writes frames.csv and frames.svg into
/// DIR.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Example:
  entire-lab frames --data xeon.csv epyc.csv \\
      --judged xeon-members.csv epyc-members.csv \\
      --priors xeon.safetensors epyc.safetensors --out out/frames")]
pub(crate) struct Options {
    /// Timing tables, one for each type of machine.
    #[arg(long, required = true, num_args = 2.., value_name = "CSV")]
    pub(crate) data: Vec<PathBuf>,
    /// Test tables, in the order of the types of machine of --data.
    #[arg(long, required = true, num_args = 2.., value_name = "CSV")]
    pub(crate) judged: Vec<PathBuf>,
    /// Prior models, in the order of the types of machine of --data.
    #[arg(long, required = true, num_args = 2.., value_name = "SAFETENSORS")]
    pub(crate) priors: Vec<PathBuf>,
    /// Clock of the frame times.
    #[arg(long, value_parser = fixed_parser(), default_value = "cpu")]
    pub(crate) clock: Clock,
    /// Folder for the results.
    #[arg(long, default_value = "out/frames", value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// Number of threads; default: one per logical processor.
    #[arg(long)]
    pub(crate) threads: Option<usize>,
}

/// Draws `count` frames and returns their indices. `of_frames`: volume and ensemble member of every frame.
fn draw(of_frames: &[(&str, String)], count: usize, seed: u64) -> Vec<usize> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let ensemble = |member: &str| member.rsplit_once('/').map_or(String::new(), |(e, _)| e.to_owned());
    let mut of_ensemble: BTreeMap<String, BTreeSet<&str>> = BTreeMap::new();
    for (_, member) in of_frames {
        of_ensemble.entry(ensemble(member)).or_default().insert(member);
    }
    let mut taken = BTreeSet::new();
    for members in of_ensemble.into_values() {
        let mut members: Vec<&str> = members.into_iter().collect();
        members.shuffle(&mut rng);
        taken.extend(members.first().copied());
    }
    let mut volumes: Vec<&str> =
        of_frames.iter().filter(|(_, m)| taken.contains(m.as_str())).map(|(v, _)| *v).collect();
    volumes.sort_unstable();
    volumes.dedup();
    volumes.shuffle(&mut rng);
    volumes.truncate(VOLUMES);
    let mut of_volume: Vec<Vec<usize>> = volumes
        .iter()
        .map(|v| {
            let mut own: Vec<usize> = (0..of_frames.len()).filter(|&i| of_frames[i].0 == *v).collect();
            own.shuffle(&mut rng);
            own
        })
        .collect();
    let mut calibrated = Vec::new();
    while calibrated.len() < count && of_volume.iter().any(|v| !v.is_empty()) {
        let next: Vec<usize> = of_volume.iter_mut().filter_map(Vec::pop).collect();
        calibrated.extend(next.into_iter().take(count - calibrated.len()));
    }
    calibrated
}

/// Returns the make of the machine on which a table was measured: the first word of the machine's description
/// in the manifest.
fn make_of(table: &Path) -> Result<String> {
    let manifest = Manifest::read(table)?;
    let make = manifest.as_ref().and_then(|m| m.machine.split([' ', '(']).next()).filter(|m| !m.is_empty());
    Ok(make
        .with_context(|| format!("{} has no manifest that names its machine", table.display()))?
        .to_owned())
}

/// Result of one draw of calibration frames.
struct Found {
    frames: usize,
    error: f64,
    rmse_over_sd: f64,
    /// Median error that the calibration expects; `None` with too few frames for a cross-validation.
    expected: Option<f64>,
}

impl Found {
    /// Returns a row of frames.csv: the table's name, number of frames, number of the draw, median error,
    /// RMSE/SD, expected median error. An unknown expected error is left empty.
    fn row(&self, name: &str, draw: u64) -> String {
        let expected = self.expected.map_or(String::new(), |e| format!("{e:.5}"));
        format!("{name},{},{draw},{:.5},{:.5},{expected}\n", self.frames, self.error, self.rmse_over_sd)
    }
}

/// Geometric mean of the expected median errors in per cent; `None` if a draw has no expected error.
fn expected_percent(draws: &[&Found]) -> Option<String> {
    let expected: Vec<f64> = draws.iter().map(|f| f.expected).collect::<Option<_>>()?;
    Some(format!("{:.1}", 100.0 * mean(expected.into_iter())))
}

/// The geometric mean.
fn mean(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let n = values.clone().count().max(1) as f64;
    (values.map(f64::ln).sum::<f64>() / n).exp()
}

pub(crate) fn run(options: &Options) -> Result<()> {
    let (tables, judged, models) = (options.data.len(), options.judged.len(), options.priors.len());
    ensure!(
        tables == models && tables == judged,
        "--data names {tables} tables, --judged {judged} and --priors {models} models; give one of each for \
         every type of machine"
    );
    make_folder(&options.out)?;
    let pool = thread_pool(options.threads)?;
    let priors: Vec<NamedPrior> = options
        .priors
        .iter()
        .map(|p| Ok((p.display().to_string(), read_model_file(p)?.0)))
        .collect::<Result<_>>()?;
    let makes: Vec<String> = options.data.iter().map(|path| make_of(path)).collect::<Result<_>>()?;
    let bar = templated_bar("frames [{bar:30}] {pos}/{len} {msg}");
    bar.set_length((options.data.len() * FRAMES.len()) as u64 * DRAWS);
    let stop = interrupt::flag()?;
    let stopped = || interrupt::requested(&stop);
    let hidden = indicatif::ProgressBar::hidden();
    let mut found: Vec<(String, Vec<Found>)> = Vec::new();
    let mut csv = String::from("table,frames,draw,median_error,rmse_over_sd,expected_median_error\n");
    for (own, path) in options.data.iter().enumerate() {
        let tables = read_tables(&[path.clone(), options.judged[own].clone()])?;
        let name = path.file_name().map_or(String::new(), |n| n.to_string_lossy().into_owned());
        let name = name.split('.').next().unwrap_or_default().to_owned();
        let first = tables[0].frames.first().with_context(|| format!("{} holds no frame", path.display()))?;
        let shading = first.scene.shading;
        let others: Vec<NamedPrior> = priors
            .iter()
            .zip(&makes)
            .filter(|(_, make)| **make != makes[own])
            .map(|(p, _)| p.clone())
            .collect();
        ensure!(!others.is_empty(), "all machines are made by {}; give tables of another make", makes[own]);
        let of_frames: Vec<(&str, String)> = tables[0]
            .frames
            .iter()
            .map(|f| (f.scene.volume.as_str(), GroupBy::Member.group(&f.scene)))
            .collect();
        let context = FitContext { tables: &tables, pool: &pool, bar: &hidden, stop: &stopped };
        let mut of_table = Vec::new();
        for count in FRAMES {
            for seed in 0..DRAWS {
                ensure!(!stopped(), "stopped; nothing was written");
                bar.set_message(format!("{name}, {count} frames"));
                let drawn = draw(&of_frames, count, seed);
                let few = drawn.iter().map(|&i| tables[0].frames[i].clone()).collect();
                let few = [TimingTable { frames: few, ..tables[0].clone() }];
                let (file, expected) = if count < FEWEST_FRAMES {
                    let few = TimedFrames::of(&few[0].frames, options.clock);
                    let files: Vec<_> = others.iter().map(|p| p.1.clone()).collect();
                    let file = calibrate_to_frames(&files, &context, few.timed())?;
                    (file, None)
                } else {
                    let (file, report) =
                        calibrate_to_tables(&few, (shading, options.clock), &others, None, &pool)?;
                    (file, Some(report.median_error))
                };
                let judged = TimedFrames::of(&tables[1].frames, options.clock);
                let predicted = predict(&file.to_model()?, &context, &judged.frames)?;
                let metrics =
                    Metrics::new(&predicted, &judged.seconds).context("there are no test frames")?;
                let one = Found {
                    frames: count,
                    error: metrics.mdape,
                    rmse_over_sd: metrics.rmse_over_sd,
                    expected,
                };
                csv.push_str(&one.row(&name, seed));
                of_table.push(one);
                bar.inc(1);
            }
        }
        found.push((name, of_table));
    }
    bar.finish_and_clear();
    write_whole(&options.out.join("frames.csv"), csv.as_bytes())?;
    report(options, &found)
}

/// Prints the table and the bars, and writes the chart.
fn report(options: &Options, found: &[(String, Vec<Found>)]) -> Result<()> {
    let mut table = Table::headed(
        "table | #frames | #median error, % | #largest median error, % | #RMSE/SD | \
         #expected median error, %",
    );
    let mut chart = Chart::new(
        "Error of calibrations, with models of other makes of machine as priors",
        Axis::log("frames"),
        Axis::linear("median error on other members, %").from(0.0),
    );
    for (color, (name, of_table)) in found.iter().enumerate() {
        let (mut line, mut band) = (Vec::new(), Vec::new());
        for count in FRAMES {
            let draws: Vec<&Found> = of_table.iter().filter(|f| f.frames == count).collect();
            let error = 100.0 * mean(draws.iter().map(|f| f.error));
            let largest = 100.0 * draws.iter().map(|f| f.error).fold(0.0, f64::max);
            let least = 100.0 * draws.iter().map(|f| f.error).fold(f64::INFINITY, f64::min);
            line.push((count as f64, error));
            band.push((count as f64, least, largest));
            table.row(vec![
                name.clone().into(),
                count.to_string().into(),
                format!("{error:.1}").into(),
                format!("{largest:.1}").into(),
                format!("{:.3}", mean(draws.iter().map(|f| f.rmse_over_sd))).into(),
                expected_percent(&draws).into(),
            ]);
        }
        chart = chart
            .series(Series::new("", Mark::Band(band)).color(color))
            .series(Series::new(name.clone(), Mark::Line(line)).color(color));
    }
    let svg = options.out.join("frames.svg");
    write_whole(&svg, chart.to_svg_file().as_bytes())?;
    println!("{}", table.to_text());
    println!("Chart: {}", svg.display());
    for (count, limit) in BARS {
        let of = |(_, of_table): &(String, Vec<Found>)| {
            mean(of_table.iter().filter(|f| f.frames == count).map(|f| f.error))
        };
        let name = format!("calibrated-to-another-make-{count}-frames");
        println!("{}", Bar::at_most(name, Some(mean(found.iter().map(of))), limit));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_expected_error_is_empty_and_not_nan() {
        let found = |expected| Found { frames: 3, error: 0.125, rmse_over_sd: 0.25, expected };
        assert_eq!(found(None).row("xeon", 2), "xeon,3,2,0.12500,0.25000,\n");
        assert_eq!(found(Some(0.5)).row("xeon", 2), "xeon,3,2,0.12500,0.25000,0.50000\n");
        assert_eq!(expected_percent(&[&found(None), &found(None)]), None);
        assert_eq!(expected_percent(&[&found(Some(0.1)), &found(Some(0.1))]).as_deref(), Some("10.0"));
    }

    #[test]
    fn the_make_is_that_of_the_processor() {
        let table = |name: &str| Path::new("../data/timings").join(name);
        let makes = ["none-train.csv.gz", "none-epyc-train.csv.gz", "none-xeon-train.csv.gz"];
        assert_eq!(makes.map(|name| make_of(&table(name)).unwrap()), ["AMD", "AMD", "Intel"]);
        assert!(make_of(&table("gone.csv")).unwrap_err().to_string().contains("no manifest"));
    }

    #[test]
    fn a_draw_takes_one_member_of_each_ensemble_and_its_volumes_in_turn() {
        let members = [("a/m01", 6), ("a/m02", 6), ("b/m01", 5), ("b/m02", 5), ("c/m01", 3)];
        let volumes: Vec<(String, &str)> =
            members.iter().flat_map(|(m, n)| (0..*n).map(move |v| (format!("{m}/t{v}.nrrd"), *m))).collect();
        let frames: Vec<(&str, String)> =
            volumes.iter().flat_map(|(v, m)| [(); 4].map(|()| (v.as_str(), (*m).to_owned()))).collect();
        for seed in 0..5 {
            let drawn = draw(&frames, 20, seed);
            let taken: BTreeSet<String> = drawn.iter().map(|i| frames[*i].1.clone()).collect();
            assert_eq!(taken.len(), 3, "{taken:?}");
            let distinct: BTreeSet<usize> = drawn.iter().copied().collect();
            assert_eq!(distinct.len(), 20);
            let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
            for &i in &drawn {
                *counts.entry(frames[i].0).or_default() += 1;
            }
            assert_eq!(counts.len(), VOLUMES);
            assert!(counts.values().all(|n| (2..=3).contains(n)), "{counts:?}");
        }
    }
}
