//! Transfer functions: Gaussian lobes, piecewise-linear control points, VTK's nodes, or a table. All are
//! converted to a 256-entry RGBA table.

use super::Nodes;
use crate::Result;
use crate::error::bail;
use crate::memory::collected;
use alloc::boxed::Box;
use alloc::vec::Vec;
use serde::{Deserialize, Serialize};

/// Number of entries of a [`TransferTable`].
pub const TABLE_LEN: usize = 256;

/// Opacity per reference step below which a table entry counts as transparent, so that the tails of a
/// Gaussian lobe leave empty space to skip. A ray of 1000 reference steps with opacities just below this
/// threshold would accumulate an opacity of about 0.03.
pub(crate) const OPACITY_FLOOR: f32 = 1.0 / 32768.0;

/// A Gaussian lobe of the opacity function O(s) = Σ h·exp(−(s − c)²/w) of the normalized scalar value s
/// (paper, section "PredNet: Rendering Time Prediction").
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GaussianLobe {
    /// c: position of the peak, in normalized scalar values [0, 1].
    pub center: f32,
    /// w: width, positive; the squared distance from the peak at which the lobe has fallen to 1/e.
    pub width: f32,
    /// h: peak opacity, not negative.
    pub height: f32,
}

/// A point of a piecewise-linear transfer function.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ControlPoint {
    /// Normalized scalar value in [0, 1].
    pub position: f32,
    /// Red, green, blue in [0, 1].
    pub color: [f32; 3],
    /// Opacity in [0, 1] over one unit distance ([`TransferTable::unit_distance`]).
    pub opacity: f32,
}

/// A transfer function as the caller specifies it.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum TransferFunction {
    /// Gaussian opacity lobes; colors follow a ramp from dark blue over green and yellow to near white.
    Gaussian(Vec<GaussianLobe>),
    /// Piecewise-linear control points in ascending position; constant beyond the first and last. Two points
    /// at one position make a step.
    Points(Vec<ControlPoint>),
    /// Opacity and color nodes with midpoint and sharpness, as in VTK and ParaView.
    Nodes(Nodes),
}

/// Colors of Gaussian transfer functions: (position, red, green, blue), interpolated linearly. From dark blue
/// over green and yellow to near white, with rising lightness.
pub const COLOR_RAMP: [(f32, [f32; 3]); 6] = [
    (0.0, [0.09, 0.11, 0.35]),
    (0.2, [0.11, 0.34, 0.60]),
    (0.4, [0.14, 0.58, 0.56]),
    (0.6, [0.53, 0.76, 0.33]),
    (0.8, [0.96, 0.80, 0.31]),
    (1.0, [1.00, 0.97, 0.86]),
];

impl TransferFunction {
    /// Returns the piecewise-linear function through evenly spaced samples (red, green, blue, opacity), the
    /// first at 0 and the last at 1.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for fewer than two samples, or a component outside [0, 1].
    pub fn uniform(samples: &[[f32; 4]]) -> Result<Self> {
        if samples.len() < 2 {
            bail!(InvalidArgument, "a transfer table has {} entries; it needs at least 2", samples.len());
        }
        let last = (samples.len() - 1) as f32;
        let points = samples.iter().enumerate().map(|(i, &[r, g, b, opacity])| ControlPoint {
            position: i as f32 / last,
            color: [r, g, b],
            opacity,
        });
        let points = collected(points)?;
        check_points(&points)?;
        Ok(Self::Points(points))
    }

    /// Checks the description and samples it into a table; entry i is sampled at the normalized scalar value
    /// i/255.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`], naming the lobe or point, the fault and the accepted range.
    pub fn to_table(&self) -> Result<TransferTable> {
        match self {
            Self::Gaussian(lobes) => gaussian_table(lobes),
            Self::Points(points) => points_table(points),
            Self::Nodes(nodes) => nodes.to_table(),
        }
    }
}

/// A 256-entry RGBA table over normalized scalar values. Entry i is the value at s = i/255; opacities hold
/// for one unit distance along the ray. Colors are not premultiplied.
#[derive(Clone, Debug, PartialEq)]
pub struct TransferTable {
    rgba: Box<[[f32; 4]; TABLE_LEN]>,
    unit_distance: f32,
}

