//! A probe that begins with few rays and is refined while its error could change the plan.

use super::Session;
use crate::features::{FrameFeatures, MAX_PROBE_SIDE, PROBE_SIDE, Setting};
use crate::predict::Prediction;
use entire_core::Result;
use entire_core::bail;
use entire_core::scene::Frame;
use glam::Vec3;

/// Numbers of rays along each side of the successive probes of a plan, coarsest first.
const SIDES: [usize; 4] = [4, 7, 11, 16];

/// Upper bound of the probe's error, in standard errors: 95 % of normal errors are smaller.
const STANDARD_ERRORS: f32 = 2.0;

/// Largest turn of the eye about the volume, and of the view about the eye, for which rays are not cast
/// again, in radians per unit of the tolerance. On the recorded training paths, a turn by an angle changes
/// ln(time) by less than angle / `TURN`, so the time changes by less than the tolerance.
const TURN: f32 = 0.4;

/// Largest change of ln(distance of the eye from the volume's center) for which rays are not cast again, per
/// unit of the tolerance. The value was derived as that of [`TURN`].
const APPROACH: f32 = 0.15;

/// View and settings for which the probe's rays were cast.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cast {
    setting: Setting,
    termination: f32,
    eye: Vec3,
    axis: Vec3,
    up: Vec3,
    /// Height of the visible region at distances 0 and 1 from the eye, in scene units.
    heights: [f32; 2],
}

impl Cast {
    pub(super) fn of(frame: &Frame) -> Self {
        let camera = &frame.camera;
        Self {
            setting: Setting { step: 1.0, ..Setting::from(frame) },
            termination: frame.termination,
            eye: camera.eye(),
            axis: camera.view().row(2).truncate(),
            up: camera.view().row(1).truncate(),
            heights: [camera.height_at(0.0), camera.height_at(1.0)],
        }
    }

    /// True if rays cast for this view may be reused for `other`, within the tolerance.
    fn serves(&self, other: &Self, tolerance: f32) -> bool {
        let distance = self.eye.length();
        let height = self.heights[0] + distance * (self.heights[1] - self.heights[0]);
        // If the visible height is less than half of the eye's distance from the volume's center, even a turn
        // within the tolerance may show other parts of the volume. So the tolerance is reduced.
        let tolerance = tolerance * (2.0 * height / distance).min(1.0);
        let least = libm::cosf(TURN * tolerance);
        let near =
            |a: Vec3, b: Vec3| a.dot(b) >= least * libm::sqrtf(a.length_squared() * b.length_squared());
        let approach = libm::fabsf(libm::logf(self.eye.length() / other.eye.length()));
        self.setting == other.setting
            && self.termination == other.termination
            && self.heights == other.heights
            && near(self.eye, other.eye)
            && near(self.axis, other.axis)
            && near(self.up, other.up)
            && approach <= APPROACH * tolerance
    }
}

/// Refinement of the probe.
#[derive(Clone, Copy, Debug)]
pub(super) struct AdaptiveProbe {
    /// Number of rays along each side of the finest probe.
    finest: usize,
    /// Largest accepted error of a frame's time, as a share of this time.
    tolerance: f32,
}

impl Session {
    /// Sets the number of probe rays to `side`²: fewer rays take less time, and their estimates have a larger
    /// variance (see [`FrameFeatures::of`]). The number affects only analytic models
    /// ([`crate::Predictor::any_probe_side`]); a network keeps the probe with which it was trained.
    ///
    /// With a `tolerance`, a plan begins with a probe of 4² rays and refines it to 7², 11², 16² and at last
    /// `side`² rays. The refinement stops as soon as the probe's estimated error is at most the tolerance (a
    /// share of the frame's time; the step changes by about the same share). It also stops if the error
    /// is unlikely to change the plan: the finest step meets the target even if its time is longer by the
    /// error, or the coarsest step exceeds the target by more than the error. While the view has hardly
    /// turned since rays were cast, plans reuse the rays' results and recompute only the volume's place in
    /// the image. So `side` bounds the time of a plan, and most plans take less time than this bound.
    /// [`Session::probe`] returns the side of the last probe. If the finest probe's number of rays changes,
    /// recorded frames are dropped. [`Session::predict`] and [`Session::choose`] use the finest probe, and so
    /// do plans while frames are recorded ([`Session::record`]).
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for a side of 0 or over [`MAX_PROBE_SIDE`], and for a tolerance
    /// outside 0…1.
    pub fn with_probe(mut self, side: usize, tolerance: Option<f32>) -> Result<Self> {
        if !(1..=MAX_PROBE_SIDE).contains(&side) {
            bail!(
                InvalidArgument,
                "the probe's side is {side} rays; a number of rays from 1 to {MAX_PROBE_SIDE} is accepted"
            );
        }
        if let Some(share) = tolerance.filter(|share| !(0.0..=1.0).contains(share)) {
            bail!(
                InvalidArgument,
                "the probe's tolerance is {share}; a share of the frame's time from 0 to 1 is accepted"
            );
        }
        self.asked_probe = Some((side, tolerance));
        self.set_probe();
        Ok(self)
    }

