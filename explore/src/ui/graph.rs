//! The graph: predicted times with their bounds, measured times, the target; the step below.

use crate::state::State;
use crate::steering::{GRAPH_FRAMES, words};
use egui::{Color32, Rangef, RichText, TextStyle, Ui, Vec2};
use egui_plot::{
    AxisHints, FilledArea, GridInput, GridMark, HLine, Line, LineStyle, Plot, PlotPoints, VLine,
};

const MEASURED_COLOR: Color32 = Color32::from_rgb(120, 200, 255);
const PREDICTED_COLOR: Color32 = Color32::from_rgb(255, 190, 90);
const TARGET_COLOR: Color32 = Color32::from_rgb(240, 90, 90);
const FULL_QUALITY_COLOR: Color32 = Color32::from_rgb(170, 130, 220);
const STEP: Color32 = Color32::from_rgb(150, 210, 130);
const DISTANCE: Color32 = Color32::from_rgb(220, 140, 200);

/// Half the height of a number at an axis, with some margin, in points.
const HALF_NUMBER: f32 = 7.0;

pub(super) fn show(ui: &mut Ui, state: &State) {
    let steer = &state.steer;
    let history = &steer.history;
    let title = steer.controllers[steer.controller].1;
    if let Some(last) = history.back() {
        ui.horizontal(|ui| {
            let full = if last.full.is_finite() {
                format!("At full quality this frame would take {:.0} ms.", last.full * 1e3)
            } else {
                String::new()
            };
            let text = format!("{} {full}", words(last, title));
            ui.add(egui::Label::new(RichText::new(&text).small()).truncate()).on_hover_text(&text);
        });
    } else {
        ui.weak("Frame times appear here once a volume is shown.");
    }
    legend(ui);
    let last = history.back().map_or(0.0, |r| r.number as f64);
    let first = (last - GRAPH_FRAMES as f64).max(0.0);
    let ms = |value: fn(&crate::steering::FrameRecord) -> f64| -> PlotPoints<'static> {
        history.iter().map(|r| [r.number as f64, value(r)]).filter(|p| p[1].is_finite()).collect()
    };
    let bounded: Vec<_> = history.iter().filter(|r| r.upper.is_finite() && r.predicted.is_finite()).collect();
    let xs: Vec<f64> = bounded.iter().map(|r| r.number as f64).collect();
    let low: Vec<f64> = bounded.iter().map(|r| r.predicted * 1e3).collect();
    let high: Vec<f64> = bounded.iter().map(|r| r.upper.max(r.predicted) * 1e3).collect();
    let target = steer.target * 1e3;
    let most = history.iter().map(|r| r.seconds * 1e3).fold(2.0 * target, f64::max);
    // The two plots fill the panel exactly. Otherwise the panel would change its height to that of its
    // content.
    let height = ui.available_height() - ui.spacing().item_spacing.y;
    let font = TextStyle::Small.resolve(ui.style());
    let plot = |id: &str, height: f32| {
        let axis = AxisHints::new_y()
            .min_thickness(34.0)
            .label_spacing(Rangef::new(12.0, 20.0))
            .tick_label_font(font.clone())
            .formatter(|mark, _| (mark.value as f32).to_string());
        Plot::new(id)
            .height(height)
            .allow_drag(false)
            .allow_zoom(false)
            .allow_scroll(false)
            .allow_boxed_zoom(false)
            .show_axes([false, true])
            .custom_y_axes(vec![axis])
            .y_grid_spacer(marks)
            .set_margin_fraction(Vec2::new(0.0, 0.02))
            .default_x_bounds(first, first + GRAPH_FRAMES as f64)
            .auto_bounds([false, false])
    };
    let switches: Vec<f64> = history.iter().filter(|r| r.switched).map(|r| r.number as f64).collect();
    let mark = |x: f64| {
        VLine::new("switch", x)
            .color(Color32::from_white_alpha(60))
            .style(LineStyle::Dashed { length: 4.0 })
            .allow_hover(false)
    };
    // The range begins below 0 and ends above the largest value, so that the numbers at the ends of the axis
    // are inside of the plot.
    let range = |top: f64, height: f32| {
        let share = f64::from(HALF_NUMBER / height.max(4.0 * HALF_NUMBER));
        -top * share / (1.0 - 2.0 * share)..=top * (1.0 - share) / (1.0 - 2.0 * share)
    };
    plot("times", 0.7 * height).show(ui, |plot| {
        plot.set_plot_bounds_x(first..=first + GRAPH_FRAMES as f64);
        plot.set_plot_bounds_y(range(most.min(4.0 * target), 0.7 * height));
        if xs.len() > 1 {
            let band = FilledArea::new("predicted to bound", &xs, &low, &high);
            plot.add(band.fill_color(PREDICTED_COLOR.gamma_multiply(0.18)));
        }
        switches.iter().for_each(|x| plot.vline(mark(*x)));
        plot.line(Line::new("full quality, ms", ms(|r| r.full * 1e3)).color(FULL_QUALITY_COLOR).width(1.0));
        plot.line(Line::new("predicted, ms", ms(|r| r.predicted * 1e3)).color(PREDICTED_COLOR).width(1.2));
        plot.line(Line::new("measured, ms", ms(|r| r.seconds * 1e3)).color(MEASURED_COLOR).width(1.5));
        plot.hline(HLine::new("target", target).color(TARGET_COLOR));
    });
    plot("steps", 0.3 * height).show(ui, |plot| {
        let most = history.iter().map(|r| f64::from(r.step.max(r.image_sample_distance))).fold(2.0, f64::max);
        plot.set_plot_bounds_x(first..=first + GRAPH_FRAMES as f64);
        plot.set_plot_bounds_y(range(most, 0.3 * height));
        switches.iter().for_each(|x| plot.vline(mark(*x)));
        plot.line(Line::new("step", ms(|r| f64::from(r.step))).color(STEP).width(1.5));
        plot.line(
            Line::new("pixels between rays", ms(|r| f64::from(r.image_sample_distance)))
                .color(DISTANCE)
                .width(1.0),
        );
    });
}

