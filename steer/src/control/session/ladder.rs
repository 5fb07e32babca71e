//! A probe that begins coarse.

use super::Session;
use crate::features::{FrameFeatures, MAX_PROBE_SIDE, Setting};
use crate::predict::Prediction;
use entire_core::Result;
use entire_core::bail;
use entire_core::scene::Frame;
use glam::Vec3;

/// Rays along each side of the probes that a plan begins with, coarsest first.
const SIDES: [usize; 4] = [4, 7, 11, 16];

/// The probe is taken to be off by at most as many of its standard errors: of normal errors 95 % are smaller.
const STANDARD_ERRORS: f32 = 2.0;

/// How far the eye may turn about the volume, and the view about the eye, before rays are cast again, in radians
/// per unit of the tolerance: after a turn by the tolerance over d ln(time) / d angle, the frame takes the tolerance's share
/// of its time more. That slope stays below 1 / `TURN` on the recorded training paths.
const TURN: f32 = 0.4;

/// As [`TURN`], of ln of the eye's distance.
const APPROACH: f32 = 0.15;

/// The frame that the probe's rays were cast for.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cast {
    setting: Setting,
    termination: f32,
    eye: Vec3,
    axis: Vec3,
    /// Height of the view at distances 0 and 1.
    heights: [f32; 2],
}

impl Cast {
    fn of(frame: &Frame) -> Self {
        let camera = &frame.camera;
        Self {
            setting: Setting { step: 1.0, ..Setting::from(frame) },
            termination: frame.termination,
            eye: camera.eye(),
            axis: camera.view().row(2).truncate(),
            heights: [camera.height_at(0.0), camera.height_at(1.0)],
        }
    }

    /// Whether rays cast for this frame tell of another as well as the tolerance asks.
    fn serves(&self, other: &Self, tolerance: f32) -> bool {
        let least = libm::cosf(TURN * tolerance);
        let near =
            |a: Vec3, b: Vec3| a.dot(b) >= least * libm::sqrtf(a.length_squared() * b.length_squared());
        let approach = libm::fabsf(libm::logf(self.eye.length() / other.eye.length()));
        self.setting == other.setting
            && self.termination == other.termination
            && self.heights == other.heights
            && near(self.eye, other.eye)
            && near(self.axis, other.axis)
            && approach <= APPROACH * tolerance
    }
}

/// How far a plan looks.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ladder {
    /// Rays along each side of the finest probe.
    finest: usize,
    /// Share of a frame's time that a plan need not know.
    tolerance: f32,
}

impl Session {
    /// Measures frames with `side`² probe rays: fewer cost less time and scatter more (see
    /// [`FrameFeatures::with_probe_side`]). For linear cost models
    /// ([`crate::Predictor::any_probe_side`]); a network keeps the probe that it was trained with.
    ///
    /// With a `tolerance`, plans begin with a probe of 4² rays, and take one of 7², 11², 16² and at last `side`² only
    /// while the error that a probe estimates of itself could change the plan: while it is larger than the tolerance (a
    /// share of the frame's time, which changes the step by as much), unless even so the finest step surely meets the
    /// target, or the coarsest surely does not. While the view has hardly turned since rays were cast, plans take what
    /// those met, and where the volume stands in the image now. So `side` bounds what a plan may cost, and most plans cost less.
    /// [`FrameFeatures::probe_side`] of [`Session::features`] tells how far the last one went.
    /// [`Session::predict`] and [`Session::choose`] take the finest probe.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for a side of 0 or over [`MAX_PROBE_SIDE`], and for a tolerance
    /// that is not in 0…1.
    pub fn with_probe(mut self, side: usize, tolerance: Option<f32>) -> Result<Self> {
        if !(1..=MAX_PROBE_SIDE).contains(&side) {
            bail!(
                InvalidArgument,
                "the probe is to have {side} rays along each side; accepted are 1 to {MAX_PROBE_SIDE}"
            );
        }
        if let Some(share) = tolerance
            && !(0.0..=1.0).contains(&share)
        {
            bail!(
                InvalidArgument,
                "the probe's tolerance is {share}; a share of the frame's time from 0 to 1 is accepted"
            );
        }
        if self.predictor.any_probe_side() {
            self.features = FrameFeatures::with_probe_side(side);
            self.ladder = tolerance.map(|tolerance| Ladder { finest: side, tolerance });
        }
        Ok(self)
    }

    /// Notes which frame rays are cast for.
    pub(super) fn note_cast(&mut self, frame: &Frame) {
        self.cast_for = self.ladder.map(|_| Cast::of(frame));
    }

    /// Measures a frame as finely as anything may.
    pub(super) fn measure(&mut self, frame: &Frame) -> Result<()> {
        if let Some(ladder) = self.ladder {
            self.features.set_probe_side(ladder.finest);
        }
        self.cast(frame)
    }

    /// Measures a frame as finely as its plan needs.
    pub(super) fn measure_for(&mut self, frame: &Frame, target: f32) -> Result<()> {
        let Some(ladder) = self.ladder else { return self.cast(frame) };
        let view = Cast::of(frame);
        if self.cast_for.is_some_and(|cast| cast.serves(&view, ladder.tolerance))
            && !self.changes_for(frame).any()
            && let Some(volume) = &self.volume
            && self.features.turn(volume, frame)?
            // Nothing is finer than the finest.
            && (self.features.probe_side() >= ladder.finest
                || self.suffices(frame, target, ladder.tolerance)?)
        {
            return Ok(());
        }
        for side in SIDES.into_iter().filter(|&side| side < ladder.finest) {
            self.features.set_probe_side(side);
            self.cast(frame)?;
            if self.suffices(frame, target, ladder.tolerance)? {
                return Ok(());
            }
        }
        self.measure(frame)
    }

    /// Whether the plan would stay as it is, however wrong the probe is likely to be.
    fn suffices(&mut self, frame: &Frame, target: f32, tolerance: f32) -> Result<bool> {
        let error = STANDARD_ERRORS * self.features.probe_error();
        if error <= tolerance {
            return Ok(true);
        }
        if !error.is_finite() {
            return Ok(false);
        }
        let changes = self.changes_for(frame);
        let limits = self.coarsening.limits();
        let (controller, mut cost) = self.costing(changes, Setting::from(frame))?;
        let finest = controller.correct(&cost.at(limits.finest), changes);
        let slower = Prediction {
            seconds: finest.seconds * (1.0 + error),
            upper: finest.upper * (1.0 + error),
            ..finest
        };
        if controller.fits(&slower, target) {
            return Ok(true);
        }
        let coarsest = controller.correct(&cost.at(limits.coarsest), changes);
        Ok(coarsest.seconds > target * (1.0 + error))
    }
}
