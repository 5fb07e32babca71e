//! `entire farm`: render an image database by local processes, HyperQueue or Slurm.

use crate::program::print_line;
use anyhow::{Context, Result, bail, ensure};
use clap::ValueEnum;
use entire_farm::database::{self, Database};
use entire_farm::dispatch::Order;
use entire_farm::engine::{Bundle, Engine, HyperQueue, Local, Places, Slurm};
use entire_farm::job::Job;
use entire_farm::list::MAX_NODES;
use entire_farm::planner::{Planner, Setting, State};
use entire_farm::show::{duration, parse_duration};
use entire_farm::worker::Worker;
use entire_farm::{drive, openjd, predict, report, survey};
use entire_io::files::{
    ensure_distinct, ensure_not_input, ensure_not_own, make_folder_of, note, write_whole,
};
use entire_io::machine;
use std::ffi::OsString;
use std::path::PathBuf;

/// Engine that runs the tasks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum EngineOption {
    /// Processes of this machine.
    #[default]
    Local,
    /// HyperQueue, through its Python package.
    Hyperqueue,
    /// Slurm, through its commands.
    Slurm,
}

/// Render an image database on a farm and predict when it is complete.
///
/// The job file (TOML) names volumes, cameras, transfer functions, sizes, steps and the renderer; see the
/// book's chapter on render farms. The result is a Cinema database (Specification D) with the table
/// NAME.cdb/data.csv. Finished images are recorded in NAME.cdb/.farm; --resume continues after any
/// interruption.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire farm job.toml --list
  entire farm job.toml --dry-run --deadline 2h --price 0.4
  entire farm job.toml --slots 2 --report out/farm.html
  entire farm job.toml --engine hyperqueue --slots 16 --python venv/bin/python
  entire farm job.toml --engine slurm --slots 4 --resume")]
pub(crate) struct Options {
    /// The job file (TOML).
    #[arg(value_name = "JOB.toml")]
    pub(crate) job: PathBuf,
    /// The engine that runs the tasks.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) engine: EngineOption,
    /// Number of bundles (groups of tasks) that run at once: local workers, HyperQueue workers or Slurm
    /// nodes. Default: the number of processors of this machine; for Slurm with neither --dry-run
    /// nor --openjd, the number of nodes that Slurm lists.
    #[arg(long, value_name = "N")]
    pub(crate) slots: Option<usize>,
    /// Continue an unfinished database.
    #[arg(long)]
    pub(crate) resume: bool,
    /// With --resume: try tasks again that were given up (quarantined) after failures.
    #[arg(long, requires = "resume")]
    pub(crate) retry_quarantined: bool,
    /// With --resume: read every image and compare it with its checksum.
    #[arg(long, requires = "resume")]
    pub(crate) verify: bool,
    /// Render a coarse subset first: every eighth view at the smallest size and the coarsest step.
    #[arg(long)]
    pub(crate) preview: bool,
    /// Render nothing: print the volume files in their order, with their time steps.
    #[arg(long, conflicts_with_all = ["dry_run", "openjd", "resume", "report", "save_tasks", "verify",
        "retry_quarantined", "preview", "deadline", "price", "slots", "order", "overhead"])]
    pub(crate) list: bool,
    /// Render nothing: print plan, cost and expected end.
    #[arg(long)]
    pub(crate) dry_run: bool,
    /// With --dry-run: find the smallest number of nodes that meets this deadline (90s, 30m, 2h, 1.5d).
    #[arg(long, value_name = "TIME", requires = "dry_run", value_parser = parse_duration)]
    pub(crate) deadline: Option<f64>,
    /// With --dry-run: price of a node hour.
    #[arg(long, value_name = "PRICE", requires = "dry_run")]
    pub(crate) price: Option<f64>,
    /// Order in which tasks are sent.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) order: Order,
    /// Overhead per bundle, seconds; default: the engine's usual overhead.
    #[arg(long, value_name = "SECONDS")]
    pub(crate) overhead: Option<f64>,
    /// Longest time that a bundle may request (90s, 30m, 2h). Slurm ends a bundle that takes longer than it
    /// requested. HyperQueue does not; there, `timeout_s` in the job file ends a task that hangs.
    #[arg(long, value_name = "TIME", value_parser = parse_duration)]
    pub(crate) time_limit: Option<f64>,
    /// Python with HyperQueue's package [default: python3].
    #[arg(long, value_name = "PROGRAM")]
    pub(crate) python: Option<String>,
    /// Folder of a running HyperQueue server; default: a new server with workers is started.
    #[arg(long, value_name = "DIR")]
    pub(crate) server_dir: Option<String>,
    /// Processors per HyperQueue bundle [default: 1].
    #[arg(long, value_name = "N")]
    pub(crate) cpus: Option<u32>,
    /// Additional option of sbatch, such as --sbatch=--partition=long; may be given several times.
    #[arg(long, value_name = "OPTION", allow_hyphen_values = true)]
    pub(crate) sbatch: Vec<String>,
    /// Write a report (HTML) at the end; with --dry-run, the report covers the finished tasks.
    #[arg(long, value_name = "FILE.html")]
    pub(crate) report: Option<PathBuf>,
    /// Write the tasks with their expected seconds as a list (CSV) for `entire schedule` and for `list` in
    /// the job file's table `[predict]`.
    #[arg(long, value_name = "TASKS.csv")]
    pub(crate) save_tasks: Option<PathBuf>,
    /// Render nothing: write an OpenJD job template (JSON) whose tasks are bundles of about equal expected
    /// time.
    #[arg(long, value_name = "FILE.json", conflicts_with_all = ["dry_run", "report", "save_tasks", "preview",
        "deadline", "price"])]
    pub(crate) openjd: Option<PathBuf>,
}

