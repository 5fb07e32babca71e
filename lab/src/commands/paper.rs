//! `entire-lab paper`: reproduction of the paper's tables and figures.

use super::replay;
use crate::bars;
use crate::farm::compare;
use crate::paper::{
    Paper, Place, Selection, Work, cases, collect, control, description, encode, improved, pictures, places,
    report, results, train, trials, yt,
};
use anyhow::{Result, ensure};
use clap::{Subcommand, ValueEnum};
use description::Panel;
use entire_cli::steering::contenders::ControllerKind;
use entire_farm::read_tasks;
use entire_io::files::{note, open_model};
use entire_io::interrupt;
use entire_io::options::{Device, open_renderer, thread_pool};
use entire_train::teacher::Teacher;
use entire_vk_raycaster::Renderer;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Folder of the recorded paths and calibration frames for the paper's use cases. `make steer-traces
/// STEER_OUT=data/steer` makes them.
const STEERING_DATA: &str = "data/steer";

/// Reproduce every table and figure of the paper, beside our results.
///
/// Collects frames and trains networks as the paper describes, and writes one report. All results are kept in
/// OUT: a stopped command continues where it was, and nothing is computed twice.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire-lab paper all --data volumes
  entire-lab paper collect --data volumes --data-sets castro_blast \\
      --modes none --budget 20
  entire-lab paper encode --data volumes --python venv/bin/python
  entire-lab paper train --data volumes --only overall,ablation --runs 1
  entire-lab paper report --bars")]
pub(crate) struct Options {
    #[command(subcommand)]
    step: Step,
}

#[derive(Debug, Subcommand)]
enum Step {
    /// Run every step, one after another.
    #[command(after_help = "Example:
  entire-lab paper all --data volumes")]
    All {
        #[command(flatten)]
        step: StepOptions,
        #[command(flatten)]
        train: HowToTrain,
        #[command(flatten)]
        report: HowToReport,
    },
    /// Render frames with our raycaster in every shading mode and with yt, and render some of these frames
    /// also from a low-resolution volume (the proxy).
    #[command(after_help = "Example:
  entire-lab paper collect --data volumes --data-sets castro_blast \\
      --modes none --budget 20")]
    Collect(StepOptions),
    /// Train VolumeNets, the networks that encode volumes.
    #[command(after_help = "Example:
  entire-lab paper encode --data volumes --python venv/bin/python")]
    Encode(Making),
    /// Train predictors on the collected frames and test them.
    #[command(after_help = "Example:
  entire-lab paper train --data volumes --only overall,ablation --runs 1")]
    Train {
        #[command(flatten)]
        step: StepOptions,
        #[command(flatten)]
        how: HowToTrain,
    },
    /// Write the report from the kept results.
    #[command(after_help = "Example:
  entire-lab paper report --bars")]
    Report {
        #[command(flatten)]
        places: Places,
        #[command(flatten)]
        how: HowToReport,
    },
}

/// Options of every step.
#[derive(Debug, Clone, clap::Args)]
struct Places {
    /// Description of the study: data sets, splits, modes, sizes, numbers of frames, epochs, runs.
    #[arg(long, value_name = "JSON", default_value = "data/timings/paper.json")]
    description: PathBuf,
    /// Folder for all results.
    #[arg(long, value_name = "FOLDER", default_value = "out/paper")]
    out: PathBuf,
}

/// Options of the steps that make results.
#[derive(Debug, Clone, clap::Args)]
struct Making {
    #[command(flatten)]
    places: Places,
    /// Folder that holds the data sets, directly or in its subfolder `ensembles`.
    #[arg(long, value_name = "FOLDER", default_value = "data")]
    data: PathBuf,
    /// Only these data sets.
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    data_sets: Vec<String>,
    /// Stop after this many minutes and keep the results.
    #[arg(long, value_name = "MINUTES")]
    budget: Option<f64>,
    /// Python with yt and the packages of lab/volumenet/requirements.txt.
    #[arg(long, value_name = "PROGRAM", default_value = "python3")]
    python: PathBuf,
    /// Number of threads; default: one per logical processor.
    #[arg(long)]
    threads: Option<usize>,
}

/// Options of the steps that render.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct StepOptions {
    #[command(flatten)]
    making: Making,
    /// Only these modes: the shading modes none, local and scatter of our raycaster, and the renderer yt.
    #[arg(long, value_delimiter = ',', value_name = "MODES")]
    modes: Vec<String>,
    /// The renderer.
    #[arg(long, value_enum, default_value_t)]
    device: Device,
}

