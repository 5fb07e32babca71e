//! Range of a model's training data: of a network's inputs, and of an analytic model's work.

use super::network::Stored;
use alloc::boxed::Box;
use alloc::vec::Vec;
use entire_core::Result;
use entire_core::bail;
use entire_core::model::{Key, Model, ModelFile};

/// Range of each input in a model's training data, to which a network's inputs are clamped.
///
/// Outside their training data, networks extrapolate linearly. Linear extrapolation is not justified for a
/// network that predicts a factor on an estimated time.
#[derive(Clone, Debug, PartialEq)]
pub struct InputRange {
    /// Low and high end per input, each finite, low ≤ high.
    ends: Box<[(f32, f32)]>,
}

impl InputRange {
    /// Returns the range of rows of `width` inputs each. Values that are not finite are ignored. The `free`
    /// inputs that come after these `width` inputs are never clamped.
    pub(super) fn of_rows(rows: &[f32], width: usize, free: usize) -> Self {
        let mut seen = Self { ends: alloc::vec![(f32::MAX, f32::MIN); width].into() };
        seen.extend(rows, width);
        let any = |(low, high)| if low > high { (f32::MIN, f32::MAX) } else { (low, high) };
        let free = core::iter::repeat_n((f32::MIN, f32::MAX), free);
        Self { ends: seen.ends.iter().copied().map(any).chain(free).collect() }
    }

    /// Extends the range by further rows of `width` inputs each.
    pub(super) fn extend(&mut self, rows: &[f32], width: usize) {
        for row in rows.chunks_exact(width.max(1)) {
            for (&x, (low, high)) in row.iter().zip(&mut self.ends) {
                if x.is_finite() {
                    (*low, *high) = (low.min(x), high.max(x));
                }
            }
        }
    }

    /// Returns the range in a model file; `None` if the file states none, so that inputs are not clamped.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidModel`] if the number of inputs is not `width`, or if ends are not
    /// ascending or not finite.
    pub(super) fn of(model: &Model, width: usize) -> Result<Option<Self>> {
        let Some(stored) = Stored::of(model)? else { return Ok(None) };
        Self::of_ends(stored.input_low, stored.input_high, width)
    }

    /// Returns the range with these low and high ends of `width` inputs; `None` if both are missing.
    ///
    /// # Errors
    /// As [`InputRange::of`].
    pub(super) fn of_ends(
        low: Option<Vec<f32>>,
        high: Option<Vec<f32>>,
        width: usize,
    ) -> Result<Option<Self>> {
        if low.is_none() && high.is_none() {
            return Ok(None);
        }
        let [low, high] = [low, high].map(Option::unwrap_or_default);
        if low.len() != width || high.len() != width {
            bail!(
                InvalidModel,
                "{} has lower limits for {} inputs and upper limits for {}; {width} of each are expected",
                Key::Calibration,
                low.len(),
                high.len()
            );
        }
        let ends: Vec<(f32, f32)> = low.into_iter().zip(high).collect();
        if let Some((i, (low, high))) =
            ends.iter().enumerate().find(|(_, (l, h))| !(l.is_finite() && h.is_finite() && l <= h))
        {
            bail!(
                InvalidModel,
                "{}: input {i} has the limits {low} and {high}; they must be finite and ascending",
                Key::Calibration
            );
        }
        Ok(Some(Self { ends: ends.into() }))
    }

    /// The low ends and the high ends.
    pub(super) fn ends(&self) -> (Vec<f32>, Vec<f32>) {
        self.ends.iter().copied().unzip()
    }

    /// Stores the range in a model file and keeps the other entries of its calibration.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidModel`] if the file's calibration is damaged.
    pub(super) fn store(&self, file: &mut ModelFile) -> Result<()> {
        let (low, high) = self.ends();
        super::bounds::store_in_calibration(
            file,
            [("input_low", serde_json::json!(low)), ("input_high", serde_json::json!(high))],
        )
    }

