//! Times of frames: repeats by every clock, their median, and their scatter.

use super::{Manifest, Scene, Table, parse_lobes};
use crate::metrics::{median, percentile};
use anyhow::{Result, ensure};
use entire_core::scene::{Arcball, Shading, Skipping};
use entire_steer::predict::{Clock, LONGEST_FRAME};
use entire_vk_raycaster::{FrameTime, WorkCounts};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// One repeat of a frame: seconds by each available clock, and work counts.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Timing {
    /// Time between device timestamps, seconds.
    pub device: Option<f64>,
    /// Wall time from submission to completion on the host, seconds.
    pub wall: Option<f64>,
    /// CPU time of the process, all threads, seconds.
    pub cpu: Option<f64>,
    /// Work counts of the frame, where the renderer counted.
    pub counts: Option<WorkCounts>,
}

impl Timing {
    /// A repeat from the times and work counts that a renderer returned.
    pub fn new(time: FrameTime, counts: Option<WorkCounts>) -> Self {
        Self { device: time.device, wall: Some(time.wall), cpu: time.cpu, counts }
    }

    /// Returns the seconds by a clock; `None` if the clock was not read.
    pub fn seconds(&self, clock: Clock) -> Option<f64> {
        match clock {
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
            "there is no time; at least one of seconds_device, seconds_wall, seconds_cpu is needed"
        );
        Ok(())
    }
}

/// A frame with all its repeats.
#[derive(Clone, Debug, PartialEq)]
pub struct TimedFrame {
    /// Index of the frame's table.
    pub table: usize,
    /// Number of the frame in that table.
    pub number: u64,
    /// The scene.
    pub scene: Scene,
    /// Every repeat, in file order.
    pub repeats: Vec<Timing>,
}

impl TimedFrame {
    /// A frame without a volume file and without times, for tests.
    #[doc(hidden)]
    pub fn of_no_volume(volume: &str, member: &str) -> Self {
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

    /// Median seconds by a clock (mean of the middle two for an even number), over the repeats with a
    /// positive time by this clock; `None` if there is no such repeat.
    pub fn seconds(&self, clock: Clock) -> Option<f64> {
        median(&mut self.times(clock))
    }

    /// The positive times of the repeats by a clock, seconds.
    fn times(&self, clock: Clock) -> Vec<f64> {
        self.repeats.iter().filter_map(|r| r.seconds(clock)).filter(|&t| t > 0.0).collect()
    }

    /// Estimated seconds of the frame without disturbance. Other programs lengthen wall time, and a GPU that
    /// saves power lengthens device time; neither effect shortens a time. So the estimate by wall or device
    /// time is the lower quartile of the repeats. By processor time, the estimate is [`TimedFrame::seconds`].
    pub fn undisturbed(&self, clock: Clock) -> Option<f64> {
        if clock == Clock::Cpu {
            return self.seconds(clock);
        }
        let mut seconds = self.times(clock);
        seconds.sort_by(f64::total_cmp);
        (!seconds.is_empty()).then(|| percentile(&seconds, 0.25))
    }

    /// The work counts of the first repeat that has them.
    pub fn counts(&self) -> Option<WorkCounts> {
        self.repeats.iter().find_map(|r| r.counts)
    }
}

/// Frames with their seconds.
#[derive(Clone, Copy, Debug)]
pub struct Timed<'a> {
    /// The frames.
    pub frames: &'a [&'a TimedFrame],
    /// Seconds of each frame.
    pub seconds: &'a [f64],
}

/// Returns the frames with the requested shading, of all tables; all frames if `shading` is `None`.
pub fn shaded(tables: &[Table], shading: Option<Shading>) -> impl Iterator<Item = &TimedFrame> + Clone {
    tables.iter().flat_map(|t| &t.frames).filter(move |f| shading.is_none_or(|s| f.scene.shading == s))
}

/// Returns the manifests of the tables that contain the frames, in the order of the tables.
pub fn manifests_of<'a>(tables: &'a [Table], frames: &[&TimedFrame]) -> Vec<&'a Manifest> {
    let used: BTreeSet<usize> = frames.iter().map(|f| f.table).collect();
    used.into_iter().filter_map(|table| tables.get(table)?.manifest.as_ref()).collect()
}

/// Returns a note that names the renderers and machines of the frames; `None` if there is only one.
pub fn mixed(manifests: &[&Manifest]) -> Option<String> {
    let source = |m: &&Manifest| format!("{} on {} ({})", m.renderer, m.device, m.machine);
    let sources: BTreeSet<String> = manifests.iter().map(source).collect();
    (sources.len() > 1).then(|| {
        format!(
            "the frames are of {} renderers or machines, which a model cannot tell apart: {}; make a model \
             for each of them",
            sources.len(),
            sources.into_iter().collect::<Vec<_>>().join("; ")
        )
    })
}

