//! Recording of the user's views and transfer functions, frame by frame, as a path.

use crate::camera::Viewpoint;
use crate::transfer::Curve;
use anyhow::{Context, Result, bail, ensure};
use entire_core::scene::Arcball;
use entire_io::files::write_whole;
use entire_io::path::{CameraPose, Keyframe, MAX_PATH_BYTES, PATH_FORMAT, PathFile, Transfer};
use std::path::Path;

/// Maximum number of frames of a recording.
const MOST_FRAMES: usize = 1_000_000;

/// A frame that was drawn.
#[derive(Clone, Debug)]
struct Frame {
    camera: CameraPose,
    /// True if the camera jumped between the previous frame and this one.
    camera_switched: bool,
    /// The transfer function, if it differs from that of the previous frame.
    transfer: Option<Transfer>,
    /// True if the transfer function was replaced at once, not dragged.
    transfer_switched: bool,
}

/// A recording that is in progress.
#[derive(Debug, Default)]
pub(crate) struct Recorder {
    /// Vertical field of view, degrees.
    fov_y_degrees: f32,
    /// Every frame in order; the first has a transfer function.
    frames: Vec<Frame>,
    /// The transfer function of the last frame.
    curve: Option<Curve>,
    /// True if a frame was panned. Path files cannot contain pans.
    pub(crate) panned: bool,
}

/// Thresholds above which the camera counts as jumped: degrees between two frames, and ratio of distances or
/// scales.
const JUMP: (f32, f32) = (20.0, 1.5);

impl Recorder {
    pub(crate) fn new(fov_y_degrees: f32) -> Self {
        Self { fov_y_degrees, ..Self::default() }
    }

    pub(crate) fn note(&mut self, view: &Viewpoint, curve: &Curve, replaced: bool) -> Result<()> {
        if self.frames.len() >= MOST_FRAMES {
            return Ok(());
        }
        self.panned |= view.target != glam::Vec3::ZERO;
        let Arcball { rx, ry, dz } = view.arcball();
        let parallel_scale = view.parallel_scale();
        let mut camera = CameraPose { rx_deg: rx, ry_deg: ry, dz_radii: dz, parallel_scale };
        if !view.orthographic {
            // A path has one field of view. The recorded distance is the one at which this field of view
            // shows the volume in the same size.
            camera.dz_radii *= view.distance_factor(self.fov_y_degrees);
        }
        let mut switched = false;
        if let Some(Frame { camera: before, .. }) = self.frames.last() {
            // Angles continue beyond a full turn, so that interpolation between two frames turns the short
            // way.
            camera.ry_deg += 360.0 * ((before.ry_deg - camera.ry_deg) / 360.0).round();
            let turned = (camera.ry_deg - before.ry_deg).abs().max((camera.rx_deg - before.rx_deg).abs());
            let moved = match (parallel_scale, before.parallel_scale) {
                (None, None) => camera.dz_radii / before.dz_radii,
                (Some(now), Some(then)) => now / then,
                // The projection was switched.
                _ => f32::INFINITY,
            };
            switched = turned > JUMP.0 || moved.max(1.0 / moved) > JUMP.1;
        }
        let changed = self.curve.as_ref() != Some(curve);
        let transfer = if changed { Some(curve.recorded()?) } else { None };
        let transfer_switched = changed && replaced;
        self.frames.push(Frame { camera, camera_switched: switched, transfer, transfer_switched });
        self.curve = Some(curve.clone());
        Ok(())
    }

    pub(crate) fn frames(&self) -> usize {
        self.frames.len()
    }

    /// Writes a recording by `write` and ends it. If the file cannot be written, the recording continues.
    ///
    /// # Errors
    /// When no frame was recorded, or `write` fails.
    pub(crate) fn save(recorder: &mut Option<Self>, write: impl FnOnce(&Self) -> Result<()>) -> Result<()> {
        match recorder {
            Some(current) if current.frames() > 0 => write(current)?,
            Some(_) => bail!("nothing was recorded: no frame was drawn since the recording began"),
            None => bail!("nothing was recorded"),
        }
        *recorder = None;
        Ok(())
    }

    /// Writes the recording as a path file.
    ///
    /// # Errors
    /// When the recording cannot be played or is too long to be read back, or the file cannot be written.
    pub(crate) fn write(&self, file: &Path) -> Result<()> {
        let path = path_file(self);
        path.resolve().context("the recording cannot be played")?;
        // Without indentation, which would more than double the size of the points of transfer functions.
        let text = serde_json::to_string(&path)? + "\n";
        ensure!(
            text.len() as u64 <= MAX_PATH_BYTES,
            "the recording takes {} bytes, but a path file has at most {MAX_PATH_BYTES} bytes; drag the \
             transfer function in fewer frames",
            text.len()
        );
        write_whole(file, text.as_bytes())
    }
}

/// Returns a recording as a path file. The frame before each change gets a keyframe with the old values, so
/// that the values are not interpolated over earlier frames.
fn path_file(recording: &Recorder) -> PathFile {
    let frames = &recording.frames;
    let mut keys: Vec<Keyframe> = (0..frames.len() as u32)
        .map(|frame| Keyframe { frame, camera: None, transfer: None, switch: false })
        .collect();
    let mut held: Option<Transfer> = None;
    for (i, frame) in frames.iter().enumerate() {
        if i == 0 || frame.camera != frames[i - 1].camera {
            keys[i].camera = Some(frame.camera);
            keys[i].switch |= i > 0 && frame.camera_switched;
            if i > 0 {
                keys[i - 1].camera = Some(frames[i - 1].camera);
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
        let at = |ry_deg, parallel_scale| CameraPose { rx_deg: 10.0, ry_deg, dz_radii: 2.0, parallel_scale };
        let frame = |ry, camera_switched, transfer| Frame {
            camera: at(ry, None),
            camera_switched,
            transfer,
            transfer_switched: false,
        };
        let recording = Recorder {
            fov_y_degrees: 40.0,
            frames: vec![
                frame(0.0, false, lobes(0.1)),
                frame(0.0, false, None),
                frame(0.0, false, None),
                frame(4.0, false, None),
                frame(90.0, true, None),
                Frame { transfer_switched: true, ..frame(90.0, false, lobes(0.3)) },
                frame(90.0, false, None),
                frame(90.0, false, lobes(0.4)),
                Frame { camera: at(90.0, Some(0.8)), ..frame(90.0, true, None) },
                Frame { camera: at(95.0, Some(0.7)), ..frame(95.0, false, None) },
            ],
            ..Recorder::default()
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
        let frames = recorder.frames;
        assert_eq!(frames[1].camera.ry_deg, 365.0);
        let switched: Vec<bool> = frames.iter().map(|f| f.camera_switched).collect();
        assert_eq!(switched, [false, false, true, true, false, true]);
        let edited: Vec<bool> = frames.iter().map(|f| f.transfer.is_some()).collect();
        assert_eq!(edited, [true, false, true, false, false, false]);
        let scales: Vec<Option<f32>> = frames.iter().map(|f| f.camera.parallel_scale).collect();
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
        let [before, after] = [0, 1].map(|i| &recorder.frames[i]);
        assert_eq!(before.camera.dz_radii, Viewpoint::default().distance);
        assert!((after.camera.dz_radii / before.camera.dz_radii - 1.0).abs() < 1e-5, "{after:?}");
        assert!(view.distance < 0.5 * before.camera.dz_radii && !after.camera_switched, "{after:?}");
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
