//! The drawing of a chart.

use super::axis::{Scale, Span};
use super::clip::{clip, clip_area};
use super::labels::{Places, Rect};
use super::palette::{DASHES, DIM, FRAME, GRID, INK, PALETTE, light, pairs};
use super::{Chart, Mark, Rule};
use askama::Template;
use plotters::chart::ChartState;
use plotters::coord::cartesian::Cartesian2d;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::mem::discriminant;

/// Drawing units per pixel: the library rounds to whole units, so small units keep curves smooth.
const UNITS: f64 = 10.0;

type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;
type Plot<'a> = ChartContext<'a, SVGBackend<'a>, Cartesian2d<Span, Span>>;
type State = ChartState<Cartesian2d<Span, Span>>;
type Drawn = Result<(), Box<dyn std::error::Error>>;

/// A layer of the chart's interior; layers are drawn from back to front.
struct Layer {
    class: &'static str,
    dash: String,
    svg: String,
}

#[derive(Template)]
#[template(path = "chart.svg")]
struct Page<'a> {
    standalone: bool,
    title: &'a str,
    size: (f64, f64),
    units: (u32, u32),
    colors: Vec<(String, String)>,
    ground: &'a str,
    layers: &'a [Layer],
    texts: &'a str,
}

/// Layout of the chart, in pixels.
struct Layout {
    left: f64,
    right: f64,
    top: f64,
    bottom: f64,
    title_height: f64,
    /// Entries of the legend: index of the series, x in pixels, row.
    legend: Vec<(usize, f64, usize)>,
    /// Number of rows over which names along the x axis are staggered.
    name_rows: usize,
    x_ticks: usize,
    y_ticks: usize,
    /// Ranges of the axes.
    x: Span,
    y: Span,
}

const MARGIN: f64 = 12.0;
const LEGEND_ROW: f64 = 20.0;
const SWATCH: f64 = 28.0;

fn units(pixels: f64) -> i32 {
    (pixels * UNITS).round() as i32
}

/// Estimates the width of a text, in pixels, since no font is available.
fn text_width(text: &str, size: f64) -> f64 {
    text.chars().map(|c| if "iljt.,:;|!' ".contains(c) { 0.34 } else { 0.6 }).sum::<f64>() * size
}

fn text_style(size: f64, color: (u32, u32), h_pos: HPos, v_pos: VPos) -> TextStyle<'static> {
    // The backend writes sizes divided by 1.24.
    ("sans-serif", size * UNITS * 1.24).into_font().color(&light(color)).pos(Pos::new(h_pos, v_pos))
}

fn stroke(color: (u32, u32), pixels: f64) -> ShapeStyle {
    light(color).stroke_width(units(pixels) as u32)
}

fn dash_of(lengths: &[u32]) -> String {
    lengths.iter().map(|l| (f64::from(*l) * UNITS).to_string()).collect::<Vec<_>>().join(" ")
}

/// Draws on an empty sheet and returns the SVG elements.
fn sheet(size: (u32, u32), draw: impl FnOnce(&Area<'_>) -> Drawn) -> String {
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        draw(&area).expect("drawing into memory does not fail");
        area.present().expect("drawing into memory does not fail");
    }
    let start = svg.find('>').map_or(0, |at| at + 1);
    let end = svg.rfind("</svg>").unwrap_or(svg.len());
    svg[start..end].trim_start().to_owned()
}

fn draw_line(plot: &mut Plot<'_>, parts: &[Vec<(f64, f64)>], style: ShapeStyle) -> Drawn {
    for part in parts {
        plot.draw_series(LineSeries::new(part.iter().copied(), style))?;
    }
    Ok(())
}