/// Returns the frames with a time by the clock and the requested shading (if any), each with its seconds.
///
/// # Errors
/// When there are no such frames.
pub fn timed(tables: &[Table], clock: Clock, shading: Option<Shading>) -> Result<Vec<(&TimedFrame, f64)>> {
    let frames: Vec<(&TimedFrame, f64)> =
        shaded(tables, shading).filter_map(|f| Some((f, f.seconds(clock)?))).collect();
    ensure!(
        !frames.is_empty(),
        "none of {} frames has {}a time by the clock {:?}; choose another --clock{}",
        shaded(tables, None).count(),
        shading.map_or(String::new(), |s| format!("shading {s} and ")),
        clock.name(),
        if shading.is_some() { " or --shade" } else { "" },
    );
    Ok(frames)
}

/// Returns a note about the frames that [`timed`] leaves out for lack of a time by the clock; `None` if no
/// frame or every frame is left out.
pub fn left_out(tables: &[Table], clock: Clock, shading: Option<Shading>) -> Option<String> {
    let frames: Vec<&TimedFrame> = shaded(tables, shading).collect();
    let without = |clock: Clock| frames.iter().filter(|f| f.seconds(clock).is_none()).count();
    let missing = without(clock);
    if missing == 0 || missing == frames.len() {
        return None;
    }
    let whole: Vec<&str> = [Clock::Cpu, Clock::Wall, Clock::Device]
        .into_iter()
        .filter(|c| without(*c) == 0)
        .map(Clock::name)
        .collect();
    let instead = match &whole[..] {
        [] => String::new(),
        names => format!(", or choose a clock that all frames have: --clock {}", names.join(" or ")),
    };
    Some(format!(
        "{missing} of {} frames are left out, since they have no {} time; measure it in every frame{instead}",
        frames.len(),
        clock.name()
    ))
}

/// Scatter of repeats of one frame, which is the floor of every predictor's error. All values are computed
/// from medians, so that disturbed repeats hardly change them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct NoiseFloor {
    /// Standard deviation of ln(seconds) of a single repeat: the median of |difference| of two repeats of a
    /// frame, divided by 0.6745·√2, as for a normal distribution. Both repeats are of one pass (of two passes
    /// if a pass has one repeat). Before the differences are taken, the trend that frames of similar duration
    /// have in common, such as a slow first repeat, is removed.
    pub log_sd: f64,
    /// Standard deviation of ln(median seconds of a frame's repeats), computed from `log_sd`. The standard
    /// error of the median is taken as that of the mean, times sqrt(π/2) for three repeats or more.
    pub log_sd_of_median: f64,
    /// Median over all repeats of |seconds − frame's median| / frame's median.
    pub median_relative_deviation: f64,
    /// Median over frames and passes of ln(first repeat / last repeat of the pass): the cost of warm-up.
    pub warm_up: f64,
    /// Drift of the machine between passes: range of the passes' values, where the value of a pass is the
    /// median over frames of ln(pass median / geometric mean of the frame's pass medians). `None` for a
    /// single pass.
    pub drift: Option<f64>,
    /// Frames with at least two repeats.
    pub frames: usize,
}

impl NoiseFloor {
    /// Describes the noise floor in words.
    pub fn describe(&self) -> String {
        let drift =
            self.drift.map_or(String::new(), |d| format!(", passes differ by {:.1} %", 100.0 * d.exp_m1()));
        let longer = 100.0 * self.warm_up.exp_m1();
        format!(
            "standard deviation {:.1} % for one repeat of a frame, {:.1} % for the median of its repeats; \
             the first repeat takes {:.1} % {} time than the last{drift}; computed from {} repeated frames",
            100.0 * self.log_sd.exp_m1(),
            100.0 * self.log_sd_of_median.exp_m1(),
            longer.abs(),
            if longer < 0.0 { "less" } else { "more" },
            self.frames
        )
    }

    /// The median of |predicted / measured − 1| that perfect predictions would have.
    pub fn mdape(&self) -> f64 {
        0.6745 * self.log_sd_of_median
    }
}

/// Minimum number of frames of similar duration for estimating their common trend.
const TREND_FRAMES: usize = 20;

/// ln(seconds) of every repeat of a frame with at least two repeats, and the number of passes.
struct Logs {
    repeats: Vec<f64>,
    median: f64,
    passes: usize,
}

