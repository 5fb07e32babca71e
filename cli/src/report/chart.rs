//! A small SVG chart: lines, steps, points, bands, bars and box plots over linear, logarithmic or categorical axes.

use super::escape;
use std::fmt::Write as _;

/// How values are laid along an axis.
#[derive(Clone, Debug, PartialEq)]
pub enum Scale {
    /// Evenly.
    Linear,
    /// By decades; values that are not positive are left out.
    Log,
    /// One slot per name; the value is the slot's index, slot i reaching from i − ½ to i + ½.
    Categories(Vec<String>),
}

/// An axis: its label with unit, its scale and, where it is not to be fitted to the data, its range.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    label: String,
    scale: Scale,
    low: Option<f64>,
    high: Option<f64>,
}

impl Axis {
    /// A linear axis fitted to the data. The label names the unit.
    pub fn linear(label: impl Into<String>) -> Self {
        Self { label: label.into(), scale: Scale::Linear, low: None, high: None }
    }

    /// A logarithmic axis fitted to the data.
    pub fn log(label: impl Into<String>) -> Self {
        Self { scale: Scale::Log, ..Self::linear(label) }
    }

    /// An axis of named slots.
    pub fn categories(label: impl Into<String>, names: Vec<String>) -> Self {
        Self { scale: Scale::Categories(names), ..Self::linear(label) }
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

/// What a series draws.
#[derive(Clone, Debug, PartialEq)]
pub enum Mark {
    /// A line through (x, y); a value that is not finite breaks it.
    Line(Vec<(f64, f64)>),
    /// As [`Mark::Line`], holding each y until the next x.
    Steps(Vec<(f64, f64)>),
    /// Dots, each with a text beside it (may be empty).
    Points(Vec<(f64, f64, String)>),
    /// The area between two curves: (x, lower, upper).
    Band(Vec<(f64, f64, f64)>),
    /// Bars from the axis' lower end (zero where it is in sight) to y.
    Bars(Vec<(f64, f64)>),
    /// Box plots at x: 5th, 25th, 50th, 75th, 95th percentile.
    Boxes(Vec<(f64, [f64; 5])>),
}

/// One entry of the legend.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    name: String,
    mark: Mark,
    color: Option<usize>,
}

impl Series {
    /// A series in the next colour of the palette. An empty name keeps it out of the legend.
    pub fn new(name: impl Into<String>, mark: Mark) -> Self {
        Self { name: name.into(), mark, color: None }
    }

