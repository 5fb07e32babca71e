//! Options of several commands: rendering, renderer, settings of drawing, number of threads.

use crate::dataset::{Clock, Timing};
use crate::files::note;
use crate::machine;
use anyhow::{Context, Result, anyhow, bail, ensure};
use clap::ValueEnum;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use entire_core::scene::{Camera, Frame, MAX_IMAGE_SIDE, Shading, Skipping};
use entire_steer::control::StepLimits;
use entire_vk_raycaster::{CpuRaycaster, Renderer, VulkanOptions, VulkanRaycaster};
use rayon::{ThreadPool, ThreadPoolBuilder};
use serde::{Deserialize, Serialize};

/// Rendering options.
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct RenderArgs {
    /// Shading of each sample.
    #[arg(long, value_parser = shade_parser(), default_value = "none")]
    pub shade: Shading,
    /// Skipping of empty space.
    #[arg(long, value_parser = skip_parser(), default_value = "blocks")]
    pub skip: Skipping,
    /// Accumulated opacity at which a ray stops; 1 for never.
    #[arg(long, default_value_t = 0.99, value_name = "OPACITY", allow_hyphen_values = true)]
    pub termination: f32,
    /// The renderer.
    #[arg(long, value_enum, default_value_t)]
    pub device: Device,
}

/// Choice of the renderer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Device {
    /// Vulkan where there is a device, else the CPU version of the raycaster.
    #[default]
    Auto,
    /// The Vulkan raycaster.
    Vulkan,
    /// The CPU version of the raycaster, which draws almost the same pictures and counts their samples.
    Cpu,
}

/// True if the renderer runs on the CPU: the CPU raycaster, or a Vulkan driver in software.
pub fn is_software(renderer: &dyn Renderer) -> bool {
    names_software(renderer.backend(), &renderer.device())
}

/// True if a renderer with this backend and this device runs on the CPU (see [`is_software`]).
pub fn names_software(backend: &str, device: &str) -> bool {
    let device = device.to_ascii_lowercase();
    backend == "cpu" || ["llvmpipe", "lavapipe", "swiftshader"].iter().any(|s| device.contains(s))
}

/// Opens a renderer; the environment chooses among Vulkan devices (see [`VulkanOptions::from_env`]). If
/// [`Device::Auto`] finds no Vulkan device, the CPU version is opened, and a note on standard error says so.
///
/// # Errors
/// When Vulkan or one of its devices was requested and there is none; the error says how to get a driver.
/// When an environment variable has an invalid value.
pub fn open_renderer(device: Device) -> Result<Box<dyn Renderer>> {
    if device == Device::Cpu {
        return Ok(Box::new(CpuRaycaster::new()));
    }
    // If the environment names a device, the CPU version does not replace it.
    let options = VulkanOptions::from_env()?;
    let named = options.device.is_some();
    match VulkanRaycaster::new(options) {
        Ok(renderer) => Ok(Box::new(renderer)),
        Err(error) if device == Device::Auto && !named => {
            note(&format!("{error}; the CPU version renders instead"));
            Ok(Box::new(CpuRaycaster::new()))
        }
        Err(error) => Err(error).context("cannot open a Vulkan device (--device cpu needs none)"),
    }
}

/// Settings with which frames are drawn. Files store modes and clock by name.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DrawSettings {
    /// Image width, pixels.
    #[serde(rename = "width_px")]
    pub width: u32,
    /// Image height, pixels.
    #[serde(rename = "height_px")]
    pub height: u32,
    /// Shading of each sample.
    #[serde(with = "by_name")]
    pub shading: Shading,
    /// Skipping of empty space.
    #[serde(with = "by_name")]
    pub skipping: Skipping,
    /// Accumulated opacity at which rays stop.
    pub termination: f32,
    /// The clock of frame times.
    #[serde(with = "by_name")]
    pub clock: Clock,
}

/// Conversion of values that files store by name.
mod by_name {
    use serde::de::{Deserialize, Deserializer, Error};
    use serde::ser::Serializer;
    use std::fmt::Display;
    use std::str::FromStr;

    pub(super) fn serialize<T: Display, S: Serializer>(value: &T, to: S) -> Result<S::Ok, S::Error> {
        to.collect_str(value)
    }

