//! Messages between driver, workers and journal, one JSON object per line.

use entire_io::identity::Identity;
use entire_io::path::Transfer;
use entire_io::volume::Reading;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Number of the current run of the database with this state folder; `None` before the first run.
pub(crate) fn run_number(state: &Path) -> Option<u64> {
    std::fs::read_to_string(state.join("run")).ok()?.trim().parse().ok()
}

/// Work order of a task: all data that a worker needs to render it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Order {
    /// The task's id, 16 hexadecimal digits.
    pub task: String,
    /// The volume file.
    pub volume: PathBuf,
    /// The volume's name.
    pub volume_name: String,
    /// Time step.
    pub time: u32,
    /// Options with which the volume file is read.
    #[serde(default)]
    pub reading: Reading,
    /// Rotation about x and y in degrees, distance in bounding-sphere radii.
    pub camera: [f32; 3],
    /// Vertical field of view, degrees.
    pub fov_y_deg: f32,
    /// The transfer function's name.
    pub transfer_name: String,
    /// The transfer function.
    pub transfer: Transfer,
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Step in reference steps.
    pub step: f32,
    /// Path of the image, relative to the database.
    pub image: String,
    /// Expected rendering time, seconds.
    pub predicted_s: f64,
    /// Identities of the volume's files. If the files differ after the picture was drawn, the task fails.
    #[serde(default)]
    pub files: Vec<Identity>,
}

#[cfg(test)]
pub(crate) fn an_order(volume_name: &str) -> Order {
    serde_json::from_value(serde_json::json!({
        "task": "7", "volume": "v.raw", "volume_name": volume_name, "time": 0, "camera": [0, 0, 2],
        "fov_y_deg": 30, "transfer_name": "t", "transfer": { "lobes": [] }, "size": [1, 1], "step": 1,
        "image": "i.png", "predicted_s": 1,
    }))
    .unwrap()
}

/// Tasks for one worker, one after another.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct BundleOrder {
    pub(crate) bundle: u64,
    /// Number of the run that sent the bundle. If another run has begun, the worker stops.
    pub(crate) run: u64,
    pub(crate) tasks: Vec<Order>,
}

/// Result of a task.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Answer {
    /// The task's id.
    pub task: String,
    /// Number of the task's bundle.
    pub bundle: u64,
    /// Name of the node that rendered the task.
    pub node: String,
    /// Seconds without loading: rendering, and writing the image.
    pub seconds: f64,
    /// Seconds of the frame only, if the renderer reports them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub render_s: Option<f64>,
    /// Seconds to load the volume; zero if the worker already had it in memory.
    pub load_s: f64,
    /// Start, seconds since 1970.
    pub begin: f64,
    /// End, seconds since 1970.
    pub end: f64,
    /// Size of the image file, bytes.
    pub bytes: u64,
    /// CRC-32 of the image file.
    pub crc32: u32,
    /// Expected rendering time in the task's order, seconds; 0 if unknown.
    #[serde(default)]
    pub predicted_s: f64,
    /// Reason for a missing image.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
    /// True if the task failed because the disk was full.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub disk_full: bool,
}

/// A line from a worker.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Line {
    /// A task has ended.
    Answer(Answer),
    /// A bundle has ended.
    End {
        /// Number of the bundle.
        end: u64,
    },
    /// A worker has started a task.
    Begin {
        /// Id of the task.
        begins: String,
    },
}

/// A line of the journal. The fields `at` and `ends` are in seconds since 1970.
/// - `Run`: a run has started; `date` is UTC, ISO 8601.
/// - `Inputs`: identities of the files of all volumes, by path, until the next line of this kind.
/// - `Done`: a task is finished, and its image is complete. `predicted_s`: rendering seconds that were expected
///   when the task was sent.
/// - `Failed`, `Lost`: a task failed, or was lost with its worker.
/// - `Quarantined`: a task was given up. `log`: path of the task's log, relative to the database.
/// - `Eta`: estimated end of the job, for the report. `share`: share of finished tasks; `ends`: quantiles 0.05,
///   0.5 and 0.95 of the end.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Entry {
    Run { format: String, job: String, date: String, engine: String, slots: usize, at: f64 },
    Inputs { files: BTreeMap<String, Vec<Identity>> },
    Done { answer: Answer, predicted_s: f64 },
    Failed { task: String, error: String },
    Lost { task: String, why: String },
    Quarantined { task: String, error: String, log: String },
    Eta { at: f64, share: f64, ends: [f64; 3] },
}

pub(crate) const JOURNAL_FORMAT: &str = "entire-farm-journal-2";

/// Seconds since 1970.
pub(crate) fn unix_now() -> f64 {
    std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64())
}

/// Parses a task's id; `None` if the text is no id.
pub(crate) fn parse_id(text: &str) -> Option<u64> {
    (text.len() == 16).then(|| u64::from_str_radix(text, 16).ok())?
}
