//! `entire-lab gpu-study`: measures a device within a time limit of a few minutes.

use crate::bars::{self, Bar};
use crate::gpu::pictures::{Difference, compare};
use crate::gpu::report::{Found, MODES};
use crate::gpu::steps::{self, Extent, Step, calibrated_with, held_out};
use crate::gpu::{Outcome, Outcomes, State};
use anyhow::{Context, Result};
use clap::ValueEnum;
use entire_io::clock::fixed_parser;
use entire_io::dataset::{Clock, Table};
use entire_io::files::{make_folder, read_text, write_json};
use entire_io::interrupt;
use entire_io::metrics::median;
use entire_io::options::Device;
use entire_io::progress::progress_bar;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

/// Measure a device: pictures, rates, timing tables, models and steering, in one report.
///
/// Takes at most --seconds. A step that runs out of time is cut short or skipped, and the report names it;
/// the same command with the same --out completes the missing steps. Needs no network: `make
/// gpu-study-folder` puts everything into one folder that can be copied to another machine.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire-lab gpu-study --out out/gpu-study
  entire-lab gpu-study --short --device vulkan --seconds 120 --out out/gpu-short
  ENTIRE_DEVICE=NVIDIA entire-lab gpu-study --out nvidia")]
pub(crate) struct Options {
    /// The renderer.
    #[arg(long, value_enum, default_value = "vulkan")]
    pub(crate) device: Device,
    /// The clock of frame times.
    #[arg(long, value_parser = fixed_parser(), default_value = "device")]
    pub(crate) clock: Clock,
    /// Limit of wall seconds for all steps.
    #[arg(long, default_value_t = 530.0, value_name = "SECONDS")]
    pub(crate) seconds: f64,
    /// Shading modes to study.
    #[arg(long, value_delimiter = ',', default_values = MODES, value_parser = MODES, value_name = "SHADE,…")]
    pub(crate) shade: Vec<String>,
    /// Use small images and few frames, for a quick test on a software driver.
    #[arg(long)]
    pub(crate) short: bool,
    /// The folder with the project's volumes.
    #[arg(long, default_value = "data", value_name = "DIR")]
    pub(crate) data: PathBuf,
    /// Folder for the results.
    #[arg(long, default_value = "out/gpu-study", value_name = "DIR")]
    pub(crate) out: PathBuf,
}

/// Context of a run: options, deadline, outcomes.
struct Study<'a> {
    options: &'a Options,
    entire: PathBuf,
    deadline: Instant,
    stop: std::sync::Arc<AtomicBool>,
    outcomes: Outcomes,
    bar: indicatif::ProgressBar,
}

impl Study<'_> {
    fn keep(&mut self, outcome: Outcome) -> Result<()> {
        self.bar.println(format!(
            "{:<24} {:<10} {:6.1} s",
            outcome.step,
            outcome.state.name(),
            outcome.seconds
        ));
        self.outcomes.keep(outcome, &self.options.out)
    }

    fn run(&mut self, step: &Step) -> Result<()> {
        self.bar.set_message(step.name.clone());
        if self.outcomes.has(&step.name, &step.arguments) {
            return Ok(());
        }
        self.keep(steps::run(step, &self.entire, &self.options.out, self.deadline, &self.stop)?)
    }

    fn pictures(&mut self, device: &str, volumes: &[PathBuf], extent: Extent) -> Result<()> {
        let arguments = vec![device.to_owned(), extent.picture.to_string()];
        if self.outcomes.has("pictures", &arguments) {
            return Ok(());
        }
        self.bar.set_message("pictures");
        let begin = Instant::now();
        let folder = self.options.out.join("pictures");
        make_folder(&folder)?;
        let compared =
            compare(self.options.device, &volumes[..volumes.len().min(2)], extent.picture, &folder);
        let (state, said) = match &compared {
            Ok(found) => (State::Done, format!("{} pictures", found.len())),
            Err(error) => (State::Failed, format!("{error:#}")),
        };
        if let Ok(found) = &compared {
            write_json(&self.options.out.join("pictures.json"), found)?;
        }
        let seconds = begin.elapsed().as_secs_f64();
        self.keep(Outcome { step: "pictures".into(), arguments, state, seconds, said })
    }
}

fn json(path: &Path) -> Option<Value> {
    serde_json::from_str(&read_text(path, 1 << 24).ok()?).ok()
}