impl TransferTable {
    /// A table from its entries, with a unit distance of one reference step.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] when an entry is not finite or lies outside [0, 1].
    pub fn new(rgba: [[f32; 4]; TABLE_LEN]) -> Result<Self> {
        for (i, entry) in rgba.iter().enumerate() {
            if entry.iter().any(|v| !(0.0..=1.0).contains(v)) {
                bail!(
                    InvalidArgument,
                    "transfer table entry {i} is {entry:?}; red, green, blue and opacity must lie in [0, 1]"
                );
            }
        }
        Ok(Self { rgba: Box::new(rgba), unit_distance: 1.0 })
    }

    /// Sets the unit distance, over which the table's opacities hold, in multiples of the reference step.
    /// Callers divide a world distance (VTK's scalar opacity unit distance, ANARI's `unitDistance`) by the
    /// smallest voxel spacing.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] unless finite and positive.
    pub fn with_unit_distance(mut self, reference_steps: f32) -> Result<Self> {
        if !(reference_steps.is_finite() && reference_steps > 0.0) {
            bail!(
                InvalidArgument,
                "unit distance is {reference_steps} reference steps; it must be finite and positive"
            );
        }
        self.unit_distance = reference_steps;
        Ok(self)
    }

    /// The entries.
    pub fn rgba(&self) -> &[[f32; 4]; TABLE_LEN] {
        &self.rgba
    }

    /// Unit distance, over which the opacities hold, in multiples of the reference step.
    pub fn unit_distance(&self) -> f32 {
        self.unit_distance
    }

    /// Returns the table for a ray step of `step` reference steps. The returned table has the same colors. An
    /// opacity α becomes 1 − (1 − α)^ratio, where `ratio` is the ray step divided by the unit distance.
    pub fn corrected(&self, step: f32) -> Box<[[f32; 4]; TABLE_LEN]> {
        let mut out = self.rgba.clone();
        for entry in out.iter_mut() {
            entry[3] = corrected_opacity(entry[3], step / self.unit_distance);
        }
        out
    }

    /// True if entry `index` has an opacity of at least 1/32768 per reference step.
    ///
    /// # Panics
    /// When `index` is not below [`TABLE_LEN`].
    pub fn is_visible(&self, index: usize) -> bool {
        corrected_opacity(self.rgba[index][3], 1.0 / self.unit_distance) >= OPACITY_FLOOR
    }
}

/// Returns the opacity over `ratio` unit distances of a medium with opacity `alpha` per unit distance:
/// 1 − (1 − `alpha`)^`ratio`.
#[inline]
pub(crate) fn corrected_opacity(alpha: f32, ratio: f32) -> f32 {
    // With an infinite ratio, the product below would be NaN for an opacity of 0.
    if alpha <= 0.0 || alpha >= 1.0 {
        return alpha;
    }
    -libm::expm1f(ratio * libm::log1pf(-alpha))
}

pub(super) fn ramp(s: f32) -> [f32; 3] {
    let upper = COLOR_RAMP.iter().position(|&(p, _)| p >= s).unwrap_or(COLOR_RAMP.len() - 1).max(1);
    let ((p0, c0), (p1, c1)) = (COLOR_RAMP[upper - 1], COLOR_RAMP[upper]);
    let t = ((s - p0) / (p1 - p0)).clamp(0.0, 1.0);
    [0, 1, 2].map(|i| c0[i] + t * (c1[i] - c0[i]))
}

fn gaussian_table(lobes: &[GaussianLobe]) -> Result<TransferTable> {
    for (i, &GaussianLobe { center, width, height }) in lobes.iter().enumerate() {
        if !center.is_finite() {
            bail!(InvalidArgument, "Gaussian lobe {i}: center is {center}; it must be finite (usually 0…1)");
        }
        if !(width.is_finite() && width > 0.0) {
            bail!(InvalidArgument, "Gaussian lobe {i}: width is {width}; it must be finite and positive");
        }
        if !(height.is_finite() && height >= 0.0) {
            bail!(
                InvalidArgument,
                "Gaussian lobe {i}: height is {height}; it must be finite and not negative"
            );
        }
    }
    let mut rgba = [[0.0; 4]; TABLE_LEN];
    for (i, entry) in rgba.iter_mut().enumerate() {
        let s = i as f32 / (TABLE_LEN - 1) as f32;
        let opacity: f32 = lobes
            .iter()
            .map(|l| l.height * libm::expf(-(s - l.center) * (s - l.center) / l.width))
            .sum::<f32>()
            .clamp(0.0, 1.0);
        let [r, g, b] = ramp(s);
        *entry = [r, g, b, opacity];
    }
    TransferTable::new(rgba)
}

