//! The panels beside the view: steering, modes, camera, part, series, files.

use crate::camera::{Axis, DISTANCES};
use crate::recording::Recorder;
use crate::script::Shot;
use crate::state::{Command, State};
use egui::{CollapsingHeader, ComboBox, DragValue, Slider, SliderClamping, Ui};
use entire_core::scene::{Shading, Skipping};

pub(super) fn show(ui: &mut Ui, state: &mut State) {
    steering(ui, state);
    modes(ui, state);
    CollapsingHeader::new("Camera").show(ui, |ui| camera(ui, state));
    CollapsingHeader::new("Part of the volume").show(ui, |ui| part(ui, state));
    if state.series.len() > 1 {
        CollapsingHeader::new("Time series").default_open(true).show(ui, |ui| series(ui, state));
    }
    CollapsingHeader::new("Pictures and recordings").show(ui, |ui| files(ui, state));
    CollapsingHeader::new("About this volume and machine").show(ui, |ui| about(ui, state));
}

fn steering(ui: &mut Ui, state: &mut State) {
    ui.strong("Frame time");
    let steer = &mut state.steer;
    let mut ms = steer.target * 1e3;
    // `--target` and scripts may set a target beyond the slider's ends, which is shown as it is.
    let slider = Slider::new(&mut ms, 2.0..=500.0).logarithmic(true).clamping(SliderClamping::Edits);
    let slider = slider.suffix(" ms").text("target");
    if ui.add(slider).changed() {
        steer.target = ms / 1e3;
        state.changed.settings = true;
    }
    ui.horizontal(|ui| {
        state.changed.settings |= ui.checkbox(&mut steer.enabled, "steering").changed();
        let titles: Vec<&str> = steer.controllers.iter().map(|c| c.1).collect();
        ComboBox::from_id_salt("controller").selected_text(titles[steer.controller]).show_ui(ui, |ui| {
            for (i, title) in titles.iter().enumerate() {
                if ui.selectable_label(steer.controller == i, *title).clicked() {
                    steer.controller = i;
                    state.changed.settings = true;
                }
            }
        });
    });
    ui.horizontal_wrapped(|ui| {
        ui.label("coarsest step");
        let step = DragValue::new(&mut steer.coarsest).range(1.0..=64.0).speed(0.1).max_decimals(1);
        state.changed.settings |= ui.add(step).changed();
        ui.label("and");
        let distance = DragValue::new(&mut steer.distance).range(1.0..=16.0).speed(0.1).max_decimals(1);
        state.changed.settings |= ui.add(distance).changed();
        ui.label("px between rays");
    });
    if let Some((seconds, upper)) = steer.full {
        // Before the first measured times, the bound may be hundreds of times the expected time.
        let bound = if upper > 10.0 * seconds {
            ", no useful upper bound yet".to_owned()
        } else if upper.is_finite() {
            format!(", upper bound {:.0} ms", upper * 1e3)
        } else {
            String::new()
        };
        ui.label(format!("ray casting at full quality: {:.0} ms expected{bound}", seconds * 1e3));
    }
    ui.weak(&state.predictor);
    ui.horizontal(|ui| {
        let discards = "Discards what all controllers have learned from measured frame times";
        if ui.button("Forget").on_hover_text(discards).clicked() {
            state.commands.push(Command::Forget);
        }
        let copy = ui.button("Calibrate …").on_hover_text(
            "Copies two commands to the clipboard. The first calibrates this machine by wall time, as the \
             window measures it; the second opens the volume again with the new model",
        );
        if copy.clicked() && state.calibration.is_empty() {
            state.said =
                Some(("the commands contain the name of a volume; open a volume first".into(), false));
        } else if copy.clicked() {
            ui.ctx().copy_text(state.calibration.clone());
            state.said = Some((format!("copied: {}", state.calibration), false));
        }
    });
    ui.separator();
}

