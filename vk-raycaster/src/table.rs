//! The table of a transfer function, in the form that the renderers use.

use entire_core::scene::{TABLE_LEN, TransferTable};

/// The opacity-corrected table of a ray step, in which samples are looked up.
pub(crate) type StepTable = [[f32; 4]; TABLE_LEN];

/// A transfer function in which invisible opacities count as zero.
pub(crate) struct Classifier {
    table: TransferTable,
    /// `visible_before[i]`: number of visible entries among 0…i−1.
    visible_before: [u32; TABLE_LEN + 1],
}

impl Classifier {
    pub(crate) fn new(table: &TransferTable) -> Self {
        let mut visible_before = [0; TABLE_LEN + 1];
        for i in 0..TABLE_LEN {
            visible_before[i + 1] = visible_before[i] + u32::from(table.is_visible(i));
        }
        Self { table: table.clone(), visible_before }
    }

    /// Returns the table for a ray step of `step` reference steps.
    pub(crate) fn step_table(&self, step: f32) -> Box<StepTable> {
        let mut out = self.table.corrected(step);
        for (i, corrected) in out.iter_mut().enumerate() {
            if !self.table.is_visible(i) {
                corrected[3] = 0.0;
            }
        }
        out
    }

    /// True if all samples at table positions `low`…`high` (0…255) are transparent. A margin of 1/1000 entry
    /// on both sides covers values that rounding has pushed over the ends. Interpolation between equal values
    /// does not round, so there is no margin if `low` is `high`.
    pub(crate) fn is_empty(&self, low: f32, high: f32) -> bool {
        let margin = if low == high { 0.0 } else { 1e-3 };
        let first = (low - margin).floor().clamp(0.0, 255.0) as usize;
        let last = (high + margin).ceil().clamp(0.0, 255.0) as usize;
        self.visible_before[last + 1] == self.visible_before[first]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn classifier(visible: impl Fn(usize) -> f32) -> Classifier {
        let mut rgba = [[0.5; 4]; TABLE_LEN];
        for (i, e) in rgba.iter_mut().enumerate() {
            e[3] = visible(i);
        }
        Classifier::new(&TransferTable::new(rgba).unwrap())
    }

    #[test]
    fn intervals_are_empty_only_without_any_neighboring_opacity() {
        let c = classifier(|i| if (100..110).contains(&i) { 0.5 } else { 0.0 });
        assert!(c.is_empty(0.0, 98.9));
        assert!(!c.is_empty(0.0, 99.5), "a sample at 99.5 blends entry 100");
        assert!(!c.is_empty(0.0, 99.0), "within the rounding margin of entry 100");
        assert!(!c.is_empty(105.0, 105.0));
        assert!(c.is_empty(110.5, 255.0));
        assert!(!c.is_empty(0.0, 255.0));
        assert!(classifier(|_| 0.0).is_empty(0.0, 255.0));
        assert!(!classifier(|_| 1.0).is_empty(255.0, 255.0));
    }

    #[test]
    fn faint_opacities_are_zero_at_every_step() {
        let c = classifier(|i| if i == 7 { 1e-5 } else { 0.25 });
        let t = c.step_table(16.0);
        assert_eq!(t[7][3], 0.0);
        assert!((t[8][3] - (1.0 - 0.75f32.powi(16))).abs() < 1e-5);
        assert!(c.is_empty(7.0 + 2e-3, 7.0 - 2e-3));
        assert!(c.is_empty(7.0, 7.0), "every sample between voxels of this value has entry 7");
        assert!(!c.is_empty(7.0, 7.0 + 1e-4) && !c.is_empty(7.0 - 1e-4, 7.0));
    }
}