    /// Sets the probe for the present predictor: the probe that the caller asked for, or the predictor's own
    /// probe.
    pub(super) fn set_probe(&mut self) {
        let side = match (self.predictor.probe_side(), self.asked_probe) {
            (_, Some((side, _))) if self.predictor.any_probe_side() => side,
            // Predictions without a probe are scaled by the analytic model, which needs a probe.
            (0, _) => PROBE_SIDE,
            (side, _) => side,
        };
        let asked = self.asked_probe.filter(|_| self.predictor.any_probe_side());
        self.adaptive_probe =
            asked.and_then(|(finest, tolerance)| Some(AdaptiveProbe { finest, tolerance: tolerance? }));
        if side != self.features.probe_side {
            self.features = FrameFeatures::with_probe_side(side);
        }
        #[cfg(feature = "calibrate")]
        {
            let finest = self.finest_probe_side();
            self.recording.iter_mut().for_each(|recording| recording.set_probe_side(finest));
        }
    }

    /// Measures a frame with the finest probe.
    pub(super) fn measure(&mut self, frame: &Frame) -> Result<()> {
        if let Some(adaptive_probe) = self.adaptive_probe {
            self.features.set_probe_side(adaptive_probe.finest);
        }
        self.cast(frame)
    }

    /// Measures a frame with as few rays as its plan needs.
    pub(super) fn measure_for(&mut self, frame: &Frame, target: f32) -> Result<()> {
        // Recorded frames are measured with the finest probe.
        let Some(adaptive_probe) = self.adaptive_probe.filter(|_| self.recording.is_none()) else {
            return self.measure(frame);
        };
        let view = Cast::of(frame);
        let serves = self.cast_for.is_some_and(|cast| cast.serves(&view, adaptive_probe.tolerance));
        let serves = serves && !self.changes_for(frame).any();
        let turned = match &self.volume {
            Some(volume) if serves => self.features.turn(volume, frame)?,
            _ => false,
        };
        // After the finest probe, no check is needed.
        if turned
            && (self.features.probe_side >= adaptive_probe.finest
                || self.suffices(frame, target, adaptive_probe.tolerance)?)
        {
            return Ok(());
        }
        for side in SIDES.into_iter().filter(|&side| side < adaptive_probe.finest) {
            self.features.set_probe_side(side);
            self.cast(frame)?;
            if self.suffices(frame, target, adaptive_probe.tolerance)? {
                return Ok(());
            }
        }
        self.measure(frame)
    }

    /// Number of rays along each side of the finest probe, which measures recorded frames.
    #[cfg(feature = "calibrate")]
    pub(super) fn finest_probe_side(&self) -> usize {
        self.adaptive_probe.map_or(self.features.probe_side, |adaptive_probe| adaptive_probe.finest)
    }

    /// True if the probe's error is within the tolerance, or is unlikely to change the plan.
    fn suffices(&mut self, frame: &Frame, target: f32, tolerance: f32) -> Result<bool> {
        let error = STANDARD_ERRORS * self.features.probe.error;
        if error <= tolerance {
            return Ok(true);
        }
        if !error.is_finite() {
            return Ok(false);
        }
        let changes = self.changes_for(frame);
        let limits = self.coarsening.limits();
        let (controller, mut cost) = self.costing(changes, Setting::from(frame))?;
        let finest = controller.judged(&cost.at(limits.finest), changes);
        let slower = Prediction {
            seconds: finest.seconds * (1.0 + error),
            upper: finest.upper * (1.0 + error),
            ..finest
        };
        if controller.fits(&slower, target) {
            return Ok(true);
        }
        let coarsest = controller.judged(&cost.at(limits.coarsest), changes);
        Ok(coarsest.seconds > target * (1.0 + error))
    }
}