fn check_points(points: &[ControlPoint]) -> Result<()> {
    if points.is_empty() {
        bail!(InvalidArgument, "a piecewise-linear transfer function needs at least one control point");
    }
    for (i, p) in points.iter().enumerate() {
        if !(0.0..=1.0).contains(&p.position) {
            bail!(
                InvalidArgument,
                "control point {i}: position is {}; it must lie in [0, 1] (map scalars over the volume's range first)",
                p.position
            );
        }
        if i > 0 && p.position < points[i - 1].position {
            bail!(
                InvalidArgument,
                "control point {i} lies before its predecessor; sort the points by position"
            );
        }
        if !(0.0..=1.0).contains(&p.opacity) || p.color.iter().any(|c| !(0.0..=1.0).contains(c)) {
            bail!(InvalidArgument, "control point {i}: color and opacity must lie in [0, 1]");
        }
    }
    Ok(())
}

fn points_table(points: &[ControlPoint]) -> Result<TransferTable> {
    check_points(points)?;
    let mut rgba = [[0.0; 4]; TABLE_LEN];
    for (i, entry) in rgba.iter_mut().enumerate() {
        let s = i as f32 / (TABLE_LEN - 1) as f32;
        let after = points.partition_point(|p| p.position <= s);
        let (a, b) = match after {
            0 => (points[0], points[0]),
            n if n == points.len() => (points[n - 1], points[n - 1]),
            n => (points[n - 1], points[n]),
        };
        let gap = b.position - a.position;
        let t = if gap > 0.0 { (s - a.position) / gap } else { 0.0 };
        let mix = |x: f32, y: f32| (x + t * (y - x)).clamp(0.0, 1.0);
        *entry = [
            mix(a.color[0], b.color[0]),
            mix(a.color[1], b.color[1]),
            mix(a.color[2], b.color[2]),
            mix(a.opacity, b.opacity),
        ];
    }
    TransferTable::new(rgba)
}

#[cfg(test)]
mod tests {
    use super::*;
    use alloc::vec;

    #[test]
    fn gaussian_lobes_follow_the_equation() {
        let lobes = vec![
            GaussianLobe { center: 0.3, width: 0.01, height: 0.5 },
            GaussianLobe { center: 0.8, width: 0.002, height: 0.9 },
        ];
        let table = TransferFunction::Gaussian(lobes.clone()).to_table().unwrap();
        for i in 0..TABLE_LEN {
            let s = i as f64 / 255.0;
            let o: f64 = lobes
                .iter()
                .map(|l| {
                    f64::from(l.height) * (-(s - f64::from(l.center)).powi(2) / f64::from(l.width)).exp()
                })
                .sum();
            assert!((f64::from(table.rgba()[i][3]) - o.min(1.0)).abs() < 1e-5, "{i}");
        }
    }

    #[test]
    fn overlapping_lobes_saturate_at_one_and_none_is_transparent() {
        let lobe = GaussianLobe { center: 0.5, width: 0.1, height: 0.8 };
        for (count, most) in [(3, 1.0), (0, 0.0)] {
            let table = TransferFunction::Gaussian(vec![lobe; count]).to_table().unwrap();
            assert_eq!(table.rgba().iter().map(|e| e[3]).fold(0.0, f32::max), most);
        }
    }

