//! Axes: their scales, ranges and ticks.

use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint, Ranged};
use std::ops::Range;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scale {
    Linear,
    /// Logarithmic; values that are not positive are left out.
    Log,
    /// One slot per name, with a tick. The value is the slot's index: slot i reaches from i − ½ to i + ½.
    Slots,
}

/// An axis: its label with unit, its scale and, if it is not fitted to the data, its range.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    pub(super) label: String,
    pub(super) scale: Scale,
    /// The names of the slots, which replace the scale; `None` without slots.
    pub(super) names: Option<Vec<String>>,
    pub(super) low: Option<f64>,
    pub(super) high: Option<f64>,
}

impl Axis {
    /// A linear axis fitted to the data. The label names the unit.
    pub fn linear(label: impl Into<String>) -> Self {
        Self { label: label.into(), scale: Scale::Linear, names: None, low: None, high: None }
    }

    /// A logarithmic axis fitted to the data. The label names the unit.
    pub fn log(label: impl Into<String>) -> Self {
        Self { scale: Scale::Log, ..Self::linear(label) }
    }

    /// An axis of named slots.
    pub fn categories(label: impl Into<String>, names: Vec<String>) -> Self {
        Self { names: Some(names), ..Self::linear(label) }
    }

    /// Fixes the lower end.
    pub fn from(mut self, low: f64) -> Self {
        self.low = Some(low);
        self
    }

    /// Fixes the upper end; marks beyond it are cut off at the frame of the plot.
    pub fn to(mut self, high: f64) -> Self {
        self.high = Some(high);
        self
    }
}

/// Largest distance of a position from the lower end, in axis lengths; positions beyond it are clamped.
const MAX_DISTANCE: f64 = 1e9;

/// Largest magnitude of a drawn value; larger ones are clamped, so that ranges stay finite.
const MAX_MAGNITUDE: f64 = 1e300;

/// The range that an axis shows. It implements the drawing library's trait of one coordinate.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Span {
    pub(super) low: f64,
    pub(super) high: f64,
    pub(super) scale: Scale,
}

impl Span {
    /// Fits the range to the values, with some margin; fixed ends of the axis are kept.
    pub(super) fn fit(axis: &Axis, values: impl Iterator<Item = f64>) -> Self {
        if let Some(names) = &axis.names {
            return Self { low: -0.5, high: names.len().max(1) as f64 - 0.5, scale: Scale::Slots };
        }
        let log = axis.scale == Scale::Log;
        let mut low = f64::INFINITY;
        let mut high = f64::NEG_INFINITY;
        for v in values.filter(|v| v.is_finite() && (!log || *v > 0.0)) {
            let v = v.clamp(-MAX_MAGNITUDE, MAX_MAGNITUDE);
            low = low.min(v);
            high = high.max(v);
        }
        if low > high {
            (low, high) = if log { (0.1, 1.0) } else { (0.0, 1.0) };
        }
        if log {
            if low == high {
                (low, high) = (low / 2.0, high * 2.0);
            }
            let air = (high / low).powf(0.04).min(10.0);
            let low = axis.low.filter(|v| *v > 0.0).unwrap_or(low / air).max(1.0 / MAX_MAGNITUDE);
            let high = axis.high.filter(|v| *v > low).unwrap_or((high * air).max(low * 1.01));
            Self { low, high, scale: Scale::Log }
        } else {
            let air = if high > low { (high - low) * 0.04 } else { low.abs().max(1.0) * 0.1 };
            let low = axis.low.unwrap_or(low - air).clamp(-MAX_MAGNITUDE, MAX_MAGNITUDE);
            let high =
                axis.high.filter(|v| *v > low).unwrap_or((high + air).max(low + air.max(low.abs() * 1e-6)));
            Self { low, high, scale: Scale::Linear }
        }
    }

    /// True if the scale can place the value on the axis or beyond its ends.
    pub(super) fn takes(&self, value: f64) -> bool {
        value.is_finite() && (self.scale != Scale::Log || value > 0.0)
    }

    /// True if the value lies between the ends.
    pub(super) fn shows(&self, value: f64) -> bool {
        (self.low..=self.high).contains(&value)
    }

    /// Returns the position of a value on the axis: 0 at the lower end, 1 at the upper end.
    pub(super) fn place(&self, value: f64) -> f64 {
        let place = if self.scale == Scale::Log {
            (value.log10() - self.low.log10()) / (self.high.log10() - self.low.log10())
        } else {
            (value - self.low) / (self.high - self.low)
        };
        if place.is_nan() { 0.0 } else { place.clamp(-MAX_DISTANCE, MAX_DISTANCE) }
    }

