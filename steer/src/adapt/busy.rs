//! Processor time per wall time of frames.

use super::constants::{CLIP, ESTABLISHED_FRAMES, PACE};

/// Usual ratio of a frame's processor time to its wall time. The ratio falls as soon as other programs take
/// processors away from the renderer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Busy {
    /// Mean and variance of ln(processor time / wall time) of undisturbed frames.
    mean: f64,
    variance: f64,
    /// Number of undisturbed frames.
    frames: u64,
    /// Number of the last consecutive disturbed frames.
    disturbed: u64,
}

/// Number of undisturbed frames after which the usual ratio is known.
const KNOWN_FRAMES: u64 = 3;
/// Smallest fall of the ratio, in ln, of a disturbed frame.
const LEAST_FALL: f64 = 0.15;

impl Busy {
    pub(crate) const UNKNOWN: Self = Self { mean: 0.0, variance: 0.0, frames: 0, disturbed: 0 };

    /// Takes ln(processor time / wall time) of a frame; NaN if the processor time is unknown. Returns true if
    /// the ratio is unusually low: other programs disturbed the frame. A ratio that stays low becomes the
    /// usual one after [`ESTABLISHED_FRAMES`] frames.
    pub(crate) fn observe(&mut self, ratio: f64) -> bool {
        if !ratio.is_finite() {
            return false;
        }
        let fall = (CLIP * libm::sqrt(self.variance)).max(LEAST_FALL);
        if self.frames >= KNOWN_FRAMES && ratio < self.mean - fall {
            self.disturbed += 1;
            if self.disturbed > ESTABLISHED_FRAMES {
                *self = Self { mean: ratio, frames: 1, ..Self::UNKNOWN };
            }
            return true;
        }
        self.disturbed = 0;
        self.frames = self.frames.saturating_add(1);
        let pace = (1.0 / self.frames as f64).max(PACE);
        let error = ratio - self.mean;
        self.mean += pace * error;
        self.variance += pace * (error * error * (1.0 - pace) - self.variance);
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::Noise;

    /// Observes frames whose ratio is `usual` with a noise of 2 %.
    fn known(busy: &mut Busy, noise: &mut Noise, usual: f64, frames: usize) -> usize {
        (0..frames).filter(|_| busy.observe(libm::log(usual) + 0.02 * noise.normal())).count()
    }

    #[test]
    fn a_frame_that_got_fewer_processors_is_disturbed() {
        let (mut busy, mut noise) = (Busy::UNKNOWN, Noise(3));
        assert_eq!(known(&mut busy, &mut noise, 1.9, 200), 0);
        assert!(busy.observe(libm::log(1.5)));
        assert!(!busy.observe(libm::log(1.75)));
        assert!(!busy.observe(f64::NAN) && !busy.observe(f64::NEG_INFINITY));
        assert!(busy.observe(libm::log(1.5)), "frames without processor time change nothing");
    }

    #[test]
    fn a_ratio_that_stays_low_becomes_the_usual_one() {
        let (mut busy, mut noise) = (Busy::UNKNOWN, Noise(5));
        known(&mut busy, &mut noise, 1.9, 20);
        let disturbed = known(&mut busy, &mut noise, 1.0, 200) as u64;
        assert_eq!(disturbed, ESTABLISHED_FRAMES + 1);
    }

    #[test]
    fn a_ratio_that_scatters_shows_no_disturbance() {
        let (mut busy, mut noise) = (Busy::UNKNOWN, Noise(7));
        let found = (0..500).filter(|_| busy.observe(0.5 * noise.normal())).count();
        assert!(found < 10, "{found}");
    }
}
