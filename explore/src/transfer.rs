//! The transfer function as the user edits it: an opacity curve and a color map.

use crate::histogram::Histogram;
use anyhow::Result;
use entire_core::GaussianLobe;
use entire_core::scene::{COLOR_RAMP, ControlPoint, TABLE_LEN, TransferFunction, TransferTable};
use entire_io::path::Transfer;

/// A point of the opacity curve: normalized scalar and opacity of one reference step.
pub(crate) type OpacityPoint = [f32; 2];

/// A point of the color map: normalized scalar; red, green, blue.
pub(crate) type ColorPoint = (f32, [f32; 3]);

/// Opacity as a function of the normalized scalar.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Opacity {
    /// Piecewise linear through points, ascending.
    Points(Vec<OpacityPoint>),
    /// The sum of Gaussian lobes.
    Lobes(Vec<GaussianLobe>),
}

impl Default for Opacity {
    fn default() -> Self {
        Self::Points(Vec::new())
    }
}

/// An opacity curve and a color map.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Curve {
    pub(crate) opacity: Opacity,
    pub(crate) colors: Vec<ColorPoint>,
}

/// Color maps by name: piecewise linear between the points.
pub(crate) const COLOR_MAPS: [(&str, &[ColorPoint]); 5] = [
    ("entire", &COLOR_RAMP),
    ("gray", &[(0.0, [0.0; 3]), (1.0, [1.0; 3])]),
    (
        "heat",
        &[
            (0.0, [0.0, 0.0, 0.0]),
            (0.35, [0.75, 0.05, 0.0]),
            (0.7, [1.0, 0.65, 0.0]),
            (1.0, [1.0, 1.0, 0.85]),
        ],
    ),
    ("cool to warm", &[(0.0, [0.23, 0.30, 0.75]), (0.5, [0.87, 0.87, 0.87]), (1.0, [0.71, 0.02, 0.15])]),
    (
        "bone and flesh",
        &[
            (0.0, [0.30, 0.10, 0.08]),
            (0.3, [0.80, 0.42, 0.32]),
            (0.6, [0.94, 0.85, 0.70]),
            (1.0, [1.0, 1.0, 0.97]),
        ],
    ),
];

/// Names of opacity presets, which adapt to a volume's values.
pub(crate) const PRESETS: [&str; 6] = ["ramp", "shell", "haze", "core", "layers", "solid"];

impl Curve {
    /// Returns a preset for a volume's values; `None` for a name that is not in [`PRESETS`].
    pub(crate) fn preset(name: &str, histogram: &Histogram) -> Option<Self> {
        let q = |share| histogram.quantile(share);
        let lobe = |center: f32, width: f32, height| GaussianLobe { center, width: width * width, height };
        let opacity = match name {
            "ramp" => Opacity::Points(vec![[0.0, 0.0], [q(0.1).min(0.9), 0.0], [1.0, 0.25]]),
            "shell" => Opacity::Lobes(vec![lobe(q(0.6), 0.03, 0.35)]),
            "haze" => Opacity::Lobes(vec![lobe(q(0.4), 0.2, 0.02)]),
            "core" => Opacity::Lobes(vec![lobe(q(0.98), 0.08, 0.6)]),
            "layers" => Opacity::Lobes(vec![
                lobe(q(0.3), 0.02, 0.03),
                lobe(q(0.75), 0.025, 0.12),
                lobe(q(0.97), 0.05, 0.7),
            ]),
            "solid" => Opacity::Points(vec![[0.0, 0.0], [q(0.5), 0.0], [q(0.5), 0.9], [1.0, 0.9]]),
            _ => return None,
        };
        Some(Self { opacity, colors: COLOR_RAMP.to_vec() })
    }

    /// The opacity at a normalized scalar.
    pub(crate) fn opacity_at(&self, s: f32) -> f32 {
        match &self.opacity {
            Opacity::Lobes(lobes) => lobes
                .iter()
                .map(|l| l.height * (-(s - l.center) * (s - l.center) / l.width).exp())
                .sum::<f32>()
                .clamp(0.0, 1.0),
            Opacity::Points(points) => {
                neighbors(points, |p| p[0], s).map_or(0.0, |(a, b, t)| a[1] + t * (b[1] - a[1]))
            }
        }
    }

