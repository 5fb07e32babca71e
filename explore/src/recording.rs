//! Recording of the user's views and transfer functions, frame by frame, as a path.

use crate::camera::Viewpoint;
use crate::transfer::Curve;
use anyhow::{Context, Result, bail};
use entire_core::scene::Arcball;
use entire_io::files::write_json;
use entire_io::path::{CameraPose, Keyframe, PATH_FORMAT, PathFile, Transfer};
use std::path::Path;

/// Maximum number of frames of a recording.
const MOST_FRAMES: usize = 1_000_000;

/// A frame that was drawn.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct RecordedFrame {
    /// The pose of the eye about the volume's center.
    pub(crate) camera: Arcball,
    /// Half of the visible height of an orthographic view, bounding-sphere radii; `None` for a perspective
    /// view.
    pub(crate) parallel_scale: Option<f32>,
    /// True if the camera jumped between the previous frame and this one.
    pub(crate) camera_switched: bool,
    /// The transfer function (lobes or points), if it differs from that of the previous frame.
    pub(crate) transfer: Option<Transfer>,
    /// True if the transfer function was replaced at once, not dragged.
    pub(crate) transfer_switched: bool,
}

/// A recorded session.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Recording {
    /// Vertical field of view, degrees.
    pub(crate) fov_y_degrees: f32,
    /// Every frame in order; the first has a transfer function.
    pub(crate) frames: Vec<RecordedFrame>,
}

impl Recording {
    /// Writes the recording as a path file.
    pub(crate) fn write(&self, file: &Path) -> Result<()> {
        let path = path_file(self);
        // A recording that cannot be played is not written.
        path.resolve().context("the recording cannot be played")?;
        write_json(file, &path)
    }
}

/// A recording that is in progress.
#[derive(Debug)]
pub(crate) struct Recorder {
    recording: Recording,
    last: Option<(Arcball, Option<f32>, Curve)>,
    /// True if a frame was panned. Path files cannot contain pans.
    pub(crate) panned: bool,
}

/// Thresholds above which the camera counts as jumped: degrees between two frames, and ratio of distances or
/// scales.
const JUMP: (f32, f32) = (20.0, 1.5);

impl Recorder {
    pub(crate) fn new(fov_y_degrees: f32) -> Self {
        Self { recording: Recording { fov_y_degrees, frames: Vec::new() }, last: None, panned: false }
    }

    pub(crate) fn note(&mut self, view: &Viewpoint, curve: &Curve, replaced: bool) -> Result<()> {
        if self.recording.frames.len() >= MOST_FRAMES {
            return Ok(());
        }
        self.panned |= view.target != glam::Vec3::ZERO;
        let mut camera = view.arcball();
        if !view.orthographic {
            // A path has one field of view. The recorded distance is the one at which this field of view
            // shows the volume in the same size.
            camera.dz *= view.distance_factor(self.recording.fov_y_degrees);
        }
        let mut switched = false;
        let parallel_scale = view.parallel_scale();
        if let Some((before, scale, _)) = &self.last {
            // Angles continue beyond a full turn, so that interpolation between two frames turns the short
            // way.
            camera.ry += 360.0 * ((before.ry - camera.ry) / 360.0).round();
            let turned = (camera.ry - before.ry).abs().max((camera.rx - before.rx).abs());
            let moved = match (parallel_scale, *scale) {
                (None, None) => camera.dz / before.dz,
                (Some(now), Some(then)) => now / then,
                // The projection was switched.
                _ => f32::INFINITY,
            };
            switched = turned > JUMP.0 || moved.max(1.0 / moved) > JUMP.1;
        }
        let changed = self.last.as_ref().is_none_or(|(.., before)| before != curve);
        let transfer = if changed { Some(curve.recorded()?) } else { None };
        self.recording.frames.push(RecordedFrame {
            camera,
            parallel_scale,
            camera_switched: switched,
            transfer,
            transfer_switched: changed && replaced,
        });
        self.last = Some((camera, parallel_scale, curve.clone()));
        Ok(())
    }

    pub(crate) fn frames(&self) -> usize {
        self.recording.frames.len()
    }

