//! The transfer function: opacity over the volume's histogram, and below it colors, numbers and presets.

use crate::state::{Command, Handle, State};
use crate::transfer::{COLOR_MAPS, Opacity, PRESETS};
use egui::{
    Color32, ComboBox, DragValue, Mesh, PointerButton, Pos2, Rect, Sense, Shape, Stroke, Ui, Vec2, pos2,
};
use entire_core::GaussianLobe;

/// Distance in points below which the mouse catches a handle.
const REACH: f32 = 9.0;

/// Maximum number of points or lobes in the editor.
const MAX_POINTS: usize = 64;

pub(super) fn show(ui: &mut Ui, state: &mut State) {
    ui.horizontal(|ui| {
        ui.strong("Transfer function");
        let lobes = state.edited.curve.lobes().is_some();
        if ui.selectable_label(!lobes, "points").clicked() && lobes {
            let curve = state.edited.curve.to_points();
            state.replace(curve);
        }
        if ui.selectable_label(lobes, "lobes").clicked() && !lobes {
            let center = state.histogram.as_ref().map_or(0.5, |h| h.quantile(0.8));
            let lobe = GaussianLobe { center, width: 0.004, height: 0.3 };
            let mut curve = state.edited.curve.clone();
            curve.opacity = Opacity::Lobes(vec![lobe]);
            state.replace(curve);
        }
        ui.checkbox(&mut state.fine, "fine near 0")
            .on_hover_text("Draws the cube root of the opacity, so that low opacities can be seen");
    });
    curve(ui, state);
    colors(ui, state);
    numbers(ui, state);
    ui.horizontal_wrapped(|ui| {
        ui.weak("Presets");
        for name in PRESETS {
            if ui.small_button(name).clicked() && !state.preset(name) {
                state.say("presets depend on the volume's values; open a volume first");
            }
        }
    });
    ui.horizontal(|ui| {
        ComboBox::from_id_salt("color map").selected_text("Color map").width(120.0).show_ui(ui, |ui| {
            for (name, colors) in COLOR_MAPS {
                if ui.selectable_label(state.edited.curve.colors == colors, name).clicked() {
                    let mut curve = state.edited.curve.clone();
                    curve.colors = colors.to_vec();
                    state.replace(curve);
                }
            }
        });
    });
    ui.horizontal(|ui| {
        ui.add(egui::TextEdit::singleline(&mut state.texts.transfer).desired_width(130.0));
        let file = || state.texts.transfer.trim().into();
        if ui.button("Load").on_hover_text("A JSON file saved here, or a ParaView preset").clicked() {
            state.commands.push(Command::LoadTransfer(file()));
        }
        if ui.button("Save").clicked() {
            state.commands.push(Command::SaveTransfer { file: file(), paraview: false });
        }
        if ui.button("for ParaView").clicked() {
            state.commands.push(Command::SaveTransfer { file: file(), paraview: true });
        }
    });
}

/// Mapping between values and screen positions.
#[derive(Clone, Copy)]
struct Axes {
    rect: Rect,
    fine: bool,
}

impl Axes {
    fn place(&self, s: f32, opacity: f32) -> Pos2 {
        let y = if self.fine { opacity.max(0.0).cbrt() } else { opacity };
        pos2(self.rect.min.x + s * self.rect.width(), self.rect.max.y - y * self.rect.height())
    }

    fn value(&self, at: Pos2) -> [f32; 2] {
        let s = ((at.x - self.rect.min.x) / self.rect.width()).clamp(0.0, 1.0);
        let y = ((self.rect.max.y - at.y) / self.rect.height()).clamp(0.0, 1.0);
        [s, if self.fine { y * y * y } else { y }]
    }
}