    /// The color at a normalized scalar.
    pub(crate) fn color_at(&self, s: f32) -> [f32; 3] {
        neighbors(&self.colors, |c| c.0, s)
            .map_or([1.0; 3], |(a, b, t)| [0, 1, 2].map(|i| a.1[i] + t * (b.1[i] - a.1[i])))
    }

    /// True if the color map is the color ramp of the core, which Gaussian transfer functions use.
    fn has_ramp(&self) -> bool {
        self.colors == COLOR_RAMP
    }

    /// The lobes, if opacity consists of lobes.
    pub(crate) fn lobes(&self) -> Option<&[GaussianLobe]> {
        match &self.opacity {
            Opacity::Lobes(lobes) => Some(lobes),
            Opacity::Points(_) => None,
        }
    }

    /// Returns the transfer table for renderer and session.
    pub(crate) fn table(&self) -> Result<TransferTable> {
        let opacity = match &self.opacity {
            Opacity::Lobes(lobes) => TransferFunction::Gaussian(lobes.clone()),
            Opacity::Points(points) => TransferFunction::Points(
                points
                    .iter()
                    .map(|p| ControlPoint { position: p[0], color: [0.0; 3], opacity: p[1] })
                    .collect(),
            ),
        };
        let opacity = opacity.to_table()?;
        if self.has_ramp() && self.lobes().is_some() {
            return Ok(opacity);
        }
        let colors = self.colors.iter();
        let colors = TransferFunction::Points(
            colors.map(|c| ControlPoint { position: c.0, color: c.1, opacity: 0.0 }).collect(),
        )
        .to_table()?;
        let mut rgba = *colors.rgba();
        for (entry, found) in rgba.iter_mut().zip(opacity.rgba()) {
            entry[3] = found[3];
        }
        Ok(TransferTable::new(rgba)?)
    }

    /// Returns the transfer function for recordings. If opacity consists of lobes and the colors are those of
    /// the core's color ramp, the function returns the lobes; else it returns a point for each entry of the
    /// table.
    pub(crate) fn recorded(&self) -> Result<Transfer> {
        if let (Some(lobes), true) = (self.lobes(), self.has_ramp()) {
            return Ok(Transfer::Lobes(lobes.to_vec()));
        }
        let table = self.table()?;
        let points = table.rgba().iter().enumerate().map(|(i, e)| ControlPoint {
            position: i as f32 / (TABLE_LEN - 1) as f32,
            color: [e[0], e[1], e[2]],
            opacity: e[3],
        });
        Ok(Transfer::Points(points.collect()))
    }

    /// Returns the curve as points, so that it can be edited point by point. Lobes are approximated.
    pub(crate) fn to_points(&self) -> Self {
        let Opacity::Lobes(lobes) = &self.opacity else { return self.clone() };
        let mut at = vec![0.0, 1.0];
        for lobe in lobes {
            let width = lobe.width.sqrt();
            at.extend([-2.2, -1.2, -0.6, 0.0, 0.6, 1.2, 2.2].map(|k| lobe.center + k * width));
        }
        at.retain(|s| (0.0..=1.0).contains(s));
        at.sort_by(f32::total_cmp);
        at.dedup_by(|a, b| (*a - *b).abs() < 1e-3);
        let points = at.into_iter().map(|s| [s, self.opacity_at(s)]).collect();
        Self { opacity: Opacity::Points(points), colors: self.colors.clone() }
    }
}

/// Returns the points before and after a scalar, and the share of the way from the first to the second; twice
/// the same point beyond the ends. `at` is the scalar of a point.
fn neighbors<P>(points: &[P], at: impl Fn(&P) -> f32, s: f32) -> Option<(&P, &P, f32)> {
    let next = points.partition_point(|p| at(p) <= s);
    match (next.checked_sub(1).and_then(|i| points.get(i)), points.get(next)) {
        (Some(a), Some(b)) if at(b) > at(a) => Some((a, b, (s - at(a)) / (at(b) - at(a)))),
        (Some(p), _) | (None, Some(p)) => Some((p, p, 0.0)),
        (None, None) => None,
    }
}

