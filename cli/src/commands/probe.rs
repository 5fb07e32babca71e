//! `entire probe`: the rates of this machine for rays, samples and skips.

use anyhow::{Context, Result};
use entire_io::options::{Device, open_renderer};
use entire_vk_raycaster::{Probe, ProbeOptions, WorkCounts, probe};
use serde_json::json;
use std::fmt::Write as _;

/// Measure the rates of this machine: rays, samples and skips of empty space per second.
///
/// Renders built-in scenes, and compares the picture of one scene with the picture that the CPU version of
/// the raycaster draws. Prints the device, its limits and the quality of its timestamps. Then prints five
/// numbers: the fixed time per frame, and four rates per second. The rates are rays, coherent samples (nearly
/// parallel rays of equal length), divergent samples (a wide field of view, rays of random lengths), and
/// skips of empty blocks. The exit status is 1 if the compared pictures differ by more than 2 of 255 levels
/// in a channel, or by more than 0.1 levels on average.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire probe
  entire probe --device cpu --json
  ENTIRE_DEVICE=llvmpipe entire probe --device vulkan --repeats 21")]
pub(crate) struct Options {
    /// The renderer.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) device: Device,
    /// Images grow until a frame takes this many milliseconds, so that the clock is precise enough.
    #[arg(long, default_value_t = 20.0, value_name = "MS", value_parser = parse_milliseconds)]
    pub(crate) frame_ms: f64,
    /// Number of timed frames of each scene; their median time is used.
    #[arg(
        long,
        default_value_t = 9,
        value_name = "N",
        value_parser = clap::value_parser!(u32).range(1..=1000)
    )]
    pub(crate) repeats: u32,
    /// Print a JSON object.
    #[arg(long)]
    pub(crate) json: bool,
}

fn parse_milliseconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(ms) if (0.1..=1000.0).contains(&ms) => Ok(ms),
        _ => Err("a frame time from 0.1 to 1000 milliseconds is expected".to_owned()),
    }
}

/// Limit of the largest difference from the CPU version's picture, on a scale of 0 to 255.
const MAX_DIFFERENCE: u8 = 2;

/// Limit of the mean difference from the CPU version's picture, on a scale of 0 to 255.
const MEAN: f64 = 0.1;

pub(crate) fn run(options: &Options) -> Result<()> {
    let mut renderer = open_renderer(options.device)?;
    let options_of_probe =
        ProbeOptions { frame_seconds: options.frame_ms * 1e-3, repeats: options.repeats as usize };
    let found = probe(&mut *renderer, options_of_probe).context("the probe could not be rendered")?;
    let text = if options.json { as_json(&found) } else { as_text(&found) };
    println!("{text}");
    let (largest, mean) = (found.agreement.largest, found.agreement.mean);
    anyhow::ensure!(
        largest <= MAX_DIFFERENCE && mean <= MEAN,
        "{} draws another picture than the CPU version: difference up to {largest}/255, mean {mean:.3}/255; \
         update its driver, choose another device (ENTIRE_DEVICE), or render with --device cpu",
        found.device
    );
    Ok(())
}

fn counts(c: &WorkCounts) -> serde_json::Value {
    json!({ "rays": c.rays, "samples": c.samples, "skips": c.skips, "shaded": c.shaded })
}

fn as_json(found: &Probe) -> String {
    let limits = found.limits.as_ref().map(|l| {
        json!({
            "name": l.name,
            "driver": l.driver,
            "api_version": l.api_version,
            "is_software": l.is_software,
            "max_image_3d": l.max_image_3d,
            "max_storage_buffer_bytes": l.max_storage_buffer,
            "max_allocation_bytes": l.max_allocation,
            "memory_bytes": l.memory,
            "subgroup_size": l.subgroup_size,
            "timestamp_valid_bits": l.timestamps.map(|t| t.0),
            "timestamp_period_ns": l.timestamps.map(|t| t.1),
        })
    });
    let agreement = &found.agreement;
    json!({
        "device": found.device,
        "backend": found.backend,
        "clock": found.clock,
        "limits": limits,
        "timestamps": found
                .timestamps
                .map(|t| json!({ "device_to_wall": t.device_to_wall, "spread": t.spread })),
        "agreement": {
            "largest_of_255": agreement.largest,
            "mean_of_255": agreement.mean,
            "counts": agreement.counts.as_ref().map(counts),
            "counts_of_twin": counts(&agreement.twin),
        },
        "numbers": serde_json::Map::from_iter(
                found.numbers().map(|(name, value)| (name.to_owned(), json!(value))),
            ),
    })
    .to_string()
}

fn as_text(found: &Probe) -> String {
    let mut out = String::new();
    let mut line = |name: &str, value: String| {
        let _ = writeln!(out, "{name:<22}{value}");
    };
    line("device", format!("{} ({})", found.device, found.backend));
    if let Some(l) = &found.limits {
        let mib = |bytes: u64| bytes >> 20;
        line("Vulkan", format!("{}{}", l.api_version, if l.is_software { ", software" } else { "" }));
        line(
            "limits",
            format!(
                "3-D textures {}³, storage buffers {} MiB, allocation {} MiB, memory {} MiB, subgroups of {}",
                l.max_image_3d,
                mib(l.max_storage_buffer),
                mib(l.max_allocation),
                mib(l.memory),
                l.subgroup_size
            ),
        );
        match (l.timestamps, &found.timestamps) {
            (Some((bits, period)), Some(t)) => line(
                "timestamps",
                format!(
                    "{bits} valid bits, {period} ns per tick; device time is {:.3} times wall time; over the \
                     repeats, the device time ranges over {:.1} % of its median",
                    t.device_to_wall,
                    100.0 * t.spread
                ),
            ),
            _ => line("timestamps", "none; frames are timed by wall time".to_owned()),
        }
    }
    let a = &found.agreement;
    let counted = match &a.counts {
        Some(c) if *c == a.twin => "counts equal".to_owned(),
        Some(c) => format!("{} samples (CPU version: {})", c.samples, a.twin.samples),
        None => "samples not counted".to_owned(),
    };
    line("difference from CPU", format!("at most {}/255, mean {:.4}/255, {counted}", a.largest, a.mean));
    line("clock", format!("{} time", found.clock));
    line("fixed time per frame", format!("{:.3} ms", found.frame_seconds * 1e3));
    line("rays", format!("{:.2} M/s", found.rays_per_second * 1e-6));
    line("coherent samples", format!("{:.1} M/s", found.coherent_samples_per_second * 1e-6));
    line("divergent samples", format!("{:.1} M/s", found.divergent_samples_per_second * 1e-6));
    line("skips", format!("{:.1} M/s", found.skips_per_second * 1e-6));
    out.truncate(out.trim_end().len());
    out
}
