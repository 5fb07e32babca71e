//! How long frames took: repeats by every clock, their median, and how far they scatter.

#[cfg(test)]
use super::parse_lobes;
use super::{Scene, Table};
use crate::metrics::median;
use anyhow::{Result, ensure};
use entire_core::predict::LONGEST_FRAME;
use entire_core::scene::Shading;
#[cfg(test)]
use entire_core::scene::{Arcball, Skipping};
use entire_vk_raycaster::{FrameTime, WorkCounts};
use serde::Serialize;

/// The timing of one repeat of a frame: the seconds by each clock that there was, and what was counted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Timing {
    /// Between device timestamps, seconds.
    pub device: Option<f64>,
    /// From submission to completion on the host, seconds.
    pub wall: Option<f64>,
    /// CPU time of the process, all threads, seconds.
    pub cpu: Option<f64>,
    /// What the frame did, where the renderer counted.
    pub counts: Option<WorkCounts>,
}

impl Timing {
    /// From what a renderer returned.
    pub fn new(time: FrameTime, counts: Option<WorkCounts>) -> Self {
        Self { device: time.device, wall: Some(time.wall), cpu: time.cpu, counts }
    }

    /// The seconds by a clock, or `None` where it was not read.
    pub fn seconds(&self, clock: Clock) -> Option<f64> {
        match clock {
            Clock::Auto => self.device.or(self.wall),
            Clock::Device => self.device,
            Clock::Wall => self.wall,
            Clock::Cpu => self.cpu,
        }
    }

    pub(super) fn check(&self) -> Result<()> {
        for (name, value) in
            [("seconds_device", self.device), ("seconds_wall", self.wall), ("seconds_cpu", self.cpu)]
        {
            if let Some(v) = value {
                ensure!(
                    (0.0..=f64::from(LONGEST_FRAME)).contains(&v),
                    "{name} is {v}; seconds from 0 to {LONGEST_FRAME} are accepted"
                );
            }
        }
        ensure!(
            self.device.is_some() || self.wall.is_some() || self.cpu.is_some(),
            "no clock was read; at least one of seconds_device, seconds_wall, seconds_cpu is needed"
        );
        Ok(())
    }
}

/// Which clock counts as a frame's time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Clock {
    /// The device's timestamps where there are any, else wall time.
    #[default]
    Auto,
    /// Device timestamps.
    Device,
    /// Wall time on the host.
    Wall,
    /// Process CPU time, all threads.
    Cpu,
}

impl Clock {
    /// The name used in options and metadata.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Device => "device",
            Self::Wall => "wall",
            Self::Cpu => "cpu",
        }
    }
}

/// A frame with all its repeats.
#[derive(Clone, Debug, PartialEq)]
pub struct TimedFrame {
    /// Which of the loaded tables it comes from.
    pub table: usize,
    /// Its number in that table.
    pub number: u64,
    /// What it shows.
    pub scene: Scene,
    /// Every repeat, in file order.
    pub repeats: Vec<Timing>,
}

impl TimedFrame {
    /// A frame of a volume that no file needs to hold, never timed.
    #[cfg(test)]
    pub(crate) fn of_no_volume(volume: &str, member: &str) -> Self {
        let scene = Scene {
            volume: volume.into(),
            member: member.into(),
            time_step: None,
            dims: [8; 3],
            camera: Arcball { rx: 1.0, ry: 2.0, dz: 3.0 },
            fov_y_degrees: 45.0,
            width: 64,
            height: 64,
            step: 1.0,
            shading: Shading::None,
            skipping: Skipping::Blocks,
            termination: 0.99,
            lobes: parse_lobes("0.5 0.1 1").expect("a lobe"),
        };
        Self { table: 0, number: 0, scene, repeats: Vec::new() }
    }

    /// Median of the repeats by a clock (mean of the middle two where their number is even), over the repeats
    /// that have it and are longer than zero; `None` when there are none.
    pub fn seconds(&self, clock: Clock) -> Option<f64> {
        let mut seconds: Vec<f64> =
            self.repeats.iter().filter_map(|r| r.seconds(clock)).filter(|&t| t > 0.0).collect();
        median(&mut seconds)
    }

    /// The counts, where any repeat was counted.
    pub fn counts(&self) -> Option<WorkCounts> {
        self.repeats.iter().find_map(|r| r.counts)
    }
}

/// Frames with their seconds.
#[derive(Clone, Copy, Debug)]
pub struct Timed<'a> {
    /// The frames.
    pub frames: &'a [&'a TimedFrame],
    /// Seconds of each.
    pub seconds: &'a [f64],
}

/// Frames that have seconds by the clock (and the shading asked for), with those seconds.
///
/// # Errors
/// When there are none.
pub fn timed(tables: &[Table], clock: Clock, shading: Option<Shading>) -> Result<Vec<(&TimedFrame, f64)>> {
    let all = || tables.iter().flat_map(|t| &t.frames);
    let frames: Vec<(&TimedFrame, f64)> = all()
        .filter(|f| shading.is_none_or(|s| f.scene.shading == s))
        .filter_map(|f| Some((f, f.seconds(clock)?)))
        .collect();
    ensure!(
        !frames.is_empty(),
        "none of {} frames has {} and a time by the clock {:?}; choose another --clock{}",
        all().count(),
        shading.map_or("any shading".to_owned(), |s| format!("shading {}", s.name())),
        clock.name(),
        if shading.is_some() { " or --shading" } else { "" },
    );
    Ok(frames)
}

/// How far repeats of one frame scatter: the floor under every predictor's error.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct NoiseFloor {
    /// Standard deviation of ln(seconds) of a single repeat about its frame's mean, pooled over frames with
    /// n − 1 degrees of freedom each.
    pub log_sd: f64,
    /// The same for the median of each frame's repeats, taking its standard error as sqrt(π/2) times the
    /// mean's for three repeats or more, and the mean's for two.
    pub log_sd_of_median: f64,
    /// Median over repeats of |t − frame median| / frame median.
    pub median_relative_deviation: f64,
    /// Frames with at least two repeats.
    pub frames: usize,
}

/// The repeat-to-repeat noise by a clock, or `None` when no frame was repeated.
pub fn noise_floor<'a>(frames: impl IntoIterator<Item = &'a TimedFrame>, clock: Clock) -> Option<NoiseFloor> {
    let (mut squares, mut freedom, mut count) = (0.0, 0usize, 0usize);
    let mut inverse_repeats = 0.0;
    let mut deviations = Vec::new();
    for frame in frames {
        let seconds: Vec<f64> =
            frame.repeats.iter().filter_map(|r| r.seconds(clock)).filter(|&t| t > 0.0).collect();
        if seconds.len() < 2 {
            continue;
        }
        let n = seconds.len() as f64;
        let mean = seconds.iter().map(|t| t.ln()).sum::<f64>() / n;
        squares += seconds.iter().map(|t| (t.ln() - mean).powi(2)).sum::<f64>();
        freedom += seconds.len() - 1;
        count += 1;
        inverse_repeats += if seconds.len() > 2 { std::f64::consts::FRAC_PI_2 / n } else { 1.0 / n };
        let mid = median(&mut seconds.clone())?;
        deviations.extend(seconds.iter().map(|t| (t - mid).abs() / mid));
    }
    if freedom == 0 {
        return None;
    }
    let log_sd = (squares / freedom as f64).sqrt();
    Some(NoiseFloor {
        log_sd,
        log_sd_of_median: log_sd * (inverse_repeats / count as f64).sqrt(),
        median_relative_deviation: median(&mut deviations)?,
        frames: count,
    })
}
