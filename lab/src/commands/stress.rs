//! `entire-lab stress`: scenes in which methods of holding a frame time fail.

use crate::bars;
use crate::stress::{self, Verdict, bars_on_device, harmless};
use anyhow::{Result, ensure};
use clap::ValueEnum;
use entire_cli::steering::contenders::ControllerKind;
use entire_io::clock::{ClockChoice, clock_parser, waited_for};
use entire_io::dataset::Clock;
use entire_io::files::{make_folder, write_json};
use entire_io::machine::Provenance;
use entire_io::options::{Device, open_renderer};
use entire_io::progress::progress_bar;
use entire_report::{Page, Table};
use entire_vk_raycaster::Renderer;
use serde_json::json;
use std::path::PathBuf;

/// Number of disturbed frames in scene 27, the long run.
const LONG_RUN: u64 = 1_000_000;

/// Play the stress scenes: scripts in which methods of holding a frame time are known to fail.
///
/// The clock of the scenes is scripted, so all runs give the same times. Each scene has a rule for passing.
/// Prints the matrix of scenes and methods, writes report.html and verdicts.json into DIR, and fails when
/// entire's controller fails a scene. The goals (bars) cover all scenes. If only some scenes are played,
/// goals are printed as missed, but do not change the exit status.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire-lab stress --out out/stress
  entire-lab stress --scenes 1,17,22 --out out/stress
  entire-lab stress --device vulkan --clock cpu --out out/stress")]
pub(crate) struct Options {
    /// Numbers of the scenes; default: all.
    #[arg(long, value_delimiter = ',', value_name = "N,…")]
    pub(crate) scenes: Vec<usize>,
    /// Also play on this device the scenes that can be played on a real renderer, timed by --clock.
    #[arg(long, value_enum)]
    pub(crate) device: Option<Device>,
    /// Clock of frame times on that device; `auto`: the device's timestamps on a GPU, else wall time.
    #[arg(long, value_parser = clock_parser(), default_value = "auto", requires = "device")]
    pub(crate) clock: ClockChoice,
    /// Folder for the results.
    #[arg(long, default_value = "out/stress", value_name = "DIR")]
    pub(crate) out: PathBuf,
}

pub(crate) fn run(options: &Options) -> Result<()> {
    let all: Vec<usize> = stress::scenes().map(|s| s.0).collect();
    let scenes = if options.scenes.is_empty() { &all } else { &options.scenes };
    for n in scenes {
        ensure!(all.contains(n), "--scenes names {n}; scenes are numbered 1 to {}", all.len());
    }
    let methods = ControllerKind::value_variants();
    let play = |methods: &[ControllerKind], real: Option<(&mut dyn Renderer, Clock)>| {
        let bar = progress_bar("stress");
        let verdicts = stress::run(scenes, methods, LONG_RUN, real, &bar);
        bar.finish_and_clear();
        verdicts
    };
    let verdicts = play(methods, None)?;
    let mut name = "scripted clock; the CPU version of the raycaster counts the work".to_owned();
    let mut real = Vec::new();
    // Two controllers play on a real renderer: OLP only reacts, hybrid predicts and reacts.
    let real_methods = [ControllerKind::Olp, ControllerKind::Hybrid];
    if let Some(device) = options.device {
        let mut renderer = open_renderer(device)?;
        let clock = waited_for(options.clock, renderer.as_ref());
        real = play(&real_methods, Some((renderer.as_mut(), clock)))?;
        name = format!("{name}; real: {}, clock {}", renderer.device(), clock.name());
    }
    make_folder(&options.out)?;
    let found = json!({ "scripted": verdicts, "real": real });
    write_json(&options.out.join("verdicts.json"), &found)?;
    page(&verdicts, methods, (&real, &real_methods), &name).write(&options.out.join("report.html"))?;
    println!("{}", matrix(&verdicts, methods).to_text());
    if !real.is_empty() {
        println!("On a real renderer ({name}):\n{}", matrix(&real, &real_methods).to_text());
    }
    println!("Report: {}", options.out.join("report.html").display());
    let mut found = stress::bars(&verdicts);
    if options.device.is_some() {
        found.extend(bars_on_device(&real));
    }
    let met = bars::print(&found);
    let ours = |played: &[Verdict], where_: &str| -> Vec<String> {
        played
            .iter()
            .filter(|v| v.is_ours() && !v.passed())
            .map(|v| format!("{}{where_} ({})", v.scene, v.failures.join("; ")))
            .collect()
    };
    let mut failed = ours(&verdicts, "");
    failed.extend(ours(&real, " on the device"));
    ensure!(failed.is_empty(), "scenes that the hybrid fails: {}", failed.join(", "));
    if all.iter().all(|n| scenes.contains(n)) {
        let harmless = harmless(&verdicts);
        ensure!(harmless.is_empty(), "scenes that no other method fails: {harmless:?}");
        met?;
    }
    Ok(())
}

/// Table with a row per scene and a column per method: `ok`, or the first failure.
fn matrix(verdicts: &[Verdict], methods: &[ControllerKind]) -> Table {
    let columns: String = methods.iter().map(|m| format!(" | {}", m.name())).collect();
    let mut table = Table::headed(&format!("## | scene{columns}"));
    for (number, title) in stress::scenes().filter(|s| verdicts.iter().any(|v| v.scene == s.0)) {
        let mut row = vec![number.to_string().into(), title.into()];
        for method in methods {
            let text = match verdicts.iter().find(|v| v.scene == number && v.method == method.name()) {
                Some(v) if v.passed() => "ok".to_owned(),
                Some(v) => v.failures[0].clone(),
                None => "-".to_owned(),
            };
            row.push(text.into());
        }
        table.row(row);
    }
    let mut row = vec!["".into(), "passed".into()];
    for method in methods {
        let mine: Vec<&Verdict> = verdicts.iter().filter(|v| v.method == method.name()).collect();
        row.push(format!("{} of {}", mine.iter().filter(|v| v.passed()).count(), mine.len()).into());
    }
    table.row(row);
    table
}

/// The report as a page.
///
/// `real` are verdicts of scenes that were also played on a real renderer, under `real_methods`.
fn page(
    verdicts: &[Verdict],
    methods: &[ControllerKind],
    (real, real_methods): (&[Verdict], &[ControllerKind]),
    device: &str,
) -> Page {
    let mut page = Page::new(
        "Stress scenes",
        "Scenes in which methods of holding a frame time are known to fail, on a scripted clock that is the \
         same in every run, each with a rule for passing (docs/src/stress.md).",
    );
    page.table(
        &matrix(verdicts, methods),
        "First failure of each method in each scene, or ok without a failure. T is the target; shares are of \
         the frames in which the coarsest step meets it.",
    );
    if !real.is_empty() {
        page.heading("On a real renderer");
        page.table(
            &matrix(real, real_methods),
            "The scenes that can be played on a real renderer, with images four times as wide and high and a \
             real clock. Because of the clock's noise, the limits are wider than those of the rules: the \
             share of frames over 1.1 T may be 5 percentage points higher, with two more in a row; quality \
             may be 0.1 lower; and 80 % of first frames inside the bound are enough.",
        );
    }
    page.heading("All failures");
    let mut failed = Table::headed("## | method | failures");
    for v in verdicts.iter().filter(|v| !v.passed()) {
        failed.row(vec![v.scene.to_string().into(), v.method.into(), v.failures.join("; ").into()]);
    }
    page.table(&failed, "");
    page.facts(Provenance::of(device.to_owned()).facts());
    page
}
