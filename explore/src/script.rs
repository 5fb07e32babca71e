//! Events from a file instead of user input, as JSON lines. Each line is an object with one action and a
//! frame number, counted from 0; the action runs before the frame with this number is drawn.
//!
//! | action | value |
//! |---|---|
//! | `camera` | `[rx, ry, dz]`: degrees, degrees, bounding-sphere radii; counts as a jump |
//! | `spin` | `[right, down]`: degrees per frame from here on |
//! | `view` | `front`, `right`, `top`, `back`, `left` or `bottom` |
//! | `orthographic` | true or false |
//! | `zoom` | factor of the distance, or of an orthographic view's scale |
//! | `pan` | `[right, down]` in heights of the view |
//! | `preset` | the name of a preset |
//! | `lobes` | `[[center, width, height], …]` |
//! | `drag` | `[center, height]`, added to the first lobe in every frame from here on |
//! | `controller` | the name of a controller |
//! | `steering` | true or false |
//! | `target` | seconds |
//! | `shading`, `skipping` | a mode's name |
//! | `size` | `[width, height]` of the window, pixels |
//! | `open` | a volume file |
//! | `screenshot` | `{"file": …, "size": [width, height]}`; the script waits for it |
//! | `rest` | true: waits until the picture is at full quality |
//! | `full_frame` | true: draws the view at full quality in one piece, for the log |
//! | `crop` | `[[first, last], …]` voxels along x, y, z; null for all |
//! | `span_data` | true: the transfer function spans the voxels' own range, not that of the file or type |
//! | `map` | true: counts the samples per ray by cell of the image, and shows the map |
//! | `save_transfer`, `load_transfer` | a file |
//! | `undo` | true: undoes the last edit |
//! | `record`, `save_recording` | true; a path file |
//! | `lose_device` | true: simulates the loss of the device; as first action at frame 0: during the load |
//! | `quit` | true: closes the window |

use crate::exchange::MOST_BYTES;
use anyhow::{Context, Result, ensure};
use entire_io::files::read_text;
use serde::Deserialize;
use serde_json::{Map, Value};
use std::collections::VecDeque;
use std::path::{Path, PathBuf};

/// Action of an event.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Action {
    Camera([f32; 3]),
    Spin([f32; 2]),
    View(String),
    Orthographic(bool),
    Zoom(f32),
    Pan([f32; 2]),
    Preset(String),
    Lobes(Vec<[f32; 3]>),
    Drag([f32; 2]),
    Controller(String),
    Steering(bool),
    Target(f64),
    Shading(String),
    Skipping(String),
    Size([u32; 2]),
    Open(PathBuf),
    /// First and last voxel along x, y, z; null for all.
    Crop(Option<[[usize; 2]; 3]>),
    /// True: the voxels' own range maps to [0, 1].
    SpanData(bool),
    Screenshot(Shot),
    Rest(bool),
    FullFrame(bool),
    Map(bool),
    SaveTransfer(PathBuf),
    LoadTransfer(PathBuf),
    Undo(bool),
    Record(bool),
    SaveRecording(PathBuf),
    LoseDevice(bool),
    Quit(bool),
}

/// A picture to write.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Shot {
    pub(crate) file: PathBuf,
    pub(crate) size: [u32; 2],
}

#[derive(Debug, Default)]
pub(crate) struct Script {
    events: VecDeque<(u64, Action)>,
    pub(crate) spin: [f32; 2],
    pub(crate) drag: [f32; 2],
}

impl Script {
    pub(crate) fn open(path: &Path) -> Result<Self> {
        let text = read_text(path, MOST_BYTES)
            .with_context(|| format!("cannot read the script {}", path.display()))?;
        Self::parse(&text).with_context(|| path.display().to_string())
    }

    fn parse(text: &str) -> Result<Self> {
        let mut events = VecDeque::new();
        let mut last = 0;
        for (i, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
            let (frame, action) = event(line).with_context(|| format!("line {}", i + 1))?;
            ensure!(
                frame >= last,
                "line {} is for frame {frame}, after a line for frame {last}; order the lines by frame",
                i + 1
            );
            last = frame;
            events.push_back((frame, action));
        }
        Ok(Self { events, ..Self::default() })
    }

    /// Takes the next action that is due before a frame.
    pub(crate) fn next(&mut self, frame: u64) -> Option<Action> {
        self.events.pop_front_if(|(at, _)| *at <= frame).map(|(_, action)| action)
    }

    /// Takes the first action if it is the loss of the device before frame 0.
    pub(crate) fn initial_loss(&mut self) -> Option<Action> {
        self.events.pop_front_if(|event| *event == (0, Action::LoseDevice(true))).map(|(_, action)| action)
    }

    pub(crate) fn is_done(&self) -> bool {
        self.events.is_empty()
    }
}

/// Reads a line: the number of the frame, and the only other field.
fn event(line: &str) -> Result<(u64, Action)> {
    let mut fields: Map<String, Value> = serde_json::from_str(line)?;
    let frame =
        fields.remove("frame").context("`frame` is missing; give the frame before which the action runs")?;
    let frame = serde_json::from_value(frame).context("`frame`")?;
    let mut names: Vec<&str> = fields.keys().map(String::as_str).collect();
    names.sort_unstable();
    ensure!(
        names.len() == 1,
        "a line must have one action, but this line has {} ({}); put each action on its own line",
        names.len(),
        names.join(", ")
    );
    Ok((frame, serde_json::from_value(Value::Object(fields))?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_come_in_order_before_their_frame() {
        let text = r#"
            {"frame": 0, "camera": [10, 20, 2.5]}
            {"frame": 2, "preset": "core"}
            {"frame": 2, "screenshot": {"file": "a.png", "size": [64, 48]}}
            {"frame": 5, "quit": true}"#;
        let mut script = Script::parse(text).unwrap();
        assert_eq!(script.next(0), Some(Action::Camera([10.0, 20.0, 2.5])));
        assert_eq!(script.next(0), None);
        assert_eq!(script.next(3), Some(Action::Preset("core".into())));
        assert!(matches!(script.next(3), Some(Action::Screenshot(_))));
        assert!(script.next(4).is_none() && !script.is_done());
        assert_eq!(script.initial_loss(), None);
        assert_eq!(script.next(5), Some(Action::Quit(true)));
        assert!(script.is_done());
    }

    #[test]
    fn what_is_wrong_is_said_with_its_line() {
        for (text, says) in [
            ("{\"frame\": 1, \"spin\": [1, 2]}\n{\"frame\": 0, \"quit\": true}", "line 2 is for frame 0"),
            ("{\"frame\": 1, \"dance\": true}", "line 1"),
            ("{\"spin\": [1, 2]}", "line 1"),
            ("{\"frame\": 1, \"spin\": [1, 2], \"preset\": \"core\"}", "(preset, spin)"),
        ] {
            let e = format!("{:#}", Script::parse(text).unwrap_err());
            assert!(e.contains(says), "{text}: {e}");
        }
    }
}