    /// Picks a palette colour, so that one thing has one colour throughout a report.
    pub fn color(mut self, index: usize) -> Self {
        self.color = Some(index % PALETTE.len());
        self
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

/// Colors that stay apart without red-green vision (Okabe and Ito's set without black, and two of Tol's) for light and dark
/// backgrounds.
pub(super) const PALETTE: [(&str, &str); 11] = [
    ("#0072b2", "#56a8e0"),
    ("#d55e00", "#ff8a3d"),
    ("#009e73", "#2fc9a0"),
    ("#aa3377", "#e388bb"),
    ("#8c6d00", "#e6c229"),
    ("#4b4b4b", "#c9c9c9"),
    ("#56b4e9", "#9bd4f5"),
    ("#7f3f00", "#c98d5a"),
    ("#332288", "#9a8cf0"),
    ("#cc3311", "#ff7a66"),
    ("#111111", "#f2f2f2"),
];
const DASHES: [&str; 11] =
    ["", "7 3", "2 3", "9 3 2 3", "5 2 1 2 1 2", "1 2", "12 4", "4 4", "9 2 1 2", "3 1", ""];
const FONT: f64 = 13.0;

/// Rough width of a text in the chart's font, pixels.
fn text_width(text: &str) -> f64 {
    text.chars().map(|c| if "iljt.,:;|!' ".contains(c) { 0.34 } else { 0.6 }).sum::<f64>() * FONT
}

struct Span {
    low: f64,
    high: f64,
    log: bool,
}

impl Span {
    /// Position in [0, 1]; beyond where the value lies beyond. `None` where it has none.
    fn place(&self, v: f64) -> Option<f64> {
        let place = if self.log {
            if v <= 0.0 {
                return None;
            }
            (v.log10() - self.low.log10()) / (self.high.log10() - self.low.log10())
        } else {
            (v - self.low) / (self.high - self.low)
        };
        place.is_finite().then_some(place)
    }

    fn fit(axis: &Axis, values: impl Iterator<Item = f64>, rules: impl Iterator<Item = f64>) -> Self {
        if let Scale::Categories(names) = &axis.scale {
            return Self { low: -0.5, high: names.len().max(1) as f64 - 0.5, log: false };
        }
        let log = axis.scale == Scale::Log;
        let mut low = f64::INFINITY;
        let mut high = f64::NEG_INFINITY;
        for v in values.chain(rules).filter(|v| v.is_finite() && (!log || *v > 0.0)) {
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
            let air = (high / low).powf(0.04);
            let low = axis.low.filter(|v| *v > 0.0).unwrap_or(low / air);
            let high = axis.high.filter(|v| *v > low).unwrap_or((high * air).max(low * 1.01));
            Self { low, high, log }
        } else {
            let air = if high > low { (high - low) * 0.04 } else { low.abs().max(1.0) * 0.1 };
            let low = axis.low.unwrap_or(low - air);
            let high = axis.high.filter(|v| *v > low).unwrap_or((high + air).max(low + air));
            Self { low, high, log }
        }
    }

    fn ticks(&self, room: usize) -> Vec<f64> {
        let room = room.max(2) as f64;
        if self.log {
            let (first, last) = (self.low.log10().floor() as i32, self.high.log10().ceil() as i32);
            let decades = f64::from(last - first);
            let stride = ((decades / room).ceil() as i32).max(1);
            let inside = |v: &f64| *v >= self.low * 0.9999 && *v <= self.high * 1.0001;
            let with = |factors: &[f64]| -> Vec<f64> {
                (first..=last)
                    .filter(|e| e.rem_euclid(stride) == 0)
                    .flat_map(|e| factors.iter().map(move |f| f * 10f64.powi(e)).collect::<Vec<_>>())
                    .filter(inside)
                    .collect()
            };
            // As many per decade as there is room for.
            for factors in [&[1.0, 2.0, 3.0, 5.0, 7.0][..], &[1.0, 2.0, 5.0], &[1.0, 3.0], &[1.0]] {
                let ticks = with(factors);
                if ticks.len() >= 2 && (ticks.len() as f64 <= room + 2.0 || factors.len() == 1) {
                    return ticks;
                }
            }
        }
        let raw = (self.high - self.low) / room;
        let magnitude = 10f64.powf(raw.log10().floor());
        let step = [1.0, 2.0, 2.5, 5.0, 10.0]
            .map(|m| m * magnitude)
            .into_iter()
            .find(|s| *s >= raw * 0.999)
            .unwrap_or(magnitude * 10.0);
        let first = (self.low / step - 1e-9).ceil();
        (0..200)
            .map(|i| (first + f64::from(i)) * step)
            .take_while(|v| *v <= self.high + step * 1e-9)
            .collect()
    }
}

/// A tick's text: as few digits as tell it from its neighbours, thousands and more kept short.
fn tick_label(value: f64, step: f64) -> String {
    if value == 0.0 {
        return "0".into();
    }
    let size = value.abs();
    if !(1e-4..1e6).contains(&size) {
        let text = format!("{value:.1e}");
        return text.replace(".0e", "e");
    }
    let digits = if step >= 1.0 { 0 } else { (-step.log10()).ceil().min(6.0) as usize };
    let mut text = format!("{value:.digits$}");
    let coarse = format!("{value:.*}", digits.saturating_sub(1));
    if step < 1.0 && coarse.parse::<f64>().is_ok_and(|v| (v - value).abs() < step * 1e-6) {
        text = coarse;
    } else if (text.parse::<f64>().unwrap_or(value) - value).abs() > step * 1e-6 {
        text = format!("{value:.*}", digits + 1);
    }
    text
}

fn tick_step(ticks: &[f64], i: usize, log: bool) -> f64 {
    if log {
        return 10f64.powf(ticks[i].abs().log10().floor());
    }
    if ticks.len() > 1 { ticks[1] - ticks[0] } else { 1.0 }
}

impl Chart {
    /// An empty chart of the default size, 860 × 320 units; it scales to the page's width.
    pub fn new(title: impl Into<String>, x: Axis, y: Axis) -> Self {
        Self { title: title.into(), x, y, series: Vec::new(), rules: Vec::new(), width: 860.0, height: 320.0 }
    }

    /// Sets the size in user units (pixels at 100 %).
    pub fn size(mut self, width: f64, height: f64) -> Self {
        self.width = width.max(240.0);
        self.height = height.max(160.0);
        self
    }

    /// Adds a series; later ones are drawn over earlier ones.
    pub fn series(mut self, series: Series) -> Self {
        self.series.push(series);
        self
    }

    /// Adds a straight line.
    pub fn rule(mut self, rule: Rule) -> Self {
        self.rules.push(rule);
        self
    }

    /// The SVG element for an HTML page.
    pub fn to_svg(&self) -> String {
        self.draw("")
    }

    /// The SVG as a file of its own.
    pub fn to_svg_file(&self) -> String {
        self.draw(" xmlns=\"http://www.w3.org/2000/svg\"")
    }

    fn points(&self) -> impl Iterator<Item = (f64, f64)> {
        self.series.iter().flat_map(|s| match &s.mark {
            Mark::Line(p) | Mark::Steps(p) | Mark::Bars(p) => p.clone(),
            Mark::Points(p) => p.iter().map(|(x, y, _)| (*x, *y)).collect(),
            Mark::Band(p) => p.iter().flat_map(|(x, a, b)| [(*x, *a), (*x, *b)]).collect(),
            Mark::Boxes(p) => p.iter().flat_map(|(x, q)| q.map(|v| (*x, v))).collect(),
        })
    }

    fn draw(&self, namespace: &str) -> String {
        let zero = self.series.iter().any(|s| matches!(s.mark, Mark::Bars(_)));
        let rule_x = self.rules.iter().filter_map(|r| match r {
            Rule::Vertical(v, _) => Some(*v),
            _ => None,
        });
        let rule_y = self.rules.iter().filter_map(|r| match r {
            Rule::Horizontal(v, _) => Some(*v),
            _ => None,
        });
        let x = Span::fit(&self.x, self.points().map(|p| p.0), rule_x);
        let mut y_axis = self.y.clone();
        if zero && y_axis.low.is_none() && y_axis.scale == Scale::Linear && self.points().all(|p| p.1 >= 0.0)
        {
            y_axis.low = Some(0.0);
        }
        let y = Span::fit(&y_axis, self.points().map(|p| p.1), rule_y);

        // Legend: rows of swatch and name between title and plot.
        let named: Vec<usize> = (0..self.series.len()).filter(|i| !self.series[*i].name.is_empty()).collect();
        let left_edge = 12.0;
        let mut places = Vec::new();
        let (mut lx, mut row) = (left_edge, 0);
        for i in &named {
            let wide = 34.0 + text_width(&self.series[*i].name) + 18.0;
            if lx + wide > self.width - 8.0 && lx > left_edge {
                (lx, row) = (left_edge, row + 1);
            }
            places.push((*i, lx, row));
            lx += wide;
        }
        let title_height = if self.title.is_empty() { 6.0 } else { 26.0 };
        let legend_height = if named.is_empty() { 0.0 } else { f64::from(row + 1) * 20.0 + 4.0 };
        let labelled = self.rules.iter().any(|r| matches!(r, Rule::Vertical(_, t) if !t.is_empty()));
        let top = title_height + legend_height + if labelled { 18.0 } else { 8.0 };
        // Category names wider than their slot stand on several heights by turns.
        let heights = match &self.x.scale {
            Scale::Categories(names) => {
                let slot = (self.width - 130.0) / names.len().max(1) as f64;
                let widest = names.iter().map(|n| text_width(n)).fold(0.0, f64::max);
                ((widest + 8.0) / slot).ceil().clamp(1.0, 4.0) as usize
            }
            _ => 1,
        };
        let bottom = self.height - 46.0 - 14.0 * (heights - 1) as f64;
        let y_ticks = y.ticks(((bottom - top) / 44.0) as usize);
        let y_names: Vec<String> = match &self.y.scale {
            Scale::Categories(names) => names.clone(),
            _ => (0..y_ticks.len()).map(|i| tick_label(y_ticks[i], tick_step(&y_ticks, i, y.log))).collect(),
        };
        let widest = y_names.iter().map(|n| text_width(n)).fold(0.0, f64::max);
        let left = (widest + 36.0).min(self.width * 0.4);
        let rule_room = self
            .rules
            .iter()
            .map(|r| match r {
                Rule::Horizontal(_, t) => text_width(t),
                _ => 0.0,
            })
            .fold(0.0, f64::max);
        let right = self.width - if rule_room > 0.0 { rule_room + 12.0 } else { 16.0 };
        let (w, h) = (right - left, bottom - top);
        let at_x = |v: f64| x.place(v).map(|p| left + p * w);
        let at_y = |v: f64| y.place(v).map(|p| bottom - p * h);

        let mut s = String::new();
        let _ = write!(
            s,
            "<svg class=\"entire-chart\"{namespace} viewBox=\"0 0 {:.0} {:.0}\" role=\"img\" aria-label=\"{}\">{}",
            self.width,
            self.height,
            escape(&self.title),
            style()
        );
        if !self.title.is_empty() {
            let _ = write!(s, "<text class=\"t\" x=\"{left_edge}\" y=\"18\">{}</text>", escape(&self.title));
        }
        for (i, lx, row) in places {
            let ly = title_height + f64::from(row) * 20.0 + 10.0;
            self.swatch(&mut s, i, lx, ly);
            let _ = write!(
                s,
                "<text x=\"{:.1}\" y=\"{:.1}\">{}</text>",
                lx + 34.0,
                ly + 4.5,
                escape(&self.series[i].name)
            );
        }

        // Grid, ticks and labels.
        for (i, tick) in y_ticks.iter().enumerate() {
            if matches!(self.y.scale, Scale::Categories(_)) {
                break;
            }
            let Some(py) = at_y(*tick) else { continue };
            let _ = write!(
                s,
                "<line class=\"g\" x1=\"{left:.1}\" x2=\"{right:.1}\" y1=\"{py:.1}\" y2=\"{py:.1}\"/>\
                 <text class=\"k\" text-anchor=\"end\" x=\"{:.1}\" y=\"{:.1}\">{}</text>",
                left - 7.0,
                py + 4.5,
                escape(&y_names[i])
            );
        }
        if let Scale::Categories(names) = &self.y.scale {
            for (i, name) in names.iter().enumerate() {
                let Some(py) = at_y(i as f64) else { continue };
                let _ = write!(
                    s,
                    "<text class=\"k\" text-anchor=\"end\" x=\"{:.1}\" y=\"{:.1}\">{}</text>",
                    left - 7.0,
                    py + 4.5,
                    escape(name)
                );
            }
        }
        if let Scale::Categories(names) = &self.x.scale {
            for (i, name) in names.iter().enumerate() {
                let Some(px) = at_x(i as f64) else { continue };
                let drop = 16.0 + 14.0 * (i % heights) as f64;
                let _ = write!(
                    s,
                    "<text class=\"k\" text-anchor=\"middle\" x=\"{px:.1}\" y=\"{:.1}\">{}</text>",
                    bottom + drop,
                    escape(name)
                );
            }
        } else {
            let ticks = x.ticks((w / 72.0) as usize);
            for (i, tick) in ticks.iter().enumerate() {
                let Some(px) = at_x(*tick) else { continue };
                let _ = write!(
                    s,
                    "<line class=\"g\" x1=\"{px:.1}\" x2=\"{px:.1}\" y1=\"{top:.1}\" y2=\"{bottom:.1}\"/>\
                     <text class=\"k\" text-anchor=\"middle\" x=\"{px:.1}\" y=\"{:.1}\">{}</text>",
                    bottom + 17.0,
                    escape(&tick_label(*tick, tick_step(&ticks, i, x.log)))
                );
            }
        }
        let _ = write!(
            s,
            "<text text-anchor=\"middle\" x=\"{:.1}\" y=\"{:.1}\">{}</text>\
             <text text-anchor=\"middle\" transform=\"translate(14 {:.1}) rotate(-90)\">{}</text>",
            left + w / 2.0,
            self.height - 8.0,
            escape(&self.x.label),
            top + h / 2.0,
            escape(&self.y.label)
        );

        // Everything inside the plot's frame is cut off at it.
        let _ = write!(
            s,
            "<svg x=\"{left:.1}\" y=\"{top:.1}\" width=\"{w:.1}\" height=\"{h:.1}\" viewBox=\"{left:.1} {top:.1} {w:.1} {h:.1}\">"
        );
        for rule in &self.rules {
            match rule {
                Rule::Horizontal(v, _) => {
                    if let Some(py) = at_y(*v) {
                        let _ = write!(
                            s,
                            "<line class=\"r\" x1=\"{left:.1}\" x2=\"{right:.1}\" y1=\"{py:.1}\" y2=\"{py:.1}\"/>"
                        );
                    }
                }
                Rule::Vertical(v, _) => {
                    if let Some(px) = at_x(*v) {
                        let _ = write!(
                            s,
                            "<line class=\"v\" x1=\"{px:.1}\" x2=\"{px:.1}\" y1=\"{top:.1}\" y2=\"{bottom:.1}\"/>"
                        );
                    }
                }
                Rule::Diagonal(_) => {
                    let (low, high) = (x.low.min(y.low), x.high.max(y.high));
                    if let (Some(x1), Some(y1), Some(x2), Some(y2)) =
                        (at_x(low), at_y(low), at_x(high), at_y(high))
                    {
                        let _ = write!(
                            s,
                            "<line class=\"r\" x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\"/>"
                        );
                    }
                }
            }
        }
        let base = y.place(0.0).map_or(bottom, |p| bottom - p.clamp(0.0, 1.0) * h);
        for i in 0..self.series.len() {
            self.draw_mark(&mut s, i, &at_x, &at_y, base, w / (x.high - x.low));
        }
        s.push_str("</svg>");
        // Texts of points stand over the frame, on the side where there is room beside points and other texts.
        let mut taken: Vec<[f64; 4]> = self
            .series
            .iter()
            .filter_map(|s| if let Mark::Points(points) = &s.mark { Some(points) } else { None })
            .flatten()
            .filter(|p| !p.2.is_empty())
            .filter_map(|p| Some((at_x(p.0)?, at_y(p.1)?)))
            .map(|(px, py)| [px - 4.0, py - 4.0, px + 4.0, py + 4.0])
            .collect();
        for series in &self.series {
            let Mark::Points(points) = &series.mark else { continue };
            for (vx, vy, text) in points.iter().filter(|p| !p.2.is_empty()) {
                let (Some(px), Some(py)) = (at_x(*vx), at_y(*vy)) else { continue };
                if !(left..=right).contains(&px) || !(top..=bottom).contains(&py) {
                    continue;
                }
                let wide = text_width(text);
                let place = |leftward: bool, dy: f64| {
                    let x = if leftward { px - 7.0 - wide } else { px + 7.0 };
                    [x, py + dy - 11.0, x + wide, py + dy + 2.0]
                };
                let fits = |b: &[f64; 4]| {
                    b[0] >= left
                        && b[2] <= right
                        && b[1] >= top
                        && b[3] <= bottom
                        && taken.iter().all(|t| b[0] > t[2] || b[2] < t[0] || b[1] > t[3] || b[3] < t[1])
                };
                let choices = [-5.0, 15.0, 4.0, -19.0, 29.0, -33.0, 43.0];
                let (leftward, dy) = choices
                    .into_iter()
                    .flat_map(|dy| [(false, dy), (true, dy)])
                    .find(|&(leftward, dy)| fits(&place(leftward, dy)))
                    .unwrap_or((px + 7.0 + wide > right, if py - 16.0 < top { 15.0 } else { -5.0 }));
                taken.push(place(leftward, dy));
                let _ = write!(
                    s,
                    "<text class=\"k\" text-anchor=\"{}\" x=\"{:.1}\" y=\"{:.1}\">{}</text>",
                    if leftward { "end" } else { "start" },
                    if leftward { px - 7.0 } else { px + 7.0 },
                    py + dy,
                    escape(text)
                );
            }
        }
        let _ = write!(
            s,
            "<rect class=\"f\" x=\"{left:.1}\" y=\"{top:.1}\" width=\"{w:.1}\" height=\"{h:.1}\"/>"
        );
        for rule in &self.rules {
            match rule {
                Rule::Horizontal(v, text) if !text.is_empty() => {
                    if let Some(py) = at_y(*v) {
                        let _ = write!(
                            s,
                            "<text class=\"k\" x=\"{:.1}\" y=\"{:.1}\">{}</text>",
                            right + 6.0,
                            py + 4.5,
                            escape(text)
                        );
                    }
                }
                Rule::Vertical(v, text) if !text.is_empty() => {
                    if let Some(px) = at_x(*v) {
                        let _ = write!(
                            s,
                            "<text class=\"k\" text-anchor=\"middle\" x=\"{px:.1}\" y=\"{:.1}\">{}</text>",
                            top - 5.0,
                            escape(text)
                        );
                    }
                }
                Rule::Diagonal(text) if !text.is_empty() => {
                    let _ = write!(
                        s,
                        "<text class=\"k\" x=\"{:.1}\" y=\"{:.1}\">{}</text>",
                        left + 8.0,
                        top + 16.0,
                        escape(text)
                    );
                }
                _ => {}
            }
        }
        s.push_str("</svg>");
        s
    }

    fn color(&self, i: usize) -> usize {
        self.series[i].color.unwrap_or(i % PALETTE.len())
    }

    fn swatch(&self, s: &mut String, i: usize, x: f64, y: f64) {
        let c = self.color(i);
        let _ = match self.series[i].mark {
            Mark::Line(_) | Mark::Steps(_) => write!(
                s,
                "<line class=\"l c{c}\" stroke-dasharray=\"{}\" x1=\"{x:.1}\" x2=\"{:.1}\" y1=\"{y:.1}\" y2=\"{y:.1}\"/>",
                DASHES[c],
                x + 28.0
            ),
            Mark::Points(_) => {
                write!(s, "<circle class=\"p f{c}\" cx=\"{:.1}\" cy=\"{y:.1}\" r=\"4\"/>", x + 14.0)
            }
            Mark::Band(_) => write!(
                s,
                "<rect class=\"b f{c}\" x=\"{x:.1}\" y=\"{:.1}\" width=\"28\" height=\"10\"/>",
                y - 5.0
            ),
            Mark::Bars(_) | Mark::Boxes(_) => write!(
                s,
                "<rect class=\"f{c}\" x=\"{:.1}\" y=\"{:.1}\" width=\"18\" height=\"10\"/>",
                x + 5.0,
                y - 5.0
            ),
        };
    }

    fn draw_mark(
        &self,
        s: &mut String,
        i: usize,
        at_x: &impl Fn(f64) -> Option<f64>,
        at_y: &impl Fn(f64) -> Option<f64>,
        base: f64,
        unit: f64,
    ) {
        let c = self.color(i);
        // Bars and boxes of several series share a slot side by side.
        let same = |m: &Mark| std::mem::discriminant(m) == std::mem::discriminant(&self.series[i].mark);
        let (sharers, mine) = (
            self.series.iter().filter(|t| same(&t.mark)).count() as f64,
            self.series[..i].iter().filter(|t| same(&t.mark)).count() as f64,
        );
        let slot = 0.76 * unit / sharers;
        let offset = (mine - (sharers - 1.0) / 2.0) * slot;
        match &self.series[i].mark {
            Mark::Line(points) | Mark::Steps(points) => {
                let steps = matches!(self.series[i].mark, Mark::Steps(_));
                let mut d = String::new();
                let mut last: Option<f64> = None;
                for (vx, vy) in points {
                    match (at_x(*vx), at_y(*vy)) {
                        (Some(px), Some(py)) => {
                            let _ = match last {
                                None => write!(d, "M{px:.1} {py:.1}"),
                                Some(before) if steps => write!(d, "L{px:.1} {before:.1}L{px:.1} {py:.1}"),
                                Some(_) => write!(d, "L{px:.1} {py:.1}"),
                            };
                            last = Some(py);
                        }
                        _ => last = None,
                    }
                }
                let _ = write!(s, "<path class=\"l c{c}\" stroke-dasharray=\"{}\" d=\"{d}\"/>", DASHES[c]);
            }
            Mark::Points(points) => {
                for (vx, vy, _) in points {
                    let (Some(px), Some(py)) = (at_x(*vx), at_y(*vy)) else { continue };
                    let radius = if points.len() > 60 { 2.2 } else { 4.0 };
                    let _ =
                        write!(s, "<circle class=\"p f{c}\" cx=\"{px:.1}\" cy=\"{py:.1}\" r=\"{radius}\"/>");
                }
            }
            Mark::Band(points) => {
                let edge = |upper: bool| {
                    points
                        .iter()
                        .filter_map(move |(vx, a, b)| Some((at_x(*vx)?, at_y(if upper { *b } else { *a })?)))
                };
                let back: Vec<(f64, f64)> = edge(false).collect();
                let corners: Vec<String> = edge(true)
                    .chain(back.into_iter().rev())
                    .map(|(px, py)| format!("{px:.1},{py:.1}"))
                    .collect();
                let _ = write!(s, "<polygon class=\"b f{c}\" points=\"{}\"/>", corners.join(" "));
            }
            Mark::Bars(points) => {
                for (vx, vy) in points {
                    let (Some(px), Some(py)) = (at_x(*vx), at_y(*vy)) else { continue };
                    let _ = write!(
                        s,
                        "<rect class=\"f{c}\" x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\"/>",
                        px + offset - slot * 0.46,
                        py.min(base),
                        slot * 0.92,
                        (base - py).abs().max(0.5)
                    );
                }
            }
            Mark::Boxes(points) => {
                for (vx, q) in points {
                    let Some(px) = at_x(*vx).map(|p| p + offset) else { continue };
                    let Some(py) =
                        q.iter().map(|v| at_y(*v)).collect::<Option<Vec<f64>>>().filter(|v| v.len() == 5)
                    else {
                        continue;
                    };
                    let half = (slot * 0.36).min(26.0);
                    let _ = write!(
                        s,
                        "<path class=\"w c{c}\" d=\"M{px:.1} {:.1}V{:.1}M{px:.1} {:.1}V{:.1}\"/>\
                         <rect class=\"x f{c} c{c}\" x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\"/>\
                         <path class=\"m c{c}\" d=\"M{:.1} {:.1}H{:.1}\"/>",
                        py[0],
                        py[1],
                        py[3],
                        py[4],
                        px - half,
                        py[3],
                        2.0 * half,
                        (py[1] - py[3]).max(0.5),
                        px - half,
                        py[2],
                        px + half
                    );
                }
            }
        }
    }
}

/// The style that every chart carries, so that it also stands alone.
fn style() -> String {
    let mut light = String::new();
    let mut dark = String::new();
    for (i, (l, d)) in PALETTE.iter().enumerate() {
        let _ = write!(light, ".entire-chart .c{i}{{stroke:{l}}}.entire-chart .f{i}{{fill:{l}}}");
        let _ = write!(dark, ".entire-chart .c{i}{{stroke:{d}}}.entire-chart .f{i}{{fill:{d}}}");
    }
    format!(
        "<style>.entire-chart{{font:{FONT}px system-ui,'Segoe UI','DejaVu Sans',sans-serif;background:#fff;\
         max-width:100%;height:auto;display:block}}\
         .entire-chart text{{fill:#1c2024}}.entire-chart .t{{font-weight:600;font-size:15px}}\
         .entire-chart .k{{fill:#555b63;font-size:12px}}\
         .entire-chart .g{{stroke:#e4e7ea;stroke-width:1}}.entire-chart .f{{fill:none;stroke:#8a9199;stroke-width:1}}\
         .entire-chart .r{{stroke:#1c2024;stroke-width:1.4;stroke-dasharray:5 4}}\
         .entire-chart .v{{stroke:#8a9199;stroke-width:1.2;stroke-dasharray:3 3}}\
         .entire-chart .l{{fill:none;stroke-width:1.8;stroke-linejoin:round}}\
         .entire-chart .p{{fill-opacity:.75}}.entire-chart .b{{fill-opacity:.2}}\
         .entire-chart .w{{fill:none;stroke-width:1.4}}.entire-chart .x{{fill-opacity:.3;stroke-width:1.4}}\
         .entire-chart .m{{fill:none;stroke-width:2.6}}{light}\
         @media(prefers-color-scheme:dark){{.entire-chart{{background:#15181c}}\
         .entire-chart text{{fill:#e8eaed}}.entire-chart .k{{fill:#a9b0b8}}.entire-chart .g{{stroke:#2a2f36}}\
         .entire-chart .f{{stroke:#6a727b}}.entire-chart .r{{stroke:#e8eaed}}{dark}}}</style>"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart() -> Chart {
        Chart::new("Frame time", Axis::linear("frame"), Axis::log("time / ms"))
            .series(Series::new("a", Mark::Line(vec![(0.0, 1.0), (1.0, f64::NAN), (2.0, 100.0)])))
            .rule(Rule::Horizontal(33.0, "target".into()))
    }

    #[test]
    fn broken_values_break_the_line_and_never_reach_the_file() {
        let svg = chart().to_svg();
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        assert_eq!(svg.matches("class=\"l c0\" stroke-dasharray=\"\" d=\"M").count(), 1);
        let path = svg.split("d=\"").nth(1).unwrap().split('"').next().unwrap();
        assert_eq!(path.matches('M').count(), 2, "{path}");
    }

    #[test]
    fn names_are_escaped_and_standalone_files_carry_their_namespace() {
        let c = Chart::new("a < b & \"c\"", Axis::linear("x"), Axis::linear("y"))
            .series(Series::new("<i>", Mark::Points(vec![(0.0, 0.0, "<b>".into())])));
        let svg = c.to_svg();
        assert!(svg.contains("a &lt; b &amp; &quot;c&quot;") && !svg.contains("<b>") && !svg.contains("<i>"));
        assert!(!svg.contains("http") && c.to_svg_file().contains("xmlns"));
    }

    #[test]
    fn empty_and_constant_data_have_a_span() {
        let empty = Chart::new("", Axis::log("x"), Axis::linear("y")).to_svg();
        assert!(!empty.contains("NaN"));
        let constant = Chart::new("", Axis::log("x"), Axis::linear("y"))
            .series(Series::new("", Mark::Line(vec![(2.0, 5.0), (2.0, 5.0)])))
            .to_svg();
        assert!(!constant.contains("NaN") && !constant.contains("inf"));
    }

    #[test]
    fn ticks_are_round_few_and_inside() {
        for (low, high) in [(0.0, 119.0), (-3.0, 7.0), (0.00012, 0.00019), (1e5, 9e7)] {
            let span = Span { low, high, log: false };
            let ticks = span.ticks(8);
            assert!((2..=10).contains(&ticks.len()), "{low} {high} {ticks:?}");
            assert!(ticks.iter().all(|t| *t >= low - 1e-12 && *t <= high * (1.0 + 1e-9)));
        }
        let log = Span { low: 0.9, high: 1100.0, log: true };
        assert!(log.ticks(5).iter().all(|t| (0.9..=1100.0).contains(t)));
        assert_eq!(tick_label(0.25, 0.25), "0.25");
        assert_eq!(tick_label(2.5, 2.5), "2.5");
        assert_eq!(tick_label(20.0, 20.0), "20");
        assert_eq!(tick_label(0.02, 0.01), "0.02");
        assert_eq!(tick_label(1e-7, 1e-7), "1e-7");
    }
}
