//! The interface: the view, the panels beside it, the graph below.

mod editor;
mod graph;
mod panels;
mod view;

use crate::state::State;
use egui::{Align, CentralPanel, Frame, Layout, Panel, ScrollArea, Ui};

/// Lays out the whole interface once.
pub(crate) fn show(ui: &mut Ui, state: &mut State) {
    keys(ui, state);
    Panel::top("bar").show(ui, |ui| bar(ui, state));
    Panel::bottom("graph").resizable(true).default_size(210.0).min_size(120.0).show(ui, |ui| {
        graph::show(ui, state);
    });
    Panel::right("side").resizable(true).default_size(340.0).min_size(260.0).show(ui, |ui| {
        ScrollArea::vertical().auto_shrink([false, false]).show(ui, |ui| {
            editor::show(ui, state);
            ui.separator();
            panels::show(ui, state);
        });
    });
    CentralPanel::default().frame(Frame::NONE).show(ui, |ui| view::show(ui, state));
}

/// The bar at the top: current volume, running work, last message.
fn bar(ui: &mut Ui, state: &mut State) {
    use crate::state::Command;
    ui.horizontal(|ui| {
        ui.menu_button("Open", |ui| {
            ui.label("A volume file (or drop one on the window):");
            ui.text_edit_singleline(&mut state.texts.open);
            if ui.button("Open").clicked() && !state.texts.open.trim().is_empty() {
                state.commands.push(Command::Open(state.texts.open.trim().into()));
                ui.close();
            }
            if !state.recent.paths.is_empty() {
                ui.separator();
                ui.weak("Recent files");
            }
            for path in state.recent.paths.clone() {
                if ui.button(path.display().to_string()).clicked() {
                    state.commands.push(Command::Open(path));
                    ui.close();
                }
            }
        });
        let undo = ui.add_enabled(state.edited.can_undo(), egui::Button::new("Undo"));
        state.changed.transfer |= undo.clicked() && state.edited.undo();
        let redo = ui.add_enabled(state.edited.can_redo(), egui::Button::new("Redo"));
        state.changed.transfer |= redo.clicked() && state.edited.redo();
        ui.separator();
        if let Some((file, stage, share)) = &state.loading {
            let bar = egui::ProgressBar::new(*share).desired_width(90.0);
            ui.add(bar);
            ui.label(format!("{file}: {stage}"));
            if ui.button("Cancel").clicked() {
                state.commands.push(Command::Cancel);
            }
        } else if let (Some(path), Some(facts)) = (&state.path, &state.facts) {
            let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
            let [x, y, z] = facts.dims;
            ui.label(format!("{name} · {x} × {y} × {z} {}", facts.kind));
        } else {
            ui.weak("no volume; open one, or drop a file here");
        }
        ui.with_layout(Layout::right_to_left(Align::Center), |ui| {
            if let Some((text, wrong)) = &state.said {
                let color = if *wrong { ui.visuals().error_fg_color } else { ui.visuals().weak_text_color() };
                ui.add(egui::Label::new(egui::RichText::new(text).color(color)).truncate())
                    .on_hover_text(text.as_str());
            }
        });
    });
}

/// Keys that work everywhere except in text input.
fn keys(ui: &Ui, state: &mut State) {
    use crate::camera::Axis;
    use crate::script::Shot;
    use crate::state::Command;
    use egui::{Key, Modifiers};
    if ui.ctx().egui_wants_keyboard_input() {
        return;
    }
    let pressed = |key| ui.input_mut(|i| i.consume_key(Modifiers::NONE, key));
    let with_command = |key| ui.input_mut(|i| i.consume_key(Modifiers::COMMAND, key));
    // A slow frame may contain several presses of a key.
    let times = |modifiers, key| ui.input_mut(|i| i.count_and_consume_key(modifiers, key));
    for _ in 0..times(Modifiers::COMMAND | Modifiers::SHIFT, Key::Z) + times(Modifiers::COMMAND, Key::Y) {
        state.changed.transfer |= state.edited.redo();
    }
    for _ in 0..times(Modifiers::COMMAND, Key::Z) {
        state.changed.transfer |= state.edited.undo();
    }
    if with_command(Key::Q) {
        state.quit = true;
    }
    if with_command(Key::P) {
        let file = state.texts.screenshot.trim().into();
        state.commands.push(Command::Screenshot(Shot { file, size: state.screenshot_size }));
    }
    // As in modeling programs: 1, 2, 3 look from the front, the right and the top, with Ctrl from the
    // opposite side.
    let axes = [Key::Num1, Key::Num2, Key::Num3].into_iter().cycle().zip(Axis::ALL);
    for (i, (key, axis)) in axes.enumerate() {
        if if i < 3 { pressed(key) } else { with_command(key) } {
            state.view.look_along(axis);
            state.changed.cut = true;
        }
    }
    if pressed(Key::Num5) {
        state.view.orthographic = !state.view.orthographic;
        state.changed.cut = true;
    }
    if pressed(Key::R) {
        state.view.reset();
        state.changed.cut = true;
    }
    if pressed(Key::F) {
        state.fly = !state.fly;
    }
    if pressed(Key::Space) && state.series.len() > 1 {
        state.playing = !state.playing;
    }
}
