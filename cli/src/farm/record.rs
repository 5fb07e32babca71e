//! Messages between driver, workers and journal, one JSON object per line.

use crate::identity::Identity;
use crate::path::Transfer;
use crate::volume::Reading;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// A task as a worker gets it: everything that it needs.
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
    /// Options of its reading.
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
    /// Where the image goes, relative to the database.
    pub image: String,
    /// Seconds that it is expected to take.
    pub predicted_s: f64,
    /// Identities of the volume's files: the picture must be of these.
    #[serde(default)]
    pub files: Vec<Identity>,
}

/// Tasks that are done by one worker, one after the other.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BundleOrder {
    /// The bundle's number in this run.
    pub bundle: u64,
    /// The run that it belongs to: when another has begun, no further task of it is.
    pub run: u64,
    /// The tasks.
    pub tasks: Vec<Order>,
}

/// Result of a task.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Answer {
    /// The task's id.
    pub task: String,
    /// The bundle it came in.
    pub bundle: u64,
    /// Who did it.
    pub node: String,
    /// Seconds without loading: rendering, and the image on the disk.
    pub seconds: f64,
    /// Seconds of the frame alone, where the renderer says so.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub render_s: Option<f64>,
    /// Seconds to load the volume; zero where it was there.
    pub load_s: f64,
    /// When it began, seconds since 1970.
    pub begin: f64,
    /// When it ended, seconds since 1970.
    pub end: f64,
    /// Size of the image file.
    pub bytes: u64,
    /// CRC-32 of the image file.
    pub crc32: u32,
    /// Why there is no image.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
    /// True if the cause was a full disk.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub disk_full: bool,
}

/// A line from a worker.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Line {
    /// A task is over.
    Answer(Answer),
    /// A bundle is over.
    End {
        /// Its number.
        end: u64,
    },
    /// A worker is at work on a task.
    Begin {
        /// Its id.
        begins: String,
    },
}

/// A line of the journal.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Entry {
    /// A run begins.
    Run {
        /// The journal's format.
        format: String,
        /// The job's name.
        job: String,
        /// When, UTC.
        date: String,
        /// Engine that runs the tasks.
        engine: String,
        /// Number of slots.
        slots: usize,
        /// When, seconds since 1970.
        at: f64,
    },
    /// Identities of the volumes' files from here on, by path.
    Inputs {
        /// The files.
        files: BTreeMap<String, Vec<Identity>>,
    },
    /// A task is done, its image in place.
    Done {
        /// Measured times and result.
        answer: Answer,
        /// Seconds that were expected when it was sent.
        predicted_s: f64,
    },
    /// A task failed.
    Failed {
        /// Its id.
        task: String,
        /// Why.
        error: String,
    },
    /// A task was lost with its worker.
    Lost {
        /// Its id.
        task: String,
        /// Why.
        why: String,
    },
    /// A task is given up.
    Quarantined {
        /// Its id.
        task: String,
        /// Why.
        error: String,
        /// Where its log is, relative to the database.
        log: String,
    },
    /// Estimate of the end, for the report.
    Eta {
        /// When, seconds since 1970.
        at: f64,
        /// Share of tasks that were done.
        share: f64,
        /// The end at 5, 50 and 95 percent, seconds since 1970.
        ends: [f64; 3],
    },
}

/// The journal's format.
pub const JOURNAL_FORMAT: &str = "entire-farm-journal-2";

/// The format of journals that do not tell what pictures were made of.
pub const BARE_JOURNAL_FORMAT: &str = "entire-farm-journal-1";

/// Seconds since 1970.
pub fn unix_now() -> f64 {
    std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64())
}

/// A task's id from its text.
pub fn parse_id(text: &str) -> Option<u64> {
    (text.len() == 16).then(|| u64::from_str_radix(text, 16).ok())?
}