/// The curve with its handles over the histogram.
fn curve(ui: &mut Ui, state: &mut State) {
    let size = Vec2::new(ui.available_width(), 130.0);
    let (response, painter) = ui.allocate_painter(size, Sense::click_and_drag());
    let rect = response.rect;
    let axes = Axes { rect: rect.shrink(4.0), fine: state.fine };
    painter.rect_filled(rect, 2.0, Color32::from_gray(18));
    if let Some(histogram) = &state.histogram {
        let heights = histogram.heights();
        let width = axes.rect.width() / heights.len() as f32;
        // All bars of the histogram are one mesh.
        let mut bars = Mesh::default();
        for (i, h) in heights.iter().enumerate().filter(|(_, h)| **h > 0.0) {
            let x = axes.rect.min.x + i as f32 * width;
            let bar = Rect::from_min_max(
                pos2(x, axes.rect.max.y - h * axes.rect.height()),
                pos2(x + width, axes.rect.max.y),
            );
            bars.add_colored_rect(bar, Color32::from_gray(58));
        }
        painter.add(Shape::mesh(bars));
    }
    let line = (0..=160).map(|i| {
        let s = i as f32 / 160.0;
        axes.place(s, state.edited.curve.opacity_at(s))
    });
    painter.add(Shape::line(line.collect(), Stroke::new(1.5, Color32::WHITE)));
    let handles = handles(state, axes);
    edit(ui, state, &response, axes, &handles);
    for (handle, at) in &handles {
        let selected = state.selected == Some(*handle);
        let color = if selected { Color32::from_rgb(255, 200, 80) } else { Color32::from_gray(220) };
        let radius = if matches!(handle, Handle::Width(_)) { 3.0 } else { 4.5 };
        painter.circle(*at, radius, color, Stroke::new(1.0, Color32::BLACK));
    }
    response.on_hover_text_at_pointer(
        "Drag moves a handle, double-click adds a handle, right-click removes a handle. Type numbers below.",
    );
}

fn handles(state: &State, axes: Axes) -> Vec<(Handle, Pos2)> {
    match &state.edited.curve.opacity {
        Opacity::Points(points) => {
            points.iter().enumerate().map(|(i, p)| (Handle::Point(i), axes.place(p[0], p[1]))).collect()
        }
        Opacity::Lobes(lobes) => lobes
            .iter()
            .enumerate()
            .flat_map(|(i, l)| {
                // The handle of the width is to the right of the center. If the right side is beyond the
                // curve's end, the handle is to the left.
                let half = l.width.sqrt();
                let side =
                    if l.center + half <= 1.001 { l.center + half } else { (l.center - half).max(0.0) };
                [
                    (Handle::Lobe(i), axes.place(l.center, l.height.min(1.0))),
                    (Handle::Width(i), axes.place(side, (l.height / std::f32::consts::E).min(1.0))),
                ]
            })
            .collect(),
    }
}

/// Edits the curve with the mouse.
fn edit(ui: &Ui, state: &mut State, response: &egui::Response, axes: Axes, handles: &[(Handle, Pos2)]) {
    let near = |at: Pos2| {
        handles
            .iter()
            .map(|(handle, place)| (*handle, place.distance(at)))
            .filter(|(_, distance)| *distance < REACH)
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .map(|(handle, _)| handle)
    };
    let Some(at) = response.interact_pointer_pos().or_else(|| response.hover_pos()) else {
        state.dragged = None;
        return;
    };
    let begun = response.drag_started_by(PointerButton::Primary);
    if begun {
        let origin = ui.input(|i| i.pointer.press_origin()).unwrap_or(at);
        state.dragged = near(origin);
        state.selected = state.dragged.or(state.selected);
    }
    if let (Some(handle), true) = (state.dragged, response.dragged_by(PointerButton::Primary)) {
        move_handle(&mut state.edited.curve.opacity, handle, axes.value(at));
        state.changed.transfer = true;
    }
    if response.drag_stopped() {
        state.dragged = None;
        state.edited.settle();
    }
    if response.clicked() {
        state.selected = near(at);
    }
    if response.double_clicked() && near(at).is_none() {
        let [s, opacity] = axes.value(at);
        match &mut state.edited.curve.opacity {
            Opacity::Points(points) if points.len() < MAX_POINTS => {
                let place = points.partition_point(|p| p[0] < s);
                points.insert(place, [s, opacity]);
                state.selected = Some(Handle::Point(place));
            }
            Opacity::Lobes(lobes) if lobes.len() < MAX_POINTS => {
                lobes.push(GaussianLobe { center: s, width: 0.002, height: opacity });
                state.selected = Some(Handle::Lobe(lobes.len() - 1));
            }
            _ => {}
        }
        state.edited.settle();
        state.changed.transfer = true;
        state.changed.replaced = true;
    }
    if response.secondary_clicked()
        && let Some(handle) = near(at)
    {
        remove(state, handle);
    }
}

fn remove(state: &mut State, handle: Handle) {
    match (&mut state.edited.curve.opacity, handle) {
        (Opacity::Points(points), Handle::Point(i)) if points.len() > 1 => {
            points.remove(i);
        }
        (Opacity::Lobes(lobes), Handle::Lobe(i) | Handle::Width(i)) => {
            lobes.remove(i);
        }
        _ => return,
    }
    state.selected = None;
    state.edited.settle();
    state.changed.transfer = true;
    state.changed.replaced = true;
}

