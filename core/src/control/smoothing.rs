//! How much of a change that is predicted from frame to frame is believed.

use super::HybridConstants;
use crate::Result;
use crate::adapt::state::{Reader, Writer};

/// Smooths ln of the prediction over the frames of one scene: s_i = s_{i-1} + w · (p_i − s_{i-1}).
///
/// A prediction that is worked out anew for every frame has an error of its own in every frame, which no
/// correction can follow; small changes of it are in part such errors. The weight w is the share of a
/// predicted change that has proved true: it is learned by normalized least mean squares from the sign and
/// size of what is left to explain. 1 leaves the prediction as it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Smoothing {
    weight: f64,
    /// s − p of the frame at hand.
    offset: f64,
    /// p − s of the frame before, for the frame at hand.
    change: f64,
    /// Mean square of the changes.
    power: f64,
    pace: f64,
    power_pace: f64,
}

/// 1 is all of a change, by definition. At 0 no error would be seen from which to learn: a guard.
const WEIGHT: (f64, f64) = (0.1, 1.0);
/// A guard: offsets stay within a factor of e^±1.
const LIMIT: f64 = 1.0;
/// Mean square of the changes before any was seen, forgotten within some ten frames: changes of 2 %.
const POWER: f64 = 4.0e-4;
/// A guard against division by nothing: changes of 0.1 %, less than any clock's noise.
const LEAST_POWER: f64 = 1.0e-6;
/// Guards: no frame counts as a larger change or error, nor moves the weight by more.
const LARGEST_CHANGE: f64 = 0.2;
const LARGEST_ERROR: f64 = 0.3;
const LARGEST_MOVE: f64 = 0.1;

impl Smoothing {
    pub(super) fn new(constants: &HybridConstants) -> Self {
        let weight = constants.believed_start.clamp(WEIGHT.0, WEIGHT.1);
        let (pace, power_pace) = (constants.believed_pace, constants.power_pace);
        Self { weight, offset: 0.0, change: 0.0, power: POWER, pace, power_pace }
    }

    /// Moves on by a frame whose prediction differs from the one before by `moved` in ln(seconds) at one
    /// step; NaN where that is not known. `novelty` is 1 where the frame begins a scene. Returns what to add
    /// to ln of its prediction.
    pub(super) fn advance(&mut self, moved: f64, novelty: f64) -> f64 {
        if !moved.is_finite() || novelty >= 1.0 {
            self.offset = 0.0;
            self.change = 0.0;
            return 0.0;
        }
        self.change = moved - self.offset;
        let keep = (1.0 - self.weight) * (1.0 - novelty.max(0.0));
        self.offset = (-keep * self.change).clamp(-LIMIT, LIMIT);
        self.offset
    }

    /// Learns from ln(measured / expected) of the frame at hand.
    pub(super) fn observe(&mut self, error: f64) {
        let change = self.change.clamp(-LARGEST_CHANGE, LARGEST_CHANGE);
        if !error.is_finite() || change == 0.0 {
            return;
        }
        self.power = (self.power + self.power_pace * (change * change - self.power)).clamp(LEAST_POWER, 1.0);
        let move_by = self.pace * error.clamp(-LARGEST_ERROR, LARGEST_ERROR) * change / self.power;
        self.weight = (self.weight + move_by.clamp(-LARGEST_MOVE, LARGEST_MOVE)).clamp(WEIGHT.0, WEIGHT.1);
    }

    pub(super) fn save(&self, w: &mut Writer<'_>) {
        w.f64(self.weight);
        w.f64(self.power);
    }

    pub(super) fn load(&mut self, r: &mut Reader<'_>) -> Result<()> {
        (self.offset, self.change) = (0.0, 0.0);
        self.weight = r.f64(WEIGHT.0, WEIGHT.1)?;
        self.power = r.f64(LEAST_POWER, 1.0)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Drives with a true change per frame and a prediction error per frame; returns the weight and the mean
    /// square error relative to taking the prediction as it is.
    fn drive(truth: impl Fn(usize) -> f64, jitter: f64) -> (f64, f64) {
        let mut s = Smoothing::new(&HybridConstants::default());
        let mut state = 7u64;
        let mut uniform = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        };
        let (mut before, mut sum, mut plain) = (0.0, 0.0, 0.0);
        for i in 0..3000 {
            let wrong = jitter * 3.46 * uniform();
            let p = truth(i) + wrong;
            let offset = s.advance(p - before, if i == 0 { 1.0 } else { 0.0 });
            before = p;
            let noise = 0.02 * 3.46 * uniform();
            let error = truth(i) + noise - (p + offset);
            s.observe(error);
            if i > 300 {
                sum += (error - noise) * (error - noise);
                plain += wrong * wrong;
            }
        }
        (s.weight, sum / plain.max(1e-12))
    }

    #[test]
    fn changes_that_prove_true_are_taken_and_jitter_is_not() {
        // Steady cost, jittering prediction: most of the jitter goes.
        let (weight, ratio) = drive(|_| 0.0, 0.05);
        assert!(weight < 0.4 && ratio < 0.35, "{weight} {ratio}");
        // Cost that swings as foretold.
        let (weight, _) = drive(|i| 0.5 * libm::sin(i as f64 * 0.5), 1e-4);
        assert!(weight > 0.9, "{weight}");
    }

    #[test]
    fn a_scene_begins_with_its_own_prediction_and_nothing_unbounds_it() {
        let mut s = Smoothing::new(&HybridConstants::default());
        assert!(s.advance(0.1, 0.0) != 0.0);
        assert_eq!(s.advance(0.1, 1.0), 0.0);
        assert_eq!(s.advance(f64::NAN, 0.0), 0.0);
        for v in [f64::NAN, f64::INFINITY, -1e300, 1e300, 0.0, -0.5] {
            for _ in 0..200 {
                let o = s.advance(v, 0.0);
                assert!(o.is_finite() && o.abs() <= LIMIT);
                s.observe(v);
                assert!((WEIGHT.0..=WEIGHT.1).contains(&s.weight));
            }
        }
    }
}