/// A worker of `entire farm`; engines start it.
#[derive(Debug, clap::Args)]
pub(crate) struct WorkerOptions {
    /// The state folder of the database.
    pub(crate) state: PathBuf,
    /// The worker's name.
    #[arg(long, value_name = "NAME")]
    pub(crate) node: Option<String>,
    /// Run this bundle and end; default: read bundles from standard input.
    #[arg(long, value_name = "N")]
    pub(crate) bundle: Option<u64>,
}

pub(crate) fn run(options: &Options, program: &[OsString]) -> Result<()> {
    let job = Job::open(&options.job)?;
    let given = options.slots.unwrap_or(1);
    ensure!((1..=MAX_NODES).contains(&given), "--slots is {given}; it must lie in 1 to {MAX_NODES}");
    for (option, value, what) in
        [("--price", options.price, "number"), ("--overhead", options.overhead, "number of seconds")]
    {
        let value = value.unwrap_or(0.0);
        ensure!(
            value.is_finite() && value >= 0.0,
            "{option} is {value}; it must be a finite {what} that is not negative"
        );
    }
    check_engine(options)?;
    if options.list {
        print!("{}", job.listing());
        return Ok(());
    }
    let inputs = || {
        let told = job.predict.list.iter().chain(&job.predict.model);
        let volumes = job.volumes.iter().map(|volume| &volume.path);
        std::iter::once(&options.job).chain(told).chain(volumes).map(PathBuf::as_path)
    };
    for (option, file) in
        [("--openjd", &options.openjd), ("--save-tasks", &options.save_tasks), ("--report", &options.report)]
    {
        let Some(file) = file else { continue };
        ensure_not_input(file, inputs()).context(option)?;
        make_folder_of(file)?;
        ensure_not_own(file, &job.output, &["data.csv"]).context(option)?;
    }
    let outputs: Vec<PathBuf> = options.report.iter().chain(&options.save_tasks).cloned().collect();
    ensure_distinct(&outputs)?;
    let base = predict::base(&job)?;
    if options.dry_run {
        return dry_run(&job, base, options);
    }
    let driving = database::Options {
        resume: options.resume,
        retry_quarantined: options.retry_quarantined,
        verify: options.verify,
        preview: options.preview,
        order: options.order,
        overhead: setting(options, 1).overhead,
    };
    let mut database = Database::open(&job, &driving)?;
    let places = Places { state: job.state(), program: program.to_vec() };
    if let Some(file) = &options.openjd {
        return export(&job, &database, base, &places, options, file);
    }
    let summary =
        drive::run(&mut database, base.clone(), &driving, &mut |run| engine(&places, options, run))?;
    if let Some(file) = &options.save_tasks {
        let planner = database.plan(base, setting(options, 1));
        save_tasks(&job, &planner, file)?;
    }
    print_line(format!(
        "{} of {} images, {} of them rendered in this run, which took {}",
        summary.done,
        job.len(),
        summary.now,
        duration(summary.seconds)
    ))?;
    print_line(job.output.join("data.csv").display())?;
    if let Some(file) = options.report.as_ref().filter(|_| summary.done > 0) {
        report::write(&job, file)?;
        print_line(file.display())?;
    } else if let Some(file) = &options.report {
        note(&format!("{} was not written, since no image is done", file.display()));
    }
    if let Some((task, error)) = summary.quarantined.first() {
        bail!(
            "{} tasks were given up, such as {task}: {}; their logs are in {}; --resume --retry-quarantined \
             tries them again",
            summary.quarantined.len(),
            error.lines().next().unwrap_or_default(),
            job.state().join("quarantine").display()
        );
    }
    Ok(())
}