    /// Writes a recording by `write` and ends it. If the file cannot be written, the recording continues.
    ///
    /// # Errors
    /// When no frame was recorded, or `write` fails.
    pub(crate) fn save(
        recorder: &mut Option<Self>,
        write: impl FnOnce(&Recording) -> Result<()>,
    ) -> Result<()> {
        match recorder {
            Some(current) if current.frames() > 0 => write(&current.recording)?,
            Some(_) => bail!("nothing was recorded: no frame was drawn since the recording began"),
            None => bail!("nothing was recorded"),
        }
        *recorder = None;
        Ok(())
    }
}

/// Returns a recording as a path file. The frame before each change gets a keyframe with the old values, so
/// that the values are not interpolated over earlier frames.
fn path_file(recording: &Recording) -> PathFile {
    let frames = &recording.frames;
    let mut keys: Vec<Keyframe> = (0..frames.len() as u32)
        .map(|frame| Keyframe { frame, camera: None, transfer: None, switch: false })
        .collect();
    let pose = |i: usize| {
        let Arcball { rx, ry, dz } = frames[i].camera;
        let parallel_scale = frames[i].parallel_scale;
        CameraPose { rx_deg: rx, ry_deg: ry, dz_radii: dz, parallel_scale }
    };
    let mut held: Option<Transfer> = None;
    for (i, frame) in frames.iter().enumerate() {
        if i == 0 || pose(i) != pose(i - 1) {
            keys[i].camera = Some(pose(i));
            keys[i].switch |= i > 0 && frame.camera_switched;
            if i > 0 {
                keys[i - 1].camera = Some(pose(i - 1));
            }
        }
        if let Some(found) = &frame.transfer {
            let dragged = held.as_ref().filter(|h| !frame.transfer_switched && alike(h, found)).cloned();
            keys[i].switch |= i > 0 && dragged.is_none();
            if let (Some(before), true) = (dragged, i > 0) {
                keys[i - 1].transfer = Some(before);
            }
            keys[i].transfer = Some(found.clone());
            held = Some(found.clone());
        }
    }
    keys.retain(|k| k.camera.is_some() || k.transfer.is_some());
    PathFile {
        format: PATH_FORMAT.into(),
        name: "recorded".into(),
        frames: frames.len() as u32,
        fov_y_deg: recording.fov_y_degrees,
        keyframes: keys,
    }
}