impl Chart {
    pub(super) fn draw(&self, standalone: bool) -> String {
        let layout = self.layout();
        let (x, y) = (&layout.x, &layout.y);
        let size = (units(self.width) as u32, units(self.height) as u32);

        let mut state = None;
        let ground = sheet(size, |area| {
            state = Some(self.draw_ground(area, &layout)?);
            Ok(())
        });
        let state: State = state.expect("the ground was drawn");

        let mut layers = Vec::new();
        for rule in &self.rules {
            let (color, wide, dash): (_, _, &[u32]) = match rule {
                Rule::Vertical(..) => (FRAME, 1.2, &[3, 3]),
                Rule::Horizontal(..) | Rule::Diagonal(_) => (INK, 1.4, &[5, 4]),
            };
            let ends = match rule {
                Rule::Horizontal(v, _) => [(x.low, *v), (x.high, *v)],
                Rule::Vertical(v, _) => [(*v, y.low), (*v, y.high)],
                Rule::Diagonal(_) => [x.low.min(y.low), x.high.max(y.high)].map(|v| (v, v)),
            };
            let svg = sheet(size, |area| {
                draw_line(&mut state.clone().restore(area), &clip(&ends, x, y), stroke(color, wide))
            });
            layers.push(Layer { class: "rule", dash: dash_of(dash), svg });
        }
        for (i, series) in self.series.iter().enumerate() {
            let svg = sheet(size, |area| self.draw_mark(i, state.clone().restore(area), &layout));
            let (class, dash) = match series.mark {
                Mark::Line(_) => ("line", dash_of(DASHES[self.color_of(i)])),
                Mark::Steps(_) => ("steps", dash_of(DASHES[self.color_of(i)])),
                Mark::Points(_) => ("points", String::new()),
                Mark::Band(_) => ("band", String::new()),
                Mark::Boxes(_) => ("boxes", String::new()),
                Mark::Stretches(_) => ("stretches", String::new()),
            };
            layers.push(Layer { class, dash, svg });
        }

        let texts = sheet(size, |area| {
            let chart = state.clone().restore(area);
            let (h, v) = chart.plotting_area().get_pixel_range();
            let corners = [(h.start, v.start), (h.end, v.start), (h.end, v.end), (h.start, v.end)];
            let frame: Vec<_> = corners.into_iter().cycle().take(5).collect();
            area.draw(&PathElement::new(frame, stroke(FRAME, 1.0)))?;
            self.draw_point_texts(area, &chart, &layout)?;
            self.draw_rule_texts(area, &chart, &layout)
        });

        let used =
            |color: &str| layers.iter().map(|l| &l.svg).chain([&ground, &texts]).any(|s| s.contains(color));
        let colors = pairs()
            .map(|(light, dark)| (format!("#{light:06X}"), format!("#{dark:06x}")))
            .filter(|(light, _)| used(light))
            .collect();
        let page = Page {
            standalone,
            title: &self.title,
            size: (self.width, self.height),
            units: size,
            colors,
            ground: &ground,
            layers: &layers,
            texts: &texts,
        };
        page.render().expect("writing into memory does not fail")
    }

    fn layout(&self) -> Layout {
        let (x, y) = self.spans();
        // The legend: rows of swatch and name between title and plot.
        let mut legend = Vec::new();
        let (mut at, mut row) = (MARGIN, 0);
        for (i, series) in self.series.iter().enumerate().filter(|(_, s)| !s.name.is_empty()) {
            let wide = SWATCH + 6.0 + text_width(&series.name, 13.0) + 18.0;
            if at + wide > self.width - 8.0 && at > MARGIN {
                (at, row) = (MARGIN, row + 1);
            }
            legend.push((i, at, row));
            at += wide;
        }
        let title_height = if self.title.is_empty() { 6.0 } else { 26.0 };
        let legend_height = if legend.is_empty() { 0.0 } else { (row + 1) as f64 * LEGEND_ROW + 4.0 };
        let labeled = self.rules.iter().any(|r| matches!(r, Rule::Vertical(_, t) if !t.is_empty()));
        let top = title_height + legend_height + if labeled { 18.0 } else { 8.0 };
        // Names wider than their slot are staggered over several rows.
        let name_rows = self.x.names.as_ref().map_or(1, |names| {
            let slot = (self.width - 130.0) / names.len().max(1) as f64;
            let widest = names.iter().map(|n| text_width(n, 12.0)).fold(0.0, f64::max);
            ((widest + 8.0) / slot).ceil().clamp(1.0, 4.0) as usize
        });
        let bottom = (self.height - 46.0 - 14.0 * (name_rows - 1) as f64).max(top + 20.0);
        let y_ticks = ((bottom - top) / 44.0) as usize;
        let widest = match &self.y.names {
            Some(names) => names.iter().map(|n| text_width(n, 12.0)).fold(0.0, f64::max),
            None => {
                let ticks = y.ticks(y_ticks);
                ticks.iter().map(|t| text_width(&y.label(*t, &ticks), 12.0)).fold(0.0, f64::max)
            }
        };
        let left = (widest + 38.0).min(self.width * 0.4);
        let beside = self
            .rules
            .iter()
            .map(|r| if let Rule::Horizontal(_, text) = r { text_width(text, 12.0) } else { 0.0 })
            .fold(0.0, f64::max);
        let right = self.width - if beside > 0.0 { beside + 12.0 } else { 16.0 };
        let right = right.max(left + 40.0);
        let x_ticks = if x.scale == Scale::Slots { 0 } else { ((right - left) / 72.0) as usize };
        Layout { left, right, top, bottom, title_height, legend, name_rows, x_ticks, y_ticks, x, y }
    }

