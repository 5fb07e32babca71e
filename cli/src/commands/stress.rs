//! `entire stress`: scenes in which methods of holding a frame time break.

use crate::commands::collect::progress_bar;
use crate::steering::contenders::ControllerKind;
use crate::stress::report::{matrix, page};
use crate::stress::{SCENES, run as play};
use anyhow::{Context, Result, ensure};
use clap::ValueEnum;
use std::path::PathBuf;

/// Play the stress scenes: each method against scripts of what is known to break it.
///
/// 28 scenes on a scripted clock, the same in every run, each with a rule that says what passes. Prints the matrix of
/// scenes and methods, writes report.html and verdicts.json into DIR, and fails when ours fails a scene.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire stress --out out/stress
  entire stress --scenes 1,17,22 --controllers olp,hybrid --out out/stress")]
pub struct Options {
    /// Numbers of the scenes; all where none is named.
    #[arg(long, value_delimiter = ',', value_name = "N,…")]
    pub scenes: Vec<usize>,
    /// Who plays; everyone where none is named.
    #[arg(long, value_enum, value_delimiter = ',', value_name = "NAME,…")]
    pub controllers: Vec<ControllerKind>,
    /// Frames of the long run.
    #[arg(long, default_value_t = 1_000_000, value_name = "FRAMES")]
    pub soak: u64,
    /// Folder for the results.
    #[arg(long, default_value = "out/stress", value_name = "DIR")]
    pub out: PathBuf,
}

/// Runs the command.
///
/// # Errors
/// Bad options, files that cannot be written, or a scene that ours fails.
pub fn run(options: &Options) -> Result<()> {
    let scenes: Vec<usize> = if options.scenes.is_empty() {
        SCENES.iter().map(|s| s.number).collect()
    } else {
        options.scenes.clone()
    };
    for n in &scenes {
        ensure!(SCENES.iter().any(|s| s.number == *n), "--scenes names {n}; scenes are numbered 1 to 28");
    }
    ensure!(
        (1_000..=100_000_000).contains(&options.soak),
        "--soak is {}; it must lie in 1000 to 100000000 frames",
        options.soak
    );
    let methods: Vec<ControllerKind> = if options.controllers.is_empty() {
        ControllerKind::value_variants().to_vec()
    } else {
        options.controllers.clone()
    };
    let bar = progress_bar("stress");
    let verdicts = play(&scenes, &methods, options.soak, &bar);
    bar.finish_and_clear();
    let verdicts = verdicts?;
    std::fs::create_dir_all(&options.out)
        .with_context(|| format!("cannot make the folder {}", options.out.display()))?;
    let json = options.out.join("verdicts.json");
    std::fs::write(&json, serde_json::to_string_pretty(&verdicts)? + "\n")
        .with_context(|| format!("cannot write {}", json.display()))?;
    page(&verdicts, &methods, "scripted clock; the raycaster's CPU twin counts work")
        .write(&options.out.join("report.html"))?;
    println!("{}", matrix(&verdicts, &methods).to_text());
    println!("Report: {}", options.out.join("report.html").display());
    let failed: Vec<String> = verdicts
        .iter()
        .filter(|v| v.method == ControllerKind::Hybrid.name() && !v.passed())
        .map(|v| format!("{} ({})", v.scene, v.failures.join("; ")))
        .collect();
    if methods.contains(&ControllerKind::Hybrid) {
        println!(
            "bar stress-scenes-passed {} {} {}",
            scenes.len() - failed.len(),
            scenes.len(),
            if failed.is_empty() { "ok" } else { "short" }
        );
    }
    ensure!(failed.is_empty(), "scenes that ours fails: {}", failed.join(", "));
    Ok(())
}