/// Moves a handle; a point stays between its neighbors.
fn move_handle(opacity: &mut Opacity, handle: Handle, [s, y]: [f32; 2]) {
    match (opacity, handle) {
        (Opacity::Points(points), Handle::Point(i)) if i < points.len() => {
            let low = if i > 0 { points[i - 1][0] } else { 0.0 };
            let high = points.get(i + 1).map_or(1.0, |p| p[0]);
            points[i] = [s.clamp(low, high), y];
        }
        (Opacity::Lobes(lobes), Handle::Lobe(i)) if i < lobes.len() => {
            lobes[i].center = s;
            lobes[i].height = y;
        }
        (Opacity::Lobes(lobes), Handle::Width(i)) if i < lobes.len() => {
            let half = (s - lobes[i].center).abs().max(0.003);
            lobes[i].width = half * half;
        }
        _ => {}
    }
}

/// The color bar.
fn colors(ui: &mut Ui, state: &State) {
    let (response, painter) = ui.allocate_painter(Vec2::new(ui.available_width(), 12.0), Sense::hover());
    let rect = response.rect.shrink2(Vec2::new(4.0, 1.0));
    let mut mesh = Mesh::default();
    const PARTS: u32 = 64;
    for i in 0..=PARTS {
        let s = i as f32 / PARTS as f32;
        let [r, g, b] = state.edited.curve.color_at(s).map(|c| (c * 255.0 + 0.5) as u8);
        let x = rect.min.x + s * rect.width();
        mesh.colored_vertex(pos2(x, rect.min.y), Color32::from_rgb(r, g, b));
        mesh.colored_vertex(pos2(x, rect.max.y), Color32::from_rgb(r, g, b));
        if i > 0 {
            let n = 2 * i;
            mesh.add_triangle(n - 2, n - 1, n);
            mesh.add_triangle(n - 1, n, n + 1);
        }
    }
    painter.add(Shape::mesh(mesh));
}

