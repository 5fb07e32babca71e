//! Traces: time and picture quality of every frame of a path at a grid of ray steps and image scales.
//!
//! A trace is recorded once with a real renderer and replayed any number of times in milliseconds. For a ray
//! step, the seconds are interpolated on the frame's curve over the step at full image size. For an image
//! resolution, they are interpolated on the frame's curve over image scales at the reference step. The
//! seconds are then multiplied by noise that was measured at the same frame. An oracle knows the curve over
//! the step, but not the noise.
//!
//! A file of a trace is a [`Trace`] as JSON.

mod format;

pub use format::{TRACE_FORMAT, Trace, TracePoint, TraceVolume};

use anyhow::{Context, Result, ensure};
use entire_cli::pictures::{BEST_PSNR, psnr, resized, scaled_size, ssim};
use entire_cli::steering::play::{scale_at, volume_at};
use entire_core::scene::Frame;
use entire_io::dataset::Timing;
use entire_io::identity::difference;
use entire_io::machine::Provenance;
use entire_io::metrics::median;
use entire_io::options::DrawSettings;
use entire_io::path::FlightPath;
use entire_io::volume::Volume;
use entire_steer::features::VolumeSummary;
use entire_vk_raycaster::{Image, Renderer};
use indicatif::ProgressBar;
use std::time::{Duration, Instant};

/// Default ray steps of the grid, reference steps: half octaves over the default limits.
pub(crate) const TRACE_STEPS: [f32; 9] = [1.0, 1.41, 2.0, 2.83, 4.0, 5.66, 8.0, 11.31, 16.0];

/// Smaller images of every frame at the reference step, each given by a number s: the image has 1 / s of the
/// pixels. Up to 16, the numbers are those of [`TRACE_STEPS`]. The last one, 100, corresponds to image sample
/// distance 10, the largest of VTK's fixed-point mapper.
pub(crate) const TRACE_IMAGES: [f32; 11] = [1.41, 2.0, 2.83, 4.0, 5.66, 8.0, 11.31, 16.0, 32.0, 64.0, 100.0];

/// Image scales of every fourth frame, at the steps of [`SCALED_STEPS`], for the quality law.
pub(crate) const TRACE_SCALES: [f32; 2] = [0.7, 0.5];

/// Steps at which the images of [`TRACE_SCALES`] are drawn.
pub(crate) const SCALED_STEPS: [f32; 4] = [1.0, 2.0, 4.0, 8.0];

// This method is not in `format`, which reads traces without opening volumes.
impl TraceVolume {
    /// Opens the volume, enlarged as in the recording.
    ///
    /// # Errors
    /// When the file cannot be read or the enlarged volume does not fit.
    pub fn open(&self) -> Result<Volume> {
        let volume = Volume::open(&self.file)?;
        volume.enlarged(self.enlarge)
    }
}

#[derive(Clone, Debug)]
pub(crate) struct Recording<'a> {
    /// The trace without frames.
    pub(crate) empty: Trace,
    pub(crate) volumes: &'a [Volume],
    /// Ray steps of the grid at scale 1, ascending; smaller images are drawn only with [`TRACE_STEPS`].
    pub(crate) steps: &'a [f32],
    pub(crate) repeats: usize,
}

/// Points of a frame's grid: ray step and image scale. `steps` are those at scale 1.
fn grid(steps: &[f32], index: usize) -> Vec<(f32, f32)> {
    let mut grid: Vec<(f32, f32)> = steps.iter().map(|s| (*s, 1.0)).collect();
    if steps != TRACE_STEPS {
        return grid;
    }
    grid.extend(TRACE_IMAGES.iter().map(|s| (1.0, 1.0 / s.sqrt())));
    if index.is_multiple_of(4) {
        for point in TRACE_SCALES.iter().flat_map(|scale| SCALED_STEPS.map(|step| (step, *scale))) {
            if !grid.contains(&point) {
                grid.push(point);
            }
        }
    }
    grid
}

/// True if both lists name the same volumes, with the same contents if both have the files' identities.
fn same_volumes(then: &[TraceVolume], now: &[TraceVolume]) -> bool {
    let same = |(a, b): (&TraceVolume, &TraceVolume)| {
        let unknown = a.files.is_empty() || b.files.is_empty();
        (&a.file, a.enlarge) == (&b.file, b.enlarge) && (unknown || difference(&a.files, &b.files).is_none())
    };
    then.len() == now.len() && then.iter().zip(now).all(same)
}

