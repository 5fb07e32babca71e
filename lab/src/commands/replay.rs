//! `entire-lab replay`: replays recorded time curves under every controller and target, beside an oracle, and
//! prints the steering bars.

use crate::bars;
use crate::fitted::{FittedPredictor, no_volume, response_of, samples_by_volume};
use crate::replay::report::Results;
use crate::replay::{
    self, Disturbance, Player, Replayable, Score, Tally, Trial, frontier, play, second_in_bound,
    trials_of_all,
};
use crate::trace::Trace;
use anyhow::{Context, Result, ensure};
use entire_cli::steering::contenders::ControllerKind;
use entire_cli::steering::model::{Sample, SteeringModel};
use entire_io::files::{make_folder, note, open_model};
use entire_io::options::parse_target;
use std::path::PathBuf;
use std::sync::Arc;

/// Recorded paths, timing tables and targets.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Paths {
    /// The recorded paths (`entire-lab record`).
    #[arg(value_name = "TRACE.json", required = true)]
    pub(crate) traces: Vec<PathBuf>,
    /// Timing tables of random scenes, each at several steps (`entire-lab record --calibration`). Unit costs
    /// and the curve of frame time over step (the paper's G) are fitted to them.
    #[arg(long, value_delimiter = ',', value_name = "TABLE.csv", required = true)]
    pub(crate) calibration: Vec<PathBuf>,
    /// Target frame times.
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "5fps,10fps,15fps,20fps,30fps,45fps,60fps,90fps",
        value_name = "TIME,…",
        allow_hyphen_values = true
    )]
    pub(crate) targets: Vec<String>,
}

impl Paths {
    /// Opens the recorded paths.
    pub(crate) fn open(&self) -> Result<Vec<Replayable>> {
        let open = |file: &PathBuf| {
            Replayable::new(Trace::open(file)?).with_context(|| format!("{}", file.display()))
        };
        self.traces.iter().map(open).collect()
    }

    /// Every target in seconds with its name, the longest first.
    pub(crate) fn targets(&self) -> Result<Vec<(f64, &str)>> {
        let mut out =
            self.targets.iter().map(|t| Ok((parse_target(t)?, t.trim()))).collect::<Result<Vec<_>>>()?;
        out.sort_by(|a, b| b.0.total_cmp(&a.0));
        Ok(out)
    }
}

/// Replay recorded paths under every controller and target, beside an oracle that knows the recorded times.
///
/// Every trace (recorded path, see `entire-lab record`) is replayed under every controller with every target
/// that an allowed step meets exactly in at least half of the frames, and with a series of these targets. A
/// trace without such a target gets a target of its own: the geometric mean of its median frame times at the
/// finest and at the coarsest step. If allowed steps meet this target, too, exactly in fewer than half of the
/// frames, the trace is not played, and the command fails after it has written the results of the other
/// traces. The predictor is fitted to a timing table of other volumes. Controllers that act on image
/// resolution get the times of smaller images at the reference step. If one trace has no smaller images,
/// these controllers act on the ray step in all traces, and the report says so. Writes report.html,
/// scores.json and frames.csv into DIR.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire-lab replay data/steer/traces/*.json.gz \\
      --calibration data/steer/calibration.csv.gz --out out/steer
  entire-lab replay nyx.json --calibration calibration.csv \\
      --targets 30fps,60fps --controllers olp,hybrid --out out/nyx")]
pub(crate) struct Options {
    /// Paths to replay.
    #[command(flatten)]
    pub(crate) paths: Paths,
    /// Replay with the slowdowns that `entire-lab disturb` recorded while another program ran.
    #[arg(long, value_name = "FILE.csv")]
    pub(crate) disturbance: Option<PathBuf>,
    /// Let the steps of our controller (hybrid) ignore the load of the other program.
    #[arg(long, requires = "disturbance")]
    pub(crate) ignore_load: bool,
    /// Model file, instead of the predictor that is fitted to the tables.
    #[arg(long, value_name = "M.safetensors")]
    pub(crate) model: Option<PathBuf>,
    /// Controllers to compare; default: all.
    #[arg(long, value_enum, value_delimiter = ',', value_name = "NAME,…")]
    pub(crate) controllers: Vec<ControllerKind>,
    /// Number of rounds over all paths and targets, each with another draw of the measured noise.
    #[arg(long, default_value_t = 2, value_name = "N")]
    pub(crate) rounds: u64,
    /// Folder for the results.
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// Print the goals (bars) of steering, and fail when one is missed.
    #[arg(long)]
    pub(crate) bars: bool,
}

pub(crate) fn run(options: &Options) -> Result<()> {
    ensure!(options.rounds >= 1, "--rounds is 0; at least one round is needed");
    let targets = options.paths.targets()?;
    let by_volume = samples_by_volume(&options.paths.calibration)?;
    let samples: Vec<Sample> = by_volume.iter().map(|(_, sample)| sample.clone()).collect();
    let response = response_of(&samples)?;
    let calibrated = match &options.model {
        Some(file) => {
            let given = SteeringModel::new(format!("{}", file.display()), open_model(file)?, &no_volume()?)?;
            FittedPredictor::given(given, &by_volume)
                .context("the model cannot predict the calibration frames")?
        }
        None => FittedPredictor::fit(&samples)?,
    };
    let mut traces = options.paths.open()?;
    if let Some(file) = &options.disturbance {
        let disturbance = Arc::new(Disturbance::open(file)?);
        traces = traces.into_iter().map(|trace| trace.disturbed(&disturbance)).collect();
    }
    let mut players = Player::all(&options.controllers, &traces);
    for player in players.iter_mut().filter(|p| p.kind == ControllerKind::Hybrid) {
        player.ignore_load = options.ignore_load;
    }
    let (trials, unplayed) = trials_of_all(&traces, &targets);
    for name in &unplayed {
        note(&format!(
            "trace {name} is not played: it has no target that some allowed step meets exactly in at least \
             half of the frames"
        ));
    }
    ensure!(
        !trials.is_empty(),
        "no trace has a target that some allowed step meets exactly in at least half of the frames"
    );
    let played =
        |trial: &Trial| play(trial, &traces[trial.trace], &players, &calibrated, &response, options.rounds);
    let outcomes = trials.iter().map(played).collect::<Result<Vec<_>>>()?;
    let mut totals = vec![Tally::default(); players.len()];
    for outcome in &outcomes {
        for (total, tally) in totals.iter_mut().zip(&outcome.tallies) {
            total.merge(tally);
        }
    }
    let scores: Vec<Score> = totals.iter().map(Tally::score).collect();
    make_folder(&options.out)?;
    let results =
        Results { players: &players, traces: &traces, trials: &trials, outcomes: &outcomes, scores: &scores };
    let frontier = frontier(&traces, &targets);
    results.write_csv(&options.out.join("frames.csv"))?;
    results.write_json(&options.out.join("scores.json"), &calibrated)?;
    results.page(&response, &samples, frontier.as_deref()).write(&options.out.join("report.html"))?;
    println!("{}", results.table().to_text());
    println!("* best of the column. Report: {}", options.out.join("report.html").display());
    if let Some(f) = &frontier {
        println!("{f}");
    }
    if options.bars {
        let mut found = replay::bars(&players, &scores)?;
        found.extend(replay::played(traces.len(), &unplayed));
        found.push(second_in_bound(&traces, &trials)?);
        bars::print(&found)?;
    }
    ensure!(unplayed.is_empty(), "not played: {}", unplayed.join(", "));
    Ok(())
}
