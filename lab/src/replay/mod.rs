//! Replay of traces: controllers act on recorded time curves and are scored beside an oracle that knows the
//! curves.

mod bars;
mod disturbance;
mod frontier;
pub(crate) mod report;
mod score;
mod trials;
pub(crate) mod tune;

pub(crate) use bars::{bars, played, second_in_bound};
pub use disturbance::{Disturbance, Slowdown};
pub(crate) use frontier::frontier;
pub use score::{Score, Tally, Three};
pub use trials::Player;
pub(crate) use trials::{Outcome, Trial, play, trials, trials_of_all};

use crate::trace::{Curve, Trace};
use anyhow::{Context, Result, ensure};
use entire_cli::steering::play::{ActsOn, Contender};
use entire_io::path::FlightPath;
use entire_steer::control::{ObserveFlags, Reason, StepLimits};
use entire_steer::features::{Changes, VolumeSummary};
use std::ops::Range;
use std::sync::Arc;

/// Number of frames that are not calm, counted from a path's first frame, or from the frame with a change
/// other than gradual motion of the camera.
pub const SETTLING: usize = 3;

/// Limits of the ray step in `entire-lab replay` and `entire-lab tune`, reference steps. Rules that act on
/// image resolution have their own ranges.
const LIMITS: StepLimits = StepLimits { finest: 1.0, coarsest: 16.0 };

/// A trace that is ready to be replayed.
#[derive(Clone)]
pub struct Replayable {
    /// The recording.
    pub trace: Trace,
    /// Path of the trace, frame by frame.
    pub path: FlightPath,
    /// Time and quality of each frame over the ray step.
    pub curves: Vec<Curve>,
    /// Time and quality of each frame over image resolution, at the reference step; `None` if some frame was
    /// drawn without smaller images.
    pub images: Option<Vec<Curve>>,
    /// Summary of each volume.
    pub summaries: Vec<VolumeSummary>,
    /// True for frames with an abrupt change: a switch of the path, another image size, or another volume if
    /// each volume is shown for at least four frames.
    pub switches: Vec<bool>,
    /// Slowdown by other programs during the replay, if any.
    pub disturbance: Option<Arc<Disturbance>>,
}

impl Replayable {
    /// Opens the volumes of a trace and computes its curves.
    ///
    /// # Errors
    /// When a volume is missing or the path is wrong.
    pub fn new(trace: Trace) -> Result<Self> {
        let path = trace.path.resolve()?;
        let curves = trace.frames.iter().map(|f| Curve::of(f)).collect();
        let images = trace.frames.iter().map(|f| Curve::of_images(f)).collect();
        let summaries = trace.summaries().with_context(|| format!("trace {}", trace.name))?;
        let switches = (0..path.frames.len())
            .map(|i| {
                i > 0
                    && (path.frames[i].switched()
                        || (trace.hold >= 4 && trace.volume_at(i) != trace.volume_at(i - 1))
                        || trace.scales.iter().any(|(from, _)| *from as usize == i))
            })
            .collect();
        Ok(Self { trace, path, curves, images, summaries, switches, disturbance: None })
    }

    /// Returns the same path, replayed under a recorded slowdown by other programs. The slowdown's name is
    /// appended to the path's name.
    #[must_use]
    pub fn disturbed(mut self, disturbance: &Arc<Disturbance>) -> Self {
        self.trace.name = format!("{}/{}", self.trace.name, disturbance.name);
        self.disturbance = Some(Arc::clone(disturbance));
        self
    }

    /// Returns the curves from which a controller gets its frame times, and the limits of its decisions:
    /// `of_step`, or the controller's own range of image resolution, as far as it was recorded.
    fn answers(&self, acts_on: ActsOn, of_step: StepLimits) -> Result<(&[Curve], StepLimits)> {
        let ActsOn::ImageResolution { .. } = acts_on else { return Ok((&self.curves, of_step)) };
        let images = self.images.as_deref().with_context(|| {
            format!(
                "trace {} has frames without smaller images at the reference step; record it again",
                self.trace.name
            )
        })?;
        let recorded = images.iter().map(Curve::coarsest).fold(f64::INFINITY, f64::min) as f32;
        let StepLimits { finest, coarsest } = acts_on.limits(of_step);
        Ok((images, StepLimits { finest, coarsest: coarsest.min(recorded) }))
    }
}

/// One frame of a replay.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Replayed {
    /// Target, seconds.
    pub target: f64,
    /// Measured seconds.
    pub seconds: f64,
    /// Seconds that the controller expects; NaN without a prediction.
    pub predicted: f64,
    /// Upper bound of the controller, seconds; NaN without one.
    pub upper: f64,
    /// Decision of the controller: the ray step, or s of [`ActsOn::ImageResolution`].
    pub step: f64,
    /// Finest value that meets the target without noise: of the ray step or of s, as in `step`.
    pub finest_step: f64,
    /// The oracle's step.
    pub oracle_step: f64,
    /// Seconds of the frame at the oracle's step, with the same noise, without slowdown by other programs.
    pub oracle_seconds: f64,
    /// PSNR against the reference picture, decibels.
    pub psnr: f64,
    /// PSNR at the oracle's step, decibels.
    pub oracle_psnr: f64,
    /// Structural similarity to the reference picture.
    pub ssim: f64,
    /// Structural similarity at the oracle's step.
    pub oracle_ssim: f64,
    /// True if the frame meets the target at the coarsest allowed step.
    pub feasible: bool,
    /// True if the frame takes exactly the target time at some allowed step.
    pub reachable: bool,
    /// True if the scene or the target changed abruptly in this frame.
    pub switched: bool,
    /// True if each of the last [`SETTLING`] frames, this one included, differs from the frame before it only
    /// by a gradual motion of the camera.
    pub calm: bool,
    /// Reason for the decision.
    pub reason: Reason,
}