    /// Draws title, legend, axes and grid.
    fn draw_ground(&self, area: &Area<'_>, layout: &Layout) -> Result<State, Box<dyn std::error::Error>> {
        let (x, y) = (&layout.x, &layout.y);
        let title = ("sans-serif", 15.0 * UNITS * 1.24, FontStyle::Bold).into_font().color(&light(INK));
        if !self.title.is_empty() {
            area.draw_text(&self.title, &title, (units(MARGIN), units(6.0)))?;
        }
        let name = text_style(13.0, INK, HPos::Left, VPos::Center);
        for &(i, at, row) in &layout.legend {
            let middle = layout.title_height + row as f64 * LEGEND_ROW + 10.0;
            self.draw_swatch(area, i, at, middle)?;
            area.draw_text(&self.series[i].name, &name, (units(at + SWATCH + 6.0), units(middle)))?;
        }

        let mut plot = ChartBuilder::on(area)
            .margin_top(units(layout.top))
            .margin_right(units(self.width - layout.right))
            .margin_bottom(units(6.0))
            .margin_left(units(6.0))
            .set_label_area_size(LabelAreaPosition::Left, units(layout.left - 6.0))
            .set_label_area_size(LabelAreaPosition::Bottom, units(self.height - 6.0 - layout.bottom))
            .build_cartesian_2d(x.clone(), y.clone())?;
        let (x_ticks, y_ticks) = (x.ticks(layout.x_ticks), y.ticks(layout.y_ticks));
        let y_label = |v: &f64| match &self.y.names {
            Some(names) => names.get(*v as usize).cloned().unwrap_or_default(),
            None => y.label(*v, &y_ticks),
        };
        let x_label = |v: &f64| x.label(*v, &x_ticks);
        let mut mesh = plot.configure_mesh();
        mesh.axis_style(TRANSPARENT)
            .x_labels(layout.x_ticks)
            .y_labels(layout.y_ticks)
            .x_label_formatter(&x_label)
            .y_label_formatter(&y_label)
            .label_style(text_style(12.0, DIM, HPos::Center, VPos::Center))
            .axis_desc_style(text_style(13.0, INK, HPos::Center, VPos::Center))
            .x_desc(&self.x.label)
            .y_desc(&self.y.label)
            .set_all_tick_mark_size(units(3.5))
            .bold_line_style(stroke(GRID, 1.0))
            .light_line_style(TRANSPARENT);
        if self.y.names.is_some() {
            mesh.disable_y_mesh();
        }
        mesh.draw()?;

        let style = text_style(12.0, DIM, HPos::Center, VPos::Center);
        for (i, name) in self.x.names.iter().flatten().enumerate() {
            let (at, _) = plot.plotting_area().map_coordinate(&(i as f64, y.low));
            let down = 12.0 + 14.0 * (i % layout.name_rows) as f64;
            area.draw_text(name, &style, (at, units(layout.bottom + down)))?;
        }
        Ok(plot.to_chart_state())
    }