/// The names of the curves in their colors, above the plots: a legend within a plot would cover its curves.
fn legend(ui: &mut Ui) {
    ui.horizontal_wrapped(|ui| {
        let mut name = |color: Color32, text: &str| ui.label(RichText::new(text).small().color(color));
        name(Color32::GRAY, "Times in ms:");
        name(MEASURED_COLOR, "measured");
        name(PREDICTED_COLOR, "predicted, shaded up to the upper bound");
        name(FULL_QUALITY_COLOR, "full quality");
        name(TARGET_COLOR, "target");
        name(Color32::GRAY, "Below:");
        name(STEP, "step");
        name(DISTANCE, "pixels between rays");
        name(Color32::GRAY, "Dashed: camera or transfer function changed abruptly");
    });
}

/// The marks of an axis from 0 on: multiples of 1, 2 or 5 times a power of ten, at least 16 points apart.
fn marks(input: GridInput) -> Vec<GridMark> {
    // The given step takes 8 points.
    let least = 2.0 * input.base_step_size;
    let power = 10f64.powf(least.log10().floor());
    let steps = [power, 2.0 * power, 5.0 * power];
    let step_size = steps.into_iter().find(|step| *step >= least).unwrap_or(10.0 * power);
    let values = (0..100).map(|i| f64::from(i) * step_size);
    values.take_while(|v| *v <= input.bounds.1).map(|value| GridMark { value, step_size }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_axis_of_any_range_has_numbers() {
        for (top, points, expected) in [
            (66.0, 125.0, vec![0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0]),
            (160.0, 125.0, vec![0.0, 50.0, 100.0, 150.0]),
            (2.0, 54.0, vec![0.0, 1.0, 2.0]),
            (16.0, 54.0, vec![0.0, 5.0, 10.0, 15.0]),
            (23.0, 46.0, vec![0.0, 10.0, 20.0]),
        ] {
            let marks = marks(GridInput { bounds: (0.0, top), base_step_size: 8.0 * top / points });
            assert_eq!(marks.iter().map(|m| m.value).collect::<Vec<_>>(), expected, "up to {top}");
        }
    }
}