/// True if the two transfer functions can be interpolated: both have lobes or both have points, of equal
/// number.
fn alike(a: &Transfer, b: &Transfer) -> bool {
    match (a, b) {
        (Transfer::Lobes(a), Transfer::Lobes(b)) => a.len() == b.len(),
        (Transfer::Points(a), Transfer::Points(b)) => a.len() == b.len(),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::histogram::Histogram;
    use entire_core::GaussianLobe;

    #[test]
    fn a_recording_plays_as_it_was_made() {
        let lobes = |height| Some(Transfer::Lobes(vec![GaussianLobe { center: 0.5, width: 0.01, height }]));
        let at = |ry| Arcball { rx: 10.0, ry, dz: 2.0 };
        let frame = |ry, camera_switched, transfer| RecordedFrame {
            camera: at(ry),
            parallel_scale: None,
            camera_switched,
            transfer,
            transfer_switched: false,
        };
        let recording = Recording {
            fov_y_degrees: 40.0,
            frames: vec![
                frame(0.0, false, lobes(0.1)),
                frame(0.0, false, None),
                frame(0.0, false, None),
                frame(4.0, false, None),
                frame(90.0, true, None),
                RecordedFrame { transfer_switched: true, ..frame(90.0, false, lobes(0.3)) },
                frame(90.0, false, None),
                frame(90.0, false, lobes(0.4)),
                RecordedFrame { parallel_scale: Some(0.8), ..frame(90.0, true, None) },
                RecordedFrame { parallel_scale: Some(0.7), ..frame(95.0, false, None) },
            ],
        };
        let file = path_file(&recording);
        let path = file.resolve().unwrap();
        assert_eq!(path.fov_y_degrees, 40.0);
        let angles: Vec<f32> = path.frames.iter().map(|f| f.camera.ry).collect();
        assert_eq!(angles, [0.0, 0.0, 0.0, 4.0, 90.0, 90.0, 90.0, 90.0, 90.0, 95.0], "{file:?}");
        assert_eq!(path.switches(), [4, 5, 8], "the drag is no switch");
        let scales: Vec<_> = path.frames[7..].iter().map(|f| f.parallel_scale).collect();
        assert_eq!(scales, [None, Some(0.8), Some(0.7)]);
        let heights: Vec<f32> = path.frames.iter().map(|f| f.transfer.lobes().unwrap()[0].height).collect();
        assert_eq!(heights, [0.1, 0.1, 0.1, 0.1, 0.1, 0.3, 0.3, 0.4, 0.4, 0.4]);
    }

    #[test]
    fn changes_and_jumps_are_noted_and_angles_go_on() {
        let curve = |name| Curve::preset(name, &Histogram { counts: vec![5; 256] }).unwrap();
        let mut recorder = Recorder::new(45.0);
        let mut view = Viewpoint { ry: 350.0, ..Default::default() };
        recorder.note(&view, &curve("shell"), true).unwrap();
        view.ry = 5.0;
        recorder.note(&view, &curve("shell"), true).unwrap();
        view.ry = 60.0;
        recorder.note(&view, &curve("core"), true).unwrap();
        // From here on, the view is orthographic; then it is zoomed.
        view.orthographic = true;
        recorder.note(&view, &curve("core"), true).unwrap();
        view.zoom(0.9);
        recorder.note(&view, &curve("core"), true).unwrap();
        view.zoom(0.5);
        recorder.note(&view, &curve("core"), true).unwrap();
        let frames = recorder.recording.frames;
        assert_eq!(frames[1].camera.ry, 365.0);
        let switched: Vec<bool> = frames.iter().map(|f| f.camera_switched).collect();
        assert_eq!(switched, [false, false, true, true, false, true]);
        let edited: Vec<bool> = frames.iter().map(|f| f.transfer.is_some()).collect();
        assert_eq!(edited, [true, false, true, false, false, false]);
        let scales: Vec<Option<f32>> = frames.iter().map(|f| f.parallel_scale).collect();
        assert_eq!(scales[..3], [None; 3]);
        assert!((scales[4].unwrap() / scales[3].unwrap() - 0.9).abs() < 1e-5);
    }

    #[test]
    fn a_changed_field_of_view_is_recorded_as_the_distance_that_shows_as_much() {
        let curve = Curve::preset("shell", &Histogram { counts: vec![5; 256] }).unwrap();
        let mut view = Viewpoint::default();
        let mut recorder = Recorder::new(view.fov_y);
        recorder.note(&view, &curve, true).unwrap();
        view.set_fov(90.0);
        recorder.note(&view, &curve, true).unwrap();
        let [before, after] = [0, 1].map(|i| &recorder.recording.frames[i]);
        assert_eq!(before.camera.dz, Viewpoint::default().distance);
        assert!((after.camera.dz / before.camera.dz - 1.0).abs() < 1e-5, "{after:?}");
        assert!(view.distance < 0.5 * before.camera.dz && !after.camera_switched, "{after:?}");
    }

    #[test]
    fn a_recording_that_cannot_be_written_continues() {
        let curve = Curve::preset("shell", &Histogram { counts: vec![5; 256] }).unwrap();
        let mut recorder = Some(Recorder::new(45.0));
        let refused = Recorder::save(&mut recorder, |_| panic!("no frame was recorded")).unwrap_err();
        assert!(refused.to_string().contains("no frame was drawn"), "{refused}");
        recorder.as_mut().unwrap().note(&Viewpoint::default(), &curve, true).unwrap();
        let full = Recorder::save(&mut recorder, |_| bail!("the disk is full")).unwrap_err();
        assert_eq!(full.to_string(), "the disk is full");
        recorder.as_mut().unwrap().note(&Viewpoint::default(), &curve, true).unwrap();
        let mut written = 0;
        Recorder::save(&mut recorder, |recording| {
            written = recording.frames.len();
            Ok(())
        })
        .unwrap();
        assert!(written == 2 && recorder.is_none(), "{written}");
    }
}