    /// Returns the value at a position: the inverse of [`Span::place`].
    pub(super) fn value(&self, place: f64) -> f64 {
        if self.scale == Scale::Log {
            let (low, high) = (self.low.log10(), self.high.log10());
            10f64.powf(low + place * (high - low))
        } else {
            self.low + place * (self.high - self.low)
        }
    }

    /// Returns the values of the ticks: about `most` round values between the ends, or fewer; on an axis of
    /// slots, the index of every slot.
    pub(super) fn ticks(&self, most: usize) -> Vec<f64> {
        match self.scale {
            Scale::Slots => (0..self.high.ceil() as usize).map(|slot| slot as f64).collect(),
            Scale::Log => self.log_ticks(most.max(2)),
            Scale::Linear => self.linear_ticks(most.max(2)),
        }
    }

    /// Returns powers of ten and, if there is space, round values between them, which the drawing library
    /// lacks. On an axis with fewer than two such values, returns linear ticks.
    fn log_ticks(&self, most: usize) -> Vec<f64> {
        let (first, last) = (self.low.log10().floor() as i32, self.high.log10().ceil() as i32);
        let stride = ((last - first) as usize).div_ceil(most).max(1) as i32;
        let with = |factors: &[f64]| -> Vec<f64> {
            (first..=last)
                .filter(|e| e.rem_euclid(stride) == 0)
                .flat_map(|e| factors.iter().map(move |f| f * 10f64.powi(e)).collect::<Vec<_>>())
                .filter(|v| *v >= self.low * 0.9999 && *v <= self.high * 1.0001)
                .collect()
        };
        // If decades are skipped, multiples within the labeled decades would look like neighboring decades.
        if stride == 1 {
            for factors in [&[1.0, 2.0, 3.0, 5.0, 7.0][..], &[1.0, 2.0, 5.0], &[1.0, 3.0]] {
                let ticks = with(factors);
                if ticks.len() >= 2 && ticks.len() <= most + 2 {
                    return ticks;
                }
            }
        }
        let decades = with(&[1.0]);
        if decades.len() >= 2 {
            return decades;
        }
        self.linear_ticks(most)
    }

    /// Returns the multiples of a step, which is 1, 2, 2.5 or 5 times a power of ten. The drawing library's
    /// own search for ticks does not end for some ranges.
    fn linear_ticks(&self, most: usize) -> Vec<f64> {
        let raw = (self.high - self.low) / most as f64;
        let magnitude = 10f64.powf(raw.log10().floor());
        let steps = [1.0, 2.0, 2.5, 5.0, 10.0].map(|m| m * magnitude);
        let step = steps.into_iter().find(|s| *s >= raw * 0.999).unwrap_or(steps[4]);
        let first = (self.low / step - 1e-9).ceil();
        let mut ticks: Vec<f64> = (0..=most + 2)
            .map(|i| (first + i as f64) * step)
            .take_while(|v| *v <= self.high + step * 1e-9)
            .collect();
        ticks.dedup();
        ticks
    }

    /// Returns the label of a tick. The labels of neighboring ticks differ from it.
    pub(super) fn label(&self, value: f64, ticks: &[f64]) -> String {
        let step = match (self.scale, ticks) {
            // The ticks of a narrow logarithmic axis are equally spaced, and their spacing may be smaller
            // than the largest power of ten up to the value.
            (Scale::Log, _) => ticks
                .iter()
                .map(|tick| (tick - value).abs())
                .filter(|gap| *gap > 0.0)
                .fold(10f64.powf(value.abs().log10().floor()), f64::min),
            (_, [first, second, ..]) => second - first,
            _ => 1.0,
        };
        tick_label(value, step)
    }
}

impl Ranged for Span {
    type FormatOption = DefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, (start, end): (i32, i32)) -> i32 {
        start + (f64::from(end - start) * self.place(*value).clamp(0.0, 1.0)).round() as i32
    }

    fn key_points<Hint: KeyPointHint>(&self, hint: Hint) -> Vec<f64> {
        match hint.bold_points() {
            0 => Vec::new(),
            most => self.ticks(most),
        }
    }

    fn range(&self) -> Range<f64> {
        self.low..self.high
    }
}