impl Replayed {
    /// The same frame as drawn by the oracle, which knows the curve but not the noise.
    pub fn by_oracle(&self) -> Self {
        Self {
            seconds: self.oracle_seconds,
            predicted: self.target,
            upper: f64::NAN,
            step: self.oracle_step,
            finest_step: self.oracle_step,
            psnr: self.oracle_psnr,
            ssim: self.oracle_ssim,
            ..*self
        }
    }
}

fn mix(a: u64, b: u64) -> u64 {
    let mut h = a.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ b.wrapping_mul(0xd1b5_4a32_d192_ed03);
    h ^= h >> 29;
    h = h.wrapping_mul(0xbf58_476d_1ce4_e5b9);
    h ^ (h >> 32)
}

/// Plays a range of the frames of a trace with `targets` (one per frame of the trace); the session starts at
/// the first frame of the range. `codes` are VolumeNet's outputs for the trace's volumes, or empty. The noise
/// of a frame is the same for every controller: `seed` selects one of the repeats that measured it. `limits`
/// are those of the ray step.
///
/// # Errors
/// When the number of targets is wrong, when a prediction fails (the error names the frame), and when the
/// controller acts on image resolution and the trace holds no smaller images.
pub fn replay(
    recorded: &Replayable,
    contender: &mut Contender,
    codes: &[Vec<f32>],
    targets: &[f64],
    limits: StepLimits,
    seed: u64,
    frames: Range<usize>,
) -> Result<Vec<Replayed>> {
    let n = recorded.path.frames.len();
    ensure!(targets.len() == n, "{} targets for {n} frames", targets.len());
    let start = frames.start;
    let (answers, own) = recorded.answers(contender.acts_on, limits)?;
    let session = &mut contender.session;
    session.set_limits(own)?;
    let (finest, coarsest) = (f64::from(limits.finest), f64::from(limits.coarsest));
    let mut out: Vec<Replayed> = Vec::with_capacity(frames.len());
    let mut shown = usize::MAX;
    let mut since_switch = 0;
    // Frames follow each other without a pause. Every round starts at another time of the recorded slowdown.
    let disturbance = recorded.disturbance.as_deref();
    let mut now = disturbance.map_or(0.0, |d| d.length() * (mix(seed, n as u64) % 1000) as f64 / 1000.0);
    for (index, at) in recorded.path.frames.iter().enumerate().take(frames.end).skip(start) {
        let place = || format!("frame {index} of trace {}", recorded.trace.name);
        let volume = recorded.trace.volume_at(index);
        let swapped = volume != shown;
        if swapped {
            session.set_volume(recorded.summaries[volume].clone(), codes.get(volume).cloned());
            shown = volume;
        }
        if at.transfer_changed || swapped {
            let table = at.transfer.function().to_table().with_context(place)?;
            session.set_transfer(&table, at.transfer.lobes().as_deref()).with_context(place)?;
        }
        if at.camera_switched && index > start {
            session.mark(Changes { camera: true, ..Changes::default() });
        }
        let frame = recorded.trace.frame(&recorded.path, index).with_context(place)?;
        let target = targets[index];
        let plan = session.plan(&frame, target as f32).with_context(place)?;
        let (curve, answer) = (&recorded.curves[index], &answers[index]);
        let step = f64::from(plan.step);
        let noise = curve.noise(mix(seed, index as u64)).exp();
        let undisturbed = answer.seconds(step) * noise;
        let seconds = disturbance.map_or(undisturbed, |d| d.wall(now, undisturbed));
        now += seconds;
        session.observe(plan.id, seconds as f32, ObserveFlags::default())?;
        let oracle_step = curve.oracle(target, finest, coarsest);
        let retargeted = index > start && (targets[index - 1] / target).ln().abs() > 0.05;
        let switched = (recorded.switches[index] && index > start) || retargeted;
        let announced = at.transfer_changed || swapped;
        since_switch = if switched || announced || index == start { 0 } else { since_switch + 1 };
        out.push(Replayed {
            target,
            seconds,
            predicted: f64::from(plan.seconds),
            upper: f64::from(plan.upper),
            step,
            finest_step: answer.oracle(target, f64::from(own.finest), f64::from(own.coarsest)),
            oracle_step,
            oracle_seconds: curve.seconds(oracle_step) * noise,
            psnr: answer.psnr(step),
            oracle_psnr: curve.psnr(oracle_step),
            ssim: answer.ssim(step),
            oracle_ssim: curve.ssim(oracle_step),
            feasible: curve.seconds(coarsest) <= target,
            reachable: curve.reaches(target, finest, coarsest),
            switched,
            calm: since_switch >= SETTLING,
            reason: plan.reason,
        });
    }
    Ok(out)
}

/// True for a useful target of a trace: some allowed step meets it exactly in at least half of the trace's
/// frames.
fn worth_playing(recorded: &Replayable, target: f64) -> bool {
    let (finest, coarsest) = (f64::from(LIMITS.finest), f64::from(LIMITS.coarsest));
    let reachable = recorded.curves.iter().filter(|c| c.reaches(target, finest, coarsest)).count();
    2 * reachable >= recorded.curves.len()
}
