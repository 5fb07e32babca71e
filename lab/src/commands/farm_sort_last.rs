//! `entire-lab farm-sort-last`: a volume too large for a node, in the simulator.

use crate::farm::bars;
use crate::farm::sort_last::{Composited, Compositing, Scene, measure};
use anyhow::{Context, Result, ensure};
use entire_core::scene::{Arcball, GaussianLobe, TransferFunction};
use entire_farm::load::Loads;
use entire_farm::simulate::{World, simulate};
use entire_io::device::{Device, open};
use entire_io::files::open_volume;
use entire_io::metrics::median;
use entire_io::volume::Reading;
use serde::Deserialize;
use std::path::PathBuf;

/// Number of views; the model is fitted to the first quarter of them.
const VIEWS: usize = 48;
/// Time to load one megabyte of a part, seconds.
const LOAD: f64 = 0.005;

/// Simulate a farm whose nodes are too small for a volume: each node of a group renders one part, and the group
/// composites the images.
///
/// Parts are rendered here, one after the other, and their times are predicted by the analytic model, which
/// is fitted to the first views. Compositing and the farm are simulated: the time of a frame is that of its
/// slowest part plus compositing, and groups of nodes take frames longest first.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  entire-lab farm-sort-last data/mr_banana.nrrd
  entire-lab farm-sort-last data/mr_banana.nrrd --nodes 32 --parts 4,8,16 --size 512")]
pub struct Options {
    /// The volume.
    #[arg(value_name = "VOLUME")]
    pub volume: PathBuf,
    /// Number of nodes of the farm.
    #[arg(long, default_value_t = 16, value_name = "N")]
    pub nodes: usize,
    /// Numbers of parts to compare; each must divide the number of nodes.
    #[arg(long, value_delimiter = ',', default_value = "2,4,8", value_name = "N")]
    pub parts: Vec<usize>,
    /// Pixels along each side.
    #[arg(long, default_value_t = 256, value_name = "N")]
    pub size: u32,
    /// Renderings of each part; the fastest counts.
    #[arg(long, default_value_t = 3, value_name = "N")]
    pub repeats: usize,
    /// Seconds per message between nodes.
    #[arg(long, default_value_t = 2e-5, value_name = "SECONDS")]
    pub latency: f64,
    /// Seconds per byte between nodes, blending included.
    #[arg(long, default_value_t = 1e-9, value_name = "SECONDS")]
    pub per_byte: f64,
    /// Table of measured compositing times, to which latency and seconds per byte are fitted, instead of --latency
    /// and --per-byte: columns parts, pixels, seconds.
    #[arg(long, value_name = "CSV")]
    pub composited: Option<PathBuf>,
    /// The renderer of the parts.
    #[arg(long, value_enum, default_value_t = Device::Cpu)]
    pub device: Device,
}

#[derive(Deserialize)]
struct Row {
    parts: usize,
    pixels: u64,
    seconds: f64,
}

/// Runs `entire-lab farm-sort-last`.
///
/// # Errors
/// When an option is out of range, the volume cannot be read or cut, or rendering fails.
pub fn run(options: &Options) -> Result<()> {
    for (name, value) in [("--latency", options.latency), ("--per-byte", options.per_byte)] {
        ensure!(value.is_finite() && value >= 0.0, "{name} is {value}; it must not be negative");
    }
    for parts in &options.parts {
        ensure!(
            *parts > 0 && options.nodes.is_multiple_of(*parts),
            "--parts has {parts}, which does not divide the {} nodes",
            options.nodes
        );
    }
    let compositing = match &options.composited {
        Some(file) => {
            let mut reader =
                csv::Reader::from_path(file).with_context(|| format!("cannot read {}", file.display()))?;
            let rows = reader.deserialize::<Row>().collect::<Result<Vec<_>, _>>();
            let rows = rows.with_context(|| format!("{}", file.display()))?;
            let of = |r: &Row| Composited { parts: r.parts, pixels: r.pixels, seconds: r.seconds };
            Compositing::fit(&rows.iter().map(of).collect::<Vec<_>>())
                .with_context(|| format!("{}", file.display()))?
        }
        None => Compositing { latency: options.latency, per_byte: options.per_byte },
    };
    let volume = open_volume(&options.volume, &Reading::default())?;
    let lobes = vec![GaussianLobe { center: 0.4, width: 0.01, height: 0.1 }];
    let scene = Scene {
        volume: volume.view(),
        table: TransferFunction::Gaussian(lobes).to_table()?,
        // Views at golden angles, from three distances.
        poses: (0..VIEWS)
            .map(|i| {
                let high = (i as f32 + 0.5) / VIEWS as f32;
                Arcball {
                    rx: high.asin().to_degrees(),
                    ry: (i as f32 * 137.507_77) % 360.0,
                    dz: [2.0, 2.5, 3.0][i % 3],
                }
            })
            .collect(),
        size: [options.size; 2],
    };
    let mut renderer = open(options.device)?;
    let pixels = u64::from(options.size).pow(2);
    println!(
        "simulated: {} nodes; compositing {:.1} us per message, {:.2} ns per byte ({}); parts rendered by {}",
        options.nodes,
        1e6 * compositing.latency,
        1e9 * compositing.per_byte,
        if options.composited.is_some() { "fitted" } else { "given, not measured" },
        renderer.device()
    );
    for &parts in &options.parts {
        let found = measure(&scene, parts, VIEWS / 4, options.repeats, renderer.as_mut(), 0.99)?;
        let (predicted, measured) = found.frames(&compositing, pixels);
        let mut errors: Vec<f64> =
            predicted.iter().zip(&measured).map(|(p, m)| (p / m - 1.0).abs()).collect();
        let load = LOAD * found.bytes as f64 / 1e6;
        let groups = options.nodes / parts;
        let end = |base: &[f64]| {
            let volume = vec![0; base.len()];
            let mut planner = bars::plan(base, &volume, Loads::known(vec![load]), bars::setting(groups));
            let world = World {
                seconds: measured.clone(),
                volume,
                load_cold: vec![load],
                load_warm: vec![load],
                speeds: vec![1.0; groups],
                bound: true,
                ..World::default()
            };
            simulate(&mut planner, &world, &[]).makespan
        };
        let mean = measured.iter().sum::<f64>() / measured.len() as f64;
        println!(
            "simulated: {parts} parts of at most {:.1} MB, {groups} groups: frame {:.2} ms, of it compositing {:.2} \
             ms; slowest part {:.2} times the mean; predicted frames off by {:.1} % at the median; {} frames in {:.3} \
             s, {:.4} times what measured times would give",
            found.bytes as f64 / 1e6,
            1e3 * mean,
            1e3 * compositing.seconds(parts, pixels),
            found.imbalance(),
            100.0 * median(&mut errors).unwrap_or(f64::NAN),
            measured.len(),
            end(&predicted),
            end(&predicted) / end(&measured)
        );
    }
    Ok(())
}