impl Logs {
    fn of(frame: &TimedFrame, clock: Clock, passes: usize) -> Option<Self> {
        let repeats: Vec<f64> = frame.times(clock).into_iter().map(f64::ln).collect();
        // If some repeats lack a time, repeats cannot be assigned to passes.
        let whole = repeats.len() == frame.repeats.len() && repeats.len().is_multiple_of(passes);
        let median = median(&mut repeats.clone())?;
        (repeats.len() > 1).then_some(Self { repeats, median, passes: if whole { passes } else { 1 } })
    }

    fn by_pass(&self) -> std::slice::Chunks<'_, f64> {
        self.repeats.chunks(self.repeats.len() / self.passes)
    }
}

/// Returns the noise of repeats by a clock; `None` if no frame was repeated. `passes` returns the number of
/// passes in which a frame's repeats were measured ([`Table::passes`] of the frame's table).
pub fn noise_floor<'a>(
    frames: impl IntoIterator<Item = &'a TimedFrame>,
    clock: Clock,
    passes: impl Fn(&TimedFrame) -> usize,
) -> Option<NoiseFloor> {
    let mut logs: Vec<Logs> =
        frames.into_iter().filter_map(|f| Logs::of(f, clock, passes(f).max(1))).collect();
    if logs.is_empty() {
        return None;
    }
    let middle = |mut values: Vec<f64>| median(&mut values);
    let warm_up = middle(
        logs.iter()
            .flat_map(|l| l.by_pass().filter(|p| p.len() > 1).map(|p| p[0] - p[p.len() - 1]))
            .collect(),
    );
    let drift = drift(&logs);
    let deviations =
        logs.iter().flat_map(|l| l.repeats.iter().map(|r| (r - l.median).exp_m1().abs())).collect();
    let median_relative_deviation = middle(deviations)?;
    logs.sort_by(|a, b| a.median.total_cmp(&b.median));
    without_trend(&mut logs);
    let mut differences = Vec::new();
    let mut inverse_repeats = 0.0;
    for l in &logs {
        let n = l.repeats.len() as f64;
        inverse_repeats += if n > 2.0 { std::f64::consts::FRAC_PI_2 / n } else { 1.0 / n };
        let several = l.repeats.len() > l.passes;
        let groups: Vec<&[f64]> = if several { l.by_pass().collect() } else { vec![&l.repeats[..]] };
        for group in groups {
            for (i, a) in group.iter().enumerate() {
                differences.extend(group[..i].iter().map(|b| (a - b).abs()));
            }
        }
    }
    // For two draws from a normal distribution, the median of |difference| is 0.6745·√2 standard deviations.
    let log_sd = middle(differences)? / (0.674_489_75 * std::f64::consts::SQRT_2);
    Some(NoiseFloor {
        log_sd,
        log_sd_of_median: log_sd * (inverse_repeats / logs.len() as f64).sqrt(),
        median_relative_deviation,
        warm_up: warm_up.unwrap_or(0.0),
        drift,
        frames: logs.len(),
    })
}

/// Subtracts, for each place in the order of repeats, the deviation that frames of similar duration have in
/// common. `logs` is ordered by duration.
fn without_trend(logs: &mut [Logs]) {
    let parts = (logs.len() / TREND_FRAMES).min(10);
    let count = logs.len();
    for part in 0..parts {
        let part = &mut logs[part * count / parts..(part + 1) * count / parts];
        let longest = part.iter().map(|l| l.repeats.len()).max().unwrap_or(0);
        for place in 0..longest {
            let mut common: Vec<f64> =
                part.iter().filter_map(|l| Some(l.repeats.get(place)? - l.median)).collect();
            let Some(common) = (common.len() >= TREND_FRAMES).then(|| median(&mut common)).flatten() else {
                continue;
            };
            for l in part.iter_mut() {
                if let Some(r) = l.repeats.get_mut(place) {
                    *r -= common;
                }
            }
        }
    }
}

fn drift(logs: &[Logs]) -> Option<f64> {
    let most = logs.iter().map(|l| l.passes).max().filter(|&p| p > 1)?;
    let mut offsets: Vec<Vec<f64>> = vec![Vec::new(); most];
    for l in logs.iter().filter(|l| l.passes > 1) {
        let medians: Vec<f64> = l.by_pass().filter_map(|p| median(&mut p.to_vec())).collect();
        let mean = medians.iter().sum::<f64>() / medians.len() as f64;
        for (offsets, m) in offsets.iter_mut().zip(&medians) {
            offsets.push(m - mean);
        }
    }
    let offsets: Vec<f64> = offsets.iter_mut().filter_map(|o| median(o)).collect();
    let ends = |f: fn(f64, f64) -> f64| offsets.iter().copied().reduce(f);
    Some(ends(f64::max)? - ends(f64::min)?)
}