impl Trace {
    /// Names of the differences from a recording that prevent its continuation; empty if there are none.
    pub(crate) fn differences(&self, recording: &Recording<'_>) -> Vec<&'static str> {
        let other = &recording.empty;
        let points = |frame: &Vec<TracePoint>| frame.iter().map(|p| (p.step, p.scale)).collect::<Vec<_>>();
        let repeats = |f: &Vec<TracePoint>| f.iter().all(|p| p.seconds.len() == recording.repeats);
        let same = |(i, f): (usize, &Vec<TracePoint>)| points(f) == grid(recording.steps, i) && repeats(f);
        [
            ("volumes", same_volumes(&self.volumes, &other.volumes)),
            ("path", self.path == other.path),
            ("hold", self.hold == other.hold),
            ("scales", self.scales == other.scales),
            ("drawing", self.draw == other.draw),
            ("steps or repeats", self.frames.iter().enumerate().all(same)),
        ]
        .into_iter()
        .filter_map(|(what, same)| (!same).then_some(what))
        .collect()
    }

    /// Index of the volume of a frame.
    pub fn volume_at(&self, frame: usize) -> usize {
        volume_at(self.hold, self.volumes.len(), frame)
    }

    /// A frame of the path at the reference step.
    ///
    /// # Errors
    /// When the core refuses a value.
    pub fn frame(&self, path: &FlightPath, index: usize) -> Result<Frame> {
        let full = (self.draw.width, self.draw.height);
        let (width, height) = scaled_size(full, scale_at(&self.scales, index));
        DrawSettings { width, height, ..self.draw }.frame(path.camera(index)?)
    }

    /// Summaries of the volumes, opened relative to the working folder.
    ///
    /// # Errors
    /// When a file is missing.
    pub fn summaries(&self) -> Result<Vec<VolumeSummary>> {
        self.volumes.iter().map(|v| Ok(VolumeSummary::new(&v.open()?.view())?)).collect()
    }
}

/// Time between two savings of a recording.
const KEEP_EVERY: Duration = Duration::from_secs(5);

/// Draws every frame of a path at every point of the grid, except frames that `begun` holds.
///
/// `keep` saves the trace every few seconds and at the end; the saved trace is incomplete after a failure or
/// `stop`.
pub(crate) fn record(
    recording: &Recording<'_>,
    renderer: &mut dyn Renderer,
    begun: Option<Trace>,
    stop: &dyn Fn() -> bool,
    keep: &mut dyn FnMut(&Trace) -> Result<()>,
    progress: &ProgressBar,
) -> Result<Trace> {
    let provenance = serde_json::to_value(Provenance::of(renderer.device()))?;
    if let Some(began) = begun.as_ref().and_then(|b| b.provenance["device"].as_str()) {
        ensure!(
            began == renderer.device(),
            "the recording was begun on {began}, and this renderer is {}; continue on that device, or record anew",
            renderer.device()
        );
    }
    let mut trace = Trace { provenance, ..begun.unwrap_or_else(|| recording.empty.clone()) };
    let before = trace.frames.len();
    let result = record_on(recording, renderer, &mut trace, stop, keep, progress);
    if trace.frames.len() > before {
        trace.check()?;
        keep(&trace)?;
    }
    result.map(|()| trace)
}

fn record_on(
    recording: &Recording<'_>,
    renderer: &mut dyn Renderer,
    trace: &mut Trace,
    stop: &dyn Fn() -> bool,
    keep: &mut dyn FnMut(&Trace) -> Result<()>,
    progress: &ProgressBar,
) -> Result<()> {
    let path = trace.path.resolve()?;
    let draw = trace.draw;
    let mut shown = usize::MAX;
    let first = trace.frames.len();
    let mut kept = Instant::now();
    progress.set_length(path.frames.len() as u64);
    progress.set_position(first as u64);
    progress.reset_eta();
    for (index, at) in path.frames.iter().enumerate().skip(first) {
        let place = || format!("frame {index} of the path");
        if stop() {
            return Ok(());
        }
        if kept.elapsed() > KEEP_EVERY {
            keep(trace)?;
            kept = Instant::now();
        }
        let volume = trace.volume_at(index);
        let swapped = volume != shown;
        if swapped {
            renderer.set_volume(&recording.volumes[volume].view()).with_context(place)?;
            shown = volume;
        }
        if at.transfer_changed || swapped {
            let table = at.transfer.function().to_table().with_context(place)?;
            renderer.set_transfer(&table).with_context(place)?;
        }
        let frame = trace.frame(&path, index).with_context(place)?;
        let full = (frame.width, frame.height);
        let grid = grid(recording.steps, index);
        if swapped || at.transfer_changed {
            renderer.render(&frame).with_context(place)?;
        }
        let point = |&(step, scale)| TracePoint { step, scale, seconds: Vec::new(), psnr: 0.0, ssim: 0.0 };
        let mut points: Vec<TracePoint> = grid.iter().map(point).collect();
        // The picture at the reference step. If the grid begins with it, the loop below sets this variable.
        let mut reference: Option<Image> = None;
        if grid.first() != Some(&(1.0, 1.0)) {
            let rendered = renderer.render(&Frame { step: 1.0, ..frame }.checked()?).with_context(place)?;
            reference = Some(rendered.image);
        }
        // Each repeat is a round over the whole grid, so that a disturbance does not hit all repeats of one
        // point.
        for round in 0..recording.repeats {
            for point in &mut points {
                let (width, height) = scaled_size(full, point.scale);
                let small = DrawSettings { width, height, ..draw };
                let drawn = if point.scale == 1.0 { frame } else { small.frame(frame.camera)? };
                let drawn = Frame { step: point.step, ..drawn }.checked()?;
                let rendered = renderer.render(&drawn).with_context(place)?;
                point.seconds.push(draw.seconds(&Timing::new(rendered.time, rendered.counts))?);
                if round > 0 {
                    continue;
                }
                let picture = resized(&rendered.image, full.0, full.1).context("an image without pixels")?;
                let original = reference.get_or_insert_with(|| picture.clone());
                point.psnr = psnr(&picture.rgba, &original.rgba).unwrap_or(0.0).min(BEST_PSNR);
                point.ssim = ssim(&picture, original).unwrap_or(0.0);
            }
        }
        trace.frames.push(points);
        progress.inc(1);
    }
    Ok(())
}

/// Time and picture quality of a frame as functions of the ray step or of image resolution, and its noise.
///
/// A curve over image resolution is a function of s, for images with 1 / s of the pixels. In the functions
/// below, `step` is then this s.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// ln(step), ln(seconds), PSNR in decibels, structural similarity; seconds never rise with the step.
    points: Vec<[f64; 4]>,
    /// Noise of every rendering: ln(measured seconds / seconds of the curve).
    residuals: Vec<f64>,
}

