//! The graph: predicted times with their bounds, measured times, the target; the step below.

use crate::state::State;
use crate::steering::{REMEMBERED, words};
use egui::{Color32, Ui, Vec2};
use egui_plot::{FilledArea, HLine, Legend, Line, LineStyle, Plot, PlotPoints, VLine};

const MEASURED: Color32 = Color32::from_rgb(120, 200, 255);
const PREDICTED: Color32 = Color32::from_rgb(255, 190, 90);
const TARGET: Color32 = Color32::from_rgb(240, 90, 90);
const FULL: Color32 = Color32::from_rgb(170, 130, 220);
const STEP: Color32 = Color32::from_rgb(150, 210, 130);

pub(super) fn show(ui: &mut Ui, state: &State) {
    let steer = &state.steer;
    let history = &steer.history;
    let title = steer.controllers[steer.controller].1;
    if let Some(last) = history.back() {
        ui.horizontal(|ui| {
            let full = match steer.full {
                Some((seconds, _)) => {
                    format!("At full quality this frame would take {:.0} ms.", seconds * 1e3)
                }
                None => String::new(),
            };
            let text = format!("{} {full}", words(last, title));
            ui.add(egui::Label::new(egui::RichText::new(&text).small()).truncate()).on_hover_text(&text);
        });
    } else {
        ui.weak("Frame times appear here once a volume is shown.");
    }
    let last = history.back().map_or(0.0, |r| r.number as f64);
    let first = (last - REMEMBERED as f64).max(0.0);
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
    let plot = |id: &str, height: f32| {
        Plot::new(id)
            .height(height)
            .allow_drag(false)
            .allow_zoom(false)
            .allow_scroll(false)
            .allow_boxed_zoom(false)
            .show_axes([false, true])
            .y_axis_min_width(34.0)
            .set_margin_fraction(Vec2::new(0.0, 0.02))
            .default_x_bounds(first, first + REMEMBERED as f64)
            .auto_bounds([false, false])
    };
    let switches: Vec<f64> = history.iter().filter(|r| r.switched).map(|r| r.number as f64).collect();
    let mark = |x: f64| {
        VLine::new("switch", x)
            .color(Color32::from_white_alpha(60))
            .style(LineStyle::Dashed { length: 4.0 })
            .allow_hover(false)
    };
    plot("times", 0.7 * height).legend(Legend::default().text_style(egui::TextStyle::Small)).show(
        ui,
        |plot| {
            plot.set_plot_bounds_x(first..=first + REMEMBERED as f64);
            plot.set_plot_bounds_y(0.0..=most.min(4.0 * target));
            if xs.len() > 1 {
                let band = FilledArea::new("predicted to bound", &xs, &low, &high);
                plot.add(band.fill_color(PREDICTED.gamma_multiply(0.18)));
            }
            switches.iter().for_each(|x| plot.vline(mark(*x)));
            plot.line(Line::new("full quality, ms", ms(|r| r.full * 1e3)).color(FULL).width(1.0));
            plot.line(Line::new("predicted, ms", ms(|r| r.predicted * 1e3)).color(PREDICTED).width(1.2));
            plot.line(Line::new("measured, ms", ms(|r| r.seconds * 1e3)).color(MEASURED).width(1.5));
            plot.hline(HLine::new("target", target).color(TARGET));
        },
    );
    plot("steps", 0.3 * height).show(ui, |plot| {
        let most = history.iter().map(|r| f64::from(r.step)).fold(2.0, f64::max);
        plot.set_plot_bounds_x(first..=first + REMEMBERED as f64);
        plot.set_plot_bounds_y(0.0..=1.05 * most);
        switches.iter().for_each(|x| plot.vline(mark(*x)));
        plot.line(Line::new("step", ms(|r| f64::from(r.step))).color(STEP).width(1.5));
        plot.line(
            Line::new("pixels between rays", ms(|r| f64::from(r.image_sample_distance)))
                .color(MEASURED.gamma_multiply(0.6))
                .width(1.0),
        );
    });
}
