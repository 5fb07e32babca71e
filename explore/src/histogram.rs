//! Histogram of a volume's values.

use entire_core::scene::{VolumeView, normalize};

/// Number of bins of the normalized scalars.
pub(crate) const BINS: usize = 256;

/// Number of voxels that the histogram needs. Of a volume with at least twice as many voxels, only every n-th
/// voxel is read.
const HISTOGRAM_VOXELS: u64 = 4_000_000;

/// Counts of normalized values.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Histogram {
    pub(crate) counts: Vec<u64>,
}

impl Histogram {
    /// Returns the histogram of all voxels, or of every n-th voxel if there are at least twice
    /// [`HISTOGRAM_VOXELS`].
    pub(crate) fn of(view: &VolumeView<'_>) -> Self {
        let [nx, ny, _] = view.shape().dims;
        let stride = (view.shape().voxels / HISTOGRAM_VOXELS).max(1);
        // An odd stride has no common factor with row lengths that are powers of two, so all columns are
        // read.
        let stride = if stride.is_multiple_of(2) { stride + 1 } else { stride };
        let mut counts = vec![0; BINS];
        let mut i = 0;
        while i < view.shape().voxels {
            let (x, rest) = (i as usize % nx, i as usize / nx);
            let s = normalize(view.range(), view.value(x, rest % ny, rest / ny));
            counts[((s * (BINS - 1) as f32 + 0.5) as usize).min(BINS - 1)] += 1;
            i += stride;
        }
        Self { counts }
    }

    /// Returns the heights of the bars, 0 to 1, by the logarithm of the counts.
    pub(crate) fn heights(&self) -> Vec<f32> {
        let log = |n: u64| (n as f32 + 1.0).ln();
        let most = self.counts.iter().copied().map(log).fold(f32::MIN_POSITIVE, f32::max);
        self.counts.iter().map(|&n| log(n) / most).collect()
    }

    /// Returns the normalized value at quantile `share` of the voxels. The ten lowest bins are left out as
    /// background if more than 0.5 % of the voxels are in higher bins.
    pub(crate) fn quantile(&self, share: f32) -> f32 {
        let background = BINS / 25;
        let all: u64 = self.counts.iter().sum();
        let above: u64 = self.counts[background..].iter().sum();
        let first = if above > all / 200 { background } else { 0 };
        let wanted = share as f64 * self.counts[first..].iter().sum::<u64>() as f64;
        let mut seen = 0;
        for (i, n) in self.counts.iter().enumerate().skip(first) {
            seen += n;
            if seen as f64 >= wanted {
                return i as f32 / (BINS - 1) as f32;
            }
        }
        1.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_core::scene::Scalars;

    #[test]
    fn every_voxel_is_counted_in_its_bin() {
        let voxels: Vec<u8> = (0..=255).flat_map(|v| [v; 4]).collect();
        let view = VolumeView::new(Scalars::U8(&voxels), [16, 8, 8]).unwrap();
        let h = Histogram::of(&view);
        assert!(h.counts.iter().all(|&n| n == 4));
        assert!((h.quantile(0.5) - 0.52).abs() < 0.01, "{}", h.quantile(0.5));
        assert!(h.heights().iter().all(|&v| v == 1.0));
    }
}
