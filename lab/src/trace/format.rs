//! The file format of a trace, and its checked reader.

use anyhow::{Context, Result, ensure};
use entire_io::files::{gzip, read_decompressed, write_whole};
use entire_io::identity::Identity;
use entire_io::options::DrawSettings;
use entire_io::path::PathFile;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Value of `format` in the file.
pub const TRACE_FORMAT: &str = "entire-trace-1";

/// A volume of a trace.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TraceVolume {
    /// Path of the file, as it was given.
    pub file: PathBuf,
    /// Factor of the enlargement at load.
    pub enlarge: usize,
    /// Identities of the volume's files; empty if they were not stored.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub files: Vec<Identity>,
}

/// Times and picture quality of a frame at one ray step and image scale.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TracePoint {
    /// Ray step, reference steps.
    pub step: f32,
    /// Image scale, relative to the frame's own size.
    pub scale: f32,
    /// Seconds of every repeat.
    pub seconds: Vec<f64>,
    /// PSNR against the picture at the reference step and scale 1, decibels.
    pub psnr: f64,
    /// Mean structural similarity (MSSIM) of the luma of both pictures, 0 to 1.
    pub ssim: f64,
}

/// A recorded path.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Trace {
    /// [`TRACE_FORMAT`].
    pub format: String,
    /// Name in reports.
    pub name: String,
    /// Volumes, in the order of the series.
    pub volumes: Vec<TraceVolume>,
    /// The path.
    pub path: PathFile,
    /// Frames per volume; 0 for a single volume.
    pub hold: u32,
    /// Image scales relative to the full size, each with the frame from which on it holds.
    pub scales: Vec<(u32, f32)>,
    /// Settings of drawing.
    pub draw: DrawSettings,
    /// Points of every frame's grid: first those at scale 1, steps ascending, then smaller images if they
    /// were recorded.
    pub frames: Vec<Vec<TracePoint>>,
    /// Machine, device, commit and date.
    pub provenance: serde_json::Value,
}

impl Trace {
    /// Reads and checks a trace, gzip-compressed where the name ends in `.gz`.
    ///
    /// # Errors
    /// When the file cannot be read, is no trace, or holds an incomplete recording; the error names the file.
    pub fn open(path: &Path) -> Result<Self> {
        let trace = Self::open_begun(path)?;
        ensure!(
            trace.is_complete(),
            "{} holds {} frames, its path has {}: its recording was interrupted; to continue, repeat the \
             same `entire-lab record` command with --resume",
            path.display(),
            trace.frames.len(),
            trace.path.frames
        );
        Ok(trace)
    }

    /// Reads and checks a trace that may hold only the first frames of its path.
    ///
    /// # Errors
    /// As [`Trace::open`].
    pub fn open_begun(path: &Path) -> Result<Self> {
        let text = read_decompressed(path)
            .and_then(|bytes| Ok(String::from_utf8(bytes)?))
            .with_context(|| format!("cannot read the trace {}", path.display()))?;
        Self::parse(&text).with_context(|| format!("{} is no trace", path.display()))
    }

    /// Writes a trace, gzip-compressed where the name ends in `.gz`.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<()> {
        let text = serde_json::to_string(self)? + "\n";
        if path.extension().is_some_and(|e| e == "gz") {
            write_whole(path, &gzip(text.as_bytes())?)
        } else {
            write_whole(path, text.as_bytes())
        }
    }

    /// Reads and checks a trace's text, which may hold only the first frames of its path.
    ///
    /// # Errors
    /// When the text is no trace; an error in the JSON has line and column.
    pub fn parse(text: &str) -> Result<Self> {
        let trace: Self = serde_json::from_str(text)?;
        trace.check()?;
        Ok(trace)
    }

    pub(super) fn check(&self) -> Result<()> {
        ensure!(
            self.format == TRACE_FORMAT,
            "format is {:?}; this version reads {TRACE_FORMAT:?}",
            self.format
        );
        ensure!(!self.volumes.is_empty(), "it names no volume");
        ensure!(
            self.frames.len() <= self.path.frames as usize,
            "it holds {} frames, its path has {}",
            self.frames.len(),
            self.path.frames
        );
        for (i, frame) in self.frames.iter().enumerate() {
            let full: Vec<&TracePoint> = frame.iter().filter(|p| p.scale == 1.0).collect();
            ensure!(
                full.len() >= 2 && full.windows(2).all(|w| w[0].step < w[1].step),
                "frame {i} has {} points at scale 1; at least two with ascending steps are needed",
                full.len()
            );
            for TracePoint { step, scale, seconds, psnr, ssim } in frame {
                ensure!(
                    !seconds.is_empty() && seconds.iter().all(|t| t.is_finite() && *t > 0.0),
                    "frame {i}, step {step}: seconds are {seconds:?}; every repeat must be finite and positive"
                );
                ensure!(
                    *step > 0.0 && *scale > 0.0 && psnr.is_finite() && (0.0..=1.0).contains(ssim),
                    "frame {i}: step {step} and scale {scale} must be positive, psnr {psnr} must be finite, \
                     and ssim {ssim} must lie in 0 to 1"
                );
            }
        }
        Ok(())
    }

    /// True if every frame of the path was recorded.
    pub fn is_complete(&self) -> bool {
        self.frames.len() == self.path.frames as usize
    }
}
