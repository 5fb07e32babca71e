//! `entire explore`: an interactive window that shows a volume at a target frame time.

#[cfg(feature = "explore")]
mod host;

use crate::steering::contenders::ControllerKind;
use anyhow::{Context, Result};
use entire_core::scene::{Shading, Skipping};
use entire_io::dataset::ensure_no_table;
use entire_io::options::{check_termination, parse_size, parse_target, shade_parser, skip_parser};
use entire_io::volume::Reading;
use std::path::PathBuf;

/// View a volume in an interactive window that holds a target frame time.
///
/// The time of every frame is predicted before the frame is drawn, and the measured time corrects later
/// predictions; a graph shows both times beside the target. While nothing changes, the picture is refined to
/// full quality, in time slices that are no longer than the target. Without --model, the model of this
/// machine is used (`entire calibrate --clock wall`), else the shipped model. Drag to turn, shift-drag to
/// pan, scroll to zoom, F to fly, 1 2 3 to look along an axis, R to reset, Ctrl+Z to undo an edit of the
/// transfer function.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire explore data/nyx_cosmology/m01/t0010.nrrd
  entire explore ct.nii.gz --target 60fps --shade local --skip distance
  entire explore t1.nrrd t2.nrrd t3.nrrd --model out/calibrated.safetensors
  xvfb-run -s '-screen 0 1280x900x24' entire explore skull.nrrd \\
      --script events.jsonl --log frames.csv")]
pub(crate) struct Options {
    /// The volume file, or the files of a time series in order; without a file, the window is empty.
    #[arg(value_name = "VOLUME")]
    pub(crate) volumes: Vec<PathBuf>,
    /// Options for reading the volumes.
    #[command(flatten)]
    pub(crate) reading: Reading,
    /// Target frame time: 33ms, 0.033s or 30fps.
    #[arg(long, default_value = "33ms", value_name = "TIME", allow_hyphen_values = true)]
    pub(crate) target: String,
    /// Model file, calibrated to this machine; default: the machine's model (`entire calibrate --clock
    /// wall`), else the shipped model, corrected by the measured time of every frame.
    #[arg(long, value_name = "M.safetensors")]
    pub(crate) model: Option<PathBuf>,
    /// Controller at the start. Controllers that act on image resolution in `entire steer` change the ray
    /// step here.
    #[arg(long, value_enum, default_value_t = ControllerKind::Hybrid)]
    pub(crate) controller: ControllerKind,
    /// Shading of each sample.
    #[arg(long, value_parser = shade_parser(), default_value = "none")]
    pub(crate) shade: Shading,
    /// Skipping of empty space.
    #[arg(long, value_parser = skip_parser(), default_value = "blocks")]
    pub(crate) skip: Skipping,
    /// Accumulated opacity at which a ray stops; 1 for never.
    #[arg(long, default_value_t = 0.99, value_name = "OPACITY", allow_hyphen_values = true)]
    pub(crate) termination: f32,
    /// Size of the window, pixels.
    #[arg(long, default_value = "1280x800", value_name = "WxH", value_parser = parse_size)]
    pub(crate) size: (u32, u32),
    /// Play events from a file (JSON lines, see the book) instead of user input.
    #[arg(long, value_name = "FILE.jsonl")]
    pub(crate) script: Option<PathBuf>,
    /// Write a CSV file with a row for each frame (seconds, prediction, step, memory), each loaded volume,
    /// each view that was refined to full quality, and each action `full_frame` of --script.
    #[arg(long, value_name = "FILE.csv")]
    pub(crate) log: Option<PathBuf>,
}

pub(crate) fn run(options: &Options) -> Result<()> {
    let target = parse_target(&options.target).context("--target")?;
    check_termination(options.termination)?;
    if let Some(log) = &options.log {
        ensure_no_table(log).context("--log")?;
    }
    open(options, target)
}

/// Refuses, since a build without the feature `explore` has no window.
#[cfg(not(feature = "explore"))]
fn open(_: &Options, _: f64) -> Result<()> {
    anyhow::bail!(
        "this `entire` was built without its window; build it with `make explore`, or with `cargo install \
         --path cli --features explore`"
    )
}

#[cfg(feature = "explore")]
fn open(options: &Options, target: f64) -> Result<()> {
    if let Some(log) = &options.log {
        let inputs = options.volumes.iter().chain(&options.model).chain(&options.script);
        entire_io::files::ensure_not_input(log, inputs.map(PathBuf::as_path)).context("--log")?;
        entire_io::files::make_folder_of(log)?;
    }
    let model = match &options.model {
        Some(file) => Some((file.display().to_string(), entire_io::files::open_model(file)?)),
        None => None,
    };
    let window = entire_explore::Options {
        volumes: options.volumes.clone(),
        target,
        controller: options.controller.name().to_owned(),
        shading: options.shade,
        skipping: options.skip,
        termination: options.termination,
        size: options.size,
        script: options.script.clone(),
        log: options.log.clone(),
    };
    entire_explore::run(
        window,
        std::sync::Arc::new(host::ExplorerHost { model, reading: options.reading.clone() }),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        options: Options,
    }

    fn said(arguments: &[&str]) -> String {
        let line = Line::try_parse_from([&["explore"], arguments].concat()).unwrap();
        format!("{:#}", run(&line.options).unwrap_err())
    }

    #[test]
    fn options_are_checked_before_a_window_opens() {
        assert!(said(&["--target", "5 bananas"]).contains("--target"));
        assert!(said(&["--termination", "0"]).contains("above 0 and at most 1"));
        let folder = tempfile::tempdir().unwrap();
        let table = folder.path().join("t.csv");
        drop(entire_io::dataset::Writer::create(&table).unwrap());
        let kept = std::fs::read(&table).unwrap();
        let refused = said(&["--log", table.to_str().unwrap()]);
        assert!(refused.starts_with("--log: ") && refused.contains("is a timing table"), "{refused}");
        assert_eq!(std::fs::read(&table).unwrap(), kept);
    }

    #[cfg(not(feature = "explore"))]
    #[test]
    fn a_build_without_the_window_says_how_to_get_it() {
        assert!(said(&[]).contains("--features explore"));
    }
}