    pub(super) fn deserialize<'de, T: FromStr<Err: Display>, D: Deserializer<'de>>(
        from: D,
    ) -> Result<T, D::Error> {
        String::deserialize(from)?.parse().map_err(D::Error::custom)
    }
}

impl DrawSettings {
    /// Settings from the options.
    pub fn new((width, height): (u32, u32), render: &RenderArgs, clock: Clock) -> Self {
        Self {
            width,
            height,
            shading: render.shade,
            skipping: render.skip,
            termination: render.termination,
            clock,
        }
    }

    /// A frame with these settings at the reference step.
    ///
    /// # Errors
    /// When the core refuses a value.
    pub fn frame(&self, camera: Camera) -> Result<Frame> {
        Ok(Frame {
            termination: self.termination,
            shading: self.shading,
            skipping: self.skipping,
            ..Frame::new(camera, self.width, self.height)?
        }
        .checked()?)
    }

    /// Seconds of a measurement by the chosen clock.
    ///
    /// # Errors
    /// When the renderer has no such clock.
    pub fn seconds(&self, measurement: &Timing) -> Result<f64> {
        measurement.seconds(self.clock).with_context(|| {
            format!("the renderer has no {} clock; choose another with --clock", self.clock.name())
        })
    }
}

/// Returns the values of an option, made from their names and descriptions.
pub(crate) fn described<const N: usize>(
    names: [&'static str; N],
    texts: [&'static str; N],
) -> Vec<PossibleValue> {
    names.into_iter().zip(texts).map(|(name, text)| PossibleValue::new(name).help(text)).collect()
}

/// Returns the values of `--shade`.
pub fn shades() -> Vec<PossibleValue> {
    let lit = "Local lighting with gradients";
    let both = "Local lighting and single scattering";
    described(Shading::ALL.map(Shading::name), ["Color and opacity only", lit, "Single scattering", both])
}

/// Parser of `--shade`.
pub fn shade_parser() -> impl TypedValueParser<Value = Shading> {
    PossibleValuesParser::new(shades()).try_map(|name| name.parse::<Shading>())
}

/// Parser of `--skip`.
pub fn skip_parser() -> impl TypedValueParser<Value = Skipping> {
    let runs = "Runs of empty blocks are skipped at once, by a distance map";
    let texts = ["Every sample is taken", "Empty blocks are skipped", runs];
    PossibleValuesParser::new(described(Skipping::ALL.map(Skipping::name), texts))
        .try_map(|name| name.parse::<Skipping>())
}

/// Checks the opacity at which a ray stops (`--termination`).
///
/// # Errors
/// When the opacity is outside of (0, 1].
pub fn check_termination(opacity: f32) -> Result<()> {
    ensure!(
        opacity > 0.0 && opacity <= 1.0,
        "--termination is {opacity}; it must be above 0 and at most 1. At 1, no ray ends early"
    );
    Ok(())
}

/// Parses an image size in pixels: `WxH`.
///
/// # Errors
/// When the text is not two sides of 1 to [`MAX_IMAGE_SIDE`] pixels.
pub fn parse_size(text: &str) -> std::result::Result<(u32, u32), String> {
    let wrong = || format!("{text:?} is not WIDTHxHEIGHT with sides of 1 to {MAX_IMAGE_SIDE} pixels");
    let (w, h) = text.split_once(['x', 'X', '×']).ok_or_else(wrong)?;
    match (w.trim().parse(), h.trim().parse()) {
        (Ok(w), Ok(h)) if (1..=MAX_IMAGE_SIDE).contains(&w) && (1..=MAX_IMAGE_SIDE).contains(&h) => {
            Ok((w, h))
        }
        _ => Err(wrong()),
    }
}

/// Parses a target frame time, in seconds: `33ms`, `0.033s`, `33000us`, `30fps` or `30hz`.
///
/// # Errors
/// For any other text; the error names the accepted forms.
pub fn parse_target(text: &str) -> Result<f64> {
    let lower = text.trim().to_ascii_lowercase();
    let split = lower.find(|c: char| c.is_alphabetic() && c != 'e').unwrap_or(lower.len());
    let (number, unit) = lower.split_at(split);
    let accepted = "give a time like 33ms or 0.033s, or a rate like 30fps";
    let value: f64 =
        number.trim().parse().map_err(|_| anyhow!("target {text:?} has no number; {accepted}"))?;
    let seconds = match unit.trim() {
        "ms" => value * 1e-3,
        "s" => value,
        "us" | "µs" | "μs" => value * 1e-6,
        "fps" | "hz" => 1.0 / value,
        _ => bail!("target {text:?} has no known unit; {accepted}"),
    };
    ensure!(
        seconds.is_finite() && seconds > 0.0 && value > 0.0,
        "target {text:?} is not a finite positive time; {accepted}"
    );
    Ok(seconds)
}

/// Parses the limits of the ray step, in reference steps: `FINEST,COARSEST`.
///
/// # Errors
/// When the text is not two numbers, or not those of a range ([`StepLimits::check`]).
pub fn parse_limits(text: &str) -> std::result::Result<StepLimits, String> {
    let pair = text.split_once(',').and_then(|(a, b)| Some((a.trim().parse().ok()?, b.trim().parse().ok()?)));
    let (finest, coarsest) = pair.ok_or_else(|| format!("{text:?} is not two numbers like 1,16"))?;
    let limits = StepLimits { finest, coarsest };
    limits.check().map_err(|e| e.to_string())?;
    Ok(limits)
}

/// Parses a frame number and the image scale from that frame on: `FRAME:SCALE`.
///
/// # Errors
/// When the text is not a frame number and a scale, or the scale is outside 0.01 to 4.
pub fn parse_scale(text: &str) -> std::result::Result<(u32, f32), String> {
    let pair = text.split_once(':').and_then(|(a, b)| Some((a.trim().parse().ok()?, b.trim().parse().ok()?)));
    pair.filter(|(_, s): &(u32, f32)| (0.01..=4.0).contains(s))
        .ok_or_else(|| format!("{text:?} is not FRAME:SCALE like 40:0.5 with a scale of 0.01 to 4"))
}

/// Parses the largest image sample distance, in pixels between rays.
///
/// # Errors
/// When the text is not a number from 1 to 20.
pub fn parse_distance(text: &str) -> std::result::Result<f32, String> {
    text.trim()
        .parse()
        .ok()
        .filter(|d| (1.0..=20.0).contains(d))
        .ok_or_else(|| format!("{text:?} is not a number from 1 to 20 (pixels between rays)"))
}

/// Returns the number of frames per volume of a series; 0 for a single volume.
///
/// # Errors
/// When `--hold` does not fit the number of volumes.
pub fn parse_hold(volumes: usize, hold: Option<u32>) -> Result<u32> {
    match (volumes, hold) {
        (1, None) => Ok(0),
        (1, Some(_)) => bail!("--hold is for several volumes; only one was given"),
        (_, Some(0)) => bail!("--hold is 0; each volume is shown for at least one frame"),
        (_, Some(n)) => Ok(n),
        (n, None) => bail!("{n} volumes were given; say for how many frames each is shown (--hold N)"),
    }
}

/// Returns a pool of `threads` threads; `None` means one thread per logical processor.
///
/// # Errors
/// When `threads` is outside 1 to 1024, or the system cannot start the threads.
pub fn thread_pool(threads: Option<usize>) -> Result<ThreadPool> {
    if let Some(n) = threads {
        ensure!((1..=1024).contains(&n), "--threads is {n}; it must lie in 1 to 1024");
    }
    ThreadPoolBuilder::new()
        .num_threads(threads.unwrap_or_else(machine::cores))
        .build()
        .context("cannot start the threads")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn targets_are_times_or_rates() {
        for (text, seconds) in [
            ("33ms", 0.033),
            ("0.5 s", 0.5),
            ("500us", 5e-4),
            ("500µs", 5e-4),
            ("500 μs", 5e-4),
            ("40fps", 0.025),
            ("25 Hz", 0.04),
            ("1e-2s", 0.01),
        ] {
            assert!((parse_target(text).unwrap() - seconds).abs() < 1e-12, "{text}");
        }
        for text in ["", "33", "ms", "-3ms", "0fps", "0ms", "nan s", "3 parsecs", "inf s"] {
            assert!(parse_target(text).is_err(), "{text}");
        }
    }
}