    /// Clamps the inputs of one row.
    pub(super) fn hold(&self, row: &mut [f32]) {
        for (x, &(low, high)) in row.iter_mut().zip(&self.ends) {
            // NaN remains NaN.
            *x = x.clamp(low, high);
        }
    }

    /// Returns the out-of-range score of a row: 0 inside the range; outside, the largest distance of an input
    /// from its range, in units of half the range's width (at least 0.7, a factor of two in logarithms).
    pub(super) fn score(&self, row: &[f32]) -> f32 {
        row.iter().zip(&self.ends).fold(0.0, |worst: f32, (x, (low, high))| {
            let beyond = (low - x).max(x - high) / (0.5 * (high - low)).max(0.7);
            worst.max(if x.is_finite() { beyond } else { f32::INFINITY })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::predict::UpperBound;
    use alloc::vec;
    use entire_core::ErrorKind;
    use entire_core::model::InputGroup;
    use entire_core::nn::{DenseParts, Dtype, PredNetParts, Target};

    fn file() -> ModelFile {
        let layer =
            DenseParts { inputs: 2, outputs: 1, weight: vec![1.0; 2], bias: vec![0.0], dtype: Dtype::F32 };
        let parts =
            PredNetParts { layers: vec![layer], input: None, output: None, target: Target::LogSeconds };
        let mut file = ModelFile::default();
        file.set_prednet(&parts, &[InputGroup { name: "resolution".into(), size: 2 }]).unwrap();
        file
    }

    #[test]
    fn inputs_are_held_within_what_was_seen() {
        let mut range = InputRange::of_rows(&[1.0, 5.0, 3.0, f32::NAN, 2.0, 9.0], 2, 0);
        let held = |range: &InputRange, mut row: [f32; 2]| {
            range.hold(&mut row);
            row
        };
        assert_eq!(held(&range, [0.0, 99.0]), [1.0, 9.0]);
        assert_eq!(held(&range, [2.5, 6.0]), [2.5, 6.0]);
        assert!(held(&range, [f32::NAN, 6.0])[0].is_nan());
        range.extend(&[-4.0, 6.0], 2);
        assert_eq!(held(&range, [-9.0, 99.0]), [-4.0, 9.0]);
        // The second input is free, so it is not clamped. An input that has no finite value in the training
        // rows is not clamped either.
        let free = InputRange::of_rows(&[1.0], 1, 1);
        assert_eq!(held(&free, [7.0, 1e30]), [1.0, 1e30]);
        assert_eq!(held(&InputRange::of_rows(&[f32::NAN, 1.0], 2, 0), [3.0, 3.0]), [3.0, 1.0]);
    }

    #[test]
    fn files_keep_it_beside_the_bound_and_damage_is_told() {
        let range = InputRange::of_rows(&[1.0, 5.0, 3.0], 1, 1);
        let mut stored = file();
        assert_eq!(InputRange::of(&stored.to_model().unwrap(), 2).unwrap(), None);
        UpperBound { log_factor: 0.25 }.store(&mut stored).unwrap();
        range.store(&mut stored).unwrap();
        UpperBound { log_factor: 0.5 }.store(&mut stored).unwrap();
        let model = stored.to_model().unwrap();
        assert_eq!(InputRange::of(&model, 2).unwrap(), Some(range));
        assert_eq!(Stored::of(&model).unwrap().unwrap().log_factor, Some(0.5));
        for bad in [
            r#"{"level":0.95,"input_low":[0.0],"input_high":[1.0]}"#,
            r#"{"level":0.95,"input_low":[0.0,2.0],"input_high":[1.0,1.0]}"#,
            r#"{"level":0.95,"input_low":[0.0,0.0]}"#,
        ] {
            stored.metadata.insert(Key::Calibration.into(), bad.into());
            let error = InputRange::of(&stored.to_model().unwrap(), 2).unwrap_err();
            assert_eq!(error.kind(), ErrorKind::InvalidModel);
            assert!(error.to_string().contains("entire.calibration"), "{error}");
        }
    }
}