#[derive(Debug, Clone, Default, clap::Args)]
struct HowToTrain {
    /// Only these parts of the results.
    #[arg(long, value_enum, value_delimiter = ',', value_name = "PARTS")]
    only: Vec<Panel>,
    /// Training runs of every network; default: the description's number.
    #[arg(long, value_name = "N")]
    runs: Option<usize>,
}

#[derive(Debug, Clone, clap::Args)]
struct HowToReport {
    /// File written by --keep. Its results are used for the parts that the folder of --out lacks.
    #[arg(long, value_name = "JSON.gz")]
    kept: Option<PathBuf>,
    /// Write all results into one small file.
    #[arg(long, value_name = "JSON.gz")]
    keep: Option<PathBuf>,
    /// Write the book's page of the paper's tables, with its charts, into this folder.
    #[arg(long, value_name = "FOLDER")]
    book: Option<PathBuf>,
    /// Print one line per goal, `bar NAME VALUE LIMIT ok|short`, and fail when one is missed (short).
    #[arg(long)]
    bars: bool,
}

pub(crate) fn run(options: &Options) -> Result<()> {
    let none = HowToTrain::default();
    match &options.step {
        Step::Collect(step) => with(&step.making, &step.modes, &none, &|work| collect_all(work, step)),
        Step::Encode(making) => with(making, &[], &none, &|work| encode_all(work, making)),
        Step::Train { step, how } => with(&step.making, &step.modes, how, &|work| train_all(work, step, how)),
        Step::Report { places, how } => {
            report_all(&description::read(&places.description)?, &places.out, how)
        }
        Step::All { step, train, report } => with(&step.making, &step.modes, train, &|work| {
            collect_all(work, step)?;
            encode_all(work, &step.making)?;
            train_all(work, step, train)?;
            report_all(work.paper, work.out, report)
        }),
    }
}