/// Refuses options that the chosen engine or --dry-run does not use. With --openjd, --time-limit is accepted
/// for every engine.
fn check_engine(options: &Options) -> Result<()> {
    let (hyperqueue, slurm) = (EngineOption::Hyperqueue, EngineOption::Slurm);
    for (name, given, engines) in [
        ("--python", options.python.is_some(), &[hyperqueue][..]),
        ("--cpus", options.cpus.is_some(), &[hyperqueue]),
        ("--server-dir", options.server_dir.is_some(), &[hyperqueue]),
        ("--sbatch", !options.sbatch.is_empty(), &[slurm]),
        ("--time-limit", options.time_limit.is_some() && options.openjd.is_none(), &[hyperqueue, slurm]),
    ] {
        let engine =
            |e: EngineOption| e.to_possible_value().map_or(String::new(), |v| v.get_name().to_owned());
        ensure!(
            !given || engines.contains(&options.engine),
            "{name} has no effect with --engine {}; leave it out, or choose --engine {}",
            engine(options.engine),
            engines.iter().map(|e| engine(*e)).collect::<Vec<_>>().join(" or ")
        );
    }
    for (name, given) in [
        ("--verify", options.verify),
        // A dry run always counts finished tasks as done, so --resume has an effect only with
        // --retry-quarantined.
        ("--resume", options.resume && !options.retry_quarantined),
        ("--python", options.python.is_some()),
        ("--cpus", options.cpus.is_some()),
        ("--server-dir", options.server_dir.is_some()),
        ("--sbatch", !options.sbatch.is_empty()),
    ] {
        ensure!(!given || !options.dry_run, "{name} has no effect with --dry-run; leave one of the two out");
    }
    Ok(())
}

pub(crate) fn work(options: &WorkerOptions) -> Result<()> {
    let node = options
        .node
        .clone()
        .or_else(|| std::env::var("SLURMD_NODENAME").ok())
        .or_else(|| std::fs::read_to_string("/etc/hostname").ok().map(|n| n.trim().to_owned()))
        .unwrap_or_else(|| "node".to_owned());
    let mut worker = Worker::open(&options.state, node)?;
    match options.bundle {
        Some(number) => worker.bundle(number),
        None => worker.serve(),
    }
}

fn slots(options: &Options) -> usize {
    options.slots.unwrap_or_else(machine::cores)
}

