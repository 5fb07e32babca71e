//! The view: the picture, its overlays, and the mouse on it.

use crate::scene::Facts;
use crate::state::{Shown, State};
use crate::work_map::CELLS;
use egui::{Align2, Color32, FontId, Key, Painter, PointerButton, Pos2, Rect, Sense, Stroke, Ui, Vec2, pos2};
use glam::Vec3;

/// Degrees per point of mouse movement.
const TURN: f32 = 0.35;

/// Speed of flight, bounding-sphere radii per second.
const SPEED: f32 = 0.7;

/// The edges of a box, by the indices of its corners.
const EDGES: [[usize; 2]; 12] =
    [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];

pub(super) fn show(ui: &mut Ui, state: &mut State) {
    let pixels = ui.pixels_per_point();
    let all = ui.available_rect_before_wrap();
    // Whole pixels, so that one ray is one pixel of the window.
    let whole = |v: f32| (v * pixels).round() / pixels;
    let rect = Rect::from_min_max(
        pos2(whole(all.min.x), whole(all.min.y)),
        pos2(whole(all.max.x), whole(all.max.y)),
    );
    let response = ui.allocate_rect(rect, Sense::click_and_drag());
    state.viewport = [rect.width(), rect.height()].map(|v| (v * pixels).round().max(1.0) as u32);
    mouse(ui, state, &response, rect);
    fly(ui, state);
    let painter = ui.painter_at(rect);
    if let Some(shown) = &state.picture {
        picture(&painter, rect, shown);
    }
    if state.picture.is_none() {
        let text = if state.loading.is_some() { "loading …" } else { "Open a volume, or drop a file here" };
        painter.text(rect.center(), Align2::CENTER_CENTER, text, FontId::proportional(18.0), Color32::GRAY);
    }
    let aspect = rect.width() / rect.height().max(1.0);
    let place = |point: Vec3| {
        let [x, y] = state.view.project(point, aspect)?;
        Some(pos2(rect.center().x + 0.5 * x * rect.width(), rect.center().y - 0.5 * y * rect.height()))
    };
    if let Some(facts) = &state.facts {
        if state.show_box {
            outline(&painter, facts, state, &place);
        }
        if state.show_axes {
            axes(&painter, facts, &place);
        }
        if state.show_probe {
            probe(&painter, facts, state, &place, rect);
        }
    }
    if state.show_work {
        work(&painter, state, rect);
    }
    caption(&painter, state, rect);
}

fn picture(painter: &Painter, rect: Rect, shown: &Shown) {
    let unit = Rect::from_min_max(Pos2::ZERO, pos2(1.0, 1.0));
    // The steered picture and the full-quality picture are both queued here. Once the application knows
    // whether it draws a new frame, it removes pictures that must not be shown (`aim` in app/frame.rs).
    painter.image(shown.steered, rect, unit, Color32::WHITE);
    let Some((full, [width, height], covered)) = shown.full else { return };
    for region in covered.into_iter().flatten() {
        let at = |x: u32, y: u32| pos2(x as f32 / width as f32, y as f32 / height as f32);
        let uv =
            Rect::from_min_max(at(region.x, region.y), at(region.x + region.width, region.y + region.height));
        let corner = |p: Pos2| rect.min + Vec2::new(p.x * rect.width(), p.y * rect.height());
        painter.image(full, Rect::from_min_max(corner(uv.min), corner(uv.max)), uv, Color32::WHITE);
    }
}

fn mouse(ui: &Ui, state: &mut State, response: &egui::Response, rect: Rect) {
    let shift = ui.input(|i| i.modifiers.shift);
    let moved = response.drag_delta();
    let pans = response.dragged_by(PointerButton::Middle)
        || response.dragged_by(PointerButton::Secondary)
        || (response.dragged_by(PointerButton::Primary) && shift);
    if moved != Vec2::ZERO && response.dragged() {
        if pans {
            state.view.pan(moved.x / rect.height(), moved.y / rect.height());
        } else if state.fly {
            state.view.look(-TURN * moved.x, -TURN * moved.y);
        } else {
            state.view.orbit(TURN * moved.x, TURN * moved.y);
        }
        state.changed.camera = true;
    }
    if response.hovered() {
        let (scroll, pinch) = ui.input(|i| (i.smooth_scroll_delta().y, i.zoom_delta()));
        let factor = (-0.0025 * scroll).exp() / pinch;
        if factor != 1.0 {
            state.view.zoom(factor);
            state.changed.camera = true;
        }
    }
    if response.double_clicked() {
        state.view.reset();
        state.changed.cut = true;
    }
}

/// Flies with W, A, S, D, Q, E while one of them is held.
fn fly(ui: &Ui, state: &mut State) {
    if !state.fly || ui.ctx().egui_wants_keyboard_input() {
        return;
    }
    let (held, seconds) = ui.input(|i| {
        let held = |key| f32::from(u8::from(i.key_down(key)));
        let forward = held(Key::W) - held(Key::S);
        let right = held(Key::D) - held(Key::A);
        ([forward, right, held(Key::E) - held(Key::Q)], i.stable_dt.min(0.1))
    });
    if held != [0.0; 3] {
        let [forward, right, up] = held.map(|h| h * SPEED * seconds);
        state.view.walk(forward, right, up);
        state.changed.camera = true;
        ui.ctx().request_repaint();
    }
}

fn corners(facts: &Facts, state: &State) -> [Vec3; 8] {
    let [low, high] = facts.corners(state.crop);
    std::array::from_fn(|i| {
        Vec3::from_array([0, 1, 2].map(|a| if i >> a & 1 == 0 { low[a] } else { high[a] }))
    })
}