impl Curve {
    /// The curve over the ray step, from a frame's points at scale 1. The seconds at a step are the median of
    /// the repeats. If seconds rise over neighboring steps, these steps all get the geometric mean of their
    /// seconds.
    pub fn of(points: &[TracePoint]) -> Self {
        Self::over(points.iter().filter(|p| p.scale == 1.0).map(|p| (f64::from(p.step), p)).collect())
    }

    /// The curve over image resolution, from a frame's points at the reference step; `None` without smaller
    /// images.
    pub fn of_images(points: &[TracePoint]) -> Option<Self> {
        let mut images: Vec<(f64, &TracePoint)> = points
            .iter()
            .filter(|p| p.step == 1.0 && p.scale <= 1.0)
            .map(|p| (f64::from(p.scale).powi(-2), p))
            .collect();
        images.sort_by(|a, b| a.0.total_cmp(&b.0));
        (images.len() >= 2 && images[0].0 == 1.0).then(|| Self::over(images))
    }

    /// The curve over points with ascending steps.
    fn over(points: Vec<(f64, &TracePoint)>) -> Self {
        let logs: Vec<f64> =
            points.iter().map(|(_, p)| median(&mut p.seconds.clone()).unwrap_or(f64::NAN).ln()).collect();
        let mut pools: Vec<(f64, usize)> = Vec::new();
        for &y in &logs {
            pools.push((y, 1));
            while let [.., a, b] = pools[..] {
                if a.0 / a.1 as f64 >= b.0 / b.1 as f64 {
                    break;
                }
                pools.truncate(pools.len() - 2);
                pools.push((a.0 + b.0, a.1 + b.1));
            }
        }
        let smooth: Vec<f64> = pools.iter().flat_map(|(sum, n)| vec![sum / *n as f64; *n]).collect();
        let residuals = points
            .iter()
            .zip(&smooth)
            .flat_map(|((_, p), y)| p.seconds.iter().map(|t| t.ln() - y).collect::<Vec<_>>())
            .collect();
        let points = points.iter().zip(&smooth).map(|((x, p), y)| [x.ln(), *y, p.psnr, p.ssim]).collect();
        Self { points, residuals }
    }