/// The selected handle's numbers, in the volume's scalars. Only numbers that the user edits are written back.
fn numbers(ui: &mut Ui, state: &mut State) {
    let (low, high) = state.facts.as_ref().map_or((0.0, 1.0), |f| f.range);
    let width = (high - low).max(f32::MIN_POSITIVE);
    let Some(handle) = state.selected else {
        ui.weak("no handle is selected");
        return;
    };
    let mut changed = false;
    let mut done = false;
    let mut number =
        |ui: &mut Ui, label: &str, value: &mut f32, range: std::ops::RangeInclusive<f32>, speed: f32| {
            ui.label(label);
            let value = DragValue::new(value).range(range).clamp_existing_to_range(false);
            // Volumes of small values need more decimals than opacities.
            let decimals = ((2.0 - speed.log10()) as usize).max(6);
            let response = ui.add(value.speed(speed).max_decimals(decimals));
            changed |= response.changed();
            done |= response.drag_stopped() || response.lost_focus();
            response.changed()
        };
    ui.horizontal_wrapped(|ui| match (&mut state.edited.curve.opacity, handle) {
        (Opacity::Points(points), Handle::Point(i)) if i < points.len() => {
            let before = if i > 0 { points[i - 1][0] } else { 0.0 };
            let after = points.get(i + 1).map_or(1.0, |p| p[0]);
            let mut scalar = low + points[i][0] * width;
            let range = low + before * width..=low + after * width;
            if number(ui, "scalar", &mut scalar, range, 0.002 * width) {
                points[i][0] = ((scalar - low) / width).clamp(before, after);
            }
            number(ui, "opacity", &mut points[i][1], 0.0..=1.0, 0.001);
        }
        (Opacity::Lobes(lobes), Handle::Lobe(i) | Handle::Width(i)) if i < lobes.len() => {
            let mut scalar = low + lobes[i].center * width;
            if number(ui, "center", &mut scalar, low..=high, 0.002 * width) {
                lobes[i].center = (scalar - low) / width;
            }
            let mut half = lobes[i].width.sqrt() * width;
            if number(ui, "half width", &mut half, 0.001 * width..=width, 0.001 * width) {
                lobes[i].width = (half / width).powi(2);
            }
            number(ui, "height", &mut lobes[i].height, 0.0..=1.0, 0.001);
        }
        _ => {}
    });
    if changed {
        state.changed.transfer = true;
    }
    if done {
        state.edited.settle();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Facts;
    use crate::state::Changed;
    use crate::transfer::Edited;
    use entire_core::scene::{Scalars, VolumeOptions, VolumeView};

    #[test]
    fn showing_numbers_changes_none() {
        let mut state = State::empty(0.03);
        // f32 rounds scalars of this range to a sixteenth.
        let range = Some((1e6, 1e6 + 10.0));
        let options = VolumeOptions { range, ..VolumeOptions::default() };
        let view = VolumeView::with(Scalars::F32(&[1e6; 8]), [2; 3], options).unwrap();
        state.facts = Some(Facts::of(&view));
        let lobe = GaussianLobe { center: 0.333, width: 1e-7, height: 1.5 };
        let points = Opacity::Points(vec![[0.1, 0.2], [0.333, 0.7]]);
        for (opacity, handle) in [(Opacity::Lobes(vec![lobe]), Handle::Lobe(0)), (points, Handle::Point(1))] {
            let mut curve = state.edited.curve.clone();
            curve.opacity = opacity;
            state.edited = Edited::new(curve);
            state.selected = Some(handle);
            state.changed = Changed::default();
            let shown =
                egui::Context::default().run_ui(egui::RawInput::default(), |ui| numbers(ui, &mut state));
            shown.drop_without_applying_deltas();
            assert!(!state.edited.can_undo() && !state.changed.any(), "{:?}", state.edited.curve);
        }
    }

    #[test]
    fn numbers_of_small_scalars_are_shown() {
        let mut state = State::empty(0.03);
        let options = VolumeOptions { range: Some((0.0, 1e-7)), ..VolumeOptions::default() };
        let view = VolumeView::with(Scalars::F32(&[1e-8; 8]), [2; 3], options).unwrap();
        state.facts = Some(Facts::of(&view));
        let mut curve = state.edited.curve.clone();
        curve.opacity = Opacity::Points(vec![[0.5, 0.2]]);
        state.edited = Edited::new(curve);
        state.selected = Some(Handle::Point(0));
        let shown = egui::Context::default().run_ui(egui::RawInput::default(), |ui| numbers(ui, &mut state));
        let texts: Vec<String> = shown
            .shapes
            .iter()
            .filter_map(|s| match &s.shape {
                Shape::Text(text) => Some(text.galley.text().to_owned()),
                _ => None,
            })
            .collect();
        shown.drop_without_applying_deltas();
        let close = |text: &String| text.parse::<f32>().is_ok_and(|v| (v - 5e-8).abs() < 1e-9);
        assert!(texts.iter().any(close), "{texts:?}");
    }

    #[test]
    fn places_and_values_are_inverse_and_fine_near_zero() {
        let rect = Rect::from_min_max(pos2(10.0, 20.0), pos2(210.0, 120.0));
        for fine in [false, true] {
            let axes = Axes { rect, fine };
            for (s, o) in [(0.0, 0.0), (0.3, 0.001), (0.7, 0.5), (1.0, 1.0)] {
                let [s2, o2] = axes.value(axes.place(s, o));
                assert!((s - s2).abs() < 1e-5 && (o - o2).abs() < 1e-5);
            }
        }
        // Opacity 0.001 is drawn at a tenth of the height.
        let fine = Axes { rect, fine: true };
        assert!((fine.place(0.0, 0.001).y - 110.0).abs() < 1e-3);
    }

    #[test]
    fn handles_of_widths_are_within_the_editor() {
        let mut state = State::empty(0.03);
        let rect = Rect::from_min_max(pos2(10.0, 20.0), pos2(210.0, 120.0));
        for (center, half, at) in [(0.3, 0.1, 90.0), (0.98, 0.08, 190.0), (0.6, 0.7, 10.0)] {
            let lobe = GaussianLobe { center, width: half * half, height: 0.5 };
            state.edited.curve.opacity = Opacity::Lobes(vec![lobe]);
            let handles = handles(&state, Axes { rect, fine: false });
            let (_, place) = handles.iter().find(|(h, _)| *h == Handle::Width(0)).unwrap();
            assert!((place.x - at).abs() < 1e-3, "{center} {half}: {place}");
        }
    }

    #[test]
    fn points_stay_between_their_neighbors() {
        let mut opacity = Opacity::Points(vec![[0.0, 0.0], [0.5, 0.5], [0.8, 1.0]]);
        move_handle(&mut opacity, Handle::Point(1), [0.95, 0.2]);
        assert_eq!(opacity, Opacity::Points(vec![[0.0, 0.0], [0.8, 0.2], [0.8, 1.0]]));
        let mut opacity = Opacity::Lobes(vec![GaussianLobe { center: 0.5, width: 0.01, height: 0.3 }]);
        move_handle(&mut opacity, Handle::Width(0), [0.7, 0.0]);
        let Opacity::Lobes(lobes) = opacity else { panic!("lobes stay lobes") };
        assert!((lobes[0].width - 0.04).abs() < 1e-6);
    }
}