fn outline(painter: &Painter, facts: &Facts, state: &State, place: &impl Fn(Vec3) -> Option<Pos2>) {
    let corners = corners(facts, state);
    let stroke = Stroke::new(1.0, Color32::from_white_alpha(70));
    for [a, b] in EDGES {
        if let (Some(a), Some(b)) = (place(corners[a]), place(corners[b])) {
            painter.line_segment([a, b], stroke);
        }
    }
}

fn axes(painter: &Painter, facts: &Facts, place: &impl Fn(Vec3) -> Option<Pos2>) {
    let origin = -facts.half_extent;
    let colors =
        [Color32::from_rgb(230, 90, 80), Color32::from_rgb(110, 200, 90), Color32::from_rgb(90, 140, 240)];
    for (axis, (name, color)) in ["x", "y", "z"].iter().zip(colors).enumerate() {
        let mut end = origin;
        end[axis] += 0.5 * facts.half_extent[axis];
        if let (Some(a), Some(b)) = (place(origin), place(end)) {
            painter.line_segment([a, b], Stroke::new(2.0, color));
            painter.text(b, Align2::LEFT_BOTTOM, name, FontId::proportional(13.0), color);
        }
    }
}

/// Draws the probe's rays as a grid over the rectangle around the volume.
fn probe(painter: &Painter, facts: &Facts, state: &State, place: &impl Fn(Vec3) -> Option<Pos2>, rect: Rect) {
    let Some((side, hits)) = state.probe else { return };
    let mut around = Rect::NOTHING;
    for corner in corners(facts, state) {
        match place(corner) {
            Some(at) => around.extend_with(at),
            // A corner is behind the eye: the rectangle is the whole image.
            None => around = rect,
        }
    }
    let around = around.intersect(rect);
    if side == 0 || !around.is_positive() {
        return;
    }
    let color = Color32::from_rgb(255, 220, 80);
    painter.rect_stroke(around, 0.0, Stroke::new(1.0, color), egui::StrokeKind::Middle);
    for i in 0..side * side {
        let (x, y) = ((i % side) as f32 + 0.5, (i / side) as f32 + 0.5);
        let at = around.min + Vec2::new(x * around.width(), y * around.height()) / side as f32;
        painter.circle_filled(at, 1.8, color);
    }
    let text = format!("{} probe rays, {hits} met the volume", side * side);
    // Above the rectangle, or within it where the view ends there.
    let [above, within] = [Vec2::new(0.0, -3.0), Vec2::new(3.0, 3.0)].map(|by| around.left_top() + by);
    let (at, align) =
        if above.y - 16.0 > rect.min.y { (above, Align2::LEFT_BOTTOM) } else { (within, Align2::LEFT_TOP) };
    note(painter, at, align, text, 12.0, color);
}

/// Draws the map of samples per ray.
fn work(painter: &Painter, state: &State, rect: Rect) {
    let Some(map) = &state.work else { return };
    let most = map.samples.iter().copied().fold(1.0, f32::max);
    let size = Vec2::new(rect.width() / CELLS[0] as f32, rect.height() / CELLS[1] as f32);
    for (i, samples) in map.samples.iter().enumerate().filter(|(_, s)| **s > 0.0) {
        let (x, y) = (i as u32 % CELLS[0], i as u32 / CELLS[0]);
        let cell = Rect::from_min_size(rect.min + Vec2::new(x as f32 * size.x, y as f32 * size.y), size);
        let share = samples / most;
        let color = Color32::from_rgba_unmultiplied(
            255,
            (255.0 * (1.0 - share)) as u8,
            40,
            (30.0 + 120.0 * share) as u8,
        );
        painter.rect_filled(cell, 0.0, color);
    }
    let text = format!("samples per ray at full quality; largest mean of a cell: {most:.0}");
    let at = rect.left_bottom() + Vec2::new(8.0, -26.0);
    note(painter, at, Align2::LEFT_BOTTOM, text, 12.0, Color32::WHITE);
}

/// Draws the line at the bottom of the picture: its time and resolution, or the expected time to full
/// quality.
fn caption(painter: &Painter, state: &State, rect: Rect) {
    let text = match (&state.rest, state.steer.history.back()) {
        (Some(rest), _) if rest.took.is_some() => {
            format!("full quality, drawn in {:.2} s", rest.took.unwrap_or_default())
        }
        (Some(rest), _) => {
            format!("refining: {:.1} s to full quality ({:.0} % done)", rest.remaining, 100.0 * rest.share)
        }
        (None, Some(last)) if state.picture.is_some() => format!(
            "{:.1} ms · step {:.2} · {:.1} pixels between rays",
            last.seconds * 1e3,
            last.step,
            last.image_sample_distance
        ),
        _ => return,
    };
    let at = rect.left_bottom() + Vec2::new(8.0, -8.0);
    note(painter, at, Align2::LEFT_BOTTOM, text, 13.0, Color32::from_gray(220));
    if state.fly {
        let at = rect.right_bottom() + Vec2::new(-8.0, -8.0);
        let text = "flying: W A S D Q E to move, drag to look around, F to stop".to_owned();
        note(painter, at, Align2::RIGHT_BOTTOM, text, 13.0, Color32::from_gray(220));
    }
}

/// Draws a text on a dark ground, since the picture below may have any color.
fn note(painter: &Painter, at: Pos2, align: Align2, text: String, size: f32, color: Color32) {
    let galley = painter.layout_no_wrap(text, FontId::proportional(size), color);
    let place = align.anchor_size(at, galley.size());
    painter.rect_filled(place.expand(2.0), 2.0, Color32::from_black_alpha(150));
    painter.galley(place.min, galley, color);
}