fn modes(ui: &mut Ui, state: &mut State) {
    ui.horizontal(|ui| {
        ui.label("shading");
        for mode in Shading::ALL {
            state.changed.settings |=
                ui.selectable_value(&mut state.shading, mode, mode.to_string()).clicked();
        }
    });
    ui.horizontal(|ui| {
        ui.label("skipping");
        for mode in Skipping::ALL {
            state.changed.settings |=
                ui.selectable_value(&mut state.skipping, mode, mode.to_string()).clicked();
        }
    });
    ui.horizontal(|ui| {
        ui.checkbox(&mut state.show_box, "box");
        ui.checkbox(&mut state.show_axes, "axes");
        ui.checkbox(&mut state.show_probe, "probe")
            .on_hover_text("Shows the probe rays, which estimate the frame's work for the prediction");
        ui.checkbox(&mut state.show_work, "work")
            .on_hover_text("Samples per ray of this view, counted by the raycaster");
    });
    ui.separator();
}

fn camera(ui: &mut Ui, state: &mut State) {
    for (row, control) in Axis::ALL.chunks(3).zip(["", "Ctrl+"]) {
        ui.horizontal(|ui| {
            for (i, axis) in row.iter().enumerate() {
                if ui.button(axis.name()).on_hover_text(format!("{control}{}", i + 1)).clicked() {
                    state.view.look_along(*axis);
                    state.changed.cut = true;
                }
            }
            if !control.is_empty() {
                return;
            }
            if ui.button("reset").on_hover_text("R").clicked() {
                state.view.reset();
                state.changed.cut = true;
            }
            ui.toggle_value(&mut state.fly, "fly");
        });
    }
    ui.horizontal(|ui| {
        ui.label("field of view");
        let mut degrees = state.view.fov_y;
        if ui.add(DragValue::new(&mut degrees).range(1.0..=120.0).suffix("°")).changed() {
            state.view.set_fov(degrees);
            state.changed.camera = true;
        }
        let toggle = ui.toggle_value(&mut state.view.orthographic, "orthographic");
        state.changed.cut |= toggle.on_hover_text("Parallel rays, without perspective (5)").changed();
    });
    ui.horizontal(|ui| {
        for (label, value, range) in
            [("rx", &mut state.view.rx, -90.0..=90.0), ("ry", &mut state.view.ry, -360.0..=360.0)]
        {
            ui.label(label);
            state.changed.camera |=
                ui.add(DragValue::new(value).range(range).speed(0.2).max_decimals(2)).changed();
        }
        if let Some(mut scale) = state.view.parallel_scale() {
            ui.label("scale").on_hover_text("Half of the height that is seen, in bounding-sphere radii");
            if ui.add(DragValue::new(&mut scale).range(1e-3..=100.0).speed(0.01).max_decimals(3)).changed() {
                state.view.set_parallel_scale(scale);
                state.changed.camera = true;
            }
        } else {
            ui.label("distance");
            let distance = DragValue::new(&mut state.view.distance).range(DISTANCES);
            state.changed.camera |= ui.add(distance.speed(0.2).max_decimals(2)).changed();
        }
    });
}

fn part(ui: &mut Ui, state: &mut State) {
    let Some(facts) = &state.facts else {
        ui.weak("no volume");
        return;
    };
    for (axis, name) in ["x", "y", "z"].iter().enumerate() {
        ui.horizontal(|ui| {
            let most = facts.dims[axis] - 1;
            let [low, high] = &mut state.crop_draft[axis];
            ui.label(*name);
            ui.add(DragValue::new(low).range(0..=*high));
            ui.label("to");
            ui.add(DragValue::new(high).range(*low..=most));
        });
    }
    ui.horizontal(|ui| {
        let draft = state.crop_draft;
        if ui.button("Crop").on_hover_text("Renderer and predictor see only this part").clicked() {
            state.commands.push(Command::Crop(Some(draft)));
        }
        if ui.add_enabled(state.crop.is_some(), egui::Button::new("Whole")).clicked() {
            state.commands.push(Command::Crop(None));
        }
    });
}