/// Reads the results in a folder.
fn found(out: &Path, outcomes: Outcomes, clock: Clock) -> Found {
    let mut tables = Vec::new();
    let mut evaluations = Vec::new();
    for mode in MODES {
        for kind in ["frames", "large"] {
            let table = out.join(format!("{kind}-{mode}.csv"));
            if let Ok(table) = Table::read_without_features(&table, 0) {
                tables.push((kind, mode, table.frames));
            }
            let evaluated = out.join(format!("evaluated-{kind}-{mode}")).join("evaluation.json");
            evaluations.extend(json(&evaluated).map(|v| (kind, mode, v)));
        }
    }
    let pictures: Option<Vec<Difference>> =
        json(&out.join("pictures.json")).and_then(|v| serde_json::from_value(v).ok());
    Found {
        outcomes,
        probe: json(&out.join("probe.json")),
        pictures: pictures.unwrap_or_default(),
        tables,
        evaluations,
        switches: json(&out.join("switches").join("summary.json")),
        clock,
    }
}

/// Returns the target of the study's command `steer`, in seconds: half of the median time of frames. The
/// frames are those with a third to three times as many pixels as the command's images; if there are none,
/// all frames.
fn target(out: &Path, clock: Clock, extent: Extent) -> Option<f64> {
    let table = Table::read_without_features(&out.join("frames-none.csv"), 0).ok()?;
    let pixels = u64::from(extent.held_size).pow(2);
    let near = pixels / 3..=pixels * 3;
    let of = |near_only: bool| -> Vec<f64> {
        let wanted = table.frames.iter().filter(|f| !near_only || near.contains(&f.scene.pixels()));
        wanted.filter_map(|f| f.seconds(clock)).collect()
    };
    let half = |mut seconds: Vec<f64>| median(&mut seconds).map(|m| 0.5 * m);
    half(of(true)).or_else(|| half(of(false)))
}

pub(crate) fn run(options: &Options) -> Result<()> {
    anyhow::ensure!(!options.seconds.is_nan(), "--seconds is no number; give the limit in wall seconds");
    let extent = if options.short { Extent::SHORT } else { Extent::FULL };
    let volumes = held_out(&options.data)?;
    let calibrated = calibrated_with(&options.data, extent.calibration_volumes)?;
    let program = std::env::current_exe().context("cannot find the folder of this program")?;
    let entire = program.with_file_name("entire");
    anyhow::ensure!(entire.is_file(), "{} does not exist; build it beside this program", entire.display());
    make_folder(&options.out.join("logs"))?;
    let bar = progress_bar("gpu-study");
    let mut study = Study {
        options,
        entire,
        deadline: Instant::now() + Duration::from_secs_f64(options.seconds.clamp(1.0, 86_400.0)),
        stop: interrupt::flag()?,
        outcomes: Outcomes::of(&options.out)?,
        bar,
    };
    let named = options.device.to_possible_value().context("the device has no name among the options")?;
    let (device, clock) = (named.get_name(), options.clock);
    let mut all = vec![steps::probe(device)];
    for mode in MODES.into_iter().filter(|m| options.shade.iter().any(|s| s == m)) {
        let volumes = (&calibrated[..], &volumes[..]);
        all.extend(steps::of_mode(mode, &options.out, volumes, (device, clock.name()), extent));
    }
    study.bar.set_length(all.len() as u64 + 2);
    for (at, step) in all.iter().enumerate() {
        study.run(step)?;
        study.bar.inc(1);
        if at == 0 {
            study.pictures(device, &volumes, extent)?;
            study.bar.inc(1);
        }
        // The steering step needs the unshaded model. It runs before the steps of the other modes, since it
        // is more important than their tables.
        if step.name == "evaluate-frames-none"
            && let Some(target) = target(&options.out, clock, extent)
        {
            study.run(&steps::switches(&options.out, &volumes[0], (device, clock.name()), target, extent))?;
            study.bar.inc(1);
        }
    }
    study.bar.finish_and_clear();
    let found = found(&options.out, study.outcomes, clock);
    let rendered_by =
        found.probe.as_ref().and_then(|p| p["device"].as_str()).unwrap_or("not known").to_owned();
    let page = options.out.join("report.html");
    found.page(rendered_by).write(&page)?;
    println!("{}\n{}\n{}", found.steps().to_text(), found.times().to_text(), found.errors().to_text());
    println!("{}", found.held().to_text());
    println!("Report: {}", page.display());
    bars::print(&[
        Bar::at_most("gpu-study-steps-missing", Some(found.missing() as f64), 0.0),
        Bar::at_most("gpu-study-picture-difference-of-255", found.worst_picture().map(f64::from), 2.0),
    ])
}
