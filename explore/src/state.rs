//! State that the interface shows and edits. The application acts on it.

use crate::camera::Viewpoint;
use crate::histogram::Histogram;
use crate::host::Options;
use crate::recent::Recent;
use crate::recording::Recorder;
use crate::scene::{Crop, Facts};
use crate::script::Shot;
use crate::steering::Steer;
use crate::transfer::{Curve, Edited, Opacity};
use crate::work_map::WorkMap;
use egui::TextureId;
use entire_core::scene::{COLOR_RAMP, Shading, Skipping};
use entire_vk_raycaster::Region;
use std::path::PathBuf;

/// Requests of the user that are carried out by the application, not by the interface.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Command {
    Open(PathBuf),
    /// Opens a volume of the time series.
    Step(usize),
    Cancel,
    Crop(Option<Crop>),
    /// Maps the voxels' own range to [0, 1].
    SpanData,
    LoadTransfer(PathBuf),
    SaveTransfer {
        file: PathBuf,
        paraview: bool,
    },
    Screenshot(Shot),
    SaveRecording(PathBuf),
    Forget,
}

/// Changes since the last frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Changed {
    pub(crate) camera: bool,
    /// True if the camera jumped.
    pub(crate) cut: bool,
    pub(crate) transfer: bool,
    /// True if the transfer function was replaced.
    pub(crate) replaced: bool,
    /// True if a mode, the target, the controller or another setting of steering changed.
    pub(crate) settings: bool,
}

impl Changed {
    /// True if the picture must be drawn again.
    pub(crate) fn any(&self) -> bool {
        *self != Self::default()
    }

    /// True if camera or transfer function changed abruptly.
    pub(crate) fn abrupt(&self) -> bool {
        self.cut || self.replaced
    }
}

/// A picture in the interface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Shown {
    /// The steered picture. Its texture coordinates are set once the frame's size is chosen.
    pub(crate) steered: TextureId,
    /// The picture at full quality, its size, and its finished regions.
    pub(crate) full: Option<(TextureId, [u32; 2], [Option<Region>; 2])>,
}

/// Progress of the refinement to full quality.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Rest {
    pub(crate) share: f64,
    pub(crate) remaining: f64,
    /// Seconds of the whole refinement, once it is finished.
    pub(crate) took: Option<f64>,
}

/// A handle of the transfer function's editor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Handle {
    Point(usize),
    Lobe(usize),
    Width(usize),
}

/// Contents of the text fields.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Texts {
    pub(crate) open: String,
    pub(crate) transfer: String,
    pub(crate) screenshot: String,
    pub(crate) recording: String,
}

#[derive(Default)]
pub(crate) struct State {
    pub(crate) steer: Steer,
    pub(crate) view: Viewpoint,
    pub(crate) edited: Edited,
    pub(crate) shading: Shading,
    pub(crate) skipping: Skipping,
    pub(crate) termination: f32,
    /// True if opacity is shown by its cube root, so that small values can be set.
    pub(crate) fine: bool,
    pub(crate) selected: Option<Handle>,
    pub(crate) dragged: Option<Handle>,

    pub(crate) path: Option<PathBuf>,
    pub(crate) facts: Option<Facts>,
    pub(crate) histogram: Option<Histogram>,
    pub(crate) bricks: String,
    pub(crate) device: String,
    pub(crate) predictor: String,
    pub(crate) calibration: String,
    pub(crate) crop: Option<Crop>,
    pub(crate) crop_draft: Crop,

    /// The volumes of a time series, and the index of the current one.
    pub(crate) series: Vec<PathBuf>,
    pub(crate) index: usize,
    pub(crate) playing: bool,
    /// Seconds for which a playing series shows each volume.
    pub(crate) hold: f32,

    pub(crate) fly: bool,
    pub(crate) show_box: bool,
    pub(crate) show_axes: bool,
    pub(crate) show_probe: bool,
    pub(crate) show_work: bool,
    pub(crate) work: Option<WorkMap>,
    pub(crate) probe: Option<(usize, u32)>,

    pub(crate) recorder: Option<Recorder>,
    pub(crate) recent: Recent,
    /// File that is loading, its stage, and the share that was read.
    pub(crate) loading: Option<(String, &'static str, f32)>,
    pub(crate) screenshot_share: Option<f64>,
    pub(crate) screenshot_size: [u32; 2],
    pub(crate) rest: Option<Rest>,
    /// The last message, and true if it is an error.
    pub(crate) said: Option<(String, bool)>,

    pub(crate) quit: bool,
    pub(crate) changed: Changed,
    pub(crate) commands: Vec<Command>,
    pub(crate) texts: Texts,
    pub(crate) picture: Option<Shown>,
    /// Size of the view, pixels.
    pub(crate) viewport: [u32; 2],
}

impl State {
    pub(crate) fn new(options: &Options, steer: Steer) -> Self {
        let ramp = Opacity::Points(vec![[0.0, 0.0], [1.0, 0.1]]);
        Self {
            steer,
            edited: Edited::new(Curve { opacity: ramp, colors: COLOR_RAMP.to_vec() }),
            shading: options.shading,
            skipping: options.skipping,
            termination: options.termination,
            fine: true,
            series: options.volumes.clone(),
            hold: 0.5,
            show_box: true,
            show_axes: true,
            recent: Recent::load(),
            screenshot_size: [1280, 720],
            texts: Texts {
                open: String::new(),
                transfer: "transfer.json".into(),
                screenshot: "screenshot.png".into(),
                recording: "path.json".into(),
            },
            ..Self::default()
        }
    }

    /// The state of a window without a volume.
    #[cfg(test)]
    pub(crate) fn empty(target: f64) -> Self {
        let options = Options {
            volumes: vec![],
            target,
            controller: "a".into(),
            shading: Shading::None,
            skipping: Skipping::Blocks,
            termination: 0.99,
            size: (640, 480),
            script: None,
            log: None,
        };
        Self::new(&options, Steer::new(vec![("a", "A")], 0, target))
    }

    /// Shows a message.
    pub(crate) fn say(&mut self, text: impl Into<String>) {
        self.said = Some((text.into(), false));
    }

    /// Shows an error.
    pub(crate) fn complain(&mut self, error: &anyhow::Error) {
        self.said = Some((format!("{error:#}"), true));
    }

    /// Applies a preset. Returns false if there is no volume or no preset of this name.
    pub(crate) fn preset(&mut self, name: &str) -> bool {
        let Some(mut curve) = self.histogram.as_ref().and_then(|h| Curve::preset(name, h)) else {
            return false;
        };
        curve.colors.clone_from(&self.edited.curve.colors);
        self.replace(curve);
        true
    }

    pub(crate) fn replace(&mut self, curve: Curve) {
        self.edited.replace(curve);
        self.selected = None;
        self.changed.transfer = true;
        self.changed.replaced = true;
    }
}