fn with(
    making: &Making,
    modes: &[String],
    train: &HowToTrain,
    f: &dyn Fn(&Work<'_>) -> Result<()>,
) -> Result<()> {
    let mut paper: Paper = description::read(&making.places.description)?;
    if let Some(runs) = train.runs {
        ensure!(runs > 0, "--runs is 0; at least 1 is needed");
        paper.runs = runs;
    }
    let stop = interrupt::flag()?;
    let pool = thread_pool(making.threads)?;
    let selection = Selection { data_sets: making.data_sets.clone(), modes: modes.to_vec() };
    if let Some(mode) =
        modes.iter().find(|m| !description::RAYCASTER_MODES.contains(&m.as_str()) && *m != description::YT)
    {
        anyhow::bail!("--modes names {mode:?}; none, local, scatter and yt are accepted");
    }
    if let Some(minutes) = making.budget {
        ensure!(
            minutes.is_finite() && minutes > 0.0 && minutes < 1e6,
            "--budget is {minutes}; a positive number of minutes is needed"
        );
    }
    let deadline = making.budget.map(|minutes| Instant::now() + Duration::from_secs_f64(60.0 * minutes));
    let interrupted = || interrupt::requested(&stop);
    f(&Work {
        paper: &paper,
        selection: &selection,
        data: &making.data,
        out: &making.places.out,
        python: &making.python,
        pool: &pool,
        deadline,
        interrupted: &interrupted,
    })
}

fn found(work: &Work<'_>) -> Result<Vec<Place>> {
    places(work.paper, work.selection, work.data)
}

fn collect_all(work: &Work<'_>, step: &StepOptions) -> Result<()> {
    let places = found(work)?;
    let mut renderer = match &work.paper.teacher {
        Some(path) => {
            let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
            Box::new(Teacher::new(&name, &open_model(path)?)?) as Box<dyn Renderer>
        }
        None => open_renderer(step.device)?,
    };
    collect::collect(work, &places, renderer.as_mut())?;
    places.iter().try_for_each(|p| yt::collect(work, p))
}

fn encode_all(work: &Work<'_>, making: &Making) -> Result<()> {
    encode::encode(work, &found(work)?, making.threads)
}

fn train_all(work: &Work<'_>, step: &StepOptions, how: &HowToTrain) -> Result<()> {
    let wanted = |p: Panel| how.only.is_empty() || how.only.contains(&p);
    train::train(work, &how.only)?;
    trials::run(work, &how.only)?;
    if how.only.contains(&Panel::Improved) {
        improved::run(work)?;
    }
    if wanted(Panel::Pictures) {
        let mut renderer = open_renderer(step.device)?;
        pictures::draw(work, &found(work)?, renderer.as_mut())?;
    }
    if wanted(Panel::Renderings) {
        let mut renderer = open_renderer(step.device)?;
        pictures::draw_renderings(work, &found(work)?, renderer.as_mut())?;
    }
    if wanted(Panel::Balancing) {
        balance(work)?;
    }
    if wanted(Panel::Steering) {
        steer(work, step)?;
    }
    Ok(())
}

/// The paper's use case 2, load balancing: assigns tasks by the paper's method, and writes a separate report
/// of all methods of `entire-lab farm`.
fn balance(work: &Work<'_>) -> Result<()> {
    cases::balance(work.out, &work.paper.orbit)?;
    let recorded = Path::new(STEERING_DATA).join("farm.json.gz");
    if recorded.exists() {
        cases::balance_recorded(work, &recorded)?;
    }
    for (set, mode) in work.paper.panels.get(&Panel::Varied).into_iter().flatten() {
        let tasks = cases::tasks_path(work.out, set, mode);
        if tasks.exists() {
            let report = work.out.join("cases").join(format!("farm-{set}-{mode}"));
            compare(&read_tasks(&tasks)?, tasks.display().to_string(), &report)?;
        }
    }
    Ok(())
}

/// The paper's use case 1, steering: replays recorded paths of a data set under every controller with the
/// paper's network, and under the controller `hybrid` with our predictor.
fn steer(work: &Work<'_>, step: &StepOptions) -> Result<()> {
    let calibration = Path::new(STEERING_DATA).join("calibration.csv.gz");
    let folder = Path::new(STEERING_DATA).join("traces");
    let Some((set, mode)) = work.paper.panels.get(&Panel::Steering).and_then(|p| p.first()) else {
        return Ok(());
    };
    let network =
        if calibration.exists() && folder.is_dir() { trials::steering_network(work, mode)? } else { None };
    let Some(network) = network else {
        note(&format!(
            "use case 1 is skipped: it needs recorded paths and calibration frames in {STEERING_DATA} (make \
             steer-traces STEER_OUT=data/steer) and the frames on which its network is trained"
        ));
        return Ok(());
    };
    let traces = control::traces_of(&folder, set)?;
    let tuned = trials::tuned_network(work, &network, &calibration)?;
    let options = |out: &str, model: Option<PathBuf>, controllers: &[ControllerKind]| replay::Options {
        paths: replay::Paths {
            traces: traces.clone(),
            calibration: vec![calibration.clone()],
            targets: ["5fps", "10fps", "20fps", "40fps"].map(str::to_owned).to_vec(),
        },
        disturbance: None,
        ignore_load: false,
        model,
        controllers: controllers.to_vec(),
        rounds: 1,
        out: work.out.join("cases").join(out),
        bars: false,
    };
    let by_network = options("steering", Some(network), ControllerKind::value_variants());
    let by_tuned =
        options("steering-tuned", Some(tuned), &[ControllerKind::Algorithm1, ControllerKind::Hybrid]);
    let by_ours = options("steering-ours", None, &[ControllerKind::Hybrid]);
    [&by_network, &by_tuned, &by_ours].into_iter().try_for_each(replay::run)?;
    let mut renderer = open_renderer(step.device)?;
    let replays = [&*by_network.out, &*by_tuned.out, &*by_ours.out];
    control::keep(work, (&traces, &calibration), replays, (set, mode), renderer.as_mut())
}

fn report_all(paper: &Paper, out: &Path, how: &HowToReport) -> Result<()> {
    let started = Instant::now();
    let material = results::material(paper, out, how.kept.as_deref())?;
    if let Some(path) = &how.keep {
        results::keep_material(&material, path)?;
        println!("wrote {}", path.display());
    }
    if let Some(pages) = &how.book {
        report::write_book(paper, &material, pages)?;
        println!("wrote {}", pages.join(report::BOOK_PAGE).display());
    }
    let found = report::write(paper, &material, out, started)?;
    println!("wrote {}", out.join("report.html").display());
    if how.bars {
        bars::print(&found)?;
    }
    Ok(())
}