    /// The coarsest recorded step.
    pub fn coarsest(&self) -> f64 {
        self.points.last().map_or(1.0, |p| p[0].exp())
    }

    fn at(&self, step: f64, k: usize) -> f64 {
        let x = step.max(1e-9).ln();
        let upper = self.points.partition_point(|p| p[0] < x);
        if upper == 0 {
            return self.points[0][k];
        }
        if upper == self.points.len() {
            return self.points[upper - 1][k];
        }
        let (a, b) = (&self.points[upper - 1], &self.points[upper]);
        a[k] + (b[k] - a[k]) * (x - a[0]) / (b[0] - a[0])
    }

    /// Returns the frame's seconds at a step, without noise.
    pub fn seconds(&self, step: f64) -> f64 {
        self.at(step, 1).exp()
    }

    /// PSNR, decibels.
    pub fn psnr(&self, step: f64) -> f64 {
        self.at(step, 2)
    }

    /// Structural similarity.
    pub fn ssim(&self, step: f64) -> f64 {
        self.at(step, 3)
    }

    /// Returns one of the measured values of this frame's noise, in ln(seconds); `which` selects the value.
    pub fn noise(&self, which: u64) -> f64 {
        self.residuals[(which % self.residuals.len() as u64) as usize]
    }

    /// Step of an oracle: the finest step within the limits whose seconds do not exceed the target; the
    /// coarsest step if there is none.
    pub fn oracle(&self, target: f64, finest: f64, coarsest: f64) -> f64 {
        if self.seconds(finest) <= target {
            return finest;
        }
        if self.seconds(coarsest) > target {
            return coarsest;
        }
        let (mut low, mut high) = (finest.ln(), coarsest.ln());
        for _ in 0..40 {
            let mid = 0.5 * (low + high);
            if self.seconds(mid.exp()) <= target { high = mid } else { low = mid }
        }
        high.exp()
    }

    /// True if the target lies between the seconds at the finest and at the coarsest step.
    pub fn reaches(&self, target: f64, finest: f64, coarsest: f64) -> bool {
        (self.seconds(coarsest)..=self.seconds(finest)).contains(&target)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(step: f32, seconds: &[f64]) -> TracePoint {
        TracePoint { step, scale: 1.0, seconds: seconds.to_vec(), psnr: 50.0 - f64::from(step), ssim: 1.0 }
    }

    #[test]
    fn a_recording_is_not_gone_on_with_after_a_volume_was_written_anew() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("v.nrrd");
        let volume = |bytes: &[u8]| {
            std::fs::write(&file, bytes).unwrap();
            let files = entire_io::identity::of_volume(&file).unwrap();
            [TraceVolume { file: file.clone(), enlarge: 1, files }]
        };
        let then = volume(b"one");
        assert!(same_volumes(&then, &volume(b"one")));
        assert!(!same_volumes(&then, &volume(b"two")));
        let unknown = [TraceVolume { files: Vec::new(), ..then[0].clone() }];
        assert!(same_volumes(&unknown, &volume(b"two")));
        assert!(!same_volumes(&then, &[TraceVolume { enlarge: 2, ..then[0].clone() }]));
        assert!(!same_volumes(&then, &[]));
    }