/// A curve with its undo history.
#[derive(Clone, Debug, Default)]
pub(crate) struct Edited {
    past: Vec<Curve>,
    future: Vec<Curve>,
    /// The curve before the current edit.
    settled: Curve,
    pub(crate) curve: Curve,
}

/// Maximum number of undo steps.
const UNDO_STEPS: usize = 200;

impl Edited {
    pub(crate) fn new(curve: Curve) -> Self {
        Self { settled: curve.clone(), curve, ..Self::default() }
    }

    /// Ends an edit (a drag, a typed value), which becomes one undo step.
    pub(crate) fn settle(&mut self) {
        if self.settled != self.curve {
            self.past.push(std::mem::replace(&mut self.settled, self.curve.clone()));
            self.future.clear();
            if self.past.len() > UNDO_STEPS {
                self.past.remove(0);
            }
        }
    }

    /// Replaces the curve, as one undo step.
    pub(crate) fn replace(&mut self, curve: Curve) {
        self.settle();
        self.curve = curve;
        self.settle();
    }

    pub(crate) fn undo(&mut self) -> bool {
        self.settle();
        let Some(before) = self.past.pop() else { return false };
        self.future.push(std::mem::replace(&mut self.curve, before));
        self.settled = self.curve.clone();
        true
    }

    pub(crate) fn redo(&mut self) -> bool {
        self.settle();
        let Some(after) = self.future.pop() else { return false };
        self.past.push(std::mem::replace(&mut self.curve, after));
        self.settled = self.curve.clone();
        true
    }

    pub(crate) fn can_undo(&self) -> bool {
        !self.past.is_empty() || self.settled != self.curve
    }

    pub(crate) fn can_redo(&self) -> bool {
        !self.future.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn histogram() -> Histogram {
        Histogram { counts: (0..256).map(|i| 1000 / (i + 1) + 1).collect() }
    }

    #[test]
    fn presets_make_tables_that_are_what_the_editor_draws() {
        for name in PRESETS {
            for (_, colors) in COLOR_MAPS {
                let mut curve = Curve::preset(name, &histogram()).unwrap();
                curve.colors = colors.to_vec();
                let table = curve.table().unwrap();
                for (i, entry) in table.rgba().iter().enumerate() {
                    let s = i as f32 / 255.0;
                    assert!((entry[3] - curve.opacity_at(s)).abs() < 1e-5, "{name} at {s}");
                    let color = curve.color_at(s);
                    assert!((0..3).all(|c| (entry[c] - color[c]).abs() < 1e-5), "{name} at {s}");
                }
                let again = curve.recorded().unwrap().function().to_table().unwrap();
                for (a, b) in table.rgba().iter().zip(again.rgba()) {
                    assert!((0..4).all(|c| (a[c] - b[c]).abs() < 1e-5), "{name}: {a:?} {b:?}");
                }
            }
        }
        assert!(Curve::preset("nothing", &histogram()).is_none());
    }

    #[test]
    fn lobes_become_points_close_to_them() {
        let curve = Curve::preset("layers", &histogram()).unwrap();
        let points = curve.to_points();
        for i in 0..=100 {
            let s = i as f32 / 100.0;
            assert!((curve.opacity_at(s) - points.opacity_at(s)).abs() < 0.1, "{s}");
        }
    }

    #[test]
    fn undo_goes_back_edit_by_edit_and_forth_again() {
        let curve = |opacity| Curve { opacity: Opacity::Points(vec![[0.0, opacity]]), colors: vec![] };
        let mut edited = Edited::new(curve(0.1));
        // A drag is one edit, with any number of intermediate values.
        for i in 2..=5 {
            edited.curve = curve(0.1 * i as f32);
        }
        edited.settle();
        edited.replace(curve(0.9));
        assert!(edited.undo() && edited.curve == curve(0.5));
        assert!(edited.undo() && edited.curve == curve(0.1) && !edited.undo());
        assert!(edited.redo() && edited.curve == curve(0.5));
        edited.replace(curve(0.2));
        assert!(!edited.can_redo() && !edited.redo(), "a new edit removes the undone edits");
        assert!(edited.undo() && edited.curve == curve(0.5));
    }
}
