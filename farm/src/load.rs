//! Loading times of volumes. The expected time is the mean of the volume's measured times and of one more
//! value, which an affine function computes from the volume's size. One such function holds for a node's
//! first reading of a volume (cold), another one for later readings (warm).

/// Assumed rates of loading before any measurement, cold and warm, bytes per second.
const ASSUMED_RATES: [f64; 2] = [200e6, 1000e6];

/// The model of loading times.
#[derive(Clone, Debug, PartialEq)]
pub struct Loads {
    bytes: Vec<f64>,
    /// Sum of the measured seconds and number of measurements of each volume, cold and warm.
    seen: Vec<[(f64, u32); 2]>,
    /// Offset in seconds and slope in seconds per byte, cold and warm.
    laws: [(f64, f64); 2],
    fixed: Option<Vec<f64>>,
}

impl Loads {
    /// A model for volumes of these sizes in bytes. `has_model` is false for a renderer that does not report
    /// loading times: it loads within its tasks, so loading takes zero seconds.
    pub(crate) fn new(bytes: Vec<f64>, has_model: bool) -> Self {
        let seen = vec![[(0.0, 0); 2]; bytes.len()];
        let laws = if has_model { ASSUMED_RATES.map(|rate| (0.0, 1.0 / rate)) } else { [(0.0, 0.0); 2] };
        Self { bytes, seen, laws, fixed: None }
    }

    /// Loading times that are known, seconds by volume.
    pub fn known(seconds: Vec<f64>) -> Self {
        Self { fixed: Some(seconds.clone()), ..Self::new(seconds, false) }
    }

    pub(crate) fn observe(&mut self, volume: usize, warm: bool, seconds: f64) {
        if !(seconds.is_finite() && seconds > 0.0) || self.fixed.is_some() {
            return;
        }
        let kind = usize::from(warm);
        let slot = &mut self.seen[volume][kind];
        slot.0 += seconds;
        slot.1 += 1;
        // Weighted least squares on mean times. If all sizes are equal, or a parameter would be negative,
        // only a slope is fitted.
        let (mut n, mut x, mut y, mut xx, mut xy) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for (bytes, seen) in self.bytes.iter().zip(&self.seen) {
            let (sum, count) = (seen[kind].0, f64::from(seen[kind].1));
            n += count;
            x += count * bytes;
            y += sum;
            xx += count * bytes * bytes;
            xy += bytes * sum;
        }
        let spread = n * xx - x * x;
        let slope = if spread > 1e-9 * n * xx { (n * xy - x * y) / spread } else { -1.0 };
        let offset = (y - slope * x) / n;
        self.laws[kind] = if slope >= 0.0 && offset >= 0.0 {
            (offset, slope)
        } else if x > 0.0 {
            (0.0, y / x)
        } else {
            (y / n, 0.0)
        };
    }

    /// Expected seconds to load a volume.
    pub fn seconds(&self, volume: usize, warm: bool) -> f64 {
        if let Some(fixed) = &self.fixed {
            return fixed[volume];
        }
        let kind = usize::from(warm);
        let (offset, slope) = self.laws[kind];
        let law = offset + slope * self.bytes[volume];
        // Mean of the volume's own measurements and of the affine function, which counts as one measurement.
        let (sum, n) = self.seen[volume][kind];
        (sum + law) / f64::from(n + 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cold_and_warm_loads_are_told_apart() {
        let bytes = vec![1e6, 2e6, 5e6, 9e6];
        let mut loads = Loads::new(bytes.clone(), true);
        for (v, size) in bytes.iter().enumerate().take(3) {
            loads.observe(v, false, 0.5 + 2e-7 * size);
            loads.observe(v, true, 1e-8 * size);
        }
        // The fourth volume has never been loaded.
        assert!((loads.seconds(3, false) - (0.5 + 1.8)).abs() < 1e-9);
        assert!((loads.seconds(3, true) - 0.09).abs() < 1e-9);
        assert_eq!(Loads::new(bytes, false).seconds(2, false), 0.0);
    }
}