    #[test]
    fn points_interpolate_extend_and_step() {
        let p = |position, opacity| ControlPoint { position, color: [opacity; 3], opacity };
        let t = TransferFunction::Points(vec![p(0.2, 0.1), p(0.6, 0.5), p(0.6, 1.0), p(0.8, 0.0)])
            .to_table()
            .unwrap();
        let at = |s: f32| t.rgba()[(s * 255.0).round() as usize][3];
        assert_eq!((at(0.0), at(0.2), at(1.0)), (0.1, 0.1, 0.0));
        assert!((at(0.4) - 0.3).abs() < 1e-6);
        assert!((at(0.6) - 1.0).abs() < 1e-6 && (at(0.7) - 0.5).abs() < 0.02);
    }

    #[test]
    fn uniform_samples_come_back_and_are_interpolated() {
        let samples: Vec<[f32; 4]> = (0..TABLE_LEN).map(|i| [(i % 7) as f32 / 7.0; 4]).collect();
        let table = TransferFunction::uniform(&samples).unwrap().to_table().unwrap();
        assert_eq!(table.rgba().as_slice(), samples.as_slice());
        let table = TransferFunction::uniform(&[[0.0; 4], [1.0; 4]]).unwrap().to_table().unwrap();
        assert!((table.rgba()[51][3] - 0.2).abs() < 1e-6);
        assert!(TransferFunction::uniform(&[[0.0; 4]]).is_err());
        assert!(TransferFunction::uniform(&[[0.0; 4], [0.0, 0.0, 0.0, 1.5]]).is_err());
    }

    #[test]
    fn opacity_correction_composes() {
        for alpha in [0.0, 0.001, 0.3, 0.99, 1.0] {
            let half = corrected_opacity(alpha, 0.5);
            assert!((1.0 - (1.0 - half) * (1.0 - half) - alpha).abs() < 1e-6);
            assert!((corrected_opacity(alpha, 1.0) - alpha).abs() < 1e-6);
        }
        assert!((corrected_opacity(1e-6, 2.0) - 2e-6).abs() < 1e-11);
        // The ratio of the step to this unit distance is infinite.
        let table = TransferTable::new([[0.0; 4]; TABLE_LEN]).unwrap().with_unit_distance(1e-40).unwrap();
        assert_eq!(table.corrected(1.0).as_slice(), table.rgba().as_slice());
    }

    #[test]
    fn unit_distance_in_world_units_counts_reference_steps() {
        let table = TransferTable::new([[0.5; 4]; TABLE_LEN]).unwrap();
        assert_eq!(table.clone().with_unit_distance(6.0).unwrap().unit_distance(), 6.0);
        assert!(table.clone().with_unit_distance(f32::NAN).is_err());
        assert!(table.with_unit_distance(0.0).is_err());
    }

    #[test]
    fn faint_opacities_count_as_zero_by_the_reference_step() {
        let mut rgba = [[0.0; 4]; TABLE_LEN];
        rgba[3][3] = OPACITY_FLOOR * 1.01;
        rgba[4][3] = OPACITY_FLOOR * 0.99;
        let table = TransferTable::new(rgba).unwrap();
        assert_eq!([2, 3, 4].map(|i| table.is_visible(i)), [false, true, false]);
        let coarse = table.clone().with_unit_distance(2.0).unwrap();
        assert!(!coarse.is_visible(3), "half the floor per reference step");
    }

    #[test]
    fn bad_descriptions_are_refused() {
        let lobe = |center, width, height| {
            TransferFunction::Gaussian(vec![GaussianLobe { center, width, height }]).to_table()
        };
        assert!(lobe(f32::NAN, 0.1, 0.1).is_err());
        assert!(lobe(0.5, 0.0, 0.1).is_err());
        assert!(lobe(0.5, 0.1, -0.1).unwrap_err().to_string().contains("lobe 0: height"));
        assert!(lobe(0.5, 0.1, f32::INFINITY).is_err());
        let point = |position, opacity| ControlPoint { position, color: [0.0; 3], opacity };
        assert!(TransferFunction::Points(vec![]).to_table().is_err());
        assert!(TransferFunction::Points(vec![point(0.5, 0.1), point(0.4, 0.1)]).to_table().is_err());
        assert!(TransferFunction::Points(vec![point(1.5, 0.1)]).to_table().is_err());
        assert!(TransferFunction::Points(vec![point(0.5, f32::NAN)]).to_table().is_err());
    }
}
