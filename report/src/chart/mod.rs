//! Charts: lines, steps, points, bands, intervals, box plots; linear, logarithmic, categorical axes; as SVG.
//!
//! `plotters` draws; `templates/chart.svg` assembles the layers.

mod axis;
mod clip;
mod draw;
mod labels;
mod palette;

pub use axis::Axis;

use axis::Span;
use palette::PALETTE;

/// Mark that a series draws.
#[derive(Clone, Debug, PartialEq)]
pub enum Mark {
    /// A line through (x, y); a value that is not finite breaks it.
    Line(Vec<(f64, f64)>),
    /// As [`Mark::Line`], but each y is kept until the next x.
    Steps(Vec<(f64, f64)>),
    /// Dots, each with a text (may be empty).
    Points(Vec<(f64, f64, String)>),
    /// The area between two curves: (x, lower, upper).
    Band(Vec<(f64, f64, f64)>),
    /// Intervals along x as horizontal bars, half a unit of y high: (from, to, y).
    Stretches(Vec<(f64, f64, f64)>),
    /// Box plots at x: 5th, 25th, 50th, 75th, 95th percentile; those of several series are side by side.
    Boxes(Vec<(f64, [f64; 5])>),
}

/// Data to be drawn, with a name for the legend.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    name: String,
    mark: Mark,
    color: Option<usize>,
    thin: bool,
}

impl Series {
    /// A series in the next color of the palette. An empty name keeps it out of the legend.
    pub fn new(name: impl Into<String>, mark: Mark) -> Self {
        Self { name: name.into(), mark, color: None, thin: false }
    }

    /// Picks a palette color, so that a thing has the same color throughout a report.
    pub fn color(mut self, index: usize) -> Self {
        self.color = Some(index % PALETTE.len());
        self
    }

    /// Draws lines half as wide.
    pub fn thin(mut self) -> Self {
        self.thin = true;
        self
    }

    /// Width of lines, pixels.
    fn line_width(&self) -> f64 {
        if self.thin { 0.9 } else { 1.8 }
    }
}

/// A straight line across the plot.
#[derive(Clone, Debug, PartialEq)]
pub enum Rule {
    /// At a y value, with a text at its right end.
    Horizontal(f64, String),
    /// At an x value, with a text at its top.
    Vertical(f64, String),
    /// y = x, where both axes have the same unit.
    Diagonal(String),
}

/// A chart.
#[derive(Clone, Debug, PartialEq)]
pub struct Chart {
    title: String,
    x: Axis,
    y: Axis,
    series: Vec<Series>,
    rules: Vec<Rule>,
    width: f64,
    height: f64,
}

impl Chart {
    /// An empty chart of the default size, 860 × 320 units; it scales to the page's width.
    pub fn new(title: impl Into<String>, x: Axis, y: Axis) -> Self {
        Self { title: title.into(), x, y, series: Vec::new(), rules: Vec::new(), width: 860.0, height: 320.0 }
    }

    /// Sets the size in user units (pixels at 100 %).
    pub fn size(mut self, width: f64, height: f64) -> Self {
        self.width = width.clamp(240.0, 4000.0);
        self.height = height.clamp(160.0, 4000.0);
        self
    }

    /// Adds a series. Later series are drawn over earlier series.
    pub fn series(mut self, series: Series) -> Self {
        self.series.push(series);
        self
    }

    /// Adds a straight line.
    pub fn rule(mut self, rule: Rule) -> Self {
        self.rules.push(rule);
        self
    }

    /// Returns the SVG element for an HTML page.
    pub(crate) fn to_svg(&self) -> String {
        self.draw(false)
    }

    /// Returns the SVG as a standalone file.
    pub fn to_svg_file(&self) -> String {
        self.draw(true)
    }

    /// Index of a series' color in the palette.
    fn color_of(&self, series: usize) -> usize {
        self.series[series].color.unwrap_or(series % PALETTE.len())
    }

    fn spans(&self) -> (Span, Span) {
        let points: Vec<(f64, f64)> = self.series.iter().flat_map(|series| series.mark.points()).collect();
        let vertical =
            self.rules.iter().filter_map(|r| if let Rule::Vertical(v, _) = r { Some(*v) } else { None });
        let horizontal =
            self.rules.iter().filter_map(|r| if let Rule::Horizontal(v, _) = r { Some(*v) } else { None });
        let x = Span::fit(&self.x, points.iter().map(|p| p.0).chain(vertical));
        let y = Span::fit(&self.y, points.iter().map(|p| p.1).chain(horizontal));
        (x, y)
    }
}

impl Mark {
    fn points(&self) -> Vec<(f64, f64)> {
        match self {
            Self::Line(p) | Self::Steps(p) => p.clone(),
            Self::Points(p) => p.iter().map(|(x, y, _)| (*x, *y)).collect(),
            Self::Band(p) => p.iter().flat_map(|(x, a, b)| [(*x, *a), (*x, *b)]).collect(),
            Self::Stretches(p) => p.iter().flat_map(|(a, b, y)| [(*a, *y), (*b, *y)]).collect(),
            Self::Boxes(p) => p.iter().flat_map(|(x, q)| q.map(|v| (*x, v))).collect(),
        }
    }
}

#[cfg(test)]
mod tests;