/// Returns the label of a tick, with as few digits as distinguish it from neighbors at distance `step`.
/// Magnitudes below 1e-4 and from 1e6 are written with exponents.
fn tick_label(value: f64, step: f64) -> String {
    if value.abs() < step.abs() * 1e-6 {
        return "0".into();
    }
    if !(1e-4..1e6).contains(&value.abs()) {
        return format!("{value:.1e}").replace(".0e", "e");
    }
    let digits = if step >= 1.0 { 0 } else { (-step.log10()).ceil().clamp(0.0, 6.0) as usize };
    let text = format!("{value:.digits$}");
    let differs = |text: &str| (text.parse().unwrap_or(value) - value).abs() > step * 1e-6;
    let coarse = format!("{value:.*}", digits.saturating_sub(1));
    if step < 1.0 && !differs(&coarse) {
        coarse
    } else if differs(&text) {
        format!("{value:.*}", digits + 1)
    } else {
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_few_and_inside() {
        for (low, high) in [(0.0, 119.0), (-3.0, 7.0), (0.00012, 0.00019), (1e5, 9e7)] {
            let ticks = Span { low, high, scale: Scale::Linear }.ticks(8);
            assert!((2..=10).contains(&ticks.len()), "{low} {high} {ticks:?}");
            assert!(ticks.iter().all(|t| *t >= low - 1e-12 && *t <= high * (1.0 + 1e-9)), "{ticks:?}");
        }
        for (low, high) in [(0.9, 1100.0), (11.0, 48.0), (0.7, 0.74), (1e-9, 1e12), (2.1, 2.2)] {
            let ticks = Span { low, high, scale: Scale::Log }.ticks(6);
            assert!((2..=9).contains(&ticks.len()), "{low} {high} {ticks:?}");
            assert!(ticks.iter().all(|t| (low * 0.999..=high * 1.001).contains(t)), "{ticks:?}");
        }
        assert_eq!(Span { low: -0.5, high: 2.5, scale: Scale::Slots }.ticks(9), [0.0, 1.0, 2.0]);
    }

    #[test]
    fn labels_have_the_digits_that_tell_ticks_apart() {
        assert_eq!(tick_label(0.25, 0.25), "0.25");
        assert_eq!(tick_label(2.5, 2.5), "2.5");
        assert_eq!(tick_label(20.0, 20.0), "20");
        assert_eq!(tick_label(0.02, 0.01), "0.02");
        assert_eq!(tick_label(1e-7, 1e-7), "1e-7");
        assert_eq!(tick_label(3e-17, 0.2), "0");
    }

    #[test]
    fn labels_of_a_logarithmic_axis_are_the_ticks() {
        for (low, high, most) in [(32.5, 32.95, 8), (32.9, 35.1, 10), (0.03, 300.0, 10), (1e-3, 2e5, 4)] {
            let span = Span { low, high, scale: Scale::Log };
            let ticks = span.ticks(most);
            for tick in &ticks {
                let text = span.label(*tick, &ticks);
                assert!((text.parse::<f64>().unwrap() / tick - 1.0).abs() < 1e-9, "{tick}: {text}");
            }
        }
    }

    #[test]
    fn ticks_of_many_decades_lie_evenly() {
        for (low, high) in [(2e-10, 3e-3), (1e-4, 0.9), (1e-9, 5e8)] {
            let ticks = Span::fit(&Axis::log("x"), [low, high].into_iter()).ticks(4);
            let steps: Vec<f64> = ticks.windows(2).map(|t| (t[1] / t[0]).log10()).collect();
            assert!(!steps.is_empty() && steps.iter().all(|s| (s - steps[0]).abs() < 0.2), "{ticks:?}");
        }
    }

    #[test]
    fn every_finite_span_has_few_ticks_and_places_that_fit_a_coordinate() {
        let values = [-1e300, -7.0, 0.0, 1e-300, 1e-12, 1.0, 1.0 + 1e-15, 3.0, 1e9, 1e300, f64::MAX];
        for a in values {
            for b in values {
                for axis in [Axis::linear("x"), Axis::log("x"), Axis::linear("x").from(a).to(b)] {
                    let span = Span::fit(&axis, [a, b].into_iter());
                    assert!(span.low < span.high && span.high.is_finite(), "{span:?}");
                    assert!(span.ticks(8).len() <= 12, "{span:?} {:?}", span.ticks(8));
                    for v in values.into_iter().filter(|v| span.takes(*v)) {
                        let at = span.map(&v, (0, 9000));
                        assert!((0..=9000).contains(&at), "{span:?} {v} {at}");
                    }
                }
            }
        }
    }
}