    fn draw_swatch(&self, area: &Area<'_>, i: usize, at: f64, middle: f64) -> Drawn {
        let color = PALETTE[self.color_of(i)];
        let block = |from: f64, wide: f64, opacity: f64| {
            let corners = [(at + from, middle - 5.0), (at + from + wide, middle + 5.0)];
            Rectangle::new(corners.map(|(x, y)| (units(x), units(y))), light(color).mix(opacity).filled())
        };
        match self.series[i].mark {
            Mark::Line(_) | Mark::Steps(_) => {
                // The swatch repeats the dashes of the line: a stroke, then a gap.
                let dash = DASHES[self.color_of(i)];
                let (mut from, mut drawn) = (0.0, true);
                for length in dash.iter().copied().cycle().chain([SWATCH as u32]) {
                    let to = (from + f64::from(length)).min(SWATCH);
                    if drawn {
                        let ends = [at + from, at + to].map(|x| (units(x), units(middle)));
                        area.draw(&PathElement::new(ends, stroke(color, self.series[i].line_width())))?;
                    }
                    (from, drawn) = (to, !drawn);
                    if from >= SWATCH {
                        break;
                    }
                }
            }
            Mark::Points(_) => {
                let center = (units(at + SWATCH / 2.0), units(middle));
                area.draw(&Circle::new(center, units(4.0), light(color).mix(0.75).filled()))?;
            }
            Mark::Band(_) => area.draw(&block(0.0, SWATCH, 0.2))?,
            Mark::Boxes(_) | Mark::Stretches(_) => area.draw(&block(5.0, 18.0, 1.0))?,
        }
        Ok(())
    }

    fn draw_mark(&self, i: usize, mut plot: Plot<'_>, layout: &Layout) -> Drawn {
        let (x, y) = (&layout.x, &layout.y);
        let series = &self.series[i];
        let color = PALETTE[self.color_of(i)];
        let fill = |opacity: f64| light(color).mix(opacity).filled();
        let seen = |&(px, py): &(f64, f64)| x.takes(px) && y.takes(py);
        // Boxes of several series share one slot of the x axis.
        let same = |other: &&super::Series| discriminant(&other.mark) == discriminant(&series.mark);
        let sharers = self.series.iter().filter(same).count() as f64;
        let mine = self.series[..i].iter().filter(same).count() as f64;
        let slot = 0.76 / sharers;
        let offset = (mine - (sharers - 1.0) / 2.0) * slot;
        match &series.mark {
            Mark::Line(points) => {
                draw_line(&mut plot, &clip(points, x, y), stroke(color, series.line_width()))?
            }
            Mark::Steps(points) => {
                draw_line(&mut plot, &clip(&steps(points), x, y), stroke(color, series.line_width()))?
            }
            Mark::Points(points) => {
                let radius = units(if points.len() > 60 { 2.2 } else { 4.0 });
                let places = points.iter().map(|p| (p.0, p.1)).filter(|p| x.shows(p.0) && y.shows(p.1));
                plot.draw_series(places.map(|at| Circle::new(at, radius, fill(0.75))))?;
            }
            Mark::Band(points) => {
                let upper = points.iter().map(|p| (p.0, p.2));
                let lower = points.iter().rev().map(|p| (p.0, p.1));
                plot.draw_series([Polygon::new(clip_area(upper.chain(lower), x, y), fill(0.2))])?;
            }
            Mark::Stretches(parts) => {
                let inside = parts.iter().filter(|(_, _, at)| y.takes(*at));
                plot.draw_series(inside.filter(|(from, to, _)| *to >= x.low && *from <= x.high).map(
                    |&(from, to, at)| {
                        let half = 0.25f64.min(at - y.low).min(y.high - at).max(0.0);
                        let (from, to) = (from.max(x.low), to.min(x.high));
                        Rectangle::new([(from, at - half), (to, at + half)], fill(0.8))
                    },
                ))?;
            }
            Mark::Boxes(points) => {
                let pixel = (x.high - x.low) / (layout.right - layout.left);
                let half = (slot * 0.36).min(26.0 * pixel);
                for (px, q) in points.iter().filter(|(px, q)| q.iter().all(|v| seen(&(*px, *v)))) {
                    let at = px + offset;
                    let (left, right) = (at - half, at + half);
                    plot.draw_series([Rectangle::new([(left, q[1]), (right, q[3])], fill(0.3))])?;
                    let outline = [(left, q[1]), (left, q[3]), (right, q[3]), (right, q[1]), (left, q[1])];
                    for whisker in [[q[0], q[1]], [q[3], q[4]]] {
                        draw_line(&mut plot, &clip(&whisker.map(|v| (at, v)), x, y), stroke(color, 1.4))?;
                    }
                    draw_line(&mut plot, &clip(&outline, x, y), stroke(color, 1.4))?;
                    draw_line(&mut plot, &clip(&[(left, q[2]), (right, q[2])], x, y), stroke(color, 2.6))?;
                }
            }
        }
        Ok(())
    }