    #[test]
    fn curves_interpolate_fall_and_keep_their_noise() {
        let c = Curve::of(&[point(1.0, &[4.0]), point(2.0, &[2.0]), point(4.0, &[0.9, 1.1])]);
        assert!((c.seconds(1.0) - 4.0).abs() < 1e-9 && (c.seconds(2f64.sqrt()) - 8f64.sqrt()).abs() < 1e-9);
        assert!((c.seconds(0.1) - 4.0).abs() < 1e-9 && (c.seconds(99.0) - 1.0).abs() < 1e-9);
        assert_eq!(c.residuals.len(), 4);
        assert!((c.noise(2) - 0.9f64.ln()).abs() < 1e-9 && c.noise(6) == c.noise(2));
        assert!((c.psnr(2.0) - 48.0).abs() < 1e-9);
        // The time rises from step 1 to 2, so both points get their geometric mean (isotonic regression).
        let c = Curve::of(&[point(1.0, &[2.0]), point(2.0, &[4.0]), point(4.0, &[1.0])]);
        assert!((c.seconds(1.0) - 8f64.sqrt()).abs() < 1e-9 && c.seconds(1.0) == c.seconds(2.0));
    }

    #[test]
    fn curves_over_images_are_of_the_reference_step() {
        let image = |scale: f32, t: f64| TracePoint { scale, ssim: f64::from(scale), ..point(1.0, &[t]) };
        let frame = [
            point(1.0, &[4.0]),
            point(2.0, &[3.0]),
            image(0.5, 1.0),
            image(0.1, 0.2),
            TracePoint { step: 2.0, ..image(0.7, 1.5) },
        ];
        let c = Curve::of_images(&frame).unwrap();
        // The images have a fourth and a hundredth of the pixels; s is interpolated between points like a
        // step.
        assert!((c.seconds(4.0) - 1.0).abs() < 1e-9 && (c.seconds(2.0) - 2.0).abs() < 1e-9);
        assert!((c.coarsest() - 100.0).abs() < 1e-4 && (c.seconds(400.0) - 0.2).abs() < 1e-9);
        assert!((c.ssim(4.0) - 0.5).abs() < 1e-9 && (c.ssim(1.0) - 1.0).abs() < 1e-9);
        assert_eq!(Curve::of(&frame).points.len(), 2);
        assert_eq!(Curve::of_images(&frame[..2]), None);
        assert_eq!(Curve::of_images(&frame[1..]), None);
    }

    #[test]
    fn every_frame_has_steps_and_images_and_no_point_twice() {
        for index in 0..8 {
            let grid = grid(&TRACE_STEPS, index);
            let images: Vec<f32> = grid[TRACE_STEPS.len()..][..TRACE_IMAGES.len()]
                .iter()
                .map(|(step, scale)| {
                    assert_eq!(*step, 1.0);
                    scale.powi(-2)
                })
                .collect();
            assert!(images.iter().zip(TRACE_IMAGES).all(|(a, b)| (a / b - 1.0).abs() < 1e-5), "{images:?}");
            assert_eq!(grid[..TRACE_STEPS.len()].to_vec(), TRACE_STEPS.map(|s| (s, 1.0)));
            // Half of every side at the reference step (s = 4) is in both lists, so only 7 of the 8 points of
            // the second list are new.
            assert_eq!(grid.len(), if index % 4 == 0 { 9 + 11 + 7 } else { 9 + 11 });
            assert!(grid.iter().enumerate().all(|(i, point)| !grid[..i].contains(point)), "{grid:?}");
            for step in SCALED_STEPS.iter().filter(|_| index % 4 == 0) {
                assert!(TRACE_SCALES.iter().all(|scale| grid.contains(&(*step, *scale))));
            }
        }
        assert_eq!(grid(&[1.0, 2.0], 0), [(1.0, 1.0), (2.0, 1.0)]);
    }

    #[test]
    fn the_oracle_is_the_finest_step_that_fits() {
        let c = Curve::of(&[point(1.0, &[4.0]), point(2.0, &[2.0]), point(4.0, &[1.0])]);
        assert!((c.oracle(2.0, 1.0, 4.0) - 2.0).abs() < 1e-6);
        assert_eq!(c.oracle(9.0, 1.0, 4.0), 1.0);
        assert_eq!(c.oracle(0.5, 1.0, 4.0), 4.0);
        assert!(c.reaches(2.0, 1.0, 4.0) && !c.reaches(9.0, 1.0, 4.0) && !c.reaches(0.5, 1.0, 4.0));
    }
}