fn series(ui: &mut Ui, state: &mut State) {
    let last = state.series.len() - 1;
    let mut index = state.index;
    ui.horizontal(|ui| {
        ui.toggle_value(&mut state.playing, "play");
        ui.add(DragValue::new(&mut state.hold).range(0.05..=10.0).speed(0.02).suffix(" s each"));
    });
    if ui.add(Slider::new(&mut index, 0..=last).text("step")).changed() && index != state.index {
        state.commands.push(Command::Step(index));
    }
}

fn files(ui: &mut Ui, state: &mut State) {
    ui.horizontal(|ui| {
        ui.add(egui::TextEdit::singleline(&mut state.texts.screenshot).desired_width(120.0));
        let [width, height] = &mut state.screenshot_size;
        ui.add(DragValue::new(width).range(1..=16384));
        ui.label("×");
        ui.add(DragValue::new(height).range(1..=16384));
    });
    ui.horizontal(|ui| {
        if ui.button("as the view").clicked() {
            state.screenshot_size = state.viewport;
        }
        if ui.button("Screenshot").on_hover_text("Always at full quality").clicked() {
            let file = state.texts.screenshot.trim().into();
            state.commands.push(Command::Screenshot(Shot { file, size: state.screenshot_size }));
        }
        if let Some(share) = state.screenshot_share {
            ui.add(egui::ProgressBar::new(share as f32).desired_width(80.0));
        }
    });
    ui.horizontal_wrapped(|ui| {
        ui.add(egui::TextEdit::singleline(&mut state.texts.recording).desired_width(120.0));
        match &state.recorder {
            None => {
                if ui.button("Record").on_hover_text("Records a path for `entire steer`").clicked() {
                    state.recorder = Some(Recorder::new(state.view.fov_y));
                }
            }
            Some(recorder) => {
                ui.label(format!("{} frames", recorder.frames()));
                if recorder.panned {
                    ui.weak("(panning is not recorded, since paths always look at the center)");
                }
                if ui.button("Save").clicked() {
                    let file = state.texts.recording.trim().into();
                    state.commands.push(Command::SaveRecording(file));
                }
                if ui.button("Discard").clicked() {
                    state.recorder = None;
                }
            }
        }
    });
}

fn about(ui: &mut Ui, state: &mut State) {
    ui.label(&state.device);
    if let Some(facts) = &state.facts {
        let [x, y, z] = facts.dims;
        ui.label(format!("{x} × {y} × {z} voxels, {}, {} … {}", facts.kind, facts.range.0, facts.range.1));
        let (low, high) = facts.own_range;
        if facts.range != facts.own_range && low < high {
            ui.horizontal_wrapped(|ui| {
                ui.label(format!("values of the voxels: {low} … {high}"));
                let why = "Makes the transfer function span the range of the voxel values";
                if ui.button("Span the data").on_hover_text(why).clicked() {
                    state.commands.push(Command::SpanData);
                }
            });
        }
        ui.label(format!("spacing {} × {} × {}", facts.spacing.x, facts.spacing.y, facts.spacing.z));
        ui.label(&state.bricks);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use egui::Shape;

    #[test]
    fn a_target_beyond_the_slider_is_shown_as_it_is() {
        let mut state = State::empty(1.0);
        let shown = egui::Context::default().run_ui(egui::RawInput::default(), |ui| steering(ui, &mut state));
        let number = |shape: &Shape| match shape {
            Shape::Text(text) => text.galley.text().trim_end_matches("ms").trim().parse::<f64>().ok(),
            _ => None,
        };
        let found: Vec<f64> = shown.shapes.iter().filter_map(|s| number(&s.shape)).collect();
        shown.drop_without_applying_deltas();
        assert!(found.contains(&1000.0), "milliseconds: {found:?}");
        assert!(state.steer.target == 1.0 && !state.changed.any());
    }
}