    /// Draws the texts of points over all marks, each beside its point where there is space.
    fn draw_point_texts(&self, area: &Area<'_>, plot: &Plot<'_>, layout: &Layout) -> Drawn {
        let (x, y) = (&layout.x, &layout.y);
        let frame = Rect { left: layout.left, top: layout.top, right: layout.right, bottom: layout.bottom };
        let pixels = |at: &(f64, f64)| {
            let (h, v) = plot.plotting_area().map_coordinate(at);
            (f64::from(h) / UNITS, f64::from(v) / UNITS)
        };
        let mut texts = Vec::new();
        let mut places = Places::default();
        let taken = &mut places.marks;
        for series in &self.series {
            match &series.mark {
                Mark::Points(points) => {
                    for (px, py, text) in points.iter().filter(|p| x.shows(p.0) && y.shows(p.1)) {
                        let (h, v) = pixels(&(*px, *py));
                        taken.push(Rect::around(h, v, 4.0));
                        if !text.is_empty() {
                            texts.push((h, v, text));
                        }
                    }
                }
                Mark::Line(points) => points.windows(2).for_each(|ends| {
                    taken.extend(Rect::along(pixels(&ends[0]), pixels(&ends[1])));
                }),
                Mark::Steps(points) => steps(points).windows(2).for_each(|ends| {
                    taken.extend(Rect::along(pixels(&ends[0]), pixels(&ends[1])));
                }),
                _ => {}
            }
        }
        // Texts are placed from top to bottom. The stable sort keeps the order of coinciding points.
        texts.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.total_cmp(&b.0)));
        for (h, v, text) in texts {
            let found = places.place(h, v, text_width(text, 12.0), &frame);
            if let Some(ends) = found.line(h, v) {
                let ends = ends.map(|(h, v)| (units(h), units(v)));
                area.draw(&PathElement::new(ends, stroke(DIM, 0.7)))?;
            }
            let side = if found.leftward { HPos::Right } else { HPos::Left };
            let at = (units(found.x), units(found.middle()));
            area.draw_text(text, &text_style(12.0, DIM, side, VPos::Center), at)?;
        }
        Ok(())
    }

    fn draw_rule_texts(&self, area: &Area<'_>, plot: &Plot<'_>, layout: &Layout) -> Drawn {
        let (x, y) = (&layout.x, &layout.y);
        let style = |side: HPos| text_style(12.0, DIM, side, VPos::Center);
        for rule in &self.rules {
            match rule {
                Rule::Horizontal(v, text) if y.shows(*v) => {
                    let (_, at) = plot.plotting_area().map_coordinate(&(x.low, *v));
                    area.draw_text(text, &style(HPos::Left), (units(layout.right + 6.0), at))?;
                }
                Rule::Vertical(v, text) if x.shows(*v) => {
                    let (at, _) = plot.plotting_area().map_coordinate(&(*v, y.low));
                    area.draw_text(text, &style(HPos::Center), (at, units(layout.top - 9.0)))?;
                }
                Rule::Diagonal(text) => {
                    let at = (units(layout.left + 8.0), units(layout.top + 12.0));
                    area.draw_text(text, &style(HPos::Left), at)?;
                }
                Rule::Horizontal(..) | Rule::Vertical(..) => {}
            }
        }
        Ok(())
    }
}

/// Returns the corners of a line of steps through points.
fn steps(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let corners = points.windows(2).flat_map(|w| [w[0], (w[1].0, w[0].1)]);
    corners.chain(points.last().copied()).collect()
}