fn engine(places: &Places, options: &Options, run: u64) -> Result<Box<dyn Engine>> {
    use entire_farm::engine::{HyperQueueOptions, SlurmOptions};
    Ok(match options.engine {
        EngineOption::Local => Box::new(Local::start(places.clone(), slots(options), run)?),
        EngineOption::Hyperqueue => {
            let how = HyperQueueOptions {
                python: options.python.clone().unwrap_or_else(|| "python3".into()),
                workers: slots(options),
                server_dir: options.server_dir.clone(),
                cpus: options.cpus.unwrap_or(1),
                worker_limit: options.time_limit,
            };
            Box::new(HyperQueue::start(places.clone(), how, run)?)
        }
        EngineOption::Slurm => {
            let how = SlurmOptions {
                nodes: options.slots,
                sbatch: options.sbatch.clone(),
                limit: options.time_limit,
            };
            Box::new(Slurm::start(places.clone(), how, run)?)
        }
    })
}

fn setting(options: &Options, slots: usize) -> Setting {
    Setting {
        slots,
        bound: options.engine == EngineOption::Local,
        overhead: options.overhead.unwrap_or(match options.engine {
            EngineOption::Local => Local::OVERHEAD,
            EngineOption::Hyperqueue => HyperQueue::OVERHEAD,
            EngineOption::Slurm => Slurm::OVERHEAD,
        }),
        limit: options.time_limit,
        order: options.order,
        learn: true,
    }
}

fn dry_run(job: &Job, base: Vec<f32>, options: &Options) -> Result<()> {
    let mut ended = database::ended(job)?;
    if options.retry_quarantined {
        ended.retain(|_, seconds| seconds.is_some());
    }
    let plan = |slots: usize| {
        let mut planner = database::plan_after(job, base.clone(), setting(options, slots), ended.clone());
        drive::queue(&mut planner, job, options.preview);
        planner
    };
    let setting = setting(options, slots(options));
    print!("{}", survey::text(job, &plan, setting, options.deadline, options.price));
    if let Some(file) = &options.save_tasks {
        save_tasks(job, &plan(setting.slots), file)?;
    }
    if let Some(file) = &options.report {
        report::write(job, file)?;
    }
    Ok(())
}

fn save_tasks(job: &Job, planner: &Planner, file: &std::path::Path) -> Result<()> {
    let mut table = csv::Writer::from_writer(Vec::new());
    table.write_record(["task", "predicted_s", "volume", "load_s"])?;
    for task in 0..job.len() {
        let at = job.place(task);
        table.write_record([
            format!("{:016x}", job.id(task)),
            planner.learner().seconds(task).to_string(),
            format!("{} {}", job.volumes[at.volume].name, job.volumes[at.volume].time),
            planner.loads.seconds(at.volume, false).to_string(),
        ])?;
    }
    write_whole(file, &table.into_inner()?)
}

fn export(
    job: &Job,
    database: &Database<'_>,
    base: Vec<f32>,
    places: &Places,
    options: &Options,
    file: &std::path::Path,
) -> Result<()> {
    let planner = database.plan(base, setting(options, slots(options)));
    let tasks: Vec<u32> = (0..job.len() as u32).filter(|t| planner.state(*t) == State::Idle).collect();
    let cut = openjd::cut(&planner, &tasks, 4 * slots(options), options.time_limit);
    let bundles: Vec<Bundle> = cut
        .into_iter()
        .enumerate()
        .map(|(k, tasks)| {
            let volume = planner.learner().shape().volume(tasks[0] as usize);
            let load = planner.loads.seconds(volume, false);
            let upper_s = planner.learner().upper(&tasks, 0.99) + 2.0 * load + 60.0;
            let upper_s = upper_s.min(options.time_limit.unwrap_or(f64::INFINITY));
            let orders = tasks.iter().map(|t| database.order(*t, planner.expected(*t))).collect();
            Bundle { number: (database.run() << 32) + k as u64, slot: None, orders, upper_s }
        })
        .collect();
    openjd::export(job, places, &bundles, database.run(), file)?;
    println!("{} bundles with {} tasks in all", bundles.len(), tasks.len());
    println!("{}", file.display());
    println!("to take over the rendered images: entire farm {} --resume", options.job.display());
    Ok(())
}
